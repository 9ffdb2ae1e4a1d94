"""The grossest errors are told before anything is fitted: by kinematics, and by signs of responses."""

import dataclasses
import functools
from unittest.mock import Mock

import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind import cases, excitation
from experiments.blind.plant import Effect
from experiments.blind.vehicle import load
from jaxmarine._types import DOFS
from jaxmarine.diagnosis import gain_of
from jaxmarine.diagnosis._criteria import DEFAULT
from jaxmarine.diagnosis._diagnose import _exchanges
from jaxmarine.diagnosis._explanation import Model
from jaxmarine.diagnosis._judge import Judged
from jaxmarine.diagnosis._prepare import Opened
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.effects import ExchangedThrusters
from jaxmarine.fitting import gross_errors, misconnected
from jaxmarine.fitting._kinematics import contradiction, misread
from jaxmarine.fitting._responses import read_otherwise, responses
from jaxmarine.vehicle import Placed
from tests.boats import boat, record, steps
from tests.crafts import packaged

BOAT, SECONDS = "cybership2", 120.0  # thrusters star, port and bow
EXCHANGED = Effect("exchanged_thrusters", "star+port", {})


@functools.cache
def sailed(
    *hidden: tuple,
    ship: str = BOAT,
    seconds: float = SECONDS,
    seed: int = 3,
    level: float = 1.0,
    kind: str = "rich",
) -> jm.Log:
    """A log of the independent plant with sensor noise; `hidden` as (effect, target, parameters)."""
    truth, rng = load(ship), np.random.default_rng(seed)
    commands = (level * excitation.commands(truth, round(seconds / cases.DT), rng, kind)).round(6)
    effects = [Effect(name, target, dict(values)) for name, target, values in hidden]
    run = cases.roll_out(truth, effects, commands, 0.7)
    channels = run.seen() + truth.noise * rng.standard_normal((len(commands), 18))
    locked = ~np.isin(np.arange(18) % 6, truth.free)
    channels[:, locked] = np.nan
    return jm.Log(run.times, channels, commands, None, packaged(ship).thruster_names, "sailed.csv")


def with_columns(log: jm.Log, order: list[int], signs: list[int]) -> jm.Log:
    assert log.commands is not None
    return dataclasses.replace(log, commands=log.commands[:, order] * signs)


def names(errors) -> list[tuple[str, str | None]]:
    return [(cause.effect.name, cause.target) for one in errors for cause in one.causes]


# --- kinematics -----------------------------------------------------------------------------------


@functools.cache
def steered() -> jm.Log:
    return record(boat(), steps(900))


MISREAD = {
    "u has the wrong sign": lambda c: _scaled(c, [6], -1),
    "v has the wrong sign": lambda c: _scaled(c, [7], -1),
    "r has the wrong sign": lambda c: _scaled(c, [11], -1),
    "psi and r have the wrong sign": lambda c: _scaled(c, [5, 11], -1),
    "x and y are exchanged": lambda c: c[:, [1, 0, *range(2, 18)]],
    "the rates are in degrees": lambda c: _scaled(c, [11], np.rad2deg(1)),
    "psi is in degrees": lambda c: _scaled(c, [5], np.rad2deg(1)),
}


def _scaled(channels: np.ndarray, columns: list[int], factor: float) -> np.ndarray:
    out = channels.copy()
    out[:, columns] *= factor
    return out


@pytest.mark.parametrize("words", MISREAD)
def test_what_was_misread_is_told(words):
    log = steered()
    found = misread(boat(), (dataclasses.replace(log, channels=MISREAD[words](log.channels)),))
    assert found is not None and words in found[0]
    assert found[0].count(", or ") <= 1


def test_sensors_that_agree_were_not_misread():
    assert misread(boat(), (steered(),)) is None
    assert misread(packaged(BOAT), (sailed(),)) is None


@pytest.mark.parametrize("kind", ["position", "attitude", "velocity", "rate"])
def test_a_late_sensor_is_told_with_its_delay(kind):
    craft = packaged(BOAT)
    # In 120 s a boat that turns so slowly hardly shows it.
    log = sailed(("sensor_delay", kind, (("delay", 0.3),)), seconds=300.0)
    errors = gross_errors(craft, (log,))
    assert names(errors) == [("sensor_delay", kind)]
    delay = errors[0].causes[0].effect.parameters()["delay"]
    assert float(delay.max()) == pytest.approx(0.3, abs=0.05)


def test_a_compass_that_deviates_is_told_with_its_coefficients():
    values = (("constant", 0.0), ("cos", 0.12), ("sin", -0.06))
    (error,) = gross_errors(packaged(BOAT), (sailed(("compass_deviation", None, values)),))
    found = error.causes[0].effect.parameters()
    assert error.told.startswith("The logged heading deviates")
    assert float(found["cos"]) == pytest.approx(0.12, abs=0.03)
    assert float(found["sin"]) == pytest.approx(-0.06, abs=0.03)


def test_nothing_is_told_of_a_log_with_nothing_wrong():
    assert gross_errors(packaged(BOAT), (sailed(),)) == ()
    assert contradiction(packaged(BOAT), (sailed(),), ()) is None


# --- signs of responses ---------------------------------------------------------------------------


def test_responses_are_those_of_the_file_where_it_is_right():
    seen = responses(packaged(BOAT), (sailed(),))
    assert seen is not None and seen.names == packaged(BOAT).thruster_names
    std = np.sqrt(np.einsum("ajj->aj", seen.covariance))
    free = seen.known
    assert (np.abs(seen.measured - seen.filed)[free] < 5 * std[free] + 0.05).all()
    assert read_otherwise(seen) == ()


def test_exchanged_columns_are_told_and_named():
    errors = misconnected(packaged(BOAT), (sailed(("exchanged_thrusters", "star+port", ())),))
    assert names(errors) == [("exchanged_thrusters", "star+port")]
    assert "yaw" in errors[0].told.lower() and "the columns of star and port are exchanged" in errors[0].told


def test_a_column_of_the_wrong_sign_is_a_negative_gain():
    errors = misconnected(packaged(BOAT), (with_columns(sailed(), [0, 1, 2], [1, 1, -1]),))
    assert names(errors) == [("thruster_gain", "bow")]
    assert float(errors[0].causes[0].effect.parameters()["factor"][2]) == -1.0


def test_columns_exchanged_and_one_of_the_wrong_sign_are_told_together():
    """The column star holds what drives port, with the wrong sign."""
    errors = misconnected(packaged(BOAT), (with_columns(sailed(), [1, 0, 2], [-1, 1, 1]),))
    assert names(errors) == [("exchanged_thrusters", "star+port"), ("thruster_gain", "port")]
    assert "the column of star has the wrong sign" in errors[0].told


HEAVY = "bluerov2_heavy"


@functools.cache
def heavy(*hidden: tuple) -> jm.Log:
    """Eight thrusters that a pilot moves in six ways; t6 and t8 exchanged, or t5 and t7, never pitch it."""
    return sailed(*hidden, ship=HEAVY, seconds=200.0, level=0.7)


CROSSED = ("exchanged_thrusters", "t6+t8", ())


# As the plant has them, and as pulses of whole microseconds, 400 of which are full thrust.
@pytest.mark.parametrize("step", [1e-6, 2.5e-3])
def test_of_exchanges_that_answer_alike_both_are_told(step):
    log = heavy(CROSSED)
    assert log.commands is not None
    log = dataclasses.replace(log, commands=step * np.round(log.commands / step))
    (error,) = misconnected(packaged(HEAVY), (log,))
    told = [(one.effect.name, one.target) for one in (*error.causes, *error.instead)]
    assert told == [("exchanged_thrusters", "t5+t7"), ("exchanged_thrusters", "t6+t8")]
    assert "the columns of t6 and t8 are exchanged" in error.told
    assert "the columns of t5 and t7 are exchanged" in error.told


@pytest.mark.parametrize(("behind", "close"), [(0.5, True), (40.0, False)])
def test_what_may_be_exchanged_instead_is_weighed_by_the_whole_likelihood(behind, close):
    """Costs of 100 with the columns as found, more by the other pair, and 1100 as filed; dispersion 2."""

    def pretended(cost):
        bench = Mock(spec=Workbench, criteria=DEFAULT)
        bench.refine.return_value.cost = cost
        return bench

    other, filed = Placed(ExchangedThrusters(), "t6+t8"), pretended(1100.0)
    filed.as_connected.side_effect = {other: pretended(100.0 + behind)}.get
    now = Mock(spec=Judged, model=Mock(spec=Model, cost=100.0), phi=2.0)
    opened = Mock(spec=Opened, exchanged=(Placed(ExchangedThrusters(), "t5+t7"),), instead=(other,))
    (finding,) = _exchanges(filed, now, opened)
    assert (finding.label, finding.log_evidence) == ("exchanged_thrusters:t5+t7", 500.0)
    (found,) = finding.alternatives
    assert (found.label, found.indistinguishable) == ("exchanged_thrusters:t6+t8", close)
    assert found.log_evidence == 500.0 - behind / 2


def test_what_commands_never_show_speaks_for_nothing():
    """The measured answers are those of the plant with its columns exchanged, as far as commands tell."""
    seen = responses(packaged(HEAVY), (heavy(CROSSED),))
    assert seen is not None
    # Four thrusters in each plane, three ways to move it.
    np.testing.assert_allclose(seen.shown @ seen.shown, seen.shown, atol=1e-9)
    np.testing.assert_allclose(np.trace(seen.shown, axis1=1, axis2=2), 6, atol=1e-9)
    order = [seen.names.index(name) for name in ("t1", "t2", "t3", "t4", "t5", "t8", "t7", "t6")]
    std = np.sqrt(np.einsum("ajj->aj", seen.covariance))
    size = np.abs(seen.filed).max(axis=1, keepdims=True)
    apart = np.abs(seen.measured - np.einsum("ajk,ak->aj", seen.shown, seen.filed[:, order]))
    # Beside the noise what a file's added mass, which other axes share, is off by in a regression.
    assert (apart < 5 * std + 0.15 * size).all()


@pytest.mark.parametrize("unit", [1 / 3600, 1 / 300, 1.0, 1000.0])
def test_what_a_full_command_is_may_have_any_unit(unit):
    right, crossed = (responses(packaged(HEAVY), (heavy(*hidden),)) for hidden in ((), (CROSSED,)))
    assert right is not None and crossed is not None
    assert read_otherwise(right._replace(measured=unit * right.measured)) == ()
    scaled = crossed._replace(measured=unit * crossed.measured, covariance=unit**2 * crossed.covariance)
    found = read_otherwise(scaled)
    assert [one.exchanged for one in found] == [(("t5", "t7"),), (("t6", "t8"),)]
    assert found[0].odds == pytest.approx(read_otherwise(crossed)[0].odds, rel=1e-3)


def test_velocities_that_come_late_make_no_rate_answer_the_wrong_way():
    """One offset for all axes is that of the late velocities; by it turns come before the thrust."""
    late = ("sensor_delay", "velocity", (("delay", 0.5),))
    log = sailed(late, ship=HEAVY, seconds=200.0, kind="single")
    assert misconnected(packaged(HEAVY), (log,)) == ()


@pytest.mark.parametrize("share", [0.1, 0.03])
@pytest.mark.parametrize("axis", ["sway", "pitch", "yaw"])
def test_an_axis_of_which_file_and_log_differ_by_far_is_no_exchange(axis, share):
    seen = responses(packaged(HEAVY), (heavy(),))
    assert seen is not None
    this = (np.array(DOFS) == axis)[:, None]
    found = read_otherwise(seen._replace(measured=np.where(this, share * seen.measured, seen.measured)))
    assert not any(one.exchanged for one in found)


def test_what_a_controller_may_hide_is_no_exchange(monkeypatch):
    """With t2 and t4 exchanged no command pushes sideways; so it looks of right columns under feedback."""
    log = heavy(("exchanged_thrusters", "t2+t4", ()))
    (error,) = misconnected(packaged(HEAVY), (log,))
    assert {cause.target for cause in (*error.causes, *error.instead)} == {"t1+t3", "t2+t4"}
    monkeypatch.setattr("jaxmarine.fitting._gross.answers", lambda log: True)
    assert misconnected(packaged(HEAVY), (log,)) == ()


@pytest.mark.parametrize(("axis", "channels"), [("pitch", [4, 10]), ("sway", [1, 7])])
def test_a_channel_of_mere_noise_is_no_axis_that_does_not_answer(axis, channels):
    log = heavy()
    noisy = log.channels.copy()
    noisy[:, channels] = 0.01 * np.random.default_rng(2).normal(size=(len(noisy), 2))
    seen = responses(packaged(HEAVY), (dataclasses.replace(log, channels=noisy),))
    assert seen is not None
    assert [dof for dof, moves in zip(DOFS, seen.known, strict=True) if not moves] == [axis]
    assert read_otherwise(seen) == ()


@pytest.mark.parametrize("seed", range(2))
def test_answers_that_scatter_beyond_all_readings_speak_for_none(seed):
    """Without their dispersion some reading of many would be 50 nats likelier than the file."""
    seen = responses(packaged(HEAVY), (heavy(),))
    assert seen is not None
    noise = np.random.default_rng(seed).normal(size=seen.measured.shape)
    size = np.abs(seen.filed).max(axis=1, keepdims=True)
    assert read_otherwise(seen._replace(measured=seen.measured + size * noise @ seen.shown[0].T)) == ()


def test_without_a_track_an_axis_may_be_of_the_wrong_sign_as_well():
    """Of a boat with two thrusters astern nothing else tells that yaw was not logged the wrong way."""
    craft = packaged(BOAT)
    log = sailed(("exchanged_thrusters", "star+port", ()))
    assert log.commands is not None
    commands = log.commands * [1, 1, 0]
    truth = load(BOAT)
    run = cases.roll_out(truth, [EXCHANGED], commands, 0.7)
    channels = np.where(np.isin(np.arange(18) % 6, truth.free), run.seen(), np.nan)
    channels += truth.noise * np.random.default_rng(0).standard_normal(channels.shape)
    whole = dataclasses.replace(log, channels=channels, commands=commands)
    lost = dataclasses.replace(whole, channels=np.where(np.arange(18) < 3, np.nan, channels))
    (error,), (unsure,) = misconnected(craft, (whole,)), misconnected(craft, (lost,))
    assert names([error]) == names([unsure]) == [("exchanged_thrusters", "star+port")]
    assert "yaw has the wrong sign" in unsure.told and "yaw has the wrong sign" not in error.told


@pytest.mark.parametrize("name", ["thruster_gain", "input_delay", "steady_current"])
def test_what_is_no_gross_error_is_left_alone(name):
    hidden = {
        "thruster_gain": ("star", (("factor", 0.0),)),
        "input_delay": (None, (("delay", 0.6),)),
        "steady_current": (None, (("north", 0.1), ("east", -0.1))),
    }[name]
    assert gross_errors(packaged(BOAT), (sailed((name, *hidden)),)) == ()


# --- what is made of it ---------------------------------------------------------------------------


def test_a_check_says_it_first():
    checked = jm.check(packaged(BOAT), sailed(("exchanged_thrusters", "star+port", ())))
    assert "star and port are exchanged" in checked.gross[0]
    assert str(checked).startswith(f"first: {checked.gross[0]}")
    # And nothing else: what a log must show besides is told once the map is right.
    (advice,) = checked.advice
    assert advice.startswith("Mend what stands under first")


@pytest.mark.slow
def test_a_diagnosis_names_exchanged_columns_before_anything_bends(tmp_path):
    craft, hidden = packaged(BOAT), ("exchanged_thrusters", "star+port", ())
    found = jm.diagnose(craft, sailed(hidden), sailed(hidden, seconds=60.0, seed=4))
    assert [f.label for f in found.findings] == ["exchanged_thrusters:star+port"]
    (finding,) = found.to_json()["findings"]
    assert finding["parameters"] == {} and finding["log_evidence"] > 100
    assert found.verdict == "explained" and found.gain.ratio < 0.5
    assert found.vehicle.placed == ()
    jm.save_vehicle(found.extended, tmp_path / "extended.toml")
    (placed,) = jm.load_vehicle(tmp_path / "extended.toml").placed
    assert (placed.effect.name, placed.target) == ("exchanged_thrusters", "star+port")
    assert jm.check(found.extended, sailed(hidden)).gross == ()
    # As worth naming as it was when it was known beforehand.
    logs = sailed(hidden), sailed(hidden, seconds=60.0, seed=4)
    known = gain_of(craft, *logs, [jm.Placed(ExchangedThrusters(), "star+port")])
    assert known.ratio == pytest.approx(found.gain.ratio, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "target", "values"),
    [
        ("sensor_delay", "velocity", {"delay": 0.3}),
        ("sensor_delay", "position", {"delay": 0.5}),
        ("sensor_delay", "attitude", {"delay": 0.2}),
        ("sensor_delay", "rate", {"delay": 0.2}),
        ("compass_deviation", None, {"constant": 0.05, "cos": 0.1, "sin": 0.05}),
        ("compass_deviation", None, {"constant": 0.0, "cos": 0.03, "sin": -0.04}),
    ],
)
def test_a_diagnosis_names_sensors_that_deviate_or_lag(name, target, values):
    hidden = (name, target, tuple(values.items()))
    found = jm.diagnose(packaged(BOAT), sailed(hidden), sailed(hidden, seconds=60.0, seed=4))
    (finding,) = found.findings
    assert (finding.effect, finding.target) == (name, target)
    for key, value in values.items():
        one = finding.parameters[key]
        assert one.value == pytest.approx(value, abs=4 * one.std + 0.1 * abs(value))


@pytest.mark.slow
def test_beside_an_axis_that_was_misread_no_name_is_believed():
    log, test = sailed(), sailed(seconds=60.0, seed=4)
    log, test = (dataclasses.replace(one, channels=_scaled(one.channels, [7], -1)) for one in (log, test))
    found = jm.diagnose(packaged(BOAT), log, test)
    assert not any(one.named for one in found.findings)
    assert found.notes[0].startswith("V has the wrong sign")
