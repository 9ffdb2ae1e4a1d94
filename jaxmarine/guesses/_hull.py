"""What is known of a craft before anything was measured: its kind's main dimensions."""

import dataclasses
import math

from .._errors import InputError

# More of the box around it than this no body fills.
_FULL = 1.0
# Less of it would be a mistake of units.
_EMPTY = 1e-3
KINEMATIC_VISCOSITY = 1.19e-6  # m²/s, sea water of 15 degrees, after ITTC


@dataclasses.dataclass(frozen=True)
class Hull:
    """Main dimensions [kg, m], a plausible top speed [m/s], and the water [kg/m³, m/s²].

    - `draft`: how deep the hull lies in the water; of a craft under water its height.
    """

    mass: float
    length: float
    beam: float
    draft: float
    speed: float
    density: float = 1025.0
    gravity: float = 9.81

    @property
    def volume(self) -> float:
        """What it displaces where its buoyancy is its weight [m³]."""
        return self.mass / self.density

    @property
    def fullness(self) -> float:
        """Share of the box around it that it displaces; of a ship its block coefficient."""
        return self.volume / (self.length * self.beam * self.draft)

    @property
    def reynolds(self) -> float:
        """Reynolds number of its length at its speed."""
        return self.speed * self.length / KINEMATIC_VISCOSITY


def check(hull: Hull) -> None:
    """Raises `InputError` where the dimensions are those of no floating body."""
    for name in ("mass", "length", "beam", "draft", "speed"):
        value = getattr(hull, name)
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"--{name} {value:g}: is no size; give a positive number in SI units.")
    box = hull.density * hull.length * hull.beam * hull.draft
    if not _EMPTY < hull.fullness <= _FULL:
        much = "more than" if hull.fullness > _FULL else "next to nothing of"
        raise InputError(
            f"--mass {hull.mass:g}: a craft that floats with {hull.mass:g} kg displaces {much} the box of "
            f"its length, beam and draft holds, {box:.4g} kg of water; check the units (kg, m)."
        )
