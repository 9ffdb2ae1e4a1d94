"""The coefficients of the vehicle file that a diagnosis may refit, by the effects that change them."""

import dataclasses
from collections.abc import Sequence
from operator import attrgetter

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._types import DOFS
from ..effects import CATALOGUE, AbstractEffect, Suspect
from ..fitting import PRIOR_KEYS
from ..vehicle import Vehicle
from ._criteria import DEFAULT
from ._saturated import Layout

# Those that change an entry of a matrix that the file has.
FILED: tuple[type[AbstractEffect], ...] = tuple(effect for effect in CATALOGUE if effect.filed)


@dataclasses.dataclass(frozen=True)
class Coefficient:
    """A coefficient that the file has: where it lies, its value there, and the width of its prior.

    - `suspect`: the one that alters it; `kind`: the matrix that it is an entry of, such as `damping.linear`.
    - `place`: row and column of its matrix; `index`: its place among the saturated model's parameters.
    """

    suspect: int
    kind: str
    label: str
    place: tuple[int, int]
    index: int
    value: float
    prior: float
    unit: str

    @property
    def diagonal(self) -> bool:
        return self.place[0] == self.place[1]


def base_coefficients(
    vehicle: Vehicle, layout: Layout, file_error: float = DEFAULT.file_error
) -> tuple[Coefficient, ...]:
    """Added mass and damping of each free axis, with priors of a share of their value, `file_error`; then
    added mass and linear damping between axes, where the file has some.

    Of the total mass for added mass. Where the file's table `[prior]` says by how much of their value they
    may be off, it is that. Where the file says zero on an axis, the prior is what brakes it by 2 % a second
    (linear), or at 1 m/s or rad/s (quadratic).
    """
    mass, spreads = np.asarray(vehicle.mass_matrix), dict(vehicle.prior)
    out = []
    for i, suspect in enumerate(layout.suspects):
        kind = suspect.effect.filed
        if not kind:
            continue
        row, column = matrix_place(suspect)
        value = np.asarray(attrgetter(kind)(vehicle))[row, column]
        if row != column and not value:
            continue
        scale = mass[row, column] if row == column and kind == "added_mass" else value
        share = spreads.get(PRIOR_KEYS[kind], 0.0)
        out.append(
            Coefficient(
                i,
                kind,
                suspect.label,
                (row, column),
                int(np.flatnonzero(layout.columns[i][:, 0])[0]),
                float(value),
                share * abs(value) or file_error * abs(scale) or 0.02 * mass[row, row],
                suspect.effect.units["value"],
            )
        )
    return tuple(sorted(out, key=lambda c: not c.diagonal))


def matrix_place(suspect: Suspect) -> tuple[int, int]:
    """Row and column of the coefficient that a suspect accuses; target `row`, `row<-column`, `row+column`."""
    row, _, column = str(suspect.target).replace("<-", "+").partition("+")
    return DOFS.index(row), DOFS.index(column or row)


def refiled(vehicle: Vehicle, base: Sequence[Coefficient], changes: Float[np.ndarray, " base"]) -> Vehicle:
    """The vehicle with its coefficients changed by so much each."""
    for kind in dict.fromkeys(c.kind for c in base):
        matrix = np.zeros((6, 6))
        for c, change in zip(base, changes, strict=True):
            if c.kind == kind:
                matrix[c.place] = change
                if kind == "added_mass":
                    matrix[c.place[::-1]] = change
        vehicle = eqx.tree_at(attrgetter(kind), vehicle, attrgetter(kind)(vehicle) + matrix)
    return vehicle
