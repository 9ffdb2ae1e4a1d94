"""Stage sensor: what the log shows of a motion, in the order lever arm, misalignment, scale, earth axes,
compass, delay.

Each touches only the channels that it names; logged accelerations stay true and of `o`.
"""

import dataclasses
from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Matrix3, Scalar
from ..physics import LATE, apply
from ._base import AbstractEffect, Craft, Readings, SensorEffect, Suspect, free, scalar, zeros


def _with_velocity(readings: Readings, velocity) -> Readings:
    return dataclasses.replace(readings, nu=jnp.concatenate([velocity, readings.nu[3:]]))


class VelocityLeverArm(SensorEffect):
    """The velocity is that of the point (x, y, z): v + w x r. Neutral: 0. Source: after Fossen (2021)."""

    name = "velocity_lever_arm"
    units = {"x": "m", "y": "m", "z": "m"}
    confused_with = ("coupled_damping", "velocity_misalignment")
    shown_by = "turns on the spot about each axis"
    advice = "enter where the velocity sensor sits: its readings are not those of the origin"

    x: Scalar
    y: Scalar
    z: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        roll, pitch, yaw = (free(craft, dof) for dof in ("roll", "pitch", "yaw"))
        u, v, w = (free(craft, dof) for dof in ("surge", "sway", "heave"))
        wanted = {
            "x": (v and yaw) or (w and pitch),
            "y": (u and yaw) or (w and roll),
            "z": (u and pitch) or (v and roll),
        }
        slots = {name: (i,) for i, name in enumerate("xyz") if wanted[name]}
        return (Suspect(cls, None, slots),) if slots else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        arm = jnp.stack([self.x, self.y, self.z])
        return _with_velocity(readings, readings.nu[:3] + jnp.cross(readings.nu[3:], arm))


class VelocityMisalignment(SensorEffect):
    """The velocity sensor is turned about z: logged = Rz(yaw) (u, v, w). Neutral: 0.

    Source: Doppler log alignment; Kinsey and Whitcomb, IEEE J. Oceanic Eng. (2007).
    """

    name = "velocity_misalignment"
    units = {"yaw": "rad"}
    confused_with = ("velocity_in_earth_axes",)
    shown_by = "straight runs with position measured"
    advice = "align the velocity sensor with the hull, or enter its angle"

    yaw: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        both = "surge" in craft.dof and "sway" in craft.dof
        return (Suspect(cls, None, {"yaw": (0,)}),) if both else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        u, v, w = readings.nu[:3]
        c, s = jnp.cos(self.yaw), jnp.sin(self.yaw)
        return _with_velocity(readings, jnp.stack([c * u - s * v, s * u + c * v, w]))


class VelocityScale(SensorEffect):
    """Logged velocities are `factor` times the true ones. Neutral: 1.

    Source: sound-speed scale error of a Doppler log; Hegrenaes and Hallingstad (2011).
    """

    name = "velocity_scale"
    units = {"factor": "1"}
    confused_with = ("thruster_gain:all", "quadratic_damping")
    shown_by = "straight runs with position measured"
    advice = "check the velocity sensor's sound speed and units"

    factor: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(1.0))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        moving = free(craft, "surge", "sway", "heave")
        return (Suspect(cls, None, {"factor": (0,)}),) if moving else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        return _with_velocity(readings, self.factor * readings.nu[:3])


class VelocityInEarthAxes(SensorEffect):
    """The logged velocity is north-east-down instead of body: (1 - f) v + f R v. Neutral: 0.

    Source: a wrong topic or setting of an inertial navigation unit.
    """

    name = "velocity_in_earth_axes"
    units = {"fraction": "1"}
    confused_with = ("velocity_misalignment",)
    shown_by = "runs on several headings"
    advice = "the navigation unit reports velocities in earth axes: turn them into body axes"

    fraction: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        moving = free(craft, "surge", "sway") and free(craft, "yaw", "roll", "pitch")
        # Fully in earth axes is the common mistake, and far from neutral: a start of its own.
        return (Suspect(cls, None, {"fraction": (0,)}, ({"fraction": 1.0},)),) if moving else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        body = readings.nu[:3]
        return _with_velocity(readings, (1.0 - self.fraction) * body + self.fraction * apply(rotation, body))


class GyroBias(SensorEffect):
    """Logged rates are the true ones plus a constant. Neutral: 0. Source: after Fossen (2021)."""

    name = "gyro_bias"
    units = {"p": "rad/s", "q": "rad/s", "r": "rad/s"}
    confused_with = ("constant_wrench",)
    shown_by = "rest, with attitude measured"
    advice = "calibrate the gyros: a constant is added to the rates"

    p: Scalar
    q: Scalar
    r: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        axes = zip("pqr", ("roll", "pitch", "yaw"), strict=True)
        slots = {name: (i,) for i, (name, dof) in enumerate(axes) if dof in craft.dof}
        return (Suspect(cls, None, slots),) if slots else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        bias = jnp.concatenate([jnp.zeros(3), jnp.stack([self.p, self.q, self.r])])
        return dataclasses.replace(readings, nu=readings.nu + bias)


class CompassDeviation(SensorEffect):
    """Logged heading is the true psi plus constant + cos cos(psi) + sin sin(psi). Neutral: 0.

    The coefficients A, B and C of a compass, by the true heading; the logged velocities are not touched.
    Source: after NGA, Handbook of Magnetic Compass Adjustment (2004).
    """

    name = "compass_deviation"
    units = {"constant": "rad", "cos": "rad", "sin": "rad"}
    confused_with = ("velocity_misalignment", "gyro_bias")
    shown_by = "straight runs on several headings, with position and velocity measured"
    advice = "swing the compass: iron and currents on board turn it, on some headings more than on others"

    constant: Scalar
    cos: Scalar
    sin: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(scalar(), scalar(), scalar())

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        slots = {"constant": (0,), "cos": (1,), "sin": (2,)}
        return (Suspect(cls, None, slots),) if free(craft, "yaw") else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        phi, theta, psi = readings.attitude
        off = self.constant + self.cos * jnp.cos(psi) + self.sin * jnp.sin(psi)
        return dataclasses.replace(readings, attitude=jnp.stack([phi, theta, psi + off]))


class SensorDelay(AbstractEffect):
    """The channels of a kind show what was `delay` seconds before. Neutral: 0.

    What a sensor showed before is not known from one state: `physics.late` reads it along the track.
    Source: transport delay; after Fossen (2021).
    """

    name = "sensor_delay"
    units = {"delay": "s"}
    plausible = {"delay": (0.0, 2.0)}
    confused_with = ("input_delay", "thruster_lag")
    shown_by = "quick turns and changes of speed, with all sensors logged"
    advice = "look at the filter and the time stamps of this sensor: what it logs is old"

    delay: Float[Array, "kinds"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(len(LATE)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        moves = free(craft, "surge", "sway", "heave")
        turns = free(craft, "roll", "pitch", "yaw")
        there = {"position": moves, "attitude": turns, "velocity": moves, "rate": turns}
        return tuple(Suspect(cls, kind, {"delay": (i,)}) for i, kind in enumerate(LATE) if there[kind])
