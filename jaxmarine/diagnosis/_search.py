"""The search: score every suspect, refit the best, keep the winner if it is real, go on."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ._model import Beginning, Member, Model, Workbench
from ._result import Weighed
from ._score import Reduced, savings

# Suspects refitted in a round, by what the linearisation says they would save.
SHORTLIST = 5
# Windows that must lie on either side of a beginning.
EARLIEST = 3
# Findings in one diagnosis at most; a model that needs more is wrong in another way.
MOST = 6
# Nats of evidence beyond the look-elsewhere correction that a finding needs.
MARGIN = 8.0
# A finding must save this many standard errors (over windows) of chi-square.
SIGMAS = 3.0


@dataclasses.dataclass(frozen=True)
class Trial:
    """A refitted suspect."""

    member: Member
    model: Model
    saved: float

    def parameters(self, bench: Workbench) -> dict[str, float]:
        where = bench.slices(self.model.members)[-1]
        names = bench.layout.suspects[self.member.suspect].slots
        values = bench.layout.neutral_of(self.member.suspect) + self.model.z[where]
        return dict(zip(names, values.tolist(), strict=True))


@dataclasses.dataclass(frozen=True)
class Found:
    """Where the search ended."""

    model: Model
    stats: Reduced
    rounds: tuple[tuple[Weighed, ...], ...]


def dispersion(bench: Workbench, model: Model, stats: Reduced) -> float:
    """How much more the windows' scores scatter than white noise of the stated size would make them.

    The median over suspects of (sum of squared scores) / (information), after what is known has been
    projected out; 1 for white noise, more under disturbances and coloured noise.
    """
    known, precision, _ = bench.known(model)
    h = stats.h.sum(0)
    ratios = []
    for i in range(len(bench.layout.suspects)):
        own = bench.own(i)
        x = np.linalg.lstsq(known.T @ h @ known + np.diag(precision), known.T @ h @ own, rcond=1e-12)[0]
        combined = own - known @ x
        scores = stats.g @ combined
        information = np.einsum("ij,wik,kj->j", combined, stats.h, combined, optimize=True)
        full = np.einsum("ij,wik,kj->j", own, stats.h, own, optimize=True)
        usable = information > 1e-6 * full + 1e-12
        ratios += ((scores - scores.mean(0)) ** 2).sum(0)[usable].__truediv__(information[usable]).tolist()
    return max(1.0, float(np.median(ratios)))


def shortlist(bench: Workbench, model: Model, stats: Reduced, beginnings: bool) -> list[tuple[Member, float]]:
    """The suspects worth refitting, with what the linearisation says they would save."""
    known, precision, offset = bench.known(model)
    active = {m.suspect for m in model.members}
    order = [i for i in range(len(bench.layout.suspects)) if i not in active]
    owns = tuple(bench.own(i) for i in order)
    earliest = EARLIEST if beginnings else bench.count
    table = savings(stats, known, precision, offset, owns, earliest)
    out = []
    for i, row in zip(order, table, strict=True):
        out.append((Member(i), float(row[0])))
        w = int(np.argmax(row[1:])) + 1 if len(row) > 1 else 0
        if w and row[w] > row[0] + max(40.0, 0.2 * row[0]):
            since = Beginning(int(bench.window_log[w]), float(bench.data.starts[w]))
            out.append((Member(i, since), float(row[w])))
    return sorted(out, key=lambda item: -item[1])


def probes(bench: Workbench, model: Model, best: float) -> list[tuple[Member, np.ndarray]]:
    """Suspects without a useful slope at neutral, at the start from which they promise most."""
    active = {m.suspect for m in model.members}
    out = []
    for i, suspect in enumerate(bench.layout.suspects):
        if i in active or not suspect.starts:
            continue
        neutral = bench.layout.neutral_of(i)
        names = list(suspect.slots)
        values = [np.array([start[n] for n in names]) - neutral for start in suspect.starts]
        promised = [bench.promise(bench.with_member(model, Member(i), value)) for value in values]
        if 2 * (model.cost - min(promised)) > 0.2 * best:
            out.append((Member(i), values[int(np.argmin(promised))]))
    return out


def _trial(bench: Workbench, model: Model, member: Member, value: np.ndarray | None = None) -> Trial:
    if value is None:
        value = np.zeros(bench.layout.columns[member.suspect].shape[1])
    fitted = bench.refine(bench.with_member(model, member, value), max_steps=20)
    return Trial(member, fitted, 2 * (model.cost - fitted.cost))


def penalty(bench: Workbench, member: Member) -> float:
    """Chi-square that the parameters of a member must pay for: log(n) each (Schwarz), one more for a beginning."""
    own = bench.layout.columns[member.suspect].shape[1] + (member.since is not None)
    return own * np.log(bench.samples)


def search(
    bench: Workbench,
    progress: Callable[[str], None] = lambda text: None,
    beginnings: bool = True,
) -> Found:
    """Adds suspects one after another until nothing is worth adding."""
    progress("fitting the vehicle file")
    model = bench.refine(bench.start())
    stats = bench.screen(model)
    rounds = []
    while len(model.members) < MOST:
        progress(f"scoring {len(bench.layout.suspects)} suspects (round {len(rounds) + 1})")
        ranked = shortlist(bench, model, stats, beginnings)
        trials = [_trial(bench, model, member) for member, _ in ranked[:SHORTLIST]]
        best = max([t.saved for t in trials], default=0.0)
        best = max(best, 1.0)
        if best > 20.0:
            for member, value in probes(bench, model, best):
                trials.append(_trial(bench, model, member, value))
        trials = [t for t in trials if np.isfinite(t.saved)]
        trials.sort(key=lambda t: penalty(bench, t.member) - t.saved)
        winner = trials[0]
        after = bench.screen(winner.model)
        phi = dispersion(bench, winner.model, after)
        tried = len(ranked) * (bench.count if winner.member.since else 1)
        own = bench.layout.columns[winner.member.suspect].shape[1]
        needed = phi * (2 * own + 2 * np.log(tried) + 2 * MARGIN)
        difference = stats.chi2 - after.chi2
        t = difference.sum() / max(np.sqrt(len(difference)) * difference.std(ddof=1), 1e-9)
        accepted = winner.saved > needed and t > SIGMAS
        rounds.append(
            tuple(
                Weighed(
                    label=bench.layout.suspects[t_.member.suspect].label,
                    log_evidence=float((t_.saved / phi - penalty(bench, t_.member)) / 2),
                    saved_chi2=float(t_.saved),
                    parameters=t_.parameters(bench),
                    remark=(
                        (f"since {t_.member.since.time:g} s " if t_.member.since else "")
                        + ("accepted" if accepted and t_ is winner else "")
                    ).strip(),
                )
                for t_ in trials
            )
        )
        if not accepted:
            break
        model, stats = winner.model, after
    return Found(model, stats, tuple(rounds))
