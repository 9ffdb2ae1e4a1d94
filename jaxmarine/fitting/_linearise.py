"""One linearisation of the windows' residuals, from which every other question is linear algebra.

For parameters z (through an affine map into the parameters of each segment's plant) and the initial
state of each window, this gives the sums J'J and J'r of the residuals (prediction - log) / noise.

The sensitivities follow a recursion instead of running every tangent through the solver:

    S <- A S + B,    A = exp(dt F),    B = dt phi1(dt F) G

with F = d(rates)/d(state) and G = d(rates)/d(z), both at the middle of the step. All parameters of
the dynamics enter through the six components of the inverse dynamics, so six reverse passes give F
and G for any number of parameters; the recursion itself is one product of small matrices. The
midpoint exponential is exact for a linear system and has an error of the order of dt² times the
change of F within a step (tested against forward-mode differentiation of the roll-out), far below
the curvature that Gauss-Newton leaves out. For 110 parameters it is many times faster than tangents
through the solver.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._compiled import compiled
from ..physics import Drive, Slide, Thrust, apply, attitude_rate, compose, rotation, small_turn, thrust
from ..simulation import hold
from ..vehicle import Input, Plant, State
from ._windows import ANGLES, Records, Windows

# Standard deviation of the prior on a window's initial state [m, rad, m/s, rad/s]. The loose one only
# keeps the elimination regular where a component was not measured; the tight one holds locked axes.
LOOSE, TIGHT = 1e3, 1e-6

# Sensors that show less of a velocity than this share of it do not tell what it was.
LEAST_SHOWN = 1e-3

# Windows that are linearised together.
BATCH = 10

PlantOf = Callable[[Float[Array, " parameters"], Array], Plant]


class Problem(eqx.Module):
    """Residuals of windows as a function of parameters.

    - `plant_of(theta, segment)`: the plant of a segment from its parameter vector.
    - `start_precision`: inverse variance of the prior on a window's initial state (`start_precision`).
    - `accelerations`: whether any are measured.
    - `split`: integration steps per sample, for a stiff vehicle (`simulation.substeps`).
    """

    plant_of: PlantOf
    records: Records
    windows: Windows
    start_precision: Float[Array, "12"]
    accelerations: bool = eqx.field(static=True)
    split: int | Int[Array, ""] = 1


class Affine(eqx.Module):
    """From z to the parameters of each segment's plant: theta + columns @ (acts * z).

    `acts` says which z act in a segment. One matrix for all segments costs one product per step of a log.
    """

    theta: Float[Array, "segments parameters"]
    columns: Float[Array, "parameters z"]
    acts: Float[Array, "segments z"]

    def __call__(self, z: Float[Array, " z"]) -> Float[Array, "segments parameters"]:
        return self.theta + (self.acts * z[None]) @ self.columns.T

    def at(self, z: Float[Array, " z"]) -> "Affine":
        """The same map seen from z."""
        return Affine(self(z), self.columns, self.acts)


def start_precision(free: Float[np.ndarray, "6"]) -> Float[np.ndarray, "12"]:
    """Inverse variance of the prior on the initial state, for free (1) and locked (0) axes."""
    surge, sway, heave, roll, pitch, yaw = free
    level = max(surge, sway)
    moves = [level, level, max(heave, level * max(roll, pitch)), roll, pitch, yaw, *free]
    return np.where(np.array(moves) > 0, LOOSE, TIGHT) ** -2.0


class Statistics(eqx.Module):
    """Per window: chi-square and the normal equations, `x` for the initial state, `z` for the parameters."""

    chi2: Float[Array, " windows"]
    g_x: Float[Array, "windows 12"]
    g_z: Float[Array, "windows z"]
    h_xx: Float[Array, "windows 12 12"]
    h_xz: Float[Array, "windows 12 z"]
    h_zz: Float[Array, "windows z z"]

    @eqx.filter_jit
    def reduced(self):
        """Chi-square, gradient and information of z with each window's initial state eliminated."""
        return jax.lax.map(_eliminated, self)


def _eliminated(window: Statistics):
    """`reduced` for one window.

    Window by window, because jaxlib shares a batch of small factorisations out over its thread pool from
    inside that pool, and waits: two at a time hang a pool of two threads (jaxlib 0.10).
    """
    chol = jnp.linalg.cholesky(window.h_xx)
    right = jnp.concatenate([window.h_xz, window.g_x[:, None]], axis=1)
    solved = jax.scipy.linalg.solve_triangular(chol, right, lower=True)
    a, b = solved[:, :-1], solved[:, -1]
    return window.chi2 - b @ b, window.g_z - b @ a, window.h_zz - a.T @ a


def _start(windows: Windows, delta, memory) -> State:
    """The window's first state, moved by `delta` (position NED, small turn in body axes, velocity)."""
    return State(
        position=windows.position + delta[:3],
        attitude=compose(windows.attitude, small_turn(delta[3:6])),
        velocity=windows.velocity + delta[6:],
        memory=memory,
    )


def _flat(state: State) -> Array:
    return jnp.concatenate([state.position, state.attitude, state.velocity])


def _unflat(x: Array, lagged: Array) -> State:
    return State(x[:3], x[3:7], x[7:13], lagged)


def wrapped(error: Float[Array | np.ndarray, "*steps 18"]) -> Array:
    """Differences of angles within (-pi, pi]."""
    return jnp.where(ANGLES, (error + jnp.pi) % (2 * jnp.pi) - jnp.pi, error)


def _pick(tree, index):
    """One segment's part of what is stacked along segments.

    With a single segment the index is not looked at: under `vmap` a gather would give every step a
    copy of its own, and products with shared matrices would become batched ones.
    """
    if jax.tree.leaves(tree)[0].shape[0] == 1:
        return jax.tree.map(lambda a: a[0], tree)
    return jax.tree.map(lambda a: a[index], tree)


def _contract(by_constants, slopes, segment):
    """Derivatives with respect to z from those with respect to a segment's constants: [steps, rows, z]."""
    out = by_constants @ slopes[0]
    for s in range(1, slopes.shape[0]):
        out = jnp.where((segment == s)[:, None, None], by_constants @ slopes[s], out)
    return out


def _drives(problem: Problem, drives: Drive) -> Thrust:
    """Thrust over each hold and at each sample of all logs, for the drive constants of each segment."""
    records = problem.records

    def one(t, commands, segment):
        here = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), _pick(drives, segment))
        return thrust(here, t, commands)

    thrusters = drives.max_thrust.shape[-1]
    return jax.vmap(one)(records.t, records.commands[..., :thrusters], records.segment)


def _slides(problem: Problem, plants: Plant) -> Slide | None:
    """The motion of the sliding mass over each hold of all logs; its servo is the same in all segments."""
    plant = jax.tree.map(lambda a: a[0], plants)
    if plant.slider is None:
        return None
    return jax.vmap(plant.slides)(problem.records.t, problem.records.commands)


def _drive_sensitivities(problem: Problem, drives: Drive, slopes: Drive):
    """Derivatives of mean and instant thrust with respect to z: [logs, steps, thrusters, z].

    A thruster's thrust depends on its own constants only, so one tangent per constant and segment
    serves all thrusters; `slopes` are the constants' derivatives [segments, thrusters, z].
    """
    leaves, structure = jax.tree.flatten(drives)
    unit = np.eye(len(leaves))

    def along(tangent):
        return jax.jvp(lambda d: _drives(problem, d), (drives,), (tangent,))[1]

    def one(s, out):
        """With what the constants of one segment add."""
        here = (jnp.arange(leaves[0].shape[0]) == s).astype(leaves[0].dtype)
        shape = (len(unit), *leaves[0].shape)
        basis = [jnp.broadcast_to(jnp.outer(row, here)[..., None], shape) for row in unit]
        values = jax.vmap(along)(jax.tree.unflatten(structure, basis))
        slope = jnp.stack([leaf[s] for leaf in jax.tree.leaves(slopes)])
        return tuple(
            old + jnp.einsum("kgst,ktz->gstz", new, slope)
            for old, new in zip(out, (values.mean, values.instant), strict=True)
        )

    shape = (*problem.records.t.shape, *jax.tree.leaves(slopes)[0].shape[1:])
    nothing = jnp.zeros(shape)
    return jax.lax.fori_loop(0, problem.records.segment.max() + 1, one, (nothing, nothing))


def _inverse(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """By cofactors, which unlike a factorisation is done for all samples at once; finite for any matrix."""
    cofactors = jnp.cross(jnp.roll(a, -1, 1), jnp.roll(a, -2, 1), axis=0)
    determinant = (a[:, 0] * cofactors[:, 0]).sum()
    return cofactors.T * determinant / (determinant**2 + LEAST_SHOWN**6)


def _true_velocity(plant: Plant, attitude: Float[Array, "4"], logged: Float[Array, "6"]) -> Float[Array, "6"]:
    """The velocity that the sensors show as the logged one: they are affine, and rates show no speeds."""

    def shown(nu):
        state = State(jnp.zeros(3), attitude, nu, jnp.zeros(0))
        return plant.readings(state, jnp.zeros(6))[6:12]

    slope = jax.jacfwd(shown)(jnp.zeros(6))
    rest = logged - shown(jnp.zeros(6))
    rates = _inverse(slope[3:, 3:]) @ rest[3:]
    return jnp.concatenate([_inverse(slope[:3, :3]) @ (rest[:3] - slope[:3, 3:] @ rates), rates])


def _memory(problem: Problem, plants: Plant):
    """Fluid memory at every step of the logs, from the smoothed logged motion, and its slope per lag."""
    records = problem.records
    if not plants.has_memory:
        nothing = jnp.zeros((*records.t.shape, 0))
        return nothing, nothing
    lags = jax.vmap(lambda plant: plant.memory_lag())(plants)

    def through_water(attitude, logged, segment):
        plant = _pick(plants, segment)
        return plant.relative(attitude, _true_velocity(plant, attitude, logged))

    # Taken as measured: what a change of the current does to the past of a window is left out.
    relative = jax.lax.stop_gradient(
        jax.vmap(jax.vmap(through_water))(records.attitude, records.velocity, records.segment)
    )

    def filtered(lags):
        def one(dt, velocity, segment):
            decay = jnp.exp(-dt[:, None] / lags[segment])
            between = 0.5 * (velocity + jnp.concatenate([velocity[1:], velocity[-1:]]))

            def step(z, now):
                decay, velocity = now
                return velocity + (z - velocity) * decay, z

            return jax.lax.scan(step, velocity[0], (decay, between))[1]

        return jax.vmap(one)(records.dt, relative, records.segment)

    return jax.jvp(filtered, (lags,), (jnp.ones_like(lags),))


class _Track(eqx.Module):
    """What drives one window, step by step: inputs, fluid memory, segment and length of the hold."""

    over: Input  # over the hold
    instant: Input  # at the sample
    lagged: Array
    segment: Array
    dt: Array


def _tracks(problem: Problem, plants: Plant, push: Thrust, lagged) -> _Track:
    """The tracks of all windows, stacked."""
    records, log, step = problem.records, problem.windows.log[:, None], problem.windows.step
    t, dt = records.t[log, step], records.dt[log, step]
    commands = records.commands[log, step, : push.mean.shape[-1]]
    common = (commands, records.wrench[log, step], t)
    slide = jax.tree.map(lambda a: a[log, step], _slides(problem, plants))
    return _Track(
        over=Input(push.mean[log, step], *common, push.slope[log, step], t + 0.5 * dt, slide),
        instant=Input(push.instant[log, step], *common, slide=slide),
        lagged=lagged[log, step],
        segment=records.segment[log, step],
        dt=dt,
    )


def _roll(problem: Problem, plants: Plant, track: _Track, start: State, follow: bool):
    """States at all steps of one window, the first included, and at the ends of all holds.

    `follow`: the fluid memory at the start of each hold is that of the track (filtered from measured
    velocity) instead of the simulated one.
    """

    def step(state, now):
        if follow:
            state = eqx.tree_at(lambda s: s.memory, state, now.lagged)
        after = hold(_pick(plants, now.segment), state, now.over, now.dt, problem.split)
        return after, (state, after)

    return jax.lax.scan(step, start, track)[1]


@compiled
def predict(problem: Problem, theta, delta):
    """Predicted channels of every window [windows, steps, 18] and the residuals, weighted."""
    plants = jax.vmap(problem.plant_of)(theta, jnp.arange(theta.shape[0]))
    lagged = _memory(problem, plants)[0]
    tracks = _tracks(problem, plants, _drives(problem, plants.drive), lagged)

    def one(windows, track, delta):
        states, _ = _roll(problem, plants, track, _start(windows, delta, track.lagged[0]), follow=False)

        def show(state, drive, segment):
            plant = _pick(plants, segment)
            return plant.readings(state, plant.acceleration(state, drive))

        return jax.vmap(show)(states, track.instant, track.segment)

    channels = jax.vmap(one)(problem.windows, tracks, delta)
    return channels, wrapped(channels - problem.windows.measured) * problem.windows.weight


def _exponential(f: Array, split) -> tuple[Array, Array]:
    """exp(f) and phi1(f) = (exp(f) - 1) / f by their Taylor series to the sixth order, and doubling.

    The integration step keeps |f / split| below 0.8 (`simulation.substeps`), where the remainder is below
    1e-4; from there it is doubled until the whole of f is reached.
    """
    eye = jnp.broadcast_to(jnp.eye(f.shape[-1]), f.shape)
    doublings = jnp.ceil(jnp.log2(split)).astype(int)
    f = f / 2.0**doublings
    phi = eye
    for order in range(6, 1, -1):
        phi = eye + f @ phi / order
    exp = eye + f @ phi
    return jax.lax.fori_loop(0, doublings, lambda _, e: (e[0] @ e[0], 0.5 * (e[0] @ e[1] + e[1])), (exp, phi))


class _Chain(eqx.Module):
    """The few plant constants that enter outside the balance, flat."""

    sensors: Array
    lag: Array


def _chain(plant: Plant) -> _Chain:
    sensors, _ = jax.flatten_util.ravel_pytree(plant.sensors)
    return _Chain(sensors, plant.memory_lag() if plant.has_memory else jnp.zeros(0))


def linearise(problem: Problem, affine: Affine, delta, knots: int = 0) -> Statistics:
    """Statistics of all windows at z = 0.

    - `delta` [windows, 12]: changes of the windows' initial states.
    - `knots`: adds, behind z, a free wrench on the hull that is constant over each of so many equal parts
      of a window: columns knot by knot, six axes each. Whatever acts on the hull is a sum of these.

    Fluid memory is driven by the measured velocity here instead of the simulated one: it is a low-pass
    filter, so the measurement's noise hardly reaches it, and the state stays as small as it is without.
    """
    theta, acts = affine.theta, affine.acts
    given = acts.shape[-1]
    count = given + 6 * knots
    steps = problem.windows.step.shape[1]
    part = jax.nn.one_hot(jnp.arange(steps) * knots // steps, knots)
    segments = jnp.arange(theta.shape[0])
    plants = jax.vmap(problem.plant_of)(theta, segments)
    chain = jax.vmap(_chain)(plants)

    def slope(of):
        """Derivatives of a plant's constants with respect to z, stacked along segments."""
        by_theta = jax.vmap(jax.jacfwd(lambda p, s: of(problem.plant_of(p, s))))(theta, segments)
        return jax.tree.map(lambda a: jnp.einsum("s...p,pz,sz->s...z", a, affine.columns, acts), by_theta)

    drive_slopes = slope(lambda plant: plant.drive)
    chain_slopes = slope(_chain)
    d_mean, d_at = _drive_sensitivities(problem, plants.drive, drive_slopes)
    lagged, d_lagged = _memory(problem, plants)
    tracks = _tracks(problem, plants, _drives(problem, plants.drive), lagged)
    log, step = problem.windows.log[:, None], problem.windows.step

    def balance(x, nu_dot, pushed, theta, lagged, segment, drive):
        drive = eqx.tree_at(lambda d: d.thrust, drive, pushed)
        return problem.plant_of(theta, segment).balance(_unflat(x, lagged), nu_dot, drive)

    def tangent(x, drive, lagged, segment):
        """nu', the derivatives of the balance, and the inverse mass at one point."""
        plant = _pick(plants, segment)
        nu_dot = plant.acceleration(_unflat(x, lagged), drive)
        first = 0 if theta.shape[0] == 1 else segment
        slopes = jax.jacrev(balance, argnums=(0, 2, 3, 4))(
            x, nu_dot, drive.thrust, theta[first], lagged, first, drive
        )
        return nu_dot, slopes, plant.mobility(drive)

    def tangents(x, drive, lagged, segment, d_thrust, d_lagged):
        """nu', d(nu')/dx and d(nu')/dz at points of a window: at every step, or twice at every step."""
        nu_dot, (by_x, by_thrust, by_theta, by_lagged), inverse = jax.vmap(tangent)(x, drive, lagged, segment)
        by_z = by_theta @ affine.columns * acts[segment][:, None, :] + by_thrust @ d_thrust
        if lagged.shape[-1]:
            by_z = by_z + by_lagged @ d_lagged
        nu_z = -inverse @ by_z
        if knots:
            inverse = jnp.broadcast_to(inverse, (len(x), 6, 6))
            here = jnp.tile(part, (len(x) // steps, 1))
            pushed = inverse[:, :, None, :] * here[:, None, :, None]
            nu_z = jnp.concatenate([nu_z, pushed.reshape(len(x), 6, 6 * knots)], axis=-1)
        return nu_dot, -inverse @ by_x, nu_z

    def kinematics(x):
        """The rates of position and attitude."""
        turn = rotation(x[3:7])
        return jnp.concatenate([apply(turn, x[7:10]), attitude_rate(x[3:7], x[10:13])])

    def propagators(x, dt, nu_x, nu_z):
        """A and B of every step of a window, from the point in its middle."""
        dt = dt[:, None, None]
        f = jnp.concatenate([jax.vmap(jax.jacfwd(kinematics))(x), nu_x], axis=1)
        exp, phi = _exponential(dt * f, problem.split)
        return exp, dt * (phi[:, :, 7:] @ nu_z)

    def shown(x, nu_dot, sensors, segment):
        plant = _pick(plants, segment)
        _, unravel = jax.flatten_util.ravel_pytree(plant.sensors)
        plant = eqx.tree_at(lambda p: p.sensors, plant, unravel(sensors))
        return plant.readings(_unflat(x, jnp.zeros(0)), nu_dot)

    def sensed(x, segment, nu_dot, nu_x, nu_z):
        """Readings at every sample of a window and their derivatives with respect to x and z."""

        def one(x, nu_dot, segment):
            sensors = _pick(chain, segment).sensors
            slopes = jax.jacfwd(shown, argnums=(0, 1, 2))(x, nu_dot, sensors, segment)
            return shown(x, nu_dot, sensors, segment), slopes

        value, (by_x, by_nu_dot, by_sensors) = jax.vmap(one)(x, nu_dot, segment)
        by_z = by_nu_dot @ nu_z
        by_z = by_z.at[:, :, :given].add(_contract(by_sensors, chain_slopes.sensors, segment))
        return value, by_x + by_nu_dot @ nu_x, by_z

    def one(now):
        windows, track, delta, d_mean, d_at, d_slow = now

        def start(delta):
            return _flat(_start(windows, delta, track.lagged[0]))

        states, after = _roll(problem, plants, track, _start(windows, delta, track.lagged[0]), follow=True)
        x, x_after = jax.vmap(_flat)(states), jax.vmap(_flat)(after)
        # Middle of the step from its ends and its first slope (third order in dt); the slope of a stiff
        # vehicle says nothing of the middle.
        rate = jax.vmap(lambda s, d, i: _flat(_pick(plants, i).rates(s, d)))(
            states, track.over, track.segment
        )
        bend = jnp.where(jnp.asarray(problem.split) == 1, 0.25, 0.0)
        middle = 0.5 * (x + x_after) + bend * (x - x_after + track.dt[:, None] * rate)
        d_lagged = (
            d_slow[..., None] * _pick(chain_slopes, track.segment[0]).lag[None]
            if d_slow.shape[-1]
            else d_slow
        )
        over = Input(
            track.over.thrust,
            track.over.command,
            track.over.wrench,
            track.over.middle,
            slide=track.over.slide,
        )
        between = 0.5 * (track.lagged + jnp.concatenate([track.lagged[1:], track.lagged[-1:]]))
        at_middle = (middle, over, between, track.segment, d_mean, d_lagged)
        if problem.accelerations:
            # Both sets of points in one call: the derivatives of the balance are compiled once.
            at_sample = (x, track.instant, track.lagged, track.segment, d_at, d_lagged)
            both = tangents(*jax.tree.map(lambda *parts: jnp.concatenate(parts), at_middle, at_sample))
            (_, nu_x, nu_z), seen = [part[:steps] for part in both], [part[steps:] for part in both]
        else:
            _, nu_x, nu_z = tangents(*at_middle)
            seen = jnp.zeros((steps, 6)), jnp.zeros((steps, 6, 13)), jnp.zeros((steps, 6, count))
        a, b = propagators(middle, track.dt, nu_x, nu_z)
        value, h_x, h_z = sensed(x, track.segment, *seen)

        def recur(s, now):
            a, b = now
            return (a @ s).at[:, 12:].add(b), s

        s_0 = jnp.concatenate([jax.jacfwd(start)(delta), jnp.zeros((13, count))], axis=1)
        _, s = jax.lax.scan(recur, s_0, (a, b))
        weight = windows.weight
        jacobian = (h_x * weight[..., None]) @ s
        jacobian = jacobian.at[:, :, 12:].add(h_z * weight[..., None]).reshape(-1, 12 + count)
        residual = (wrapped(value - windows.measured) * weight).reshape(-1)
        h = jacobian.T @ jacobian
        g = jacobian.T @ residual
        return Statistics(
            chi2=residual @ residual + problem.start_precision @ delta**2,
            g_x=g[:12] + problem.start_precision * delta,
            g_z=g[12:],
            h_xx=h[:12, :12] + jnp.diag(problem.start_precision),
            h_xz=h[:12, 12:],
            h_zz=h[12:, 12:],
        )

    # In batches: the derivatives of some hundred steps stay in the processor's cache, and the memory
    # does not grow with the length of the logs. Filled up, so that no shorter batch is compiled as well.
    everything = (problem.windows, tracks, delta, d_mean[log, step], d_at[log, step], d_lagged[log, step])
    windows = len(delta)
    fill = -windows % BATCH
    filled = jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], fill, axis=0)]), everything)
    out = jax.lax.map(one, filled, batch_size=BATCH)
    return jax.tree.map(lambda a: a[:windows], out)
