"""Resistance ahead, as a force per speed squared at a given speed."""

import math

from ._hull import Hull

# The correlation line means nothing for slower flows, and rises without bound.
_LEAST_REYNOLDS = 1e5


def friction(reynolds: float) -> float:
    r"""Friction coefficient $C_F = 0.075 / (\log_{10} Re - 2)^2$: the line of ITTC (1957)."""
    return 0.075 / (math.log10(max(reynolds, _LEAST_REYNOLDS)) - 2.0) ** 2


def wetted(hull: Hull) -> float:
    """Wetted surface of a hull that floats, 1.7 L T + volume / T [m²]: Mumford's formula."""
    return 1.7 * hull.length * hull.draft + hull.volume / hull.draft


def ship_drag(hull: Hull, residuary: float) -> float:
    r"""$\frac12 \rho S ((1 + k) C_F + C_R)$ [N s²/m²].

    The form factor is $k = -0.095 + 25.6 C_B / ((L/B)^2 \sqrt{B/T})$, between 0.1 and 0.4.

    - `residuary`: C_R, for waves and appendages.

    Source: ITTC-1957 and Mumford as cybergalactic/MSS, XuuITTC.m, has them; k after Watanabe.
    """
    full = hull.fullness / ((hull.length / hull.beam) ** 2 * math.sqrt(hull.beam / hull.draft))
    form = min(max(25.6 * full - 0.095, 0.1), 0.4)
    return 0.5 * hull.density * wetted(hull) * ((1.0 + form) * friction(hull.reynolds) + residuary)


def torpedo_drag(hull: Hull, diameter: float) -> float:
    r"""$\frac12 \rho S C_F (1 + 1.5 (d/l)^{3/2} + 7 (d/l)^3)$ [N s²/m²] of a bare body of revolution.

    Its surface is taken to be 0.85 of that of a cylinder.

    Source: after Hoerner (1965), Fluid-Dynamic Drag; friction by ITTC (1957).
    """
    thickness = diameter / hull.length
    form = 1.0 + 1.5 * thickness**1.5 + 7.0 * thickness**3
    surface = 0.85 * math.pi * diameter * hull.length
    return 0.5 * hull.density * surface * form * friction(hull.reynolds)
