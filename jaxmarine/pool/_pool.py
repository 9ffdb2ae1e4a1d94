"""The pool: a craft that is steered in real time, and what becomes of it in a log."""

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from .._errors import InputError
from .._files import did_you_mean, written_whole
from .._types import ALL_CHANNELS, ALWAYS
from ..vehicle_io import packaged_vehicle
from ._basin import DT, Basin, Sample
from ._crafts import Craft
from ._faults import faults_of
from ._recording import FAULTS, FLIGHT, VEHICLE, Rows, next_flight

# Beyond so much delay [s] the simulation gives up what it has missed: its time then runs behind the wall's.
_CATCHES_UP = 1.0
# Without word from the page for so long [s] all is set to rest. A page in the background speaks every second.
_SILENCE = 3.0
_DISTURBANCE = "disturbance"


class Pool:
    """One flight: `steer` and `switch` from any thread, `run` in one.

    - `folder`: of the log, the vehicle file and the table of faults; it is there.
    - `noisy`: whether the sensors have the noise that the vehicle file states.
    - `clock`: seconds of a clock that goes on steadily.

    Raises `InputError` where the folder cannot be written or belongs to another craft.
    """

    def __init__(
        self,
        craft: Craft,
        folder: Path,
        seed: int | None = None,
        noisy: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.craft, self.vehicle = craft, craft.vehicle()
        self.faults = faults_of(self.vehicle, craft.push)
        self.columns, self.limits = self.vehicle.command_names, self.vehicle.command_limits
        noise = self.vehicle.stated_noise[:ALWAYS]
        self._measured = np.flatnonzero(np.isfinite(noise))
        self._basin = Basin(self.vehicle, self.faults, craft, noise if noisy else 0.0 * noise, seed)
        self.vehicle_file = folder / VEHICLE
        _place_vehicle(packaged_vehicle(craft.packaged), self.vehicle_file)
        number = next_flight(folder)
        names = ("t", *(ALL_CHANNELS[i] for i in self._measured), *self.columns)
        self.log = Rows(folder / FLIGHT.format(number), names)
        self.switched = Rows(folder / FAULTS.format(number), ("t", "fault", "on", "size"))
        self._clock, self._lock = clock, threading.Lock()
        self._begun, self._ended = threading.Event(), threading.Event()
        self._commands, self._heard = np.zeros(len(self.columns)), -np.inf
        self._on: dict[str, dict[str, float]] = {}
        self._since: dict[str, float] = {}
        self.late = self.lost = 0.0
        self.sample: Sample | None = None
        self.failure: InputError | None = None

    # --- what an operator does -------------------------------------------------------------------

    def steer(self, commands: Mapping[str, float]) -> None:
        """Sets commands of some columns from the next sample on; the first call lets the clock begin."""
        new = self._commands.copy()
        for name, value in commands.items():
            if name not in self.columns:
                raise InputError(f"Command `{name}`: is of no actuator; {did_you_mean(name, self.columns)}")
            i = self.columns.index(name)
            if not abs(value) <= self.limits[i]:
                raise InputError(
                    f"Command `{name}`: is {value:g}, but must lie within {self.limits[i]:g} of 0."
                )
            new[i] = value
        with self._lock:
            self._commands, self._heard = new, self._clock()
        self._begun.set()

    def switch(self, label: str, on: bool, values: Mapping[str, float]) -> None:
        """Switches a fault, or the disturbance, from the next sample on; `values`: sizes other than now."""
        if label == _DISTURBANCE:
            if values:
                raise InputError("Disturbance: has no size to be set.")
            with self._lock:
                self._basin.disturbed = on
                self._note(label, on, {})
            return
        if label not in self.faults:
            raise InputError(f"Fault `{label}`: is not known; {did_you_mean(label, self.faults)}")
        sizes = self.faults[label].sizes
        for name, value in values.items():
            if name not in sizes:
                raise InputError(f"Fault `{label}`: has no parameter `{name}`; give {', '.join(sizes)}.")
            if not sizes[name].low <= value <= sizes[name].high:
                raise InputError(
                    f"Fault `{label}`: `{name}` is {value:g}, but must lie from {sizes[name].low:g} to "
                    f"{sizes[name].high:g}."
                )
        with self._lock:
            size = {name: one.value for name, one in sizes.items()} | self._on.get(label, {}) | dict(values)
            self._basin.switch(label, on, size)
            self._note(label, on, size)

    def _note(self, label: str, on: bool, size: Mapping[str, float]) -> None:
        words = " ".join(f"{name}={value!r}" for name, value in size.items())
        self.switched.append((repr(self._basin.t), label, str(int(on)), words))
        if on:
            self._since.setdefault(label, self._basin.t)
            self._on[label] = dict(size)
        else:
            self._since.pop(label, None)
            self._on.pop(label, None)

    # --- what goes on --------------------------------------------------------------------------

    def step(self) -> None:
        """Takes the next sample and records it. The first has commands of zero: they held before it."""
        with self._lock:
            if self._clock() - self._heard > _SILENCE:
                self._commands = np.zeros(len(self.columns))
            first = self.sample is None
            sample = self._basin.step(np.zeros(len(self.columns)) if first else self._commands)
            numbers = np.concatenate([sample.shown[self._measured], sample.commands])
            if not np.isfinite(numbers).all():
                raise InputError(
                    f"{self.log.path}: the simulation runs away after {sample.t:.1f} s; begin again with "
                    "smaller faults."
                )
            self.log.append(f"{value:.9g}" for value in (round(sample.t, 9), *numbers))
            self.sample = sample

    def run(self, failed: Callable[[], None] = lambda: None) -> None:
        """Steps in real time once somebody steers, until `end`; `failed` is called where it cannot go on."""
        self._begun.wait()
        due = self._clock()
        try:
            while not self._ended.wait(max(0.0, due - self._clock())):
                late = max(0.0, self._clock() - due)
                if late > _CATCHES_UP:
                    self.lost += late
                    due, late = due + late, 0.0
                self.late = late
                self.step()
                due += DT
        except InputError as error:
            self.failure = error
            failed()

    def end(self) -> None:
        """Ends `run`, before its next sample."""
        self._ended.set()
        self._begun.set()

    def close(self) -> None:
        """Ends the files, each with its last whole row; those without one are removed."""
        with self._lock:
            self.log.close()
            self.switched.close()

    # --- what is seen --------------------------------------------------------------------------

    def view(self) -> dict:
        """What changes while it is flown, for JSON."""
        with self._lock:
            sample = self.sample
            seen = {
                "faults": {
                    label: {"since": self._since[label], "values": values}
                    for label, values in self._on.items()
                },
                "rows": self.log.count,
                "late": round(self.late, 2),
                "lost": round(self.lost, 2),
                "failure": None if self.failure is None else str(self.failure),
            }
        if sample is None:
            return seen
        return seen | {
            "t": round(sample.t, 3),
            "pose": sample.pose.tolist(),
            "shown": {ALL_CHANNELS[i]: float(sample.shown[i]) for i in self._measured},
            "commands": dict(zip(self.columns, sample.commands.tolist(), strict=True)),
            "given": dict(zip(self.columns, sample.given.tolist(), strict=True)),
        }


def _place_vehicle(packaged: Path, place: Path) -> None:
    content = packaged.read_bytes()
    try:
        there = place.read_bytes() if place.exists() else content
    except OSError:
        there = b""
    if there != content:
        raise InputError(f"{place}: is another craft's, or changed; choose another --out.")
    with written_whole(place) as beside:
        beside.write_bytes(content)
