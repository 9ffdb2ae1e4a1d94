"""What every fit, check and diagnosis does with a log first: accidents out, noise and clocks checked."""

import dataclasses
from collections.abc import Sequence

from ..logs import Log, doubtful_noise, smooth_states
from ..vehicle import Vehicle
from ._clock import clock_offset, told
from ._dirty import without_accidents
from ._driven import HALF, driven

# A shorter log does not show what is usual in it [s].
_LEAST = 30.0


def reviewed(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """The logs without their accidents (`Log.rejected`), and what there is to say of these, of clocks, and of
    stated noise that the samples contradict.

    The sentences stand in the logs' notes too. A log of which there is nothing to say comes back as it is.
    """
    after = tuple(_reviewed(vehicle, log) for log in logs)
    added = (note for old, new in zip(logs, after, strict=True) for note in new.notes[len(old.notes) :])
    return after, tuple(dict.fromkeys(added))


def _reviewed(vehicle: Vehicle, log: Log) -> Log:
    said = doubtful_noise(log, dict(vehicle.sensors))
    if log.duration >= _LEAST and log.dt <= 2 * HALF and not log.rejected:
        track = smooth_states(log, vehicle.dof)
        drive = driven(vehicle, log, track)
        log = without_accidents(vehicle, log, track, drive)
        offset = clock_offset(log, track, drive)
        if offset is not None and offset.significant:
            said.append(f"{log.name}: {told(offset)}")
    said = [note for note in said if note not in log.notes]
    return dataclasses.replace(log, notes=(*log.notes, *said)) if said else log
