"""Velocities and accelerations from measured positions and attitudes alone, without phase error.

Each channel is smoothed as a signal whose third derivative is white noise. The whole log is solved at
once, which gives what the fixed-interval smoother of Rauch, Tung and Striebel (1965) gives: it looks ahead
as far as back, so that in the middle of a log value, slope and curvature are in phase with the signal at
every frequency. A causal filter lags.
"""

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Float

from .._errors import InputError
from .._types import ATTITUDE, CHANNELS
from ._craft import free_poses
from ._log import Log
from ._states import body_rates, rotations

# Strengths of the white noise that are tried, in units of noise² / dt^5, three a decade: the band that the
# smoother passes goes with the sixth root of the strength, so a step widens it by an eighth.
_STRENGTHS = 10.0 ** np.arange(-10.0, 1.1, 1 / 3)
# The covariance of value, slope and curvature after one unit of time, for a strength of one.
_SPREAD = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_BANDS = 6  # of the matrix to be factorised: two neighbouring blocks of three


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


def differentiate(log: Log, dof: tuple[str, ...], noise: Float[np.ndarray, "18"]) -> Kinematics:
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
    value, slope, bend = np.zeros((3, len(log.t), 6))
    for index, name in enumerate(CHANNELS[:6]):
        if name not in wanted:
            continue
        samples = log.channels[:, index].copy()
        if name in ATTITUDE:
            seen = np.isfinite(samples)
            samples[seen] = np.unwrap(samples[seen])
        value[:, index], slope[:, index], bend[:, index] = smooth(log.t, samples, float(noise[index]))

    attitude = value[:, 3:]
    turn = rotations(attitude)
    rates = body_rates(attitude, slope[:, 3:])
    velocity = np.einsum("tji,tj->ti", turn, slope[:, :3])
    # d/dt (R' p') = R' p'' - w x R' p'; the rates are linear in the slopes of the angles.
    pushed = np.einsum("tji,tj->ti", turn, bend[:, :3]) - np.cross(rates, velocity)
    turned = body_rates(attitude, bend[:, 3:]) + _by_attitude(attitude, slope[:, 3:])
    return Kinematics(
        t=log.t,
        position=value[:, :3],
        attitude=attitude,
        nu=np.concatenate([velocity, rates], axis=1),
        nu_dot=np.concatenate([pushed, turned], axis=1),
    )


def smooth(
    t: Float[np.ndarray, " times"], samples: Float[np.ndarray, " times"], noise: float
) -> Float[np.ndarray, "3 times"]:
    """Value, slope and curvature of a noisy signal at each of its samples; NaN where none was taken.

    - `noise`: standard deviation of the samples.
    """
    unit = float(np.median(np.diff(t)))
    problem = _Smoothing(np.diff(t) / unit, samples / noise)
    best = max((problem.solved(strength) for strength in _STRENGTHS), key=lambda s: s[0])
    return noise * best[1].T / unit ** np.arange(3)[:, None]


class _Smoothing:
    """Noise and time are one: min sum (y - x)² + sum |x_k+1 - F x_k|² / Q over all states x."""

    def __init__(self, steps: np.ndarray, samples: np.ndarray):
        self.seen = np.isfinite(samples)
        self.samples = np.where(self.seen, samples, 0.0)
        powers = steps[:, None] ** np.arange(3)
        forward = np.zeros((len(steps), 3, 3))
        for i in range(3):
            for j in range(i, 3):
                forward[:, i, j] = powers[:, j - i] / (1.0, 1.0, 2.0)[j - i]
        # Q over a step dt is S (dt _SPREAD) S with S = diag(dt², dt, 1).
        scale = powers[:, ::-1]
        precision = np.linalg.inv(_SPREAD) / (scale[:, :, None] * scale[:, None, :] * steps[:, None, None])
        self.diagonal = np.zeros((len(samples), 3, 3))
        self.diagonal[:-1] += np.swapaxes(forward, 1, 2) @ precision @ forward
        self.diagonal[1:] += precision
        self.below = -precision @ forward

    def solved(self, strength: float) -> tuple[float, np.ndarray]:
        """Log-likelihood of the samples up to a constant, and the states [times, 3]."""
        count = len(self.samples)
        diagonal = self.diagonal / strength
        diagonal[:, 0, 0] += self.seen
        bands = np.zeros((_BANDS, 3 * count))
        for i in range(3):
            for j in range(i + 1):
                bands[i - j, j::3] = diagonal[:, i, j]
            for j in range(3):
                bands[3 + i - j, j : 3 * (count - 1) : 3] = self.below[:, i, j] / strength
        right = np.zeros(3 * count)
        right[::3] = self.samples
        factor = scipy.linalg.cholesky_banded(bands, lower=True)
        states = scipy.linalg.cho_solve_banded((factor, True), right)
        cost = (self.samples**2).sum() - right @ states
        spread = 2.0 * np.log(factor[0]).sum() + 3.0 * (count - 1) * np.log(strength)
        return -0.5 * (cost + spread), states.reshape(count, 3)


def _by_attitude(
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
