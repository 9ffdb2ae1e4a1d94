"""Smoothed motion from subsets of the channels: against the truth, dense least squares, and backwards."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmarine._types import CHANNELS, DOFS, SENSORS
from jaxmarine.logs import Log, _motion, doubtful_noise, smooth_motion
from jaxmarine.logs._euler import matrices_of, quaternions_of, turns_of
from jaxmarine.logs._states import body_rates
from jaxmarine.physics import from_euler

DT, FINE = 0.1, 20
NOISE = np.repeat([0.02, 0.005, 0.02, 0.01, 0.05, 0.05], 3)


def truth() -> tuple[np.ndarray, np.ndarray]:
    """Times, and all channels of a smooth motion of six axes that begins at zero; by fine differences."""
    t = np.arange(0.0, 40.0, DT / FINE)
    speeds, sizes = np.array([0.5, 0.7, 0.9, 0.8, 0.6, 0.4]), np.array([3, 2, 1, 0.3, 0.3, 1.5])
    pose = sizes * np.sin(speeds * t[:, None])
    slope = np.gradient(pose, t, axis=0, edge_order=2)
    nu = np.concatenate(
        [
            np.einsum("tji,tj->ti", turns_of(pose[:, 3:]).as_matrix(), slope[:, :3]),
            body_rates(pose[:, 3:], slope[:, 3:]),
        ],
        axis=1,
    )
    nu_dot = np.gradient(nu, t, axis=0, edge_order=2)
    return t[::FINE], np.concatenate([pose, nu, nu_dot], axis=1)[::FINE]


TIMES, TRUE = truth()


def log_with(kinds: str, seed: int = 0) -> Log:
    """The noisy channels whose names are given."""
    values = TRUE + NOISE * np.random.default_rng(seed).normal(size=TRUE.shape)
    values[:, ~np.isin(CHANNELS, kinds.split())] = np.nan
    return Log(TIMES, values, np.zeros((len(TIMES), 1)), None, ("main",), "log")


POSE, VELOCITY = "x y z phi theta psi", "u v w p q r"


@pytest.mark.parametrize(
    "kinds",
    [POSE, VELOCITY, f"{POSE} {VELOCITY}", f"{POSE} u v w", "phi theta psi z u v", f"{VELOCITY} du dv dw"],
)
def test_errors_are_as_large_as_their_standard_deviations(kinds):
    motion = smooth_motion(log_with(kinds), DOFS, NOISE)
    for name, part in (("position", slice(0, 3)), ("attitude", slice(3, 6)), ("nu", slice(6, 12))):
        error = getattr(motion, name) - TRUE[:, part]
        ratio = error / getattr(motion, f"{name}_std")
        if name == "position" and "x" not in kinds.split():
            # integrated errors are one long wander, whose size is one draw
            assert np.sqrt(np.mean(ratio**2)) < 3.0
        else:
            assert 0.4 < np.sqrt(np.mean(ratio**2)) < 1.6, name
    assert (motion.nu_std < 0.3 * TRUE[:, 6:12].std(axis=0)).all()
    inner = slice(20, -20)  # an end has no other side
    assert 0.3 < np.sqrt(np.mean(((motion.nu_dot - TRUE[:, 12:]) / motion.nu_dot_std)[inner] ** 2)) < 1.6


def test_more_sensors_leave_less_uncertainty():
    alone, both = (smooth_motion(log_with(kinds), DOFS, NOISE) for kinds in (POSE, f"{POSE} {VELOCITY}"))
    inner = slice(20, -20)
    assert (both.nu_std[inner] < alone.nu_std[inner]).mean() > 0.99
    error = [np.abs(one.nu - TRUE[:, 6:12])[inner].mean() for one in (alone, both)]
    assert error[1] < 0.8 * error[0]


@pytest.mark.parametrize("kinds", [POSE, f"{POSE} u v w", f"{POSE} {VELOCITY}"])
def test_a_log_played_backwards_gives_the_motion_played_backwards(kinds):
    log = log_with(kinds)
    sign = np.repeat([1.0, -1.0, 1.0], 6)
    back = dataclasses.replace(log, t=-log.t[::-1], channels=(sign * log.channels)[::-1])
    one, two = (smooth_motion(each, DOFS, NOISE) for each in (log, back))
    for name, turned in (("position", 1.0), ("attitude", 1.0), ("nu", -1.0), ("nu_dot", 1.0)):
        std = getattr(one, f"{name}_std")
        # the filter begins with a large variance instead of none, on one side
        assert np.abs(getattr(one, name) - turned * getattr(two, name)[::-1]).max() < 1e-2 * std.min(), name
        assert np.allclose(std, getattr(two, f"{name}_std")[::-1], rtol=1e-3), name


def test_it_is_the_least_squares_of_its_model(monkeypatch):
    """Heave alone, dense, with the covariance of a step by quadrature; uneven sampling and gaps."""
    monkeypatch.setattr(_motion, "_STRENGTHS", np.array([1e-3]))
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.15, 30))
    noise = np.full(18, np.nan)
    places = [CHANNELS.index(name) for name in ("z", "w", "dw")]
    noise[places] = 0.02, 0.03, 0.1
    values = np.full((30, 18), np.nan)
    values[:, places] = rng.normal(size=(30, 3))
    values[12:16, places[0]] = values[5:9, places[1]] = values[::2, places[2]] = np.nan
    motion = smooth_motion(Log(t, values, np.zeros((30, 1)), None, ("main",), "log"), ("heave",), noise)

    unit = float(np.median(np.diff(t)))
    white = 1e-3 * np.min(noise[places] * unit ** np.arange(3)) ** 2 / unit**5  # of the third derivative
    rows, right = [], []
    for k, i in np.argwhere(np.isfinite(values[:, places])):
        row = np.zeros(90)
        row[3 * k + i] = 1 / noise[places][i]
        rows.append(row)
        right.append(values[k, places][i] / noise[places][i])
    nodes, weights = np.polynomial.legendre.leggauss(6)
    for k, h in enumerate(np.diff(t)):
        forward = np.array([[1, h, h**2 / 2], [0, 1, h], [0, 0, 1]])
        past = h * (nodes + 1) / 2
        kicks = np.stack([past**2 / 2, past, np.ones(6)])
        whitened = np.linalg.inv(np.linalg.cholesky(white * (kicks * weights * h / 2) @ kicks.T))
        block = np.zeros((3, 90))
        block[:, 3 * k : 3 * k + 3], block[:, 3 * k + 3 : 3 * k + 6] = -whitened @ forward, whitened
        rows.extend(block)
        right.extend([0.0, 0.0, 0.0])
    rows = np.array(rows)
    states = np.linalg.lstsq(rows, np.array(right), rcond=None)[0].reshape(30, 3)
    std = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))).reshape(30, 3)
    got = np.stack([motion.position[:, 2], motion.nu[:, 2], motion.nu_dot[:, 2]], axis=1)
    got_std = np.stack([motion.position_std[:, 2], motion.nu_std[:, 2], motion.nu_dot_std[:, 2]], axis=1)
    # a millionth of it is the variance with which the filter begins, the rest what rounding of the dense one
    assert np.abs(got - states).max() < 1e-3 * std.min()
    assert np.allclose(got_std, std, rtol=1e-3)


def test_stated_noise_is_checked():
    log = log_with(f"{POSE} {VELOCITY}")
    stated = {kind: float(NOISE[CHANNELS.index(names[0])]) for kind, names in SENSORS.items()}
    assert doubtful_noise(log, stated) == []
    for factor in (0.2, 5.0):
        (note,) = doubtful_noise(log, stated | {"velocity": factor * stated["velocity"]})
        assert note.startswith("log: the samples of velocity scatter by about 0.0") and "[sensors]" in note


def test_attitudes_of_many_samples_are_those_one_by_one():
    """Matrices by their formula as scipy's; quaternions as the simulation's, with their sign."""
    angles = np.random.default_rng(0).normal(scale=5.0, size=(50, 3))
    np.testing.assert_allclose(matrices_of(angles), turns_of(angles).as_matrix(), atol=1e-14)
    each = [from_euler(jnp.asarray(one)) for one in angles]
    np.testing.assert_allclose(quaternions_of(angles), each, atol=1e-6)
    assert matrices_of(angles.reshape(5, 10, 3)).shape == (5, 10, 3, 3)
