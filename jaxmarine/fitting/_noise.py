"""How far each channel is trusted by what its samples alone show."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .._errors import InputError
from ..logs import Log, sensor_noise
from ..vehicle import Vehicle


def noise_of(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, "18"]:
    """Noise per channel: stated by the vehicle, else estimated from the logs; NaN: unmeasured.

    Raises `InputError` where nothing that was measured can be weighed.
    """
    return median_noise(noises_of(vehicle, logs), [log.name for log in logs])


def noises_of(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, "logs 18"]:
    """Noise per log and channel."""
    return np.array([sensor_noise(log, dict(vehicle.sensors)) for log in logs])


def median_noise(noises: Float[np.ndarray, "logs 18"], logs: Sequence[str]) -> Float[np.ndarray, "18"]:
    """Noise per channel from that of logs with these names; raises `InputError` where there is none."""
    out = np.full(noises.shape[1], np.nan)
    seen = np.isfinite(noises).any(axis=0)
    out[seen] = np.nanmedian(noises[:, seen], axis=0)
    if not seen.any():
        names = ", ".join(logs)
        raise InputError(f"{names}: no measured channel ever changes; use a log in which the vehicle moves.")
    return out
