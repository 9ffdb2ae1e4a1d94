"""Thrusters that swivel: azimuth drives, outboard motors, steered nozzles."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._tables import Table
from .._types import Wrench
from ..physics import Drive
from ._base import AbstractActuators, Flow, Stream, servo, stacked

# Azimuths may be counted on over some turns [rad], but not in degrees.
AZIMUTH = 8 * math.pi


def turned(
    vectors: Float[Array, "swivels 3"], axes: Float[Array, "swivels 3"], angles: Float[Array, " swivels"]
) -> Float[Array, "swivels 3"]:
    """Vectors turned right-handed about unit axes (Rodrigues)."""
    sin, cos = jnp.sin(angles)[:, None], jnp.cos(angles)[:, None]
    along = (axes * vectors).sum(-1, keepdims=True) * axes
    return cos * vectors + sin * jnp.cross(axes, vectors) + (1.0 - cos) * along


class Swivels(AbstractActuators):
    """Angles of thrusters, in columns `<name>_angle` [rad]: `direction` turns right-handed about `axis`.

    They are keys of the thrusters' tables; `places` says which thrusters they are.
    """

    key: ClassVar[str] = "swivel"
    title: ClassVar[str] = "Swivelling thrusters"
    table: ClassVar[type[Table]] = Table

    position: Float[Array, "swivels 3"]
    direction: Float[Array, "swivels 3"]
    axis: Float[Array, "swivels 3"]
    delay: Float[Array, " swivels"]
    lag: Float[Array, " swivels"]
    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        """From the tables of all thrusters."""
        places = tuple(i for i, one in enumerate(tables) if one.swivel is not None)
        those = [tables[i] for i in places]
        vectors = {key: stacked(those, name, 3) for key, name in _VECTORS.items()}
        zero = jnp.zeros(len(those))
        return cls(**vectors, delay=zero, lag=zero, names=tuple(one.name for one in those), places=places)

    def tables(self) -> list[dict[str, Any]]:
        return []

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(f"{name}_angle" for name in self.names)

    @property
    def units(self) -> tuple[str, ...]:
        return ("rad",) * len(self.names)

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.full(len(self.names), AZIMUTH)

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        return np.outer(np.ones(len(self.names)), [-0.6, 0.6])

    def servo(self) -> Drive:
        return servo(jnp.full(len(self.names), AZIMUTH), self.delay, self.lag)

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        del state, flow
        return {}

    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        """Of the thrust that is `flow.thrust`, what its turn changes."""
        at = np.array(self.places)
        by = turned(self.direction, self.axis, state) - self.direction
        force = flow.thrust[at][:, None] * by
        return jnp.concatenate([force.sum(0), jnp.cross(self.position, force).sum(0)])


_VECTORS = {"position": "position", "direction": "direction", "axis": "swivel"}
