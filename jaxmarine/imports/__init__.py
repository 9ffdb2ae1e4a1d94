"""Vehicle files from what people have: one module per format, with two names.

- `SUFFIXES`: of its files.
- `read(path)`: the tables of a vehicle file, and what was left out or taken for granted, a sentence each.

A further format is one more such module in this folder.
"""

import os
import pkgutil
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from .._errors import InputError
from .._files import file_to_hold, validated
from ..vehicle_file import VehicleFile, write_vehicle_file

_FORMATS = tuple(one.name for one in pkgutil.iter_modules(__path__) if not one.name.startswith("_"))
# A description of one vehicle is text that people wrote.
_MOST_BYTES = 10_000_000


class Format(Protocol):
    """What each of the modules has."""

    SUFFIXES: tuple[str, ...]

    def read(self, path: Path) -> tuple[dict[str, Any], tuple[str, ...]]: ...


def import_vehicle(source: str | os.PathLike[str], out: str | os.PathLike[str]) -> tuple[str, ...]:
    """Writes a vehicle file from another program's; raises `InputError` with one sentence.

    Gives what was left out or taken for granted, one sentence each, which stands at its head too.
    """
    source = Path(source)
    forms = [cast(Format, import_module(f".{name}", __name__)) for name in _FORMATS]
    by_suffix = {suffix: form for form in forms for suffix in form.SUFFIXES}
    if source.suffix not in by_suffix:
        raise InputError(
            f"{source}: is no file that can be imported; known are {', '.join(sorted(by_suffix))}."
        )
    tables, notes = by_suffix[source.suffix].read(file_to_hold(source, _MOST_BYTES))
    file = validated(VehicleFile, {"schema": 1} | tables, str(source))
    write_vehicle_file(file, out, (f"Imported from {source.name}.", *notes))
    return notes
