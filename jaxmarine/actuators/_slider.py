"""A mass that slides inside the vehicle to trim it, moved by a servo that follows a command."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pydantic
from jaxtyping import Array, Float
from pydantic import Field

from .._tables import Number, Table, Triple, unit_direction, usable_name
from .._types import Scalar, Vector3, Velocity, Wrench
from ..physics import Load, rigid_body_matrix, skew
from ._base import AbstractMasses

# Of the servo's time constant, whose pole is double: then what it was told before no longer shows.
_SETTLED = 6.0


class SliderTable(Table):
    """A mass that slides in the vehicle, with a command column of its name."""

    name: str = Field(description="the name of the slider's command column, in quotes")
    mass: Number = Field(gt=0, description="a positive number [kg], part of the body's mass")
    position: Triple = Field(
        description="[x, y, z] from `o` at command 0, where the body's masses have it [m]"
    )
    direction: Triple = Field(description="[x, y, z], not zero: where a positive command moves it")
    travel: Number = Field(gt=0, description="a positive number, the way at command 1 [m]")
    time_constant: Number = Field(gt=0, description="a positive number, of its critically damped servo [s]")

    _usable_name = pydantic.field_validator("name")(usable_name)
    _unit_direction = pydantic.field_validator("direction")(unit_direction)


class Slide(eqx.Module):
    """How the slider moves over a hold: from `offset` [m] and `rate` [m/s] at `since` [s] to `goal` [m].

    The servo is critically damped, `s'' = (goal - s) / T² - 2 s' / T` with T the `time_constant` [s];
    position, rate and acceleration at any time of the hold are its closed form.
    """

    offset: Float[Array, "*times"]
    rate: Float[Array, "*times"]
    goal: Float[Array, "*times"]
    since: Float[Array, "*times"]
    time_constant: Float[Array, "*times"]

    def __call__(self, t: Float[Array, "*times"]) -> tuple[Array, Array, Array]:
        """Position along the direction [m], rate [m/s] and acceleration [m/s²] at the time `t` [s]."""
        pace = 1.0 / self.time_constant
        error = self.offset - self.goal
        slope = self.rate + pace * error
        past = t - self.since
        decay = jnp.exp(-pace * past)
        away = (error + slope * past) * decay
        rate = slope * decay - pace * away
        return self.goal + away, rate, -pace * (pace * away + 2.0 * rate)


class Slider(AbstractMasses):
    """A point mass on a straight rail in the vehicle, which its command moves.

    - `mass` [kg], part of the vehicle's mass; `position` [m] from `o` at command 0, where the file's
      masses have it; unit `direction` of the rail.
    - `travel` [m] along the direction at command 1; `time_constant` [s] of the servo.

    Source: thesis (7.1) and appendix B, with the momenta of both bodies about `o` written out: the slider
    adds its Coriolis force and its own acceleration, and the mass matrix holds it where it is. The printed
    V, (7.2) and (B.31), does not agree with those momenta.
    """

    key: ClassVar[str] = "slider"
    title: ClassVar[str] = "Sliding mass"
    table: ClassVar[type[Table]] = SliderTable
    single: ClassVar[bool] = True

    mass: Scalar
    position: Vector3
    direction: Vector3
    travel: Scalar
    time_constant: Scalar
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        (table,) = tables
        numbers = {key: jnp.asarray(np.array(getattr(table, key), float)) for key in _NUMBERS}
        return cls(**numbers, names=(table.name,))

    def tables(self) -> list[dict[str, Any]]:
        return [{"name": self.names[0]} | {key: np.asarray(getattr(self, key)).tolist() for key in _NUMBERS}]

    @classmethod
    def check(cls, tables: Sequence[Any], mass: float) -> None:
        for table in tables:
            if table.mass >= mass:
                raise ValueError(
                    f"`{cls.key}.mass` is {table.mass:g} kg, but must be below `body.mass`, "
                    f"{mass:g} kg, which it is part of."
                )

    @property
    def columns(self) -> tuple[str, ...]:
        return self.names

    @property
    def units(self) -> tuple[str, ...]:
        return ("1",) * len(self.names)

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.ones(1)

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        return np.array([[-1.0, 1.0]])

    @property
    def settled(self) -> float:
        return _SETTLED * float(self.time_constant)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Offset along the rail [m] and its rate [m/s]."""
        return f"{self.names[0]}_offset", f"{self.names[0]}_rate"

    def rest(self, command: Float[Array, " columns"]) -> Float[Array, " state"]:
        offset = self.travel * command[0]
        return jnp.stack([offset, jnp.zeros_like(offset)])

    def held(self, state: Float[Array, " state"], command: Float[Array, " columns"], t: Scalar) -> Slide:
        return Slide(state[0], state[1], self.travel * command[0], t, self.time_constant)

    def state(self, motion: Slide, t: Scalar) -> Float[Array, " state"]:
        return jnp.stack(motion(t)[:2])

    def rates(self, motion: Slide, t: Scalar) -> Float[Array, " state"]:
        return jnp.stack(motion(t)[1:])

    def moved(self, load: Load, motion: Slide, t: Scalar) -> Load:
        place = self.position + motion(t)[0] * self.direction
        shift = self.mass * load.gravity * (place - self.position)
        return dataclasses.replace(
            load,
            rigid=load.rigid + self._alone(place) - self._alone(self.position),
            weight_moment=load.weight_moment + shift,
        )

    def _alone(self, place: Vector3):
        return rigid_body_matrix(self.mass, -self.mass * skew(place) @ skew(place), place)

    def reaction(self, motion: Slide, t: Scalar, nu: Velocity) -> Wrench:
        """V nu + b at `o`: m (2 w x r' + r'') and its moment at r [N, N m]."""
        offset, rate, acceleration = motion(t)
        place = self.position + offset * self.direction
        force = self.mass * (2.0 * rate * jnp.cross(nu[3:], self.direction) + acceleration * self.direction)
        return jnp.concatenate([force, jnp.cross(place, force)])


_NUMBERS = ("mass", "position", "direction", "travel", "time_constant")
