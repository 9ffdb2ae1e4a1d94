"""What tables of a vehicle file are made of: checked numbers, vectors, matrices, names and directions."""

import math
from typing import Annotated, Any

import numpy as np
import pydantic
from pydantic import BeforeValidator

from ._types import ALL_CHANNELS, WRENCH

# A direction this near to length one is kept to the last digit, so that files round-trip.
_UNIT_LENGTH = 1e-9
# Beyond any quantity of a vehicle in SI units (a tanker's inertia is some 1e12 kg m²); products of such
# numbers stay finite.
_ABSURD = 1e18
_RESERVED = ("t", "all", *ALL_CHANNELS, *WRENCH)


def finite(value: Any) -> Any:
    # pydantic would take "5" and true for numbers
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"must be a number, but is {value!r:.60}.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"must be a finite number, but is {value!r:.60}.")
    if abs(number) > _ABSURD:
        raise ValueError(f"must be in SI units, where no vehicle has {value!r:.60}.")
    return number


def _nested(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _row(value: Any, length: int, what: str) -> tuple[float, ...]:
    value = _nested(value)
    if not isinstance(value, list | tuple) or len(value) != length:
        found = f"has {len(value)}" if isinstance(value, list | tuple) else f"is {value!r:.60}"
        raise ValueError(f"must be {what}, but {found}.")
    try:
        return tuple(finite(entry) for entry in value)
    except ValueError as error:
        raise ValueError(f"holds an entry that {error}") from error


def _square(value: Any, size: int, what: str) -> tuple[tuple[float, ...], ...]:
    value = _nested(value)
    if not isinstance(value, list | tuple):
        raise ValueError(f"must be {what}, but is {value!r:.60}.")
    lengths = [len(row) if isinstance(row, list | tuple) else None for row in map(_nested, value)]
    if lengths != [size] * size:
        rows = ", ".join("none" if length is None else str(length) for length in lengths)
        raise ValueError(f"must be {what}, but its {len(value)} rows have the lengths {rows}.")
    return tuple(_row(row, size, what) for row in value)


def _triple(value: Any) -> tuple[float, ...]:
    return _row(value, 3, "3 numbers [x, y, z]")


def pair(value: Any) -> tuple[float, ...]:
    return _row(value, 2, "2 numbers")


def _numbers(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f"must be a list of numbers, but is {value!r:.60}.")
    return tuple(finite(entry) for entry in value)


def _matrix3(value: Any) -> tuple[tuple[float, ...], ...]:
    return _square(value, 3, "3 rows of 3 numbers")


def _matrix6(value: Any) -> tuple[tuple[float, ...], ...]:
    what = "6 rows of 6 numbers, or 6 numbers for a diagonal"
    value = _nested(value)
    if isinstance(value, list | tuple) and not any(isinstance(row, list | tuple) for row in value):
        diagonal = _row(value, 6, what)
        return tuple(tuple(row) for row in np.diag(diagonal).tolist())
    return _square(value, 6, what)


Number = Annotated[float, BeforeValidator(finite)]
Numbers = Annotated[tuple[float, ...], BeforeValidator(_numbers)]
Triple = Annotated[tuple[float, float, float], BeforeValidator(_triple)]
Rows3 = Annotated[tuple[tuple[float, ...], ...], BeforeValidator(_matrix3)]
Rows6 = Annotated[tuple[tuple[float, ...], ...], BeforeValidator(_matrix6)]


class Table(pydantic.BaseModel):
    """A TOML table: values never change, and a key that nothing knows is an error."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, validate_by_name=True)


def usable_name(name: str) -> str:
    if not name or name != name.strip() or not name.isprintable():
        raise ValueError(f"is {name!r}, but must be a name without spaces around it.")
    if name in _RESERVED:
        raise ValueError(f"is `{name}`, which names something else in logs; choose another.")
    return name


def unit_direction(direction: Triple) -> tuple[float, ...]:
    length = math.hypot(*direction)
    if length == 0:
        raise ValueError("must not be zero; give the direction of a positive command.")
    if abs(length - 1) < _UNIT_LENGTH:
        return direction
    return tuple(part / length for part in direction)
