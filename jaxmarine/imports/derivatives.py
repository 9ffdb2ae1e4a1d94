"""Scripts of PythonVehicleSimulator's and MSS' kind (Python, Matlab): derivatives by their names.

Nothing is run: lines `name = arithmetic` of numbers and earlier names are worked out, all others passed over.
Derivatives have the signs of SNAME (1950), negative where they brake: `Xudot`, `Yr`, `Nrr` or `N_r_abs_r`.
The rest of a vehicle is `m`, `Ig` (3x3 or its diagonal, about the centre of gravity) or `Ix Iy Iz`, `rg`,
`rb`, `W`, `B`, `rho`, `g`.
"""

import ast
import math
import operator
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import InputError

SUFFIXES = (".py", ".m")
_FORCES, _VELOCITIES = "XYZKMN", "uvwpqr"
_DERIVATIVE = re.compile(rf"([{_FORCES}])_?([{_VELOCITIES}])(?:_?(dot|d)|_?(?:abs)?_?(\2))?")
_LINE = re.compile(r"^\s*(?:\w+\.)?([A-Za-z]\w*)\s*=(?!=)\s*([^#%;]+)")
_DO: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
# What is asked for under one of several names.
_NAMES = {"m": ("m", "mass"), "rg": ("rg", "r_g", "r_bg"), "rb": ("rb", "r_b", "r_bb")}
_OF_BODY = ("m", "Ig", "Ix", "Iy", "Iz", "rg", "rb", "W", "B", "rho", "g")
# So that a power cannot take forever or all memory.
_LARGEST_POWER = 20.0


def read(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The vehicle about the point to which the derivatives refer; `InputError` where it lacks a mass."""
    known, failed = _worked_out(path.read_text(encoding="utf-8", errors="replace"))
    notes: list[str] = []
    failed = [name for name in failed if _DERIVATIVE.fullmatch(name) or name in _OF_BODY]
    if failed:
        notes.append(
            f"These lines are no arithmetic of known numbers and are passed over: {', '.join(failed)}."
        )

    def given(name: str, default: Any, said: str) -> np.ndarray:
        for one in _NAMES.get(name, (name,)):
            # `B` is also what many call their matrix of inputs.
            if one in known and (np.size(known[one]) == 1) == (np.size(default) == 1):
                return np.asarray(known[one], float)
        if said:
            notes.append(f"`{name}` is not given: {said}.")
        return np.asarray(default, float)

    mass = float(given("m", math.nan, "").reshape(-1)[0])
    matrices, braking = _matrices(known)
    if math.isnan(mass) or not np.any(matrices):
        raise InputError(
            f"{path}: has no lines such as `m = 11.5` and `Xudot = -5.5`, which say a vehicle; write them."
        )
    if braking:
        notes.append(f"Derivatives that feed energy are taken as they stand: {', '.join(braking)}.")
    gravity = float(given("g", 9.81, "9.81 m/s² is taken"))
    cog = given("rg", np.zeros(3), "the centre of gravity is taken to be the origin")
    cob = given("rb", np.zeros(3), "the centre of buoyancy is taken to be the origin")
    moments = [known.get(f"I{a}", known.get(f"I{a}{a}", 0.0)) for a in "xyz"]
    inertia = given("Ig", moments, "")
    if not np.any(inertia):
        raise InputError(f"{path}: has no inertia that can be worked out; write `Ig` as numbers about `rg`.")
    inertia = np.diag(inertia.ravel()) if inertia.size == 3 else inertia
    if inertia.shape != (3, 3) or cog.shape != (3,) or cob.shape != (3,):
        raise InputError(f"{path}: `Ig` must be 3x3 or 3 numbers, `rg` and `rb` 3 numbers; correct them.")
    arm = np.cross(np.eye(3), cog)
    notes.append("Thrusters are not among derivatives; add tables [[thruster]] or [[propeller]].")
    weight = float(given("W", mass * gravity, ""))
    added, linear, quadratic = matrices
    return {
        "name": re.sub(r"\W", "_", path.stem),
        "environment": {"density": float(given("rho", 1025.0, "1025 kg/m³ is taken")), "gravity": gravity},
        "body": {
            "mass": mass,
            "inertia": (inertia - mass * arm @ arm).tolist(),
            "cog": cog.tolist(),
            "cob": cob.tolist(),
            "weight": weight,
            "buoyancy": float(given("B", weight, "the vehicle is taken to be neutral")),
        },
        "added_mass": {"matrix": added.tolist()},
        "damping": {"linear": linear.tolist(), "quadratic": quadratic.tolist()},
    }, tuple(notes)


def _matrices(known: dict[str, Any]) -> tuple[np.ndarray, list[str]]:
    """Added mass, linear and quadratic damping with positive signs, and the derivatives that do not brake."""
    out, feeding = np.zeros((3, 6, 6)), []
    for name, value in known.items():
        match = _DERIVATIVE.fullmatch(name)
        if match is None or np.size(value) != 1:
            continue
        i, j = _FORCES.index(match[1]), _VELOCITIES.index(match[2])
        kind = 0 if match[3] else 2 if match[4] else 1
        out[kind, i, j] = -float(np.reshape(value, ()))
        if i == j and out[kind, i, j] < 0.0:
            feeding.append(name)
    # Added mass is symmetric, and scripts state one of two that are equal.
    out[0] = np.where(out[0] == 0.0, out[0].T, out[0])
    return out, feeding


def _worked_out(text: str) -> tuple[dict[str, Any], list[str]]:
    """Names and their last numbers, and names of lines that could not be worked out."""
    known: dict[str, Any] = {"pi": math.pi}
    failed: list[str] = []
    for line in text.splitlines():
        match = _LINE.match(line)
        if match is None:
            continue
        try:
            value = _value(ast.parse(_pythonic(match[2]), mode="eval").body, known)
            if np.isfinite(value).all():
                known[match[1]] = value
        except (SyntaxError, ValueError, TypeError, KeyError, ArithmeticError, RecursionError, MemoryError):
            # Some other line of a program, often within a function, whose names are its own.
            failed.append(match[1])
    return known, list(dict.fromkeys(failed))


def _pythonic(text: str) -> str:
    """Matlab's powers and rows as Python's."""
    text = text.strip().rstrip("'").replace("^", "**").replace(".*", "*")
    return re.sub(r"\[([^\[\],]*)\]", lambda row: f"[{','.join(row[1].split())}]", text)


def _value(node: ast.expr, known: dict[str, Any]) -> Any:
    """Arithmetic; KeyError or ValueError for everything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        return known[node.id]
    if isinstance(node, ast.Attribute):  # self.mass, np.pi
        return known[node.attr]
    if isinstance(node, ast.List | ast.Tuple):
        return np.array([_value(one, known) for one in node.elts], float)
    if isinstance(node, ast.UnaryOp):
        return _DO[type(node.op)](_value(node.operand, known))
    if isinstance(node, ast.BinOp):
        left, right = _value(node.left, known), _value(node.right, known)
        if isinstance(node.op, ast.Pow):
            if np.size(right) != 1 or abs(right) > _LARGEST_POWER:
                raise ValueError
            return left**right
        return _DO[type(node.op)](left, right)
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant | ast.Tuple):
        where = _value(node.slice, known)
        return np.asarray(_value(node.value, known))[tuple(np.atleast_1d(where).astype(int))]
    if isinstance(node, ast.Call) and node.args:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in ("array", "diag", "sqrt"):
            value = _value(node.args[0], known)
            return np.diag(value) if name == "diag" else np.sqrt(value) if name == "sqrt" else value
    raise ValueError
