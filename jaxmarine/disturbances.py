"""What wind, waves and water do to a craft at random."""

import dataclasses

import numpy as np
import scipy.linalg
from jaxtyping import Float

from ._types import DOFS

# Memories of a swell after which nothing is left of it that counts.
FORGOTTEN = 40.0


@dataclasses.dataclass(frozen=True)
class RandomWrench:
    """A Gauss-Markov wrench on the hull in body axes, a swell, a drift in earth axes, and a current.

    Each axis has its own; what acts on two axes at once is not described. A swell is white noise twice
    through

        s / (s^2 + 2 s / swell_memory + 1 / swell_memory^2 + (2 pi / period)^2),

    so that no part of it lasts and hardly anything is far from its period. Source: after Fossen (2021), on
    filters for slowly varying forces, in body and in earth axes, and for waves.

    - `size` [6]: standard deviation [N, N m], 0 where nothing acts; `memory` [6]: time [s] in which it
      forgets all but 1/e, read where something acts.
    - `swell` [6]: standard deviation of the swell [N, N m]; `period` [s]; `swell_memory` [s]: how long it
      stays in step with itself, as of the filter; after it a correlation of 2/e is left, of 1/e after 2.15.
    - `drift`: standard deviation of a force to the north and to the east [N], each; `drift_memory` [s].
    - `current`: standard deviation of the water's velocity to the north and to the east [m/s], each;
      `current_memory` [s].
    """

    size: Float[np.ndarray, "6"]
    memory: Float[np.ndarray, "6"]
    swell: Float[np.ndarray, "6"] = dataclasses.field(default_factory=lambda: np.zeros(6))
    period: float | None = None
    swell_memory: float | None = None
    drift: float = 0.0
    drift_memory: float | None = None
    current: float = 0.0
    current_memory: float | None = None

    def __post_init__(self):
        memories = {"period": "swell_memory", "drift": "drift_memory", "current": "current_memory"}
        for one, memory in memories.items():
            if getattr(self, one) and not getattr(self, memory):
                raise ValueError(f"A RandomWrench with `{one}` needs `{memory}` [s], which is not given.")

    def draw(self, t: Float[np.ndarray, " times"], seed: int) -> Float[np.ndarray, "times 6"]:
        """One course of it over the times of a log [s], as `simulate` takes it for `push`.

        Exact at the samples, however far apart they are. The first value is a draw too: it has been blowing.
        `simulate` goes along lines from one to the next: where samples are farther apart than a small part of
        a memory or of a period, that pushes otherwise than the disturbance would.
        """
        rng, gap = np.random.default_rng(seed), np.diff(t, prepend=-np.inf)
        out = _course(np.where(self.size > 0, self.memory, 1.0), self.size, gap, rng)
        return out if self.period is None else out + self._swelling(gap, rng)

    def _swelling(
        self, gap: Float[np.ndarray, " times"], rng: np.random.Generator
    ) -> Float[np.ndarray, "times 6"]:
        """The swell at times that are so far apart [s]: white noise twice through the filter of this class.

        Of two filters in a row, each of two numbers of which the first comes out; `fitting` has the same in
        closed form, for JAX.
        """
        assert self.period is not None and self.swell_memory is not None
        frequency, slow = 2 * np.pi / self.period, 1.0 / self.swell_memory
        pair = np.array([[-slow, -frequency], [frequency, -slow]])
        into = np.array([1.0, slow / frequency])
        rates = np.block([[pair, np.zeros((2, 2))], [np.outer(into, [1.0, 0.0]), pair]])
        noise = np.pad(np.outer(into, into), (0, 2))
        whole = np.asarray(scipy.linalg.solve_continuous_lyapunov(rates, -noise))
        # What was before the first of the times is forgotten: some memories are as good as all.
        stays = scipy.linalg.expm(np.minimum(gap, FORGOTTEN * self.swell_memory)[:, None, None] * rates)
        value, way = np.linalg.eigh(whole - stays @ whole @ np.swapaxes(stays, 1, 2))
        # Rounding makes the least one of a short time less than nothing.
        root = way * np.sqrt(np.maximum(value, 0.0))[:, None]
        now, out = np.zeros((4, 6)), np.empty((len(gap), 6))
        for k, new in enumerate(root @ rng.normal(size=(len(gap), 4, 6))):
            now = stays[k] @ now + new
            out[k] = now[2]
        return self.swell * out / np.sqrt(whole[2, 2])

    def draw_current(self, t: Float[np.ndarray, " times"], seed: int) -> Float[np.ndarray, "times 3"]:
        """One course of the water's velocity, as `simulate` takes it for `water`."""
        return _level(self.current, self.current_memory, t, np.random.SeedSequence([seed, 1]))

    def draw_drift(self, t: Float[np.ndarray, " times"], seed: int) -> Float[np.ndarray, "times 3"]:
        """One course of the force in earth axes, as `simulate` takes it for `drift`."""
        return _level(self.drift, self.drift_memory, t, np.random.SeedSequence([seed, 2]))

    def to_json(self) -> dict:
        """What `diagnosis.json` holds of it: of each axis on which it acts, of swell, drift and current."""
        axes = {}
        for i, dof in enumerate(DOFS):
            one: dict[str, float | str] = {"unit": "N" if i < 3 else "N m"}
            if self.size[i] > 0:
                one |= {"size": float(self.size[i]), "memory_s": float(self.memory[i])}
            if self.swell[i] > 0:
                one |= {"swell": float(self.swell[i])}
            if len(one) > 1:
                axes[dof] = one
        period = {"period_s": self.period, "swell_memory_s": self.swell_memory}
        drift = {"size_N": self.drift, "memory_s": self.drift_memory}
        current = {"size_m_s": self.current, "memory_s": self.current_memory}
        return (
            {"axes": axes}
            | (period if self.period is not None else {})
            | ({"drift": drift} if self.drift_memory is not None else {})
            | ({"current": current} if self.current_memory is not None else {})
        )


def _course(
    memory: Float[np.ndarray, " n"],
    size: Float[np.ndarray, " n"],
    gap: Float[np.ndarray, " times"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "times n"]:
    """Gauss-Markov numbers of some memories [s] and sizes, at times that are so far apart [s]."""
    left = np.exp(-gap[:, None] / memory)
    out, now = np.sqrt(1.0 - left**2) * size * rng.normal(size=left.shape), np.zeros(len(size))
    for k in range(len(gap)):
        now = out[k] = left[k] * now + out[k]
    return out


def _level(
    size: float, memory: float | None, t: Float[np.ndarray, " times"], seed: np.random.SeedSequence
) -> Float[np.ndarray, "times 3"]:
    """One course of what has a size to the north and to the east, and no part downwards.

    - `seed`: another than that of the wrench, which it does not go with.
    """
    gap, rng = np.diff(t, prepend=-np.inf), np.random.default_rng(seed)
    return np.pad(_course(np.full(2, memory or 1.0), np.full(2, size), gap, rng), ((0, 0), (0, 1)))
