"""What no craft can have: of the plants of a model their bodies, and what brakes them."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._compiled import compiled
from ..effects import Motion
from ..physics import damping
from ..vehicle import Plant, Vehicle

# Share of its own mass that a vehicle may have more or less, and how often the file's inertia of an axis,
# added mass included, it may have at most or must have at least.
MASS, INERTIA = 0.5, 5.0


def of_a_craft(
    vehicle: Vehicle,
    plant_of: Callable[..., Plant],
    theta: Float[Array, "segments slots"],
    along: Float[np.ndarray, " thrusters"],
    met: int,
) -> bool:
    """Whether bodies and thrusters can be those of a craft, in the first `met` segments.

    A positive definite mass, at most half of the vehicle's own mass more or less, on each axis a fifth to
    five times the inertia of the file; no negative delays, lags and dead zones, no thrust that the flow turns
    round.

    - `along`: as of `_bodies`.
    """
    own, free = float(vehicle.body.matrix[0, 0]), np.flatnonzero(vehicle.free)
    filed = np.diag(np.asarray(vehicle.mass_matrix))[free]
    bodies = _bodies(plant_of, theta, jnp.asarray(along))
    for rigid, added, least in zip(*(np.asarray(one)[:met] for one in bodies), strict=True):
        mass = rigid + added
        if not np.isfinite(mass).all() or not abs(rigid[0, 0] - own) <= MASS * own:
            return False
        ratio = np.diag(mass)[free] / filed
        if ratio.min() < 1 / INERTIA or ratio.max() > INERTIA:
            return False
        if np.linalg.eigvalsh((0.5 * (mass + mass.T))[np.ix_(free, free)])[0] <= 0:
            return False
        if least < -1e-9:
            return False
    return True


def braking_holds(
    free: Bool[np.ndarray, "6"],
    braking: Float[np.ndarray, "segments 6"],
    coupled: Float[np.ndarray, "segments 6 6"],
) -> Bool[np.ndarray, "6 6"]:
    """On the diagonal whether each free axis is braked in all segments, off it whether any motion of two is.

    Of a linear coupling both terms come to at most twice the geometric mean of what brakes the two, as D + D'
    is positive (after Fossen 2021, on damping).
    """
    both = coupled + coupled.swapaxes(1, 2)
    pairs = both**2 <= 4 * braking[:, :, None] * braking[:, None, :]
    out = np.where(np.eye(6, dtype=bool), braking[:, :, None] >= 0, pairs).all(axis=0)
    return out | ~(free[:, None] & free)


@compiled
def braked(
    plant_of: Callable[..., Plant],
    theta: Float[Array, "segments slots"],
    speed: Float[Array, "6"],
) -> Float[Array, "segments 6"]:
    """What each axis is braked by in each segment [N s/m, N m s]: the force over the speed, gear at rest.

    - `speed` [m/s, rad/s]: ahead, and of each other axis beside going ahead. What comes late brakes as much
      in the end.
    """
    size = jnp.maximum(speed, 1e-3)
    ahead = jnp.eye(6)[0] * size[0]

    def one(theta: Array, segment: Array) -> Array:
        plant = plant_of(theta, segment)
        still = jnp.zeros(plant.drive.lag.shape[-1])

        def wrench(nu: Array) -> Array:
            motion = Motion(jnp.zeros(3), jnp.eye(3), nu, nu, nu, jnp.zeros(()), still)
            own = damping(plant.damping.linear, plant.damping.quadratic, nu)
            return sum((effect(motion) for effect in plant.wrenches), plant.pushed(still, nu) - own)

        beside = jax.vmap(wrench)(
            jnp.concatenate([ahead[None] + jnp.diag(size), ahead[None] - jnp.diag(size)])
        )
        slopes = jnp.diagonal(beside[:6] - beside[6:]) / (2 * size)
        surge = (wrench(ahead) - wrench(jnp.zeros(6)))[0] / size[0]
        return -slopes.at[0].set(surge)

    return jax.vmap(one)(theta, jnp.arange(len(theta)))


@compiled
def water_of(plant_of: Callable[..., Plant], theta: Float[Array, " slots"], segment) -> Float[Array, "3"]:
    return plant_of(theta, segment).water


@compiled
def _bodies(
    plant_of: Callable[..., Plant],
    theta: Float[Array, "segments slots"],
    along: Float[Array, " thrusters"],
):
    """Rigid and added mass in each segment, and the least of the thrusters' limits and zero.

    - `along`: speed [m/s] along each thruster, at which the flow must leave some of its thrust.
    """

    def one(theta, segment):
        plant = plant_of(theta, segment)
        drive = plant.drive
        left = 1.0 - drive.inflow[: len(along)] * along
        limits = jnp.concatenate([drive.delay, drive.deadband, drive.lag, drive.saturation, left])
        return plant.load.rigid, plant.load.added, jnp.min(limits, initial=0.0)

    return jax.vmap(one)(theta, jnp.arange(len(theta)))
