"""Stage actuator: propellers, control surfaces, the hull across the flow and the wind are not as filed."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numbers import number
from .._types import Scalar
from ..actuators import FREE, AbstractActuators, CrossFlow, Propellers, Supply, Surfaces, Wind
from ._base import ActuatorEffect, Craft, Filed, Suspect, each, each_and_all, free, scalar, whole, zeros
from ._words import Found, degrees, estimate, listed, value_of


def all_of(craft: Craft, kind: type[AbstractActuators]) -> Any:
    """The actuators of a kind, None where the craft has none."""
    return next((one for one in craft.actuators if isinstance(one, kind)), None)


def names_of(craft: Craft, kind: type[AbstractActuators]) -> tuple[str, ...]:
    return () if all_of(craft, kind) is None else all_of(craft, kind).names


def _moving(craft: Craft) -> tuple[str, ...]:
    """Surfaces that have a column."""
    surfaces = all_of(craft, Surfaces)
    if surfaces is None:
        return ()
    return tuple(name for name, fixed in zip(surfaces.names, surfaces.fixed, strict=True) if not fixed)


def _each_moving(
    effect: type[ActuatorEffect], craft: Craft, *starts: Mapping[str, float]
) -> tuple[Suspect, ...]:
    """A suspect for each surface that moves, of an effect with an entry for all of them."""
    suspects = each(effect, names_of(craft, Surfaces), *starts)
    return tuple(suspect for suspect in suspects if suspect.target in _moving(craft))


def _of(what: str, target: str | None, kind: str) -> str:
    """`force of each control surface`, `force of all control surfaces`, ``force of `rudder` ``."""
    if target is None:
        return f"{what} of each {kind}"
    return f"{what} of {f'all {kind}s' if target == 'all' else f'`{target}`'}"


class SurfaceGain(ActuatorEffect):
    """A surface gives `factor` times the force of the file. Neutral: 1; near 0 it is gone.

    Source: loss-of-effectiveness fault; after Fossen (2021), on forces of rudders.
    """

    name = "surface_gain"
    units = {"factor": "1"}
    confused_with = ("thruster_gain", "hull_lift", "surface_offset")
    shown_by = "each surface moved by itself to both sides, at speed"
    advice = "inspect the surface named: damage, weed, a loose stock, a part that is missing"

    factor: Float[Array, " surfaces"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(zeros(len(names_of(craft, Surfaces))) + 1.0)

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return each_and_all(cls, names_of(craft, Surfaces))

    @classmethod
    def title(cls, target: str | None) -> str:
        return _of("force", target, "control surface")

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        who = "all control surfaces give" if found.target == "all" else f"surface `{found.target}` gives"
        text = f"{who} {estimate(found, 'factor')} times the force of the file"
        return f"{text}: it acts the wrong way" if value_of(found, "factor") < 0 else text

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Surfaces):
            return actuators
        return dataclasses.replace(actuators, gain=actuators.gain * self.factor)


class SurfaceOffset(ActuatorEffect):
    """A surface stands `angle` beside what is commanded. Neutral: 0.

    Source: bias of the steering gear; after Fossen (2021).
    """

    name = "surface_offset"
    units = {"angle": "rad"}
    plausible = {"angle": (-1.0, 1.0)}
    confused_with = ("constant_wrench", "surface_gain")
    shown_by = "straight runs at several speeds"
    advice = "look at the zero of the steering gear: linkage, servo horn, the output map of the autopilot"

    angle: Float[Array, " surfaces"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(zeros(len(names_of(craft, Surfaces))))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _each_moving(cls, craft)

    @classmethod
    def title(cls, target: str | None) -> str:
        return _of("offset", target, "control surface")

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"surface `{found.target}` stands {degrees(found, 'angle')} beside its command"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Surfaces):
            return actuators
        return dataclasses.replace(actuators, offset=actuators.offset + self.angle)


class SurfaceStuck(ActuatorEffect):
    """A surface stands at `angle`, whatever is commanded. Neutral: 10 rad, from which on it stands nowhere.

    Source: lock-in-place fault; after Fossen (2021).
    """

    name = "surface_stuck"
    units = {"angle": "rad"}
    plausible = {"angle": (-math.pi, math.pi)}
    confused_with = ("surface_gain", "surface_offset")
    shown_by = "the surface commanded to both sides, at speed"
    advice = "the surface does not move: look at its motor, its linkage and what may jam it"

    angle: Float[Array, " surfaces"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(zeros(len(names_of(craft, Surfaces))) + FREE)

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _each_moving(cls, craft, {"angle": 0.0}, {"angle": 0.3}, {"angle": -0.3})

    @classmethod
    def title(cls, target: str | None) -> str:
        return _of("stuck deflection", target, "control surface")

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"surface `{found.target}` is stuck at {degrees(found, 'angle')}, whatever is commanded"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Surfaces):
            return actuators
        stands = jnp.abs(self.angle) < FREE
        return dataclasses.replace(actuators, stuck=jnp.where(stands, self.angle, actuators.stuck))


class SurfaceLag(ActuatorEffect):
    """All surfaces follow their commands with a first-order lag of `time_constant` more. Neutral: 0.

    Source: after Fossen (2021), on steering machines.
    """

    name = "surface_lag"
    titled = "lag of the control surfaces"
    units = {"time_constant": "s"}
    confused_with = ("input_delay", "surface_rate")
    shown_by = "abrupt changes of deflection at speed, logged at 10 Hz or faster"
    advice = "look at the servos: worn, starved of power, or filtered by their controller"

    time_constant: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if _moving(craft) else (), *({"time_constant": v} for v in (0.15, 0.6)))

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        lag = estimate(found, "time_constant")
        return f"the control surfaces follow their commands with {lag} more lag than the file says"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Surfaces):
            return actuators
        return dataclasses.replace(actuators, lag=actuators.lag + self.time_constant)


class SurfaceRate(ActuatorEffect):
    """No surface turns faster than `limit`. Neutral: 10 rad/s, from which on it leaves the file's alone.

    Source: after Fossen (2021), on the limits of steering machines.
    """

    name = "surface_rate"
    titled = "rate of the control surfaces"
    units = {"limit": "rad/s"}
    plausible = {"limit": (0.0, np.inf)}
    confused_with = ("surface_lag", "input_delay")
    shown_by = "abrupt changes of deflection from side to side, at speed"
    advice = "look at the steering gear's pump or motor and its supply: it turns more slowly than it should"

    limit: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(FREE))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if _moving(craft) else (), *({"limit": v} for v in (0.05, 0.2, 0.6)))

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"the control surfaces turn no faster than {degrees(found, 'limit')}/s"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Surfaces):
            return actuators
        # Not zero, by which the time to the goal would be divided.
        slower = jnp.minimum(actuators.max_rate, jnp.maximum(self.limit, 1e-3))
        rate = jnp.where(self.limit < FREE, slower, actuators.max_rate)
        return dataclasses.replace(actuators, max_rate=rate)


class Wake(ActuatorEffect):
    """The wake fraction of a propeller is `fraction` more than the file says. Neutral: 0.

    Source: after Fossen (2021), and Yasukawa and Yoshimura (2015).
    """

    name = "wake"
    units = {"fraction": "1"}
    plausible = {"fraction": (-1.0, 0.9)}
    confused_with = ("thruster_gain", "quadratic_damping:surge")
    shown_by = "the same shaft speed at different speeds of the craft"
    advice = "the water comes to the propeller at another speed than the file says: fouling, trim, a new hull"

    fraction: Float[Array, " propellers"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(zeros(len(names_of(craft, Propellers))))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return each(cls, names_of(craft, Propellers))

    @classmethod
    def title(cls, target: str | None) -> str:
        return _of("wake", target, "propeller")

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"the wake fraction of `{found.target}` is that of the file plus {estimate(found, 'fraction')}"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Propellers):
            return actuators
        return dataclasses.replace(actuators, wake_fraction=actuators.wake_fraction + self.fraction)


class CrossFlowDrag(ActuatorEffect):
    """The drag coefficient of the hull's sections is `coefficient` more than the file says. Neutral: 0.

    Source: after Fossen (2021), on strip theory; Hoerner (1965), the coefficient by beam and draft.
    """

    name = "cross_flow_drag"
    titled = "drag across the flow"
    units = {"coefficient": "1"}
    confused_with = ("quadratic_damping:sway", "quadratic_damping:yaw", "hull_lift")
    shown_by = "turns and sideways motion at low speed"
    advice = "the hull drags more or less across the flow than the file says: keel, bilge, draft, fouling"

    coefficient: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        there = all_of(craft, CrossFlow) is not None and free(craft, "sway", "yaw")
        return whole(cls, cls.units if there else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        change = estimate(found, "coefficient")
        return f"the hull's drag coefficient across the flow is that of the file plus {change}"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, CrossFlow):
            return actuators
        return dataclasses.replace(actuators, coefficient=actuators.coefficient + self.coefficient[None])


class Voltage(ActuatorEffect):
    """Thrust goes with (battery / nominal) to a power that is `exponent` more than the file's. Neutral: 0.

    Where the file has no `nominal_voltage` its power is 0, and the nominal voltage the battery's mean over
    the training logs (`supplied`). Source: a motor turns with its voltage, and thrust goes with a power of
    that from one to two; after Fossen (2021).
    """

    name = "voltage"
    titled = "thrust by the battery's voltage"
    units = {"exponent": "1"}
    plausible = {"exponent": (-1.0, 4.0)}
    confused_with = ("thruster_gain:all", "thrust_curve", "quadratic_damping:surge")
    shown_by = "the same commands with a full and with an empty battery"
    advice = "thrust sinks with the battery: give the thrusters a nominal_voltage, or a supply that holds it"

    exponent: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, () if all_of(craft, Supply) is None else cls.units)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        share = number(100.0 * 0.9 ** value_of(found, "exponent"), 2)
        return (
            f"thrust goes with the battery's voltage: at nine tenths of it there is {share} % as much (power "
            f"{estimate(found, 'exponent')} more than the file's)"
        )

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Supply):
            return actuators
        return dataclasses.replace(actuators, exponent=actuators.exponent + self.exponent)


class WindLoad(ActuatorEffect):
    """The first harmonics of the wind's coefficients are `surge`, `sway` and `yaw` more. Neutral: 0.

    Source: after Blendermann (1994) and Isherwood (1972).
    """

    name = "wind"
    titled = "load of the wind"
    units = {"surge": "1", "sway": "1", "yaw": "1"}
    confused_with = ("constant_wrench", "steady_current")
    shown_by = "several headings in the wind"
    advice = "the wind pushes more or less than the file says: look at deck load, masts and the wind sensor"

    surge: Scalar
    sway: Scalar
    yaw: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, [dof for dof in cls.units if dof in craft.dof and all_of(craft, Wind) is not None])

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"the wind pushes otherwise than the file says (first harmonics plus {listed(found)})"

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Wind):
            return actuators
        more = {dof: getattr(actuators, dof).at[0].add(getattr(self, dof)) for dof in self.units}
        return dataclasses.replace(actuators, **more)
