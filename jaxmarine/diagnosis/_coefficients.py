"""Which of the file's own coefficients have moved: one or two that are wrong, or the whole file a little."""

import dataclasses

import numpy as np

from ._model import Member, Model, Workbench
from ._score import solve, t_value
from ._search import SIGMAS, needed, putting_back

# More coefficients than this being off means a file that is a little wrong everywhere.
FEW = 2


def _needed_changes(bench: Workbench, model: Model, phi: float) -> list[int]:
    """Coefficients that must leave their file value, one after another, the most urgent first.

    Forward selection on the linearised chi-square without any prior; the members stay free throughout.
    """
    stats = bench.screen(model)
    known, _, z = bench.known(model)
    n = len(bench.base)
    h = known.T @ stats.h.sum(0) @ known
    g = known.T @ stats.g.sum(0)
    # As functions of z itself: gradient where the coefficients are at their file values.
    g = g - h @ z
    members = list(range(n, len(z)))
    chosen: list[int] = []

    def least(free: list[int]) -> float:
        if not free:
            return 0.0
        return float(-g[free] @ solve(h[np.ix_(free, free)], g[free]))

    suspects = {s.label: i for i, s in enumerate(bench.layout.suspects)}
    active = {bench.layout.suspects[m.suspect].label for m in model.members if m.since is None}
    open_ = [j for j in range(n) if bench.base[j].label not in active]
    while open_:
        now = least([*members, *chosen])
        gains = {j: now - least([*members, *chosen, j]) for j in open_}
        best = max(gains, key=lambda j: gains[j])
        if gains[best] < needed(bench, Member(suspects[bench.base[best].label]), phi):
            break
        chosen.append(best)
        open_.remove(best)
    return chosen


def settle(bench: Workbench, model: Model, phi: float) -> tuple[Model, bool]:
    """The model with its few wrong coefficients as members and all others at the file's value.

    Or, where many have moved together, the model as it is: a recalibrated file. Returns which.
    """
    chosen = _needed_changes(bench, model, phi)
    suspects = {s.label: i for i, s in enumerate(bench.layout.suspects)}
    if len(chosen) > FEW:
        return model, True
    z = model.z.copy()
    frozen = bench.frozen(dataclasses.replace(model, z=z))
    for j in chosen:
        frozen = bench.with_member(frozen, Member(suspects[bench.base[j].label]), z[j : j + 1])
    frozen.z[: len(bench.base)] = 0.0
    frozen = bench.refine(frozen)
    for i in reversed(range(len(model.members), len(frozen.members))):
        lost = putting_back(bench, frozen, bench.screen(frozen), bench.slices(frozen.members)[i])
        if t_value(lost) < SIGMAS:
            # A few windows pulled it there.
            frozen = bench.refine(bench.without_member(frozen, i))
    return frozen, False
