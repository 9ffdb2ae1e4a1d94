"""The interactive figures of the page: small plotly panels, laid out by the page in a grid.

One panel is one plotly figure, so that a narrow screen stacks them. A chart with several sheets
shows one at a time. Text colours and grids come from the page, which knows whether it is light or
dark.
"""

import dataclasses
import html

import numpy as np
import plotly.graph_objects as go

from .._types import CHANNELS
from ..diagnosis import Diagnosis, MissingWrench
from ._curves import (
    CHANNEL_TITLES,
    Axis,
    Course,
    GroupError,
    beginnings,
    compared,
    course,
    errors_by_horizon,
    finite,
    free_axes,
    known,
    lacking,
    measured_channels,
    shown_unit,
    telling_channel,
    thinned,
    typical_starts,
)
from ._numbers import count, joined, number

# Orange and blue differ for every kind of colour vision, and both hold on white and on black.
_COLOURS = {"before": "#d97706", "after": "#2f86d6"}
_BANDS = {"before": "rgba(217,119,6,0.20)", "after": "rgba(47,134,214,0.22)"}
_QUIET = "#7d8590"
_MARK = {"dash": "dot", "width": 1.5, "color": _QUIET}
_POINTS = 1000  # per trace, which is more than a panel has pixels


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plotly figure with its heading and a description for those who cannot see it."""

    key: str
    title: str
    description: str
    figure: go.Figure


@dataclasses.dataclass(frozen=True)
class Sheet:
    """Panels that are shown together."""

    name: str
    panels: tuple[Panel, ...]


@dataclasses.dataclass(frozen=True)
class Chart:
    """A captioned set of panels; with several sheets, `choice` says what the reader chooses.

    `legend` names the marks in use: before, after, noise, measured, band, since.
    """

    key: str
    title: str
    caption: str
    legend: tuple[str, ...]
    sheets: tuple[Sheet, ...]
    choice: str = ""
    chosen: int = 0


def error_chart(diagnosis: Diagnosis) -> Chart | None:
    """Prediction error against horizon, one panel per sensor kind."""
    shown = compared(diagnosis)
    groups = errors_by_horizon(diagnosis.predictions)
    if not groups:
        return None
    caption = (
        "The model is started from the test log and then left alone with the commands. See how far "
        "it drifts off: the blue line (extended vehicle) should stay near the dashed noise level, "
        "where the orange one (vehicle file) climbs. Errors are per axis, averaged over the axes."
    )
    if len(shown) == 1:
        caption = (
            "The model is started from the test log and then left alone with the commands. Its "
            "error should stay near the dashed noise level. Errors are per axis, averaged over the axes."
        )
    return Chart(
        key="error",
        title="Prediction error against horizon",
        caption=caption,
        legend=(*shown, "noise"),
        sheets=(Sheet("", tuple(_error(group, i, shown) for i, group in enumerate(groups))),),
    )


def _error(group: GroupError, i: int, shown: tuple[str, ...]) -> Panel:
    figure = _figure("prediction horizon [s]", f"rms error [{group.unit}]")
    ends = group.horizon[[0, -1]]
    if np.isfinite(group.noise):
        _add_line(figure, "noise", ends, np.full(2, group.noise), _QUIET, dash="dash", width=1.5)
    for name in shown:
        _add_line(figure, name, group.horizon, group.errors[name], _COLOURS[name])
    figure.update_yaxes(rangemode="tozero")
    last = joined([f"{number(group.errors[name][-1])} {group.unit} {name}" for name in shown])
    description = (
        f"{group.title} error after {number(ends[1])} s of prediction: {last}; "
        f"noise {number(group.noise)} {group.unit}."
    )
    return Panel(f"error-{i}", group.title, description, figure)


def missing_time_chart(diagnosis: Diagnosis) -> Chart | None:
    """Missing wrench over time, one sheet per training log."""
    axes = free_axes(diagnosis.vehicle.dof)
    sheets, lacks = [], []
    for log, name in enumerate(diagnosis.train):
        panels = [_missing_over_time(diagnosis, axis, log) for axis in axes]
        panels = [panel for panel in panels if panel is not None]
        if panels:
            sheets.append(Sheet(name, tuple(panels)))
            lacks.append(_lack(diagnosis.missing_before, log))
    if not sheets:
        return None
    caption = (
        "What would have to be added to the model at each moment to explain the log, with a band "
        "of ± 2 standard deviations. A model that is right leaves a band that nearly always holds "
        "zero."
    )
    since = any(finding.since is not None for finding in diagnosis.findings)
    if since:
        caption += " The dotted line marks the time since which a finding acts."
    return Chart(
        key="missing",
        title="Missing force and moment over time",
        caption=caption,
        legend=(*compared(diagnosis), "band", *(("since",) if since else ())),
        sheets=tuple(sheets),
        choice="Log",
        chosen=int(np.argmax(lacks)),
    )


def _lack(missing: MissingWrench, log: int) -> float:
    """How much is missing in a log: mean square in units of its uncertainty."""
    size = finite(missing.wrench / missing.std)[missing.log == log]
    size = size[np.isfinite(size)]
    return float(np.mean(size**2)) if size.size else 0.0


def _missing_over_time(diagnosis: Diagnosis, axis: Axis, log: int) -> Panel | None:
    figure = _figure("time in the log [s]", f"{axis.symbol} [{axis.unit}]")
    limit = max(100, _POINTS // len(diagnosis.train))
    for name, missing in lacking(diagnosis).items():
        there = np.flatnonzero(known(missing, axis.index, log))
        there = there[np.argsort(missing.t[there], kind="stable")]
        there = there[thinned(there.size, limit)]
        if there.size:
            std = np.nan_to_num(finite(missing.std[there, axis.index]))
            _add_band(figure, name, missing.t[there], missing.wrench[there, axis.index], 2 * std)
    if not figure.data:
        return None
    for since in beginnings(diagnosis, log):
        figure.add_vline(x=since, line=_MARK)
    description = f"{axis.title} that the model lacks over the time of {diagnosis.train[log]}."
    return Panel(f"missing-{log}-{axis.index}", axis.title, description, figure)


def missing_velocity_chart(diagnosis: Diagnosis) -> Chart | None:
    """Missing wrench against the velocity of its own axis."""
    axes = free_axes(diagnosis.vehicle.dof)
    panels = [_missing_over_velocity(diagnosis, axis) for axis in axes]
    panels = [panel for panel in panels if panel is not None]
    if not panels:
        return None
    shown = compared(diagnosis)
    last = "blue points" if "after" in shown else "points"
    return Chart(
        key="missing-velocity",
        title="Missing force and moment against velocity",
        caption=(
            "The same, against the velocity of the same axis. A slope or a bend is damping that "
            f"the model does not have, an offset is a constant push; the {last} should lie level "
            "around zero."
        ),
        legend=shown,
        sheets=(Sheet("", tuple(panels)),),
    )


def _missing_over_velocity(diagnosis: Diagnosis, axis: Axis) -> Panel | None:
    figure = _figure(axis.velocity_title, f"{axis.symbol} [{axis.unit}]")
    for name, missing in lacking(diagnosis).items():
        velocity = finite(missing.velocity[:, axis.index]) * axis.velocity_scale
        there = np.flatnonzero(known(missing, axis.index) & np.isfinite(velocity))
        there = there[thinned(there.size, _POINTS)]
        if there.size:
            figure.add_scatter(
                x=_short(velocity[there]),
                y=_short(missing.wrench[there, axis.index]),
                mode="markers",
                marker={"color": _COLOURS[name], "size": 5, "opacity": 0.55},
                name=name,
            )
    if not figure.data:
        return None
    description = f"{axis.title} that the model lacks against {axis.velocity_title}."
    return Panel(f"missing-velocity-{axis.index}", axis.title, description, figure)


def trajectory_chart(diagnosis: Diagnosis) -> Chart | None:
    """Typical predictions beside the log, one sheet per channel."""
    predictions = diagnosis.predictions
    courses = tuple(course(predictions, start) for start in typical_starts(predictions))
    chosen = telling_channel(predictions)
    if not courses or chosen is None:
        return None
    shown, channels = compared(diagnosis), measured_channels(predictions)
    sheets = [
        Sheet(
            f"{CHANNEL_TITLES[channel]} [{shown_unit(channel)}]",
            tuple(_over_time(c, i, channel, shown) for i, c in enumerate(courses)),
        )
        for channel in channels
    ]
    if "x" in channels and "y" in channels:
        tracks = tuple(_track(c, i, shown) for i, c in enumerate(courses))
        sheets.append(Sheet("track, north over east [m]", tracks))
    return Chart(
        key="trajectory",
        title="Predicted and measured",
        caption=(
            f"{count(len(courses), 'prediction').capitalize()} with an error that is typical of "
            f"all {len(predictions.times)} (the median before). Left of the dotted line lies the "
            "data from which the start is estimated; right of it the model sees the commands only. "
            f"{'Blue' if 'after' in shown else 'Orange'} should follow grey."
        ),
        legend=("measured", *shown),
        sheets=tuple(sheets),
        choice="Channel",
        chosen=channels.index(chosen),
    )


def _over_time(c: Course, i: int, channel: str, shown: tuple[str, ...]) -> Panel:
    column = CHANNELS.index(channel)
    figure = _figure("time since the start [s]", f"{channel} [{shown_unit(channel)}]")
    measured = c.curves["measured"][:, column]
    _add_line(figure, "measured", c.ahead, measured, _QUIET, width=5.0, opacity=0.6)
    for name in shown:
        _add_line(figure, name, c.ahead, c.curves[name][:, column], _COLOURS[name])
    if c.ahead[0] < 0:
        figure.add_vline(x=0.0, line=_MARK)
    start = number(c.begin, 4)
    description = f"{CHANNEL_TITLES[channel]}, predicted from t = {start} s, and measured."
    return Panel(f"trajectory-{channel}-{i}", f"Start at t = {start} s", description, figure)


def _track(c: Course, i: int, shown: tuple[str, ...]) -> Panel:
    figure = _figure("east y [m]", "north x [m]")
    north, east = CHANNELS.index("x"), CHANNELS.index("y")
    track = {name: curve[c.ahead >= 0] for name, curve in c.curves.items()}
    measured = track["measured"]
    _add_line(figure, "measured", measured[:, east], measured[:, north], _QUIET, "solid", 5.0, 0.6)
    for name in shown:
        _add_line(figure, name, track[name][:, east], track[name][:, north], _COLOURS[name])
    figure.update_yaxes(scaleanchor="x", scaleratio=1)
    start = number(c.begin, 4)
    description = f"Track seen from above, predicted from t = {start} s, and measured."
    return Panel(f"trajectory-track-{i}", f"Start at t = {start} s", description, figure)


def _add_line(
    figure: go.Figure,
    name: str,
    x: np.ndarray,
    y: np.ndarray,
    colour: str,
    dash: str = "solid",
    width: float = 2.2,
    opacity: float = 1.0,
) -> None:
    figure.add_scatter(
        x=_short(x),
        y=_short(y),
        mode="lines",
        line={"color": colour, "dash": dash, "width": width},
        opacity=opacity,
        name=name,
    )


def _add_band(figure: go.Figure, name: str, x: np.ndarray, y: np.ndarray, half: np.ndarray) -> None:
    """A line in the middle of a band."""
    figure.add_scatter(
        x=_short(np.concatenate([x, x[::-1]])),
        y=_short(np.concatenate([y + half, (y - half)[::-1]])),
        mode="lines",
        fill="toself",
        fillcolor=_BANDS[name],
        line={"width": 0},
        hoverinfo="skip",
        name=f"{name} ± 2 std",
    )
    _add_line(figure, name, x, y, _COLOURS[name], width=1.6)


def _short(values: np.ndarray) -> np.ndarray:
    """Single precision where the eye cannot tell it: half the page."""
    values = finite(values)
    small = np.nanmax(np.abs(values), initial=0.0) < 1e4
    return values.astype(np.float32) if small else values


def _figure(x_title: str, y_title: str) -> go.Figure:
    """An empty panel; titles are escaped, because plotly reads a little HTML in them."""
    axis = {
        "automargin": True,
        "zeroline": True,
        "showline": False,
        "ticks": "outside",
        "ticklen": 4,
    }
    return go.Figure(
        layout={
            "template": go.layout.Template(),
            "xaxis": {
                **axis,
                "title": {"text": html.escape(x_title), "standoff": 8},
                "zeroline": False,
            },
            "yaxis": {**axis, "title": {"text": html.escape(y_title), "standoff": 6}, "nticks": 6},
            "margin": {"l": 8, "r": 10, "t": 8, "b": 8},
            "height": 250,
            "showlegend": False,
            "hovermode": "closest",
            "paper_bgcolor": "rgba(0,0,0,0)",
            "plot_bgcolor": "rgba(0,0,0,0)",
        }
    )
