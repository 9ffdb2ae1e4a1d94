"""The wrench that a log's commands stand for."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._compiled import compiled
from ..logs import Log
from ..physics import thrust
from ..vehicle import Plant, Vehicle


@compiled
def _mean_thrust(plant: Plant, t, commands):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    return thrust(drive, t, commands).mean @ plant.allocation.T


def commanded(vehicle: Vehicle, log: Log) -> Float[np.ndarray, "times 6"]:
    """The wrench over each sample's hold by the vehicle as it is, without inflow loss, body axes [N, N m]."""
    if log.commands is None:
        assert log.wrench is not None
        return np.asarray(log.wrench)
    thrusters = log.commands[:, : len(vehicle.thruster_names)]
    return np.asarray(_mean_thrust(vehicle.plant(), jnp.asarray(log.t), jnp.asarray(thrusters)))
