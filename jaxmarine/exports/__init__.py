"""Vehicles for other programs: one module per format, named as it, with three names.

- `NEEDS`: the packages that must be installed for it (extra `exports`).
- `lost(vehicle)`: what the format cannot hold, a sentence each; `InputError` where it cannot hold the
  vehicle.
- `write(vehicle, path, notes)`: writes it, those sentences included.

A further format is one more such module in this folder.
"""

import os
import pkgutil
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from .._errors import InputError
from .._extras import need
from .._files import did_you_mean
from .._precision import need_double
from ..vehicle import Vehicle

FORMATS: tuple[str, ...] = tuple(
    sorted(one.name for one in pkgutil.iter_modules(__path__) if not one.name.startswith("_"))
)


class Format(Protocol):
    """What each of the modules has."""

    NEEDS: tuple[str, ...]

    def lost(self, vehicle: Vehicle) -> tuple[str, ...]: ...
    def write(self, vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None: ...


def export(vehicle: Vehicle, path: str | os.PathLike[str], to: str) -> tuple[str, ...]:
    """Writes the vehicle with its effects for another program; raises `InputError` with one sentence.

    - `to`: one of `FORMATS`.

    Gives what the format leaves behind, one sentence each, which stands in the written file too.
    """
    need_double("An export")
    if to not in FORMATS:
        raise InputError(f"Format `{to}` is not known; {did_you_mean(to, FORMATS)}")
    form = cast(Format, import_module(f".{to}", __name__))
    need(form.NEEDS, "exports", f"Format `{to}`")
    notes = form.lost(vehicle)
    form.write(vehicle, Path(path), notes)
    return notes
