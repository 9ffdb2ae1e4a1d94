"""How well the data determine what was fitted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from ..vehicle import Vehicle
from ._estimate import Estimate, Units, entries_at
from ._free import Freed, Scales

# Below this eigenvalue of the scaled information a combination is not determined: its standard
# error is more than a third of its typical size.
UNDETERMINED = 9.0
# Windows below which their scatter says too little; least share of information outside a window.
_FEWEST, _LEAST_REST = 8, 0.02
# Least weight in a unit combination at which a parameter is named.
_NAMED = 0.3


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One freed entry: its value before and after, with two standard errors.

    - `std_model`: from the curvature of the chi-square, right if the stated noise is all there is.
    - `std_sandwich`: from the scatter of the windows' scores (White 1982), right also under
      coloured disturbances that last less than a window; NaN for fewer than eight windows.
    """

    name: str
    start: float
    value: float
    std_model: float
    std_sandwich: float


@dataclasses.dataclass(frozen=True)
class Combination:
    """A direction that the data do not determine: its `eigenvalue`, and the parameters in it.

    Parameters count in units of their typical size; the standard error along the direction is
    eigenvalue**-0.5.
    """

    eigenvalue: float
    weights: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        terms = (f"{weight:+.2f} {name}" for name, weight in self.weights)
        return " ".join(terms)


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Covariances of the freed entries, and the eigenvalues of their scaled information, rising."""

    parameters: tuple[Parameter, ...]
    covariance_model: Float[np.ndarray, "entries entries"]
    covariance_sandwich: Float[np.ndarray, "entries entries"]
    information: Float[np.ndarray, " entries"]
    undetermined: tuple[Combination, ...]


@dataclasses.dataclass(frozen=True)
class Posterior:
    """The vehicles that the data and the prior leave, to first order in what is free: normal in raw numbers.

    - `mean`, `root` [raw, z]: raw numbers are mean + root @ n for standard normal n.
    """

    freed: Freed
    mean: Float[np.ndarray, " raw"]
    root: Float[np.ndarray, "raw z"]

    def draw(self, count: int, key: PRNGKeyArray) -> tuple[Vehicle, ...]:
        """So many of them, independent; each keeps the constraints of the fit."""
        normal = jax.random.normal(key, (count, self.root.shape[1]))
        return tuple(self.freed(jnp.asarray(self.mean + self.root @ np.asarray(n))) for n in normal)


def posterior(freed: Freed, units: Units, estimate: Estimate) -> Posterior:
    """By the curvature at the estimate, as `std_model`; all NaN where the solve has diverged."""
    information = estimate.information.sum(0) + np.diag(units.precision)
    if not estimate.finite:
        return Posterior(freed, estimate.raw, np.full_like(units.map, np.nan))
    values, vectors = np.linalg.eigh(information)
    # Nothing is less known than its prior has it, whatever rounding has left of the rest.
    values = np.maximum(values, units.precision.min())
    return Posterior(freed, estimate.raw, units.map @ (vectors / np.sqrt(values)))


def uncertainty(freed: Freed, scales: Scales, units: Units, estimate: Estimate) -> Uncertainty:
    """By linear propagation at the estimate; the prior counts as one more observation.

    All NaN where the solve has diverged.
    """
    start, _ = entries_at(freed, np.asarray(freed.start))
    # What the factors of a zero entry leave of it by rounding.
    start = np.where(np.abs(start) < 1e-12 * scales.size, 0.0, start)
    value, by_raw = entries_at(freed, estimate.raw)
    if estimate.finite:
        by_z = by_raw @ units.map
        information = estimate.information.sum(0)
        model = by_z @ np.linalg.inv(information + np.diag(units.precision)) @ by_z.T
        sandwich = by_z @ _sandwich(estimate, units) @ by_z.T
        size = np.maximum(scales.size, np.abs(value))
        eigenvalues, vectors = _scaled_information(information - estimate.spurious, by_z / size[:, None])
    else:
        model = sandwich = vectors = np.full((len(value), len(value)), np.nan)
        eigenvalues = np.full(len(value), np.nan)
    deviations = zip(np.sqrt(np.diag(model)), np.sqrt(np.diag(sandwich)), strict=True)
    return Uncertainty(
        parameters=tuple(
            Parameter(name, float(a), float(b), float(c), float(d))
            for name, a, b, (c, d) in zip(freed.names, start, value, deviations, strict=True)
        ),
        covariance_model=model,
        covariance_sandwich=sandwich,
        information=eigenvalues,
        undetermined=tuple(
            Combination(float(eigenvalue), named(freed.names, vector))
            for eigenvalue, vector in zip(eigenvalues, vectors.T, strict=True)
            if eigenvalue < UNDETERMINED
        ),
    )


def _sandwich(estimate: Estimate, units: Units) -> np.ndarray:
    """Covariance of z from the scatter of the scores, each freed of what the fit took from it.

    With the total information as unit, the score of a window with information h has, under the
    model, the covariance h - h²; (1 - h)^-1/2 restores h, so that the result is unbiased.
    After Bell and McCaffrey (2002), Survey Methodology 28, 169-181.
    """
    count = estimate.scores.shape[1]
    if len(estimate.scores) < _FEWEST:
        return np.full((count, count), np.nan)
    total = estimate.information.sum(0) + np.diag(units.precision)
    # Scaled to a diagonal of ones: held entries, whose precision is huge, would cost it its last digits.
    size = np.sqrt(np.diag(total))
    unit = np.linalg.inv(np.linalg.cholesky(total / np.outer(size, size))) / size
    share, axes = np.linalg.eigh(unit @ estimate.information @ unit.T)
    # A window that alone determines a parameter says nothing of its scatter.
    grow = np.clip(1.0 - share, _LEAST_REST, None) ** -0.5
    scores = np.einsum("wij,wj,wkj,kl,wl->wi", axes, grow, axes, unit, estimate.scores, optimize=True)
    meat = scores.T @ scores + unit @ np.diag(units.precision * units.has_prior) @ unit.T
    return unit.T @ meat @ unit


def _scaled_information(information: np.ndarray, by_z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors of the information on the entries, in units of their sizes."""
    # A dissipative matrix at its bound has no slope: the data then say nothing of that direction.
    inverse = np.linalg.pinv(by_z, rcond=1e-9)
    scaled = inverse.T @ information @ inverse
    eigenvalues, vectors = np.linalg.eigh((scaled + scaled.T) / 2)
    return np.maximum(eigenvalues, 0.0), vectors


def named(names: tuple[str, ...], vector: np.ndarray) -> tuple[tuple[str, float], ...]:
    order = np.argsort(-np.abs(vector))
    large = [k for k in order if abs(vector[k]) >= _NAMED] or [order[0]]
    return tuple((names[k], float(vector[k])) for k in large)


def t_value(per_window: Float[np.ndarray, " windows"]) -> float:
    """A sum over windows in standard errors of it."""
    return float(per_window.sum() / max(np.sqrt(len(per_window)) * per_window.std(ddof=1), 1e-12))
