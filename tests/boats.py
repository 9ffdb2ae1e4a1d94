"""A small boat with three thrusters and its noisy logs, for the tests of fitting."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from jaxmarine._types import SENSORS
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Body, Damping, Thrusters, Vehicle

PLANAR = ("surge", "sway", "yaw")
NOISE = {"position": 0.02, "attitude": 0.005, "velocity": 0.02, "rate": 0.01}


def _diagonal(*values: float):
    return jnp.diag(jnp.array(values, float))


def boat(dof: tuple[str, ...] = PLANAR, sensors: Mapping[str, float] | None = None) -> Vehicle:
    """A boat of 50 kg: two thrusters astern, one across the bow."""
    sensors = NOISE if sensors is None else sensors
    return Vehicle(
        body=Body(
            matrix=_diagonal(50, 50, 50, 5, 5, 8),
            mass=jnp.asarray(50.0),
            cog=jnp.zeros(3),
            cob=jnp.zeros(3),
            weight=jnp.asarray(490.5),
            buoyancy=jnp.asarray(490.5),
        ),
        added_mass=_diagonal(5, 40, 40, 1, 1, 3).at[1, 5].set(2.0).at[5, 1].set(2.0),
        damping=Damping(_diagonal(20, 60, 60, 5, 5, 12), _diagonal(30, 90, 90, 5, 5, 8)),
        thrusters=Thrusters(
            position=jnp.array([[-0.5, -0.3, 0.0], [-0.5, 0.3, 0.0], [0.5, 0.0, 0.0]]),
            direction=jnp.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
            max_thrust=jnp.array([40.0, 40.0, 30.0]),
            deadband=jnp.zeros(3),
            lag=jnp.zeros(3),
            delay=jnp.zeros(3),
            saturation=jnp.ones(3),
            max_thrust_reverse=jnp.zeros(3),
            quadratic=jnp.zeros(3),
            advance_loss=jnp.zeros(3),
        ),
        density=jnp.asarray(1025.0),
        gravity=jnp.asarray(9.81),
        placed=(),
        name="boat",
        dof=dof,
        thruster_names=("port", "starboard", "bow"),
        sensors=tuple(sensors.items()),
    )


def steps(samples: int = 400, seed: int = 0, hold: int = 20) -> np.ndarray:
    """Random commands, new ones every `hold` samples."""
    levels = np.random.default_rng(seed).uniform(-0.9, 0.9, (samples // hold + 1, 3))
    return np.repeat(levels, hold, axis=0)[:samples]


def record(
    vehicle: Vehicle,
    commands: np.ndarray,
    noise: Mapping[str, float] = NOISE,
    seed: int = 0,
    dt: float = 0.1,
    name: str = "log.csv",
) -> Log:
    """A log of a run from rest with white noise; sensors that `noise` does not name are absent."""
    t = np.arange(len(commands)) * dt
    blank = Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.thruster_names, name)
    channels = np.asarray(simulate(vehicle, blank, initial_state(vehicle)).channels)
    std = np.repeat([noise.get(kind, np.nan) for kind in SENSORS], 3)
    errors = std * np.random.default_rng(seed).normal(size=channels.shape)
    return Log(t, channels + errors, commands, None, vehicle.thruster_names, name)
