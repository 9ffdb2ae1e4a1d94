"""How noisy each channel is, from the vehicle file or from the log alone."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from .._types import ALL_CHANNELS, ALL_SENSORS, ATTITUDE, CHANNEL_UNITS, JUMPS
from ._log import Log
from ._notes import Note

# Samples per divided difference: lines, cubics and quintics through the neighbours. The short one
# crosses few jumps, the long one follows fast motion; both can only err upwards.
_SPANS = (3, 5, 7)
_MIN_DIFFERENCES = 100
_MAD_TO_STD = 1.4826
# A sensor that claims to be finer than this part of the change between two samples, or than this
# number in SI units, would outweigh all others for no physical reason.
_FINEST_SHARE = 1e-3
_FINEST = 1e-6
# A stated noise is doubtful where the estimate, which sees fast motion as well, is off by this factor.
_DOUBTFUL = 3.0


def sensor_noise(
    log: Log, sensors: Mapping[str, float | None] | None = None
) -> Float[np.ndarray, " channels"]:
    """Standard deviation of the noise of each channel; NaN where nothing is measured.

    `sensors` holds what the vehicle file states per kind of sensor; other kinds are estimated. A
    channel that never changes, of a kind that is not stated, counts as not measured: nothing says how
    far to trust it.
    """
    noise = estimate_noise(log)
    measured = np.isfinite(log.channels).any(axis=0)
    for kind, std in (sensors or {}).items():
        if std is not None:
            noise[_of_kind(kind, len(noise)) & measured] = std
    return noise


def doubtful_noise(log: Log, sensors: Mapping[str, float | None]) -> list[Note]:
    """Sentences on sensors whose noise is not what the vehicle file states, by far more than chance."""
    notes = []
    estimated = estimate_noise(log)
    for kind, stated in sensors.items():
        found = estimated[_of_kind(kind, len(estimated))]
        if stated is None or not np.isfinite(found).any():
            continue
        noise = float(np.nanmedian(found))
        if not 1 / _DOUBTFUL < noise / stated < _DOUBTFUL:
            unit = CHANNEL_UNITS[ALL_SENSORS[kind][0]]
            said = (
                f"the samples of {kind} scatter by about {{noise:.2g}} {unit}, but the vehicle file states a "
                f"noise of {stated:.2g} {unit}, which is used; correct it under [sensors], or leave it out "
                "there to have it estimated."
            )
            notes.append(Note.of(log.name, "{log}: " + said, "{logs}: " + said, noise=noise))
    return notes


def _of_kind(kind: str, width: int) -> Bool[np.ndarray, " channels"]:
    """Which of the first so many channels a kind of sensor shows."""
    return np.isin(ALL_CHANNELS[:width], ALL_SENSORS[kind])


def estimate_noise(log: Log) -> Float[np.ndarray, " channels"]:
    """Standard deviation of what no smooth motion explains, per channel, NaN where unmeasured or constant.

    Each sample is compared with the polynomial through its neighbours. That residual is a divided
    difference of the samples, whose weights are known for any spacing, so that the noise follows
    by dividing by their norm. The median over the log is insensitive to jumps and outliers.
    Noise that is correlated from one sample to the next is only seen in part.
    """
    jumps = command_jumps(log)
    noise = np.full(log.channels.shape[1], np.nan)
    for index, name in enumerate(ALL_CHANNELS[: len(noise)]):
        finite = np.isfinite(log.channels[:, index])
        if not finite.any():
            continue
        values = log.channels[finite, index]
        if np.ptp(values) == 0:
            continue
        if name in ATTITUDE:
            values = np.unwrap(values)
        # accelerations jump with the commands; everything else is continuous
        jumping = jumps if JUMPS[index] else jumps[:0]
        noise[index] = _noise(log.t[finite], values, jumping)
    return noise


def _noise(t: np.ndarray, values: np.ndarray, jumps: np.ndarray) -> float:
    changes = np.diff(values)
    held = np.append(False, changes == 0)
    repeated = np.mean(held) > 0.5
    if repeated:
        # The sensor is slower than the log or coarse: only its own new values tell anything.
        t, values = t[~held], values[~held]
        changes = np.diff(values)
    if len(values) < max(_SPANS):
        return max(float(np.std(values)), _FINEST)
    floor = max(_FINEST, _FINEST_SHARE * float(np.median(np.abs(changes))), resolution(values))
    # With commands that change all the time no neighbourhood is without a jump.
    found = _difference_noises(t, values, jumps) or _difference_noises(t, values, jumps[:0])
    return max(floor, min(found))


def _difference_noises(t: np.ndarray, values: np.ndarray, jumps: np.ndarray) -> list[float]:
    """Noise by divided differences, for each span that has enough neighbourhoods without jumps."""
    noises = []
    for span in _SPANS:
        times = np.lib.stride_tricks.sliding_window_view(t, span)
        samples = np.lib.stride_tricks.sliding_window_view(values, span)
        length = times[:, -1] - times[:, 0]
        good = length <= 3 * np.median(length)  # a gap is no neighbourhood
        good &= np.searchsorted(jumps, times[:, -1]) == np.searchsorted(jumps, times[:, 0])
        if np.count_nonzero(good) >= (_MIN_DIFFERENCES if len(jumps) else 1):
            noises.append(_difference_noise(times[good], samples[good]))
    return noises


def _difference_noise(times: np.ndarray, samples: np.ndarray) -> float:
    """Noise from neighbourhoods [n, span], as the median size of their divided differences."""
    scaled = (times - times[:, :1]) / (times[:, -1:] - times[:, :1])
    apart = scaled[:, :, None] - scaled[:, None, :] + np.eye(times.shape[1])
    weights = 1 / np.prod(apart, axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    # the mean is taken out first, as large numbers would leave their rounding in the difference
    samples = samples - np.mean(samples, axis=1, keepdims=True)
    return _MAD_TO_STD * float(np.median(np.abs(np.sum(weights * samples, axis=1))))


def resolution(values: np.ndarray) -> float:
    """Rounding noise of a coarse sensor, step / sqrt(12); zero where the samples hardly repeat."""
    levels = np.unique(values)
    if len(levels) < 2 or len(levels) > len(values) / 2:
        return 0.0
    return float(np.median(np.diff(levels))) / np.sqrt(12)


def command_jumps(log: Log) -> np.ndarray:
    """Times just before the samples at which a command or the wrench is a new one [s]."""
    drive = log.commands if log.commands is not None else log.wrench
    assert drive is not None
    changed = np.flatnonzero(np.any(np.diff(drive, axis=0) != 0, axis=1))
    return (log.t[changed] + log.t[changed + 1]) / 2
