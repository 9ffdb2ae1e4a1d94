"""Sentences on logs: each says which log it is of, and those that repeat from log to log become one."""

from collections.abc import Iterable, Sequence
from typing import Any

# Names that are all listed; of more of them the first ones stand for the rest.
LISTED, FIRST = 12, 3


class Note(str):
    """A sentence on one log, or on one of its channels, that can be told of several at once.

    It reads as `one`. Several with the same `many` are told by that: `{places}` in it becomes the channels
    with their logs, `{logs}` the logs, and a number that differs between them its range.
    """

    log: str
    channel: str
    many: str
    numbers: dict[str, float | int]

    @classmethod
    def of(cls, log: str, one: str, many: str, channel: str = "", **numbers: float | int) -> "Note":
        """The note; `one` and `many` name `numbers` as `str.format` does."""
        out = cls(one.format(log=log, channel=f"`{channel}`", **numbers))
        out.log, out.channel, out.many, out.numbers = log, channel, many, numbers
        return out

    @classmethod
    def on(cls, log: str, sentence: str) -> "Note":
        """A sentence that does not name its log itself."""
        out = cls(sentence)
        out.log, out.channel, out.numbers = log, "", {}
        out.many = "{logs}: " + sentence.replace("{", "{{").replace("}", "}}")
        return out

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (str(self), self.log, self.channel, self.many, self.numbers)


def _restored(text: str, log: str, channel: str, many: str, numbers: dict[str, float | int]) -> Note:
    out = Note(text)
    out.log, out.channel, out.many, out.numbers = log, channel, many, numbers
    return out


def merged(notes: Iterable[str]) -> tuple[str, ...]:
    """Each sentence once, in the order in which they first come; what repeats over logs or channels as one.

    Every sentence that is a `Note` names its logs; others stay as they are.
    """
    groups: dict[str, dict[tuple[str, str], str]] = {}
    for note in notes:
        # The same sentence may be said of two logs.
        kind, log = (note.many, note.log) if isinstance(note, Note) else (note, "")
        groups.setdefault(kind, {})[str(note), log] = note
    return tuple(_together(list(group.values())) for group in groups.values())


def _together(group: Sequence[str]) -> str:
    first = group[0]
    if not isinstance(first, Note):
        return first
    notes = [note for note in group if isinstance(note, Note)]
    if len(notes) == 1 and first.log in first:
        return str(first)
    spread = {name: Range(*(note.numbers[name] for note in notes)) for name in first.numbers}
    logs = together(tuple(dict.fromkeys(note.log for note in notes)))
    return first.many.format(places=_places(notes), logs=logs, **spread)


class Range:
    """Numbers that a format shows as one where they look alike, else as the range that they span."""

    def __init__(self, *numbers: float | int):
        self.numbers = numbers

    def __format__(self, spec: str) -> str:
        ends = dict.fromkeys(format(number, spec) for number in (min(self.numbers), max(self.numbers)))
        return " to ".join(ends)


def _places(notes: Sequence[Note]) -> str:
    """Channels with their logs: `x`, `y` of two.csv; those of the same logs together."""
    logs_of: dict[str, tuple[str, ...]] = {}
    for note in notes:
        logs_of[note.channel] = (*logs_of.get(note.channel, ()), note.log)
    channels_of: dict[tuple[str, ...], list[str]] = {}
    for channel, logs in logs_of.items():
        channels_of.setdefault(logs, []).append(f"`{channel}`")
    return " and ".join(
        f"{', '.join(channels)} of {together(logs)}" for logs, channels in channels_of.items()
    )


def together(names: Sequence[str]) -> str:
    """`a.csv`, `a.csv and b.csv`, `11 logs (a.csv, ...)`."""
    if len(names) < 3:
        return " and ".join(names)
    shown = names if len(names) <= LISTED else (*names[:FIRST], "...", names[-1])
    return f"{len(names)} logs ({', '.join(shown)})"


def moment(t: float, clock: float, spec: str = ".6g") -> str:
    """A time of a log in words: since the log's start, with the log's own clock beside it.

    - `t`: by the log's own clock [s]; `clock`: what that shows at the log's start (`Log.clock`), 0 where
      both are the same.
    """
    return f"{t - clock:{spec}} s (t = {t:.1f} s)" if clock else f"t = {t:{spec}} s"
