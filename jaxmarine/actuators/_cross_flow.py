"""Drag of the hull's sections across the flow."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Table
from .._types import Wrench
from ._base import AbstractHull, Flow

# Exact while the flow has one sign along the hull; where it turns within, off by a part in a hundred at most.
_AT, _WEIGHT = np.polynomial.legendre.leggauss(8)


class CrossFlowTable(Table):
    """Drag of the hull's sections, integrated over the length."""

    length: Number = Field(gt=0, description="a positive number [m], half of it ahead of `o`")
    draft: Number = Field(gt=0, description="a positive number [m]")
    coefficient: Number = Field(ge=0, description="a number not below zero")


class CrossFlow(AbstractHull):
    r"""Strip theory: $Y = -\frac12 \rho d C \int |v + x r| (v + x r) dx$, N with x inside. It has no column.

    Source: after Fossen (2021), on cross-flow drag, and Faltinsen (1990).
    """

    key: ClassVar[str] = "cross_flow"
    title: ClassVar[str] = "Drag across the flow"
    table: ClassVar[type[Table]] = CrossFlowTable
    told: ClassVar[tuple[str, ...]] = ("coefficient",)
    positive: ClassVar[tuple[str, ...]] = ("coefficient",)
    single: ClassVar[bool] = True

    length: Float[Array, " one"]
    draft: Float[Array, " one"]
    coefficient: Float[Array, " one"]
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        (table,) = tables
        numbers = {key: jnp.array([getattr(table, key)], float) for key in ("length", "draft", "coefficient")}
        return cls(**numbers, names=("cross_flow",))

    def tables(self) -> list[dict[str, Any]]:
        return [{key: float(getattr(self, key)[0]) for key in ("length", "draft", "coefficient")}]

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        del state
        x = 0.5 * self.length[0] * _AT
        across = flow.nu_r[1] + x * flow.nu_r[5]
        size = 0.25 * flow.density * self.draft[0] * self.length[0] * self.coefficient[0]
        drag = size * _WEIGHT * jnp.abs(across) * across
        zero = jnp.zeros_like(size)
        return -jnp.stack([zero, drag.sum(), zero, zero, zero, (x * drag).sum()])
