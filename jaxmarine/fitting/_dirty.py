"""Stretches of a log in which something acted that is no property of the vehicle, named and left out.

Only what is brief, rare and extreme against the rest of its log goes: an effect that begins and stays, a
disturbance that goes on and what a wrong vehicle file misses everywhere are for the diagnosis to find.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .._compiled import compiled
from ..logs import Log, StateTrack, smooth_states
from ..physics import from_euler
from ..vehicle import Input, Plant, State, Vehicle
from ._driven import commanded

# Half of the time over which an acceleration is read [s].
_HALF = 0.25
# A collision: a force beyond that of all thrusters on its axis by this factor (on an axis that they hardly
# push: of this share of the axis of its kind that they push most); so many standard deviations (by the
# median) from that of the commands, and so many times what all but a thirtieth of the log has.
_BEYOND, _SHARE, _SIGMAS, _REST, _USUAL = 1.5, 0.5, 8.0, 3.0, 29 / 30
# At the surface: within so many metres of a least depth of about zero, in a log mostly deeper than that.
_AT_SURFACE, _ZERO, _DEEP = 0.1, 0.2, 0.4
# A take-over: over this time [s], of what the commands change the motion shows less than the first share, and
# at other times (nine in ten) more than the second, where they change by so much of the most that they can.
_OVER, _FOLLOWS_NOT, _FOLLOWS, _CHANGES = 3.0, 0.3, 0.6, 0.1
# Nearer to each other than this (take-overs: than the time above) is one stretch [s], which is widened by
# this on either side [s].
_ONE, _MARGIN = 1.0, 0.5
# How long one lasts at most [s], how many there are at most per minute, and the most of the log that they
# take up.
_MOST = {
    "collision": (1.2, 1.0, 0.05),
    "surfacing": (np.inf, 3.0, 0.2),
    "take-over": (30.0, 1.0, 0.15),
}

Reason = Literal["collision", "surfacing", "take-over"]
_WORDS = {
    "collision": "it moves as no thrust explains",
    "surfacing": "it is held at the surface, where its buoyancy is cut",
    "take-over": "it does not follow the commands, as where a pilot takes over",
}


@dataclasses.dataclass(frozen=True)
class Rejected:
    """A stretch of a log that is left out, from `start` until `end` [s, the log's own time], and why."""

    log: str
    start: float
    end: float
    reason: Reason

    def __str__(self) -> str:
        return (
            f"{self.log}: t = {self.start:.1f} s to {self.end:.1f} s is left out ({self.reason}: "
            f"{_WORDS[self.reason]})."
        )


def without_dirt(vehicle: Vehicle, log: Log) -> tuple[Log, tuple[Rejected, ...], list[str]]:
    """The log without its dirty stretches, these, and sentences on them.

    Nothing is measured there any more, so that no window spans them (`cut`). A log without any comes back
    as it is. Where more looks like it than can be an accident, nothing goes, and a sentence says so.
    """
    if log.duration < 10 * _OVER or log.dt > 2 * _HALF:
        return log, (), []
    track = smooth_states(log, vehicle.dof)
    needed, given = _needed(vehicle, track), _mean(log.t, commanded(vehicle, log))
    able = _able(vehicle, log)
    # beside what is missing no acceleration can be read
    gone = (~np.isfinite(log.channels).any(axis=1)).astype(float)
    read = np.convolve(gone, np.ones(2 * round(4 * _HALF / log.dt) + 1), "same") < 0.5
    rejected, notes = [], []
    looks: dict[Reason, Bool[np.ndarray, " times"]] = {
        "collision": _collision(needed, needed - given, able),
        "surfacing": _surfacing(log, track, (needed - given)[:, 2], vehicle.free[2] > 0),
        "take-over": _take_over(log, needed, given, able, read),
    }
    for reason, bad in looks.items():
        spans = _spans(log, bad & read, _OVER if reason == "take-over" else _ONE)
        longest, most, share = _MOST[reason]
        lasts = [end - start for start, end in spans]
        if not spans:
            continue
        if (
            max(lasts) > longest + 2 * _MARGIN
            or len(spans) > most * log.duration / 60
            or sum(lasts) > share * log.duration
        ):
            notes.append(
                f"{log.name}: {len(spans)} stretches of {sum(lasts):.3g} s in all look like {reason} "
                f"({_WORDS[reason]}), which is too much for an accident; nothing is left out."
            )
            continue
        rejected += [Rejected(log.name, start, end, reason) for start, end in spans]
    if not rejected:
        return log, (), notes
    rejected.sort(key=lambda one: one.start)
    channels = log.channels.copy()
    for one in rejected:
        channels[(log.t >= one.start) & (log.t <= one.end)] = np.nan
    return dataclasses.replace(log, channels=channels), tuple(rejected), [*map(str, rejected), *notes]


@compiled
def _balance(plant: Plant, position, attitude, nu, nu_dot, t):
    def one(position, attitude, nu, nu_dot, t):
        state = State(position, from_euler(attitude), nu, jnp.zeros(6 if plant.has_memory else 0))
        still = jnp.zeros(plant.allocation.shape[1])
        return plant.balance(state, nu_dot, Input(still, still, jnp.zeros(6), t))

    return jax.vmap(one)(position, attitude, nu, nu_dot, t)


def _needed(vehicle: Vehicle, track: StateTrack) -> Float[np.ndarray, "times 6"]:
    """The control wrench that the motion would take, zero on locked axes."""
    t, width = track.t, 2 * _HALF
    ahead = np.stack([np.interp(t + _HALF, t, one) for one in track.nu.T], axis=1)
    behind = np.stack([np.interp(t - _HALF, t, one) for one in track.nu.T], axis=1)
    arrays = (track.position, track.attitude, track.nu, (ahead - behind) / width, t)
    return np.asarray(_balance(vehicle.plant(), *map(jnp.asarray, arrays))) * vehicle.free


def _mean(t: np.ndarray, held: Float[np.ndarray, "times 6"]) -> Float[np.ndarray, "times 6"]:
    """What holds from sample to sample, averaged over the time in which an acceleration is read."""
    steps = np.diff(t)[:, None] * held[:-1]
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(steps, axis=0)])
    low, high = np.maximum(t - _HALF, t[0]), np.minimum(t + _HALF, t[-1])
    impulse = np.stack([np.interp(high, t, one) - np.interp(low, t, one) for one in total.T], axis=1)
    return impulse / (high - low)[:, None]


def _able(vehicle: Vehicle, log: Log) -> Float[np.ndarray, "6"]:
    """The largest wrench that commands can give on each axis, of a log of wrenches the largest in it."""
    if log.commands is None:
        assert log.wrench is not None
        able = np.abs(log.wrench).max(axis=0)
    else:
        plant = vehicle.plant()
        able = np.abs(np.asarray(plant.allocation)) @ np.asarray(
            plant.drive.max_thrust * plant.drive.saturation
        )
    able = able * vehicle.free
    kinds = np.repeat([able[:3].max(), able[3:].max()], 3)
    return np.maximum(able, _SHARE * kinds) * vehicle.free


def _collision(needed, error, able) -> Bool[np.ndarray, " times"]:
    error = np.abs(error - np.median(error, axis=0))
    scatter = 1.4826 * np.median(error, axis=0)
    least = np.maximum(_SIGMAS * scatter, _REST * np.quantile(error, _USUAL, axis=0))
    bad = ((np.abs(needed) > _BEYOND * able) & (error > least) & (able > 0)).any(axis=1)
    bad[[0, -1]] = False  # where no acceleration can be read
    return bad


def _surfacing(log: Log, track: StateTrack, error, heaves: bool) -> Bool[np.ndarray, " times"]:
    z = track.position[:, 2]
    deep = z > _DEEP
    if not heaves or "z" not in log.measured or abs(z.min()) > _ZERO or deep.mean() < 0.5:
        return np.zeros(len(z), bool)
    middle = np.median(error[deep])
    scatter = 1.4826 * np.median(np.abs(error[deep] - middle))
    least = max(_SIGMAS * scatter, _REST * np.quantile(np.abs(error[deep] - middle), 0.9))
    # held down: the motion would take a force downwards that is not commanded
    return (z < z.min() + _AT_SURFACE) & (error - middle > least)


def _take_over(log: Log, needed, given, able, read) -> Bool[np.ndarray, " times"]:
    """Where changes of the commanded wrench do not show, if they show before and after."""
    nothing = np.zeros(len(log.t), bool)
    pushed = np.flatnonzero((able > 0) & (np.ptp(given, axis=0) > _CHANGES * able))
    size = round(_OVER / log.dt)
    if not len(pushed) or len(log.t) < 4 * size:
        return nothing
    over = np.lib.stride_tricks.sliding_window_view
    told = over(given[:, pushed] / able[pushed], size, axis=0)
    done = over(needed[:, pushed] / able[pushed], size, axis=0)
    told = told - told.mean(axis=2, keepdims=True)
    done = done - done.mean(axis=2, keepdims=True)
    power = (told**2).sum(axis=2)
    tells = power > _CHANGES**2 * size
    follows = np.where(tells, (told * done).sum(axis=2) / np.maximum(power, 1e-12), np.nan)
    # All axes that the commands move, and several where there are several: an effect that is hidden on one
    # axis and seldom shows is no pilot.
    several = (tells.sum(axis=1) >= min(2, len(pushed))) & over(read, size).all(axis=1)
    lost = np.flatnonzero(several & (np.where(tells, follows, -np.inf).max(axis=1) < _FOLLOWS_NOT))
    if len(lost) * log.dt < _ONE:
        return nothing
    bad = nothing.copy()
    for first in lost:
        bad[first : first + size] = True
    # far from those nothing is in between: what follows the commands badly everywhere is a wrong vehicle file
    apart = several & ~over(np.convolve(bad, np.ones(2 * size + 1), "same") > 0, size).any(axis=1)
    if np.count_nonzero(apart) < 2 * size:
        return nothing
    if np.nanquantile(np.where(tells, follows, np.inf).min(axis=1)[apart], 0.1) < _FOLLOWS:
        return nothing
    # what lasts to the end of the log is an effect that begins, and what it begins with one that ends
    followed = np.flatnonzero(apart)
    return bad if followed[0] < lost[0] and lost[-1] < followed[-1] else nothing


def _spans(log: Log, bad: Bool[np.ndarray, " times"], apart: float) -> list[tuple[float, float]]:
    """The stretches of bad samples with their margins [s]; those nearer than `apart` are one."""
    times = log.t[bad]
    if not len(times):
        return []
    breaks = np.flatnonzero(np.diff(times) > apart)
    firsts, lasts = times[np.append(0, breaks + 1)], times[np.append(breaks, len(times) - 1)]
    margin = max(_MARGIN, 3 * log.dt)
    return [
        (float(max(a - margin, log.t[0])), float(min(b + margin, log.t[-1])))
        for a, b in zip(firsts, lasts, strict=True)
    ]
