"""Levenberg-Marquardt from many starts at once: restarts, or the random beginnings of networks.

optimistix' own solver factorises the Jacobian, which for ten thousand samples and some tens of weights costs
many times its square. `fit_samples` sums J'J and J'r over the samples and hands them to a solver inside
optimistix' loop; the squared condition number is what the damping is there for.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._compiled import compiled
from ._parts import in_parts, part_of
from ._trust import Trust, pick

# Samples whose Jacobian is held at once: of some tens of weights it stays in the processor's cache, and the
# Jacobian of ten thousand takes two thirds of the time to be written and read.
BATCH = 1000


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

    After Levenberg (1944), Marquardt (1963).
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


class Normal(eqx.Module):
    """Normal equations of residuals r with Jacobian J: `gradient` J'r, `curvature` J'J."""

    gradient: Float[Array, " weights"]
    curvature: Float[Array, "weights weights"]


class _State(eqx.Module):
    y_eval: Float[Array, " weights"]
    normal: Normal
    trust: Trust
    terminate: Bool[Array, ""]


class NormalLevenbergMarquardt(optx.AbstractMinimiser[Float[Array, " weights"], Normal, _State]):
    """Levenberg-Marquardt on a function that gives half the sum of squares and its `Normal` equations.

    Damping as in `Trust`, scaled by Marquardt (1963). It ends where a step promises less than `rtol`
    of the cost, or where damping of 1e10 finds no decrease.
    """

    rtol: float
    # What optimistix asks of any minimiser besides.
    atol: float = 0.0
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        del fn, args, options, f_struct, tags
        return _State(
            y_eval=y,
            normal=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_struct),
            trust=Trust.start(1e-2),
            terminate=jnp.array(False),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        del options, tags
        cost, normal = fn(state.y_eval, args)
        better, trust = state.trust.judged(cost)
        y, normal = pick(better, state.y_eval, y), pick(better, normal, state.normal)
        diagonal = jnp.diag(normal.curvature)
        # A weight without slope, behind a saturated node, must not fly off.
        scale = jnp.maximum(diagonal, 1e-6 * diagonal.max() + 1e-300)
        step = -jax.scipy.linalg.solve(
            normal.curvature + trust.damping * jnp.diag(scale), normal.gradient, assume_a="pos"
        )
        predicted = -(normal.gradient @ step + 0.5 * step @ normal.curvature @ step)
        lost = ~jnp.isfinite(predicted) | (trust.damping > 1e10)
        done = lost | (predicted < self.rtol * trust.cost)
        return y, _State(y + step, normal, trust.promised(predicted), done), normal

    def terminate(self, fn, y, args, options, state: _State, tags):
        del fn, y, args, options, tags
        return state.terminate, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        del fn, args, options, tags, result
        return y, aux, {"cost": state.trust.cost}


@compiled
def fit_samples(
    fn: Callable[[PyTree, Any], Array],
    starts: PyTree,
    samples: PyTree,
    *,
    rtol: float = 1e-12,
    max_steps: int = 50,
) -> Restarts:
    r"""Minimises $\frac12 \sum_k |r_k(y)|^2$ over samples from every start, by normal equations.

    - `fn(y, sample)`: the residuals of one sample, a vector.
    - `starts`: y with one leading axis more; `samples`: a pytree of arrays with the samples as leading axis.
    - `max_steps`: epochs, steps that were not taken included.

    For residuals of many samples in few unknowns, such as small networks; see `levenberg_marquardt` for
    any others. Source: after Hagan and Menhaj (1994), IEEE Trans. Neural Networks 5(6); thesis, app. A with
    the sign of (A.28) mended, and its Jacobian transposed.
    """
    _, unravel = jax.flatten_util.ravel_pytree(jax.tree.map(lambda a: a[0], starts))
    solver = NormalLevenbergMarquardt(rtol=rtol)

    def normal(flat, batches):
        def one(sample, counts):
            def residual(y):
                return counts * fn(unravel(y), sample)

            return residual(flat), jax.jacrev(residual)(flat)

        def add(sums, batch):
            # Samples last: the product below then runs along contiguous memory.
            residual, jacobian = jax.vmap(one, out_axes=-1)(*batch)
            rows = jnp.moveaxis(jacobian, 0, 1).reshape(flat.size, -1)
            along = residual.reshape(-1)
            more = 0.5 * along @ along, Normal(rows @ along, rows @ rows.T)
            return jax.tree.map(jnp.add, sums, more), None

        nothing = Normal(jnp.zeros_like(flat), jnp.zeros((flat.size, flat.size), flat.dtype))
        return jax.lax.scan(add, (jnp.zeros((), flat.dtype), nothing), batches)[0]

    batches = _in_batches(samples)

    def solve(start):
        flat, _ = jax.flatten_util.ravel_pytree(start)
        found = optx.minimise(normal, solver, flat, batches, has_aux=True, max_steps=max_steps, throw=False)
        done = found.result == optx.RESULTS.successful
        cost = found.stats["cost"]
        return unravel(found.value), cost, done & jnp.isfinite(cost), found.stats["num_steps"]

    return Restarts(*jax.vmap(solve)(starts))


def _in_batches(samples: PyTree) -> tuple[PyTree, Bool[Array, "batches batch"]]:
    """The samples in batches, filled up with the last one, and which of them count."""
    count = len(jax.tree.leaves(samples)[0])
    size = part_of(count, BATCH)
    batches = jax.tree.map(lambda a: in_parts(a, size), samples)
    return batches, jnp.arange(count + -count % size).reshape(-1, size) < count
