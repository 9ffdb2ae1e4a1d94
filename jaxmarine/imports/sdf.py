"""Gazebo SDF: the link that the plug-in Hydrodynamics moves, and the thrusters that push its model."""

import itertools
import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .._errors import InputError

SUFFIXES = (".sdf", ".world")
# Forward-left-up there, forward-starboard-down here.
_FLIP = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
_FORCES, _VELOCITIES, _ADDED = "xyzkmn", "UVWPQR", "xyzpqr"
_ADDS = re.compile(rf"([{_FORCES}])Dot([{_VELOCITIES}])")
_LINEAR = re.compile(rf"([{_FORCES}])([{_VELOCITIES}])")
_QUADRATIC = re.compile(rf"([{_FORCES}])([{_VELOCITIES}])(abs)?([{_VELOCITIES}])")


def read(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The vehicle about the link's origin; `InputError` where there is none."""
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        # Entities could unfold without end, and no model has them.
        if "<!ENTITY" in text:
            raise ET.ParseError("it declares entities")
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path}: is not valid XML: {error}; correct it there.") from error
    try:
        return _vehicle(root)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def _vehicle(root: ET.Element) -> tuple[dict[str, Any], tuple[str, ...]]:
    model, water = _moved(root)
    name = (water.findtext("link_name") or "").strip()
    link = next((one for one in model.findall("link") if one.get("name") == name), None)
    if link is None or link.find("inertial") is None:
        raise ValueError(f"has no link `{name}` with an <inertial>, which its hydrodynamics move; add it.")
    notes: list[str] = []
    gravity = abs(_numbers(root, ".//gravity", (0.0, 0.0, -9.8))[2])
    density = _numbers(root, ".//uniform_fluid_density", _numbers(water, "water_density", (998.0,)))[0]
    body = _body(link.find("inertial"))
    added, linear, quadratic = _hydrodynamics(water, link, notes)
    lift, centre = _displaced(link, body, gravity, density, notes)
    thrusters = _thrusters(model, link, notes)
    known = {name, *(one["link"] for one in thrusters)}
    others = [str(one.get("name")) for one in model.findall("link") if one.get("name") not in known]
    if others:
        notes.append(f"Links beside `{name}` are left out with their masses: {', '.join(others)}.")
    if any(_numbers(water, "default_current", (0.0,))):
        notes.append("The current is left out: it is the water's, not the vehicle's.")
    return {
        "name": model.get("name") or name,
        "environment": {"density": density, "gravity": gravity},
        "body": body | {"cob": centre, "buoyancy": lift},
        "added_mass": {"matrix": added},
        "damping": {"linear": linear, "quadratic": quadratic},
        "thruster": [{key: value for key, value in one.items() if key != "link"} for one in thrusters],
    }, tuple(notes)


def _moved(root: ET.Element) -> tuple[ET.Element, ET.Element]:
    """The first model with the plug-in, and the plug-in."""
    for model in root.iter("model"):
        for plugin in model.findall("plugin"):
            if (plugin.get("name") or "").endswith("Hydrodynamics"):
                return model, plugin
    raise ValueError("has no model with a plug-in Hydrodynamics; add it, as its numbers are the vehicle's.")


def _numbers(parent: ET.Element | None, path: str, default: tuple[float, ...]) -> tuple[float, ...]:
    text = None if parent is None else parent.findtext(path)
    if text is None or not text.strip():
        return default
    try:
        values = tuple(float(one) for one in text.split())
    except ValueError:
        raise ValueError(f"has <{path.strip('./')}> {text.strip()!r:.40}, which are no numbers.") from None
    if not np.isfinite(values).all():
        raise ValueError(f"has <{path.strip('./')}> {text.strip()!r:.40}, which is not finite.")
    return values


def _pose(element: ET.Element | None) -> tuple[np.ndarray, np.ndarray]:
    """Place and turn of an element in what holds it."""
    six = np.array(_numbers(element, "pose", (0.0,) * 6))
    if six.size != 6:
        raise ValueError(f"has a <pose> of {six.size} numbers, which needs 6.")
    return six[:3], Rotation.from_euler("xyz", six[3:]).as_matrix()


def _body(inertial: ET.Element | None) -> dict[str, Any]:
    """Mass, inertia about the link's origin, and centre of gravity."""
    mass = _numbers(inertial, "mass", (1.0,))[0]
    place, turn = _pose(inertial)
    inertia = np.zeros((3, 3))
    for i, j in itertools.combinations_with_replacement(range(3), 2):
        path = f"inertia/i{'xyz'[i]}{'xyz'[j]}"
        inertia[i, j] = inertia[j, i] = _numbers(inertial, path, (float(i == j),))[0]
    arm = np.cross(np.eye(3), place)
    inertia = turn @ inertia @ turn.T - mass * arm @ arm
    inertia = _FLIP[:3, None] * inertia * _FLIP[:3]
    return {"mass": mass, "inertia": inertia.tolist(), "cog": (_FLIP[:3] * place).tolist()}


def _hydrodynamics(water: ET.Element, link: ET.Element, notes: list[str]) -> list[list[list[float]]]:
    """Added mass, linear and quadratic damping, positive signs."""
    added, linear, quadratic = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    for i, j in itertools.combinations_with_replacement(range(6), 2):
        entry = _numbers(link, f"inertial/fluid_added_mass/{_ADDED[i]}{_ADDED[j]}", (0.0,))[0]
        added[i, j] = added[j, i] = entry
    own = (water.findtext("disable_added_mass") or "").strip().lower() not in ("true", "1")
    left: list[str] = []
    for element in water:
        tag = element.tag if isinstance(element.tag, str) else ""
        if match := _ADDS.fullmatch(tag):
            if own:
                i, j = _FORCES.index(match[1]), _VELOCITIES.index(match[2])
                added[i, j] -= _numbers(water, tag, (0.0,))[0]
        elif match := _LINEAR.fullmatch(tag):
            linear[_FORCES.index(match[1]), _VELOCITIES.index(match[2])] -= _numbers(water, tag, (0.0,))[0]
        elif match := _QUADRATIC.fullmatch(tag):
            value = _numbers(water, tag, (0.0,))[0]
            if match[3] and match[2] == match[4]:
                quadratic[_FORCES.index(match[1]), _VELOCITIES.index(match[2])] -= value
            elif value != 0.0:
                left.append(tag)
    if left:
        notes.append(f"Damping by products of two velocities is left out: {', '.join(left)}.")
    if np.any(np.diag(linear) < 0.0) or np.any(np.diag(quadratic) < 0.0):
        notes.append(
            "Damping with positive numbers feeds energy in Gazebo, and does so here; check the signs."
        )
    return [(_FLIP[:, None] * one * _FLIP).tolist() for one in (added, linear, quadratic)]


def _displaced(
    link: ET.Element, body: dict[str, Any], gravity: float, density: float, notes: list[str]
) -> tuple[float, list[float]]:
    """Buoyancy [N] and its centre: of the collision shapes, or as heavy as the body."""
    volumes, moments = 0.0, np.zeros(3)
    for collision in link.findall("collision"):
        shape = collision.find("geometry")
        volume = _volume(shape) if shape is not None else None
        if volume is None:
            notes.append(f"The volume of the collision `{collision.get('name')}` is not known, and left out.")
            continue
        volumes, moments = volumes + volume, moments + volume * _pose(collision)[0]
    if volumes == 0.0:
        notes.append("No collision shape says the buoyancy: the vehicle is taken to be neutral, untrimmed.")
        return body["mass"] * gravity, body["cog"]
    return density * gravity * volumes, (_FLIP[:3] * moments / volumes).tolist()


def _volume(shape: ET.Element) -> float | None:
    """Of a simple shape [m³]; None of others."""
    if (box := shape.find("box")) is not None:
        return math.prod(_numbers(box, "size", (1.0, 1.0, 1.0)))
    if (ball := shape.find("sphere")) is not None:
        return 4 / 3 * math.pi * _numbers(ball, "radius", (1.0,))[0] ** 3
    if (rod := shape.find("cylinder")) is not None:
        return math.pi * _numbers(rod, "radius", (1.0,))[0] ** 2 * _numbers(rod, "length", (1.0,))[0]
    return None


def _thrusters(model: ET.Element, link: ET.Element, notes: list[str]) -> list[dict[str, Any]]:
    """Of each plug-in Thruster the joint's place and axis, and its limits as the thrust at command 1."""
    out: list[dict[str, Any]] = []
    plugins = [one for one in model.findall("plugin") if (one.get("name") or "").endswith("Thruster")]
    joints = {one.get("name"): one for one in model.findall("joint")}
    links = {one.get("name"): one for one in model.findall("link")}
    origin, upright = _pose(link)
    for plugin in plugins:
        name = (plugin.findtext("joint_name") or "").strip()
        joint = joints.get(name)
        rotor = None if joint is None else links.get((joint.findtext("child") or "").strip())
        if joint is None or rotor is None:
            raise ValueError(
                f"has a Thruster at the joint `{name}`, which is not there with its link; add it."
            )
        place, turn = _pose(rotor)
        shift, own = _pose(joint)
        place, turn = place + turn @ shift, turn @ own
        axis = np.array(_numbers(joint, "axis/xyz", (0.0, 0.0, 1.0)))
        most = _numbers(plugin, "max_thrust_cmd", (1000.0,))[0]
        least = -_numbers(plugin, "min_thrust_cmd", (-1000.0,))[0]
        thruster = {
            "name": re.sub(r"_?joint$", "", name) or name,
            "position": (_FLIP[:3] * (upright.T @ (place - origin))).tolist(),
            "direction": (_FLIP[:3] * (upright.T @ turn @ axis)).tolist(),
            "max_thrust": most,
            "link": rotor.get("name"),
        }
        out.append(thruster if least == most else thruster | {"max_thrust_reverse": least})
    if out:
        notes.append("A thruster's command is its thrust as a share of its largest.")
    return out
