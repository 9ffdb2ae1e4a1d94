"""What effects say of themselves is made of these: a found cause, and its numbers in words.

All texts are plain; what stands between backticks is a name from a file.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Protocol

from .._numbers import joined, number, plus_minus, unit_on
from .._types import DOFS


class Estimated(Protocol):
    """A number that was found, with its standard error and unit."""

    @property
    def value(self) -> float: ...
    @property
    def std(self) -> float: ...
    @property
    def unit(self) -> str: ...


class Found(Protocol):
    """A cause that was found: its target, and its parameters by name."""

    @property
    def target(self) -> str | None: ...
    @property
    def parameters(self) -> Mapping[str, Estimated]: ...


FROM_ORIGIN = {
    "x": ("ahead of", "behind"),
    "y": ("to starboard of", "to port of"),
    "z": ("below", "above"),
}
SHIFTED = {
    "x": ("further forward", "further aft"),
    "y": ("further to starboard", "further to port"),
    "z": ("lower", "higher"),
}
PUSHES = {
    "surge": ("pushes the vehicle forward", "pushes the vehicle backward"),
    "sway": ("pushes the vehicle to starboard", "pushes the vehicle to port"),
    "heave": ("pushes the vehicle down", "pushes the vehicle up"),
    "roll": ("rolls the vehicle to starboard", "rolls the vehicle to port"),
    "pitch": ("turns the bow up", "turns the bow down"),
    "yaw": ("turns the bow to starboard", "turns the bow to port"),
}


def push(dof: str) -> str:
    """`force in surge`, `moment in yaw`."""
    return f"{'moment' if dof in DOFS[3:] else 'force'} in {dof}"


def value_of(found: Found, name: str) -> float:
    """The parameter, zero where it was not fitted."""
    parameter = found.parameters.get(name)
    return 0.0 if parameter is None else parameter.value


def estimate(found: Found, name: str, scale: float = 1.0, unit: str | None = None) -> str:
    """`0.71 ± 0.02 m/s`: the parameter in the unit that its target has, or times `scale` in another."""
    parameter = found.parameters[name]
    shown = unit_on(parameter.unit, found.target) if unit is None else unit
    return plus_minus(scale * parameter.value, abs(scale) * parameter.std, shown)


def size(found: Found, name: str) -> str:
    """The parameter without its sign, which the sentence puts into words."""
    return estimate(found, name, -1.0 if found.parameters[name].value < 0 else 1.0)


def listed(found: Found, names: Iterable[str] = ()) -> str:
    """`north 0.10 ± 0.01 m/s, east …` of the parameters that there are."""
    wanted = [name for name in (tuple(names) or found.parameters) if name in found.parameters]
    return ", ".join(f"{name} {estimate(found, name)}" for name in wanted)


def place_of(found: Found, words: Mapping[str, tuple[str, str]]) -> str:
    """Coordinates in words; per coordinate those for a positive and for a negative one."""
    there = [name for name in words if name in found.parameters]
    return joined([f"{size(found, name)} {words[name][value_of(found, name) < 0]}" for name in there])


def polar(found: Found) -> tuple[str, int]:
    """Size, and the direction towards which it points [deg], of a vector (north, east)."""
    north, east = value_of(found, "north"), value_of(found, "east")
    return number(math.hypot(north, east), 2), round(math.degrees(math.atan2(east, north))) % 360


def degrees(found: Found, name: str, unit: str = "°") -> str:
    """An angle with its sign, and what is known of it; or a rate in `unit`."""
    angle = found.parameters[name]
    return f"{plus_minus(math.degrees(angle.value), math.degrees(angle.std))}{unit}"


def more(change: float) -> str:
    return "more" if change >= 0 else "less"
