"""The same figures as PNG files for print, with matplotlib on a white ground."""

import io
import warnings

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._numbers import number
from .._types import ALL_CHANNELS
from ..diagnosis import Diagnosis, Weighed
from ._causes import title
from ._curves import (
    CHANNEL_TITLES,
    beginnings,
    compared,
    course,
    errors_by_horizon,
    finite,
    free_axes,
    known,
    lacking,
    leading,
    shown_unit,
    taken_suspects,
    telling_channel,
    typical_starts,
)
from ._words import VERY_STRONG

_COLOURS = {"before": "#c2620a", "after": "#1f6fb5"}
_QUIET = "#7d8590"
_DPI = 150


def pictures(diagnosis: Diagnosis) -> dict[str, bytes]:
    """File name and content of each picture."""
    drawn = {
        "error_vs_horizon.png": _errors(diagnosis),
        "missing_wrench.png": _missing(diagnosis),
        "evidence.png": _evidence(diagnosis),
        "trajectories.png": _trajectories(diagnosis),
    }
    return {name: _png(figure) for name, figure in drawn.items() if figure is not None}


def _errors(diagnosis: Diagnosis) -> Figure | None:
    groups = errors_by_horizon(diagnosis.predictions)
    if not groups:
        return None
    figure, axes = _grid(len(groups), 3)
    for ax, group in zip(axes, groups, strict=True):
        for name in compared(diagnosis):
            ax.plot(group.horizon, group.errors[name], color=_COLOURS[name], label=name)
        if np.isfinite(group.noise):
            ax.axhline(group.noise, color=_QUIET, ls="--", lw=1, label="noise")
        ax.set(title=group.title, xlabel="horizon [s]", ylabel=f"rms error [{group.unit}]")
        ax.set_ylim(bottom=0.0)
    axes[0].legend(frameon=False)
    return figure


def _missing(diagnosis: Diagnosis) -> Figure | None:
    free = [
        axis for axis in free_axes(diagnosis.vehicle.dof) if known(diagnosis.missing_before, axis.index).any()
    ]
    if not free:
        return None
    figure, axes = _grid(len(free), 3)
    starts = _log_starts(diagnosis)
    for ax, axis in zip(axes, free, strict=True):
        for name, missing in lacking(diagnosis).items():
            colour = _COLOURS[name]
            for log, shift in enumerate(starts):
                there = known(missing, axis.index, log)
                t, wrench = missing.t[there] + shift, missing.wrench[there, axis.index]
                band = 2 * np.nan_to_num(finite(missing.std[there, axis.index]))
                ax.fill_between(t, wrench - band, wrench + band, color=colour, alpha=0.2, lw=0)
                ax.plot(t, wrench, color=colour, lw=1.2, label=f"{name} ± 2 std" if log == 0 else None)
        for log, shift in enumerate(starts):
            for since in beginnings(diagnosis, log):
                ax.axvline(since + shift, color=_QUIET, ls=":")
        ax.axhline(0.0, color="black", lw=0.6)
        ax.set(title=axis.title, ylabel=f"[{axis.unit}]", xlabel="time, training logs in a row [s]")
    axes[0].legend(frameon=False)
    return figure


def _log_starts(diagnosis: Diagnosis) -> list[float]:
    """What is added to the time of each training log so that they stand one after another."""
    missing = diagnosis.missing_before
    shifts, end = [], None
    for log in range(len(diagnosis.train)):
        t = missing.t[(missing.log == log) & np.isfinite(missing.t)]
        shift = 0.0 if end is None or t.size == 0 else end - float(t.min())
        shifts.append(shift)
        if t.size:
            end = float(t.max()) + shift + 0.03 * float(np.ptp(t))
    return shifts


def _evidence(diagnosis: Diagnosis) -> Figure | None:
    rounds = [
        (leading(suspects, taken, 8), taken)
        for suspects, taken in zip(diagnosis.rounds, taken_suspects(diagnosis), strict=True)
        if suspects
    ]
    if not rounds:
        return None
    sizes = [len(suspects) for suspects, _ in rounds]
    figure = Figure(figsize=(9, 0.8 * len(rounds) + 0.3 * sum(sizes)), layout="constrained")
    axes = figure.subplots(len(rounds), 1, squeeze=False, height_ratios=sizes)[:, 0]
    for i, (ax, (suspects, taken)) in enumerate(zip(axes, rounds, strict=True)):
        values = np.nan_to_num(finite(np.array([s.log_evidence for s in suspects])))
        colours = [_COLOURS["after"] if s is taken else "#b8bec6" for s in suspects]
        bars = ax.barh(np.arange(len(suspects)), values, color=colours)
        ax.bar_label(bars, [number(s.log_evidence) for s in suspects], padding=3, fontsize=8)
        ax.set_yticks(np.arange(len(suspects)), [_named(s) for s in suspects])
        ax.invert_yaxis()
        # A round in which nothing counts must not look like one in which much does.
        ax.set_xlim(min(0.0, 1.25 * values.min()), 1.12 * max(values.max(), VERY_STRONG))
        ax.set(title=f"Round {i + 1}", xlabel="log evidence")
        _bare(ax)
    return figure


def _trajectories(diagnosis: Diagnosis) -> Figure | None:
    predictions = diagnosis.predictions
    channel = telling_channel(predictions)
    clock = diagnosis.clocks.get(predictions.log, 0.0)
    courses = [course(predictions, start, clock) for start in typical_starts(predictions)]
    if channel is None or not courses:
        return None
    column = ALL_CHANNELS.index(channel)
    figure, axes = _grid(len(courses), 3)
    for ax, c in zip(axes, courses, strict=True):
        measured = c.curves["measured"][:, column]
        ax.plot(c.ahead, measured, color=_QUIET, lw=4, alpha=0.6, label="measured")
        for name in compared(diagnosis):
            ax.plot(c.ahead, c.curves[name][:, column], color=_COLOURS[name], label=name)
        if c.band is not None:
            last = compared(diagnosis)[-1]
            middle, half = c.curves[last][:, column], c.band[:, column]
            ax.fill_between(c.ahead, middle - half, middle + half, color=_COLOURS[last], alpha=0.15, lw=0)
        ax.axvline(0.0, color=_QUIET, ls=":")
        ax.set(
            title=f"start at {c.start}",
            xlabel="time since the start [s]",
            ylabel=f"{CHANNEL_TITLES[channel]} [{shown_unit(channel)}]",
        )
    axes[0].legend(frameon=False)
    return figure


def _grid(count: int, columns: int) -> tuple[Figure, list[Axes]]:
    columns = 2 if count == 4 else min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns if columns > 1 else 6.0, 2.5 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for spare in axes[count:]:
        spare.remove()
    for ax in axes[:count]:
        _bare(ax)
    return figure, axes[:count]


def _bare(ax: Axes) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.title.set_fontsize(10)


def _named(suspect: Weighed) -> str:
    """A suspect with the time from which it was weighed, where it was not weighed throughout."""
    begins = "" if suspect.since is None else f", since {number(suspect.since)} s"
    return _plain(title(suspect.label) + begins)


def _plain(text: str) -> str:
    """Names from files as they are: a dollar sign would begin a formula."""
    return text.replace("`", "").replace("$", r"\$")


def _png(figure: Figure) -> bytes:
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a name in a script that the font lacks
        figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()
