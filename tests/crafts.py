"""What several test files share: vehicles, logs, and the same things for the independent plant."""

import functools

import jax.numpy as jnp
import numpy as np

from experiments.blind import plant as blind
from experiments.blind import vehicle as blind_vehicle
from jaxmarine._types import CHANNELS
from jaxmarine.effects import place
from jaxmarine.logs import Log
from jaxmarine.simulation import initial_state
from jaxmarine.vehicle import Body, Damping, Placed, Thrusters, Vehicle
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle, suspect_named

PACKAGED = ("tethra", "tethra_geometry", "minesniper", "bluerov2_heavy", "cybership2")
# `tethra_geometry` is `tethra` with other numbers, and would be compiled once more.
SIMULATED = tuple(name for name in PACKAGED if name != "tethra_geometry")


@functools.cache
def packaged(name: str) -> Vehicle:
    """A vehicle of the package."""
    return load_vehicle(packaged_vehicle(name))


@functools.cache
def independent(name: str) -> blind_vehicle.Vehicle:
    """The package's file, read by code that shares nothing with it."""
    return blind_vehicle.load(packaged_vehicle(name))


def brick(**changes) -> Vehicle:
    """A neutral, unpropelled body with no off-diagonal number but those in `changes`."""
    parts = {"mass": 10.0, "weight": 98.1, "buoyancy": 98.1, "linear": np.zeros(6)}
    parts |= {"quadratic": np.zeros(6), "added": np.zeros(6), "dof": packaged("tethra").dof}
    parts |= {"cog": np.zeros(3)} | changes
    mass = parts["mass"]
    return Vehicle(
        body=Body(
            matrix=jnp.diag(jnp.array([mass, mass, mass, 2.0, 3.0, 4.0])),
            mass=jnp.asarray(mass),
            cog=jnp.asarray(parts["cog"]),
            cob=jnp.zeros(3),
            weight=jnp.asarray(parts["weight"]),
            buoyancy=jnp.asarray(parts["buoyancy"]),
        ),
        added_mass=jnp.diag(jnp.asarray(parts["added"])),
        damping=Damping(jnp.diag(jnp.asarray(parts["linear"])), jnp.diag(jnp.asarray(parts["quadratic"]))),
        thrusters=Thrusters(jnp.zeros((0, 3)), jnp.zeros((0, 3)), *(jnp.zeros(0),) * 8),
        density=jnp.asarray(1025.0),
        gravity=jnp.asarray(9.81),
        placed=(),
        name="brick",
        dof=parts["dof"],
        thruster_names=(),
    )


def log_of(vehicle: Vehicle, t, commands=None, wrench=None, channels=None, name="log.csv") -> Log:
    """A log with these commands or this wrench, and measurements if there are any."""
    t = np.asarray(t, float)
    if channels is None:
        channels = np.full((len(t), len(CHANNELS)), np.nan)
    if commands is None and wrench is None:
        commands = np.zeros((len(t), len(vehicle.thruster_names)))
    return Log(t, np.asarray(channels), commands, wrench, vehicle.thruster_names, name)


def random_commands(vehicle: Vehicle, samples: int, hold: int, seed: int) -> np.ndarray:
    """Commands within +-0.9, new ones every `hold` samples, some of them zero."""
    rng = np.random.default_rng(seed)
    count = len(vehicle.thruster_names)
    levels = rng.uniform(-0.9, 0.9, (samples // hold + 1, count))
    levels *= rng.random(levels.shape) > 0.2
    return np.repeat(levels, hold, axis=0)[:samples]


def random_start(vehicle: Vehicle, seed: int, speed: float = 0.3):
    """A start with all free axes moving, as a state and as the independent plant's rows."""
    rng = np.random.default_rng(seed)
    free = vehicle.free
    position, angles, velocity = rng.normal(size=3), rng.normal(size=3), rng.normal(size=6)
    pose = np.concatenate([position * [1, 1, free[2]], 0.4 * angles * free[3:]])
    velocity = speed * velocity * free
    rows = np.concatenate([pose, velocity, [0.0]])[:, None]
    return initial_state(vehicle, pose[:3], pose[3:], velocity), rows


def placed(vehicle: Vehicle, effect: blind.Effect) -> Placed:
    """An effect of the independent plant as one of the package."""
    suspect = suspect_named(vehicle, effect.effect, effect.target)
    known = {name: value for name, value in effect.parameters.items() if name in suspect.slots}
    return Placed(place(suspect, vehicle, known), effect.target, effect.since)


def independent_run(
    name: str,
    effects: list[blind.Effect],
    t: np.ndarray,
    commands: np.ndarray,
    start: np.ndarray,
    step: float,
) -> np.ndarray:
    """All channels that the independent plant logs, [times, 18], from the file of that name."""
    dt = t[1] - t[0]
    begun = sorted({0, *(int(np.searchsorted(t, e.since)) for e in effects if e.since is not None)})
    schedule = [(k, [e for e in effects if e.since is None or e.since <= t[k] + 1e-9]) for k in begun]
    vehicle = independent(name)
    models = [(k, blind.Model(vehicle, acting)) for k, acting in schedule]
    thrust = 0.0
    if models[0][1].lag.any():  # steady thrust of the first command
        thrust = models[0][1].drive(commands[:1, :, None])[0]
    run = blind.simulate(
        models, commands[:, :, None], start, len(t), t0=t[0], thrust=thrust, dt=dt, step=step
    )
    return blind.observed(effects, t, run.signals())[:, :, 0]


def unwrapped(difference: np.ndarray) -> np.ndarray:
    """Differences of channels with angles within half a turn."""
    out = np.array(difference)
    out[:, 3:6] = (out[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
    return out
