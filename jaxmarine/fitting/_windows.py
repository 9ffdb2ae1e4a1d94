"""Logs cut into windows, each with an initial state of its own."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import InputError
from .._types import AXES, CHANNELS
from ..logs import Log, StateTrack, alike, quaternions_of, smooth_states
from ..vehicle import Vehicle

# Times from sample to sample after which a log has a gap: more than five samples are missing.
GAP = 5.5
SHORTEST = 4  # samples of a window
# Numbers of what lies in the plane, to the north and to the east: the water's velocity, and a force.
PLANE = 2
PITCH, TURNS = CHANNELS.index("theta"), np.array([CHANNELS.index(name) for name in ("phi", "psi")])


class Records(eqx.Module):
    """The whole logs on one time grid each, padded at the end to a common length.

    - `dt`: from each sample to the next [s]; `hold`: for how long a window goes on after it, which is the
      same but where none spans the gap behind it.
    - `attitude`, `velocity` (body axes), smoothed or as expected: lagged states at a window's start come from
      them.
    """

    t: Float[Array, "logs steps"]
    dt: Float[Array, "logs steps"]
    hold: Float[Array, "logs steps"]
    commands: Float[Array, "logs steps columns"]
    wrench: Float[Array, "logs steps 6"]
    attitude: Float[Array, "logs steps 4"]
    velocity: Float[Array, "logs steps 6"]
    segment: Int[Array, "logs steps"]


def steep(pitch: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
    """Where roll and yaw are not unique, and their errors say nothing: near a pitch [rad] of 90 degrees."""
    return np.abs(np.cos(pitch)) < 0.15


def at_rest(samples: int) -> Float[Array, "samples 13"]:
    """Position, attitude and velocity of a craft that lies at the origin."""
    return jnp.zeros((samples, 13)).at[:, 3].set(1.0)


class Before(eqx.Module):
    """States of a craft before windows begin, which sensors show that are late.

    - `states`: position, attitude, velocity at so many samples, the last one just before a window.
    - `known`: how many of them are, the last ones.
    """

    states: Float[Array, "*windows past 13"]
    known: Int[Array, "*windows"]

    @property
    def last(self) -> "Before":
        """The sample just before a window alone."""
        return Before(self.states[..., -1:, :], jnp.minimum(self.known, 1))


class Trail(eqx.Module):
    """Where a craft was last in the windows so far, which late sensors may show in those to come.

    - `states`: position, attitude, velocity; `known`: how many of them follow each other without a gap, the
      last ones. `log`, `step`: where the last one lies in `Records`.
    """

    states: Float[Array, "past 13"]
    known: Int[Array, ""]
    log: Int[Array, ""]
    step: Int[Array, ""]

    @classmethod
    def nothing(cls, past: int) -> "Trail":
        """Before the first window."""
        none = jnp.array(-1)
        return cls(at_rest(past), jnp.array(0), none, none)

    def then(
        self, records: Records, windows: "Windows", states: Float[Array, "windows steps 13"]
    ) -> tuple[Before, "Trail"]:
        """What was before some windows with such states, and the trail after them."""
        past, steps = len(self.states), windows.step.shape[1]
        along = jnp.concatenate([self.states, states.reshape(-1, 13)])
        log = jnp.concatenate([self.log[None], windows.log])
        last = jnp.concatenate([self.step[None], windows.step[:, -1]])
        follows = (windows.log == log[:-1]) & (windows.step[:, 0] == last[:-1] + 1)
        # Behind the last sample before a gap a hold is shorter than the gap.
        follows &= records.dt[log, last][:-1] == records.hold[log, last][:-1]

        def each(known, follows):
            known = jnp.where(follows, jnp.minimum(known, past), 0)
            return known + steps, known

        after, known = jax.lax.scan(each, self.known, follows)
        before = along[np.arange(windows.count)[:, None] * steps + np.arange(past)]
        return Before(before, known), Trail(
            along[len(along) - past :], jnp.minimum(after, past), log[-1], last[-1]
        )


class Windows(eqx.Module):
    """Stretches of the logs, with what was measured in them.

    - `log`, `step`: where each step of a window lies in `Records`.
    - `measured`, `weight` (1 / standard deviation of the noise, 0 where nothing was measured).
    - `position`, `attitude`, `velocity`: guess of the state at the window's first step.
    - `wrench`, `water` [m/s, north and east]: what is expected to act on the hull, and how the water is
      expected to move, throughout and beside all that the logs know.
    - `before`: where the craft was; None: a late sensor's first line goes on backwards.
    """

    log: Int[Array, " windows"]
    step: Int[Array, "windows steps"]
    measured: Float[Array, "windows steps channels"]
    weight: Float[Array, "windows steps channels"]
    position: Float[Array, "windows 3"]
    attitude: Float[Array, "windows 4"]
    velocity: Float[Array, "windows 6"]
    wrench: Float[Array, "windows 6"] | None = None
    water: Float[Array, "windows 2"] | None = None
    before: Before | None = None

    @property
    def count(self) -> int:
        return self.log.shape[0]


@dataclasses.dataclass(frozen=True)
class Cut:
    """Logs and the windows cut from them: what a fit or a diagnosis works on."""

    logs: tuple[Log, ...]
    records: Records
    windows: Windows
    starts: np.ndarray  # time at which each window starts [s, its log's own time]
    length: float  # of a window [s]
    dof: tuple[str, ...]  # axes that are free
    hold: float  # the longest time from a sample of a window to the next [s]

    @property
    def speeds(self) -> Float[np.ndarray, "6"]:
        """Root mean squares of the velocities with which windows are guessed to begin [m/s, rad/s]."""
        return np.sqrt((np.asarray(self.windows.velocity) ** 2).mean(axis=0))


@dataclasses.dataclass(frozen=True)
class Room:
    """Sizes of the arrays that a program is compiled for, so that logs of other lengths share it."""

    logs: int
    steps: int
    windows: int

    @staticmethod
    def of(records: Records, windows: Windows) -> "Room":
        """Steps and windows rounded up by at most a quarter, or to 1024 and 10."""
        logs, steps = records.t.shape

        def rounded(count: int, least: int) -> int:
            grain = max(least, 2 ** (count.bit_length() - 3))
            return -(-count // grain) * grain

        return Room(logs, rounded(steps, 1024), rounded(windows.count, 10))

    def holds(self, other: "Room") -> bool:
        return self.logs >= other.logs and self.steps >= other.steps and self.windows >= other.windows

    def filled(self, records: Records, windows: Windows) -> tuple[Records, Windows]:
        """The arrays filled up with logs that no window looks at and windows that weigh nothing."""
        # By numpy: jax would compile every operation for every shape.
        records, windows = jax.tree.map(np.asarray, (records, windows))
        logs, steps = records.t.shape
        more = self.steps - steps
        after = records.t[:, -1:] + records.dt[:, -1:] * np.arange(1, more + 1)

        def stretch(a):
            """More rows, and more steps, like the last ones."""
            width = [(0, self.logs - logs), (0, self.steps - a.shape[1])] + [(0, 0)] * (a.ndim - 2)
            return np.pad(a, width, mode="edge")

        # Put in place, not `replace`d: records are JAX's arrays when they are made.
        longer = eqx.tree_at(
            lambda r: r.t, jax.tree.map(stretch, records), stretch(np.concatenate([records.t, after], axis=1))
        )
        again = jax.tree.map(lambda a: np.repeat(a[-1:], self.windows - len(a), axis=0), windows)
        again = eqx.tree_at(lambda w: w.weight, again, np.zeros_like(again.weight))
        more_windows = jax.tree.map(lambda a, b: np.concatenate([a, b]), windows, again)
        return jax.tree.map(jnp.asarray, (longer, more_windows))


def _settled(vehicle: Vehicle, log: Log) -> int:
    """The first sample at which what the actuators were told before the log no longer acts.

    Four lags and the delay, placed effects included, or until masses inside have settled; at most a tenth
    of the log.
    """
    if log.commands is None or not vehicle.command_names:
        return 0
    drive = vehicle.plant().drive
    memory = float(jnp.max(4.0 * drive.lag + drive.delay, initial=0.0))
    if drive.rate is not None:
        # From one end to the other at the limited rate.
        memory += float(jnp.max(2.0 * drive.saturation / drive.rate, initial=0.0))
    memory = max([memory, *(one.settled for one in vehicle.masses)])
    return int(np.searchsorted(log.t, log.t[0] + min(memory, 0.1 * log.duration) - 1e-9))


def cut(
    vehicle: Vehicle,
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    length: float,
    stride: float | None = None,
    segments: Sequence[np.ndarray] | None = None,
    dt: float | None = None,
) -> Cut:
    """Cuts windows of `length` seconds, one every `stride` seconds (default: end to end).

    The first begins where the thrusters have forgotten what they were told before the log. None spans a
    gap of more than five samples or touches a stretch that is left out (`Log.rejected`).

    - `noise`: standard deviation per channel, NaN for those not to be used, as are those beyond.
    - `segments`: per log, per sample, the index of the vehicle's plant that acts there.
    - `dt` [s]: from sample to sample, default the logs' median; that of others too where there are more.
    """
    logs = alike(logs, len(noise))
    noise = np.pad(noise, (0, logs[0].channels.shape[1] - len(noise)), constant_values=np.nan)
    dt = float(np.median([log.dt for log in logs])) if dt is None else dt
    _check_sampling(logs, dt, length)
    size = max(SHORTEST, round(length / dt))
    jump = size if stride is None else max(1, round(stride / dt))
    longest = max(len(log.t) for log in logs)
    records, windows, starts, holds = [], [], [], []
    for g, log in enumerate(logs):
        track = smooth_states(log, vehicle.dof)
        segment = np.zeros(len(log.t), int) if segments is None else segments[g]
        records.append(_recorded(vehicle, log, track, segment, longest, dt))
        begins = _begins(vehicle, log, size, jump, GAP * dt)
        seen = _weighed(vehicle, log, track, noise)
        windows.append(_window_parts(g, begins, size, track, *seen))
        starts.append(log.t[begins])
        holds += [float(records[-1]["hold"][first : first + size].max()) for first in begins]
    if len(holds) < 2:
        names = ", ".join(log.name for log in logs)
        raise InputError(f"{names}: is shorter than two windows of {length:g} s; use a longer log.")
    of_all = {name: np.concatenate([parts[name] for parts in windows]) for name in windows[0]}
    of_all["attitude"] = quaternions_of(of_all["attitude"])
    of_windows: dict[str, Any] = {name: jnp.asarray(values) for name, values in of_all.items()}
    return Cut(
        logs=logs,
        records=Records(
            **{name: jnp.asarray(np.stack([parts[name] for parts in records])) for name in records[0]}
        ),
        windows=Windows(**of_windows),
        starts=np.concatenate(starts),
        length=length,
        dof=vehicle.dof,
        # Stamps of an even log are rounded.
        hold=max(holds) if max(holds) > 1.01 * dt else dt,
    )


def _check_sampling(logs: Sequence[Log], dt: float, length: float) -> None:
    """All about as fast as every `dt` seconds, and that fast enough for windows of this length [s]."""
    for log in logs:
        if not 0.8 < log.dt / dt < 1.25:
            raise InputError(
                f"{log.name}: has a sample every {log.dt:g} s, the others every {dt:g} s; resample it."
            )
    if dt > length / 2:
        raise InputError(
            f"{logs[0].name}: has a sample every {dt:g} s, too few for windows of {length:g} s; give t in "
            "seconds, or take a log that is sampled faster."
        )


def _recorded(
    vehicle: Vehicle, log: Log, track: StateTrack, segment: np.ndarray, longest: int, dt: float
) -> dict[str, np.ndarray]:
    """One log's row of all `Records`, padded to so many samples; `dt` [s]: that of most of them."""
    t, short = log.t, longest - len(log.t)
    steps = np.diff(t, append=2 * t[-1] - t[-2])

    def pad(values):
        return np.pad(values, [(0, short)] + [(0, 0)] * (values.ndim - 1), mode="edge")

    given = log.commanded(vehicle.command_names)
    commands = np.zeros((len(t), len(vehicle.command_names))) if given is None else given
    wrench = np.zeros((len(t), 6)) if log.wrench is None else log.wrench
    return {
        "t": np.concatenate([t, t[-1] + steps[-1] * np.arange(1, short + 1)]),
        "dt": pad(steps),
        "hold": pad(np.where(steps > GAP * dt, dt, steps)),
        "commands": pad(np.asarray(commands)),
        "wrench": pad(np.asarray(wrench)),
        "attitude": pad(quaternions_of(track.attitude)),
        "velocity": pad(track.nu),
        "segment": pad(segment),
    }


def _weighed(
    vehicle: Vehicle, log: Log, track: StateTrack, noise: Float[np.ndarray, " channels"]
) -> tuple[Float[np.ndarray, "times channels"], Float[np.ndarray, "times channels"]]:
    """What was measured (0: nothing, or the axis is locked), and 1 / standard deviation of its noise."""
    free = vehicle.free[np.array(AXES[: len(noise)])].astype(bool)
    usable = np.isfinite(log.channels) & np.isfinite(noise) & free
    weight = np.where(usable, 1.0 / np.where(np.isfinite(noise), noise, 1.0), 0.0)
    weight[np.ix_(steep(track.attitude[:, 1]), TURNS)] = 0.0
    return np.where(usable, log.channels, 0.0), weight


def _begins(vehicle: Vehicle, log: Log, size: int, jump: int, longest: float) -> Int[np.ndarray, " windows"]:
    """The first samples of a log's windows, none of which has a gap of more than `longest` seconds."""

    def sound(first: int) -> bool:
        t = log.t[first : first + size]
        left_out = any(one.start <= t[-1] and t[0] <= one.end for one in log.rejected)
        return float(np.diff(t).max()) <= longest and not left_out

    firsts = range(_settled(vehicle, log), len(log.t) - size + 1, jump)
    return np.array([first for first in firsts if sound(first)], int)


def _window_parts(
    number: int,
    begins: Int[np.ndarray, " windows"],
    size: int,
    track: StateTrack,
    measured: Float[np.ndarray, "times channels"],
    weight: Float[np.ndarray, "times channels"],
) -> dict[str, np.ndarray]:
    """The `Windows` of one log, by its number, their first samples and their size; Euler angles yet."""
    step = begins[:, None] + np.arange(size)
    return {
        "log": np.full(len(begins), number),
        "step": step,
        "measured": measured[step],
        "weight": weight[step],
        "position": track.position[begins],
        "attitude": track.attitude[begins],
        "velocity": track.nu[begins],
    }


def split(data: Cut, parts: int) -> Windows:
    """Each window cut into so many of equal length, in the order of time."""
    windows = data.windows
    count, steps = windows.step.shape
    tracks = [smooth_states(log, data.dof) for log in data.logs]
    log = np.repeat(np.asarray(windows.log), parts)
    step = np.asarray(windows.step).reshape(count * parts, steps // parts)

    def at_start(values: list[np.ndarray]) -> np.ndarray:
        return np.array([values[g][first] for g, first in zip(log, step[:, 0], strict=True)])

    def cut_up(values: Array) -> Array:
        return jnp.asarray(np.asarray(values).reshape(count * parts, steps // parts, -1))

    return Windows(
        log=jnp.asarray(log),
        step=jnp.asarray(step),
        measured=cut_up(windows.measured),
        weight=cut_up(windows.weight),
        position=jnp.asarray(at_start([track.position for track in tracks])),
        attitude=jnp.asarray(quaternions_of(at_start([track.attitude for track in tracks]))),
        velocity=jnp.asarray(at_start([track.nu for track in tracks])),
    )
