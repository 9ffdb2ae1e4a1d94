"""The map from what is asked for to the parameters of the plants."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Columns with several entries that are multiplied one by one; with more of them all are.
FEW = 4


class Affine(eqx.Module):
    """From z to the parameters of each segment's plant: theta + columns @ (acts * z).

    `acts` says which z act in a segment. One matrix for all segments costs one product per step of a log.
    """

    theta: Float[Array, "segments parameters"]
    columns: Float[Array, "parameters z"]
    acts: Float[Array, "segments z"]

    def __call__(self, z: Float[Array, " z"]) -> Float[Array, "segments parameters"]:
        return self.theta + (self.acts * z[None]) @ self.columns.T

    def at(self, z: Float[Array, " z"]) -> "Affine":
        """The same map seen from z."""
        return Affine(self(z), self.columns, self.acts)

    def in_parts(self, width: int) -> list["Affine"]:
        """The same map for so many z at a time; behind the last ones stand some that change nothing."""
        given = self.acts.shape[-1]
        more = ((0, 0), (0, -given % width))
        columns, acts = jnp.pad(self.columns, more), jnp.pad(self.acts, more)
        return [
            Affine(self.theta, columns[:, i : i + width], acts[:, i : i + width])
            for i in range(0, given, width)
        ]


class Columns(eqx.Module):
    """A matrix to multiply by, of which most columns have a single entry: to pick those is less work.

    - `first`, `entry`: of each column where its single entry is, and the entry; 0 where it has several.
    - `others`, `narrow`: which columns have several, and these; `many`: more than `FEW` have.
    """

    whole: Float[Array, "parameters z"]
    first: Int[Array, " z"]
    entry: Float[Array, " z"]
    others: Int[Array, " few"]
    narrow: Float[Array, "parameters few"]
    many: Bool[Array, ""]

    @classmethod
    def of(cls, whole: Float[Array, "parameters z"]) -> "Columns":
        several = (whole != 0).sum(0) > 1
        first = jnp.argmax(whole != 0, axis=0)
        entry = jnp.where(several, 0.0, whole[first, jnp.arange(whole.shape[1])])
        others = jnp.argsort(~several)[:FEW]
        narrow = jnp.where(several[others], whole[:, others], 0.0)
        return cls(whole, first, entry, others, narrow, several.sum() > FEW)

    def __call__(self, by: Float[Array, "points rows parameters"]) -> Float[Array, "points rows z"]:
        """`by @ whole`."""

        def picked():
            return (by[..., self.first] * self.entry[None, None]).at[..., self.others].add(by @ self.narrow)

        return jax.lax.cond(self.many, lambda: by @ self.whole, picked)
