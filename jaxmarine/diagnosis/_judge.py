"""What the residual of a model says of it: how far it scatters, what wrench it lacks, whether it is noise."""

import dataclasses

import numpy as np

from ..fitting import Disturbance
from ._explanation import Model
from ._knots import Knots, KnotsBeside, knots
from ._score import Reduced
from ._search import dispersion
from ._workbench import Workbench

# What is left is sensor noise alone where its chi-square is at most this many standard deviations, and this
# share for rounding, above its expectation (and where scores scatter as noise does).
DEVIATIONS, ROUNDING = 5.0, 0.01


@dataclasses.dataclass(frozen=True)
class Judged:
    """A model with what its residual says.

    - `stats`, `phi`: its statistics and the dispersion of the windows' scores, beside its disturbance.
    - `left`: the missing wrench beside the disturbance.
    - `plain_phi`, `knots`: dispersion and the missing wrench of the same model without a disturbance.
    - `white`: whether only sensor noise is left: its size is right, and the scores scatter like it.
    """

    model: Model
    stats: Reduced
    phi: float
    left: Knots
    plain_phi: float
    knots: Knots
    white: bool

    @property
    def disturbance(self) -> Disturbance | None:
        """Beside which it stands, and what else is unknown."""
        return self.left.disturbance if isinstance(self.left, KnotsBeside) else None


def judged(bench: Workbench, model: Model) -> Judged:
    """The model with what its residual says, by one linearisation."""
    stats = bench.screen(model)
    phi = dispersion(bench, model, stats)
    plain = bench.undisturbed(model)
    plain_phi = dispersion(bench, plain, bench.screen(plain))
    missing = knots(bench, plain)
    size = 1.0 + DEVIATIONS * np.sqrt(2.0 / bench.freedom) + ROUNDING
    alike = plain_phi < bench.criteria.scatter
    quiet = missing.chi2.sum() / bench.freedom < size and alike and not bench.raised
    left = missing if plain is model else knots(bench, model)
    return Judged(model, stats, phi, left, plain_phi, missing, bool(quiet))
