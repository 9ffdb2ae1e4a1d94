"""How the columns of a foreign file map to those of the contract."""

import os
from typing import Annotated, Any

import numpy as np
import pydantic
from pydantic import Field

from .._files import read_toml, validated


class ColumnSource(pydantic.BaseModel):
    """Where one contract column comes from: value = scale * file's number + offset."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    source: str = Field(alias="from", description='the column\'s name in the file, `from = "..."`')
    scale: float = Field(
        default=1.0, strict=True, allow_inf_nan=False, description="a finite number other than zero"
    )
    offset: float = Field(default=0.0, strict=True, allow_inf_nan=False, description="a finite number")

    @pydantic.field_validator("scale")
    @classmethod
    def _not_zero(cls, scale: float) -> float:
        if scale == 0:
            raise ValueError("must not be zero; leave the column out if it is not measured.")
        return scale

    def __call__(self, raw: np.ndarray) -> np.ndarray:
        """The contract's values of the file's."""
        return self.scale * raw + self.offset


def _from_name(source: Any) -> Any:
    return {"from": source} if isinstance(source, str) else source


_Source = Annotated[ColumnSource, pydantic.BeforeValidator(_from_name)]


class ColumnMap(pydantic.BaseModel):
    """The `[columns]` of a MAP.toml: per contract name, the file's own name and its units."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)

    columns: dict[str, _Source] = Field(
        description="a table [columns] with, per contract name, the file's own name or "
        '{from = "...", scale = ..., offset = ...}'
    )


def read_columns(path: str | os.PathLike[str]) -> ColumnMap:
    """Read a MAP.toml."""
    return validated(ColumnMap, read_toml(path), str(path))
