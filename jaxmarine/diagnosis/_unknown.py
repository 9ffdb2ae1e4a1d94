"""On which signals a residual depends that no known effect explains."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from .._types import ATTITUDE, DOFS, POSITION
from ._knots import Knots, missing_wrench, on_axis
from ._score import left_out_savings, solve

# Standard errors (over windows) by which a dependence must help on left-out windows.
SIGMAS = 2.5
# Share of the saving by which one more signal must help.
SHARE = 0.05
# Harmonics of a heading (or of another angle that turns through more than 2 rad).
HARMONICS = 6


@dataclasses.dataclass(frozen=True)
class Dependence:
    """A missing wrench on one axis as a function of signals.

    - `saved`: chi-square saved on left-out windows; `tied`: signals that would do as well as one of those
      named, within two standard errors: the log cannot tell them apart.
    - `features`: the regressors' values at the knots.
    """

    axis: int
    signals: tuple[str, ...]
    tied: tuple[str, ...]
    saved: float
    features: Float[np.ndarray, "windows knots features"]

    @property
    def dof(self) -> str:
        return DOFS[self.axis]


def _single(name: str, values: np.ndarray) -> np.ndarray:
    """Shapes of one signal: harmonics of an angle that turns; else x, x², x³ and |x| x.

    x is the signal over its largest size; depth, time and small angles are centred first, the others have
    a zero of their own.
    """
    if name in ATTITUDE and np.ptp(values) > 2.0:
        turns = np.arange(1, HARMONICS + 1) * values[..., None]
        return np.concatenate([np.sin(turns), np.cos(turns)], axis=-1)
    if name in (*POSITION, "t", *ATTITUDE):
        low, high = np.quantile(values, [0.005, 0.995])
        values = values - 0.5 * (low + high)
    x = np.clip(values / max(float(np.quantile(np.abs(values), 0.99)), 1e-12), -1.5, 1.5)
    return np.stack([x, x**2, x**3, np.abs(x) * x], axis=-1)


def features(names: tuple[str, ...], signals: dict[str, np.ndarray]) -> np.ndarray:
    """Shapes of each signal, and for every pair the products of harmonics, or of their first two shapes."""
    singles = [_single(name, signals[name]) for name in names]
    heads = [shapes if shapes.shape[-1] > 4 else shapes[..., :2] for shapes in singles]
    products = [
        (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:2], -1)
        for a, b in itertools.combinations(heads, 2)
    ]
    return np.concatenate([*singles, *products], axis=-1)


class _Ledger:
    """Savings on left-out windows beside what is known already (z, constants, dependences found)."""

    def __init__(self, k: Knots):
        self.k = k
        self.known = np.zeros((*k.t.shape, 6, 0))
        self.ridge = np.zeros(0)
        # The missing wrench's own size, generously, is the prior width of every regressor.
        self.size = 3.0 * np.nanstd(missing_wrench(k).wrench, axis=0)
        for axis in np.flatnonzero(k.free):
            self.add(int(axis), np.ones((*k.t.shape, 1)))

    def add(self, axis: int, values: np.ndarray) -> None:
        self.known = np.concatenate([self.known, on_axis(axis, values)], axis=-1)
        self.ridge = np.concatenate([self.ridge, np.full(values.shape[2], self.size[axis] ** -2.0)])

    def saved(self, axis: int, values: np.ndarray) -> Float[np.ndarray, " windows"]:
        """Chi-square saved on each window by regressors fitted on the others."""
        stats = self.k.wrench(np.concatenate([self.known, on_axis(axis, values)], axis=-1))
        precision = np.concatenate([self.k.precision, self.ridge])
        offset = np.concatenate([self.k.offset, np.zeros(len(self.ridge))])
        own = np.full(values.shape[2], self.size[axis] ** -2.0)
        return left_out_savings(stats, precision, offset, own)


def _t(per_window: np.ndarray) -> float:
    return float(per_window.sum() / max(np.sqrt(len(per_window)) * per_window.std(ddof=1), 1e-12))


def _best_signals(ledger: _Ledger, axis: int) -> tuple[tuple[str, ...], np.ndarray, tuple[str, ...]]:
    signals = ledger.k.signals

    def saved(names: tuple[str, ...]) -> np.ndarray:
        return ledger.saved(axis, features(names, signals))

    singles = {name: saved((name,)) for name in signals}
    order = sorted(singles, key=lambda name: -singles[name].sum())
    chosen: tuple[str, ...] = (order[0],)
    gain = singles[order[0]]
    best_pair, best = chosen, gain
    for pair in itertools.combinations(order, 2):
        now = saved(pair)
        if now.sum() > best.sum():
            best_pair, best = pair, now
    if _better(best, gain):
        chosen, gain = best_pair, best
        results = {(*chosen, name): saved((*chosen, name)) for name in order if name not in chosen}
        names = max(results, key=lambda n: results[n].sum(), default=chosen)
        if names != chosen and _better(results[names], gain):
            chosen, gain = names, results[names]
    tied = []
    for name in order:
        if name in chosen:
            continue
        for i in range(len(chosen)):
            other = tuple(name if j == i else kept for j, kept in enumerate(chosen))
            now = singles[name] if len(chosen) == 1 else saved(other)
            if _t(gain - now) < 2.0 and now.sum() > 0.8 * gain.sum():
                tied.append(name)
                break
    return chosen, gain, tuple(tied)


def _better(new: np.ndarray, old: np.ndarray) -> bool:
    return bool(new.sum() > (1 + SHARE) * max(old.sum(), 0.0) and _t(new - old) > 2.0)


def dependences(k: Knots, phi: float, smallest: float = 0.02) -> tuple[Dependence, ...]:
    """Axes with a missing wrench that depends on signals, the strongest first.

    - `phi`: dispersion of the scores (`_search.dispersion`); `smallest`: share of the strongest saving
      that another axis must have, since a strong missing force reaches others through the coupled mass.
    """
    ledger = _Ledger(k)
    left = [int(axis) for axis in np.flatnonzero(k.free)]
    found: list[Dependence] = []
    while left:
        trials = {axis: _best_signals(ledger, axis) for axis in left}
        axis = max(trials, key=lambda a: trials[a][1].sum())
        names, gain, tied = trials[axis]
        enough = 2 * phi * np.log(len(k.signals) ** 2 * len(left)) + 10.0
        if gain.sum() < enough or _t(gain) < SIGMAS:
            break
        if found and gain.sum() < smallest * found[0].saved:
            break
        values = features(names, k.signals)
        found.append(Dependence(axis, names, tied, float(gain.sum()), values))
        ledger.add(axis, values)
        left.remove(axis)
    return tuple(found)


def cost_of_removal(
    k: Knots, members: list[slice], found: tuple[Dependence, ...]
) -> list[tuple[float, float]]:
    """Chi-square lost by putting each member back to neutral: as things are, and beside the dependences.

    A true cause costs the same in both; one that only stood in for an unknown dependence costs little
    once that dependence may act for itself.
    """
    whole = np.zeros((*k.t.shape, 6, 0))
    for one in found:
        whole = np.concatenate([whole, on_axis(one.axis, one.features)], axis=-1)
    out = []
    for where in members:
        pair = []
        for extra in (whole[..., :0], whole):
            stats = k.wrench(extra)
            h, g = stats.h.sum(0), stats.g.sum(0)
            n = k.width
            h[:n, :n] += np.diag(k.precision)
            g[:n] += k.precision * k.offset
            h[range(n, len(h)), range(n, len(h))] *= 1 + 1e-6
            free = -solve(h, g)
            best = float(g @ free)
            held = np.arange(where.start, where.stop)
            rest = np.setdiff1d(np.arange(len(h)), held)
            step = np.zeros(len(h))
            step[held] = -k.offset[held]
            g_rest = g[rest] + h[np.ix_(rest, held)] @ step[held]
            step[rest] = -solve(h[np.ix_(rest, rest)], g_rest)
            pair.append(float(2 * g @ step + step @ h @ step) - best)
        out.append((pair[0], pair[1]))
    return out
