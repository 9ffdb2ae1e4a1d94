"""MSS (Matlab, Octave): a function in the style of its vehicle models, which needs no other function."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._errors import InputError
from .._files import written_whole
from ..vehicle import Vehicle
from . import _plain

NEEDS = ()
_FUNCTION = re.compile(r"[A-Za-z]\w*", re.ASCII)


def lost(vehicle: Vehicle) -> tuple[str, ...]:
    return _plain.lost(vehicle)


def write(vehicle: Vehicle, path: Path, notes: Sequence[str]) -> None:
    """Writes the file; its function has the file's name, as Matlab wants."""
    if path.suffix != ".m" or not _FUNCTION.fullmatch(path.stem):
        raise InputError(f"{path}: Matlab calls a function by its file; name it such as `{vehicle.name}.m`.")
    plain = _plain.Plain.of(vehicle)
    rows = "".join(f"p.{name} = {_matrix(value)};\n" for name, value in dataclasses.asdict(plain).items())
    parameters = (
        "% SI units, body axes at the origin: x forward, y starboard, z down. Matrices stand on the left:\n"
        f"% MRB nu_dot + MA nu_r_dot + C nu + D nu_r + Dn |nu_r| nu_r + g = tau.\n{rows}"
    )
    slow = [name for name, lag in zip(vehicle.thruster_names, plain.lag, strict=True) if lag > 0.0]
    text = Path(__file__).with_name("_mss_vehicle.m").read_text(encoding="utf-8")
    for mark, words in (
        ("VEHICLE", path.stem),
        ("COMMANDS", " ".join(vehicle.thruster_names)),
        (" THRUSTS ]", "".join(f" T_{name}" for name in slow) + " ]"),
        ("THRUSTS", "states T_..."),
        ("PARAMETERS\n", parameters),
    ):
        text = text.replace(mark, words)
    head = "".join(f"% {note}\n" for note in notes)
    with written_whole(path) as beside:
        beside.write_text(head + text, encoding="utf-8")


def _matrix(value: float | np.ndarray) -> str:
    """A number, a column, or a matrix in rows."""
    rows = np.asarray(value).tolist()
    if not isinstance(rows, list):
        return repr(rows)
    between = " ...\n    " if isinstance(rows[0], list) else ""
    lines = [" ".join(map(repr, row)) if isinstance(row, list) else repr(row) for row in rows]
    return f"[{between}{f'; {between}'.join(lines)}]"
