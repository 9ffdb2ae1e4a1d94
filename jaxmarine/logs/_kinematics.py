"""Velocities and accelerations from measured positions and attitudes alone, without phase error.

Each channel is smoothed as a signal whose third derivative is white noise, by the fixed-interval smoother of
Rauch, Tung and Striebel (1965). It looks ahead as far as back, so that in the middle of a log value, slope
and curvature are in phase with the signal at every frequency. A causal filter lags.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._errors import InputError
from .._types import ALL_CHANNELS, ATTITUDE
from ._craft import free_poses
from ._euler import matrices_of
from ._log import Log
from ._states import body_rates

# Strengths of the white noise that are tried, in units of noise² / dt^5, three a decade: the band that the
# smoother passes goes with the sixth root of the strength, so a step widens it by an eighth.
_STRENGTHS = 10.0 ** np.arange(-10.0, 1.1, 1 / 3)
# The covariance of value, slope and curvature after one unit of time, for a strength of one.
_SPREAD = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
# Variance before the first sample, in units of noise² and dt: nothing is known then.
_UNKNOWN = 1e8


class Kinematics(eqx.Module):
    """The motion at every sample, from positions and attitudes.

    - `t`: time [s].
    - `position`: of `o`, NED [m]; `attitude`: phi theta psi, unwrapped [rad].
    - `nu`: u v w p q r of `o`, body axes [m/s, rad/s]; `nu_dot`: their time derivatives [m/s², rad/s²].
    """

    t: Float[np.ndarray, " times"]
    position: Float[np.ndarray, "times 3"]
    attitude: Float[np.ndarray, "times 3"]
    nu: Float[np.ndarray, "times 6"]
    nu_dot: Float[np.ndarray, "times 6"]


def differentiate(log: Log, dof: tuple[str, ...], noise: Float[np.ndarray, " channels"]) -> Kinematics:
    """The motion from the measured position and attitude of every free degree of freedom.

    - `noise`: standard deviation per channel, of which those of position and attitude are used.

    How fast a channel changes is found per channel, by the likelihood of its samples. Gaps are bridged.
    Raises `InputError` where a pose channel of a free degree of freedom was not measured.
    """
    wanted = free_poses(dof)
    missing = [name for name in wanted if name not in log.measured]
    if missing:
        raise InputError(
            f"{log.name}: has no `{missing[0]}`; without a speed sensor, velocities come from the position "
            "and attitude of every free degree of freedom."
        )
    places = np.array([ALL_CHANNELS.index(name) for name in wanted])
    samples = log.channels[:, places].copy()
    for column, name in zip(samples.T, wanted, strict=True):
        if name in ATTITUDE:
            seen = np.isfinite(column)
            column[seen] = np.unwrap(column[seen])
    value, slope, bend = np.zeros((3, len(log.t), 6))
    value[:, places], slope[:, places], bend[:, places] = smooth(log.t, samples, noise[places])

    attitude = value[:, 3:]
    turn = matrices_of(attitude)
    rates = body_rates(attitude, slope[:, 3:])
    velocity = np.einsum("tji,tj->ti", turn, slope[:, :3])
    # d/dt (R' p') = R' p'' - w x R' p'; the rates are linear in the slopes of the angles.
    pushed = np.einsum("tji,tj->ti", turn, bend[:, :3]) - np.cross(rates, velocity)
    turned = body_rates(attitude, bend[:, 3:]) + by_attitude(attitude, slope[:, 3:])
    return Kinematics(
        t=log.t,
        position=value[:, :3],
        attitude=attitude,
        nu=np.concatenate([velocity, rates], axis=1),
        nu_dot=np.concatenate([pushed, turned], axis=1),
    )


def smooth(
    t: Float[np.ndarray, " times"],
    samples: Float[np.ndarray, "times channels"],
    noise: Float[np.ndarray, " channels"],
    strengths: Float[np.ndarray, " strengths"] = _STRENGTHS,
) -> Float[np.ndarray, "3 times channels"]:
    """Value, slope and curvature of noisy signals at each of their samples; NaN where none was taken.

    - `noise`: standard deviation of each channel's samples.
    - `strengths`: of the white noise, in units of noise² / dt^5; the most likely one is taken per channel.
    """
    unit = float(np.median(np.diff(t)))
    steps = np.diff(t) / unit
    first = np.array([column[np.isfinite(column)][0] for column in samples.T])
    scaled = (samples - first) / noise
    likelihood, _ = _forward(steps, scaled[:, :, None], strengths)
    best = strengths[np.argmax(likelihood, axis=1)][:, None]
    _, filtered = _forward(steps, scaled[:, :, None], best)
    states = np.moveaxis(_backward(steps, filtered)[:, :, 0], -1, 0) * noise
    states[0] += first
    return states / unit ** np.arange(3)[:, None, None]


def step(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition of value, slope and curvature over a step, and the covariance that it adds."""
    scale = length ** np.array([2.0, 1.0, 0.0])
    forward = np.array([[1.0, length, length**2 / 2], [0.0, 1.0, length], [0.0, 0.0, 1.0]])
    return forward, length * scale[:, None] * _SPREAD * scale


def _forward(steps: np.ndarray, samples: np.ndarray, strengths: np.ndarray):
    """Kalman filter with noise and time in their own units: log-likelihood [channels, strengths], and mean
    and covariance of the state at each sample."""
    shape = np.broadcast_shapes(samples.shape[1:], strengths.shape)
    mean, covariance = np.zeros((*shape, 3)), np.broadcast_to(_UNKNOWN * np.eye(3), (*shape, 3, 3))
    likelihood, filtered = np.zeros(shape), []
    for k, now in enumerate(samples):
        if k:
            forward, added = step(steps[k - 1])
            mean = mean @ forward.T
            covariance = forward @ covariance @ forward.T + strengths[..., None, None] * added
        seen = np.isfinite(now)
        surprise = np.where(seen, now, 0.0) - mean[..., 0] * seen
        spread = covariance[..., 0, 0] + 1.0
        gain = covariance[..., 0] / spread[..., None] * seen[..., None]
        likelihood = likelihood - 0.5 * seen * (surprise**2 / spread + np.log(spread))
        mean = mean + gain * surprise[..., None]
        covariance = covariance - gain[..., :, None] * covariance[..., :1, :]
        covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
        filtered.append((mean, covariance, strengths))
    return likelihood, filtered


def _backward(steps: np.ndarray, filtered: list) -> np.ndarray:
    """Means of the states given all samples [times, channels, strengths, 3]."""
    smoothed = [filtered[-1][0]]
    for length, (mean, covariance, strengths) in zip(steps[::-1], filtered[-2::-1], strict=True):
        forward, added = step(length)
        ahead = forward @ covariance @ forward.T + strengths[..., None, None] * added
        missed = (smoothed[-1] - mean @ forward.T)[..., None]
        smoothed.append(mean + (covariance @ forward.T @ np.linalg.solve(ahead, missed))[..., 0])
    return np.array(smoothed[::-1])


def by_attitude(
    attitude: Float[np.ndarray, "times 3"], slope: Float[np.ndarray, "times 3"]
) -> Float[np.ndarray, "times 3"]:
    """What p q r change by because the angles do, at constant rates of the angles [rad/s²]."""
    (phi, theta, _), (dphi, dtheta, dpsi) = attitude.T, slope.T
    sf, cf, st, ct = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta)
    return np.stack(
        [
            -dpsi * ct * dtheta,
            -dtheta * sf * dphi + dpsi * (ct * cf * dphi - st * sf * dtheta),
            -dtheta * cf * dphi - dpsi * (ct * sf * dphi + st * cf * dtheta),
        ],
        axis=1,
    )
