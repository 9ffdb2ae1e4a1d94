"""Paths into messages: `TOPIC.field.field`, `[2]` for an entry, `[name=port]` for the entry of that name."""

import array
import re
from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np

from ..._errors import InputError
from ..._files import did_you_mean

_STEP = re.compile(r"\.(?P<field>\w+)|\[(?P<index>\d{1,9})\]|\[(?P<key>\w+(\.\w+)*)=(?P<value>[^\[\]]+)\]")
_ARRAYS = (list, tuple, array.array, np.ndarray)

# The names of a message's fields, which are its attributes or a dictionary's keys; none if it is no message.
Fields = Callable[[object], Collection[str]]


class FieldPath(NamedTuple):
    """A path into the messages called `head`, as the map has it in `text`."""

    text: str
    head: str
    steps: tuple[re.Match[str], ...]

    @staticmethod
    def parse(text: str, heads: Collection[str], kind: str, path: object) -> "FieldPath":
        """Splits a path at the longest of the file's `heads` that it begins with.

        - `kind`: what a head is called, "topic" or "message"; `path`: the file, for sentences.
        """
        fitting = [
            head for head in heads if text.startswith(head) and text[len(head) :][:1] in ("", ".", "[")
        ]
        if not fitting:
            head = re.split(r"[.\[]", text, maxsplit=1)[0]
            raise InputError(
                f"{path}: has no {kind} `{head}`, which the column map names; {did_you_mean(head, heads)}"
            )
        head = max(fitting, key=len)
        steps, at = [], len(head)
        while step := _STEP.match(text, at):
            steps.append(step)
            at = step.end()
        if at < len(text):
            raise InputError(
                f"{path}: `{text}` is no path from `{text[at:]}` on; write {kind}.field.field, with [0] or "
                "[name=port] behind an array."
            )
        return FieldPath(text, head, tuple(steps))

    def number(self, message: object, fields: Fields, path: object) -> float:
        """The number there; NaN where an array has no such entry."""
        here, owner = message, message
        for step in self.steps:
            name, index, key = step["field"], step["index"], step["key"]
            if name is not None:
                if name not in fields(here):
                    raise InputError(
                        f"{path}: `{self.text}` leads nowhere: {self._dead_end(step, here, fields)}"
                    )
                owner, here = here, _child(here, name)
                continue
            if not isinstance(here, _ARRAYS):
                raise InputError(f"{path}: `{self.text}` leads nowhere: {step[0]} stands behind no array.")
            entry = int(index) if key is None else _entry(here, owner, key, step["value"], fields)
            if entry is None or entry >= len(here):
                return np.nan
            owner, here = here, here[entry]
        if isinstance(here, int | float | np.integer | np.floating) and not isinstance(here, bool):
            return float(here)
        raise InputError(f"{path}: `{self.text}` is no number but {_described(here, fields)}")

    def _dead_end(self, step: re.Match[str], here: object, fields: Fields) -> str:
        known = fields(here)
        if not known:
            return f"there are no fields below `{self.text[: step.start()]}`."
        return f"there is no field `{step['field']}`; {did_you_mean(step['field'], known)}"


def _entry(entries: object, owner: object, key: str, value: str, fields: Fields) -> int | None:
    """Where an array's entry has `key` equal to `value`, or where the array `key` beside it has.

    The first is how transforms are named, the second how joints are.
    """
    assert isinstance(entries, _ARRAYS)
    first, _, rest = key.partition(".")
    for index, entry in enumerate(entries):
        if first in fields(entry):
            named: object = entry
            for part in key.split("."):
                named = _child(named, part) if part in fields(named) else None
        elif not rest and first in fields(owner):
            beside = _child(owner, first)
            named = beside[index] if isinstance(beside, _ARRAYS) and index < len(beside) else None
        else:
            return None
        if str(named) == value:
            return index
    return None


def _child(message: object, name: str) -> object:
    return message[name] if isinstance(message, dict) else getattr(message, name)


def _described(value: object, fields: Fields) -> str:
    if fields(value):
        return f"a message with the fields {', '.join(list(fields(value))[:20])}; name one of them."
    if isinstance(value, _ARRAYS):
        return f"an array of {len(value)}; name an entry, the first by [0]."
    return f"{str(value)[:40]!r}; map a field that is one."
