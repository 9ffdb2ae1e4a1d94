"""How networks are trained: the ways of the thesis' appendix A, with the errata's signs and factors.

All take weights in one flat vector and `miss(weights, samples)`, the errors e of all samples; the loss is
E = 1/2 mean e² (A.1 with its square), and (A.21) with 2 lambda beside the Hessian where weights decay.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jaxmarine.fitting import levenberg_marquardt

Weights = Float[Array, " weights"]
Miss = Callable[[Weights, PyTree], Float[Array, " errors"]]


def loss(miss: Miss, weights: Weights, samples: PyTree, decay: float = 0.0) -> Float[Array, ""]:
    """Half the mean square error, and `decay` times the weights' square."""
    return 0.5 * (miss(weights, samples) ** 2).mean() + decay * (weights**2).sum()


@functools.partial(jax.jit, static_argnums=(0, 4))
def steepest_descent(miss: Miss, start: Weights, samples: PyTree, rate, epochs: int) -> Weights:
    """(A.15) with one rate: each step by the gradient of all samples (batch learning)."""
    slope = jax.grad(lambda w: loss(miss, w, samples))
    return jax.lax.fori_loop(0, epochs, lambda _, w: w - rate * slope(w), start)


@functools.partial(jax.jit, static_argnums=(0, 5))
def sequential(miss: Miss, start: Weights, samples: PyTree, rate, key: PRNGKeyArray, epochs: int) -> Weights:
    """Back propagation sample by sample (A.14, its sign mended), each epoch in another order (A.1.1)."""
    count = len(jax.tree.leaves(samples)[0])

    def one(w, k):
        sample = jax.tree.map(lambda a: a[k][None], samples)
        return w - rate * jax.grad(lambda w: loss(miss, w, sample))(w), None

    def epoch(w, key):
        return jax.lax.scan(one, w, jax.random.permutation(key, count))[0], None

    return jax.lax.scan(epoch, start, jax.random.split(key, epochs))[0]


@functools.partial(jax.jit, static_argnums=(0, 4))
def newton(miss: Miss, start: Weights, samples: PyTree, decay, epochs: int) -> Weights:
    """(A.19) with the whole Hessian and a rate of one; nothing keeps it from a saddle or a maximum."""

    def total(w):
        return loss(miss, w, samples, decay)

    def step(_, w):
        return w - jnp.linalg.solve(jax.hessian(total)(w), jax.grad(total)(w))

    return jax.lax.fori_loop(0, epochs, step, start)


@functools.partial(jax.jit, static_argnums=(0, 4))
def marquardt(miss: Miss, start: Weights, samples: PyTree, decay, epochs: int) -> Weights:
    """Levenberg and Marquardt's (A.28, its sign mended), by optimistix, with weights that decay."""

    def residuals(w, samples):
        missed = miss(w, samples)
        return missed / jnp.sqrt(missed.size), jnp.sqrt(2.0 * decay) * w

    return levenberg_marquardt(residuals, start[None], samples, max_steps=epochs).values[0]


def pruned(
    miss: Miss, weights: Weights, samples: PyTree, left_out: PyTree
) -> tuple[Weights, Float[np.ndarray, " weights"]]:
    """Weights taken out one by one, as far as left-out samples are predicted better; and which are left.

    Each time the one whose loss costs least, w² / (2 [H^-1]_ww), the others following: "optimal brain
    surgeon" of Hassibi and Stork (1993), with H = J'J. The thesis names pruning by low eigenvalues of the
    Hessian (A.2.3) and does not use it.
    """
    jacobian = jax.jit(jax.jacfwd(lambda w: miss(w, samples)))
    judge = jax.jit(lambda w: loss(miss, w, left_out))
    now, kept = np.array(weights), np.ones(len(weights), bool)
    best = float(judge(weights)), now.copy(), kept.copy()
    while kept.sum() > 1:
        slopes = np.asarray(jacobian(jnp.asarray(now)))[:, kept]
        hessian = slopes.T @ slopes / len(slopes)
        if not np.trace(hessian) > 0:
            break
        # Weights behind a saturated node have no slope: they go first, and must not make it singular.
        inverse = np.linalg.inv(hessian + 1e-8 * np.trace(hessian) / len(hessian) * np.eye(len(hessian)))
        places = np.flatnonzero(kept)
        q = int(np.argmin(now[kept] ** 2 / np.diag(inverse)))
        now[places] -= now[places[q]] / inverse[q, q] * inverse[:, q]
        kept[places[q]] = False
        now[~kept] = 0.0
        cost = float(judge(jnp.asarray(now)))
        if cost < best[0]:
            best = cost, now.copy(), kept.copy()
    return jnp.asarray(best[1]), best[2].astype(float)
