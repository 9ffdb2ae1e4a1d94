"""Forces of a hull as polynomials of drift and turn."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Table, finite
from .._types import Wrench
from ._base import AbstractHull, Flow

# A hull that turns about a point within it has a turn r L / U beyond any measured one. There the polynomials
# are those of this share of the turning speed r L.
_ON_THE_SPOT = 0.02
# Below this share of all speed a hull goes neither ahead nor astern, but aside.
_ASIDE = 0.03
_AXES = ("surge", "sway", "yaw")


def _so_many(count: int) -> pydantic.BeforeValidator:
    def checked(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != count:
            raise ValueError(f"must be a list of {count} numbers, but is {value!r:.60}.")
        return tuple(finite(entry) for entry in value)

    return pydantic.BeforeValidator(checked)


class HullPolynomialTable(Table):
    """Forces of the hull by drift and turn; without dimension and with their signs as they are printed."""

    length: Number = Field(gt=0, description="a positive number [m]")
    draft: Number = Field(gt=0, description="a positive number [m]")
    surge: Annotated[tuple[float, ...], _so_many(5)] = Field(
        description="5 numbers [R_0, X_vv, X_vr, X_rr, X_vvvv]"
    )
    sway: Annotated[tuple[float, ...], _so_many(6)] = Field(
        description="6 numbers [Y_v, Y_r, Y_vvv, Y_vvr, Y_vrr, Y_rrr]"
    )
    yaw: Annotated[tuple[float, ...], _so_many(6)] = Field(
        description="6 numbers [N_v, N_r, N_vvv, N_vvr, N_vrr, N_rrr]"
    )


class HullPolynomial(AbstractHull):
    r"""Polynomials of $v' = v / U$ and $r' = r L / U$, $U^2 = u^2 + v^2$, of the flow at `o`. No column.

    $X = \frac12 \rho L d U^2 (-R_0 + X_{vv} v'^2 + X_{vr} v' r' + X_{rr} r'^2 + X_{vvvv} v'^4)$,
    $Y = \frac12 \rho L d U^2 (Y_v v' + Y_r r' + Y_{vvv} v'^3 + Y_{vvr} v'^2 r' + Y_{vrr} v' r'^2
    + Y_{rrr} r'^3)$,
    N likewise with $L^2 d$, on the right-hand side. `o` is midship, as in the source. Published numbers of N
    hold the Munk moment, which the added mass brings here: a file takes that away by the effect `hull_lift`
    with `N_uv` the added mass in surge less that in sway.

    Polynomials speak of a ship under way. Astern the hull is its own mirror image, with a smooth change where
    it goes aside; where it turns on the spot, U counts as 0.02 r L; at rest force and slope are zero.

    After Yasukawa and Yoshimura (2015), J. Mar. Sci. Technol. 20, 37-52, on hull forces.
    """

    key: ClassVar[str] = "hull_polynomial"
    title: ClassVar[str] = "Polynomials of the hull"
    table: ClassVar[type[Table]] = HullPolynomialTable
    told: ClassVar[tuple[str, ...]] = ("surge", "sway", "yaw")
    single: ClassVar[bool] = True

    length: Float[Array, " one"]
    draft: Float[Array, " one"]
    surge: Float[Array, "5"]
    sway: Float[Array, "6"]
    yaw: Float[Array, "6"]
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        (table,) = tables
        one = {key: jnp.array([getattr(table, key)], float) for key in ("length", "draft")}
        several = {axis: jnp.array(getattr(table, axis), float) for axis in _AXES}
        return cls(**one, **several, names=("hull",))

    def tables(self) -> list[dict[str, Any]]:
        one = {key: float(getattr(self, key)[0]) for key in ("length", "draft")}
        return [one | {axis: tuple(np.asarray(getattr(self, axis)).tolist()) for axis in _AXES}]

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        del state
        u, v, turning = flow.nu_r[0], flow.nu_r[1], flow.nu_r[5] * self.length[0]
        squared = u**2 + v**2 + (_ON_THE_SPOT * turning) ** 2
        moving = squared > 0.0
        speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)
        safe = jnp.where(moving, speed, 1.0)
        # 1 ahead, -1 astern. The mirrored hull sees the turn, and gives surge and yaw, the other way round.
        ahead = jnp.tanh(u / (_ASIDE * safe))
        r = ahead * turning
        parts = jnp.stack([v * v, v * r, r * r, v * v * (v / safe) ** 2])
        cubic = jnp.stack([v**3, v * v * r, v * r * r, r**3]) / safe
        odd = jnp.concatenate([jnp.stack([v * speed, r * speed]), cubic])
        size = 0.5 * flow.density * self.length[0] * self.draft[0]
        x = ahead * ((self.surge[1:] * parts).sum() - self.surge[0] * (u**2 + v**2))
        y = (self.sway * odd).sum()
        n = self.length[0] * ahead * (self.yaw * odd).sum()
        zero = jnp.zeros_like(u)
        return size * jnp.stack([x, y, zero, zero, zero, n])
