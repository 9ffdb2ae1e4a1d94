"""The table of a fleet: a row per log, which says whose it is and where its files lie."""

import dataclasses
import os
import re
from collections import Counter
from pathlib import Path

import pandas as pd

from .._errors import InputError
from .._files import did_you_mean
from ..logs import read_table
from ._paths import at_hand, found, is_url

NEEDED, OPTIONAL = ("vehicle", "train", "test"), ("name", "craft", "date")


@dataclasses.dataclass(frozen=True)
class Entry:
    """A row of the table, its cells as they stand there.

    - `train`, `test`: paths or globs, separated by `;`. `folder`: what they are relative to.
    - `name`: of the log, unlike all others also as the name of a folder (`slug`); `craft`: whose it is.
    - `date`: of the log, None where the table has none.
    """

    name: str
    craft: str
    date: pd.Timestamp | None
    vehicle: str
    train: str
    test: str
    folder: str

    @property
    def slug(self) -> str:
        """The name as that of a folder."""
        return _slug(self.name)

    def files(self) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
        """The vehicle file, the training logs and the test logs; raises `InputError` where one is missing."""
        vehicle, train, test = (self._found(column) for column in NEEDED)
        if len(vehicle) != 1:
            raise InputError(f"{self.name}: its `vehicle` names {len(vehicle)} files; give one vehicle file.")
        return vehicle[0], train, test

    def _found(self, column: str) -> tuple[str, ...]:
        patterns = [part.strip() for part in getattr(self, column).split(";") if part.strip()]
        if not patterns:
            raise InputError(f"{self.name}: has no `{column}` in the table; give a path.")
        return tuple(place for pattern in patterns for place in found(pattern, self.folder))


def read_entries(table: str | os.PathLike[str] | pd.DataFrame, scratch: Path) -> tuple[Entry, ...]:
    """The rows of a table: CSV, Parquet (paths or URLs) or a data frame of pandas.

    Paths in it are relative to its folder, those of a data frame to the current one. What is wrong with the
    table is an `InputError`; what is wrong with the files of a row shows when they are used.

    - `scratch`: a folder for what is fetched.
    """
    if isinstance(table, pd.DataFrame):
        source, folder = "DataFrame", os.getcwd()
    else:
        source = os.fspath(table)
        folder = source.rpartition("/")[0] if is_url(source) else os.path.dirname(os.path.abspath(source))
        table = at_hand(source, scratch)
    columns = read_table(table)
    known = (*NEEDED, *OPTIONAL)
    missing = [name for name in NEEDED if name not in columns]
    if missing:
        raise InputError(
            f"{source}: lacks the column `{missing[0]}`; a table of logs has {', '.join(NEEDED)} and, if you "
            f"like, {', '.join(OPTIONAL)}."
        )
    strange = [name for name in columns if name not in known]
    if strange:
        raise InputError(f"{source}: has an unknown column `{strange[0]}`; {did_you_mean(strange[0], known)}")
    cells = {name: _text(columns[name]) for name in columns}
    count = len(cells["vehicle"])
    if not count:
        raise InputError(f"{source}: has no rows; give one per log.")
    rows = [{name: cells[name][i] if name in cells else "" for name in known} for i in range(count)]
    names = _names([row["name"] for row in rows], [row["train"] for row in rows], source)
    return tuple(
        Entry(
            name=name,
            craft=row["craft"] or _stem(row["vehicle"]) or "unknown",
            date=_date(row["date"], source, name),
            vehicle=row["vehicle"],
            train=row["train"],
            test=row["test"],
            folder=folder,
        )
        for name, row in zip(names, rows, strict=True)
    )


def _text(column: pd.Series) -> list[str]:
    """The cells as text, empty where there is nothing."""
    # Whole numbers beside an empty cell have become fractions.
    return [
        ""
        if pd.isna(cell)
        else f"{cell:.0f}"
        if isinstance(cell, float) and cell.is_integer()
        else str(cell).strip()
        for cell in column
    ]


def _stem(path: str) -> str:
    return re.split(r"[/\\]", path)[-1].partition(".")[0]


def _slug(name: str) -> str:
    """Letters, digits and `-_.`, in lower case as some file systems know no other."""
    return re.sub(r"[^\w.-]+", "_", name).strip(".").lower() or "_"


def _names(given: list[str], train: list[str], source: str) -> list[str]:
    """Those that are given; of the others the first training file's, with a number where it comes again."""
    taken = Counter(_slug(name) for name in given if name)
    twice = next((name for name in given if name and taken[_slug(name)] > 1), None)
    if twice is not None:
        raise InputError(f"{source}: has two logs named `{twice}`; give each a `name` of its own.")
    out = []
    for name, path in zip(given, train, strict=True):
        if not name:
            base = _stem(path.partition(";")[0].strip().replace("*", "")) or "log"
            name, number = base, 2
            while _slug(name) in taken:
                name, number = f"{base}-{number}", number + 1
            taken[_slug(name)] += 1
        out.append(name)
    return out


def _date(text: str, source: str, name: str) -> pd.Timestamp | None:
    if not text:
        return None
    try:
        date = pd.Timestamp(text)
    except ValueError:
        date = pd.NaT
    if not isinstance(date, pd.Timestamp):
        raise InputError(f"{source}: the date of `{name}` is {text!r}; give it as 2026-03-31.")
    return date.tz_convert(None) if date.tzinfo is not None else date
