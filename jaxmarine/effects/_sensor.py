"""Stage sensor: what the log shows of a motion, in the order lever arm, misalignment, scale, earth axes,
compass, delay.

Each touches only the channels that it names; logged accelerations stay true and of `o`.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Self

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numbers import percent, plus_minus
from .._types import Matrix3, Scalar
from ..physics import LATE, apply
from ._base import (
    AbstractEffect,
    Craft,
    Filed,
    Readings,
    SensorEffect,
    Suspect,
    each,
    free,
    scalar,
    whole,
    zeros,
)
from ._words import FROM_ORIGIN, Found, degrees, estimate, place_of, value_of


def _with_velocity(readings: Readings, velocity) -> Readings:
    return dataclasses.replace(readings, nu=jnp.concatenate([velocity, readings.nu[3:]]))


# A delay is told from half a sample on, and from this on [s]: less is how times are stamped.
_SHARE, _LEAST = 0.5, 0.05
# A deviation is told from this on [rad]: a compass is seldom better.
_DEVIATES = 0.03


class VelocityLeverArm(SensorEffect):
    """The velocity is that of the point (x, y, z): v + w x r. Neutral: 0. Source: after Fossen (2021)."""

    name = "velocity_lever_arm"
    titled = "place of the velocity sensor"
    units = {"x": "m", "y": "m", "z": "m"}
    confused_with = ("coupled_damping", "velocity_misalignment")
    shown_by = "turns on the spot about each axis"
    advice = "enter where the velocity sensor sits: its readings are not those of the origin"

    x: Scalar
    y: Scalar
    z: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        roll, pitch, yaw = (free(craft, dof) for dof in ("roll", "pitch", "yaw"))
        u, v, w = (free(craft, dof) for dof in ("surge", "sway", "heave"))
        wanted = {
            "x": (v and yaw) or (w and pitch),
            "y": (u and yaw) or (w and roll),
            "z": (u and pitch) or (v and roll),
        }
        return whole(cls, [name for name in "xyz" if wanted[name]])

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        place = place_of(found, FROM_ORIGIN)
        return f"the logged velocity is that of a point {place} the body origin, not of the origin"

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        arm = jnp.stack([self.x, self.y, self.z])
        return _with_velocity(readings, readings.nu[:3] + jnp.cross(readings.nu[3:], arm))


class VelocityMisalignment(SensorEffect):
    """The velocity sensor is turned about z: logged = Rz(yaw) (u, v, w). Neutral: 0.

    Source: Doppler log alignment; after Kinsey and Whitcomb, IEEE J. Oceanic Eng. (2007).
    """

    name = "velocity_misalignment"
    titled = "misaligned velocity sensor"
    units = {"yaw": "rad"}
    confused_with = ("velocity_in_earth_axes",)
    shown_by = "straight runs with position measured"
    advice = "align the velocity sensor with the hull, or enter its angle"

    yaw: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if {"surge", "sway"} <= {*craft.dof} else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        yaw = found.parameters["yaw"]
        angle = plus_minus(math.degrees(abs(yaw.value)), math.degrees(yaw.std))
        logged, sensor = ("starboard", "port") if yaw.value >= 0 else ("port", "starboard")
        return (
            f"the logged velocity is turned by {angle}° to {logged}: the velocity sensor sits turned "
            f"by as much to {sensor}"
        )

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        u, v, w = readings.nu[:3]
        c, s = jnp.cos(self.yaw), jnp.sin(self.yaw)
        return _with_velocity(readings, jnp.stack([c * u - s * v, s * u + c * v, w]))


class VelocityScale(SensorEffect):
    """Logged velocities are `factor` times the true ones. Neutral: 1.

    Source: sound-speed scale error of a Doppler log; after Hegrenaes and Hallingstad (2011).
    """

    name = "velocity_scale"
    titled = "scale of the velocity sensor"
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
        return whole(cls, cls.units if free(craft, "surge", "sway", "heave") else ())

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        factor = value_of(found, "factor")
        wrong = f"{percent(abs(factor - 1))} too {'large' if factor >= 1 else 'small'}"
        return f"the logged velocity is {estimate(found, 'factor')} times the true one: {wrong}"

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        return _with_velocity(readings, self.factor * readings.nu[:3])


class VelocityInEarthAxes(SensorEffect):
    """The logged velocity is north-east-down instead of body: (1 - f) v + f R v. Neutral: 0.

    Source: a wrong topic or setting of an inertial navigation unit.
    """

    name = "velocity_in_earth_axes"
    titled = "velocity logged in earth axes"
    units = {"fraction": "1"}
    confused_with = ("velocity_misalignment",)
    shown_by = "runs on several headings"
    advice = "the navigation unit reports velocities in earth axes: turn them into body axes"

    fraction: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        moving = free(craft, "surge", "sway") and free(craft, "yaw", "roll", "pitch")
        # Fully in earth axes is the common mistake, and far from neutral: a start of its own.
        return whole(cls, cls.units if moving else (), {"fraction": 1.0})

    @classmethod
    def contradicts(cls, target: str | None, values: Mapping[str, float], dt: float) -> str:
        del target, values, dt
        return "The logged velocities are in earth axes: turn them into body axes."

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        if value_of(found, "fraction") > 0.9:
            return (
                "the logged velocity is in earth axes (north, east, down) instead of body axes "
                f"(fraction {estimate(found, 'fraction')})"
            )
        part = estimate(found, "fraction", 100.0, "%")
        return f"{part} of the logged velocity is in earth axes (north, east, down), the rest in body axes"

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        body = readings.nu[:3]
        return _with_velocity(readings, (1.0 - self.fraction) * body + self.fraction * apply(rotation, body))


class GyroBias(SensorEffect):
    """Logged rates are the true ones plus a constant. Neutral: 0. Source: after Fossen (2021)."""

    name = "gyro_bias"
    titled = "bias of the gyros"
    units = {"p": "rad/s", "q": "rad/s", "r": "rad/s"}
    confused_with = ("constant_wrench",)
    shown_by = "rest, with attitude measured"
    advice = "calibrate the gyros: a constant is added to the rates"

    p: Scalar
    q: Scalar
    r: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        axes = zip("pqr", ("roll", "pitch", "yaw"), strict=True)
        return whole(cls, [name for name, dof in axes if dof in craft.dof])

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        rates = ", ".join(f"{name} {degrees(found, name, ' °/s')}" for name in found.parameters)
        return f"the logged turning rates are the true ones plus a constant ({rates})"

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
    titled = "deviation of the compass"
    units = {"constant": "rad", "cos": "rad", "sin": "rad"}
    confused_with = ("velocity_misalignment", "gyro_bias")
    shown_by = "straight runs on several headings, with position and velocity measured"
    advice = "swing the compass: iron and currents on board turn it, on some headings more than on others"

    constant: Scalar
    cos: Scalar
    sin: Scalar

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return whole(cls, cls.units if free(craft, "yaw") else ())

    @classmethod
    def contradicts(cls, target: str | None, values: Mapping[str, float], dt: float) -> str:
        del target, dt
        if math.hypot(values["cos"], values["sin"]) < _DEVIATES:
            return ""
        return (
            f"The logged heading deviates from the true one by {values['constant']:.2f} + {values['cos']:.2f}"
            f" cos(psi) + {values['sin']:.2f} sin(psi) rad: swing the compass."
        )

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        times = {"constant": "", "cos": " cos(psi)", "sin": " sin(psi)"}
        parts = [f"{degrees(found, name)}{by}" for name, by in times.items()]
        return f"the logged heading is the true one plus {' + '.join(parts)}"

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

    delay: Float[Array, " kinds"]

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(zeros(len(LATE)))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        moves = free(craft, "surge", "sway", "heave")
        turns = free(craft, "roll", "pitch", "yaw")
        there = {"position": moves, "attitude": turns, "velocity": moves, "rate": turns}
        # The slope at zero says little of a sensor that is late by longer than a motion takes to begin.
        some = each(cls, LATE, {"delay": 0.3})
        return tuple(suspect for suspect in some if there[str(suspect.target)])

    @classmethod
    def longest(cls, dt: float) -> int:
        """Samples, `dt` [s] apart, that a sensor may be late by, and one more."""
        return math.ceil(cls.plausible["delay"][1] / dt - 1e-3) + 1

    @classmethod
    def title(cls, target: str | None) -> str:
        return super().title(target) if target is None else f"late {target}"

    @classmethod
    def contradicts(cls, target: str | None, values: Mapping[str, float], dt: float) -> str:
        if values["delay"] < max(_LEAST, _SHARE * dt):
            return ""
        return f"The logged {target} comes {values['delay']:.2f} s late beside the other sensors."

    @classmethod
    def said(cls, found: Found, craft: Filed) -> str:
        del craft
        return f"the logged {found.target} comes {estimate(found, 'delay')} late"
