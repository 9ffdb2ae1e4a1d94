"""StableHLO, by `jax.export`: a zip archive of functions that `jax` alone loads, differentiates and runs."""

import json
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp

from .._files import written_whole
from ..vehicle import Vehicle
from . import _lost
from ._model import SHOWN, Model

NEEDS = ("flatbuffers",)
# Programs of one description run on either.
_PLATFORMS = ("cpu", "cuda")


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    """All is held but what is the log's."""
    return _lost.always(vehicle)


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes `start`, `step`, `rates` and `shown` (see `_model.Model`) in double precision.

    Read by `jax.export.deserialize(archive.read("step.stablehlo")).call`, with `jax_enable_x64`; `model.json`
    names states and commands. Derivatives of first order come along.
    """
    model = Model.of(vehicle)

    def shaped(*shape: int):
        return jax.ShapeDtypeStruct(shape, jnp.float64)

    state, command, wrench, t = (
        shaped(len(model.state_names)),
        shaped(len(model.command_names)),
        shaped(6),
        shaped(),
    )
    functions: dict[str, tuple[Callable[..., Any], tuple]] = {
        "start": (model.start, (shaped(3), shaped(3), wrench, command)),
        "step": (model.step, (state, command, wrench, t, t)),
        "rates": (model.rates, (state, command, wrench, t)),
        "shown": (model.shown, (state,)),
    }
    told = {
        "vehicle": vehicle.name,
        "functions": {
            "start": "position, attitude, velocity, command -> state",
            "step": "state, command, wrench, t, dt -> state",
            "rates": "state, command, wrench, t -> its time derivative",
            "shown": "state -> " + " ".join(SHOWN),
        },
        "state": model.state_names,
        "command": model.command_names,
        "longest_step": model.longest_step,
        "notes": list(notes),
    }
    with written_whole(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model.json", json.dumps(told, indent=1, ensure_ascii=False))
        for name, (function, arguments) in functions.items():
            # A method of a module is not hashable, which `jit` asks for.
            traced = jax.jit(lambda *given, function=function: function(*given))
            exported = jax.export.export(traced, platforms=_PLATFORMS)(*arguments)
            archive.writestr(f"{name}.stablehlo", bytes(exported.serialize(vjp_order=1)))
