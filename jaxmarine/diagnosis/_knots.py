"""The missing wrench: a free force on the hull, piece by piece in time, and what it depends on.

Any wrench that the model lacks is a combination of the knots' columns, so their statistics answer every
question about it by linear algebra: how large it is over time, on which signals it depends, whether it
swings with a period. No hypothesis needs a simulation of its own.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ._model import KNOT, Model, Workbench
from ._result import MissingWrench
from ._score import Reduced, solve
from ._signals import Places


def on_axis(
    axis: int, values: Float[np.ndarray, "windows knots features"]
) -> Float[np.ndarray, "windows knots 6 features"]:
    """Wrenches that take the given values on one axis and are zero on all others."""
    out = np.zeros((*values.shape[:2], 6, values.shape[2]))
    out[:, :, axis] = values
    return out


@dataclasses.dataclass(frozen=True)
class Knots:
    """Statistics of the known parameters and the knots, and where the knots lie.

    - `stats`: columns are the model's z, then knots times six axes.
    - `precision`, `offset`: prior of z; `free` [6].
    """

    stats: Reduced
    width: int
    precision: np.ndarray
    offset: np.ndarray
    free: np.ndarray
    places: Places

    def wrench(self, values: Float[np.ndarray, "windows knots 6 features"]) -> Reduced:
        """Statistics of z and of wrenches with the given values at the knots."""
        n = self.width
        flat = values.reshape(len(values), values.shape[1] * 6, values.shape[-1])
        g, h = self.stats.g, self.stats.h
        h_zk = np.einsum("wzk,wkf->wzf", h[:, :n, n:], flat, optimize=True)
        h_kk = np.einsum("wkf,wkl,wlm->wfm", flat, h[:, n:, n:], flat, optimize=True)
        g_k = np.einsum("wk,wkf->wf", g[:, n:], flat)
        top = np.concatenate([h[:, :n, :n], h_zk], axis=2)
        bottom = np.concatenate([np.swapaxes(h_zk, 1, 2), h_kk], axis=2)
        return Reduced(
            self.stats.chi2,
            np.concatenate([g[:, :n], g_k], axis=1),
            np.concatenate([top, bottom], axis=1),
        )


def knots(bench: Workbench, model: Model) -> Knots:
    """The knots' statistics at a model."""
    count = bench.knots
    whole = bench.screen_with_knots(model)
    known, precision, offset = bench.known(model)
    size, width = known.shape
    # From the catalogue's parameters to the model's own.
    into = np.zeros((whole.g.shape[1], width + 6 * count))
    into[:size, :width] = known
    into[size:, width:] = np.eye(6 * count)
    stats = Reduced(whole.chi2, whole.g @ into, np.swapaxes(whole.h @ into, 1, 2) @ into)

    # Forces on the hull depend on the velocity through the water, where that is known to move.
    places = bench.places
    signals = places.through_water(bench.water(model), places.signals)
    places = dataclasses.replace(places, signals=signals)
    return Knots(stats, width, precision, offset, bench.vehicle.free, places)


def missing_wrench(k: Knots) -> MissingWrench:
    """The missing wrench over time with its standard deviation, each window by itself.

    A weak pull to zero (a tenth of the information, at least) keeps neighbouring knots that the window
    cannot tell apart from running against each other.
    """
    n = k.width
    windows, count = k.places.t.shape
    wrench = np.full((windows, count, 6), np.nan)
    std = np.full((windows, count, 6), np.nan)
    free = np.flatnonzero(k.free)
    index = (np.arange(count)[:, None] * 6 + free).ravel()
    for w in range(windows):
        h = k.stats.h[w][n:, n:][np.ix_(index, index)]
        g = k.stats.g[w][n:][index]
        scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
        cov = np.linalg.inv(h / np.outer(scale, scale) + 0.02 * np.eye(len(h))) / np.outer(scale, scale)
        wrench[w][:, free] = (-cov @ g).reshape(count, -1)
        std[w][:, free] = np.sqrt(np.diag(cov)).reshape(count, -1)
    return MissingWrench(
        log=np.repeat(k.places.log, count),
        t=k.places.t.ravel(),
        wrench=wrench.reshape(-1, 6),
        std=std.reshape(-1, 6),
        velocity=k.places.velocity.reshape(-1, 6),
    )


def wave_start(k: Knots) -> tuple[float, dict[str, float]]:
    """What a swinging force of the best period would save, and its parameters to start a fit from."""
    windows, count = k.places.t.shape
    longest = 0.5 * (k.places.t.max() - k.places.t.min())
    periods = np.geomspace(4 * KNOT, max(longest, 8 * KNOT), 160)
    north = np.swapaxes(k.places.rotation, 2, 3)[:, :, :, 0]
    east = np.swapaxes(k.places.rotation, 2, 3)[:, :, :, 1]
    best = (-np.inf, {})
    n = k.width
    for period in periods:
        angle = 2 * np.pi * k.places.t / period
        values = np.zeros((windows, count, 6, 4))
        for j, (axis, swing) in enumerate(
            (a, s) for a in (north, east) for s in (np.sin(angle), np.cos(angle))
        ):
            values[:, :, :3, j] = axis * swing[:, :, None]
        stats = k.wrench(values)
        h, g = stats.h.sum(0), stats.g.sum(0)
        h[:n, :n] += np.diag(k.precision)
        g[:n] += k.precision * k.offset
        x = solve(h[:n, :n], h[:n, n:])
        own_h, own_g = h[n:, n:] - x.T @ h[:n, n:], g[n:] - x.T @ g[:n]
        step = -solve(own_h, own_g)
        saved = float(-own_g @ step)
        if saved > best[0]:
            # One phase for both axes: the direction in which (sin, cos) parts are largest.
            parts = step.reshape(2, 2)
            _, _, direction = np.linalg.svd(parts)
            phase = float(np.arctan2(direction[0, 1], direction[0, 0]))
            size = parts @ direction[0]
            if not -np.pi / 2 < phase <= np.pi / 2:
                phase, size = phase - np.copysign(np.pi, phase), -size
            best = (
                saved,
                {
                    "north": float(size[0]),
                    "east": float(size[1]),
                    "period": float(period),
                    "phase": phase,
                },
            )
    return best
