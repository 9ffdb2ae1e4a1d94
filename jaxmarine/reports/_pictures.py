"""The figures of the page as PNG files for print, with matplotlib on a white ground.

What they show is defined in `_figures.py`; only the ranking of causes, a table on the page, is drawn here.
"""

import io
import warnings
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .._numbers import number
from ..diagnosis import Diagnosis, Weighed
from ._causes import title
from ._curves import finite, leading, taken_suspects
from ._figures import Chart, error_chart, missing_time_chart, trajectory_chart
from ._svg import Plot
from ._words import VERY_STRONG

_COLOURS = {"before": "#c2620a", "after": "#1f6fb5"}
_QUIET = "#7d8590"
_DPI = 150
# How a line is drawn, by whose it is.
_LINES: dict[str, dict[str, Any]] = {
    "before": {"color": _COLOURS["before"], "lw": 1.4},
    "after": {"color": _COLOURS["after"], "lw": 1.4},
    "noise": {"color": _QUIET, "lw": 1.0, "ls": "--"},
    "measured": {"color": _QUIET, "lw": 4.0, "alpha": 0.6},
}


def pictures(diagnosis: Diagnosis) -> dict[str, bytes]:
    """File name and content of each picture."""
    charts = {
        "error_vs_horizon.png": error_chart(diagnosis),
        "missing_wrench.png": missing_time_chart(diagnosis),
        "trajectories.png": trajectory_chart(diagnosis),
    }
    drawn = {name: None if chart is None else printed(chart) for name, chart in charts.items()}
    drawn["evidence.png"] = _evidence(diagnosis)
    return {name: _png(figure) for name, figure in drawn.items() if figure is not None}


def printed(chart: Chart) -> Figure:
    """The sheet of a chart that the page shows first, named where there are others."""
    sheet = chart.sheets[chart.chosen]
    figure, axes = _grid(len(sheet.panels), 3)
    for ax, panel in zip(axes, sheet.panels, strict=True):
        ax.set_title(_plain(panel.title))
        _draw(ax, panel.figure)
    if len(chart.sheets) > 1:
        figure.suptitle(_plain(sheet.name), fontsize=10)
    if "band" in chart.legend:
        # A mark of its own, beside the lines of the first panel.
        axes[0].fill_between([], [], [], color=_QUIET, alpha=0.3, lw=0, label=chart.band)
    # Below the panels, where it covers no curve; in the order of the page.
    named = dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
    shown = (chart.band if name == "band" else name for name in chart.legend)
    order = [name for name in shown if name in named]
    figure.legend(
        [named[name] for name in order], order, loc="outside lower center", ncols=len(order), frameon=False
    )
    return figure


def _draw(ax: Axes, plot: Plot) -> None:
    """What a plot of the page has, on axes of matplotlib."""
    for shape in plot.shapes:
        style = _LINES[shape.kind]
        if shape.form == "line":
            ax.plot(shape.x, shape.y, label=shape.kind, **style)
        elif shape.upper is not None:
            ax.fill_between(shape.x, shape.y, shape.upper, color=style["color"], alpha=0.15, lw=0)
        else:
            ax.plot(shape.x, shape.y, ".", color=style["color"], ms=2, label=shape.kind)
    for mark in plot.marks:
        ax.axvline(mark, color=_QUIET, ls=":")
    if plot.from_zero:
        ax.set_ylim(bottom=0.0)
    elif ax.get_ylim()[0] < 0.0 < ax.get_ylim()[1]:
        ax.axhline(0.0, color=_QUIET, lw=0.6)
    if plot.equal:
        ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel=_plain(plot.x_title), ylabel=_plain(plot.y_title))


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


def _grid(count: int, columns: int) -> tuple[Figure, list[Axes]]:
    columns = 2 if count == 4 else min(columns, count)
    rows = -(-count // columns)
    size = 3.6 * columns if columns > 1 else 6.0, 2.5 * rows + 0.5  # with room for names above and below
    figure = Figure(figsize=size, layout="constrained")
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
