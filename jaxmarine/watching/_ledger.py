"""The blocks of the last minute or two, and what they and all before them say beside a disturbance.

How large the disturbance is and how long it lasts is estimated on the blocks that are held, beside a model,
as a diagnosis does on a whole log; then they are filtered anew. Blocks that are let go leave the sums that
they were judged by, so that memory stays constant. Beginnings that are long ago are kept with gaps that grow
with their age.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..diagnosis import STEADY, Criteria, of_a_craft, steady_of
from ..fitting import (
    PLANE,
    USUAL_SIZE,
    Disturbance,
    Message,
    Wider,
    Windowed,
    count_of,
    drifting,
    estimated,
    flowing,
    likeliest_of,
    nothing_known,
    wider_by,
    with_current,
    with_drift,
)
from ._blocks import LONG, Begun, Bench, Place, expected, passed, replayed
from ._evidence import Acting, Member, Sum, Suspicions, place

# Blocks that are let go at once; twice as many are held at most.
CHUNK = 80
# Of these, how many are left for parts of blocks within which something begins, or may begin.
SPARE = 16
# Beginnings before the blocks that are held, at most.
KEPT = 24
# Variance of the logarithms of sizes and memories before anything is known of them.
UNLEARNED = 0.25
# A disturbance, the covariance of its logarithms, and -2 log p (`fitting.estimated`).
Estimated = tuple[Disturbance, Float[np.ndarray, "_ _"], float]
# Columns of z, and since when they act [s].
Gate = tuple[tuple[int, ...], float]
Says = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclasses.dataclass
class Account:
    """What blocks say beside one disturbance.

    - `message`: what is known where the last block ends, `before`: where the held ones begin.
    - `minus_twice`, `sums`: of the blocks that are held no more; beginnings among them, the last one now.
    - `said`: per block that is held -2 log p, gradient, information.
    - `learned`: covariance of the logarithms of sizes and memories (`fitting.estimated`).
    - `gates`: columns of z that act from a time on [s] only.
    """

    force: Disturbance
    before: Message
    message: Message
    minus_twice: float
    sums: list[Sum]
    said: Says
    learned: Float[np.ndarray, "logarithms logarithms"]
    gates: tuple[Gate, ...] = ()

    @classmethod
    def blank(cls, bench: Bench) -> "Account":
        """Before the first block, beside a usual disturbance."""
        size, most = bench.layout.size, 2 * CHUNK
        zero = Sum(-np.inf, 0, np.zeros(size), np.zeros((size, size)))
        said = np.zeros(most), np.zeros((most, size)), np.zeros((most, size, size))
        learned = UNLEARNED * np.eye(count_of(bench.usual))
        return cls(bench.usual, bench.nothing, bench.nothing, 0.0, [zero], said, learned)

    def close(self, columns: list[int]) -> None:
        """Leaves no trace of columns of z that have not begun."""
        _, g, h = self.said
        g[:, columns], h[:, columns], h[:, :, columns] = 0.0, 0.0, 0.0
        self.message = closed(self.message, columns)

    def branched(self) -> "Account":
        minus, g, h = self.said
        said = np.array(minus), np.array(g), np.array(h)
        return dataclasses.replace(self, sums=list(self.sums), said=said)


class Opening(NamedTuple):
    """The first `kept` of a ledger's blocks, filtered for others that go on from there; `blocks`: its own.

    Those who may be it began at one time, mostly, and are told beside one disturbance.
    """

    kept: int
    blocks: int
    account: Account

    def is_of(self, kept: int, blocks: int, force: Disturbance, gates: tuple[Gate, ...]) -> bool:
        same = self.account.force is force and self.account.gates == gates
        return same and (self.kept, self.blocks) == (kept, blocks)


class Ledger:
    """What was said so far.

    - `held`: blocks at hand; of each `windows`, and its `Place`: `begun_at`, `ends_at`, `counts`, `samples`,
      `within`.
    - `blocks`: since the first; `let_go`: how often half of those held were; `lost`: how many count for
      nothing; `t`: where the last ends [s].
    - `about`: what blocks are linear about.
    - `accounts`: the first one is beside what is named, and says where the craft is expected.
    - `opening`: what others last went on from.
    """

    def __init__(self, bench: Bench):
        self.bench = bench
        self.suspicions = Suspicions(
            np.array([c.index for c in bench.base]), bench.precision, bench.layout.columns
        )
        most = 2 * CHUNK
        self.accounts = [Account.blank(bench)]
        self.windows: Windowed = jax.tree.map(lambda a: np.array([a] * most), bench.empty)
        self.begun_at, self.ends_at = np.zeros((2, most))
        self.counts, self.samples, self.within = np.zeros((3, most), int)
        self.held, self.blocks, self.let_go, self.lost, self.t = 0, 0, 0, 0, -np.inf
        self.about = Acting(((-np.inf, np.zeros(bench.layout.size)),))
        self.opening: Opening | None = None

    def anew(
        self, known: Float[np.ndarray, " known"], members: Sequence[Member], account: Account, kept: int
    ) -> "Ledger":
        """One that holds the first `kept` blocks alone, beside the disturbance of an account.

        Those to come will be linear about members with known numbers, and about the file's own. What went
        before the blocks that are held stays.
        """
        out = Ledger(self.bench)
        filed = np.arange(len(known)) < len(self.suspicions.base)
        out.about = self.suspicions.acting(np.where(filed, 0.0, known), members)
        out.blocks, out.let_go, out.held = self.blocks - self.held + kept, self.let_go, kept
        for new, one in zip(out.of_blocks, self.of_blocks, strict=True):
            new[:kept] = one[:kept]
        gates = tuple((self._columns(m.suspect), m.since) for m in members if m.since >= self.begun_at[0])
        before = tuple(gate for gate in gates if kept and gate[1] < self.begun_at[kept])
        if not kept:
            own = self._blank(account, ())
        elif self.opening is not None and self.opening.is_of(kept, self.blocks, account.force, before):
            own = self.opening.account.branched()
        else:
            out._replay(filtered := self._blank(account, before))
            self.opening = Opening(kept, self.blocks, filtered)
            own = filtered.branched()
        own.learned, own.gates = account.learned, gates
        for columns in (gate[0] for gate in gates if gate not in before):
            own.close(list(columns))
        for columns in self._first_elsewhere(members):
            own.sums = [one.without(columns) for one in own.sums]
        out.accounts = [own]
        return out

    def begins_elsewhere(self, suspect: int) -> bool:
        """Whether it has starts, as slopes at neutral need not lead to it, or swings, at whatever period."""
        return suspect in self.bench.swinging or bool(self.bench.layout.suspects[suspect].starts)

    def _first_elsewhere(self, members: Sequence[Member]) -> list[list[int]]:
        """Columns of members that begin elsewhere and were not told about: older sums say nothing of them."""
        told = self.about.at(np.inf)
        columns = (list(self._columns(m.suspect)) for m in members if self.begins_elsewhere(m.suspect))
        return [some for some in columns if not told[some].any()]

    def begun(self) -> Begun:
        """What is expected where the blocks that are held end."""
        first, last = self.accounts[0], self.held - 1
        ends = self.ends_at[last]
        return expected(first.message, first.force, 0.5 * (ends - self.begun_at[last]), self.about.at(ends))

    def _blank(self, account: Account, gates: tuple[Gate, ...]) -> Account:
        """Before the blocks that are held, beside the disturbance of another account."""
        first = nothing_known(account.force, self.bench.layout.size + 1)
        return dataclasses.replace(
            self.accounts[0].branched(),
            force=account.force,
            learned=account.learned,
            before=first,
            message=first,
            gates=gates,
        )

    def forget(self) -> None:
        """What was said before the blocks that are held counts no more."""
        self.opening = None
        for account in self.accounts:
            account.sums, account.minus_twice = Account.blank(self.bench).sums, 0.0

    def likelihood_beside(self, account: Account, members: Sequence[Member]) -> float:
        """Likelihood of members beside a disturbance that is estimated from that of another account on.

        Its numbers are paid for.
        """
        own = self._blank(account, self.accounts[0].gates)
        self._replay(own)
        self.estimate(own, members)
        return self.likelihood(own, self.since(own), members) - self.price(own.force)

    @property
    def full(self) -> bool:
        return self.room <= SPARE

    @property
    def room(self) -> int:
        """For so many blocks more."""
        return 2 * CHUNK - self.held

    @property
    def places(self) -> tuple[np.ndarray, ...]:
        """Those of all blocks, each as an array, in the order of `Place`."""
        return self.begun_at, self.ends_at, self.counts, self.samples, self.within

    @property
    def of_blocks(self) -> tuple[np.ndarray, ...]:
        """All that is kept of each block."""
        return *jax.tree.leaves(self.windows), *self.places

    def states(self, blocks: slice) -> Float[np.ndarray, "samples 13"]:
        """Where the craft was expected at the samples of some blocks."""
        states = np.asarray(self.windows.states)[blocks]
        return states[np.arange(states.shape[1]) < self.samples[blocks, None]]

    def add(self, window: Windowed, place: Place) -> Begun | None:
        """Filters one more block; where it leaves the craft.

        None where the craft runs away from what is expected: the block counts for nothing.
        """
        k = self.held
        for kept, new in zip(jax.tree.leaves(self.windows), jax.tree.leaves(window), strict=True):
            kept[k] = new
        for kept, new in zip(self.places, place, strict=True):
            kept[k] = new
        for account in self.accounts:
            acts = acts_of(account.gates, np.array(place.begins), window.end.shape[-1])
            said, account.message = passed(account.message, window, acts, account.force, self.bench.spread)
            for kept, new in zip(account.said, said, strict=True):
                kept[k] = new
        self.held, self.blocks = k + 1, self.blocks + 1
        now = self.begun()
        if not all(np.isfinite(one).all() for one in now):
            for account in self.accounts:
                account.message = nothing_known(account.force, self.bench.layout.size + 1)
            self.held, self.blocks, self.lost = k, self.blocks - 1, self.lost + 1
            return None
        self.t = place.ends
        return now

    def since(self, account: Account) -> list[Sum]:
        """What was said from each beginning on: a window apart, and from where something acts."""
        gates = [t for one in (account, *self.accounts) for _, t in one.gates]
        first = self._beginnings(self.held, gates)
        return since_each(account, first, self.begun_at[: self.held], self.counts)

    def _beginnings(self, held: int, pinned: Sequence[float]) -> list[int]:
        """Of so many blocks those that begin a window, and those within which some times [s] lie."""
        at = {self.block_of(t) for t in pinned if t > self.begun_at[0] - 1e-9}
        begins = np.flatnonzero(~np.asarray(self.windows.joined[:held])).tolist()
        return sorted({0, *begins, *(k for k in at if k < held)})

    def block_of(self, t: float) -> int:
        """The last block that is held and begins no later than a time [s], or the first."""
        return max(int(np.searchsorted(self.begun_at[: self.held], t + 1e-9, side="right")) - 1, 0)

    def nats(self, account: Account, since: Sequence[Sum], members: Sequence[Member]) -> np.ndarray:
        """Nats beside what is named; what only acts from a time on in an account cannot have begun before."""
        nats = self.suspicions.nats(since, members)
        begun = np.array([one.t for one in since])
        for columns, gate in account.gates:
            for i in range(len(nats)):
                if {*columns} & {*self._columns(i)}:
                    nats[i, begun < gate - 1e-9] = -np.inf
        return nats

    def begun_within(self, t: float) -> Float[np.ndarray, " times"]:
        """Where blocks begin that are held, less than a window from a time [s]; but for the first of all."""
        begun = self.begun_at[int(self.blocks == self.held) : self.held]
        return begun[np.abs(begun - t) < self.bench.length - 1e-9]

    def nats_from(
        self, account: Account, members: Sequence[Member], times: Sequence[float]
    ) -> list[tuple[Sum, Float[np.ndarray, " suspects"]]]:
        """What was said from each of some blocks on, and nats of every suspect that begins with it.

        Within a window a state is where a suspect would have taken it that had acted before. So blocks are
        filtered without a trace of any but of the file's own coefficients, which act anyway, and of members'.
        Those before a beginning are for all later ones the same.

        - `times` [s]: where the blocks begin.
        """
        before, found = account.branched(), {}
        suspects = range(len(self.suspicions.columns))
        stay = {*self.suspicions.base.tolist(), *(c for m in members for c in self._columns(m.suspect))}
        begins = tuple(sorted({column for i in suspects for column in self._columns(i)} - stay))
        gates = self._gates(account, members)
        before.gates = (*gates, (begins, np.inf))
        message, done = self._opened(before), 0
        for t in sorted(times):
            k = self.block_of(t)
            message, done = self._filter(before, message, done, k), k
            own = before.branched()
            own.gates = (*gates, (begins, t))
            self._filter(own, message, k, self.held)
            since = self.since(own)
            of_members = (since[place(since, m.since)] for m in members)
            some = [since[0], *of_members, since[place(since, t)]]
            found[t] = some[-1], self.nats(own, some, members)[:, -1]
        return [found[t] for t in times]

    def likelihood(self, account: Account, since: Sequence[Sum], members: Sequence[Member]) -> float:
        """Logarithm of the likelihood of a model beside an account's disturbance, but for a constant."""
        minus_twice = account.minus_twice + float(account.said[0][: self.held].sum())
        return self.suspicions.gained(since, members) - 0.5 * minus_twice

    def at_hand(
        self, account: Account, known: Float[np.ndarray, " known"], members: Sequence[Member]
    ) -> float:
        """The same by the blocks that are held alone, of known numbers, the file's coefficients among them.

        Without their prior: they are as all that was ever told has them.
        """
        minus_twice, g, h = (one[: self.held] for one in account.said)
        z = self.suspicions.acting(known, members).at(self.begun_at[: self.held])
        return -0.5 * float(
            np.sum(minus_twice + np.einsum("bz,bz->b", 2 * g + np.einsum("bzy,by->bz", h, z), z))
        )

    def apart(
        self,
        account: Account,
        one: tuple[Float[np.ndarray, " known"], Sequence[Member]],
        other: tuple[Float[np.ndarray, " others"], Sequence[Member]],
    ) -> float:
        """Nats by which the blocks that are held ought to tell two models apart, known numbers and members.

        Expected if one of them is true; the variance of what blocks say is twice that.
        """
        begun, h = self.begun_at[: self.held], account.said[2][: self.held]
        z, y = (self.suspicions.acting(*each).at(begun) for each in (one, other))
        return 0.5 * float(np.einsum("bz,bzy,by->", z - y, h, z - y))

    def price(self, force: Disturbance) -> float:
        """What the numbers of a disturbance cost [nats]."""
        return self.price_of(count_of(force))

    def price_of(self, numbers: int) -> float:
        """What so many numbers cost [nats], by all that was measured at hand (Schwarz)."""
        return 0.5 * numbers * float(np.log(max(self.counts[: self.held].sum(), 2)))

    def sound(self, known: Float[np.ndarray, " known"], members: Sequence[Member]) -> bool:
        """Whether members' numbers mean something: in their effects' ranges, and such as a craft can have.

        Of the file's own coefficients, which bend beside what is not named yet, it is not asked.
        """
        bench, layout = self.bench, self.bench.layout
        parts = zip(members, self.suspicions.parts_of(known, members), strict=True)
        if not all(layout.plausible(m.suspect, z) for m, z in parts):
            return False
        filed = np.arange(len(known)) < len(self.suspicions.base)
        z = self.suspicions.acting(np.where(filed, 0.0, known), members).at(np.inf)
        still = np.zeros(len(bench.vehicle.thrusters.direction))
        return of_a_craft(bench.vehicle, bench.saturated, jnp.asarray((layout.neutral + z)[None]), still, 1)

    # --- a disturbance beside a model ------------------------------------------------------------

    def estimate(self, account: Account, members: Sequence[Member]) -> None:
        """Estimates the disturbance of the blocks that are held beside a model, and filters them anew.

        With a swell, a drift and a current beside it once the blocks are likelier so, by the odds of a name,
        their numbers paid for (Schwarz); with what wanders unless a steady one is likelier still, by as much.
        What is steady must then explain what one that wanders does not. All stay.
        """
        every, found = self._suit(account, members)
        amid, steady = {one: self._amid(one, every, found) for one in wider_by(account.force)}, None
        while amid:
            one = max(amid, key=lambda one: amid[one][0])
            gained, wider = amid.pop(one)
            if gained < Criteria().nats:
                break
            if one in STEADY:
                steady = self._best_steady(account, members) if steady is None else steady
                if gained < steady - Criteria().nats:
                    continue
            account.before = account.before.widened(account.force, wider[0])
            self._take(account, wider)
            # Beside the wider one the model has other numbers.
            every, found = self._suit(account, members)
            amid, steady = {other: self._amid(other, every, found) for other in amid}, None

    def _suit(self, account: Account, members: Sequence[Member]) -> tuple[Windowed, Estimated]:
        """`estimate` of the kind that it is; the blocks beside the model, and the estimate."""
        bench = self.bench
        gates = self._gates(account, members)
        if gates != account.gates:
            account.gates = gates
            self._replay(account)
        every = self._beside(account, members)
        found = estimated(bench.spread, every, account.force, bench.unit, account.learned)
        self._take(account, found)
        return every, found

    def _beside(self, account: Account, members: Sequence[Member]) -> Windowed:
        """The blocks that are held, at the numbers of a model."""
        known = self.suspicions.estimate(self.since(account), members)
        z = self.suspicions.acting(known, members).at(self.begun_at)
        line, end = self.windows.line, self.windows.end
        residual = line.residual[..., -1] + np.einsum("bsrz,bz->bsr", line.residual[..., :-1], z)
        ends = end[..., -1] + np.einsum("bsz,bz->bs", end[..., :-1], z)
        # Blocks that are held no more leave their numbers behind.
        live = np.arange(2 * CHUNK) < self.held
        residual = np.where(live[:, None, None], residual, 0.0)[..., None]
        h = np.where(live[:, None, None, None], line.h, 0.0)
        gap, joined = np.array(self.windows.gap), np.array(self.windows.joined)
        gap[0], joined[0] = LONG, False
        return eqx.tree_at(
            lambda w: (w.line.residual, w.line.h, w.end, w.gap, w.joined),
            self.windows,
            tuple(map(jnp.asarray, (residual, h, ends[..., None], gap, joined))),
        )

    def _take(self, account: Account, found: Estimated) -> None:
        """Filters the blocks that are held beside what was estimated."""
        account.force, account.learned, _ = found
        self._replay(account)

    def _amid(self, with_one: Wider, every: Windowed, found: Estimated) -> tuple[float, Estimated]:
        """What was estimated of a wider disturbance, and what it gains so [nats]."""
        bench, (force, _, worth) = self.bench, found
        wider = likeliest_of(bench.spread, every, with_one(force), bench.unit, worth)
        if wider is None or not np.isfinite(worth):
            return -np.inf, found
        amid = estimated(bench.spread, every, wider, bench.unit, UNLEARNED * np.eye(count_of(wider)))
        return 0.5 * (worth - amid[2]) - (self.price(wider) - self.price(force)), amid

    def _best_steady(self, account: Account, members: Sequence[Member]) -> float:
        """Nats of what is steady where a disturbance wanders, beside some members and what suits both."""
        before, best = self.likelihood(account, self.since(account), members), -np.inf
        taken = {one.suspect for one in members}
        for i in steady_of(self.bench.layout):
            if i not in taken:
                own = account.branched()
                self._suit(own, (*members, Member(i, -np.inf)))
                since = self.since(own)
                nats = self.nats(own, since, members)[i, 0]
                best = max(best, self.likelihood(own, since, members) - before + float(nats))
        return best

    def wandering_as(self, suspect: int) -> list[Wider]:
        """What does the same as a suspect that is steady, but wanders; nothing of all others."""
        return [one for one in STEADY if suspect in steady_of(self.bench.layout, [one])]

    def wandering(self, account: Account, members: Sequence[Member], suspect: int) -> Account:
        """Beside some members and what wanders as a suspect does not; from an account beside that suspect.

        And beside what else suits the rows (`estimate`).
        """
        out = account.branched()
        (wider,) = self.wandering_as(suspect)
        if wider in wider_by(account.force):
            out.force = self._usually[wider](account.force)
            out.learned = UNLEARNED * np.eye(count_of(out.force))
            out.before = account.before.widened(account.force, out.force)
        self.estimate(out, members)
        return out

    @property
    def _usually(self) -> dict[Wider, Callable[[Disturbance], Disturbance]]:
        """What wanders as steady causes do not, of a usual size."""
        push = USUAL_SIZE.median * float(self.bench.unit[np.array(self.bench.axes) < PLANE].max())
        return {with_drift: lambda force: drifting(force, push), with_current: flowing}

    def _gates(self, account: Account, members: Sequence[Member]) -> tuple[Gate, ...]:
        """Columns of members that began among the blocks that are held, or did so when these were held."""
        found = [(self._columns(m.suspect), m.since) for m in members if m.since > -np.inf]
        early = self.begun_at[0]
        return tuple(gate for gate in found if gate[1] >= early or gate in account.gates)

    def _columns(self, suspect: int) -> tuple[int, ...]:
        return tuple(np.flatnonzero(self.suspicions.columns[suspect].any(axis=1)).tolist())

    def _replay(self, account: Account) -> None:
        """Filters the blocks that are held once more, from where they begin."""
        account.message = self._filter(account, self._opened(account), 0, self.held)

    def _opened(self, account: Account) -> Message:
        """What is known where the blocks that are held begin."""
        message = account.before
        for columns, since in account.gates:
            if since >= self.begun_at[0]:
                message = closed(message, list(columns))
        return message

    def _filter(self, account: Account, message: Message, first: int, after: int) -> Message:
        """Blocks from one on, up to another that is not among them; what they leave."""
        for start in range(first // CHUNK * CHUNK, after, CHUNK):
            part: Windowed = jax.tree.map(lambda a, k=start: a[k : k + CHUNK], self.windows)
            acts = acts_of(account.gates, self.begun_at[start : start + CHUNK], part.end.shape[-1])
            here = slice(max(first, start), min(after, start + CHUNK))
            inside = jnp.asarray(here.start - start), jnp.asarray(here.stop - start)
            said, message = replayed(message, part, acts, account.force, self.bench.spread, *inside)
            for kept, new in zip(account.said, said, strict=True):
                kept[here] = np.asarray(new)[here.start - start : here.stop - start]
        return message

    # --- memory ----------------------------------------------------------------------------------

    def release(self, pinned: Sequence[float]) -> None:
        """Lets the older half of the blocks go; their sums stay. `pinned`: beginnings that are kept [s]."""
        self.opening = None
        for account in self.accounts:
            message = self._filter(account, account.before, 0, CHUNK)
            minus, g, h = account.said
            for k, after in itertools.pairwise([*self._beginnings(CHUNK, pinned), CHUNK]):
                here = slice(k, after)
                last = account.sums[-1]
                # The last sum is all so far; at its time the next beginning lies.
                account.sums[-1] = last._replace(t=float(self.begun_at[k]))
                account.sums.append(
                    Sum(
                        float(self.begun_at[min(here.stop, self.held - 1)]),
                        last.seen + int(self.counts[here].sum()),
                        last.g + g[here].sum(axis=0),
                        last.h + h[here].sum(axis=0),
                    )
                )
            account.minus_twice += float(minus[:CHUNK].sum())
            account.sums = thinned(account.sums, pinned)
            account.before = message
            for kept in account.said:
                kept[:CHUNK] = kept[CHUNK:]
                kept[CHUNK:] = 0.0
        for kept in self.of_blocks:
            kept[:CHUNK] = kept[CHUNK:]
        self.held, self.let_go = self.held - CHUNK, self.let_go + 1


def closed(message: Message, columns: list[int]) -> Message:
    """Without a trace of columns of z that have not begun."""
    at = np.array(columns)
    return dataclasses.replace(
        message, mean=message.mean.at[:, at].set(0.0), end=message.end.at[:, at].set(0.0)
    )


def acts_of(
    gates: Sequence[Gate], begun_at: Float[np.ndarray, "*blocks"], columns: int
) -> Float[np.ndarray, "*blocks columns"]:
    """1 for columns that act in blocks which begin at some times [s], 0 for those behind a gate until then.

    Suspects may share columns: behind several gates one acts once it has passed all of them.
    """
    acts = np.ones((*begun_at.shape, columns))
    for behind, since in gates:
        acts[..., list(behind)] *= (begun_at >= since - 1e-9)[..., None]
    return acts


def since_each(account: Account, first: Sequence[int], begun, counts) -> list[Sum]:
    """From always, then from each beginning that is kept, and from some of the blocks held, the first too.

    - `begun` [s], `counts`: where each held block begins, and the measured numbers in it.
    """
    _, g, h = account.said
    last = account.sums[-1]
    out = [Sum(np.inf, 0, np.zeros_like(last.g), np.zeros_like(last.h))]
    for k, after in reversed([*itertools.pairwise([*first, len(begun)])]):
        here, later = slice(k, after), out[-1]
        seen = later.seen + int(counts[here].sum())
        out.append(Sum(float(begun[k]), seen, later.g + g[here].sum(axis=0), later.h + h[here].sum(axis=0)))
    now = out[-1]
    total = Sum(-np.inf, last.seen + now.seen, last.g + now.g, last.h + now.h)
    for one in reversed(account.sums[:-1]):
        out.append(Sum(one.t, total.seen - one.seen, total.g - one.g, total.h - one.h))
    return [total, *(one for one in reversed(out[1:]) if one.seen < total.seen)]


def thinned(sums: list[Sum], pinned: Sequence[float]) -> list[Sum]:
    """At most `KEPT` beginnings: of neighbours goes the one whose loss leaves the least gap for its age."""
    sums = list(sums)
    while len(sums) > KEPT + 1 + len(pinned):
        now = sums[-1].t
        gaps = [
            np.inf if sums[i].t in pinned else (sums[i + 1].t - sums[i - 1].t) / (now - sums[i - 1].t + 1e-9)
            for i in range(1, len(sums) - 1)
        ]
        del sums[1 + int(np.argmin(gaps))]
    return sums
