"""What every fit, check and diagnosis does with a log first: accidents out, noise and clocks checked."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .._types import DOFS
from ..logs import Log, Note, doubtful_noise, merged, smooth_states
from ..vehicle import Vehicle
from ._clock import clock_offset, told
from ._dirty import without_accidents
from ._driven import HALF, driven

# A shorter log does not show what is usual in it [s].
_LEAST = 30.0
# Share of its mass by which an axis is pushed at 1 m/s or rad/s [1/s]: less is rounding.
_PUSH = 0.02


def reviewed(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """The logs without their accidents (`Log.rejected`), and what there is to say of these, of clocks, of
    stated noise that the samples contradict, and of damping with the wrong sign.

    What is said of a log stands in its notes too. One of which there is nothing to say comes back as it is.
    """
    after = tuple(_reviewed(vehicle, log) for log in logs)
    added = (note for old, new in zip(logs, after, strict=True) for note in new.notes[len(old.notes) :])
    return after, merged((*_pushing(vehicle), *added))


def _pushing(vehicle: Vehicle) -> list[str]:
    """A note on axes that the vehicle's damping drives."""
    force = np.diag(np.asarray(vehicle.damping.linear + vehicle.damping.quadratic))
    pushes = (force < -_PUSH * np.diag(np.asarray(vehicle.mass_matrix))) & (np.asarray(vehicle.free) > 0)
    names = ", ".join(name for name, bad in zip(DOFS, pushes, strict=True) if bad)
    if not names:
        return []
    return [
        f"{vehicle.name}: its damping drives it in {names} instead of braking it; a vehicle file has damping "
        "with the positive sign."
    ]


def _reviewed(vehicle: Vehicle, log: Log) -> Log:
    said: list[str] = [*doubtful_noise(log, dict(vehicle.sensors))]
    if log.duration >= _LEAST and log.dt <= 2 * HALF and not log.rejected:
        track = smooth_states(log, vehicle.dof)
        drive = driven(vehicle, log, track)
        log = without_accidents(vehicle, log, track, drive)
        offset = clock_offset(log, track, drive)
        if offset is not None and offset.significant:
            words, size = told(offset), abs(offset.seconds)
            said.append(
                Note.of(log.name, f"{{log}}: {words}", f"{{logs}}: {words}", size=size, std=offset.std)
            )
    said = [note for note in said if note not in log.notes]
    return dataclasses.replace(log, notes=(*log.notes, *said)) if said else log
