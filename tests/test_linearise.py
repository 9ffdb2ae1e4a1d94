"""The windows' normal equations against forward-mode differentiation of their predictions."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.effects import CATALOGUE, AbstractEffect
from jaxmarine.fitting import Problem, cut, linearise, predict, start_precision
from jaxmarine.simulation import simulate
from jaxmarine.vehicle import Placed, Plant, Vehicle
from tests.crafts import independent, log_of, packaged, random_commands, random_start

DT, LENGTH = 0.05, 2.0


class Saturated(eqx.Module):
    """A vehicle with the whole catalogue in it, from one flat vector of parameters."""

    vehicle: Vehicle
    families: tuple[AbstractEffect, ...]

    def __call__(self, theta, segment) -> Plant:
        del segment
        _, unravel = jax.flatten_util.ravel_pytree(self.families)
        return self.vehicle.plant(extra=unravel(theta))


@dataclasses.dataclass(frozen=True)
class Case:
    problem: Problem
    theta: np.ndarray
    spread: np.ndarray
    names: tuple[str, ...]  # of the parameters
    label: str


def parameter_names(families) -> tuple[str, ...]:
    return tuple(
        f"{family.name}.{field}[{i}]"
        for family in families
        for field, value in family.parameters().items()
        for i in range(np.size(value))
    )


@functools.cache
def case(name: str, segments: int, logs: int, noise_of_log: float) -> Case:
    """Windows of simulated logs, and parameters near the neutral ones."""
    vehicle = packaged(name)
    families = tuple(cls.neutral(vehicle) for cls in CATALOGUE)
    neutral, _ = jax.flatten_util.ravel_pytree(families)
    names = parameter_names(families)
    rng = np.random.default_rng(1)
    theta = np.asarray(neutral) + 0.02 * rng.normal(size=(segments, len(neutral)))
    # A width, a delay and a lag are positive: their derivative at zero is one-sided.
    one_sided = [i for i, n in enumerate(names) if n.split(".")[0] in ("deadband", "input_delay")]
    theta[:, one_sided] = np.abs(theta[:, one_sided]) + 0.01
    theta[:, names.index("thruster_lag.time_constant[0]")] = 0.1
    recordings = []
    noise = independent(name).noise
    t = DT * np.arange(round(3 * LENGTH / DT))
    for g in range(logs):
        commands = random_commands(vehicle, len(t), 10, seed=g)
        start, _ = random_start(vehicle, g, speed=0.2)
        whole = vehicle.place(*(Placed(cls.neutral(vehicle)) for cls in CATALOGUE))
        start = dataclasses.replace(start, memory=start.velocity)
        shown = np.array(simulate(whole, log_of(vehicle, t, commands), start).channels)
        shown += noise_of_log * noise * rng.normal(size=shown.shape)
        recordings.append(log_of(vehicle, t, commands, channels=shown, name=f"{g}.csv"))
    acting = [np.minimum(np.arange(len(t)) // 45 + g, segments - 1) for g in range(logs)]
    data = cut(vehicle, recordings, noise, LENGTH, segments=acting)
    problem = Problem(
        Saturated(vehicle, families),
        data.records,
        data.windows,
        jnp.asarray(start_precision(vehicle.free)),
        True,
    )
    # Each parameter acts in some segments and not in others.
    acts = rng.random((segments, len(neutral))) < 0.7
    acts[-1] = True
    spread = np.eye(len(neutral))[None] * (acts if segments > 1 else np.ones(acts.shape))[:, None, :]
    return Case(problem, theta, spread, names, f"{name}-{segments}-{logs}")


@eqx.filter_jit
def by_recursion(problem, theta, spread, delta):
    return linearise(problem, theta, spread, delta)


@eqx.filter_jit
def by_forward_mode(problem, theta, spread, delta):
    """Residuals of the predictions [windows, rows] and their Jacobians by `z` and initial state."""

    def residuals(z, move):
        out = predict(problem, theta + spread @ z, delta + move[None, :])[1]
        return out.reshape(out.shape[0], -1)

    z, move = jnp.zeros(spread.shape[-1]), jnp.zeros(12)
    by_z, by_move = jax.jacfwd(residuals, argnums=(0, 1))(z, move)
    return residuals(z, move), by_move, by_z


CASES = [("tethra", 1, 1), ("cybership2", 1, 2), ("tethra", 3, 2)]


@functools.cache
def both(name: str, segments: int, logs: int, noise: float = 0.0):
    """Statistics by the recursion, and residuals with Jacobians by forward mode."""
    this = case(name, segments, logs, noise)
    delta = 0.01 * np.random.default_rng(3).normal(size=(this.problem.windows.count, 12))
    arguments = [jnp.asarray(a) for a in (this.theta, this.spread, delta)]
    stats = jax.tree.map(np.asarray, by_recursion(this.problem, *arguments))
    exact = tuple(np.asarray(a) for a in by_forward_mode(this.problem, *arguments))
    return this, delta, stats, exact


@pytest.mark.parametrize(("name", "segments", "logs"), CASES)
def test_statistics_are_those_of_forward_mode(name, segments, logs):
    this, delta, stats, (residual, by_move, by_z) = both(name, segments, logs)
    precision = np.asarray(this.problem.start_precision)
    tuned = np.array(["fluid_memory.time_constant" in n for n in this.names])
    lagging = np.array([n.startswith("fluid_memory") for n in this.names])
    chi2 = (residual**2).sum(1) + (precision * delta**2).sum(1)
    length = np.sqrt(chi2)
    # Fluid memory follows the measured velocity in the one and the simulated one in the other.
    assert np.abs(stats.chi2 - chi2).max() < 0.02 * chi2.max()

    size_x = np.sqrt(np.einsum("wrx,wrx->wx", by_move, by_move) + precision)
    size_z = np.sqrt(np.einsum("wrz,wrz->wz", by_z, by_z))
    scale = size_z.max(0)
    assert (scale[~lagging] > 0).sum() > 0.5 * len(scale)

    def off(got, exact, left, right):
        """Differences as parts of the Jacobian columns' lengths; 0 where there is no column."""
        bound = left[:, :, None] * right[:, None, :]
        return np.abs(got - exact) / np.where(bound > 0, bound, np.inf)

    x_x = np.einsum("wrx,wry->wxy", by_move, by_move) + np.diag(precision)[None]
    x_z = np.einsum("wrx,wrz->wxz", by_move, by_z)
    z_z = np.einsum("wrz,wry->wzy", by_z, by_z)
    g_x = np.einsum("wrx,wr->wx", by_move, residual) + precision * delta
    g_z = np.einsum("wrz,wr->wz", by_z, residual)
    one = length[:, None]
    rest = ~tuned
    report = {
        "x_x": off(stats.h_xx, x_x, size_x, size_x).max((0, 1)),
        "x_z": off(stats.h_xz, x_z, size_x, size_z).max((0, 1)),
        "z_z": off(stats.h_zz, z_z, size_z, size_z)[:, rest].max((0, 1)),
        "g_x": off(stats.g_x[..., None], g_x[..., None], size_x, one).max((0, 2)),
        "g_z": off(stats.g_z[..., None], g_z[..., None], size_z, one).max((0, 2)),
    }
    for what, error in report.items():
        worst = error
        if what in ("x_z", "z_z", "g_z"):
            # The lag's own derivative leaves out how its velocity depends on it.
            assert error[tuned].max() < 0.2, what
            worst = np.where(tuned, 0.0, error)
        place = int(worst.argmax())
        label = this.names[place] if len(worst) == len(this.names) else place
        # An error of the order of dt^2 times the change of the dynamics within a step.
        assert worst[place] < 0.01, (what, label)


def test_elimination_is_that_of_the_whole_problem():
    """Each window's initial state is eliminated exactly: a Schur complement."""
    _, _, stats, _ = both("cybership2", 1, 2)
    chi2, g, h = (np.asarray(a) for a in jax.tree.map(jnp.asarray, stats).reduced())
    for w in range(len(chi2)):
        solved = np.linalg.solve(stats.h_xx[w], np.column_stack([stats.g_x[w], stats.h_xz[w]]))
        assert chi2[w] == pytest.approx(stats.chi2[w] - stats.g_x[w] @ solved[:, 0], rel=1e-6)
        size = np.abs(stats.h_zz[w]).max()
        assert np.allclose(g[w], stats.g_z[w] - stats.h_xz[w].T @ solved[:, 0], atol=1e-6 * size)
        assert np.allclose(h[w], stats.h_zz[w] - stats.h_xz[w].T @ solved[:, 1:], atol=1e-6 * size)


def test_predictions_are_those_of_a_simulation():
    """A window's prediction is the stretch of a simulation that begins in its state."""
    this = case("tethra", 1, 1, 0.0)
    records, windows = this.problem.records, this.problem.windows
    vehicle, families = this.problem.plant_of.vehicle, this.problem.plant_of.families
    theta, _ = jax.flatten_util.ravel_pytree(families)
    channels, residual = eqx.filter_jit(predict)(
        this.problem, theta[None], jnp.zeros((windows.count, 12))
    )
    whole = vehicle.place(*(Placed(family) for family in families))
    start = dataclasses.replace(
        random_start(vehicle, 0)[0],
        position=windows.position[0],
        attitude=windows.attitude[0],
        velocity=windows.velocity[0],
        memory=records.velocity[0, 0],
    )
    log = log_of(vehicle, np.asarray(records.t[0]), np.asarray(records.commands[0]))
    track = simulate(whole, log, start)
    steps = windows.step.shape[1]
    assert np.allclose(channels[0], track.channels[:steps], rtol=1e-12, atol=1e-12)
    # Weighted, and without full turns.
    plain = (channels - windows.measured) * windows.weight
    angles = np.isin(CHANNELS, ("phi", "theta", "psi"))
    assert np.allclose(residual[..., ~angles], plain[..., ~angles], rtol=1e-12, atol=1e-12)
    assert np.abs(residual[..., angles] / windows.weight[..., angles]).max() <= np.pi
