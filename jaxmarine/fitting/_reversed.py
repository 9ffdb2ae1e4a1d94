"""Columns of propellers, surfaces and swivels whose effect is opposite to what the file says.

What these give hangs on the flow, so that they have no answer of one size, as thrusters have (`_responses`).
But along the measured motion the file says what each column gives: what each axis gains in momentum over half
a second is regressed on that, beside all that else acts. As filed its coefficient is 1; by a wrong damping,
mass or lift slope it is another one, by a wrong sign it is negative.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._compiled import compiled
from .._types import BATTERY, DOFS
from ..actuators import Supply, Wind
from ..logs import Log, smooth_states
from ..physics import from_euler, rotation, thrust
from ..vehicle import Plant, Vehicle
from ._clock import BLOCKS, FEWEST, STRETCH, impulses, integrals, others
from ._driven import padded

# A coefficient is that of a wrong sign from this on, by so many standard errors: what drives a craft under an
# autopilot answers its motion, which bends the coefficients of weak columns, but by less than they are.
_WRONG, _SIGMAS = -1 / 3, 4.0
# A column is asked for on the axes on which what it gives is no less than this share of the strongest's.
_LEAST = 0.2


class Reversed(NamedTuple):
    """A column that acts on an axis with `factor` times what the file says, a negative number.

    - `sigmas`: standard errors by which it is below zero.
    """

    column: str
    axis: str
    factor: float
    sigmas: float


def reversed_columns(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[Reversed, ...]:
    """Of logs of commands; none where they are too short to tell, or where the craft has thrusters alone."""
    told = [*vehicle.thruster_names]
    for one in vehicle.actuators:
        told += [] if isinstance(one, Supply | Wind) else one.columns
    logs = [log for log in logs if log.commands is not None and np.ptp(log.t) > 4 * STRETCH]
    if not logs or len(told) == len(vehicle.thruster_names):
        return ()
    mass, parts = np.asarray(vehicle.mass_matrix), []
    for log in logs:
        track = smooth_states(log, vehicle.dof)
        edges = np.arange(log.t[0], log.t[-1], STRETCH)
        nu = np.stack([np.interp(edges, log.t, one) for one in track.nu.T], axis=1)
        given = _given(vehicle, log, track.attitude, track.nu)
        flat = impulses(log.t, given.reshape(len(given), -1), edges).reshape(-1, *given.shape[1:])
        around = integrals(log.t, others(track, vehicle.free > 0), edges)
        parts.append((np.diff(nu, axis=0) @ mass.T, around, flat))
    width = max(part[1].shape[1] for part in parts)
    around = np.concatenate([np.pad(part[1], [(0, 0), (0, width - part[1].shape[1])]) for part in parts])
    gained, pushed = (np.concatenate([part[i] for part in parts]) for i in (0, 2))
    found = []
    for a in np.flatnonzero((vehicle.free > 0) & (gained.std(axis=0) > 0)):
        found += _on_axis(np.array(vehicle.drive_names), told, int(a), gained[:, a], around, pushed[:, :, a])
    # Each column once, on the axis that tells most.
    best = {one.column: one for one in sorted(found, key=lambda one: one.sigmas)}
    return tuple(best[name] for name in told if name in best)


def _on_axis(
    names: np.ndarray,
    told: Sequence[str],
    axis: int,
    gained: Float[np.ndarray, " stretches"],
    around: Float[np.ndarray, "stretches others"],
    pushed: Float[np.ndarray, "stretches columns"],
) -> list[Reversed]:
    """Those of `told` that act on one axis with the wrong sign."""
    size = pushed.std(axis=0)
    # Without the battery all thrust would be missing: that is the thrusters' once more.
    used = (size > _LEAST * size.max()) & (names != BATTERY)
    count = int(used.sum())
    if not count or len(gained) < max(BLOCKS, FEWEST * (around.shape[1] + count)):
        return []
    columns = np.concatenate([pushed[:, used], around], axis=1)
    scale = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
    inverse = np.linalg.pinv(columns / scale, rcond=1e-6)
    slopes = inverse @ gained
    rest = gained - columns / scale @ slopes
    # By the scatter over blocks of the logs, and no less than that of stretches one by one.
    starts = np.searchsorted(np.arange(len(gained)) * BLOCKS // len(gained), np.arange(BLOCKS))
    added = np.add.reduceat(inverse * rest, starts, axis=1)
    std = np.sqrt((added**2).sum(axis=1) * BLOCKS / (BLOCKS - 1) + (inverse**2).sum(axis=1) * rest.var())
    factor, std = (slopes / scale)[:count], (std / scale)[:count]
    return [
        Reversed(str(name), DOFS[axis], float(value), float(-value / error))
        for name, value, error in zip(names[used], factor, std, strict=True)
        if name in told and value + _SIGMAS * error < 0 and value < _WRONG
    ]


def _given(
    vehicle: Vehicle, log: Log, attitude: np.ndarray, nu: np.ndarray
) -> Float[np.ndarray, "times columns 6"]:
    """What each column gives at each sample by the file: what would be missing if it stood at zero."""
    count = len(vehicle.drive_names)
    commands = log.commanded(vehicle.command_names)
    assert commands is not None
    t, *arrays = padded(log.t, commands[:, :count], attitude, nu)
    return np.asarray(_each(vehicle.plant(), t, *arrays))[: len(log.t)]


@compiled
def _each(plant: Plant, t, commands, attitude, nu):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    free = eqx.tree_at(lambda p: p.drive.inflow, plant, jnp.zeros(commands.shape[1]))

    def each(acting, attitude, nu):
        turn = from_euler(attitude)
        flow = plant.relative(turn, nu), nu, rotation(turn)
        without = jax.vmap(lambda keep: free.pushed(acting * keep, *flow))(1.0 - jnp.eye(len(acting)))
        return free.pushed(acting, *flow)[None] - without

    return jax.vmap(each)(thrust(drive, t, commands).mean, attitude, nu)
