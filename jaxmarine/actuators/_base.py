"""What an actuator is, and what is asked of one.

It has two halves. What a command makes of the actuator's own state (delay, lag, limits of rate and range) is
known from the log alone, before any motion is simulated: `servo` gives the constants of that. What force the
state gives in the flow (`wrench`) stands inside the equations of motion, which differentiate it. All
actuators of one kind in a vehicle are one module, with an entry each along the first axis of its arrays.
Masses that move inside have the same two halves (`AbstractMasses`).
"""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._tables import Table
from .._types import Matrix3, Scalar, Times, Velocity, Wrench
from ..physics import UNLIMITED, Curve, Drive, Load, step_lengths


class Stream(eqx.Module):
    """What a propeller makes of the water behind it.

    - `inflow` [m/s]: speed at which the water comes to it, wake included.
    - `loading` [m²/s²]: 8 K_T n² D² / pi, by which its thrust raises the square of that far behind; not
      negative.
    """

    inflow: Scalar
    loading: Scalar


class Flow(eqx.Module):
    """The water as actuators see it.

    - `nu_r`: velocity of the vehicle through the water at `o`, body axes [m/s, rad/s]; `density` [kg/m³].
    - `nu`: over ground; `rotation`: body to world.
    - `thrust`: of the fixed thrusters, and of those that swivel as if they did not [N].
    - `streams`: behind propellers, by their names.
    """

    nu_r: Velocity
    density: Scalar
    nu: Velocity
    rotation: Matrix3
    thrust: Float[Array, " thrusters"]
    streams: dict[str, Stream]


class AbstractKind(eqx.Module):
    """All of one kind that commands move, in a vehicle: their table, their columns.

    - `names`: of the single ones.
    """

    key: ClassVar[str]  # of their tables [[key]] in a vehicle file
    single: ClassVar[bool] = False  # it has one table [key] in all
    commanded: ClassVar[bool] = True  # somebody sets its columns; else they are what was measured
    title: ClassVar[str]  # of their row in a report
    table: ClassVar[type[Table]]  # what such a table may say
    told: ClassVar[tuple[str, ...]] = ()  # fields that logs tell, which `jaxmarine fit --free KEY` frees
    # Fields that are positive by what they are: of one that is a curve per actuator, its first number.
    positive: ClassVar[tuple[str, ...]] = ()

    names: eqx.AbstractVar[tuple[str, ...]]

    @classmethod
    @abc.abstractmethod
    def of(cls, tables: Sequence[Any]) -> Self:
        """From the tables of a vehicle file, in their order."""

    @abc.abstractmethod
    def tables(self) -> list[dict[str, Any]]:
        """The tables from which `of` makes the same."""

    @classmethod
    def check(cls, tables: Sequence[Any], mass: float) -> None:
        """Raises `ValueError` where tables do not go with a body of this mass [kg]."""
        del tables, mass

    @property
    @abc.abstractmethod
    def columns(self) -> tuple[str, ...]:
        """The command columns of a log that drive them."""

    @property
    @abc.abstractmethod
    def units(self) -> tuple[str, ...]:
        """The unit of each column, "1" of shares."""

    @property
    @abc.abstractmethod
    def limits(self) -> Float[np.ndarray, " columns"]:
        """The largest |command| that a log may hold, per column."""

    @property
    @abc.abstractmethod
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        """Between which commands an operator who tries the vehicle out moves each column."""


class AbstractActuators(AbstractKind):
    """All actuators of one kind, which push in the flow; see the module's text.

    - `delay`, `lag` [s]: of each.
    """

    delay: eqx.AbstractVar[Float[Array, " actuators"]]
    lag: eqx.AbstractVar[Float[Array, " actuators"]]

    def typical(self, braking: Float[np.ndarray, "6"]) -> Mapping[str, np.ndarray]:
        """How large the numbers of some fields commonly are that may be zero in a file, by the field.

        - `braking` [N s²/m², N m s²]: the craft's own quadratic damping on each axis.
        """
        del braking
        return {}

    @abc.abstractmethod
    def servo(self) -> Drive:
        """What each column makes of its actuator's state: constants, an entry per column (`servo`)."""

    @abc.abstractmethod
    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        """What those that leave a stream make of the water behind them, by their names; mostly nothing."""

    @abc.abstractmethod
    def wrench(self, state: Float[Array, " columns"], flow: Flow) -> Wrench:
        """The wrench on the hull at `o`, body axes [N, N m]."""


def _none() -> Float[Array, " none"]:
    return jnp.zeros(0)


class AbstractHull(AbstractActuators):
    """What the flow does to the hull, which nobody commands: it has no column, no state and no stream."""

    delay: Float[Array, " none"] = eqx.field(default_factory=_none, kw_only=True)
    lag: Float[Array, " none"] = eqx.field(default_factory=_none, kw_only=True)

    @property
    def columns(self) -> tuple[str, ...]:
        return ()

    @property
    def units(self) -> tuple[str, ...]:
        return ()

    @property
    def limits(self) -> Float[np.ndarray, " columns"]:
        return np.zeros(0)

    @property
    def usual(self) -> Float[np.ndarray, "columns 2"]:
        return np.zeros((0, 2))

    def servo(self) -> Drive:
        return servo(_none(), self.delay, self.lag)

    def streams(self, state: Float[Array, " columns"], flow: Flow) -> dict[str, Stream]:
        del state, flow
        return {}


class AbstractMasses(AbstractKind):
    """All masses of one kind that commands move inside the vehicle.

    How they move is known from the log alone: `held` gives it over a hold, as any module of arrays. Where
    they then are changes what the vehicle carries (`moved`), and that they move pushes back (`reaction`).
    Their columns come last in a log, and are none of `Plant.drive`.
    """

    @property
    @abc.abstractmethod
    def settled(self) -> float:
        """Time after which what they were told before no longer shows [s]."""

    @property
    @abc.abstractmethod
    def state_names(self) -> tuple[str, ...]:
        """What each number of their state is."""

    @abc.abstractmethod
    def rest(self, command: Float[Array, " columns"]) -> Float[Array, " state"]:
        """Their state where a command has acted long."""

    @abc.abstractmethod
    def held(self, state: Float[Array, " state"], command: Float[Array, " columns"], t: Scalar) -> Any:
        """How they move from a state at `t` [s] on under a command that is held."""

    @abc.abstractmethod
    def state(self, motion: Any, t: Scalar) -> Float[Array, " state"]:
        """Their state at a time [s] of that motion."""

    @abc.abstractmethod
    def rates(self, motion: Any, t: Scalar) -> Float[Array, " state"]:
        """The time derivative of their state."""

    @abc.abstractmethod
    def moved(self, load: Load, motion: Any, t: Scalar) -> Load:
        """What is carried, which the file has with them at command 0, with them where they are."""

    @abc.abstractmethod
    def reaction(self, motion: Any, t: Scalar, nu: Velocity) -> Wrench:
        """What their motion takes beside that, at `o` on the left-hand side, body axes [N, N m]."""

    def moves(self, t: Times, commands: Float[Array, "times columns"]) -> Any:
        """Their motion over each hold, one row per sample; at rest at the first command before that."""

        def hold(state, now):
            command, begin, dt = now
            motion = self.held(state, command, begin)
            return self.state(motion, begin + dt), motion

        return jax.lax.scan(hold, self.rest(commands[0]), (commands, t, step_lengths(t)))[1]


def servo(
    reach: Float[Array, " columns"],
    delay: Float[Array, " columns"],
    lag: Float[Array, " columns"],
    rate: Float[Array, " columns"] | None = None,
) -> Drive:
    """A state that follows its command late by `delay` and `lag` [s], within +-`reach`, at most at `rate`."""
    one, zero = jnp.ones_like(reach), jnp.zeros_like(reach)
    return Drive(
        delay=delay,
        deadband=zero,
        saturation=reach,
        quadratic=zero,
        gain=one,
        lag=lag,
        inflow=zero,
        max_thrust=one,
        max_thrust_reverse=one,
        rate=UNLIMITED * one if rate is None else rate,
    )


def joined(drives: Sequence[Drive]) -> Drive:
    """The constants of several groups of columns as one, in their order.

    A learned curve of one group is none to the others.
    """
    if len(drives) == 1:
        return drives[0]
    names = [name for name in vars(drives[0]) if name not in ("curves", "rate")]
    numbers = {name: jnp.concatenate([getattr(one, name) for one in drives]) for name in names}
    rates = [UNLIMITED * jnp.ones_like(one.lag) if one.rate is None else one.rate for one in drives]
    sizes = [one.lag.size for one in drives]

    def filled(values: Float[Array, " group"], before: int):
        return jnp.pad(values, (before, sum(sizes) - before - values.size))

    def widened(curve: Curve, before: int) -> Curve:
        slope, bias, weight = (
            tuple(filled(a, before) for a in part) for part in (curve.slope, curve.bias, curve.weight)
        )
        return Curve(slope, bias, weight, filled(curve.low, before), filled(curve.high, before))

    curves = [widened(c, sum(sizes[:i])) for i, one in enumerate(drives) for c in one.curves]
    return Drive(**numbers, curves=tuple(curves), rate=jnp.concatenate(rates))


def stacked(tables: Sequence[Any], name: str, *width: int) -> Array:
    """One key of all tables as an array, zero where it is left out."""
    values = [getattr(table, name) for table in tables]
    zero = np.zeros(width)
    filled = [zero if value is None else value for value in values]
    return jnp.asarray(np.array(filled, float).reshape(len(values), *width))


def at_point(nu: Velocity, position: Float[Array, "points 3"]) -> Float[Array, "points 3"]:
    """Velocity of points that are fixed to the vehicle [m/s]."""
    return nu[None, :3] + jnp.cross(nu[None, 3:], position)


def along(a: Float[Array, "points 3"], b: Float[Array, "points 3"]) -> Float[Array, " points"]:
    """Scalar products, row by row."""
    return (a * b).sum(-1)
