"""What the samples of a smooth motion scatter by, and attitudes of many samples at once."""

import jax.numpy as jnp
import numpy as np

from jaxmarine._types import CHANNELS, SENSORS
from jaxmarine.logs import Log, doubtful_noise
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
