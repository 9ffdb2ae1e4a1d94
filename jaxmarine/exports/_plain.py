"""A vehicle as the numbers that every simulator of this field has, and what is not among them."""

import dataclasses

import numpy as np

from ..actuators import AbstractActuators
from ..effects import ConstantWrench, CoupledDamping, FluidMemory, LinearDamping, QuadraticDamping
from ..vehicle import Vehicle
from . import _lost

_PLAIN = (LinearDamping, QuadraticDamping, CoupledDamping, ConstantWrench)


@dataclasses.dataclass(frozen=True)
class Plain:
    """Constants with effects summed into them, SI units, body axes at `o`, signs as in a vehicle file.

    - `rigid`, `added`, `linear`, `quadratic`: 6x6; `wrench`: a constant one (6); `current` NED (3).
    - `weight`, `buoyancy` [N]; `weight_moment`, `buoyancy_moment` [N m]: times their centres.
    - `free`: 1 for free axes; `allocation`: 6 rows, a column per thruster; the rest one number per thruster.
    """

    rigid: np.ndarray
    added: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    wrench: np.ndarray
    current: np.ndarray
    weight: float
    buoyancy: float
    weight_moment: np.ndarray
    buoyancy_moment: np.ndarray
    free: np.ndarray
    allocation: np.ndarray
    max_thrust: np.ndarray
    max_thrust_reverse: np.ndarray
    deadband: np.ndarray
    saturation: np.ndarray
    quadratic_share: np.ndarray
    lag: np.ndarray

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Plain":
        plant = vehicle.plant()
        load, drive, count = plant.load, plant.drive, plant.allocation.shape[-1]
        linear, quadratic = np.array(plant.damping.linear), np.array(plant.damping.quadratic)
        wrench = np.zeros(6)
        for effect in plant.wrenches:
            if isinstance(effect, LinearDamping):
                linear += np.diag(np.asarray(effect.value))
            elif isinstance(effect, CoupledDamping):
                linear += np.asarray(effect.value)
            elif isinstance(effect, QuadraticDamping):
                quadratic += np.diag(np.asarray(effect.value))
            elif isinstance(effect, ConstantWrench):
                wrench += np.asarray(effect.value)
            elif isinstance(effect, FluidMemory):
                linear += np.diag(np.asarray(effect.gain))
        gain = np.asarray(drive.gain)[:count]
        added = np.asarray(load.added)
        return cls(
            rigid=np.asarray(load.rigid),
            added=0.5 * (added + added.T),
            linear=linear,
            quadratic=quadratic,
            wrench=wrench,
            current=np.asarray(plant.water),
            weight=float(load.weight),
            buoyancy=float(load.buoyancy),
            weight_moment=np.asarray(load.weight_moment),
            buoyancy_moment=np.asarray(load.buoyancy_moment),
            free=vehicle.free,
            allocation=np.asarray(plant.allocation),
            max_thrust=gain * np.asarray(drive.max_thrust)[:count],
            max_thrust_reverse=gain * np.asarray(drive.max_thrust_reverse)[:count],
            deadband=np.asarray(drive.deadband)[:count],
            saturation=np.asarray(drive.saturation)[:count],
            quadratic_share=np.asarray(drive.quadratic)[:count],
            lag=np.asarray(drive.lag)[:count],
        )


def lost(vehicle: Vehicle, held: tuple[type[AbstractActuators], ...] = ()) -> tuple[str, ...]:
    """What a vehicle has beside those numbers, and beside actuators that are `held` otherwise."""
    plant = vehicle.plant()
    out = [*_lost.always(vehicle), *_lost.masses(vehicle), *_lost.memory(vehicle)]
    for one in (one for one in vehicle.actuators if not isinstance(one, held)):
        out.append(f"{one.title} are left out: {', '.join(one.names)}.")
    others = [e.name for e in plant.wrenches if not isinstance(e, (*_PLAIN, FluidMemory))]
    if others:
        out.append(f"Forces are left out: {_lost.named(others)}.")
    if plant.drive.curves:
        out.append("The learned curve of thrust is left out.")
    if np.any(np.asarray(plant.drive.inflow)):
        out.append("Thrust does not fall with speed, as `inflow_loss` has it.")
    if np.any(np.asarray(plant.advance)):
        out.append("The flow past thrusters takes no thrust, as `advance_loss` has it.")
    if not np.allclose(plant.load.added, plant.load.added.T):
        out.append("Added mass is made symmetric.")
    return tuple(out)
