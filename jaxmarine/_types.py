"""Frames, signs, units, array shapes and what sensors show, said once.

- World frame: north-east-down (NED), metres. Body frame: x forward, y starboard, z down, about the
  body origin `o`. SI units and radians everywhere; degrees end in the readers.
- Attitude in files is roll `phi`, pitch `theta`, yaw `psi` (ZYX); inside it is a unit quaternion
  `(w, x, y, z)` that turns body vectors into world vectors, so that no attitude is singular.
- `nu = (u, v, w, p, q, r)` is the velocity of `o` over ground in body axes [m/s, rad/s]; a wrench
  is `(X, Y, Z, K, M, N)` at `o` in body axes [N, N m] (SNAME, 1950).
- Damping and added mass carry the positive sign: they stand on the left-hand side of
  `M nu' + C(nu) nu + D(nu) nu + g(eta) = tau`.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

DOFS = ("surge", "sway", "heave", "roll", "pitch", "yaw")

Scalar: TypeAlias = Float[Array, ""]
Vector3: TypeAlias = Float[Array, "3"]
Quaternion: TypeAlias = Float[Array, "4"]  # (w, x, y, z), body to world
Velocity: TypeAlias = Float[Array, "6"]  # u v w [m/s], p q r [rad/s]; body axes at `o`
Wrench: TypeAlias = Float[Array, "6"]  # X Y Z [N], K M N [N m]; body axes at `o`
Matrix3: TypeAlias = Float[Array, "3 3"]
Matrix6: TypeAlias = Float[Array, "6 6"]
Times: TypeAlias = Float[Array, " times"]
Commands: TypeAlias = Float[Array, "times thrusters"]

WRENCH = ("X", "Y", "Z", "K", "M", "N")
# The column of the battery's voltage [V].
BATTERY = "battery"
# The wind that blows over the ground, and as a craft that moves feels it: speed [m/s], and whence [rad],
# clockwise from north and from the bow.
WIND = ("wind_speed", "wind_direction")
APPARENT_WIND = ("apparent_wind_speed", "apparent_wind_angle")


class Moving(NamedTuple):
    """What there is to be seen of a craft at one time, by sensors at `o`.

    - `rotation` body to world; `nu` over ground, `nu_r` through the water, `nu_dot` the derivative of `nu`,
      body axes [m, rad, s]; `gravity` [m/s²].
    """

    rotation: Matrix3
    nu: Velocity
    nu_r: Velocity
    nu_dot: Velocity
    gravity: Scalar


def _specific_force(seen: Moving) -> Vector3:
    """R' (a - g), with the acceleration a of `o` in earth axes: a craft that rests level shows (0, 0, -g)."""
    turning = jnp.cross(seen.nu[3:], seen.nu[:3])
    return seen.nu_dot[:3] + turning - seen.gravity * seen.rotation[2]


class Sensor(NamedTuple):
    """One kind of sensor: a key of the vehicle file's table [sensors], and three columns of a log.

    - `channels`: of the axes surge, sway, heave or roll, pitch, yaw in turn; `unit` of each.
    - `title`: the kind in a reader's words; `titles`: each channel.
    - `turns`: whether it is of the axes that turn.
    - `in_body`: whether these are the components of a vector along body axes.
    - `jumps`: whether it shows accelerations, which jump with the commands.
    - `shows`: its equation, where a log only has a place for it if it was measured; the kinds of every log,
      of which position to rate are the state, have none here (`Plant.readings`).
    """

    kind: str
    channels: tuple[str, str, str]
    unit: str
    title: str
    titles: tuple[str, str, str]
    turns: bool = False
    in_body: bool = True
    jumps: bool = False
    shows: Callable[[Moving], Vector3] | None = None


POSITION = ("x", "y", "z")
ATTITUDE = ("phi", "theta", "psi")
VELOCITY = ("u", "v", "w")
RATE = ("p", "q", "r")
ACCELERATION = ("du", "dv", "dw")
ANGULAR_ACCELERATION = ("dp", "dq", "dr")
WATER_VELOCITY = ("u_water", "v_water", "w_water")
SPECIFIC_FORCE = ("fx", "fy", "fz")

# All sensors, in the order of all channel arrays. Those of every log come first; one more is one more line.
TABLE = (
    Sensor(
        "position",
        POSITION,
        "m",
        "Position",
        ("north position x", "east position y", "down position z"),
        in_body=False,
    ),
    Sensor(
        "attitude",
        ATTITUDE,
        "rad",
        "Attitude",
        ("roll angle phi", "pitch angle theta", "heading psi"),
        turns=True,
        in_body=False,
    ),
    Sensor(
        "velocity",
        VELOCITY,
        "m/s",
        "Velocity",
        ("surge velocity u", "sway velocity v", "heave velocity w"),
    ),
    Sensor("rate", RATE, "rad/s", "Turning rate", ("roll rate p", "pitch rate q", "yaw rate r"), turns=True),
    Sensor(
        "acceleration",
        ACCELERATION,
        "m/s²",
        "Acceleration",
        ("surge acceleration du", "sway acceleration dv", "heave acceleration dw"),
        jumps=True,
    ),
    Sensor(
        "angular_acceleration",
        ANGULAR_ACCELERATION,
        "rad/s²",
        "Angular acceleration",
        (
            "roll acceleration dp",
            "pitch acceleration dq",
            "yaw acceleration dr",
        ),
        turns=True,
        jumps=True,
    ),
    Sensor(
        "water_velocity",
        WATER_VELOCITY,
        "m/s",
        "Velocity through the water",
        (
            "surge velocity through the water",
            "sway velocity through the water",
            "heave velocity through the water",
        ),
        shows=lambda seen: seen.nu_r[:3],
    ),
    Sensor(
        "specific_force",
        SPECIFIC_FORCE,
        "m/s²",
        "Specific force",
        ("specific force fx", "specific force fy", "specific force fz"),
        jumps=True,
        shows=_specific_force,
    ),
)

# Sensor kinds with the channels that each one covers, and the channels in their order: those of every log,
# and all there are, for which channel arrays have columns where one of them was measured (`width_of`).
SENSORS = {one.kind: one.channels for one in TABLE if one.shows is None}
ALL_SENSORS = {one.kind: one.channels for one in TABLE}
CHANNELS = tuple(name for names in SENSORS.values() for name in names)
ALL_CHANNELS = tuple(name for names in ALL_SENSORS.values() for name in names)
ALWAYS = len(CHANNELS)
CHANNEL_UNITS = {name: one.unit for one in TABLE for name in one.channels}
# Where these lie in the channel arrays: what is of position, attitude and velocities is the state.
POSES, MOTION, STATE, ACCELERATIONS = slice(0, 6), slice(6, 12), slice(0, 12), slice(12, 18)
# Of each channel the degree of freedom that it is of, and whether it jumps with the commands.
AXES = tuple(3 * one.turns + axis for one in TABLE for axis in range(3))
JUMPS = tuple(one.jumps for one in TABLE for _ in one.channels)


def width_of(used: Iterable[Any]) -> int:
    """How many channels arrays must have for these to be among them; `used`: of each channel, in order."""
    last = max((i for i, one in enumerate(used) if one), default=0)
    return max(ALWAYS, 3 * (last // 3 + 1))
