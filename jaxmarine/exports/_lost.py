"""What an export leaves behind, one sentence each."""

from collections.abc import Sequence

import numpy as np

from ..effects import SensorDelay, SensorEffect
from ..physics import UNLIMITED
from ..vehicle import Vehicle


def always(vehicle: Vehicle) -> tuple[str, ...]:
    """What no target of equations holds: times at which effects begin, sensors, delays of commands."""
    out = []
    begun = [f"`{p.effect.name}` ({p.since:g} s)" for p in vehicle.placed if p.since is not None]
    if begun:
        out.append(f"Effects with a beginning act all the time here: {', '.join(begun)}.")
    seen = [p.effect.name for p in vehicle.placed if isinstance(p.effect, SensorEffect | SensorDelay)]
    if seen:
        out.append(f"Sensors show the true motion, without {named(seen)}.")
    delay = np.asarray(vehicle.plant().drive.delay)
    late = [f"{name} ({d:g} s)" for name, d in zip(vehicle.drive_names, delay, strict=True) if d > 0.0]
    if late:
        out.append(f"Commands act at once; hand them in late by the delays of {', '.join(late)}.")
    return tuple(out)


def masses(vehicle: Vehicle) -> tuple[str, ...]:
    """Of targets in which no masses move."""
    return tuple(
        f"The {one.title.lower()} {named(one.names)} rests where the file has it and has no command."
        for one in vehicle.masses
    )


def lag(vehicle: Vehicle) -> tuple[str, ...]:
    """Of targets whose actuators have no state."""
    drive = vehicle.plant().drive
    slow = np.asarray(drive.lag) > 0.0
    if drive.rate is not None:
        slow = slow | (np.asarray(drive.rate) < UNLIMITED)
    names = [name for name, one in zip(vehicle.drive_names, slow, strict=True) if one]
    return (f"Actuators follow at once, without lag or limit of rate: {named(names)}.",) if names else ()


def memory(vehicle: Vehicle) -> tuple[str, ...]:
    """Of targets whose hull has no state beside its motion."""
    if not vehicle.plant().has_memory:
        return ()
    return ("Fluid memory acts at once, as linear damping.",)


def named(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in dict.fromkeys(names))
