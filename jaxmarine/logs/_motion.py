"""The motion with its uncertainty, from whatever subset of the channels was measured.

First the angles, then the position, as three signals whose third derivatives are white noise of one strength,
by the fixed-interval smoother of Rauch, Tung and Striebel (1965). What a sensor shows in body axes is a
combination of their slopes or curvatures that the attitude gives.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._types import DOFS
from ._euler import matrices_of
from ._kinematics import by_attitude, step
from ._log import Log
from ._noise import sensor_noise
from ._states import body_rates, reachable, smooth_states

# Strengths of the white noise that are tried, in units of the noise, two a decade.
_STRENGTHS = 10.0 ** np.arange(-10.0, 2.1, 0.5)
# Standard deviation before the first sample, in units of the noise and the time between samples: nothing is
# known. And that of what cannot move.
_UNKNOWN, _STILL = 1e4, 1e-4


class Motion(eqx.Module):
    """The motion at every sample, and standard deviations.

    - `t`: time [s].
    - `position`: of `o`, NED [m]; `attitude`: phi theta psi, unwrapped [rad].
    - `nu`: u v w p q r of `o`, body axes [m/s, rad/s]; `nu_dot`: their time derivatives [m/s², rad/s²].
    - `position_std`, `attitude_std`, `nu_std`, `nu_dot_std`: of the same, to first order; that of the
      attitude does not enter those of u v w.
    """

    t: Float[np.ndarray, " times"]
    position: Float[np.ndarray, "times 3"]
    attitude: Float[np.ndarray, "times 3"]
    nu: Float[np.ndarray, "times 6"]
    nu_dot: Float[np.ndarray, "times 6"]
    position_std: Float[np.ndarray, "times 3"]
    attitude_std: Float[np.ndarray, "times 3"]
    nu_std: Float[np.ndarray, "times 6"]
    nu_dot_std: Float[np.ndarray, "times 6"]


def smooth_motion(log: Log, dof: Sequence[str], noise: Float[np.ndarray, "18"] | None = None) -> Motion:
    """States and accelerations given all samples: positions alone, velocities alone, or any of the channels.

    - `noise`: standard deviation per channel, NaN for channels that are not to be used; default: estimated
      from the log.

    Positions and angles that were not measured begin at zero; velocities of which nothing is known have a
    large standard deviation. Looking ahead as far as back, the smoother gives a log played backwards the
    same motion played backwards.
    """
    noise = sensor_noise(log) if noise is None else noise
    free = np.isin(DOFS, list(dof))
    poses = np.append(reachable(free), free[3:])
    samples = np.where(np.isfinite(noise), log.channels, np.nan)
    # a first guess, good enough to turn small uncertain vectors by
    guess = smooth_states(log, dof)
    angles = samples[:, 3:6].copy()
    for column in angles.T:
        seen = np.isfinite(column)
        column[seen] = np.unwrap(column[seen])
    attitude_slope = np.gradient(guess.attitude, log.t, axis=0)
    rates = np.stack([body_rates(guess.attitude, np.tile(one, (len(log.t), 1))) for one in np.eye(3)], axis=2)
    turning = by_attitude(guess.attitude, attitude_slope)
    mean, covariance = _smoothed(
        log.t,
        np.concatenate([angles, samples[:, 9:12], samples[:, 15:18] - turning], axis=1),
        noise[[3, 4, 5, 9, 10, 11, 15, 16, 17]],
        rates,
        poses[3:],
        free[3:],
    )
    attitude, slope, bend = np.split(mean, 3, axis=1)
    p, dp = body_rates(attitude, slope), body_rates(attitude, bend) + by_attitude(attitude, slope)
    p_std, dp_std = _turned_std(rates, covariance)

    turn = np.swapaxes(matrices_of(attitude), 1, 2)
    carried = np.cross(p, guess.nu[:, :3])
    moved, spread = _smoothed(
        log.t,
        np.concatenate([samples[:, :3], samples[:, 6:9], samples[:, 12:15] + carried], axis=1),
        noise[[0, 1, 2, 6, 7, 8, 12, 13, 14]],
        turn,
        poses[:3],
        free[:3],
    )
    position, velocity, pushed = np.split(moved, 3, axis=1)
    u = np.einsum("tij,tj->ti", turn, velocity)
    # d/dt (R' p') = R' p'' - w x R' p'
    du = np.einsum("tij,tj->ti", turn, pushed) - np.cross(p, u)
    u_std, du_std = _turned_std(turn, spread)
    return Motion(
        t=log.t,
        position=position,
        attitude=attitude,
        nu=np.concatenate([u, p], axis=1) * free,
        nu_dot=np.concatenate([du, dp], axis=1) * free,
        position_std=_std(spread)[:, :3],
        attitude_std=_std(covariance)[:, :3],
        nu_std=np.concatenate([u_std, p_std], axis=1) * free,
        nu_dot_std=np.concatenate([du_std, dp_std], axis=1) * free,
    )


def _std(covariance: Float[np.ndarray, "times n n"]) -> Float[np.ndarray, "times n"]:
    return np.sqrt(np.maximum(np.einsum("tii->ti", covariance), 0.0))


def _turned_std(rows: Float[np.ndarray, "times 3 3"], covariance: Float[np.ndarray, "times 9 9"]):
    """Standard deviations of slopes and of curvatures in body axes."""
    parts = [covariance[:, one, one] for one in (slice(3, 6), slice(6, 9))]
    return [_std(rows @ part @ np.swapaxes(rows, 1, 2)) for part in parts]


def _smoothed(
    t: Float[np.ndarray, " times"],
    samples: Float[np.ndarray, "times 9"],
    noise: Float[np.ndarray, "9"],
    rows: Float[np.ndarray, "times 3 3"],
    moves: Bool[np.ndarray, "3"],
    free: Bool[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "times 9"], Float[np.ndarray, "times 9 9"]]:
    """Mean and covariance of three values, their slopes and their curvatures, given all samples.

    - `samples`: of the values, and of `rows` times the slopes and times the curvatures; NaN where missing.
    - `moves`: which values can change; `free`: which rows of the slopes are not zero.
    """
    unit = float(np.median(np.diff(t)))
    steps = np.diff(t) / unit
    times = np.repeat(unit ** np.arange(3), 3)
    known = np.where(np.isfinite(noise), noise, np.inf) * times
    size = float(known.min()) if np.isfinite(known).any() else 1.0
    std = np.where(np.isfinite(known), known / size, 1.0)
    seen = np.isfinite(samples[:, :3]).any(axis=0)
    first = np.zeros(9)
    for i in np.flatnonzero(seen):
        first[i] = samples[np.isfinite(samples[:, i]), i][0]
    scaled = (samples * times - first) / size
    # what is locked is measured all the time, as zero
    locked = ~np.concatenate([moves | seen, free, free])
    scaled[:, locked], std[locked] = 0.0, _STILL
    observed = np.zeros((len(t), 9, 9))
    observed[:, :3, :3], observed[:, 3:6, 3:6], observed[:, 6:, 6:] = np.eye(3), rows, rows
    begin = np.where(np.append(seen, np.ones(6, bool)), _UNKNOWN, _STILL) ** 2
    likelihood, _ = _forward(steps, scaled, std, observed, begin, _STRENGTHS)
    best = _STRENGTHS[[np.argmax(likelihood)]]
    _, filtered = _forward(steps, scaled, std, observed, begin, best)
    mean, covariance = _backward(steps, filtered, best)
    back = size / times
    return mean * back + first, covariance * back[:, None] * back


def _step(length: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition of values, slopes and curvatures over a step, and the covariance that it adds."""
    forward, added = step(length)
    return np.kron(forward, np.eye(3)), np.kron(added, np.eye(3))


def _forward(steps, samples, std, rows, begin, strengths):
    """Kalman filter: log-likelihood [strengths], and mean and covariance at each sample."""
    count = len(strengths)
    mean, covariance = np.zeros((count, 9)), np.tile(np.diag(begin), (count, 1, 1))
    likelihood, filtered = np.zeros(count), []
    for k, now in enumerate(samples):
        if k:
            forward, added = _step(steps[k - 1])
            mean = mean @ forward.T
            covariance = forward @ covariance @ forward.T + strengths[:, None, None] * added
        for i in np.flatnonzero(np.isfinite(now)):
            row = rows[k, i]
            along = covariance @ row
            spread = along @ row + std[i] ** 2
            surprise = now[i] - mean @ row
            likelihood = likelihood - 0.5 * (surprise**2 / spread + np.log(spread))
            mean = mean + along * (surprise / spread)[:, None]
            covariance = covariance - along[:, :, None] * along[:, None, :] / spread[:, None, None]
        filtered.append((mean, covariance))
    return likelihood, filtered


def _backward(steps, filtered, strengths):
    """Means and covariances given all samples, of one strength."""
    mean, covariance = filtered[-1][0][0], filtered[-1][1][0]
    means, covariances = [mean], [covariance]
    for length, (now, spread) in zip(steps[::-1], filtered[-2::-1], strict=True):
        forward, added = _step(length)
        ahead = forward @ spread[0] @ forward.T + strengths[0] * added
        gain = np.linalg.solve(ahead, forward @ spread[0]).T
        mean = now[0] + gain @ (mean - forward @ now[0])
        covariance = spread[0] + gain @ (covariance - ahead) @ gain.T
        means.append(mean)
        covariances.append(0.5 * (covariance + covariance.T))
    return np.array(means[::-1]), np.array(covariances[::-1])
