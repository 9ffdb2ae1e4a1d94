"""What a solve leaves behind, whichever loss it minimised: the input of all uncertainty."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._free import Freed, Scales

# Inverse variance, per squared typical size, of a parameter without prior: a trace of curvature
# that keeps within ten sizes what the data do not determine. Where the size is but a guess, a
# thousand.
_TRACE, _FAINT_TRACE = 1e-2, 1e-6


@dataclasses.dataclass(frozen=True)
class Units:
    """The solver's unknowns z: raw = start + map @ z, one z per freed entry.

    To first order a unit of z is one standard deviation of the entry's prior, or one typical size
    where it has none. `precision` is that of the normal prior on z.
    """

    map: Float[np.ndarray, "raw z"]
    precision: Float[np.ndarray, " z"]
    has_prior: np.ndarray


def units(freed: Freed, scales: Scales) -> Units:
    """The unknowns at the start of `freed`."""
    _, by_raw = entries_at(freed, np.asarray(freed.start))
    has_prior = np.isfinite(scales.prior)
    return Units(
        map=np.linalg.solve(by_raw, np.diag(np.where(has_prior, scales.prior, scales.size))),
        precision=np.where(has_prior, 1.0, np.where(scales.known, _TRACE, _FAINT_TRACE)),
        has_prior=has_prior,
    )


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Where a solve ended.

    - `z`; `raw`: the raw numbers of `Freed` there.
    - `scores` [groups, z]: derivative of half the chi-square of each window.
    - `information` [groups, z, z]: that of each window, without prior.
    - `spurious` [z, z]: the part of the information that comes from noise in the regressors.
    - `chi2` without prior, in units of the sensors' noise, and its `freedom`: samples less everything that
      was fitted; `weighed_chi2`: what was minimised, NaN where that is the same.
    - `steps`, `converged`, `result`: how the solve ended, in words.
    - `rejected`: times at which windows begin that were left out [s].
    - `weighed` [channels]: factors of the sensors' noise that channels were weighed with in the end; `left`
      [channels]: root mean square of what the model leaves in each, in units of it, NaN: not measured.
    - `worst`: in words, where the model misses most.
    """

    z: Float[np.ndarray, " z"]
    raw: Float[np.ndarray, " raw"]
    scores: Float[np.ndarray, "groups z"]
    information: Float[np.ndarray, "groups z z"]
    spurious: Float[np.ndarray, "z z"]
    chi2: float
    freedom: float
    steps: int
    converged: bool
    result: str
    weighed: Float[np.ndarray, " channels"]
    left: Float[np.ndarray, " channels"]
    rejected: Float[np.ndarray, " rejected"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    worst: str = ""
    weighed_chi2: float = np.nan

    @property
    def finite(self) -> bool:
        """Whether the solve ended at a point where anything can be said."""
        parts = (self.chi2, self.raw, self.scores, self.information)
        return all(bool(np.isfinite(part).all()) for part in parts)

    def promise(self, units: Units) -> Float[np.ndarray, " z"]:
        """Half the chi-square that one more undamped step promises to save, by what each z contributes."""
        g = self.scores.sum(0) + units.precision * self.z
        curvature = self.information.sum(0) + np.diag(units.precision)
        return 0.5 * g * np.linalg.solve(curvature, g)


def entries_at(freed: Freed, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The freed entries at `raw`, and their derivative with respect to it."""
    values, slopes = _entries_at(freed, jnp.asarray(raw))
    return np.asarray(values), np.asarray(slopes)


@eqx.filter_jit
def _entries_at(freed: Freed, raw: Float[Array, " raw"]) -> tuple[Array, Array]:
    return freed.entries(raw), jax.jacfwd(freed.entries)(raw)
