"""Which suspect it is, and when that is sure.

What is said of the last minute or two is said beside a disturbance whose sizes and memories were estimated
on just these blocks, beside the model that is compared: so much a diagnosis would do. What is older keeps
what it was judged by. By slopes a suspect is found; who it is the rows decide, told once more about each
(`_rivals.py`).

When to be sure: the ratio of a suspect's likelihood to that of none is a martingale where nothing is wrong.
A sum of such ratios over all suspects, one begun at every window, passes a bound in no less than bound
windows on the average; the largest passes it no sooner. So the bound follows from how often a false name may
be said. After Shiryaev and Roberts on quickest detection, and Ville's inequality. It holds as far as the
model of what disturbs the craft does, a Gauss-Markov wrench per axis, a swell, a drift and a current once
the rows tell them, and no further: sizes are estimated from the same rows, and what is none of these is
evidence for whatever explains it best.
"""

from collections.abc import Sequence

import numpy as np

from ..diagnosis import Criteria
from ..fitting import Wider, unusual, with_current, with_drift
from ..vehicle import Placed
from ._anew import answered_otherwise
from ._evidence import Member, Sum
from ._ledger import Account, Ledger
from ._passage import Passage
from ._rivals import HOPEFUL, Rival, Weighed, rivals
from ._status import Name, moment_of

# Blocks after which sizes and memories are estimated first: 32 s, some memories of a usual disturbance.
OPENING = 64
# Blocks from one look at the suspects to the next, and from one comparison of rivals to the next.
LOOK, PATIENCE = 4, 16
# To which patience doubles: five minutes, as a comparison may take one.
MOST_PATIENT = 600
# Nats from which on a disturbance is estimated beside the leading suspect as well.
LEADS = 3.0
# Rivals with a disturbance of their own each before one is named; of those that are `HOPEFUL`.
RIVALS = 3
DAY = 86400.0
WANDERING: dict[Wider, str] = {with_drift: "a force that wanders", with_current: "a current that wanders"}
UNSUSPECTED = "a cause that is not suspected"


class Judge:
    """Weighs the suspects as blocks come, and names one that is sure.

    - `bound` [nats]: from which on a suspect is named. `nats`: of each suspect at its best beginning, as last
      weighed.
    - `members`, `exchanged`: those that are named, `named` in words; `undecided`: labels that explain the
      blocks alike.
    - `estimated_at`: the block at which disturbances were last estimated, -1: never.
    - `asked_at`: that at which rivals were last compared, when there were `asked_with` nats and `asked_about`
      led (`_waits`); `patience`: blocks from one time to the next, doubled each time until all is quiet.
    - `swell_at`, `calm`: likewise of a swell that may be a wave, which need not ever be quiet, and of columns
      that may be exchanged; `in_step`: whether it was one when all rows at hand were last asked.
    """

    def __init__(self, passage: Passage, false_alarms: float):
        self.passage = passage
        bench = passage.bench
        chances = len(bench.layout.suspects) * DAY / bench.length
        self.bound = float(np.log(chances / false_alarms)) if false_alarms else np.inf
        self.members: tuple[Member, ...] = ()
        self.exchanged: tuple[Placed, ...] = ()
        self.named: tuple[Name, ...] = ()
        self.undecided: tuple[str, ...] = ()
        self.nats: np.ndarray | None = None
        self.estimated_at, self.asked_at, self.patience = -1, -MOST_PATIENT, PATIENCE
        self.asked_with, self.asked_about = 0.0, list[int]()
        self.swell_at, self.calm, self.in_step = -MOST_PATIENT, PATIENCE, False

    @property
    def ledger(self) -> Ledger:
        return self.passage.ledger

    def judge(self) -> list[str]:
        """After each block; what is new."""
        ledger = self.ledger
        opening = self.estimated_at < 0
        if ledger.full or (opening and ledger.held >= OPENING):
            self._estimate()
            told = self._look()
            if self.ledger.full:
                self.ledger.release([m.since for m in self.members if m.since > -np.inf])
            return told
        return [] if opening or ledger.blocks % LOOK else self._look()

    # --- weighing --------------------------------------------------------------------------------

    def _estimate(self) -> None:
        """The disturbance of the blocks that are held, beside what is named, and beside the leading suspect.

        That which leads before a disturbance has grown to what it does, or that which leads beside it then.
        """
        ledger = self.ledger
        leaders = [self._leading()]
        ledger.estimate(ledger.accounts[0], self.members)
        self.estimated_at = ledger.blocks
        latest = ledger.accounts[-1]
        del ledger.accounts[1:]
        leaders.append(self._leading())
        likely: list[tuple[float, Account]] = []
        for leader in dict.fromkeys(one for one in leaders if one is not None):
            own, model = latest.branched(), (*self.members, leader)
            ledger.estimate(own, model)
            likely.append((ledger.likelihood(own, ledger.since(own), model), own))
        if likely:
            ledger.accounts.append(max(likely, key=lambda one: one[0])[1])

    def _weigh(self) -> tuple[list[Sum], np.ndarray]:
        """Nats of every suspect and beginning, each beside the disturbance that suits it best."""
        ledger, levels = self.ledger, self._levels()
        every = [ledger.since(one) for one in ledger.accounts]
        tables = [
            ledger.nats(account, since, self.members) + level
            for account, since, level in zip(ledger.accounts, every, levels, strict=True)
        ]
        return every[0], np.max(tables, axis=0) - max(levels)

    def _levels(self) -> list[float]:
        """Logarithms of the likelihood of none, beside each disturbance."""
        ledger = self.ledger
        return [ledger.likelihood(one, ledger.since(one), self.members) for one in ledger.accounts]

    def _closely(self, since: Sequence[Sum], table: np.ndarray) -> list[Member]:
        """The best suspects, each with its beginning to the block near those that are best by windows.

        Who began within a window resembles another who hardly acts between its beginning and that.
        """
        ledger, levels = self.ledger, self._levels()
        columns = {one.t: (one, nats) for one, nats in zip(since, table.T, strict=True)}
        times = sorted({float(t) for one in hopeful(since, table) for t in ledger.begun_within(one.since)})
        every = [ledger.nats_from(one, self.members, times) for one in ledger.accounts]
        for t, *told in zip(times, *every, strict=True):
            nats = [nats + level for (_, nats), level in zip(told, levels, strict=True)]
            columns[t] = told[0][0], np.max(nats, axis=0) - max(levels)
        sums, nats = zip(*columns.values(), strict=True)
        return hopeful(sums, np.array(nats).T)

    def _leading(self) -> Member | None:
        since, table = self._weigh()
        i = int(np.argmax(table.max(axis=1)))
        b, nats = best_beginning(since, table[i])
        return Member(i, since[b].t) if nats > LEADS else None

    # --- naming ----------------------------------------------------------------------------------

    def _look(self) -> list[str]:
        """Weighs all suspects, and names one that is sure."""
        ledger = self.ledger
        since, table = self._weigh()
        self.nats = table.max(axis=1)
        waited, rested = ledger.blocks - self.estimated_at, ledger.blocks - self.asked_at
        sure, unsloped = self.nats.max() >= self.bound, self._unsloped()
        if not sure and waited >= PATIENCE:
            self.undecided, self.patience = (), PATIENCE
        sure = sure and rested >= self._waits()
        if not (sure or unsloped) or 0 < waited < PATIENCE:
            return []
        if unsloped:
            self.swell_at, self.calm = ledger.blocks, min(2 * self.calm, MOST_PATIENT)
        if not sure:
            return self._decide([], unsloped)
        self.asked_at, self.patience = ledger.blocks, min(2 * self.patience, MOST_PATIENT)
        suspected = hopeful(since, table)
        if waited:
            self._estimate()
            since, table = self._weigh()
            self.nats = table.max(axis=1)
            suspected += hopeful(since, table)
        self.asked_with, self.asked_about = float(self.nats.max()), self._within(Criteria().close)
        suspected += self._closely(since, table)
        return self._decide(list({one.suspect: one for one in suspected}.values()), unsloped)

    def _waits(self) -> int:
        """How many blocks to wait until rivals are compared once more: `patience`, or less if rows tell more.

        They may tell two apart where they tell twice as much, and where another has come to those who led, or
        one of them has fallen behind, beyond what two that go up and down do at the edge.
        """
        assert self.nats is not None
        if self.nats.max() >= 2 * self.asked_with:
            return PATIENCE
        close, asked = Criteria().close, {*self.asked_about}
        changed = {*self._within(close)} - asked or asked - {*self._within(2 * close)}
        return max(PATIENCE, self.patience // 4) if changed else self.patience

    def _within(self, nats: float) -> list[int]:
        """Suspects with so many nats less than the best at most, as they were last weighed."""
        assert self.nats is not None
        return np.flatnonzero(self.nats > self.nats.max() - nats).tolist()

    def _unsloped(self) -> bool:
        """Whether to ask of what no slope tells, of all rows that can be at hand.

        If a swell is a regular wave, and if columns are exchanged where the craft answers so: what disturbs
        may have grown to what either does, and then no suspect is likely.
        """
        ledger = self.ledger
        if not (ledger.full and ledger.blocks - self.swell_at >= self.calm and np.isfinite(self.bound)):
            return False
        unnamed = {*ledger.bench.swinging} - {one.suspect for one in self.members}
        swings = bool(unnamed) and ledger.accounts[0].force.swells
        return swings or bool(answered_otherwise(self.passage))

    def _weighed(self, suspected: Sequence[Member]) -> list[Weighed]:
        """Suspects by slopes, each beside a disturbance of its own, the best first."""
        ledger, level = self.ledger, max(self._levels())
        weighed: list[Weighed] = []
        for member in suspected:
            own = ledger.accounts[-1].branched()
            ledger.estimate(own, (*self.members, member))
            found = [(*self._worth(one, member.suspect, level), one) for one in (ledger.accounts[0], own)]
            nats, since, account = max(found, key=lambda one: one[0])
            weighed.append(Weighed(nats, Member(member.suspect, since), account))
        # What begins elsewhere has a slope on one side only, which may lead where no craft is.
        weighed = [one for one in weighed if self._sound(one) or ledger.begins_elsewhere(one.member.suspect)]
        # What swings has slopes at a period of its own only.
        weighed = [one for one in weighed if one.member.suspect not in ledger.bench.swinging]
        return sorted(weighed, key=lambda one: -one.nats)

    def _decide(self, suspected: Sequence[Member], unsloped: bool) -> list[str]:
        """Weighs the best suspects, each beside a disturbance of its own, and asks further if one is sure.

        Or if it may be what no slope tells.
        """
        ledger, weighed = self.ledger, self._weighed(suspected)
        sure = [one for one in weighed if one.nats >= self.bound]
        if not sure and not unsloped:
            self.undecided = ()
            return []
        compared = rivals(self.passage, self.members, weighed if sure else (), self.bound)
        if not compared:
            sure = [one for one in sure if self._sound(one)]
            if sure:
                return self._cannot_tell((UNSUSPECTED,), sure[0].nats, sure[0].member.since)
        if max((one.nats for one in compared), default=-np.inf) < self.bound:
            self.undecided, self.in_step = (), False
            return []
        best, least = compared[0], Criteria().close
        if self._passing(best):
            return []
        # Rows at hand may speak for one of which they are not sure, against one of which all rows are.
        close = [o.label for o in compared[1:] if o.behind(best) < least or o.nats >= self.bound > best.nats]
        for one in weighed:
            if self.label(one.member.suspect) == best.label and not self._steady(one.member, one.account):
                close += [WANDERING[wider] for wider in ledger.wandering_as(one.member.suspect)]
        if close:
            return self._cannot_tell((best.label, *close), best.nats, best.since)
        return self._name(best)

    def _passing(self, best: Rival) -> bool:
        """Whether what swings was not in step when rows were last asked: a group of waves is for a while."""
        swings = not best.exchanged and best.told.members[-1].suspect in self.ledger.bench.swinging
        before, self.in_step = self.in_step, swings
        return swings and not before

    def _cannot_tell(self, labels: tuple[str, ...], nats: float, since: float) -> list[str]:
        """That something is wrong, unless that was said."""
        if {*labels} == {*self.undecided}:
            return []
        self.undecided = labels
        why = f"what it is cannot be told yet, {', '.join(labels)} explain it alike"
        if labels == (UNSUSPECTED,):
            why = "none of the suspects explains it"
        when = moment_of(_time(since))
        return [f"t = {self.ledger.t:g} s: something is wrong, {when} ({nats:.0f} nats); {why}."]

    def _name(self, best: Rival) -> list[str]:
        """Takes a suspect into the model, which goes on linear about it."""
        # What is left has nats of its own.
        self.undecided, self.asked_with, self.asked_about = (), 0.0, []
        self.passage.adopt(best.told.passage)
        self.members, self.estimated_at = best.told.members, self.ledger.blocks
        numbers = {} if best.exchanged else self.parameters(len(self.members) - 1)
        if best.exchanged:
            # Older rows told of another craft.
            self.ledger.forget()
            self.exchanged = (*self.exchanged, best.exchanged)
        name = Name(best.label, _time(best.since), self.ledger.t, best.nats, numbers)
        self.named = (*self.named, name)
        self.nats = self._weigh()[1].max(axis=1)
        values = ", ".join(f"{k} = {v:.3g} ± {s:.2g}" for k, (v, s, _) in name.parameters.items())
        values = f": {values}" if values else ""
        return [
            f"t = {name.at:g} s: {name.label}, {moment_of(name.since)}{values} ({name.nats:.0f} nats; "
            f"named from {self.bound:.0f})."
        ]

    def _worth(self, account: Account, suspect: int, level: float) -> tuple[float, float]:
        """A suspect's nats beside the disturbance of an account, and its beginning; `level`: of none."""
        ledger = self.ledger
        since = ledger.since(account)
        nats = ledger.nats(account, since, self.members)[suspect]
        b, best = best_beginning(since, nats + ledger.likelihood(account, since, self.members) - level)
        return best, since[b].t

    def _steady(self, member: Member, own: Account) -> bool:
        """Whether a member that is steady is as sure beside what wanders as it does not; true of all others.

        Some memories long the two are alike. By the rows at hand, with the file's coefficients as they are
        beside the steady one: older rows, judged beside neither, have bent them for want of either.

        - `own`: the account of the member.
        """
        ledger, model = self.ledger, (*self.members, member)
        if not ledger.wandering_as(member.suspect):
            return True
        other = ledger.wandering(own, self.members, member.suspect)
        known = ledger.suspicions.estimate(ledger.since(own), model)
        width = ledger.suspicions.columns[member.suspect].shape[1]
        prior = 0.5 * (unusual(own.force, ledger.bench.unit) - unusual(other.force, ledger.bench.unit))
        # These coefficients need not suit what was estimated beside others.
        some = known[: len(known) - width], ledger.suspicions.estimate(ledger.since(other), self.members)
        wanders = max(ledger.at_hand(other, one, self.members) for one in some) + prior
        return ledger.at_hand(own, known, model) - ledger.price_of(width) - wanders >= self.bound

    def _sound(self, one: Weighed) -> bool:
        """Whether a suspect, as estimated beside what is named, can be of a craft, as in a diagnosis.

        A sensor that shows what is yet to come explains much of a craft that its file does not describe.
        """
        ledger, model = self.ledger, (*self.members, one.member)
        return ledger.sound(ledger.suspicions.estimate(ledger.since(one.account), model), model)

    def label(self, suspect: int) -> str:
        return self.ledger.bench.layout.suspects[suspect].label

    def parameters(self, which: int) -> dict[str, tuple[float, float, str]]:
        """Of a member, as it is known now: value, standard error, unit."""
        ledger, suspect = self.ledger, self.members[which].suspect
        suspicions, since = ledger.suspicions, ledger.since(ledger.accounts[0])
        known, errors = suspicions.estimate(since, self.members), suspicions.errors(since, self.members)
        z, std = (suspicions.parts_of(one, self.members)[which] for one in (known, errors))
        layout = ledger.bench.layout
        values, units = layout.values(suspect, z), layout.suspects[suspect].effect.units
        return {
            name: (value, float(s), units[name]) for (name, value), s in zip(values.items(), std, strict=True)
        }


def hopeful(since: Sequence[Sum], nats: np.ndarray) -> list[Member]:
    """Of all suspects from every beginning the best, each with its beginning."""
    best = nats.max(axis=1)
    order = np.argsort(-best)[:RIVALS]
    some = [int(i) for i in order if best[i] > max(HOPEFUL * best[order[0]], LEADS)]
    return [Member(i, since[best_beginning(since, nats[i])[0]].t) for i in some]


def best_beginning(since: Sequence[Sum], nats: np.ndarray) -> tuple[int, float]:
    """Of one suspect, and its nats there: always, unless a beginning pays for itself."""
    b = int(np.argmax(nats))
    price = 0.5 * np.log(max(since[0].seen, 2))
    return (0, float(nats[0])) if nats[b] - price < nats[0] else (b, float(nats[b]))


def _time(since: float) -> float | None:
    """Since when [s], None: always."""
    return None if since == -np.inf else since
