"""MATLAB files, `.mat` of versions 5 to 7.2, read element by element.

A file is a sequence of tagged elements, see MathWorks, *MAT-File Format*, "Level 5". Here every size is
checked against the bytes that are there; `scipy.io.loadmat` crashes the interpreter on some damaged files.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from ..._errors import InputError
from ..._files import MOST_BYTES
from ._series import reading

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_STRUCTURE, _ARRAYS = 2, range(6, 16)
_HEADER = 128
_DEPTH = 16


class _Element(NamedTuple):
    """A tag's kind, and the bytes behind it."""

    kind: int
    data: memoryview


def read_matlab(path: Path) -> dict[str, pd.Series]:
    """The columns of a file's variables.

    A vector is one column; a matrix is one per `name[0]`, `name[1]`, its longer side being time; what stands
    in a structure is named `structure.field`. Text, cells and the like are left out.
    """
    with reading(path, "a MATLAB file", "save it again by save(name, '-v7')"):
        content = path.read_bytes()
        if content.startswith(b"MATLAB 7.3"):
            raise InputError(
                f"{path}: is a MATLAB file of version 7.3, which needs another reader; save it by "
                "save(name, '-v7')."
            )
        order = {b"IM": "<", b"MI": ">"}.get(content[_HEADER - 2 : _HEADER])
        if order is None:
            raise ValueError("it does not begin as such")
        columns: dict[str, pd.Series] = {}
        room = MOST_BYTES
        for element in _elements(memoryview(content)[_HEADER:], order):
            if element.kind == _COMPRESSED:
                unpacked = _unpacked(element.data, room)
                room -= len(unpacked)
                element = next(_elements(unpacked, order))
            if element.kind == _MATRIX:
                _add(columns, "", element.data, order, depth=0)
    return columns


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """The elements in some bytes, one behind the other; what claims more than there is raises."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        begin, padded = at + 8, size if kind == _COMPRESSED else 8 * math.ceil(size / 8)
        if kind >> 16:  # up to four bytes share the tag
            kind, size = kind & 0xFFFF, kind >> 16
            begin, padded = at + 4, 4
        if size > min(padded, len(data) - begin):
            raise ValueError(f"it is cut off, or claims {size} bytes where {len(data) - begin} are")
        yield _Element(kind, data[begin : begin + size])
        at = begin + padded


def _unpacked(data: memoryview, room: int) -> memoryview:
    unpacker = zlib.decompressobj()
    found = unpacker.decompress(data, max(room, 1))  # 0 would be without limit
    if not unpacker.eof:
        raise ValueError("a compressed variable is cut off or too long")
    return memoryview(found)


def _add(columns: dict[str, pd.Series], inside: str, data: memoryview, order: str, depth: int) -> None:
    """Adds the columns of the matrix or structure in `data`; `inside`: what its name is prefixed by."""
    if not len(data) or depth > _DEPTH:
        return
    parts = _elements(data, order)
    flags, shape = _numbers(next(parts), order), _numbers(next(parts), order).tolist()
    name = inside + bytes(next(parts).data).decode()
    kind = int(flags[0]) & 0xFF
    if kind == _STRUCTURE and math.prod(shape) == 1:
        width, names = int(_numbers(next(parts), order)[0]), bytes(next(parts).data)
        for at in range(0, len(names), max(width, 1)):
            field = names[at : at + width].split(b"\0")[0].decode()
            _add(columns, f"{name}.{field}", next(parts).data, order, depth + 1)
    elif kind in _ARRAYS and len(shape) == 2:
        matrix = _numbers(next(parts), order).reshape(shape, order="F")
        rows = matrix if shape[0] >= shape[1] else matrix.T
        for index, column in enumerate(rows.T):
            columns[name if rows.shape[1] == 1 else f"{name}[{index}]"] = pd.Series(column)


def _numbers(element: _Element, order: str) -> np.ndarray:
    return np.frombuffer(element.data, order + _NUMBERS[element.kind]).astype(_NUMBERS[element.kind])
