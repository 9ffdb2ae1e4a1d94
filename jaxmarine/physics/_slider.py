"""A mass that slides inside the vehicle to trim it, moved by a servo that follows a command."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar, Times, Vector3, Velocity, Wrench
from ._actuators import step_lengths
from ._body import Load, rigid_body_matrix
from ._frames import skew


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


class Slider(eqx.Module):
    """A point mass on a straight rail in the vehicle, which its command moves.

    - `mass` [kg], part of the vehicle's mass; `position` [m] from `o` at command 0, where the file's
      masses have it; unit `direction` of the rail.
    - `travel` [m] along the direction at command 1; `time_constant` [s] of the servo.

    Source: thesis (7.1) and appendix B, with the momenta of both bodies about `o` written out: the slider
    adds its Coriolis force and its own acceleration, and the mass matrix holds it where it is. The printed
    V, (7.2) and (B.31), does not agree with those momenta.
    """

    mass: Scalar
    position: Vector3
    direction: Vector3
    travel: Scalar
    time_constant: Scalar
    name: str = eqx.field(static=True)

    def slides(self, t: Times, commands: Times) -> Slide:
        """The motion over each hold, one row per sample; at rest at the first command before that."""
        goals = self.travel * commands

        def hold(state, now):
            offset, rate = state
            goal, t, dt = now
            slide = Slide(offset, rate, goal, t, self.time_constant)
            return slide(t + dt)[:2], slide

        start = (goals[0], jnp.zeros_like(goals[0]))
        return jax.lax.scan(hold, start, (goals, t, step_lengths(t)))[1]

    def moved(self, load: Load, offset: Scalar) -> Load:
        """What is carried with the slider `offset` [m] along its rail."""
        place = self.position + offset * self.direction
        shift = self.mass * load.gravity * (place - self.position)
        return dataclasses.replace(
            load,
            rigid=load.rigid + self._alone(place) - self._alone(self.position),
            weight_moment=load.weight_moment + shift,
        )

    def _alone(self, place: Vector3):
        return rigid_body_matrix(self.mass, -self.mass * skew(place) @ skew(place), place)

    def reaction(self, slide: tuple[Scalar, Scalar, Scalar], nu: Velocity) -> Wrench:
        """V nu + b at `o`, on the left-hand side: m (2 w x r' + r'') and its moment at r [N, N m].

        - `slide`: position, rate and acceleration along the rail.
        """
        offset, rate, acceleration = slide
        place = self.position + offset * self.direction
        force = self.mass * (2.0 * rate * jnp.cross(nu[3:], self.direction) + acceleration * self.direction)
        return jnp.concatenate([force, jnp.cross(place, force)])
