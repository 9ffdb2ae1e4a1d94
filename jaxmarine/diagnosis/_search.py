"""The search: score every suspect, refit the best, keep the winner if it is real, go on."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Float

from .._progress import FOUND, MOST_ROUNDS, Progress, in_round, silent
from ._amid import amid_more, calmed, disturbed, hurried, price, suited
from ._climb import climbed
from ._explanation import Beginning, Member, Model
from ._fine import STRAIGHT
from ._knots import knots, wave_start
from ._score import Reduced, savings, scatter, step_with
from ._workbench import FEW_STEPS, ROUGH, Workbench

# Suspects refitted in a round, by what the linearisation says they would save: acting always, and from a
# beginning on, of which there are so many to choose from that they would crowd the others out.
SHORTLIST, SHORTLIST_BEGUN = 8, 4
# Leading suspects that are refitted with a beginning too, and suspects that may win a round where the best
# does not.
WITH_BEGINNING = 3
CHANCES = 3
# Gauss-Newton steps of the refit of a suspect that is hopeful: that saves or promises this share of what the
# best saves.
STEPS, HOPEFUL = 12, 0.5
# Linearisations that tell who is hopeful beside white noise: where it began, and where the first step led.
TELLING = 2
# Hopeful suspects that get more steps, and stuck ones that are begun afresh, of those refitted together.
MORE, AFRESH = 5, 2
# Suspects refitted for what they would save beside a disturbance that is no slower than usual.
HIDDEN = 3
# Share of what the best of some suspects saves that decides nothing between them.
SLIGHT = 1e-3
# Windows that must lie on either side of a beginning.
EARLIEST = 3
# Findings in one diagnosis at most; a model that needs more is wrong in another way.
MOST = MOST_ROUNDS
# A prior's weight is left as it is where it should be up to this many times as much, or as little.
SAME = 1.25
# Share of the best saving that a costly start must promise, what acts always must save to be tried with a
# beginning too, and by which a beginning must beat acting always; and the chi-square that it must beat it by
# at least.
WORTHWHILE, BEGINS = 0.2, 40.0


@dataclasses.dataclass(frozen=True)
class Trial:
    """A refitted suspect, the last of its model's members."""

    member: Member
    model: Model
    saved: float

    def parameters(self, bench: Workbench) -> dict[str, float]:
        where = bench.slices(self.model.members)[-1]
        return bench.layout.values(self.member.suspect, self.model.z[where])


@dataclasses.dataclass(frozen=True)
class Round:
    """One round: the refitted suspects, the best first, and whether the best was accepted."""

    trials: tuple[Trial, ...]
    accepted: bool
    phi: float


@dataclasses.dataclass(frozen=True)
class Found:
    """Where the search ended.

    - `held`: what was worth most in the end beside the model with the file held as it is.
    """

    model: Model
    stats: Reduced
    rounds: tuple[Round, ...]
    held: tuple[Trial, ...]


def dispersion(bench: Workbench, model: Model, stats: Reduced) -> float:
    """How much more the windows' scores scatter than white noise of the stated size would make them.

    The median over suspects of (variance of the summed scores) / (information), after what is known has been
    projected out; 1 for white noise, more under disturbances and coloured noise.
    """
    known, precision, _ = bench.known(model)
    owns = np.concatenate([bench.own(i) for i in range(len(bench.layout.suspects))], axis=1)
    return max(1.0, float(np.median(dispersions(stats.g, stats.h.sum(0), owns, known, precision))))


def _projected(h: np.ndarray, own: np.ndarray, known: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Each own column that says more than the known ones, less what they say of it; `h`: of all windows."""
    x = np.linalg.lstsq(known.T @ h @ known + np.diag(precision), known.T @ h @ own, rcond=1e-12)[0]
    combined = own - known @ x
    return combined[:, _information(h, combined) > 1e-6 * _information(h, own) + 1e-12]


def _information(h: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Of each column, by the information of all parameters, of one window or of several."""
    return ((h @ columns) * columns).sum(-2)


def dispersions(
    g: Float[np.ndarray, "windows columns"],
    h: Float[np.ndarray, "columns columns"],
    own: np.ndarray,
    known: np.ndarray,
    precision: np.ndarray,
) -> np.ndarray:
    """Variance of summed scores over information, of each own column that says more than the known ones.

    - `g`: of each window; `h`: of all of them.
    """
    combined = _projected(h, own, known, precision)
    scores = g @ combined
    return len(scores) * scatter(scores) / _information(h, combined)


def _split(bench: Workbench, model: Model, where: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns of one member, `where` its parameters lie in z, those of all else, and the latter's prior."""
    known, precision, _ = bench.known(model)
    mine = np.zeros(known.shape[1], bool)
    mine[where] = True
    return known[:, mine], known[:, ~mine], precision[~mine]


def own_dispersion(bench: Workbench, model: Model, stats: Reduced, where: slice, phi: float) -> float:
    """Dispersion of the scores of one member, `where` its parameters lie in z; at least that of all, `phi`.

    A disturbance that pushes one axis more than the others scatters the scores of what acts there, and so
    does what a few windows pull one way and the rest another.
    """
    return mean_dispersion(stats.g, stats.h.sum(0), *_split(bench, model, where), phi)


def mean_dispersion(
    g: Float[np.ndarray, "windows columns"],
    h: Float[np.ndarray, "columns columns"],
    own: np.ndarray,
    known: np.ndarray,
    precision: np.ndarray,
    least: float,
) -> float:
    """Of the scores of all own columns that say more than the known ones; `least` at least."""
    ratios = dispersions(g, h, own, known, precision)
    return max(least, float(ratios.mean())) if len(ratios) else least


def shortlist(
    bench: Workbench, model: Model, stats: Reduced
) -> tuple[dict[Member, float], dict[int, Member]]:
    """The suspects with what they would save by the linearisation, the best first.

    And each suspect with the beginning that suits it best, whether that is worth a refit or not.
    """
    known, precision, offset = bench.known(model)
    order = bench.open(model)
    owns = tuple(bench.own(i) for i in order)
    table = savings(stats, known, precision, offset, owns, EARLIEST)
    out, begun = [], {}
    for i, row in zip(order, table, strict=True):
        out.append((Member(i), float(row[0])))
        w = int(np.argmax(row[1:])) + 1 if len(row) > 1 else 0
        if w and bench.may_begin(model, i) and np.isfinite(row[w]):
            begun[i] = Member(i, Beginning(int(bench.group_log[w]), float(bench.group_starts[w])))
            if row[w] > row[0] + max(BEGINS, WORTHWHILE * row[0]):
                out.append((begun[i], float(row[w])))
    return dict(sorted(out, key=lambda item: -item[1])), begun


def probes(bench: Workbench, model: Model, best: float) -> list[tuple[Member, np.ndarray]]:
    """Suspects without a useful slope at neutral, at the start from which they promise most."""
    out, sample = [], bench.sampled(model)
    for i in bench.open(model):
        suspect = bench.layout.suspects[i]
        if not (suspect.starts or suspect.effect.swings):
            continue
        neutral = bench.layout.neutral_of(i)
        names = list(suspect.slots)
        if suspect.effect.swings:
            out += _swinging(bench, model, i, WORTHWHILE * best)
            continue
        values = [np.array([start[n] for n in names]) - neutral for start in suspect.starts]
        begun = [bench.with_member(sample.model, Member(i), value) for value in values]
        promised = sample.bench.promised(begun)
        if sample.saved(min(promised)) > WORTHWHILE * best:
            out.append((Member(i), values[int(np.argmin(promised))]))
    return out


def _swinging(bench: Workbench, model: Model, suspect: int, least: float) -> list[tuple[Member, np.ndarray]]:
    """A suspect that swings at the start from which it promises most, if that is more than so much."""
    promised, start = wave_start(knots(bench, model))
    value = np.array([start[name] for name in bench.layout.suspects[suspect].slots])
    return [(Member(suspect), value - bench.layout.neutral_of(suspect))] if promised > least else []


def trial_of(model: Model, refitted: Model) -> Trial:
    """By what a refit with one member more, the last, saves."""
    return Trial(refitted.members[-1], refitted, 2 * (model.cost - refitted.cost))


def _joined(bench: Workbench, model: Model, member: Member, value: np.ndarray | None) -> Model:
    """The model with one member more, at a value or neutral.

    One that stands for a coefficient of the file takes over how far that has bent: the model stays the same.
    """
    if value is not None:
        return bench.with_member(model, member, value)
    begin = np.zeros(bench.layout.columns[member.suspect].shape[1])
    which = bench.coefficient_of(member.suspect)
    if which is not None and member.since is None:
        begin[0] = model.z[which]
        model = dataclasses.replace(model, z=np.where(np.arange(len(model.z)) == which, 0.0, model.z))
    return bench.with_member(model, member, begin)


def _refined_each(
    bench: Workbench, models: Sequence[Model], steps: int, rtol: float = ROUGH, times: int = 0
) -> list[Model]:
    """Models refined roughly, the last member of each on the best of its stairs."""
    return [climbed(bench, one, steps, rtol, True) for one in bench.refine_each(models, steps, rtol, times)]


def _roughly(
    bench: Workbench, model: Model, starts: Sequence[tuple[Member, np.ndarray | None]], steps: int
) -> list[Trial]:
    """Suspects after a few steps of a refit, those that can be refitted."""
    begun = [_joined(bench, model, member, value) for member, value in starts]
    trials = [trial_of(model, one) for one in _refined_each(bench, begun, steps)]
    return [t for t in trials if np.isfinite(t.saved)]


def _leading(ranked: Iterable[Member]) -> list[tuple[Member, np.ndarray | None]]:
    """The first of some suspects at neutral, of those that act always and of those that begin."""
    some = list(ranked)
    always = [one for one in some if one.since is None][:SHORTLIST]
    late = [one for one in some if one.since is not None][:SHORTLIST_BEGUN]
    return [(one, None) for one in (*always, *late)]


def _trials(
    bench: Workbench,
    model: Model,
    starts: Sequence[tuple[Member, np.ndarray | None]],
    before: Sequence[Trial] = (),
) -> list[Trial]:
    """Refitted suspects whose numbers mean something.

    Where there are many windows, on some of them: all of them judge the best, before it is taken.

    - `before`: those that were refitted in this round before, which they have to compare with.
    """
    sample = bench.sampled(model)
    best = max([t.saved for t in before if np.isfinite(t.saved)], default=0.0) / sample.every
    found = _refitted(sample.bench, sample.model, starts, best, sample.every)
    fitted = [sample.whole(model, climbed(sample.bench, t.model, STEPS, ROUGH, True)) for t in found]
    trials = [trial_of(model, one) for one in fitted]
    return [t for t in trials if bench.sound(t.model)]


def _refitted(
    bench: Workbench,
    model: Model,
    starts: Sequence[tuple[Member, np.ndarray | None]],
    best: float,
    every: int,
) -> list[Trial]:
    """A step for all suspects, more for those that may win: whose promise, too, is what a finding needs.

    - `best`: what the best of others saves; `every`: one of so many windows are these.
    """
    trials = _roughly(bench, model, starts, TELLING)
    hopeful = HOPEFUL * max([best, *(t.saved for t in trials)])
    leading = HOPEFUL * max([best, *(2 * (model.cost - t.model.promised) for t in trials)])
    trials.sort(key=lambda t: t.model.promised)

    def hoped(trial: Trial) -> float:
        more = trial.model.cost - trial.model.promised
        return trial.saved + 2 * more if more > ROUGH * trial.model.cost else -np.inf

    def may_win(trial: Trial) -> bool:
        return bool(hoped(trial) > max(hopeful, needed(bench, trial.member, 1.0) / every))

    going_on = [i for i, trial in enumerate(trials) if may_win(trial)][:MORE]
    fitted = dict(
        zip(going_on, bench.refine_each([trials[i].model for i in going_on], STEPS, ROUGH), strict=True)
    )

    def stuck(one: Model) -> bool:
        return 2 * (one.cost - one.promised) > hopeful or not bench.sound(one)

    # The coefficients of the file had bent to what the suspect explains, and stand in its way.
    anew = [i for i in going_on if hoped(trials[i]) > leading and stuck(fitted[i])][:AFRESH]
    afresh = bench.refine_each([bench.as_filed(fitted[i]) for i in anew], 2 * STEPS, ROUGH)
    for i, other in zip(anew, afresh, strict=True):
        fitted[i] = min(fitted[i], other, key=lambda m: (not bench.sound(m), m.cost))
    for i, one in fitted.items():
        trials[i] = trial_of(model, one)
    return trials


def penalty(bench: Workbench, member: Member) -> float:
    """Chi-square that a member's parameters, and its beginning, must pay for: log(n) each (Schwarz)."""
    own = bench.layout.columns[member.suspect].shape[1] + (member.since is not None)
    return own * np.log(bench.samples)


def tried(bench: Workbench, member: Member) -> int:
    """How many suspects there were to choose a member from, and times at which it may have begun."""
    return len(bench.layout.suspects) * (len(bench.group_windows) if member.since else 1)


def prior_nats(bench: Workbench, member: Member) -> float:
    """What a member must gain to be as likely as nothing: its parameters, and how many were tried."""
    return 0.5 * penalty(bench, member) + float(np.log(tried(bench, member)))


def evidence(bench: Workbench, member: Member, saved: float, phi: float) -> float:
    """Logarithm of the Bayes factor [nats] of a member that saves so much chi-square (Schwarz)."""
    return float(0.5 * (saved / phi - penalty(bench, member)))


def replaces(
    bench: Workbench, other: Model, member: Member, model: Model, beaten: Member, phi: float
) -> bool:
    """Whether a model with another member in the place of one may stand and has more evidence."""
    more = evidence(bench, member, 2 * (model.cost - other.cost), phi) - evidence(bench, beaten, 0.0, phi)
    return bench.stands(other, model) and more > 0


def putting_back(bench: Workbench, model: Model, stats: Reduced, where: slice) -> np.ndarray:
    """Chi-square lost on each window when some of z go back to zero and the rest is refitted (linearised)."""
    known, precision, z = bench.known(model)
    g, h = stats.g @ known, np.einsum("wij,ia,jb->wab", stats.h, known, known, optimize=True)
    total = h.sum(0) + np.diag(precision)
    held = np.arange(where.start, where.stop)
    step = step_with(g.sum(0) + precision * z, total, held, -z[held])
    return 2 * g @ step + np.einsum("wab,a,b->w", h, step, step, optimize=True)


def needed(bench: Workbench, member: Member, phi: float) -> float:
    """Chi-square that a member must save to have the odds that a finding needs.

    - `phi`: dispersion of its scores.
    """
    return 2 * phi * (prior_nats(bench, member) + bench.criteria.nats)


def least_needed(bench: Workbench) -> float:
    """Chi-square per dispersion that a member must save at least: what saves less hides no finding."""
    return min(needed(bench, Member(i), 1.0) for i in range(len(bench.layout.suspects)))


def significant(bench: Workbench, trial: Trial, after: Reduced, phi: float) -> bool:
    """Whether a trial has the odds that a finding needs, at the dispersion of its own scores.

    - `after`: statistics of its model, of dispersion `phi`.
    """
    where = bench.slices(trial.model.members)[-1]
    own = own_dispersion(bench, trial.model, after, where, phi)
    return bool(trial.saved > needed(bench, trial.member, own))


def weigh(bench: Workbench, model: Model, stats: Reduced, progress: Progress = silent) -> list[Trial]:
    """The most promising suspects, each refitted beside what the model has, the best first."""
    progress(f"scoring {len(bench.layout.suspects)} suspects")
    weighed = _weighed if model.beside is None else _likelier
    return _by_penalty(bench, weighed(bench, model, stats, progress))


def _likelier(bench: Workbench, model: Model, stats: Reduced, progress: Progress) -> list[Trial]:
    """Suspects that make the logs likelier beside a disturbance, which is estimated anew beside the best.

    A disturbance as large as all that the model misses is what a suspect has to do better than, so that the
    linearisation says the least that it saves: where it does not pay for its parameters no refit is needed.
    But one that is slow hides what acts for long: that shows beside one that is no slower than usual. And a
    swell hides what swings and keeps in step.
    """
    ranked, with_beginning = shortlist(bench, model, stats)
    starts = _leading(_paying(bench, ranked))
    starts += probes(bench, model, max(ranked.values(), default=0.0))
    quick = hurried(model)
    shown = _paying(bench, shortlist(bench, quick, bench.screen(quick))[0])[:HIDDEN]
    progress("refitting the best suspects")
    trials = _roughly(bench, model, starts, FEW_STEPS)
    best, always = max([t.saved for t in trials], default=0.0), _always(bench, trials)

    def may_win(trial: Trial) -> bool:
        return _hoped(trial) > HOPEFUL * best and _pays(bench, trial)

    hopeful, rest = [t for t in trials if may_win(t)], [t for t in trials if not may_win(t)]
    share = _decisive(bench, hopeful, best)
    refitted = _placed(bench, [t.model for t in hopeful], always, share)
    otherwise = _hidden(bench, quick, shown, hopeful, best) + _in_step(bench, model)
    refitted += _placed(bench, otherwise, {}, share)
    refitted += _afresh(bench, model, refitted)
    trials = rest + [trial_of(model, one) for one in refitted]
    tried = {member for member, _ in starts}
    late = [one for one in _late(trials, with_beginning) if one not in tried]
    begun = [t.model for t in _roughly(bench, model, _leading(late), FEW_STEPS) if _pays(bench, t)]
    trials += [trial_of(model, one) for one in _placed(bench, begun, always, share)]
    return [t for t in trials if np.isfinite(t.saved) and bench.sound(t.model)]


def _decisive(bench: Workbench, hopeful: Sequence[Trial], best: float) -> float:
    """The share of -2 log p that is worth a step while suspects are compared; `best`: what the best saves."""
    most = max([2 * t.model.cost for t in hopeful], default=0.0)
    return max(ROUGH, SLIGHT * best / max(bench.samples, most))


def _late(trials: Sequence[Trial], begun: dict[int, Member]) -> list[Member]:
    """The leading suspects once more, from the time that suits them best, of those that save most.

    What a cause does for half of a log can pass for a disturbance as long as it is thought to act always.
    """
    least = WORTHWHILE * max([t.saved for t in trials], default=0.0)
    return _begun(begun, [t for t in trials if t.saved > least])


def _hoped(trial: Trial) -> float:
    """What a rough refit saves, or promises where its few steps all went too far to be taken."""
    return trial.saved if trial.saved > 0.0 else 2 * (trial.model.cost - trial.model.promised)


def _always(bench: Workbench, trials: Sequence[Trial]) -> dict[int, float]:
    """What suspects cost that act always, and mean something, each at its best."""
    out: dict[int, float] = {}
    for trial in trials:
        suspect, cost = trial.member.suspect, trial.model.cost
        if trial.member.since is None and bench.sound(trial.model):
            out[suspect] = min(cost, out.get(suspect, np.inf))
    return out


def _pays(bench: Workbench, trial: Trial) -> bool:
    """Whether what a rough refit saves and promises pays for the suspect's parameters and its beginning."""
    promised = 2 * max(trial.model.cost - trial.model.promised, 0.0)
    return evidence(bench, trial.member, trial.saved + promised, 1.0) > 0


def _placed(bench: Workbench, models: Sequence[Model], always: dict[int, float], share: float) -> list[Model]:
    """Models refitted with their last member from where it begins best, if it has not acted always.

    What acts at once spoils more by beginning a second late than it saves. One that begins and costs no less
    than if it acted always, beside the same disturbance, is not refitted.

    - `always`: what suspects cost that act always, after a few steps and beside the same disturbance, as far
      as that is known; `share`: that is worth a step.
    """
    begun = [begun_at_best(bench, one, -1, STRAIGHT, FEW_STEPS) for one in models]

    def gains(one: Model) -> bool:
        last = one.members[-1]
        return last.since is None or not one.cost >= always.get(last.suspect, np.inf)

    return _refined_each(bench, [one for one in begun if gains(one)], STEPS, share, 1)


def _hidden(
    bench: Workbench, quick: Model, shown: Sequence[Member], hopeful: Sequence[Trial], best: float
) -> list[Model]:
    """Models with each of some suspects that a slow disturbance hides: they are hopeful beside a quick one.

    Those that cost no less there than beside the disturbance as it is look alike beside either.

    - `shown`: suspects that pay beside a quick disturbance; `hopeful`: those beside the one as it is, of
      which the best saves `best`.
    """
    if not shown:
        return []
    joined = [_joined(bench, quick, one, None) for one in shown]
    without, *refitted = _refined_each(bench, [quick, *joined], FEW_STEPS)
    slow = {t.member: t.model.cost for t in hopeful}

    def hides(one: Model) -> bool:
        alike = one.cost >= slow.get(one.members[-1], np.inf)
        return trial_of(without, one).saved > HOPEFUL * best and not alike

    return [one for one in refitted if hides(one)]


def _in_step(bench: Workbench, model: Model) -> list[Model]:
    """Models with each suspect that swings in the place of the disturbance's swell, which hides it.

    They must pay for their numbers as beside it: what the swell's numbers cost is not given back.
    """
    assert model.beside is not None
    if not model.beside.force.swells:
        return []
    calm = calmed(model)
    swing = [i for i in bench.open(model) if bench.layout.suspects[i].effect.swings]
    starts = [start for i in swing for start in _swinging(bench, calm, i, penalty(bench, Member(i)))]
    return [_joined(bench, calm, member, value) for member, value in starts]


def _afresh(bench: Workbench, model: Model, refitted: Sequence[Model]) -> list[Model]:
    """The likeliest of some models whose file has bent far, from the file as it is and what disturbs that.

    Both had bent to what the suspect explains, and stand in its way: if nothing explains most of it beside a
    file that holds.
    """
    far = [_bent_far(bench, one) for one in refitted]
    straight = [one for one, bent in zip(refitted, far, strict=True) if not bent and bench.sound(one)]
    least = HOPEFUL * max((model.cost - one.cost for one in straight), default=0.0)
    bent = [one for one, bent in zip(refitted, far, strict=True) if bent and model.cost - one.cost > least]
    begun = [disturbed(bench, bench.as_filed(one)) for one in sorted(bent, key=lambda m: m.cost)[:AFRESH]]
    return bench.refine_each(suited(bench, begun), 2 * STEPS, ROUGH, 1)


def _bent_far(bench: Workbench, model: Model) -> bool:
    """Whether the file's coefficients have bent by more than a finding must be worth."""
    base = slice(0, len(bench.base))
    _, precision, z = bench.known(model)
    return bool(0.5 * precision[base] @ z[base] ** 2 > model.weight * bench.criteria.nats)


def begun_at_best(bench: Workbench, model: Model, which: int, least: float, steps: int) -> Model:
    """The model with a member that begins at the time that costs least, from half a window to `least` [s].

    Steps double while they lead on, and halve where they do not. As it is where the member always acts.

    - `steps`: of each refit.
    """
    since = model.members[which].since
    if since is None:
        return model
    which, log = which % len(model.members), bench.data.logs[since.log]
    # Else a neighbour would be better by its steps alone.
    model = bench.refine(model, steps)
    step, ways, seen = bench.data.length / 2, (-1, 1), {since.time}
    while step >= 0.9 * least:
        moved, since = [], model.members[which].since
        assert since is not None
        for way in ways:
            time = float(np.clip(since.time + way * step, log.t[0], log.t[-1]))
            time = float(log.t[np.argmin(np.abs(log.t - time))])
            other = dataclasses.replace(model.members[which], since=Beginning(since.log, time))
            members = tuple(other if j == which else m for j, m in enumerate(model.members))
            # Of beginnings that coincide one moves only where there is room for one more.
            if time not in seen and bench.have_room(members):
                moved.append(dataclasses.replace(model, members=members))
                seen.add(time)
        best = min(bench.refine_each(moved, steps), key=lambda m: m.cost, default=model)
        if best.cost < model.cost - 1e-6:
            now = best.members[which].since
            assert now is not None
            model, ways, step = best, ((1,) if now.time > since.time else (-1,)), 2 * step
        else:
            ways, step = (-1, 1), step / 2
    return model


def _paying(bench: Workbench, ranked: dict[Member, float]) -> list[Member]:
    """Suspects that save more than their parameters and their beginning cost."""
    return [member for member, saved in ranked.items() if evidence(bench, member, saved, 1.0) > 0]


def _weighed(bench: Workbench, model: Model, stats: Reduced, progress: Progress) -> list[Trial]:
    """The most promising suspects, each refitted beside what the model has."""
    ranked, begun = shortlist(bench, model, stats)
    trials = _trials(bench, model, _leading(ranked))
    trials += _trials(bench, model, [(member, None) for member in _begun(begun, trials)], trials)
    best = max([t.saved for t in trials], default=0.0)
    # Where there is none, the file's coefficients bent until they mean nothing, perhaps to what has no slope.
    if best > least_needed(bench) or not trials:
        progress("refitting the best suspects")
        trials += _trials(bench, model, probes(bench, model, best), trials)
    return trials


def _by_penalty(bench: Workbench, trials: Sequence[Trial]) -> list[Trial]:
    return sorted(trials, key=lambda t: -evidence(bench, t.member, t.saved, 1.0))


def beside_file(bench: Workbench, model: Model, phi: float, progress: Progress = silent) -> list[Trial]:
    """What is worth most beside the model's members and the file held as it is, where that has bent far.

    Free, the file's coefficients bend to what a cause does, and leave it nothing to explain.
    """
    if model.beside is not None and not _bent(bench, model):
        return []
    held = bench.likeliest(bench.frozen(bench.as_filed(model)))
    bent = 2 * (held.cost - model.cost) > phi * least_needed(bench)
    return weigh(bench, held, bench.screen(held), progress) if bent and np.isfinite(held.cost) else []


def _bent(bench: Workbench, model: Model) -> bool:
    """Whether a file that may bend within its prior makes the logs likelier than one that holds."""
    stats, base = bench.screen(model), slice(0, len(bench.base))
    _, precision, z = bench.known(model)
    lost = putting_back(bench, model, stats, base).sum() - precision[base] @ z[base] ** 2
    return bool(0.5 * lost > narrowed(bench, model, stats))


def narrowed(bench: Workbench, model: Model, stats: Reduced) -> float:
    """Nats that coefficients of the file cost which may bend: by how much the logs narrow their prior.

    Integrated over the prior, what they could have been and are not counts against them (Laplace).
    """
    base = slice(0, len(bench.base))
    known, precision, _ = bench.known(model)
    h = (known.T @ stats.h.sum(0) @ known)[base, base]
    shares = h / np.sqrt(np.outer(precision[base], precision[base]))
    return 0.5 * float(np.linalg.slogdet(np.eye(len(h)) + shares)[1])


def nats(bench: Workbench, model: Model, stats: Reduced, phi: float) -> float:
    """Logarithm of the marginal likelihood of a model [nats], but for a constant.

    Members and the disturbance are charged for their parameters (Schwarz), members also for how many there
    were to choose from, the file's coefficients, where they may bend, by how far logs narrow their prior.

    - `phi`: dispersion of the scores, the same for all models that are compared.
    """
    narrow = 0.0 if model.frozen else narrowed(bench, model, stats)
    own = sum(prior_nats(bench, member) for member in model.members) + price(bench, model)
    return -model.cost / phi - narrow - own


def _freed(bench: Workbench, model: Model, trials: Sequence[Trial]) -> list[Trial]:
    """Trials that were made beside a file held as it is, refitted beside one that may bend as the model's."""
    out = []
    for trial in trials:
        free = bench.refine(dataclasses.replace(trial.model, frozen=False), STEPS, ROUGH)
        out.append(trial_of(model, free))
    return [t for t in out if np.isfinite(t.saved) and bench.sound(t.model)]


def search(
    bench: Workbench,
    model: Model,
    progress: Progress,
    hopeless: Callable[[Model, Reduced], bool],
) -> Found:
    """Adds suspects to a refined model one after another until nothing is worth adding.

    - `hopeless`: whether a model with some members is no better than none.
    """
    model, stats = _weighted(bench, model, bench.screen(model))
    rounds: list[Round] = []
    held: list[Trial] = []
    while len(model.members) < MOST:

        def tell(words: str, which: int = len(rounds) + 1) -> None:
            progress(in_round(which, MOST, words))

        trials = weigh(bench, model, stats, tell) if bench.sound(model) else []
        decided = _decided(bench, model, trials)
        if decided is None:
            phi = dispersion(bench, model, stats)
            if trials:
                rounds.append(Round(_once(trials), False, phi))
            held = beside_file(bench, model, phi, tell)
            decided = _decided(bench, model, _by_penalty(bench, _freed(bench, model, held[:MORE])))
        if decided is None:
            # A current that was left to its name, and has not got it, disturbs.
            wider = amid_more(bench, model, steady=False)
            if wider is model:
                break
            if trials:
                rounds.pop()
            model, stats = _weighted(bench, wider, bench.screen(wider))
            continue
        one, stats = decided
        rounds.append(one)
        held = []
        model = amid_more(bench, one.trials[0].model)
        if model is not one.trials[0].model:
            stats = bench.screen(model)
        model, stats = _weighted(bench, model, stats)
        progress(FOUND + bench.layout.suspects[one.trials[0].member.suspect].label)
        if hopeless(model, stats):
            break
    return Found(model, stats, tuple(rounds), tuple(held))


def _weighted(bench: Workbench, model: Model, stats: Reduced) -> tuple[Model, Reduced]:
    """The model with the prior as heavy as its scores scatter, and its statistics."""
    phi = dispersion(bench, model, stats)
    if 1 / SAME < phi / model.weight < SAME:
        return model, stats
    model = dataclasses.replace(model, weight=phi)
    bent = bench.refine(model)
    if not bench.sound(bent):
        # Without the weight they had bent until they mean nothing, and do not find back from there.
        anew = bench.refine(bench.as_filed(model))
        bent = min(bent, anew, key=lambda m: (not bench.sound(m), m.cost))
    return bent, bench.screen(bent)


def _decided(bench: Workbench, model: Model, trials: Sequence[Trial]) -> tuple[Round, Reduced] | None:
    """The round that a significant one of the best trials wins, and the statistics of its model."""
    # The best may rest on a few windows, as one does that acts throughout in the place of one that begins:
    # then the next ones are looked at too.
    saves = [t.saved > needed(bench, t.member, 1.0) for t in trials]
    sure = list(itertools.compress(trials, saves))
    hopeful = [t for t, enough in zip(trials, saves, strict=True) if not enough and _may_be_found(bench, t)]
    to_beat = model
    for place, trial in enumerate([*sure, *hopeful][:CHANCES]):
        exact = bench.likeliest(trial.model)
        since = trial.member.since
        if exact.beside is not None and since is not None:
            # What is left of some samples on the wrong side scatters its scores.
            dt = bench.data.logs[since.log].dt
            exact = bench.likeliest(begun_at_best(bench, exact, -1, dt, FEW_STEPS))
        if not bench.stands(exact, model):
            continue
        if place >= len(sure) and to_beat is model:
            # What the disturbance gains by being fitted to the end is not the suspect's.
            to_beat = bench.likeliest(model)
        winner = trial_of(to_beat, exact)
        after = bench.screen(exact)
        phi = dispersion(bench, exact, after)
        if not significant(bench, winner, after, phi):
            continue
        others = [t for t in trials if t is not trial]
        ranked = by_evidence(bench, model, winner, others, phi)
        if ranked[0] is not winner:
            # By the evidence, which knows how far the scores scatter, another one was better.
            stats_of = bench.screen(ranked[0].model)
            phi_of = dispersion(bench, ranked[0].model, stats_of)
            if significant(bench, ranked[0], stats_of, phi_of):
                return Round(_once(ranked), True, phi_of), stats_of
            ranked = [winner, *(t for t in ranked if t is not winner)]
        return Round(_once(ranked), True, phi), after
    return None


def _may_be_found(bench: Workbench, trial: Trial) -> bool:
    """Whether a trial without the odds that a finding needs may have them where it is refitted to the end.

    Beside a disturbance, which is fitted to it in part only: one that stood in for what acts all the time, by
    a memory as long as the log, goes step by step.
    """
    return trial.model.beside is not None and bool(trial.saved > penalty(bench, trial.member))


def by_evidence(
    bench: Workbench, model: Model, winner: Trial, others: Sequence[Trial], phi: float
) -> list[Trial]:
    """All trials, the best by evidence first.

    Those that may be as good as the winner are refitted to the end, and left out where they cannot stand.
    """
    least = evidence(bench, winner.member, winner.saved, phi) - bench.criteria.close
    out = [winner]
    for trial in others:
        hoped = trial.saved + 2 * max(trial.model.cost - trial.model.promised, 0.0)
        if evidence(bench, trial.member, hoped, phi) > least:
            exact = bench.likeliest(trial.model)
            if not bench.stands(exact, model):
                continue
            trial = trial_of(model, exact)
        out.append(trial)
    return sorted(out, key=lambda t: -evidence(bench, t.member, t.saved, phi))


def _begun(begun: dict[int, Member], trials: list[Trial]) -> list[Member]:
    """The leading suspects once more, acting from the time that suits them best."""
    leading = sorted(trials, key=lambda t: -t.saved)[:WITH_BEGINNING]
    tried = {t.member for t in trials}
    wanted = [begun[t.member.suspect] for t in leading if t.member.suspect in begun]
    return [member for member in dict.fromkeys(wanted) if member not in tried]


def _once(trials: list[Trial]) -> tuple[Trial, ...]:
    """Each member once, at its best."""
    best: dict[Member, Trial] = {}
    for trial in trials:
        best.setdefault(trial.member, trial)
    return tuple(best.values())
