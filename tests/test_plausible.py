"""Forces that no disturbance makes: told with their axis, time and size, where no name explains them."""

import dataclasses
import functools
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from experiments.blind import cases
from experiments.blind.plant import Outside
from experiments.blind.vehicle import load
from jaxmarine._types import DOFS
from jaxmarine.diagnosis import MissingWrench
from jaxmarine.diagnosis._plausible import excesses, full_thrust, told
from jaxmarine.effects import AddedMass, ConstantWrench, LinearDamping, ThrusterGain
from jaxmarine.logs import Log
from tests.boats import boat, record

KNOT, KNOTS, STD = 0.5, 120, 0.3
# Two thrusters of 40 N that push ahead 0.3 m off the middle, and one of 30 N across the bow, 0.5 m ahead.
SURGE, SWAY, YAW = 80.0, 30.0, 2 * 40.0 * 0.3 + 30.0 * 0.5
BEGIN = 1.7e9  # [s] clock of the second log


def missing(rng: np.random.Generator, force: np.ndarray, axis: int, std: float = STD) -> MissingWrench:
    """What knots show of a force on one axis, over two logs of a minute each, with noise on all."""
    wrench = np.full((2 * KNOTS, 6), np.nan)
    wrench[:, [0, 1, 5]] = std * rng.normal(size=(2 * KNOTS, 3))
    wrench[:, axis] += force
    middles = KNOT * (np.arange(KNOTS) + 0.5)
    return MissingWrench(
        log=np.repeat([0, 1], KNOTS),
        t=np.concatenate([middles, BEGIN + middles]),
        wrench=wrench,
        std=np.where(np.isnan(wrench), np.nan, std),
        velocity=np.zeros_like(wrench),
    )


@functools.cache
def logs() -> tuple[Log, ...]:
    still = record(boat(), np.zeros((601, 3)))
    return still, dataclasses.replace(still, t=still.t + BEGIN, name="later.csv")


def coloured(rng: np.random.Generator, memory: float, rms: float) -> np.ndarray:
    """A Gauss-Markov force at the knots of both logs, of exactly this size."""
    keep = np.exp(-KNOT / memory)
    out = np.zeros(2 * KNOTS)
    for k, kick in enumerate(rng.normal(size=out.size)[1:], 1):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * kick
    return rms * out / np.sqrt((out**2).mean())


def test_full_thrust_is_the_sum_of_all_thrusters_on_an_axis():
    np.testing.assert_allclose(full_thrust(boat()), [SURGE, SWAY, 0, 0, 0, YAW], atol=1e-12)
    weak = boat().place(jm.Placed(ThrusterGain(jnp.array([1.0, 0.25, 1.0]))))
    np.testing.assert_allclose(full_thrust(weak)[0], 50.0)


def test_a_force_of_most_of_the_thrust_is_told_with_its_time_and_size():
    """0.7 of full thrust from 20 to 32 s of the second log, swinging from side to side."""
    rng = np.random.default_rng(0)
    force = np.zeros(2 * KNOTS)
    acts = slice(KNOTS + 40, KNOTS + 64)
    force[acts] = 0.7 * YAW * np.sign(np.sin(np.arange(24) / 3.0 + 0.1))
    (one,) = excesses(missing(rng, force, 5), (boat(),), logs(), 1.0)
    assert (one.label, one.named, one.signals, one.since) == ("unknown:yaw", False, (), None)
    found = one.excess
    assert found is not None
    assert (found.log, found.strongest, found.unit) == ("later.csv", "yaw", "N m")
    assert (found.begin - BEGIN, found.end - BEGIN) == pytest.approx((20.0, 32.0), abs=0.01)
    assert (found.rms, found.peak) == pytest.approx((0.7 * YAW, 0.7 * YAW), rel=0.06)
    assert found.share == pytest.approx(0.7, rel=0.02)
    assert "yaw: from 20.0 to 32.0 s after the start of later.csv (t = 1700000020.0" in told(one)
    assert excesses(missing(rng, force, 5), (boat(),), logs(), 1.0, known={"yaw"}) == ()


def test_a_push_across_is_compared_with_the_thrust_of_the_strongest_axis():
    rng = np.random.default_rng(1)
    across = np.zeros(2 * KNOTS)
    across[30:50] = 0.9 * SWAY
    assert excesses(missing(rng, across, 1), (boat(),), logs(), 1.0) == ()
    across[30:50] = 0.6 * SURGE
    (one,) = excesses(missing(rng, across, 1), (boat(),), logs(), 1.0)
    assert one.target == "sway" and one.excess is not None and one.excess.strongest == "surge"
    # A thruster that has failed calms no sea, and one that was found to be stronger than filed braves more.
    weak, strong = (boat().place(jm.Placed(ThrusterGain(jnp.full(3, gain)))) for gain in (0.1, 2.0))
    assert excesses(missing(rng, across, 1), (boat(), weak), logs(), 1.0)
    assert excesses(missing(rng, across, 1), (boat(), strong), logs(), 1.0) == ()


@pytest.mark.parametrize("memory", [0.5, 2.0, 8.0])
def test_gusts_of_a_seventh_of_the_thrust_are_a_disturbance(memory):
    rng = np.random.default_rng(2)
    for _ in range(20):
        gusts = missing(rng, coloured(rng, memory, SURGE / 7), 0)
        assert excesses(gusts, (boat(),), logs(), 5.0) == ()


def test_what_noise_feigns_is_no_force_and_one_half_second_is_no_stretch():
    rng = np.random.default_rng(3)
    nothing, blow = np.zeros(2 * KNOTS), np.zeros(2 * KNOTS)
    blow[100] = SURGE
    for _ in range(20):
        assert excesses(missing(rng, nothing, 0, std=2.0 * SURGE), (boat(),), logs(), 1.0) == ()
        assert excesses(missing(rng, blow, 0), (boat(),), logs(), 1.0) == ()
    # The same scatter beyond what the sensors' own noise makes of it is one.
    loud = missing(rng, nothing, 0, std=2.0 * SURGE)
    assert excesses(loud, (boat(),), logs(), 1.0, quiet=0.1)


def test_a_body_without_thrust_has_nothing_to_compare_with_but_a_log_of_wrenches_has():
    rng = np.random.default_rng(4)
    force = np.full(2 * KNOTS, 50.0)
    thrusters = dataclasses.replace(boat().thrusters, max_thrust=jnp.zeros(3))
    towed = dataclasses.replace(boat(), thrusters=thrusters)
    assert excesses(missing(rng, force, 0), (towed,), logs(), 1.0) == ()
    for most, expected in (60.0, ["surge"]), (140.0, []):
        pushed = [dataclasses.replace(log, commands=None, wrench=np.full((601, 6), most)) for log in logs()]
        found = excesses(missing(rng, force, 0), (towed,), pushed, 1.0)
        assert [one.target for one in found] == expected


# --- the whole diagnosis, on logs of a simulator that shares no code with the package -------------------

SHIP = "cybership2"
LENGTH, FAILS = 30.0, 15.0  # [s]
# Few suspects compile fast. Among them are those that come nearest to the truth.
SUSPECTS = (AddedMass, LinearDamping, ConstantWrench, ThrusterGain)
# Someone else is at the sticks: seconds from FAILS on, each with its push [N, N m].
PUSHES = {
    0: (-3.2, 0.0, -0.5),
    3: (3.2, 0.0, 0.6),
    5.5: (-3.0, 0.0, 0.6),
    9: (3.4, 0.0, -0.6),
    12: (-3.2, 0.0, 0.5),
}


def pushed(t: np.ndarray | float, s: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Wrench [6, times] of the other hand at one time or at several."""
    del s
    steps = np.array([(0.0, 0.0, 0.0), *PUSHES.values()])
    out = np.zeros_like(nu)
    out[[0, 1, 5]] = steps[np.searchsorted(FAILS + np.array([*PUSHES]) - 1e-9, np.atleast_1d(t))].T
    return out


def deaf(t: np.ndarray, commands: np.ndarray) -> np.ndarray:
    return np.where(t[:, None] >= FAILS - 1e-9, 0.0, commands)


def diagnosed(hidden: list, **options) -> tuple[jm.Diagnosis, jm.Log]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cases.make_case(folder, SHIP, hidden, 5, duration_train=LENGTH, duration_test=LENGTH, **options)
        craft = jm.load_vehicle(folder / "vehicle.toml")
        train, test = (jm.read_log(folder / f"{part}.csv", craft) for part in ("train", "test"))
    return jm.diagnose(craft, train, test, SUSPECTS), train


@pytest.mark.slow
def test_a_boat_that_stops_following_its_commands_is_not_called_disturbed():
    stops = Outside("taken over", ("surge", "yaw"), ("t",), pushed, deaf)
    diagnosis, log = diagnosed([stops])
    assert diagnosis.verdict == "unexplained" and diagnosis.depends_on == ()
    craft = load(SHIP)
    late = log.t >= FAILS
    assert log.commands is not None
    truth = -log.commands @ craft.allocation.T
    truth += pushed(log.t, np.zeros((13, len(log.t))), np.zeros((6, len(log.t)))).T
    found = {one.target: one.excess for one in diagnosis.findings if one.excess is not None}
    assert set(found) == {"surge", "yaw"}
    for dof, excess in found.items():
        true = truth[late, DOFS.index(str(dof))]
        assert excess.begin == pytest.approx(FAILS, abs=1.5) and excess.end > LENGTH - 2.0
        assert excess.rms == pytest.approx(np.sqrt((true**2).mean()), rel=0.25)
        assert any(note.startswith(f"{dof}: from") for note in diagnosis.notes)


@pytest.mark.slow
def test_a_boat_in_gusts_is_called_disturbed():
    """Of a twelfth of the full thrust in surge."""
    share = 0.5 / cases.typical(load(SHIP), "rich").wrench[0]
    diagnosis, _ = diagnosed([], disturbance=share)
    assert diagnosis.verdict == "nothing_found" and not diagnosis.white
    assert not diagnosis.findings
    wrench, std = diagnosis.missing_after.wrench[:, 0], diagnosis.missing_after.std[:, 0]
    assert np.sqrt((wrench**2 - std**2).mean()) > 0.07 * full_thrust(diagnosis.vehicle)[0]
