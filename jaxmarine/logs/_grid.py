"""From series with clocks of their own to one clock, without inventing samples.

What compares a simulation with a log takes the noise of its samples as independent. A slow sensor is
therefore never interpolated: each sample stands in the nearest row, and the other rows stay empty. A fast one
is averaged. A command holds, and a row has what was applied on the average until the next row.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from .._angles import wrap_to_pi
from .._errors import InputError
from .._files import listed
from .._types import ATTITUDE
from ._sources import Series

# Unless a map says otherwise: rows faster than 50 Hz, with some jitter, add little about a vehicle [s].
_FINEST = 0.02
_JITTER = 0.9
# A motion that was left unsampled for longer than this many rows is a gap, which gets rows of its own,
# because other sensors may have seen it.
_GAP = 1.5
# Stamps nearer to each other than this share of the usual spacing are one row.
_SAME = 0.5
# More rows than half a year at 1 Hz or two weeks at 10 Hz come from a clock that was set.
_MOST_ROWS = 15_000_000
# Samples out of order by at most this were only stored in another order; beyond it, a clock was set [s].
_SWAPPED = 1.0
# Among this many neighbours a time that is damaged stands out, and a clock that is set does not.
_NEIGHBOURS = 5
# A command that stays away for longer than this deserves a note [s].
_LONG_HOLD = 2.0


def in_order(
    series: Mapping[str, Series], label: Mapping[str, str], path: object
) -> tuple[dict[str, Series], list[str]]:
    """The series sorted by time, each time there once, without missing values; and what was done."""
    ordered, notes = {}, []
    swapped, repeated, strayed = [], [], []
    for name, (t, values) in series.items():
        seen = np.isfinite(t) & np.isfinite(values)
        t, values = t[seen], values[seen]
        if not len(t):
            raise InputError(
                f"{path}: {label[name]} has no value in any message; check its place there (entries of an "
                "array count from [0]), or leave it out of the column map if it is not measured."
            )
        stray = np.abs(t - scipy.ndimage.median_filter(t, _NEIGHBOURS, mode="nearest")) > _SWAPPED
        if stray.any():
            strayed.append(name)
            t, values = t[~stray], values[~stray]
        back = np.maximum.accumulate(t) - t
        if np.max(back) > _SWAPPED:
            at = int(np.argmax(back > _SWAPPED))
            raise InputError(
                f"{path}: the time of {label[name]} goes back by {back[at]:.6g} s, {t[at - 1] - t[0]:.6g} s "
                "after it begins, as where a clock is set or a vehicle starts anew; cut the file there, "
                'or take the times of recording by [time] stamp = "bag".'
            )
        if np.any(back > 0):
            swapped.append(name)
            order = np.argsort(t, kind="stable")
            t, values = t[order], values[order]
        first = np.append(True, np.diff(t) > 0)
        if not first.all():
            repeated.append(name)
        if np.count_nonzero(first) == 1 and len(t) > 1:
            raise InputError(
                f"{path}: all {len(t)} samples of {label[name]} have the same time; correct it, or take the "
                'times of recording by [time] stamp = "bag".'
            )
        ordered[name] = Series(t[first], values[first])
    if strayed:
        notes.append(
            f"Samples of {listed(strayed)} with a time far from that of their neighbours are left out."
        )
    if swapped:
        notes.append(
            f"Samples of {listed(swapped)} were out of order by at most {_SWAPPED:g} s and are sorted."
        )
    if repeated:
        notes.append(f"Samples of {listed(repeated)} with the time of another are left out.")
    return ordered, notes


def on_one_clock(
    series: Mapping[str, Series],
    main: Sequence[str],
    drive: Sequence[str],
    dt: float | None,
    path: object,
) -> tuple[Float[np.ndarray, " rows"], dict[str, Float[np.ndarray, " rows"]], list[str]]:
    """Times [s] of the rows, the columns with NaN where nothing was measured, and what was done.

    - `series`: in order, as `in_order` gives them.
    - `main`: channels among which the fastest gives the rows; `drive`: columns that hold.
    - `dt`: spacing of the rows [s], or None for the samples of the fastest main channel.
    """
    _check_overlap(series, path)
    main = [name for name in main if name in series] or list(series)
    spacing = {name: _spacing(s.t) for name, s in series.items()}
    fastest = min(main, key=lambda name: spacing[name])
    own = dt is None and spacing[fastest] > _JITTER * _FINEST
    step = dt or (spacing[fastest] if own else _FINEST)
    begin = min(series[name].t[0] for name in main)
    first = max([begin, *(series[name].t[0] - 0.5 * step for name in drive if name in series)])
    last = max(series[name].t[-1] for name in series if name not in drive or name in main)
    if (last - first) / step > _MOST_ROWS:
        raise InputError(
            f"{path}: would have {(last - first) / step:.2g} rows, as its times span {last - first:.4g} s; "
            'correct its clock, or take the times of recording by [time] stamp = "bag", or a longer dt.'
        )
    if own:
        t = _rows(series[fastest].t, step, first, last)
        notes = [f"Rows are the samples of `{fastest}`, {step:.3g} s apart."]
    else:
        t = first + step * np.arange(np.floor((last - first) / step + 1e-6) + 1)
        notes = [f"Rows are {step:.3g} s apart."]
    edges = np.concatenate([[t[0] - 0.5 * step], 0.5 * (t[1:] + t[:-1]), [t[-1] + 0.5 * step]])
    columns = {}
    averaged, sparse, held = [], [], []
    for name, one in series.items():
        if name in drive:
            columns[name] = _held(one, t, step)
            held.append(name)
            continue
        columns[name], off = _nearest(one, t, edges, name in ATTITUDE)
        if np.nanmax(off) > 0.05 * step and spacing[name] > 0.75 * step:
            sparse.append((name, spacing[name], float(np.nanmax(off))))
        elif spacing[name] <= 0.75 * step:
            averaged.append(name)
    notes += _grouped(sparse)
    if averaged:
        notes.append(f"{listed(averaged)} are sampled faster than that and averaged over each row's time.")
    if held:
        notes += _of_commands(series, held, spacing, t)
    if t[0] - begin > _LONG_HOLD:
        notes.append(
            f"The first {t[0] - begin:.3g} s are left out, as nothing tells what was commanded then."
        )
    return t, columns, notes


def _check_overlap(series: Mapping[str, Series], path: object) -> None:
    late = max(series, key=lambda name: series[name].t[0])
    early = min(series, key=lambda name: series[name].t[-1])
    if series[late].t[0] > series[early].t[-1]:
        raise InputError(
            f"{path}: `{early}` ends {series[late].t[0] - series[early].t[-1]:.6g} s before `{late}` begins, "
            "so that they share no time; if their clocks differ, set them alike, or take the times of "
            'recording by [time] stamp = "bag".'
        )


def _spacing(t: np.ndarray) -> float:
    """Usual time between samples [s]."""
    return float(np.median(np.diff(t))) if len(t) > 1 else np.inf


def _rows(t: np.ndarray, step: float, first: float, last: float) -> np.ndarray:
    """The times of samples, thinned where they crowd and filled up where they are missing."""
    inside = t[(t >= first) & (t <= last)]
    rows = [first] if not len(inside) or inside[0] - first > _GAP * step else []
    for time in [*inside, last]:
        if rows and time - rows[-1] > _GAP * step:
            missing = round((time - rows[-1]) / step)
            rows.extend(np.linspace(rows[-1], time, missing + 1)[1:-1])
        if not rows or time - rows[-1] >= _SAME * step:
            rows.append(time)
    return np.array(rows, dtype=np.float64)


def _nearest(one: Series, t: np.ndarray, edges: np.ndarray, is_angle: bool) -> tuple[np.ndarray, np.ndarray]:
    """What was measured in each row's time, NaN where nothing was, and how far off the row's time [s].

    Several samples that lie around the row's time are averaged by the line through them, taken at that time:
    a mean alone would be late or early where they lie to one side. A single one is carried to the row's time
    by the slope of its neighbours: half a row at an acceleration of 1 m/s² would show beside the noise of a
    good sensor, and the neighbours' noise hardly counts, as the way is short against their distance.
    """
    row = np.searchsorted(edges, one.t, side="right") - 1
    inside = (row >= 0) & (row < len(t))
    trend = _slopes(one, is_angle)[inside]
    row, off, values = row[inside], one.t[inside] - t[row[inside]], one.values[inside]
    if is_angle and len(row):  # its neighbours in a row are at most half a turn away
        values = _unwrapped(values, values[np.searchsorted(row, row)])
    count = np.bincount(row, minlength=len(t)).astype(float)
    count[count == 0] = np.nan

    def mean(samples: np.ndarray) -> np.ndarray:
        return np.bincount(row, samples, minlength=len(t)) / count

    centre, level = mean(off), mean(values)
    spread = mean((off - centre[row]) ** 2)
    around = (
        (count > 1)
        & (_extreme(row, off, len(t), np.minimum) <= 0)
        & (_extreme(row, off, len(t), np.maximum) >= 0)
    )
    slope = mean((off - centre[row]) * (values - level[row])) / np.where(around, spread, 1.0)
    return level - np.where(around, slope, mean(trend)) * centre, np.where(around, 0.0, np.abs(centre))


def _slopes(one: Series, is_angle: bool) -> np.ndarray:
    """Slope at each sample by the samples before and behind it; zero at ends and beside gaps."""
    slopes = np.zeros(len(one.t))
    if len(one.t) > 2:
        before, after = one.values[:-2], one.values[2:]
        if is_angle:
            before, after = _unwrapped(before, one.values[1:-1]), _unwrapped(after, one.values[1:-1])
        apart = one.t[2:] - one.t[:-2]
        slopes[1:-1] = np.where(apart < 2 * _GAP * _spacing(one.t), (after - before) / apart, 0.0)
    return slopes


def _unwrapped(angles: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The same angles within half a turn of others [rad]."""
    return near + wrap_to_pi(angles - near)


def _extreme(row: np.ndarray, off: np.ndarray, rows: int, which: np.ufunc) -> np.ndarray:
    found = np.full(rows, np.inf if which is np.minimum else -np.inf)
    which.at(found, row, off)
    return found


def _held(one: Series, t: np.ndarray, step: float) -> np.ndarray:
    """The mean of a command that holds, from each row's time to the next's."""
    ends = np.append(t[1:], t[-1] + step)
    t = np.maximum(t, one.t[0])  # the first command may come up to half a row after the first row
    before, until = np.searchsorted(one.t, t, side="right") - 1, np.searchsorted(one.t, ends) - 1
    total = np.concatenate([[0.0], np.cumsum(np.diff(one.t) * one.values[:-1])])
    applied = (
        total[until]
        - total[before]
        + one.values[until] * (ends - one.t[until])
        - one.values[before] * (t - one.t[before])
    )
    mean = np.clip(applied / (ends - t), one.values.min(), one.values.max())
    return np.where(until == before, one.values[before], mean)


def _grouped(sparse: list[tuple[str, float, float]]) -> list[str]:
    """One note for channels of the same sensor."""
    alike: dict[tuple[str, str], list[str]] = {}
    for name, spacing, off in sparse:
        alike.setdefault((f"{spacing:.2g}", f"{off:.1g}"), []).append(name)
    return [
        f"{listed(names)} are sampled every {spacing} s; each sample stands in the nearest row, carried "
        f"over up to {off} s by the slope of its neighbours."
        for (spacing, off), names in alike.items()
    ]


def _of_commands(
    series: Mapping[str, Series], held: list[str], spacing: Mapping[str, float], t: np.ndarray
) -> list[str]:
    notes = [f"{listed(held)} hold between their samples; a row has their mean until the next row."]
    for name in held:
        times = series[name].t
        pause = np.max(np.diff(np.append(times[times <= t[-1]], t[-1])), initial=0.0)
        if pause > max(_LONG_HOLD, 10 * spacing[name]):
            notes.append(f"`{name}` is silent for up to {pause:.3g} s, over which its last value holds.")
    return notes
