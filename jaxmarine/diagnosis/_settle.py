"""After the search: what it found is pruned, weighed once more, and beginnings are moved to their time."""

from collections.abc import Sequence

import numpy as np

from ._climb import climbed
from ._coefficients import settle
from ._dropped import HARMFUL, REPLACED, gone, needless
from ._explanation import Model
from ._result import Dropped
from ._search import (
    STEPS,
    Found,
    Round,
    begun_at_best,
    beside_file,
    dispersion,
    needed,
    own_dispersion,
    replaces,
)
from ._workbench import FEW_STEPS, ROUGH, Workbench
from ._worth import gain_at_home

# A member is kept without more than a few steps of a refit where those promise that its removal costs this
# many times what it must save.
OBVIOUS = 10.0
# Steps of a refit that moves a beginning.
BEGIN_STEPS = 6
# Suspects beaten in a round that are weighed once more in the end.
RIVALS = 3


def pruned(bench: Workbench, model: Model) -> Model:
    """The model without members that are not needed beside the others, or mean nothing beside them."""
    if not model.members:
        return model
    stats = bench.screen(model)
    phi, sound = dispersion(bench, model, stats), bench.sound(model)
    for i, where in enumerate(bench.slices(model.members)):
        least = needed(bench, model.members[i], own_dispersion(bench, model, stats, where, phi))
        less = bench.likeliest(bench.without_member(model, i), FEW_STEPS, ROUGH, 1)
        higher = climbed(bench, less)
        if higher is less and sound and 2 * (less.promised - model.cost) > OBVIOUS * least:
            continue
        less = bench.likeliest(higher)
        idle = 2 * (less.cost - model.cost) < least
        if idle or (not sound and np.isfinite(less.cost) and bench.sound(less)):
            return pruned(bench, less)
    return model


def _reweighed(bench: Workbench, model: Model, rounds: Sequence[Round], phi: float) -> Model:
    """Each member against those that it beat in its round, now that the other members are known.

    But for coefficients of the file: what could stand in their place was weighed while the others may bend.
    """
    if len(model.members) == 1:
        return model
    for i, member in enumerate(model.members):
        if bench.coefficient_of(member.suspect) is not None:
            continue
        trials = [r.trials for r in rounds if r.accepted and r.trials[0].member.suspect == member.suspect]
        for trial in trials[0][1 : 1 + RIVALS] if trials else ():
            suspect, less = trial.member.suspect, bench.without_member(model, i)
            if suspect in {m.suspect for m in model.members} or suspect not in bench.open(less):
                continue
            if trial.member.since is not None and not bench.may_begin(less, suspect):
                continue
            value = trial.model.z[bench.slices(trial.model.members)[-1]]
            other = bench.refine(bench.with_other(model, i, trial.member, value), STEPS)
            if replaces(bench, other, trial.member, model, model.members[i], phi):
                model = other
    return model


def _beginnings_refined(bench: Workbench, model: Model) -> Model:
    """Moves each beginning to the time that costs least, from coarse to fine."""
    for i, member in enumerate(model.members):
        if member.since is not None:
            model = begun_at_best(bench, model, i, bench.data.logs[member.since.log].dt, BEGIN_STEPS)
    return model


def settled(bench: Workbench, found: Found) -> tuple[Model, bool, tuple[Round, ...], tuple[Dropped, ...]]:
    """What the search found, without what is not needed, and whether the whole file was recalibrated.

    And all that was weighed, in the search and in the place of single coefficients, and what was dropped.
    """
    phi, model = dispersion(bench, found.model, found.stats), pruned(bench, found.model)
    dropped = needless(bench, found.model, model)
    held = found.held if model is found.model else beside_file(bench, model, phi)
    model, dense, more = settle(bench, model, held, phi)
    model = _beginnings_refined(bench, model)
    phi = dispersion(bench, model, bench.screen(model))
    rounds = found.rounds + more
    weighed = _reweighed(bench, model, rounds, phi)
    left = pruned(bench, weighed)
    harmless = _without_harm(bench, left, dense)
    dropped += gone(bench, model, weighed, REPLACED) + needless(bench, weighed, left)
    return harmless, dense, rounds, dropped + gone(bench, left, harmless, HARMFUL)


def _without_harm(bench: Workbench, model: Model, dense: bool) -> Model:
    """The model without members beside which it predicts the training log worse over 5 s than without them.

    Windows are shorter, and a member that takes up what is left in them may run away over more.
    """
    if len(model.members) < 2:
        return model
    own = gain_at_home(bench, model, dense)
    for i in reversed(range(len(model.members))):
        less = bench.refine(bench.without_member(model, i))
        if gain_at_home(bench, less, dense) < (1 - bench.criteria.worth) * own:
            return _without_harm(bench, pruned(bench, less), dense)
    return model
