"""What drives a vehicle along a log: the wrench that was commanded, and the one that its motion takes."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compiled import compiled
from ..logs import Log, StateTrack
from ..physics import from_euler, rotation, thrust
from ..vehicle import Input, Plant, State, Vehicle, reach

# An acceleration is read over this time on either side [s].
HALF = 0.25
# Logs are filled up to a multiple of as many samples, so that most share one program: to run it over all of
# these takes milliseconds, to build another a fifth of a second.
_GRAIN = 4096


class Driven(NamedTuple):
    """Control wrenches at each sample, `o`, body axes [N, N m], zero on locked axes.

    - `commanded`: over the sample's hold, by the vehicle as it is, without inflow loss.
    - `needed`: by the motion, of which the acceleration is read over half a second.
    - `able` [6]: the largest that commands can give on each axis; of a log of wrenches the largest in it.
    """

    commanded: Float[np.ndarray, "times 6"]
    needed: Float[np.ndarray, "times 6"]
    able: Float[np.ndarray, "6"]


def driven(vehicle: Vehicle, log: Log, track: StateTrack) -> Driven:
    """The wrenches along a log; `track`: its smoothed motion."""
    t, plant = log.t, vehicle.plant()
    ahead = np.stack([np.interp(t + HALF, t, one) for one in track.nu.T], axis=1)
    behind = np.stack([np.interp(t - HALF, t, one) for one in track.nu.T], axis=1)
    nu_dot = (ahead - behind) / (2 * HALF)
    count = len(vehicle.drive_names)
    given = log.commanded(vehicle.command_names)
    commands = np.zeros((len(t), count)) if given is None else given[:, :count]
    arrays = padded(t, commands, track.position, track.attitude, track.nu, nu_dot)
    acted, needed = _wrenches(plant, *arrays)
    acted, needed = np.asarray(acted)[: len(t)], np.asarray(needed)[: len(t)]
    if log.wrench is not None:
        acted, able = log.wrench, np.abs(log.wrench).max(axis=0)
    else:
        drive, thrusters = plant.drive, len(vehicle.thruster_names)
        most = jnp.maximum(drive.max_thrust, drive.max_thrust_reverse) * drive.saturation
        able = np.abs(np.asarray(plant.allocation)) @ np.asarray(most)[:thrusters] + reach(plant)
    return Driven(acted * vehicle.free, needed * vehicle.free, able * vehicle.free)


def padded(t: np.ndarray, *columns: np.ndarray) -> list[Array]:
    """Times and columns of a log, filled up to a length that many logs share (`_GRAIN`)."""
    more = -len(t) % _GRAIN
    after = t[-1] + (t[-1] - t[-2]) * np.arange(1, more + 1)
    filled = [np.pad(one, [(0, more), (0, 0)], mode="edge") for one in columns]
    return [jnp.asarray(np.append(t, after)), *map(jnp.asarray, filled)]


def thrusts(vehicle: Vehicle, log: Log) -> Float[np.ndarray, "times thrusters"]:
    """Thrust [N] that each thruster's column asks for over each sample's hold, without inflow loss."""
    count = len(vehicle.drive_names)
    given = log.commanded(vehicle.command_names)
    commands = np.zeros((len(log.t), count)) if given is None else given[:, :count]
    mean = np.asarray(_thrusts(vehicle.plant(), *padded(log.t, commands)))
    return mean[: len(log.t), : len(vehicle.thruster_names)]


def in_still_water(plant: Plant) -> Plant:
    """The plant whose fixed thrusters give what they would in still water."""
    losses = plant.drive.inflow, plant.advance
    return eqx.tree_at(lambda p: (p.drive.inflow, p.advance), plant, tuple(map(jnp.zeros_like, losses)))


@compiled
def _thrusts(plant: Plant, t, commands):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    return thrust(drive, t, commands).mean


@compiled
def _wrenches(plant: Plant, t, commands, position, attitude, nu, nu_dot):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)

    def needed(position, attitude, nu, nu_dot, t):
        state = State(position, from_euler(attitude), nu, jnp.zeros(6 * len(plant.memories)))
        still = jnp.zeros(commands.shape[1])
        # What the others give at rest and zero speed of shafts is theirs, not the hull's.
        rest = plant.balance(state, nu_dot, Input(still, still, jnp.zeros(6), t))
        if not plant.actuators:
            return rest
        return rest + plant.pushed(still, plant.relative(state.attitude, nu), nu, rotation(state.attitude))

    mean = thrust(drive, t, commands).mean
    if plant.actuators:
        # Thrusters without what the flow takes; the others hang on the flow by what they are.
        free = in_still_water(plant)

        def pushed(acting, attitude, nu):
            turn = from_euler(attitude)
            return free.pushed(acting, plant.relative(turn, nu), nu, rotation(turn))

        given = jax.vmap(pushed)(mean, attitude, nu)
    else:
        given = mean @ plant.allocation.T
    return given, jax.vmap(needed)(position, attitude, nu, nu_dot, t)
