"""Samples that are no measurements: spikes and dropouts become missing samples, each with a note.

Nothing is put in their place, and a log without them comes back as it is. What a vehicle can have done is
kept: a step that stays, a kink, rough motion that goes on, a vehicle at rest.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from .._angles import wrap_to_pi
from .._types import ALL_CHANNELS, ATTITUDE, JUMPS
from ._log import Log
from ._noise import command_jumps, resolution
from ._notes import Note, moment

# Fewer samples than this do not show what is usual in a channel.
_FEWEST = 50
# A spike is at most so many samples long, and the good ones around it at most so many seconds apart: in a
# longer time a vehicle may have gone and come back.
_LONGEST, _APART = 3, 0.6
# It leaves its neighbours by so many standard deviations of the noise, and by so many times all that the
# channel changes by from sample to sample elsewhere: a vehicle that is pushed leaves a slope.
_SIGMAS, _CHANGES = 10.0, 3.0
# More than this share of the samples is not looked at for spikes.
_LOOKED_AT = 0.1
# So many equal samples are one that was held, where equal neighbours are rarer than this share; so many,
# where nothing else shows that they were, as a sensor at rest may repeat a few.
_HELD, _REPEATS, _HELD_FOR_SURE = 4, 0.02, 10
# Noise shows in how often samples leave the line between their neighbours to the other side than the sample
# before: 0.73 of white noise, hardly ever of a smooth motion.
_NOISY = 0.5
# Edges of a dropout stand out by so many usual changes (all but a hundredth are smaller); a vehicle may
# answer a command by such an edge within so many seconds.
_EDGE, _ANSWERS = 2.0, 2.0
# More than these shares of a channel are no accident, and are left as they are; a sensor whose noise stands
# still for long is not measuring, however often it does that, unless that is most of what there is.
_MOST_SPIKES, _MOST_DROPOUTS, _MOST_FROZEN = 0.02, 0.2, 0.6
# Commands that change with more than this share of the samples are measured ones, or the wind: they tell of
# no moment at which something new was commanded.
_COMMANDED = 0.5

# Second differences of white noise have a standard deviation of sqrt(6), and the median of its size is this
# much below the standard deviation.
_TO_STD = 1.4826 / np.sqrt(6)


def clean(log: Log) -> Log:
    """The log with spikes and dropouts as missing samples, and a sentence per channel on them in its notes.

    Samples of a sensor that is slower than the rows of the log, and that every row repeats until the next one
    comes, are measured once each. Steps of a coarse sensor are told too; they stay as they are.

    - A *spike* is at most three samples that leave both neighbours to the same side and come back, by ten
      standard deviations of the noise and by three times all that the channel changes by from one sample to
      the next elsewhere in the log. Accelerations right after a new command may do so.
    - A *dropout* is a value that is held where samples otherwise hardly ever repeat. What was measured last
      stays; a value that was never measured, such as zero, goes.

    Up to 2 % of a channel's samples are taken for spikes and 20 % for dropouts, 60 % where a noisy sensor
    holds its values for ten samples and more. Where more look like it, the channel is left alone and the note
    says so. Cleaning again changes nothing.
    """
    jumps = command_jumps(log)
    if len(jumps) > _COMMANDED * len(log.t):
        jumps = jumps[:0]
    channels, notes = _without_repeats(log)
    for index, name in enumerate(ALL_CHANNELS[: log.channels.shape[1]]):
        values = channels[:, index].copy()
        spikes, dropouts, frozen = _defects(log.t, values, name, jumps)
        count = int(np.isfinite(values).sum())
        most = _MOST_FROZEN if frozen else _MOST_DROPOUTS
        found = {"spikes": (spikes, _MOST_SPIKES), "dropouts": (dropouts, most)}
        found = {kind: one for kind, one in found.items() if one[0].any()}
        many = [kind for kind, (where, most) in found.items() if np.count_nonzero(where) > most * count]
        for kind, (where, _) in found.items():
            if not many:
                channels[where, index] = np.nan
                notes.append(_note(log, name, kind, log.t[where], count))
            elif kind in many:
                too_many = f"look like {kind}, which are too many for that; the channel is left as it is."
                notes.append(
                    Note.of(
                        log.name,
                        "{log}: {found} of {count} samples of {channel} " + too_many,
                        "{found} of {count} samples each of {places} " + too_many,
                        name,
                        found=int(np.count_nonzero(where)),
                        count=count,
                    )
                )
    notes = [note for note in (*notes, *_rounding(log)) if note not in log.notes]
    if not notes:
        return log
    return dataclasses.replace(log, channels=channels, notes=(*log.notes, *notes))


def _without_repeats(log: Log) -> tuple[Float[np.ndarray, "times channels"], list[Note]]:
    """The channels without rows that only repeat an older sample, and a note on those.

    Where a value commonly changes every so many rows only, it comes from a sensor so many times slower than
    the log: what stands in between is old by up to that time. Where it lasts for more than two such times, as
    at rest, a sample counts for each of them.
    """
    channels, notes = log.channels.copy(), []
    late = "{every:.2g} s, and rows in between repeat what is old by then; each sample counts once."
    for index, name in enumerate(ALL_CHANNELS[: log.channels.shape[1]]):
        seen = np.flatnonzero(np.isfinite(log.channels[:, index]))
        values = log.channels[seen, index]
        first = np.flatnonzero(np.append(True, np.diff(values) != 0))
        if len(first) < _FEWEST:
            continue
        if _step(values):
            continue  # a coarse sensor repeats itself while its motion lasts for less than a step
        rows = np.diff(np.append(first, len(values)))
        period = int(np.quantile(rows[:-1], 0.5, method="lower"))
        if period < 2:
            continue
        since, lasts = np.arange(len(values)) - np.repeat(first, rows), np.repeat(rows, rows)
        measured = (since == 0) | ((since % period == 0) & (lasts > 2 * period))
        channels[seen[~measured], index] = np.nan
        notes.append(
            Note.of(
                log.name,
                "{log}: {channel} comes every " + late,
                "{places} come every " + late,
                name,
                every=period * log.dt,
            )
        )
    return channels, notes


def _note(log: Log, name: str, kind: str, t: Float[np.ndarray, " defects"], count: int) -> Note:
    first, last = moment(t[0], log.clock), moment(t[-1], log.clock)
    when = f"at {first}" if len(t) == 1 else f"between {first} and {last.removeprefix('t = ')}"
    done = {
        "spikes": "leave their neighbours and come back as no vehicle does",
        "dropouts": "hold a value that otherwise changes with every sample",
    }[kind]
    what = f"{done} ({kind}); they count as missing."
    return Note.of(
        log.name,
        f"{{log}}: {{found}} of {{count}} samples of {{channel}}, {when}, {what}",
        f"{{found}} of {{count}} samples each of {{places}} {what}",
        name,
        found=len(t),
        count=count,
    )


def _step(values: Float[np.ndarray, " seen"]) -> float:
    """The step in which the samples of a coarse sensor come; zero where they do not come in steps.

    Samples of a slow sensor repeat too, but have no step in common; and where noise is larger than a step,
    neighbours seldom share one.
    """
    step = np.sqrt(12) * resolution(values) if len(values) >= _FEWEST else 0.0
    if step == 0:
        return 0.0
    levels = (np.unique(values) - values.min()) / step
    even = np.allclose(levels, np.round(levels), rtol=0, atol=1e-3)
    return (
        float(step) if even and len(levels) > 2 and np.median(np.abs(np.diff(values))) < 1.5 * step else 0.0
    )


def _rounding(log: Log) -> list[Note]:
    """A note on each channel of which the steps are coarser than its noise."""
    notes = []
    for index, name in enumerate(ALL_CHANNELS[: log.channels.shape[1]]):
        values = log.channels[np.isfinite(log.channels[:, index]), index]
        step = _step(values)
        if step:
            steps = (
                "comes in steps of {step:.3g}; where its noise is not stated, it is taken for at least "
                "{noise:.2g}."
            )
            notes.append(
                Note.of(
                    log.name,
                    "{log}: {channel} " + steps,
                    "Each of {places} " + steps,
                    name,
                    step=step,
                    noise=step / np.sqrt(12),
                )
            )
    return notes


def _defects(
    t: Float[np.ndarray, " times"],
    values: Float[np.ndarray, " times"],
    name: str,
    jumps: Float[np.ndarray, " jumps"],
) -> tuple[Bool[np.ndarray, " times"], Bool[np.ndarray, " times"], bool]:
    """Which samples of a channel are spikes, which dropouts, and whether those are mostly long ones of noise.

    By turns, until neither shows any more: a spike beside a dropout is seen once that has gone, and what is
    found does not hang on which is looked for first.
    """
    left, is_angle = values.copy(), name in ATTITUDE
    jumping = jumps if JUMPS[ALL_CHANNELS.index(name)] else jumps[:0]
    spikes, dropouts = np.zeros(len(t), bool), np.zeros(len(t), bool)
    while True:
        seen = np.flatnonzero(np.isfinite(left))
        if len(seen) < _FEWEST:
            break
        held = seen[_dropouts(t[seen], left[seen], is_angle, jumps)]
        peaks = seen[_spikes(t[seen], left[seen], is_angle, jumping)]
        if not len(held) and not len(peaks):
            break
        dropouts[held] = True
        spikes[np.setdiff1d(peaks, held)] = True
        left[held] = left[peaks] = np.nan
    return spikes, dropouts, _is_frozen(values, left, dropouts, is_angle)


def _is_frozen(values: np.ndarray, left: np.ndarray, dropouts: np.ndarray, is_angle: bool) -> bool:
    """Whether most of what is held is held for long, by a sensor that shows noise where it measures."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], dropouts.astype(int), [0]])))
    length = edges[1::2] - edges[::2]
    return bool(
        length[length >= _HELD_FOR_SURE - 1].sum() > 0.5 * length.sum()
        and _is_noisy(_changes(left[np.isfinite(left)], is_angle), 1e-9 * np.ptp(values[np.isfinite(values)]))
    )


def _is_noisy(changes: np.ndarray, digits: float) -> bool:
    moving = np.abs(changes) > digits
    bends = np.diff(changes)[moving[1:] & moving[:-1]]
    return bool(len(bends) > 1 and np.mean(bends[1:] * bends[:-1] < 0) > _NOISY)


def _changes(values: np.ndarray, is_angle: bool) -> np.ndarray:
    steps = np.diff(values)
    return wrap_to_pi(steps) if is_angle else steps


def _dropouts(
    t: Float[np.ndarray, " seen"],
    values: Float[np.ndarray, " seen"],
    is_angle: bool,
    jumps: Float[np.ndarray, " jumps"],
) -> Int[np.ndarray, " dropouts"]:
    changes = _changes(values, is_angle)
    # in a steady motion without noise the last digits still change
    digits = 1e-9 * np.ptp(values)
    first = np.flatnonzero(np.append(True, np.abs(changes) > digits))
    length = np.diff(np.append(first, len(values)))
    long = length >= _HELD
    other = len(values) - length[long].sum()
    # a coarse or slow sensor repeats itself all the time
    if not long.any() or len(first) == 1 or other < _FEWEST or (length[~long] - 1).sum() > _REPEATS * other:
        return np.zeros(0, int)
    moving = np.abs(changes) > digits
    noisy = _is_noisy(changes, digits)
    edges = np.append(False, np.abs(changes) > _EDGE * np.quantile(np.abs(changes[moving]), 0.99))
    # A vehicle without noise holds its values too, at rest or in steady motion, until a command moves it.
    commanded = np.searchsorted(jumps, t) > np.searchsorted(jumps, t - _ANSWERS)
    edges &= noisy | ~commanded
    edges = np.append(edges, False)
    found = []
    for start, count in zip(first[long], length[long], strict=True):
        entry, stop = edges[start], start + count
        if entry or edges[stop] or (noisy and count >= _HELD_FOR_SURE and values[start] != 0):
            measured = 0 if entry or values[start] == 0 else 1
            found.append(np.arange(start + measured, stop))
    return np.concatenate(found) if found else np.zeros(0, int)


def _spikes(
    t: Float[np.ndarray, " seen"],
    values: Float[np.ndarray, " seen"],
    is_angle: bool,
    jumps: Float[np.ndarray, " jumps"],
) -> Int[np.ndarray, " spikes"]:
    # of a sensor that is slower than the log, each of its own samples counts once
    own = np.append(True, np.diff(values) != 0)
    first = np.flatnonzero(own) if own.mean() < 0.5 else np.arange(len(values))
    ends = np.append(first[1:], len(values))
    t, values = t[first], values[first]
    if len(values) < _FEWEST:
        return np.zeros(0, int)
    changes = np.abs(_changes(values, is_angle))
    bends = np.diff(_changes(values, is_angle))
    least = _SIGMAS * max(_TO_STD * float(np.median(np.abs(bends))), resolution(values))
    peaks = []  # of which the samples from k + 1 to k + width leave those around them
    for width in range(1, _LONGEST + 1):
        height = _height(values, width, is_angle)
        apart = t[width + 1 :] - t[: -width - 1]
        commanded = np.searchsorted(jumps, t[width:-1]) > np.searchsorted(jumps, t[: -width - 1] - apart)
        for k in np.flatnonzero((height > least) & (least > 0) & (apart <= _APART) & ~commanded):
            peaks.append((float(height[k]), int(k), width))
    peaks.sort(reverse=True)
    found, count = np.zeros(len(values), bool), 0
    new = np.searchsorted(jumps, t)
    elsewhere = np.where(np.diff(new) > 0, 0.0, changes)
    for number, (height, k, width) in enumerate(peaks[: int(_LOOKED_AT * len(values))], start=1):
        elsewhere[k : k + width + 1] = 0.0
        if height > _CHANGES * elsewhere.max():
            count = number
    for _, k, width in peaks[:count]:
        found[k + 1 : k + 1 + width] = True
    rows = [np.arange(first[k], ends[k]) for k in np.flatnonzero(found)]
    return np.concatenate(rows) if rows else np.zeros(0, int)


def _height(values: np.ndarray, width: int, is_angle: bool) -> np.ndarray:
    """By how much `width` samples leave those around them to the same side [len - width - 1], 0 if not."""
    inside = np.lib.stride_tricks.sliding_window_view(values, width)[1:-1]
    apart = [inside - values[: -width - 1, None], inside - values[width + 1 :, None]]
    apart = np.concatenate([wrap_to_pi(one) if is_angle else one for one in apart], axis=1)
    return np.maximum(np.maximum(apart.min(axis=1), -apart.max(axis=1)), 0.0)
