"""The page: what the template shows, put together from words and figures."""

import dataclasses
import math
from pathlib import Path

import jinja2
import markupsafe
import numpy as np

from .._numbers import count, interval, joined, number, percent, plus_minus, unit_on
from .._types import ALL_CHANNELS, ALL_SENSORS, CHANNEL_UNITS, DOFS
from .._version import __version__
from ..diagnosis import BeforeAfter, Diagnosis, Finding, Recalibrated, Weighed
from ..fitting import AxisCheck, sparkline
from ..fitting import percent as relative
from ..logs import moment
from . import _words as words
from ._causes import title, what
from ._curves import (
    CHANNEL_TITLES,
    GROUP_TITLES,
    compared,
    leading,
    measured_channels,
    shown_scale,
    shown_unit,
    taken_suspects,
)
from ._figures import (
    error_chart,
    missing_time_chart,
    missing_velocity_chart,
    trajectory_chart,
)
from ._svg import Plot

_SHOWN = 8  # suspects per round


@dataclasses.dataclass(frozen=True)
class Card:
    """A finding for the first section; empty texts are left out."""

    heading: str
    what: str
    advice: str
    sure: str
    rivals: str
    deciding: str


@dataclasses.dataclass(frozen=True)
class Row:
    """A line of a round's ranking; `width` [%] of its bar."""

    title: str
    evidence: str
    width: float
    taken: bool
    dropped: bool
    remark: str


@dataclasses.dataclass(frozen=True)
class Error:
    """A line of the gain's table: a quantity or one of its channels; `worse` than before for certain."""

    name: str
    before: str
    after: str
    left: str
    interval: str
    channel: bool = False
    worse: bool = False


def page(diagnosis: Diagnosis) -> str:
    """The whole page as one text."""
    charts = {
        "error": error_chart(diagnosis),
        "missing": missing_time_chart(diagnosis),
        "missing_velocity": missing_velocity_chart(diagnosis),
        "trajectory": trajectory_chart(diagnosis),
    }
    return (
        templates(Path(__file__).parent)
        .get_template("page.html.j2")
        .render(
            d=diagnosis,
            verdict=words.verdict(diagnosis),
            explanation=words.explanation(diagnosis),
            yardstick=words.yardstick(diagnosis),
            facts=_facts(diagnosis),
            cards=[_card(finding, diagnosis) for finding in diagnosis.findings],
            checked=_checked(diagnosis),
            charts=charts,
            rounds=_rounds(diagnosis),
            parameters=[row for finding in diagnosis.findings for row in _parameters(finding, diagnosis)],
            groups=[
                (joined([title(label, diagnosis.catalogue) for label in group]), diagnosis.causes_of(group))
                for group in diagnosis.groups
            ],
            recalibrated=[_recalibrated(entry) for entry in diagnosis.recalibrated],
            remainder=words.remainder(diagnosis),
            gain=words.gain_words(diagnosis),
            held_out=words.held_out(diagnosis),
            gains=_gains(diagnosis),
            per_log=_per_log(diagnosis),
            warnings=diagnosis.warnings,
            notes=[note for note in diagnosis.notes if note not in diagnosis.warnings],
            dropped=[(title(one.label, diagnosis.catalogue), one.reason) for one in diagnosis.dropped],
            horizon=number(diagnosis.gain.horizon),
            told=[_told(axis) for axis in (diagnosis.check.axes if diagnosis.check else ())],
            done=_done(diagnosis),
        )
    )


def templates(*folders: Path) -> jinja2.Environment:
    """The templates in some folders; what they show is escaped, and a plot is drawn."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["marked"] = _marked
    environment.filters["drawn"] = _drawn
    return environment


def _drawn(plot: Plot) -> markupsafe.Markup:
    return markupsafe.Markup(plot.svg())


def _marked(text: str) -> markupsafe.Markup:
    """The text escaped, with what stands between backticks as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # a backtick of the user's own: nothing is marked
        return markupsafe.escape(text)
    return markupsafe.Markup("").join(
        markupsafe.Markup("<code>{}</code>").format(part) if i % 2 else markupsafe.escape(part)
        for i, part in enumerate(parts)
    )


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """The few numbers at the top: what, how much, explained."""
    gain = diagnosis.gain
    shown = compared(diagnosis)
    misfits = {"before": diagnosis.misfit_before, "after": diagnosis.misfit_after}
    named = sum(finding.named for finding in diagnosis.findings)
    unknown = joined([finding.target or "" for finding in diagnosis.findings if not finding.named])
    found = "found in the training logs"
    if unknown:
        found = (
            f"besides, something unknown acts in {unknown}"
            if named
            else f"something unknown acts in {unknown}"
        )
    elif not named and diagnosis.dropped:
        found = "what was found at first did not hold"
    return [
        ("Named causes", str(named) if named else "none", found),
        (
            "Chi-square per sample",
            " → ".join(number(misfits[name], 2) for name in shown),
            (f"{' → '.join(shown)}; " if len(shown) > 1 else "") + f"1 is {words.yardstick(diagnosis)}",
        ),
        (
            "Prediction error left",
            percent(gain.ratio),
            f"over {number(gain.horizon)} s, {'' if gain.held_out else 'not '}held out; "
            + (f"worse in {joined(list(gain.worse))}" if gain.worse else "the log's own noise counts in it"),
        ),
    ]


def _card(finding: Finding, diagnosis: Diagnosis) -> Card:
    rivals = words.rivals(finding, diagnosis.groups)
    if not finding.named:
        other = ""
    elif rivals:
        names = joined([title(label, diagnosis.catalogue) for label in rivals], "or")
        other = f"These logs cannot tell it from: {names}."
    else:
        other = "Nothing else that was weighed explains these logs as well."
        other = f"{other} {words.next_best(finding, diagnosis.catalogue)}".strip()
    return Card(
        heading=title(finding.label, diagnosis.catalogue),
        what=what(finding, diagnosis.vehicle, diagnosis.clock_of(finding), diagnosis.catalogue),
        advice=words.advice(finding, diagnosis.catalogue),
        sure=words.sureness(
            finding.log_evidence,
            "" if finding.named else "That something acts there",
            finding.named and diagnosis.doubted is not None,
        )
        + (" This holds for the finding or what it cannot be told from." if rivals else ""),
        rivals=other,
        deciding=words.deciding((finding.label, *rivals), diagnosis.catalogue) if rivals else "",
    )


def _checked(diagnosis: Diagnosis) -> str:
    """Which causes were weighed, for a reader who wonders what was looked for."""
    labels = {suspect.label.partition(":")[0] for round_ in diagnosis.rounds for suspect in round_}
    return joined(sorted(title(label, diagnosis.catalogue) for label in labels))


def _rounds(diagnosis: Diagnosis) -> list[tuple[int, int, list[Row]]]:
    """Per round: its number, how many suspects were refitted in it, and the best few of them."""
    out = []
    for i, (suspects, taken) in enumerate(
        zip(diagnosis.rounds, taken_suspects(diagnosis), strict=True), start=1
    ):
        shown = leading(suspects, taken, _SHOWN)
        sizes = [s.log_evidence for s in shown if math.isfinite(s.log_evidence)]
        largest = max([*sizes, words.VERY_STRONG])
        if shown:
            # The best of a round that was taken and does not stand in the answer.
            gone = {one.label for one in diagnosis.dropped} if taken is None else set()
            rows = [_row(s, taken, s is suspects[0] and s.label in gone, largest, diagnosis) for s in shown]
            out.append((i, len(suspects), rows))
    return out


def _row(suspect: Weighed, taken: Weighed | None, dropped: bool, largest: float, diagnosis: Diagnosis) -> Row:
    evidence = suspect.log_evidence
    part = evidence / largest if math.isfinite(evidence) else 0.0
    values = words.values(suspect.label, suspect.parameters, diagnosis.catalogue)
    begins = ""
    if suspect.since is not None:
        begins = f", since {moment(suspect.since, diagnosis.clock_of(suspect), '.3g')}"
    return Row(
        title=title(suspect.label, diagnosis.catalogue) + begins,
        evidence=number(evidence),
        width=round(100 * min(max(part, 0.0), 1.0), 1),
        taken=suspect is taken,
        dropped=dropped,
        remark=values,
    )


def _parameters(finding: Finding, diagnosis: Diagnosis) -> list[tuple[str, str, str, str, str]]:
    """Cause, parameter, value with standard error, 95 % interval, unit."""
    return [
        (
            title(finding.label, diagnosis.catalogue),
            name,
            plus_minus(p.value, p.std),
            interval(p.value, p.std),
            unit_on(p.unit, finding.target),
        )
        for name, p in finding.parameters.items()
    ]


def _recalibrated(entry: Recalibrated) -> tuple[str, str, str, str, str]:
    """Coefficient, in the file, refitted, change, unit."""
    change = "–"
    if entry.file_value != 0 and math.isfinite(entry.value / entry.file_value):
        ratio = 100 * (entry.value / entry.file_value - 1)
        change = f"{'+' if ratio >= 0 else ''}{number(ratio, 2)} %"
    return (
        title(entry.label),
        number(entry.file_value),
        plus_minus(entry.value, entry.std),
        change,
        entry.unit,
    )


def _gains(diagnosis: Diagnosis) -> list[Error]:
    """Each quantity with its channels, and all together."""
    gain, out = diagnosis.gain, []
    for name, error in gain.quantities.items():
        what = f"{GROUP_TITLES[name]} error (rms, all axes together)"
        out.append(_error(what, error, ALL_SENSORS[name][0]))
        out += [
            _error(CHANNEL_TITLES[channel], gain.channels[channel], channel, channel=True)
            for channel in ALL_SENSORS[name]
            if channel in gain.channels
        ]
    ends = "–" if gain.ratio_ci95 is None else " to ".join(map(percent, gain.ratio_ci95))
    left = percent(gain.ratio)
    return [*out, Error("All channels, in units of noise", "100 %", left, left, ends)]


def _error(name: str, error: BeforeAfter | None, channel_of: str, channel: bool = False) -> Error:
    if error is None:
        return Error(name, "not measured", "not measured", "–", "–")
    unit, scale = shown_unit(channel_of), shown_scale(channel_of)
    return Error(
        name,
        f"{number(scale * error.before)} {unit}",
        f"{number(scale * error.after)} {unit}",
        "–" if error.ratio is None else percent(error.ratio),
        "–" if error.ratio_ci95 is None else " to ".join(map(percent, error.ratio_ci95)),
        channel,
        error.worse,
    )


def _per_log(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """Name, starts, left, interval of each test log, where there are several."""
    logs = diagnosis.gain.per_log
    return [
        (
            one.name,
            str(one.starts),
            percent(one.ratio),
            "–" if one.ratio_ci95 is None else " to ".join(map(percent, one.ratio_ci95)),
        )
        for one in (logs if len(logs) > 1 else ())
    ]


def _rejected(diagnosis: Diagnosis) -> str:
    """Stretches of logs that were left out, by the time since each log's start."""
    parts = []
    for one in diagnosis.rejected:
        clock = diagnosis.clocks.get(one.log, 0.0)
        ends = (moment(one.start, clock, ".1f"), moment(one.end, clock, ".1f").removeprefix("t = "))
        parts.append(f"`{one.log}` {' to '.join(ends)} ({one.reason})")
    return ", ".join(parts)


def _told(axis: AxisCheck) -> tuple[str, str, str, str, str, list[tuple[str, str]]]:
    """Axis, whether it is excited, its slowest velocity, bars, its fastest, relative errors by head."""
    low, high = (number(v, 2) for v in axis.coverage.velocity_range)
    unit = "m/s" if axis.dof in DOFS[:3] else "rad/s"
    errors = {
        "Inertia": axis.inertia,
        "Damping force": axis.damping,
        "Linear": axis.linear,
        "Quadratic": axis.quadratic,
    }
    bars = sparkline(axis.coverage.velocity_shares)
    return (
        axis.dof,
        axis.excited,
        low,
        bars,
        f"{high} {unit}",
        [(head, relative(e)) for head, e in errors.items()],
    )


def _done(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """What the diagnosis was made from."""
    vehicle = diagnosis.vehicle
    channels = ", ".join(f"`{name}`" for name in measured_channels(diagnosis.predictions))
    return [
        ("Vehicle", f"{vehicle.name}, free in {joined(vehicle.dof)}"),
        ("Thrusters", ", ".join(f"`{name}`" for name in vehicle.thruster_names) or "none"),
        *((one.title, ", ".join(f"`{name}`" for name in one.names)) for one in vehicle.actuators),
        ("Training logs", ", ".join(f"`{name}`" for name in diagnosis.train)),
        (
            "Test log" if len(diagnosis.tests) == 1 else "Test logs",
            ", ".join(f"`{name}`" for name in diagnosis.tests),
        ),
        ("Measured in the test log", channels or "nothing"),
        *([("Left out", _rejected(diagnosis))] if diagnosis.rejected else []),
        ("Sensor noise", _noises(diagnosis) or "none is measured"),
        (
            "Predictions",
            f"{count(diagnosis.gain.starts, 'start')} on {count(len(diagnosis.tests), 'test log')}, "
            f"{number(diagnosis.gain.horizon)} s each",
        ),
        (
            "Search",
            f"{count(len(diagnosis.rounds), 'round')}, each of which scores every suspect and refits the "
            f"most promising: {count(sum(map(len, diagnosis.rounds)), 'refit')} in all",
        ),
        ("Program", f"jaxmarine {__version__}"),
    ]


def _noises(diagnosis: Diagnosis) -> str:
    """The standard deviations that were used, of each kind of sensor: the median over its channels."""
    noise = dict(zip(ALL_CHANNELS, diagnosis.predictions.noise, strict=False))
    stated = dict(diagnosis.vehicle.sensors)
    out = []
    for sensor, names in ALL_SENSORS.items():
        used = [noise[name] for name in names if np.isfinite(noise.get(name, np.nan))]
        if used:
            whence = "stated" if sensor in stated else "estimated"
            size = f"{number(float(np.median(used)), 2)} {CHANNEL_UNITS[names[0]]}"
            out.append(f"{sensor.replace('_', ' ')} {size} ({whence})")
    return ", ".join(out)
