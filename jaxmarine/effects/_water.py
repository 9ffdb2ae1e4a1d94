"""Stage water: how the water itself moves."""

from typing import Self

import jax.numpy as jnp

from .._types import Scalar, Vector3
from ._base import Craft, Suspect, WaterEffect, free, scalar


class SteadyCurrent(WaterEffect):
    """The water moves with a constant velocity in earth axes. Neutral: still water.

    It enters through the relative velocity and its time derivative in body axes, which is
    `-w x R' v_c` for a constant `v_c`. Source: after Fossen (2021).
    """

    name = "steady_current"
    units = {"north": "m/s", "east": "m/s", "down": "m/s"}
    confused_with = ("constant_wrench", "velocity_scale")
    shown_by = "the same manoeuvre on several headings"
    advice = "a steady current: nothing to mend, but plan and control have to know of it"

    north: Scalar
    east: Scalar
    down: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        slots = {"north": (0,), "east": (1,)}
        if free(craft, "heave"):
            slots["down"] = (2,)
        return (Suspect(cls, None, slots),) if free(craft, "surge", "sway") else ()

    def __call__(self) -> Vector3:
        return jnp.stack([self.north, self.east, self.down])
