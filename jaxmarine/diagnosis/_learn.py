"""Learns a missing wrench as a network of the signals that it depends on."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import ATTITUDE, POSITION
from ..fitting import fit_samples
from ..networks import LearnedWrench, learned_wrench
from ._knots import Knots, missing_wrench
from ._score import Reduced, joined
from ._unknown import Dependence, resolved

HIDDEN = 12
RESTARTS = 4
STEPS = 80
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
    return max([HIDDEN, *places])


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
    own = joined(k.stats.each(_of_knots, k.width))
    h, g = own.h, own.g
    eigen, vectors = np.linalg.eigh(h)
    # Directions that a window does not see carry no residual.
    root = np.sqrt(np.maximum(eigen, 1e-9 * np.maximum(eigen[:, -1:], 1e-6 * eigen.max())))
    a = np.swapaxes(vectors * root[:, None, :], 1, 2)
    b = np.einsum("wkr,wk->wr", vectors, g) / root
    return a, b


def _of_knots(stats: Reduced, n: int) -> Reduced:
    """Statistics of the columns behind the first `n`."""
    return Reduced(stats.chi2, stats.g[:, n:], stats.h[:, n:, n:])


class _Missing(eqx.Module):
    """What the knots of one window still lack beside networks: the residual that they are fitted to."""

    terms: tuple[LearnedWrench, ...]
    axes: tuple[int, ...] = eqx.field(static=True)
    windows: int = eqx.field(static=True)

    def __call__(self, networks, window) -> Array:
        inputs, a, b = window
        wrench = jnp.zeros((len(inputs[0]), 6))
        for axis, x, network, term in zip(self.axes, inputs, networks, self.terms, strict=True):
            force = jax.vmap(term.force, in_axes=(0, None))(x, network)
            wrench = wrench.at[:, axis].set(force)
        weights, _ = jax.flatten_util.ravel_pytree(networks)
        decay = np.sqrt(DECAY / self.windows) * weights
        return jnp.concatenate([a @ wrench.ravel() + b, decay])


def learn(k: Knots, found: tuple[Dependence, ...], thrusters: tuple[str, ...]) -> tuple[LearnedWrench, ...]:
    """One network per axis, fitted together on the knots' chi-square by Levenberg-Marquardt.

    The knots' statistics are those of whole trajectories, so this is the trajectory loss to second order,
    at the price of a curve fit. The best of several restarts is kept. A force that hangs on the past of a
    command is left out, since a network has no memory, and one that changes with time over several logs; so
    is one of which only the size is known.
    """
    several = k.places.log.max() > 0
    found = tuple(
        one for one in found if not (one.remembers or one.size_only or (several and "t" in one.signals))
    )
    if not found:
        return ()
    sizes = {one.axis: float(np.nanstd(missing_wrench(k).wrench[:, one.axis])) for one in found}
    inputs = [_inputs(k, one.signals) for one in found]
    ranges = [(x.min((0, 1)), x.max((0, 1))) for x in inputs]

    def built(key) -> tuple[LearnedWrench, ...]:
        out, keys = [], jax.random.split(key, len(found))
        for one, (low, high), key in zip(found, ranges, keys, strict=True):
            units = _hidden(k, one.signals)
            term = learned_wrench(one.dof, one.signals, thrusters, low, high, sizes[one.axis], key, units)
            out.append(_spread(term, key) if units > HIDDEN else term)
        return tuple(out)

    beginnings = [built(key) for key in jax.random.split(jax.random.PRNGKey(0), RESTARTS)]
    terms = beginnings[0]
    starts = jax.tree.map(lambda *w: jnp.stack(w), *[tuple(t.network for t in b) for b in beginnings])
    a, b = (jnp.asarray(x) for x in _quadratic(k))
    missing = _Missing(terms, tuple(one.axis for one in found), len(a))
    windows = tuple(jnp.asarray(x) for x in inputs), a, b
    networks = fit_samples(missing, starts, windows, rtol=1e-5, max_steps=STEPS).best
    return tuple(term.with_network(network) for term, network in zip(terms, networks, strict=True))
