"""A ship of one hull, with a propeller and the rudder behind it."""

import math

from ._clarke import clarke
from ._floating import ABOUT_MIDSHIP, DOF, added_ahead, floating_body, lifts, matrix
from ._hull import Hull
from ._parts import Guess, damping, propeller, rounded, triple
from ._resistance import ship_drag
from ._strips import cross_flow, hull_drag

# For waves and appendages.
_RESIDUARY = 5e-4
_KT = (0.2931, -0.2753, -0.1385)
_ASPECT = 1.6
_PRIOR = {"added_mass": 0.3, "linear": 1.0, "quadratic": 0.4, "propeller": 0.3, "surface": 0.3, "lift": 0.3}


def speed(hull: Hull) -> float:
    """Speed [m/s] for which so full a ship is built: its Froude number is (1.08 - C_B) / 1.68.

    Source: after Alexander's formula.
    """
    froude = min(max((1.08 - hull.fullness) / 1.68, 0.12), 0.3)
    return froude * math.sqrt(hull.gravity * hull.length)


def rudder_area(hull: Hull) -> float:
    """T L / 100 (1 + 25 (B / L)²) [m²], after the rules of Det Norske Veritas."""
    return 0.01 * hull.draft * hull.length * (1.0 + 25.0 * (hull.beam / hull.length) ** 2)


def guess(hull: Hull) -> Guess:
    """Three degrees of freedom about midship."""
    length, draft = hull.length, hull.draft
    force, ahead = clarke(hull), added_ahead(hull)
    aside, turned = cross_flow(hull_drag(hull.beam, draft), draft, length, hull.density)
    quadratic = [ship_drag(hull, _RESIDUARY), aside, 0.0, 0.0, 0.0, turned]
    drag = damping(hull, quadratic, 0.02, (1.0, 1.0, length / 2.0))
    wake = min(max(0.5 * hull.fullness - 0.05, 0.1), 0.4)
    screw = 0.6 * draft
    area = rudder_area(hull)
    share = min(1.0, screw / math.sqrt(_ASPECT * area))
    tables = {
        "dof": DOF,
        "body": floating_body(hull),
        "added_mass": matrix(ahead, force.sway, force.yaw),
        "damping": drag,
        "propeller": propeller(hull, drag, 0.48 * length, screw, _KT, wake, 0.6 * wake),
        "surface": [
            {
                "name": "rudder",
                "position": triple(-0.5 * length, 0.0, 0.0),
                "axis": [0.0, 0.0, -1.0],
                "area": rounded(area),
                "aspect_ratio": _ASPECT,
                "behind": "propeller",
                "slipstream": {"share": rounded(share), "gain": 0.5, "wake_ratio": 1.09},
                "hull": {
                    "steering_deduction": 0.387,
                    "lift_increase": 0.312,
                    "lift_position": rounded(-0.464 * length),
                    "straightening": [0.5, 0.5],
                    "arm": rounded(-0.71 * length),
                },
                "max_angle": 0.61,
                # 2.32 degrees a second, the least that is allowed, of a ship of 100 m; models are faster.
                "max_rate": rounded(0.0405 * max(1.0, math.sqrt(100.0 / length))),
            }
        ],
        "prior": _PRIOR,
        "effect": lifts(force, ahead, force.sway),
    }
    return Guess(tables, _notes(hull))


def _notes(hull: Hull) -> dict[str, tuple[str, ...]]:
    """What stands above the tables."""
    return {
        "body": ABOUT_MIDSHIP,
        "added_mass": (
            "Ahead after Söding (1982). Aside and in yaw by the regression of Clarke, Gedling and Hine "
            "(1983), as PythonVehicleSimulator has it; what couples the two is left out.",
        ),
        "damping": (
            "Quadratic ahead: friction by ITTC (1957) on Mumford's surface, form factor after Watanabe, "
            f"and {_RESIDUARY:g} for the rest. Across: strips with Hoerner's drag of ships' sections. "
            "Linear: as large as that at 0.02 of the speed.",
        ),
        "propeller": (
            "A placeholder: 0.6 of the draft, K_T of KVLCC2 (Yasukawa and Yoshimura 2015), wake after "
            f"Taylor, at most the turns of {hull.speed:.3g} m/s.",
        ),
        "surface": (
            "A placeholder: area after Det Norske Veritas, lift after Fujii and Tuda (1961), what the hull "
            "makes of it as of KVLCC2.",
        ),
        "effect": (
            "By Clarke, Gedling and Hine (1983): their forces by drift and turn less what the added mass "
            "brings. A full ship may be unstable on its course, as many are; the drag across bounds its "
            "turn.",
        ),
    }
