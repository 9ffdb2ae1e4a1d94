"""PythonVehicleSimulator: a module with a vehicle class in its style, which needs numpy alone."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._files import written_whole
from ..vehicle import Vehicle
from . import _plain

NEEDS = ()
_FOREIGN = re.compile(r"\W|^(?=\d)", re.ASCII)


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    return (
        *_plain.lost(vehicle),
        "Its integration is Euler's; take steps of a hundredth of a second or shorter.",
    )


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes the module; its class has the vehicle's name."""
    numbers = {
        key: np.asarray(value).tolist() for key, value in dataclasses.asdict(_plain.Plain.of(vehicle)).items()
    }
    rows = "".join(f"        {key!r}: {_rows(value)},\n" for key, value in numbers.items())
    parameters = (
        "# SI units, body axes at the origin: x forward, y starboard, z down. Matrices stand on the left:\n"
        "# MRB nu_dot + MA nu_r_dot + C nu + D nu_r + Dn |nu_r| nu_r + g = tau.\n"
        f"PARAMETERS = {{\n    'name': {vehicle.name!r},\n    'thrusters': {vehicle.thruster_names!r},\n"
        f"    'numbers': {{\n{rows}    }},\n}}"
    )
    text = Path(__file__).with_name("_pvs_vehicle.py").read_text(encoding="utf-8")
    text = text.replace("PARAMETERS = {}", parameters)
    text = re.sub(r"\bvehicle\(", f"{_FOREIGN.sub('_', vehicle.name)}(", text)
    text = text.replace("class vehicle:", f"class {_FOREIGN.sub('_', vehicle.name)}:")
    head = "".join(f"# {note}\n" for note in notes)
    with written_whole(path) as beside:
        beside.write_text(head + text, encoding="utf-8")


def _rows(value: float | list) -> str:
    """A matrix in rows, as people read it."""
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n" + "".join(f"            {row!r},\n" for row in value) + "        ]"
    return repr(value)
