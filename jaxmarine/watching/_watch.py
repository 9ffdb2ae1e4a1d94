"""A craft that is watched: rows go in, and what is wrong, since when, comes out.

    rows -> blocks -> filter -> evidence -> names

What is said of the last minute or two is said beside a disturbance whose sizes and memories were estimated on
just these blocks, beside the model that is compared: so much a diagnosis would do. What is older keeps what it
was judged by, so that memory stays constant.

When to be sure: the ratio of a suspect's likelihood to that of none is a martingale where nothing is wrong. A
sum of such ratios over all suspects, one begun at every window, passes a bound in no less than bound windows on
the average; the largest passes it no sooner. So the bound follows from how often a false name may be said.
After Shiryaev and Roberts on quickest detection, and Ville's inequality.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from .._precision import need_double
from ..diagnosis import CLOSE
from ..effects import CATALOGUE, AbstractEffect, place
from ..fitting import Disturbance, Problem, Windowed, estimated
from ..vehicle import Placed, Vehicle
from ._blocks import GAP, LONG, Bench, Begun, Rows, Said, expected, passed, replayed
from ._evidence import Account, Member, Since, Sum, Suspicions, since_each, thinned
from ._rows import Intake

# Blocks after which sizes and memories are estimated first, and that are judged beside them together at most.
OPENING, CHUNK = 64, 80
# Blocks from one look at the suspects to the next, and from one estimate that a suspicion asks for to the next.
LOOK, PATIENCE = 4, 16
# Nats from which on a disturbance is estimated beside the leading suspect as well.
LEADS = 3.0
# Rivals with a disturbance of their own each before one is named; those with this share of the best's nats.
RIVALS, HOPEFUL = 3, 0.5
# A disturbance beyond this share of the full thrust is none in which a craft can be steered.
STEERABLE = 0.5
# False names per day unless it is said otherwise: one in a hundred days.
FALSE_ALARMS = 0.01
# Variance of the logarithms of sizes and memories before anything is known of them.
UNLEARNED = 0.25
DAY = 86400.0


@dataclasses.dataclass(frozen=True)
class Name:
    """A cause that is named: the suspect, since when (t of the log [s], None: as long as it is watched).

    - `at`: when it was named [s]; `nats`: its evidence; `parameters`: value, standard error, unit.
    - `rivals`: what the rows cannot tell from it; then none of them is certain.
    """

    label: str
    since: float | None
    at: float
    nats: float
    parameters: Mapping[str, tuple[float, float, str]]
    rivals: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Status:
    """Where a watch stands.

    - `t`: where the last block ends [s]; `blocks`: that were filtered.
    - `position`, `attitude` (quaternion), `velocity`: the craft's; `wrench`: what disturbs it, axis by axis,
      `size` and `memory`: as far as usual.
    - `nats`: of each suspect, at its best beginning; `bound`: from which on one is named.
    - `named`; `undecided`: causes of which one is at work, and the rows do not tell which.
    - `unseen`: axes and actuators of which too little was seen to tell what the file says of them.
    """

    t: float
    blocks: int
    state: Begun | None
    axes: tuple[str, ...]
    size: tuple[float, ...]
    memory: tuple[float, ...]
    nats: Mapping[str, float]
    bound: float
    named: tuple[Name, ...]
    undecided: tuple[str, ...]
    unseen: tuple[str, ...]


class Watch:
    """Watches a craft by its vehicle file; `update` takes one row after another.

    - `false_alarms`: false names per day that are allowed for.
    - `catalogue`: the effects that are suspected.

    The one object of the package that changes: a link goes on. What it holds is bounded.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        false_alarms: float = FALSE_ALARMS,
        catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    ):
        need_double("A watch")
        self.vehicle = vehicle
        self.catalogue = tuple(catalogue)
        self.false_alarms = false_alarms
        self.intake = Intake(vehicle)
        self.bench: Bench | None = None
        self.rows: Rows | None = None  # of this stretch: what a block needs of the past, and what is to come
        self.waiting: list[Rows] = []
        self.named: tuple[Name, ...] = ()
        self.members: tuple[Member, ...] = ()
        self.undecided: tuple[str, ...] = ()
        self.told: list[str] = []

    # --- rows ------------------------------------------------------------------------------------

    @threadpool_limits.wrap(limits=1, user_api="blas")
    def update(self, row: Mapping[str, float]) -> list[str]:
        """Takes a row by the contract's column names (`t`, channels, commands); says what is new, if anything.

        Empty cells and NaN were not measured. Raises `InputError` where the rows cannot be this craft's.
        """
        one, set_back, told = self.intake.take(row)
        if one is None:
            return self._noted(told)
        if set_back:
            self._interrupt(LONG)
        elif self.waiting or self.rows is not None:
            told += self._gap(float(one.t[0]))
        self.waiting.append(one)
        if self.bench is None:
            told += self._open()
        if self.bench is not None and len(self.waiting) >= self._wanted():
            told += self._advance()
        return self._noted(told)

    def _noted(self, told: list[str]) -> list[str]:
        self.told += told
        return told

    def _gap(self, t: float) -> list[str]:
        """What there is to say of the time since the last row."""
        last = float((self.waiting[-1] if self.waiting else self.rows).t[-1])  # pyright: ignore
        if self.bench is None or t - last <= GAP * self.bench.dt:
            return []
        self._interrupt(t - last)
        return [f"Nothing came from t = {last:g} to {t:g} s; motion begins anew there, evidence is kept."]

    def _interrupt(self, gap: float) -> None:
        """A new stretch: rows of the old one that fill no block are of no use."""
        if self.bench is None:
            self.waiting = []
            return
        self.rows, self.waiting = None, []
        self.gap, self.begun, self.within = gap, None, 0
        self.settled_at = None

    def _open(self) -> list[str]:
        """Sizes up the rows once there are enough of them."""
        t = np.array([one.t[0] for one in self.waiting])
        if len(t) < 40 or t[-1] - t[0] < 8.0:
            return []
        rows = Rows.joined(*self.waiting)
        assert self.intake.driven is not None
        log = rows.log(self.vehicle, self.intake.driven, "rows")
        self._begin(Bench.of(self.vehicle, log, self.catalogue))
        speeds = np.abs(np.nan_to_num(rows.channels[:, 6:12])).max(axis=0)
        self.speed = np.maximum(speeds, np.where(np.isfinite(rows.channels[:, 6:12]).any(axis=0), 0.1, 1.0))
        return []

    def _begin(self, bench: Bench) -> None:
        self.bench = bench
        size = bench.layout.size
        self.suspicions = Suspicions(
            np.array([c.index for c in bench.base]), bench.precision, bench.layout.columns
        )
        zero = Sum(-np.inf, 0, np.zeros(size), np.zeros((size, size)))
        nothing, most = bench.nothing, 2 * CHUNK
        said = np.zeros(most), np.zeros((most, size)), np.zeros((most, size, size))
        self.accounts = [Account(bench.usual, nothing, nothing, 0.0, [zero], said)]
        self.windows: Windowed = jax.tree.map(lambda a: np.array([a] * most), bench.empty)
        self.held, self.blocks, self.since_look, self.estimated_at = 0, 0, 0, 0
        self.begun_at, self.counts = np.zeros(most), np.zeros(most, int)
        self.learned = UNLEARNED * np.eye(2 * len(bench.axes))
        self.gap, self.begun, self.within, self.settled_at = LONG, None, 0, None
        self.table: np.ndarray | None = None
        self.split_at = np.zeros(6)
        self.split = 1
        self.speed = np.full(6, 0.1)
        self.estimated_once = False

    def _wanted(self) -> int:
        """Rows to come before the next block can be filtered."""
        assert self.bench is not None
        return self.bench.steps + (self.rows is None)

    # --- blocks ----------------------------------------------------------------------------------

    def _advance(self) -> list[str]:
        """Filters what fills blocks."""
        bench, told = self.bench, []
        assert bench is not None
        fresh = Rows.joined(*self.waiting)
        self.waiting = []
        if self.rows is None:
            self.rows, self.next = fresh, 0
            self.next = int(np.searchsorted(fresh.t, fresh.t[0] + bench.settling - 1e-9))
        else:
            self.rows = Rows.joined(self.rows, fresh)
        while self.next + bench.steps + 1 <= len(self.rows):
            first = max(0, self.next - bench.past)
            told += self._block(self.rows.part(first, self.next + bench.steps + 1))
            self.next += bench.steps
        drop = max(0, self.next - bench.past)
        self.rows, self.next = self.rows.part(drop), self.next - drop
        return told

    def _block(self, rows: Rows) -> list[str]:
        """Filters one block; `rows`: its past, its own, and one more."""
        bench = self.bench
        assert bench is not None
        own = rows.part(-bench.steps - 1, -1)
        speed = np.nan_to_num(np.abs(own.channels[:, 6:12])).max(axis=0)
        if (speed > self.split_at).any():
            # Ahead by half, so that it seldom changes.
            self.split_at = np.maximum(self.speed, 1.5 * speed)
            self.split = bench.split(self.split_at)
        joined = self.within % bench.whole > 0
        window = bench.window(rows, self.begun, self.gap, joined, self.split)
        k = self.held
        for kept, new in zip(jax.tree.leaves(self.windows), jax.tree.leaves(window), strict=True):
            kept[k] = new
        self.begun_at[k] = own.t[0]
        self.counts[k] = int(np.isfinite(own.channels[:, list(bench.channels)]).sum())
        half = 0.5 * float(window.line.dt.sum())
        for account in self.accounts:
            said, account.message = passed(account.message, window, account.force, bench.spread)
            for kept, new in zip(account.said, said, strict=True):
                kept[k] = new
        first = self.accounts[0]
        now = expected(first.message, first.force, half)
        if not all(np.isfinite(one).all() for one in now):
            self._interrupt(LONG)
            first.message = bench.nothing
            for account in self.accounts:
                account.message = bench.nothing
            return [f"The craft runs away from what is expected at t = {own.t[0]:g} s; motion begins anew."]
        self.begun, self.gap = now, 0.0
        self.t = float(rows.t[-1])
        self.held, self.blocks, self.within = k + 1, self.blocks + 1, self.within + 1
        return self._judge()

    def _judge(self) -> list[str]:
        told: list[str] = []
        if not self.estimated_once:
            if self.held >= OPENING:
                self._estimate()
                told += self._look()
        elif self.held == 2 * CHUNK:
            self._estimate()
            told += self._look()
            self._commit()
        elif self.blocks % LOOK == 0:
            told += self._look()
        return told

    # --- disturbance -----------------------------------------------------------------------------

    def _since(self, account: Account) -> list[Since]:
        assert self.bench is not None
        return since_each(account, self.held, self.bench.whole, self.begun_at, self.counts)

    def _beside(self, account: Account, members: Sequence[Member]) -> None:
        """Estimates the disturbance of the blocks that are held beside a model, and filters them anew."""
        bench = self.bench
        assert bench is not None
        z = self.suspicions.estimate(self._since(account), members)
        at = len(self.suspicions.base)
        whole = np.zeros((2 * CHUNK, bench.layout.size))
        whole[:, self.suspicions.base] += z[:at]
        for member in members:
            own = self.suspicions.columns[member.suspect]
            acts = self.begun_at >= member.since - 1e-9
            whole += acts[:, None] * (own @ z[at : at + own.shape[1]])
            at += own.shape[1]
        line, end = self.windows.line, self.windows.end
        residual = line.residual[..., -1] + np.einsum("bsrz,bz->bsr", line.residual[..., :-1], whole)
        ends = end[..., -1] + np.einsum("bsz,bz->bs", end[..., :-1], whole)
        # Blocks that are held no more leave their numbers behind.
        live = np.arange(2 * CHUNK) < self.held
        line = dataclasses.replace(
            line,
            residual=np.where(live[:, None, None], residual, 0.0)[..., None],
            h=np.where(live[:, None, None, None], line.h, 0.0),
        )
        gap = self.windows.gap.copy()
        gap[0] = LONG
        joined = self.windows.joined.copy()
        joined[0] = False
        every = dataclasses.replace(self.windows, line=line, end=ends[..., None], gap=gap, joined=joined)
        force, _, _ = estimated(bench.spread, every, account.force, bench.unit, self.learned)
        account.force = bench.force(force.size, force.time)
        self._replay(account)

    def _replay(self, account: Account) -> None:
        """Filters the blocks that are held once more, from where they begin."""
        message = account.before
        for first in (0, CHUNK):
            count = min(max(self.held - first, 0), CHUNK)
            if count:
                message = self._filter(account, message, first, count)
        account.message = message

    def _filter(self, account: Account, message, first: int, count: int):
        bench = self.bench
        assert bench is not None
        part = jax.tree.map(lambda a: a[first : first + CHUNK], self.windows)
        said, message = replayed(message, part, account.force, bench.spread, jnp.asarray(count))
        for kept, new in zip(account.said, said, strict=True):
            kept[first : first + CHUNK] = new
        return message

    def _estimate(self) -> None:
        """The disturbance of the blocks that are held, beside what is named, and beside the leading suspect."""
        self._beside(self.accounts[0], self.members)
        self.estimated_once, self.estimated_at = True, self.blocks
        leader = self._leading()
        if leader is None:
            del self.accounts[1:]
            return
        if len(self.accounts) == 1:
            self.accounts.append(self.accounts[0].branched())
        self._beside(self.accounts[1], (*self.members, leader))

    def _commit(self) -> None:
        """Lets the older half of the blocks go; their sums stay."""
        bench = self.bench
        assert bench is not None
        pinned = [m.since for m in self.members if m.since > -np.inf]
        for account in self.accounts:
            message = self._filter(account, account.before, 0, CHUNK)
            minus, g, h = account.said
            for k in range(0, CHUNK, bench.whole):
                here = slice(k, min(k + bench.whole, CHUNK))
                last = account.sums[-1]
                # The last sum is all so far; at its time the next beginning lies.
                account.sums[-1] = last._replace(t=float(self.begun_at[k]))
                account.sums.append(
                    Sum(
                        float(self.begun_at[min(here.stop, self.held - 1)]),
                        last.count + int(self.counts[here].sum()),
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
        for kept in (*jax.tree.leaves(self.windows), self.begun_at, self.counts):
            kept[:CHUNK] = kept[CHUNK:]
        self.held -= CHUNK

    # --- suspects --------------------------------------------------------------------------------

    @property
    def bound(self) -> float:
        """Nats from which on a suspect is named."""
        if self.bench is None:
            return np.inf
        suspects = len(self.bench.layout.suspects)
        window = self.bench.whole * self.bench.steps * self.bench.dt
        return float(np.log(suspects) + np.log(DAY / window / self.false_alarms))

    def _likelihood(self, account: Account, since: Sequence[Since], members: Sequence[Member]) -> float:
        """Logarithm of the likelihood of a model beside an account's disturbance, but for a constant."""
        minus_twice = account.minus_twice + float(account.said[0][: self.held].sum())
        return self.suspicions.gained(since, members) - 0.5 * minus_twice

    def _weigh(self) -> tuple[list[Since], np.ndarray]:
        """Nats of every suspect and beginning, each beside the disturbance that suits it best."""
        sums = [self._since(account) for account in self.accounts]
        level = [
            self._likelihood(account, since, self.members)
            for account, since in zip(self.accounts, sums, strict=True)
        ]
        tables = [
            self.suspicions.nats(since, self.members) + one for since, one in zip(sums, level, strict=True)
        ]
        return sums[0], np.max(tables, axis=0) - max(level)

    def _best(self, since: Sequence[Since], row: np.ndarray) -> tuple[int, float]:
        """The beginning of a suspect, and its nats: always, unless a beginning pays for itself."""
        b = int(np.argmax(row))
        price = 0.5 * np.log(max(since[0].count, 2))
        return (0, float(row[0])) if row[b] - price < row[0] else (b, float(row[b]))

    def _leading(self) -> Member | None:
        since, table = self._weigh()
        i = int(np.argmax(table.max(axis=1)))
        b, nats = self._best(since, table[i])
        return Member(i, since[b].t) if nats > LEADS else None

    def _look(self) -> list[str]:
        """Weighs all suspects, and names one that is sure."""
        since, table = self._weigh()
        self.table = table.max(axis=1)
        if self.table.max() < self.bound:
            self.undecided = ()
            return []
        if self.blocks - self.estimated_at >= PATIENCE:
            self._estimate()
            since, table = self._weigh()
            self.table = table.max(axis=1)
        elif self.estimated_at != self.blocks:
            return []
        return self._decide(since, table)

    def _decide(self, since: Sequence[Since], table: np.ndarray) -> list[str]:
        """Names the best suspect if it stands beside a disturbance of its own, and so do its rivals theirs."""
        best = table.max(axis=1)
        order = np.argsort(-best)
        hopeful = [int(i) for i in order[:RIVALS] if best[i] > HOPEFUL * best[order[0]]]
        accounts, weighed = list(self.accounts), {}
        level = max(self._likelihood(a, self._since(a), self.members) for a in accounts)
        for i in hopeful:
            b, _ = self._best(since, table[i])
            member = Member(i, since[b].t)
            own = accounts[-1].branched()
            self._beside(own, (*self.members, member))
            of = self._since(own)
            row = self.suspicions.nats(of, self.members)[i] + self._likelihood(own, of, self.members) - level
            row = np.maximum(row, table[i]) if i == order[0] else row
            b, nats = self._best(of, row)
            weighed[i] = (nats, Member(i, of[b].t), own)
        ranked = sorted(weighed, key=lambda i: -weighed[i][0])
        nats, member, own = weighed[ranked[0]]
        if nats < self.bound:
            return []
        labels = [self._label(i) for i in ranked]
        close = tuple(
            label for label, i in zip(labels[1:], ranked[1:], strict=True) if weighed[i][0] > nats - CLOSE / 2
        )
        if close:
            both = (labels[0], *close)
            if both == self.undecided:
                return []
            self.undecided = both
            return [
                f"t = {self.t:g} s: something is wrong, {self._when(member.since)}; it is one of "
                f"{', '.join(both)}, which these rows do not tell apart ({nats:.0f} nats)."
            ]
        self.undecided = ()
        self.members = (*self.members, member)
        self.accounts = [own]
        name = self._named(len(self.members) - 1, nats)
        self.named = (*self.named, name)
        values = ", ".join(f"{k} = {v:.3g} ± {s:.2g}" for k, (v, s, _) in name.parameters.items())
        self.table = self._weigh()[1].max(axis=1)
        return [
            f"t = {self.t:g} s: {name.label}, {self._when(member.since)}: {values} ({nats:.0f} nats; named "
            f"from {self.bound:.0f})."
        ]

    def _when(self, since: float) -> str:
        return "for as long as it is watched" if since == -np.inf else f"since t = {since:g} s"

    def _label(self, i: int) -> str:
        assert self.bench is not None
        return self.bench.layout.suspects[i].label

    def _named(self, which: int, nats: float) -> Name:
        member, bench = self.members[which], self.bench
        assert bench is not None
        since = self._since(self.accounts[0])
        z = self.suspicions.estimate(since, self.members)
        std = np.sqrt(np.diag(self.suspicions.covariance(since, self.members)))
        at = len(self.suspicions.base)
        at += sum(self.suspicions.columns[m.suspect].shape[1] for m in self.members[:which])
        suspect = bench.layout.suspects[member.suspect]
        here = slice(at, at + len(suspect.slots))
        values = bench.layout.values(member.suspect, z[here])
        parameters = {
            name: (value, float(s), suspect.effect.units[name])
            for (name, value), s in zip(values.items(), std[here], strict=True)
        }
        begun = None if member.since == -np.inf else member.since
        return Name(suspect.label, begun, self.t, nats, parameters)

    # --- what it offers --------------------------------------------------------------------------

    @property
    def extended(self) -> Vehicle:
        """The vehicle with what is named in it, acting from now on."""
        placed = []
        for i, member in enumerate(self.members):
            assert self.bench is not None
            suspect = self.bench.layout.suspects[member.suspect]
            now = self._named(i, 0.0)
            values = {name: value for name, (value, _, _) in now.parameters.items()}
            placed.append(Placed(place(suspect, self.vehicle, values), suspect.target))
        return self.vehicle.place(*placed) if placed else self.vehicle
