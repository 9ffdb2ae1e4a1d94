"""MuJoCo: a rigid body with a free joint, and its water as a passive-force callback."""

import json
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._files import written_whole
from .._types import Matrix6, Scalar, Wrench
from ..physics import apply, coriolis, rotation
from ..vehicle import Input, State, Vehicle
from . import _lost
from ._model import Command, Model

NEEDS = ("casadi",)
# [s]; a classical Runge-Kutta step of a craft that lives a tenth of a second and longer.
_TIMESTEP = 0.01
_FLIP = np.array([1.0, -1.0, -1.0])


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    """The callback has no state of its own, so that nothing lags."""
    out = [*_lost.always(vehicle), *_lost.masses(vehicle), *_lost.lag(vehicle), *_lost.memory(vehicle)]
    out.append("Contacts and ties feel the rigid body alone, without its added mass.")
    if not _bodily(_inertia(vehicle)[2]):
        out.append(
            "The file's inertia is that of no body, as axes are locked; MuJoCo has a ball's in its place, "
            "which moves the same in the water."
        )
    return tuple(out)


def _inertia(vehicle: Vehicle) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], centre of gravity [m] and inertia about that [kg m²], effects included, body axes."""
    rigid = np.asarray(vehicle.plant().load.rigid)
    mass = float(rigid[0, 0])
    # The lower left block is m S(cog).
    x, y, z = np.array([rigid[5, 1], rigid[3, 2], rigid[4, 0]]) / mass
    arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return mass, np.array([x, y, z]), rigid[3:, 3:] + mass * arm @ arm


def _bodily(inertia: np.ndarray) -> bool:
    """Whether a body can have this inertia: its moments are positive, and none exceeds the other two."""
    moments = np.linalg.eigvalsh(inertia)
    return bool(moments[0] > 0.0 and moments[2] <= moments[0] + moments[1])


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes a zip archive of `vehicle.xml`, `hull.py`, which has the callback, and what that reads."""
    from ._symbols import expressed

    model = Model.of(vehicle, moves=False)
    mass, cog, inertia = _inertia(vehicle)
    if not _bodily(inertia):
        inertia = np.eye(3) * np.abs(inertia).max()
    arm = np.cross(np.eye(3), cog)
    lever = mass * arm
    rigid = np.block([[mass * np.eye(3), -lever], [lever, inertia - mass * arm @ arm]])
    weight = mass * float(vehicle.gravity)

    def passive(state: Float[Array, "13"], command: Command, t: Scalar) -> Wrench:
        return _passive(model, jnp.asarray(rigid), weight, jnp.asarray(cog), state, command, t)

    sizes = {"state": 13, "command": len(model.command_names), "t": 0}
    told = {"vehicle": vehicle.name, "joint": "hull", "command": model.command_names, "notes": list(notes)}
    with written_whole(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("vehicle.xml", _xml(vehicle, mass, cog, inertia, notes))
        archive.writestr("hull.py", Path(__file__).with_name("_hull.py").read_text(encoding="utf-8"))
        archive.writestr("passive.casadi", expressed("passive", passive, sizes, "wrench").serialize())
        archive.writestr("model.json", json.dumps(told, indent=1, ensure_ascii=False))


def _passive(
    model: Model, rigid: Matrix6, weight: float, cog: Array, state: Array, command: Command, t: Scalar
) -> Wrench:
    """What acts at `o` beside the weight [N, N m], so that the rigid body moves as the vehicle does."""
    plant = model.plant
    attitude, nu = state[3:7], state[7:13]
    memory = plant.for_each_memory(plant.relative(attitude, nu)) if plant.has_memory else jnp.zeros(0)
    now = State(state[:3], attitude, nu, memory)
    goal = model.asked(command, jnp.ones(())).goal[0]
    nu_dot = plant.acceleration(now, Input(goal, command, jnp.zeros(6), t))
    down = weight * rotation(attitude)[2]
    return apply(rigid, nu_dot) + coriolis(rigid, nu) - jnp.concatenate([down, jnp.cross(cog, down)])


def _xml(vehicle: Vehicle, mass: float, cog: np.ndarray, inertia: np.ndarray, notes: Sequence[str]) -> str:
    root = ET.Element("mujoco", model=vehicle.name)
    for note in notes:
        # Two dashes would end the comment.
        root.append(ET.Comment(f" {note.replace('--', '- -')} "))
    ET.SubElement(
        root, "option", gravity=f"0 0 {-float(vehicle.gravity)!r}", timestep=str(_TIMESTEP), integrator="RK4"
    )
    body = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=vehicle.name)
    ET.SubElement(body, "freejoint", name="hull")
    turned = _FLIP[:, None] * inertia * _FLIP
    entries = [turned[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    ET.SubElement(body, "inertial", pos=_numbers(_FLIP * cog), mass=repr(mass), fullinertia=_numbers(entries))
    actuators = ET.SubElement(root, "actuator")
    for name, limit in zip(vehicle.drive_names, vehicle.command_limits, strict=False):
        # They only hold the commands: what these do in the water is the callback's.
        ET.SubElement(
            actuators,
            "general",
            name=name,
            joint="hull",
            gear="0 0 0 0 0 0",
            ctrllimited="true",
            ctrlrange=f"{-limit} {limit}",
        )
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)
