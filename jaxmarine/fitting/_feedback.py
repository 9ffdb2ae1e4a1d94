"""Whether a log was recorded under feedback: its commands answer what was measured.

An autopilot acts on its sensors, their noise included, so that what they showed helps to predict its next
command better than its past commands do. Hands on sticks do not see the noise, nor does a prepared
manoeuvre, except for slow sines in hardly any noise, which their own responses predict. Source: after Granger
(1969), with prediction errors on parts of the log that were left out.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._angles import ANGLES
from .._types import STATE
from ..logs import Log

# Samples of the past that a command is predicted from, and parts that are left out in turn.
PAST, PARTS = 2, 24
# Samples of fewer are too few for so many parts.
LEAST = 4 * PARTS * PAST
# Samples in which means of its past forget all but 1/e.
LONGER = (4, 16, 64)
# Pull of the regression's coefficients to zero, per sample: for columns that are nearly the same.
PULL = 1e-6
# Variance of an answer to noise, as a share of that of a command's changes: weak as a rule beside what a new
# set-point or a turn asks for. So small are its coefficients held to be, or what the regression learns of
# noise in its many columns would cost more than the answer is worth.
ANSWERED = 0.02
# Variance, as a share of that of a command's changes, that is no answer.
RESTING = 1e-6
# Probability that a log without feedback looks as if one of its commands answered: then a disturbance
# is looked for that is not there, which costs time and no answer. So one log in ten may.
CHANCE = 0.1


def answers(log: Log) -> bool:
    """Whether a command of a log, or its wrench, is predicted better by what has just changed in the samples.

    Better for certain: by the errors in parts of the log that were left out, after Wilcoxon (1945).
    """
    if len(log.t) < LEAST:
        return False
    given = np.asarray(log.wrench if log.commands is None else log.commands, float)
    seen = _seen(log)
    if not seen.shape[1]:
        return False
    new = np.diff(given, axis=0, prepend=given[:1])[PAST:]
    acts, new = (new != 0).any(axis=1), new[:, new.any(axis=0)]
    if acts.sum() < LEAST:
        return False
    past, shown = _regressors(given, seen)
    # One that rests, as at its limit, does not say what it would answer, but one that is clipped may. And all
    # together: an answer may show in the difference of two thrusters alone.
    before, after = _both_errors(past[acts], shown[acts], new[acts])
    chances = [_chance(before[:, [i]], after[:, [i]]) for i in range(new.shape[1])]
    if new.shape[1] > 1:
        chances.append(_chance(before, after))
    for y in new.T[:, :, None]:
        own = y[:, 0] != 0
        if not np.array_equal(own, acts):
            enough = own.sum() >= LEAST
            chances.append(_chance(*_both_errors(past[own], shown[own], y[own])) if enough else 1.0)
    return min(chances) * len(chances) < CHANCE


def _seen(log: Log) -> Float[np.ndarray, "samples channels"]:
    """What a controller sees of a log's states, those of which most samples are measured."""
    seen = log.channels[:, STATE].copy()
    measured = np.isfinite(seen).mean(axis=0) > 0.5
    seen = seen[:, measured]
    for i in np.flatnonzero(ANGLES[STATE][measured]):
        # A heading that jumps by a turn has not changed.
        here = np.isfinite(seen[:, i])
        seen[here, i] = np.unwrap(seen[here, i])
    # What was not measured at a sample is held from the one before, as a controller does.
    return _held(seen)


def _regressors(
    given: Float[np.ndarray, "samples commands"], seen: Float[np.ndarray, "samples channels"]
) -> tuple[Float[np.ndarray, "rows past"], Float[np.ndarray, "rows shown"]]:
    """At each sample but the first `PAST`: what commands were before, and what was seen of late."""
    # Here, as it takes half a second to import, which a fit has no use for.
    from scipy.signal import lfilter

    # With means over longer: a craft's motion has them, and would pass for an answer by them alone.
    means = [lfilter([1 / many], [1, 1 / many - 1], given, axis=0) for many in LONGER]
    lagged = [np.roll(given, k, axis=0) for k in range(1, PAST + 1)]
    past = np.concatenate([*lagged, *(np.roll(mean, 1, axis=0) for mean in means)], axis=1)
    changed = np.diff(seen, axis=0, prepend=seen[:1])
    shown = np.concatenate([np.roll(changed, k, axis=0) for k in range(PAST)], axis=1)
    return past[PAST:], shown[PAST:]


def _both_errors(
    past: Float[np.ndarray, "rows past"],
    shown: Float[np.ndarray, "rows shown"],
    y: Float[np.ndarray, "rows commands"],
) -> tuple[Float[np.ndarray, "rows commands"], Float[np.ndarray, "rows commands"]]:
    """Errors of commands that are predicted by their past alone, and by what was seen as well.

    A normal prior: as many coefficients as columns share what is answered. Of its own past, with which its
    motion goes, a command has what it likes: else that would pass for an answer.
    """
    own, pull = np.zeros(past.shape[1]), np.full(shown.shape[1], shown.shape[1] / ANSWERED)
    both = np.concatenate([past, shown], axis=1)
    return _errors(past, y, own), _errors(both, y, np.concatenate([own, pull]))


def _chance(before: Float[np.ndarray, "rows commands"], after: Float[np.ndarray, "rows commands"]) -> float:
    """Probability that errors without an answer are that much smaller by what was seen."""
    # Here, as in `_regressors`.
    from scipy.stats import wilcoxon

    better = _spread(before) - _spread(after)
    if not better.any():
        return 1.0
    # By ranks: the first seconds of a log, in which a craft is brought to its course, are unlike all others.
    tested: Any = wilcoxon(better, alternative="greater")
    return float(tested.pvalue)


def _held(seen: Float[np.ndarray, "samples channels"]) -> Float[np.ndarray, "samples channels"]:
    """The last finite value of each channel, zero before the first."""
    last = np.where(np.isfinite(seen), np.arange(len(seen))[:, None], 0)
    last = np.maximum.accumulate(last, axis=0)
    return np.nan_to_num(seen[last, np.arange(seen.shape[1])])


def _parts(samples: int) -> Int[np.ndarray, " samples"]:
    """In which part of a log each sample lies."""
    return np.arange(samples) * PARTS // samples


def _errors(
    x: Float[np.ndarray, "samples regressors"],
    y: Float[np.ndarray, "samples commands"],
    pull: Float[np.ndarray, " regressors"],
) -> Float[np.ndarray, "samples commands"]:
    """Errors of a linear regression, in each part of a log of one fitted to the others; commands scaled.

    - `pull`: of each coefficient to zero, beside `PULL`: what is left of a command, by what it may be.
    """
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    x = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    y = y / np.maximum(y.std(axis=0), 1e-12)
    prior = np.diag(np.append(pull, 0.0)) + PULL * len(x) * np.eye(x.shape[1])
    part, out = _parts(len(x)), np.empty_like(y)
    for k in range(PARTS):
        here, rest = part == k, part != k
        h = x[rest].T @ x[rest] + prior
        out[here] = y[here] - x[here] @ np.linalg.solve(h, x[rest].T @ y[rest])
    return out


def _spread(errors: Float[np.ndarray, "samples commands"]) -> Float[np.ndarray, " parts"]:
    """Logarithm of the errors' generalised variance in each part; after Geweke (1982)."""
    part, out = _parts(len(errors)), np.empty(PARTS)
    for k in range(PARTS):
        own = errors[part == k]
        # A command that hardly changes in a part is predicted as well by both.
        out[k] = np.linalg.slogdet(own.T @ own / len(own) + RESTING * np.eye(own.shape[1]))[1]
    return out
