"""Draws of a random wrench: against the correlation that its memory and period say."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import jaxmarine as jm
from jaxmarine.effects import SteadyCurrent, WindPush
from jaxmarine.logs import Log
from tests.boats import boat

GUSTS = jm.RandomWrench(size=np.array([3.0, 0.0, 0, 0, 0, 0.4]), memory=np.array([4.0, 0, 0, 0, 0, 1.0]))
SWELL = jm.RandomWrench(np.zeros(6), np.zeros(6), np.array([0, 2.0, 0, 0, 0, 0]), 5.0, 20.0)


def test_gusts_have_their_size_and_memory_on_any_times():
    """Within four standard errors of 8000 s / (2 memories) independent values; what lies far apart is new."""
    t = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.35, 40000))
    drawn = GUSTS.draw(t, 0)
    assert (drawn[:, 1:5] == 0).all()
    for axis, size, memory in ((0, 3.0, 4.0), (5, 0.4, 1.0)):
        error = 4 * np.sqrt(2 * 2 * memory / np.ptp(t))
        assert drawn[:, axis].var() == pytest.approx(size**2, rel=error)
        # One memory later it is 1/e of it.
        later = np.interp(t + memory, t, drawn[:, axis])[t + memory < t[-1]]
        now = drawn[: len(later), axis]
        assert (now * later).mean() / size**2 == pytest.approx(np.exp(-1), abs=error)
    far = GUSTS.draw(np.arange(2000) * 100.0, 0)[:, 0]
    assert abs(np.corrcoef(far[1:], far[:-1])[0, 1]) < 4 / np.sqrt(2000)


def test_a_swell_comes_back_after_its_period():
    """On any times, as its spectrum says: its correlation is the transform of that (Wiener, Khinchin)."""
    t = np.arange(0.0, 20000.0, 0.5)
    drawn = SWELL.draw(t, 1)[:, 1]
    at = np.linspace(0.0, 50.0, 200001)  # rad/s
    power = spectrum_of(SWELL, at)
    for lag in (5, 10, 20):  # half a period, one and two
        now = (drawn[lag:] * drawn[:-lag]).mean() / 4.0
        expected = np.trapezoid(power * np.cos(at * 0.5 * lag), at) / np.trapezoid(power, at)
        # Over some 500 stretches of twice its memory.
        assert now == pytest.approx(expected, abs=4 * np.sqrt(1 / 500))


def spectrum_of(swell: jm.RandomWrench, at: np.ndarray) -> np.ndarray:
    """Of white noise twice through the filter, but for a factor; at frequencies [rad/s]."""
    slow, frequency = 1 / swell.swell_memory, 2 * np.pi / swell.period
    _, response = scipy.signal.freqs([1.0, 0.0], [1.0, 2 * slow, slow**2 + frequency**2], at)
    return np.abs(response) ** 4


def test_a_swell_has_the_spectrum_of_its_filters():
    """Over frequencies from far below its own, where nothing of it is, to far above, by Welch's method."""
    swell = dataclasses.replace(SWELL, swell_memory=8.0)
    dt, at = 0.1, np.array([0.02, 0.1, 0.15, 0.2, 0.25, 0.3, 0.6])  # s, Hz
    frequency, power = scipy.signal.welch(swell.draw(dt * np.arange(400000), 1)[:, 1], 1 / dt, nperseg=4000)
    every = np.linspace(0.0, 10.0, 200001)  # Hz
    whole = np.trapezoid(spectrum_of(swell, 2 * np.pi * every), every)
    expected = 4.0 / whole * spectrum_of(swell, 2 * np.pi * at)
    # Of 200 stretches: a standard error of 7 %, three of them; less where several frequencies count.
    found = [power[np.abs(frequency - one) < 0.005].mean() for one in at]
    np.testing.assert_allclose(found, expected, rtol=0.21)


@pytest.mark.parametrize("what", ["period", "drift", "current"])
def test_what_has_no_memory_is_refused(what):
    with pytest.raises(ValueError, match=f"`{what}` needs `.*memory`"):
        dataclasses.replace(GUSTS, **{what: 3.0})


def test_a_seed_gives_the_same_again_and_another_another():
    t = np.arange(100) * 0.1
    np.testing.assert_array_equal(GUSTS.draw(t, 3), GUSTS.draw(t, 3))
    assert np.abs(GUSTS.draw(t, 3) - GUSTS.draw(t, 4)).max() > 0.1


def test_a_push_moves_the_craft_as_a_wrench_of_the_log_does():
    """Over a hold as its mean does; an acceleration shows what it is at its sample."""
    t = np.arange(50) * 0.1
    given = np.tile([10.0, 2.0, 0, 0, 0, 1.0], (50, 1))
    push = GUSTS.draw(t, 2)
    over = given + 0.5 * (push + np.append(push[1:], push[-1:], axis=0))
    blank = Log(t, np.full((50, 18), np.nan), None, given, (), "log.csv")
    both = Log(t, blank.channels, None, over, (), "log.csv")
    pushed = np.asarray(jm.simulate(boat(), blank, jm.initial_state(boat()), push=push).channels)
    same = np.asarray(jm.simulate(boat(), both, jm.initial_state(boat())).channels)
    np.testing.assert_allclose(pushed[:, :12], same[:, :12], atol=1e-12)
    # The mass is that of the boat's surge: a force of 1 N more at the sample than over the hold.
    surge = boat().mass_matrix[0, 0]
    more = push[:, 0] - (over - given)[:, 0]
    np.testing.assert_allclose(pushed[:, 12] - same[:, 12], more / surge, atol=1e-12)
    calm = jm.simulate(boat(), blank, jm.initial_state(boat()))
    assert np.abs(np.asarray(calm.channels) - pushed).max() > 1e-3


def test_water_that_moves_steadily_is_a_steady_current():
    t = np.arange(50) * 0.1
    blank = Log(
        t, np.full((50, 18), np.nan), None, np.tile([10.0, 2.0, 0, 0, 0, 1.0], (50, 1)), (), "log.csv"
    )
    current = np.array([0.3, -0.2, 0.0])
    filed = boat().place(jm.Placed(SteadyCurrent(*map(jnp.asarray, current))))
    start = jm.initial_state(boat(), attitude=(0, 0, 0.5))
    moving = jm.simulate(boat(), blank, start, water=np.tile(current, (50, 1)), sensors=("water_velocity",))
    steady = jm.simulate(filed, blank, start, sensors=("water_velocity",))
    np.testing.assert_allclose(moving.channels, steady.channels, atol=1e-12)


def test_a_force_in_earth_axes_is_a_wind_where_it_is_steady():
    t = np.arange(50) * 0.1
    blank = Log(
        t, np.full((50, 18), np.nan), None, np.tile([10.0, 2.0, 0, 0, 0, 1.0], (50, 1)), (), "log.csv"
    )
    filed = boat().place(jm.Placed(WindPush(jnp.asarray(3.0), jnp.asarray(-2.0))))
    start = jm.initial_state(boat(), attitude=(0, 0, 0.5))
    drifting = jm.simulate(boat(), blank, start, drift=np.tile([3.0, -2.0, 0.0], (50, 1)))
    steady = jm.simulate(filed, blank, start)
    np.testing.assert_allclose(drifting.channels, steady.channels, atol=1e-12)


@pytest.mark.parametrize("which", ["current", "drift"])
def test_what_lies_in_the_plane_has_its_size_and_memory(which):
    """Alike to the north and to the east, and not the wrench of the same seed."""
    wanders = dataclasses.replace(GUSTS, **{which: 0.1, f"{which}_memory": 30.0})
    t = np.arange(0.0, 60000.0, 2.0)
    drawn = getattr(wanders, f"draw_{which}")(t, 4)
    assert drawn.shape == (len(t), 3) and (drawn[:, 2] == 0).all()
    error = 4 * np.sqrt(2 * 2 * 30.0 / np.ptp(t))
    assert drawn[:, :2].var(axis=0) == pytest.approx([0.01, 0.01], rel=error)
    later = (drawn[15:, :2] * drawn[:-15, :2]).mean(axis=0) / 0.01
    assert later == pytest.approx(np.full(2, np.exp(-1)), abs=error)
    assert abs(np.corrcoef(drawn[:, 0], wanders.draw(t, 4)[:, 0])[0, 1]) < error
    unit = {"current": "m_s", "drift": "N"}[which]
    assert wanders.to_json()[which] == {f"size_{unit}": 0.1, "memory_s": 30.0}


def test_what_is_written_names_the_axes_that_are_pushed():
    assert GUSTS.to_json() == {
        "axes": {
            "surge": {"unit": "N", "size": 3.0, "memory_s": 4.0},
            "yaw": {"unit": "N m", "size": 0.4, "memory_s": 1.0},
        }
    }
    both = SWELL.to_json()
    assert both["axes"] == {"sway": {"unit": "N", "swell": 2.0}} and both["period_s"] == 5.0
