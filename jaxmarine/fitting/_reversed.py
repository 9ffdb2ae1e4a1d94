"""Columns of propellers, surfaces and swivels whose effect is opposite to what the file says.

What these give hangs on the flow, so that they have no answer of one size, as thrusters have (`_responses`).
But along the measured motion the file says what each column gives: what each axis gains in momentum over half
a second is regressed on that, beside all that else acts. As filed its coefficient is 1; by a wrong damping,
mass or lift slope it is another one, by a wrong sign it is negative.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._compiled import compiled
from .._types import DOFS
from ..actuators import Supply, Wind
from ..logs import Log, smooth_states
from ..physics import from_euler, rotation, thrust
from ..vehicle import Plant, Vehicle
from ._clock import BLOCKS, FEWEST, STRETCH, impulses, integrals, others
from ._driven import in_still_water, padded

# A coefficient is that of a wrong sign between these, by so many standard errors. What an autopilot tells its
# rudder answers the motion, which bends a coefficient, but not by more than it is; beyond the other, the
# column hardly changes and stands for something else.
_WRONG, _TOO_MUCH, _SIGMAS = -1 / 3, -3.0, 4.0


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
        flat = impulses(log.t, given.reshape(len(given), -1), edges)
        around = integrals(log.t, others(track, vehicle.free > 0), edges)
        parts.append((np.diff(nu, axis=0) @ mass.T, around, flat.reshape(len(flat), *given.shape[1:])))
    width = max(part[1].shape[1] for part in parts)
    around = np.concatenate([np.pad(part[1], [(0, 0), (0, width - part[1].shape[1])]) for part in parts])
    gained, given = (np.concatenate([part[i] for part in parts]) for i in (0, 2))
    count = len(vehicle.drive_names)
    pushed, still, whole = given[:, :count], given[:, count:-1], given[:, -1]
    moves = (vehicle.free > 0) & (gained.std(axis=0) > 0)
    if not moves.any() or len(gained) < max(BLOCKS, FEWEST * (width + 2)):
        return ()
    found = []
    for i, name in enumerate(vehicle.drive_names):
        if name in told:
            # On the axis of whose motion it makes the largest part. At rest, if it gives anything there: what
            # a propeller does in motion to a rudder behind it has the rudder's sign.
            size = (still[:, i] if np.ptp(still[:, i]) > 0 else pushed[:, i]).std(axis=0)
            size = size / np.maximum(gained.std(axis=0), 1e-12)
            a = int(np.argmax(np.where(moves, size, 0.0)))
            own = pushed[:, i, a]
            regressors = np.stack([own, whole[:, a] - own], axis=1)
            factor, std = _regressed(gained[:, a], np.concatenate([regressors, around], axis=1))
            if _TOO_MUCH < factor < _WRONG and factor + _SIGMAS * std < 0:
                found.append(Reversed(name, DOFS[a], factor, -factor / std))
    return tuple(found)


def _regressed(
    gained: Float[np.ndarray, " stretches"], columns: Float[np.ndarray, "stretches regressors"]
) -> tuple[float, float]:
    """The coefficient of the first column, and its standard error by the scatter over blocks of the logs."""
    # Without units, and without what the others tell already.
    scale = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
    inverse = np.linalg.pinv(columns / scale, rcond=1e-6)
    slopes = inverse @ gained
    rest = gained - columns / scale @ slopes
    starts = np.searchsorted(np.arange(len(gained)) * BLOCKS // len(gained), np.arange(BLOCKS))
    added = np.add.reduceat(inverse[0] * rest, starts)
    # Of some blocks the scatter is a rough number: never less than that of stretches one by one.
    variance = max((added**2).sum() * BLOCKS / (BLOCKS - 1), (inverse[0] ** 2).sum() * rest.var())
    return float(slopes[0] / scale[0]), float(np.sqrt(variance) / scale[0])


def _given(
    vehicle: Vehicle, log: Log, attitude: np.ndarray, nu: np.ndarray
) -> Float[np.ndarray, "times parts 6"]:
    """What each column gives at each sample by the file: what would be missing if it stood at zero.

    Behind these what each gives by itself, the craft at rest and, as the last, what all give together.
    """
    count = len(vehicle.drive_names)
    commands = log.commanded(vehicle.command_names)
    assert commands is not None
    t, *arrays = padded(log.t, commands[:, :count], attitude, nu)
    return np.asarray(_each(vehicle.plant(), t, *arrays))[: len(log.t)]


@compiled
def _each(plant: Plant, t, commands, attitude, nu):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    free = in_still_water(plant)

    def each(acting, attitude, nu):
        turn = from_euler(attitude)
        flow = plant.relative(turn, nu), nu, rotation(turn)
        eye = jnp.eye(len(acting))

        without = jax.vmap(lambda share: free.pushed(acting * share, *flow))(1.0 - eye)
        still = jax.vmap(lambda share: free.pushed(acting * share, jnp.zeros(6)))(eye)
        whole = free.pushed(acting, *flow)[None]
        return jnp.concatenate([whole - without, still, whole])

    return jax.vmap(each)(thrust(drive, t, commands).mean, attitude, nu)
