"""Sway and yaw derivatives of ships, by regression over model tests."""

import dataclasses
import math

from .._errors import InputError
from ._hull import Hull

# Beyond these ratios of ships the regression was not fitted, and its masses become negative.
_WIDEST, _FLATTEST = 0.25, 6.0


@dataclasses.dataclass(frozen=True)
class Derivatives:
    """About midship, in SI units: added masses, and forces per product of velocities.

    - `sway` [kg], `yaw` [kg m²]: added mass, positive.
    - `Yv`, `Nv` per abs(u) v and u v; `Yr`, `Nr` per u r and abs(u) r: the whole force of the water in the
      signs of SNAME, what the added mass brings (the Munk moment) included.
    """

    sway: float
    yaw: float
    Yv: float
    Nv: float
    Yr: float
    Nr: float


def clarke(hull: Hull) -> Derivatives:
    r"""The regression, with $S = \pi (T/L)^2$, scaled by $\frac12 \rho L^2$ (and L for each moment or turn):

    $-Y_{\dot v}' = S (1 + 0.16 C_B B/T - 5.1 (B/L)^2)$, $-N_{\dot r}' = S (1/12 + 0.017 C_B B/T - 0.33 B/L)$,
    $-Y_v' = S (1 + 0.4 C_B B/T)$, $-Y_r' = S (-1/2 + 2.2 B/L - 0.08 B/T)$,
    $-N_v' = S (1/2 + 2.4 T/L)$, $-N_r' = S (1/4 + 0.039 B/T - 0.56 B/L)$.

    The added mass between sway and yaw, under a tenth of L times that of sway, is left out.

    Source: Clarke, Gedling and Hine (1983), "The application of manoeuvring criteria in hull design using
    linear theory", Trans. RINA 125, 45-68, as `clarke83` of cybergalactic/PythonVehicleSimulator has it.
    """
    length, beam, draft, block = hull.length, hull.beam, hull.draft, hull.fullness
    wide, flat = beam / length, beam / draft
    if wide > _WIDEST or flat > _FLATTEST:
        raise InputError(
            f"--like ship: a beam of {wide:.2g} lengths and {flat:.2g} drafts is none of a ship (at most "
            f"{_WIDEST:g} and {_FLATTEST:g}); take --like boat."
        )
    size = math.pi * (draft / length) ** 2
    half = 0.5 * hull.density * length**2
    return Derivatives(
        sway=half * length * size * (1.0 + 0.16 * block * flat - 5.1 * wide**2),
        yaw=half * length**3 * size * (1.0 / 12.0 + 0.017 * block * flat - 0.33 * wide),
        Yv=-half * size * (1.0 + 0.4 * block * flat),
        Nv=-half * length * size * (0.5 + 2.4 * draft / length),
        Yr=-half * length * size * (-0.5 + 2.2 * wide - 0.08 * flat),
        Nr=-half * length**2 * size * (0.25 + 0.039 * flat - 0.56 * wide),
    )


def slender_wing(hull: Hull) -> Derivatives:
    r"""The same of a boat of any beam: the hull as a wing of low aspect ratio, the regression without beam.

    Added masses are left at zero: strips over the hull give them.

    Source: the terms of Clarke et al. (1983) that are left for B = 0, after Jones (1946).
    """
    half = 0.5 * hull.density * hull.length**2
    size = math.pi * (hull.draft / hull.length) ** 2
    force = half * size
    return Derivatives(
        0.0,
        0.0,
        Yv=-force,
        Nv=-0.5 * force * hull.length,
        Yr=0.5 * force * hull.length,
        Nr=-0.25 * force * hull.length**2,
    )
