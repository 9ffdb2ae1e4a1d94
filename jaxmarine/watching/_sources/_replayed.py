"""A recording that is replayed row by row, as if it came in now."""

from pathlib import Path

import numpy as np

from ..._types import ALL_CHANNELS, WRENCH
from ...logs import ColumnMap, read_log
from ...vehicle import Vehicle
from ._source import Row

# Rows that are handed on at once.
_SOME = 256


class Replayed:
    """A ROS 2 bag, or anything else that `read_log` reads; its place is the number of rows taken."""

    def __init__(self, path: Path, vehicle: Vehicle, columns: ColumnMap | None):
        self.log = read_log(path, vehicle, columns)
        self.name = path.name
        self.told = list(self.log.notes)
        self.place: int = 0

    def go_on(self, place: int) -> None:
        self.place = place

    def close(self) -> None:
        """Nothing is held open."""

    def take(self, wait: float) -> list[Row] | None:
        del wait
        log, here = self.log, range(self.place, min(self.place + _SOME, len(self.log.t)))
        if not here:
            return None
        self.place = here.stop
        names = WRENCH if log.commands is None else log.command_names
        driven = log.wrench if log.commands is None else log.commands
        assert driven is not None
        rows = list[Row]()
        for k in here:
            seen = np.flatnonzero(np.isfinite(log.channels[k]))
            row = {"t": float(log.t[k])} | {ALL_CHANNELS[c]: float(log.channels[k, c]) for c in seen}
            row |= dict(zip(names, driven[k].tolist(), strict=True))
            if log.battery is not None:
                row["battery"] = float(log.battery[k])
            rows.append(row)
        return rows
