"""The figures of the page and of the print: small panels, laid out in a grid.

One panel is one plot, so that a narrow screen stacks them. A chart with several sheets shows one at a time.
All colours come from the page, which knows whether it is light or dark.
"""

import dataclasses

import numpy as np

from .._numbers import count, joined, number, percent
from .._types import ALL_CHANNELS
from ..diagnosis import BANDS, Diagnosis, MissingWrench, Predictions
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
    tested,
    thinned,
    typical_starts,
)
from ._svg import Plot

# Of a curve, which is about what a panel has pixels; of all logs together, of which one is seen at a time.
_POINTS, _POINTS_OF_ALL = 400, 1000


@dataclasses.dataclass(frozen=True)
class Panel:
    """One plot with its heading and a description for those who cannot see it."""

    key: str
    title: str
    description: str
    figure: Plot


@dataclasses.dataclass(frozen=True)
class Sheet:
    """Panels that are shown together."""

    name: str
    panels: tuple[Panel, ...]


@dataclasses.dataclass(frozen=True)
class Chart:
    """A captioned set of panels; with several sheets, `choice` says what the reader chooses.

    `legend` names the marks in use: before, after, noise, measured, band, since; `band`: what a band holds.
    """

    key: str
    title: str
    caption: str
    legend: tuple[str, ...]
    sheets: tuple[Sheet, ...]
    choice: str = ""
    chosen: int = 0
    band: str = ""


def error_chart(diagnosis: Diagnosis) -> Chart | None:
    """Prediction error against horizon, one panel per sensor kind."""
    shown = compared(diagnosis)
    groups = errors_by_horizon(diagnosis.predictions)
    if not groups:
        return None
    log = tested(diagnosis)
    caption = (
        f"The model is started from {log} and then left alone with the commands. See how far "
        "it drifts off: the blue line (extended vehicle) should stay near the dashed noise level, "
        "where the orange one (vehicle file) climbs. Errors are per axis, averaged over the axes."
    )
    if len(shown) == 1:
        caption = (
            f"The model is started from {log} and then left alone with the commands. Its "
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
    figure = Plot("prediction horizon [s]", f"rms error [{group.unit}]", from_zero=True)
    ends = group.horizon[[0, -1]]
    if np.isfinite(group.noise):
        figure.line("noise", ends, np.full(2, group.noise))
    for name in shown:
        figure.line(name, group.horizon, group.errors[name])
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
        band="± 2 standard deviations",
    )


def _lack(missing: MissingWrench, log: int) -> float:
    """How much is missing in a log: mean square in units of its uncertainty."""
    size = finite(missing.wrench / missing.std)[missing.log == log]
    size = size[np.isfinite(size)]
    return float(np.mean(size**2)) if size.size else 0.0


def _missing_over_time(diagnosis: Diagnosis, axis: Axis, log: int) -> Panel | None:
    figure = Plot("time since the log's start [s]", f"{axis.symbol} [{axis.unit}]")
    limit = min(_POINTS, max(100, _POINTS_OF_ALL // len(diagnosis.train)))
    clock = diagnosis.clocks.get(diagnosis.train[log], 0.0)
    for name, missing in lacking(diagnosis).items():
        there = np.flatnonzero(known(missing, axis.index, log))
        there = there[np.argsort(missing.t[there], kind="stable")]
        there = there[thinned(there.size, limit)]
        if there.size:
            std = np.nan_to_num(finite(missing.std[there, axis.index]))
            t, wrench = missing.t[there] - clock, finite(missing.wrench[there, axis.index])
            figure.band(name, t, wrench - 2 * std, wrench + 2 * std)
            figure.line(name, t, wrench)
    if figure.empty:
        return None
    for since in beginnings(diagnosis, log):
        figure.mark(since - clock)
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
    figure = Plot(axis.velocity_title, f"{axis.symbol} [{axis.unit}]")
    for name, missing in lacking(diagnosis).items():
        velocity = finite(missing.velocity[:, axis.index]) * axis.velocity_scale
        there = np.flatnonzero(known(missing, axis.index) & np.isfinite(velocity))
        there = there[thinned(there.size, _POINTS)]
        if there.size:
            figure.points(name, velocity[there], finite(missing.wrench[there, axis.index]))
    if figure.empty:
        return None
    description = f"{axis.title} that the model lacks against {axis.velocity_title}."
    return Panel(f"missing-velocity-{axis.index}", axis.title, description, figure)


def trajectory_chart(diagnosis: Diagnosis) -> Chart | None:
    """Typical predictions beside the log, one sheet per channel."""
    predictions = diagnosis.predictions
    clock = diagnosis.clocks.get(predictions.log, 0.0)
    courses = tuple(course(predictions, start, clock) for start in typical_starts(predictions))
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
            f"all {len(predictions.times)} on {tested(diagnosis)} (the median before). Left of the dotted "
            "line lies the data from which the start is estimated; right of it the model sees the commands "
            "only. "
            f"{'Blue' if 'after' in shown else 'Orange'} should follow grey." + _banded(predictions)
        ),
        legend=("measured", *shown, *(() if predictions.band is None else ("band",))),
        sheets=tuple(sheets),
        choice="Channel",
        chosen=channels.index(chosen),
        band=f"{percent(BANDS)} of predictions",
    )


def _banded(predictions: Predictions) -> str:
    """What the band holds, in a sentence, where there is one."""
    if predictions.held is None:
        return ""
    return (
        f" The band is as wide as {percent(BANDS)} of the predictions of the training logs were off; here it "
        f"holds {percent(predictions.held)} of what was measured."
    )


def _over_time(c: Course, i: int, channel: str, shown: tuple[str, ...]) -> Panel:
    column = ALL_CHANNELS.index(channel)
    figure = Plot("time since the start [s]", f"{channel} [{shown_unit(channel)}]")
    if c.band is not None:
        later = c.ahead >= 0
        middle, half = c.curves[shown[-1]][later, column], c.band[later, column]
        figure.band(shown[-1], c.ahead[later], middle - half, middle + half)
    for name in ("measured", *shown):
        figure.line(name, c.ahead, c.curves[name][:, column])
    if c.ahead[0] < 0:
        figure.mark(0.0)
    description = f"{CHANNEL_TITLES[channel]}, predicted from {c.start}, and measured."
    return Panel(f"trajectory-{channel}-{i}", f"Start at {c.start}", description, figure)


def _track(c: Course, i: int, shown: tuple[str, ...]) -> Panel:
    figure = Plot("east y [m]", "north x [m]", equal=True)
    north, east = ALL_CHANNELS.index("x"), ALL_CHANNELS.index("y")
    track = {name: curve[c.ahead >= 0] for name, curve in c.curves.items()}
    for name in ("measured", *shown):
        figure.line(name, track[name][:, east], track[name][:, north])
    description = f"Track seen from above, predicted from {c.start}, and measured."
    return Panel(f"trajectory-track-{i}", f"Start at {c.start}", description, figure)
