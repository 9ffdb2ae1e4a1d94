"""How long work says what it does: a function that is called with a few words at each stage."""

from collections.abc import Callable

Progress = Callable[[str], None]

# How words begin that say what was found, before anything is settled.
FOUND = "found "


def silent(text: str) -> None:
    """Says nothing."""
    del text
