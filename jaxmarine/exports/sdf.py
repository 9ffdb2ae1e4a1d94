"""Gazebo SDF: a world with the vehicle, by the plug-ins Hydrodynamics, Buoyancy, Thruster and LiftDrag.

Axes are forward-left-up. Damping stands in the plug-in with negative signs, added mass once, as
`<fluid_added_mass>` (positive, about the link's origin), so that the plug-in's own is turned off. A thruster
is told its thrust [N], a surface its deflection [rad].
"""

import itertools
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .._errors import InputError
from .._files import written_whole
from .._types import DOFS
from ..actuators import FREE, Surfaces
from ..vehicle import Vehicle
from . import _lost, _plain

NEEDS = ()
_FLIP = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
_FORCES, _VELOCITIES, _ADDED = "xyzkmn", "UVWPQR", "xyzpqr"
# Of what turns in a thruster or with a surface, which Gazebo wants to be a body [kg, kg m²]: too light to be
# felt.
_ROTOR = (1e-3, 1e-6)


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    """Plain numbers without a state of their own; `InputError` where an axis is locked."""
    locked = [dof for dof in DOFS if dof not in vehicle.dof]
    if locked:
        raise InputError(
            f"Format `sdf` holds vehicles that are free in all axes, but {vehicle.name} is locked in "
            f"{', '.join(locked)}; export it as `mujoco` or `fmi3`."
        )
    plain = _plain.Plain.of(vehicle)
    out = [*_plain.lost(vehicle, held=(Surfaces,)), *_lost.lag(vehicle)]
    if vehicle.thruster_names:
        out.append("Thrusters are told their thrust in N; the curve from command to thrust is yours.")
    surfaces = _surfaces(vehicle)
    out += (sentence for one in surfaces for sentence in _beyond_lift(one))
    if np.any(plain.current):
        out.append("The current drags the hull, but the added mass is that of still water.")
    if np.any(plain.current) and surfaces:
        out.append("Surfaces see no current.")
    if np.any(plain.wrench):
        out.append("The constant wrench is left out.")
    out.append("The hull collides as a ball of its displaced volume; give it its shape.")
    out.append("The equations are those of the plug-ins' documentation; this file was not run in Gazebo.")
    return tuple(out)


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes the world (SDF 1.11, for Gazebo Harmonic and later)."""
    plain = _plain.Plain.of(vehicle)
    root = ET.Element("sdf", version="1.11")
    for note in notes:
        # Two dashes would end the comment.
        root.append(ET.Comment(f" {note.replace('--', '- -')} "))
    world = ET.SubElement(root, "world", name="water")
    gravity, density = float(vehicle.gravity), float(vehicle.density)
    _put(world, "gravity", (0.0, 0.0, -gravity))
    _plugin(world, "physics", "Physics")
    _plugin(world, "user-commands", "UserCommands")
    _plugin(world, "scene-broadcaster", "SceneBroadcaster")
    _put(_plugin(world, "buoyancy", "Buoyancy"), "uniform_fluid_density", density)
    model = ET.SubElement(world, "model", name=vehicle.name)
    _hull(ET.SubElement(model, "link", name="base_link"), plain, gravity, density)
    _water(_plugin(model, "hydrodynamics", "Hydrodynamics"), plain)
    for i, name in enumerate(vehicle.thruster_names):
        _thruster(model, vehicle, plain, i, name)
    for surfaces in _surfaces(vehicle):
        for i, name in enumerate(surfaces.names):
            _surface(model, surfaces, i, name, density)
    ET.indent(root)
    with written_whole(path) as beside:
        beside.write_text(
            f"<?xml version='1.0'?>\n{ET.tostring(root, encoding='unicode')}\n", encoding="utf-8"
        )


def _hull(link: ET.Element, plain: _plain.Plain, gravity: float, density: float) -> None:
    """Rigid body, added mass, and a ball that displaces the water."""
    mass = plain.rigid[0, 0]
    cog = np.array([plain.rigid[5, 1], plain.rigid[3, 2], plain.rigid[4, 0]]) / mass
    arm = np.cross(np.eye(3), cog)
    inertia = _FLIP[:3, None] * (plain.rigid[3:, 3:] + mass * arm @ arm) * _FLIP[:3]
    inertial = ET.SubElement(link, "inertial")
    _put(inertial, "pose", (*(_FLIP[:3] * cog), 0.0, 0.0, 0.0))
    _put(inertial, "mass", mass)
    moments = ET.SubElement(inertial, "inertia")
    for i, j in itertools.combinations_with_replacement(range(3), 2):
        _put(moments, f"i{'xyz'[i]}{'xyz'[j]}", inertia[i, j])
    added = ET.SubElement(inertial, "fluid_added_mass")
    matrix = _FLIP[:, None] * plain.added * _FLIP
    for i, j in itertools.combinations_with_replacement(range(6), 2):
        _put(added, _ADDED[i] + _ADDED[j], matrix[i, j])
    # Gravity pulls at the mass alone: where the file's weight differs, the ball makes up for it.
    lift = mass * gravity - plain.weight + plain.buoyancy
    if lift <= 0.0:
        return
    moment = plain.weight_moment - plain.buoyancy_moment
    centre = (mass * gravity * cog - moment) / lift
    collision = ET.SubElement(link, "collision", name="displaced")
    _put(collision, "pose", (*(_FLIP[:3] * centre), 0.0, 0.0, 0.0))
    ball = ET.SubElement(ET.SubElement(collision, "geometry"), "sphere")
    _put(ball, "radius", (0.75 / math.pi * lift / (density * gravity)) ** (1 / 3))


def _water(plugin: ET.Element, plain: _plain.Plain) -> None:
    """Damping and current."""
    _put(plugin, "link_name", "base_link")
    _put(plugin, "disable_added_mass", "true")
    _put(plugin, "disable_coriolis", "true")
    for i, j in itertools.product(range(6), repeat=2):
        for value, name in (
            (_FLIP[i] * plain.linear[i, j] * _FLIP[j], f"{_FORCES[i]}{_VELOCITIES[j]}"),
            (_FLIP[i] * plain.quadratic[i, j] * _FLIP[j], f"{_FORCES[i]}{_VELOCITIES[j]}abs{_VELOCITIES[j]}"),
        ):
            if value != 0.0:
                _put(plugin, name, -value)
    if np.any(plain.current):
        _put(plugin, "default_current", _FLIP[:3] * plain.current)


def _thruster(model: ET.Element, vehicle: Vehicle, plain: _plain.Plain, i: int, name: str) -> None:
    """A light link that turns about the direction of the thrust, and the plug-in that pushes it."""
    position = np.asarray(vehicle.thrusters.position[i])
    _turning(model, f"{name}_rotor", f"{name}_joint", position, plain.allocation[:3, i])
    plugin = _plugin(model, "thruster", "Thruster")
    _put(plugin, "namespace", vehicle.name)
    _put(plugin, "joint_name", f"{name}_joint")
    _put(plugin, "fluid_density", float(vehicle.density))
    # With these the thrust is applied as it is told; by shaft speed [rad/s] it would be
    # thrust_coefficient * fluid_density * propeller_diameter^4 * speed |speed|.
    _put(plugin, "velocity_control", "true")
    _put(plugin, "max_thrust_cmd", plain.saturation[i] * plain.max_thrust[i])
    _put(plugin, "min_thrust_cmd", -plain.saturation[i] * plain.max_thrust_reverse[i])


def _turning(
    model: ET.Element,
    link_name: str,
    joint_name: str,
    position: Float[np.ndarray, "3"],
    axis: Float[np.ndarray, "3"],
) -> ET.Element:
    """A light link on the hull that turns about an axis, both in the vehicle's axes; the joint's `axis`."""
    link = ET.SubElement(model, "link", name=link_name)
    _put(link, "pose", (*(_FLIP[:3] * position), 0.0, 0.0, 0.0))
    inertial = ET.SubElement(link, "inertial")
    _put(inertial, "mass", _ROTOR[0])
    moments = ET.SubElement(inertial, "inertia")
    for one in "xyz":
        _put(moments, f"i{one}{one}", _ROTOR[1])
    joint = ET.SubElement(model, "joint", name=joint_name, type="revolute")
    _put(joint, "parent", "base_link")
    _put(joint, "child", link_name)
    about = ET.SubElement(joint, "axis")
    _put(about, "xyz", _FLIP[:3] * axis)
    return about


# --- control surfaces ----------------------------------------------------------------------------


def _surfaces(vehicle: Vehicle) -> list[Surfaces]:
    """All of them, or none, with what effects make of them."""
    return [one for one in vehicle.plant().actuators if isinstance(one, Surfaces)]


def _seen(surfaces: Surfaces, i: int) -> float:
    """Share of the flow across that a surface sees: the mean of those to port and to starboard."""
    return float(np.mean(np.asarray(surfaces.straightening[i])))


def _initial_attack(surfaces: Surfaces, i: int) -> float | None:
    """The plug-in's `a0` [rad], which stands for an offset; None where it would have to be too large.

    What is beyond a right angle it takes for a flow from behind; the half of one is left to the flow itself.
    """
    offset, seen = float(surfaces.offset[i]), _seen(surfaces, i)
    if not offset:
        return 0.0
    return offset / seen if abs(offset) < math.pi / 4 * seen else None


def _beyond_lift(surfaces: Surfaces) -> list[str]:
    """What surfaces have that the plug-in has not."""
    out = [
        "Control surfaces lift by LiftDrag in proportion to deflection and angle of the flow, without drag, "
        "as they do at small angles."
    ]
    if any(behind is not None for behind in surfaces.behind):
        out.append("Surfaces see the flow of the vehicle's own motion, not a propeller's stream.")
    own = np.asarray(surfaces.position)[:, 0]
    unequal = np.ptp(np.asarray(surfaces.straightening), axis=1)
    if any(np.any(one) for one in (surfaces.lift_increase, surfaces.arm - own, unequal)):
        out.append(
            "Of a hull's part in its rudder's force (`hull`) the mean of `straightening` alone is written."
        )
    off = [name for i, name in enumerate(surfaces.names) if _initial_attack(surfaces, i) is None]
    if off:
        out.append(f"The offset of surfaces is left out: {', '.join(off)}.")
    return out


def _surface(model: ET.Element, surfaces: Surfaces, i: int, name: str, density: float) -> None:
    """What lifts at a surface's place, and, of one that moves or is stuck, a stock to turn."""
    slope = float(surfaces.gain[i] * surfaces.lift_slope[i])
    axis, chord, position = (np.asarray(getattr(surfaces, k)[i]) for k in ("axis", "chord", "position"))
    plugin = _plugin(model, "lift-drag", "LiftDrag")
    _put(plugin, "link_name", "base_link")
    _put(plugin, "air_density", density)
    _put(plugin, "area", float(surfaces.area[i]))
    _put(plugin, "cp", _FLIP[:3] * position)
    _put(plugin, "forward", _FLIP[:3] * chord)
    _put(plugin, "upward", _FLIP[:3] * np.cross(axis, chord))
    # Astern it lifts as well.
    _put(plugin, "reversible", "true")
    _put(plugin, "cla", slope * _seen(surfaces, i))
    _put(plugin, "cda", 0.0)
    most, stuck = float(surfaces.max_angle[i]), float(surfaces.stuck[i])
    held = abs(stuck) < FREE
    _put(plugin, "a0", 0.0 if held else _initial_attack(surfaces, i) or 0.0)
    if surfaces.fixed[i] and not held:
        return
    about = _turning(model, f"{name}_stock", f"{name}_joint", position, axis)
    limit = ET.SubElement(about, "limit")
    _put(limit, "lower", stuck if held else -most)
    _put(limit, "upper", stuck if held else most)
    _put(plugin, "control_joint_name", f"{name}_joint")
    _put(plugin, "control_joint_rad_to_cl", slope)
    driver = _plugin(model, "joint-position-controller", "JointPositionController")
    _put(driver, "joint_name", f"{name}_joint")
    _put(driver, "use_velocity_commands", "true")
    if held:
        _put(driver, "initial_position", stuck)


def _plugin(parent: ET.Element, file: str, name: str) -> ET.Element:
    return ET.SubElement(parent, "plugin", filename=f"gz-sim-{file}-system", name=f"gz::sim::systems::{name}")


def _put(parent: ET.Element, name: str, value) -> None:
    text = (
        value if isinstance(value, str) else " ".join(repr(float(one) + 0.0) for one in np.atleast_1d(value))
    )
    ET.SubElement(parent, name).text = text
