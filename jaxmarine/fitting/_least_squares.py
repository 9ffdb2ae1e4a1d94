"""Linear least squares on the equations of motion: the classical baseline.

At every sample the measured motion makes the equations of motion linear in masses, damping and
gains, Y(nu', nu, ...) p = tau. The regressor Y is the derivative of the inverse dynamics.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from .._errors import InputError
from .._precision import need_double
from ..logs import Log
from ..vehicle import Vehicle
from ._estimate import units
from ._free import Select, Selection, set_free
from ._noise import noise_of
from ._one_step import OneStep, groups_of, one_step, scatter_of

# Share of a regressor that must be left after the others are taken out of it.
_INDEPENDENT = 1e-9


class LinearSolution(eqx.Module):
    """`values` that minimise |A p - b|², and their covariance s² (A'A)^-1, s² of the residuals."""

    values: Float[Array, " p"]
    covariance: Float[Array, "p p"]

    @property
    def std(self) -> Float[Array, " p"]:
        """Standard errors."""
        return jnp.sqrt(jnp.diag(self.covariance))


def solve_linear(matrix: Float[Array, "rows p"], right: Float[Array, " rows"]) -> LinearSolution:
    """Least squares by QR with Householder reflections; after Golub and Van Loan (2013).

    Rows that are all zero, on both sides, do not count as samples.
    """
    q, r, length = _factored(matrix)
    scaled = jax.scipy.linalg.solve_triangular(r, q.T @ right)
    inverse = jax.scipy.linalg.solve_triangular(r, jnp.eye(len(length))) / length[:, None]
    rest = right - matrix @ (scaled / length)
    used = ((matrix != 0).any(axis=1) | (right != 0)).sum()
    variance = (rest**2).sum() / jnp.maximum(used - len(length), 1)
    return LinearSolution(scaled / length, variance * inverse @ inverse.T)


def _factored(matrix: Float[Array, "rows p"]):
    """Q, R and lengths such that the matrix is Q R times the lengths, column by column."""
    # Columns of one length, so that the triangular solve sees no units.
    length = jnp.sqrt((matrix**2).sum(0))
    length = jnp.where(length > 0, length, 1.0)
    return *jnp.linalg.qr(matrix / length[None]), length


def members_of(group: Int[np.ndarray, " samples"]) -> Int[np.ndarray, "groups most"]:
    """The samples of each group by index; smaller ones filled up by the index behind the last."""
    order = np.argsort(group, kind="stable")
    sizes = np.bincount(group)
    out = np.full((len(sizes), sizes.max()), len(group))
    out[np.arange(out.shape[1])[None] < sizes[:, None]] = order
    return out


@eqx.filter_jit
def resample_linear(
    matrix: Float[Array, "samples axes p"],
    right: Float[Array, "samples axes"],
    members: Int[Array, "groups most"],
    keys: Key[Array, " draws"],
) -> Float[Array, "draws p"]:
    """Least squares once per key, on as many groups of samples as there are, drawn with replacement.

    - `members`: the samples of each group (`members_of`).

    Each group's part of the normal equations is formed once; a draw only counts the groups. It is formed
    of orthonormal columns, in which the sum over all groups is the identity: the normal equations of a
    draw are then about as well conditioned as its groups are alike, whatever the condition of the matrix.
    """
    samples, axes, count = matrix.shape
    q, r, length = _factored(matrix.reshape(-1, count))
    groups, most = members.shape

    def grouped(a):
        return a.at[members].get(mode="fill", fill_value=0.0).reshape(groups, most * axes, -1)

    rows, sides = grouped(q.reshape(samples, axes, count)), grouped(right[..., None])
    parts = jnp.einsum("gri,grj->gij", rows, jnp.concatenate([rows, sides], axis=-1))

    def one(key):
        drawn = jnp.zeros(groups).at[jax.random.randint(key, (groups,), 0, groups)].add(1.0)
        summed = jnp.tensordot(drawn, parts, 1)
        scaled = jnp.linalg.solve(summed[:, :-1], summed[:, -1])
        return jax.scipy.linalg.solve_triangular(r, scaled) / length

    # One draw after the other: see `Statistics.reduced` for what a batch of small factorisations does.
    return jax.lax.map(one, keys)


class LeastSquares(eqx.Module):
    """A vehicle fitted by linear least squares.

    - `names`, `solution`: the freed entries, with standard errors that hold for white residuals.
    - `bootstrap` [samples, p]: the same from windows drawn with replacement.
    """

    vehicle: Vehicle
    solution: LinearSolution
    bootstrap: Float[Array, "samples p"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def std_bootstrap(self) -> Float[Array, " p"]:
        """Standard errors from the scatter over resampled windows; NaN for fewer than two."""
        if len(self.bootstrap) < 2:
            return jnp.full(len(self.names), jnp.nan)
        return jnp.std(self.bootstrap, axis=0, ddof=1)


def least_squares(
    vehicle: Vehicle,
    logs: Log | Sequence[Log],
    free: Select,
    *,
    entries: Selection = "all",
    window: float = 4.0,
    bootstrap: int = 0,
    key: PRNGKeyArray | None = None,
    noise: Float[np.ndarray, " channels"] | None = None,
) -> LeastSquares:
    """Fits what enters the inverse dynamics linearly, in one linear solve per weighting.

    - `free`, `entries`, `noise`: as in `fit`. Inertia is symmetric, but nothing keeps it positive.
    - `bootstrap`: number of resamplings of windows of `window` seconds; `key` chooses them.

    Axes are weighed by the scatter that a first solve leaves. Noise in the velocities biases the
    result, as it does that of `fit(..., loss="one_step")`.

    Raises `InputError` for logs that cannot be fitted, as `fit` does, and `ValueError` where a freed
    parameter does not enter linearly, where the data do not determine one, and without double precision.
    """
    logs = (logs,) if isinstance(logs, Log) else tuple(logs)
    if not logs:
        raise InputError("Least squares need at least one log.")
    need_double("A fit")
    noise = noise_of(vehicle, logs) if noise is None else noise
    freed, scales = set_free(vehicle, free, entries=entries, linear=True)
    task = one_step(freed, units(freed, scales), logs, noise)
    matrix, right, curved = _regression(task)
    if bool(curved):
        raise ValueError(
            "Least squares needs parameters that enter the equations of motion linearly; use `fit`."
        )
    known = task.samples.weight > 0
    _check_rank(np.asarray(matrix)[np.asarray(known)], freed.names)
    weight = 1.0 * known
    first = _weighted(matrix, right, weight)
    rest = np.asarray(right - matrix @ first.values)
    scatter = jnp.asarray(scatter_of(rest, np.asarray(known)))
    weight = weight / jnp.maximum(scatter, 1e-12)[None, None]
    solution = _weighted(matrix, right, weight)
    members = members_of(groups_of(logs, known.shape[1], window).ravel())
    keys = jax.random.split(jax.random.key(0) if key is None else key, bootstrap)
    resampled = resample_linear(
        (matrix * weight[..., None]).reshape(-1, *matrix.shape[2:]),
        (right * weight).reshape(-1, right.shape[-1]),
        jnp.asarray(members),
        keys,
    )
    scale = jnp.asarray(scales.size)
    return LeastSquares(
        vehicle=freed(solution.values * scale + freed.start),
        solution=LinearSolution(
            solution.values * scale + freed.start,
            scale[:, None] * solution.covariance * scale[None],
        ),
        bootstrap=resampled * scale[None] + freed.start[None],
        names=freed.names,
    )


@eqx.filter_jit
def _regression(task: OneStep):
    """Regressors [logs, steps, 6, z] and right side of the linear problem; whether it is none."""
    zero = jnp.zeros_like(task.precision)
    missing, matrix = task.missing(zero), jax.jacfwd(task.missing)(zero)
    # An affine function is known from its value and slope: another point must agree.
    other = jnp.ones_like(zero)
    expected = missing + matrix @ other
    error = jnp.abs(task.missing(other) - expected).max()
    return matrix, -missing, error > 1e-6 * jnp.abs(expected - missing).max()


@eqx.filter_jit
def _weighted(matrix, right, weight) -> LinearSolution:
    rows = (matrix * weight[..., None]).reshape(-1, matrix.shape[-1])
    return solve_linear(rows, (right * weight).ravel())


def _check_rank(rows: np.ndarray, names: tuple[str, ...]) -> None:
    length = np.linalg.norm(rows, axis=0)
    left = np.abs(np.diag(np.linalg.qr(rows / np.where(length > 0, length, 1.0), mode="r")))
    lost = [name for name, share in zip(names, left, strict=True) if share < _INDEPENDENT]
    if lost:
        raise ValueError(f"The data do not determine {', '.join(lost)}; free less or excite more.")
