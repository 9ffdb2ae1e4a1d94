"""Craft of one class: what their logs say together of a parameter that sisters share, or nearly share.

A log's own Gaussian summary is where a fit of it ended and its covariance. Of craft c in dive d it is

    y = theta_c + b + e,    theta_c ~ N(mu, T),    b ~ N(0, W),    e ~ N(0, S)

with the stated covariance S, the scatter W from dive to dive that it lacks, and the spread T of sisters, both
diagonal: a hull is shared where T is small, thrusters are own where it is large, and the logs say which.
Source: empirical Bayes after Efron and Morris (1975), Journal of the American Statistical Association 70,
311-319; EM after Laird and Ware (1982), Biometrics 38, 963-974.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float

# Steps of EM, and the relative change of the spread that is not worth one more: its own error is some
# percent.
_STEPS, _SMALL = 200, 1e-3
# A spread below this share of the mean stated variance is as good as none, and keeps matrices regular.
_LEAST = 1e-6


@dataclasses.dataclass(frozen=True)
class Class:
    """What craft of a class have in common.

    - `mean`, `spread` [parameters]: of the sisters, the latter a standard deviation.
    - `scatter` [parameters]: standard deviation from dive to dive beyond what is stated.
    """

    mean: Float[np.ndarray, " parameters"]
    spread: Float[np.ndarray, " parameters"]
    scatter: Float[np.ndarray, " parameters"]


def scatter_of(
    values: Sequence[Float[np.ndarray, "_ parameters"]],
    covariance: Sequence[Float[np.ndarray, "_ parameters parameters"]],
) -> Float[np.ndarray, " parameters"]:
    """Standard deviation from dive to dive that the stated covariances lack, 0 where they lack none.

    - `values`, `covariance`: of each craft, its dives in order of time.

    By the median square of differences of successive dives over their variance: a drift or a step hardly
    shows in it, and dives that went wrong do not either. After von Neumann (1941), Annals of Mathematical
    Statistics 12, 367-395, and made robust.
    """
    square = np.concatenate([np.diff(own, axis=0) ** 2 for own in values])
    variance = [np.diagonal(own, axis1=1, axis2=2) for own in covariance]
    stated = np.concatenate([own[1:] + own[:-1] for own in variance])
    middle = scipy.stats.chi2.median(1)

    def lacks(own: float, j: int) -> float:
        return float(np.median(square[:, j] / (stated[:, j] + 2 * own))) - middle

    def root(j: int) -> float:
        if lacks(0.0, j) <= 0:
            return 0.0
        high = float(square[:, j].max()) / middle
        return scipy.optimize.root_scalar(lacks, args=(j,), bracket=(0.0, high)).root

    return np.sqrt([root(j) for j in range(square.shape[1])])


def pooled(
    values: Sequence[Float[np.ndarray, "dives parameters"]],
    covariance: Sequence[Float[np.ndarray, "dives parameters parameters"]],
) -> Class:
    """Mean, spread and scatter of a class from the summaries of its craft; arguments as of `scatter_of`."""
    scatter = scatter_of(values, covariance)
    inverse = [np.linalg.inv(own + np.diag(scatter**2)) for own in covariance]
    # All that the dives of a craft say of it: precision and weighed sum.
    own = np.stack([one.sum(0) for one in inverse])
    told = np.stack([np.einsum("dij,dj->i", *both) for both in zip(inverse, values, strict=True)])
    alone = np.linalg.solve(own, told[..., None])[..., 0]
    least = _LEAST * np.diagonal(np.linalg.inv(own), axis1=1, axis2=2).mean(0)
    mean, variance = alone.mean(0), np.maximum(alone.var(0), least)
    for _ in range(_STEPS):
        posterior = np.linalg.inv(own + np.diag(1 / variance))
        theta = np.einsum("cij,cj->ci", posterior, told + mean / variance)
        before, mean = variance, theta.mean(0)
        spread = (theta - mean) ** 2 + np.diagonal(posterior, axis1=1, axis2=2)
        variance = np.maximum(spread.mean(0), least)
        if (np.abs(variance - before) < _SMALL * before).all():
            break
    return Class(mean, np.sqrt(variance), scatter)


def craft_of(
    common: Class,
    values: Float[np.ndarray, "dives parameters"],
    covariance: Float[np.ndarray, "dives parameters parameters"],
) -> tuple[Float[np.ndarray, " parameters"], Float[np.ndarray, "parameters parameters"]]:
    """Mean and covariance of one craft's parameters: its own dives, and its sisters as far as alike."""
    inverse = np.linalg.inv(covariance + np.diag(common.scatter**2))
    posterior = np.linalg.inv(inverse.sum(0) + np.diag(common.spread**-2.0))
    told = np.einsum("dij,dj->i", inverse, values) + common.mean / common.spread**2
    return posterior @ told, posterior
