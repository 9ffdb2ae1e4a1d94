"""A swell that may be a regular wave: from where a suspect that swings is told.

A sine of time has no slope by its period and phase where it is none, and a disturbance takes it for a swell
as soon as the rows tell one. What that is expected to do when they end is a wave with its period, forces and
phase, and they say whether it keeps in step as a wave does.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..diagnosis import Layout, in_phase
from ..fitting import Disturbance
from ._blocks import swelling
from ._evidence import Member, Suspicions
from ._ledger import Account
from ._passage import Passage

# By how many turns more over the rows at hand than the swell's period says. Where that is off by no more than
# 5/6 of a turn over these, one of them is off by no more than a sixth.
SLIPS = (0.0, 1 / 3, -1 / 3, 2 / 3, -2 / 3)


def waves(
    passage: Passage,
    account: Account,
    known: Float[np.ndarray, " known"],
    members: Sequence[Member],
    suspect: int,
) -> Iterator[Float[np.ndarray, " z"]]:
    """Parameters of a suspect that swings, as the swell of an account; none without one.

    Where the passage ends, beside members with known numbers.
    """
    ledger, begun, force = passage.ledger, passage.course.begun, account.force
    if force.swell is None or begun is None:
        return
    z = ledger.suspicions.acting(known, members).at(ledger.t)
    here, there = np.zeros((2, 6))
    here[list(force.axes)], there[list(force.axes)] = swelling(account.message, force, z).T
    turn = Rotation.from_quat(begun.attitude, scalar_first=True)
    towards, across = turn.apply(here[:3])[:2], turn.apply(there[:3])[:2]
    frequency = float(force.swell.frequency) / (2 * np.pi)
    layout, span = ledger.bench.layout, ledger.t - float(ledger.begun_at[0])
    slots, neutral = layout.suspects[suspect].slots, layout.neutral_of(suspect)
    for turns in SLIPS:
        now = frequency + turns / span
        if now > 0:
            angle = 2 * np.pi * ledger.t * now
            sine = np.sin(angle) * towards - np.cos(angle) * across
            cosine = np.cos(angle) * towards + np.sin(angle) * across
            start = in_phase(np.stack([sine, cosine], axis=1), 1 / now)
            yield np.array([start[name] for name in slots]) - neutral


def in_step(
    suspicions: Suspicions,
    layout: Layout,
    members: Sequence[Member],
    before: Float[np.ndarray, " known"],
    known: Float[np.ndarray, " known"],
    t: float,
) -> Float[np.ndarray, " known"]:
    """Known numbers in which what swings has, at a time [s], the phase to which slopes `before` led.

    A phase is that of t = 0, and hours later a period that is a little other turns it as slopes do not show.
    """
    out, at = known.copy(), len(suspicions.base)
    for member in members:
        suspect = layout.suspects[member.suspect]
        if suspect.effect.swings:
            period, phase = (at + list(suspect.slots).index(name) for name in ("period", "phase"))
            old = before[period] + layout.neutral_of(member.suspect)[period - at]
            moved = known[period] - before[period]
            if old + moved > 0:
                out[phase] += 2 * np.pi * t * (1 / old - moved / old**2 - 1 / (old + moved))
        at += suspicions.columns[member.suspect].shape[1]
    return out


def stilled(before: Disturbance, after: Disturbance) -> bool:
    """Whether a wave takes most of the swell's energy in the plane: else it is a part of what keeps no step.

    One direction and phase for both axes can be likelier than a swell's own for each, which the groups of an
    irregular sea have as well. `before`, `after`: what disturbs without it and beside it.
    """
    return _energy(after) < 0.5 * _energy(before)


def _energy(force: Disturbance) -> float:
    """Variance of a swell's forces ahead and abeam [N^2]."""
    size = force.size[force.parts.swell] if force.swells else np.zeros(len(force.axes))
    return sum(float(one) ** 2 for one, axis in zip(size, force.axes, strict=True) if axis < 2)
