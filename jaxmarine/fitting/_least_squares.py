"""Linear least squares on the equations of motion: the classical baseline.

At every sample the measured motion makes the equations of motion linear in masses, damping and
gains, Y(nu', nu, ...) p = tau. The regressor Y is the derivative of the inverse dynamics.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

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
    """Least squares by QR with Householder reflections; Golub and Van Loan (2013), sec. 5.3.

    Rows that are all zero, on both sides, do not count as samples.
    """
    # Columns of one length, so that the triangular solve sees no units.
    length = jnp.sqrt((matrix**2).sum(0))
    length = jnp.where(length > 0, length, 1.0)
    q, r = jnp.linalg.qr(matrix / length[None])
    scaled = jax.scipy.linalg.solve_triangular(r, q.T @ right)
    inverse = jax.scipy.linalg.solve_triangular(r, jnp.eye(len(length))) / length[:, None]
    rest = right - matrix @ (scaled / length)
    used = ((matrix != 0).any(axis=1) | (right != 0)).sum()
    variance = (rest**2).sum() / jnp.maximum(used - len(length), 1)
    return LinearSolution(scaled / length, variance * inverse @ inverse.T)


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
    noise: Float[np.ndarray, "18"] | None = None,
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
    group = jnp.asarray(groups_of(logs, known.shape[1], window))
    weight, ones = 1.0 * known, jnp.ones(int(group.max()) + 1)
    first = _weighted(matrix, right, weight, group, ones)
    rest = np.asarray(right - matrix @ first.values)
    scatter = jnp.asarray(scatter_of(rest, np.asarray(known)))
    weight = weight / jnp.maximum(scatter, 1e-12)[None, None]
    solution = _weighted(matrix, right, weight, group, ones)
    keys = jax.random.split(jax.random.key(0) if key is None else key, bootstrap)
    resampled = _resampled(matrix, right, weight, group, keys, len(ones))
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
def _weighted(matrix, right, weight, group, count: Float[Array, " groups"]) -> LinearSolution:
    """The solution where each group of samples counts so many times."""
    weight = weight * jnp.sqrt(count)[group][..., None]
    rows = (matrix * weight[..., None]).reshape(-1, matrix.shape[-1])
    return solve_linear(rows, (right * weight).ravel())


@eqx.filter_jit
def _resampled(matrix, right, weight, group: Int[Array, "logs steps"], keys, groups: int):
    def one(key):
        drawn = jax.random.randint(key, (groups,), 0, groups)
        count = jnp.zeros(groups).at[drawn].add(1.0)
        return _weighted(matrix, right, weight, group, count).values

    return jax.vmap(one)(keys)


def _check_rank(rows: np.ndarray, names: tuple[str, ...]) -> None:
    length = np.linalg.norm(rows, axis=0)
    left = np.abs(np.diag(np.linalg.qr(rows / np.where(length > 0, length, 1.0), mode="r")))
    lost = [name for name, share in zip(names, left, strict=True) if share < _INDEPENDENT]
    if lost:
        raise ValueError(f"The data do not determine {', '.join(lost)}; free less or excite more.")
