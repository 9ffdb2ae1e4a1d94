"""Whether a log was recorded under feedback: its commands answer what was measured.

An autopilot acts on its sensors, their noise included, so that what they showed helps to predict its next
command better than its past commands do. Hands on sticks do not see the noise, nor does a prepared
manoeuvre, except for slow sines in hardly any noise, which their own responses predict. Source: after Granger
(1969), with prediction errors on parts of the log that were left out.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from .._angles import ANGLES
from .._types import STATE
from ..logs import Log

# Samples of the past that a command is predicted from, and parts that are left out in turn.
PAST, PARTS = 2, 24
# Pull of the regression's coefficients to zero, per sample: for columns that are nearly the same.
PULL = 1e-6
# Variance, as a share of that of a command's changes, that is no answer.
RESTING = 1e-6
# Probability that a log without feedback looks as if one of its commands answered: then a disturbance
# is looked for that is not there, which costs time and no answer. So one log in ten may.
CHANCE = 0.1


def answers(log: Log) -> bool:
    """Whether a command of a log, or its wrench, is predicted better by what has just changed in the samples.

    Better for certain: by the errors in parts of the log that were left out, after Wilcoxon (1945).
    """
    if len(log.t) < 4 * PARTS * PAST:
        return False
    given = np.asarray(log.wrench if log.commands is None else log.commands, float)
    new = np.diff(given, axis=0, prepend=given[:1])[PAST:]
    seen = log.channels[:, STATE].copy()
    measured = np.isfinite(seen).mean(axis=0) > 0.5
    if not measured.any():
        return False
    seen = seen[:, measured]
    for i in np.flatnonzero(ANGLES[STATE][measured]):
        # A heading that jumps by a turn has not changed.
        here = np.isfinite(seen[:, i])
        seen[here, i] = np.unwrap(seen[here, i])
    # What was not measured at a sample is held from the one before, as a controller does.
    seen = _held(seen)
    past = np.concatenate([np.roll(given, k, axis=0) for k in range(1, PAST + 1)], axis=1)[PAST:]
    changed = np.diff(seen, axis=0, prepend=seen[:1])
    shown = np.concatenate([np.roll(changed, k, axis=0) for k in range(PAST)], axis=1)[PAST:]
    both = np.concatenate([past, shown], axis=1)
    # By ranks: the first seconds of a log, in which a craft is brought to its course, are unlike all others.
    # Here, as it takes half a second to import, which a fit or a check has no use for.
    from scipy.stats import wilcoxon

    def chance(acts: np.ndarray, y: np.ndarray) -> float:
        if acts.sum() < 4 * PARTS * PAST:
            return 1.0
        better = _spread(past[acts], y[acts]) - _spread(both[acts], y[acts])
        if not better.any():
            return 1.0
        tested: Any = wilcoxon(better, alternative="greater")
        return float(tested.pvalue)

    acts = (new != 0).any(axis=1)
    each = [new[:, [i]] for i in np.flatnonzero(new.any(axis=0))]
    # One that rests, as at its limit, does not say what it would answer, but one that is clipped may. And all
    # together: an answer may show in the difference of two thrusters alone.
    tests = [(acts, y) for y in each]
    tests += [(y[:, 0] != 0, y) for y in each if not np.array_equal(y[:, 0] != 0, acts)]
    tests += [(acts, new)] if len(each) > 1 else []
    chances = [chance(*one) for one in tests]
    return bool(chances) and min(chances) * len(chances) < CHANCE


def _held(seen: Float[np.ndarray, "samples channels"]) -> Float[np.ndarray, "samples channels"]:
    """The last finite value of each channel, zero before the first."""
    last = np.where(np.isfinite(seen), np.arange(len(seen))[:, None], 0)
    last = np.maximum.accumulate(last, axis=0)
    return np.nan_to_num(seen[last, np.arange(seen.shape[1])])


def _spread(
    x: Float[np.ndarray, "samples regressors"], y: Float[np.ndarray, "samples commands"]
) -> Float[np.ndarray, " parts"]:
    """Logarithm of the generalised variance of a linear regression's errors in each part of a log.

    Fitted to the other parts. After Geweke (1982), of several series together.
    """
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    x = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    y = y / np.maximum(y.std(axis=0), 1e-12)
    part = np.arange(len(x)) * PARTS // len(x)
    out = np.empty(PARTS)
    for k in range(PARTS):
        here, rest = part == k, part != k
        h = x[rest].T @ x[rest] + PULL * len(x) * np.eye(x.shape[1])
        errors = y[here] - x[here] @ np.linalg.solve(h, x[rest].T @ y[rest])
        # A command that hardly changes in a part is predicted as well by both.
        spread = errors.T @ errors / len(errors) + RESTING * np.eye(y.shape[1])
        out[k] = np.linalg.slogdet(spread)[1]
    return out
