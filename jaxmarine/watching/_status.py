"""Where a watch stands, as numbers and in words."""

import dataclasses
from collections.abc import Mapping

from ..disturbances import RandomWrench
from ._blocks import Begun


@dataclasses.dataclass(frozen=True)
class Name:
    """A cause that is named: the suspect, since when (t of the log [s], None: as long as it is watched).

    - `at`: when it was named [s]; `nats`: its evidence then; `parameters`: value, standard error, unit.
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
    - `state`: of the craft, and what disturbs it now on each of `axes`; `disturbance`: of which kind that is,
      as estimated.
    - `nats`: of each suspect, at its best beginning; `bound`: from which on one is named.
    - `named`; `undecided`: causes of which one is at work, and the rows do not tell which.
    - `unseen`: axes and actuators of which too little was seen to tell what the file says of them.
    """

    t: float
    blocks: int
    state: Begun | None
    axes: tuple[str, ...]
    disturbance: RandomWrench
    nats: Mapping[str, float]
    bound: float
    named: tuple[Name, ...]
    undecided: tuple[str, ...]
    unseen: tuple[str, ...]


def moment_of(since: float | None) -> str:
    """Since when, in words."""
    return "for as long as it is watched" if since is None else f"since t = {since:g} s"


def sentence_of(status: Status) -> str:
    """Where a watch stands, in one sentence."""
    if not status.nats:
        return "Too little has come to say anything yet."
    if status.undecided:
        return f"Something is wrong: one of {', '.join(status.undecided)}; the rows do not tell which yet."
    if status.named:
        return "Named: " + "; ".join(f"{one.label} {moment_of(one.since)}" for one in status.named) + "."
    return "Nothing is named: the vehicle file and a disturbance explain what comes."
