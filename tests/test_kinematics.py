"""Velocities from positions: against dense least squares, without phase, in body axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmarine as jm
from jaxmarine._errors import InputError
from jaxmarine._types import DOFS
from jaxmarine.logs import _kinematics as kinematics
from jaxmarine.logs import differentiate, smooth, smooth_states


def test_the_smoother_is_the_least_squares_of_its_model():
    """Dense, with the covariance of a step by quadrature; uneven sampling and a gap."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.15, 40))
    y = np.sin(2 * t) + 0.02 * rng.standard_normal(40)
    y[12:16] = np.nan
    noise, unit = 0.02, float(np.median(np.diff(t)))
    strength = 1e-3
    got = smooth(t, y[:, None], np.array([noise]), np.array([strength]))[:, :, 0]
    white = strength * noise**2 / unit**5  # of the third derivative, in SI units

    rows, right = [], []
    for k in range(40):
        if np.isfinite(y[k]):
            row = np.zeros(120)
            row[3 * k] = 1 / noise
            rows.append(row)
            right.append(y[k] / noise)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    for k, h in enumerate(np.diff(t)):
        forward = np.array([[1, h, h**2 / 2], [0, 1, h], [0, 0, 1]])
        past = h * (nodes + 1) / 2
        kicks = np.stack([past**2 / 2, past, np.ones(6)])
        covariance = white * (kicks * weights * h / 2) @ kicks.T
        whitened = np.linalg.inv(np.linalg.cholesky(covariance))
        block = np.zeros((3, 120))
        block[:, 3 * k : 3 * k + 3], block[:, 3 * k + 3 : 3 * k + 6] = -whitened @ forward, whitened
        rows.extend(block)
        right.extend([0.0, 0.0, 0.0])
    scale = np.tile([noise, noise / unit, noise / unit**2], 40)  # of like size, for the conditioning
    states = scale * np.linalg.lstsq(np.array(rows) * scale, np.array(right), rcond=None)[0]
    # The filter begins with a variance of 1e8 instead of none.
    assert np.allclose(got, states.reshape(40, 3).T, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("omega", [0.5, 1.5, 4.0])
def test_value_slope_and_curvature_are_in_phase_with_a_sinusoid(omega):
    t = np.arange(0.0, 60.0, 0.1)
    y = np.sin(omega * t)[:, None]
    strength = np.array([1e-4])
    found = smooth(t, y, np.array([0.02]), strength)[:, :, 0]
    middle = np.abs(t - 30.0) < 15.0
    basis = np.stack([np.sin(omega * t), np.cos(omega * t)], axis=1)[middle]

    def lag(signal, of):
        """Phase against sin or cos at that frequency [rad], and the gain."""
        s, c = np.linalg.lstsq(basis, signal[middle], rcond=None)[0]
        along, across = {"sin": (s, c), "cos": (c, -s)}[of]
        return np.arctan2(across, along), np.hypot(s, c)

    lags = [lag(found[0], "sin"), lag(found[1] / omega, "cos"), lag(-found[2] / omega**2, "sin")]
    # By symmetry zero, up to what reaches the middle from the ends.
    assert max(abs(phase) for phase, _ in lags) < 1e-6
    # Continuously sampled, the model's smoother passes 1 / (1 + (omega dt)^6 / strength).
    gains = [gain for _, gain in lags]
    assert np.allclose(gains, 1 / (1 + (0.1 * omega) ** 6 / strength), rtol=0.03)
    # The filter alone, which knows only the past, is late.
    _, filtered = kinematics._forward(np.ones(len(t) - 1), y[:, :, None] / 0.02, strength)
    causal = np.array([mean[0, 0] for mean, *_ in filtered]) * 0.02 / 0.1 ** np.arange(3)
    assert abs(lag(-causal[:, 2] / omega**2, "sin")[0]) > 0.05


def test_the_strength_fits_the_signal():
    """With 2 cm of noise the slope is far better than that of a fixed short window."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 30.0, 0.1)
    channels = np.full((len(t), 18), np.nan)
    channels[:, 0] = np.sin(0.8 * t) + 0.02 * rng.standard_normal(len(t))
    log = jm.Log(t, channels, np.zeros((len(t), 1)), None, ("main",), "log")
    noise = np.full(18, 0.02)
    motion = differentiate(log, ("surge",), noise)
    error = np.std(motion.nu[:, 0] - 0.8 * np.cos(0.8 * t))
    assert error < 0.02
    assert error < 0.4 * np.std(smooth_states(log, ("surge",)).nu[:, 0] - 0.8 * np.cos(0.8 * t))


def pose(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Some position and phi theta psi over time; the yaw passes half a turn."""
    position = np.stack([np.sin(0.7 * t), 0.5 * np.cos(0.9 * t), 0.3 * np.sin(0.5 * t + 1)], axis=1)
    angles = np.stack([0.4 * np.sin(0.6 * t), 0.5 * np.sin(0.8 * t + 2), 2.5 + 0.4 * t], axis=1)
    return position, angles


def in_body_axes(t: np.ndarray) -> np.ndarray:
    """u v w p q r by differences of positions and rotation matrices, with a step of 1e-4 s."""
    step = 1e-4

    def turn(t):
        return Rotation.from_euler("ZYX", pose(t)[1][:, ::-1]).as_matrix()

    now = turn(t)
    velocity = (pose(t + step)[0] - pose(t - step)[0]) / (2 * step)
    spin = np.swapaxes(now, 1, 2) @ (turn(t + step) - turn(t - step)) / (2 * step)
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    return np.concatenate([np.einsum("tji,tj->ti", now, velocity), rates], axis=1)


def test_velocities_and_accelerations_are_those_of_the_body():
    t = np.arange(0.0, 12.0, 0.05)
    position, angles = pose(t)
    channels = np.full((len(t), 18), np.nan)
    channels[:, :3] = position
    channels[:, 3:6] = (angles + np.pi) % (2 * np.pi) - np.pi
    channels[50:53, :6] = np.nan
    log = jm.Log(t, channels, np.zeros((len(t), 1)), None, ("main",), "log")
    motion = differentiate(log, DOFS, np.full(18, 1e-6))
    middle = (t > 1.0) & (t < 11.0)
    nu_dot = (in_body_axes(t + 1e-2) - in_body_axes(t - 1e-2)) / 2e-2
    # The smoother passes frequencies of 1 rad/s at 0.05 s with a bias of that size.
    assert np.abs(motion.nu - in_body_axes(t))[middle].max() < 1e-4
    assert np.abs(motion.nu_dot - nu_dot)[middle].max() < 2e-3


def test_a_pose_that_was_not_measured_is_asked_for():
    t = np.arange(0.0, 3.0, 0.1)
    channels = np.full((len(t), 18), np.nan)
    channels[:, 0] = t
    log = jm.Log(t, channels, np.zeros((len(t), 1)), None, ("main",), "log.csv")
    with pytest.raises(InputError, match=r"log\.csv: has no `psi`"):
        differentiate(log, ("surge", "yaw"), np.full(18, 0.1))
