"""What a model is worth by the rows at hand, told once more as blocks that are linear about itself."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..diagnosis import Layout
from ..effects import ExchangedThrusters
from ..fitting import misconnected
from ..vehicle import Placed
from ._evidence import Member
from ._ledger import Account
from ._passage import Passage
from ._swell import in_step

# Times at most that rows are told about one model. A parameter that moves by less than its standard error is
# where its slopes are the same; one that still moves after that is judged where it has come to.
TIMES = 6
# Pairs of columns that are told anew, each as if it were exchanged: as many as there are starts.
FEW = 10


class Told(NamedTuple):
    """The rows at hand beside some members, linear about them as they were found, and what went before.

    - `level`: logarithm of their likelihood, but for a constant that all models of these rows share; the
      numbers of the disturbance are paid for.
    """

    passage: Passage
    members: tuple[Member, ...]
    known: Float[np.ndarray, " known"]
    level: float

    @property
    def account(self) -> Account:
        return self.passage.ledger.accounts[0]

    @property
    def at_hand(self) -> float:
        """The same by the rows at hand alone, with the known numbers as they are."""
        ledger = self.passage.ledger
        return ledger.at_hand(self.account, self.known, self.members) - ledger.price(self.account.force)


def tell(
    passage: Passage,
    members: Sequence[Member],
    known: Float[np.ndarray, " known"],
    account: Account,
    since: float = -np.inf,
) -> Told | None:
    """Tells the rows at hand about members with known numbers, estimates these, and so on until they stay.

    The file's own coefficients stay where they are, as they are near enough. None where the craft runs away,
    or where no craft can have a member, so estimated.

    - `since`: as of `Passage.again`.
    """
    told: Told | None = None
    for _ in range(TIMES):
        before, told = known, promised(passage, members, known, account, since)
        if told is None:
            return None
        told = suited(told, before)
        members, known, account = told.members, told.known, told.account
        sums, suspicions = told.passage.ledger.since(account), told.passage.ledger.suspicions
        moved = np.abs(known - before) > suspicions.errors(sums, members)
        if not moved[len(suspicions.base) :].any():
            break
    return told if told is not None and possible(told) else None


def promised(
    passage: Passage,
    members: Sequence[Member],
    known: Float[np.ndarray, " known"],
    account: Account,
    since: float = -np.inf,
    cuts: Sequence[float] = (),
) -> Told | None:
    """Tells the rows at hand once about members with known numbers, beside the disturbance of an account.

    What the slopes there promise; None where the craft runs away.

    - `since`, `cuts`: as of `Passage.again`.
    """
    again = passage.again(known, members, account, since, cuts)
    if again is None:
        return None
    return estimated(Told(again, tuple(members), known, -np.inf), known)


def suited(told: Told, before: Float[np.ndarray, " known"]) -> Told:
    """With the disturbance that suits its members, which its account takes, and estimated beside that.

    - `before`: the numbers about which its blocks are linear.
    """
    told.passage.ledger.estimate(told.account, told.members)
    return estimated(told, before)


def estimated(told: Told, before: Float[np.ndarray, " known"]) -> Told:
    """With its members' numbers, and its level, as estimated from its blocks, linear about those before."""
    ledger, account, members = told.passage.ledger, told.account, told.members
    since, middle = ledger.since(account), 0.5 * (ledger.begun_at[0] + ledger.t)
    known = ledger.suspicions.estimate(since, members)
    known = in_step(ledger.suspicions, ledger.bench.layout, members, before, known, middle)
    level = ledger.likelihood(account, since, members) - ledger.price(account.force)
    return told._replace(known=known, level=level)


def possible(told: Told) -> bool:
    """Whether each member is in its effect's range, and such as a craft can have."""
    return told.passage.ledger.sound(told.known, told.members)


def exchanged(passage: Passage) -> list[Placed]:
    """Columns of commands that may be exchanged: each pair of few, of many those that rows answer so."""
    if ExchangedThrusters not in passage.bench.catalogue or not passage.rows.commands.any():
        return []
    pairs = [one.target for one in ExchangedThrusters.suspects(passage.bench.vehicle)]
    if len(pairs) > FEW:
        return answered_otherwise(passage)
    return [Placed(ExchangedThrusters(), pair) for pair in pairs]


def answered_otherwise(passage: Passage) -> list[Placed]:
    """Columns of commands that are exchanged by the signs of what the craft answers in the rows at hand."""
    rows, vehicle = passage.rows.driven(passage.columns), passage.bench.vehicle
    if ExchangedThrusters not in passage.bench.catalogue or not rows.commands.any():
        return []
    wrong = misconnected(vehicle, [rows.log(vehicle, True, "rows")])
    causes = (cause for one in wrong for cause in (*one.causes, *one.instead))
    return [cause for cause in causes if isinstance(cause.effect, ExchangedThrusters)]


def starts(layout: Layout, suspect: int) -> Iterator[Float[np.ndarray, " z"]]:
    """Parameters from which a suspect without a useful slope at neutral has one."""
    slots = layout.suspects[suspect].slots
    for start in layout.suspects[suspect].starts:
        yield np.array([start[name] for name in slots]) - layout.neutral_of(suspect)
