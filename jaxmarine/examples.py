"""Logs that the package makes itself: an operator at the sticks, and sensors with noise."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from ._errors import InputError
from .effects import CATALOGUE, AbstractEffect, place
from .logs import Log
from .simulation import initial_state, simulate
from .vehicle import Placed, Vehicle
from .vehicle_io import load_vehicle, packaged_vehicle, suspect_named

# Of an operator at the sticks, as a share of full commands.
STRENGTH = 0.6


def operator(
    count: int, t: Float[np.ndarray, " times"], seed: int, strength: float = STRENGTH
) -> Float[np.ndarray, "times thrusters"]:
    """Commands of an operator who holds each stick for some seconds and slews within 0.3 s.

    - `count` thrusters in neighbouring pairs, which an operator moves together or against each other.
    """
    rng = np.random.default_rng(seed)
    dt = float(np.median(np.diff(t)))
    sticks = np.zeros((len(t), count))
    for i in range(count):
        at = 0
        while at < len(t):
            held = int(rng.uniform(2.0, 8.0) / dt)
            level = rng.choice([0.0, rng.uniform(-1.0, 1.0)], p=[0.3, 0.7])
            sticks[at : at + held, i] = level
            at += held
    sticks = scipy.ndimage.uniform_filter1d(sticks, max(1, round(0.3 / dt)), axis=0, mode="nearest")
    pairs = np.eye(count)
    for i in range(0, count - 1, 2):
        pairs[i : i + 2, i : i + 2] = [[0.7, 0.3], [0.7, -0.3]]
    return np.clip(strength * sticks @ pairs.T, -1.0, 1.0)


def operated(
    vehicle: Vehicle, t: Float[np.ndarray, " times"], seed: int
) -> Float[np.ndarray, "times columns"]:
    """Commands of an operator for all columns: those of thrusters as shares, others in their usual range."""
    commands = operator(len(vehicle.command_names), t, seed)
    at = len(vehicle.thruster_names)
    for one in vehicle.actuators:
        low, high = one.usual.T
        stick = 0.5 + 0.5 * commands[:, at : at + len(low)] / STRENGTH
        commands[:, at : at + len(low)] = low + (high - low) * np.clip(stick, 0.0, 1.0)
        at += len(low)
    return commands


def recorded(vehicle: Vehicle, commands, t, seed: int, name: str) -> Log:
    """The log of a vehicle from rest under commands, with the white noise that its file states.

    Sensors whose noise it does not state are not in the log; raises `InputError` where that leaves none.
    """
    noise = vehicle.stated_noise
    if np.isnan(noise).all():
        raise InputError(f"{vehicle.name}: states no noise under [sensors]; say what a log of it measures.")
    empty = Log(t, np.full((len(t), len(noise)), np.nan), commands, None, vehicle.command_names, name)
    clean = np.asarray(simulate(vehicle, empty, initial_state(vehicle)).channels)
    rng = np.random.default_rng(seed)
    channels = clean + noise * rng.standard_normal(clean.shape)
    return Log(t, channels, commands, None, vehicle.command_names, name)


def hidden(
    vehicle: Vehicle,
    effect: str,
    target: str | None,
    parameters: Mapping[str, float],
    duration: tuple[float, float] = (180.0, 90.0),
    seed: int = 0,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    dt: float = 0.1,
) -> tuple[Log, Log]:
    """A training and a test log of the vehicle with an effect in it that its file does not have.

    Lengths and `dt` between samples in seconds. `catalogue`: where the effect is found by its name.
    """
    suspect = suspect_named(vehicle, effect, target, catalogue)
    plant = vehicle.place(Placed(place(suspect, vehicle, parameters), target))
    logs = []
    for i, (length, name) in enumerate(zip(duration, ("train.csv", "test.csv"), strict=True)):
        t = np.arange(0.0, length, dt)
        commands = operated(vehicle, t, seed + 2 * i)
        logs.append(recorded(plant, commands, t, seed + 2 * i + 1, name))
    return logs[0], logs[1]


@dataclasses.dataclass(frozen=True)
class Demo:
    """A packaged craft with an effect hidden in its logs; `told` says in words what that is.

    - `duration` [s] of the training and the test log, `dt` [s] between samples: as slow as the craft is.
    """

    craft: str
    effect: str
    target: str
    parameters: Mapping[str, float]
    told: str
    duration: tuple[float, float] = (180.0, 90.0)
    dt: float = 0.1

    def vehicle(self) -> Vehicle:
        """The craft as its file has it, without what is hidden."""
        return load_vehicle(packaged_vehicle(self.craft))

    def logs(self, vehicle: Vehicle) -> tuple[Log, Log]:
        """The training and the test log of `vehicle()`."""
        return hidden(vehicle, self.effect, self.target, self.parameters, self.duration, dt=self.dt)


# By the kind of craft.
DEMOS: Mapping[str, Demo] = {
    "rov": Demo(
        "tethra", "thruster_gain", "port_h", {"factor": 0.72}, "thruster port_h gives 0.72 of its thrust"
    ),
    "auv": Demo(
        "remus100",
        "surface_stuck",
        "plane_star",
        {"angle": 0.08},
        "plane_star is stuck at 0.08 rad",
        dt=0.2,
    ),
    "ship": Demo(
        "kvlcc2",
        "surface_offset",
        "rudder",
        {"angle": 0.06},
        "the rudder stands 0.06 rad beside its command",
        (600.0, 300.0),
        0.5,
    ),
    "boat": Demo(
        "milliampere",
        "thruster_gain",
        "aft",
        {"factor": 0.6},
        "azimuth thruster aft gives 0.6 of its thrust",
        (240.0, 120.0),
        0.2,
    ),
}
