"""Attitudes as roll, pitch and yaw, and as rotations that can be composed."""

import warnings

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def turns_of(angles: Float[np.ndarray, "*times 3"]) -> Rotation:
    """Rotations from body to world axes of phi theta psi [rad], ZYX."""
    return Rotation.from_euler("ZYX", angles[..., ::-1])


def angles_of(turns: Rotation) -> Float[np.ndarray, "*times 3"]:
    """phi theta psi [rad] of rotations from body to world axes."""
    with warnings.catch_warnings():
        # at a pitch of 90 degrees roll is set to zero, which is as good as any
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        return turns.as_euler("ZYX")[..., ::-1]
