"""How much the samples of a window weigh: by what they tell of the model, not by how little they jitter.

An error of the model grows along a window, is alike from sample to sample, and is often far larger than the
noise of the sensors; an estimator's output (a Kalman filter's) hardly jitters at all. A sample that counted
by its jitter alone would outweigh every prior and every other channel. Here each channel counts by the error
that the model leaves in it over the windows, and by how many of its samples are worth one; the first sample
of each window keeps the sensor's own noise, because no error of the model has grown there yet.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Array, Float

from .._types import STATE
from ._rollout import wrapped

# What is first measured within this time of a window's beginning holds its start [s]: in half a second the
# velocity of a craft hardly changes by what a model lacks.
_EARLY = 0.5
# Weights are settled where none changes by more than this share: standard errors are not known better from a
# hundred independent samples.
_SETTLED = 0.1


def begun_at_sensors(
    weight: Float[np.ndarray, "windows steps channels"], dt: float
) -> Float[np.ndarray, "windows steps channels"]:
    """1 at the first measured sample of each channel and window, if it comes early; 0 elsewhere.

    Not of accelerations and what else is no state: those a model misses from the first sample on.
    """
    seen = weight > 0
    first = seen & (np.cumsum(seen, axis=1) == 1)
    first[:, 1 + int(_EARLY / dt) :] = False
    first[..., STATE.stop :] = False
    return first.astype(float)


def scaled(
    weight: Float[np.ndarray, "windows steps channels"], factor: Float[np.ndarray, " channels"], dt: float
) -> Float[np.ndarray, "windows steps channels"]:
    """The weights for noise that is raised by a factor per channel, but at the beginning of each window."""
    first = begun_at_sensors(weight, dt)
    return weight * (first + (1.0 - first) / factor)


def changes(
    measured: Float[np.ndarray, "windows steps channels"], weight: Float[np.ndarray, "windows steps channels"]
) -> tuple[Float[np.ndarray, " channels"], Float[np.ndarray, " channels"]]:
    """What each channel changes by in windows, in units of its noise and squared: summed, and how many."""
    # Angles about the first sample, as they may be wrapped.
    near = np.asarray(wrapped(measured - measured[:, :1]))
    square = np.ma.masked_array(near * weight, weight == 0).std(axis=1) ** 2
    return square.filled(0.0).sum(axis=0), (~np.ma.getmaskarray(square)).sum(axis=0).astype(float)


def largest(
    measured: Float[np.ndarray, "windows steps channels"], weight: Float[np.ndarray, "windows steps channels"]
) -> Float[np.ndarray, " channels"]:
    """Factors that raise a channel's noise to what it changes by in windows, the most it can be missed by."""
    return largest_of(*changes(measured, weight))


def largest_of(
    total: Float[np.ndarray, " channels"], count: Float[np.ndarray, " channels"]
) -> Float[np.ndarray, " channels"]:
    """`largest` from the `changes` of all windows."""
    return np.maximum(np.sqrt(np.where(count > 0, total / np.maximum(count, 1.0), 1.0)), 1.0)


class Products:
    """Sums of products of what a model leaves in windows, lag by lag; arguments as of `overdispersion`."""

    def __init__(
        self,
        residual: Float[Array | np.ndarray, "windows steps channels"],
        weight: Float[Array | np.ndarray, "windows steps channels"],
    ):
        # What ran away is not a number to go by.
        self._seen = ((np.asarray(weight) > 0) & np.isfinite(residual)).astype(float)
        self._error = np.where(self._seen > 0, np.nan_to_num(np.asarray(residual)), 0.0)
        self.steps = self._error.shape[1]

    def __call__(self, lag: int) -> Float[np.ndarray, "2 channels"]:
        """How many pairs of samples are so far apart, and the sum of their products."""
        late, early = slice(lag, None), slice(self.steps - lag)
        return np.stack([(a[:, late] * a[:, early]).sum(axis=(0, 1)) for a in (self._seen, self._error)])


def overdispersion(
    residual: Float[Array | np.ndarray, "windows steps channels"],
    weight: Float[Array | np.ndarray, "windows steps channels"],
    most: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, " channels"]:
    """Factors that raise the noise of each channel to what the model leaves in it; 1 where that is noise.

    - `residual`: prediction minus measured, in units of the sensors' noise; `weight`: 0 where not measured.
    """
    products = Products(residual, weight)
    return overdispersion_of(products, products.steps, most)


def overdispersion_of(
    products: Callable[[int], Float[np.ndarray, "2 channels"]],
    steps: int,
    most: Float[np.ndarray, " channels"],
) -> Float[np.ndarray, " channels"]:
    r"""`overdispersion` from the `Products` of all windows, by lag; each window has so many `steps`.

    The root mean square, no more than `most` (a channel that is missed would else be missed the more), times
    the root of how many neighbouring samples are worth one, $1 + 2 \sum_l (1 - l / n) \rho_l$ over the lags l
    up to the first that is not positive (after Geyer 1992), at most the window's n samples.
    """
    count, square = products(0)
    count = np.maximum(count, 1.0)
    variance = square / count
    size = np.minimum(variance, most**2)
    alike, going = np.ones(len(count)), variance > 0
    for lag in range(1, steps):
        pairs, product = products(lag)
        measured = pairs > 0
        correlation = np.where(measured, product / np.maximum(pairs, 1.0), 0.0) / np.maximum(variance, 1e-300)
        # A lag at which nothing was measured (a slow sensor) tells nothing and ends nothing.
        going &= (correlation > 0) | ~measured
        alike += 2.0 * np.where(going, correlation * pairs / count, 0.0)
        if not going.any():
            break
    return np.sqrt(np.maximum(size * alike, 1.0))


def settled(before: Float[np.ndarray, " channels"], after: Float[np.ndarray, " channels"]) -> bool:
    """Whether noises, or their factors, have hardly changed."""
    return bool(np.abs(np.log(after / before)).max() < np.log1p(_SETTLED))
