"""What a source of rows is."""

from collections.abc import Mapping
from typing import Protocol

Row = Mapping[str, float]


class Source(Protocol):
    """Rows as they come. Each kind is one class with these members.

    - `name`: how sentences begin; `told`: what there is to say, sentence by sentence; the reader empties it.
    - `place`: where to go on after a restart, None where what was sent meanwhile is lost.
    """

    name: str
    told: list[str]

    @property
    def place(self) -> int | None: ...

    def go_on(self, place: int) -> None:
        """Continues from a place that it had before."""
        ...

    def take(self, wait: float) -> list[Row] | None:
        """Rows that have come, after at most `wait` [s]; []: none yet, None: there will be none."""
        ...

    def close(self) -> None:
        """Lets go of what it reads from."""
        ...
