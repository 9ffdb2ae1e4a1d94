"""MAVLink telemetry as ground stations record it, `.tlog`, by the library pymavlink."""

import contextlib
import io
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ..._errors import InputError
from ._instances import Instances, Origin
from ._series import Series, reading

# Fields with the vehicle's own time, their unit [s], and where a counter of 32 bits begins anew.
_TIMES = {"time_boot_ms": 1e-3, "time_usec": 1e-6}
_WRAP = 2.0**32
# This share of the messages came through fast; the very fastest may have a damaged time.
_FAST = 0.05


class Telemetry:
    """The messages of a telemetry log.

    - `stamp`: "header" takes the vehicle's own time where a message has one, "bag" that of reception.
    """

    def __init__(self, path: Path, stamp: str):
        self.path = path
        self.notes: list[str] = []
        self._by_vehicle = stamp == "header"
        with self._opened() as log:
            self.names = tuple(log.name_to_id)
        if not self.names:
            raise InputError(f"{path}: holds no MAVLink message; check that it is the right file.")

    def read(self, wanted: Collection[str]) -> dict[str, Series]:
        stamps = defaultdict(list)
        with self._opened() as log:
            instances = Instances(wanted, self.names, self.path)
            order = []
            while (message := log.recv_match(type=list(instances.heads))) is not None:
                name = message.get_type()
                time = next((one for one in _TIMES if one in message.get_fieldnames()), None)
                counted = np.nan if time is None else getattr(message, time)
                origin = Origin((message.get_srcSystem(), message.get_srcComponent()), _instance(message))
                stamps[name, origin].append((message._timestamp, counted, _TIMES.get(time or "", 1.0)))
                order.append((name, origin, message))
            times = {key: iter(self._times(np.array(found))) for key, found in stamps.items()}
            for name, origin, message in order:
                instances.take(name, origin, float(next(times[name, origin])), message)
        found = instances.series()
        self.notes = instances.notes + self._notes(stamps)
        return found

    def _times(self, stamps: np.ndarray) -> np.ndarray:
        """Times [s] on the recorder's clock, of times of reception, the vehicle's count and its unit.

        The vehicle's clock is set to the recorder's by the messages that came through fastest: the spacing of
        the samples is then the vehicle's, without the delays of the link.
        """
        received, counted, unit = stamps.T
        if not self._by_vehicle or np.isnan(counted).any():
            return received
        if counted.max() < _WRAP:
            counted = np.unwrap(counted, period=_WRAP)
        own = unit * counted
        return own + np.quantile(received - own, _FAST, method="higher")

    def _notes(self, stamps: dict) -> list[str]:
        without = sorted({name for (name, _), found in stamps.items() if np.isnan(found[0][1])})
        if not self._by_vehicle or not without:
            return []
        names = ", ".join(f"`{name}`" for name in without)
        return [f"The messages {names} have no time of their own and stand at that of reception."]

    @contextlib.contextmanager
    def _opened(self):
        with reading(self.path, "a telemetry log", "copy it from the ground station again"):
            from pymavlink import mavutil

            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                log = mavutil.mavmmaplog(str(self.path))
                try:
                    yield log
                finally:
                    log.close()


def _instance(message) -> int | str | None:
    field = message._instance_field
    return None if field is None else getattr(message, field)
