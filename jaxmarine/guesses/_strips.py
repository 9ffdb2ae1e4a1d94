"""Strip theory: sections across the hull, added up over its length."""

import math


def swaying_section(draft: float, density: float) -> float:
    r"""Added mass per length [kg/m] of the lower half of an ellipse that moves sideways, $\pi \rho T^2 / 2$.

    It does not depend on the beam; the water's surface is taken to be a wall, as for slow motions.

    Source: after Newman (1977), Marine Hydrodynamics, on added mass of sections.
    """
    return 0.5 * math.pi * density * draft**2


def cross_flow(coefficient: float, width: float, length: float, density: float) -> tuple[float, float]:
    r"""Quadratic damping of a hull that is driven sideways [N s²/m²], and turned [N m s²].

    $\frac12 \rho C_D d \int dx$ and $\frac12 \rho C_D d \int |x|^3 dx = \frac12 \rho C_D d L^4 / 32$ over the
    length L, with `width` d across the flow and across the length.

    Source: strip theory, after Faltinsen (1990) and Fossen (2021), on cross-flow drag.
    """
    half = 0.5 * density * coefficient * width
    return half * length, half * length**4 / 32.0


def hull_drag(beam: float, draft: float) -> float:
    r"""Drag coefficient of a ship's section across the flow, $0.83 (B / 2T)^{-0.35}$, at most 1.2.

    A power through Hoerner's curve, from which it is off by at most 0.06 for B / 2T of 0.6 to 4.

    Source: Hoerner's curve as cybergalactic/MSS, HYDRO/Hoerner.m, has it after Leite et al. (1998).
    """
    return min(1.2, 0.83 * (beam / (2.0 * draft)) ** -0.35)
