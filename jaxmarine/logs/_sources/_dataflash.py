"""ArduPilot's own logs, `.BIN` (DataFlash), which define their messages themselves.

Each message is two bytes that mark it, one for its kind, and packed numbers; those of kind 128 define the
others (ArduPilot, `AP_Logger/LogStructure.h`). It is read here, as the reader of pymavlink writes a line to
the terminal for every damaged byte.
"""

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..._errors import InputError
from ._instances import Instances, Origin
from ._series import Series, reading

_MARK = b"\xa3\x95"
_DEFINING = 128
# Letters of a layout: how a number is packed, and what one of it is worth; text is worth nothing.
_LETTERS = {
    "a": ("(32,)<i2", 1.0),
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "g": ("<f2", 1.0),
    "M": ("u1", 1.0),
    "c": ("<i2", 1e-2),
    "C": ("<u2", 1e-2),
    "e": ("<i4", 1e-2),
    "E": ("<u4", 1e-2),
    "L": ("<i4", 1e-7),
    "n": ("S4", 0.0),
    "N": ("S16", 0.0),
    "Z": ("S64", 0.0),
}
_TIMES = {"TimeUS": 1e-6, "TimeMS": 1e-3}


class _Format(NamedTuple):
    """A kind of message."""

    name: str
    packed: np.dtype
    worth: dict[str, float]  # by column; 0 for text
    length: int

    @staticmethod
    def of(name: bytes, layout: bytes, columns: bytes, length: int) -> "_Format | None":
        """None if its parts contradict one another, as in damaged bytes."""
        letters, names = _text(layout), _text(columns).split(",")
        if len(letters) != len(names) or not set(letters) <= set(_LETTERS) or len({*names}) < len(names):
            return None
        chosen = {column: _LETTERS[letter] for column, letter in zip(names, letters, strict=True)}
        packed = np.dtype([(column, kind) for column, (kind, _) in chosen.items()])
        if packed.itemsize + 3 != length:
            return None
        worth = {column: worth for column, (_, worth) in chosen.items()}
        return _Format(_text(name), packed, worth, length)


class DataFlash:
    """The messages of a DataFlash log, each stamped by the vehicle's clock since its start."""

    def __init__(self, path: Path, stamp: str):
        del stamp  # there is one clock only
        self.path = path
        self.notes: list[str] = []
        with reading(path, "a DataFlash log", "download it from the vehicle again"):
            self._data = path.read_bytes()
            self._index()
        self.names = tuple(self._places)
        if not self.names:
            raise InputError(
                f"{path}: is no DataFlash log, as it defines no message; check that it is the right file."
            )

    def read(self, wanted: Collection[str]) -> dict[str, Series]:
        instances = Instances(wanted, self.names, self.path)
        for name in instances.heads:
            layout, rows = self._formats[name], self._rows(name)
            time = next((column for column in _TIMES if column in layout.worth), None)
            if time is None:
                raise InputError(
                    f"{self.path}: message `{name}` has no time (`TimeUS`); map another message for it."
                )
            with np.errstate(invalid="ignore"):  # damaged bytes may be any kind of NaN
                numbers = [worth * rows[c] if worth else rows[c] for c, worth in layout.worth.items()]
            which = self._instance_columns.get(name)
            for k, t in enumerate(_TIMES[time] * rows[time]):
                message = dict(zip(layout.worth, (column[k] for column in numbers), strict=True))
                instance = None if which not in message else int(message[which])
                instances.take(name, Origin(instance=instance), float(t), message)
        found = instances.series()
        self.notes = instances.notes
        return found

    def _index(self) -> None:
        """Where the messages of each name are; what stands between them is skipped."""
        data, at = self._data, 0
        self._formats: dict[str, _Format] = {}
        self._instance_columns: dict[str, str] = {}
        self._places: dict[str, list[int]] = defaultdict(list)
        kinds = {_DEFINING: _Format.of(b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns", 89)}
        while (at := data.find(_MARK, at)) >= 0 and at + 3 <= len(data):
            layout = kinds.get(data[at + 2])
            if layout is None or at + layout.length > len(data):
                at += 1
                continue
            if layout.name == "FMT":
                number, length, name, letters, columns = self._row(layout, at)
                kinds[number] = _Format.of(name, letters, columns, length)
            else:
                self._formats.setdefault(layout.name, layout)
                self._places[layout.name].append(at)
                if layout.name == "FMTU":
                    self._note_instance(layout, at, kinds)
            at += layout.length

    def _note_instance(self, layout: _Format, at: int, kinds: dict) -> None:
        """Among the units of a message, # marks the column that tells its instances apart."""
        units = dict(zip(layout.worth, self._row(layout, at), strict=True))
        about = kinds.get(int(units.get("FmtType", -1)))
        place = _text(units.get("UnitIds", b"")).find("#")
        if about is not None and 0 <= place < len(about.worth):
            self._instance_columns[about.name] = list(about.worth)[place]

    def _row(self, layout: _Format, at: int) -> tuple:
        return np.frombuffer(self._data, layout.packed, 1, at + 3)[0].item()

    def _rows(self, name: str) -> np.ndarray:
        length = self._formats[name].length
        packed = b"".join(self._data[at + 3 : at + length] for at in self._places[name])
        return np.frombuffer(packed, self._formats[name].packed)


def _text(word: bytes) -> str:
    return word.split(b"\0")[0].decode("ascii", "replace")
