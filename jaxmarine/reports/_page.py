"""The page: what the template shows, put together from words and figures."""

import dataclasses
import importlib.metadata
import json
import math
from pathlib import Path
from typing import Any

import jinja2
import markupsafe
import numpy as np
from plotly.offline import get_plotlyjs

from .._types import CHANNEL_UNITS, CHANNELS, DOFS, SENSORS
from ..diagnosis import BeforeAfter, Diagnosis, Finding, Recalibrated, Weighed
from ..fitting import AxisCheck, sparkline
from ..fitting import percent as relative
from . import _words as words
from ._causes import kind, title, what
from ._curves import compared, leading, measured_channels, taken_suspects
from ._figures import (
    Chart,
    error_chart,
    missing_time_chart,
    missing_velocity_chart,
    trajectory_chart,
)
from ._numbers import count, interval, joined, number, percent, plus_minus, unit_on

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
    remark: str


def page(diagnosis: Diagnosis) -> str:
    """The whole page as one text."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["marked"] = _marked
    charts = {
        "error": error_chart(diagnosis),
        "missing": missing_time_chart(diagnosis),
        "missing_velocity": missing_velocity_chart(diagnosis),
        "trajectory": trajectory_chart(diagnosis),
    }
    return environment.get_template("page.html.j2").render(
        d=diagnosis,
        verdict=words.verdict(diagnosis),
        explanation=words.explanation(diagnosis),
        facts=_facts(diagnosis),
        cards=[_card(finding, diagnosis) for finding in diagnosis.findings],
        checked=_checked(diagnosis),
        charts=charts,
        figures=_figures(charts),
        rounds=_rounds(diagnosis),
        parameters=[row for finding in diagnosis.findings for row in _parameters(finding)],
        groups=[
            (joined([title(label) for label in group]), diagnosis.causes_of(group))
            for group in diagnosis.groups
        ],
        recalibrated=[_recalibrated(entry) for entry in diagnosis.recalibrated],
        remainder=words.remainder(diagnosis),
        gain=words.gain_words(diagnosis),
        held_out=words.held_out(diagnosis),
        gains=_gains(diagnosis),
        horizon=number(diagnosis.gain.horizon),
        told=[_told(axis) for axis in diagnosis.check.axes],
        done=_done(diagnosis),
        plotly=markupsafe.Markup(get_plotlyjs()),
    )


def _marked(text: str) -> markupsafe.Markup:
    """The text escaped, with what stands between backticks as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # a backtick of the user's own: nothing is marked
        return markupsafe.escape(text)
    return markupsafe.Markup("").join(
        markupsafe.Markup("<code>{}</code>").format(part) if i % 2 else markupsafe.escape(part)
        for i, part in enumerate(parts)
    )


def _figures(charts: dict[str, Chart | None]) -> dict[str, Any]:
    """Data and layout of every panel, by its key."""
    return {
        panel.key: json.loads(str(panel.figure.to_json()))
        for chart in charts.values()
        if chart is not None
        for sheet in chart.sheets
        for panel in sheet.panels
    }


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """The few numbers at the top: what, how much, explained."""
    gain = diagnosis.gain
    shown = compared(diagnosis)
    misfits = {"before": diagnosis.misfit_before, "after": diagnosis.misfit_after}
    named = sum(finding.named for finding in diagnosis.findings)
    return [
        ("Named causes", str(named), "found in the training logs"),
        (
            "Chi-square per sample",
            " → ".join(number(misfits[name], 2) for name in shown),
            f"{' → '.join(shown)}; 1 is sensor noise" if len(shown) > 1 else "1 is sensor noise",
        ),
        (
            "Prediction error left",
            percent(gain.ratio),
            f"over {number(gain.horizon)} s, {'' if gain.held_out else 'not '}held out; "
            "the log's own noise counts in it",
        ),
    ]


def _card(finding: Finding, diagnosis: Diagnosis) -> Card:
    rivals = words.rivals(finding, diagnosis.groups)
    if not finding.named:
        other = ""
    elif rivals:
        names = joined([title(label) for label in rivals], "or")
        other = f"These logs cannot tell it from: {names}."
    else:
        other = "Nothing else that was weighed explains these logs as well."
        other = f"{other} {words.next_best(finding)}".strip()
    return Card(
        heading=title(finding.label),
        what=what(finding, diagnosis.vehicle),
        advice=words.advice(finding, diagnosis.catalogue),
        sure=words.sureness(finding.log_evidence)
        + (" This holds for the finding or what it cannot be told from." if rivals else ""),
        rivals=other,
        deciding=words.deciding((finding.label, *rivals), diagnosis.catalogue) if rivals else "",
    )


def _checked(diagnosis: Diagnosis) -> str:
    """Which causes were weighed, for a reader who wonders what was looked for."""
    labels = {suspect.label.partition(":")[0] for round_ in diagnosis.rounds for suspect in round_}
    return joined(sorted(kind(label) for label in labels))


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
            out.append((i, len(suspects), [_row(s, taken, largest, diagnosis) for s in shown]))
    return out


def _row(suspect: Weighed, taken: Weighed | None, largest: float, diagnosis: Diagnosis) -> Row:
    evidence = suspect.log_evidence
    part = evidence / largest if math.isfinite(evidence) else 0.0
    values = words.values(suspect.label, suspect.parameters, diagnosis.catalogue)
    begins = "" if suspect.since is None else f", since {number(suspect.since)} s"
    return Row(
        title=title(suspect.label) + begins,
        evidence=number(evidence),
        width=round(100 * min(max(part, 0.0), 1.0), 1),
        taken=suspect is taken,
        remark=values,
    )


def _parameters(finding: Finding) -> list[tuple[str, str, str, str, str]]:
    """Cause, parameter, value with standard error, 95 % interval, unit."""
    return [
        (
            title(finding.label),
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


def _gains(diagnosis: Diagnosis) -> list[tuple[str, str, str, str]]:
    """What, before, after, left."""
    gain = diagnosis.gain
    return [
        ("Position error (rms, all axes together)", *_pair(gain.position, "m")),
        ("Velocity error (rms, all axes together)", *_pair(gain.velocity, "m/s")),
        (
            "All channels, in units of noise",
            "100 %",
            percent(gain.ratio),
            percent(gain.ratio),
        ),
    ]


def _pair(errors: BeforeAfter | None, unit: str) -> tuple[str, str, str]:
    if errors is None:
        return "not measured", "not measured", "–"
    left = percent(errors.after / errors.before) if errors.before else "–"
    return f"{number(errors.before)} {unit}", f"{number(errors.after)} {unit}", left


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
        ("Training logs", ", ".join(f"`{name}`" for name in diagnosis.train)),
        ("Test log", f"`{diagnosis.test}`"),
        ("Measured in the test log", channels or "nothing"),
        ("Sensor noise", _noises(diagnosis) or "none is measured"),
        (
            "Predictions",
            f"{count(diagnosis.gain.starts, 'start')} on the test log, "
            f"{number(diagnosis.gain.horizon)} s each",
        ),
        (
            "Search",
            f"{count(len(diagnosis.rounds), 'round')}, each of which scores every suspect and refits the "
            f"most promising: {count(sum(map(len, diagnosis.rounds)), 'refit')} in all",
        ),
        ("Program", f"jaxmarine {importlib.metadata.version('jaxmarine')}"),
    ]


def _noises(diagnosis: Diagnosis) -> str:
    """The standard deviations that were used, of each kind of sensor: the median over its channels."""
    noise = dict(zip(CHANNELS, diagnosis.predictions.noise, strict=True))
    stated = dict(diagnosis.vehicle.sensors)
    out = []
    for sensor, names in SENSORS.items():
        used = [noise[name] for name in names if np.isfinite(noise[name])]
        if used:
            whence = "stated" if sensor in stated else "estimated"
            size = f"{number(float(np.median(used)), 2)} {CHANNEL_UNITS[names[0]]}"
            out.append(f"{sensor.replace('_', ' ')} {size} ({whence})")
    return ", ".join(out)
