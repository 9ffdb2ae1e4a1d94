"""The windows' normal equations against forward-mode differentiation of their predictions."""

import dataclasses
import functools
import inspect

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import CHANNELS
from jaxmarine.effects import CATALOGUE, AbstractEffect, FluidMemory, LinearDamping, SensorEffect
from jaxmarine.fitting import (
    Affine,
    Cut,
    Problem,
    _linearise,
    _rollout,
    _rows,
    _thrust_slopes,
    cut,
    linearise,
    measured_channels,
    predict,
    screening,
    start_precision,
)
from jaxmarine.fitting._affine import FEW, Columns
from jaxmarine.fitting._rollout import fluid_memory
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Input, Placed, Plant, State, Vehicle
from tests.boats import boat, steps
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


def saturated_problem(vehicle: Vehicle, families: tuple, data: Cut) -> Problem:
    """Windows of logs that a vehicle with these effects beside its own is to predict."""
    return Problem(
        Saturated(vehicle, families),
        data.records,
        data.windows,
        jnp.asarray(start_precision(vehicle.free)),
        measured_channels(data.windows),
        axes=vehicle.axes,
    )


@dataclasses.dataclass(frozen=True)
class Case:
    problem: Problem
    affine: Affine
    names: tuple[str, ...]  # of the parameters


def parameter_names(families) -> tuple[str, ...]:
    return tuple(
        f"{family.name}.{field}[{i}]"
        for family in families
        for field, value in family.parameters().items()
        for i in range(np.size(value))
    )


@functools.cache
def case(name: str, segments: int, logs: int) -> Case:
    """Windows of simulated logs without noise, and parameters near the neutral ones.

    With one segment the logs are of these very parameters, and the sensors true, so that the fluid
    memory, which follows the logged velocity, is that of the prediction.
    """
    vehicle = packaged(name)
    families = tuple(cls.neutral(vehicle) for cls in CATALOGUE)
    neutral, unravel = jax.flatten_util.ravel_pytree(families)
    names = parameter_names(families)
    rng = np.random.default_rng(6)
    theta = np.asarray(neutral) + 0.02 * rng.normal(size=(segments, len(neutral)))
    # A width, a delay and a lag are positive: their derivative at zero is one-sided.
    one_sided = [i for i, n in enumerate(names) if n.split(".")[0] in ("deadband", "input_delay")]
    theta[:, one_sided] = np.abs(theta[:, one_sided]) + 0.01
    theta[:, names.index("thruster_lag.time_constant[0]")] = 0.1
    if segments == 1:
        sensing = {cls.name for cls in CATALOGUE if issubclass(cls, SensorEffect)}
        true = [i for i, n in enumerate(names) if n.split(".")[0] in sensing]
        theta[:, true] = np.asarray(neutral)[true]
    effects = unravel(jnp.asarray(theta[0])) if segments == 1 else families
    whole = vehicle.place(*(Placed(effect) for effect in effects))

    t = DT * np.arange(round(3 * LENGTH / DT))
    recordings = []
    for g in range(logs):
        commands = random_commands(vehicle, len(t), 10, seed=g)
        start, _ = random_start(vehicle, g, speed=0.2)
        start = dataclasses.replace(start, memory=start.velocity)
        shown = simulate(whole, log_of(vehicle, t, commands), start).channels
        recordings.append(log_of(vehicle, t, commands, channels=shown, name=f"{g}.csv"))
    acting = [np.minimum(np.arange(len(t)) // 45 + g, segments - 1) for g in range(logs)]
    data = cut(vehicle, recordings, independent(name).noise, LENGTH, segments=acting)
    problem = saturated_problem(vehicle, families, data)
    # Each parameter acts in some segments and not in others.
    acts = (rng.random((segments, len(neutral))) < 0.7) | (np.arange(segments)[:, None] == 0)
    affine = Affine(jnp.asarray(theta), jnp.eye(len(neutral)), jnp.asarray(acts, float))
    return Case(problem, affine, names)


@eqx.filter_jit
def by_recursion(problem, affine, delta):
    return linearise(problem, affine, delta)


@eqx.filter_jit
def by_forward_mode(problem, theta, acts, delta):
    """Residuals of the predictions [windows, rows] and their Jacobians by `z` and initial state.

    Each parameter is a z, moved by hand in the segments in which it acts.
    """

    def residuals(z, move):
        out = predict(problem, theta + jnp.where(acts > 0, z[None], 0.0), delta + move[None, :])[1]
        out = out.reshape(out.shape[0], -1)
        return out, out

    z, move = jnp.zeros(theta.shape[-1]), jnp.zeros(12)
    (by_z, by_move), residual = jax.jacfwd(residuals, argnums=(0, 1), has_aux=True)(z, move)
    return residual, by_move, by_z


# Six axes take a minute to compile, three have all that can go wrong but the coupling of six.
THRUSTERS = ("port", "starboard", "bow")
THREE_AXES = ("cybership2", 3, 2)
CASES = [pytest.param("tethra", 1, 1, marks=pytest.mark.slow), THREE_AXES]


@functools.cache
def both(name: str, segments: int, logs: int):
    """Statistics by the recursion, and residuals with Jacobians by forward mode."""
    this = case(name, segments, logs)
    delta = 1e-3 * np.random.default_rng(3).normal(size=(this.problem.windows.count, 12))
    stats = jax.tree.map(np.asarray, by_recursion(this.problem, this.affine, jnp.asarray(delta)))
    exact = by_forward_mode(this.problem, this.affine.theta, this.affine.acts, jnp.asarray(delta))
    exact = tuple(np.asarray(a) for a in exact)
    return this, delta, stats, exact


@pytest.mark.parametrize(("name", "segments", "logs"), CASES)
def test_statistics_are_those_of_forward_mode(name, segments, logs):
    this, delta, stats, (residual, by_move, by_z) = both(name, segments, logs)
    precision = np.asarray(this.problem.start_precision)
    lagging = np.array([n.startswith("fluid_memory") for n in this.names])
    chi2 = (residual**2).sum(1) + (precision * delta**2).sum(1)
    length = np.sqrt(chi2)
    assert np.abs(stats.chi2 - chi2).max() < 0.02 * chi2.max()

    size_x = np.sqrt(np.einsum("wrx,wrx->wx", by_move, by_move) + precision)
    size_z = np.sqrt(np.einsum("wrz,wrz->wz", by_z, by_z))
    # All that can be accused is felt; on locked axes the rest is not.
    accused = [s for cls in CATALOGUE for s in cls.suspects(packaged(name))]
    assert (size_z.max(0) > 0).sum() >= sum(len(s.slots) for s in accused) - len(accused)

    def off(got, exact, left, right):
        """Differences per z, as parts of the lengths of the Jacobian's columns."""
        bound = left[:, :, None] * right[:, None, :]
        return (np.abs(got - exact) / np.where(bound > 0, bound, np.inf)).max((0, 1))

    x_x = np.einsum("wrx,wry->wxy", by_move, by_move) + np.diag(precision)[None]
    x_z = np.einsum("wrx,wrz->wxz", by_move, by_z)
    z_z = np.einsum("wrz,wry->wzy", by_z, by_z)
    g_x = np.einsum("wrx,wr->wx", by_move, residual) + precision * delta
    g_z = np.einsum("wrz,wr->wz", by_z, residual)
    one = length[:, None]
    # An error of the order of dt^2 times the change of the dynamics within a step.
    assert off(stats.h_xx, x_x, size_x, size_x).max() < 0.01
    assert off(stats.g_x[:, None], g_x[:, None], one, size_x).max() < 0.01
    known = ~lagging
    for what, error in {
        "h_xz": off(stats.h_xz, x_z, size_x, size_z),
        "h_zz": off(stats.h_zz[:, known], z_z[:, known], size_z[:, known], size_z),
        "g_z": off(stats.g_z[:, None], g_z[:, None], one, size_z),
    }.items():
        worst = int(np.where(lagging, 0.0, error).argmax())
        assert error[worst] < 0.02, (what, this.names[worst])
        # Fluid memory follows the logged velocity in the one and the predicted one in the other,
        # which is the same only where the log is of these very parameters; the lag's own slope,
        # taken along the log, is rougher still.
        if segments == 1:
            gains = np.array([n.startswith("fluid_memory.gain") for n in this.names])
            assert error[gains].max() < 0.3 and error[lagging].max() < 0.5, what


@pytest.mark.slow
def test_long_logs_are_linearised_in_parts(monkeypatch):
    """Windows two by two, four at a time, thrust along sixteen samples at a time: the same statistics.

    And their sum is that of all windows.
    """
    this, delta, whole, (residual, _, _) = both(*THREE_AXES)
    for module, name, size in (
        (_linearise, "BATCH", 2),
        (_linearise, "CHUNK", 4),
        (_rollout, "CHUNK", 4),
        (_rollout, "BLOCK", 16),
        (_thrust_slopes, "BLOCK", 16),
    ):
        monkeypatch.setattr(module, name, size)
    problem = dataclasses.replace(this.problem, apart=False)
    assert problem.windows.count > 4 and problem.records.t.shape[1] > 32
    stats = eqx.filter_jit(lambda *args: linearise(*args))(problem, this.affine, jnp.asarray(delta))
    assert stats.h_zz.shape[0] == 1
    scale = np.sqrt(np.diag(whole.h_zz.sum(0)))
    for got, expected, size in (
        (stats.chi2, whole.chi2, whole.chi2.max()),
        (stats.g_x, whole.g_x, np.abs(whole.g_x).max()),
        (stats.g_z, whole.g_z, np.sqrt(whole.chi2.max()) * scale),
        (stats.h_xx, whole.h_xx, np.abs(whole.h_xx).max()),
        (stats.h_xz, whole.h_xz, np.sqrt(np.abs(whole.h_xx).max()) * scale),
        (stats.h_zz[0], whole.h_zz.sum(0), np.outer(scale, scale)),
    ):
        # Sums in another order.
        assert (np.abs(np.asarray(got) - expected) <= 1e-10 * size + 1e-300).all()

    predicted = eqx.filter_jit(inspect.unwrap(predict))(problem, this.affine.theta, jnp.asarray(delta))[1]
    assert np.allclose(
        predicted.reshape(residual.shape), residual, rtol=0, atol=1e-9 * np.abs(residual).max()
    )

    chi2, g, h = (np.asarray(a) for a in stats.reduced())
    by_window = [np.asarray(a) for a in jax.tree.map(jnp.asarray, whole).reduced()]
    assert np.allclose(chi2, by_window[0], rtol=1e-9)
    assert (np.abs(g - by_window[1]) <= 1e-8 * np.sqrt(whole.chi2.max()) * scale + 1e-300).all()
    assert (np.abs(h[0] - by_window[2].sum(0)) <= 1e-8 * np.outer(scale, scale) + 1e-300).all()


@pytest.mark.slow
def test_a_memory_that_pushes_nothing_and_is_not_asked_for_is_left_out(monkeypatch):
    """Beside other causes nothing is lost by it; a slope of it needs its motion."""
    this = case(*THREE_AXES)
    gains = np.array([i for i, name in enumerate(this.names) if name.startswith("fluid_memory.gain")])
    delta = jnp.zeros((this.problem.windows.count, 12))
    still = dataclasses.replace(this.affine, theta=this.affine.theta.at[:, gains].set(0.0))
    unasked = dataclasses.replace(still, columns=still.columns.at[gains].set(0.0))

    @eqx.filter_jit
    def plain(affine):
        return linearise(this.problem, affine, delta).h_zz

    @eqx.filter_jit
    def told(affine, remembers):
        with monkeypatch.context() as patch:
            patch.setattr(_rows, "_remembers", lambda *_: remembers)
            return linearise(this.problem, affine, delta).h_zz

    for affine, needed in ((still, True), (unasked, False)):
        found = [told(affine, jnp.array(answer)) for answer in (True, False)]
        # Rounding of sums that are as large as the largest entry.
        near = [np.allclose(one, plain(affine), rtol=0, atol=1e-9 * np.abs(one).max()) for one in found]
        assert near == [True, not needed]


def test_elimination_is_that_of_the_whole_problem():
    """Each window's initial state is eliminated exactly: a Schur complement."""
    _, _, stats, _ = both(*THREE_AXES)
    chi2, g, h = (np.asarray(a) for a in jax.tree.map(jnp.asarray, stats).reduced())
    for w in range(len(chi2)):
        solved = np.linalg.solve(stats.h_xx[w], np.column_stack([stats.g_x[w], stats.h_xz[w]]))
        assert chi2[w] == pytest.approx(stats.chi2[w] - stats.g_x[w] @ solved[:, 0], abs=1e-7 * stats.chi2[w])
        size = np.abs(stats.h_zz[w]).max()
        assert np.allclose(g[w], stats.g_z[w] - stats.h_xz[w].T @ solved[:, 0], atol=1e-6 * size)
        assert np.allclose(h[w], stats.h_zz[w] - stats.h_xz[w].T @ solved[:, 1:], atol=1e-6 * size)


@pytest.mark.slow
def test_a_screening_sums_groups_of_windows_and_has_a_free_wrench():
    """By the linearisation of each window, and by forward mode along wrenches that are in the log."""
    this, delta, stats, (_, by_move, by_z) = both(*THREE_AXES)
    windows, problem, knots = len(delta), this.problem, 2
    width = by_z.shape[2]
    group = np.minimum(np.arange(windows) // 2, 2)  # the last one is left out
    own = np.eye(width + 6 * knots)[:, width - 3 :]
    found = eqx.filter_jit(screening)(problem, this.affine, jnp.asarray(delta), knots, own, group, 2)

    row, column = np.tril_indices(own.shape[1])
    h_own = np.zeros((windows, *2 * own.shape[1:]))
    h_own[:, row, column] = h_own[:, column, row] = found.h_own
    chi2, g, h = (np.asarray(a) for a in jax.tree.map(jnp.asarray, stats).reduced())
    size = np.abs(h).max()
    assert np.allclose(found.chi2, chi2, rtol=1e-9)
    assert np.allclose(found.g[:, :width], g, atol=1e-9 * size)
    for k in range(2):
        assert np.allclose(found.h[k], h[group == k].sum(0), atol=1e-9 * size)
    assert np.allclose(h_own[:, :3, :3], h[:, -3:, -3:], atol=1e-9 * size)

    log, step = problem.windows.log[:, None], problem.windows.step
    part = np.arange(step.shape[1]) * knots // step.shape[1]

    @eqx.filter_jit
    def residuals(push):
        over = problem.records.wrench.at[log, step].add(push[part][None])
        records = dataclasses.replace(problem.records, wrench=over)
        return predict(dataclasses.replace(problem, records=records), this.affine.theta, delta)[1]

    by_wrench = np.asarray(jax.jacfwd(residuals)(jnp.zeros((knots, 6))))
    by_wrench = by_wrench.reshape(windows, -1, 6 * knots)
    precision = np.diag(np.asarray(problem.start_precision))
    for w in range(windows):
        start, pushed = by_move[w], by_wrench[w]
        known = np.linalg.solve(start.T @ start + precision, start.T @ pushed)
        exact = pushed.T @ pushed - (start.T @ pushed).T @ known
        bound = np.linalg.norm(pushed, axis=0)
        # As the derivatives by z above.
        assert (np.abs(h_own[w, 3:, 3:] - exact) <= 0.02 * np.outer(bound, bound) + 1e-12).all()
    assert np.linalg.norm(by_wrench, axis=(0, 1)).max() > 1.0


@pytest.mark.slow
def test_what_moving_water_does_is_that_of_forward_mode():
    """Each window in a current of its own, through a speed that is shown relative to the water as well."""
    vehicle, samples, water = boat(), 120, np.array([0.2, -0.1, 0.0])
    blank = Log(
        0.1 * np.arange(samples), np.full((samples, 18), np.nan), steps(samples), None, THRUSTERS, "a"
    )
    start, sensors = initial_state(vehicle, attitude=(0, 0, 0.7)), ("water_velocity",)
    flow = np.tile(water, (samples, 1))
    shown = np.asarray(simulate(vehicle, blank, start, water=flow, sensors=sensors).channels)
    data = cut(vehicle, [dataclasses.replace(blank, channels=shown)], np.full(shown.shape[1], 0.01), LENGTH)
    problem = saturated_problem(vehicle, (LinearDamping.neutral(vehicle),), data)
    apart = np.random.default_rng(2).normal(size=(data.windows.count, 2)) * 0.2
    affine = Affine(jnp.zeros((1, 6)), jnp.eye(6), jnp.ones((1, 6)))
    assert set(problem.channels) >= {18, 19}  # of the speed through the water, level

    def amid(level):
        return dataclasses.replace(problem, windows=dataclasses.replace(problem.windows, water=level))

    @eqx.filter_jit
    def along(level):
        sweep, windows = _rows.Sweep.of(amid(level), affine, 0), amid(level).windows
        push = sweep.driven.begun
        return jax.vmap(sweep.rows)(sweep.rolled(windows, jnp.zeros((windows.count, 12)), push))

    def residuals(level):
        return predict(amid(level), affine.theta, jnp.zeros((data.windows.count, 12)))[1]

    rows, given, seen = along(jnp.asarray(apart)), np.arange(len(apart)), np.array(problem.channels)
    residual = np.asarray(residuals(jnp.asarray(apart)))[..., seen]
    np.testing.assert_allclose(rows.residual, residual, atol=1e-9 * np.abs(residual).max())
    exact = np.asarray(jax.jacfwd(residuals)(jnp.asarray(apart)))[given, ..., given, :][:, :, seen]
    found, size = np.asarray(rows.jacobian)[..., -2:], np.abs(exact).max(axis=(0, 1, 3))
    assert (size > 0).all()
    # As the derivatives by z above.
    assert (np.abs(found - exact).max(axis=(0, 1, 3)) < 0.02 * size).all()


def test_each_fluid_memory_of_a_log_is_that_which_is_alone():
    """A vehicle that has one on every axis may get a second: their motions, slopes and forces stay apart."""
    this = case(*THREE_AXES)
    vehicle = packaged("cybership2")
    both = [
        Placed(FluidMemory(jnp.full(6, gain), jnp.full(6, lag))) for gain, lag in ((30.0, 0.5), (-8.0, 4.0))
    ]

    def plants_of(*placed):
        return jax.tree.map(lambda a: a[None], vehicle.place(*placed).plant())

    still = dataclasses.replace(
        this.problem,
        records=dataclasses.replace(this.problem.records, segment=0 * this.problem.records.segment),
    )
    apart = [fluid_memory(still, plants_of(one)) for one in both]
    together = fluid_memory(still, plants_of(*both))
    for got, first, second in zip(together, *apart, strict=True):
        np.testing.assert_allclose(got, np.concatenate([first, second], axis=-1), rtol=0, atol=1e-14)
        assert np.abs(first - second).max() > 0.1 * np.abs(first).max()
    moved, nothing = 13, jnp.zeros(len(vehicle.drive_names))
    drive = Input(nothing, nothing, jnp.zeros(6), jnp.zeros(()))
    nu = jnp.zeros(6)

    def missing(lagged, *placed):
        state = State(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), nu, lagged)
        return vehicle.place(*placed).plant().balance(state, nu, drive)

    first, second = (one[0][0, moved] for one in apart)
    expected = 30.0 * first - 8.0 * second
    found = missing(together[0][0, moved], *both)
    free = np.array(vehicle.axes)
    np.testing.assert_allclose(found[free], expected[free], rtol=0, atol=1e-12)


def test_fluid_memory_follows_the_true_velocity_and_not_the_shown_one(unchecked):
    """Else errors of the sensors would pass for forces: a misalignment times a memory is a cross damping."""
    this = case(*THREE_AXES)
    records, theta = this.problem.records, this.affine.theta
    plants = jax.vmap(this.problem.plant_of)(theta, jnp.arange(len(theta)))

    def shown(attitude, velocity, segment):
        plant = jax.tree.map(lambda a: a[segment], plants)
        state = State(jnp.zeros(3), attitude, velocity, jnp.zeros(0))
        return plant.readings(state, jnp.zeros(6))[6:12]

    logged = jax.vmap(jax.vmap(shown))(records.attitude, records.velocity, records.segment)
    assert np.abs(logged - records.velocity).max() > 0.01
    spoilt = dataclasses.replace(this.problem, records=dataclasses.replace(records, velocity=logged))
    true = dataclasses.replace(plants, sensors=())
    remembered, expected = fluid_memory(spoilt, plants)[0], fluid_memory(this.problem, true)[0]
    # What the sensors hide at their least is divided by itself and LEAST_SHOWN squared.
    assert np.abs(remembered - expected).max() < 1e-5 * np.abs(expected).max()


def test_predictions_are_those_of_a_simulation():
    """A window's prediction is the stretch of a simulation that begins in its state."""
    this = case("tethra", 1, 1)
    records, windows = this.problem.records, this.problem.windows
    vehicle, families = this.problem.plant_of.vehicle, this.problem.plant_of.families
    theta, _ = jax.flatten_util.ravel_pytree(families)
    channels, residual = eqx.filter_jit(predict)(this.problem, theta[None], jnp.zeros((windows.count, 12)))
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


@pytest.mark.parametrize("several", [0, 1, FEW, FEW + 2])
def test_columns_are_picked_as_a_product_would_have_them(several):
    rng = np.random.default_rng(several)
    whole = np.zeros((7, 12))
    whole[rng.integers(0, 7, 12), np.arange(12)] = rng.normal(size=12)
    whole[:, 3] = 0.0
    many = rng.permutation(12)[:several]
    whole[:, many] = rng.normal(size=(7, several))
    by = rng.normal(size=(5, 6, 7))
    product = jax.jit(lambda by, whole: Columns.of(whole)(by))(by, whole)
    np.testing.assert_allclose(product, by @ whole, atol=1e-14)
