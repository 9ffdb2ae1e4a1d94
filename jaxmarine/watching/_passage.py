"""Rows on their way to the ledger, the last minute or two of which can be told once more.

Blocks that are linear about the file tell badly of a craft that is far from it. So rows are kept as long as
their blocks are held, and once something is named they go the same way again, linear about that.
"""

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int

from ..effects import ExchangedThrusters
from ..vehicle import Placed
from ._blocks import LONG, Bench, Place, Rows
from ._course import Course
from ._evidence import Member
from ._ledger import CHUNK, SPARE, Account, Ledger


class Passage:
    """Cuts rows into blocks and tells them to the ledger.

    - `recent`: rows of the blocks that may be held, behind those in which actuators settle; of each whether
      a clock was set back. `columns`: of each command that which is said to be another's.
    """

    def __init__(self, course: Course, ledger: Ledger, columns: Int[np.ndarray, " columns"]):
        self.bench, self.columns = ledger.bench, columns
        self.course, self.ledger = course, ledger
        # The last block needs another row behind it.
        most = course.next + (2 * CHUNK - SPARE) * self.bench.steps + 1
        self.recent = deque[tuple[Rows, bool]](maxlen=most)

    @classmethod
    def of(cls, bench: Bench) -> "Passage":
        """Before the first row."""
        return cls(Course(bench), Ledger(bench), np.arange(len(bench.vehicle.command_names)))

    def take(self, one: Rows, set_back: bool) -> Iterator[str | None]:
        """Takes a row; each thing there is to say, and None for each block that was told."""
        self.recent.append((one, set_back))
        gap = LONG if set_back else self.course.gap_before(one)
        if gap:
            self.course.interrupt(gap)
        if gap and not set_back:
            t = float(one.t[0])
            yield f"Nothing came from t = {t - gap:g} to {t:g} s; motion begins anew there, evidence is kept."
        self.course.waiting.append(one.driven(self.columns))
        while (block := self.course.cut(self.ledger.about)) is not None:
            window, rows = block
            seen = int(np.isfinite(rows.channels[:-1, list(self.bench.channels)]).sum())
            begins, ends = float(rows.t[0]), float(rows.t[-1])
            place = Place(begins, ends, seen, len(rows) - 1, self.course.within)
            begun = self.ledger.add(window, place)
            if begun is None:
                self.course.interrupt(LONG)
                yield f"The craft runs away from what is expected at t = {rows.t[0]:g} s; motion begins anew."
            else:
                self.course.go_on(begun, np.asarray(window.states)[: len(rows) - 1])
                yield None

    @property
    def rows(self) -> Rows:
        """Those that are kept, as they came."""
        return Rows.joined(*(one for one, _ in self.recent))

    def exchanged(self, cause: Placed) -> "Passage":
        """The same rows with two columns exchanged, to be told again before anything else."""
        columns = ExchangedThrusters.columns_of(str(cause.target), self.bench.vehicle.command_names)
        out = Passage(self.course.anew(), self.ledger, self.columns[columns])
        out.recent = self.recent
        return out

    def again(
        self,
        known: Float[np.ndarray, " known"],
        members: Sequence[Member],
        account: Account,
        since: float = -np.inf,
        cuts: Sequence[float] = (),
    ) -> "Passage | None":
        """The rows of the blocks that are held told once more, linear about members with known numbers.

        Beside the disturbance of an account; what older rows said stays. None where the craft runs away from
        what is expected, or where there are more blocks than can be held, as some were lost before.

        - `since` [s]: blocks that end before that stay as they are, as nothing acts otherwise there. Only
          where this passage was told again itself.
        - `cuts` [s]: samples with which a block shall begin, besides those with which members do.
        """
        first = self.ledger.block_of(since)
        out = Passage(self.course.anew(), self.ledger.anew(known, members, account, first), self.columns)
        out.ledger.about = out.ledger.about.cut(cuts)
        begins = self.ledger.begun_at[0] - (out.course.next + 0.5) * self.bench.dt
        rows = [(one, set_back) for one, set_back in self.recent if one.t[0] > begins]
        # Blocks and windows begin where they did.
        out.course.within = int(self.ledger.within[0])
        if first:
            out._skip(self.ledger, first, rows)
        # Numbers of a craft that runs away overflow before it is seen to.
        with np.errstate(over="ignore", invalid="ignore"):
            for one, set_back in rows[len(out.recent) :]:
                for _ in out.take(one, set_back):
                    if out.ledger.lost or not out.ledger.room:
                        return None
        return out

    def _skip(self, told: Ledger, first: int, rows: Sequence[tuple[Rows, bool]]) -> None:
        """Goes on from a block that was told, behind those that the ledger holds of these rows.

        Its first block is the first of a stretch, and none was lost, as in what was told again.
        """
        assert told.windows.gap[0] and not told.lost
        # The last one of its time, as a clock that was set back goes on from the time before.
        here = int(np.searchsorted([one.t[0] for one, _ in rows], told.begun_at[first], side="right")) - 1
        if told.windows.gap[first]:
            self.course.interrupt(float(told.windows.gap[first]))
            self.recent.extend(rows[: here - self.course.next])
            return
        stretch = slice(int(np.flatnonzero(np.asarray(told.windows.gap[:first])).max()), first)
        states = told.states(stretch)
        count = min(self.course.next + len(states), self.bench.past)
        past = rows[max(here - count, 0) : here]
        driven, within = [one.driven(self.columns) for one, _ in past], int(told.within[first])
        self.course.go_to(driven, self.ledger.begun(), states, within)
        self.recent.extend(rows[:here])

    def adopt(self, other: "Passage") -> None:
        """Goes on as another one that was told the same rows."""
        self.columns, self.recent = other.columns, other.recent
        self.course, self.ledger = other.course, other.ledger
