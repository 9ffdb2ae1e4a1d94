"""Frames, signs, units and array shapes, said once.

- World frame: north-east-down (NED), metres. Body frame: x forward, y starboard, z down, about the
  body origin `o`. SI units and radians everywhere; degrees end in the readers.
- Attitude in files is roll `phi`, pitch `theta`, yaw `psi` (ZYX); inside it is a unit quaternion
  `(w, x, y, z)` that turns body vectors into world vectors, so that no attitude is singular.
- `nu = (u, v, w, p, q, r)` is the velocity of `o` over ground in body axes [m/s, rad/s]; a wrench
  is `(X, Y, Z, K, M, N)` at `o` in body axes [N, N m] (SNAME, 1950).
- Damping and added mass carry the positive sign: they stand on the left-hand side of
  `M nu' + C(nu) nu + D(nu) nu + g(eta) = tau`.
"""

from typing import TypeAlias

from jaxtyping import Array, Float

DOFS = ("surge", "sway", "heave", "roll", "pitch", "yaw")

POSITION = ("x", "y", "z")
ATTITUDE = ("phi", "theta", "psi")
VELOCITY = ("u", "v", "w")
RATE = ("p", "q", "r")
ACCELERATION = ("du", "dv", "dw")
ANGULAR_ACCELERATION = ("dp", "dq", "dr")
WRENCH = ("X", "Y", "Z", "K", "M", "N")
# The column of the battery's voltage [V].
BATTERY = "battery"
# The wind that blows over the ground, and as a craft that moves feels it: speed [m/s], and whence [rad],
# clockwise from north and from the bow.
WIND = ("wind_speed", "wind_direction")
APPARENT_WIND = ("apparent_wind_speed", "apparent_wind_angle")

# Every channel that a log can measure, in the order of all channel arrays.
CHANNELS = POSITION + ATTITUDE + VELOCITY + RATE + ACCELERATION + ANGULAR_ACCELERATION

# Sensor kinds of the vehicle file's [sensors] table with the channels that each one covers.
SENSORS = {
    "position": POSITION,
    "attitude": ATTITUDE,
    "velocity": VELOCITY,
    "rate": RATE,
    "acceleration": ACCELERATION,
    "angular_acceleration": ANGULAR_ACCELERATION,
}

CHANNEL_UNITS = dict(
    zip(
        CHANNELS,
        ("m",) * 3 + ("rad",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3 + ("m/s²",) * 3 + ("rad/s²",) * 3,
        strict=True,
    )
)

Scalar: TypeAlias = Float[Array, ""]
Vector3: TypeAlias = Float[Array, "3"]
Quaternion: TypeAlias = Float[Array, "4"]  # (w, x, y, z), body to world
Velocity: TypeAlias = Float[Array, "6"]  # u v w [m/s], p q r [rad/s]; body axes at `o`
Wrench: TypeAlias = Float[Array, "6"]  # X Y Z [N], K M N [N m]; body axes at `o`
Matrix3: TypeAlias = Float[Array, "3 3"]
Matrix6: TypeAlias = Float[Array, "6 6"]
Times: TypeAlias = Float[Array, " times"]
Commands: TypeAlias = Float[Array, "times thrusters"]
