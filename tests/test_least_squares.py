"""Least squares against numpy, a hand calculation and Monte Carlo; batched Levenberg-Marquardt."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxmarine._types import CHANNELS, SENSORS
from jaxmarine.fitting import least_squares, levenberg_marquardt, solve_linear
from jaxmarine.fitting._least_squares import members_of, resample_linear
from jaxmarine.logs import Log
from jaxmarine.vehicle import Vehicle
from tests.boats import boat, record, steps


def damping(v: Vehicle):
    return v.damping.linear, v.damping.quadratic


def test_qr_agrees_with_numpy():
    rng = np.random.default_rng(0)
    # Columns of very different units, and rows that do not count.
    matrix = rng.normal(size=(50, 4)) * np.array([1.0, 1e-4, 1e3, 10.0])
    right = matrix @ np.array([2.0, 3e4, -1e-3, 0.5]) + rng.normal(size=50)
    padded = np.concatenate([matrix, np.zeros((7, 4))]), np.concatenate([right, np.zeros(7)])
    found = solve_linear(*map(jnp.asarray, padded))
    expected, rest, _, _ = np.linalg.lstsq(matrix, right)
    # numpy does not scale the columns and loses the digits of their condition, 1e7
    np.testing.assert_allclose(found.values, expected, rtol=1e-7)
    covariance = rest[0] / 46 * np.linalg.inv(matrix.T @ matrix)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-6)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(covariance)), rtol=1e-7)


def test_draws_of_groups_are_solved_as_by_a_loop():
    rng = np.random.default_rng(1)
    # Groups of unlike sizes, out of order; two columns that are nearly one, and very different units.
    group = rng.permutation(np.repeat(np.arange(7), [9, 14, 8, 21, 10, 8, 12]))
    matrix = rng.normal(size=(len(group), 2, 4)) * np.array([1.0, 1e-4, 1e3, 10.0])
    matrix[..., 3] = 10.0 * matrix[..., 0] + 1e-5 * matrix[..., 3]
    right = matrix @ np.array([2.0, 3e4, -1e-3, 0.5]) + 1e-3 * rng.normal(size=(len(group), 2))
    keys = jax.random.split(jax.random.key(3), 20)
    given = jnp.asarray(matrix), jnp.asarray(right), jnp.asarray(members_of(group))
    found = resample_linear(*given, keys)
    length = np.linalg.norm(matrix.reshape(-1, 4), axis=0)
    for key, values in zip(keys, found, strict=True):
        drawn = np.asarray(jax.random.randint(key, (7,), 0, 7))
        samples = np.concatenate([np.flatnonzero(group == g) for g in drawn])
        rows, sides = (matrix[samples] / length).reshape(-1, 4), right[samples].ravel()
        expected = np.linalg.lstsq(rows, sides)[0] / length
        # The condition, 1e5, counts squared, but only times residuals of 1e-3; normal equations of columns
        # as they are leave 3e-5.
        np.testing.assert_allclose(values, expected, rtol=3e-8)


def test_one_axis_by_hand():
    """(50 + a) u' + d u = X, with (u', u, X) = (1, 0, 52.5), (0, 1, 3), (1, 1, 54.5) three times over.

    With y = X - 50 u': the normal equations (2 a + d, a + 2 d) = (7, 7.5) give a = 13/6, d = 8/3; the
    nine residuals are +-1/3, so s² = 1/7 and the variances are s² (2/3)/3 = 2/63.
    """
    bare = boat(("surge",))
    vehicle = eqx.tree_at(damping, bare, (0 * bare.damping.linear, 0 * bare.damping.quadratic))
    t = np.arange(9) * 0.1
    channels, wrench = np.full((9, 18), np.nan), np.zeros((9, 6))
    channels[:, CHANNELS.index("x")] = 0.0
    channels[:, CHANNELS.index("du")] = [1, 0, 1] * 3
    channels[:, CHANNELS.index("u")] = [0, 1, 1] * 3
    wrench[:, 0] = [52.5, 3.0, 54.5] * 3
    log = Log(t, channels, None, wrench, (), "hand.csv")
    found = least_squares(vehicle, log, lambda v: (v.added_mass, v.damping.linear), entries="diagonal")
    assert found.names == ("added_mass[surge]", "damping.linear[surge]")
    np.testing.assert_allclose(found.solution.values, [13 / 6, 8 / 3], rtol=1e-9)
    np.testing.assert_allclose(found.solution.std, np.sqrt(2 / 63), rtol=1e-9)
    np.testing.assert_allclose(found.vehicle.added_mass[0, 0], 13 / 6, rtol=1e-9)
    np.testing.assert_allclose(found.vehicle.damping.linear[0, 0], 8 / 3, rtol=1e-9)


def test_three_axes_agree_with_regressors_written_out_in_numpy():
    noise = dict.fromkeys(SENSORS, 0.02)
    vehicle = boat()
    log = record(vehicle, steps(), noise=noise)
    found = least_squares(vehicle, log, damping, entries="diagonal", bootstrap=200)
    u, v, r = log.channels[:, [6, 7, 11]].T
    du, dv, dr = log.channels[:, [12, 13, 17]].T
    port, starboard, bow = log.commands.T * np.array([[40.0], [40.0], [30.0]])
    # M = [[55, 0, 0], [0, 90, 2], [0, 2, 11]]; C nu after Fossen (2021).
    surge = port + starboard - (55 * du - (90 * v + 2 * r) * r)
    sway = bow - (90 * dv + 2 * dr + 55 * u * r)
    yaw = 0.3 * (port - starboard) + 0.5 * bow - (2 * dv + 11 * dr + (90 * v + 2 * r) * u - 55 * u * v)
    linear, quadratic = [], []
    for speed, push in ((u, surge), (v, sway), (r, yaw)):
        (d_l, d_q), *_ = np.linalg.lstsq(np.stack([speed, np.abs(speed) * speed], 1), push)
        linear.append(d_l)
        quadratic.append(d_q)
    np.testing.assert_allclose(found.solution.values, linear + quadratic, rtol=1e-8)
    # Resampled windows scatter about as much as white residuals would: they nearly are white.
    ratio = np.asarray(found.std_bootstrap / found.solution.std)
    assert found.bootstrap.shape == (200, 6)
    assert np.all((ratio > 0.4) & (ratio < 2.5))


def test_the_same_forces_as_commands_and_as_wrench_give_the_same():
    vehicle, quiet = boat(), dict.fromkeys(("position", "attitude", "velocity", "rate"), 1e-9)
    log = record(vehicle, steps(hold=3), noise=quiet)
    assert log.commands is not None
    lever = np.array([[1, 1, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, -0.3, 0.5]])
    wrench = (log.commands * np.array([40.0, 40.0, 30.0])) @ lever.T
    told = Log(log.t, log.channels, None, wrench, (), log.name)
    both = [least_squares(vehicle, one, damping, entries="diagonal").solution.values for one in (log, told)]
    np.testing.assert_allclose(*both, rtol=1e-9)


def test_accelerations_of_some_axes_do_not_spoil_the_others():
    vehicle = boat()
    full = record(vehicle, steps(hold=3), noise=dict.fromkeys(SENSORS, 1e-9))
    some, none = full.channels.copy(), full.channels.copy()
    some[:, CHANNELS.index("dr")] = np.nan
    none[:, 12:] = np.nan
    found = [
        least_squares(vehicle, dataclasses.replace(full, channels=channels), damping, entries="diagonal")
        for channels in (some, none)
    ]
    # What is not measured is differentiated, and then all axes alike.
    np.testing.assert_allclose(*[one.solution.values for one in found], rtol=1e-9)


def test_errors_match_the_reported_ones():
    vehicle, found = boat(), []
    # Noise in the accelerations alone: there least squares is unbiased.
    noise = dict.fromkeys(SENSORS, 1e-9) | {"acceleration": 0.05, "angular_acceleration": 0.05}
    for seed in range(20):
        log = record(vehicle, steps(), noise=noise, seed=seed)
        found.append(least_squares(vehicle, log, damping, entries="diagonal"))
    truth = np.concatenate([np.diag(np.asarray(m))[[0, 1, 5]] for m in damping(vehicle)])
    errors = np.array([f.solution.values for f in found]) - truth
    ratio = np.sqrt((errors**2).mean(0)) / np.mean([f.solution.std for f in found], axis=0)
    np.testing.assert_allclose(ratio, 1.0, atol=0.47)  # three standard errors of twenty seeds
    assert np.abs(errors.mean(0) / errors.std(0, ddof=1) * np.sqrt(20)).max() < 4.0


def test_what_is_not_linear_or_not_shown_is_refused():
    log = record(boat(), steps(), noise=dict.fromkeys(SENSORS, 0.02))
    with pytest.raises(ValueError, match="linearly"):
        least_squares(boat(), log, lambda v: v.thrusters.delay)
    with pytest.raises(ValueError, match=r"body\.mass"):
        least_squares(boat(), log, lambda v: v.body.mass)


def test_restarts_agree_with_scipy():
    rng = np.random.default_rng(2)
    x = np.linspace(0.0, 4.0, 40)
    y = 2.0 * np.exp(-1.3 * x) + 0.5 + 0.02 * rng.normal(size=40)

    def residuals(p, data):
        x, y = data
        return p["size"] * jnp.exp(-p["rate"] * x) + p["floor"] - y

    starts = {name: jnp.asarray(rng.uniform(0.2, 3.0, 6)) for name in ("floor", "rate", "size")}
    found = levenberg_marquardt(residuals, starts, (jnp.asarray(x), jnp.asarray(y)))
    assert bool(found.converged.all())
    for k in range(6):
        reference = scipy.optimize.least_squares(
            lambda p: p[2] * np.exp(-p[1] * x) + p[0] - y,
            [float(starts[name][k]) for name in ("floor", "rate", "size")],
            method="lm",
            xtol=1e-12,
            ftol=1e-12,
        )
        np.testing.assert_allclose(found.costs[k], reference.cost, rtol=1e-7)
        here = [float(found.values[name][k]) for name in ("floor", "rate", "size")]
        np.testing.assert_allclose(here, reference.x, rtol=1e-4)
    best = [float(found.best[name]) for name in ("floor", "rate", "size")]
    np.testing.assert_allclose(best, [0.5, 1.3, 2.0], atol=0.1)


def test_networks_in_a_batch_are_independent_and_the_best_is_found():
    """Each network of a batch ends where it would have ended alone; a diverging one harms no other."""
    x = jnp.linspace(-1.0, 1.0, 30)
    y = x**3

    def residuals(network, _):
        return jax.vmap(network)(x[:, None])[:, 0] - y

    def make(key):
        return eqx.nn.MLP(1, 1, 4, 1, activation=jnp.tanh, dtype=jnp.float64, key=key)

    batch = eqx.filter_vmap(make)(jax.random.split(jax.random.key(0), 4))
    arrays, frame = eqx.partition(batch, eqx.is_array)

    def flat(arrays, args):
        return residuals(eqx.combine(arrays, frame), args)

    spoilt = jax.tree.map(lambda a: a.at[2].set(jnp.nan), arrays)
    whole = levenberg_marquardt(flat, arrays, max_steps=60)
    harmed = levenberg_marquardt(flat, spoilt, max_steps=60)
    kept = np.array([0, 1, 3])
    np.testing.assert_allclose(harmed.costs[kept], whole.costs[kept], rtol=1e-9)
    assert np.isinf(harmed.costs[2]) and not harmed.converged[2]
    assert float(whole.costs.min()) < 1e-3
    error = flat(whole.best, None)
    np.testing.assert_allclose(0.5 * (error**2).sum(), whole.costs.min(), rtol=1e-9)
