"""Accidents and false clocks put into simulated logs: named with their time, and all else is left alone."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.effects import ConstantWrench, ThrusterGain
from jaxmarine.fitting import clock_offset, cut, fit, noise_of, without_dirt
from jaxmarine.fitting._clock import clock_note
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed, Vehicle
from tests.boats import NOISE, PLANAR, boat, record, steps

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


# --- accidents -------------------------------------------------------------------------------


def test_a_good_log_is_left_alone(good):
    kept, rejected, notes = without_dirt(boat(), good)
    assert kept is good and rejected == () and notes == []


def test_a_collision_is_named_with_its_time():
    log = pieces(boat(), COMMANDS, struck)
    kept, (one,), notes = without_dirt(boat(), log)
    assert one.reason == "collision" and one.start < 42.0 < one.end < one.start + 2.5
    assert "collision" in notes[0] and f"t = {one.start:.1f} s" in notes[0]
    gone = np.isnan(kept.channels[:, 0])
    assert np.array_equal(gone, (log.t >= one.start) & (log.t <= one.end))
    assert np.array_equal(kept.channels[~gone], log.channels[~gone], equal_nan=True)
    noise = noise_of(boat(), [kept])
    starts = cut(boat(), [kept], noise, 4.0).starts
    assert not ((starts < one.end) & (starts + 3.9 > one.start)).any()
    assert len(starts) == len(cut(boat(), [log], noise, 4.0).starts) - 1
    again, none, notes = without_dirt(boat(), kept)
    assert again is kept and none == (), notes


def test_parameters_are_as_near_as_without_the_collision(good):
    """Beside the good log's within half a standard error; the collision itself moves them by many."""

    def found(log):
        result = fit(boat(), log, lambda v: v.damping.linear, entries="diagonal", throw=False)
        return np.array([(p.value, p.std_model) for p in result.parameters])

    log = pieces(boat(), COMMANDS, struck)
    kept = without_dirt(boat(), log)[0]
    # the truth, as the boat drives elsewhere after the collision and the noise meets other motion
    truth = np.diag(np.asarray(boat().damping.linear))[[0, 1, 5]]
    value, std = found(kept).T
    assert (np.abs(value - truth) < 3.0 * std).all()
    value, std = found(log).T
    assert (np.abs(value - truth) > 6.0 * std).any()


def test_a_take_over_is_named_and_one_that_does_not_end_is_an_effect(good):
    _, (one,), notes = without_dirt(boat(), taken(good, 600, 720))
    assert one.reason == "take-over" and "take-over" in notes[0]
    assert abs(one.start - 60.0) < 2.5 and abs(one.end - 72.0) < 3.5
    unended = taken(good, 700, SAMPLES)
    assert without_dirt(boat(), unended)[0] is unended


def test_a_float_at_the_surface_is_named():
    vehicle, log = surfaced(hits=True)
    at_surface = log.channels[:, CHANNELS.index("z")] < 0.05
    kept, rejected, _ = without_dirt(vehicle, log)
    assert rejected and {one.reason for one in rejected} == {"surfacing"}
    gone = np.isnan(kept.channels[:, CHANNELS.index("z")])
    assert gone[at_surface].mean() > 0.8 and gone.mean() < 0.2
    vehicle, log = surfaced(hits=False)
    assert without_dirt(vehicle, log)[0] is log


@pytest.mark.parametrize(
    "placed",
    [
        Placed(ThrusterGain(jnp.array([0.0, 1.0, 1.0])), "port", 50.0),
        Placed(ConstantWrench(jnp.array([0.0, 40.0, 0, 0, 0, 0])), "sway", 50.0),
    ],
    ids=["thruster fails", "current sets in"],
)
def test_an_effect_that_begins_is_no_dirt(placed):
    log = record(boat().place(placed), COMMANDS)
    kept, rejected, notes = without_dirt(boat(), log)
    assert kept is log and rejected == () and notes == []


def test_rough_water_is_no_dirt(good):
    """Pushes that come again and again, each as large as a collision, are the water's."""
    rng, pushed = np.random.default_rng(0), np.array([1.0, 1.0, 0, 0, 0, 1.0])
    log = pieces(boat(), COMMANDS, lambda k, nu: nu + pushed * rng.normal(size=6))
    kept, rejected, notes = without_dirt(boat(), log)
    assert kept is log and rejected == ()
    assert all("nothing is left out" in note for note in notes)


# --- clocks ----------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [-4, 3, 7])
def test_an_offset_between_the_clocks_is_told(good, samples):
    late = dataclasses.replace(good, commands=np.roll(COMMANDS, -samples, axis=0))
    offset = clock_offset(boat(), late)
    assert offset is not None and offset.significant
    assert abs(offset.seconds - samples * DT) < max(4.0 * offset.std, 0.02)
    assert offset.std < 0.02
    note = clock_note(boat(), late)
    assert note is not None and ("later than" if samples > 0 else "before") in note
    assert "No time was shifted" in note


def test_no_offset_is_told_where_there_is_none(good):
    """Nor where the file is far off: the regression has its own coefficients."""
    wrong = eqx.tree_at(lambda v: v.damping, boat(), replace_fn=lambda d: jax.tree.map(lambda a: 2.0 * a, d))
    for vehicle in (boat(), wrong):
        offset = clock_offset(vehicle, good)
        assert offset is not None and not offset.significant
        assert abs(offset.seconds) < max(4.0 * offset.std, 0.02)
        assert clock_note(vehicle, good) is None


def test_a_delay_that_the_file_has_is_no_offset():
    delayed = eqx.tree_at(lambda v: v.thrusters.delay, boat(PLANAR), jnp.full(3, 0.4))
    log = record(delayed, COMMANDS)
    assert clock_note(delayed, log) is None
    note = clock_note(boat(), log)
    assert note is not None and "later than" in note


def test_a_log_without_commands_that_change_has_no_offset(good):
    still = dataclasses.replace(good, commands=np.zeros_like(COMMANDS))
    assert clock_offset(boat(), still) is None
