"""What ships and boats share: surge, sway and yaw, and the hull as a wing."""

from typing import Any

from ._clarke import Derivatives
from ._hull import Hull
from ._parts import body, rounded

DOF = ["surge", "sway", "yaw"]
# What stands above `floating_body`.
ABOUT_MIDSHIP = (
    "About midship, with the centre of gravity there. Radii of gyration: a quarter of the length, 0.4 of the "
    "beam.",
)


def floating_body(hull: Hull) -> dict[str, Any]:
    """Radii of gyration as of most: 0.4 of the beam in roll, a quarter of the length in pitch and yaw."""
    return body(hull, (0.4 * hull.beam, 0.25 * hull.length, 0.25 * hull.length))


def added_ahead(hull: Hull) -> float:
    """2.7 rho volume^(5/3) / length² [kg].

    Source: Söding (1982), "Prediction of ship steering capabilities", Schiffstechnik, 3-29, as
    `addedMassSurge` of cybergalactic/MSS has it.
    """
    return 2.7 * hull.density * hull.volume ** (5.0 / 3.0) / hull.length**2


def lifts(force: Derivatives, ahead: float, aside: float) -> list[dict[str, Any]]:
    """The effects that with the added mass ahead and aside [kg] give the derivatives' whole force.

    The added mass brings Y = -A11 u r and N = -(A22 - A11) u v by itself.
    """
    return [
        {"effect": "hull_lift", "Y_uv": rounded(-force.Yv), "N_uv": rounded(-force.Nv - (aside - ahead))},
        {"effect": "turning_lift", "Y_ur": rounded(-force.Yr - ahead), "N_ur": rounded(-force.Nr)},
    ]


def matrix(ahead: float, aside: float, yaw: float) -> dict[str, Any]:
    return {"matrix": [rounded(ahead), rounded(aside), 0.0, 0.0, 0.0, rounded(yaw)]}
