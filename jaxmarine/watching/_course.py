"""Rows cut into blocks, each about the path that all before it lets one expect."""

import numpy as np
from jaxtyping import Float

from .._types import MOTION
from ..fitting import GAP, Windowed
from ._blocks import LONG, Begun, Bench, Rows
from ._evidence import Acting


class Course:
    """A stretch without a gap, and where the craft is expected in it.

    - `rows`: what a block needs of the past, and what is to come; `waiting`: behind them, not joined yet.
      `next`: where the next block begins in them.
    - `begun`: what is expected there, None: not known yet, and so as measured. `gap` [s]: to the block
      before. `within`: samples of this stretch in blocks so far; `trail`: position, quaternion and velocity
      that were expected at the last of them.
    - `speed` [m/s, rad/s]: the fastest that integration steps are made for, `split` of them per sample.
    """

    def __init__(self, bench: Bench):
        self.bench = bench
        self.speed, self.split = np.zeros(6), 1
        self.interrupt(LONG)

    def anew(self) -> "Course":
        """One of the same craft, at its beginning."""
        out = Course(self.bench)
        out.speed, out.split = self.speed, self.split
        return out

    def interrupt(self, gap: float) -> None:
        """Begins a new stretch; rows of the old one that fill no block are of no use."""
        self.rows: Rows | None = None
        self.waiting: list[Rows] = []
        self.next = int(np.ceil(self.bench.settling / self.bench.dt - 1e-9))
        self.begun: Begun | None = None
        self.gap, self.within = gap, 0
        self.trail = np.zeros((0, 13))

    def gap_before(self, row: Rows) -> float:
        """How long nothing came before a row [s], 0 if that is no gap."""
        if not self.waiting and self.rows is None:
            return 0.0
        last = self.waiting[-1] if self.waiting else self.rows
        assert last is not None
        gap = float(row.t[0] - last.t[-1])
        return gap if gap > GAP * self.bench.dt else 0.0

    def quicken(self, rows: Rows) -> None:
        """Steps for the speeds of some rows and half as much again, so that they seldom change."""
        speed = _speeds(rows)
        if (speed > self.speed).any():
            self.speed = np.maximum(self.speed, 1.5 * speed)
            self.split = self.bench.split(self.speed)

    def cut(self, about: Acting) -> tuple[Windowed, Rows] | None:
        """The next block, linear about what acts in it, and its rows; None where there are not enough yet.

        Where something begins to act within a block, that is told as two.
        """
        bench = self.bench
        ready = (0 if self.rows is None else len(self.rows)) + len(self.waiting)
        left = bench.steps - self.within % bench.steps
        if ready < self.next + left + 1:
            return None
        some = [] if self.rows is None else [self.rows]
        rows = Rows.joined(*some, *self.waiting)
        drop = max(0, self.next - bench.past)
        self.rows, self.waiting, self.next = rows.part(drop), [], self.next - drop
        t = self.rows.t[self.next : self.next + left]
        begins = np.searchsorted(t, [since - 1e-9 for since, _ in about.parts])
        count = int(begins[begins > 0].min(initial=left))
        # The row behind a block ends its last hold.
        end = self.next + count
        block = self.rows.part(self.next, end + 1)
        self.quicken(block.part(0, count))
        # Where a stretch begins any state is allowed, as after a window.
        joined = self.begun is not None and self.within % (bench.whole * bench.steps) > 0
        rows, z = self.rows.part(0, end + 1), about.at(t[0])
        window = bench.window(rows, count, self.begun, self.gap, joined, self.split, z, self.trail)
        return window, block

    def go_to(
        self, past: list[Rows], begun: Begun, states: Float[np.ndarray, "samples 13"], within: int
    ) -> None:
        """Behind some rows, where so much is expected, and so many samples of a stretch are in blocks.

        - `states`: at those of them that are at hand.
        """
        self.waiting, self.next, self.within = past, len(past), within
        self.begun, self.gap, self.trail = begun, 0.0, states[-self.bench.past :]

    def go_on(self, begun: Begun, states: Float[np.ndarray, "samples 13"]) -> None:
        """To the next block, where so much is expected, from one with such states."""
        self.begun, self.gap = begun, 0.0
        trail = np.concatenate([self.trail, states])
        self.trail = trail[max(0, len(trail) - self.bench.past) :]
        self.within, self.next = self.within + len(states), self.next + len(states)


def _speeds(rows: Rows) -> Float[np.ndarray, "6"]:
    """The fastest that rows go on each axis [m/s, rad/s], 1 where that was not measured."""
    speeds = np.abs(rows.channels[:, MOTION])
    return np.where(np.isfinite(speeds).any(axis=0), np.nan_to_num(speeds).max(axis=0), 1.0)
