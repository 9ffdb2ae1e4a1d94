"""Who else it may be: suspects compared by rows at hand that are told once more, linear about each.

A slope at neutral says little of a cause that is far from it, and nothing of one that has none there. So who
is likely by slopes is compared here with those that begin elsewhere, and with columns that are exchanged.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from ..diagnosis import Criteria
from ..vehicle import Placed
from ._anew import Told, answered_otherwise, exchanged, possible, promised, starts, suited, tell
from ._evidence import Member, place
from ._ledger import Account, Ledger
from ._passage import Passage
from ._swell import stilled, waves

# Of what the best has, what another must promise to be told about again [nats].
HOPEFUL = 0.5
# Within a block a suspect is tried from every sample, or from every fourth part of it where there are more.
PARTS = 4
# Times its start from which the step of a staircase is searched: a delay of 0.3 s from a short one of 0.15 s
# to one longer than a second, each half of the next, as a search between neighbours has one top to find.
OCTAVES = np.array([0.5, 1.0, 2.0, 4.0])


class Weighed(NamedTuple):
    """A suspect with its nats by the blocks as they are, beside the disturbance of an account."""

    nats: float
    member: Member
    account: Account


class Rival(NamedTuple):
    """A suspect with its nats by rows that were told once more about it, and when it began [s].

    - `here`: those of the rows at hand alone. `summed`: whether older rows tell of it as well.
    - `begins`: what its beginning costs [nats] where it is compared with others, 0 of what always was; the
      bound from which one is named counts beginnings as well.
    - `exchanged`: columns of commands, which no number tells; None: the last member of what was told.
    """

    nats: float
    label: str
    since: float
    told: Told
    here: float
    summed: bool
    begins: float = 0.0
    exchanged: Placed | None = None

    @property
    def compared(self) -> float:
        return self.nats - self.begins

    @property
    def compared_here(self) -> float:
        return self.here - self.begins

    def behind(self, other: "Rival") -> float:
        """By how many nats another is likelier, by the rows that tell of both."""
        if self.summed and other.summed:
            return other.compared - self.compared
        return other.compared_here - self.compared_here


def rivals(
    passage: Passage, members: Sequence[Member], weighed: Sequence[Weighed], bound: float
) -> list[Rival]:
    """Suspects beside what is named, by the rows at hand told about each, the likeliest first.

    - `weighed`: those that are likely by their slopes, the best first. Without any a swell may be a wave, and
      columns may be exchanged.
    - `bound` [nats]: from which on one is named.
    """
    field = Field.of(passage, members)
    if field is None:
        return []
    out = list(field.swung())
    if not weighed:
        out += field.connected_otherwise(answered_otherwise(passage), HOPEFUL * bound)
    if max((one.nats for one in (*weighed, *out)), default=-np.inf) < HOPEFUL * bound:
        return out
    out += field.sloped(weighed)
    if not out:
        return []
    # What the rows, told again, do not bear out needs no other explanation either.
    if max(one.nats for one in out) > HOPEFUL * bound:
        least = HOPEFUL * max(bound, *(one.here for one in out))
        out += field.begun_elsewhere(weighed, least)
        if weighed:
            out += field.connected_otherwise(exchanged(passage), least)
    out = ranked(out)
    # A disturbance that was found beside the best may suit the rows better without it, too.
    none = field.none
    more = none.passage.ledger.likelihood_beside(out[0].told.account, none.members) - none.level
    return [one._replace(nats=one.nats - max(more, 0.0)) for one in out]


def ranked(some: Sequence[Rival]) -> list[Rival]:
    """The likeliest first, the others by how far they are behind it, by the rows that tell of both.

    All rows and those at hand may lead in a circle: another is likelier than the first then, and none sure.
    """
    summed, others = [one for one in some if one.summed], [one for one in some if not one.summed]
    leaders = [max(summed, key=lambda one: one.compared)] if summed else []
    leaders += [max(others, key=lambda one: one.compared_here)] if others else []
    best = min(leaders, key=lambda one: one.behind(leaders[0]))
    return [best, *sorted((one for one in some if one is not best), key=lambda one: one.behind(best))]


@dataclasses.dataclass(frozen=True)
class Field:
    """Those that are compared, beside what is named.

    - `members`: what is named. `none`: the rows at hand told about that alone; before a suspect begins they
      are told so about that, too.
    """

    passage: Passage
    members: tuple[Member, ...]
    none: Told

    @classmethod
    def of(cls, passage: Passage, members: Sequence[Member]) -> "Field | None":
        """None where the craft runs away from what is named."""
        first, members = passage.ledger.accounts[0], tuple(members)
        known = passage.ledger.suspicions.estimate(passage.ledger.since(first), members)
        none = tell(passage, members, known, first)
        return None if none is None else cls(passage, members, none)

    @property
    def ledger(self) -> Ledger:
        return self.passage.ledger

    def sloped(self, weighed: Sequence[Weighed]) -> Iterator[Rival]:
        """Those that were weighed, from where their slopes lead, and from elsewhere if that is better.

        A delay or a lag that is none has a slope on one side only, which may point to the other. Slopes of
        what is far from the file tell badly when it began, and what seems to have begun soon after the first
        row may always have been there.
        """
        first = self.ledger.accounts[0]
        for _, member, account in weighed:
            model = (*self.members, member)
            known = self.ledger.suspicions.estimate(self.ledger.since(account), model)
            told = tell(self.none.passage, model, known, account, member.since)
            found = [] if told is None else [self._rival(member, told)]
            for z in self._starts(member):
                found += self._begun(member, [z], first, max([0.0, *(one.nats for one in found)]))
            if found:
                yield self._as_ever(self._as_begun(max(found, key=lambda one: one.nats)))

    def swung(self) -> Iterator[Rival]:
        """Suspects that swing, where what disturbs does, of all rows that can be at hand."""
        if not self.ledger.full:
            return
        account, known = self.none.account, self.none.known
        for suspect in {*self.ledger.bench.swinging} - {one.suspect for one in self.members}:
            some = waves(self.none.passage, account, known, self.members, suspect)
            # A phase has no beginning.
            found = self._begun(Member(suspect, -np.inf), some, account, 0.0)
            yield from (one for one in found if stilled(account.force, one.told.account.force))

    def begun_elsewhere(self, weighed: Sequence[Weighed], least: float) -> Iterator[Rival]:
        """Suspects that were not weighed from a start that promises no less than so much [nats]."""
        layout, since = self.ledger.bench.layout, weighed[0].member.since if weighed else -np.inf
        done = {one.suspect for one in (*self.members, *(one.member for one in weighed))}
        for suspect in range(len(layout.suspects)):
            if suspect not in done:
                member = Member(suspect, since)
                found = self._begun(member, self._starts(member), self.ledger.accounts[0], least)
                yield from map(self._as_ever, found)

    def _starts(self, member: Member) -> Iterator[Float[np.ndarray, " z"]]:
        """Parameters from which a suspect has a useful slope: of a staircase the step that promises most.

        No slope leads from one step to the next. So its start is halved and doubled, and between neighbours
        of the one that promises most, if that is more than its price, the best is searched to a sample.
        """
        bench, first = self.ledger.bench, self.ledger.accounts[0]
        some = starts(bench.layout, member.suspect)
        if not bench.layout.suspects[member.suspect].effect.stairs:
            yield from some
            return

        def cost(z: float) -> float:
            told = self._promised(member, np.array([z]), first)
            # What no craft bears is worse than none, and the worse the more, as a search has to turn back.
            return z if told is None else self.none.level - told.level

        for (start,) in some:
            grid = start * OCTAVES
            costs = [cost(z) for z in grid]
            best = float(grid[int(np.argmin(costs))])
            if min(costs) < -self._price(member):
                bounds, to = (best / 2, best * 2), {"xatol": bench.dt}
                found = minimize_scalar(cost, bounds=bounds, method="bounded", options=to)
                yield np.array([found.x if found.fun < min(costs) else best])

    def _promised(self, member: Member, z: Float[np.ndarray, " z"], account: Account) -> Told | None:
        """What slopes promise of a suspect at some parameters; None where no craft has it so."""
        known, members = np.append(self.none.known, z), (*self.members, member)
        told = promised(self.none.passage, members, known, account, member.since)
        return told if told is not None and possible(told) else None

    def _begun(
        self, member: Member, some: Iterable[Float[np.ndarray, " z"]], account: Account, least: float
    ) -> Iterator[Rival]:
        """A suspect from that of some parameters which promises most, if it does no less than so much [nats].

        Beside the disturbance of an account.
        """
        every = (self._promised(member, z, account) for z in some)
        hopeful = [told for told in every if told is not None and self._rival(member, told).nats > least]
        for one in sorted(hopeful, key=lambda told: -told.level):
            told = tell(self.none.passage, (*self.members, member), one.known, account, member.since)
            if told is not None:
                yield self._rival(member, told)
                return

    def _as_begun(self, rival: Rival) -> Rival:
        """A suspect from the time on, less than a window from its beginning, that suits it best.

        By blocks that are linear about it all the while; then told again from there. First the block that
        suits it best, then the sample within that or the one before, with which a block is made to begin.
        """
        times = self.none.passage.ledger.begun_within(rival.since).tolist()
        if not times:
            return rival
        *model, member = rival.told.members
        longer = (*model, member._replace(since=times[0]))

        def best_of(told: Told, some: list[float]) -> float:
            every = told.passage.ledger.nats_from(told.account, model, some)
            nats = {t: one[member.suspect] for t, (_, one) in zip(some, every, strict=True)}
            return max(some, key=lambda t: nats[t])

        told = promised(self.none.passage, longer, rival.told.known, rival.told.account, times[0])
        if told is None:
            return rival
        best = best_of(told, times)
        within = self._within(best, times[0])
        if within:
            told = promised(told.passage, longer, rival.told.known, told.account, within[0], within)
            if told is not None:
                best = best_of(told, [best, *within])
        begun = member._replace(since=best)
        if begun == member:
            return rival
        z = self.ledger.suspicions.parts_of(rival.told.known, rival.told.members)[-1]
        found = self._begun(begun, [z], rival.told.account, rival.compared)
        return max([rival, *found], key=lambda one: one.compared)

    def _within(self, t: float, first: float) -> list[float]:
        """Some samples [s] within the block that begins at a time, and the one before, from the first on."""
        ledger, rows = self.none.passage.ledger, self.none.passage.rows.t
        k = ledger.block_of(t)
        begins = max(ledger.begun_at[max(k - 1, 0)], first)
        every = max(1, ledger.bench.steps // PARTS)
        inside = (rows > begins) & (rows < ledger.ends_at[k]) & (rows != t)
        # One block more each, and one for its own beginning once it is known.
        return rows[inside][every - 1 :: every][: max(ledger.room - 2, 0)].tolist()

    def _as_ever(self, rival: Rival) -> Rival:
        """A suspect as if it had always been there, where that is likelier than its beginning, paid for."""
        if rival.since == -np.inf:
            return rival
        suspect = rival.told.members[-1].suspect
        z = self.ledger.suspicions.parts_of(rival.told.known, rival.told.members)[-1]
        ever = self._begun(Member(suspect, -np.inf), [z], rival.told.account, rival.compared)
        return max([rival, *ever], key=lambda one: one.compared)

    def connected_otherwise(self, causes: Iterable[Placed], least: float) -> Iterator[Rival]:
        """Columns of commands that may be exchanged, and promise no less than so much [nats] if they are.

        Beside a disturbance of their own: what was estimated beside the others had to push as they do not.
        """
        known = self.none.known
        for cause in causes:
            other, label = self.passage.exchanged(cause), f"{cause.effect.name}:{cause.target}"
            told = promised(other, self.members, known, self.ledger.accounts[0])
            if told is None:
                continue
            told = suited(told, known)
            if told.level - self.none.level > least:
                told = tell(other, self.members, told.known, told.account)
                if told is not None:
                    nats, here = told.level - self.none.level, told.at_hand - self.none.at_hand
                    yield Rival(nats, label, -np.inf, told, here, summed=False, exchanged=cause)

    def _rival(self, member: Member, told: Told) -> Rival:
        """By the rows at hand alone, if these say too little for what older ones say to be true.

        What older rows say of it was summed up by slopes, which may have been none. Of what is true rows say
        as much as they ought to, or more, with a variance of twice that: less is too little where it had to
        be an accident by the odds at which two are told apart. Where they ought to say next to nothing, it
        is too little that they speak against it by those odds.
        """
        ledger, none, close = self.ledger, self.none, Criteria().close
        width = ledger.suspicions.columns[member.suspect].shape[1]
        nats, said = told.level - none.level - self._price(member), told.at_hand - none.at_hand
        here = said - none.passage.ledger.price_of(width)
        # Beside the disturbance of none, grown to what it takes of the suspect, they ought to say least.
        models = (told.known, told.members), (none.known, none.members)
        ought = max(none.passage.ledger.apart(none.account, *models), close)
        summed = not ledger.begins_elsewhere(member.suspect)
        if here < nats and said < ought and (ought - said) ** 2 > 4 * ought * close:
            nats, summed = here, False
        label = ledger.bench.layout.suspects[member.suspect].label
        return Rival(nats, label, member.since, told, here, summed, self._begins(member.since))

    def _begins(self, since: float) -> float:
        """What a beginning costs [nats]: as much as a number that is estimated."""
        return 0.0 if since == -np.inf else self._number(-np.inf)

    def _price(self, member: Member) -> float:
        """What a member's parameters cost [nats]."""
        return self.ledger.suspicions.columns[member.suspect].shape[1] * self._number(member.since)

    def _number(self, t: float) -> float:
        """Half the logarithm of the numbers measured since a time [s] (Schwarz)."""
        since = self.ledger.since(self.ledger.accounts[0])
        return 0.5 * float(np.log(max(since[place(since, t)].seen, 2)))
