"""The page of a fleet: which craft has what since when, sizes over dates, and every log with its report."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from .._numbers import number, percent, plus_minus, unit_on
from ..reports import Plot, templates, title
from ._history import Rows, Series, by_craft, by_log, label_of, present, series_of
from ._rows import Row
from ._told import Notice, notices

_DAY = 86400.0  # s
_VERDICTS = {
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
    "nothing_found": "nothing found",
}


@dataclasses.dataclass(frozen=True)
class Cell:
    """What a cell shows, and the number or text that its column is sorted by."""

    text: str
    by: str
    link: str | None = None


def page(rows: Sequence[Row]) -> str:
    """The page of a fleet, whole; `rows`: of its table."""
    here = Path(__file__).parent
    logs, crafts = by_log(rows), by_craft(rows)
    series = [one for craft, own in crafts.items() for one in series_of(craft, own)]
    return (
        templates(here, here.parent / "reports")
        .get_template("fleet.html.j2")
        .render(
            logs=len(logs),
            craft=len(crafts),
            wrong=sum(log[0]["error"] is not None for log in logs),
            states=[row for craft, own in crafts.items() for row in _states(craft, own)],
            alarms=[_alarm(one) for one in notices(rows)],
            panels=[_panel(one) for one in series if len(one.sizes) > 1],
            rows=[_log(log) for log in logs],
        )
    )


def _alarm(one: Notice) -> list[Cell]:
    """Craft, what, since when, how sure."""
    if one.series is None:
        return [_cell(one.craft), _cell(f"New: {title(one.label)}"), _when(one.first), _cell("")]
    what = f"{title(one.label)}: {one.series.parameter} has left its level"
    sure = Cell(f"{number(one.nats or 0.0)} nats", str(one.nats))
    return [_cell(one.craft), _cell(what), _when(one.first), sure]


def _states(craft: str, logs: Sequence[Rows]) -> Iterator[list[Cell]]:
    """Craft, class, logs, the latest one, what it has, how large, since when: a row for each thing it has."""
    usable = [log for log in logs if log[0]["error"] is None]
    kind = usable[-1][0]["kind"] if usable else ""
    begin = [_cell(craft), _cell(kind), _cell(str(len(logs)))]
    if not usable:
        yield [*begin, _cell("–"), _cell("no log could be used"), _cell(""), _cell("")]
        return
    begin.append(_when(usable[-1][0]))
    found = present(usable)
    for first, last in found:
        yield [*begin, _cell(title(label_of(last) or "")), _cell(_sizes(last)), _when(first)]
    if not found:
        yield [*begin, _cell("nothing"), _cell(""), _cell("")]


def _log(log: Rows) -> list[Cell]:
    """Log, craft, date, verdict, what was found or the sentence, error left."""
    one, wrong = log[0], log[0]["error"]
    named = [title(label) for label in map(label_of, log) if label is not None]
    gain = one.get("gain")
    return [
        Cell(one["name"], one["name"], one["report"]),
        _cell(one["craft"]),
        _when(one) if one["date"] else _cell(""),
        _cell("not used" if wrong else _VERDICTS[one["verdict"]]),
        _cell(wrong or ", ".join(named)),
        _cell("") if gain is None else Cell(percent(gain), str(gain)),
    ]


@dataclasses.dataclass(frozen=True)
class Panel:
    """A plot of sizes over dates."""

    title: str
    description: str
    figure: Plot


def _panel(series: Series) -> Panel:
    dates = [date for date in series.dates if date is not None]
    if len(dates) == len(series.dates):
        across, x = (
            f"days since {dates[0]:%Y-%m-%d}",
            [(date - dates[0]).total_seconds() / _DAY for date in dates],
        )
    else:
        across, x = "log", range(1, len(series.dates) + 1)
    x = np.array(x, float)
    unit = "" if series.unit == "1" else series.unit
    plot = Plot(across, f"{series.parameter} {unit}".strip())
    # From end to end of each interval, and a gap before the next.
    ends = series.sizes[:, None] + 1.96 * series.std[:, None] * np.array([-1.0, 1.0, np.nan])
    plot.line("after", np.repeat(x, 3), ends.ravel())
    plot.points("after", x, series.sizes)
    sizes = f"{number(series.sizes[0])} to {number(series.sizes[-1])}"
    return Panel(
        f"{series.craft}: {title(series.of)}",
        f"{series.parameter} in {len(x)} logs, {sizes} {unit}".strip(),
        plot,
    )


def _sizes(row: Row) -> str:
    parts = zip(row["parameters"], row["sizes"], row["std"], row["units"], strict=True)
    return ", ".join(
        f"{name} {plus_minus(value, std, unit_on(unit, row['target']))}" for name, value, std, unit in parts
    )


def _when(row: Row) -> Cell:
    """The date of a log, or its name, with its report."""
    date = row["date"]
    if date is None:
        return Cell(row["name"], row["name"], row["report"])
    return Cell(f"{date:%Y-%m-%d}", date.isoformat(), row["report"])


def _cell(text: str) -> Cell:
    return Cell(text, text)
