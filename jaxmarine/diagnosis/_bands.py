"""Bands of predictions: as wide as predictions of the training logs were off, so long after their start.

They hold whatever is left, a disturbance and noise of any colour included, and ask for nothing but that the
test log is like the training logs. A model that was fitted to these has few numbers beside so many errors.
Source: after Vovk, Gammerman and Shafer (2005), on conformal prediction.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..fitting import wrapped
from ._result import BANDS, Predictions

# Errors count together over so long [s]: starts are some tens, and a slow sensor shows at few samples.
SMOOTH = 0.5


def ahead_of(shown: Predictions) -> Float[np.ndarray, " steps"]:
    """Times after a start at which there are predictions [s]."""
    return shown.times[0, shown.begin :] - shown.times[0, shown.begin]


def banded(shown: Predictions, home: Sequence[Float[np.ndarray, "_ steps channels"]]) -> Predictions:
    """The predictions with their band, as they are where no training log tells it.

    - `home`: `errors_of` the training logs at the times `ahead_of` the predictions' starts.
    """
    if not home:
        return shown
    ahead, off = ahead_of(shown), np.concatenate(home)
    # Of one more than were seen: the next is as likely to lie in each gap between those that were.
    share = min(1.0, BANDS * (1 + 1 / len(off)))
    half = np.full((len(ahead), off.shape[2]), np.nan)
    for step, t in enumerate(ahead):
        near = np.abs(ahead - t) <= 0.5 * SMOOTH
        for channel in range(half.shape[1]):
            seen = off[:, near, channel]
            seen = seen[~np.isnan(seen)]
            if len(seen):
                half[step, channel] = np.quantile(seen, share, method="higher")
    return dataclasses.replace(shown, band=half)


def errors_of(
    one: Predictions, ahead: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, "starts steps channels"]:
    """Absolute errors at times [s] after the starts, NaN where nothing was measured."""
    own = one.times[0, one.begin :] - one.times[0, one.begin]
    nearest = one.begin + np.abs(own[:, None] - ahead).argmin(axis=0)
    predicted, measured = one.after[:, nearest], one.measured[:, nearest]
    error = np.nan_to_num(np.abs(np.asarray(wrapped(predicted - measured))), nan=np.inf, posinf=np.inf)
    return np.where(np.isfinite(measured), error, np.nan)
