"""Lamb's factors: the added mass of a prolate spheroid as shares of the water that it displaces."""

import math

# Nearer to a sphere the closed forms lose their digits (they are differences of the order of e^5): this
# near, the sphere's are right to within 1e-3.
_ROUND = 1e-3


def lamb(slenderness: float) -> tuple[float, float, float]:
    r"""k_1 (along), k_2 (across) of the displaced mass, k' of the displaced water's moment of inertia.

    With $e^2 = 1 - (b/a)^2$, $\alpha_0 = 2 (1 - e^2) / e^3 (\mathrm{artanh}\, e - e)$ and
    $\beta_0 = 1 / e^2 - (1 - e^2) / e^3 \mathrm{artanh}\, e$:
    $k_1 = \alpha_0 / (2 - \alpha_0)$, $k_2 = \beta_0 / (2 - \beta_0)$,
    $k' = e^4 (\beta_0 - \alpha_0) / ((2 - e^2) (2 e^2 - (2 - e^2) (\beta_0 - \alpha_0)))$.
    A sphere has 1/2, 1/2, 0, a needle 0, 1, 1.

    - `slenderness`: length over diameter a / b; below 1 (a disc) the sphere's are given.

    Source: Lamb (1932), Hydrodynamics, and Imlay (1961), DTMB report 1528, as `imlay61` of cybergalactic/MSS
    writes them after Fossen (2021).
    """
    e2 = 1.0 - 1.0 / max(slenderness, 1.0) ** 2
    if e2 < _ROUND:
        return 0.5, 0.5, 0.0
    e = math.sqrt(e2)
    alpha = 2.0 * (1.0 - e2) / e**3 * (math.atanh(e) - e)
    beta = 1.0 / e2 - (1.0 - e2) / e**3 * math.atanh(e)
    difference = beta - alpha
    turning = e2**2 * difference / ((2.0 - e2) * (2.0 * e2 - (2.0 - e2) * difference))
    return alpha / (2.0 - alpha), beta / (2.0 - beta), turning
