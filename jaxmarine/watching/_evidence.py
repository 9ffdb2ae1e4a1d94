"""What sums over blocks say of suspects, from any beginning on: the nats of a linear model.

Gradient and information of all parameters add up over blocks, and what is said from a beginning on is the
whole less what was said before. So a few sums tell of suspects that begin there.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..diagnosis import solve

# A direction of which known ones leave less than this share says nothing of its own.
OWN = 1e-8
# Share of a direction's information that is added for what rounding takes away, as in a diagnosis.
RIDGE = 1e-10
# Precision that stands for no prior, as in a diagnosis.
TRACE = 1e-8


class Sum(NamedTuple):
    """What was said until a time `t` [s], or from it on; -inf: all.

    - `seen`: how many numbers were measured; `g`, `h`: half the slope of -2 log p by the catalogue's
      parameters z at z = 0, and their information.
    """

    t: float
    seen: int
    g: Float[np.ndarray, " z"]
    h: Float[np.ndarray, "z z"]

    def without(self, columns: list[int]) -> "Sum":
        """As if it told nothing of some columns of z."""
        g, h = self.g.copy(), self.h.copy()
        g[columns], h[columns], h[:, columns] = 0.0, 0.0, 0.0
        return self._replace(g=g, h=h)


class Member(NamedTuple):
    """A suspect that is part of the model, from a time on [s]; -inf: always."""

    suspect: int
    since: float


class Acting(NamedTuple):
    """What acts over time: parameters z, each part from a time on [s]."""

    parts: tuple[tuple[float, Float[np.ndarray, " z"]], ...]

    def cut(self, times: Sequence[float]) -> "Acting":
        """The same, told as if nothing began at some times [s]."""
        return Acting((*self.parts, *((t, np.zeros(self.parts[0][1].shape)) for t in times)))

    def at(self, t) -> Float[np.ndarray, "*times z"]:
        """z at some times [s]."""
        t = np.asarray(t)[..., None]
        return sum(((t >= since - 1e-9) * z for since, z in self.parts), start=np.zeros(()))


@dataclasses.dataclass(frozen=True)
class Suspicions:
    """The columns of z: those of the file's coefficients, with their prior, and those of each suspect."""

    base: Int[np.ndarray, " base"]
    precision: Float[np.ndarray, " base"]
    columns: tuple[Float[np.ndarray, "z _"], ...]

    def _known(self, since: Sequence[Sum], members: Sequence[Member]):
        """Matrix and slope of what is known; per column its own columns of z and its beginning."""
        parts = [(np.eye(len(since[0].g))[:, self.base], 0)]
        parts += [(self.columns[m.suspect], place(since, m.since)) for m in members]
        size = [one.shape[1] for one, _ in parts]
        at = np.cumsum([0, *size])
        h, g = np.zeros((at[-1], at[-1])), np.zeros(at[-1])
        for i, (a, b) in enumerate(parts):
            g[at[i] : at[i + 1]] = a.T @ since[b].g
            for j, (c, d) in enumerate(parts):
                # What acts in both acts from the later one on.
                h[at[i] : at[i + 1], at[j] : at[j + 1]] = a.T @ since[later(since, b, d)].h @ c
        h += np.diag(np.concatenate([self.precision, np.full(at[-1] - size[0], TRACE)]))
        return parts, h, g

    def estimate(self, since: Sequence[Sum], members: Sequence[Member]) -> Float[np.ndarray, " known"]:
        """The file's coefficients' changes and each member's parameters."""
        _, h, g = self._known(since, members)
        return -solve(h, g)

    def acting(self, known: Float[np.ndarray, " known"], members: Sequence[Member]) -> Acting:
        """What acts over time by numbers as `estimate` gives them."""
        always = np.zeros(len(self.columns[0]))
        always[self.base] = known[: len(self.base)]
        parts = zip(members, self.parts_of(known, members), strict=True)
        return Acting(((-np.inf, always), *((m.since, self.columns[m.suspect] @ z) for m, z in parts)))

    def parts_of(self, known: np.ndarray, members: Sequence[Member]) -> list[np.ndarray]:
        """Those of what is known that are each member's."""
        ends = len(self.base) + np.cumsum([0, *(self.columns[m.suspect].shape[1] for m in members)])
        return np.split(known, ends)[1:-1]

    def errors(self, since: Sequence[Sum], members: Sequence[Member]) -> Float[np.ndarray, " known"]:
        """Standard errors of what is known."""
        _, h, _ = self._known(since, members)
        return np.sqrt(np.diag(solve(h, np.eye(len(h)))))

    def gained(self, since: Sequence[Sum], members: Sequence[Member]) -> float:
        """Nats by which the known parameters make all likelier than z = 0 does, the file's integrated out."""
        _, h, g = self._known(since, members)
        size = len(self.base)
        width = np.linalg.slogdet(h[:size, :size] / np.sqrt(np.outer(self.precision, self.precision)))[1]
        return 0.5 * float(g @ solve(h, g)) - 0.5 * float(width)

    def nats(self, since: Sequence[Sum], members: Sequence[Member]) -> Float[np.ndarray, "suspects begun"]:
        """Of every suspect beside the known ones, for every beginning; -inf of the members.

        Each parameter pays half the logarithm of the numbers measured since (Schwarz), as in a diagnosis.
        """
        parts, h_kk, g_k = self._known(since, members)
        every = np.concatenate(self.columns, axis=1)
        factor = np.linalg.inv(h_kk / scale_of(h_kk)) / scale_of(h_kk)
        own, left = [], []
        for b, one in enumerate(since):
            h_kc = np.concatenate([a.T @ since[later(since, d, b)].h for a, d in parts]) @ every
            h_whole = every.T @ one.h @ every
            h = h_whole - h_kc.T @ factor @ h_kc
            # What tells nothing of its own takes no part.
            tells = np.diag(h) > OWN * np.diag(h_whole) + 1e-300
            own.append(np.where(np.outer(tells, tells), h, np.eye(len(h))))
            left.append(np.where(tells, every.T @ one.g - h_kc.T @ (factor @ g_k), 0.0))
        own, left = np.array(own), np.array(left)
        price = 0.5 * np.log(np.maximum([one.seen for one in since], 2))
        taken, ends = {m.suspect for m in members}, np.cumsum([one.shape[1] for one in self.columns])
        out = np.full((len(self.columns), len(since)), -np.inf)
        for i, (columns, end) in enumerate(zip(self.columns, ends, strict=True)):
            if i not in taken:
                here = slice(end - columns.shape[1], end)
                out[i] = gains(own[:, here, here], left[:, here]) - columns.shape[1] * price
        return out


def gains(h: Float[np.ndarray, "some z z"], g: Float[np.ndarray, "some z"]) -> Float[np.ndarray, " some"]:
    """Nats by which the best z of each makes it likelier than z = 0, columns in any units."""
    scale = np.sqrt(np.diagonal(h, axis1=1, axis2=2))
    scaled = h / (scale[:, :, None] * scale[:, None]) + RIDGE * np.eye(h.shape[1])
    pulled = (g / scale)[..., None]
    return 0.5 * (pulled * np.linalg.solve(scaled, pulled)).sum(axis=(1, 2))


def later(since: Sequence[Sum], a: int, b: int) -> int:
    return a if since[a].t >= since[b].t else b


def place(since: Sequence[Sum], t: float) -> int:
    """The beginning that is nearest to a time."""
    if t == -np.inf:
        return 0
    return int(np.argmin([np.inf if one.t == -np.inf else abs(one.t - t) for one in since]))


def scale_of(h: np.ndarray) -> np.ndarray:
    root = np.sqrt(np.maximum(np.diag(h), 1e-300))
    return np.outer(root, root)
