"""The log of one run, as arrays."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._errors import InputError
from .._types import ALL_CHANNELS, ALWAYS, BATTERY

Reason = Literal["collision", "surfacing", "take-over"]


@dataclasses.dataclass(frozen=True)
class Rejected:
    """A stretch of the log of that name in which something acted that is no property of the vehicle.

    From `start` until `end` [s, the log's own time].
    """

    log: str
    start: float
    end: float
    reason: Reason


class Log(eqx.Module):
    """What was commanded and what was measured, sample by sample.

    - `t`: time [s], strictly increasing.
    - `channels`: measurements in the order of `ALL_CHANNELS`, SI units and radians; NaN where missing. The
      first `ALWAYS` are those of every log; others have columns where they or later ones were measured.
    - `commands`: one column per thruster and, behind them, the sliding mass, in the order of
      `command_names`; held until the next sample.
    - `wrench`: applied control wrench X Y Z K M N at `o`, body axes [N, N m]; held likewise.
    - `name`: the file's name; `notes`: its history, what was done, found or ignored, sentence by sentence.
    - `battery`: its voltage [V], held likewise, where it is logged and no command of the vehicle.
    - `rejected`: stretches that are left out: their channels are NaN, and no window touches them.

    Either `commands` or `wrench` drives the vehicle; the other one is None.
    """

    t: Float[np.ndarray, " times"]
    channels: Float[np.ndarray, "times channels"]
    commands: Float[np.ndarray, "times columns"] | None
    wrench: Float[np.ndarray, "times 6"] | None
    command_names: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True, default=())
    rejected: tuple[Rejected, ...] = eqx.field(static=True, default=())
    battery: Float[np.ndarray, " times"] | None = None

    def __check_init__(self):
        times = len(self.t)
        widths = range(ALWAYS, len(ALL_CHANNELS) + 1, 3)
        if self.channels.shape not in {(times, width) for width in widths}:
            columns = " or ".join(map(str, widths))
            raise ValueError(
                f"Argument `channels` must be ({times}, {columns}), but is {self.channels.shape}."
            )
        if (self.commands is None) == (self.wrench is None):
            raise ValueError("Exactly one of `commands` and `wrench` must be given.")
        if self.commands is not None and self.commands.shape != (times, len(self.command_names)):
            columns = len(self.command_names)
            raise ValueError(
                f"Argument `commands` must be ({times}, {columns}), but is {self.commands.shape}."
            )
        if self.wrench is not None and self.wrench.shape != (times, 6):
            raise ValueError(f"Argument `wrench` must be ({times}, 6), but is {self.wrench.shape}.")

    @property
    def duration(self) -> float:
        """From the first sample to the last [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def clock(self) -> float:
        """What the log's own clock shows at its start [s]; 0 where that is within a sample of zero."""
        return float(self.t[0]) if abs(self.t[0]) > 1.001 * self.dt else 0.0

    @property
    def dt(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.t)))

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the channels with at least one sample."""
        names = np.array(ALL_CHANNELS[: self.channels.shape[1]])
        return tuple(names[np.isfinite(self.channels).any(axis=0)].tolist())

    def commanded(self, names: Sequence[str]) -> Float[np.ndarray, "times columns"] | None:
        """The commands of a vehicle with these columns, which may ask for the voltage of the battery too."""
        if self.commands is None or BATTERY not in names or BATTERY in self.command_names:
            return self.commands
        if self.battery is None:
            raise InputError(f"{self.name}: lacks the column `{BATTERY}`, by which the thrust goes; add it.")
        return np.insert(self.commands, list(names).index(BATTERY), self.battery, axis=1)

    def split(self, at: float) -> tuple["Log", "Log"]:
        """The samples before the time `at` [s, the log's own], and those from it on."""
        return self.between(-np.inf, at), self.between(at, np.inf)

    def between(self, t0: float, t1: float) -> "Log":
        """The samples with t0 <= t < t1 [s, the log's own time, which is kept].

        Half-open, so that neighbouring parts share no sample.
        """
        inside = (self.t >= t0) & (self.t < t1)
        if np.count_nonzero(inside) < 2:
            raise InputError(
                f"{self.name}: has fewer than two samples from t = {t0:g} s to {t1:g} s; "
                f"choose times between {self.t[0]:g} s and {self.t[-1]:g} s."
            )
        return Log(
            t=self.t[inside],
            channels=self.channels[inside],
            commands=None if self.commands is None else self.commands[inside],
            wrench=None if self.wrench is None else self.wrench[inside],
            command_names=self.command_names,
            name=self.name,
            notes=self.notes,
            rejected=tuple(one for one in self.rejected if one.start < t1 and one.end >= t0),
            battery=None if self.battery is None else self.battery[inside],
        )


def alike(logs: Sequence[Log], width: int = ALWAYS) -> tuple[Log, ...]:
    """The logs with as many channels each as the one with most has, and no fewer than `width`."""
    width = max([width, *(log.channels.shape[1] for log in logs)])

    def widened(log: Log) -> Log:
        short = width - log.channels.shape[1]
        if not short:
            return log
        channels = np.pad(log.channels, [(0, 0), (0, short)], constant_values=np.nan)
        return dataclasses.replace(log, channels=channels)

    return tuple(map(widened, logs))
