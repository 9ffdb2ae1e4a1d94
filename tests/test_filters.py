"""Kalman filters that isolate faults: against dense Gaussians, and on toys whose answer is known."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy import stats

from experiments import filters
from jaxmarine import Log
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.effects import CATALOGUE
from jaxmarine.physics import delayed
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Vehicle
from jaxmarine.vehicle_io import cause_named

from .crafts import packaged


class Linear(filters.System[Array]):
    """x' = F x, shown H x: whatever is measured of it is one Gaussian."""

    f: Float[Array, "n n"]
    h: Float[Array, "rows n"]

    def moved(self, x: Array, by: Array) -> Array:
        return x + by

    def shown(self, x: Array, now: Any) -> tuple[Array, Array]:
        return self.h @ x, self.h

    def after(self, x: Array, now: Any) -> tuple[Array, Array]:
        return self.f @ x, self.f

    def missed(self, y: Array, shown: Array) -> Array:
        return y - shown


TIMES, ROWS, STATES = 6, 2, 3


@pytest.fixture(scope="module")
def linear() -> dict[str, Any]:
    """A filtered log of a linear system, one number of it missing, and the Gaussian of all its numbers."""
    rng = np.random.default_rng(0)
    f, h = rng.normal(size=(STATES, STATES)) / 2, rng.normal(size=(ROWS, STATES))
    mean, root = rng.normal(size=STATES), rng.normal(size=(STATES, STATES))
    p, walk, noise = root @ root.T, np.array([0.2, 0.0, 0.5]), np.array([0.3, 0.7])
    # Everything is linear in the first state and all steps' noises: x_k = maps_k @ (x_0, w_0, w_1, ...).
    sources = STATES * (TIMES + 1)
    at = np.eye(STATES, sources)
    maps = []
    for k in range(TIMES):
        maps.append(at)
        at = f @ at + np.eye(STATES, sources, STATES * (k + 1))
    spread = np.zeros((sources, sources))
    spread[:STATES, :STATES] = p
    spread[STATES:, STATES:] = np.diag(np.tile(walk, TIMES))
    shown = np.concatenate([h @ one for one in maps])
    begun = np.concatenate([mean, np.zeros(sources - STATES)])
    dense = shown @ spread @ shown.T + np.diag(np.tile(noise**2, TIMES))
    y = rng.multivariate_normal(shown @ begun, dense)
    seen = np.arange(TIMES * ROWS) != 5
    found = filters.run_filter(
        Linear(jnp.asarray(f), jnp.asarray(h)),
        *map(jnp.asarray, (mean, p, walk, noise, np.where(seen, y, np.nan).reshape(TIMES, ROWS))),
        jnp.zeros(TIMES),
    )
    last, off = maps[-1], (y - shown @ begun)[seen]
    gain = last @ spread @ shown[seen].T @ np.linalg.inv(dense[np.ix_(seen, seen)])
    return {
        "found": found,
        "density": stats.multivariate_normal.logpdf(off, cov=dense[np.ix_(seen, seen)]),
        "mean": last @ begun + gain @ off,
        "covariance": last @ spread @ last.T - gain @ shown[seen] @ spread @ last.T,
    }


def test_innovations_of_a_linear_system_have_the_likelihood_of_one_dense_gaussian(linear):
    assert float(linear["found"].log_likelihood) == pytest.approx(linear["density"], rel=1e-10)


def test_the_last_state_is_the_conditional_mean_of_that_gaussian(linear):
    assert np.allclose(linear["found"].state, linear["mean"], rtol=1e-9)
    assert np.allclose(linear["found"].covariance, linear["covariance"], atol=1e-10)


class Turning(Linear):
    """The same for an angle that turns: what is measured comes round."""

    def missed(self, y: Array, shown: Array) -> Array:
        return filters.wrap_to_pi(y - shown)


def test_a_heading_that_comes_round_is_no_surprise():
    t = np.arange(40) * 0.1
    f, h = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[1.0, 0.0]])
    y = jnp.asarray((3.0 + 0.5 * t + np.pi) % (2 * np.pi) - np.pi)[:, None]
    given = jnp.array([3.0, 0.5]), jnp.eye(2), jnp.zeros(2), jnp.array([0.01]), y, jnp.zeros(40)
    right, wrong = (filters.run_filter(kind(f, h), *given).log_likelihood for kind in (Turning, Linear))
    assert float(right) > float(wrong) + 1e3


class Braked(filters.System[Array]):
    """A body of speed v, pushed by u: v' = v + dt (u - d v - q v |v|), whose causes are its d or its q."""

    which: Float[Array, "2"]

    def moved(self, x: Array, by: Array) -> Array:
        return x + by

    def shown(self, x: Array, now: Array) -> tuple[Array, Array]:
        return x[:1], jnp.eye(2)[:1]

    def after(self, x: Array, now: Array) -> tuple[Array, Array]:
        def then(x):
            d, q = jnp.array([0.2, 0.1]) + self.which * x[1]
            return x.at[0].add(0.1 * (now - d * x[0] - q * x[0] * jnp.abs(x[0])))

        return then(x), jax.jacfwd(then)(x)

    def missed(self, y: Array, shown: Array) -> Array:
        return y - shown


@pytest.mark.parametrize("true", [0, 1])
def test_a_bank_of_two_names_the_drag_that_a_body_has_more_of(true):
    rng = np.random.default_rng(true)
    u = np.repeat(rng.uniform(-1.0, 1.0, 30), 20)
    drag, v = np.array([0.2, 0.1]), [0.0]
    drag[true] += 0.15
    for now in u[:-1]:
        v.append(v[-1] + 0.1 * (now - drag[0] * v[-1] - drag[1] * v[-1] * abs(v[-1])))
    y = jnp.asarray(np.array(v) + 0.02 * rng.standard_normal(len(v)))[:, None]
    given = jnp.zeros(2), jnp.eye(2), jnp.array([1e-8, 0.0]), jnp.array([0.02]), y, jnp.asarray(u)
    found = [filters.run_filter(Braked(which), *given) for which in jnp.eye(2)]
    nats = [float(one.log_likelihood) for one in found]
    assert nats[true] > nats[1 - true] + 5.0
    value, error = float(found[true].state[1]), float(found[true].covariance[1, 1]) ** 0.5
    assert abs(value - 0.15) < 3.0 * error < 0.05


@pytest.mark.parametrize("spread", [0.5, 50.0])
def test_evidence_is_that_of_schwarz_however_wide_a_prior_was(spread):
    """Two numbers of a line: the likelihood where they end, less log(n) / 2 each, by dense Gaussians."""
    rng = np.random.default_rng(3)
    h, sigma, start = rng.normal(size=(40, 2)), 0.3, np.array([0.4, -0.2])
    y = h @ [1.5, -0.7] + sigma * rng.standard_normal(40)
    covariance = np.linalg.inv(h.T @ h / sigma**2 + np.eye(2) / spread**2)
    z = covariance @ (h.T @ y / sigma**2 + start / spread**2)
    dense = sigma**2 * np.eye(40) + spread**2 * h @ h.T
    found = filters.Answer(
        np.array([stats.multivariate_normal.logpdf(y, h @ start, dense)]), z[None], covariance[None], None
    )
    hypothesis = filters.Hypothesis((0,), np.eye(2), start, np.full(2, spread))
    watched: Any = SimpleNamespace(run=lambda lanes: found, y=y)
    evidence, ended = filters._schwarz(watched, [(hypothesis, 0.0)])
    expected = stats.norm.logpdf(y, h @ z, sigma).sum() - np.log(40)
    assert evidence[0] == pytest.approx(expected, rel=1e-9)
    assert np.array_equal(ended[0], z)


@pytest.mark.parametrize("delay", [0.0, 0.07, 0.1, 0.34])
def test_late_commands_are_those_of_the_simulation(delay):
    rng = np.random.default_rng(0)
    t, held = 5.0 + 0.1 * np.arange(30), rng.uniform(-1.0, 1.0, (30, 2))
    delays = np.array([delay, 0.0])
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(held[:-1] * 0.1, axis=0)])
    commands = filters.Commands(*map(jnp.asarray, (t[0], 0.1, held, sums)))
    mine = jax.vmap(lambda now: commands.late(now, jnp.asarray(delays)))(jnp.asarray(t))
    theirs = delayed(jnp.asarray(t), jnp.asarray(held), jnp.broadcast_to(jnp.asarray(delays), held.shape))
    assert np.allclose(mine.mean[:, 0], theirs.mean, atol=1e-9)
    assert np.allclose(mine.now[:, 0], theirs.now)
    slope = jax.jacfwd(lambda d: commands.late(jnp.asarray(t[7]), d).mean[0])(jnp.asarray(delays))
    # Later by a little, a hold has a little more of the command before it.
    k = 7 - int(delay / 0.1 + 1e-9)
    assert float(slope[0, 0]) == pytest.approx((held[k - 1, 0] - held[k, 0]) / 0.1, rel=1e-6)


def plain_log(craft: Vehicle) -> Log:
    """Commands that change every two seconds, and nothing measured."""
    t = 0.1 * np.arange(400)
    levels = np.random.default_rng(1).uniform(-0.6, 0.6, (20, len(craft.command_names)))
    commands = np.repeat(levels, 20, axis=0)
    return Log(t, np.zeros((len(t), 18)), commands, None, craft.command_names, "plain")


@pytest.mark.slow
def test_a_filter_that_knows_the_truth_goes_where_the_simulation_goes():
    craft = packaged("cybership2")
    causes = ("thruster_lag time_constant=0.4", "input_delay delay=0.25", "linear_damping:yaw value=0.5")
    placed = [cause_named(craft, words) for words in causes]
    log = plain_log(craft)
    truth = simulate(craft.place(*placed), log, initial_state(craft))
    shown = np.where(np.isfinite(craft.stated_noise), np.asarray(truth.channels), np.nan)
    bench = workbench(craft, (dataclasses.replace(log, channels=shown),), CATALOGUE, None)
    watched = filters.Watched(bench)
    layout = bench.layout
    members = [layout.place_of(cause) for cause in placed]
    values = [
        layout.suspects[i].values(cause.effect) - layout.neutral_of(i)
        for i, cause in zip(members, placed, strict=True)
    ]
    columns = np.concatenate([layout.columns[i] for i in members], axis=1)
    pad = (0, filters.WIDTH - columns.shape[1])
    true = filters.Hypothesis(
        tuple(members),
        np.pad(columns, [(0, 0), pad]),
        np.pad(np.concatenate(values), pad),
        np.zeros(filters.WIDTH),
    )
    nothing = dataclasses.replace(true, columns=np.zeros_like(true.columns))
    right, wrong = watched.run([(true, 1e-3), (nothing, 1e-3)]).log_likelihood
    # Without noise innovations are next to nothing: what is left is the density at the mean.
    rows = np.isfinite(watched.y).sum()
    own = bench.own_noise[list(watched.craft.rows)]
    at_most = -(np.isfinite(watched.y) * np.log(own * np.sqrt(2 * np.pi))).sum()
    assert at_most - 0.05 * rows < right <= at_most
    assert right > wrong + 100.0
