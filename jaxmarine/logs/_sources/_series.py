"""What a recording of messages gives: numbers, each series with its own times."""

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ..._errors import InputError


class Series(NamedTuple):
    """Samples of one quantity: times [s], increasing, and finite values."""

    t: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, " samples"]


@runtime_checkable
class Recording(Protocol):
    """A file of messages. Each format is one class with these members.

    - `names`: the topics or kinds of message in it.
    - `notes`: what there is to say of the last `read`, sentence by sentence.
    """

    names: tuple[str, ...]
    notes: list[str]

    def read(self, wanted: Collection[str]) -> dict[str, Series]:
        """The series at some paths, `TOPIC.field.field[0]`; times [s] on one clock, in the file's order.

        Raises `InputError` where a path leads nowhere or to no number.
        """
        ...


@contextlib.contextmanager
def reading(path: Path, kind: str, advice: str) -> Iterator[None]:
    """Turns whatever a library raises on a file into one sentence.

    - `kind`: what the file should be, with its article; `advice`: what to do if it is not.
    """
    try:
        yield
    except InputError:
        raise
    except ImportError as error:
        raise InputError(
            f"{path}: needs the library {error.name or error}, which is not installed; run "
            "`pip install 'jaxmarine[bags]'`."
        ) from error
    except Exception as error:
        # Parsers of foreign bytes fail in every way there is: struct, assertion, key, unicode, memory.
        reason = " ".join(str(error).split())[:160].rstrip(".") or type(error).__name__
        raise InputError(f"{path}: cannot be read as {kind} ({reason}); {advice}.") from error
