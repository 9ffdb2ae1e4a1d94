"""What was found on the way and does not stand in the answer, with a sentence that says why."""

from ._explanation import Model
from ._result import Dropped
from ._workbench import Workbench

SHARPER = "With sensors as exact as what was found leaves them it was not found again."
NEEDLESS = "Beside what else was found it explains too little of the training logs."
SENSELESS = "Beside what else was found its numbers, or the vehicle's, mean nothing."
REPLACED = "Another cause explains the training logs better in its place, now that the others are known."
HARMFUL = "The model predicts the training log better over 5 s without it."
STOOD_IN = "It only stood in for a force that depends on signals and has no name."
UNNAMED = "Forces without a name that depend on signals make the training logs likelier than what was named."
WORSE = "What was named predicts the training log worse over 5 s than the vehicle file."
SPOILT = "With it what was named is of no use on the test logs."
USELESS = "What was named buys nothing on the test logs."


def gone(bench: Workbench, before: Model, after: Model, reason: str) -> tuple[Dropped, ...]:
    """The members of a model that another one lacks, and why."""
    left = {member.suspect for member in after.members}
    return tuple(
        Dropped(bench.layout.suspects[member.suspect].label, reason)
        for member in before.members
        if member.suspect not in left
    )


def needless(bench: Workbench, before: Model, after: Model) -> tuple[Dropped, ...]:
    """What pruning took out."""
    return gone(bench, before, after, NEEDLESS if bench.sound(before) else SENSELESS)
