"""Where a vehicle is to be, and how it is to move there: way points become a smooth reference."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
from jaxtyping import Array, Float

from .._errors import InputError
from .._types import Times, Velocity
from ..physics import apply, compose, conjugate, from_euler, rotation
from ..vehicle import State


class Reference(eqx.Module):
    """A motion to follow, at times `t` [s]: `states` and `acceleration` nu' [m/s², rad/s²], one row each."""

    t: Times
    states: State
    acceleration: Float[Array, "times 6"]


@dataclasses.dataclass(frozen=True)
class Path:
    """A smooth path in time: `pose` gives x, y, z [m] NED and roll, pitch, yaw [rad] at a time [s]."""

    pose: scipy.interpolate.CubicSpline

    @property
    def duration(self) -> float:
        """From the first way point to the last [s]."""
        return float(self.pose.x[-1] - self.pose.x[0])

    def at(self, t: Float[np.ndarray, " times"]) -> Reference:
        """The reference at times [s], at rest before the first way point and after the last.

        Velocities and accelerations are those of the path itself, in body axes: they belong to each
        other exactly, as inverse dynamics need it (the reference velocity of thesis (5.26)).
        """
        first, last = self.pose.x[0], self.pose.x[-1]
        inside = ((t >= first) & (t <= last))[:, None]
        now = np.clip(t, first, last)
        pose, rate, second = (jnp.asarray(self.pose(now, order)) for order in range(3))
        states, acceleration = _moving(pose, rate * inside, second * inside)
        return Reference(jnp.asarray(t), states, acceleration)


def _velocity(pose: Float[Array, "6"], rate: Float[Array, "6"]) -> Velocity:
    """Velocity in body axes of a pose that changes by `rate`."""
    attitude, change = jax.jvp(from_euler, (pose[3:],), (rate[3:],))
    # q' = q (0, w) / 2.
    turning = 2.0 * compose(conjugate(attitude), change)[1:]
    return jnp.concatenate([apply(rotation(attitude).T, rate[:3]), turning])


@jax.jit
@jax.vmap
def _moving(pose, rate, second) -> tuple[State, Velocity]:
    velocity, acceleration = jax.jvp(_velocity, (pose, rate), (rate, second))
    return State(pose[:3], from_euler(pose[3:]), velocity, jnp.zeros(0)), acceleration


def plan(t: Float[np.ndarray, " points"], pose: Float[np.ndarray, "points 6"]) -> Path:
    """The cubic spline through way points, at rest at both ends.

    - `t` [s], strictly increasing; `pose`: x, y, z [m] NED, roll, pitch, yaw [rad], not wrapped.

    Accelerations are continuous between the ends, and jump there. Thesis, sec. 5.3 (a path planner whose
    way points become desired accelerations).
    """
    t, pose = np.asarray(t, float), np.asarray(pose, float)
    if t.ndim != 1 or len(t) < 2 or pose.shape != (len(t), 6):
        raise InputError("A path needs at least two way points, each with a time and a pose of six numbers.")
    if not (np.isfinite(t).all() and np.isfinite(pose).all() and (np.diff(t) > 0).all()):
        raise InputError("The way points of a path must be finite, and their times increase.")
    return Path(scipy.interpolate.CubicSpline(t, pose, bc_type="clamped"))


def spiral(
    radius: float, speed: float, depths: tuple[float, float], duration: float, ramp: float, every: float = 1.0
) -> Path:
    """A dive from `depths[0]` to `depths[1]` [m] and back in circles to starboard, heading along them.

    It starts at rest at x = y = 0 heading north, gathers `speed` [m/s] within `ramp` [s], and loses it
    likewise. Depth is a cubic of time on the way down, and one on the way up; a way point stands
    `every` seconds. Thesis, fig. 5.7, which states neither radius nor speed.
    """
    if not (radius > 0 and 0 < ramp <= duration / 2):
        raise InputError("A spiral needs a positive radius, and a ramp of at most half its duration.")
    t = np.linspace(0.0, duration, round(duration / every) + 1)
    # Way along the circle under a speed that rises and falls linearly.
    rising = np.minimum(t, ramp) ** 2 / (2 * ramp) + np.clip(t - ramp, 0.0, None)
    falling = np.clip(t - duration + ramp, 0.0, None) ** 2 / (2 * ramp)
    turned = speed / radius * (rising - falling)
    half = 1.0 - np.abs(2.0 * t / duration - 1.0)
    depth = depths[0] + (depths[1] - depths[0]) * half**2 * (3.0 - 2.0 * half)
    zero = np.zeros_like(t)
    x, y = radius * np.sin(turned), radius - radius * np.cos(turned)
    return plan(t, np.stack([x, y, depth, zero, zero, turned], axis=1))
