"""A log file as a table of text or numbers, before anything is known of its meaning."""

import decimal
import gzip
import io
import os
import warnings
import zlib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from .._errors import InputError
from .._extras import of_extra
from .._files import MOST_BYTES, file_to_hold, written_whole

with of_extra("files", "A log in a file"):
    import pandas as pd
    import pyarrow
    import pyarrow.parquet

    from ._sources import read_matlab

_WRITTEN = (".csv", ".csv.gz", ".parquet")
_READ = (*_WRITTEN, ".mat")

# What reading bytes that are no table raises; pandas' own parser errors are ValueErrors that name the line,
# its notes in a Parquet file are JSON that may nest.
_DAMAGED = (
    OSError,
    EOFError,
    MemoryError,
    RecursionError,
    ValueError,
    zlib.error,
    pyarrow.ArrowException,
)

# Columns by their names, of one length, or of several in a MATLAB file.
Table: TypeAlias = Mapping[str, pd.Series]


def read_table(source: str | os.PathLike[str] | pd.DataFrame) -> Table:
    """The columns of a data frame or of a CSV, Parquet or MATLAB file, names stripped and each there once."""
    if isinstance(source, pd.DataFrame):
        return _of_frame(source, "DataFrame")
    path = file_to_hold(source)
    kind = _format(path, _READ)
    if kind == ".mat":
        return read_matlab(path)
    try:
        return _read_parquet(path) if kind == ".parquet" else _read_csv(path, kind)
    except InputError:
        raise
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text; save it as a UTF-8 CSV file.") from error
    except _DAMAGED as error:
        reason = " ".join(str(error).removeprefix("Error tokenizing data. C error: ").split())
        raise InputError(
            f"{path}: cannot be read as a {kind} file ({reason}); correct or export it again."
        ) from error


def write_table(table: pd.DataFrame, path: str | os.PathLike[str]) -> None:
    """Write what `read_table` reads; numbers keep all their digits."""
    kind = _format(Path(path), _WRITTEN)
    with written_whole(path) as beside:
        if kind == ".parquet":
            table.to_parquet(beside, index=False)
        else:
            table.to_csv(beside, index=False)


def numbers(table: Table, column: str, path: object) -> np.ndarray:
    """A column as float64 [rows], NaN where a cell is empty."""
    cells = table[column]
    if pd.api.types.is_numeric_dtype(cells.dtype) and cells.dtype != bool:
        values = np.asarray(cells, dtype=np.float64)
    else:
        values = np.full(len(cells), np.nan)
        for row in np.flatnonzero(cells.notna()):
            values[row] = _number(cells.iloc[row], column, int(row), path)
    infinite = np.flatnonzero(np.isinf(values))
    if len(infinite):
        raise InputError(
            f"{path}: column `{column}` is infinite in {place(int(infinite[0]))}; leave the cell "
            "empty where a sample is missing."
        )
    return values


def place(row: int) -> str:
    """How messages name a row: counted from one, the line of column names left out."""
    return f"data row {row + 1}"


def _number(cell: object, column: str, row: int, path: object) -> float:
    try:
        if isinstance(cell, str | int | float | decimal.Decimal) and not isinstance(cell, bool):
            return float(cell)
    except (ValueError, OverflowError):
        pass
    raise InputError(
        f"{path}: column `{column}` holds {str(cell)[:40]!r} in {place(row)}, which is not a "
        "number; leave the cell empty where a sample is missing."
    )


def _format(path: Path, formats: tuple[str, ...]) -> str:
    for suffix in formats:
        if path.name.lower().endswith(suffix):
            return suffix
    others = ", .bag, .db3, .mcap, .bin or .tlog" if formats == _READ else ""
    raise InputError(
        f"{path}: has a name that does not end in {', '.join(formats)}{others}; give it that of its format."
    )


def _read_csv(path: Path, kind: str) -> Table:
    # Names and numbers are read apart: pandas would rename a column that is there twice, and would
    # take the first column for row labels where the rows are one cell longer than the header.
    text = _unpacked(path) if kind == ".csv.gz" else path.read_bytes()
    try:
        header = pd.read_csv(
            io.BytesIO(text),
            header=None,
            nrows=1,
            dtype=str,
            keep_default_na=False,
            skip_blank_lines=False,
            encoding="utf-8-sig",
        )
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: is empty; a log has a line of column names, then rows.") from None
    names = _checked_names([str(name) for name in header.iloc[0]], path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                io.BytesIO(text),
                header=None,
                skiprows=1,
                skipinitialspace=True,
                low_memory=False,
                encoding="utf-8-sig",
            )
    except pd.errors.EmptyDataError:
        raise InputError(
            f"{path}: has column names but no rows; check that the recording was not cut off."
        ) from None
    if table.shape[1] != len(names):
        raise InputError(
            f"{path}: names {len(names)} columns, but its rows have {table.shape[1]} cells; "
            "check the separators of the first two lines."
        )
    table.columns = names
    return _of_frame(table, path)


def _unpacked(path: Path) -> bytes:
    with gzip.open(path) as packed:
        text = packed.read(MOST_BYTES + 1)
    if len(text) > MOST_BYTES:
        raise InputError(
            f"{path}: is more than {MOST_BYTES / 1e6:.0f} MB when unpacked; check that it is the right file."
        )
    return text


def _read_parquet(path: Path) -> Table:
    claimed = pyarrow.parquet.read_metadata(path)
    names = pyarrow.parquet.read_schema(path).names
    if not names:
        raise InputError(f"{path}: is empty; a log has columns with names, and rows.")
    _checked_names(names, path)
    size = 8 * claimed.num_rows * len(names)
    if size > MOST_BYTES:
        raise InputError(
            f"{path}: claims {claimed.num_rows} rows of {len(names)} columns, {size / 1e6:.0f} MB when "
            f"unpacked, but a log has at most {MOST_BYTES / 1e6:.0f} MB; check that it is the right file."
        )
    return _of_frame(pyarrow.parquet.read_table(path).to_pandas(), path)


def _of_frame(frame: pd.DataFrame, path: object) -> Table:
    # a time that somebody made the row label is a column all the same
    frame = frame.reset_index() if frame.index.name is not None else frame
    names = _checked_names([str(name) for name in frame.columns], path)
    return {name: frame.iloc[:, index] for index, name in enumerate(names)}


def _checked_names(names: list[str], path: object) -> list[str]:
    names = [name.strip() for name in names]
    for name, count in Counter(names).items():
        if name and count > 1:
            raise InputError(f"{path}: has {count} columns named `{name}`; keep or rename one.")
    if len(names) == 1 and any(separator in names[0] for separator in ";\t"):
        raise InputError(
            f"{path}: separates its columns by semicolons or tabs; write commas between columns "
            "and points in numbers."
        )
    return names
