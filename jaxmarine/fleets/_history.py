"""What a craft has since when, and how the sizes of what it has go over its logs."""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float

from ._rows import Row

# The rows of one log.
Rows = list[Row]


def by_log(rows: Sequence[Row]) -> list[Rows]:
    """The rows of a fleet's table log by log, in their order."""
    return [list(group) for _, group in itertools.groupby(rows, key=lambda row: row["name"])]


def by_craft(rows: Sequence[Row]) -> dict[str, list[Rows]]:
    """The logs of each craft in the order of their dates; where one has none, as they stand."""
    logs: dict[str, list[Rows]] = {}
    for log in by_log(rows):
        logs.setdefault(log[0]["craft"], []).append(log)
    return {craft: _in_time(logs[craft]) for craft in sorted(logs)}


def _in_time(logs: list[Rows]) -> list[Rows]:
    dates = [log[0]["date"] for log in logs]
    if any(date is None for date in dates):
        return logs
    return [log for _, log in sorted(zip(dates, logs, strict=True), key=lambda one: one[0])]


def label_of(row: Row) -> str | None:
    """Such as `thruster_gain:port`; None of a row without a finding."""
    effect, target = row.get("effect"), row.get("target")
    return effect if effect is None or target is None else f"{effect}:{target}"


def present(logs: Sequence[Rows]) -> list[tuple[Row, Row]]:
    """Of each cause in the last log, its row in the first log that has it without a break, and there.

    - `logs`: the usable ones of one craft, in the order of time.
    """
    out = []
    for last in logs[-1]:
        label, first = label_of(last), last
        if label is None:
            continue
        for log in reversed(logs[:-1]):
            same = [row for row in log if label_of(row) == label]
            if not same:
                break
            first = same[0]
        out.append((first, last))
    return out


@dataclasses.dataclass(frozen=True)
class Series:
    """A number of a craft over its logs.

    - `of`: what it is a number of, such as `thruster_gain:port`; `parameter`, in `unit`.
    - `dates`: of the logs, None where the table has none; `sizes`, `std` [logs].
    """

    craft: str
    of: str
    parameter: str
    unit: str
    dates: tuple[pd.Timestamp | None, ...]
    sizes: Float[np.ndarray, " logs"]
    std: Float[np.ndarray, " logs"]


def series_of(craft: str, logs: Sequence[Rows]) -> Iterator[Series]:
    """The sizes of what was named in a craft's logs."""
    found: dict[tuple[str, str, str], list[tuple[pd.Timestamp | None, float, float]]] = {}
    for row in itertools.chain.from_iterable(logs):
        label = label_of(row)
        if label is not None:
            for name, unit, size, std in zip(
                row["parameters"], row["units"], row["sizes"], row["std"], strict=True
            ):
                found.setdefault((label, name, unit), []).append((row["date"], size, std))
    for (label, name, unit), points in found.items():
        dates, sizes, std = zip(*points, strict=True)
        yield Series(craft, label, name, unit, dates, np.array(sizes), np.array(std))
