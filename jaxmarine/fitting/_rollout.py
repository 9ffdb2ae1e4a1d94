"""Windows rolled out: from parameters and initial states to what the sensors show.

Each segment of the logs has a plant of its own, each hold of a log its thrust, and each window the state
that it begins in. A prediction simulates the fluid memory with the rest of the state; a linearisation
follows the memory that the motion of the records drives.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._angles import ANGLES, wrap_to_pi
from .._compiled import compiled
from .._types import JUMPS, MOTION
from ..physics import Drive, Late, Thrust, delayed, lagging, late
from ..simulation import hold
from ..vehicle import Input, Plant, State
from ._parts import in_parts, joined, part_of
from ._windows import Records, Windows

# Standard deviation of the prior on a window's initial state [m, rad, m/s, rad/s]. The loose one only
# keeps the elimination regular where a component was not measured; the tight one holds locked axes.
LOOSE, TIGHT = 1e3, 1e-6
# A window begins no farther from the velocity that was guessed than so many times the root mean square of the
# log's: at rest that is the scatter of the guess itself, which must not hold it.
SWIFT = 3.0

# Windows that are rolled out together at most, so that memory hardly grows with the length of the logs.
CHUNK = 640
# Samples of a log that are looked at together.
BLOCK = 512

# Sensors that show less of a velocity than this share of it do not tell what it was.
LEAST_SHOWN = 1e-3

PlantOf = Callable[[Float[Array, " parameters"], Array], Plant]


class Problem(eqx.Module):
    """Residuals of windows as a function of parameters.

    - `plant_of(theta, segment)`: the plant of a segment from its parameter vector.
    - `start_precision`: inverse variance of the prior on a window's initial state (`start_precision`).
    - `channels`: those that are measured in any window (`measured_channels`); the others have no rows.
    - `split`: integration steps per sample, for a stiff vehicle (`simulation.substeps`).
    - `apart`: whether the information of each window is kept, as the scatter of a fit asks for, or their sum.
    - `axes`: those that can move.
    - `trail`: samples before a window that late sensors show as the windows before it have them; 0: as each
      window's `before` has them, or, without, as its first line goes on backwards. Predictions do the latter.
    - `expected`: the records' motion is what was expected of the craft, and not what sensors showed.
    """

    plant_of: PlantOf
    records: Records
    windows: Windows
    start_precision: Float[Array, "12"]
    channels: tuple[int, ...] = eqx.field(static=True)
    split: int | Int[Array, ""] = 1
    apart: bool = eqx.field(static=True, default=True)
    axes: tuple[int, ...] = eqx.field(static=True, default=tuple(range(6)))
    trail: int = eqx.field(static=True, default=0)
    expected: bool = eqx.field(static=True, default=False)

    @property
    def accelerations(self) -> bool:
        """Whether any are measured, or what only they tell."""
        return any(JUMPS[channel] for channel in self.channels)

    @property
    def width(self) -> int:
        """How many channels the windows have a place for."""
        return self.windows.measured.shape[-1]


def measured_channels(windows: Windows) -> tuple[int, ...]:
    """The channels that are measured in any of the windows."""
    return tuple(np.flatnonzero((np.asarray(windows.weight) > 0).any(axis=(0, 1))).tolist())


def start_precision(
    free: Float[np.ndarray, "6"], speeds: Float[np.ndarray, "6"] | None = None
) -> Float[np.ndarray, "12"]:
    """Inverse variance of the prior on the initial state, for free (1) and locked (0) axes.

    - `speeds`: root mean squares of the craft's velocities [m/s, rad/s]: where no sensor holds it, a window
      begins no farther than `SWIFT` times that from the velocity that was guessed.
    """
    surge, sway, heave, roll, pitch, yaw = free
    level = max(surge, sway)
    moves = [level, level, max(heave, level * max(roll, pitch)), roll, pitch, yaw, *free]
    loose = np.full(12, LOOSE)
    if speeds is not None:
        loose[6:] = np.where(speeds > TIGHT, np.minimum(SWIFT * speeds, LOOSE), LOOSE)
    return np.where(np.array(moves) > 0, loose, TIGHT) ** -2.0


def wrapped(error: Float[Array | np.ndarray, "*steps channels"]) -> Array:
    """Differences of channels, those of angles the short way round."""
    return jnp.where(ANGLES[: error.shape[-1]], wrap_to_pi(jnp.asarray(error)), error)


def of_segment(tree, index):
    """One segment's part of what is stacked along segments.

    With a single segment the index is not looked at: under `vmap` a gather would give every step a
    copy of its own, and products with shared matrices would become batched ones.
    """
    if jax.tree.leaves(tree)[0].shape[0] == 1:
        return jax.tree.map(lambda a: a[0], tree)
    return jax.tree.map(lambda a: a[index], tree)


def late_of(problem: Problem, drives: Drive) -> Late:
    """The commands that act in all logs, for the drive constants of each segment."""
    records = problem.records

    def one(t, commands, segment):
        return delayed(t, commands, jnp.broadcast_to(of_segment(drives.delay, segment), commands.shape))

    thrusters = drives.max_thrust.shape[-1]
    return jax.vmap(one)(records.t, records.commands[..., :thrusters], records.segment)


def thrust_of(problem: Problem, drives: Drive, late: Late) -> Thrust:
    """Thrust over each hold and at each sample of all logs, for the drive constants of each segment."""

    def one(late, t, segment):
        here = of_segment(drives, segment)
        return lagging(jax.tree.map(lambda a: jnp.broadcast_to(a, late.mean.shape), here), late, t)

    return jax.vmap(one)(late, problem.records.t, problem.records.segment)


def moves_of(problem: Problem, plants: Plant) -> tuple[Any, ...] | None:
    """The motion of masses inside over each hold of all logs; their servos are the same in all segments."""
    plant = jax.tree.map(lambda a: a[0], plants)
    if not plant.masses:
        return None
    return jax.vmap(plant.moves)(problem.records.t, problem.records.commands)


def _inverse(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """By cofactors, which unlike a factorisation is done for all samples at once; finite for any matrix."""
    cofactors = jnp.cross(jnp.roll(a, -1, 1), jnp.roll(a, -2, 1), axis=0)
    determinant = (a[:, 0] * cofactors[:, 0]).sum()
    return cofactors.T * determinant / (determinant**2 + LEAST_SHOWN**6)


def true_velocity(plant: Plant, attitude: Float[Array, "4"], logged: Float[Array, "6"]) -> Float[Array, "6"]:
    """The velocity [m/s, rad/s] that sensors show as logged: they are affine, and rates show no speeds.

    - `attitude`: quaternion.
    """

    def shown(nu):
        state = State(jnp.zeros(3), attitude, nu, jnp.zeros(0))
        return plant.readings(state, jnp.zeros(6))[MOTION]

    slope = jax.jacfwd(shown)(jnp.zeros(6))
    rest = logged - shown(jnp.zeros(6))
    rates = _inverse(slope[3:, 3:]) @ rest[3:]
    return jnp.concatenate([_inverse(slope[:3, :3]) @ (rest[:3] - slope[:3, 3:] @ rates), rates])


def fluid_memory(problem: Problem, plants: Plant, asked: Bool[Array, ""] | bool = True):
    """Fluid memory of the logged motion and its slope per lag, each [logs, steps, memory] as `State.memory`.

    The smoothed log drives it, without the errors that the plants' sensors have put into its velocity, or the
    motion that was expected. Zeros where it is not `asked` for, as it pushes nothing and nobody wants its
    slopes.
    """
    records = problem.records
    if not plants.has_memory:
        nothing = jnp.zeros((*records.t.shape, 0))
        return nothing, nothing
    lags = jax.vmap(lambda plant: plant.memory_lag())(plants)

    def through_water(attitude, logged, segment):
        plant = of_segment(plants, segment)
        own = logged if problem.expected else true_velocity(plant, attitude, logged)
        return plant.relative(attitude, own)

    def then(first, second):
        """Two affine maps after one another."""
        return second[0] * first[0], second[0] * first[1] + second[1]

    def filtered(relative, lags):
        def one(dt, velocity, segment):
            kept = jnp.exp(-dt[:-1, None] / lags[segment[:-1]])
            between = 0.5 * (velocity[:-1] + velocity[1:])
            # All samples of a log at once: one after another they took a fifth of a linearisation.
            of_start, rest = jax.lax.associative_scan(then, (kept, (1 - kept) * between))
            return jnp.concatenate([velocity[:1], of_start * velocity[:1] + rest])

        return jax.vmap(one)(records.dt, relative, records.segment)

    def driven():
        # Taken as measured: what a change of the current does to the past of a window is left out.
        logged = jax.tree.map(
            lambda a: in_parts(a.reshape(-1, *a.shape[2:]), BLOCK),
            (records.attitude, records.velocity, records.segment),
        )
        relative = jax.lax.map(lambda block: jax.vmap(through_water)(*block), logged)
        relative = joined(relative, records.t.size).reshape(*records.t.shape, 6)
        of_lags = functools.partial(filtered, plants.for_each_memory(jax.lax.stop_gradient(relative)))
        return jax.jvp(of_lags, (lags,), (jnp.ones_like(lags),))

    nothing = jnp.zeros((*records.t.shape, lags.shape[1]))
    return jax.lax.cond(asked, driven, lambda: (nothing, nothing))


class Track(eqx.Module):
    """What drives one window, step by step: inputs, fluid memory, segment and length of the hold."""

    over: Input  # over the hold
    instant: Input  # at the sample
    lagged: Array
    segment: Array
    dt: Array


def tracks_of(
    problem: Problem, windows: Windows, push: Thrust, moving: tuple[Any, ...] | None, lagged
) -> Track:
    """The tracks of some windows, stacked; thrust, masses inside and fluid memory are of all logs."""
    records, log, step = problem.records, windows.log[:, None], windows.step
    t, dt = records.t[log, step], records.hold[log, step]
    commands = records.commands[log, step, : push.mean.shape[-1]]
    wrench = records.wrench[log, step]
    common = (commands, wrench if windows.wrench is None else wrench + windows.wrench[:, None], t)
    moving = jax.tree.map(lambda a: a[log, step], moving)
    water = None
    if windows.water is not None:
        level = jnp.pad(windows.water, ((0, 0), (0, 1)))
        water = jnp.broadcast_to(level[:, None], (*step.shape, 3))
    return Track(
        over=Input(push.mean[log, step], *common, push.slope[log, step], t + 0.5 * dt, moving, water),
        instant=Input(push.instant[log, step], *common, moving=moving, water=water),
        lagged=lagged[log, step],
        segment=records.segment[log, step],
        dt=dt,
    )


def start_of(windows: Windows, delta: Float[Array, "12"], memory) -> State:
    """The first state of one window, moved by `delta`."""
    return State(windows.position, windows.attitude, windows.velocity, memory).moved(delta)


@eqx.filter_jit
def _held(plants: Plant, segment, state: State, over: Input, dt, split) -> State:
    """Part of the caller's program; by itself it is traced once for all of them."""
    return hold(of_segment(plants, segment), state, over, dt, split)


def roll_out(problem: Problem, plants: Plant, track: Track, start: State, follow: bool):
    """States at all steps of one window, the first included, and at the ends of all holds.

    - `follow`: the fluid memory at the start of each hold is that of the track (filtered from measured
      velocity) instead of the simulated one.
    """

    def step(state, now):
        if follow:
            state = eqx.tree_at(lambda s: s.memory, state, now.lagged)
        after = _held(plants, now.segment, state, now.over, now.dt, problem.split)
        return after, (state, after)

    return jax.lax.scan(step, start, track)[1]


@compiled
def predict(problem: Problem, theta, delta):
    """Predicted channels of every window [windows, steps, channels] and the residuals, weighted.

    - `theta` [segments, parameters]; `delta` [windows, 12]: changes of the initial states (`State.moved`).
    """
    plants = jax.vmap(problem.plant_of)(theta, jnp.arange(theta.shape[0]))
    push = thrust_of(problem, plants.drive, late_of(problem, plants.drive))
    moving = moves_of(problem, plants)
    lagged = fluid_memory(problem, plants)[0]

    def one(windows, track, delta):
        states, _ = roll_out(problem, plants, track, start_of(windows, delta, track.lagged[0]), follow=False)

        def show(state, drive, segment):
            plant = of_segment(plants, segment)
            nu_dot = plant.acceleration(state, drive)
            return plant.amid(drive.water).readings(state, nu_dot, problem.width)

        shown = jax.vmap(show)(states, track.instant, track.segment)
        if plants.delay is None:
            return shown
        return late(track.instant.t, shown, plants.delay[track.segment])

    def some(index):
        here, moved = jax.tree.map(lambda a: a[index], (problem.windows, delta))
        return jax.vmap(one)(here, tracks_of(problem, here, push, moving, lagged), moved)

    windows, count = problem.windows, problem.windows.count
    channels = jax.lax.map(some, in_parts(jnp.arange(count), part_of(count, CHUNK)))
    channels = joined(channels, count)
    return channels, wrapped(channels - windows.measured) * windows.weight
