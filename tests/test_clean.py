"""Spikes and dropouts put into the logs of a simulated boat: found, named and harmless; all else is kept."""

import dataclasses
import re

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.fitting import fit
from jaxmarine.logs import Log, clean, read_log, write_log
from tests.boats import NOISE, boat, record, steps

SAMPLES = 400


@pytest.fixture(scope="module")
def good() -> Log:
    return record(boat(), steps(SAMPLES), seed=1)


def column(log: Log, name: str) -> np.ndarray:
    return log.channels[:, CHANNELS.index(name)]


def with_channel(log: Log, name: str, values: np.ndarray) -> Log:
    channels = log.channels.copy()
    channels[:, CHANNELS.index(name)] = values
    return dataclasses.replace(log, channels=channels)


def spiked(log: Log, name: str, rows, size: float) -> Log:
    values = column(log, name).copy()
    values[rows] += size
    return with_channel(log, name, values)


def held(log: Log, name: str, first: int, count: int, value: float | None = None) -> Log:
    """A sensor that repeats what it measured at `first`, or shows a value of its own from there on."""
    values = column(log, name).copy()
    values[first : first + count] = values[first] if value is None else value
    return with_channel(log, name, values)


def missing(log: Log, name: str) -> list[int]:
    return np.flatnonzero(np.isnan(column(log, name))).tolist()


# --- what is found ---------------------------------------------------------------------------


@pytest.mark.parametrize("name,size", [("x", 3.0), ("psi", -1.0), ("u", 1.5), ("r", -2.0)])
@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_spike_goes_and_nothing_else(good, name, size, width):
    rows = [*range(77, 77 + width), 203, 301]
    found = clean(spiked(good, name, rows, size))
    assert missing(found, name) == rows
    others = [c for c in good.measured if c != name]
    assert all(np.array_equal(column(found, c), column(good, c)) for c in others)
    assert np.array_equal(np.delete(column(found, name), rows), np.delete(column(good, name), rows))
    (note,) = found.notes
    assert f"{len(rows)} of 400 samples of `{name}`" in note and "spikes" in note
    assert re.search(r"between t = 7.7 s and 30.1 s", note)


def test_a_heading_that_is_wrapped_is_no_spike_and_hides_none(good):
    turning = with_channel(good, "psi", np.angle(np.exp(1j * (column(good, "psi") + 3.1))))
    assert clean(turning) is turning
    assert missing(clean(spiked(turning, "psi", [150], 1.2)), "psi") == [150]


@pytest.mark.parametrize("name", ["x", "psi", "u", "r"])
def test_a_sensor_that_is_held_goes_but_for_its_last_sample(good, name):
    found = clean(held(good, name, 120, 12))
    assert missing(found, name) == [*range(121, 132)]
    assert "dropouts" in found.notes[0] and "t = 12.1 s and 13.1 s" in found.notes[0]


@pytest.mark.parametrize("name,value", [("x", 0.0), ("u", -9.0)])
def test_a_value_that_was_never_measured_goes_whole(good, name, value):
    moved = with_channel(good, name, column(good, name) + 5.0)
    assert missing(clean(held(moved, name, 120, 12, value)), name) == [*range(120, 132)]


def test_a_spike_beside_a_dropout_is_seen_once_that_has_gone():
    log = record(boat(), steps(SAMPLES), seed=1, dt=0.05)
    beside = spiked(held(log, "u", 120, 4, 9.5), "u", [119], 9.0)
    found = clean(beside)
    assert missing(found, "u") == [*range(119, 124)]
    assert len(found.notes) == 2 and "at t = 5.95 s" in found.notes[0]


def test_too_many_are_left_as_they_are(good):
    many = spiked(good, "u", np.arange(10, 390, 39), 1.5)
    found = clean(many)
    assert np.array_equal(found.channels, many.channels, equal_nan=True)
    assert "10 of 400 samples of `u` look like spikes" in found.notes[0] and "left as it is" in found.notes[0]
    assert clean(found) is found


def test_a_noisy_sensor_that_freezes_often_is_missing_then(good):
    """Two fifths of a position stand still for 2 s at a time and jump, in a wind that always changes."""
    frozen, rows = good, []
    for first in range(30, 380, 50):
        frozen = held(frozen, "x", first, 20)
        rows += range(first + 1, first + 20)
    wind = np.random.default_rng(0).normal(size=(SAMPLES, 1))
    log = dataclasses.replace(frozen, commands=good.commands + 1e-3 * wind)
    found = clean(log)
    assert missing(found, "x") == [row for row in rows if row < SAMPLES]
    assert clean(found) is found


def test_steps_of_a_coarse_sensor_are_told(good):
    coarse = with_channel(good, "x", np.round(column(good, "x") / 0.25) * 0.25)
    found = clean(coarse)
    assert np.array_equal(found.channels, coarse.channels, equal_nan=True)
    assert "`x` comes in steps of 0.25" in found.notes[0]


# --- what is left alone ----------------------------------------------------------------------


@pytest.mark.parametrize("noise", [NOISE, dict.fromkeys(NOISE, 0.0)], ids=["noisy", "exact"])
@pytest.mark.parametrize("hold,dt", [(1, 0.1), (3, 0.02), (20, 0.5), (100, 0.1)])
def test_a_good_log_comes_back_as_it_is(noise, hold, dt):
    commands = steps(SAMPLES, seed=hold, hold=hold)
    commands[:30] = 0.0  # at rest
    log = record(boat(), commands, noise | {"acceleration": noise["velocity"]}, seed=hold, dt=dt)
    assert clean(log) is log


def test_a_step_that_stays_and_rough_motion_are_no_spikes(good):
    stepped = spiked(good, "x", np.arange(200, SAMPLES), 3.0)
    assert clean(stepped) is stepped
    rng = np.random.default_rng(0)
    # a quarter of the log in breaking waves
    rough = spiked(good, "r", np.arange(100, 200), 0.0)
    rough = with_channel(
        rough, "r", column(good, "r") + np.repeat([0, 0.3, 0, 0], 100) * rng.normal(size=400)
    )
    assert clean(rough) is rough


def test_an_acceleration_after_a_short_command_is_no_spike():
    commands = np.zeros((SAMPLES, 3))
    commands[[50, 180, 310]] = 0.9
    log = record(boat(), commands, {"acceleration": 0.01, "velocity": 0.02, "rate": 0.01})
    assert np.abs(column(log, "du")).max() > 50 * 0.01
    assert clean(log) is log
    assert missing(clean(spiked(log, "du", [100], 2.0)), "du") == [100]


def test_rows_that_repeat_a_slow_sensor_are_missing(good):
    """Each sample of it counts once; a channel beside it is as before."""
    held = np.repeat(column(good, "x")[::2], 2)
    found = clean(with_channel(good, "x", held))
    assert [note for note in found.notes if "`x` comes every 0.2 s" in note]
    seen = np.isfinite(column(found, "x"))
    np.testing.assert_array_equal(seen, np.arange(len(held)) % 2 == 0)
    np.testing.assert_array_equal(column(found, "y"), column(good, "y"))
    assert clean(found).channels.tobytes() == found.channels.tobytes()


# --- invariants ------------------------------------------------------------------------------

defects = st.lists(
    st.tuples(
        st.sampled_from(["x", "psi", "u", "v", "r"]),
        st.sampled_from(["spike", "held", "zero"]),
        st.integers(0, SAMPLES - 20),
        st.integers(1, 15),
        st.floats(-3.0, 3.0),
    ),
    max_size=6,
)


def spoilt(log: Log, what) -> Log:
    for name, kind, first, count, size in what:
        if kind == "spike":
            log = spiked(log, name, [first], size)
        else:
            log = held(log, name, first, count, 0.0 if kind == "zero" else None)
    return log


@hypothesis.given(defects)
@hypothesis.settings(max_examples=8)
def test_cleaning_twice_is_cleaning_once(good, what):
    once = clean(spoilt(good, what))
    assert clean(once) is once


@hypothesis.given(defects)
@hypothesis.settings(max_examples=8)
def test_nothing_is_invented(good, what):
    dirty = spoilt(good, what)
    found = clean(dirty)
    kept = np.isfinite(found.channels)
    assert np.array_equal(found.channels[kept], dirty.channels[kept])
    changed = [
        name for name in CHANNELS if np.isnan(column(found, name)).sum() > np.isnan(column(dirty, name)).sum()
    ]
    assert all(any(f"`{name}`" in note for note in found.notes) for name in changed)
    assert all(
        one is two for one, two in zip(jax.tree.leaves(dirty)[::2], jax.tree.leaves(found)[::2], strict=True)
    )


@hypothesis.given(defects)
@hypothesis.settings(max_examples=8)
def test_spikes_are_the_same_backwards_in_time(good, what):
    dirty = spoilt(good, [one for one in what if one[1] == "spike"])
    back = jax.tree.map(lambda a: a[::-1].copy(), dirty)
    back = dataclasses.replace(back, t=-back.t)
    assert np.array_equal(clean(back).channels[::-1], clean(dirty).channels, equal_nan=True)


@hypothesis.given(defects)
@hypothesis.settings(max_examples=3)
def test_channels_are_cleaned_in_any_order(good, what):
    """Each by itself: what is found in one does not hang on what was found in another."""
    dirty, all_at_once = spoilt(good, what), clean(spoilt(good, what))
    for name in reversed(good.measured):
        dirty = with_channel(dirty, name, column(clean(dirty), name))
    assert np.array_equal(dirty.channels, all_at_once.channels, equal_nan=True)


# --- what it is for --------------------------------------------------------------------------


def damping(vehicle):
    return (vehicle.damping.linear, vehicle.added_mass)


@pytest.mark.slow
def test_a_fit_of_a_cleaned_log_is_that_of_the_good_one(tmp_path, good):
    """Read from a file with defects, the log gives what the good one gives within half a standard error.

    Fitted as it is, it does not: windows that jump weigh little, but they weigh.
    """
    dirty = held(spiked(spiked(good, "u", [60, 250], 2.0), "x", [180, 181], 4.0), "psi", 300, 15)
    write_log(dirty, tmp_path / "dirty.csv")
    write_log(good, tmp_path / "good.csv")
    start = eqx.tree_at(lambda v: v.damping.linear, boat(), replace_fn=lambda d: 1.3 * d)

    def found(log: Log):
        return fit(start, log, damping, entries="diagonal")

    read = read_log(tmp_path / "dirty.csv", boat())
    assert sum("count as missing" in note for note in read.notes) == 3
    clean_fit, dirty_fit = found(read_log(tmp_path / "good.csv", boat())), found(read)
    std = np.array([p.std_model for p in clean_fit.parameters])
    values = np.array([[p.value for p in one.parameters] for one in (clean_fit, dirty_fit)])
    assert (np.abs(values[0] - values[1]) < 0.5 * std).all()
    spoilt_fit = fit(start, dirty, damping, entries="diagonal", throw=False)
    assert (np.abs([p.value for p in spoilt_fit.parameters] - values[0]) > 0.5 * std).any()
