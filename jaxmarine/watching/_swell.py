"""A swell that may be a regular wave: from where a suspect that swings is told.

A sine of time has no slope by its period and phase where it is none, and a disturbance takes it for a swell
as soon as the rows tell one. What that is expected to do when they end is a wave with its period, forces and
phase, and they say whether it keeps in step as a wave does.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..diagnosis import in_phase
from ._anew import Told
from ._blocks import swell

# By how many turns more over the rows at hand than the swell's period says: its phase, which is that of the
# end, is nowhere off by more than a sixth of a turn then if the period is by no more than five.
SLIPS = (0.0, 1 / 3, -1 / 3, 2 / 3, -2 / 3)


def waves(told: Told, suspect: int) -> Iterator[Float[np.ndarray, " z"]]:
    """Parameters of a suspect that swings, as the swell beside which rows were told; none without one."""
    passage, account, force = told.passage, told.account, told.account.force
    ledger, begun = passage.ledger, passage.course.begun
    if not force.swells or begun is None:
        return
    z = ledger.suspicions.acting(told.known, told.members).at(ledger.t)
    here, there = np.zeros((2, 6))
    here[list(force.axes)], there[list(force.axes)] = swell(account.message, force, z)
    turn = Rotation.from_quat(begun.attitude, scalar_first=True)
    towards, across = turn.apply(here[:3])[:2], turn.apply(there[:3])[:2]
    frequency = float(force.frequency[len(force.axes)]) / (2 * np.pi)
    layout, span = ledger.bench.layout, ledger.t - float(ledger.begun_at[0])
    for turns in SLIPS:
        period = 1 / (frequency + turns / span)
        if period > 0:
            angle = 2 * np.pi * ledger.t / period
            sine = np.sin(angle) * towards - np.cos(angle) * across
            cosine = np.cos(angle) * towards + np.sin(angle) * across
            start = in_phase(np.stack([sine, cosine], axis=1), period)
            yield np.array([start[name] for name in layout.suspects[suspect].slots]) - layout.neutral_of(
                suspect
            )
