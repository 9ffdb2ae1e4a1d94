"""How far each channel is trusted by what its samples alone show."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .._errors import InputError
from .._types import ALL_CHANNELS, CHANNEL_UNITS
from ..logs import Log, alike, sensor_noise
from ..vehicle import Vehicle

# A channel that is missed by so many times its noise is told: the noise itself is known to a factor of three.
_FAR = 3.0


def noise_of(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, " channels"]:
    """Noise per channel: stated by the vehicle, else estimated from the logs; NaN: unmeasured.

    Raises `InputError` where nothing that was measured can be weighed.
    """
    return median_noise(noises_of(vehicle, logs), [log.name for log in logs])


def noises_of(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, "logs channels"]:
    """Noise per log and channel."""
    return np.array([sensor_noise(log, dict(vehicle.sensors)) for log in alike(logs)])


def median_noise(
    noises: Float[np.ndarray, "logs channels"], logs: Sequence[str]
) -> Float[np.ndarray, " channels"]:
    """Noise per channel from that of logs with these names; raises `InputError` where there is none."""
    out = np.full(noises.shape[1], np.nan)
    seen = np.isfinite(noises).any(axis=0)
    out[seen] = np.nanmedian(noises[:, seen], axis=0)
    if not seen.any():
        names = ", ".join(logs)
        raise InputError(f"{names}: no measured channel ever changes; use a log in which the vehicle moves.")
    return out


def widened(noise: Float[np.ndarray, "*logs _"], width: int) -> Float[np.ndarray, "*logs channels"]:
    """Noise by channel of at least so many channels; NaN: unmeasured."""
    short = max(0, width - noise.shape[-1])
    return np.pad(noise, [(0, 0)] * (noise.ndim - 1) + [(0, short)], constant_values=np.nan)


def tell_missed(
    vehicle: Vehicle,
    logs: Sequence[str],
    left: Float[np.ndarray, " channels"],
    noise: Float[np.ndarray, " channels"],
    window: float,
) -> str | None:
    """A sentence on channels that the model misses by far more than their sensors' noise, if there are any.

    - `left`: root mean square error of the model over windows of this length [s], in units of `noise`.
    """
    far = np.flatnonzero(np.nan_to_num(left) > _FAR)
    if not far.size:
        return None
    stated = vehicle.states_noise(len(noise))
    errors = ", ".join(
        f"{ALL_CHANNELS[i]} by {left[i] * noise[i]:.2g} {CHANNEL_UNITS[ALL_CHANNELS[i]]} "
        f"({'stated' if stated[i] else 'jitter'} {noise[i]:.2g})"
        for i in far
    )
    names = logs[0] if len(logs) == 1 else f"{len(logs)} logs"
    return (
        f"{names}: over windows of {window:g} s the model misses {errors}; channels were weighed by what is "
        "missed, which is an error of the model rather than of the sensors."
    )
