"""A window along its path: what is measured of it, and the derivatives of that by all that may be asked for.

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

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import ALWAYS
from ..physics import KIND, Earlier, Thrust, apply, attitude_rate, rotation
from ..vehicle import Input, Plant, State
from ._affine import Affine, Columns
from ._rollout import (
    PlantOf,
    Problem,
    Track,
    fluid_memory,
    late_of,
    moves_of,
    of_segment,
    roll_out,
    start_of,
    thrust_of,
    tracks_of,
    wrapped,
)
from ._thrust_slopes import ThrustSlopes
from ._windows import PLANE, Before, Trail, Windows


class Rows(eqx.Module):
    """A window along its path: what the measured channels are off by, weighted, and what that comes from.

    - `jacobian`: derivatives of the residuals by the initial state, z, the free wrench, and the velocity of
      the water to the north and to the east, where windows say one.
    - `dt` of the holds; `a`, `b`: from a state and from all but the first of these over a hold to the next.
    - `h_x`, `h_z`: from these to what is measured. `by_push`: derivatives of the residuals by the free wrench
      and the water. All of them in time: how far a craft is off now stands for how far it was when a late
      sensor saw it.
    - `states`, `end`: at the samples, and after the last hold; `begin`: derivative of the first one by the
      twelve changes of the initial state; `end_by`: of the latter, as `jacobian`.
    """

    residual: Float[Array, "steps rows"]
    jacobian: Float[Array, "steps rows columns"]
    dt: Float[Array, " steps"]
    a: Float[Array, "steps 13 13"]
    b: Float[Array, "steps 13 z"]
    h_x: Float[Array, "steps rows 13"]
    h_z: Float[Array, "steps rows z"]
    by_push: Float[Array, "steps rows pushes"]
    begin: Float[Array, "13 12"]
    states: Float[Array, "steps 13"]
    end: Float[Array, "13"]
    end_by: Float[Array, "13 columns"]


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
    """The few plant constants that enter outside the balance, flat; `shown`: those of the readings."""

    shown: Array
    lag: Array
    delay: Array


def _seen_by(plant: Plant, width: int):
    """Constants on which readings of so many channels hang, beside state and acceleration."""
    more = (plant.current, plant.load.gravity) if width > ALWAYS else ()
    return plant.sensors, *more


def _seeing(plant: Plant, constants, width: int) -> Plant:
    """The plant with other constants of the readings."""
    sensors, *more = constants
    plant = dataclasses.replace(plant, sensors=sensors)
    if width == ALWAYS:
        return plant
    current, gravity = more
    return dataclasses.replace(plant, current=current, load=dataclasses.replace(plant.load, gravity=gravity))


def _chain(plant: Plant, width: int) -> _Chain:
    shown, _ = jax.flatten_util.ravel_pytree(_seen_by(plant, width))
    lag = plant.memory_lag() if plant.has_memory else jnp.zeros(0)
    return _Chain(shown, lag, jnp.zeros(0) if plant.delay is None else plant.delay)


@eqx.filter_jit
def _balances(plant_of: PlantOf, axes: tuple[int, ...], plants: Plant, theta, x, drive, lagged, segment):
    """At some points nu', the derivatives of the balance on some axes, the inverse mass' columns for these.

    Derivatives by the state, thrust, theta, fluid memory and, where it is given, the water's velocity.

    Compiled as part of the caller; by itself it is traced once for all programs that linearise.
    """
    free = np.array(axes)

    def balance(x, nu_dot, pushed, theta, lagged, water, segment, drive):
        drive = dataclasses.replace(drive, thrust=pushed, water=water)
        return plant_of(theta, segment).balance(_unflat(x, lagged), nu_dot, drive)[free]

    def one(x, drive, lagged, segment):
        plant = of_segment(plants, segment)
        nu_dot = plant.acceleration(_unflat(x, lagged), drive)
        first = 0 if theta.shape[0] == 1 else segment
        slopes = jax.jacrev(balance, argnums=(0, 2, 3, 4, 5))(
            x, nu_dot, drive.thrust, theta[first], lagged, drive.water, first, drive
        )
        return nu_dot, slopes, plant.mobility(drive)[:, free]

    return jax.vmap(one)(x, drive, lagged, segment)


@eqx.filter_jit
def _readings(plants: Plant, channels: tuple[int, ...], width: int, chain: _Chain, x, nu_dot, segment, water):
    """What the sensors show at some points, and the derivatives of some channels by x, nu', the constants of
    the readings and, where it is given, the water's velocity.

    - `width`: how many channels are shown.

    In reverse, since there are fewer channels than constants. Traced once, as `_balances` is.
    """
    rows = np.array(channels, int)

    def shown(x, nu_dot, constants, water, segment):
        plant = of_segment(plants, segment)
        _, unravel = jax.flatten_util.ravel_pytree(_seen_by(plant, width))
        plant = _seeing(plant, unravel(constants), width).amid(water)
        return plant.readings(_unflat(x, jnp.zeros(0)), nu_dot, width)

    def one(x, nu_dot, segment, water):
        at = x, nu_dot, of_segment(chain, segment).shown, water, segment
        slopes = jax.jacrev(lambda *at: shown(*at)[rows], argnums=(0, 1, 2, 3))(*at)
        return shown(*at), slopes

    return jax.vmap(one)(x, nu_dot, segment, water)


def _remembers(plants: Plant, slope: Callable[..., Array]) -> Bool[Array, ""] | bool:
    """Whether some fluid memory pushes, or some z would make it push. Mostly none does."""
    if not plants.has_memory:
        return False
    return (plants.memory_gain() != 0).any() | (slope(lambda plant: plant.memory_gain()) != 0).any()


class _Rolled(NamedTuple):
    """One window, or some, with its path.

    - `begun`: what the thrusters' lag is like where it begins, of `ThrustSlopes`; `states`: at its samples;
      `after`: at the ends of the holds; `d_slow`: slope of the fluid memory per lag.
    """

    windows: Windows
    delta: Array
    begun: Array
    track: Track
    states: State
    after: State
    d_slow: Array


class _Points(NamedTuple):
    """Points of a window's path: states, what drives them, fluid memory and its slope by z, segments."""

    x: Array
    drive: Input
    lagged: Array
    segment: Array
    d_lagged: Array


class _Slopes(NamedTuple):
    """nu' at some points, and its derivatives by the state and by z, the free wrench and the water."""

    nu_dot: Array
    by_x: Array
    by_z: Array


class Sweep(eqx.Module):
    """What all windows have in common where they are linearised at z = 0.

    - `knots`: of the free wrench (`screening`).
    - `plants`, `chain`: of each segment; `chain_slopes`: derivatives of the latter by z.
    - `push`, `moving`, `lagged`: thrust, masses inside and fluid memory along all logs; `driven`: derivatives
      of the thrust by z; `d_lagged`: slope of the memory per lag.
    """

    problem: Problem
    affine: Affine
    knots: int = eqx.field(static=True)
    plants: Plant
    chain: _Chain
    chain_slopes: _Chain
    columns: Columns
    push: Thrust
    moving: tuple[Any, ...] | None
    driven: ThrustSlopes
    lagged: Array
    d_lagged: Array

    @classmethod
    def of(cls, problem: Problem, affine: Affine, knots: int) -> "Sweep":
        theta, segments = affine.theta, jnp.arange(affine.theta.shape[0])
        plants = jax.vmap(problem.plant_of)(theta, segments)
        chain = jax.vmap(lambda plant: _chain(plant, problem.width))(plants)

        def slope(of):
            """Derivatives of a plant's constants with respect to z, stacked along segments."""
            by_theta = jax.vmap(jax.jacfwd(lambda p, s: of(problem.plant_of(p, s))))(theta, segments)
            return jax.tree.map(
                lambda a: jnp.einsum("s...p,pz,sz->s...z", a, affine.columns, affine.acts), by_theta
            )

        drive_slopes = slope(lambda plant: plant.drive)
        chain_slopes = slope(lambda plant: _chain(plant, problem.width))
        late, moving = late_of(problem, plants.drive), moves_of(problem, plants)
        push = thrust_of(problem, plants.drive, late)
        driven = ThrustSlopes.of(problem, plants.drive, drive_slopes, late, push.before)
        columns = Columns.of(affine.columns)
        lagged, d_lagged = fluid_memory(problem, plants, _remembers(plants, slope))
        return cls(
            problem=problem,
            affine=affine,
            knots=knots,
            plants=plants,
            chain=chain,
            chain_slopes=chain_slopes,
            columns=columns,
            push=push,
            moving=moving,
            driven=driven,
            lagged=lagged,
            d_lagged=d_lagged,
        )

    @property
    def steps(self) -> int:
        """Of a window."""
        return self.problem.windows.step.shape[1]

    @property
    def given(self) -> int:
        """How many z there are, without the free wrench and the water."""
        return self.affine.acts.shape[-1]

    @property
    def asked(self) -> int:
        """Of how many numbers derivatives are: z, the free wrench and the water."""
        return self.given + 6 * self.knots + (0 if self.problem.windows.water is None else PLANE)

    def rolled(self, windows: Windows, delta: Float[Array, "windows 12"], begun: Array) -> _Rolled:
        """Some windows all at once: of a stiff vehicle this is one short step after another, in which few
        windows take as long as many.

        - `begun`: theirs of `driven.begun`.
        """
        tracks = tracks_of(self.problem, windows, self.push, self.moving, self.lagged)

        def followed(windows, track, delta):
            first = start_of(windows, delta, track.lagged[0])
            return roll_out(self.problem, self.plants, track, first, follow=True)

        states, after = jax.vmap(followed)(windows, tracks, delta)
        d_slow = self.d_lagged[windows.log[:, None], windows.step]
        return _Rolled(windows, delta, begun, tracks, states, after, d_slow)

    def followed(self, rolled: _Rolled, trail: Trail) -> tuple[_Rolled, Trail]:
        """Windows that know what was before them, and the trail after them."""
        states = jax.vmap(jax.vmap(_flat))(rolled.states)
        before, trail = trail.then(self.problem.records, rolled.windows, states)
        return rolled._replace(windows=dataclasses.replace(rolled.windows, before=before)), trail

    def rows(self, now: _Rolled) -> Rows:
        """One window's rows, with derivatives by its initial state and all that is asked for."""
        track, windows, measured = now.track, now.windows, np.array(self.problem.channels, int)
        x, x_after = jax.vmap(_flat)(now.states), jax.vmap(_flat)(now.after)
        at_middle = self._middle(now, x, x_after)
        moved, seen = self._along(now, at_middle, x)
        a, b = self._propagators(at_middle.x, track.dt, moved)
        value, h_x, h_z = self._sensed(x, track, seen)

        def start(delta):
            return _flat(start_of(windows, delta, track.lagged[0]))

        def recur(s, now):
            a, b = now
            return (a @ s).at[:, 12:].add(b), s

        s_0 = jnp.concatenate([jax.jacfwd(start)(now.delta), jnp.zeros((13, self.asked))], axis=1)
        s_end, s = jax.lax.scan(recur, s_0, (a, b))
        weight = windows.weight[:, measured]
        jacobian = (h_x @ s).at[:, :, 12:].add(h_z)
        by_push = jacobian[..., 12 + self.given :]
        value, jacobian = self._earlier(windows, track, value, jacobian)
        return Rows(
            residual=wrapped(value - windows.measured)[:, measured] * weight,
            jacobian=jacobian * weight[..., None],
            dt=track.dt,
            a=a,
            b=b,
            h_x=h_x * weight[..., None],
            h_z=h_z * weight[..., None],
            by_push=by_push * weight[..., None],
            begin=s_0[:, :12],
            states=x,
            end=x_after[-1],
            end_by=s_end,
        )

    def _middle(self, now: _Rolled, x: Array, x_after: Array) -> _Points:
        """The points in the middle of a window's holds."""
        track = now.track
        # Middle of the step from its ends and its first slope (third order in dt); the slope of a stiff
        # vehicle says nothing of the middle.
        rate = jax.vmap(lambda s, d, i: _flat(of_segment(self.plants, i).rates(s, d)))(
            now.states, track.over, track.segment
        )
        bend = jnp.where(jnp.asarray(self.problem.split) == 1, 0.25, 0.0)
        middle = 0.5 * (x + x_after) + bend * (x - x_after + track.dt[:, None] * rate)
        d_slow = now.d_slow
        if d_slow.shape[-1]:
            d_lagged = d_slow[..., None] * of_segment(self.chain_slopes, track.segment[0]).lag[None]
        else:
            d_lagged = d_slow
        held = track.over
        assert held.middle is not None
        over = dataclasses.replace(held, t=held.middle, slope=None, middle=None)
        between = 0.5 * (track.lagged + jnp.concatenate([track.lagged[1:], track.lagged[-1:]]))
        return _Points(middle, over, between, track.segment, d_lagged)

    def _along(self, now: _Rolled, at_middle: _Points, x: Array) -> tuple[_Slopes, _Slopes]:
        """In the middle of the holds, and at the samples: zero where no acceleration is measured."""
        steps, z = self.steps, self.asked
        if not self.problem.accelerations:
            still = _Slopes(jnp.zeros((steps, 6)), jnp.zeros((steps, 6, 13)), jnp.zeros((steps, 6, z)))
            return self._tangents(now, at_middle), still
        track = now.track
        at_sample = _Points(x, track.instant, track.lagged, track.segment, at_middle.d_lagged)
        # Both sets of points in one call: the derivatives of the balance are compiled once.
        points = jax.tree.map(lambda *parts: jnp.concatenate(parts), at_middle, at_sample)
        both = self._tangents(now, points)
        return _Slopes(*(part[:steps] for part in both)), _Slopes(*(part[steps:] for part in both))

    def _tangents(self, now: _Rolled, points: _Points) -> _Slopes:
        """At points of a window: at every step, or twice at every step."""
        x, drive, lagged, segment, d_lagged = points
        nu_dot, slopes, inverse = _balances(
            self.problem.plant_of,
            self.problem.axes,
            self.plants,
            self.affine.theta,
            x,
            drive,
            lagged,
            segment,
        )
        by_x, by_thrust, by_theta, by_lagged, by_water = slopes
        acts = self.affine.acts[segment][:, None, :]
        by_z = self.columns(by_theta) * acts + self._by_thrusters(by_thrust, now)
        if lagged.shape[-1]:
            by_z = by_z + by_lagged @ d_lagged
        nu_z = -inverse @ by_z
        if self.knots:
            nu_z = jnp.concatenate([nu_z, self._by_wrench(inverse)], axis=-1)
        if by_water is not None:
            nu_z = jnp.concatenate([nu_z, -inverse @ by_water[..., :PLANE]], axis=-1)
        return _Slopes(nu_dot, -inverse @ by_x, nu_z)

    def _by_thrusters(self, by_thrust: Array, now: _Rolled) -> Array:
        """What the balance has of z by the thrusters, at every step of a window, or twice at every step."""
        # Most causes are none of a thruster; the predicate is the same for all windows of a batch.
        return jax.lax.cond(
            self.driven.touched,
            lambda: by_thrust @ self.driven.at(now.windows, now.begun, len(by_thrust) > self.steps),
            lambda: jnp.zeros((*by_thrust.shape[:2], self.given)),
        )

    def _by_wrench(self, inverse: Array) -> Array:
        """Derivatives of nu' by the free wrench's knots, from the inverse mass' columns of what moves."""
        steps, knots, points = self.steps, self.knots, len(inverse)
        # A wrench on an axis that cannot move moves nothing.
        every = jnp.zeros((points, 6, 6)).at[:, :, np.array(self.problem.axes)].set(inverse)
        part = jax.nn.one_hot(jnp.arange(steps) * knots // steps, knots)
        here = jnp.tile(part, (points // steps, 1))
        pushed = every[:, :, None, :] * here[:, None, :, None]
        return pushed.reshape(points, 6, 6 * knots)

    def _propagators(self, x: Array, dt: Array, moved: _Slopes) -> tuple[Array, Array]:
        """A and B of every step of a window, from the point in its middle."""
        dt = dt[:, None, None]
        f = jnp.concatenate([jax.vmap(jax.jacfwd(_kinematics))(x), moved.by_x], axis=1)
        exp, phi = _exponential(dt * f, self.problem.split)
        return exp, dt * (phi[:, :, 7:] @ moved.by_z)

    def _sensed(self, x: Array, track: Track, seen: _Slopes) -> tuple[Array, Array, Array]:
        """Readings at every sample of a window; the derivatives of the measured ones by x and z."""
        problem, segment = self.problem, track.segment
        value, slopes = _readings(
            self.plants,
            problem.channels,
            problem.width,
            self.chain,
            x,
            seen.nu_dot,
            segment,
            track.instant.water,
        )
        by_x, by_nu_dot, by_constants, by_water = slopes
        by_z = by_nu_dot @ seen.by_z
        by_z = by_z.at[:, :, : self.given].add(_contract(by_constants, self.chain_slopes.shown, segment))
        if by_water is not None:
            by_z = by_z.at[:, :, -PLANE:].add(by_water[..., :PLANE])
        return value, by_x + by_nu_dot @ seen.by_x, by_z

    def _earlier(self, windows: Windows, track: Track, value: Array, jacobian: Array) -> tuple[Array, Array]:
        """Readings of a window and the derivatives of the measured ones, of late sensors so long before."""
        delay, segment, rows = self.plants.delay, track.segment, np.array(self.problem.channels, int)
        if delay is None:
            return value, jacobian
        when = Earlier(track.instant.t, delay[segment], self.problem.width)

        def along(before: Before | None):
            """Between which samples late sensors read, and readings and derivatives from `before` on."""
            if before is None:
                return when, value, jacobian
            return self._since_before(before, windows, track, value, jacobian)

        own = slice(-self.steps, None)

        def in_time():
            # The slope of the past, which is that of the sample before.
            when, values, _ = along(None if windows.before is None else windows.before.last)
            shown, slopes = when.shown(values)
            return shown[own], slopes[own], jacobian

        def late():
            when, values, by = along(windows.before)
            shown, slopes = when.shown(values)
            return shown[own], slopes[own], when.rows(by, rows)[own]

        # Mostly none is late; the predicate is the same for all windows of a batch.
        shown, slopes, jacobian = jax.lax.cond(jnp.any(delay != 0.0), late, in_time)
        by_delay = -slopes[:, rows, None] * self.chain_slopes.delay[segment][:, KIND[rows]]
        return shown, jacobian.at[:, :, 12 : 12 + self.given].add(by_delay)

    def _since_before(
        self, before: Before, windows: Windows, track: Track, value: Array, jacobian: Array
    ) -> tuple[Earlier, Array, Array]:
        """Between which samples late sensors read; readings and derivatives of what was before, and now.

        What was before is as it was expected: no initial state of the window changes it.
        """
        assert self.plants.delay is not None
        x, count = before.states, len(before.states)

        def as_first(values):
            return jnp.broadcast_to(values[0], (count, *values.shape[1:]))

        segment, water = jax.tree.map(as_first, (track.segment, track.instant.water))
        still = jnp.zeros((count, 6))
        seen, (_, _, by_constants, _) = _readings(
            self.plants, self.problem.channels, self.problem.width, self.chain, x, still, segment, water
        )
        by_z = _contract(by_constants, self.chain_slopes.shown, segment)
        by = jnp.zeros((count, *jacobian.shape[1:])).at[:, :, 12 : 12 + self.given].set(by_z)
        ago = windows.step[0] - jnp.arange(count, 0, -1)
        # Before a log began nothing is known, but times go on.
        early = self.problem.records.t[windows.log, jnp.maximum(ago, 0)] + jnp.minimum(ago, 0) * track.dt[0]
        t = jnp.concatenate([early, track.instant.t])
        delay = self.plants.delay[jnp.concatenate([segment, track.segment])]
        when = Earlier(t, delay, self.problem.width, count - before.known)
        return when, jnp.concatenate([seen, value]), jnp.concatenate([by, jacobian])


def _kinematics(x: Float[Array, "13"]) -> Float[Array, "7"]:
    """The rates of position and attitude."""
    turn = rotation(x[3:7])
    return jnp.concatenate([apply(turn, x[7:10]), attitude_rate(x[3:7], x[10:13])])
