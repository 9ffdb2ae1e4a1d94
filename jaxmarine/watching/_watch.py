"""A craft that is watched: rows go in, and what is wrong, since when, comes out.

rows -> passage: course -> ledger -> judge
                 (blocks)  (filter)  (names)
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from .._precision import need_double
from .._types import DOFS
from ..diagnosis import known
from ..disturbances import RandomWrench
from ..effects import CATALOGUE, AbstractEffect, ThrusterGain, place
from ..vehicle import Placed, Vehicle
from ._blocks import Bench, Rows
from ._judge import Judge
from ._passage import Passage
from ._rows import Intake
from ._status import Name, Status

# False names per day unless it is said otherwise: one in a hundred days.
FALSE_ALARMS = 0.01
# Rows by which sample time and noise are told first, and how long they last [s]: twice a window.
FEW, BRIEF = 40, 8.0
# Standard error of an actuator's gain beyond which it counts as not excited.
TENTH = 0.1
# Sentences that are remembered.
MOST_TOLD = 200


class Parts(NamedTuple):
    """What there is once the rows have told their sample time and noise."""

    passage: Passage
    judge: Judge


class Watch:
    """Watches a craft by its vehicle file; `update` takes one row after another.

    - `false_alarms`: false names per day that are allowed for; 0: nothing is named, and evidence grows. They
      are no more as far as Gauss-Markov wrenches, a swell and a current are what disturbs the craft.
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
        self.opening: list[Rows] = []
        self.parts: Parts | None = None
        self.told: list[str] = []

    # --- rows ------------------------------------------------------------------------------------

    @threadpool_limits.wrap(limits=1, user_api="blas")
    def update(self, row: Mapping[str, float]) -> list[str]:
        """Takes a row by the contract's column names (`t`, channels, commands); says what is new.

        Empty cells and NaN were not measured. Raises `InputError` where the rows cannot be this craft's.
        """
        one, set_back, told = self.intake.take(row)
        if one is not None and self.parts is not None:
            told += self._take(self.parts, one, set_back)
        elif one is not None:
            self.opening = [one] if set_back else [*self.opening, one]
            told += self._open()
        self.told = [*self.told, *told][-MOST_TOLD:]
        return told

    def _open(self) -> list[str]:
        """Sizes up the first rows once there are enough of them, and takes them."""
        if len(self.opening) < FEW or self.opening[-1].t[0] - self.opening[0].t[0] < BRIEF:
            return []
        rows = Rows.joined(*self.opening)
        assert self.intake.driven is not None
        log = rows.log(self.vehicle, self.intake.driven, "rows")
        parts = self.begin(Bench.of(self.vehicle, log, self.catalogue))
        parts.passage.course.quicken(rows)
        first, self.opening = self.opening, []
        return [said for one in first for said in self._take(parts, one, False)]

    def begin(self, bench: Bench) -> Parts:
        """With nothing known, on what stays the same from block to block."""
        passage = Passage.of(bench)
        self.parts = Parts(passage, Judge(passage, self.false_alarms))
        return self.parts

    def _take(self, parts: Parts, one: Rows, set_back: bool) -> list[str]:
        """Takes a row, and judges each block that it completes."""
        told = []
        for said in parts.passage.take(one, set_back):
            told += parts.judge.judge() if said is None else [said]
        return told

    # --- what it offers --------------------------------------------------------------------------

    @property
    def named(self) -> tuple[Name, ...]:
        """The causes that are named so far."""
        return () if self.parts is None else self.parts.judge.named

    @property
    def status(self) -> Status:
        """Where it stands now."""
        if self.parts is None or not self.parts.passage.ledger.blocks:
            names = tuple(DOFS[i] for i in self.vehicle.axes)
            none = RandomWrench(np.zeros(6), np.zeros(6))
            return Status(-np.inf, 0, None, names, none, {}, np.inf, (), (), ())
        (passage, judge), bench = self.parts, self.parts.passage.bench
        ledger = passage.ledger
        nats = () if judge.nats is None else judge.nats
        return Status(
            ledger.t,
            ledger.blocks,
            passage.course.begun,
            tuple(DOFS[axis] for axis in bench.axes),
            known(ledger.accounts[0].force),
            {judge.label(i): float(n) for i, n in enumerate(nats) if np.isfinite(n)},
            judge.bound,
            judge.named,
            judge.undecided,
            self.unseen,
        )

    @property
    def unseen(self) -> tuple[str, ...]:
        """Axes of which the rows tell less than the file does, and actuators whose strength they leave open.

        An axis: of each of its coefficients the rows alone say less than the file's prior. An actuator: the
        standard error of its gain, all else known, is beyond a tenth.
        """
        if self.parts is None:
            return ()
        bench, ledger = self.parts.passage.bench, self.parts.passage.ledger
        h = np.diag(ledger.since(ledger.accounts[0])[0].h)
        told = {DOFS[c.place[0]] for c in bench.base if h[c.index] * c.prior**2 > 1.0}
        out = [DOFS[axis] for axis in bench.axes if DOFS[axis] not in told]
        for suspect, columns in zip(bench.layout.suspects, bench.layout.columns, strict=True):
            own_gain = suspect.effect is ThrusterGain and suspect.target != "all"
            if own_gain and h @ columns[:, 0] ** 2 < TENTH**-2:
                out.append(str(suspect.target))
        return tuple(out)

    @property
    def extended(self) -> Vehicle:
        """The vehicle with what is named in it, acting from now on."""
        if self.parts is None:
            return self.vehicle
        (passage, judge), placed = self.parts, []
        for i, member in enumerate(judge.members):
            suspect = passage.bench.layout.suspects[member.suspect]
            values = {name: value for name, (value, _, _) in judge.parameters(i).items()}
            placed.append(Placed(place(suspect, self.vehicle, values), suspect.target))
        return self.vehicle.place(*judge.exchanged, *placed)
