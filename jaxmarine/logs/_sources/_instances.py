"""ArduPilot's messages, of which several sensors, filters or senders may give one kind."""

from collections import defaultdict
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from ..._errors import InputError
from ._paths import FieldPath
from ._series import Series


class Origin(NamedTuple):
    """Who gave a message: a system and component of a network, and a number among its own kind."""

    sender: tuple[int, int] = (0, 0)
    instance: int | str | None = None


class Instances:
    """Samples of fields, collected message by message and apart by origin.

    `XKF1[1].VN` asks for instance 1, `XKF1.VN` for the first. Of several senders the busiest is taken.
    """

    def __init__(self, wanted: Collection[str], names: Collection[str], path: object):
        self._path = path
        self._paths = defaultdict(list)
        self._samples: dict[str, dict[Origin, list]] = {text: defaultdict(list) for text in wanted}
        for text in wanted:
            whole = FieldPath.parse(text, names, "message", path)
            first = whole.steps[0]["index"] if whole.steps else None
            steps = whole.steps if first is None else whole.steps[1:]
            self._paths[whole.head].append((whole._replace(steps=steps), first))
        self.heads = tuple(self._paths)
        self.notes: list[str] = []

    def take(self, head: str, origin: Origin, t: float, message: object) -> None:
        """Adds a message of time `t` [s]."""
        for field_path, _ in self._paths[head]:
            value = field_path.number(message, _fields, self._path)
            self._samples[field_path.text][origin].append((t, value))

    def series(self) -> dict[str, Series]:
        """The series of each path; `notes` then say which origin was taken where there was a choice."""
        found = {}
        for head, paths in self._paths.items():
            for field_path, instance in paths:
                origin = self._chosen(head, instance, self._samples[field_path.text])
                samples = self._samples[field_path.text][origin]
                found[field_path.text] = Series(*np.array(samples).reshape(-1, 2).T)
        self.notes = list(dict.fromkeys(self.notes))
        return found

    def _chosen(self, head: str, instance: str | None, samples: dict[Origin, list]) -> Origin:
        if not samples:
            raise InputError(f"{self._path}: message `{head}` is cut off; map another message for it.")
        count = defaultdict(int)
        for origin, taken in samples.items():
            count[origin.sender] += len(taken)
        sender = max(count, key=lambda one: (count[one], one))
        if len(count) > 1:
            self.notes.append(f"Message `{head}` comes from {len(count)} senders; {_said(sender)} is read.")
        own = sorted((one.instance for one in samples if one.sender == sender), key=str)
        if instance is None:
            if len(own) > 1:
                self.notes.append(
                    f"Message `{head}` has the instances {_listed(own)}; `{head}[{own[0]}]` is read."
                )
            return Origin(sender, own[0])
        fitting = [one for one in own if str(one) == instance]
        if not fitting:
            there = "has no instances" if own == [None] else f"has the instances {_listed(own)}"
            raise InputError(
                f"{self._path}: has no `{head}[{instance}]`, which the column map names; `{head}` {there}."
            )
        return Origin(sender, fitting[0])


def _fields(value: object) -> Collection[str]:
    return value if isinstance(value, dict) else getattr(value, "get_fieldnames", tuple)()


def _said(sender: tuple[int, int]) -> str:
    return f"system {sender[0]}, component {sender[1]}"


def _listed(instances: list) -> str:
    return ", ".join(str(one) for one in instances)
