"""CasADi functions: the ground for optimal control (acados, IPOPT) and for C code."""

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .._files import written_whole
from .._types import CHANNEL_UNITS
from ..vehicle import Vehicle
from . import _lost
from ._model import SHOWN, Model

NEEDS = ("casadi",)


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    """All is held, memory and learned terms too, but the sliding mass and what is the log's."""
    return *_lost.always(vehicle), *_lost.masses(vehicle)


def functions(vehicle: Vehicle) -> tuple[Model, dict[str, Any]]:
    """`start`, `step`, `rates` and `shown` of the vehicle's `Model` as functions of CasADi."""
    # Loads CasADi, which only those who ask for this format have.
    from ._symbols import expressed

    model = Model.of(vehicle, moves=False)
    state, command = len(model.state_names), len(model.command_names)
    signatures = {
        "start": (model.start, {"position": 3, "attitude": 3, "velocity": 6, "command": command}, "state"),
        "step": (model.step, {"state": state, "command": command, "wrench": 6, "t": 0, "dt": 0}, "next"),
        "rates": (model.rates, {"state": state, "command": command, "wrench": 6, "t": 0}, "derivative"),
        "shown": (model.shown, {"state": state}, "shown"),
    }
    return model, {name: expressed(name, *one) for name, one in signatures.items()}


def described(vehicle: Vehicle, model: Model, notes: Sequence[str]) -> dict[str, Any]:
    """What a reader of the functions must know."""
    units = dict(zip(vehicle.command_names, vehicle.command_units, strict=True)) | CHANNEL_UNITS
    return {
        "vehicle": vehicle.name,
        "state": model.state_names,
        "command": model.command_names,
        "shown": SHOWN,
        "units": {name: units[name] for name in (*model.command_names, *SHOWN)},
        "longest_step": model.longest_step,
        "notes": list(notes),
    }


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes a zip archive of `start.casadi`, `step.casadi`, `rates.casadi`, `shown.casadi` and `model.json`.

    Each is read by `casadi.Function.deserialize(archive.read("rates.casadi").decode())`.
    """
    model, made = functions(vehicle)
    with written_whole(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "model.json", json.dumps(described(vehicle, model, notes), indent=1, ensure_ascii=False)
        )
        for name, function in made.items():
            archive.writestr(f"{name}.casadi", function.serialize())
