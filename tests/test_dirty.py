"""Accidents and false clocks put into simulated logs: named with their time, and all else is left alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.diagnosis import diagnose
from jaxmarine.effects import ThrusterGain
from jaxmarine.fitting import check, cut, driven, fit, noise_of, reviewed
from jaxmarine.fitting._clock import ClockOffset, clock_offset
from jaxmarine.logs import Log, smooth_states
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Damping, Placed, Vehicle
from tests.boats import NOISE, boat, steps

SAMPLES, DT = 1260, 0.1
# What follows in a stretch of as many samples is simulated by itself: one length, one program.
PIECES = 6


def pieces(vehicle: Vehicle, commands: np.ndarray, between, seed: int = 0) -> Log:
    """A log of a run in pieces; `between(k, nu)` is the velocity with which piece k begins."""
    channels, size = [], SAMPLES // PIECES
    position, attitude, nu = np.zeros(3), np.zeros(3), np.zeros(6)
    for k in range(PIECES):
        here = slice(k * size, (k + 1) * size)
        told = np.concatenate([commands[here], commands[here][-1:]])
        t = np.arange(size + 1) * DT
        blank = Log(t, np.full((size + 1, 18), np.nan), told, None, vehicle.thruster_names, "")
        start = initial_state(vehicle, position, attitude, jnp.asarray(between(k, nu)))
        run = np.asarray(simulate(vehicle, blank, start).channels)
        channels.append(run[:-1])
        position, attitude, nu = run[-1, :3], run[-1, 3:6], run[-1, 6:12]
    std = np.repeat([NOISE.get(k, np.nan) for k in ("position", "attitude", "velocity", "rate", "", "")], 3)
    noise = std * np.random.default_rng(seed).normal(size=(SAMPLES, 18))
    return Log(
        np.arange(SAMPLES) * DT,
        np.concatenate(channels) + noise,
        commands,
        None,
        vehicle.thruster_names,
        "log",
    )


COMMANDS = steps(SAMPLES, seed=3)


@pytest.fixture(scope="module")
def good() -> Log:
    return pieces(boat(), COMMANDS, lambda k, nu: nu)


def struck(k: int, nu: np.ndarray) -> np.ndarray:
    """A boat that runs into a wall at 42 s: it comes back and is turned."""
    return nu + (k == 2) * np.array([-1.6, 0.5, 0, 0, 0, 1.5])


def taken(log: Log, begin: int, end: int) -> Log:
    """What a pilot drove stays unlogged: the log has other commands from `begin` to `end`."""
    others = steps(SAMPLES, seed=11)
    told = COMMANDS.copy()
    told[begin:end] = others[begin:end]
    return dataclasses.replace(log, commands=told)


def surfaced(hits: bool, seed: int = 0) -> tuple[Vehicle, Log]:
    """A float of one axis, by Euler steps: buoyant, driven up and down, and held at the surface."""
    vehicle = dataclasses.replace(boat(("heave",)), thruster_names=boat().thruster_names)
    vehicle = eqx.tree_at(lambda v: v.body.buoyancy, vehicle, jnp.asarray(500.5))
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.uniform(-5, 25, SAMPLES // 20), 20)
    force[500:600] = -30.0
    force[600:640] = 40.0
    z, w, out = 2.0, 0.0, []
    for k in range(SAMPLES):
        out.append((z, w))
        for _ in range(10):
            w += DT / 10 * (force[k] - 10.0 - 60 * w - 90 * abs(w) * w) / 90
            z += DT / 10 * w
            if hits and z < 0:
                z, w = 0.0, 0.0
    channels = np.full((SAMPLES, 18), np.nan)
    z, w = np.array(out).T
    if not hits:
        z = z - z.min() + 1.0
    channels[:, CHANNELS.index("z")] = z + 0.01 * rng.normal(size=SAMPLES)
    channels[:, CHANNELS.index("w")] = w + 0.01 * rng.normal(size=SAMPLES)
    wrench = np.zeros((SAMPLES, 6))
    wrench[:, 2] = force
    return vehicle, Log(np.arange(SAMPLES) * DT, channels, None, wrench, vehicle.thruster_names, "float", ())


def review(vehicle: Vehicle, log: Log) -> tuple[Log, tuple[str, ...]]:
    (after,), notes = reviewed(vehicle, [log])
    return after, notes


# --- accidents -------------------------------------------------------------------------------


def test_a_good_log_is_left_alone(good):
    after, notes = review(boat(), good)
    assert after is good and notes == ()


def test_a_collision_is_named_with_its_time():
    log = pieces(boat(), COMMANDS, struck)
    after, notes = review(boat(), log)
    (one,) = after.rejected
    assert one.reason == "collision" and one.start < 42.0 < one.end < one.start + 2.5
    assert "collision" in notes[0] and f"t = {one.start:.1f} s" in notes[0]
    assert after.notes == (*log.notes, *notes)
    gone = np.isnan(after.channels[:, 0])
    assert np.array_equal(gone, (log.t >= one.start) & (log.t <= one.end))
    assert np.array_equal(after.channels[~gone], log.channels[~gone], equal_nan=True)
    noise = noise_of(boat(), [after])
    starts = cut(boat(), [after], noise, 4.0).starts
    assert not ((starts < one.end) & (starts + 3.9 > one.start)).any()
    assert len(starts) == len(cut(boat(), [log], noise, 4.0).starts) - 1
    again, notes = review(boat(), after)
    assert again is after and notes == ()
    # a part of the log knows what of it was left out
    assert after.split(60.0)[0].rejected == (one,) and after.split(60.0)[1].rejected == ()


def test_one_step_takes_no_slope_from_a_collision(good):
    """Where velocities jump: the estimate is that of a log without, and as sure."""

    def found(log):
        fitted = fit(boat(), log, lambda v: v.damping.linear, entries="diagonal", loss="one_step")
        return np.array([(p.value, p.std_model) for p in fitted.parameters]).T

    twice = pieces(boat(), COMMANDS, lambda k, nu: struck(2, nu) if k in (2, 4) else nu)
    (value, std), (struck_value, struck_std) = found(good), found(twice)
    # A fiftieth of the log is left out. With slopes through both jumps the estimate is two errors off.
    assert (np.abs(struck_value - value) < 0.5 * std).all()
    np.testing.assert_allclose(struck_std, std, rtol=0.1)


@pytest.mark.slow
def test_parameters_are_as_near_as_without_the_collision(monkeypatch):
    """Within three standard errors of the truth; a fit that takes the collision along is far less sure.

    One window of thirty is missed by many times the noise, by which all of them are then weighed.
    """

    def found(log):
        result = fit(boat(), log, lambda v: v.damping.linear, entries="diagonal", throw=False)
        return np.array([(p.value, p.std_model) for p in result.parameters]), result.notes

    log = pieces(boat(), COMMANDS, struck)
    truth = np.diag(np.asarray(boat().damping.linear))[[0, 1, 5]]
    (value, std), notes = found(log)[0].T, found(log)[1]
    assert (np.abs(value - truth) < 3.0 * std).all() and "collision" in notes[0]
    assert check(boat(), log).notes == notes
    monkeypatch.setattr("jaxmarine.fitting._fit.reviewed", lambda vehicle, logs: (logs, ()))
    (_, unsure), notes = found(log)[0].T, found(log)[1]
    # Nine to thirty times less sure, by axis.
    assert (unsure > 5.0 * std).all() and "the model misses" in notes[0]


@pytest.mark.slow
def test_a_cause_is_named_as_if_the_collision_were_not_there(monkeypatch):
    """Half a thruster in a log that is struck; a diagnosis that takes the collision along is worse."""
    weak = boat().place(Placed(ThrusterGain(jnp.array([1.0, 0.5, 1.0]))))
    test = pieces(weak, steps(SAMPLES, seed=4), lambda k, nu: nu, seed=1)
    log = pieces(weak, COMMANDS, struck)
    found = diagnose(boat(), log, test)
    (one,) = found.findings
    factor = one.parameters["factor"]
    assert one.label == "thruster_gain:starboard" and found.verdict == "explained" and found.white
    assert abs(factor.value - 0.5) < 3.0 * factor.std
    assert [accident.reason for accident in found.rejected] == ["collision"]
    monkeypatch.setattr("jaxmarine.diagnosis._prepare.reviewed", lambda vehicle, logs: (logs, ()))
    taken_along = diagnose(boat(), log, test)
    assert not taken_along.white and not taken_along.rejected


def test_a_take_over_is_named_and_one_that_does_not_end_is_an_effect(good):
    after, notes = review(boat(), taken(good, 600, 720))
    (one,) = after.rejected
    assert one.reason == "take-over" and "take-over" in notes[0]
    assert abs(one.start - 60.0) < 2.5 and abs(one.end - 72.0) < 3.5
    unended = taken(good, 700, SAMPLES)
    assert review(boat(), unended)[0].rejected == ()


def test_a_float_at_the_surface_is_named():
    vehicle, log = surfaced(hits=True)
    at_surface = log.channels[:, CHANNELS.index("z")] < 0.05
    after, _ = review(vehicle, log)
    assert after.rejected and {one.reason for one in after.rejected} == {"surfacing"}
    gone = np.isnan(after.channels[:, CHANNELS.index("z")])
    assert gone[at_surface].mean() > 0.8 and gone.mean() < 0.2
    vehicle, log = surfaced(hits=False)
    assert review(vehicle, log)[0].rejected == ()


@pytest.mark.parametrize("change", [(0.0, 1.0, 1.0), (1.0, 1.0, 0.3)], ids=["a dead thruster", "a weak one"])
def test_an_effect_that_begins_is_no_dirt(change):
    done = COMMANDS.copy()
    done[500:] *= change
    log = dataclasses.replace(pieces(boat(), done, lambda k, nu: nu), commands=COMMANDS)
    assert review(boat(), log)[0].rejected == ()


def test_rough_water_is_no_dirt():
    """Pushes that come again and again, each as large as a collision, are the water's."""
    rng, pushed = np.random.default_rng(0), np.array([1.0, 1.0, 0, 0, 0, 1.0])
    log = pieces(boat(), COMMANDS, lambda k, nu: nu + pushed * rng.normal(size=6))
    after, notes = review(boat(), log)
    assert after.rejected == () and np.array_equal(after.channels, log.channels, equal_nan=True)
    assert all("nothing is left out" in note for note in notes)


def test_damping_with_the_sign_of_a_derivative_is_told(good):
    """X_u of the literature is negative; a hundredth of what brakes is no sign."""
    whole, small = boat(), 0.01 * boat().mass_matrix[0, 0]

    def with_surge(linear, quadratic):
        damping = Damping(
            whole.damping.linear.at[0, 0].set(linear), whole.damping.quadratic.at[0, 0].set(quadratic)
        )
        return review(dataclasses.replace(whole, damping=damping), good)[1]

    (note,) = with_surge(-20.0, -30.0)
    assert note.startswith("boat: its damping drives it in surge instead of braking it")
    # Some craft brake at speed alone, some nearly not at all.
    assert with_surge(-20.0, 30.0) == with_surge(0.0, 0.0) == with_surge(-small, 0.0) == ()


class Reviewed(Exception):
    """Raised in place of a review, with the names of the logs."""


ACTS = {
    "fit": ("fitting._fit", lambda log: fit(boat(), log, lambda v: v.damping), ["log"]),
    "check": ("fitting._check", lambda log: check(boat(), log), ["log"]),
    "diagnose": (
        "diagnosis._prepare",
        lambda log: diagnose(
            boat(), log, dataclasses.replace(log, channels=log.channels + 1.0, name="other")
        ),
        ["log", "other"],
    ),
}


@pytest.mark.parametrize("module,act,names", ACTS.values(), ids=ACTS)
def test_fits_checks_and_diagnoses_review_their_logs_first(good, monkeypatch, module, act, names):
    def review(vehicle, logs):
        raise Reviewed([log.name for log in logs])

    monkeypatch.setattr(f"jaxmarine.{module}.reviewed", review)
    with pytest.raises(Reviewed) as caught:
        act(good)
    assert caught.value.args[0] == names


# --- clocks ----------------------------------------------------------------------------------


def offset_of(vehicle: Vehicle, log: Log) -> ClockOffset | None:
    track = smooth_states(log, vehicle.dof)
    return clock_offset(log, track, driven(vehicle, log, track))


@pytest.mark.parametrize("samples", [-4, 3, 7])
def test_an_offset_between_the_clocks_is_told(good, samples):
    late = dataclasses.replace(good, commands=np.roll(COMMANDS, -samples, axis=0))
    offset = offset_of(boat(), late)
    assert offset is not None and offset.significant
    assert abs(offset.seconds - samples * DT) < max(4.0 * offset.std, 0.02)
    assert offset.std < 0.02
    after, (note,) = review(boat(), late)
    assert ("later than" if samples > 0 else "before") in note and "No time was shifted" in note
    assert after.notes == (note,) and after.t is late.t and after.commands is late.commands


def test_no_offset_is_told_where_there_is_none(good):
    """Nor where the file is far off: the regression has its own coefficients."""
    wrong = eqx.tree_at(lambda v: v.damping, boat(), replace_fn=lambda d: jax.tree.map(lambda a: 2.0 * a, d))
    for vehicle in (boat(), wrong):
        offset = offset_of(vehicle, good)
        assert offset is not None and not offset.significant
        assert abs(offset.seconds) < max(4.0 * offset.std, 0.02)


def test_a_delay_that_the_file_has_is_no_offset(good):
    late = dataclasses.replace(good, commands=np.roll(COMMANDS, -4, axis=0))
    delayed = eqx.tree_at(lambda v: v.thrusters.delay, boat(), jnp.full(3, 0.4))
    assert review(delayed, late)[1] == ()


def test_a_log_without_commands_that_change_has_no_offset(good):
    still = dataclasses.replace(good, commands=np.zeros_like(COMMANDS))
    assert offset_of(boat(), still) is None
    resting = dataclasses.replace(good, channels=np.where(np.isfinite(good.channels), 0.0, np.nan))
    assert offset_of(boat(), resting) is None
