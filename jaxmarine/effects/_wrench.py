"""Stage wrench: forces and moments on the hull, on the right-hand side, body axes at `o`."""

from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import DOFS, Matrix6, Scalar, Wrench
from ..actuators import Wind
from ..physics import apply, norm
from ._actuator import all_of
from ._base import Craft, Motion, Suspect, WrenchEffect, free, per_dof, scalar, zeros


class ConstantWrench(WrenchEffect):
    """A constant force or moment in body axes. Neutral: 0. Source: bias forces, after Fossen (2021)."""

    name = "constant_wrench"
    units = {"value": "N or N m"}
    confused_with = ("buoyancy", "trim", "steady_current")
    shown_by = "rest, and roll, pitch and heading changed widely"
    advice = "a steady push in body axes: a thruster that never stops, a bent fin, a cable under tension"

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return per_dof(cls, craft)

    def __call__(self, motion: Motion) -> Wrench:
        del motion
        return self.value


class LinearDamping(WrenchEffect):
    """More damping in proportion to the velocity of one axis. Neutral: 0. Source: thesis (5.24)."""

    name = "linear_damping"
    units = {"value": "N s/m or N m s"}
    confused_with = ("quadratic_damping", "fluid_memory", "inflow_loss")
    shown_by = "slow and fast motion along that axis"
    advice = "more or less drag than the file says at low speed"

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return per_dof(cls, craft)

    def __call__(self, motion: Motion) -> Wrench:
        return -self.value * motion.nu_r


class QuadraticDamping(WrenchEffect):
    """More damping with the square of the velocity of one axis. Neutral: 0. Source: thesis (5.24)."""

    name = "quadratic_damping"
    units = {"value": "N s²/m² or N m s²"}
    confused_with = ("linear_damping", "tether_drag", "inflow_loss")
    shown_by = "slow and fast motion along that axis"
    advice = "more or less drag than the file says at high speed: fouling, new parts in the flow"

    value: Float[Array, "6"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(6))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return per_dof(cls, craft)

    def __call__(self, motion: Motion) -> Wrench:
        return -self.value * jnp.abs(motion.nu_r) * motion.nu_r


class CoupledDamping(WrenchEffect):
    """Linear damping on one axis from the velocity of another. Neutral: 0. Source: thesis (5.24)."""

    name = "coupled_damping"
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

    def __call__(self, motion: Motion) -> Wrench:
        return -apply(self.value, motion.nu_r)


class HullLift(WrenchEffect):
    """Lift of a hull at an angle of attack: Y = -Y_uv |u| v, N = -N_uv u v, Z = -Z_uw |u| w, M = -M_uw u w.

    Neutral: 0. The forces oppose the drift going ahead and astern: with u in the place of |u| they would feed
    energy to a craft that goes astern. The moments change sign with u, as the Munk moment does.
    Source: after Fossen (2021), on lift and Munk moment; Prestero (2001).
    """

    name = "hull_lift"
    units = {"Y_uv": "N s²/m²", "N_uv": "N s²/m", "Z_uw": "N s²/m²", "M_uw": "N s²/m"}
    confused_with = ("coupled_damping", "added_mass")
    shown_by = "sway and heave at speed, turns"
    advice = "fins or hull shape carry lift that the file does not have"

    Y_uv: Scalar
    N_uv: Scalar
    Z_uw: Scalar
    M_uw: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar(), scalar())

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
        slots = {
            name: (i,)
            for i, (name, (acted, moving)) in enumerate(pairs.items())
            if acted in craft.dof and moving in craft.dof
        }
        return (Suspect(cls, None, slots),) if slots else ()

    def __call__(self, motion: Motion) -> Wrench:
        u, v, w = motion.nu_r[:3]
        zero, speed = jnp.zeros_like(u), jnp.abs(u)
        return -jnp.stack(
            [zero, self.Y_uv * speed * v, self.Z_uw * speed * w, zero, self.M_uw * u * w, self.N_uv * u * v]
        )


class TurningLift(WrenchEffect):
    """Lift of a hull that turns while it makes way: Y = -Y_ur u r, N = -N_ur |u| r. Neutral: 0.

    The moment brakes the turn going ahead and astern. Source: after Fossen (2021), on lift of the hull and
    its fins; Yasukawa and Yoshimura (2015), the linear yaw-rate terms of the hull forces.
    """

    name = "turning_lift"
    units = {"Y_ur": "N s²", "N_ur": "N m s²"}
    confused_with = ("hull_lift", "coupled_damping", "linear_damping:yaw")
    shown_by = "turns at several speeds, ahead and astern"
    advice = "the stern or its fins carry lift in turns that the file does not have"

    Y_ur: Scalar
    N_ur: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        if not (free(craft, "surge") and free(craft, "yaw")):
            return ()
        return (Suspect(cls, None, {"Y_ur": (0,), "N_ur": (1,)} if free(craft, "sway") else {"N_ur": (1,)}),)

    def __call__(self, motion: Motion) -> Wrench:
        u, r = motion.nu_r[0], motion.nu_r[5]
        zero = jnp.zeros_like(u)
        return -jnp.stack([zero, self.Y_ur * u * r, zero, zero, zero, self.N_ur * jnp.abs(u) * r])


class TetherDrag(WrenchEffect):
    """Drag of a towed cable at `o`, along the relative velocity: -coefficient |v_r| v_r. Neutral: 0.

    Source: cross-flow drag of a cable element, after Fossen (2021); the three axes share one speed.
    """

    name = "tether_drag"
    units = {"coefficient": "N s²/m²"}
    plausible = {"coefficient": (0.0, np.inf)}
    confused_with = ("quadratic_damping", "inflow_loss")
    shown_by = "fast motion along several translations, also combined"
    advice = "the cable drags: pay out slack, or keep its drag in the model"

    coefficient: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return (Suspect(cls, None, {"coefficient": (0,)}),) if free(craft, "surge", "sway", "heave") else ()

    def __call__(self, motion: Motion) -> Wrench:
        v_r = motion.nu_r[:3]
        return jnp.concatenate([-self.coefficient * norm(v_r) * v_r, jnp.zeros(3)])


class WindPush(WrenchEffect):
    """A constant force at `o` in earth axes, as a steady wind's on what stands out of the water. Neutral: 0.

    A vehicle file has no stiffness of a waterplane: what is free in heave is under water, where no wind
    blows. Source: after Fossen (2021), on wind forces; here one that does not turn with the craft.
    """

    name = "wind_push"
    units = {"north": "N", "east": "N"}
    confused_with = ("steady_current", "constant_wrench")
    shown_by = "several headings, at rest and at speed"
    advice = "wind, or a line under tension: nothing to mend; log the wind, and give the file a table [wind]"

    north: Scalar
    east: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        afloat = free(craft, "surge", "sway") and not free(craft, "heave")
        if not afloat or all_of(craft, Wind) is not None:
            return ()
        return (Suspect(cls, None, {"north": (0,), "east": (1,)}),)

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
        slots = {name: (i,) for i, name in enumerate(cls.units)}
        return (Suspect(cls, None, slots),) if free(craft, "surge", "sway") else ()

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

    def __call__(self, motion: Motion) -> Wrench:
        return -self.gain * motion.lagged
