"""A best guess of the whole motion at every sample, to start simulations from."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._types import ALL_CHANNELS, ATTITUDE, DOFS, MOTION, POSES, STATE
from ._euler import angles_of, matrices_of, turns_of
from ._log import Log

# Half the width of the smoothing window: long enough to tame differentiated positions, short
# against the motion of small craft.
_HALF_WIDTH = 0.25  # [s]
_HALF_SAMPLES = (2, 25)
# A measured velocity counts this much more than one from differentiated positions.
_MEASURED_WEIGHT = 1e6


class StateTrack(eqx.Module):
    """Position, attitude and velocity at every sample, all finite.

    - `t`: time [s].
    - `position`: of `o`, NED [m]; `attitude`: phi theta psi, unwrapped [rad].
    - `nu`: u v w p q r of `o`, body axes [m/s, rad/s].
    """

    t: Float[np.ndarray, " times"]
    position: Float[np.ndarray, "times 3"]
    attitude: Float[np.ndarray, "times 3"]
    nu: Float[np.ndarray, "times 6"]


def smooth_states(log: Log, dof: Sequence[str]) -> StateTrack:
    """The motion from whatever was measured: sane, not optimal.

    Measured channels are interpolated over gaps and smoothed by a symmetric local polynomial.
    Velocities that were not measured come from the slope of position and attitude; positions and
    attitudes that were not measured come from integrated velocities and start at zero. Locked
    degrees of freedom are zero.
    """
    free = np.isin(DOFS, list(dof))
    half = int(np.clip(round(_HALF_WIDTH / log.dt), *_HALF_SAMPLES))
    value = np.zeros((len(log.t), STATE.stop))
    slope = np.zeros((len(log.t), STATE.stop))
    seen = np.isin(ALL_CHANNELS[STATE], log.measured)
    for index in np.flatnonzero(seen):
        is_angle = ALL_CHANNELS[index] in ATTITUDE
        samples = _without_gaps(log.t, log.channels[:, index], is_angle)
        value[:, index], slope[:, index] = _local_polynomial(log.t, samples, half)
    pose_free = np.append(reachable(free), free[3:])
    value[:, POSES] *= pose_free
    slope[:, POSES] *= pose_free
    value[:, MOTION] *= free
    known_pose = np.logical_or(seen[POSES], ~pose_free)
    known_nu = np.logical_or(seen[MOTION], ~free)

    attitude = _attitude(log.t, value[:, 3:6], value[:, 9:12], known_pose[3:])
    slope[:, 3:6] = np.where(known_pose[3:], slope[:, 3:6], np.gradient(attitude, log.t, axis=0))
    rates = np.where(known_nu[3:], value[:, 9:12], body_rates(attitude, slope[:, 3:6]))
    turn = matrices_of(attitude)
    velocity = _body_velocity(turn, value[:, 6:9], slope[:, :3], known_nu[:3], known_pose[:3])
    travelled = _integral(log.t, np.einsum("tij,tj->ti", turn, velocity))
    position = np.where(known_pose[:3], value[:, :3], travelled * pose_free[:3])
    return StateTrack(
        t=log.t,
        position=position,
        attitude=attitude,
        nu=np.concatenate([velocity, rates], axis=1) * free,
    )


def reachable(free: np.ndarray) -> np.ndarray:
    """Which of north, east and down can change: a boat with surge and yaw goes east as well."""
    surge, sway, heave, roll, pitch, yaw = free
    return np.array(
        [
            surge or (sway and yaw) or (heave and pitch),
            sway or (surge and yaw) or (heave and roll),
            heave or (surge and pitch) or (sway and roll),
        ]
    )


def _without_gaps(t: np.ndarray, values: np.ndarray, is_angle: bool) -> np.ndarray:
    finite = np.isfinite(values)
    samples = np.unwrap(values[finite]) if is_angle else values[finite]
    return np.interp(t, t[finite], samples)


def _local_polynomial(t: np.ndarray, y: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
    """Value and slope of parabolas fitted to 2 * half + 1 neighbours of each sample.

    At the ends of the log the neighbourhood stays whole and the fit is evaluated off its middle.
    """
    span = min(2 * half + 1, len(t))
    first = np.clip(np.arange(len(t)) - half, 0, len(t) - span)
    index = first[:, None] + np.arange(span)
    scale = np.maximum(t[index[:, -1]] - t[index[:, 0]], np.finfo(float).tiny)
    powers = min(3, span)
    basis = ((t[index] - t[:, None]) / scale[:, None])[:, :, None] ** np.arange(powers)
    # QR keeps digits that normal equations would lose where samples are unevenly spaced
    q, r = np.linalg.qr(basis)
    fit = np.linalg.solve(r, np.einsum("tij,ti->tj", q, y[index])[:, :, None])[:, :, 0]
    return fit[:, 0], fit[:, 1] / scale


def _attitude(t: np.ndarray, measured: np.ndarray, rates: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Euler angles [T,3]; unknown ones from integrated rates, starting at zero."""
    if known.all():
        return measured
    attitude = measured.copy()
    # Rotations are composed, as summed Euler rates would blow up at a pitch of 90 degrees.
    turning = np.diff(t)[:, None] * (rates[1:] + rates[:-1]) / 2
    turn = turns_of(attitude[0])
    for k, step in enumerate(Rotation.from_rotvec(turning), start=1):
        turn = turn * step
        attitude[k] = np.where(known, measured[k], angles_of(turn))
        if known.any():
            turn = turns_of(attitude[k])
    return np.unwrap(attitude, axis=0)


def body_rates(attitude: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """p q r [T,3] of the time derivatives of phi theta psi."""
    (phi, theta, _), (dphi, dtheta, dpsi) = attitude.T, slope.T
    return np.stack(
        [
            dphi - dpsi * np.sin(theta),
            dtheta * np.cos(phi) + dpsi * np.cos(theta) * np.sin(phi),
            -dtheta * np.sin(phi) + dpsi * np.cos(theta) * np.cos(phi),
        ],
        axis=1,
    )


def _body_velocity(
    turn: np.ndarray,
    measured: np.ndarray,
    slope: np.ndarray,
    known_velocity: np.ndarray,
    known_position: np.ndarray,
) -> np.ndarray:
    """u v w [T,3] that agree with what is known of them and of the position's slope.

    Least squares at each sample, as a log may hold depth and u v, say, but not w. What nothing
    determines is held at zero by a weak pull.
    """
    weight = _MEASURED_WEIGHT * known_velocity + 1e-9
    seen = turn * known_position[:, None]  # rows of the rotation whose position is known
    normal = np.einsum("tij,tik->tjk", seen, seen) + np.diag(weight)
    right = np.einsum("tij,ti->tj", seen, slope) + _MEASURED_WEIGHT * known_velocity * measured
    return np.linalg.solve(normal, right[:, :, None])[:, :, 0]


def _integral(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    steps = np.diff(t)[:, None] * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)])
