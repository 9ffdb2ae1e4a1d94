"""Rows that come in one by one: in order of time, in range, in stretches without a gap."""

from collections.abc import Mapping

import numpy as np

from .._errors import InputError
from .._types import CHANNELS, WRENCH
from ..vehicle import Vehicle
from ._blocks import Rows

# Commands that are beyond the limit by less than this share are rounded (as in a log that is read whole).
_ROUNDING = 1e-3


class Intake:
    """Turns rows of named numbers into arrays; says each kind of trouble once.

    - `offset` [s]: what the watch counts on beyond the log's own clock, where that was set back.
    """

    def __init__(self, vehicle: Vehicle):
        self.vehicle = vehicle
        self.last: float | None = None
        self.offset = 0.0
        self.held = np.zeros(len(vehicle.command_names))
        self.driven: bool | None = None
        self.said: set[str] = set()

    def once(self, key: str, sentence: str) -> list[str]:
        """The sentence, the first time."""
        if key in self.said:
            return []
        self.said.add(key)
        return [sentence]

    def take(self, row: Mapping[str, float]) -> tuple[Rows | None, bool, list[str]]:
        """The row as arrays, None where it is of no use; whether a clock was set; what there is to say."""
        told: list[str] = []
        t = _number(row, "t")
        if not np.isfinite(t):
            return None, False, self.once("t", "A row has no time `t` and was left out; give every row one.")
        set_back = False
        if self.last is not None:
            now = t + self.offset
            if now == self.last:
                return None, False, self.once("twice", f"Rows at the same time (t = {t:g} s) count once.")
            if now < self.last:
                set_back = True
                told.append(
                    f"The clock jumped back by {self.last - now:g} s, from {self.last - self.offset:g} s to "
                    f"{t:g} s; motion begins anew, evidence is kept, and times count on from there."
                )
                self.offset = self.last - t
        names = self.vehicle.command_names
        if self.driven is None:
            self.driven = bool(names) and any(name in row for name in names)
            missing = [name for name in names if name not in row] if self.driven else []
            if missing:
                raise InputError(
                    f"A row lacks the command {', '.join(missing)}; give one column per actuator of "
                    f"{self.vehicle.name} ({', '.join(names)})."
                )
            if not self.driven and not any(name in row for name in WRENCH):
                raise InputError(
                    f"A row has neither commands ({', '.join(names)}) nor a wrench ({', '.join(WRENCH)}); "
                    "map the columns."
                )
            if self.vehicle.prior:
                told.append(
                    f"The file of {self.vehicle.name} says in [prior] that its numbers may be far off, and a "
                    "name may stand in for what they miss; fit it to a log (`jaxmarine fit`), and narrow or "
                    "remove that table, before names count.",
                )
        commands = np.array([_number(row, name) for name in names])
        commands = np.where(np.isfinite(commands), commands, self.held)
        limits = self.vehicle.command_limits
        for name, value, limit in zip(names, commands, limits, strict=True):
            if abs(value) > limit * (1 + _ROUNDING):
                told += self.once(
                    name,
                    f"Command {name} is {value:g} at t = {t:g} s, beyond {limit:g}; it counts as {limit:g}.",
                )
        self.held = np.clip(commands, -limits, limits)
        wrench = np.nan_to_num(np.array([_number(row, name) for name in WRENCH]))
        channels = np.array([_number(row, name) for name in CHANNELS])
        self.last = t + self.offset if not set_back else self.last
        assert self.last is not None
        return (
            Rows(np.array([self.last]), channels[None], self.held[None], wrench[None] * (not self.driven)),
            set_back,
            told,
        )


def _number(row: Mapping[str, float], name: str) -> float:
    """A finite number of a row, NaN where it has none."""
    value = row.get(name)
    try:
        out = float("nan") if value is None or value == "" else float(value)
    except (TypeError, ValueError):
        return float("nan")
    return out if np.isfinite(out) else float("nan")
