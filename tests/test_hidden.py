"""Effects hidden in logs that are made here from recorded seeds; the diagnosis has to give the answer.

The logs come from `experiments/blind`, which shares no code with the package: an effect whose equation is
wrong here cannot explain them. The full run of `experiments/blind_matrix.py` draws others.
"""

import dataclasses
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind import cases, catalogue, grading, outside
from experiments.blind.plant import Effect, Outside
from experiments.blind.vehicle import load
from jaxmarine._progress import silent
from jaxmarine.diagnosis._amid import refine_fully
from jaxmarine.diagnosis._learn import learn
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._search import search
from jaxmarine.effects import (
    CATALOGUE,
    Deadband,
    LinearDamping,
    QuadraticDamping,
    SteadyCurrent,
    ThrusterGain,
)
from jaxmarine.vehicle_io import packaged_vehicle

# Of quick tests and of slow ones, which hide fainter things [s]; as long as those of other tests, so that a
# vehicle's programs are compiled once.
QUICK, TRAIN, TEST = 60.0, 120.0, 60.0
# Of a quick test with suspects of its own, whose programs are no others' [s].
BRIEF = 30.0
# Factor by which what is hidden raises the error of predictions over 5 s.
SEVERITY = 3.0
BOAT, ROV = "cybership2", "tethra"

# One seed of every effect of the catalogue.
FIRST = {"thruster_lag": 2}
# What came later has seeds of its own, which leaves the others theirs.
LATER = {"reverse_thrust": 80, "turning_lift": 81, "wind_push": 82, "coupled_added_mass": 83}
# What is looked at before anything is fitted has tests of its own (`test_gross.py`).
GROSS = {"compass_deviation", "exchanged_thrusters", "sensor_delay"}
# Of the others some can be seen on a craft that moves in all six axes only.
_ON_A_BOAT = sorted({*catalogue.names(load(BOAT))} - {*LATER, *GROSS})
SINGLE = FIRST | {name: 4 + i for i, name in enumerate(_ON_A_BOAT) if name not in FIRST} | LATER
IN_SIX_AXES = {
    name: 40 + i for i, name in enumerate(sorted({*catalogue.names(load(ROV))} - {*SINGLE, *GROSS}))
}
PAIRS = {("steady_current", "thruster_gain"): 60, ("input_delay", "velocity_scale"): 61}
BEGUN = {"constant_wrench": 62, "gyro_bias": 63}
OUTSIDE = {"stick_slip": 65, "heading_force": 64, "cross_terms": 66}
NOTHING = {67: {"train": QUICK}, 1: {"misfit": True, "disturbance": 0.03}}
DISTURBED = 67


def first_always(cases: Iterable) -> list:
    """The first of some cases always, the others where there is time."""
    first, *others = cases
    return [first, *(pytest.param(*case, marks=pytest.mark.slow) for case in others)]


def answered(
    ship: str, hidden: list, seed: int, suspected: tuple = CATALOGUE, **options
) -> tuple[dict, dict]:
    """What is hidden in a log of this seed, and the diagnosis of it, both as files state them."""
    answer, diagnosis = diagnosed(ship, hidden, seed, suspected, **options)
    return answer, diagnosis.to_json()


def diagnosed(
    ship: str,
    hidden: list,
    seed: int,
    suspected: tuple = CATALOGUE,
    train: float = TRAIN,
    test: float = TEST,
    **options,
) -> tuple[dict, jm.Diagnosis]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lengths = {"duration_train": train, "duration_test": test}
        answer = cases.make_case(folder, ship, hidden, seed, **lengths, **options)
        craft = jm.load_vehicle(folder / "vehicle.toml")
        logs = [jm.read_log(folder / f"{part}.csv", craft) for part in ("train", "test")]
    return answer, jm.diagnose(craft, *logs, suspected)


def drawn(ship: str, name: str, seed: int, severity: float = SEVERITY) -> Effect:
    """An effect of this name, of random size, sign and target, acting always."""
    rng = np.random.default_rng(seed)
    vehicle = load(ship)
    scales = cases.typical(vehicle, "rich")
    while True:
        found = cases.sized(vehicle, catalogue.draw(name, vehicle, scales, rng), severity, "rich")
        if isinstance(found, Effect):
            return found


def whole(answer: dict, diagnosis: dict) -> bool:
    return grading.grade(answer, diagnosis)["whole"]


SINGLES = [
    *(pytest.param(BOAT, name, seed, id=name) for name, seed in SINGLE.items()),
    *(pytest.param(ROV, name, seed, id=name) for name, seed in IN_SIX_AXES.items()),
]


def test_every_effect_of_the_catalogue_is_hidden_in_some_log():
    crafts = [jm.load_vehicle(packaged_vehicle(ship)) for ship in (BOAT, ROV)]
    # What other actuators may have hidden is found in `test_actuators.py`.
    suspected = {cls.name for cls in CATALOGUE if any(cls.suspects(craft) for craft in crafts)}
    assert {*SINGLE, *IN_SIX_AXES, *GROSS} == suspected


@pytest.mark.slow
@pytest.mark.parametrize(("ship", "name", "seed"), SINGLES)
def test_one_effect_is_named_and_nothing_else(ship, name, seed):
    answer, diagnosis = answered(ship, [drawn(ship, name, seed)], seed)
    assert whole(answer, diagnosis), (answer, diagnosis["findings"])


@pytest.mark.slow
@pytest.mark.parametrize(("names", "seed"), PAIRS.items(), ids=["+".join(p) for p in PAIRS])
def test_two_effects_are_both_named(names, seed):
    answer, diagnosis = answered(BOAT, [drawn(BOAT, name, seed) for name in names], seed)
    assert whole(answer, diagnosis), (answer, diagnosis["findings"])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), BEGUN.items())
def test_an_effect_that_begins_is_named_with_its_beginning(name, seed):
    begun = dataclasses.replace(drawn(BOAT, name, seed), since=70.0)
    answer, diagnosis = answered(BOAT, [begun], seed)
    assert whole(answer, diagnosis), (answer, diagnosis["findings"])
    assert grading.timely(answer, diagnosis)


def strange(name: str, seed: int) -> Outside:
    """An effect outside the catalogue on the boat."""
    vehicle, rng = load(BOAT), np.random.default_rng(seed)
    while True:
        draw = outside.draw(name, vehicle, cases.typical(vehicle, "rich"), rng)
        found = cases.sized(vehicle, draw, SEVERITY, "rich")
        if isinstance(found, Outside):
            return found


# What comes nearest to a force that sticks and slips: with the whole catalogue it takes three times as long.
LIKE_FRICTION = (LinearDamping, QuadraticDamping, ThrusterGain, Deadband, SteadyCurrent)


@pytest.mark.slow
def test_a_force_that_sticks_and_slips_is_unknown_with_a_signal_that_it_depends_on():
    name, seed = "stick_slip", OUTSIDE["stick_slip"]
    lengths = {"train": BRIEF, "test": BRIEF}
    answer, diagnosis = answered(BOAT, [strange(name, seed)], seed, LIKE_FRICTION, **lengths)
    assert whole(answer, diagnosis), (answer, diagnosis["findings"], diagnosis["residual_after"])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), OUTSIDE.items())
def test_what_the_catalogue_lacks_is_unknown_with_a_signal_that_it_depends_on(name, seed):
    answer, diagnosis = answered(BOAT, [strange(name, seed)], seed)
    assert whole(answer, diagnosis), (answer, diagnosis["findings"], diagnosis["residual_after"])


@pytest.mark.slow
def test_a_learned_force_that_predicts_the_training_log_worse_is_left_out(monkeypatch):
    """Here because it is learned with the wrong sign and ten times too large."""
    name, seed = "stick_slip", OUTSIDE["stick_slip"]

    def wrong(*args):
        return tuple(dataclasses.replace(term, scale=-10.0 * term.scale) for term in learn(*args))

    monkeypatch.setattr("jaxmarine.diagnosis._diagnose.learn", wrong)
    _, diagnosis = diagnosed(BOAT, [strange(name, seed)], seed)
    assert diagnosis.verdict == "unexplained"
    assert diagnosis.extended.placed == () and diagnosis.gain.ratio == 1.0
    assert any("left out" in note for note in diagnosis.notes)


@pytest.mark.slow
def test_a_disturbance_bends_a_right_file_no_more_than_chance_would():
    """By more than five widths of its prior if that weighed as in logs without a disturbance."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases.make_case(
            folder, BOAT, [], DISTURBED, duration_train=TRAIN, duration_test=TEST, disturbance=0.1
        )
        craft = jm.load_vehicle(folder / "vehicle.toml")
        bench = workbench(craft, (jm.read_log(folder / "train.csv", craft),), CATALOGUE, None)
    widths = np.array([c.prior for c in bench.base])
    light = refine_fully(bench, bench.start())
    found = search(bench, light, silent, lambda model, stats: False).model
    assert np.abs(light.z / widths).max() > 5.0
    assert found.members == () and np.abs(found.z / widths).max() < 3.0


@pytest.mark.parametrize(
    ("seed", "options"),
    first_always(NOTHING.items()),
    ids=["exact file", "file wrong everywhere, disturbed"],
)
def test_nothing_is_found_where_nothing_is_hidden(seed, options):
    answer, diagnosis = diagnosed(BOAT, [], seed, **options)
    assert whole(answer, diagnosis.to_json()), diagnosis.findings
    assert diagnosis.gain.ratio == 1.0 and diagnosis.extended.placed == ()
    if not options.get("misfit"):
        assert diagnosis.white and not diagnosis.depends_on
        assert diagnosis.misfit_after == pytest.approx(1.0, abs=0.05)
