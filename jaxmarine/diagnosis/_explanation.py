"""What is said to act: members beside the file's coefficients, where they begin, amid which disturbance."""

import dataclasses

import numpy as np
from jaxtyping import Array, Float, Int

from ..fitting import LEAST_DAMPING, Disturbance, Kept, Path


@dataclasses.dataclass(frozen=True)
class Beginning:
    """When an effect begins: the log's index and the time in it [s]."""

    log: int
    time: float


@dataclasses.dataclass(frozen=True)
class Stretches:
    """Between which beginnings a sample lies: per log and sample a segment, and what each segment means.

    - `passed` [segments]: how many beginnings of members are passed in it.
    - `gates` [segments, placed]: which effects of the vehicle itself act in it.
    """

    of_samples: tuple[np.ndarray, ...]
    passed: Int[np.ndarray, " segments"]
    gates: Float[np.ndarray, "segments placed"]


@dataclasses.dataclass(frozen=True)
class Member:
    """A suspect that is in the model, acting always or from a beginning on."""

    suspect: int
    since: Beginning | None = None


@dataclasses.dataclass(frozen=True)
class Beside:
    """A disturbance, and the path along which the windows are followed beside it.

    - `covariance`: of the logarithms of its sizes and memories (`fitting.estimated`).
    """

    force: Disturbance
    path: Path
    covariance: Float[np.ndarray, "logarithms logarithms"]


@dataclasses.dataclass(frozen=True)
class Model:
    """Members, and where the last refinement left all numbers.

    - `z`: base coefficients' changes, then each member's parameters minus their neutral values.
    - `delta`: initial states of the windows, where these lie; `cost`: half the chi-square with the priors.
    - `promised`: the cost that one more step of it would reach by its last linearisation, with `damping`.
    - `weight`: of the prior on the file's coefficients, by how much the windows' scores scatter more than
      noise of the stated size would make them: that much more is left to bend to, and means nothing.
    - `frozen`: whether the file's coefficients are held at their values; `held`: those that are in any case.
    - `beside`: the disturbance beside which it is refined, None for white noise alone. With it `cost` is half
      of minus twice the logarithm of the likelihood with the disturbance's prior, but for a constant.
    """

    members: tuple[Member, ...]
    z: Float[np.ndarray, " z"]
    delta: Array | Kept
    cost: float
    promised: float = np.inf
    damping: float = LEAST_DAMPING
    weight: float = 1.0
    frozen: bool = False
    held: tuple[int, ...] = ()
    beside: Beside | None = None
