"""Sensors that contradict one another, whatever forces act.

Positions, attitude and velocities belong together by kinematics alone. Where they do not, no force can be
the cause, and no model of forces is needed to see it; a model that follows wrong velocities would only
make the contradiction look like noise.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from .._compiled import compiled
from .._types import ALL_CHANNELS, ATTITUDE, MOTION, POSES, RATE
from ..effects import (
    CompassDeviation,
    Readings,
    SensorDelay,
    SensorEffect,
    Suspect,
    place,
)
from ..logs import Log, matrices_of, reachable, resolution
from ..physics import LATE
from ..vehicle import Vehicle
from ._uncertainty import t_value

# Stretch over which a velocity is read from positions [s]: long against their rounding, short against turns.
SPAN = 1.0
# Stretches that must be there.
FEWEST = 8
# A channel with a sample every few rows is read between them where they are no further apart than this [s].
BRIDGED = 0.3
# Standard errors (over stretches) by which an explanation must help, and nats beyond its parameters.
SIGMAS, MARGIN = 4.0, 10.0
# Nats within which two explanations are not told apart (odds of 1 to 20).
CLOSE = 3.0
# The residual of some channel must fall below this part: what is smaller is left to the search.
GROSS = 0.5
# Sensors agree where their chi-square beyond the noise is below this share of the noise. If not, they come
# at different times where this part of it is left at another lag, of so many seconds at most; or else they
# contradict one another where a velocity is off by so many standard deviations and by this share of its size.
AGREES, AT_ANOTHER_TIME, LATEST = 0.3, 0.5, 2.0
OFF, SHARE = 5.0, 0.2
# Lags that must be there to tell a time by: a slowly sampled log has fewer.
FEWEST_LAGS = 6
# Stretches are filled up to a multiple of as many, so that those at other lags share one program.
_GRAIN = 128
# A radian.
_DEGREES = np.rad2deg(1.0)
_ONES = np.ones(6)
# Refits with each channel weighed by what the last one has left of it.
REFITS = 3


@dataclasses.dataclass(frozen=True)
class Kinematics:
    """Per stretch and sample what positions and attitude say of the motion, and what was logged of it.

    - `rotation` body to world; `nu` [m/s, rad/s]: body velocities of the mean motion over the stretch.
    - `logged`: the mean of each logged velocity over the stretch, NaN where not measured.
    - `span` [s]: length of the stretch; `at`: its number, however many before it were not all there.
    """

    rotation: Float[np.ndarray, "stretches samples 3 3"]
    nu: Float[np.ndarray, "stretches samples 6"]
    logged: Float[np.ndarray, "stretches 6"]
    span: Float[np.ndarray, " stretches"]
    at: Int[np.ndarray, " stretches"]


def kinematics(vehicle: Vehicle, logs: Sequence[Log]) -> Kinematics | None:
    """Those of logs, end to end; None where too few stretches have all free positions and angles."""
    parts, locked, before = [], vehicle.free == 0, 0
    # A boat with surge and yaw goes east as well.
    still = ~np.append(reachable(~locked), ~locked[3:])
    size = max(2, round(SPAN / float(np.median([log.dt for log in logs]))))
    for log in logs:
        channels = _bridged(log)
        poses = np.where(still, 0.0, channels[:, POSES])
        there = np.asarray(np.isfinite(poses).all(axis=1))
        turns = matrices_of(np.where(there[:, None], poses, 0.0)[:, 3:])
        rows = np.arange(0, len(log.t) - size, size)[:, None] + np.arange(size + 1)
        span = log.t[rows[:, -1]] - log.t[rows[:, 0]]
        at = np.flatnonzero(there[rows].all(axis=1) & (span <= 1.5 * size * log.dt))
        rows, span = rows[at], span[at]
        over_ground = (poses[rows[:, -1], :3] - poses[rows[:, 0], :3]) / span[:, None]
        velocity = np.einsum("sabc,sb->sac", turns[rows], over_ground)
        turned = np.swapaxes(turns[rows[:, 0]], 1, 2) @ turns[rows[:, -1]]
        rate = Rotation.from_matrix(turned).as_rotvec() / span[:, None] if len(at) else np.zeros((0, 3))
        nu = np.concatenate([velocity, np.repeat(rate[:, None], size + 1, axis=1)], axis=2)
        logged = np.where(locked, np.nan, channels[rows, MOTION].mean(axis=1))
        parts.append((turns[rows], nu, logged, span, before + at))
        before += len(log.t)
    if sum(len(at) for *_, at in parts) < FEWEST:
        return None
    return Kinematics(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _bridged(log: Log) -> Float[np.ndarray, "times channels"]:
    """The channels, also between samples of one that is measured less often than there are rows."""
    out = np.array(log.channels)
    for name, column in zip(ALL_CHANNELS[: out.shape[1]], out.T, strict=True):
        known = np.isfinite(column)
        seen, rows = np.flatnonzero(known), np.flatnonzero(~known)
        if name in ATTITUDE:
            column[seen] = np.unwrap(column[seen])
        if not len(seen) or not len(rows):
            continue
        after = np.searchsorted(seen, rows)
        inside = (after > 0) & (after < len(seen))
        rows, after = rows[inside], after[inside]
        near = log.t[seen[after]] - log.t[seen[after - 1]] <= BRIDGED
        if near.any():
            column[rows[near]] = np.interp(log.t[rows[near]], log.t[seen], column[seen])
    return out


class Contradiction(NamedTuple):
    """What puts contradictory sensors right.

    - `suspect`: its place among those that were asked for; `values`: its parameters.
    - `evidence` [nats]: by which the logged velocities prefer it.
    """

    suspect: int
    values: dict[str, float]
    evidence: float


def contradiction(vehicle: Vehicle, logs: Sequence[Log], suspects: Sequence[Suspect]) -> Contradiction | None:
    """The suspect that puts contradictory sensors right.

    By the likelihood of the logged velocities given those that positions and attitude show, with each
    channel's scatter unknown. None where the sensors agree, where they hardly do not (but for a compass that
    deviates and a sensor that is late, which leave velocities nearly as they are), or where not all of them
    were logged.
    """
    seen = kinematics(vehicle, logs)
    if seen is None or not np.isfinite(seen.logged).any():
        return None
    found = []
    for i, suspect in enumerate(suspects):
        if issubclass(suspect.effect, SensorDelay):
            put_right = _in_time(vehicle, logs, seen, str(suspect.target))
        elif issubclass(suspect.effect, SensorEffect):
            put_right = _refitted(vehicle, seen, suspect)
        else:
            continue
        if put_right is None:
            continue
        values, before, after = put_right
        case = _weighed(before, after, len(values))
        if case is None:
            continue
        small = issubclass(suspect.effect, CompassDeviation | SensorDelay)
        if small or case.left < GROSS:
            found.append(Contradiction(i, values, case.evidence))
    return max(found, key=lambda one: one.evidence, default=None)


PutRight = tuple[dict[str, float], Float[np.ndarray, "stretches 6"], Float[np.ndarray, "stretches 6"]]


def _refitted(vehicle: Vehicle, seen: Kinematics, suspect: Suspect) -> PutRight:
    """A suspect's parameters that explain the logged velocities best, and the errors without and with it."""
    known = np.isfinite(seen.logged)
    count = np.maximum(known.sum(axis=0), 1)
    neutral = jax.flatten_util.ravel_pytree(suspect.effect.neutral(vehicle))[0]
    names = list(suspect.slots)

    def errors(values: np.ndarray) -> np.ndarray:
        effect = place(suspect, vehicle, dict(zip(names, values, strict=True)))
        assert isinstance(effect, SensorEffect)
        return np.where(known, np.nan_to_num(seen.logged) - np.asarray(_shown(seen, [effect])), 0.0)

    values = np.array([neutral[slots[0]] for slots in suspect.slots.values()])
    before = after = errors(values)
    for _ in range(REFITS):
        spread = _rms(after, count)
        values = least_squares(lambda x, spread=spread: (errors(x) / spread).ravel(), values).x
        after = errors(values)
    found = dict(zip(names, values.tolist(), strict=True))
    return found, np.where(known, before, np.nan), np.where(known, after, np.nan)


def _in_time(vehicle: Vehicle, logs: Sequence[Log], seen: Kinematics, kind: str) -> PutRight | None:
    """The delay of a kind of sensor that explains the logged velocities best, and the errors likewise."""
    dt = float(np.median([log.dt for log in logs]))
    which = slice(3 * LATE.index(kind), 3 * LATE.index(kind) + 3)
    lags = np.arange(0, round(LATEST / dt) + 1, max(1, round(SPAN / 10 / dt)))
    if len(lags) < FEWEST_LAGS:
        return None
    moved = [kinematics(vehicle, _moved(logs, which, int(lag))) for lag in lags]
    pairs = [_alike(_logged_errors(seen), seen, one) for one in moved if one is not None]
    if len(pairs) < len(lags):
        return None
    known = [np.isfinite(after) for _, after in pairs]
    spreads = [
        _rms(np.nan_to_num(e), np.maximum(k.sum(axis=0), 1)) for (_, e), k in zip(pairs, known, strict=True)
    ]
    left = [(np.log(spread) * k.any(axis=0)).sum() for spread, k in zip(spreads, known, strict=True)]
    best = int(np.argmin(left))
    if not 0 < best < len(lags) - 1:
        return None
    near = slice(best - 1, best + 2)
    bend, slope, _ = np.polyfit(lags[near] * dt, left[near], 2)
    return {"delay": float(-0.5 * slope / bend)}, *pairs[best]


def _alike(
    before: Float[np.ndarray, "stretches 6"], seen: Kinematics, other: Kinematics, factor: np.ndarray = _ONES
) -> tuple[Float[np.ndarray, "_ 6"], Float[np.ndarray, "_ 6"]]:
    """Errors in stretches that are there both as logged and in another reading of the log."""
    _, own, there = np.intersect1d(seen.at, other.at, return_indices=True)
    return before[own], _logged_errors(other, factor)[there]


class _Case(NamedTuple):
    """Nats by which errors after are more likely than before; the least share of a channel's that is left."""

    evidence: float
    left: float


def _weighed(
    before: Float[np.ndarray, "stretches 6"], after: Float[np.ndarray, "stretches 6"], parameters: int
) -> _Case | None:
    """Errors of logged velocities without and with an explanation, NaN where not measured.

    None where it does not help for sure: on stretches in general, and by more than its parameters cost.
    """
    known = np.isfinite(before) & np.isfinite(after)
    before, after = np.where(known, before, 0.0), np.where(known, after, 0.0)
    count = np.maximum(known.sum(axis=0), 1)
    scatter, spread = _rms(before, count), _rms(after, count)
    if not np.isfinite(after).all():
        return None
    evidence = float((known.sum(axis=0) * np.log(scatter / spread)).sum())
    evidence -= 0.5 * parameters * np.log(known.sum())
    each = ((before**2 - after**2) / spread**2).sum(axis=1)
    if evidence <= MARGIN or t_value(each) <= SIGMAS:
        return None
    return _Case(evidence, float((spread / scatter).min()))


def _logged_errors(
    seen: Kinematics, factor: Float[np.ndarray, "6"] = _ONES
) -> Float[np.ndarray, "stretches 6"]:
    """By how much the logged velocities are off from those shown, times a factor; NaN where not measured."""
    return seen.logged - seen.nu.mean(axis=1) * factor


def _misreadings() -> list[tuple[str, Callable[[np.ndarray], np.ndarray], Float[np.ndarray, "6"]]]:
    """What logs are commonly misread by: in words, what mends the channels, a factor of shown velocities."""

    def same(channels: np.ndarray) -> np.ndarray:
        return channels

    def times(columns: list[int], factor: float) -> Callable[[np.ndarray], np.ndarray]:
        def mended(channels: np.ndarray) -> np.ndarray:
            out = channels.copy()
            out[:, columns] *= factor
            return out

        return mended

    def exchanged(channels: np.ndarray) -> np.ndarray:
        return channels[:, [1, 0, *range(2, channels.shape[1])]]

    one, eye = _ONES, np.eye(6)
    wrong = "has the wrong sign"
    out = [(f"{ALL_CHANNELS[MOTION][i]} {wrong}", same, one - 2 * eye[i]) for i in range(6)]
    out += [(f"{ALL_CHANNELS[i]} {wrong}", times([i], -1.0), one) for i in range(6)]
    # Rates of Euler angles have their signs together.
    out += [
        (f"{angle} and {rate} have the wrong sign", times([3 + i], -1.0), one - 2 * eye[3 + i])
        for i, (angle, rate) in enumerate(zip(ATTITUDE, RATE, strict=True))
    ]
    rates = one + (_DEGREES - 1) * eye[3:].sum(axis=0)
    out += [
        ("x and y are exchanged (east before north)", exchanged, one),
        ("the angles are in degrees", times([3, 4, 5], 1 / _DEGREES), one),
        ("psi is in degrees", times([5], 1 / _DEGREES), one),
        ("the rates are in degrees per second", same, rates),
        ("angles and rates are in degrees", times([3, 4, 5], 1 / _DEGREES), rates),
    ]
    return out


def misread(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[str, float] | None:
    """What positions, attitude and velocities say was misread, in words, and its evidence [nats].

    Signs, degrees and exchanged axes, whatever forces act; those that explain as much are named as well. None
    where no such mistake makes the sensors agree better for sure, and halves what some channel is off by.
    """
    seen = kinematics(vehicle, logs)
    if seen is None or not np.isfinite(seen.logged).any():
        return None
    before, found = _logged_errors(seen), []
    for words, mend, factor in _misreadings():
        own = [dataclasses.replace(log, channels=mend(log.channels)) for log in logs]
        mended = kinematics(vehicle, own)
        if mended is None:
            continue
        case = _weighed(*_alike(before, seen, mended, factor), 1)
        if case is not None and case.left < GROSS:
            found.append((words, case.evidence))
    if not found:
        return None
    best = max(evidence for _, evidence in found)
    return ", or ".join(words for words, evidence in found if best - evidence < CLOSE), best


def disagreement(vehicle: Vehicle, logs: Sequence[Log], noise: Float[np.ndarray, " channels"]) -> str | None:
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
        f"{', '.join(ALL_CHANNELS[MOTION][i] for i in bad)} contradict what positions and attitude show, "
        "whatever forces act: check units, signs and frames of the sensors."
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
    noise: Float[np.ndarray, " channels"],
) -> _Apart:
    if seen is None:
        return _Apart(np.zeros(6), np.zeros(6), 0.0)
    shown = _shown(seen, effects)
    duration = sum(log.duration for log in logs)
    measured = sum(np.isfinite(log.channels[:, MOTION]).sum(axis=0) for log in logs)
    # Of a mean over a stretch, and of the difference of its ends.
    samples = np.maximum(measured * SPAN / duration, 1.0)
    expected = np.sqrt(noise[MOTION] ** 2 / samples + 2 * (noise[POSES] / SPAN) ** 2)
    known = np.isfinite(seen.logged) & np.isfinite(expected)
    error = np.where(known, seen.logged - shown, 0.0)
    scaled = error / np.where(np.isfinite(expected), expected, 1.0)
    count = np.maximum(known.sum(axis=0), 1)
    return _Apart(
        np.sqrt((scaled**2).sum(axis=0) / count),
        _rms(error, count) / _rms(np.where(known, shown, 0.0), count),
        float((scaled**2).sum() / max(known.sum(), 1)) - 1.0,
    )


def _shown(seen: Kinematics, effects: Sequence[SensorEffect]) -> Float[np.ndarray, "stretches 6"]:
    """What velocity sensors with these effects would have logged on average over each stretch."""
    count = len(seen.span)
    more = -count % _GRAIN
    filled = [
        np.pad(a, [(0, more)] + [(0, 0)] * (a.ndim - 1), mode="edge")
        for a in (seen.rotation, seen.nu, seen.span)
    ]
    return np.asarray(_sensed(tuple(effects), *filled))[:count]


@compiled
def _sensed(effects: tuple[SensorEffect, ...], rotation, nu, span):
    for effect in effects:
        if isinstance(effect, CompassDeviation):
            rotation, nu = _by_true_heading(rotation, nu, span, effect)

    def one(nu, turn):
        readings = Readings(jnp.zeros(3), jnp.zeros(3), nu, jnp.zeros(6))
        for effect in effects:
            readings = effect(readings, turn)
        return readings.nu

    return jax.vmap(jax.vmap(one))(nu, rotation).mean(axis=1)


def _by_true_heading(rotation, nu, span, compass: CompassDeviation):
    """Rotations and motions as they are where the heading, from which they were read, deviates."""
    logged = jnp.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    off = jnp.zeros_like(logged)
    # The deviation goes by the true heading; it changes by less than itself, so that this converges.
    for _ in range(4):
        psi = logged - off
        off = compass.constant + compass.cos * jnp.cos(psi) + compass.sin * jnp.sin(psi)
    c, s, zero = jnp.cos(off), jnp.sin(off), jnp.zeros_like(off)
    back = jnp.stack(
        [jnp.stack([c, s, zero], -1), jnp.stack([-s, c, zero], -1), jnp.stack([zero, zero, zero + 1.0], -1)],
        -2,
    )
    true = back @ rotation
    over_ground = jnp.einsum("sabc,sac->sab", rotation, nu[..., :3])
    velocity = jnp.einsum("sabc,sab->sac", true, over_ground)
    # The logged heading turned by this much more than the true one.
    more = (off[:, -1] - off[:, 0]) / span
    rate = nu[..., 3:] - true[..., 2, :] * more[:, None, None]
    return true, jnp.concatenate([velocity, rate], axis=-1)


def _rms(errors: Float[np.ndarray, "stretches 6"], count: Int[np.ndarray, "6"]) -> Float[np.ndarray, "6"]:
    return np.maximum(np.sqrt((errors**2).sum(axis=0) / count), 1e-9)
