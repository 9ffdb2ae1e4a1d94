"""What a reader has to know of a vehicle."""

from typing import Protocol, runtime_checkable

import numpy as np

from .._types import APPARENT_WIND, ATTITUDE, BATTERY, DOFS, POSITION, RATE, VELOCITY, WIND, WRENCH


@runtime_checkable
class Craft(Protocol):
    """A vehicle as its logs see it.

    - `dof`: the free degrees of freedom, names as in `DOFS`.
    - `command_names`: the names of the command columns, one per thruster and one for a sliding mass.
    - `command_limits`: the largest |command| allowed per column, max(1, saturation).
    """

    @property
    def dof(self) -> tuple[str, ...]: ...

    @property
    def command_names(self) -> tuple[str, ...]: ...

    @property
    def command_limits(self) -> np.ndarray: ...


def beside(craft: Craft) -> tuple[str, ...]:
    """Columns that a log may have beside the commands: the battery's, or what stands for the wind's."""
    return (BATTERY, *APPARENT_WIND) if {*WIND} <= {*craft.command_names} else (BATTERY,)


def free_poses(dof: tuple[str, ...]) -> tuple[str, ...]:
    """The position and attitude channels of the free degrees of freedom."""
    return tuple(c for d, c in zip(DOFS, POSITION + ATTITUDE, strict=True) if d in dof)


def free_velocities(dof: tuple[str, ...]) -> tuple[str, ...]:
    """The velocity channels of the free degrees of freedom."""
    return tuple(c for d, c in zip(DOFS, VELOCITY + RATE, strict=True) if d in dof)


def free_motions(dof: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Channels of which a log needs one set: poses, velocities, or velocities with attitude for rates."""
    poses, velocities = free_poses(dof), free_velocities(dof)
    steered = tuple(c for c in velocities if c in VELOCITY) + tuple(c for c in poses if c in ATTITUDE)
    return poses, velocities, steered


def free_wrench(dof: tuple[str, ...]) -> tuple[str, ...]:
    """The components of the control wrench on the free degrees of freedom."""
    return tuple(c for d, c in zip(DOFS, WRENCH, strict=True) if d in dof)
