"""A small boat that is steered by two thrusters aft."""

import math

from ._clarke import slender_wing
from ._floating import ABOUT_MIDSHIP, DOF, added_ahead, floating_body, lifts, matrix
from ._hull import Hull
from ._parts import Guess, damping, resistance, rounded, triple
from ._resistance import ship_drag
from ._spheroid import lamb
from ._strips import cross_flow, swaying_section

# A Froude number where waves begin to cost much, and what they cost there.
_FROUDE, _RESIDUARY = 0.4, 0.01
_DRAG = 1.0
# Astern as a share of ahead.
_ASTERN = 0.7
_PRIOR = {"added_mass": 0.5, "linear": 1.0, "quadratic": 0.8, "thrust": 0.4, "lift": 0.7}


def speed(hull: Hull) -> float:
    """Top speed [m/s] of a boat that does not plane."""
    return _FROUDE * math.sqrt(hull.gravity * hull.length)


def guess(hull: Hull) -> Guess:
    """Three degrees of freedom about midship."""
    length, draft = hull.length, hull.draft
    section = swaying_section(draft, hull.density)
    # What flows round the ends: of a spheroid as deep as the hull.
    _, across, turning = lamb(length / (2.0 * draft))
    ahead, aside, yaw = added_ahead(hull), across * section * length, turning * section * length**3 / 12.0
    sway, turned = cross_flow(_DRAG, draft, length, hull.density)
    quadratic = [ship_drag(hull, _RESIDUARY), sway, 0.0, 0.0, 0.0, turned]
    drag = damping(hull, quadratic, 0.15, (1.0, 1.0, length / 2.0))
    most = rounded(resistance(drag, hull.speed) / 2.0)
    tables = {
        "dof": DOF,
        "body": floating_body(hull),
        "added_mass": matrix(ahead, aside, yaw),
        "damping": drag,
        "thruster": [
            {
                "name": name,
                "position": triple(-0.45 * length, side * 0.3 * hull.beam, 0.0),
                "direction": [1.0, 0.0, 0.0],
                "max_thrust": most,
                "max_thrust_reverse": rounded(_ASTERN * most),
            }
            for name, side in (("port", -1.0), ("starboard", 1.0))
        ],
        "prior": _PRIOR,
        "effect": lifts(slender_wing(hull), ahead, aside),
    }
    notes: dict[str, tuple[str, ...]] = {
        "body": ABOUT_MIDSHIP,
        "added_mass": (
            "Ahead after Söding (1982). Aside and in yaw: strips of half ellipses (after Newman 1977), "
            "less what flows round the ends by Lamb's factors. Of two hulls take their draft, and expect "
            "more aside.",
        ),
        "damping": (
            f"Quadratic ahead: friction by ITTC (1957) on Mumford's surface, and {_RESIDUARY:g} for waves. "
            f"Across: strips with a drag coefficient of {_DRAG:g}. Linear: as large as that at 0.15 of the "
            "top speed.",
        ),
        "thruster": (
            f"Placeholders: two aft, such that {hull.speed:.3g} m/s are the most ahead. Measure their "
            "places, and the thrust at the bollard ahead and astern.",
        ),
        "effect": (
            "The hull as a wing of low aspect ratio, which is what the regression of Clarke et al. (1983) "
            "leaves of a narrow hull, less what the added mass brings.",
        ),
    }
    return Guess(tables, notes)
