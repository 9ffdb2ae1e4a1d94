"""Packages that an extra of jaxmarine brings: what is said where one is missing."""

import contextlib
from collections.abc import Iterator
from importlib import util

from ._errors import InputError


class MissingExtra(InputError, ImportError):
    """A package is not installed that only a part of jaxmarine needs."""


@contextlib.contextmanager
def of_extra(extra: str, what: str) -> Iterator[None]:
    """Imports of what an extra brings; where one is missing, one sentence names the extra.

    - `what`: needs it, and begins the sentence.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise _missing(str(error.name).partition(".")[0], extra, what) from error


def need(packages: tuple[str, ...], extra: str, what: str) -> None:
    """Raises the same sentence where one of the packages is missing, without an import."""
    for package in packages:
        if util.find_spec(package) is None:
            raise _missing(package, extra, what)


def _missing(package: str, extra: str, what: str) -> MissingExtra:
    return MissingExtra(
        f"{what} needs the package {package}, which is not installed; run `pip install 'jaxmarine[{extra}]'`."
    )
