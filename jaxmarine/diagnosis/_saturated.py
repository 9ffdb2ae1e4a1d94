"""The saturated model: the vehicle with every effect of the catalogue in it, at its neutral value."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.flatten_util
import numpy as np
from jaxtyping import Array, Float

from .._errors import InputError
from ..effects import CATALOGUE, AbstractEffect, Suspect
from ..vehicle import Placed, Plant, Vehicle


class SaturatedPlant(eqx.Module):
    """`plant_of` for `fitting.Problem`: parameters of the whole catalogue to a plant.

    - `gates` [segments, placed]: which effects of the vehicle itself act in a segment.
    """

    vehicle: Vehicle
    families: tuple[AbstractEffect, ...]
    gates: Float[Array, "segments placed"]

    def __call__(self, theta: Float[Array, " parameters"], segment) -> Plant:
        _, unravel = jax.flatten_util.ravel_pytree(self.families)
        return self.vehicle.plant(self.gates[segment], extra=unravel(theta))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where each suspect's parameters lie in the flat vector of the saturated model."""

    neutral: Float[np.ndarray, " parameters"]
    suspects: tuple[Suspect, ...]
    columns: tuple[Float[np.ndarray, "parameters _"], ...]  # one per suspect: parameters per z

    @property
    def size(self) -> int:
        return len(self.neutral)

    def place_of(self, cause: Placed) -> int:
        """Which suspect a cause is; raises `InputError` where it is none."""
        for i, suspect in enumerate(self.suspects):
            if suspect.effect is type(cause.effect) and suspect.target == cause.target:
                return i
        known = ", ".join(suspect.label for suspect in self.suspects)
        target = "" if cause.target is None else f":{cause.target}"
        raise InputError(
            f"Cause `{cause.effect.name}{target}` is none that this vehicle can have; take one of {known}."
        )

    def neutral_of(self, i: int) -> np.ndarray:
        """Neutral values of a suspect's parameters, in the order of its slots."""
        return np.array([self.neutral[np.flatnonzero(column)[0]] for column in self.columns[i].T])

    def values(self, i: int, z: np.ndarray) -> dict[str, float]:
        """A suspect's parameters by name, `z` away from neutral."""
        return dict(zip(self.suspects[i].slots, (self.neutral_of(i) + z).tolist(), strict=True))

    def plausible(self, i: int, z: np.ndarray) -> bool:
        """Whether a suspect's parameters, `z` away from neutral, are in its effect's ranges."""
        values, ranges = self.values(i, z), self.suspects[i].effect.plausible
        return all(low <= values[name] <= high for name, (low, high) in ranges.items() if name in values)


def saturate(
    vehicle: Vehicle, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE
) -> tuple[tuple[AbstractEffect, ...], Layout]:
    """The catalogue's families at their neutral value, and the layout of their parameters.

    A suspect without a number to fit is none of a search, and a family without suspects is left out. Raises
    `InputError` where no suspect is left.
    """
    # What accuses nothing here would only be computed along.
    catalogue = [cls for cls in catalogue if cls.suspects(vehicle)]
    if not any(suspect.slots for cls in catalogue for suspect in cls.suspects(vehicle)):
        raise InputError(
            f"{vehicle.name}: can have none of the suspected effects; give a catalogue with one that it may "
            "have."
        )
    families = tuple(cls.neutral(vehicle) for cls in catalogue)
    parts = [np.concatenate([np.zeros(0), *map(np.ravel, jax.tree.leaves(one))]) for one in families]
    flat, offsets = np.concatenate(parts), np.cumsum([0, *map(len, parts)])[:-1]
    suspects, columns = [], []
    for cls, offset in zip(catalogue, offsets, strict=True):
        for suspect in (one for one in cls.suspects(vehicle) if one.slots):
            column = np.zeros((len(flat), len(suspect.slots)))
            for j, slots in enumerate(suspect.slots.values()):
                column[int(offset) + np.array(slots), j] = 1.0
            suspects.append(suspect)
            columns.append(column)
    return families, Layout(flat, tuple(suspects), tuple(columns))
