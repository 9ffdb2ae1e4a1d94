"""Stretches of a log in which something acted that is no property of the vehicle, named and left out.

Only what is brief, rare and extreme against the rest of its log goes: an effect that begins and stays, a
disturbance that goes on and what a wrong vehicle file misses everywhere are for the diagnosis to find.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import median_filter

from ..logs import Log, Note, Reason, Rejected, StateTrack, moment
from ..vehicle import Vehicle
from ._driven import HALF, Driven

# A collision: a force beyond that of all thrusters on its axis by this factor (on an axis that they hardly
# push: of this share of the axis of its kind that they push most). What it is beside that of the commands
# leaves the median over so many seconds by as much, by so many standard deviations (by the median), and by so
# many times what all but a thirtieth of the log does.
_BEYOND, _SHARE, _AROUND, _SIGMAS, _REST, _USUAL = 1.5, 0.5, 4.0, 8.0, 3.0, 29 / 30
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

_WORDS: dict[Reason, str] = {
    "collision": "it moves as no thrust explains",
    "surfacing": "it is held at the surface, where its buoyancy is cut",
    "take-over": "it does not follow the commands, as where a pilot takes over",
}


def without_accidents(vehicle: Vehicle, log: Log, track: StateTrack, drive: Driven) -> Log:
    """The log without its dirty stretches, which its history names; without any it comes back as it is.

    - `track`, `drive`: its smoothed motion, and the wrenches along it.

    Nothing is measured there any more, and no window touches them (`cut`). Where more looks like it than
    can be an accident, nothing goes, and the history says so.
    """
    # beside what is missing no acceleration can be read
    gone = (~np.isfinite(log.channels).any(axis=1)).astype(float)
    read = np.convolve(gone, np.ones(2 * round(4 * HALF / log.dt) + 1), "same") < 0.5
    looks: dict[Reason, Bool[np.ndarray, " times"]] = {
        "surfacing": _surfacing(log, track, drive, bool(vehicle.free[2] > 0)),
        "collision": _collision(log, drive),
        "take-over": _take_over(log, drive, read),
    }
    rejected, notes = [], []
    for reason, bad in looks.items():
        spans = _spans(log, bad & read, _OVER if reason == "take-over" else _ONE)
        spans = [(a, b) for a, b in spans if not any(a <= one.end and one.start <= b for one in rejected)]
        longest, most, share = _MOST[reason]
        lasts = [end - start for start, end in spans]
        if not spans:
            continue
        if (
            max(lasts) > longest + 2 * _MARGIN
            or len(spans) > most * log.duration / 60
            or sum(lasts) > share * log.duration
        ):
            alike = "{lasts:.3g} s of {duration:.3g} s look like " + f"{reason} ({_WORDS[reason]})"
            first = moment(spans[0][0], log.clock, ".1f")
            kept = "that is too much for an accident, and nothing is left out."
            notes.append(
                Note.of(
                    log.name,
                    f"{{log}}: {alike}, the first from {first}; {kept}",
                    f"{{logs}}: {alike}; {kept}",
                    lasts=sum(lasts),
                    duration=log.duration,
                )
            )
            continue
        rejected += [Rejected(log.name, start, end, reason) for start, end in spans]
    if not rejected and not notes:
        return log
    rejected.sort(key=lambda one: one.start)
    channels = log.channels.copy()
    for one in rejected:
        channels[(log.t >= one.start) & (log.t <= one.end)] = np.nan
    notes += [
        _told(log, reason, [one for one in rejected if one.reason == reason])
        for reason in dict.fromkeys(one.reason for one in rejected)
    ]
    return dataclasses.replace(log, channels=channels, notes=(*log.notes, *notes), rejected=tuple(rejected))


def _told(log: Log, reason: Reason, stretches: Sequence[Rejected]) -> Note:
    """A sentence on all stretches that are left out for one reason."""
    verb = "is" if len(stretches) == 1 else "are"
    when = ", ".join(
        f"{moment(one.start, log.clock, '.1f')} to {moment(one.end, log.clock, '.1f').removeprefix('t = ')}"
        for one in stretches
    )
    return Note.of(
        log.name,
        f"{{log}}: {when} {verb} left out ({reason}: {_WORDS[reason]}).",
        f"{{logs}}: {{count}} stretches each are left out ({reason}: {_WORDS[reason]}).",
        count=len(stretches),
    )


def _able(drive: Driven) -> Float[np.ndarray, "6"]:
    """The largest wrench on each free axis, at least a share of that on the best of its kind."""
    kinds = np.repeat([drive.able[:3].max(), drive.able[3:].max()], 3)
    return np.maximum(drive.able, _SHARE * kinds) * (drive.needed != 0).any(axis=0)


def _collision(log: Log, drive: Driven) -> Bool[np.ndarray, " times"]:
    able = _able(drive)
    error = drive.needed - drive.commanded
    # what a wrong vehicle file misses comes and goes with the motion, a collision at once
    around = 2 * round(_AROUND / log.dt / 2) + 1
    error = np.abs(error - median_filter(error, (around, 1), mode="nearest"))
    scatter = 1.4826 * np.median(error, axis=0)
    least = np.maximum(_SIGMAS * scatter, _REST * np.quantile(error, _USUAL, axis=0))
    beyond = np.minimum(np.abs(drive.needed), error) > _BEYOND * able
    bad = np.any(beyond & (error > least) & (able > 0), axis=1)
    bad[[0, -1]] = False  # where no acceleration can be read
    return bad


def _surfacing(log: Log, track: StateTrack, drive: Driven, heaves: bool) -> Bool[np.ndarray, " times"]:
    z, error = track.position[:, 2], (drive.needed - drive.commanded)[:, 2]
    deep = z > _DEEP
    if not heaves or "z" not in log.measured or abs(z.min()) > _ZERO or deep.mean() < 0.5:
        return np.zeros(len(z), bool)
    middle = np.median(error[deep])
    scatter = 1.4826 * np.median(np.abs(error[deep] - middle))
    least = max(_SIGMAS * scatter, _REST * np.quantile(np.abs(error[deep] - middle), 0.9))
    # held down: the motion would take a force downwards that is not commanded
    return (z < z.min() + _AT_SURFACE) & (error - middle > least)


def _take_over(log: Log, drive: Driven, read: Bool[np.ndarray, " times"]) -> Bool[np.ndarray, " times"]:
    """Where changes of the commanded wrench do not show, if they show before and after."""
    given, needed, able = drive.commanded, drive.needed, _able(drive)
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
