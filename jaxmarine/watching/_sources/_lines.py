"""Tables that grow line by line: a CSV that is being written, and standard input."""

import csv
import os
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..._errors import InputError
from ..._files import did_you_mean, existing_file, listed
from ..._types import CHANNELS, WRENCH
from ...logs import ColumnMap
from ._source import Row

# Bytes that are taken at once; a line is shorter than this.
_PIECE = 1 << 16
_LONGEST_LINE = 1 << 20
# From one look at a file to the next [s].
_PAUSE = 0.02


class Table:
    """Turns bytes of a CSV into rows; the first line names the columns."""

    def __init__(self, name: str, columns: ColumnMap | None, commands: Sequence[str]):
        if columns is not None and not (columns.keeps_rows and columns.keeps_axes):
            raise InputError(
                f"{name}: a table that is followed stays in its rows and axes; leave [frame], [time], "
                "groups, quaternions and places out of the column map, or replay the whole recording."
            )
        self.name = name
        self.sources = {} if columns is None else columns.sources(name, commands)
        self.known = ("t", *CHANNELS, *commands, *WRENCH, "battery")
        self.header: list[str] | None = None
        self.rest = b""
        self.told: list[str] = []

    def feed(self, piece: bytes) -> list[Row]:
        lines = (self.rest + piece).split(b"\n")
        self.rest = lines.pop()
        if len(self.rest) > _LONGEST_LINE:
            raise InputError(f"{self.name}: has a line of over a megabyte; check that it is a CSV.")
        rows = []
        for line in lines:
            row = self._row(line)
            if row is not None:
                rows.append(row)
        return rows

    def _row(self, line: bytes) -> Row | None:
        try:
            cells = next(csv.reader([line.decode("utf-8-sig").strip("\r")]), [])
        except (UnicodeDecodeError, csv.Error):
            self._tell(f"{self.name}: a line is no text and was left out.")
            return None
        if not cells:
            return None
        if self.header is None:
            self.header = [cell.strip() for cell in cells]
            self._check(self.header)
            return None
        if len(cells) != len(self.header):
            self._tell(
                f"{self.name}: a line has {len(cells)} cells in the place of {len(self.header)} and was left "
                "out."
            )
            return None
        raw = dict(zip(self.header, cells, strict=True))
        row = {name: _float(raw[name]) for name in self.header if name in self.known}
        for name, one in self.sources.items():
            row[name] = float(one(np.array([_float(raw[one.source])]))[0])
        return row

    def _check(self, header: list[str]) -> None:
        for name, one in self.sources.items():
            if one.source not in header:
                raise InputError(
                    f"{self.name}: has no column `{one.source}`, which the column map names for `{name}`; "
                    f"{did_you_mean(one.source, header)}"
                )
        if "t" not in header and "t" not in self.sources:
            raise InputError(
                f"{self.name}: has no column `t` (time in seconds) in its first line, which must name the "
                f"columns; it has {listed(header)}."
            )

    def _tell(self, sentence: str) -> None:
        if sentence not in self.told:
            self.told.append(sentence)


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


class Growing:
    """A CSV that is being written; its place is the number of bytes that were taken."""

    def __init__(self, path: Path, columns: ColumnMap | None, commands: Sequence[str]):
        self.path = existing_file(path)
        self.name = path.name
        self._new = lambda: Table(self.name, columns, commands)
        self.table = self._new()
        self.told = self.table.told
        self.taken = 0

    @property
    def place(self) -> int | None:
        return self.taken - len(self.table.rest)

    def go_on(self, place: int) -> None:
        with self.path.open("rb") as file:
            self.table.feed(file.readline())  # the names of the columns
        self.taken = place

    def close(self) -> None:
        """Nothing is held open."""

    def take(self, wait: float) -> list[Row] | None:
        until = time.monotonic() + wait
        while True:
            try:
                size = os.stat(self.path).st_size
                if size < self.taken:
                    self.told.append(f"{self.name}: is shorter than it was; it is read from its start.")
                    self.table, self.taken = self._new(), 0
                    self.table.told = self.told
                with self.path.open("rb") as file:
                    file.seek(self.taken)
                    piece = file.read(_PIECE)
            except OSError as error:
                raise InputError(f"{self.name}: can be read no more ({error.strerror}).") from error
            self.taken += len(piece)
            rows = self.table.feed(piece) if piece else []
            if rows or time.monotonic() >= until:
                return rows
            if not piece:
                time.sleep(_PAUSE)


class Piped:
    """A CSV that another program writes to standard input."""

    name = "standard input"
    place = None

    def __init__(self, columns: ColumnMap | None, commands: Sequence[str]):
        self.table = Table(self.name, columns, commands)
        self.told = self.table.told

    def go_on(self, place: int) -> None:
        """What was sent meanwhile is lost, and shows as a gap."""

    def close(self) -> None:
        """Nothing is held open."""

    def take(self, wait: float) -> list[Row] | None:
        if not select.select([sys.stdin.fileno()], [], [], wait)[0]:
            return []
        piece = os.read(sys.stdin.fileno(), _PIECE)
        if not piece:
            return self.table.feed(b"\n") or None if self.table.rest else None
        return self.table.feed(piece)
