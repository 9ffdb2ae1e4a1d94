"""Rigid body, added mass and what they weigh."""

import equinox as eqx
import jax.numpy as jnp

from .._types import Matrix3, Matrix6, Scalar, Vector3, Velocity, Wrench
from ._frames import apply, skew


def rigid_body_matrix(mass: Scalar, inertia: Matrix3, cog: Vector3) -> Matrix6:
    """M_RB about `o` from mass [kg], inertia about `o` [kg m²] and centre of gravity [m].

    After Fossen (2021).
    """
    lever = mass * skew(cog)
    return jnp.block([[mass * jnp.eye(3), -lever], [lever, inertia]])


def coriolis(matrix: Matrix6, nu: Velocity) -> Wrench:
    """The wrench `C(nu) nu` of a symmetric mass matrix (Kirchhoff's equations; after Fossen 2021).

    With the momentum `(a, b) = M nu` it is `(w x a, v x a + w x b)`, so `nu' C(nu) nu = 0`.
    """
    momentum = apply(matrix, nu)
    a, b = momentum[:3], momentum[3:]
    v, w = nu[:3], nu[3:]
    return jnp.concatenate([jnp.cross(w, a), jnp.cross(v, a) + jnp.cross(w, b)])


class Load(eqx.Module):
    """What the vehicle carries: masses, and the forces of weight and buoyancy with their lever arms.

    - `rigid`, `added`: mass matrices about `o` [kg, kg m, kg m²].
    - `weight`, `buoyancy`: forces [N]; `weight_moment`, `buoyancy_moment`: force times point of
      attack from `o` [N m], summed over what is carried.
    - `density` [kg/m³], `gravity` [m/s²]: of the place.
    """

    rigid: Matrix6
    added: Matrix6
    weight: Scalar
    weight_moment: Vector3
    buoyancy: Scalar
    buoyancy_moment: Vector3
    density: Scalar
    gravity: Scalar

    def restoring(self, down: Vector3) -> Wrench:
        """g(eta), on the left-hand side; `down` is the unit vector downwards in body axes.

        after Fossen (2021); thesis (4.6), of which its (4.7) prints y_b for y_g in row 6.
        """
        force = (self.weight - self.buoyancy) * down
        moment = jnp.cross(self.weight_moment - self.buoyancy_moment, down)
        return -jnp.concatenate([force, moment])
