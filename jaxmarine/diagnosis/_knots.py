"""The missing wrench: a free force on the hull, piece by piece in time, and what it depends on.

Any wrench that the model lacks is a combination of the knots' columns, so their statistics answer every
question about it by linear algebra: how large it is over time, on which signals it depends, whether it
swings with a period. No hypothesis needs a simulation of its own.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ._model import Model, Workbench
from ._result import MissingWrench
from ._score import Reduced, solve
from ._signals import Places

# Waves are looked for over this much of a log [s]: swell is hardly in step with itself for longer.
COHERENT = 1800.0


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

    def beside(self, values: Float[np.ndarray, "windows knots 6 features"], share: float) -> "Knots":
        """The statistics once wrenches with these values may act, each as often as a prior `share` allows.

        The known numbers give way to them (one step of the linearised chi-square).
        """
        n = self.width
        stats = self.wrench(values)
        h, g = stats.h.sum(0), stats.g.sum(0)
        h += np.diag(np.concatenate([self.precision, np.full(values.shape[-1], share**-2)]))
        g[:n] += self.precision * self.offset
        step = -solve(h, g)
        push = (values @ step[n:]).reshape(len(values), -1)
        moved = np.concatenate([np.broadcast_to(step[:n], (len(values), n)), push], axis=1)
        bent = (self.stats.h @ moved[..., None])[..., 0]
        chi2 = self.stats.chi2 + ((2 * self.stats.g + bent) * moved).sum(axis=1)
        after = Reduced(chi2, self.stats.g + bent, self.stats.h)
        return dataclasses.replace(self, stats=after, offset=self.offset + step[:n])


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

    A weak pull to zero (by a fiftieth of the information) keeps neighbouring knots that the window
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
    """What a swinging force of the best period would save, and its parameters to start a fit from.

    Along the longest log, as a phase means nothing in another one. Periods are as dense as the log tells them
    apart; of a very long log its beginning is enough.
    """
    longest = max(np.unique(k.places.log), key=lambda i: np.ptp(k.places.t[k.places.log == i]))
    t = k.places.t
    begin = t[k.places.log == longest].min()
    here = (k.places.log == longest) & (t[:, 0] <= begin + COHERENT)
    t, span = t[here], np.ptp(t[here])
    knot = float(np.median(np.diff(t, axis=1)))
    slowest = min(2.0 / span, 1.0 / (8 * knot))
    frequencies = np.arange(slowest, 1.0 / (4 * knot), 0.3 / span)
    stats = _horizontal(k, here)
    n, count = k.width, t.shape[1]
    h_z = stats.h[:, :n, :n].sum(0) + np.diag(k.precision)
    g_z = stats.g[:, :n].sum(0) + k.precision * k.offset
    inverse = solve(h_z, np.eye(n))
    pulled = inverse @ g_z
    # Knots times (north, east).
    g = stats.g[:, n:].reshape(-1, count, 2)
    cross = stats.h[:, :n, n:].reshape(len(t), n, count, 2)
    own = stats.h[:, n:, n:].reshape(-1, count, 2, count, 2)
    best = (-np.inf, {})
    for frequency in frequencies:
        angle = 2 * np.pi * frequency * t
        swing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        across = np.einsum("wnka,wks->nas", cross, swing, optimize=True).reshape(n, 4)
        own_h = np.einsum("wkalb,wks,wlr->asbr", own, swing, swing, optimize=True).reshape(4, 4)
        own_g = np.einsum("wka,wks->as", g, swing).ravel() - across.T @ pulled
        step = -solve(own_h - across.T @ inverse @ across, own_g)
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
                    "period": float(1.0 / frequency),
                    "phase": phase,
                },
            )
    return best


def _horizontal(k: Knots, here: np.ndarray) -> Reduced:
    """Statistics of z and of a force to the north and one to the east at each knot, of some windows."""
    count = k.places.t.shape[1]
    axes = np.swapaxes(k.places.rotation[here], 2, 3)[..., :2]
    values = np.zeros((len(axes), count, 6, count, 2))
    values[:, range(count), :3, range(count)] = np.swapaxes(axes, 0, 1)
    some = dataclasses.replace(k, stats=Reduced(k.stats.chi2[here], k.stats.g[here], k.stats.h[here]))
    return some.wrench(values.reshape(len(axes), count, 6, 2 * count))
