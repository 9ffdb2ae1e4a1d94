"""Damping as radial-basis networks of the velocity, beside a classical model that takes over elsewhere."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from .._types import DOFS, Wrench
from ..effects import Craft, Motion
from ._term import LearnedDamping, check_shapes

# What left-out stretches choose among: widths of the basis functions and reaches of what was seen, in
# scaled velocity; weight decay, in samples of unit force.
_WIDTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
_DECAYS = (1e-6, 1e-4, 1e-2)
_REACHES = (0.5, 1.0, 2.0)
# More velocities than these vouch for nothing new.
_MOST_SEEN = 200


class RBFDamping(LearnedDamping):
    r"""Damping beside that of the vehicle, $\tau_a = s_a\, g_a(x) \sum_k w_{ak} \psi_a(x, c_{ak})$.

    The inputs are scaled velocities through the water, $x = \nu_r / s_i$.
    $\psi(x, c) = \phi(|x - c|) - \phi(|c|)\, \phi(|x|)$ with $\phi(d) = \exp(-d^2 / 2 h^2)$ is zero at rest
    and far away. $g(x) = 1 - \prod_n (1 - \exp(-|x - x_n|^2 / 2 r^2))$ is one where a velocity $x_n$ was
    seen and goes smoothly to zero away from all of them: there the vehicle's own damping is left alone.

    - `centres`, `weights`: of each axis' network; `width` h: of its basis functions, in scaled velocity.
    - `seen`: velocities that the networks were fitted on; `reach` r: how far each of them vouches, scaled.
    - `input_scale` [m/s, rad/s]: root mean square of the velocities, their usual distance from rest.
    - `output_scale` [N, N m].

    Source: thesis sec. 7.1 and 7.2 (the networks where the velocity is known, (7.5) where it is not). There
    is no force at rest, by construction. Nothing makes the force dissipative.
    """

    name: ClassVar[str] = "rbf_damping"

    centres: Float[Array, "axes units axes"]
    weights: Float[Array, "axes units"]
    width: Float[Array, " axes"]
    seen: Float[Array, "points axes"]
    reach: Float[Array, " axes"]
    input_scale: Float[Array, " axes"]
    output_scale: Float[Array, " axes"]

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        del craft, target
        count = len(inputs)
        units, points = np.shape(arrays["weights"])[-1], len(arrays["seen"])
        shapes = dict.fromkeys(("width", "reach", "input_scale", "output_scale"), (count,))
        shapes |= {"centres": (count, units, count), "weights": (count, units), "seen": (points, count)}
        check_shapes(arrays, shapes)
        return cls(**{name: jnp.asarray(value) for name, value in arrays.items()}, inputs=inputs)

    def known(self, x: Float[Array, " axes"]) -> Float[Array, " axes"]:
        """How far the velocities seen vouch for a scaled velocity, per axis: g of the formula above."""
        away = ((x[None] - self.seen) ** 2).sum(-1)[None] / (2.0 * self.reach[:, None] ** 2)
        return 1.0 - jnp.prod(1.0 - jnp.exp(-away), axis=-1)

    def __call__(self, motion: Motion) -> Wrench:
        places = np.array([DOFS.index(axis) for axis in self.inputs])
        x = motion.nu_r[places] / self.input_scale
        spread = 2.0 * self.width[:, None] ** 2
        near = jnp.exp(-((x[None, None] - self.centres) ** 2).sum(-1) / spread)
        at_rest = jnp.exp(-(self.centres**2).sum(-1) / spread) * jnp.exp(-(x**2).sum() / spread)
        force = self.output_scale * self.known(x) * (self.weights * (near - at_rest)).sum(-1)
        return jnp.zeros(6).at[places].set(force)


def rbf_damping(
    axes: Sequence[str],
    velocity: Float[np.ndarray, "samples axes"],
    force: Float[np.ndarray, "samples axes"],
    stretch: Int[np.ndarray, " samples"],
    most: int = 500,
) -> RBFDamping:
    """The term grown on samples of the force that the vehicle lacks, one network per axis.

    - `velocity` relative to the water [m/s, rad/s], `force` [N, N m].
    - `stretch`: which part of the data a sample belongs to. Width, reach, decay and number of centres are
      those that predict a stretch best that is left out; at most `most` centres.
    """
    velocity, force = np.asarray(velocity, float), np.asarray(force, float)
    # Distances are measured against the way to rest, where the force is known to be none.
    input_scale = np.maximum(np.sqrt((velocity**2).mean(axis=0)), 1e-9)
    output_scale = np.maximum(np.sqrt((force**2).mean(axis=0)), 1e-9)
    x, y = velocity / input_scale, force / output_scale
    best = [(np.inf, 0, 0.0, 0.0, 0.0)] * len(axes)
    for width, decay in itertools.product(_WIDTHS, _DECAYS):
        for reach, errors in _left_out(x, y, stretch, width, decay, most).items():
            for a, path in enumerate(errors):
                count = int(np.argmin(path))
                best[a] = min(best[a], (float(path[count]), count, width, decay, reach))

    units = max(count for _, count, *_ in best)
    centres, weights = np.zeros((len(axes), units, len(axes))), np.zeros((len(axes), units))
    for a, (_, count, width, decay, _) in enumerate(best):
        grown = grow(*_normal(basis_of(x, x, width), y[:, a], decay), count)
        centres[a, :count], weights[a, :count] = x[grown.order], grown.weights(count)
    return RBFDamping(
        centres=jnp.asarray(centres),
        weights=jnp.asarray(weights),
        width=jnp.asarray([width for _, _, width, _, _ in best]),
        seen=jnp.asarray(x[:: -(-len(x) // _MOST_SEEN)]),
        reach=jnp.asarray([reach for *_, reach in best]),
        input_scale=jnp.asarray(input_scale),
        output_scale=jnp.asarray(output_scale),
        inputs=tuple(axes),
    )


def basis_of(
    x: Float[np.ndarray, "samples axes"], centres: Float[np.ndarray, "centres axes"], width: float
) -> Float[np.ndarray, "samples centres"]:
    """The basis functions of `RBFDamping` at scaled velocities."""
    to_rest, from_rest = (
        np.exp(-0.5 * (centres**2).sum(1) / width**2),
        np.exp(-0.5 * (x**2).sum(1) / width**2),
    )
    return np.exp(-0.5 * _squares(x, centres) / width**2) - from_rest[:, None] * to_rest


def _squares(x: np.ndarray, centres: np.ndarray) -> np.ndarray:
    return ((x[:, None, :] - centres[None, :, :]) ** 2).sum(-1)


@dataclasses.dataclass(frozen=True)
class Growth:
    """Columns in the order in which they were taken, and the triangular factor of their normal equations.

    The square of `solution` says by how much each column lowered the penalised sum of squares.
    """

    order: Int[np.ndarray, " taken"]
    factor: Float[np.ndarray, "taken taken"]
    solution: Float[np.ndarray, " taken"]

    def weights(self, count: int) -> Float[np.ndarray, " count"]:
        """Least-squares weights of the first `count` columns."""
        factor = self.factor[:count, :count]
        return np.asarray(scipy.linalg.solve_triangular(factor, self.solution[:count], trans=1, lower=True))

    def predicted(self, columns: Float[np.ndarray, "samples taken"]) -> Float[np.ndarray, "samples taken"]:
        """What the first one, two, three ... columns predict, given the columns in the order of `order`."""
        steps = np.asarray(scipy.linalg.solve_triangular(self.factor, columns.T, lower=True)).T
        return np.cumsum(steps * self.solution, axis=1)


def grow(
    gram: Float[np.ndarray, "columns columns"], right: Float[np.ndarray, " columns"], count: int
) -> Growth:
    """Takes columns one by one, each time the one that lowers the sum of squares most.

    For least squares with the normal equations `gram` (positive definite) and `right`. The Cholesky factor
    grows by one row per column, at the cost of one product with a vector; what a column would save beside
    those that are in is known for all of them. This is orthogonal least squares (Chen, Cowan and Grant
    1991, IEEE Transactions on Neural Networks 2(2), 302-309) on normal equations.
    """
    columns = len(right)
    count = min(count, columns)
    factor = np.zeros((count, columns))
    left, pull = np.diag(gram).copy(), right.copy()
    order, solution, taken = np.zeros(count, int), np.zeros(count), np.zeros(columns, bool)
    for k in range(count):
        best = int(np.argmax(np.where(taken, -np.inf, pull**2 / left)))
        root = np.sqrt(left[best])
        row = (gram[best] - factor[:k, best] @ factor[:k]) / root
        factor[k], solution[k] = row, pull[best] / root
        order[k], taken[best] = best, True
        pull = pull - solution[k] * row
        # What rounding leaves of a column that is a sum of those that are in stays positive.
        left = np.maximum(left - row**2, 1e-12 * np.diag(gram))
    return Growth(order, np.tril(factor[:, order].T), solution)


def _normal(basis: np.ndarray, target: np.ndarray, decay: float) -> tuple[np.ndarray, np.ndarray]:
    return basis.T @ basis + decay * np.eye(basis.shape[1]), basis.T @ target


def _left_out(
    x: np.ndarray, y: np.ndarray, stretch: np.ndarray, width: float, decay: float, most: int
) -> dict[float, np.ndarray]:
    """Per reach the mean squared error on left-out stretches, [axes, 0 ... most centres]."""
    squares = _squares(x, x)
    basis = basis_of(x, x, width)
    parts = np.unique(stretch)
    most = min(most, *(int((stretch != part).sum()) for part in parts))
    out = {reach: np.zeros((y.shape[1], most + 1)) for reach in _REACHES}
    for part in parts:
        test, rest = stretch == part, stretch != part
        known = {
            reach: 1.0 - np.prod(1.0 - np.exp(-0.5 * squares[np.ix_(test, rest)] / reach**2), axis=1)
            for reach in _REACHES
        }
        gram, right = _normal(basis[np.ix_(rest, rest)], y[rest], decay)
        for a in range(y.shape[1]):
            grown = grow(gram, right[:, a], most)
            columns = basis[np.ix_(test, rest)][:, grown.order]
            path = np.pad(grown.predicted(columns), [(0, 0), (1, 0)])
            for reach in _REACHES:
                errors = known[reach][:, None] * path - y[test, a][:, None]
                out[reach][a] += (errors**2).sum(axis=0) / len(x)
    return out
