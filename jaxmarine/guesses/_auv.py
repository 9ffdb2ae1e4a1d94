"""An AUV: a torpedo with four fins and a propeller aft."""

import math

from ._hull import Hull
from ._parts import Guess, body, damping, propeller, rounded, triple
from ._resistance import torpedo_drag
from ._spheroid import lamb
from ._strips import cross_flow

SPEED = 2.0  # m/s
# Of a cylinder across the flow.
_DRAG = 1.1
# Fins, antenna and transducers, beside the bare hull ahead.
_APPENDAGES = 1.5
# Added inertia in roll, which a spheroid has none of, as a share of its own there.
_ROLL = 0.3
# Each fin's area as a share of the diameter's square, and its aspect ratio.
_FIN, _ASPECT = 0.25, 2.0
_KT, _WAKE, _DEDUCTION = (0.35, -0.35, -0.05), 0.1, 0.1
_PRIOR = {"added_mass": 0.4, "linear": 1.0, "quadratic": 0.6, "propeller": 0.3, "surface": 0.3, "lift": 0.5}


def guess(hull: Hull) -> Guess:
    """Six degrees of freedom about the centre of buoyancy, amidships.

    The hull is a body of revolution with the mean diameter of beam and height. Lamb's factors are those of
    the spheroid about it, and act on the water that it really displaces.
    """
    length, diameter = hull.length, math.sqrt(hull.beam * hull.draft)
    along, across, turning = lamb(length / diameter)
    # The ends of a fuller hull hold more: from a spheroid (2/3 of the cylinder around it) to that cylinder.
    filled = hull.volume / (math.pi / 4.0 * diameter**2 * length)
    second = 0.2 + 0.4 * min(max(filled - 2.0 / 3.0, -0.25), 1.0 / 3.0)
    water = hull.mass * (second * (length / 2.0) ** 2 + 0.2 * (diameter / 2.0) ** 2)
    below = 0.1 * diameter
    radii = (diameter / math.sqrt(8.0), length / 4.0, length / 4.0)
    aside, yaw = cross_flow(_DRAG, hull.draft, length, hull.density)
    down, pitch = cross_flow(_DRAG, hull.beam, length, hull.density)
    area, reach = _FIN * diameter**2, 0.75 * diameter
    roll = 0.5 * hull.density * _DRAG * 4.0 * area * reach**3
    ahead = _APPENDAGES * torpedo_drag(hull, diameter)
    arms = (diameter / 2.0, length / 2.0, length / 2.0)
    drag = damping(hull, [ahead, aside, down, roll, pitch, yaw], 0.05, arms)
    # After Hoerner: 0.003 a degree of d² times l / d, at 0.65 of the length from the nose.
    lift = rounded(0.5 * hull.density * diameter * length * math.degrees(0.003))
    arm = 0.15 * length
    aft = -0.45 * length
    fins = {
        "rudder_top": ((aft, 0.0, -reach), (0.0, 0.0, -1.0)),
        "rudder_bottom": ((aft, 0.0, reach), (0.0, 0.0, -1.0)),
        "plane_port": ((aft, -reach, 0.0), (0.0, 1.0, 0.0)),
        "plane_star": ((aft, reach, 0.0), (0.0, 1.0, 0.0)),
    }
    added = (
        along * hull.mass,
        across * hull.mass,
        across * hull.mass,
        _ROLL * hull.mass * radii[0] ** 2,
        turning * water,
        turning * water,
    )
    tables = {
        "body": body(hull, radii, below),
        "added_mass": {"matrix": [rounded(one) for one in added]},
        "damping": drag,
        "propeller": propeller(hull, drag, 0.5 * length, 0.7 * diameter, _KT, _WAKE, _DEDUCTION),
        "surface": [
            {
                "name": name,
                "position": triple(*at),
                "axis": list(axis),
                "area": rounded(area),
                "aspect_ratio": _ASPECT,
                "max_angle": 0.35,
                "lag": 0.1,
            }
            for name, (at, axis) in fins.items()
        ],
        "prior": _PRIOR,
        "effect": [
            {
                "effect": "hull_lift",
                "Y_uv": lift,
                "N_uv": rounded(-arm * lift),
                "Z_uw": lift,
                "M_uw": rounded(arm * lift),
            }
        ],
    }
    return Guess(tables, _notes(hull))


def _notes(hull: Hull) -> dict[str, tuple[str, ...]]:
    """What stands above the tables."""
    return {
        "body": (
            "Inertia: radii of gyration of a quarter of the length, and in roll of a full cylinder. The "
            "centre of gravity lies a tenth of the diameter below that of buoyancy, and the origin there.",
        ),
        "added_mass": (
            "Lamb's factors of the spheroid of this length and diameter, on the water that is displaced "
            f"(Imlay 1961, as MSS has them). In roll {_ROLL:g} of its own inertia, for fins. Fins "
            "add more aft.",
        ),
        "damping": (
            "Quadratic ahead: friction by ITTC (1957), the form's share after Hoerner (1965), half as much "
            f"again for what sticks out. Across: strips with a drag coefficient of {_DRAG:g}, roll by the "
            "fins. Linear: as large as that at 0.05 of the top speed.",
        ),
        "propeller": (
            "A placeholder: 0.7 of the diameter, K_T as of usual screws, at most the turns of "
            f"{hull.speed:g} m/s. Measure thrust at the bollard and the speed over the turns.",
        ),
        "surface": (
            f"Placeholders: four fins of {_FIN:g} times the diameter's square, which keep such a hull on "
            "course. Lift after Fujii and Tuda (1961), by the aspect ratio. Measure area and place.",
        ),
        "effect": (
            "Lift of the hull itself, 0.003 a degree of length times diameter, at 0.65 of the length from "
            "the nose: after Hoerner (1965) and Prestero (2001). The Munk moment comes by "
            "the added mass.",
        ),
    }
