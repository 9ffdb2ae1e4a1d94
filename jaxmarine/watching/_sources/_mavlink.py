"""MAVLink messages as they come: over UDP, or replayed from telemetry (`.tlog`), by the library pymavlink.

Messages of several kinds, each with its own time, become rows on one clock: a sample stands in the nearest
row, a command holds. A row is complete once a message has come that is later than it by `LATE`.
"""

import contextlib
import datetime
import io
import time
from collections.abc import Mapping

import numpy as np

from ..._errors import InputError
from ..._extras import need
from ..._types import WRENCH
from ...logs import ColumnMap
from ...logs._columns import ColumnSource
from ...vehicle import Vehicle
from ._source import Row

# Between rows unless the map says otherwise, and how much later than a row its messages may come [s].
_DT, _LATE = 0.1, 0.5
# Fields with the vehicle's own time, and their unit [s].
_TIMES = {"time_boot_ms": 1e-3, "time_usec": 1e-6}
# A message that is earlier than rows that are out by more than this tells of a clock that was set [s].
_SET_BACK = 2.0
# The row before all rows.
_NEVER = -(10**18)
# Messages that are handed on at once.
_SOME = 1000


class Mavlink:
    """A link. The column map says which field of which message is what: `roll = "ATTITUDE.roll"`."""

    place = None

    def __init__(self, address: str, name: str, vehicle: Vehicle, columns: ColumnMap | None):
        need(("pymavlink",), "bags", "MAVLink")
        self.name = name
        self.told: list[str] = []
        sources = {} if columns is None else columns.sources(name, vehicle.command_names)
        if columns is None or not sources:
            raise InputError(
                f"{name}: needs a column map that says which message holds what, such as "
                'phi = "ATTITUDE.roll"; give one by --columns.'
            )
        if not columns.keeps_axes:
            raise InputError(
                f"{name}: the axes of a link are those of MAVLink (north, east, down; forward, right, down); "
                "leave [frame], groups, quaternions and places out of the column map."
            )
        self.dt = columns.time.dt or _DT
        self.fields: dict[str, list[tuple[str, str, ColumnSource]]] = {}
        for contract, one in sources.items():
            head, _, field = one.source.partition(".")
            self.fields.setdefault(head, []).append((contract, field, one))
        self.held = (*vehicle.command_names, *WRENCH, "battery")
        self.follows = address.startswith("udp")
        self.link = _opened(address, name)
        self.clocks: dict[str, float] = {}
        self.cells: dict[int, dict[str, float]] = {}
        self.commands: dict[str, float] = {}
        self.out = _NEVER
        self.newest = -np.inf
        self.zero: int | None = None

    def go_on(self, place: int) -> None:
        """What was sent meanwhile is lost, and shows as a gap."""

    def close(self) -> None:
        self.link.close()

    def take(self, wait: float) -> list[Row] | None:
        rows: list[Row] = []
        for _ in range(_SOME):
            message = self._next(0.0 if rows else wait)
            if message is None:
                return rows if self.follows or rows else (self._flushed() or None)
            rows += self._place(message)
        return rows

    def _next(self, wait: float):
        until = time.monotonic() + wait
        while True:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                left = max(0.0, until - time.monotonic())
                found = self.link.recv_match(type=list(self.fields), blocking=self.follows, timeout=left)
            if found is not None or not self.follows or time.monotonic() >= until:
                return found

    def _place(self, message) -> list[Row]:
        """Puts a message where it belongs; the rows that are complete now."""
        kind = message.get_type()
        t = self._time(kind, message)
        rows: list[Row] = []
        if t < self.newest - _SET_BACK:
            rows = self._flushed()
            self.out, self.newest = _NEVER, -np.inf
        self.newest = max(self.newest, t)
        cell = round(t / self.dt)
        for contract, field, one in self.fields[kind]:
            value = getattr(message, field, None)
            if isinstance(value, int | float) and cell > self.out:
                self.cells.setdefault(cell, {})[contract] = float(one(np.array([float(value)]))[0])
            elif value is None:
                sentence = f"{self.name}: {kind} has no field `{field}`; see the column map."
                self.told += [] if sentence in self.told else [sentence]
        return rows + self._complete(self.newest - _LATE)

    def _time(self, kind: str, message) -> float:
        """On one clock [s]: that of the vehicle, where its messages have one; all began as they came."""
        received = float(message._timestamp)
        field = next((one for one in _TIMES if one in message.get_fieldnames()), None)
        if field is None:
            return received
        own = getattr(message, field) * _TIMES[field]
        return own + self.clocks.setdefault(field, received - own)

    def _complete(self, until: float) -> list[Row]:
        rows = list[Row]()
        for cell in sorted(one for one in self.cells if one * self.dt <= until):
            found: Mapping[str, float] = self.cells.pop(cell)
            self.commands |= {name: value for name, value in found.items() if name in self.held}
            self.out = cell
            # Before every command is known there is nothing to simulate by.
            if {name for name in self.held if name in self._mapped} <= {*self.commands}:
                if self.zero is None:
                    self.zero = cell
                    start = datetime.datetime.fromtimestamp(cell * self.dt, datetime.UTC)
                    self.told.append(f"Time 0 is {start:%Y-%m-%d %H:%M:%S.%f} UTC.")
                rows.append({"t": (cell - self.zero) * self.dt} | dict(found) | self.commands)
        return rows

    @property
    def _mapped(self) -> set[str]:
        return {contract for fields in self.fields.values() for contract, _, _ in fields}

    def _flushed(self) -> list[Row]:
        return self._complete(np.inf)


def _opened(address: str, name: str):
    from pymavlink import mavutil

    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return mavutil.mavlink_connection(address)
    except Exception as error:  # of foreign bytes, of ports that are taken
        reason = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
        raise InputError(f"{name}: cannot be opened ({reason}); check the address.") from error
