"""What to log next, in sentences, from what a log does not tell."""

from collections.abc import Sequence
from typing import Protocol

from ._coverage import AxisCoverage

_TRANSLATIONS = ("surge", "sway", "heave")
# What moves an axis, and its two sides.
_MANOEUVRES = {
    "surge": "drive ahead and astern",
    "sway": "drive sideways to either side",
    "heave": "dive and rise",
    "roll": "roll to either side",
    "pitch": "pitch up and down",
    "yaw": "turn to either side",
}
# What shows damping where weight and buoyancy right the craft, and where they do not.
_RIGHTED = "let it swing to rest from large angles."
_STEADY = "hold a thrust until the speed is steady."
_SIDES = {
    "surge": ("astern", "ahead"),
    "sway": ("to port", "to starboard"),
    "heave": ("up", "down"),
    "roll": ("to port", "to starboard"),
    "pitch": ("bow down", "bow up"),
    "yaw": ("to port", "to starboard"),
}
# An axis went to one side only where the other side's speed is less than this share of it.
_ONE_SIDED = 0.1
# A fit that scatters this much more than by noise has something to explain first.
_SCATTERED = 2.0
# ... and so far that the log is hardly one of this vehicle: of faults that a diagnosis names, few come near.
_FAR = 100.0


class Axis(Protocol):
    """What the sentences need to know of an axis (`AxisCheck`)."""

    @property
    def dof(self) -> str: ...
    @property
    def coverage(self) -> AxisCoverage: ...
    @property
    def inertia(self) -> float: ...
    @property
    def linear(self) -> float: ...
    @property
    def quadratic(self) -> float: ...
    @property
    def damping(self) -> float: ...
    @property
    def scatter(self) -> float: ...
    @property
    def driven(self) -> bool: ...


# Where something gross is wrong, all that is said of the log is of a craft that it does not show.
MEND = (
    "Mend what stands under first, in the column map or in the vehicle file, and check again; what else "
    "stands here holds for the file as it is. Where the craft itself is so, diagnose names it."
)


def advice(axes: Sequence[Axis], known: float, guessed: bool) -> tuple[str, ...]:
    """Sentences on what the next log should have; one that says so where nothing is missing.

    - `known`: the relative standard error from which a number is not determined.
    - `guessed`: whether the vehicle file says that its numbers may be far off.
    """
    out = [sentence for axis in axes for sentence in _of_axis(axis, known)]
    if not out:
        out = ["Every axis is excited, and all its coefficients are determined."]
    missed = [axis for axis in axes if axis.scatter > _SCATTERED]
    if missed:
        most = max(axis.scatter for axis in missed)
        look = "diagnose the log first" if most < _FAR else "look at the axes, signs and units of both first"
        if guessed and most < _FAR:
            look = "fit the guesses that logs can tell, thrust too unless it was measured, before a diagnosis"
        out.append(
            f"The vehicle file misses something in {', '.join(axis.dof for axis in missed)}: a fit would be "
            f"off by up to {most:.2g} times these errors; {look}."
        )
    return tuple(out)


def _of_axis(axis: Axis, known: float) -> list[str]:
    dof, (low, high) = axis.dof, axis.coverage.velocity_middle
    name = dof.capitalize()
    speed = f"{max(-low, high):.2g} {'m/s' if dof in _TRANSLATIONS else 'rad/s'}"
    moves, stops = axis.inertia < known, axis.damping < known
    if not moves and not stops:
        if axis.driven:
            return [f"{name} is not excited: {_MANOEUVRES[dof]}, in steps from low to full thrust."]
        return [
            f"{name} is not excited, and no thruster acts on it: push or tow it by hand, and log how it "
            "comes to rest."
        ]
    out = []
    if not moves:
        out.append(f"{name} shows its damping, but not its inertia: change its thrust in quick steps.")
    elif not stops:
        how = _RIGHTED if dof in ("roll", "pitch") else _STEADY
        out.append(f"{name} shows its inertia, but not its damping: {how}")
    elif max(axis.linear, axis.quadratic) >= known:
        which = "linear" if axis.linear > axis.quadratic else "quadratic"
        how = f"hold speeds well below {speed}" if which == "linear" else f"go well beyond {speed}"
        out.append(f"{name} leaves its {which} damping open: {how}.")
    if stops and min(-low, high) < _ONE_SIDED * max(-low, high):
        seen, other = _SIDES[dof][::-1] if high > -low else _SIDES[dof]
        out.append(f"{name} went only {seen}: go {other} too, where the model extrapolates.")
    return out
