"""The likelihood of windows beside a disturbance that is part of the model: a Kalman filter along their path.

Wind, waves and water push a craft, and what pushes it now still pushes it a second later: a disturbance with
a memory (`_disturbance.py`) acts on it.

A filter goes along the path about which the residuals are linearised, sample by sample, with the craft's
state and this disturbance as its own. What it does to the residuals it does to their derivatives too, so that
their sums are those of white noise: minus twice the logarithm of the likelihood is the chi-square of the
innovations and the logarithm of their determinants. Each window begins with any state, or where the one
before lets one expect, but always with the wrench that this has left.

The path is a causal prediction: each window begins as the one before lets one expect. A path that follows the
samples themselves goes with their noise and with the disturbance, and biases what is fitted along it.

Source: after Ljung, System Identification, on prediction errors, and Anderson and Moore, Optimal Filtering.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import optimize

from .._compiled import compiled
from ._affine import Affine
from ._damped import ATOL, DampedGaussNewton, minimise_outside
from ._disturbance import Disturbance, by_plane
from ._linearise import BATCH, added, of_filled, swept
from ._logarithms import improbable, logarithms_of, new_of, with_logarithms
from ._parts import part_of
from ._rollout import LOOSE, TIGHT, Problem
from ._rows import Rows
from ._windows import PLANE, Trail

# Standard deviation of a window's first state [m, rad, m/s, rad/s] about its guess: far more than a guess is
# off, and so little that rounding leaves the filter what the sensors tell.
ANY = 10.0
# Steps of the search for sizes and memories at most, and the decrease of minus twice the logarithm of the
# likelihood that is not worth one.
STEPS, ENOUGH = 40, 0.1
# Looks with which sizes come near at most, by how much of itself a size is near, and the least that a step
# leaves of its square.
COMING, NEAR, SHRINKING = 6, 0.1, 0.01
# Minus twice the logarithm of a sample's likelihood beyond which a cause is missing, whatever the weather:
# innovations of exp(8) = 3000 standard deviations of the sensors' noise. And the share of what is beyond it
# that is worth a step, as the cause that has yet to be found will explain it.
GROSS, BEYOND = 16.0, 0.01
# Stands for the improbability of samples along a path that has run away.
RUN_AWAY = 1e300
# Variance along a direction, in units of what was expected, that is taken for rounding.
CURVED = 1e-10
# Windows that are held as linear systems at once at most: one with 150 columns takes 110 kB.
HELD = 640


class Path(eqx.Module):
    """About what the windows are linearised, or one window.

    - `delta`: changes of their initial states (`State.moved`); `push`: the wrench on the disturbance's axes
      and the velocity of the water that are expected in their middle.
    """

    delta: Float[Array, "*windows 12"]
    push: Float[Array, "*windows pushes"]

    @classmethod
    def measured(cls, count: int, axes: tuple[int, ...]) -> "Path":
        """So many windows as measured, where nothing disturbs."""
        return cls(jnp.zeros((count, 12)), jnp.zeros((count, len(axes) + PLANE)))


class Line(eqx.Module):
    """A window as a linear system: states from sample to sample, and what is measured, by state and pushes.

    - `driven`: the 13 numbers of a state, and behind them what pushes.
    - `residual`: of what is measured, and its derivatives by what else is asked for, last that itself.
    - `by_plane`: what a force to the north and one to the east are on the axes that are pushed, where a hold
      begins: by how far the craft turns within one, and off its path, is left out.
    - `begin`: derivative of the first state by the twelve changes of the initial state.
    """

    f: Float[Array, "steps 13 driven"]
    h: Float[Array, "steps rows driven"]
    residual: Float[Array, "steps rows columns"]
    dt: Float[Array, " steps"]
    by_plane: Float[Array, "steps axes plane"]
    begin: Float[Array, "13 12"]

    @property
    def back(self) -> Float[Array, "12 13"]:
        """From a first state to its changes: the pseudo-inverse of `begin`, which has full rank."""
        return jnp.linalg.solve(self.begin.T @ self.begin, self.begin.T)


class Message(eqx.Module):
    """What is known of state and disturbance where a window ends, by the columns that stay.

    They are `joint`: the 13 numbers of the state, and behind them those of the disturbance.

    - `mean`: how far these are below those of the path without one, which ends at `end`; `covariance`.
    """

    mean: Float[Array, "joint columns"]
    covariance: Float[Array, "joint joint"]
    end: Float[Array, "13 columns"]

    def widened(self, force: Disturbance, wider: Disturbance) -> "Message":
        """With what a wider disturbance has and `force` has not, of which nothing is known yet."""
        kept = 13 + wider.shared_with(force)
        mean = jnp.zeros((13 + wider.states, self.mean.shape[1]))
        mean = mean.at[:13].set(self.mean[:13]).at[kept].set(self.mean[13:])
        unknown = jax.scipy.linalg.block_diag(jnp.zeros((13, 13)), wider.spread)
        kept = np.concatenate([np.arange(13), kept])
        return Message(mean, unknown.at[np.ix_(kept, kept)].set(self.covariance), self.end)


def _throughout(by: Float[Array, "*rows given"], force: Disturbance) -> Float[Array, "*rows pushes"]:
    """Derivatives by what pushes throughout, from those by a wrench's knots on six axes, and by the water."""
    by_knots, by_water = by[..., :-PLANE], by[..., -PLANE:]
    by_wrench = by_knots.reshape(*by.shape[:-1], -1, 6).sum(-2)[..., np.array(force.axes)]
    return jnp.concatenate([by_wrench, by_water], axis=-1)


def line_of(rows: Rows, z: int, push: Float[Array, " pushes"], force: Disturbance) -> Line:
    """A window's rows as a linear system about its path, but without what is expected to push there.

    - `z`: how many parameters the rows have; behind them are a free wrench and the water.
    """
    residual = rows.residual - _throughout(rows.by_push, force) @ push
    return Line(
        f=jnp.concatenate([rows.a, _throughout(rows.b[..., z:], force)], axis=-1),
        h=jnp.concatenate([rows.h_x, _throughout(rows.h_z[..., z:], force)], axis=-1),
        residual=jnp.concatenate([rows.jacobian[..., 12 : 12 + z], residual[..., None]], axis=-1),
        dt=rows.dt,
        by_plane=by_plane(force.axes, rows.states[:, 3:7]),
        begin=rows.begin,
    )


class Begun(NamedTuple):
    """State and disturbance (`joint`, see `Message`) at a sample: how far below the path's, by some columns.

    - `log_det`: of the covariance of all that was measured before.
    """

    mean: Float[Array, "joint columns"]
    covariance: Float[Array, "joint joint"]
    log_det: Float[Array, ""]


def _through(
    line: Line, force: Disturbance, begin: Begun
) -> tuple[Begun, Float[Array, "steps rows columns"]]:
    """Where a window ends, and its whitened residuals, each given all before it."""
    # What does not hang on what was measured, for all samples at once.
    pushes, over = jax.vmap(force.output)(line.by_plane), jax.vmap(force.over)(line.dt)
    h = jnp.concatenate([line.h[..., :13], line.h[..., 13:] @ pushes], axis=-1)
    by = line.f[..., 13:] @ pushes
    f = jnp.concatenate([line.f[..., :13], by @ over.mean], axis=-1)
    by_both = over.covariance @ jnp.swapaxes(by, 1, 2)
    in_states = by @ over.variance @ jnp.swapaxes(by, 1, 2)

    def step(carry: Begun, now):
        f, h, residual, dt, in_states, by_both, new = now
        mean, covariance, log_det = carry
        # All sensors of a sample at once, whose noises have a size of one.
        by_rows = h @ covariance
        root = jnp.linalg.cholesky(by_rows @ h.T + jnp.eye(len(h)))
        both = jnp.concatenate([by_rows, residual - h @ mean], axis=1)
        told, white = jnp.split(
            jax.scipy.linalg.solve_triangular(root, both, lower=True), [len(covariance)], axis=1
        )
        mean, covariance = mean + told.T @ white, covariance - told.T @ told
        log_det = log_det + 2.0 * jnp.log(jnp.diagonal(root)).sum()
        mean = jnp.concatenate([f @ mean, force.after(dt, mean[13:])])
        half = f @ covariance
        states, beside = half @ f.T + in_states, force.after(dt, half[:, 13:].T) + by_both
        own = force.after(dt, force.after(dt, covariance[13:, 13:]).T) + new
        covariance = jnp.block([[0.5 * (states + states.T), beside.T], [beside, 0.5 * (own + own.T)]])
        return Begun(mean, covariance, log_det), white

    return jax.lax.scan(step, begin, (f, h, line.residual, line.dt, in_states, by_both, over.new))


def nothing_known(force: Disturbance, columns: int) -> Message:
    """Before the first window."""
    state = 13 + force.states
    return Message(jnp.zeros((state, columns)), jnp.zeros((state, state)), jnp.zeros((13, columns)))


class Innovations(eqx.Module):
    """What the windows say of z, each given all before it, and the path that they let one expect.

    - `minus_twice`: minus twice the logarithm of the likelihood, but for a constant; `g` its slope by half.
    - `h`: information of z, and of shapes behind it, in each group of windows.
    """

    minus_twice: Float[Array, " windows"]
    g: Float[Array, "windows columns"]
    h: Float[Array, "groups columns columns"]
    path: Path


def pushed(problem: Problem, force: Disturbance, path: Path) -> Problem:
    """The problem with the wrench and the moving water that are expected along the path."""
    wrench = jnp.zeros((len(path.push), 6)).at[:, np.array(force.axes)].set(path.push[:, :-PLANE])
    windows = dataclasses.replace(problem.windows, wrench=wrench, water=path.push[:, -PLANE:])
    return dataclasses.replace(problem, windows=windows)


def start_spread(precision: Float[Array, "12"]) -> Float[Array, "12"]:
    """Standard deviation of a window's first state; `precision`: `_rollout.start_precision`."""
    return jnp.where(precision > LOOSE**-2.0, TIGHT, ANY)


def _spread(problem: Problem) -> Float[Array, "12"]:
    return start_spread(problem.start_precision)


class Free(eqx.Module):
    """Derivatives of a window's residuals and of its end by a wrench that is free in each of its knots.

    - `wrenches`: six numbers of each knot in turn.
    """

    residual: Float[Array, "steps rows wrenches"]
    end: Float[Array, "13 wrenches"]


class Windowed(eqx.Module):
    """A window as a linear system, and what it takes to join it to the one before.

    - `states` at the samples of its path; `end` of that without a push, its derivatives by what is asked for
      first.
    """

    line: Line
    states: Float[Array, "steps 13"]
    end: Float[Array, "13 columns"]
    delta: Float[Array, "12"]
    gap: Float[Array, ""]
    joined: Bool[Array, ""]

    @property
    def start(self) -> Float[Array | np.ndarray, "13"]:
        """Where its path begins."""
        return self.states[0]

    @property
    def alone(self) -> "Windowed":
        """Nothing asked for but the residuals."""
        return self.told(self.line.residual[..., -1:], self.end[..., -1:])

    def told(self, residual: Array | np.ndarray, end: Array | np.ndarray) -> "Windowed":
        """With other residuals and another end, by what is asked for."""
        return eqx.tree_at(lambda w: (w.line.residual, w.end), self, (residual, end))

    @classmethod
    def of(cls, rows: Rows, z: int, path: Path, force: Disturbance, index) -> "Windowed":
        """`z`: how many parameters the rows have."""
        push = path.push[index]
        return cls(
            line=line_of(rows, z, push, force),
            states=rows.states,
            end=jnp.concatenate(
                [
                    rows.end_by[:, 12 : 12 + z],
                    (rows.end - _throughout(rows.end_by[:, 12 + z :], force) @ push)[:, None],
                ],
                axis=1,
            ),
            delta=path.delta[index],
            gap=force.gap[index],
            joined=force.joined[index],
        )

    def signs(self, message: Message) -> Float[Array, "13"]:
        """Of states as the window before has them: quaternions of both signs are one attitude."""
        sign = jnp.where(message.end[3:7, -1] @ self.start[3:7] < 0, -1.0, 1.0)
        return jnp.ones(13).at[3:7].set(sign)

    def ahead(self, message: Message) -> Float[Array, "12 columns"]:
        """By how many changes its first state is above that with which the path before it ended."""
        end = self.signs(message)[:, None] * message.end
        return self.line.back @ (-end).at[:, -1].add(self.start)

    def begun(
        self, message: Message, force: Disturbance, spread: Float[Array, "12"]
    ) -> tuple[Float[Array, "first columns"], Float[Array, "first first"]]:
        """Mean and covariance of the twelve changes of its first state, and of the disturbance's first."""
        carried = jnp.zeros((12 + force.states, 13 + force.states))
        carried = carried.at[:12, :13].set(
            jnp.where(self.joined, self.line.back * self.signs(message)[None], 0.0)
        )
        carried = carried.at[12:, 13:].set(force.after(self.gap, jnp.eye(force.states)))
        free = jnp.zeros((12, message.end.shape[1])).at[:, -1].set(self.delta)
        new = jnp.diag(jnp.where(self.joined, 0.0, spread**2)), force.new(self.gap)
        mean = (carried @ message.mean).at[:12].add(jnp.where(self.joined, self.ahead(message), free))
        return mean, carried @ message.covariance @ carried.T + jax.scipy.linalg.block_diag(*new)

    def after(
        self, message: Message, force: Disturbance, spread: Float[Array, "12"]
    ) -> tuple[Float[Array, "steps rows columns"], Float[Array, ""], Message]:
        """The window filtered: its whitened residuals, their determinant and what it tells the next.

        - `message`: of the window before.
        """
        mean, covariance = self.begun(message, force, spread)
        into = jax.scipy.linalg.block_diag(self.line.begin, jnp.eye(force.states))
        begin = Begun(into @ mean, into @ covariance @ into.T, jnp.zeros(()))
        (mean, covariance, log_det), white = _through(self.line, force, begin)
        return white, log_det, Message(mean, covariance, self.end)

    def informed(
        self, message: Message, force: Disturbance, spread: Float[Array, "12"]
    ) -> tuple[Float[Array, "columns columns"], Float[Array, ""], Message]:
        """The same, but of the whitened residuals their information by the columns."""
        white, log_det, message = self.after(message, force, spread)
        white = white.reshape(-1, white.shape[-1])
        return white.T @ white, log_det, message

    def held(self, wrench: Float[Array, "steps axes shapes"]) -> tuple[Array, Array]:
        """Derivatives of its residuals and its end by the sizes of wrenches that are held from each sample.

        - `wrench`: on the disturbance's axes.
        """
        pushed = slice(13, 13 + wrench.shape[1])
        over, at = self.line.f[..., pushed] @ wrench, self.line.h[..., pushed] @ wrench

        def step(state, now):
            f, over = now
            return f @ state + over, state

        begin = jnp.zeros((13, wrench.shape[-1]))
        end, states = jax.lax.scan(step, begin, (self.line.f[..., :13], over))
        return self.line.h[..., :13] @ states + at, end

    def shaped(self, wrench: Float[Array, "steps axes shapes"]) -> "Windowed":
        """The sizes of wrenches of given shapes asked for as well, behind what is asked for first."""

        def behind(stays: Array, more: Array) -> Array:
            return jnp.concatenate([stays[..., :-1], more, stays[..., -1:]], axis=-1)

        by_residual, by_end = self.held(wrench)
        return self.told(behind(self.line.residual, by_residual), behind(self.end, by_end))

    def beside(self, wrench: Float[Array, "steps axes"]) -> "Windowed":
        """The window where a wrench acts that its path does not have."""
        by_residual, by_end = self.held(wrench[..., None])
        residual = self.line.residual.at[..., -1].add(by_residual[..., 0])
        return self.told(residual, self.end.at[..., -1].add(by_end[..., 0]))


@compiled
def _lines(
    problem: Problem, affine: Affine, force: Disturbance, path: Path, knots: int, trail: Trail
) -> tuple[Windowed, Free, Trail]:
    given = affine.acts.shape[-1]

    def of_rows(rows, index):
        free = Free(rows.jacobian[..., 12 + given : -PLANE], rows.end_by[:, 12 + given : -PLANE])
        return Windowed.of(rows, given, path, force, index), free

    def each(carry, now):
        return carry, now

    whole = pushed(problem, force, path)
    _, (every, free), trail = swept(whole, affine, path.delta, knots, of_rows, each, None, trail)
    return every, free, trail


def lines(
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    knots: int = 1,
    trail: Trail | None = None,
) -> tuple[Windowed, Free, Trail]:
    """All windows as linear systems, by z = 0 and by a free wrench, and their trail.

    `trail`: of the windows before them; None: there are none.

    The program that everything else here goes on from: to compile it takes several times as long as all of
    that, and it is the same for all disturbances.
    """
    nothing = jnp.zeros(len(force.axes))
    still = Disturbance(nothing, nothing + 1.0, nothing, force.gap, force.joined, force.axes)
    return _lines(
        problem, affine, still, path, knots, Trail.nothing(problem.trail) if trail is None else trail
    )


@compiled
def _abreast(every: tuple[Windowed, ...], given: int) -> Windowed:
    """The same windows with what is asked for in each of some parts, of which the first `given` count."""

    def joined(parts: list[Array]) -> Array:
        asked = jnp.concatenate([one[..., :-1] for one in parts], axis=-1)
        return jnp.concatenate([asked[..., :given], parts[0][..., -1:]], axis=-1)

    return every[0].told(joined([one.line.residual for one in every]), joined([one.end for one in every]))


def _lines_by(
    width: int | None,
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    knots: int,
    trail: Trail | None = None,
) -> tuple[Windowed, Free, Trail]:
    """`lines`, by so many z at a time, so that the program of few z serves for many."""
    given = affine.acts.shape[-1]
    if width is None or given == width:
        return lines(problem, affine, force, path, knots, trail)
    parts = [lines(problem, part, force, path, knots, trail) for part in affine.in_parts(width)]
    every, (free, *_), (trail, *_) = zip(*parts, strict=True)
    return _abreast(every, given), free, trail


def _in_turn(
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    knots: int = 1,
    width: int | None = None,
) -> Iterator[tuple[Windowed, Free, np.ndarray]]:
    """Some windows after others as linear systems, and their indices; what fills up lies beyond the last.

    - `width`: how many z at a time; None: all of them.
    """
    count = len(path.delta)
    size = part_of(count, HELD, BATCH)
    if size >= count:
        every, free, _ = _lines_by(width, problem, affine, force, path, knots)
        yield every, free, np.arange(count)
        return
    trail = None
    for index in np.arange(-(-count // size) * size).reshape(-1, size):
        here = np.minimum(index, count - 1)
        windows, part = jax.tree.map(lambda a, here=here: a[here], (problem.windows, path))
        some = eqx.tree_at(lambda p: p.windows, problem, windows)
        beside = dataclasses.replace(force, gap=force.gap[here], joined=force.joined[here])
        every, free, trail = _lines_by(width, some, affine, beside, part, knots, trail)
        yield every, free, index


@compiled
def _joined_up(begin, every: Windowed, force: Disturbance, group: Int[Array, " windows"], spread):
    """What windows say of z, added to what those before them did."""

    def each(carry, now):
        total, message = carry
        window, group = now
        half, follows = 0.5 * window.line.dt.sum(), window.gap < 0.5 * window.line.dt[0]
        pushes = force.output(window.line.by_plane[len(window.line.by_plane) // 2])
        expected = -pushes @ force.after(window.gap + half, message.mean[13:, -1:])[:, 0]
        # As the one before lets one expect it, if this window follows it at once.
        known = window.line.back @ (window.signs(message) * message.mean[:13, -1])
        delta = jnp.where(follows, window.delta - window.ahead(message)[:, -1] - known, window.delta)
        information, log_det, message = window.informed(message, force, spread)
        kept = information[-1, -1] + log_det, information[:-1, -1], Path(delta, expected)
        return (added(total, information[:-1, :-1], group), message), kept

    return jax.lax.scan(each, begin, (every, group))


def innovations(
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    group: Int[Array, " windows"],
    groups: int,
    shapes: Float[Array, "windows steps 6 shapes"] | None = None,
    width: int | None = None,
) -> Innovations:
    """What all windows say of z at z = 0, and of the sizes of wrenches of given shapes at 0.

    - `group`: of each window; windows of the group with the number `groups` are left out.
    - `shapes`: of wrenches that are held from each sample to the next [N, N m].
    - `width`: how many z are linearised at a time, so that the program of few serves for many; None: all.
    """
    count, spread = len(path.delta), _spread(problem)
    given = affine.acts.shape[-1] + (0 if shapes is None else shapes.shape[-1])
    carry = jnp.zeros((groups + 1, given, given)), nothing_known(force, given + 1)
    found = []
    for every, _, index in _in_turn(problem, affine, force, path, width=width):
        if shapes is not None:
            every = _shaped(every, force.axes, shapes[np.minimum(index, count - 1)])
        carry, kept = _joined_up(carry, every, force, of_filled(group, groups, index), spread)
        found.append(kept)
    minus_twice, g, path = jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *found)
    return Innovations(minus_twice, g, carry[0][:-1], path)


@compiled
def _shaped(
    every: Windowed, axes: tuple[int, ...], shapes: Float[Array, "windows steps 6 shapes"]
) -> Windowed:
    return jax.vmap(Windowed.shaped)(every, shapes[:, :, np.array(axes)])


@compiled
def _beside(every: Windowed, axes: tuple[int, ...], wrench: Float[Array, "windows steps 6"]) -> Windowed:
    return jax.vmap(Windowed.beside)(every, wrench[:, :, np.array(axes)])


def path_lines(
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    wrench: Float[Array, "windows steps 6"] | None = None,
) -> Windowed:
    """All windows as linear systems, of which nothing but the residuals is asked for.

    - `wrench`: that acts besides, held from each sample to the next [N, N m].
    """
    count, found = len(path.delta), []
    for every, _, index in _in_turn(problem, affine, force, path):
        if wrench is not None:
            every = _beside(every, force.axes, wrench[np.minimum(index, count - 1)])
        found.append(every.alone)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[: len(path.delta)], *found)


@compiled
def _whitened(every: Windowed, force: Disturbance, spread) -> Float[Array, "windows steps rows"]:
    def each(message: Message, window: Windowed):
        white, _, message = window.after(message, force, spread)
        return message, white[..., 0]

    return jax.lax.scan(each, nothing_known(force, 1), every)[1]


def whitened(
    problem: Problem, affine: Affine, force: Disturbance, path: Path
) -> Float[Array, "windows steps rows"]:
    """By how much each sample differs from what all before it lets one expect, in standard deviations.

    Of a model that is right these are white noise of size one. 0 where nothing was measured.
    """
    return _whitened(path_lines(problem, affine, force, path), force, _spread(problem))


def _minus_twice(logarithms: Float[Array, " logarithms"], unit: Array, every: Windowed, spread, force):
    """-2 log p(samples, sizes, memories) but for a constant."""
    now = with_logarithms(force, unit, logarithms)

    # What a window needs for its slope is made again, or that of all would be held at once.
    @jax.checkpoint
    def each(message, window):
        white, log_det, message = window.after(message, now, spread)
        return message, (white**2).sum() + log_det

    _, minus_twice = jax.lax.scan(each, nothing_known(now, 1), every)
    return minus_twice.sum() + improbable(now, unit)


@compiled
def _sloped(logarithms: Float[Array, " logarithms"], unit: Array, every: Windowed, spread, force):
    """-2 log p(samples, sizes, memories) but for a constant, and its slope by the logarithms."""
    return jax.value_and_grad(_minus_twice)(logarithms, unit, every, spread, force)


@compiled
def _valued(each: Float[Array, "some logarithms"], unit: Array, every: Windowed, spread, force):
    """The same of several, without slopes, which take three times as long."""
    return jax.lax.map(lambda logarithms: _minus_twice(logarithms, unit, every, spread, force), each)


def improbability(
    spread: Float[Array, "12"],
    every: Windowed,
    forces: Sequence[Disturbance],
    unit: Float[np.ndarray, " axes"],
) -> Float[np.ndarray, " forces"]:
    """Minus twice the logarithm of the samples' likelihood and a disturbance's prior, but for a constant.

    - `forces`: of one kind, on the same axes. `spread`, `unit`: as of `estimated`.
    """
    logarithms = jnp.asarray(np.array([logarithms_of(force, unit) for force in forces]))
    return np.asarray(_valued(logarithms, jnp.asarray(unit), every, spread, forces[0]))


def estimated(
    spread: Float[Array, "12"],
    every: Windowed,
    force: Disturbance,
    unit: Float[np.ndarray, " axes"],
    covariance: Float[np.ndarray, "logarithms logarithms"],
    enough: float = 0.0,
    far: bool = False,
) -> tuple[Disturbance, Float[np.ndarray, "logarithms logarithms"], float]:
    """The disturbance that makes the samples most likely, with a weak prior on its numbers.

    And minus twice the logarithm of that likelihood, but for a constant.

    - `spread`: `start_spread`; `force`: where the search begins; `unit`: the full thrust [N, N m] of each
      axis, or what stands for it.
    - `covariance`: of the logarithms (`_logarithms.py`) by the curvature, as far as it is known, and returned
      as the search has learned it. One that begins with that of a similar model takes few steps.
    - `enough`: the decrease of minus twice the logarithm that is not worth a step; `ENOUGH` at least.
    - `far`: whether sizes may be many times too large or too small to begin with.
    """
    enough = max(ENOUGH, enough)

    @functools.cache
    def sloped(*logarithms: float) -> tuple[float, Float[np.ndarray, " logarithms"]]:
        value, slope = _sloped(jnp.asarray(logarithms), jnp.asarray(unit), every, spread, force)
        value, slope = float(value), np.asarray(slope)
        # Where the path has run away there is nothing to be found.
        usable = np.isfinite(value) and np.isfinite(slope).all()
        return (value, slope) if usable else (RUN_AWAY, np.zeros_like(slope))

    begin = logarithms_of(force, unit)
    if far:
        holds = float((np.asarray(every.line.dt) > 0).sum())
        begin = _come_near(sloped, begin, holds * new_of(force))
    # In these coordinates the likelihood curves alike in all directions.
    root = np.linalg.cholesky(covariance)

    def of(whitened):
        value, slope = sloped(*(begin + root @ whitened))
        return value, root.T @ slope

    last, _ = sloped(*begin)

    def ended(intermediate_result: optimize.OptimizeResult) -> None:
        nonlocal last
        before, last = last, intermediate_result.fun
        if before - last < enough:
            raise StopIteration

    # Half the slope's square is what a step is worth where the curvature is as it was said to be.
    how = {"maxiter": STEPS, "gtol": np.sqrt(2 * enough), "norm": 2}
    best = optimize.minimize(of, np.zeros(len(begin)), jac=True, method="BFGS", callback=ended, options=how)
    found = with_logarithms(force, jnp.asarray(unit), jnp.asarray(begin + root @ best.x))
    learned = root @ best.hess_inv @ root.T
    # A line search that fails, as over a likelihood that rounding makes rough, can leave a curvature that is
    # none: no search could begin with it.
    usable = np.isfinite(learned).all() and np.linalg.eigvalsh(best.hess_inv)[0] > CURVED
    worth = float(best.fun) if best.fun < RUN_AWAY else np.inf
    return found, learned if usable else covariance, worth


def _come_near(
    sloped: Callable[..., tuple[float, Float[np.ndarray, " logarithms"]]],
    begin: Float[np.ndarray, " logarithms"],
    new: Float[np.ndarray, " logarithms"],
) -> Float[np.ndarray, " logarithms"]:
    """Logarithms whose sizes are about what the samples let one expect, from far away.

    Given the samples and sizes that are said, what is new in the disturbance is as large as these say and the
    slopes add. That alone comes near slowly, so that the second step goes twice as far, the third four times.
    Source: after Dempster, Laird and Rubin on expectation and maximisation, by Fisher's identity.

    - `sloped`: minus twice the logarithm of the likelihood by the logarithms, and its slope.
    - `new`: of each size, how many numbers are new that are as large as it; 0 of all others.
    """
    best, least = begin, np.inf
    for faster in 2.0 ** np.arange(COMING):
        value, slope = sloped(*begin)
        if not value < least:
            break
        best, least = begin, value
        larger = np.divide(-0.5 * slope, new, out=np.zeros_like(new), where=new > 0)
        step = 0.5 * np.log(np.maximum(1 + larger, SHRINKING))
        if np.abs(step).max() < NEAR:
            break
        begin = begin + faster * step
    return best


def likeliest_of(
    spread: Float[Array, "12"],
    every: Windowed,
    others: Sequence[Disturbance],
    unit: Float[np.ndarray, " axes"],
    worth: float,
) -> Disturbance | None:
    """The likeliest of some disturbances of one kind; None if none is likelier than one worth so much.

    - `worth`: `improbability` of that. `spread`, `unit`: as of `estimated`.
    """
    of_others = improbability(spread, every, others, unit)
    best = int(np.argmin(np.nan_to_num(of_others, nan=np.inf)))
    return others[best] if of_others[best] < worth else None


class Likelihood(eqx.Module):
    """What is maximised: the windows' likelihood beside a disturbance, and a normal prior on z around 0."""

    problem: Problem
    affine: Affine
    precision: Float[Array, " z"]
    force: Disturbance


def _improbable(y: tuple[Array, Path], task: Likelihood) -> tuple[Array, Innovations]:
    """Half of minus twice the logarithm of the likelihood with the prior, and what the windows say of z."""
    z, path = y
    group = jnp.zeros(len(path.delta), int)
    found = innovations(task.problem, task.affine.at(z), task.force, path, group, 1)
    return 0.5 * (found.minus_twice.sum() + (task.precision * z * z).sum()), found


def worth_a_step(share: float | Array, samples: int | Array, minus_twice: float | Array) -> Array:
    """The decrease of -2 log p that is worth a step; `share`: of it, or of the number of samples."""
    beyond = BEYOND * jnp.maximum(minus_twice - GROSS * samples, 0.0)
    return jnp.maximum(share * jnp.maximum(samples, minus_twice), beyond)


def saved_at_once(
    z: Float[Array, " z"], found: Innovations, precision: Float[Array, " z"]
) -> Float[Array, ""]:
    """The decrease of -2 log p with the prior that slopes promise at z, without any damping."""
    h, g = found.h.sum(0) + jnp.diag(precision), found.g.sum(0) + precision * z
    return g @ jax.scipy.linalg.solve(h, g, assume_a="pos")


def saved_by_chance(found: Innovations, precision: Float[Array, " z"]) -> Float[Array, ""]:
    """As much as numbers save that are right as they are, and two standard deviations more."""
    h = found.h.sum(0)
    count = jnp.trace(jax.scipy.linalg.solve(h + jnp.diag(precision), h, assume_a="pos"))
    return count + 2.0 * jnp.sqrt(2.0 * count)


class FilterGaussNewton(DampedGaussNewton[tuple[Array, Path], Innovations]):
    """Damped Gauss-Newton on the innovations; each step goes on from the path that the last one predicts.

    Its arguments are the precision of the prior. A step is worth what `worth_a_step` says of the options
    `share` and `samples`, and `ATOL` at least.
    """

    def usable(self, found: Innovations) -> Bool[Array, ""]:
        # Of a path that runs away rounding makes anything, a likelihood without bounds included.
        stays = (jnp.abs(found.path.delta[:, 6:]) < LOOSE).all()
        return jnp.isfinite(found.h).all() & jnp.isfinite(found.path.delta).all() & stays

    def moved(
        self, y: tuple[Array, Path], found: Innovations, args: Float[Array, " z"], damping: Float[Array, ""]
    ) -> tuple[tuple[Array, Path], Float[Array, ""]]:
        z, _ = y
        h, g = found.h.sum(0) + jnp.diag(args), found.g.sum(0) + args * z
        scale = jnp.diag(h) + 1e-12 * jnp.diag(h).max()
        d_z = -jax.scipy.linalg.solve(h + damping * jnp.diag(scale), g, assume_a="pos")
        return (z + d_z, found.path), -(g @ d_z + 0.5 * d_z @ h @ d_z)

    def by_chance(
        self, y: tuple[Array, Path], found: Innovations, args: Float[Array, " z"]
    ) -> Bool[Array, ""]:
        # How the covariance of what was measured hangs on the numbers is left out of their slopes, so that
        # these may promise what the likelihood does not keep.
        return saved_at_once(y[0], found, args) < saved_by_chance(found, args)

    def worth(self, options, cost: Float[Array, ""]) -> Float[Array, ""]:
        # Where it could not be begun, what is worth a step is not known.
        minus_twice = jnp.where(jnp.isfinite(cost), 2 * cost, 0.0)
        return jnp.maximum(ATOL, worth_a_step(options["share"], options["samples"], minus_twice))


class Likeliest(eqx.Module):
    """Where the likelihood is largest: z, the path, half of minus twice its logarithm with the prior.

    - `promised`: the decrease of that which one step more would bring, with the `damping` that it would have.
    """

    z: Float[Array, " z"]
    path: Path
    cost: Float[Array, ""]
    promised: Float[Array, ""]
    damping: Float[Array, ""]


def maximise(
    task: Likelihood, z, path: Path, max_steps: int, share: float, samples: int, damping: float
) -> Likeliest:
    """The largest likelihood from z and a path, at most so many steps away.

    - `share`, `samples`: what a step must be worth, as of `FilterGaussNewton`.
    """
    options = {
        "limit": jnp.asarray(max_steps),
        "share": jnp.asarray(share, jnp.result_type(float)),
        "samples": jnp.asarray(samples, jnp.result_type(float)),
        "damping": jnp.asarray(damping, jnp.result_type(float)),
    }
    y, found, stats = minimise_outside(
        lambda y: _improbable(y, task), FilterGaussNewton(), (z, path), task.precision, options
    )
    # Along a path that was tried and not taken the craft may run away.
    path = found.path if stats["taken"] else y[1]
    return Likeliest(y[0], path, stats["cost"], stats["predicted"], stats["damping"])


def promise(task: Likelihood, z, path: Path, damping: float) -> Float[Array, ""]:
    """Half of minus twice the logarithm of the likelihood that a step from z would reach, by its slopes."""
    cost, found = _improbable((z, path), task)
    return cost - _promised(z, path, found, task.precision, jnp.asarray(damping))


@compiled
def _promised(z, path: Path, found: Innovations, precision, damping):
    return FilterGaussNewton().moved((z, path), found, precision, damping)[1]


@compiled
def _joined_beside(begin, every: Windowed, free: Free, force: Disturbance, index, group, spread, parts: int):
    """What windows say of z and of the knots of a free wrench, added to what those before them did."""
    given, width = every.end.shape[-1] - 1, free.end.shape[-1]
    columns = given + parts * width

    def of_window(window: Windowed, free: Free, index) -> Windowed:
        place = given + index % parts * width

        def beside(stays: Array, by_knots: Array) -> Array:
            """What stays, with the window's own knots in their place before its last column."""
            room = jnp.zeros((*stays.shape[:-1], columns + 1))
            room = room.at[..., :given].set(stays[..., :-1]).at[..., -1].set(stays[..., -1])
            return jax.lax.dynamic_update_slice_in_dim(room, by_knots, place, axis=-1)

        return window.told(beside(window.line.residual, free.residual), beside(window.end, free.end))

    def each(carry, now):
        total, message = carry
        window, free, index, group = now
        window = of_window(window, free, index)
        forgotten = message.mean.at[:, given:columns].multiply(window.joined)
        message = eqx.tree_at(lambda m: m.mean, message, forgotten)
        information, _, message = window.informed(message, force, spread)
        return (added(total, information, group), message), None

    return jax.lax.scan(each, begin, (every, free, index, group))[0]


def free_wrench(
    problem: Problem,
    affine: Affine,
    force: Disturbance,
    path: Path,
    knots: int,
    parts: int,
    group: Int[Array, " windows"],
    groups: int,
) -> Float[Array, "groups columns columns"]:
    """Information of z, of a free wrench beside the disturbance, and of 1, the residuals' square, in groups.

    - `knots`: of the wrench in each window, columns knot by knot on six axes; `parts`: windows in a row whose
      knots stand side by side, and are forgotten afterwards but for the disturbance.
    """
    columns, spread = affine.acts.shape[-1] + 6 * knots * parts + 1, _spread(problem)
    carry = jnp.zeros((groups + 1, columns, columns)), nothing_known(force, columns)
    for every, free, index in _in_turn(problem, affine, force, path, knots):
        of = of_filled(group, groups, index)
        carry = _joined_beside(carry, every, free, force, jnp.asarray(index), of, spread, parts)
    return carry[0][:-1]
