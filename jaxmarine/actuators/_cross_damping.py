"""Quadratic damping of one axis by the motion of two."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._files import did_you_mean
from .._tables import Number, Table
from .._types import DOFS, Wrench
from ._base import AbstractHull, Flow


def _dof(value: Any) -> str:
    if value not in DOFS:
        raise ValueError(f"is {value!r:.60}, which is no degree of freedom; {did_you_mean(str(value), DOFS)}")
    return value


_Dof = Annotated[str, pydantic.BeforeValidator(_dof)]


class CrossDampingTable(Table):
    """One coefficient of quadratic damping: the force on an axis by the size of a velocity times another."""

    axis: _Dof = Field(description="the degree of freedom that is braked, in quotes")
    size: _Dof = Field(description="that whose velocity counts by its size, in quotes")
    velocity: _Dof = Field(description="that whose velocity counts with its sign, in quotes")
    value: Number = Field(description="a number, positive where it opposes that velocity")

    @property
    def name(self) -> str:
        """`sway<-|yaw|sway` for Y = -value |r| v."""
        return f"{self.axis}<-|{self.size}|{self.velocity}"


class CrossDamping(AbstractHull):
    r"""$\tau_i = -d\, |\nu_j|\, \nu_k$ of the velocity through the water, a term per table. No column.

    Of a ship these are $Y_{|r|v}$, $Y_{|v|r}$, $N_{|r|v}$, $N_{|v|r}$, of a torpedo also those of heave and
    pitch, with the positive sign of damping. Units: N or N m, by m/s or rad/s of either velocity. Those with
    j = k are in `damping.quadratic`. A term between axes may feed energy, which others must take.

    Source: after Fossen (2021), on nonlinear damping of ships, and Skjetne, Fossen and Kokotovic (2004).
    """

    key: ClassVar[str] = "cross_damping"
    title: ClassVar[str] = "Damping between axes"
    table: ClassVar[type[Table]] = CrossDampingTable
    told: ClassVar[tuple[str, ...]] = ("value",)

    value: Float[Array, " terms"]
    names: tuple[str, ...] = eqx.field(static=True)
    # Of each term the axis that is braked, that of the size, and that of the velocity.
    places: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        return cls(
            value=jnp.array([one.value for one in tables], float),
            names=tuple(one.name for one in tables),
            places=tuple(
                (DOFS.index(one.axis), DOFS.index(one.size), DOFS.index(one.velocity)) for one in tables
            ),
        )

    def tables(self) -> list[dict[str, Any]]:
        keys = ("axis", "size", "velocity")
        return [
            {key: DOFS[i] for key, i in zip(keys, those, strict=True)} | {"value": float(value)}
            for those, value in zip(self.places, self.value, strict=True)
        ]

    def typical(self, braking: Float[np.ndarray, "6"]) -> Mapping[str, np.ndarray]:
        """The geometric mean of the three axes' own damping, which has a term's unit."""
        return {"value": np.cbrt(braking[np.array(self.places)].prod(axis=1))}

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        del state
        axis, size, velocity = np.array(self.places).T
        braking = self.value * jnp.abs(flow.nu_r[size]) * flow.nu_r[velocity]
        return -(np.eye(6)[axis] * braking[:, None]).sum(0)
