"""How strongly a Gauss-Newton step is damped, and whether it is taken: shared by the solvers."""

from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree


class Trust(eqx.Module):
    """Damping after Nielsen (1999): eased as well as the last step was predicted, doubled ever faster.

    - `cost` of what was taken last; `predicted`: the decrease that the pending step promises.
    - `damping` of the next step, as a share of the curvature's diagonal; `growth` after the next failure.
    - `first`: nothing was evaluated yet.
    """

    cost: Float[Array, ""]
    predicted: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    first: Bool[Array, ""]

    @classmethod
    def start(cls, damping: float | Float[Array, ""]) -> Self:
        big = jnp.asarray(jnp.inf, jnp.result_type(float))
        return cls(big, big, jnp.asarray(damping, big.dtype), jnp.asarray(2.0, big.dtype), jnp.array(True))

    @property
    def taken(self) -> Bool[Array, ""]:
        """Whether the last step was."""
        return self.growth <= 2.0

    def judged(self, cost: Float[Array, ""]) -> tuple[Bool[Array, ""], Self]:
        """Whether the pending step is taken, and the trust after it; a cost that is not finite never is."""
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        better = (cost < self.cost) | self.first
        ratio = (self.cost - cost) / jnp.maximum(self.predicted, 1e-300)
        eased = self.damping * jnp.maximum(1 / 3, 1 - (2 * jnp.clip(ratio, 0.0, 1.0) - 1) ** 3)
        damping = jnp.where(better, eased, self.damping * self.growth)
        damping = jnp.where(self.first, self.damping, damping)
        growth = jnp.where(better, 2.0, 2.0 * self.growth)
        cost = jnp.where(better, cost, self.cost)
        return better, type(self)(cost, self.predicted, damping, growth, jnp.array(False))

    def promised(self, decrease: Float[Array, ""]) -> Self:
        """With the decrease that the next step promises."""
        return eqx.tree_at(lambda trust: trust.predicted, self, decrease)


def pick(condition: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """The new where the condition holds, else the old."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)
