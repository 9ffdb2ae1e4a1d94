"""Stages command and thruster: what happens between a command and the thrust.

Which thruster a column drives comes first (`ExchangedThrusters`). The others act in the order delay,
deadband, saturation, curve, gain, lag, inflow, whatever the order in which they stand in the vehicle
(`physics.Drive`).
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numbers import percent
from .._types import Scalar
from ..actuators import AbstractActuators, Propellers
from ..physics import Drive
from ._actuator import names_of
from ._base import (
    AbstractEffect,
    ActuatorEffect,
    Craft,
    DriveEffect,
    Filed,
    Suspect,
    each_and_all,
    scalar,
    whole,
)
from ._words import Found, estimate, value_of

# A limit of commands that none reaches.
_NO_LIMIT = 10.0


def _one(cls, names: tuple[str, ...], *starts: float) -> tuple[Suspect, ...]:
    """The single suspect of an effect with one number for all that bear these names; none without them."""
    (parameter,) = cls.units
    return whole(cls, cls.units if names else (), *({parameter: start} for start in starts))


def _that_push(craft: Craft) -> tuple[str, ...]:
    """The thrusters and, behind them, the propellers."""
    return *craft.thruster_names, *names_of(craft, Propellers)


def _thrust_of(target: str | None) -> str:
    if target is None:
        return "thrust of each thruster"
    return f"thrust of {'all thrusters' if target == 'all' else f'`{target}`'}"


def _factor_of_thrust(found: Found) -> str:
    factor = found.parameters["factor"]
    who = "all thrusters give" if found.target == "all" else f"thruster `{found.target}` gives"
    text = f"{who} {estimate(found, 'factor')} times the thrust of the file"
    slack = 2 * factor.std if math.isfinite(factor.std) else 0.0
    if abs(factor.value) < 0.05 + slack:
        return f"{text}: commands are practically not acted on"
    return f"{text}: it pushes the wrong way" if factor.value < 0 else text


class ExchangedThrusters(AbstractEffect):
    """Each of two columns holds the other's command. Neutral: no target, which changes nothing.

    It has no number: its target `a+b` says all, and `columns_of` what a column drives. A diagnosis decides it
    by the signs of responses before anything is fitted. Source: swapped outputs of an autopilot.
    """

    name = "exchanged_thrusters"
    titled = "exchanged columns of commands"
    units = {}
    confused_with = ("thruster_gain", "coupled_damping")
    shown_by = "each thruster driven by itself"
    advice = "look at the wiring and the output map of the autopilot, or rename the two columns of the log"

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        pairs = itertools.combinations(craft.thruster_names, 2)
        return tuple(Suspect(cls, f"{a}+{b}", {}) for a, b in pairs)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        first, _, second = str(found.target).partition("+")
        return f"the columns of `{first}` and `{second}` are exchanged: each holds the other's command"

    @staticmethod
    def columns_of(target: str, names: Sequence[str]) -> list[int]:
        """Of each column the thruster that it drives, by the places in `names`."""
        out = list(range(len(names)))
        for i, j in itertools.combinations(out, 2):
            if f"{names[i]}+{names[j]}" == target:
                out[i], out[j] = j, i
        return out


class InputDelay(DriveEffect, ActuatorEffect):
    """Every command acts `delay` seconds late: c(t - delay). Neutral: 0.

    Source: pure transport delay.
    """

    name = "input_delay"
    titled = "delay of the commands"
    units = {"delay": "s"}
    confused_with = ("thruster_lag",)
    shown_by = "abrupt changes of command, logged at 10 Hz or faster"
    advice = "look at the transport and scheduling of commands, and at the log's clocks"
    stairs = ("delay",)

    delay: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _one(cls, craft.drive_names, 0.3)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"every command acts {estimate(found, 'delay')} late"

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, delay=drive.delay + self.delay)

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        return dataclasses.replace(actuators, delay=actuators.delay + self.delay)


class Deadband(DriveEffect):
    """Small commands do nothing: c -> sign(c) max(|c| - width, 0). Neutral: 0.

    Source: the thruster block of Blue Robotics ESCs behaves so; after Bessa et al. (2006), dead zones.
    """

    name = "deadband"
    titled = "dead band of the thrusters"
    units = {"width": "1"}
    plausible = {"width": (-1.0, 0.5)}
    confused_with = ("thrust_curve", "thruster_gain")
    shown_by = "many small commands of both signs beside large ones"
    advice = "look at the motor controllers' dead zone and start-up threshold"

    width: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        # The slope at none is that of commands beyond any width: a craft that lies still at a trim within it
        # would be pushed the other way.
        return _one(cls, craft.thruster_names, 0.05, 0.15)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        width = estimate(found, "width", 100.0, "%")
        return f"commands smaller than {width} of full command do nothing, and larger ones lose as much"

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, deadband=drive.deadband + self.width)


class Saturation(DriveEffect):
    """Large commands are clipped at `limit`. Neutral: 10, from which on it leaves the file's limit alone.

    Source: amplitude limit of the actuator; after Fossen (2021).
    """

    name = "saturation"
    titled = "saturation of the thrusters"
    units = {"limit": "1"}
    confused_with = ("thrust_curve", "thruster_gain")
    shown_by = "full commands beside half ones"
    advice = "look at current limits, battery voltage and the command's scaling"

    limit: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(_NO_LIMIT))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _one(cls, craft.thruster_names, 0.8, 0.5, 0.3, 0.2)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"commands beyond {estimate(found, 'limit', 100.0, '%')} of full command bring no more thrust"

    def __call__(self, drive: Drive) -> Drive:
        clipped = jnp.minimum(drive.saturation, self.limit)
        saturation = jnp.where(self.limit < _NO_LIMIT, clipped, drive.saturation)
        return dataclasses.replace(drive, saturation=saturation)


class ThrustCurve(DriveEffect):
    """Thrust is not linear in the command: max_thrust ((1 - quadratic) c + quadratic c |c|). Neutral: 0.

    Source: after Fossen (2021), on thrust, which grows with n|n|.
    """

    name = "thrust_curve"
    titled = "shape of the thrust curve"
    units = {"quadratic": "1"}
    confused_with = ("deadband", "saturation", "thruster_gain:all")
    shown_by = "small and large commands in equal parts"
    advice = "measure thrust against command on a stand"

    quadratic: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _one(cls, craft.thruster_names)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        half = percent(1.0 - value_of(found, "quadratic") / 2)
        return (
            f"thrust is not proportional to the command: at half command there is {half} of the file's "
            f"thrust, at full command all of it (quadratic part {estimate(found, 'quadratic')})"
        )

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, quadratic=drive.quadratic + self.quadratic)


class ThrusterGain(DriveEffect, ActuatorEffect):
    """A thruster or propeller gives `factor` times the thrust of the file. Neutral: 1; near 0 it gives none.

    Source: loss-of-effectiveness fault; after Omerdic and Roberts, Control Engineering Practice 12 (2004).
    """

    name = "thruster_gain"
    units = {"factor": "1"}
    confused_with = ("inflow_loss", "thrust_curve", "velocity_scale")
    shown_by = "each thruster driven by itself"
    advice = "inspect the propeller and the motor named: weed, damage, a loose coupling, a dead phase"

    factor: Float[Array, " thrusters_and_propellers"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(jnp.ones(len(_that_push(craft)), jnp.result_type(float)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return each_and_all(cls, _that_push(craft))

    @classmethod
    def title(cls, target: str | None) -> str:
        return _thrust_of(target)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return _factor_of_thrust(found)

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, gain=drive.gain * self.factor[: drive.gain.shape[-1]])

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Propellers):
            return actuators
        behind = self.factor[len(self.factor) - len(actuators.names) :]
        return dataclasses.replace(actuators, gain=actuators.gain * behind)


class ReverseThrust(DriveEffect):
    """A thruster gives `factor` times the thrust of the file where its command is negative. Neutral: 1.

    Source: after Fossen (2021), on propellers, which are made for one way.
    """

    name = "reverse_thrust"
    units = {"factor": "1"}
    plausible = {"factor": (-0.1, math.inf)}  # astern none pushes ahead; none is found within its error
    confused_with = ("thruster_gain", "thrust_curve", "constant_wrench")
    shown_by = "each thruster driven by itself, ahead as well as astern"
    advice = "look which way round the propeller is mounted, and measure its thrust astern on a stand"

    factor: Float[Array, " thrusters"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        return cls(jnp.ones(len(craft.thruster_names), jnp.result_type(float)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return each_and_all(cls, craft.thruster_names)

    @classmethod
    def title(cls, target: str | None) -> str:
        return f"{_thrust_of(target)} astern"

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"at negative commands {_factor_of_thrust(found)}"

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, max_thrust_reverse=drive.max_thrust_reverse * self.factor)


class ThrusterLag(DriveEffect, ActuatorEffect):
    """Thrust follows its goal with a first-order lag, `time_constant` T' = T_goal - T. Neutral: 0.

    Source: after Yoerger, Cooke and Slotine (1990) and Fossen (2021).
    """

    name = "thruster_lag"
    titled = "lag of the thrusters"
    units = {"time_constant": "s"}
    confused_with = ("input_delay",)
    shown_by = "abrupt changes of command, logged at 10 Hz or faster"
    advice = "look at the motor controllers' ramp and at the propellers' inertia"
    plausible = {"time_constant": (-math.inf, 60.0)}  # no engine takes longer; below 0 the file's is too long

    time_constant: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _one(cls, _that_push(craft), 0.15, 0.6)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return (
            f"thrust follows the command with a lag of {estimate(found, 'time_constant')} (the time to 63 %)"
        )

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, lag=drive.lag + self.time_constant)

    def changed(self, actuators: AbstractActuators) -> AbstractActuators:
        if not isinstance(actuators, Propellers):
            return actuators
        return dataclasses.replace(actuators, lag=actuators.lag + self.time_constant)


class InflowLoss(DriveEffect):
    """Thrust falls with the speed along the thruster: times 1 - per_speed |n . v_r|. Neutral: 0.

    `v_r` is the velocity of `o` through the water. Source: after Fossen (2021), on advance speed.
    """

    name = "inflow_loss"
    titled = "thrust lost to the inflow"
    units = {"per_speed": "s/m"}
    plausible = {"per_speed": (0.0, math.inf)}
    confused_with = ("tether_drag", "quadratic_damping", "thruster_gain:all")
    shown_by = "the same command at different speeds, also against the motion"
    advice = "use the propeller's open-water curve: thrust is lost to the inflow"

    per_speed: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return _one(cls, craft.thruster_names)

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        loss = estimate(found, "per_speed", 100.0, "%")
        return f"the thrusters lose {loss} of their thrust per m/s of speed along them"

    def __call__(self, drive: Drive) -> Drive:
        return dataclasses.replace(drive, inflow=drive.inflow + self.per_speed)
