"""One linearisation of the windows' residuals, from which every other question is linear algebra.

For parameters z (through an affine map into the parameters of each segment's plant) and the initial
state of each window, this gives the sums J'J and J'r of the residuals (prediction - log) / noise.

The sensitivities follow a recursion instead of running every tangent through the solver:

    S <- A S + B,    A = exp(dt F),    B = dt phi1(dt F) G

with F = d(rates)/d(state) and G = d(rates)/d(z), both at the middle of the step. All parameters of
the dynamics enter through the components of the inverse dynamics, so one reverse pass for each axis
that moves gives F and G for any number of parameters; the recursion itself is one product of small
matrices. The midpoint exponential is exact for a linear system and has an error of the order of dt² times the
change of F within a step (tested against forward-mode differentiation of the roll-out), far below
the curvature that Gauss-Newton leaves out. For 110 parameters it is many times faster than tangents
through the solver.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics import KIND, Earlier, apply, attitude_rate, rotation
from ..vehicle import Input, Plant, State
from ._parts import in_parts, joined, part_of
from ._rollout import (
    CHUNK,
    PlantOf,
    Problem,
    fluid_memory,
    late_of,
    of_segment,
    roll_out,
    slides_of,
    start_of,
    thrust_of,
    tracks_of,
    wrapped,
)
from ._thrust_slopes import ThrustSlopes

# Windows that are linearised together: the derivatives of some hundred steps stay in the processor's cache.
BATCH = 10
# Columns with several entries that are multiplied one by one; with more of them all are.
FEW = 4


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


class Columns(eqx.Module):
    """A matrix to multiply by, of which most columns have a single entry: to pick those is less work.

    - `first`, `entry`: of each column where its single entry is, and the entry; 0 where it has several.
    - `others`, `narrow`: which columns have several, and these; `many`: more than `FEW` have.
    """

    whole: Float[Array, "parameters z"]
    first: Int[Array, " z"]
    entry: Float[Array, " z"]
    others: Int[Array, " few"]
    narrow: Float[Array, "parameters few"]
    many: Bool[Array, ""]

    @classmethod
    def of(cls, whole: Float[Array, "parameters z"]) -> "Columns":
        several = (whole != 0).sum(0) > 1
        first = jnp.argmax(whole != 0, axis=0)
        entry = jnp.where(several, 0.0, whole[first, jnp.arange(whole.shape[1])])
        others = jnp.argsort(~several)[:FEW]
        narrow = jnp.where(several[others], whole[:, others], 0.0)
        return cls(whole, first, entry, others, narrow, several.sum() > FEW)

    def __call__(self, by: Float[Array, "points rows parameters"]) -> Float[Array, "points rows z"]:
        """`by @ whole`."""

        def picked():
            return (by[..., self.first] * self.entry[None, None]).at[..., self.others].add(by @ self.narrow)

        return jax.lax.cond(self.many, lambda: by @ self.whole, picked)


class Rows(eqx.Module):
    """A window along its path: what the measured channels are off by, weighted, and what that comes from.

    - `jacobian`: derivatives of the residuals by the initial state, z and the free wrench.
    - `dt` of the holds; `a`, `b`: from a state and from z and the wrench over a hold to the next state.
    - `h_x`, `h_z`: from these to what is measured.
    - `start`, `end`: the first state and the one after the last hold; `begin`: derivative of the former by
      the twelve changes of the initial state; `end_by`: of the latter, as `jacobian`.
    """

    residual: Float[Array, "steps rows"]
    jacobian: Float[Array, "steps rows columns"]
    dt: Float[Array, " steps"]
    a: Float[Array, "steps 13 13"]
    b: Float[Array, "steps 13 z"]
    h_x: Float[Array, "steps rows 13"]
    h_z: Float[Array, "steps rows z"]
    begin: Float[Array, "13 12"]
    start: Float[Array, "13"]
    end: Float[Array, "13"]
    end_by: Float[Array, "13 columns"]


class Statistics(eqx.Module):
    """Chi-square and normal equations of each window, `x` for its initial state, `z` for the parameters.

    - `h_zz`: of each window, or one, their sum (`Problem.apart`).
    """

    chi2: Float[Array, " windows"]
    g_x: Float[Array, "windows 12"]
    g_z: Float[Array, "windows z"]
    h_xx: Float[Array, "windows 12 12"]
    h_xz: Float[Array, "windows 12 z"]
    h_zz: Float[Array, "groups z z"]

    @eqx.filter_jit
    def reduced(self):
        """Chi-square, gradient and information of z with each window's initial state eliminated.

        The information is that of each window, or their sum, as `h_zz` is.
        """
        own, _ = grouped(len(self.chi2), len(self.h_zz) > 1)

        def one(h, now):
            window, group = now
            chi2, gradient, explained = _eliminated(*window)
            return added(h, -explained, group), (chi2, gradient)

        h, (chi2, gradient) = jax.lax.scan(one, self.h_zz, (self.of_windows, own))
        return chi2, gradient, h

    @property
    def of_windows(self):
        """All but the information of z."""
        return self.chi2, self.g_x, self.g_z, self.h_xx, self.h_xz


def _eliminated(chi2, g_x, g_z, h_xx, h_xz):
    """Chi-square and gradient of z of one window without its initial state, and the information that goes.

    Window by window, because jaxlib shares a batch of small factorisations out over its thread pool from
    inside that pool, and waits: two at a time hang a pool of two threads (jaxlib 0.10).
    """
    chol = jnp.linalg.cholesky(h_xx)
    right = jnp.concatenate([h_xz, g_x[:, None]], axis=1)
    solved = jax.scipy.linalg.solve_triangular(chol, right, lower=True)
    a, b = solved[:, :-1], solved[:, -1]
    return chi2 - b @ b, g_z - b @ a, a.T @ a


def _flat(state: State) -> Array:
    return jnp.concatenate([state.position, state.attitude, state.velocity])


def _unflat(x: Array, lagged: Array) -> State:
    return State(x[:3], x[3:7], x[7:13], lagged)


def _contract(by_constants, slopes, segment):
    """Derivatives with respect to z from those with respect to a segment's constants: [steps, rows, z]."""
    out = by_constants @ slopes[0]
    for s in range(1, slopes.shape[0]):
        out = jnp.where((segment == s)[:, None, None], by_constants @ slopes[s], out)
    return out


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
    delay: Array


def _chain(plant: Plant) -> _Chain:
    sensors, _ = jax.flatten_util.ravel_pytree(plant.sensors)
    lag = plant.memory_lag() if plant.has_memory else jnp.zeros(0)
    return _Chain(sensors, lag, jnp.zeros(0) if plant.delay is None else plant.delay)


def linearise(problem: Problem, affine: Affine, delta: Float[Array, "windows 12"]) -> Statistics:
    """Statistics of all windows at z = 0.

    - `delta`: changes of the windows' initial states (`State.moved`).

    Fluid memory is driven by the measured velocity here instead of the simulated one: it is a low-pass
    filter, so the measurement's noise hardly reaches it, and the state stays as small as it is without.
    """
    group, groups = grouped(len(delta), problem.apart)
    count = affine.acts.shape[-1]

    def each(total, now):
        stats, group = now
        return added(total, stats.h_zz, group), stats.of_windows

    def of_rows(rows, index):
        return _normal(problem, delta[index], rows), of_filled(group, groups, index)

    begin = jnp.zeros((groups + 1, count, count))
    h_zz, kept = swept(problem, affine, delta, 0, of_rows, each, begin)
    return Statistics(*kept, h_zz=h_zz[:-1])


def _normal(problem: Problem, delta: Float[Array, "12"], rows: "Rows") -> Statistics:
    """The statistics of one window."""
    residual, precision = rows.residual.ravel(), problem.start_precision
    jacobian = rows.jacobian.reshape(residual.size, -1)
    h = jacobian.T @ jacobian
    g = jacobian.T @ residual
    return Statistics(
        chi2=residual @ residual + precision @ delta**2,
        g_x=g[:12] + precision * delta,
        g_z=g[12:],
        h_xx=h[:12, :12] + jnp.diag(precision),
        h_xz=h[:12, 12:],
        h_zz=h[12:, 12:],
    )


class Screening(eqx.Module):
    """Reduced statistics of windows for many parameters z and, behind them, a free wrench.

    - `chi2`, `g`: of each window; `h`: information of z in each group of windows, as that of many parameters
      in every window of a long log is more than a memory holds.
    - `h_own`: of each window, for some combinations of z and the wrench: the lower triangle, row by row.
    """

    chi2: Float[Array, " windows"]
    g: Float[Array, "windows columns"]
    h: Float[Array, "groups z z"]
    h_own: Float[Array, "windows pairs"]


def screening(
    problem: Problem,
    affine: Affine,
    delta: Float[Array, "windows 12"],
    knots: int,
    own: Float[Array, "columns own"],
    group: Int[Array, " windows"],
    groups: int,
) -> Screening:
    """Reduced statistics of all windows at z = 0.

    - `knots`: of the free wrench on the hull, which is constant over each of so many equal parts of a window:
      columns knot by knot, six axes each. Whatever acts on the hull is a sum of these.
    - `own`: the combinations, of z and the wrench.
    - `group`: of each window; windows of the group with the number `groups` are left out.
    """
    given, lower = affine.acts.shape[-1], np.tril_indices(own.shape[1])

    def of_rows(rows, index):
        return _normal(problem, delta[index], rows), of_filled(group, groups, index)

    def each(total, now):
        stats, group = now
        chi2, gradient, explained = _eliminated(*stats.of_windows)
        information = stats.h_zz - explained
        kept = chi2, gradient, (own.T @ information @ own)[lower]
        return added(total, information[:given, :given], group), kept

    begin = jnp.zeros((groups + 1, given, given))
    h, (chi2, g, h_own) = swept(problem, affine, delta, knots, of_rows, each, begin)
    return Screening(chi2, g, h[:-1], h_own)


def grouped(count: int, apart: bool) -> tuple[Int[Array, " windows"], int]:
    """The group of each window, and how many there are: one each, or one for all."""
    return (jnp.arange(count), count) if apart else (jnp.zeros(count, int), 1)


def added(h: Float[Array, "groups z z"], more: Float[Array, "z z"], group) -> Float[Array, "groups z z"]:
    """One window to its group. Row by row: a scatter would copy."""
    before = jax.lax.dynamic_index_in_dim(h, group, keepdims=False)
    return jax.lax.dynamic_update_index_in_dim(h, before + more, group, 0)


def of_filled(group: Int[Array, " windows"], groups: int, index) -> Array:
    """The group of a window; those that only fill the last batch up are in one of their own."""
    return jnp.where(index < len(group), group[jnp.minimum(index, len(group) - 1)], groups)


def swept(
    problem: Problem,
    affine: Affine,
    delta: Float[Array, "windows 12"],
    knots: int,
    of_rows: Callable[["Rows", Array], Any],
    each: Callable[[Any, Any], tuple[Any, Any]],
    begin: Any,
) -> tuple[Any, Any]:
    """All windows one after another: what is carried through them, and what is kept of every one.

    - `of_rows`: from a window's rows and its index what is wanted of it, for some windows at once; those that
      only fill the last batch up have indices beyond the last one.
    - `each`: from what is carried, beginning with `begin`, and that: what is carried on, and what is kept.
    """
    roll, rows_of, begun = _each(problem, affine, knots)
    count = len(delta)
    batch = min(BATCH, count)
    chunk = part_of(count, CHUNK, batch)

    def of_batch(carry, now):
        windows, index = now
        wanted = jax.vmap(lambda window, index: of_rows(rows_of(window), index))(windows, index)
        return jax.lax.scan(each, carry, wanted)

    def of_chunk(carry, index):
        here = jnp.minimum(index, count - 1)
        rolled = roll(*jax.tree.map(lambda a: a[here], (problem.windows, delta, begun)))
        return jax.lax.scan(of_batch, carry, jax.tree.map(lambda a: in_parts(a, batch), (rolled, index)))

    chunks = jnp.arange(-(-count // chunk) * chunk).reshape(-1, chunk)
    carried, kept = jax.lax.scan(of_chunk, begin, chunks)
    return carried, jax.tree.map(lambda a: joined(jax.vmap(joined, (0, None))(a, chunk), count), kept)


@eqx.filter_jit
def _balances(plant_of: PlantOf, axes: tuple[int, ...], plants: Plant, theta, x, drive, lagged, segment):
    """At some points nu', the derivatives of the balance on some axes, the inverse mass' columns for these.

    Compiled as part of the caller; by itself it is traced once for all programs that linearise.
    """
    free = np.array(axes)

    def balance(x, nu_dot, pushed, theta, lagged, segment, drive):
        drive = eqx.tree_at(lambda d: d.thrust, drive, pushed)
        return plant_of(theta, segment).balance(_unflat(x, lagged), nu_dot, drive)[free]

    def one(x, drive, lagged, segment):
        plant = of_segment(plants, segment)
        nu_dot = plant.acceleration(_unflat(x, lagged), drive)
        first = 0 if theta.shape[0] == 1 else segment
        slopes = jax.jacrev(balance, argnums=(0, 2, 3, 4))(
            x, nu_dot, drive.thrust, theta[first], lagged, first, drive
        )
        return nu_dot, slopes, plant.mobility(drive)[:, free]

    return jax.vmap(one)(x, drive, lagged, segment)


@eqx.filter_jit
def _readings(plants: Plant, channels: tuple[int, ...], chain: _Chain, x, nu_dot, segment):
    """What the sensors show at some points, and the derivatives of some channels by x, nu' and the sensors'
    constants.

    In reverse, since there are fewer channels than constants. Traced once, as `_balances` is.
    """
    rows = np.array(channels, int)

    def shown(x, nu_dot, sensors, segment):
        plant = of_segment(plants, segment)
        _, unravel = jax.flatten_util.ravel_pytree(plant.sensors)
        plant = eqx.tree_at(lambda p: p.sensors, plant, unravel(sensors))
        return plant.readings(_unflat(x, jnp.zeros(0)), nu_dot)

    def one(x, nu_dot, segment):
        sensors = of_segment(chain, segment).sensors
        slopes = jax.jacrev(lambda *at: shown(*at)[rows], argnums=(0, 1, 2))(x, nu_dot, sensors, segment)
        return shown(x, nu_dot, sensors, segment), slopes

    return jax.vmap(one)(x, nu_dot, segment)


def _remembers(plants: Plant, slope: Callable[..., Array]) -> Bool[Array, ""] | bool:
    """Whether some fluid memory pushes, or some z would make it push. Mostly none does."""
    if not plants.has_memory:
        return False
    return (plants.memory_gain() != 0).any() | (slope(lambda plant: plant.memory_gain()) != 0).any()


def _each(problem: Problem, affine: Affine, knots: int):
    """What is asked of each window in turn.

    A function that rolls some windows out, which takes windows, `delta` and what the thrusters' lag is like
    where they begin; one that gives the rows of one window from that; and that for all windows.
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
    late, slides = late_of(problem, plants.drive), slides_of(problem, plants)
    push = thrust_of(problem, plants.drive, late)
    driven = ThrustSlopes.of(problem, plants.drive, drive_slopes, late, push.before)
    columns = Columns.of(affine.columns)
    lagged, d_lagged = fluid_memory(problem, plants, _remembers(plants, slope))
    rows = np.array(problem.channels, int)

    def by_thrusters(by_thrust, windows, begun):
        """What the balance has of z by the thrusters, at every step of a window, or twice at every step."""
        # Most causes are none of a thruster; the predicate is the same for all windows of a batch.
        return jax.lax.cond(
            driven.touched,
            lambda: by_thrust @ driven.at(windows, begun, len(by_thrust) > steps),
            lambda: jnp.zeros((*by_thrust.shape[:2], given)),
        )

    def tangents(windows, begun, x, drive, lagged, segment, d_lagged):
        """nu', d(nu')/dx and d(nu')/dz at points of a window: at every step, or twice at every step."""
        nu_dot, slopes, inverse = _balances(
            problem.plant_of, problem.axes, plants, theta, x, drive, lagged, segment
        )
        by_x, by_thrust, by_theta, by_lagged = slopes
        by_z = columns(by_theta) * acts[segment][:, None, :] + by_thrusters(by_thrust, windows, begun)
        if lagged.shape[-1]:
            by_z = by_z + by_lagged @ d_lagged
        nu_z = -inverse @ by_z
        if knots:
            # A wrench on an axis that cannot move moves nothing.
            every = jnp.zeros((len(x), 6, 6)).at[:, :, np.array(problem.axes)].set(inverse)
            here = jnp.tile(part, (len(x) // steps, 1))
            pushed = every[:, :, None, :] * here[:, None, :, None]
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

    def sensed(x, segment, nu_dot, nu_x, nu_z):
        """Readings at every sample of a window; the derivatives of the measured ones by x and z."""
        value, slopes = _readings(plants, problem.channels, chain, x, nu_dot, segment)
        by_x, by_nu_dot, by_sensors = slopes
        by_z = by_nu_dot @ nu_z
        by_z = by_z.at[:, :, :given].add(_contract(by_sensors, chain_slopes.sensors, segment))
        return value, by_x + by_nu_dot @ nu_x, by_z

    def earlier(t, segment, value, jacobian):
        """Readings and their derivatives of a window, of sensors that are late so long before."""
        if plants.delay is None:
            return value, jacobian
        when = Earlier(t, plants.delay[segment])
        shown, slopes = when.shown(value)
        # Mostly none is; the predicate is the same for all windows of a batch.
        jacobian = jax.lax.cond(
            jnp.any(plants.delay != 0.0), lambda: when.rows(jacobian, rows), lambda: jacobian
        )
        by_delay = -slopes[:, rows, None] * chain_slopes.delay[segment][:, KIND[rows]]
        return shown, jacobian.at[:, :, 12 : 12 + given].add(by_delay)

    def rows_of(now):
        """A window's rows, with derivatives by its initial state, z and the free wrench."""
        windows, delta, begun, track, states, after, d_slow = now

        def start(delta):
            return _flat(start_of(windows, delta, track.lagged[0]))

        x, x_after = jax.vmap(_flat)(states), jax.vmap(_flat)(after)
        # Middle of the step from its ends and its first slope (third order in dt); the slope of a stiff
        # vehicle says nothing of the middle.
        rate = jax.vmap(lambda s, d, i: _flat(of_segment(plants, i).rates(s, d)))(
            states, track.over, track.segment
        )
        bend = jnp.where(jnp.asarray(problem.split) == 1, 0.25, 0.0)
        middle = 0.5 * (x + x_after) + bend * (x - x_after + track.dt[:, None] * rate)
        d_lagged = (
            d_slow[..., None] * of_segment(chain_slopes, track.segment[0]).lag[None]
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
        at_middle = (middle, over, between, track.segment, d_lagged)
        if problem.accelerations:
            # Both sets of points in one call: the derivatives of the balance are compiled once.
            at_sample = (x, track.instant, track.lagged, track.segment, d_lagged)
            points = jax.tree.map(lambda *parts: jnp.concatenate(parts), at_middle, at_sample)
            both = tangents(windows, begun, *points)
            (_, nu_x, nu_z), seen = [part[:steps] for part in both], [part[steps:] for part in both]
        else:
            _, nu_x, nu_z = tangents(windows, begun, *at_middle)
            seen = jnp.zeros((steps, 6)), jnp.zeros((steps, 6, 13)), jnp.zeros((steps, 6, count))
        a, b = propagators(middle, track.dt, nu_x, nu_z)
        value, h_x, h_z = sensed(x, track.segment, *seen)

        def recur(s, now):
            a, b = now
            return (a @ s).at[:, 12:].add(b), s

        s_0 = jnp.concatenate([jax.jacfwd(start)(delta), jnp.zeros((13, count))], axis=1)
        s_end, s = jax.lax.scan(recur, s_0, (a, b))
        weight = windows.weight[:, rows]
        jacobian = (h_x @ s).at[:, :, 12:].add(h_z)
        value, jacobian = earlier(track.instant.t, track.segment, value, jacobian)
        return Rows(
            residual=wrapped(value - windows.measured)[:, rows] * weight,
            jacobian=jacobian * weight[..., None],
            dt=track.dt,
            a=a,
            b=b,
            h_x=h_x * weight[..., None],
            h_z=h_z * weight[..., None],
            begin=s_0[:, :12],
            start=x[0],
            end=x_after[-1],
            end_by=s_end,
        )

    def roll(windows, delta, begun):
        """All at once: of a stiff vehicle this is one short step after another, in which few windows take as
        long as many.
        """
        tracks = tracks_of(problem, windows, push, slides, lagged)

        def followed(windows, track, delta):
            first = start_of(windows, delta, track.lagged[0])
            return roll_out(problem, plants, track, first, follow=True)

        states, after = jax.vmap(followed)(windows, tracks, delta)
        d_slow = d_lagged[windows.log[:, None], windows.step]
        return windows, delta, begun, tracks, states, after, d_slow

    return roll, rows_of, driven.begun
