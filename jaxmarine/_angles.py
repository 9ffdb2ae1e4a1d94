"""Angles: which channels are angles, and how they differ."""

from typing import TypeVar

import numpy as np
from jaxtyping import Array

from ._types import ALL_CHANNELS, ATTITUDE

ANGLES = np.array([name in ATTITUDE for name in ALL_CHANNELS])

Angle = TypeVar("Angle", Array, np.ndarray)


def wrap_to_pi(angle: Angle) -> Angle:
    """The same angle within [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi  # pyrefly: ignore[bad-return]
