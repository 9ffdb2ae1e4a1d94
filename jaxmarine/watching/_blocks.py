"""Rows of a log that goes on, block by block, as linear systems about the path that is expected.

A block is what a window of a diagnosis beside a disturbance is (`fitting/_filter.py`): half a second, rolled
out from where all before it lets one expect the craft, and linearised there by every parameter of the
catalogue at once. Arrays have one shape from the first block to the last, so that one program serves all.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from .._compiled import compiled
from .._errors import InputError
from .._types import ACCELERATIONS, AXES
from ..diagnosis import (
    Coefficient,
    Layout,
    SaturatedPlant,
    base_coefficients,
    parts_of,
    saturate,
    strength,
)
from ..effects import AbstractEffect, SensorDelay
from ..fitting import (
    PITCH,
    PLANE,
    TURNS,
    USUAL_MEMORY,
    USUAL_SIZE,
    Affine,
    Before,
    Disturbance,
    Line,
    Message,
    Path,
    Problem,
    Records,
    Windowed,
    Windows,
    at_rest,
    by_plane,
    lines,
    noise_of,
    nothing_known,
    start_precision,
    start_spread,
    steep,
    true_velocity,
)
from ..logs import Log, angles_of, quaternions_of, smooth_states
from ..simulation import substeps
from ..vehicle import Vehicle

# As long as a window of a diagnosis, which begins with any state [s].
WINDOW = 4.0
# As many samples as fit into this are taken together [s], as to filter twice as many takes twice as long.
# What pushes is the same for all of them: of a memory of half a second, quick for what disturbs, a tenth is
# new meanwhile. Taken by fives at 50 Hz, they lost a tenth of the nats of a thruster that grew weak.
NEAR = 0.05
# What actuators and fluid memory were told before a block [s]: ten times what usual ones remember.
PAST = 10.0
# From one stretch without a gap to the next: many times any memory [s].
LONG = 1e6
# Rows before and behind those of a block by which its beginning is smoothed where it is as measured [s].
AROUND = 0.5
# Of a sample's time, how long each of those takes that fill a block which ends early, and of what rounding
# leaves of large times at least.
INSTANT, ROUNDED = 1e-6, 8


@dataclasses.dataclass(frozen=True)
class Rows:
    """Rows of one stretch without a gap; `commands` has the columns of the vehicle."""

    t: Float[np.ndarray, " rows"]
    channels: Float[np.ndarray, "rows channels"]
    commands: Float[np.ndarray, "rows columns"]
    wrench: Float[np.ndarray, "rows 6"]

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.t, self.channels, self.commands, self.wrench

    def __len__(self) -> int:
        return len(self.t)

    def driven(self, columns: Int[np.ndarray, " columns"]) -> "Rows":
        """The rows if these were the columns of their commands."""
        return dataclasses.replace(self, commands=self.commands[:, columns])

    def part(self, first: int | None, end: int | None = None) -> "Rows":
        return Rows(*(one[first:end] for one in self.arrays))

    def filled(self, count: int, dt: float) -> "Rows":
        """So many rows more that take no time: from the last one on, nothing is measured.

        And nothing new is commanded: what begins with the last row is told by the block that does.
        """
        end = len(self) - 1
        rows = np.minimum(np.arange(len(self) + count), end)
        t, channels, commands, wrench = (one[rows] for one in self.arrays)
        t[end:] += max(INSTANT * dt, ROUNDED * np.spacing(abs(t[-1]))) * np.arange(count + 1)
        channels[end:], commands[end:], wrench[end:] = np.nan, commands[end - 1], wrench[end - 1]
        return Rows(t, channels, commands, wrench)

    @staticmethod
    def joined(*parts: "Rows") -> "Rows":
        return Rows(*map(np.concatenate, zip(*(one.arrays for one in parts), strict=True)))

    def log(self, vehicle: Vehicle, driven: bool, name: str) -> Log:
        """The rows as a log; `driven`: by commands, not by a wrench."""
        names = vehicle.command_names
        return Log(
            self.t,
            self.channels,
            self.commands if driven else None,
            None if driven else self.wrench,
            names,
            name,
        )


@dataclasses.dataclass(frozen=True)
class Bench:
    """What stays the same from block to block of one craft and its sensors.

    - `steps`: samples of a block, `dt` [s] apart, of which `together` are taken as one (`averaged`); `whole`:
      blocks of a window, after which any state is allowed again.
    - `noise` of each channel, NaN where it is not used.
    """

    vehicle: Vehicle
    catalogue: tuple[type[AbstractEffect], ...]
    families: tuple[AbstractEffect, ...]
    layout: Layout
    base: tuple[Coefficient, ...]
    noise: Float[np.ndarray, " channels"]
    channels: tuple[int, ...]
    dt: float
    steps: int
    together: int
    whole: int
    unit: Float[np.ndarray, " axes"]
    axes: tuple[int, ...]

    @classmethod
    def of(cls, vehicle: Vehicle, log: Log, catalogue: Sequence[type[AbstractEffect]]) -> "Bench":
        """By the first rows of a log; raises `InputError` where they measure nothing that moves."""
        noise = noise_of(vehicle, [log])
        return cls.with_noise(vehicle, noise, log.dt, catalogue)

    @classmethod
    def with_noise(cls, vehicle: Vehicle, noise, dt: float, catalogue) -> "Bench":
        free = vehicle.free[np.array(AXES[: len(noise)])].astype(bool)
        channels = tuple(np.flatnonzero(np.isfinite(noise) & free).tolist())
        if not channels:
            axes = ", ".join(vehicle.dof)
            raise InputError(
                f"The rows measure nothing of {axes} that changes; map the columns, or state [sensors]."
            )
        families, layout = saturate(vehicle, catalogue)
        size = max(4, round(WINDOW / dt))
        whole = parts_of(size, dt)
        # Clocks are not that exact. Accelerations show what pushes at their very sample.
        apart = any(channel >= ACCELERATIONS.start for channel in channels)
        together = 1 if apart else max(1, int(1.1 * NEAR / dt))
        axes = np.flatnonzero(vehicle.free)
        return cls(
            vehicle,
            tuple(catalogue),
            families,
            layout,
            base_coefficients(vehicle, layout),
            noise,
            channels,
            dt,
            max(1, size // whole // together) * together,
            together,
            whole,
            strength(vehicle)[axes],
            tuple(axes.tolist()),
        )

    @property
    def past(self) -> int:
        """Rows before a block that its records hold."""
        return round(PAST / self.dt)

    @property
    def length(self) -> float:
        """Of a window [s]."""
        return self.whole * self.steps * self.dt

    @property
    def settling(self) -> float:
        """In which actuators forget what they were told before a stretch [s]."""
        drive = self.vehicle.plant().drive
        return min(float(jnp.max(4.0 * drive.lag + drive.delay, initial=0.0)), PAST)

    @functools.cached_property
    def usual(self) -> Disturbance:
        """The disturbance that is assumed before any was estimated."""
        size, time = USUAL_SIZE.median * jnp.asarray(self.unit), jnp.full(len(self.axes), USUAL_MEMORY.median)
        return Disturbance(size, time, jnp.zeros(len(size)), jnp.zeros(1), jnp.zeros(1, bool), self.axes)

    @functools.cached_property
    def start(self) -> Float[Array, "12"]:
        """Precision of where a window begins."""
        return jnp.asarray(start_precision(self.vehicle.free))

    @functools.cached_property
    def spread(self) -> Float[Array, "12"]:
        return start_spread(self.start)

    @functools.cached_property
    def saturated(self) -> SaturatedPlant:
        return SaturatedPlant(self.vehicle, self.families, jnp.ones((1, len(self.vehicle.placed))))

    @functools.cached_property
    def swinging(self) -> tuple[int, ...]:
        """Suspects that swing."""
        return tuple(i for i, one in enumerate(self.layout.suspects) if one.effect.swings)

    @functools.cached_property
    def resting(self) -> Float[np.ndarray, "late 13"]:
        """What may be before a block, as long as sensors may be late."""
        return np.asarray(at_rest(SensorDelay.longest(self.dt)))

    @functools.cached_property
    def about_neutral(self) -> Affine:
        """The parameters of the whole catalogue, each by a z of its own."""
        size = self.layout.size
        return Affine(jnp.asarray(self.layout.neutral[None]), jnp.eye(size), jnp.ones((1, size)))

    @property
    def nothing(self) -> Message:
        """Before the first block."""
        return nothing_known(self.usual, self.layout.size + 1)

    @property
    def precision(self) -> Float[np.ndarray, " base"]:
        """Of the prior on the file's coefficients."""
        return np.array([c.prior**-2.0 for c in self.base])

    def split(self, speed: Float[np.ndarray, "6"]) -> int:
        """Integration steps per sample, at the fastest that the craft goes."""
        return substeps(self.vehicle, self.dt, speed)

    def window(
        self,
        rows: Rows,
        count: int,
        begun: "Begun | None",
        gap: float,
        joined: bool,
        split: int,
        z: Float[np.ndarray, " z"],
        trail: Float[np.ndarray, "_ 13"],
    ) -> Windowed:
        """A block as a linear system.

        - `rows`: what there is of `past` rows before it, its own, and one more, that ends its last hold.
        - `count`: of its own; those to come fill it where they are fewer than `steps`.
        - `begun`: what all before it lets one expect; None: as measured. `gap`, `joined`: see `Disturbance`.
        - `z`: which parameters it is linear about; it tells of them all as seen from neutral.
        - `trail`: where the craft was expected at the samples before, as far as the stretch goes back.
        """
        begun = self._measured(rows, count, z) if begun is None else begun
        missing = self.steps - count
        seen = self._seen(rows.filled(missing, self.dt) if missing else rows, begun, trail)
        force = dataclasses.replace(self.usual, gap=jnp.array([gap]), joined=jnp.array([joined]))
        affine = dataclasses.replace(self.about_neutral, theta=jnp.asarray((self.layout.neutral + z)[None]))
        kit = self.saturated, self.start, self.channels, self.vehicle.axes
        found = _linear(kit, affine, force, seen, np.array(split), self.together)
        window = jax.tree.map(np.asarray, found)
        residual, end = np.array(window.line.residual), np.array(window.end)
        residual[..., -1] -= residual[..., :-1] @ z
        end[..., -1] -= end[..., :-1] @ z
        return window.told(residual, end)

    def _seen(self, rows: Rows, begun: "Begun", trail: Float[np.ndarray, "_ 13"]) -> "Seen":
        """Arguments as of `window`."""
        short = self.past + self.steps + 1 - len(rows.t)
        t = np.concatenate([rows.t[0] - self.dt * np.arange(short, 0, -1), rows.t])

        def filled(values):
            return np.concatenate([np.repeat(values[:1], short, axis=0), values])

        so_far = np.concatenate([trail, begun.state[None]])
        # What fluids remember is a low-pass of this. Smoothed, it has the noise of what is yet to come in it:
        # in gusts, at 1 Hz, that made a fluid memory of 19 nats that is none in four hours.
        along = so_far[np.clip(np.arange(len(t)) - self.past + len(trail), 0, len(trail))]
        measured = rows.channels[-self.steps - 1 : -1]
        usable = np.isfinite(measured) & np.isin(np.arange(measured.shape[1]), self.channels)
        weight = np.where(usable, 1.0 / np.where(np.isfinite(self.noise), self.noise, 1.0), 0.0)
        pitch = np.where(usable[:, PITCH], measured[:, PITCH], begun.pitch)
        weight[np.ix_(steep(pitch), TURNS)] = 0.0
        before = np.array(self.resting)
        known = trail[-len(before) :]
        before[len(before) - len(known) :] = known
        return Seen(
            t,
            filled(rows.commands),
            filled(rows.wrench),
            along,
            np.where(usable, measured, 0.0),
            weight,
            begun,
            before,
            np.array(len(known)),
        )

    def _measured(self, rows: Rows, count: int, z: Float[np.ndarray, " z"]) -> "Begun":
        """Where a block begins, as measured by sensors at z: its rows and one more are the last."""
        first = len(rows.t) - count - 1
        around = max(0, first - round(AROUND / self.dt))
        near = rows.part(around)
        track = smooth_states(near.log(self.vehicle, False, "rows"), self.vehicle.dof)
        turn = quaternions_of(track.attitude[first - around : first - around + 1])[0]
        theta, nu = jnp.asarray(self.layout.neutral + z), jnp.asarray(track.nu[first - around])
        velocity = np.array(_unlogged(self.saturated, theta, jnp.asarray(turn), nu))
        return Begun(track.position[first - around], turn, velocity, np.zeros(len(self.axes) + PLANE))

    @property
    def empty(self) -> Windowed:
        """A block in which nothing was measured."""
        rows, columns, pushes = len(self.channels), self.layout.size + 1, len(self.axes) + PLANE
        count = self.steps // self.together
        line = Line(
            f=jnp.zeros((count, 13, 13 + pushes)),
            h=jnp.zeros((count, rows, 13 + pushes)),
            residual=jnp.zeros((count, rows, columns)),
            dt=jnp.full(count, self.together * self.dt),
            by_plane=jnp.zeros((count, len(self.axes), PLANE)),
            begin=jnp.eye(13, 12),
        )
        nothing = jnp.zeros(()), jnp.zeros((), bool)
        return Windowed(line, jnp.zeros((self.steps, 13)), jnp.zeros((13, columns)), jnp.zeros(12), *nothing)


class Place(NamedTuple):
    """Of a block: where it begins and ends [s], and how many numbers were `seen` in it.

    - `samples`: its own, without those that fill it; `within`: those of its stretch before it.
    """

    begins: float
    ends: float
    seen: int
    samples: int
    within: int


class Begun(NamedTuple):
    """What is expected of a craft: NED [m], quaternion, velocity [m/s, rad/s], and of what pushes it.

    - `push`: the wrench on its axes [N, N m], and the water's velocity to the north and to the east [m/s].
    """

    position: Float[np.ndarray, "3"]
    attitude: Float[np.ndarray, "4"]
    velocity: Float[np.ndarray, "6"]
    push: Float[np.ndarray, " pushes"]

    @property
    def wrench(self) -> Float[np.ndarray, " axes"]:
        return self.push[:-PLANE]

    @property
    def state(self) -> Float[np.ndarray, "13"]:
        return np.concatenate([self.position, self.attitude, self.velocity])

    @property
    def pitch(self) -> float:
        """[rad]."""
        return float(angles_of(Rotation.from_quat(self.attitude, scalar_first=True))[1])


class Seen(NamedTuple):
    """What a block is made of.

    - `t` [s], `commands`, `wrench`: of `Bench.past` rows before it, its own, and one more; `along`: where
      the craft was expected at them.
    - `measured`, `weight`: as of `Windows`; `before`, `known`: as of `Before`.
    """

    t: Float[np.ndarray, " rows"]
    commands: Float[np.ndarray, "rows columns"]
    wrench: Float[np.ndarray, "rows 6"]
    along: Float[np.ndarray, "rows 13"]
    measured: Float[np.ndarray, "steps channels"]
    weight: Float[np.ndarray, "steps channels"]
    begun: Begun
    before: Float[np.ndarray, "late 13"]
    known: Int[np.ndarray, ""]


@compiled
def _linear(kit, affine: Affine, force: Disturbance, seen: Seen, split, together: int) -> Windowed:
    """A block as a linear system about the parameters of `affine`; `kit`: what a `Bench` has of its craft.

    `together`: samples that are taken as one.

    One program from what is seen on: to hand its parts to JAX one by one took as long as itself.
    """
    saturated, start, channels, axes = kit
    alone: Any = jax.tree.map(lambda a: jnp.asarray(a)[None], seen)
    (_, steps, _), (_, rows, _) = alone.measured.shape, alone.along.shape
    dt = jnp.diff(alone.t, append=2 * alone.t[:, -1:] - alone.t[:, -2:-1])
    records = Records(
        t=alone.t,
        dt=dt,
        hold=dt,
        commands=alone.commands,
        wrench=alone.wrench,
        attitude=alone.along[..., 3:7],
        velocity=alone.along[..., 7:],
        segment=jnp.zeros((1, rows), int),
    )
    windows = Windows(
        log=jnp.zeros(1, int),
        step=jnp.arange(rows - 1 - steps, rows - 1)[None],
        measured=alone.measured,
        weight=alone.weight,
        position=alone.begun.position,
        attitude=alone.begun.attitude,
        velocity=alone.begun.velocity,
        before=Before(alone.before, alone.known),
    )
    problem = Problem(
        saturated, records, windows, start, channels, split, apart=False, axes=axes, expected=True
    )
    path = Path(jnp.zeros((1, 12)), alone.begun.push)
    window: Windowed = jax.tree.map(lambda a: a[0], lines(problem, affine, force, path)[0])
    if together == 1:
        return window
    weight = alone.weight[0][:, np.array(channels)]
    return eqx.tree_at(lambda w: w.line, window, averaged(window.line, weight > 0, together))


def averaged(line: Line, seen: Bool[Array, "steps rows"], together: int) -> Line:
    """The line with so many samples in the place of each: of every sensor the mean of what it measured.

    What pushes is the same for all of them. The noise of a mean is of size one again, as a sensor has the
    same in all of them.

    - `seen`: whether a sensor measured anything; rows of others are 0.
    """
    driven, state = line.f.shape[-1], line.f.shape[1]
    f, h, residual, dt, plane, seen = (
        one.reshape(-1, together, *one.shape[1:])
        for one in (line.f, line.h, line.residual, line.dt, line.by_plane, seen)
    )

    def through(f: Array, h: Array) -> tuple[Array, Array]:
        """Where samples lead, and what is measured at each, by the state at the first and what pushes."""

        def step(by, now):
            f, h = now
            return by.at[:state].set(f @ by), h @ by

        by, at = jax.lax.scan(step, jnp.eye(driven), (f, h))
        return by[:state], at

    f, at = jax.vmap(through)(f, h)
    share = seen / jnp.sqrt(jnp.maximum(seen.sum(axis=1, keepdims=True), 1))
    h, residual = (jnp.einsum("gsr,gsrc->grc", share, one) for one in (at, residual))
    return Line(f, h, residual, dt.sum(axis=1), plane[:, 0], line.begin)


def expected(message: Message, force: Disturbance, after: float, z: Float[np.ndarray, " z"]) -> Begun:
    """State where a block ends, and the push so long after [s], by all that was measured until then, at z."""
    state, left = map(np.asarray, _expected(message, force, jnp.asarray(after), jnp.asarray(z)))
    turn = state[3:7] / np.linalg.norm(state[3:7])
    return Begun(state[:3], turn, state[7:], -left)


def swelling(message: Message, force: Disturbance, z: Float[np.ndarray, " z"]) -> Float[np.ndarray, "axes 2"]:
    """The swell that is expected where a block ends, and that a quarter of a turn before (`Swell.out`).

    [N, N m], along the axes of a disturbance that has one.
    """
    assert force.swell is not None
    mean = message.mean @ jnp.append(jnp.asarray(z), 1.0)
    states = -mean[13 + force.places.swell.start : 13 + force.places.swell.stop]
    return np.asarray(force.swell.out(states.reshape(len(force.axes), -1)))


@compiled
def _unlogged(saturated: SaturatedPlant, theta: Array, attitude: Array, logged: Array) -> Array:
    return true_velocity(saturated(theta, jnp.array(0)), attitude, logged)


@compiled
def _expected(message: Message, force: Disturbance, after: Array, z: Array) -> tuple[Array, Array]:
    at = jnp.append(z, 1.0)
    mean, end = message.mean @ at, message.end @ at
    state = end - mean[:13]
    pushes = force.output(by_plane(force.axes, state[3:7]))
    return state, (pushes @ force.after(after, mean[13:, None]))[:, 0]


@compiled
def passed(
    message: Message,
    window: Windowed,
    acts: Float[Array | np.ndarray, " columns"],
    force: Disturbance,
    spread: Float[Array, "12"],
) -> tuple[tuple[Array, Array, Array], Message]:
    """What a block says of z: -2 log p, its slope by half, information; and what it tells the next.

    - `acts`: 0 for columns of z that have not begun in it, of which no trace is left, 1 for all others.
    """
    window = window.told(window.line.residual * acts[None, None], window.end * acts[None])
    information, log_det, message = window.informed(message, force, spread)
    return (information[-1, -1] + log_det, information[:-1, -1], information[:-1, :-1]), message


@compiled
def replayed(
    message: Message,
    every: Windowed,
    acts: Float[Array | np.ndarray, "blocks columns"],
    force: Disturbance,
    spread: Float[Array, "12"],
    first: Int[Array, ""],
    after: Int[Array, ""],
) -> tuple[tuple[Array, Array, Array], Message]:
    """The same of some of many blocks; 0 of all others, which take no time.

    - `first`, `after`: numbers of the first of them, and of the one behind the last.
    """
    count, size = len(every.gap), acts.shape[1] - 1
    nothing = jnp.zeros(count), jnp.zeros((count, size)), jnp.zeros((count, size, size))

    def each(index, so_far):
        said, message = so_far
        window, own = jax.tree.map(lambda a: a[index], (every, acts))
        new, message = passed(message, window, own, force, spread)
        return jax.tree.map(lambda a, b: a.at[index].set(b), said, new), message

    return jax.lax.fori_loop(first, after, each, (nothing, message))
