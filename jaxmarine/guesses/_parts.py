"""What guesses are made of: tables of a vehicle file with the words that stand above them."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from ._hull import Hull

# A guess has no more digits.
_DIGITS = 4


@dataclasses.dataclass(frozen=True)
class Guess:
    """Tables of a vehicle file by their keys, and comments above them by the same keys."""

    tables: dict[str, Any]
    notes: dict[str, tuple[str, ...]]


def body(hull: Hull, radii: Sequence[float], below: float = 0.0) -> dict[str, Any]:
    """A body about the centre of its buoyancy, with radii of gyration [m], its centre `below` that [m].

    The inertia stands about `o` (parallel axes).
    """
    lever = hull.mass * below**2
    moments = [
        hull.mass * radius**2 + extra for radius, extra in zip(radii, (lever, lever, 0.0), strict=True)
    ]
    return {
        "mass": hull.mass,
        "inertia": [[rounded(moments[i]) if i == j else 0.0 for j in range(3)] for i in range(3)],
        "cog": [0.0, 0.0, rounded(below)],
        "cob": [0.0, 0.0, 0.0],
    }


def damping(hull: Hull, quadratic: Sequence[float], share: float, arms: Sequence[float]) -> dict[str, Any]:
    """Quadratic damping, and a linear one that is as large at a small speed: `share` of the top speed.

    - `arms` [m]: of roll, pitch and yaw, at which their rates make that speed.
    """
    slow = [share * hull.speed] * 3 + [share * hull.speed / arm for arm in arms]
    linear = [rounded(one * d) for one, d in zip(slow, quadratic, strict=True)]
    return {"linear": linear, "quadratic": [rounded(one) for one in quadratic]}


def resistance(tables: dict[str, Any], speed: float) -> float:
    """What holds the craft at that speed ahead [N]."""
    return tables["linear"][0] * speed + tables["quadratic"][0] * speed**2


def shaft_speed(
    force: float, hull: Hull, diameter: float, kt: Sequence[float], wake: float, deduction: float
) -> float:
    """Shaft speed [rev/s] whose thrust holds a force [N] at the hull's speed: the root of a quadratic.

    (1 - t) rho D^4 (k0 n² + k1 n V / D + k2 V² / D²) = force, with V = (1 - w) times the speed.
    """
    k0, k1, k2 = kt
    pace = (1.0 - wake) * hull.speed / diameter
    wanted = force / ((1.0 - deduction) * hull.density * diameter**4)
    b, c = k1 * pace, k2 * pace**2 - wanted
    return (-b + math.sqrt(b**2 - 4.0 * k0 * c)) / (2.0 * k0)


def propeller(
    hull: Hull,
    drag: dict[str, Any],
    aft: float,
    diameter: float,
    kt: Sequence[float],
    wake: float,
    deduction: float,
) -> list[dict[str, Any]]:
    """One that makes the hull's speed at the most, so far [m] behind the origin; `drag`: as of `damping`."""
    turns = shaft_speed(resistance(drag, hull.speed), hull, diameter, kt, wake, deduction)
    return [
        {
            "name": "propeller",
            "position": triple(-aft, 0.0, 0.0),
            "direction": [1.0, 0.0, 0.0],
            "diameter": rounded(diameter),
            "kt": list(kt),
            "wake_fraction": rounded(wake),
            "thrust_deduction": rounded(deduction),
            "max_speed": rounded(turns),
        }
    ]


def rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def triple(*values: float) -> list[float]:
    return [rounded(value) for value in values]
