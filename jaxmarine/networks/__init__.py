"""Learned terms inside the physics."""

from ._learned import (
    SIGNALS as SIGNALS,
    LearnedWrench as LearnedWrench,
    learned_wrench as learned_wrench,
    signals as signals,
    signals_known as signals_known,
)
from ._damping import MLPDamping as MLPDamping, mlp_damping as mlp_damping
