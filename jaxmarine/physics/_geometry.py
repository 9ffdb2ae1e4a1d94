"""Mass properties of a craft that is built from simple bodies.

A craft is a sum of elements. Each is a solid of uniform density, or a wall around a concentric cavity that
may hold something else. Sums over the elements give mass, displaced volume, centres and inertia.
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._types import Matrix3, Matrix6, Quaternion, Scalar, Vector3
from ._body import rigid_body_matrix
from ._frames import rotation, skew


def _array(value: ArrayLike | Sequence[float]) -> Array:
    """So that fields take plain numbers and lists of them."""
    return jnp.asarray(value, float)


class AbstractSolid(eqx.Module):
    """A solid of uniform density, its centre at the origin and its principal axes along x, y, z."""

    @property
    @abc.abstractmethod
    def volume(self) -> Scalar:
        """Volume [m³]."""

    @property
    @abc.abstractmethod
    def gyration(self) -> Vector3:
        """Moments of inertia per mass about x, y, z through the centre [m²]."""


class Cylinder(AbstractSolid):
    """A cylinder along x: `length`, `radius` [m]. Thesis, (5.12) and (5.13), there along z."""

    length: Scalar = eqx.field(converter=_array)
    radius: Scalar = eqx.field(converter=_array)

    @property
    def volume(self) -> Scalar:
        return jnp.pi * self.radius**2 * self.length

    @property
    def gyration(self) -> Vector3:
        across = self.radius**2 / 4 + self.length**2 / 12
        return jnp.stack([self.radius**2 / 2, across, across])


class Box(AbstractSolid):
    """A box with the edges `size` along x, y, z [m]."""

    size: Vector3 = eqx.field(converter=_array)

    @property
    def volume(self) -> Scalar:
        return jnp.prod(self.size)

    @property
    def gyration(self) -> Vector3:
        squares = self.size**2
        return (squares.sum() - squares) / 12


class Sphere(AbstractSolid):
    """A ball of `radius` [m]."""

    radius: Scalar = eqx.field(converter=_array)

    @property
    def volume(self) -> Scalar:
        return 4 / 3 * jnp.pi * self.radius**3

    @property
    def gyration(self) -> Vector3:
        return jnp.full(3, 2 / 5 * self.radius**2)


class Element(eqx.Module):
    """A body somewhere in the craft: a hull, without or with a concentric cavity in it.

    - `hull`: the outer shape, which displaces water; `cavity`: a smaller one, or None for a solid.
    - `mass`: of the solid, or of the wall between hull and cavity [kg], spread evenly over its volume.
    - `contents`: mass of what fills the cavity evenly [kg]; it must be zero without a cavity.
    - `position`: of the centre from `o` [m]; `attitude`: turns the element's axes into the craft's.

    A tube that is open at its ends has a cavity as long as its hull, a closed one a shorter cavity. The
    wall's inertia is a difference of two solids: a wall thinner than 1e-8 of its radius has no digits left.
    """

    hull: AbstractSolid
    cavity: AbstractSolid | None
    mass: Scalar = eqx.field(converter=_array)
    contents: Scalar = eqx.field(converter=_array)
    position: Vector3 = eqx.field(converter=_array)
    attitude: Quaternion = eqx.field(converter=_array)

    @property
    def total_mass(self) -> Scalar:
        """Wall and contents [kg]."""
        return self.mass + self.contents

    @property
    def gyration(self) -> Vector3:
        """Moments of inertia about the element's own axes through its centre [kg m²]."""
        hull, cavity = self.hull, self.cavity
        if cavity is None:
            return self.mass * hull.gyration
        wall = hull.volume * hull.gyration - cavity.volume * cavity.gyration
        return self.mass * wall / (hull.volume - cavity.volume) + self.contents * cavity.gyration

    @property
    def inertia(self) -> Matrix3:
        """Inertia about the craft's origin, in its axes [kg m²].

        Turned, T I T' (thesis, (5.8)), and moved by the parallel axes, I - m S(r) S(r) ((5.10), with the
        vector r from the origin to the centre).
        """
        turn = rotation(self.attitude)
        arm = skew(self.position)
        return turn @ jnp.diag(self.gyration) @ turn.T - self.total_mass * arm @ arm


class Assembly(eqx.Module):
    """Elements that are rigidly joined to one craft. Thesis, sec. 5.1 and 5.2.1.

    Everything is about the origin `o` of the craft, in its axes.
    """

    elements: tuple[Element, ...]

    @property
    def mass(self) -> Scalar:
        """Total mass [kg]."""
        return sum((e.total_mass for e in self.elements), jnp.zeros(()))

    @property
    def volume(self) -> Scalar:
        """Displaced volume [m³]; elements that share space count twice."""
        return sum((e.hull.volume for e in self.elements), jnp.zeros(()))

    @property
    def cog(self) -> Vector3:
        """Centre of gravity [m]."""
        return sum((e.total_mass * e.position for e in self.elements), jnp.zeros(3)) / self.mass

    @property
    def cob(self) -> Vector3:
        """Centre of buoyancy, that of the displaced volume [m]."""
        return sum((e.hull.volume * e.position for e in self.elements), jnp.zeros(3)) / self.volume

    @property
    def inertia(self) -> Matrix3:
        """Inertia about `o` [kg m²]."""
        return sum((e.inertia for e in self.elements), jnp.zeros((3, 3)))

    @property
    def inertia_at_cog(self) -> Matrix3:
        """Inertia about the centre of gravity [kg m²]."""
        arm = skew(self.cog)
        return self.inertia + self.mass * arm @ arm

    @property
    def matrix(self) -> Matrix6:
        """M_RB about `o`; thesis, (5.16), with the inertia about `o` in its lower right block."""
        return rigid_body_matrix(self.mass, self.inertia, self.cog)
