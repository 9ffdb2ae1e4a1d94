"""Sensors that contradict one another, whatever forces act.

Positions, attitude and velocities belong together by kinematics alone. Where they do not, no force can be
the cause, and no model of forces is needed to see it; a model that follows wrong velocities would only
make the contradiction look like noise.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from .._types import ATTITUDE, CHANNELS
from ..effects import AbstractEffect, Readings, SensorEffect, Suspect, place
from ..fitting import levenberg_marquardt
from ..logs import Log, reachable, resolution
from ..vehicle import Vehicle
from ._score import t_value

# Stretch over which a velocity is read from positions [s]: long against their rounding, short against turns.
SPAN = 1.0
# Stretches that must be there.
FEWEST = 8
# A channel with a sample every few rows is read between them where they are no further apart than this [s].
BRIDGED = 0.3
# Standard errors (over stretches) by which an explanation must help, and nats beyond its parameters.
SIGMAS, MARGIN = 4.0, 10.0
# The residual of some channel must fall below this part: what is smaller is left to the search.
GROSS = 0.5
# Sensors agree where their chi-square beyond the noise is below this share of the noise. If not, they come
# at different times where this part of it is left at another lag, of so many seconds at most; or else they
# contradict one another where a velocity is off by so many standard deviations and by this share of its size.
AGREES, AT_ANOTHER_TIME, LATEST = 0.3, 0.5, 2.0
OFF, SHARE = 5.0, 0.2
# Lags that must be there to tell a time by: a slowly sampled log has fewer.
FEWEST_LAGS = 6
# Refits with each channel weighed by what the last one has left of it.
REFITS = 3


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """Per stretch and sample what positions and attitude say of the motion, and what was logged of it.

    - `rotation` body to world; `nu` [m/s, rad/s]: body velocities of the mean motion over the stretch.
    - `logged`: the mean of each logged velocity over the stretch, NaN where not measured.
    """

    rotation: Float[np.ndarray, "stretches samples 3 3"]
    nu: Float[np.ndarray, "stretches samples 6"]
    logged: Float[np.ndarray, "stretches 6"]


def kinematics(vehicle: Vehicle, logs: Sequence[Log]) -> Kinematics | None:
    """Those of logs, end to end; None where too few stretches have all free positions and angles."""
    rotations, motions, logged = [], [], []
    locked = vehicle.free == 0
    # A boat with surge and yaw goes east as well.
    still = ~np.append(reachable(~locked), ~locked[3:])
    size = max(2, round(SPAN / float(np.median([log.dt for log in logs]))))
    for log in logs:
        channels = _bridged(log)
        poses = np.where(still, 0.0, channels[:, :6])
        for first in range(0, len(log.t) - size, size):
            here = slice(first, first + size + 1)
            span = log.t[first + size] - log.t[first]
            if not np.isfinite(poses[here]).all() or span > 1.5 * size * log.dt:
                continue
            turns = Rotation.from_euler("ZYX", poses[here, :2:-1])
            velocity = turns.inv().apply((poses[here][-1, :3] - poses[here][0, :3]) / span)
            rate = (turns[0].inv() * turns[-1]).as_rotvec() / span
            rotations.append(turns.as_matrix())
            motions.append(np.concatenate([velocity, np.tile(rate, (size + 1, 1))], axis=1))
            logged.append(np.where(locked, np.nan, channels[here, 6:12].mean(axis=0)))
    if len(logged) < FEWEST:
        return None
    return Kinematics(np.array(rotations), np.array(motions), np.array(logged))


def _bridged(log: Log) -> Float[np.ndarray, "times 18"]:
    """The channels, also between samples of one that is measured less often than there are rows."""
    out = np.array(log.channels)
    for name, column in zip(CHANNELS, out.T, strict=True):
        seen = np.flatnonzero(np.isfinite(column))
        if name in ATTITUDE:
            column[seen] = np.unwrap(column[seen])
        rows = np.flatnonzero(np.isnan(column))
        after = np.searchsorted(seen, rows)
        inside = (after > 0) & (after < len(seen))
        rows, after = rows[inside], after[inside]
        near = log.t[seen[after]] - log.t[seen[after - 1]] <= BRIDGED
        if near.any():
            column[rows[near]] = np.interp(log.t[rows[near]], log.t[seen], column[seen])
    return out


def contradiction(
    vehicle: Vehicle, logs: Sequence[Log], suspects: Sequence[Suspect]
) -> tuple[int, dict[str, float]] | None:
    """The place of the suspect that puts grossly contradictory sensors right, and its parameters.

    By the likelihood of the logged velocities given those that positions and attitude show, with each
    channel's scatter unknown. None where the sensors agree, or where not all of them were logged.
    """
    seen = kinematics(vehicle, logs)
    if seen is None or not np.isfinite(seen.logged).any():
        return None
    known = np.isfinite(seen.logged)
    count = np.maximum(known.sum(axis=0), 1)
    best, found = MARGIN, None

    def errors(effect: AbstractEffect):
        assert isinstance(effect, SensorEffect)
        return jnp.where(known, _shown(seen, [effect]) - jnp.nan_to_num(seen.logged), 0.0)

    def misfit(values, args, suspect: Suspect):
        return errors(place(suspect, vehicle, values)) / args[None]

    for i, suspect in enumerate(suspects):
        if not issubclass(suspect.effect, SensorEffect):
            continue
        neutral, _ = jax.flatten_util.ravel_pytree(suspect.effect.neutral(vehicle))
        values = {name: neutral[slots[0]] for name, slots in suspect.slots.items()}
        before = np.asarray(errors(place(suspect, vehicle, values)))
        after, fn = before, functools.partial(misfit, suspect=suspect)
        for _ in range(REFITS):
            starts = {name: value[None] for name, value in values.items()}
            values = levenberg_marquardt(fn, starts, jnp.asarray(_rms(after, count))).best
            after = np.asarray(errors(place(suspect, vehicle, values)))
        scatter, spread = _rms(before, count), _rms(after, count)
        if not np.isfinite(after).all() or (spread / scatter).min() > GROSS:
            continue
        evidence = float((known.sum(axis=0) * np.log(scatter / spread)).sum())
        evidence -= 0.5 * len(values) * np.log(known.sum())
        each = ((before**2 - after**2) / spread**2).sum(axis=1)
        if evidence > best and t_value(each) > SIGMAS:
            best, found = evidence, (i, {name: float(value) for name, value in values.items()})
    return found


def disagreement(vehicle: Vehicle, logs: Sequence[Log], noise: Float[np.ndarray, "18"]) -> str | None:
    """A sentence on velocities that positions and attitude contradict, None where they agree.

    - `vehicle`: with its sensor effects, as found; `noise`: standard deviation of each channel, NaN where
      it was not measured.
    """
    effects = [p.effect for p in vehicle.placed if isinstance(p.effect, SensorEffect) and p.since is None]
    # A file may state less than the steps that a coarse sensor's samples come in.
    columns = np.concatenate([log.channels for log in logs]).T
    noise = np.maximum(noise, [resolution(column[np.isfinite(column)]) for column in columns])

    def apart(logs: Sequence[Log]) -> _Apart:
        return _apart(kinematics(vehicle, logs), effects, logs, noise)

    now = apart(logs)
    if now.excess < AGREES:
        return None
    at = _other_time(lambda which, lag: apart(_moved(logs, which, lag)).excess, logs, now.excess)
    if at is not None:
        what, late = at
        sense = "later" if late > 0 else "earlier"
        return f"The logged {what} about {abs(late):.1g} s {sense} than the velocities."
    bad = np.flatnonzero((now.off > OFF) & (now.share > SHARE))
    if not bad.size:
        return None
    return (
        f"{', '.join(CHANNELS[6 + i] for i in bad)} contradict what positions and attitude show, whatever "
        "forces act: check units, signs and frames of the sensors."
    )


def _other_time(
    excess: Callable[[slice, int], float], logs: Sequence[Log], now: float
) -> tuple[str, float] | None:
    """What comes at another time, and how late [s], if that explains most of what is apart; else None.

    - `excess`: what is apart once some channels are taken so many samples earlier; `now`: as they are.
    """
    dt = float(np.median([log.dt for log in logs]))
    most, step = round(LATEST / dt), max(1, round(SPAN / 10 / dt))
    lags = [lag for lag in range(-most, most + 1, step) if lag]
    if len(lags) < FEWEST_LAGS:
        return None
    kinds = {"positions and attitude come": slice(0, 6), "attitude comes": slice(3, 6)}
    left = {what: [excess(which, lag) for lag in lags] for what, which in kinds.items()}
    what = min(left, key=lambda kind: min(left[kind]))
    best = int(np.argmin(left[what]))
    if left[what][best] >= AT_ANOTHER_TIME * now:
        return None
    # The lowest point of a parabola: the noise moves the least of the lags tried by one or two.
    near = slice(max(best - 4, 0), best + 5)
    bend, slope, _ = np.polyfit(lags[near], left[what][near], 2)
    late = -0.5 * slope / bend * dt if bend > 0 else lags[best] * dt
    return what, float(np.clip(late, -LATEST, LATEST))


def _moved(logs: Sequence[Log], which: slice, lag: int) -> list[Log]:
    """The logs with some of their channels that many samples earlier."""
    out = []
    for log in logs:
        channels = np.array(log.channels)
        channels[:, which] = np.nan
        ahead, here = slice(max(lag, 0), min(lag, 0) or None), slice(max(-lag, 0), min(-lag, 0) or None)
        channels[here, which] = log.channels[ahead, which]
        out.append(dataclasses.replace(log, channels=channels))
    return out


@dataclasses.dataclass(frozen=True)
class _Apart:
    """How far logged velocities are from those shown by positions and attitude.

    - `off`: over the standard deviation of the noise; `share`: over their size.
    - `excess`: chi-square beyond the noise, of all, per number.
    """

    off: Float[np.ndarray, "6"]
    share: Float[np.ndarray, "6"]
    excess: float


def _apart(
    seen: Kinematics | None,
    effects: Sequence[SensorEffect],
    logs: Sequence[Log],
    noise: Float[np.ndarray, "18"],
) -> _Apart:
    if seen is None:
        return _Apart(np.zeros(6), np.zeros(6), 0.0)
    shown = np.asarray(_shown(seen, effects))
    duration = sum(log.duration for log in logs)
    measured = sum(np.isfinite(log.channels[:, 6:12]).sum(axis=0) for log in logs)
    # Of a mean over a stretch, and of the difference of its ends.
    samples = np.maximum(measured * SPAN / duration, 1.0)
    expected = np.sqrt(noise[6:12] ** 2 / samples + 2 * (noise[:6] / SPAN) ** 2)
    known = np.isfinite(seen.logged) & np.isfinite(expected)
    error = np.where(known, seen.logged - shown, 0.0)
    scaled = error / np.where(np.isfinite(expected), expected, 1.0)
    count = np.maximum(known.sum(axis=0), 1)
    return _Apart(
        np.sqrt((scaled**2).sum(axis=0) / count),
        _rms(error, count) / _rms(np.where(known, shown, 0.0), count),
        float((scaled**2).sum() / max(known.sum(), 1)) - 1.0,
    )


def _shown(seen: Kinematics, effects: Sequence[SensorEffect]) -> Float[Array, "stretches 6"]:
    """What velocity sensors with these effects would have logged on average over each stretch."""

    def one(nu, turn):
        readings = Readings(jnp.zeros(3), jnp.zeros(3), nu, jnp.zeros(6))
        for effect in effects:
            readings = effect(readings, turn)
        return readings.nu

    return jax.vmap(jax.vmap(one))(jnp.asarray(seen.nu), jnp.asarray(seen.rotation)).mean(axis=1)


def _rms(errors: Float[np.ndarray, "stretches 6"], count: Int[np.ndarray, "6"]) -> Float[np.ndarray, "6"]:
    return np.maximum(np.sqrt((errors**2).sum(axis=0) / count), 1e-9)
