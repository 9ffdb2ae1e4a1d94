"""Sensors that contradict one another, whatever forces act.

Positions, attitude and velocities belong together by kinematics alone. With a free wrench on the hull in
every knot no force can explain a contradiction between them, nor be blamed for one: what a sensor's error
still saves then, it saves on the sensors' own evidence.
"""

import numpy as np

from ..effects import SensorEffect
from ._model import Member, Model, Workbench
from ._score import Reduced, solve, t_value
from ._search import SIGMAS, dispersion, needed

# Pull of a knot's wrench to zero, relative to what its window says of it: none but for rounding.
FREE = 1e-6


def without_forces(bench: Workbench, model: Model) -> Reduced:
    """The screening's statistics with a free wrench in every knot eliminated from each window."""
    whole = bench.screen_with_knots(model)
    n = len(bench.known(model)[0])
    h, g = whole.h[:, n:, n:], whole.g[:, n:]
    size = np.sqrt(np.maximum(np.einsum("wii->wi", h), 1e-300))
    scaled = h / (size[:, :, None] * size[:, None, :]) + FREE * np.eye(h.shape[1])
    cross = whole.h[:, n:, :n] / size[:, :, None]
    by_columns = np.linalg.solve(scaled, cross)
    by_residual = np.linalg.solve(scaled, (g / size)[..., None])[..., 0]
    return Reduced(
        whole.chi2 - (g / size * by_residual).sum(1),
        whole.g[:, :n] - np.einsum("wkn,wk->wn", cross, by_residual),
        whole.h[:, :n, :n] - np.swapaxes(cross, 1, 2) @ by_columns,
    )


def contradiction(bench: Workbench, model: Model) -> tuple[Member, np.ndarray] | None:
    """The sensor's error that the sensors prove against one another, with its parameters minus neutral."""
    stats = without_forces(bench, model)
    known, precision, z = bench.known(model)
    phi = dispersion(bench, model, stats)
    best: tuple[float, Member, np.ndarray] | None = None
    for i in bench.open(model):
        if not issubclass(bench.layout.suspects[i].effect, SensorEffect):
            continue
        columns = np.concatenate([known, bench.own(i)], axis=1)
        held = np.concatenate([precision, np.zeros(columns.shape[1] - len(z))])
        g = stats.g @ columns
        h = np.swapaxes(stats.h @ columns, 1, 2) @ columns
        pull = np.concatenate([precision * z, np.zeros(len(held) - len(z))])
        step = -solve(h.sum(0) + np.diag(held), g.sum(0) + pull)
        alone = np.zeros_like(step)
        alone[: len(z)] = -solve(
            h.sum(0)[: len(z), : len(z)] + np.diag(precision), (g.sum(0) + pull)[: len(z)]
        )
        each = [2 * g @ s + np.einsum("wab,a,b->w", h, s, s, optimize=True) for s in (alone, step)]
        lost = each[0] - each[1]
        saved, member = float(lost.sum()), Member(i)
        if (
            saved > needed(bench, member, phi)
            and t_value(lost) > SIGMAS
            and (best is None or saved > best[0])
        ):
            best = saved, member, step[len(z) :]
    return None if best is None else (best[1], best[2])
