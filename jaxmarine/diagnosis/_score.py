"""Linear algebra on the windows' statistics: what would be saved, and whether it is real."""

import dataclasses

import numpy as np
import scipy.stats
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Reduced:
    """Per window: gradient and information of all columns, initial states eliminated."""

    chi2: Float[np.ndarray, " windows"]
    g: Float[np.ndarray, "windows columns"]
    h: Float[np.ndarray, "windows columns columns"]

    def map(self, columns: Float[np.ndarray, "columns own"]) -> "Reduced":
        """The statistics of linear combinations of the columns."""
        return Reduced(
            self.chi2, self.g @ columns, np.einsum("wij,ia,jb->wab", self.h, columns, columns, optimize=True)
        )


@dataclasses.dataclass(frozen=True)
class Score:
    """What a suspect would save, to second order, everything that is in refitted beside it.

    - `saved`: chi-square over all windows; `value`: the step of its parameters.
    - `p_value`: of the windows' own scatter (Hotelling's T², so disturbances and coloured noise count).
    - `left_out`: chi-square saved on left-out blocks of windows, and `t` that in standard errors.
    """

    saved: float
    value: np.ndarray
    p_value: float
    left_out: float
    t: float


def solve(h: np.ndarray, g: np.ndarray) -> np.ndarray:
    """h^-1 g for a positive semidefinite h whose columns may be in very different units."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    scaled = h / np.outer(scale, scale)
    ridge = 1e-10 * np.eye(len(h))
    return (np.linalg.solve(scaled + ridge, (g.T / scale).T).T / scale).T


def blocks(windows: int, count: int = 6) -> np.ndarray:
    """The block of contiguous windows that each window belongs to."""
    return np.minimum(np.arange(windows) * count // max(windows, 1), count - 1)


def left_out_savings(
    stats: Reduced, known: np.ndarray, precision: np.ndarray, offset: np.ndarray, own: np.ndarray, gate: np.ndarray
) -> Float[np.ndarray, " windows"]:
    """Chi-square that the suspect saves on each window when fitted on the others.

    - `known`, `own`: columns (matrices into `stats`) that are in, and the suspect's; `precision`, `offset`:
      prior of the known ones (inverse variance, and value minus mean); `gate` [windows]: where the suspect acts.

    Blocks are contiguous and their neighbours on both sides are left out of the fit, because windows
    that touch share disturbances.
    """
    both = np.concatenate([known, own], axis=1)
    n = known.shape[1]
    mapped = stats.map(both)
    g, h = mapped.g.copy(), mapped.h.copy()
    g[:, n:] *= gate[:, None]
    h[:, n:, :] *= gate[:, None, None]
    h[:, :, n:] *= gate[:, None, None]
    prior = np.diag(np.concatenate([precision, np.zeros(own.shape[1])]))
    pull = np.concatenate([precision * offset, np.zeros(own.shape[1])])
    block = blocks(len(g))
    out = np.zeros(len(g))
    for b in np.unique(block):
        left = block == b
        near = np.convolve(left, [1, 1, 1], "same") > 0
        keep = ~near
        h_fit = h[keep].sum(0) + prior
        g_fit = g[keep].sum(0) + pull
        full = -solve(h_fit, g_fit)
        without = np.zeros(len(full))
        without[:n] = -solve(h_fit[:n, :n], g_fit[:n])
        for step, sign in ((full, -1.0), (without, 1.0)):
            out[left] += sign * (2 * g[left] @ step + np.einsum("wab,a,b->w", h[left], step, step))
    return out


def score(
    stats: Reduced,
    known: np.ndarray,
    precision: np.ndarray,
    offset: np.ndarray,
    own: np.ndarray,
    gate: np.ndarray | None = None,
) -> Score:
    """Scores one suspect; arguments as in `left_out_savings`."""
    gate = np.ones(len(stats.g)) if gate is None else gate
    h_kk = known.T @ stats.h.sum(0) @ known + np.diag(precision)
    g_k = known.T @ stats.g.sum(0) + precision * offset
    gated_h = np.einsum("w,wij->ij", gate, stats.h)
    h_ko = known.T @ gated_h @ own
    x = solve(h_kk, h_ko)
    h = own.T @ gated_h @ own - x.T @ h_ko
    per_window = gate[:, None] * (stats.g @ own) - (stats.g @ known) @ x
    g = own.T @ (gate @ stats.g) - x.T @ g_k
    value = -solve(h, g)
    saved = float(-g @ value)

    windows, k = per_window.shape
    spread = per_window - per_window.mean(0)
    scatter = spread.T @ spread
    t2 = float(g @ solve(scatter, g)) * (windows - 1) / windows
    dof = max(int(gate.sum()) - k, 1)
    p_value = float(scipy.stats.f.sf(t2 * dof / (k * max(windows - 1, 1)), k, dof))
    out = left_out_savings(stats, known, precision, offset, own, gate)
    t = float(out.sum() / max(np.sqrt(len(out)) * out.std(ddof=1), 1e-12))
    return Score(saved, value, p_value, float(out.sum()), t)


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
