"""Drift of a parameter over dives, told from scatter: alarms as dives come, and since when in hindsight."""

import dataclasses

import numpy as np
import scipy.optimize
import scipy.special
from jaxtyping import Float

from ._sisters import Class

# A chart waits for a shift of twice the error of one dive: half of that is what it takes off.
_SLACK = 1.0
# Alarms of a craft per dive, by chance and over all parameters: four in ten thousand where scatter is
# normal, so that they are at most one in a thousand where its tails are heavy.
_FALSE = 0.4e-3
# One dive alone raises no alarm: of the level that does it adds at most this share. Scatter with heavy tails
# would else raise three times as many (experiments/fleet_drift.py); a step still shows in its second dive.
_ALONE = 0.55
# A step's size before it is known, in errors of one dive: what a dive can just tell alone.
_STEP = 5.0


@dataclasses.dataclass(frozen=True)
class Alarm:
    """A parameter that has left its level.

    - `dive`: at which it is told; `parameter`: its index; `rising`: which way.
    """

    dive: int
    parameter: int
    rising: bool


def level(charts: int, rate: float = _FALSE) -> float:
    """Where one of so many one-sided charts raises an alarm, so that all together do at a rate per dive.

    From the mean number of dives to an alarm of a CUSUM without drift, (exp(2 k b) - 2 k b - 1) / (2 k²) with
    b = h + 1.166. Source: after Siegmund (1985), Sequential Analysis, Springer.
    """
    k = _SLACK

    def lacks(h: float) -> float:
        b = h + 1.166
        return (np.exp(2 * k * b) - 2 * k * b - 1) / (2 * k**2) - charts / rate

    return scipy.optimize.root_scalar(lacks, bracket=(0.0, 50.0)).root


def alarms(
    common: Class,
    values: Float[np.ndarray, "dives parameters"],
    covariance: Float[np.ndarray, "dives parameters parameters"],
) -> list[Alarm]:
    """The alarms of one craft's dives in the order of time.

    Each dive is compared with what its craft was known to be from its sisters and its dives before. A change
    of one parameter alone is looked for: its score is the errors' projection on it, all covariances known,
    and has mean 0 and variance 1 from dive to dive while nothing changes. Two CUSUM charts (Page 1954,
    Biometrika 41, 100-115) per parameter add up the scores. After an alarm the craft is taken for a new one,
    which only its sisters are known of.
    """
    count = values.shape[1]
    high = level(2 * count)
    most = _ALONE * high + _SLACK
    prior = np.diag(common.spread**2)
    mean, known, sums = common.mean, prior, np.zeros((2, count))
    out = []
    for dive, (y, stated) in enumerate(zip(values, covariance, strict=True)):
        error = stated + np.diag(common.scatter**2)
        inverse = np.linalg.inv(error + known)
        score = inverse @ (y - mean) / np.sqrt(np.diagonal(inverse))
        signed = np.stack([score, -score])
        sums = np.maximum(sums + np.clip(signed, -most, most) - _SLACK, 0.0)
        gain = known @ inverse
        mean, known = mean + gain @ (y - mean), known - gain @ known
        if sums.max() > high:
            # Of several the one of which this dive says most, as the sums know no more than the limit.
            told = np.where(sums > high, signed, -np.inf)
            side, parameter = np.unravel_index(np.argmax(told), told.shape)
            out.append(Alarm(dive, int(parameter), bool(side == 0)))
            mean, known, sums = common.mean, prior, np.zeros((2, count))
    return out


@dataclasses.dataclass(frozen=True)
class Change:
    """A step in a parameter, or none.

    - `nats`: logarithm of the Bayes factor of one step at any dive over none.
    - `dive`: the first after the likeliest step; `size` of the step there, `std` of it.
    """

    nats: float
    dive: int
    size: float
    std: float


def change_point(values: Float[np.ndarray, " dives"], std: Float[np.ndarray, " dives"]) -> Change:
    """Whether a parameter has stepped, and when; each dive as likely as any other beforehand.

    - `std`: of each dive, scatter included.

    The level has a flat prior, the step a normal one of five typical errors of a dive; both are integrated.
    """
    weight = std**-2.0
    total, moment = np.cumsum(weight), np.cumsum(weight * values)
    before, after = total[:-1], total[-1] - total[:-1]
    size = (moment[-1] - moment[:-1]) / after - moment[:-1] / before
    variance = 1 / before + 1 / after
    prior = (_STEP * np.median(std)) ** 2
    nats = 0.5 * (size**2 / variance * prior / (prior + variance) - np.log1p(prior / variance))
    best = int(np.argmax(nats))
    whole = float(scipy.special.logsumexp(nats) - np.log(len(nats)))
    return Change(whole, best + 1, float(size[best]), float(np.sqrt(variance[best])))
