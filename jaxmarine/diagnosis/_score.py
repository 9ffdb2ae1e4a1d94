"""Linear algebra on the windows' statistics: what would be saved, and whether it is real."""

import abc
import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ..fitting import t_value as t_value

# Windows on either side that one disturbance may push alike.
NEIGHBOURS = 3
# Share that a window may keep of the one before: with more, a sum over some tens of them says nothing.
MOST_REMEMBERED = 0.85
# Folds of a cross-validation, and windows in one stretch of a fold.
FOLDS, STRETCH = 6, 3


Result = TypeVar("Result")


class AbstractStatistics(abc.ABC):
    """Statistics of windows, which may lie elsewhere: functions of them are asked, or kept where they lie.

    A function is one of a `Reduced`, of what is given `along` the windows (arrays, one row for each), and of
    what else is given; it is one that another process can import.
    """

    @abc.abstractmethod
    def each(self, of: Callable[..., Result], *given: Any, along: Sequence[Any] = ()) -> list[Result]:
        """What a function says in each place, in the order of the logs."""

    @abc.abstractmethod
    def keep(
        self, of: Callable[..., "Reduced"], *given: Any, along: Sequence[Any] = ()
    ) -> "AbstractStatistics":
        """The statistics that a function makes of these."""

    @abc.abstractmethod
    def lay(self, values: Float[np.ndarray, "windows ..."]) -> Any:
        """What may be given along in the place of values, which then lie where the statistics do."""


@dataclasses.dataclass(frozen=True)
class Reduced(AbstractStatistics):
    """Per window, or group of them: gradient and information of all columns, initial states eliminated."""

    chi2: Float[np.ndarray, " windows"]
    g: Float[np.ndarray, "windows columns"]
    h: Float[np.ndarray, "windows columns columns"]

    def each(self, of: Callable[..., Result], *given: Any, along: Sequence[Any] = ()) -> list[Result]:
        return [of(self, *along, *given)]

    def keep(
        self, of: Callable[..., "Reduced"], *given: Any, along: Sequence[Any] = ()
    ) -> AbstractStatistics:
        return of(self, *along, *given)

    def lay(self, values: Float[np.ndarray, "windows ..."]) -> Any:
        return values


def joined(parts: Sequence[Reduced]) -> Reduced:
    """Statistics of windows that lie in several places, in the order of the logs."""
    each = zip(*((one.chi2, one.g, one.h) for one in parts), strict=True)
    return Reduced(*map(rows, each))


def rows(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of windows that lie in several places, in the order of the logs."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def totals(parts: Sequence[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    """Sums over places of what each has summed."""
    return tuple(functools.reduce(operator.add, column) for column in zip(*parts, strict=True))


def solve(h: np.ndarray, g: np.ndarray) -> np.ndarray:
    """h^-1 g for a positive semidefinite h whose columns may be in very different units."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    scaled = h / np.outer(scale, scale)
    ridge = 1e-10 * np.eye(len(h))
    return (np.linalg.solve(scaled + ridge, (g.T / scale).T).T / scale).T


def root(h: np.ndarray) -> np.ndarray:
    """A matrix that times its transpose is a positive semidefinite h, which rounding may have spoilt."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    sizes, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(sizes, 0.0))


def step_with(
    g: Float[np.ndarray, " z"],
    h: Float[np.ndarray, "z z"],
    held: Int[np.ndarray, " held"],
    values: np.ndarray,
) -> Float[np.ndarray, " z"]:
    """The step that minimises 2 g'x + x'h x where some entries of x are held at values."""
    step = np.zeros(len(g))
    step[held] = values
    rest = np.setdiff1d(np.arange(len(g)), held)
    step[rest] = -solve(h[np.ix_(rest, rest)], g[rest] + h[np.ix_(rest, held)] @ values)
    return step


def scatter(per_window: Float[np.ndarray, " windows *columns"]) -> Float[np.ndarray, "*columns"]:
    """Variance of a sum over windows, per window, with what neighbours have in common.

    A slow disturbance pushes several windows in a row the same way: it does not average out as noise
    does. After Newey and West (1987), with their weights; never less than without neighbours.
    """
    count = len(per_window)
    off = per_window - per_window.mean(0)
    own = (off**2).sum(0)
    alike = sum(
        (1 - lag / (NEIGHBOURS + 1)) * 2 * (off[lag:] * off[:-lag]).sum(0)
        for lag in range(1, min(NEIGHBOURS, count - 2) + 1)
    )
    return (own + np.maximum(alike, 0.0)) / max(count - 1, 1)


def lasting(per_window: Float[np.ndarray, " windows *columns"]) -> Float[np.ndarray, "*columns"]:
    """Variance of a sum over windows, per window, if each remembers a share of the one before.

    Less biased than `scatter` where a disturbance lasts for some windows, as weights that fall off leave out
    much of that; less steady for decisions. After Andrews and Monahan (1992), prewhitening of first order.
    The share has its bias of small samples taken off (Kendall 1954). Never less than without memory.
    """
    count = len(per_window)
    off = per_window - per_window.mean(0)
    own = (off**2).sum(0)
    share = (off[1:] * off[:-1]).sum(0) / np.maximum(own, 1e-300)
    share = np.clip(share + (1 + 3 * share) / count, 0.0, MOST_REMEMBERED)
    new = ((off[1:] - share * off[:-1]) ** 2).sum(0)
    return np.maximum(new / (1 - share) ** 2 / max(count - 2, 1), own / max(count - 1, 1))


def blocks(windows: int) -> np.ndarray:
    """The fold of each window: stretches of some windows dealt out to the folds in turn.

    Each fold then sees the whole log, so that a slow signal (depth, heading) is not judged by
    extrapolation; the stretches' neighbours are left out of the fit by the caller.
    """
    size = max(1, min(STRETCH, windows // (2 * FOLDS)))
    return np.arange(windows) // size % min(FOLDS, windows)


def savings(
    stats: Reduced,
    known: np.ndarray,
    precision: np.ndarray,
    offset: np.ndarray,
    owns: tuple[np.ndarray, ...],
    earliest: int,
) -> Float[np.ndarray, "suspects windows"]:
    """Chi-square saved by every suspect, for every window from which it may begin to act.

    Column 0 is "always", column w "from window w on". Beginnings that leave
    fewer than `earliest` windows on a side are not considered (minus infinity).
    """
    windows = len(stats.g)
    h_kk = known.T @ stats.h.sum(0) @ known + np.diag(precision)
    g_k = known.T @ stats.g.sum(0) + precision * offset
    out = np.full((len(owns), windows), -np.inf)
    h_after, g_after = np.zeros_like(stats.h[0]), np.zeros_like(stats.g[0])
    for w in reversed(range(windows)):
        h_after, g_after = h_after + stats.h[w], g_after + stats.g[w]
        if w and (w < earliest or windows - w < earliest):
            continue
        h_kc = known.T @ h_after
        x = solve(h_kk, h_kc)
        h = h_after - x.T @ h_kc
        g = g_after - x.T @ g_k
        for i, own in enumerate(owns):
            own_g = own.T @ g
            out[i, w] = own_g @ solve(own.T @ h @ own, own_g)
    return out
