"""Learns a missing wrench as a network of the signals that it depends on."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from .._types import ATTITUDE, POSITION
from ..networks import LearnedWrench, learned_wrench
from ._knots import Knots, missing_wrench
from ._unknown import Dependence, resolved

HIDDEN = 12
RESTARTS = 4
# Weight decay: a weight of one costs this much chi-square.
DECAY = 1.0


def _inputs(k: Knots, names: tuple[str, ...]) -> np.ndarray:
    """The signals at the knots as a learned term sees them [windows, knots, inputs]."""
    out = []
    for name in names:
        values = k.places.signals[name]
        out += [np.sin(values), np.cos(values)] if name in ATTITUDE else [values]
    return np.stack(out, axis=-1)


def _hidden(k: Knots, names: tuple[str, ...]) -> int:
    """Hidden units: two bumps of the regression make a turn, which takes a unit."""
    places = [resolved(name, k.places.signals[name]) // 2 for name in names if name in POSITION]
    return max(HIDDEN, *places, 0)


def _spread(term: LearnedWrench, key) -> LearnedWrench:
    """The term with its units' steps spread over the range, as steep as they lie close.

    Units of slope one are nearly straight lines over the range: fitted from there they do not follow a
    force that turns often.
    """
    hidden, inputs = term.weight_1.shape
    centre = jax.random.uniform(key, (hidden, inputs), minval=-1.0, maxval=1.0)
    weight = hidden / 4 * term.weight_1
    return term.with_network((weight, -(weight * centre).sum(-1), term.weight_2, term.bias_2))


def _quadratic(k: Knots) -> tuple[np.ndarray, np.ndarray]:
    """Square roots A_w and vectors b_w with chi-square change |A_w c + b_w|² for a wrench c at the knots."""
    n = k.width
    h, g = k.stats.h[:, n:, n:], k.stats.g[:, n:]
    eigen, vectors = np.linalg.eigh(h)
    # Directions that a window does not see carry no residual.
    root = np.sqrt(np.maximum(eigen, 1e-9 * np.maximum(eigen[:, -1:], 1e-6 * eigen.max())))
    a = np.swapaxes(vectors * root[:, None, :], 1, 2)
    b = np.einsum("wkr,wk->wr", vectors, g) / root
    return a, b


def learn(k: Knots, found: tuple[Dependence, ...], thrusters: tuple[str, ...]) -> tuple[LearnedWrench, ...]:
    """One network per axis, fitted together on the knots' chi-square by Levenberg-Marquardt.

    The knots' statistics are those of whole trajectories, so this is the trajectory loss to second order,
    at the price of a curve fit. The best of several restarts is kept.
    """
    sizes = {one.axis: float(np.nanstd(missing_wrench(k).wrench[:, one.axis])) for one in found}
    a, b = (jnp.asarray(x) for x in _quadratic(k))
    inputs = [_inputs(k, one.signals) for one in found]
    ranges = [(x.min((0, 1)), x.max((0, 1))) for x in inputs]
    windows, count = k.places.t.shape
    hidden = [_hidden(k, one.signals) for one in found]

    def built(key) -> tuple[LearnedWrench, ...]:
        keys = jax.random.split(key, len(found))
        out = []
        for one, (low, high), units, key in zip(found, ranges, hidden, keys, strict=True):
            term = learned_wrench(one.dof, one.signals, thrusters, low, high, sizes[one.axis], key, units)
            out.append(_spread(term, key) if units > HIDDEN else term)
        return tuple(out)

    def residual(networks, args):
        start, inputs, a, b = args
        wrench = jnp.zeros((windows, count, 6))
        for one, x, network, term in zip(found, inputs, networks, start, strict=True):
            wrench = wrench.at[:, :, one.axis].set(term.force(x, network))
        error = jnp.einsum("wrk,wk->wr", a, wrench.reshape(windows, -1)) + b
        return error, jax.tree.map(lambda w: np.sqrt(DECAY) * w, networks)

    def fitted(key, inputs, a, b):
        start = built(key)
        args = (start, inputs, a, b)
        networks = tuple(term.network for term in start)
        solution = optx.least_squares(
            residual,
            optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5),
            networks,
            args,
            max_steps=80,
            throw=False,
        )
        error, _ = residual(solution.value, args)
        return solution.value, (error**2).sum()

    keys = jax.random.split(jax.random.PRNGKey(0), RESTARTS)
    data = ([jnp.asarray(x) for x in inputs], a, b)
    values, costs = jax.jit(lambda keys, *data: jax.lax.map(lambda key: fitted(key, *data), keys))(
        keys, *data
    )
    best = int(jnp.argmin(costs))
    start = built(keys[best])
    networks = jax.tree.map(lambda leaf: leaf[best], values)
    return tuple(term.with_network(network) for term, network in zip(start, networks, strict=True))
