"""How far each channel is trusted: its noise, and by how much a model misses it beyond that."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float

from .._errors import InputError
from ..logs import Log, sensor_noise
from ..vehicle import Vehicle


def noise_of(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, "18"]:
    """Noise per channel: stated by the vehicle, else estimated from the logs; NaN: unmeasured.

    Raises `InputError` where nothing that was measured can be weighed.
    """
    noises = np.array([sensor_noise(log, dict(vehicle.sensors)) for log in logs])
    out = np.full(noises.shape[1], np.nan)
    seen = np.isfinite(noises).any(axis=0)
    out[seen] = np.nanmedian(noises[:, seen], axis=0)
    if not seen.any():
        names = ", ".join(log.name for log in logs)
        raise InputError(f"{names}: no measured channel ever changes; use a log in which the vehicle moves.")
    return out


def at_residual(
    residual: Float[Array | np.ndarray, "windows steps 18"],
    measured: Float[Array | np.ndarray, "windows steps 18"],
    weight: Float[Array | np.ndarray, "windows steps 18"],
) -> Float[np.ndarray, "18"]:
    """Factors that raise the noise of each channel to its residual; 1 where it is noise already.

    - `residual`: prediction minus `measured`, in units of the noise.
    - `weight`: one over the noise, 0 where nothing was measured.

    To the root mean square in the median window, at most to what a channel changes by within a window, which
    is the most that it can be missed by.
    """
    weight = np.asarray(weight)
    missing = weight == 0
    squares = np.ma.masked_array(np.asarray(residual), missing) ** 2
    missed = np.sqrt(np.ma.median(squares.mean(axis=1), axis=0)).filled(1.0)
    changes = np.ma.masked_array(np.asarray(measured) * weight, missing).std(axis=1)
    most = changes.mean(axis=0).filled(1.0)
    return np.maximum(np.minimum(missed, most), 1.0)
