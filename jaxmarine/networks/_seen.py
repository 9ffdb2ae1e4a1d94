"""Where in velocity space a network has been fitted, and how it ends there."""

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar

# Share of the data that the region holds: nearly all, since the network is as good there as it ever will
# be (at 0.99 it gave away a fifth of its gain), but single samples far out must not blow it up.
_INSIDE = 0.999
# The network has ended at this multiple of the region's size.
_END = 1.5
# Widening of an axis, as a share of the largest speed, so that one that hardly moved still has a width.
_LEAST = 1e-3


def faded(t: Array) -> Array:
    """1 below 0, 0 above 1, between them a step with two derivatives (Perlin 2002)."""
    t = jnp.clip(t, 0.0, 1.0)
    return 1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def moved(speed: Float[np.ndarray, " axes"]) -> Float[np.ndarray, " axes"]:
    """Largest speeds, that of an axis at rest a thousandth of the largest [m/s, rad/s]."""
    speed = np.asarray(speed, float)
    return np.maximum(speed, _LEAST * speed.max(initial=0.0) + 1e-12)


class Seen(eqx.Module):
    r"""An ellipsoid of velocities: 1 inside, 0 beyond 1.5 times its size, and smooth in between.

    $q = |A (x - c)|^2$; the gate is 1 for q <= 1, 0 for q >= 1.5², and between them falls by
    $1 - t^3 (10 - 15 t + 6 t^2)$, $t = (q - 1) / (1.5^2 - 1)$.

    - `centre` c [m/s, rad/s], `shape` A [s/m, s/rad]; zero A: everywhere is inside.

    A network says nothing where it was not fitted, while a linear plus quadratic law still has the right
    sign and growth; so the law takes over there. Smoothly, because a step in the force would be felt at
    each crossing, and the integration and Gauss-Newton want two derivatives. An ellipsoid by the data's
    covariance follows velocities that go together (drift and turning), where a box would call their
    unseen corners seen; unlike a density it has no holes, so that it cannot switch within the data.
    A hollow inside the data does count as seen.
    """

    centre: Float[Array, " axes"]
    shape: Float[Array, "axes axes"]

    @classmethod
    def of(cls, velocities: Float[np.ndarray, "samples axes"]) -> Self:
        """The ellipsoid of the data's covariance that holds 99.9 % of them."""
        velocities = np.asarray(velocities, float)
        centre = velocities.mean(axis=0)
        off = velocities - centre
        least = _LEAST * np.abs(velocities).max(axis=0) + 1e-12
        covariance = off.T @ off / len(off) + np.diag(least**2)
        shape = np.linalg.inv(np.linalg.cholesky(covariance))
        reach = max(float(np.quantile(np.linalg.norm(off @ shape.T, axis=1), _INSIDE)), 1.0)
        return cls(jnp.asarray(centre), jnp.asarray(shape / reach))

    @classmethod
    def within(cls, speed: Float[np.ndarray, " axes"]) -> Self:
        """The ellipsoid about the box of these largest speeds."""
        speed = moved(speed)
        return cls(jnp.zeros(len(speed)), jnp.asarray(np.diag(1.0 / speed) / np.sqrt(len(speed))))

    def __call__(self, velocity: Float[Array, " axes"]) -> Scalar:
        q = ((self.shape * (velocity - self.centre)[None]).sum(-1) ** 2).sum()
        return faded((q - 1.0) / (_END**2 - 1.0))

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, as they stand in a file."""
        return {"seen_centre": np.asarray(self.centre), "seen_shape": np.asarray(self.shape)}

    @classmethod
    def restored(cls, arrays) -> Self:
        """The region whose `arrays()` these were."""
        return cls(jnp.asarray(arrays["seen_centre"], float), jnp.asarray(arrays["seen_shape"], float))
