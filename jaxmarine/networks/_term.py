"""What all learned terms share: they are made for one vehicle, and live in a file of arrays beside it."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import ClassVar, Self

import equinox as eqx
import numpy as np

from ..effects import AbstractEffect, Craft, Suspect, WrenchEffect


class LearnedTerm(AbstractEffect):
    """An effect that is learned as a whole: nobody is accused of it, and it is built, not neutral.

    - `inputs`: what a vehicle file names beside the arrays: signals, axes or thrusters.
    """

    units: ClassVar[Mapping[str, str]] = {}

    inputs: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        raise NotImplementedError("A learned term has no neutral value before it is built.")

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return ()

    @classmethod
    @abc.abstractmethod
    def check(cls, craft: Craft, target: str | None, inputs: tuple[str, ...]) -> None:
        """ValueError, with the end of a sentence, where a vehicle file's entry does not fit the vehicle."""

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, as they stand in the file."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: np.asarray(value) for name, value in values.items() if eqx.is_array(value)}

    @classmethod
    @abc.abstractmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        """The term whose `arrays()` these were; ValueError or KeyError where they do not fit together."""


class LearnedDamping(LearnedTerm, WrenchEffect):
    """A learned force that depends on the velocities of some axes, and acts on the same; `inputs`: these."""

    @classmethod
    def check(cls, craft: Craft, target: str | None, inputs: tuple[str, ...]) -> None:
        del target
        if not set(inputs) <= set(craft.dof):
            raise ValueError("is a learned damping and needs free axes as `inputs`.")


def check_shapes(arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """ValueError where these are not arrays of those names and shapes."""
    if dict(shapes) != {name: np.shape(value) for name, value in arrays.items()}:
        raise ValueError(f"its arrays are not {dict(shapes)}")
