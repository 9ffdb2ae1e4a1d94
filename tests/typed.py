"""The checker of types that jaxtyping applies in tests: beartype, wherever it can."""

from collections.abc import Callable
from typing import Any

from beartype import beartype
from beartype.roar import BeartypeDecorHintException


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Checked at every call, and as it is where its hints have a meaning in their class alone (`Self`)."""
    try:
        return beartype(function)
    except BeartypeDecorHintException:
        return function
