"""Drag of the hull ahead and astern, of any shape over the speed."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Numbers, Table
from .._types import Wrench
from ._base import AbstractHull, Flow


class SurgeDragTable(Table):
    """Drag in surge per speed, at several speeds; beside [damping]."""

    speed: Numbers = Field(description="a list of rising numbers [m/s], the first 0")
    drag: Numbers = Field(description="a list of as many numbers not below zero [N s/m]")

    @pydantic.field_validator("speed")
    @classmethod
    def _rises(cls, speed: tuple[float, ...]) -> tuple[float, ...]:
        if speed[0] != 0.0 or len(speed) < 2 or min(np.diff(speed)) <= 0.0:
            raise ValueError(f"is {list(speed)}, but must begin with 0 and rise.")
        return speed

    @pydantic.model_validator(mode="after")
    def _brakes(self) -> "SurgeDragTable":
        if len(self.drag) != len(self.speed) or min(self.drag) < 0.0:
            raise ValueError(
                f"`drag` must be {len(self.speed)} numbers not below zero, one for each `speed`."
            )
        return self


class SurgeDrag(AbstractHull):
    """X = -D(|u|) u, with D linear between the speeds of the table and constant beyond the last. No column.

    Source: wave resistance has humps and hollows over the Froude number, after Faltinsen (2005).
    """

    key: ClassVar[str] = "surge_drag"
    title: ClassVar[str] = "Drag ahead over the speed"
    table: ClassVar[type[Table]] = SurgeDragTable
    told: ClassVar[tuple[str, ...]] = ("drag",)
    positive: ClassVar[tuple[str, ...]] = ("drag",)
    single: ClassVar[bool] = True

    speed: Float[Array, " speeds"]
    drag: Float[Array, " speeds"]
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        (table,) = tables
        return cls(speed=jnp.array(table.speed), drag=jnp.array(table.drag), names=("surge_drag",))

    def tables(self) -> list[dict[str, Any]]:
        return [{key: tuple(np.asarray(getattr(self, key)).tolist()) for key in ("speed", "drag")}]

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        del state
        u = flow.nu_r[0]
        # How much of each step between two speeds is climbed: no search for a place, which some exports lack.
        climbed = jnp.clip((jnp.abs(u) - self.speed[:-1]) / jnp.diff(self.speed), 0.0, 1.0)
        drag = self.drag[0] + (jnp.diff(self.drag) * climbed).sum()
        return jnp.zeros(6).at[0].set(-drag * u)
