"""What an effect is, and what is asked of one.

An effect is one physical cause. It belongs to one stage of the vehicle, is an Equinox module whose
array fields are its parameters, and has a neutral value at which it changes nothing. A new effect is
one class: derive from the stage's interface, name it, say its parameters' units, its suspects, its
neutral value where that is not zero, and what it means in words. The classical
terms of a vehicle file and learned networks enter the same way.
"""

import abc
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, Protocol, Self

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numbers import number
from .._types import DOFS, Matrix3, Scalar, Vector3, Velocity, Wrench
from ..actuators import AbstractActuators
from ..physics import Drive, Load
from ._words import Found, listed, more, size, value_of


class Craft(Protocol):
    """What an effect may know of the vehicle that it is placed in."""

    @property
    def dof(self) -> tuple[str, ...]: ...
    @property
    def thruster_names(self) -> tuple[str, ...]: ...
    @property
    def drive_names(self) -> tuple[str, ...]: ...
    @property
    def actuators(self) -> tuple[AbstractActuators, ...]: ...


class Filed(Craft, Protocol):
    """A vehicle with the numbers of its file, beside which a finding is told."""

    @property
    def density(self) -> Scalar: ...
    @property
    def gravity(self) -> Scalar: ...


@dataclasses.dataclass(frozen=True)
class Suspect:
    """One accusation: an effect, on a target, with the parameters that would have to be fitted.

    - `slots`: per parameter, the places in the flattened effect that it fills (several where one
      number acts on several thrusters).
    - `starts`: values, besides the neutral one, from which a fit is to begin; needed where the neutral
      value has no useful slope (a lag, a saturation) or the usual size is far from it.
    """

    effect: type["AbstractEffect"]
    target: str | None
    slots: Mapping[str, tuple[int, ...]]
    starts: tuple[Mapping[str, float], ...] = ()

    @property
    def label(self) -> str:
        return self.effect.name if self.target is None else f"{self.effect.name}:{self.target}"

    def values(self, effect: "AbstractEffect") -> Float[np.ndarray, " slots"]:
        """What it would have to find: its parameters in an effect, in the order of its slots."""
        flat = np.concatenate([np.zeros(0), *(np.ravel(value) for value in effect.parameters().values())])
        return flat[[places[0] for places in self.slots.values()]] if self.slots else flat[:0]


class AbstractEffect(eqx.Module):
    """One cause; see the module's text. All fields are arrays of parameters."""

    name: ClassVar[str]
    units: ClassVar[Mapping[str, str]]
    titled: ClassVar[str] = ""  # its name in a reader's words, where they are others
    filed: ClassVar[str] = ""  # the matrix of the vehicle whose entry it changes, such as `damping.linear`
    confused_with: ClassVar[tuple[str, ...]] = ()
    shown_by: ClassVar[str] = ""  # the manoeuvre in which it shows best
    advice: ClassVar[str] = ""  # what to look at on the boat
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})  # range of a parameter
    phases: ClassVar[tuple[str, ...]] = ()  # angles [rad] of the log's own clock, others in another log
    stairs: ClassVar[tuple[str, ...]] = ()  # times [s] after which it acts: samples show it by whole steps
    swings: ClassVar[bool] = False  # a sine of time, whose start a spectrum of the missing force gives
    amplitudes: ClassVar[tuple[str, ...]] = ()  # change sign where a phase goes on by half a turn

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        """The effect where it changes nothing: each of its scalars zero, unless the effect says otherwise."""
        del craft
        return cls(*(scalar() for _ in dataclasses.fields(cls)))

    @classmethod
    @abc.abstractmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        """The accusations that this effect can make on that vehicle."""

    @classmethod
    def title(cls, target: str | None) -> str:
        """What it accuses, in a few words; without a target, what it can accuse on any."""
        words = cls.titled or cls.name.replace("_", " ")
        return words if target is None else f"{words} in {target}"

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        """What was found, as the body of a sentence with its numbers.

        - `craft`: the vehicle of the file.
        """
        del craft
        return f"{cls.title(found.target)} ({listed(found)})"

    @classmethod
    def contradicts(cls, target: str | None, values: Mapping[str, float], dt: float) -> str:
        """The sentence where sensors alone contradict one another as they do by it; empty: by too little.

        - `dt` [s]: between two samples.
        """
        del dt
        label = cls.name if target is None else f"{cls.name}:{target}"
        numbers = ", ".join(f"{name} {value:.3g}" for name, value in values.items())
        as_told = f"{label} ({numbers})"
        return f"Positions, attitude and velocities contradict one another as {as_told} would make them."

    def parameters(self) -> dict[str, Any]:
        """The fields by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


class Motion(eqx.Module):
    """Where the vehicle is and how it moves, as effects on the hull see it.

    - `position` [m] NED, `rotation` body to world, `nu` over ground, `nu_r` relative to the water,
      `t` [s] the log's own time, `command` what each actuator but the sliding mass was told.
    - `lagged`: `nu_r` passed through the first-order lag of a fluid memory, six numbers of use to that effect
      alone: each is shown its own, zero where none of these has a gain. Others see all or none.
    """

    position: Vector3
    rotation: Matrix3
    nu: Velocity
    nu_r: Velocity
    lagged: Float[Array, " memory"]
    t: Scalar
    command: Float[Array, " columns"]


class Readings(eqx.Module):
    """What the sensors show: position [m], attitude (phi, theta, psi) [rad], velocities, accelerations."""

    position: Vector3
    attitude: Vector3
    nu: Velocity
    nu_dot: Velocity


class DriveEffect(AbstractEffect):
    """Stages command and thruster: changes how commands become thrust."""

    @abc.abstractmethod
    def __call__(self, drive: Drive) -> Drive: ...


class ActuatorEffect(AbstractEffect):
    """Stage actuator: changes the numbers of actuators beside the fixed thrusters."""

    @abc.abstractmethod
    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        """The same of a kind that it does not concern."""


class WaterEffect(AbstractEffect):
    """Stage water: velocity of the water in earth axes [m/s], added to that of the others."""

    @abc.abstractmethod
    def __call__(self) -> Vector3: ...


class LoadEffect(AbstractEffect):
    """Stage inertia: changes what the vehicle carries, its masses, weight and buoyancy."""

    @abc.abstractmethod
    def __call__(self, load: Load) -> Load: ...


class WrenchEffect(AbstractEffect):
    """Stage wrench: a wrench on the hull at `o`, body axes, on the right-hand side [N, N m]."""

    @abc.abstractmethod
    def __call__(self, motion: Motion) -> Wrench: ...


class SensorEffect(AbstractEffect):
    """Stage sensor: changes what is logged, not what happens."""

    @abc.abstractmethod
    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings: ...


def place(suspect: Suspect, craft: Craft, values: Mapping[str, float | Scalar]) -> AbstractEffect:
    """The effect with the suspect's parameters at `values` and all others neutral."""
    neutral = suspect.effect.neutral(craft)
    flat, unravel = jax.flatten_util.ravel_pytree(neutral)
    for name, value in values.items():
        flat = flat.at[np.array(suspect.slots[name])].set(value)
    return unravel(flat)


def blend(neutral: AbstractEffect, effect: AbstractEffect, gate: Scalar) -> AbstractEffect:
    """The effect where `gate` is 1, its neutral value where it is 0."""
    return jax.tree.map(lambda n, e: n + gate * (e - n), neutral, effect)


def zeros(count: int) -> Array:
    return jnp.zeros(count, dtype=jnp.result_type(float))


def scalar(value: float = 0.0) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


def free(craft: Craft, *dofs: str) -> bool:
    """Whether any of these degrees of freedom can move."""
    return any(dof in craft.dof for dof in dofs)


def whole(
    effect: type[AbstractEffect], names: Iterable[str], *starts: Mapping[str, float]
) -> tuple[Suspect, ...]:
    """The suspect of an effect without targets, by those of its parameters that can show; none without."""
    fields = [field.name for field in dataclasses.fields(effect)]
    slots = {name: (fields.index(name),) for name in names}
    return (Suspect(effect, None, slots, starts),) if slots else ()


def each(
    effect: type[AbstractEffect], names: Iterable[str], *starts: Mapping[str, float]
) -> tuple[Suspect, ...]:
    """A suspect for each of these targets, of an effect with one parameter that has an entry for each."""
    (parameter,) = effect.units
    return tuple(Suspect(effect, name, {parameter: (i,)}, starts) for i, name in enumerate(names))


def each_and_all(effect: type[AbstractEffect], names: Sequence[str]) -> tuple[Suspect, ...]:
    """Those of `each`, and, where they are several, all of them by one number."""
    (parameter,) = effect.units
    together = Suspect(effect, "all", {parameter: tuple(range(len(names)))})
    return (*each(effect, names), together) if len(names) > 1 else each(effect, names)


class OnEachAxis(AbstractEffect):
    """An effect with one number on each degree of freedom, zero where it changes nothing."""

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return tuple(suspect for suspect in each(cls, DOFS) if suspect.target in craft.dof)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        if not cls.filed:
            return super().said(found, craft)
        i, change = DOFS.index(str(found.target)), value_of(found, "value")
        file = float(np.asarray(attrgetter(cls.filed)(craft))[i, i])
        beside = f"(file {number(file)}, now {number(file + change)})"
        return (
            f"the vehicle has {size(found, 'value')} {more(change)} {cls.title(found.target)} than the file "
            f"says {beside}"
        )
