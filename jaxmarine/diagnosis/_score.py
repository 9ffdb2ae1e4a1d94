"""Linear algebra on the windows' statistics: what would be saved, and whether it is real."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Reduced:
    """Per window: gradient and information of all columns, initial states eliminated."""

    chi2: Float[np.ndarray, " windows"]
    g: Float[np.ndarray, "windows columns"]
    h: Float[np.ndarray, "windows columns columns"]


def solve(h: np.ndarray, g: np.ndarray) -> np.ndarray:
    """h^-1 g for a positive semidefinite h whose columns may be in very different units."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    scaled = h / np.outer(scale, scale)
    ridge = 1e-10 * np.eye(len(h))
    return (np.linalg.solve(scaled + ridge, (g.T / scale).T).T / scale).T


def blocks(windows: int, count: int = 6, size: int = 3) -> np.ndarray:
    """The fold of each window: stretches of `size` windows dealt out to the folds in turn.

    Each fold then sees the whole log, so that a slow signal (depth, heading) is not judged by
    extrapolation; the stretches' neighbours are left out of the fit by the caller.
    """
    size = max(1, min(size, windows // (2 * count)))
    return np.arange(windows) // size % min(count, windows)


def left_out_savings(
    stats: Reduced, precision: np.ndarray, offset: np.ndarray, own: np.ndarray
) -> Float[np.ndarray, " windows"]:
    """Chi-square that the last columns save on each window when fitted on the others.

    - `stats`: columns of what is known, then of what is judged; `precision`, `offset`: prior of the known
      ones (inverse variance, and value minus mean); `own`: prior precision of the judged ones.

    Neighbours on both sides of a left-out stretch are kept out of the fit too, because windows that touch
    share disturbances.
    """
    n = len(precision)
    prior = np.diag(np.concatenate([precision, own]))
    pull = np.concatenate([precision * offset, np.zeros(len(own))])
    fold = blocks(len(stats.g))
    g_all, h_all = stats.g.sum(0), stats.h.sum(0)
    out = np.zeros(len(stats.g))
    for b in np.unique(fold):
        left = fold == b
        near = np.convolve(left, [1, 1, 1], "same") > 0
        h_fit = h_all - stats.h[near].sum(0) + prior
        g_fit = g_all - stats.g[near].sum(0) + pull
        full = -solve(h_fit, g_fit)
        without = np.zeros(len(full))
        without[:n] = -solve(h_fit[:n, :n], g_fit[:n])
        for step, sign in ((full, -1.0), (without, 1.0)):
            change = 2 * stats.g[left] @ step + np.einsum(
                "wab,a,b->w", stats.h[left], step, step, optimize=True
            )
            out[left] += sign * change
    return out


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
    h_after = np.cumsum(stats.h[::-1], axis=0)[::-1]
    g_after = np.cumsum(stats.g[::-1], axis=0)[::-1]
    for w in range(windows):
        if w and (w < earliest or windows - w < earliest):
            continue
        h_kc = known.T @ h_after[w]
        x = solve(h_kk, h_kc)
        h = h_after[w] - x.T @ h_kc
        g = g_after[w] - x.T @ g_k
        for i, own in enumerate(owns):
            own_g = own.T @ g
            out[i, w] = own_g @ solve(own.T @ h @ own, own_g)
    return out
