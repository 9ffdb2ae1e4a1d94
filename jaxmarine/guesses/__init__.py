"""Vehicle files from nothing but main dimensions: strip theory, potential flow and regressions.

Each kind of craft is one module with its `guess`; what they are made of stands in modules by their ideas. The
numbers are prior knowledge, and say how far they may be off in the file's table `[prior]`.
"""

import dataclasses
import os
from collections.abc import Callable
from typing import NamedTuple

from .._errors import InputError
from .._files import did_you_mean, validated
from ..vehicle_file import VehicleFile, write_vehicle_file
from . import _auv, _boat, _rov, _ship
from ._hull import Hull, check
from ._parts import Guess


class Kind(NamedTuple):
    """How a craft of a kind is guessed: its usual top speed, and with that all the rest."""

    speed: Callable[[Hull], float]
    guess: Callable[[Hull], Guess]


KINDS = {
    "rov": Kind(lambda _: _rov.SPEED, _rov.guess),
    "auv": Kind(lambda _: _auv.SPEED, _auv.guess),
    "ship": Kind(_ship.speed, _ship.guess),
    "boat": Kind(_boat.speed, _boat.guess),
}


def guess_vehicle(
    out: str | os.PathLike[str],
    like: str,
    *,
    mass: float,
    length: float,
    beam: float,
    draft: float,
    speed: float | None = None,
    name: str | None = None,
) -> None:
    """Writes a vehicle file, with comments, from main dimensions; raises `InputError` with one sentence.

    - `like`: "rov", "auv", "ship" or "boat" (with two thrusters).
    - `mass` [kg]; `length`, `beam` [m]; `draft` [m]: of an rov or auv its height.
    - `speed` [m/s]: the most it makes, by which thrust is sized; default: what is usual.
    - `name`: default `like`.

    Added mass, damping and lift are regressions and theory, each with its source above it in the file; weight
    is buoyancy, and thrusters, propellers and fins are placeholders. How far numbers may be off stands in the
    table `[prior]`, by which fits and diagnoses hold them.
    """
    if like not in KINDS:
        raise InputError(f"--like {like}: is no kind of craft; {did_you_mean(like, KINDS)}")
    kind = KINDS[like]
    hull = Hull(mass, length, beam, draft, 1.0 if speed is None else speed)
    check(hull)
    if speed is None:
        hull = dataclasses.replace(hull, speed=kind.speed(hull))
    told = kind.guess(hull)
    data = {"schema": 1, "name": like if name is None else name} | told.tables
    head = (
        f"Guessed by `jaxmarine init --like {like} --mass {mass:g} --length {length:g} --beam {beam:g} "
        f"--draft {draft:g} --speed {hull.speed:.4g}`; nothing of it was measured.",
        "Measure what is easy (centres, places, thrust at the bollard), fit the rest, and correct what "
        "stands here.",
    )
    write_vehicle_file(validated(VehicleFile, data, str(out)), out, head, told.notes | {"prior": _PRIOR_NOTE})


_PRIOR_NOTE = (
    "How far the numbers above and below may be off: one standard deviation, as a share of each value (0.4 "
    "is a factor of 1.5, 0.7 one of 2).",
    "`fit` and `diagnose` hold them so; take the table away once they are known.",
)
