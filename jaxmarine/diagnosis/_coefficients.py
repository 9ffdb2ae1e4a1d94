"""Which of the file's own coefficients have moved: one or two that are wrong, or the whole file a little."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ._explanation import Member, Model
from ._score import solve
from ._search import (
    CHANCES,
    Round,
    Trial,
    by_evidence,
    needed,
    own_dispersion,
    penalty,
    putting_back,
    replaces,
    trial_of,
    weigh,
)
from ._workbench import Workbench

# A refit with coefficients put back that ends above this many times the cost before may have gone astray.
ASTRAY = 2.0


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

    open_ = np.flatnonzero(~bench.stood_for(model)).tolist()
    while open_:
        now = least([*members, *chosen])
        gains = {j: now - least([*members, *chosen, j]) for j in open_}
        best = max(gains, key=lambda j: gains[j])
        if gains[best] < needed(bench, Member(bench.base[best].suspect), phi):
            break
        chosen.append(best)
        open_.remove(best)
    return chosen


def settle(
    bench: Workbench, model: Model, held: Sequence[Trial], phi: float
) -> tuple[Model, bool, tuple[Round, ...]]:
    """The model with its few wrong coefficients as members and all others at the file's value.

    Or, where many have moved together and no one cause does the same, the model as it is: a recalibrated
    file. Returns which, and what was weighed in the place of wrong coefficients.

    - `held`: what is worth most beside the model with the file held as it is.
    """
    chosen = _needed_changes(bench, model, phi)
    rounds: list[Round] = []
    if len(chosen) <= bench.criteria.few:
        frozen = _with_changes(bench, model, chosen)
    else:
        cause = _one_for_many(bench, model, held, len(chosen), phi)
        if cause is None:
            return model, True, ()
        model, frozen, trials = cause
        rounds.append(Round(trials, True, phi))
    for i in reversed(range(len(model.members), len(frozen.members))):
        stats, where = bench.screen(frozen), bench.slices(frozen.members)[i]
        own = own_dispersion(bench, frozen, stats, where, phi)
        if putting_back(bench, frozen, stats, where).sum() < needed(bench, frozen.members[i], own):
            # A few windows pulled it there.
            frozen = _refitted(bench, bench.without_member(frozen, i), frozen.cost)
    for member in frozen.members[len(model.members) :]:
        frozen, trials = _instead(bench, frozen, member, phi)
        rounds.append(Round(trials, True, phi))
    return frozen, False, tuple(rounds)


def _with_changes(bench: Workbench, model: Model, chosen: Sequence[int]) -> Model:
    """The model with some coefficients of the file as members, after its own, and all others held."""
    frozen = bench.frozen(dataclasses.replace(model, z=model.z.copy()))
    for j in chosen:
        frozen = bench.with_member(frozen, Member(bench.base[j].suspect), model.z[j : j + 1])
    frozen.z[: len(bench.base)] = 0.0
    return _refitted(bench, frozen, model.cost)


def _one_for_many(
    bench: Workbench, model: Model, held: Sequence[Trial], many: int, phi: float
) -> tuple[Model, Model, tuple[Trial, ...]] | None:
    """A cause that makes more coefficients superfluous than it has numbers, few being left, if there is one.

    All coefficients too high alike are a thrust that is too weak: free, they bent to what it does, and left
    it nothing to explain. It is looked for beside the file held as it is. Returns the model with it, the same
    with what must change nevertheless and all else held, and all that was weighed.
    """
    trials = [t for t in held if bench.coefficient_of(t.member.suspect) is None]
    for trial in trials[:CHANCES]:
        free = bench.refine(dataclasses.replace(trial.model, frozen=False))
        if not bench.stands(free, trial.model):
            continue
        chosen = _needed_changes(bench, free, phi)
        simpler = (many - len(chosen)) * np.log(bench.samples) - penalty(bench, trial.member)
        if len(chosen) > bench.criteria.few or simpler < 0:
            continue
        frozen = _with_changes(bench, free, chosen)
        if bench.stands(frozen, trial.model) and 2 * (frozen.cost - model.cost) / phi < simpler:
            return free, frozen, (trial, *(t for t in trials if t is not trial))
    return None


def _refitted(bench: Workbench, model: Model, before: float) -> Model:
    """The model refined; from neutral members too where what they had bent to is far from any use."""
    fitted = bench.likeliest(model)
    if fitted.cost > ASTRAY * before:
        anew = dataclasses.replace(bench.as_filed(model), z=np.zeros_like(model.z))
        fitted = min(fitted, bench.refine(anew), key=lambda m: m.cost)
    return fitted


def _instead(bench: Workbench, model: Model, member: Member, phi: float) -> tuple[Model, tuple[Trial, ...]]:
    """The model with what explains more in the place of a wrong coefficient, and all that was weighed there.

    During the search the coefficient could bend to what another cause does, so that none was needed. All
    others may bend here, or what they are off by would speak for a cause that has more numbers.
    """
    which = model.members.index(member)
    value = model.z[bench.slices(model.members)[which]]
    wrong = bench.coefficient_of(member.suspect)
    held = model.held if wrong is None else (*model.held, wrong)
    bent = dataclasses.replace(bench.without_member(model, which), frozen=False, held=held)
    less = bench.refine(bent)
    same = bench.refine(bench.with_member(dataclasses.replace(less, delta=model.delta), member, value))
    own = trial_of(less, same)
    others = [t for t in weigh(bench, less, bench.screen(less)) if t.member.suspect != member.suspect]
    trials = by_evidence(bench, less, own, others, phi)
    best = next(t for t in trials if t is own or bench.stands(t.model, less))
    if best is not own:
        instead = dataclasses.replace(best.model, frozen=True, held=model.held, z=best.model.z.copy())
        instead.z[: len(bench.base)] = 0.0
        instead = bench.likeliest(instead)
        if replaces(bench, instead, best.member, model, member, phi):
            return instead, (best, *(t for t in trials if t is not best))
    return model, (own, *(t for t in trials if t is not own))
