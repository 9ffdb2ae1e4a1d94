"""Which faults there are to switch on, and how large they are at first."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from .._types import DOFS, Scalar
from ..effects import CATALOGUE, Suspect, place
from ..vehicle import Placed, Vehicle


@dataclasses.dataclass(frozen=True)
class Size:
    """Of a fault's parameter: `value` at first, and between which ones it can be set, in its unit."""

    value: float
    low: float
    high: float


# What a fault is by default and at most, times a size of the craft's own where one is named. Not offered:
# what asks for the past (delays, the memory of the water), for a column that these craft do not log (battery,
# wind), and what is no fault but an error of a vehicle file's shape.
_OFFERED: Mapping[str, tuple[Mapping[str, Size], str | None]] = {
    "thruster_gain": ({"factor": Size(0.5, 0.0, 1.5)}, None),
    "reverse_thrust": ({"factor": Size(0.5, 0.0, 1.5)}, None),
    "deadband": ({"width": Size(0.15, 0.0, 0.5)}, None),
    "saturation": ({"limit": Size(0.5, 0.1, 1.0)}, None),
    "thrust_curve": ({"quadratic": Size(0.6, 0.0, 1.0)}, None),
    "exchanged_thrusters": ({}, None),
    "thruster_lag": ({"time_constant": Size(0.6, 0.0, 3.0)}, None),
    "inflow_loss": ({"per_speed": Size(0.3, 0.0, 1.0)}, None),
    "surface_gain": ({"factor": Size(0.5, 0.0, 1.5)}, None),
    "surface_offset": ({"angle": Size(0.1, -0.5, 0.5)}, None),
    "surface_stuck": ({"angle": Size(0.1, -0.5, 0.5)}, None),
    "surface_lag": ({"time_constant": Size(0.6, 0.0, 3.0)}, None),
    "surface_rate": ({"limit": Size(0.05, 0.01, 1.0)}, None),
    "wake": ({"fraction": Size(0.2, -0.5, 0.8)}, None),
    "steady_current": (
        {"north": Size(0.15, -1.0, 1.0), "east": Size(0.1, -1.0, 1.0), "down": Size(0.0, -1.0, 1.0)},
        None,
    ),
    "wind_push": ({"north": Size(0.1, -0.5, 0.5), "east": Size(0.05, -0.5, 0.5)}, "push"),
    "buoyancy": ({"force": Size(-0.005, -0.05, 0.05)}, "weight"),
    "quadratic_damping": ({"value": Size(0.5, 0.0, 3.0)}, "drag"),
    "tether_drag": ({"coefficient": Size(0.3, 0.0, 3.0)}, "drag"),
    "velocity_scale": ({"factor": Size(0.9, 0.5, 1.5)}, None),
    "velocity_misalignment": ({"yaw": Size(0.1, -0.5, 0.5)}, None),
    "gyro_bias": ({name: Size(0.02 * (name == "r"), -0.1, 0.1) for name in "pqr"}, None),
    "compass_deviation": (
        {"constant": Size(0.1, -0.5, 0.5), "cos": Size(0.0, -0.5, 0.5), "sin": Size(0.0, -0.5, 0.5)},
        None,
    ),
}


@dataclasses.dataclass(frozen=True)
class Fault:
    """An accusation of the catalogue that can be made true; `sizes`: of its parameters."""

    suspect: Suspect
    sizes: Mapping[str, Size]

    @property
    def label(self) -> str:
        return self.suspect.label

    def units(self) -> dict[str, str]:
        return {name: self.suspect.effect.units[name] for name in self.sizes}


def faults_of(vehicle: Vehicle, push: float) -> dict[str, Fault]:
    """Faults by their labels, such as `thruster_gain:port_h`, the plainest first.

    - `push` [N]: what the craft's actuators give together.
    """
    out = {}
    weight = float(vehicle.body.weight)
    drag = np.diag(np.asarray(vehicle.damping.quadratic)) + np.diag(np.asarray(vehicle.damping.linear))
    effects = {effect.name: effect for effect in CATALOGUE}
    for name, (sizes, by) in _OFFERED.items():
        for suspect in effects[name].suspects(vehicle):
            axis = DOFS.index(suspect.target) if suspect.target in DOFS else 0
            scale = {"weight": weight, "push": push, "drag": float(drag[axis]), None: 1.0}[by]
            if scale <= 0.0 or suspect.target == "all":
                continue
            own = {name: _scaled(sizes[name], scale) for name in suspect.slots}
            out[suspect.label] = Fault(suspect, own)
    return out


def _scaled(size: Size, scale: float) -> Size:
    if scale == 1.0:
        return size
    # Three digits are what an operator reads.
    return Size(*(float(f"{scale * one:.3g}") for one in dataclasses.astuple(size)))


def with_faults(
    vehicle: Vehicle, faults: Mapping[str, Fault], sizes: Mapping[str, Mapping[str, float | Scalar]]
) -> Vehicle:
    """The vehicle with all faults, behind what it has, each with a beginning: it acts where its gate is 1."""
    return vehicle.place(
        *(
            Placed(place(fault.suspect, vehicle, sizes[label]), fault.suspect.target, since=0.0)
            for label, fault in faults.items()
        )
    )
