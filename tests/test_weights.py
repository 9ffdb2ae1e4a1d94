"""Weights of a window's samples: against the closed form of coloured noise, and what a fit makes of them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmarine._types import CHANNELS, SENSORS
from jaxmarine.effects import HullLift
from jaxmarine.fitting import fit
from jaxmarine.fitting._weights import largest, overdispersion, scaled
from jaxmarine.vehicle import Placed
from tests.boats import boat, record, steps

MANY = np.full(18, 1e9)


def coloured(rho: float, windows: int, size: int, seed: int = 0) -> np.ndarray:
    """Stationary first-order noise of variance 1 in every channel [windows, size, 18]."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(windows, size, 18))
    for k in range(1, size):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * out[:, k]
    return out


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_overdispersion_is_that_of_the_mean_of_coloured_noise(rho: float):
    """The variance of a mean of n samples with correlation rho^l is known; twice the noise is twice of it."""
    size, noise = 40, coloured(rho, 600, 40)
    lags = np.arange(1, size)
    expected = np.sqrt(1 + 2 * np.sum((1 - lags / size) * rho**lags))
    seen = np.ones_like(noise)
    # 600 windows know a variance to 6 %.
    assert overdispersion(noise, seen, MANY).mean() == pytest.approx(expected, rel=0.06)
    assert overdispersion(2 * noise, seen, MANY).mean() == pytest.approx(2 * expected, rel=0.06)
    np.testing.assert_array_equal(overdispersion(0.1 * noise, seen, MANY), 1.0)


def test_a_sensor_of_every_other_row_counts_its_own_samples():
    noise = coloured(0.8, 600, 40)
    sparse = np.ones_like(noise)
    sparse[:, 1::2] = 0.0
    lags = np.arange(1, 20)
    expected = np.sqrt(1 + 2 * np.sum((1 - lags / 20) * 0.64**lags))
    assert overdispersion(noise, sparse, MANY).mean() == pytest.approx(expected, rel=0.08)


def test_a_window_begins_as_exactly_as_its_sensors_measure():
    weight = np.full((2, 40, 18), 5.0)
    weight[:, :3, 0] = 0.0  # comes a little late
    weight[:, :30, 1] = 0.0  # comes when errors of the model have grown
    out = scaled(weight, np.full(18, 10.0), 0.1)
    assert (out[:, 3, 0] == 5.0).all() and (out[:, 4:, 0] == 0.5).all()
    assert (out[:, 30:, 1] == 0.5).all()
    assert (out[:, 0, 2:12] == 5.0).all() and (out[:, 1:, 2:] == 0.5).all()
    assert (out[:, 0, 12:] == 0.5).all()  # a model may miss accelerations from the first sample on
    np.testing.assert_array_equal(out > 0, weight > 0)


def test_no_channel_is_missed_by_more_than_it_changes():
    measured = np.linspace(0.0, 1.0, 40)[None, :, None] * np.ones((3, 1, 18))
    assert largest(measured, np.full((3, 40, 18), 100.0)) == pytest.approx(100 * np.sqrt(1 / 12), rel=0.05)
    np.testing.assert_array_equal(largest(measured, np.full((3, 40, 18), 1e-3)), 1.0)


# --- what a fit makes of them -----------------------------------------------------------------


def everything(v):
    return v.added_mass, v.damping.linear, v.damping.quadratic, v.thrusters.max_thrust


def unstated(vehicle):
    return dataclasses.replace(vehicle, sensors=())


def test_a_log_at_rest_leaves_the_file_and_the_spread_it_came_with():
    log = record(boat(), 0.0 * steps(), seed=4)
    found = fit(boat(), log, everything, entries="diagonal", prior=0.3)
    assert found.converged
    mass = np.diag(boat().mass_matrix)[[0, 1, 5]]
    size = np.concatenate([mass, [abs(p.start) for p in found.parameters[3:]]])
    value, start, std = (
        np.array([getattr(p, k) for p in found.parameters]) for k in ("value", "start", "std_model")
    )
    # Noise in the fitted starts of the windows looks like motion, and moves them by a part of a width.
    np.testing.assert_array_less(np.abs(value - start), 0.7 * 0.3 * size)
    assert (std > 0.5 * 0.3 * size).all() and (std < 1.1 * 0.3 * size).all()


@pytest.mark.slow
def test_what_the_model_lacks_does_not_outweigh_the_prior():
    """A hull's lift that the file lacks, sensors without noise, none stated: chi-squares of millions."""
    lift = dataclasses.replace(HullLift.neutral(boat()), Y_uv=jnp.asarray(60.0), N_uv=jnp.asarray(40.0))
    exact = dict.fromkeys(SENSORS, 1e-6)
    log = record(boat().place(Placed(lift, None)), steps(), noise=exact)
    found = fit(unstated(boat()), log, everything, entries="diagonal", prior=0.3)
    assert found.converged
    assert found.reduced_chi2 > 1e4 and [note for note in found.notes if "the model misses" in note]
    for p in found.parameters:
        assert np.isfinite(p.value) and p.value > 0
        # Without the weights some are seven widths off and more.
        assert abs(p.value - p.start) < 4.0 * 0.3 * max(abs(p.start), 1.0) or "added_mass" in p.name
    total = np.diag(found.vehicle.mass_matrix)[[0, 1, 5]] / np.diag(boat().mass_matrix)[[0, 1, 5]]
    assert (total > 0.3).all() and (total < 3.0).all()


@pytest.mark.parametrize(
    "channels",
    ["x y psi", *(pytest.param(one, marks=pytest.mark.slow) for one in ("u v r", "x y psi u v r"))],
)
@settings(max_examples=2)
@given(seed=st.integers(0, 10**6))
def test_no_log_makes_a_mass_negative_or_huge(channels: str, seed: int):
    """Channels that walk at random have nothing to do with the commands, whatever these are."""
    rng = np.random.default_rng(seed)
    log = record(boat(), rng.choice([0.0, 0.3, 1.0]) * steps(seed=seed))
    walk = np.cumsum(rng.normal(size=log.channels.shape), axis=0) * rng.uniform(1e-3, 0.1, 18)
    walk = np.where(np.isin(CHANNELS, channels.split()), walk, np.nan)
    found = fit(
        unstated(boat()),
        dataclasses.replace(log, channels=walk),
        everything,
        entries="diagonal",
        prior=0.3,
        throw=False,
    )
    numbers = np.array([p.value for p in found.parameters])
    assert np.isfinite(numbers).all()
    assert (np.diag(found.vehicle.added_mass) >= 0).all() and (found.vehicle.thrusters.max_thrust > 0).all()
    if found.converged:
        total = np.diag(found.vehicle.mass_matrix)[[0, 1, 5]] / np.diag(boat().mass_matrix)[[0, 1, 5]]
        assert (total > 0.1).all() and (total < 10.0).all()
