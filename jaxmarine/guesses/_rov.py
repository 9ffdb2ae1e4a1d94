"""An ROV: an open frame with a box around it, four thrusters aslant and two upright."""

import math

from ._box import added_mass_of_box
from ._hull import Hull
from ._parts import Guess, body, damping, resistance, rounded, triple
from ._strips import cross_flow

SPEED = 1.5  # m/s, three knots: of small and of large ones
# A cube that stands across its face to the flow.
_DRAG = 1.05
# Its masses stand nearer to the middle than those of a full box: its inertia over that of one.
_GATHERED = 0.6
# From the centre of gravity up to that of buoyancy, as a share of the height.
_RIGHTING = 0.1
_PRIOR = {"added_mass": 0.5, "linear": 1.0, "quadratic": 0.7, "thrust": 0.4, "lift": 0.5}


def guess(hull: Hull) -> Guess:
    """Six degrees of freedom about the centre of buoyancy.

    Water goes through the frame, so that its added mass is that of a smaller box: of the same proportions,
    but of the volume that it displaces. Its drag is that of the whole. Behind it the flow does not close:
    there is no Munk moment.
    """
    length, beam, height = hull.length, hull.beam, hull.draft
    small = hull.fullness ** (1.0 / 3.0)
    a, b, c = small * length, small * beam, small * height
    ahead = added_mass_of_box(a, b, c, hull.density)
    aside = added_mass_of_box(b, a, c, hull.density)
    down = added_mass_of_box(c, a, b, hull.density)
    # Each pair of faces, its added mass spread evenly along the other side.
    turning = [
        (down * b**2 + aside * c**2) / 12.0,
        (down * a**2 + ahead * c**2) / 12.0,
        (aside * a**2 + ahead * b**2) / 12.0,
    ]
    # Along and about each axis: of the face across it, and of the four faces that turn, as strips.
    pushed, turned = [], []
    for along, one, other in ((length, beam, height), (beam, length, height), (height, length, beam)):
        pushed.append(cross_flow(_DRAG, one, other, hull.density)[0])
        turned.append(sum(cross_flow(_DRAG, along, side, hull.density)[1] for side in (one, other)))
    quadratic = [*pushed, *turned]
    arms = (max(beam, height) / 2.0, max(length, height) / 2.0, max(length, beam) / 2.0)
    drag = damping(hull, quadratic, 0.15, arms)
    sides = ((beam, height), (length, height), (length, beam))
    radii = [math.sqrt(_GATHERED * (one**2 + other**2) / 12.0) for one, other in sides]
    most = rounded(resistance(drag, hull.speed) / (4.0 * math.sqrt(0.5)))
    x, y = 0.35 * length, 0.35 * beam
    aslant = math.sqrt(0.5)
    places = {
        "fore_star": ((x, y, 0.0), (aslant, -aslant, 0.0)),
        "fore_port": ((x, -y, 0.0), (aslant, aslant, 0.0)),
        "aft_star": ((-x, y, 0.0), (aslant, aslant, 0.0)),
        "aft_port": ((-x, -y, 0.0), (aslant, -aslant, 0.0)),
        "down_star": ((0.0, y, 0.0), (0.0, 0.0, 1.0)),
        "down_port": ((0.0, -y, 0.0), (0.0, 0.0, 1.0)),
    }
    tables = {
        "body": body(hull, radii, _RIGHTING * height),
        "added_mass": {"matrix": [rounded(one) for one in (ahead, aside, down, *turning)]},
        "damping": drag,
        "thruster": [
            {"name": name, "position": triple(*at), "direction": list(to), "max_thrust": most}
            for name, (at, to) in places.items()
        ],
        "prior": _PRIOR,
        "effect": [
            {"effect": "hull_lift", "N_uv": rounded(ahead - aside), "M_uw": rounded(down - ahead)},
        ],
    }
    return Guess(tables, _notes(hull))


def _notes(hull: Hull) -> dict[str, tuple[str, ...]]:
    """What stands above the tables."""
    return {
        "body": (
            f"Inertia: {_GATHERED:g} of that of a full box. The centre of gravity lies {_RIGHTING:g} of the "
            "height below that of buoyancy, and the origin there. Weigh it, and measure its trim.",
        ),
        "added_mass": (
            f"A box of the same proportions that displaces as much water, {hull.fullness:.2g} of the one "
            "around it, after DNV-RP-H103 (2011). About axes: each face's, spread along the other "
            "side.",
        ),
        "damping": (
            f"Quadratic: a drag coefficient of {_DRAG:g} (a cube) on the whole faces, and strips of them for "
            "turns. Linear: as large as that at 0.15 of the top speed.",
        ),
        "effect": (
            "The Munk moment, which the added mass brings, taken away: behind a frame the flow does not "
            "close.",
        ),
        "thruster": (
            f"A placeholder, as of many: four aslant, two upright. Thrust such that {hull.speed:g} m/s are "
            "the most ahead. Measure their places, and the thrust at the bollard.",
        ),
    }
