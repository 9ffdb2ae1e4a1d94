"""Added mass of a box in unbounded water, such as the frame of an ROV."""

import math

import numpy as np

# Of a rectangular plate that moves across itself: longer side over shorter one, and C_A, by which it moves as
# much water as C_A cylinders about its longer side with the shorter one for diameter; after DNV-RP-H103
# (2011).
_RATIOS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.25, 8.0, 10.0)
_PLATE = (0.579, 0.642, 0.690, 0.757, 0.801, 0.830, 0.872, 0.897, 0.917, 0.934, 0.947)


def added_mass_of_box(depth: float, side: float, other: float, density: float) -> float:
    r"""Added mass [kg] of a box that moves along its `depth`, across the face `side` times `other` [m].

    That of its face as a plate, $\rho C_A \frac\pi4 a^2 b$ with sides $a \le b$, times
    $1 + \sqrt{(1 - \lambda^2) / (2 (1 + \lambda^2))}$, $\lambda = \sqrt{ab} / (\sqrt{ab} + depth)$.

    Source: after DNV-RP-H103 (2011), whose equations vamseeachanta/digitalmodel has.
    """
    a, b = sorted((side, other))
    plate = density * float(np.interp(b / a, _RATIOS, _PLATE)) * math.pi / 4.0 * a**2 * b
    face = math.sqrt(a * b)
    ratio = (face / (face + depth)) ** 2
    return plate * (1.0 + math.sqrt((1.0 - ratio) / (2.0 * (1.0 + ratio))))
