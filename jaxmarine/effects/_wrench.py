"""Stage wrench: forces and moments on the hull, on the right-hand side, body axes at `o`."""

from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numbers import number
from .._types import DOFS, Matrix6, Scalar, Wrench
from ..actuators import Wind
from ..physics import apply, norm
from ._actuator import all_of
from ._base import Craft, Filed, Motion, OnEachAxis, Suspect, WrenchEffect, free, scalar, whole, zeros
from ._words import PUSHES, Found, estimate, listed, polar, push, size, value_of


class ConstantWrench(OnEachAxis, WrenchEffect):
    """A constant force or moment in body axes. Neutral: 0. Source: bias forces, after Fossen (2021)."""

    name = "constant_wrench"
    units = {"value": "N or N m"}
    confused_with = ("buoyancy", "trim", "steady_current")
    shown_by = "rest, and roll, pitch and heading changed widely"
    advice = "a steady push in body axes: a thruster that never stops, a bent fin, a cable under tension"

    @classmethod
    def title(cls, target: str | None) -> str:
        return "constant force" if target is None else f"constant {push(target)}"

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        target = str(found.target)
        kind, way = push(target).split()[0], PUSHES[target][value_of(found, "value") < 0]
        return f"a constant {kind} of {size(found, 'value')} in {target} {way}"

    def __call__(self, motion: Motion) -> Wrench:
        del motion
        return self.value


class LinearDamping(OnEachAxis, WrenchEffect):
    """More damping in proportion to the velocity of one axis. Neutral: 0. Source: thesis (5.24)."""

    name = "linear_damping"
    filed = "damping.linear"
    units = {"value": "N s/m or N m s"}
    confused_with = ("quadratic_damping", "fluid_memory", "inflow_loss")
    shown_by = "slow and fast motion along that axis"
    advice = "more or less drag than the file says at low speed"

    def __call__(self, motion: Motion) -> Wrench:
        return -self.value * motion.nu_r


class QuadraticDamping(OnEachAxis, WrenchEffect):
    """More damping with the square of the velocity of one axis. Neutral: 0. Source: thesis (5.24)."""

    name = "quadratic_damping"
    filed = "damping.quadratic"
    units = {"value": "N s²/m² or N m s²"}
    confused_with = ("linear_damping", "tether_drag", "inflow_loss")
    shown_by = "slow and fast motion along that axis"
    advice = "more or less drag than the file says at high speed: fouling, new parts in the flow"

    def __call__(self, motion: Motion) -> Wrench:
        return -self.value * jnp.abs(motion.nu_r) * motion.nu_r


class CoupledDamping(WrenchEffect):
    """Linear damping on one axis from the velocity of another. Neutral: 0. Source: thesis (5.24)."""

    name = "coupled_damping"
    filed = "damping.linear"
    units = {"value": "N s/m, N s or N m s"}
    confused_with = ("hull_lift", "velocity_lever_arm")
    shown_by = "each axis moved by itself"
    advice = "the hull is not symmetric in the flow: one axis' motion pushes another"

    value: Matrix6

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(36).reshape(6, 6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return tuple(
            Suspect(cls, f"{DOFS[i]}<-{DOFS[j]}", {"value": (6 * i + j,)})
            for i in range(6)
            for j in range(6)
            if i != j and DOFS[i] in craft.dof and DOFS[j] in craft.dof
        )

    @classmethod
    def title(cls, target: str | None) -> str:
        if target is None:
            return super().title(target)
        pushed, _, moving = target.partition("<-")
        return f"damping in {pushed} from motion in {moving}"

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        pushed, _, moving = str(found.target).partition("<-")
        return (
            f"motion in {moving} causes a {push(pushed)} that the file does not have "
            f"(linear damping {estimate(found, 'value')})"
        )

    def __call__(self, motion: Motion) -> Wrench:
        return -apply(self.value, motion.nu_r)


class HullLift(WrenchEffect):
    """Lift of a hull at an angle of attack: Y = -Y_uv |u| v, N = -N_uv u v, Z = -Z_uw |u| w, M = -M_uw u w.

    Neutral: 0. The forces oppose the drift going ahead and astern: with u in the place of |u| they would feed
    energy to a craft that goes astern. The moments change sign with u, as the Munk moment does.
    Source: after Fossen (2021), on lift and Munk moment, and Prestero (2001).
    """

    name = "hull_lift"
    titled = "lift of the hull"
    units = {"Y_uv": "N s²/m²", "N_uv": "N s²/m", "Z_uw": "N s²/m²", "M_uw": "N s²/m"}
    confused_with = ("coupled_damping", "added_mass")
    shown_by = "sway and heave at speed, turns"
    advice = "fins or hull shape carry lift that the file does not have"

    Y_uv: Scalar
    N_uv: Scalar
    Z_uw: Scalar
    M_uw: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        if not free(craft, "surge"):
            return ()
        pairs = {
            "Y_uv": ("sway", "sway"),
            "N_uv": ("yaw", "sway"),
            "Z_uw": ("heave", "heave"),
            "M_uw": ("pitch", "heave"),
        }
        return whole(cls, [name for name, pair in pairs.items() if {*pair} <= {*craft.dof}])

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"at an angle to the flow the hull feels a lift that the file does not have ({listed(found)})"

    def __call__(self, motion: Motion) -> Wrench:
        u, v, w = motion.nu_r[:3]
        zero, speed = jnp.zeros_like(u), jnp.abs(u)
        return -jnp.stack(
            [zero, self.Y_uv * speed * v, self.Z_uw * speed * w, zero, self.M_uw * u * w, self.N_uv * u * v]
        )


class TurningLift(WrenchEffect):
    """Lift of a hull that turns while it makes way: Y = -Y_ur u r, N = -N_ur |u| r. Neutral: 0.

    The moment brakes the turn going ahead and astern. Source: after Fossen (2021), on lift of the hull and
    its fins; after Yasukawa and Yoshimura (2015), the linear yaw-rate terms of the hull forces.
    """

    name = "turning_lift"
    titled = "lift of the hull in turns"
    units = {"Y_ur": "N s²", "N_ur": "N m s²"}
    confused_with = ("hull_lift", "coupled_damping", "linear_damping:yaw")
    shown_by = "turns at several speeds, ahead and astern"
    advice = "the stern or its fins carry lift in turns that the file does not have"

    Y_ur: Scalar
    N_ur: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        if not (free(craft, "surge") and free(craft, "yaw")):
            return ()
        return whole(cls, ("Y_ur", "N_ur") if free(craft, "sway") else ("N_ur",))

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"in turns at speed the hull feels a lift that the file does not have ({listed(found)})"

    def __call__(self, motion: Motion) -> Wrench:
        u, r = motion.nu_r[0], motion.nu_r[5]
        zero = jnp.zeros_like(u)
        return -jnp.stack([zero, self.Y_ur * u * r, zero, zero, zero, self.N_ur * jnp.abs(u) * r])


class TetherDrag(WrenchEffect):
    """Drag of a towed cable at `o`, along the relative velocity: -coefficient |v_r| v_r. Neutral: 0.

    Source: cross-flow drag of a cable element, after Fossen (2021); the three axes share one speed.
    """

    name = "tether_drag"
    titled = "drag of a cable"
    units = {"coefficient": "N s²/m²"}
    plausible = {"coefficient": (0.0, np.inf)}
    confused_with = ("quadratic_damping", "inflow_loss")
    shown_by = "fast motion along several translations, also combined"
    advice = "the cable drags: pay out slack, or keep its drag in the model"

    coefficient: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if free(craft, "surge", "sway", "heave") else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        at_one = number(value_of(found, "coefficient"), 2)
        return (
            f"something towed, such as a cable, drags with {at_one} N at 1 m/s and with the square of "
            f"the speed (coefficient {estimate(found, 'coefficient')})"
        )

    def __call__(self, motion: Motion) -> Wrench:
        v_r = motion.nu_r[:3]
        return jnp.concatenate([-self.coefficient * norm(v_r) * v_r, jnp.zeros(3)])


class WindPush(WrenchEffect):
    """A constant force at `o` in earth axes, as a steady wind's on what stands out of the water. Neutral: 0.

    A vehicle file has no stiffness of a waterplane: what is free in heave is under water, where no wind
    blows. Source: after Fossen (2021), on wind forces; here one that does not turn with the craft.
    """

    name = "wind_push"
    titled = "push of the wind"
    units = {"north": "N", "east": "N"}
    confused_with = ("steady_current", "constant_wrench")
    shown_by = "several headings, at rest and at speed"
    advice = "wind, or a line under tension: nothing to mend; log the wind, and give the file a table [wind]"

    north: Scalar
    east: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        afloat = free(craft, "surge", "sway") and not free(craft, "heave")
        return whole(cls, cls.units if afloat and all_of(craft, Wind) is None else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        force, towards = polar(found)
        return f"a steady force of {force} N, as of the wind, pushes towards {towards}° ({listed(found)})"

    def __call__(self, motion: Motion) -> Wrench:
        force = jnp.stack([self.north, self.east, jnp.zeros_like(self.north)])
        return jnp.concatenate([apply(motion.rotation.T, force), jnp.zeros(3)])


class Waves(WrenchEffect):
    """A regular wave force at `o` in earth axes: (north, east) sin(2 pi t / period + phase). Neutral: 0.

    `t` is the log's own time. Source: first-order wave force, after Fossen (2021).
    """

    name = "waves"
    units = {"north": "N", "east": "N", "period": "s", "phase": "rad"}
    plausible = {"period": (0.0, np.inf)}
    swings = True
    phases = ("phase",)
    amplitudes = ("north", "east")
    confused_with = ("unknown",)
    shown_by = "some minutes on any course"
    advice = "waves: nothing to mend; filter them from the controller's signals"

    north: Scalar
    east: Scalar
    period: Scalar
    phase: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar(5.0), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if free(craft, "surge", "sway") else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        force, towards = polar(found)
        along = towards % 180
        return (
            f"waves push the vehicle to and fro with up to {force} N along {along}°/{along + 180}°, "
            f"once in {estimate(found, 'period')} ({listed(found, ('north', 'east', 'phase'))})"
        )

    def __call__(self, motion: Motion) -> Wrench:
        swing = jnp.sin(2.0 * jnp.pi * motion.t / self.period + self.phase)
        force = jnp.stack([self.north * swing, self.east * swing, jnp.zeros_like(swing)])
        return jnp.concatenate([apply(motion.rotation.T, force), jnp.zeros(3)])


class FluidMemory(WrenchEffect):
    """Damping that comes late: the wrench -m on its axis, time_constant m' = gain nu_r - m. Neutral: gain 0.

    Source: the first-order approximation of Cummins' (1962) retardation function; after Fossen (2021).
    """

    name = "fluid_memory"
    units = {"gain": "N s/m or N m s", "time_constant": "s"}
    # A shorter memory is damping and added mass, to all that a log shows: gain (nu_r - time_constant nu_r').
    plausible = {"time_constant": (0.2, np.inf)}
    confused_with = ("linear_damping", "added_mass")
    shown_by = "stops and reversals, with times around the time constant"
    advice = "the wake catches up with the hull: damping depends on the motion's past"

    gain: Float[Array, "6"]
    time_constant: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6), zeros(6) + 1.0)

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return tuple(
            Suspect(cls, dof, {"gain": (i,), "time_constant": (6 + i,)})
            for i, dof in enumerate(DOFS)
            if dof in craft.dof
        )

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return (
            f"part of the damping in {found.target} comes late: {estimate(found, 'gain')}, building up over "
            f"{estimate(found, 'time_constant')}"
        )

    def __call__(self, motion: Motion) -> Wrench:
        return -self.gain * motion.lagged
