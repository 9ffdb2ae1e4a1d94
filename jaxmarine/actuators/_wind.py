"""Wind on what stands out of the water."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Numbers, Table, pair
from .._types import WIND, Wrench
from ..physics import Drive
from ._base import AbstractActuators, Flow, Stream, servo

# Of air at 15 °C [kg/m³].
_AIR = 1.225
# No wind is faster [m/s], and no direction is further round [rad].
_STORM, _TURNS = 100.0, 4 * np.pi


class WindTable(Table):
    """Forces of the wind by the apparent angle, from which it comes, clockwise from the bow."""

    frontal_area: Number = Field(gt=0, description="a positive number [m²]")
    lateral_area: Number = Field(gt=0, description="a positive number [m²]")
    length: Number = Field(gt=0, description="a positive number [m]")
    centre: Annotated[tuple[float, float], pydantic.BeforeValidator(pair)] = Field(
        default=(0.0, 0.0), description="[x, z] of the wind's centre from `o` [m]"
    )
    surge: Numbers = Field(description="a list of numbers, C_X = sum a_k cos k g")
    sway: Numbers = Field(description="a list of numbers, C_Y = sum b_k sin k g")
    yaw: Numbers = Field(default=(0.0,), description="a list of numbers, C_N = sum c_k sin k g")


class Wind(AbstractActuators):
    r"""$\frac12 \rho_a V_a^2 (A_T C_X, A_L C_Y, A_L L C_N)$ of the apparent wind, at `centre`.

    Its columns are the true wind's, `wind_speed` [m/s] and `wind_direction` [rad], from which it blows,
    clockwise from north; a log that has the apparent one instead is read with the craft's measured motion.
    The coefficients are harmonics of the apparent angle. Without wind there is no
    force, and its slope is finite.

    After Blendermann (1994), J. Wind Eng. Ind. Aerodyn. 51, 339-351; Isherwood (1972), Trans. RINA 115.
    """

    key: ClassVar[str] = "wind"
    title: ClassVar[str] = "Wind"
    table: ClassVar[type[Table]] = WindTable
    told: ClassVar[tuple[str, ...]] = ("surge", "sway", "yaw")
    commanded: ClassVar[bool] = False
    single: ClassVar[bool] = True

    frontal_area: Float[Array, " one"]
    lateral_area: Float[Array, " one"]
    length: Float[Array, " one"]
    centre: Float[Array, "one 2"]
    surge: Float[Array, " surge"]
    sway: Float[Array, " sway"]
    yaw: Float[Array, " yaw"]
    delay: Float[Array, " columns"]
    lag: Float[Array, " columns"]
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        (table,) = tables
        one = {key: jnp.array([getattr(table, key)], float) for key in (*_SIZES, "centre")}
        several = {key: jnp.array(getattr(table, key), float) for key in _HARMONICS}
        return cls(**one, **several, delay=jnp.zeros(2), lag=jnp.zeros(2), names=("wind",))

    def tables(self) -> list[dict[str, Any]]:
        one = {key: np.asarray(getattr(self, key)[0]).tolist() for key in (*_SIZES, "centre")}
        return [one | {key: tuple(np.asarray(getattr(self, key)).tolist()) for key in _HARMONICS}]

    @property
    def columns(self) -> tuple[str, ...]:
        return WIND

    @property
    def units(self) -> tuple[str, ...]:
        return ("m/s", "rad")

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.array([_STORM, _TURNS])

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        return np.array([[2.0, 8.0], [0.0, 1.0]])

    def servo(self) -> Drive:
        return servo(jnp.array([_STORM, _TURNS]), jnp.zeros(2), jnp.zeros(2))

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        del state, flow
        return {}

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        speed, direction = state
        blows = -speed * jnp.stack([jnp.cos(direction), jnp.sin(direction), jnp.zeros_like(speed)])
        over = (flow.rotation.T * blows[None]).sum(-1) - flow.nu[:3]
        # From ahead and from starboard [m/s].
        ahead, starboard = -over[0], -over[1]
        squared = ahead**2 + starboard**2
        moving = squared > 0.0
        angle = jnp.arctan2(jnp.where(moving, starboard, 0.0), jnp.where(moving, ahead, 1.0))
        size = 0.5 * _AIR * squared

        def series(weights, function):
            orders = jnp.arange(1, len(weights) + 1, dtype=weights.dtype)
            return (weights * function(orders * angle)).sum()

        x = size * self.frontal_area[0] * series(self.surge, jnp.cos)
        y = size * self.lateral_area[0] * series(self.sway, jnp.sin)
        n = size * self.lateral_area[0] * self.length[0] * series(self.yaw, jnp.sin)
        (forward, down) = self.centre[0]
        return jnp.stack([x, y, jnp.zeros_like(x), -down * y, down * x, n + forward * y])


_SIZES = ("frontal_area", "lateral_area", "length")
_HARMONICS = ("surge", "sway", "yaw")
