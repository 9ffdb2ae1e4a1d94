"""Foreign recordings of one known motion, written by the libraries of their formats."""

import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.worked import bag
from experiments.worked.bag import (
    ENU,
    EPOCH,
    FLU,
    Topics,
    header,
    maker,
    ros_types,
    vector,
)
from experiments.worked.bag import write_bag as write_bag
from jaxmarine._types import ATTITUDE, DOFS, POSITION, RATE, VELOCITY

MAPS = Path(__file__).resolve().parent.parent / "docs" / "maps"
THRUSTERS = tuple(f"t{k}" for k in range(1, 9))
ROV = SimpleNamespace(dof=DOFS, command_names=THRUSTERS, command_limits=np.ones(8))
BOAT = SimpleNamespace(
    dof=("surge", "sway", "yaw"), command_names=("left", "right"), command_limits=np.ones(2)
)
LENGTH = 20.0  # [s]


def attitude(t: np.ndarray) -> Rotation:
    """Body to north-east-down, turning through more than one whole turn."""
    return Rotation.from_euler(
        "ZYX", np.stack([2.0 + 0.6 * t, 0.3 * np.cos(0.4 * t), 0.4 * np.sin(0.5 * t)], axis=1)
    )


def position(t: np.ndarray) -> np.ndarray:
    return np.stack([3 * np.sin(0.5 * t), 2 * np.cos(0.4 * t), 5 + 0.2 * t], axis=1)


def truth(t: np.ndarray) -> dict[str, np.ndarray]:
    """x y z phi theta psi u v w p q r at some times; scipy turns, differences differentiate."""
    step = 1e-5
    turn = attitude(t)
    slope = (position(t + step) - position(t - step)) / (2 * step)
    rate = (attitude(t - step).inv() * attitude(t + step)).as_rotvec() / (2 * step)
    angles = turn.as_euler("ZYX")[:, ::-1]
    parts = np.concatenate([position(t), angles, turn.inv().apply(slope), rate], axis=1)
    return dict(zip((*POSITION, *ATTITUDE, *VELOCITY, *RATE), parts.T, strict=True))


def commands(t: np.ndarray) -> np.ndarray:
    """Eight commands [times, 8] that change every 0.7 s; multiples of 1/400, as a PWM of whole µs has."""
    levels = np.random.default_rng(3).integers(-300, 301, (200, 8)) / 400
    return levels[np.floor(np.asarray(t) / 0.7).astype(int)]


def times(period: float, first: float = 0.0, last: float = LENGTH) -> np.ndarray:
    return np.arange(first, last, period)


# --- ROS -------------------------------------------------------------------------------------


def odometry(version: int) -> Topics:
    """20 Hz odometry, 50 Hz gyroscope, 4 Hz depth, commands every 0.7 s, in the axes of ROS; with a gap."""
    make = maker(ros_types(version))
    odom = times(0.05)
    odom = odom[(odom < 8.0) | (odom >= 10.0)]
    seen = truth(odom)
    along = np.stack([seen[name] for name in VELOCITY], axis=1)
    messages = bag.odometry(make, odom, position(odom), attitude(odom), along)
    topics = {"/odom": ("nav_msgs/msg/Odometry", messages)}

    gyro = times(0.02, first=0.003)
    rates = np.stack([truth(gyro)[name] for name in RATE], axis=1) @ FLU
    topics["/imu"] = (
        "sensor_msgs/msg/Imu",
        [
            (
                t,
                make(
                    "sensor_msgs/msg/Imu",
                    header=header(make, t),
                    angular_velocity=vector(make, "Vector3", rate),
                ),
            )
            for t, rate in zip(gyro, rates, strict=True)
        ],
    )
    depth = times(0.25, first=0.01)
    topics["/depth"] = (
        "geometry_msgs/msg/PointStamped",
        [
            (
                t,
                make(
                    "geometry_msgs/msg/PointStamped",
                    header=header(make, t),
                    point=vector(make, "Point", np.array([0, 0, z])),
                ),
            )
            for t, z in zip(depth, position(depth)[:, 2], strict=True)
        ],
    )
    ordered = list(THRUSTERS[::-1])  # a name, not a place, tells which is which
    pushed = times(0.7)
    topics["/thrusters"] = (
        "sensor_msgs/msg/JointState",
        [
            (
                t,
                make(
                    "sensor_msgs/msg/JointState",
                    header=header(make, t),
                    name=ordered,
                    effort=row[::-1].copy(),
                ),
            )
            for t, row in zip(pushed, 40.0 * commands(pushed + 1e-6), strict=True)  # [N]
        ],
    )
    return topics


# --- ArduPilot -------------------------------------------------------------------------------

_FORMATS = {"Q": "Q", "B": "B", "c": "h", "C": "H", "f": "f", "H": "H"}


class DataFlashWriter:
    """A .BIN as an autopilot writes it: formats first, then messages."""

    def __init__(self):
        self.data = bytearray()
        self._layout: dict[str, tuple[int, str]] = {}
        self.define("FMT", 128, "BBnNZ", "Type,Length,Name,Format,Columns", 89)

    def define(self, name: str, number: int, layout: str, columns: str, length: int | None = None) -> None:
        length = length or 3 + struct.calcsize("<" + "".join(_FORMATS[c] for c in layout))
        self._layout[name] = (number, layout)
        words = (name.encode(), layout.encode(), columns.encode())
        self.data += struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 128, number, length, *words)

    def instances(self, name: str, units: str) -> None:
        """Says by `#` in its units which column of a message is its instance."""
        if "FMTU" not in self._layout:
            self._layout["FMTU"] = (130, "QBNN")
            words = (b"FMTU", b"QBNN", b"TimeUS,FmtType,UnitIds,MultIds")
            self.data += struct.pack("<BBBBB4s16s64s", 0xA3, 0x95, 128, 130, 3 + 41, *words)
        number = self._layout[name][0]
        self.data += struct.pack(
            "<BBBQB16s16s", 0xA3, 0x95, 130, 0, number, units.encode(), b"-" * len(units)
        )

    def write(self, name: str, *values: float) -> None:
        number, layout = self._layout[name]
        scaled = [
            round(100 * value) if c in "cC" else value if c == "f" else round(value)
            for c, value in zip(layout, values, strict=True)
        ]
        self.data += struct.pack("<BBB" + "".join(_FORMATS[c] for c in layout), 0xA3, 0x95, number, *scaled)


def dataflash() -> DataFlashWriter:
    """25 Hz attitude in degrees, 10 Hz filters of which the second is wrong, two gyroscopes, PWM."""
    log = DataFlashWriter()
    log.define("ATT", 129, "QccC", "TimeUS,Roll,Pitch,Yaw")
    log.define("XKF1", 131, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD")
    log.define("IMU", 132, "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ")
    log.define("RCOU", 133, "Q" + "H" * 8, "TimeUS," + ",".join(f"C{k}" for k in range(1, 9)))
    log.define("TEXT", 134, "H", "Name")
    log.write("TEXT", 1)
    log.instances("XKF1", "s#nnnmmm")
    log.instances("IMU", "s#EEE")
    rows: list[tuple[float, str, list[float]]] = []
    for name, at in (("ATT", times(0.04)), ("XKF1", times(0.1, 0.01)), ("IMU", times(0.04, 0.002))):
        seen = truth(at)
        angles = np.degrees(np.stack([seen[angle] for angle in ATTITUDE], axis=1))
        angles[:, 2] %= 360
        speed = attitude(at).apply(np.stack([seen[one] for one in VELOCITY], axis=1))
        rate = np.stack([seen[one] for one in RATE], axis=1)
        for k, t in enumerate(at):
            if name == "ATT":
                rows.append((t, name, [*angles[k]]))
            elif name == "XKF1":
                rows += [(t, name, [core, *(speed[k] + core), *position(at)[k]]) for core in (0, 1)]
            else:
                rows += [(t, name, [one, *(rate[k] + one)]) for one in (0, 1)]
    rows += [(t, "RCOU", [*(1500 + 400 * commands(t + 1e-6))]) for t in times(0.1)]
    for t, name, values in sorted(rows, key=lambda row: row[0]):
        log.write(name, 1e6 * (30 + t), *values)
    return log


def telemetry(latency: Callable[[int], float]) -> bytes:
    """A .tlog of attitude (10 Hz), a position by GPS (5 Hz) and PWM; `latency(k)` of the k-th message [s]."""
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    other = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    sent: list[tuple[float, Any, Any]] = []
    at = times(0.1)
    seen = truth(at)
    for k, t in enumerate(at):
        boot = round(1e3 * (30 + t))
        sent.append(
            (
                t,
                link,
                dialect.MAVLink_attitude_message(boot, *(float(seen[n][k]) for n in (*ATTITUDE, *RATE))),
            )
        )
    at = times(0.2, 0.02)
    where, seen = position(at), truth(at)
    speed = attitude(at).apply(np.stack([seen[one] for one in VELOCITY], axis=1))
    for t, (north, east, down), velocity in zip(at, where - where[0], speed, strict=True):
        # radii of curvature of WGS 84 at 54 degrees north, along the meridian and across it [m]
        lat = 54 + np.degrees(north / 6377306.9)
        lon = -6 + np.degrees(east / (6392156.1 * np.cos(np.radians(54))))
        centimetres = [round(100 * one) for one in velocity]
        sent.append(
            (
                t,
                link,
                dialect.MAVLink_global_position_int_message(
                    round(1e3 * (30 + t)),
                    round(1e7 * lat),
                    round(1e7 * lon),
                    round(-1e3 * down),
                    0,
                    *centimetres,
                    0,
                ),
            )
        )
    for t in times(0.1):
        pwm = [round(1500 + 400 * one) for one in commands(t + 1e-6)]
        sent.append((t, link, dialect.MAVLink_servo_output_raw_message(round(1e6 * (30 + t)), 0, *pwm)))
    # a ground station that sends an attitude of its own now and then
    sent += [
        (t, other, dialect.MAVLink_attitude_message(0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0)) for t in (3.0, 9.0)
    ]
    data = bytearray()
    for k, (t, sender, message) in enumerate(sorted(sent, key=lambda one: one[0])):
        data += struct.pack(">Q", round(1e6 * (EPOCH + t + latency(k)))) + message.pack(sender)
    return bytes(data)


# --- tables ----------------------------------------------------------------------------------


def matlab() -> dict[str, Any]:
    """Two loggers with times of their own, in seconds and milliseconds, and a matrix of commands."""
    ahrs, dvl, pushed = times(0.1), times(0.4, 0.07), times(0.7)
    seen, slow = truth(ahrs), truth(dvl)
    return {
        "ahrs": {
            "time": ahrs,
            "euler": np.degrees(np.stack([seen[one] for one in ATTITUDE], axis=1)),
            "rate": np.degrees(np.stack([seen[one] for one in RATE], axis=1)),
        },
        "dvl": {"time_ms": 1e3 * dvl, "velocity": np.stack([slow[one] for one in VELOCITY])},
        "command": commands(pushed + 1e-6),
        "command_time": pushed,
        "remark": "calm",
    }


def foreign_table() -> dict[str, np.ndarray]:
    """One clock in milliseconds, other axes, quaternions and PWM."""
    t = times(0.1)
    seen = truth(t)
    turns = Rotation.from_matrix(ENU @ attitude(t).as_matrix() @ FLU).as_quat(scalar_first=True)
    rates = np.degrees(np.stack([seen[one] for one in RATE], axis=1) @ FLU)
    return {
        "time_ms": 1e3 * t,
        "east": seen["y"],
        "north": seen["x"],
        "up": -seen["z"],
        **{f"quat_{part}": values for part, values in zip("wxyz", turns.T, strict=True)},
        **dict(zip(("roll_rate_deg", "pitch_rate_deg", "yaw_rate_deg"), rates.T, strict=True)),
        **{f"pwm_{k + 1}": 1500 + 400 * row for k, row in enumerate(commands(t + 1e-6).T)},
    }
