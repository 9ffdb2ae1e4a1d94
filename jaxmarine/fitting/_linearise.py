"""One linearisation of the windows' residuals, from which every other question is linear algebra.

For parameters z (through an affine map into the parameters of each segment's plant) and the initial
state of each window, this gives the sums J'J and J'r of the residuals (prediction - log) / noise.
The windows' rows and their derivatives are those of `_rows.py`; here they are summed.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._affine import Affine
from ._parts import in_parts, joined, part_of
from ._rollout import CHUNK, Problem
from ._rows import Rows, Sweep
from ._windows import Trail

# Windows that are linearised together: the derivatives of some hundred steps stay in the processor's cache.
BATCH = 10


class Statistics(eqx.Module):
    """Chi-square and normal equations of each window, `x` for its initial state, `z` for the parameters.

    - `h_zz`: of each window, or one, their sum (`Problem.apart`). Of one window alone, likewise.
    """

    chi2: Float[Array, "*windows"]
    g_x: Float[Array, "*windows 12"]
    g_z: Float[Array, "*windows z"]
    h_xx: Float[Array, "*windows 12 12"]
    h_xz: Float[Array, "*windows 12 z"]
    h_zz: Float[Array, "*groups z z"]

    @eqx.filter_jit
    def reduced(self):
        """Chi-square, gradient and information of z with each window's initial state eliminated.

        The information is that of each window, or their sum, as `h_zz` is.
        """
        own, _ = grouped(len(self.chi2), len(self.h_zz) > 1)

        def one(h, now):
            window, group = now
            chi2, gradient, explained = _eliminated(*window)
            return added(h, -explained, group), (chi2, gradient)

        h, (chi2, gradient) = jax.lax.scan(one, self.h_zz, (self.of_windows, own))
        return chi2, gradient, h

    @property
    def of_windows(self):
        """All but the information of z."""
        return self.chi2, self.g_x, self.g_z, self.h_xx, self.h_xz


def _eliminated(chi2, g_x, g_z, h_xx, h_xz):
    """Chi-square and gradient of z of one window without its initial state, and the information that goes.

    Window by window, because jaxlib shares a batch of small factorisations out over its thread pool from
    inside that pool, and waits: two at a time hang a pool of two threads (jaxlib 0.10).
    """
    chol = jnp.linalg.cholesky(h_xx)
    right = jnp.concatenate([h_xz, g_x[:, None]], axis=1)
    solved = jax.scipy.linalg.solve_triangular(chol, right, lower=True)
    a, b = solved[:, :-1], solved[:, -1]
    return chi2 - b @ b, g_z - b @ a, a.T @ a


def linearise(problem: Problem, affine: Affine, delta: Float[Array, "windows 12"]) -> Statistics:
    """Statistics of all windows at z = 0.

    - `delta`: changes of the windows' initial states (`State.moved`).

    Fluid memory is driven by the records' velocity here instead of the simulated one: it is a low-pass
    filter, so the measurement's noise hardly reaches it, and the state stays as small as it is without.
    """
    group, groups = grouped(len(delta), problem.apart)
    count = affine.acts.shape[-1]

    def each(total, now):
        stats, group = now
        return added(total, stats.h_zz, group), stats.of_windows

    def of_rows(rows, index):
        return _normal(problem, delta[index], rows), of_filled(group, groups, index)

    begin = jnp.zeros((groups + 1, count, count))
    h_zz, kept, _ = swept(problem, affine, delta, 0, of_rows, each, begin)
    return Statistics(*kept, h_zz=h_zz[:-1])


def _normal(problem: Problem, delta: Float[Array, "12"], rows: Rows) -> Statistics:
    """The statistics of one window."""
    residual, precision = rows.residual.ravel(), problem.start_precision
    jacobian = rows.jacobian.reshape(residual.size, -1)
    h = jacobian.T @ jacobian
    g = jacobian.T @ residual
    return Statistics(
        chi2=residual @ residual + precision @ delta**2,
        g_x=g[:12] + precision * delta,
        g_z=g[12:],
        h_xx=h[:12, :12] + jnp.diag(precision),
        h_xz=h[:12, 12:],
        h_zz=h[12:, 12:],
    )


class Screening(eqx.Module):
    """Reduced statistics of windows for many parameters z and, behind them, a free wrench.

    - `chi2`, `g`: of each window; `h`: information of z in each group of windows, as that of many parameters
      in every window of a long log is more than a memory holds.
    - `h_own`: of each window, for some combinations of z and the wrench: the lower triangle, row by row.
    """

    chi2: Float[Array, " windows"]
    g: Float[Array, "windows columns"]
    h: Float[Array, "groups z z"]
    h_own: Float[Array, "windows pairs"]


def screening(
    problem: Problem,
    affine: Affine,
    delta: Float[Array, "windows 12"],
    knots: int,
    own: Float[Array, "columns own"],
    group: Int[Array, " windows"],
    groups: int,
) -> Screening:
    """Reduced statistics of all windows at z = 0.

    - `knots`: of the free wrench on the hull, which is constant over each of so many equal parts of a window:
      columns knot by knot, six axes each. Whatever acts on the hull is a sum of these.
    - `own`: the combinations, of z and the wrench.
    - `group`: of each window; windows of the group with the number `groups` are left out.
    """
    given, lower = affine.acts.shape[-1], np.tril_indices(own.shape[1])

    def of_rows(rows, index):
        return _normal(problem, delta[index], rows), of_filled(group, groups, index)

    def each(total, now):
        stats, group = now
        chi2, gradient, explained = _eliminated(*stats.of_windows)
        information = stats.h_zz - explained
        kept = chi2, gradient, (own.T @ information @ own)[lower]
        return added(total, information[:given, :given], group), kept

    begin = jnp.zeros((groups + 1, given, given))
    h, (chi2, g, h_own), _ = swept(problem, affine, delta, knots, of_rows, each, begin)
    return Screening(chi2, g, h[:-1], h_own)


def grouped(count: int, apart: bool) -> tuple[Int[Array, " windows"], int]:
    """The group of each window, and how many there are: one each, or one for all."""
    return (jnp.arange(count), count) if apart else (jnp.zeros(count, int), 1)


def added(h: Float[Array, "groups z z"], more: Float[Array, "z z"], group) -> Float[Array, "groups z z"]:
    """One window to its group. Row by row: a scatter would copy."""
    before = jax.lax.dynamic_index_in_dim(h, group, keepdims=False)
    return jax.lax.dynamic_update_index_in_dim(h, before + more, group, 0)


def of_filled(group: Int[Array, " windows"], groups: int, index) -> Array:
    """The group of a window; those that only fill the last batch up are in one of their own."""
    return jnp.where(index < len(group), group[jnp.minimum(index, len(group) - 1)], groups)


def swept(
    problem: Problem,
    affine: Affine,
    delta: Float[Array, "windows 12"],
    knots: int,
    of_rows: Callable[[Rows, Array], Any],
    each: Callable[[Any, Any], tuple[Any, Any]],
    begin: Any,
    trail: Trail | None = None,
) -> tuple[Any, Any, Trail]:
    """All windows one after another: what is carried through them, what is kept of each, and their trail.

    - `of_rows`: from a window's rows and its index what is wanted of it, for some windows at once; those that
      only fill the last batch up have indices beyond the last one.
    - `each`: from what is carried, beginning with `begin`, and that: what is carried on, and what is kept.
    - `trail`: of the windows before these; None: there are none.
    """
    sweep = Sweep.of(problem, affine, knots)
    count = len(delta)
    batch = min(BATCH, count)
    chunk = part_of(count, CHUNK, batch)

    def of_batch(carry, now):
        windows, index = now
        wanted = jax.vmap(lambda window, index: of_rows(sweep.rows(window), index))(windows, index)
        return jax.lax.scan(each, carry, wanted)

    def of_chunk(so_far, index):
        carry, trail = so_far
        here = jnp.minimum(index, count - 1)
        rolled = sweep.rolled(*jax.tree.map(lambda a: a[here], (problem.windows, delta, sweep.driven.begun)))
        if problem.trail:
            rolled, trail = sweep.followed(rolled, trail)
        parts = jax.tree.map(lambda a: in_parts(a, batch), (rolled, index))
        carry, kept = jax.lax.scan(of_batch, carry, parts)
        return (carry, trail), kept

    chunks = jnp.arange(-(-count // chunk) * chunk).reshape(-1, chunk)
    before = Trail.nothing(problem.trail) if trail is None else trail
    (carried, trail), kept = jax.lax.scan(of_chunk, (begin, before), chunks)
    every = jax.tree.map(lambda a: joined(jax.vmap(joined, (0, None))(a, chunk), count), kept)
    return carried, every, trail
