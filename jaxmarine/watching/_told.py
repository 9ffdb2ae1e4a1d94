"""A watch in words."""

from ._watch import Status, moment_of


def sentence_of(status: Status) -> str:
    """Where a watch stands, in one sentence."""
    if not status.nats:
        return "Too little has come to say anything yet."
    if status.undecided:
        return f"Something is wrong: one of {', '.join(status.undecided)}; the rows do not tell which yet."
    if status.named:
        return "Named: " + "; ".join(f"{one.label} {moment_of(one.since)}" for one in status.named) + "."
    return "Nothing is named: the vehicle file and a disturbance explain what comes."
