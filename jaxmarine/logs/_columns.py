"""How the columns, topics or messages of a foreign file map to the columns of the contract."""

import os
from collections.abc import Collection, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from pydantic import Field

from .._errors import InputError
from .._files import did_you_mean, read_toml, validated
from .._types import (
    ALL_CHANNELS,
    APPARENT_WIND,
    ATTITUDE,
    BATTERY,
    CHANNEL_UNITS,
    POSITION,
    RATE,
    TABLE,
    VELOCITY,
    WIND,
    WRENCH,
)

# Units of a foreign file by the contract's unit of the same quantity, and what one is of that.
_QUANTITIES = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": np.pi / 180},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "kn": 1852 / 3600},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180},
    "m/s²": {"m/s²": 1.0, "m/s^2": 1.0},
    "rad/s²": {"rad/s²": 1.0, "rad/s^2": 1.0},
    "N": {"N": 1.0},
    "N m": {"N m": 1.0},
}
_UNITS = {unit: factor for units in _QUANTITIES.values() for unit, factor in units.items()}

QUATERNION = ("qw", "qx", "qy", "qz")
GEODETIC = ("latitude", "longitude", "altitude")
# A vector or quaternion in one line: its parts carry the path with one of these names behind it.
_GROUPS = {
    "position": dict(zip(POSITION, "xyz", strict=True)),
    "attitude": dict(zip(QUATERNION, "wxyz", strict=True)),
    "velocity": dict(zip(VELOCITY, "xyz", strict=True)),
    "rate": dict(zip(RATE, "xyz", strict=True)),
    **{one.kind: dict(zip(one.channels, "xyz", strict=True)) for one in TABLE if one.shows},
}

# The contract's unit of each column that has one; of what is not here, commands and quaternions are numbers.
_UNIT_OF = {
    "t": "s",
    **CHANNEL_UNITS,
    **dict(zip(WRENCH, ("N",) * 3 + ("N m",) * 3, strict=True)),
    "altitude": "m",
    **dict.fromkeys((WIND[0], APPARENT_WIND[0]), "m/s"),
    **dict.fromkeys((WIND[1], APPARENT_WIND[1]), "rad"),
}

# Two ways to give the same quantity, of which a map takes one.
_SAME = ((QUATERNION, ATTITUDE), (GEODETIC[:2], POSITION[:2]), (GEODETIC[2:], POSITION[2:]))


class ColumnSource(pydantic.BaseModel):
    """Where one contract column comes from: value = scale * unit * file's number + offset."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    source: str = Field(alias="from", description='the column\'s name in the file, `from = "..."`')
    scale: float = Field(
        default=1.0, strict=True, allow_inf_nan=False, description="a finite number other than zero"
    )
    offset: float = Field(default=0.0, strict=True, allow_inf_nan=False, description="a finite number")
    unit: str | None = Field(default=None, description="one of " + ", ".join(_UNITS))
    clock: "_Source | None" = Field(
        default=None, description="the name of the column with its times, or {from = ..., scale = ...}"
    )

    @pydantic.field_validator("scale")
    @classmethod
    def _not_zero(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("must not be zero; leave the column out if it is not measured.")
        return scale

    @pydantic.field_validator("unit")
    @classmethod
    def _known(cls, unit: str | None) -> str | None:
        if unit is not None and unit not in _UNITS:
            raise ValueError(f"is {unit!r}, which is no unit of a map; {did_you_mean(unit, _UNITS)}")
        return unit

    def __call__(self, raw: np.ndarray) -> np.ndarray:
        """The contract's values of the file's."""
        return self.scale * _UNITS.get(self.unit or "", 1.0) * raw + self.offset


def _from_name(source: Any) -> Any:
    return {"from": source} if isinstance(source, str) else source


_Source = Annotated[ColumnSource, pydantic.BeforeValidator(_from_name)]
ColumnSource.model_rebuild()


class Frame(pydantic.BaseModel):
    """Axes that the file's vectors and attitudes are given in."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    world: Literal["ned", "enu"] = Field(
        default="ned", description='"ned" (north, east, down) or "enu" (east, north, up)'
    )
    body: Literal["frd", "flu"] = Field(
        default="frd", description='"frd" (forward, right, down) or "flu" (forward, left, up)'
    )
    velocity: Literal["body", "world"] = Field(
        default="body", description='"body" or "world": the axes along which u v w are given'
    )


class Clock(pydantic.BaseModel):
    """Times of messages, and the spacing of the log's samples [s]."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    stamp: Literal["header", "bag"] = Field(
        default="header", description='"header" (when it was measured) or "bag" (when it was recorded)'
    )
    dt: float | None = Field(
        default=None, gt=0, strict=True, allow_inf_nan=False, description="a positive number [s]"
    )


class ColumnMap(pydantic.BaseModel):
    """A MAP.toml: per contract name, the file's own name and its units; its frames and its clock."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    columns: dict[str, _Source] = Field(
        description="a table [columns] with, per column of the log, the file's own name or "
        '{from = "...", scale = ..., offset = ...}'
    )
    frame: Frame = Field(default=Frame(), description="a table [frame]")
    time: Clock = Field(default=Clock(), description="a table [time]")

    def sources(self, path: object, thrusters: Sequence[str]) -> dict[str, ColumnSource]:
        """Where each contract column, quaternion part or geodetic coordinate comes from.

        Raises `InputError` that begins with `path` for a name that is none of them.
        """
        known = (
            "t",
            *ALL_CHANNELS,
            *thrusters,
            *WRENCH,
            BATTERY,
            *APPARENT_WIND,
            *_GROUPS,
            *QUATERNION,
            *GEODETIC,
        )
        found: dict[str, ColumnSource] = {}
        for name, source in self.columns.items():
            if name not in known:
                commands = f" or command of the vehicle ({', '.join(thrusters)})" if thrusters else ""
                raise InputError(
                    f"{path}: the column map gives `{name}`, which is no column of a log{commands}; "
                    f"{did_you_mean(name, known)}"
                )
            if name in GEODETIC[:2] and source.unit == "deg":
                source = source.model_copy(update={"unit": None})  # degrees are what a place is read in
            # a thruster may be called `rate`, and is then meant
            parts = {} if name in thrusters else _GROUPS.get(name, {})
            given = {
                part: source.model_copy(update={"source": f"{source.source}.{end}"})
                for part, end in parts.items()
            } or {name: source}
            _check_unit(path, name, next(iter(given)), source.unit, thrusters)
            if source.clock is not None:
                _check_unit(path, f"{name}.clock", "t", source.clock.unit, ())
            twice = [part for part in given if part in found]
            if twice:
                raise InputError(f"{path}: the column map gives `{twice[0]}` twice; keep one.")
            found |= given
        for one, other in _SAME:
            both = [name for names in (one, other) for name in names if name in found]
            if both and both[0] in one and both[-1] in other:
                raise InputError(
                    f"{path}: the column map gives both `{both[0]}` and `{both[-1]}`, which measure the "
                    "same; keep one."
                )
        return found

    @property
    def keeps_rows(self) -> bool:
        """Whether the rows of a table stay: no column has a clock of its own, no spacing is asked for."""
        return self.time.dt is None and not any(source.clock for source in self.columns.values())

    @property
    def keeps_axes(self) -> bool:
        """Whether every column is one of the contract's, in its axes."""
        return self.frame == Frame() and not {*_GROUPS, *QUATERNION, *GEODETIC} & {*self.columns}


def _check_unit(path: object, name: str, part: str, unit: str | None, thrusters: Collection[str]) -> None:
    """Raises `InputError` for a unit of another quantity than that of a column, or of one that has none.

    - `name`: as the map has it; `part`: a column that it gives.
    """
    if unit is None:
        return
    own = None if part in thrusters and part not in WIND else _UNIT_OF.get(part)
    if own is None:
        what = "is in degrees" if part in GEODETIC else "has no unit"
        raise InputError(
            f"{path}: the column map gives `{name}` in {unit}; it {what}, so leave the unit out, and give a "
            "scale where the file has another one."
        )
    if unit not in _QUANTITIES[own]:
        raise InputError(
            f"{path}: the column map gives `{name}` in {unit}; it is in {own}, so name one of "
            f"{', '.join(_QUANTITIES[own])}, and give a scale where the file has none of them."
        )


def replaced(names: Collection[str]) -> set[str]:
    """The channels that quaternions or geodetic coordinates among some names stand for."""
    return {name for one, other in _SAME for name in other if {*one} & {*names}}


def read_columns(path: str | os.PathLike[str]) -> ColumnMap:
    """Read a MAP.toml."""
    return validated(ColumnMap, read_toml(path), str(path))
