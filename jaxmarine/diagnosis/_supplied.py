"""Thrusters whose file knows no battery, where the logs have its voltage."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .._types import BATTERY
from ..actuators import Supply
from ..effects import AbstractEffect, Voltage
from ..logs import Log
from ..networks import LearnedTerm
from ..vehicle import Vehicle


def lacks_battery(vehicle: Vehicle, catalogue: Sequence[type[AbstractEffect]]) -> bool:
    """Whether the effect `voltage` is suspected of a vehicle with thrusters whose file knows no battery."""
    return Voltage in catalogue and bool(vehicle.thruster_names) and BATTERY not in vehicle.command_names


def supplied(
    vehicle: Vehicle,
    train: Sequence[Log],
    test: Sequence[Log],
    catalogue: Sequence[type[AbstractEffect]],
) -> Vehicle:
    """The vehicle with a battery on which its thrust does not hang yet, as the effect `voltage` asks for it.

    As it is where that is not suspected, where not every log has the voltage beside commands, and where it
    never changes. The nominal voltage is the mean over the training logs.
    """
    volts = [log.battery for log in (*train, *test) if log.commands is not None and log.battery is not None]
    if not lacks_battery(vehicle, catalogue) or len(volts) < len(train) + len(test):
        return vehicle
    seen = np.concatenate(volts[: len(train)])
    if np.ptp(seen) == 0 or seen.min() <= 0:
        return vehicle
    battery = Supply.unfiled(vehicle.thruster_names, float(seen.mean()))
    return dataclasses.replace(vehicle, actuators=(*vehicle.actuators, battery))


def unsupplied(extended: Vehicle, filed: Vehicle) -> Vehicle:
    """An extended vehicle without the battery that its file does not have, where nothing hangs on that."""
    if BATTERY in filed.command_names:
        return extended
    for placed in extended.placed:
        learned = isinstance(placed.effect, LearnedTerm) and BATTERY in placed.effect.inputs
        if learned or isinstance(placed.effect, Voltage):
            return extended
    others = tuple(one for one in extended.actuators if not isinstance(one, Supply))
    return dataclasses.replace(extended, actuators=others)
