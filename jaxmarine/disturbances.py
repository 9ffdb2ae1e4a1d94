"""What wind, waves and water do to a craft at random."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ._types import DOFS


@dataclasses.dataclass(frozen=True)
class RandomWrench:
    """A Gauss-Markov wrench on the hull in body axes, a swell (the same with a period), and a current.

    Each axis has its own; what acts on two axes at once is not described. Source: after Fossen (2021), on
    shaping filters for slowly varying forces and for waves.

    - `size` [6]: standard deviation [N, N m], 0 where nothing acts; `memory` [6]: time [s] in which it
      forgets all but 1/e, read where something acts.
    - `swell` [6]: standard deviation of the swell [N, N m]; `period` [s]; `swell_memory` [s]: how long it
      stays in step with itself.
    - `current`: standard deviation of the water's velocity to the north and to the east [m/s], each;
      `current_memory` [s].
    """

    size: Float[np.ndarray, "6"]
    memory: Float[np.ndarray, "6"]
    swell: Float[np.ndarray, "6"] = dataclasses.field(default_factory=lambda: np.zeros(6))
    period: float | None = None
    swell_memory: float | None = None
    current: float = 0.0
    current_memory: float | None = None

    def draw(
        self, t: Float[np.ndarray, " times"], seed: int | np.random.SeedSequence
    ) -> Float[np.ndarray, "times 6"]:
        """One course of it over the times of a log [s], as `simulate` takes it for `push`.

        Exact at the samples, however far apart they are. The first value is a draw too: it has been blowing.
        `simulate` holds each until the next: where samples are farther apart than a small part of a memory or
        of a period, that pushes more than the disturbance would, of which means over a hold are smaller.
        """
        decay = 1.0 / np.where(self.size > 0, self.memory, 1.0).astype(complex)
        size = np.asarray(self.size, float)
        if self.period is not None and self.swell_memory is not None:
            turning = np.full(6, 1.0 / self.swell_memory - 2j * np.pi / self.period)
            decay, size = np.concatenate([decay, turning]), np.concatenate([size, self.swell])
        # Of a pair that turns, the real part is what pushes: both have the standard deviation `size`.
        normal = np.random.default_rng(seed).normal(size=(len(t), len(size), 2)) @ np.array([1.0, 1j])
        gap = np.diff(t, prepend=-np.inf)[:, None]
        left = np.exp(-decay * np.where(np.isfinite(gap), gap, 0.0)) * np.isfinite(gap)
        new = np.sqrt(1.0 - np.abs(left) ** 2) * size * normal
        out = np.empty_like(new)
        now = np.zeros(len(size), complex)
        for k in range(len(t)):
            now = left[k] * now + new[k]
            out[k] = now
        return out.real.reshape(len(t), -1, 6).sum(axis=1)

    def draw_current(self, t: Float[np.ndarray, " times"], seed: int) -> Float[np.ndarray, "times 3"]:
        """One course of the water's velocity, as `simulate` takes it for `water`."""
        memory = self.current_memory or 1.0
        level = np.array([self.current, self.current, 0, 0, 0, 0])
        # Another seed than that of the wrench: the two do not go together.
        return RandomWrench(level, np.full(6, memory)).draw(t, np.random.SeedSequence([seed, 1]))[:, :3]

    def to_json(self) -> dict:
        """What `diagnosis.json` holds of it: of each axis on which it acts, of swell and current, if any."""
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
        current = {"size_m_s": self.current, "memory_s": self.current_memory}
        return (
            {"axes": axes}
            | (period if self.period is not None else {})
            | ({"current": current} if self.current_memory is not None else {})
        )
