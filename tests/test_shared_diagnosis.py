"""A diagnosis whose training logs lie in several places comes to what one process comes to."""

import dataclasses

import numpy as np
import pytest

from jaxmarine._errors import InputError
from jaxmarine.diagnosis import _workbench, diagnose
from jaxmarine.diagnosis._keeper import Part
from jaxmarine.diagnosis._knots import Knots, missing_wrench
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._score import Reduced
from jaxmarine.diagnosis._shared import _Desk, _Elsewhere, _laid, opened_over
from jaxmarine.diagnosis._unknown import _Ledger
from jaxmarine.effects import AddedMass, LinearDamping, QuadraticDamping, ThrusterGain, Voltage, place
from jaxmarine.fitting import Share, Shares
from jaxmarine.logs import read_logs, write_log
from jaxmarine.vehicle import Placed
from jaxmarine.vehicle_io import load_vehicle, save_vehicle, suspect_named
from tests.boats import NOISE, boat, record, steps
from tests.fleet_work import child
from tests.test_walk import blocks
from tests.test_workbench import _places

FEW = (ThrusterGain, LinearDamping, QuadraticDamping, AddedMass)
# Sums in another order at each step of a search: far below what a number is known by.
ROUNDED = 1e-6
SAMPLES = (300, 360, 240)


def weak(target, factor, since=None, since_log=None):
    effect = place(suspect_named(boat(), "thruster_gain", target), boat(), {"factor": factor})
    return Placed(effect, target, since, since_log)


def logs_of(*causes):
    """Three short logs of a boat."""
    craft = boat().place(*causes)
    return [record(craft, steps(n, seed=i), seed=i, name=f"log{i}.csv") for i, n in enumerate(SAMPLES)]


def test_of(*causes):
    return record(boat().place(*causes), steps(300, seed=9), seed=9, name="test.csv")


test_of.__test__ = False


@pytest.fixture(scope="module")
def logs():
    return logs_of(weak("port", 0.7))


def shares(logs, vehicle=None):
    """Two places, of which the first has one log."""
    return Shares([Share(vehicle or boat(), part) for part in (logs[:1], logs[1:])])


def agree(one, two, predicted=ROUNDED):
    """Whether two diagnoses have the same names, numbers, evidence, gain and missing wrench.

    - `predicted`: relative difference of what they predict.
    """
    assert two.verdict == one.verdict and two.groups == one.groups and two.dropped == one.dropped
    assert [(f.label, f.since, f.since_log, f.signals, f.learned) for f in two.findings] == [
        (f.label, f.since, f.since_log, f.signals, f.learned) for f in one.findings
    ]
    for ours, theirs in zip(two.findings, one.findings, strict=True):
        assert ours.log_evidence == pytest.approx(theirs.log_evidence, rel=ROUNDED)
        assert [a.label for a in ours.alternatives] == [a.label for a in theirs.alternatives]
        for name, parameter in theirs.parameters.items():
            found = ours.parameters[name]
            assert found.value == pytest.approx(parameter.value, abs=ROUNDED * parameter.std)
            assert found.std == pytest.approx(parameter.std, rel=ROUNDED)
    assert two.gain.ratio == pytest.approx(one.gain.ratio, rel=predicted)
    assert two.gain.ratio_ci95 == pytest.approx(one.gain.ratio_ci95, rel=predicted)
    assert two.misfit_before == pytest.approx(one.misfit_before, rel=ROUNDED)
    assert two.misfit_after == pytest.approx(one.misfit_after, rel=ROUNDED)
    np.testing.assert_allclose(two.predictions.band, one.predictions.band, rtol=predicted)
    for ours, theirs in (
        (two.missing_before, one.missing_before),
        (two.missing_after, one.missing_after),
    ):
        np.testing.assert_array_equal(ours.log, theirs.log)
        np.testing.assert_array_equal(ours.t, theirs.t)
        off = (ours.wrench - theirs.wrench) / theirs.std
        assert np.nanmax(np.abs(off)) < ROUNDED
        np.testing.assert_allclose(ours.std, theirs.std, rtol=ROUNDED)


@pytest.mark.slow
def test_a_weak_thruster_is_found_over_shares_as_in_one_process(logs, monkeypatch):
    """With windows that are sampled and groups of several: each place has to know what the others have."""
    monkeypatch.setattr(_workbench, "SAMPLE", 10)
    monkeypatch.setattr(_workbench, "GROUPS", 10)
    one, two = (diagnose(boat(), train, test_of(weak("port", 0.7)), FEW) for train in (logs, shares(logs)))
    assert [finding.label for finding in one.findings] == ["thruster_gain:port"]
    agree(one, two)
    assert one.check is not None and two.check is None and two.to_json()["excitation"] == []
    assert "lie on workers" in " ".join(set(two.notes) - set(one.notes))


@pytest.mark.slow
def test_a_beginning_in_the_last_place_is_found_over_shares_as_in_one_process():
    """A thruster that fails in the third log, too short to tell what does, but not that something does."""
    train, test = logs_of(weak("bow", 0.3, 8.0, "log2.csv")), test_of(weak("bow", 0.3))
    one, two = (diagnose(boat(), logs, test, FEW) for logs in (train, shares(train)))
    agree(one, two)
    begun = [finding.since_log for finding in two.findings if finding.since is not None]
    assert begun == ["log2.csv"]


@pytest.mark.slow
def test_what_has_no_name_is_found_over_shares_as_in_one_process():
    """A thruster that is weak, and no such cause in the catalogue: a force that hangs on its command."""
    catalogue, weak_bow = (LinearDamping, AddedMass), weak("bow", 0.4)
    train, test = logs_of(weak_bow), test_of(weak_bow)
    one, two = (diagnose(boat(), logs, test, catalogue) for logs in (train, shares(train)))
    assert any("bow" in finding.signals for finding in one.findings)
    # A network that is trained makes more of rounding: four millionths were seen.
    agree(one, two, 1e-4)


# What the page prints, in digits, of a catalogue that is quickly compiled.
REMOTE = """
import os, sys
os.chdir(sys.argv[1])
from tests.test_shared_diagnosis import FEW
{page}
    (finding,) = diagnosis.findings
    factor = finding.parameters["factor"]
    print(finding.label, factor.value, factor.std, finding.log_evidence, diagnosis.gain.ratio)
"""


@pytest.mark.slow
def test_the_page_diagnoses_logs_on_two_workers_as_one_process_does(logs, tmp_path):
    (page,) = blocks("python", "docs/fleets.md")
    names = dict(
        zip(("a.csv", "b.csv", "c.csv", "test.csv"), (*logs, test_of(weak("port", 0.7))), strict=True)
    )
    save_vehicle(boat(), tmp_path / "boat.toml")
    for name, log in names.items():
        write_log(log, tmp_path / name)
    file = load_vehicle(tmp_path / "boat.toml")
    *train, test = read_logs([tmp_path / name for name in names], file)
    one = diagnose(file, train, test, FEW)
    # Fits over workers have a test of their own.
    lines = [line for line in page.splitlines() if "jm.fit(" not in line]
    done = child(REMOTE.format(page="\n".join(lines).replace("logs, test)", "logs, test, FEW)")), tmp_path)
    assert done.returncode == 0, done.stderr
    (finding,) = one.findings
    label, *numbers = done.stdout.splitlines()[-1].split()
    assert label == finding.label
    factor = finding.parameters["factor"]
    expected = factor.value, factor.std, finding.log_evidence, one.gain.ratio
    np.testing.assert_allclose([float(number) for number in numbers], expected, rtol=ROUNDED)


def answering(log):
    """As an autopilot steers: against what was measured, its noise included."""
    errors = log.channels[:, [0, 1, 5]]
    return dataclasses.replace(log, commands=np.clip(-0.5 * (errors - errors.mean(axis=0)), -1, 1))


def charged(log):
    return dataclasses.replace(log, battery=np.linspace(12.0, 11.0, len(log.t)))


@pytest.mark.parametrize(
    ("change", "catalogue", "told"),
    [
        (lambda logs: [answering(logs[0]), *logs[1:]], FEW, "commands answer what was measured"),
        (lambda logs: [dataclasses.replace(log, name="a.csv") for log in logs], FEW, "its own name"),
        (lambda logs: [*logs[:2], test_of(weak("port", 0.7))], FEW, "test on another log"),
        (
            lambda logs: [*logs[:1], *(dataclasses.replace(log, commands=-log.commands) for log in logs[1:])],
            FEW,
            "the wrong sign.*mend it first",
        ),
        (lambda logs: list(map(charged, logs)), (*FEW, Voltage), "leave `Voltage` out"),
        (
            lambda logs: [dataclasses.replace(log, channels=np.ones_like(log.channels)) for log in logs],
            FEW,
            "no channel ever changes",
        ),
    ],
)
def test_what_shares_cannot_answer_is_refused(logs, change, catalogue, told):
    test = charged(test_of(weak("port", 0.7)))
    with pytest.raises(InputError, match=told):
        diagnose(boat(), shares(change(logs)), test, catalogue)


def test_noise_that_is_not_stated_is_refused_over_shares(logs):
    stated = boat(sensors={name: std for name, std in NOISE.items() if name != "rate"})
    with pytest.raises(InputError, match=r"state it under \[sensors\], or diagnose"):
        diagnose(stated, shares(logs, stated), test_of(), FEW)


def test_a_diagnosis_over_shares_needs_a_test_log(logs):
    with pytest.raises(InputError, match="at least one test log"):
        diagnose(boat(), shares(logs), [], FEW)


def test_places_know_which_windows_they_have(logs):
    """Every second and third window of all are those of one process, as are groups, samples and speeds."""
    one = workbench(boat(), logs, FEW, None)
    there = opened_over(boat(), shares(logs), test_of(), FEW, None).bench
    for own, over in ((one, there), (one.every(2), there.every(2)), (one.every(3), there.every(3))):
        np.testing.assert_array_equal(over.group_starts, own.group_starts)
        np.testing.assert_array_equal(over.group_log, own.group_log)
        assert (over.samples, over.freedom, over.knots) == (own.samples, own.freedom, own.knots)
        starts = over.keeper.each(over, _starts_of)
        np.testing.assert_array_equal(np.concatenate(starts), own.data.starts)
    np.testing.assert_allclose(there.data.speeds, one.data.speeds, rtol=1e-12)
    assert there.split == one.split
    np.testing.assert_allclose(there.places.t, one.places.t)
    np.testing.assert_allclose(there.places.driven, one.places.driven, atol=1e-9)
    for name, values in one.places.signals.items():
        np.testing.assert_allclose(there.places.signals[name], values, atol=1e-12)
    for name, values in one.places.played.items():
        np.testing.assert_allclose(there.places.played[name], values, atol=1e-12)


def _starts_of(bench):
    return bench.data.starts


def test_a_part_of_every_second_window():
    """Seven windows before five own of 20: 8 and 10 are taken, four before them, ten in all."""
    assert Part(1, (), 7, 20, 0.1).every(2) == Part(1, (), 4, 10, 0.1)


def test_statistics_elsewhere_say_what_these_say():
    rng = np.random.default_rng(0)
    windows, knots, n, features = 7, 2, 3, 4
    half = rng.normal(size=(windows, 30, n + 6 * knots))
    stats = Reduced(
        rng.uniform(1.0, 2.0, windows),
        rng.normal(size=(windows, n + 6 * knots)),
        np.swapaxes(half, 1, 2) @ half,
    )
    desk = _Desk(Shares([Share(boat(), []) for _ in range(2)]))
    parts = [
        (Reduced(stats.chi2[part], stats.g[part], stats.h[part]),) for part in (slice(3), slice(3, None))
    ]
    there = _Elsewhere(desk, desk.keep(_laid, each=parts), [3, 4])
    at = _places(np.arange(windows * knots, dtype=float).reshape(windows, knots))
    prior = np.ones(n), rng.normal(size=n), np.ones(6), at
    own, over = (Knots(one, n, *prior) for one in (stats, there))
    values = rng.normal(size=(windows, knots, 6, features))
    for ours, theirs in zip(over.summed(values), own.summed(values), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10)
    for a, b in ((own, over), (own.beside(values, 0.5), over.beside(values, 0.5))):
        np.testing.assert_allclose(b.chi2, a.chi2)
        np.testing.assert_allclose(b.offset, a.offset)
        np.testing.assert_allclose(missing_wrench(b).wrench, missing_wrench(a).wrench)
    ledgers, wrenches = [_Ledger(own), _Ledger(over)], rng.normal(size=(2, windows, knots))
    for ledger in ledgers:
        ledger.add(1, wrenches[0])
    np.testing.assert_allclose(ledgers[1].chi2(0, wrenches), ledgers[0].chi2(0, wrenches))


def test_shares_keep_nothing_that_is_not_held():
    share = Share(boat(), [])
    desk = _Desk(Shares([share]))
    first, second = (desk.keep(_laid, each=[(np.arange(3),)]) for _ in range(2))
    assert [*share.kept] == [first.number, second.number]
    del first
    third = desk.keep(_laid, each=[(np.arange(3),)])
    assert [*share.kept] == [second.number, third.number]
