"""The battery that thrusters draw from."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._tables import Table
from .._types import BATTERY, Wrench
from ..physics import Drive
from ._base import AbstractActuators, Flow, Stream, servo, stacked

# Of no battery [V], above and below.
_MOST, _LEAST = 1e4, 1e-3


class Supply(AbstractActuators):
    """Thrust goes with (battery / `nominal`) to the power `exponent`; the column `battery` [V] is logged.

    They are keys of the thrusters' tables; `places` says which thrusters they are. Source: a motor turns with
    its voltage, and thrust goes with a power of that from one to two; after Fossen (2021).
    """

    key: ClassVar[str] = BATTERY
    title: ClassVar[str] = "Thrusters on the battery"
    table: ClassVar[type[Table]] = Table
    commanded: ClassVar[bool] = False

    nominal: Float[Array, " supplied"]
    exponent: Float[Array, " supplied"]
    delay: Float[Array, " columns"]
    lag: Float[Array, " columns"]
    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        """From the tables of all thrusters."""
        places = tuple(i for i, one in enumerate(tables) if one.nominal_voltage is not None)
        those = [tables[i] for i in places]
        nominal, exponent = stacked(those, "nominal_voltage"), stacked(those, "voltage_exponent")
        names, zero = tuple(one.name for one in those), jnp.zeros(1)
        return cls(nominal=nominal, exponent=exponent, delay=zero, lag=zero, names=names, places=places)

    @classmethod
    def unfiled(cls, names: Sequence[str], nominal: float) -> Self:
        """All thrusters on a battery of this voltage [V], with which their thrust does not go."""
        count, zero = len(names), jnp.zeros(1)
        return cls(
            nominal=jnp.full(count, nominal),
            exponent=jnp.zeros(count),
            delay=zero,
            lag=zero,
            names=tuple(names),
            places=tuple(range(count)),
        )

    def tables(self) -> list[dict[str, Any]]:
        return []

    def of_thruster(self, name: str) -> dict[str, float]:
        """Its keys of the table of a thruster."""
        if name not in self.names:
            return {}
        i = self.names.index(name)
        return {"nominal_voltage": float(self.nominal[i]), "voltage_exponent": float(self.exponent[i])}

    @property
    def columns(self) -> tuple[str, ...]:
        return (BATTERY,)

    @property
    def units(self) -> tuple[str, ...]:
        return ("V",)

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.array([_MOST])

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        return np.array([[0.85, 1.05]]) * float(self.nominal[0])

    def servo(self) -> Drive:
        return servo(jnp.array([_MOST]), self.delay, self.lag)

    def supplied(
        self, thrust: Float[Array, " thrusters"], state: Float[Array, " columns"]
    ) -> Float[Array, " thrusters"]:
        """What thrusters give at this voltage [N]."""
        volts = jnp.maximum(state[0], _LEAST)
        ratio = (volts / self.nominal) ** self.exponent
        place = {i: k for k, i in enumerate(self.places)}
        one = jnp.ones_like(volts)
        return thrust * jnp.stack([ratio[place[i]] if i in place else one for i in range(len(thrust))])

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        del state, flow
        return {}

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        del state, flow
        return jnp.zeros(6)
