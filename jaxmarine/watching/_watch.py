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
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from .._precision import need_double
from .._types import DOFS
from ..diagnosis import CLOSE
from ..effects import CATALOGUE, AbstractEffect, ThrusterGain, place
from ..fitting import Windowed, estimated
from ..vehicle import Placed, Vehicle
from ._blocks import GAP, LONG, Begun, Bench, Rows, expected, passed, replayed
from ._evidence import Account, Gate, Member, Since, Sum, Suspicions, since_each, thinned
from ._rows import Intake

# Blocks after which sizes and memories are estimated first, and that are judged beside them together at most.
OPENING, CHUNK = 64, 80
# Blocks from one look at the suspects to the next, and from one estimate that a suspicion asks for to the next.
LOOK, PATIENCE = 4, 16
# Nats from which on a disturbance is estimated beside the leading suspect as well.
LEADS = 3.0
# Rivals with a disturbance of their own each before one is named; those with this share of the best's nats.
RIVALS, HOPEFUL = 3, 0.5
# False names per day unless it is said otherwise: one in a hundred days.
FALSE_ALARMS = 0.01
# Variance of the logarithms of sizes and memories before anything is known of them.
UNLEARNED = 0.25
DAY = 86400.0
# Standard error of an actuator's gain beyond which it counts as not excited.
TENTH = 0.1
# Sentences that are remembered.
MOST_TOLD = 200


@dataclasses.dataclass(frozen=True)
class Name:
    """A cause that is named: the suspect, since when (t of the log [s], None: as long as it is watched).

    - `at`: when it was named [s]; `nats`: its evidence; `parameters`: value, standard error, unit.
    """

    label: str
    since: float | None
    at: float
    nats: float
    parameters: Mapping[str, tuple[float, float, str]]


@dataclasses.dataclass(frozen=True)
class Status:
    """Where a watch stands.

    - `t`: where the last block ends [s]; `blocks`: that were filtered.
    - `state`: of the craft, and the wrench that disturbs it on each of `axes`; `size` [N, N m] and `memory` [s]
      of that, as estimated.
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


def moment_of(since: float | None) -> str:
    """Since when, in words."""
    return "for as long as it is watched" if since is None else f"since t = {since:g} s"


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
        self.told = [*self.told, *told][-MOST_TOLD:]
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

    def _open(self) -> list[str]:
        """Sizes up the rows once there are enough of them."""
        t = np.array([one.t[0] for one in self.waiting])
        if len(t) < 40 or t[-1] - t[0] < 8.0:
            return []
        rows = Rows.joined(*self.waiting)
        assert self.intake.driven is not None
        log = rows.log(self.vehicle, self.intake.driven, "rows")
        self.begin(Bench.of(self.vehicle, log, self.catalogue))
        self._quicker(_speeds(rows))
        return []

    def _quicker(self, speed: np.ndarray) -> None:
        """Integration steps for these speeds and half as much again, so that they seldom change."""
        assert self.bench is not None
        self.speed = np.maximum(self.speed, 1.5 * speed)
        self.split = self.bench.split(self.speed)

    def begin(self, bench: Bench) -> None:
        """With nothing known, on what stays the same from block to block."""
        self.bench = bench
        size = bench.layout.size
        self.suspicions = Suspicions(
            np.array([c.index for c in bench.base]), bench.precision, bench.layout.columns
        )
        zero = Sum(-np.inf, 0, np.zeros(size), np.zeros((size, size)))
        nothing, most = bench.nothing, 2 * CHUNK
        said = np.zeros(most), np.zeros((most, size)), np.zeros((most, size, size))
        learned = UNLEARNED * np.eye(2 * len(bench.axes))
        self.accounts = [Account(bench.usual, nothing, nothing, 0.0, [zero], said, learned)]
        self.windows: Windowed = jax.tree.map(lambda a: np.array([a] * most), bench.empty)
        self.held, self.blocks, self.estimated_at, self.next = 0, 0, 0, 0
        self.begun_at, self.counts = np.zeros(most), np.zeros(most, int)
        self.gap, self.begun, self.within = LONG, None, 0
        self.table: np.ndarray | None = None
        self.speed, self.split = np.zeros(6), 1
        self.estimated_once, self.committed, self.patience = False, 0, PATIENCE
        self.t = -np.inf

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
            self.rows = fresh
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
        speed = _speeds(own)
        if (speed > self.speed).any():
            self._quicker(speed)
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
        gates = self._gates(account, members)
        if gates != account.gates:
            account.gates = gates
            self._replay(account)
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
        begin = account.force, bench.unit, account.learned
        force, account.learned, _ = estimated(bench.spread, every, *begin)
        account.force = bench.force(force.size, force.time)
        self._replay(account)

    def _gates(self, account: Account, members: Sequence[Member]) -> tuple[Gate, ...]:
        """Columns of members that began among the blocks that are held, or did so when these were held."""
        found = [(self._columns(m.suspect), m.since) for m in members if m.since > -np.inf]
        early = self.begun_at[0]
        return tuple(gate for gate in found if gate[1] >= early or gate in account.gates)

    def _columns(self, suspect: int) -> tuple[int, ...]:
        return tuple(np.flatnonzero(self.suspicions.columns[suspect].any(axis=1)).tolist())

    def _nats(self, account: Account, since: Sequence[Since]) -> np.ndarray:
        """Nats beside what is named; what only acts from a time on in an account cannot have begun before."""
        nats = self.suspicions.nats(since, self.members)
        begun = np.array([one.t for one in since])
        for columns, gate in account.gates:
            for i in range(len(nats)):
                if {*columns} & {*self._columns(i)}:
                    nats[i, begun < gate - 1e-9] = -np.inf
        return nats

    def _replay(self, account: Account) -> None:
        """Filters the blocks that are held once more, from where they begin."""
        message = account.before
        for columns, since in account.gates:
            if since < self.begun_at[0]:
                continue
            # What has not begun has left no trace.
            at = np.array(columns)
            parts = message.mean.at[:, at].set(0.0), message.end.at[:, at].set(0.0)
            message = dataclasses.replace(message, mean=parts[0], end=parts[1])
        for first in (0, CHUNK):
            count = min(max(self.held - first, 0), CHUNK)
            if count:
                message = self._filter(account, message, first, count)
        account.message = message

    def _filter(self, account: Account, message, first: int, count: int):
        bench = self.bench
        assert bench is not None
        part: Windowed = jax.tree.map(lambda a: a[first : first + CHUNK], self.windows)
        for columns, since in account.gates:
            early, at = self.begun_at[first : first + CHUNK] < since - 1e-9, np.array(columns)
            residual, end = np.array(part.line.residual), np.array(part.end)
            residual[np.ix_(early, *map(np.arange, residual.shape[1:3]), at)] = 0.0
            end[np.ix_(early, np.arange(end.shape[1]), at)] = 0.0
            part = dataclasses.replace(part, line=dataclasses.replace(part.line, residual=residual), end=end)
        said, message = replayed(message, part, account.force, bench.spread, jnp.asarray(count))
        for kept, new in zip(account.said, said, strict=True):
            kept[first : first + CHUNK] = new
        return message

    def _estimate(self) -> None:
        """The disturbance of the blocks that are held, beside what is named, and beside the leading suspect.

        That which leads before a disturbance has grown to what it does, or that which leads beside it then.
        """
        leaders = [self._leading()]
        self._beside(self.accounts[0], self.members)
        self.estimated_once, self.estimated_at = True, self.blocks
        rivals, likely = [], []
        latest = self.accounts[-1]
        del self.accounts[1:]
        leaders.append(self._leading())
        for leader in dict.fromkeys(one for one in leaders if one is not None):
            own = latest.branched()
            self._beside(own, (*self.members, leader))
            rivals.append(own)
            likely.append(self._likelihood(own, self._since(own), (*self.members, leader)))
        if rivals:
            self.accounts.append(rivals[int(np.argmax(likely))])

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
        self.held, self.committed = self.held - CHUNK, self.committed + 1

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
            self._nats(account, since) + one
            for account, since, one in zip(self.accounts, sums, level, strict=True)
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
            if self.blocks - self.estimated_at >= PATIENCE:
                self.undecided, self.patience = (), PATIENCE
            return []
        if self.estimated_at != self.blocks:
            if self.blocks - self.estimated_at < self.patience:
                return []
            self.patience = min(2 * self.patience, CHUNK)
            suspected = self._hopeful(since, table)
            self._estimate()
        else:
            suspected = []
        since, table = self._weigh()
        self.table = table.max(axis=1)
        hopeful = {one.suspect: one for one in (*suspected, *self._hopeful(since, table))}
        return self._decide(list(hopeful.values()))

    def _hopeful(self, since: Sequence[Since], table: np.ndarray) -> list[Member]:
        """The best suspects, each with its beginning."""
        best = table.max(axis=1)
        order = np.argsort(-best)[:RIVALS]
        some = [int(i) for i in order if best[i] > max(HOPEFUL * best[order[0]], LEADS)]
        return [Member(i, since[self._best(since, table[i])[0]].t) for i in some]

    def _decide(self, hopeful: Sequence[Member]) -> list[str]:
        """Names the best suspect, each weighed beside a disturbance of its own, if it is sure."""
        first = self.accounts[0]
        level = max(self._likelihood(a, self._since(a), self.members) for a in self.accounts)
        weighed: dict[int, tuple[float, Member, Account]] = {}
        for member in hopeful:
            own = self.accounts[-1].branched()
            self._beside(own, (*self.members, member))
            found = [self._worth(account, member.suspect, level) for account in (first, own)]
            (nats, since), account = max(zip(found, (first, own), strict=True), key=lambda one: one[0][0])
            weighed[member.suspect] = (nats, Member(member.suspect, since), account)
        ranked = sorted(weighed, key=lambda i: -weighed[i][0])
        if not ranked or weighed[ranked[0]][0] < self.bound:
            self.undecided = ()
            return []
        nats, member, own = weighed[ranked[0]]
        close = tuple(self._label(i) for i in ranked[1:] if weighed[i][0] > nats - CLOSE / 2)
        if close:
            both = (self._label(ranked[0]), *close)
            if {*both} == {*self.undecided}:
                return []
            self.undecided = both
            return [
                f"t = {self.t:g} s: something is wrong, {moment_of(_time(member))} ({nats:.0f} nats); what it is "
                f"cannot be told yet, {', '.join(both)} explain it alike."
            ]
        self.undecided, self.patience = (), PATIENCE
        self.members = (*self.members, member)
        self.accounts = [own if own is not first else first.branched()]
        name = self._named(len(self.members) - 1, nats)
        self.named = (*self.named, name)
        values = ", ".join(f"{k} = {v:.3g} ± {s:.2g}" for k, (v, s, _) in name.parameters.items())
        self.table = self._weigh()[1].max(axis=1)
        return [
            f"t = {self.t:g} s: {name.label}, {moment_of(name.since)}: {values} ({nats:.0f} nats; named "
            f"from {self.bound:.0f})."
        ]

    def _worth(self, account: Account, suspect: int, level: float) -> tuple[float, float]:
        """A suspect's nats beside the disturbance of an account, and its beginning; `level`: of none."""
        since = self._since(account)
        nats = self._nats(account, since)[suspect]
        b, best = self._best(since, nats + self._likelihood(account, since, self.members) - level)
        return best, since[b].t

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
        return Name(suspect.label, _time(member), self.t, nats, parameters)

    # --- what it offers --------------------------------------------------------------------------

    @property
    def status(self) -> Status:
        """Where it stands now."""
        bench = self.bench
        if bench is None or not self.blocks:
            names = tuple(DOFS[i] for i in np.flatnonzero(self.vehicle.free))
            return Status(-np.inf, 0, None, names, (), (), {}, self.bound, self.named, (), ())
        force = self.accounts[0].force
        table = np.full(len(bench.layout.suspects), -np.inf) if self.table is None else self.table
        return Status(
            self.t,
            self.blocks,
            self.begun,
            tuple(DOFS[axis] for axis in bench.axes),
            tuple(np.asarray(force.size).tolist()),
            tuple(np.asarray(force.time).tolist()),
            {self._label(i): float(n) for i, n in enumerate(table) if np.isfinite(n)},
            self.bound,
            self.named,
            self.undecided,
            self.unseen,
        )

    @property
    def unseen(self) -> tuple[str, ...]:
        """Axes of which the rows tell less than the file does, and actuators whose strength they leave open.

        An axis: of each of its coefficients the rows alone say less than the file's prior. An actuator: the
        standard error of its gain, all else known, is beyond a tenth.
        """
        bench = self.bench
        if bench is None or not self.held:
            return ()
        h = np.diag(self._since(self.accounts[0])[0].h)
        told = {DOFS[c.place[0]] for c in bench.base if h[c.index] * c.prior**2 > 1.0}
        out = [DOFS[axis] for axis in bench.axes if DOFS[axis] not in told]
        for i, suspect in enumerate(bench.layout.suspects):
            if suspect.effect is ThrusterGain and suspect.target != "all":
                own = bench.layout.columns[i][:, 0]
                if h @ own**2 < TENTH**-2:
                    out.append(str(suspect.target))
        return tuple(out)

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


def _time(member: Member) -> float | None:
    """Since when [s], None: always."""
    return None if member.since == -np.inf else member.since


def _speeds(rows: Rows) -> np.ndarray:
    """The fastest that rows go on each axis [m/s, rad/s], 1 where that was not measured."""
    speeds = np.abs(rows.channels[:, 6:12])
    return np.where(np.isfinite(speeds).any(axis=0), np.nan_to_num(speeds).max(axis=0), 1.0)
