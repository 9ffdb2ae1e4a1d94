"""The control wrench that a motion needs, before anything has gone wrong."""

import equinox as eqx
import jax
from jaxtyping import Array, Float

from ..vehicle import Vehicle, inverse_dynamics
from ._path import Reference


@eqx.filter_jit
def feedforward(vehicle: Vehicle, reference: Reference) -> Float[Array, "times 6"]:
    """The wrench [N, N m] at `o`, body axes, with which the vehicle moves as the reference does.

    Every term is taken at the *reference* velocity. With the measured one in its place the estimated
    damping is positive feedback: estimates that are a tenth too large make the loop unstable, while
    thesis (5.26) does not say which is meant.

    A wrench that is held for dt belongs to the middle of its hold:
    `feedforward(vehicle, path.at(t + dt / 2))`. For vehicles without fluid memory.
    """
    if vehicle.plant().has_memory:
        raise ValueError("Feedforward needs a vehicle without fluid memory: a reference has none.")
    return jax.vmap(lambda state, nu_dot, t: inverse_dynamics(vehicle, state, nu_dot, t))(
        reference.states, reference.acceleration, reference.t
    )
