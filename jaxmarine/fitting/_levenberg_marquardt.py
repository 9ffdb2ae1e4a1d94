"""Levenberg-Marquardt from many starts at once: restarts, or the random beginnings of networks."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree


class Restarts(eqx.Module):
    """Where each start has led; everything has the starts as its leading axis.

    `costs` is half the sum of squares, infinite where a solve has diverged; `converged` is false
    where the steps were not enough.
    """

    values: PyTree
    costs: Float[Array, " starts"]
    converged: Bool[Array, " starts"]
    steps: Int[Array, " starts"]

    @property
    def best(self) -> PyTree:
        """The value of least cost."""
        which = jnp.argmin(self.costs)
        return jax.tree.map(lambda a: a[which], self.values)


@eqx.filter_jit
def levenberg_marquardt(
    fn: Callable[[PyTree, Any], PyTree],
    starts: PyTree,
    args: Any = None,
    *,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    max_steps: int = 256,
) -> Restarts:
    r"""Minimises $\frac12 \sum r(y)^2$ from every start by optimistix' Levenberg-Marquardt.

    - `fn(y, args)`: residuals, a pytree of arrays.
    - `starts`: y with one leading axis more. All run together under `vmap`, as long as the slowest.

    Source: Levenberg (1944), Marquardt (1963).
    """
    solver = optx.LevenbergMarquardt(rtol=rtol, atol=atol)

    def solve(y):
        found = optx.least_squares(fn, solver, y, args, max_steps=max_steps, throw=False)
        squares = [(leaf**2).sum() for leaf in jax.tree.leaves(fn(found.value, args))]
        cost = 0.5 * jnp.stack(squares).sum()
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        done = found.result == optx.RESULTS.successful
        return found.value, cost, done & jnp.isfinite(cost), found.stats["num_steps"]

    return Restarts(*jax.vmap(solve)(starts))
