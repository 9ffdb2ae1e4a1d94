"""A foreign file's columns under their names in the contract, all on one clock."""

import datetime
import itertools
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from .._errors import InputError
from .._files import did_you_mean, listed
from .._types import ALL_CHANNELS, WRENCH
from ._columns import ColumnMap, ColumnSource, replaced
from ._craft import Craft, beside, free_poses, free_velocities
from ._frames import in_our_axes
from ._grid import in_order, on_one_clock
from ._sources import Series, is_recording, open_recording
from ._table import Table, numbers, place, read_table

# Beyond any quantity of a vehicle in SI units: times in nanoseconds, sentinels such as 1e38.
_ABSURD = 1e12
# A clock that shows more than this counts from 1970, not from when it was started; and until when it can [s].
_SINCE_1970, _YEAR_3000 = 1e9, 3.25e10
# Rows were only stored in another order where none is late by more than this [s], and where sorted the steps
# between them are the usual one within this share.
_LATE, _REGULAR = 1.0, 0.3


class MappedFile:
    """The columns of a file by the names of the log's columns, and what there is to say of them.

    - `path`: how sentences begin; `name`: the log's name.
    - `table`: the columns, and `sources`: which of them serve under which name of the contract.
    - `labels`: how a column is called where it no longer bears the file's name.
    - `places`: what row k is called in sentences.
    """

    def __init__(
        self,
        path: object,
        table: Table,
        sources: Mapping[str, ColumnSource],
        notes: Iterable[str] = (),
        labels: Mapping[str, str] | None = None,
        places: Callable[[int], str] = place,
    ):
        self.path = path
        self.notes = list(notes)
        self.place = places
        self._table = table
        self._sources = dict(sources)
        self._labels = labels or {name: _label(name, source) for name, source in sources.items()}

    def __contains__(self, name: str) -> bool:
        return name in self._sources

    def __getitem__(self, name: str) -> np.ndarray:
        """A contract column [rows], in the contract's units."""
        source = self._sources[name]
        values = source(self.raw(source.source))
        absurd = np.flatnonzero(np.abs(values) > _ABSURD)
        if len(absurd):
            row = int(absurd[0])
            raise InputError(
                f"{self.path}: column {self.label(name)} is {values[row]:.6g} in {self.place(row)}, "
                "which no sensor measures; check its unit, and leave the cell empty where a "
                "sample is missing."
            )
        return values

    def add(self, name: str, values: np.ndarray) -> None:
        """One more contract column [rows], in the contract's units, made of others."""
        self._table = {**self._table, name: pd.Series(values)}
        self._sources |= _as_named([name])
        self._labels = {**self._labels, name: f"`{name}`"}

    def raw(self, column: str) -> np.ndarray:
        """One of the file's columns [rows], in its own units."""
        return numbers(self._table, column, self.path)

    def put_in_order(self) -> None:
        """Rows that are there twice count once, rows that were only stored in another order are sorted.

        Times that are wrong otherwise stay, for the rules for times to tell. Notes say what was done.
        """
        t = self["t"]
        if not len(t) or not np.isfinite(t).all() or np.all(np.diff(t) > 0):
            return
        order = np.argsort(t, kind="stable")
        cells = np.stack([self[name] for name in self._sources], axis=1)[order]
        twins = [np.array_equal(*pair, equal_nan=True) for pair in itertools.pairwise(cells)]
        again = np.append(False, twins).astype(bool)
        kept = order[~again]
        moved = np.append(False, np.diff(kept) < 0)
        steps = np.diff(t[kept], prepend=np.nan, append=np.nan)
        beside = np.concatenate([steps[:-1][moved], steps[1:][moved]])
        beside = beside[np.isfinite(beside)] / np.nanmedian(steps)
        late = np.maximum.accumulate(t) - t
        if late.max() > _LATE or np.any(np.diff(t[kept]) <= 0) or np.any(np.abs(beside - 1) > _REGULAR):
            return
        self._table = {name: self._table[name].iloc[kept].reset_index(drop=True) for name in self._table}
        place_in_file = self.place
        self.place = lambda row: place_in_file(int(kept[row]))
        if again.any():
            self.notes.append(
                f"Rows that are there twice count once ({np.count_nonzero(again)} of {len(t)})."
            )
        if moved.any():
            self.notes.append(
                f"Rows that were stored in another order are sorted by {self.label('t')} "
                f"({np.count_nonzero(moved)} of {len(t)} times back)."
            )

    @property
    def file_names(self) -> list[str]:
        return [name for name in self._table if name]

    def label(self, name: str) -> str:
        """A column as the user knows it."""
        return self._labels[name]

    def missing(self, names: Iterable[str]) -> tuple[str, ...]:
        return tuple(name for name in names if name not in self)

    def note_ignored(self) -> None:
        used = {source.source for source in self._sources.values()}
        ignored = [name for name in self.file_names if name not in used]
        if ignored:
            self.notes.append(f"Columns that nothing knows are ignored: {listed(ignored)}.")


def open_mapped(
    source: str | os.PathLike[str] | pd.DataFrame, vehicle: Craft, columns: ColumnMap | None
) -> MappedFile:
    """The file, or data frame, as a vehicle's log names its columns."""
    if not isinstance(source, pd.DataFrame) and is_recording(Path(source)):
        return _of_recording(Path(source), vehicle, columns)
    path = "DataFrame" if isinstance(source, pd.DataFrame) else source
    table = read_table(source)
    sources = _of_table(path, table, vehicle, columns)
    file = MappedFile(path, table, sources)
    if "t" in file and (columns is None or columns.keeps_rows):
        file.put_in_order()
    if columns is None or (columns.keeps_rows and columns.keeps_axes):
        return file
    if "t" in file and columns.keeps_rows and not np.all(np.diff(file["t"]) > 0):
        return file  # of which the rules for times tell what is wrong
    if columns.keeps_rows:
        turned = _on_its_rows(file, sources, columns)
    else:
        turned = _on_one_clock(path, _timed(file, sources), sources, vehicle, columns)
    file.note_ignored()
    turned.notes[:0] = file.notes
    return turned


def _of_table(
    path: object, table: Table, vehicle: Craft, columns: ColumnMap | None
) -> dict[str, ColumnSource]:
    """Which of a table's columns serve: those of the map, and those that bear the name of a log's column."""
    mapped = {} if columns is None else columns.sources(path, vehicle.command_names)
    clocks = {f"{name}.clock": one.clock for name, one in mapped.items() if one.clock}
    for name, one in (mapped | clocks).items():
        if one.source not in table:
            raise InputError(
                f"{path}: has no column `{one.source}`, which the column map names for "
                f"`{name}`; {did_you_mean(one.source, [name for name in table if name])}"
            )
    # A file's column that the map claims does not serve under its own name as well.
    claimed = {one.source for one in (mapped | clocks).values()}
    taken = claimed | {*mapped} | replaced(mapped)
    named = dict.fromkeys(("t", *ALL_CHANNELS, *vehicle.command_names, *WRENCH, *beside(vehicle)))
    sources = mapped | _as_named(name for name in named if name in table and name not in taken)
    for name, one in sources.items():
        clock = one.clock or sources.get("t", one)
        if len(table[one.source]) != len(table[clock.source]):
            raise InputError(
                f"{path}: column {_label(name, one)} has {len(table[one.source])} values, but its times "
                f'`{clock.source}` are {len(table[clock.source])}; name its own times by clock = "...".'
            )
    return sources


def _of_recording(path: Path, vehicle: Craft, columns: ColumnMap | None) -> MappedFile:
    """The messages of a recording, whose times say where they belong."""
    stamp = "header" if columns is None else columns.time.stamp
    recording = open_recording(path, stamp)
    sources = {} if columns is None else columns.sources(path, vehicle.command_names)
    if not sources:
        raise InputError(
            f"{path}: needs a column map that says which message holds what; the file has "
            f"{listed(recording.names)}."
        )
    assert columns is not None
    odd = next((name for name, one in sources.items() if name == "t" or one.clock), None)
    if odd is not None:
        raise InputError(
            f"{path}: its messages have times of their own, so that the column map cannot give those of "
            f"`{odd}`; leave them out."
        )
    raw = recording.read({one.source for one in sources.values()})
    series = {name: Series(raw[one.source].t, one(raw[one.source].values)) for name, one in sources.items()}
    file = _on_one_clock(path, series, sources, vehicle, columns)
    file.notes[:0] = recording.notes
    return file


def _timed(file: MappedFile, sources: Mapping[str, ColumnSource]) -> dict[str, Series]:
    """The columns of a table, each with the times of its own clock or of `t`."""
    series = {}
    for name in sources:
        clock = sources[name].clock or sources.get("t")
        if name == "t":
            continue
        if clock is None:
            raise InputError(
                f"{file.path}: has no times for {file.label(name)}; map `t`, or name its column of times by "
                'clock = "...".'
            )
        series[name] = Series(clock(file.raw(clock.source)), file[name])
    return series


def _on_its_rows(file: MappedFile, sources: Mapping[str, ColumnSource], columns: ColumnMap) -> MappedFile:
    """The columns of a table in the contract's axes; each row stays what it was."""
    timed = _timed(file, sources)
    seen, rows = {}, {"t": file["t"]}
    for name, (t, values) in timed.items():
        known = np.isfinite(values)
        if known.any():
            seen[name] = Series(t[known], values[known])
        else:
            rows[name] = values
    for name, (t, values) in in_our_axes(seen, columns.frame, file.path).items():
        rows[name] = np.full(len(rows["t"]), np.nan)
        rows[name][np.searchsorted(rows["t"], t)] = values
    labels = {name: file.label(name) if name in file else f"`{name}`" for name in rows}
    table = {name: pd.Series(values) for name, values in rows.items()}
    return MappedFile(file.path, table, _as_named(table), labels=labels)


def _on_one_clock(
    path: object,
    series: Mapping[str, Series],
    sources: Mapping[str, ColumnSource],
    vehicle: Craft,
    columns: ColumnMap,
) -> MappedFile:
    labels = {name: _label(name, one) for name, one in sources.items()}
    ordered, notes = in_order(series, labels, path)
    ours = in_our_axes(ordered, columns.frame, path)
    main = free_poses(tuple(vehicle.dof)) + free_velocities(tuple(vehicle.dof))
    held = (*vehicle.command_names, *WRENCH, *beside(vehicle))
    t, found, done = on_one_clock(ours, main, held, columns.time.dt, path)
    t, told = from_start(t)
    notes += told
    table = {name: pd.Series(values) for name, values in ({"t": t} | found).items()}
    return MappedFile(
        path,
        table,
        _as_named(table),
        notes + done,
        {name: labels.get(name, f"`{name}`") for name in table},
        lambda row: f"the row of t = {t[row]:.6g} s",
    )


def from_start(t: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times counted from the first one, with a note, where they are counted from 1970."""
    if not _SINCE_1970 < t[0] < _YEAR_3000:
        return t, []
    start = datetime.datetime.fromtimestamp(t[0], datetime.UTC)
    return t - t[0], [f"Time 0 of the log is {start:%Y-%m-%d %H:%M:%S.%f} UTC."]


def _as_named(names: Iterable[str]) -> dict[str, ColumnSource]:
    return {name: ColumnSource.model_validate({"from": name}) for name in names}


def _label(name: str, source: ColumnSource) -> str:
    return f"`{name}`" if source.source == name else f"`{name}` (`{source.source}` in the file)"
