"""Bags as a recorder of ROS would have written them, in the axes of ROS, which are not those of a log."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rosbags.rosbag1
import rosbags.rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from jaxmarine._types import CHANNELS
from jaxmarine.logs import Log

EPOCH = 1_700_000_000  # [s] since 1970, when recordings begin
# What turns our vectors into those of ROS: east, north, up, and forward, left, up.
ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU = np.diag([1.0, -1.0, -1.0])
# By topic the type of its messages, and these with their times [s].
Topics = Mapping[str, tuple[str, list[tuple[float, Any]]]]


def nanoseconds(t: float) -> int:
    return EPOCH * 10**9 + round(t * 1e9)


def ros_types(version: int):
    return get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)


def maker(store) -> Callable[..., Any]:
    """Messages by the name of their type, with every field given or zero."""
    arrays = {"float64": np.float64, "float32": np.float32}

    def make(kind: str, **given: Any) -> Any:
        fields = {}
        for name, (nature, inner) in store.fielddefs[kind][1]:
            if name in given:
                fields[name] = given[name]
            elif nature == 1:
                fields[name] = "" if inner[0] == "string" else 0
            elif nature == 2:
                fields[name] = make(inner)
            elif inner[0][0] == 1 and inner[0][1][0] in arrays:
                fields[name] = np.zeros(inner[1], arrays[inner[0][1][0]])
            else:
                fields[name] = []
        return store.types[kind](**fields)

    return make


def header(make: Callable[..., Any], t: float) -> Any:
    """Of a message that was measured at a time [s]."""
    stamp = make("builtin_interfaces/msg/Time", sec=EPOCH + int(t), nanosec=round(t % 1 * 1e9))
    return make("std_msgs/msg/Header", stamp=stamp)


def vector(make: Callable[..., Any], kind: str, values: np.ndarray, names: str = "xyz") -> Any:
    """A vector, a point or a quaternion of `geometry_msgs`."""
    return make(f"geometry_msgs/msg/{kind}", **dict(zip(names, map(float, values), strict=True)))


def odometry(
    make: Callable[..., Any], t: np.ndarray, place, attitude: Rotation, velocity, rate=None
) -> list[tuple[float, Any]]:
    """nav_msgs/Odometry of a motion as a log has it, in the axes of ROS.

    - `place` [times 3, m] NED, `attitude` body to that, `velocity` [m/s] and `rate` [rad/s] in body axes.
    """
    turns = Rotation.from_matrix(ENU @ attitude.as_matrix() @ FLU).as_quat()
    rate = np.zeros((len(t), 3)) if rate is None else rate
    out = []
    for now, at, turn, along, about in zip(t, place @ ENU.T, turns, velocity @ FLU, rate @ FLU, strict=True):
        pose = make(
            "geometry_msgs/msg/Pose",
            position=vector(make, "Point", at),
            orientation=vector(make, "Quaternion", turn, "xyzw"),
        )
        linear, angular = vector(make, "Vector3", along), vector(make, "Vector3", about)
        twist = make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
        message = make(
            "nav_msgs/msg/Odometry",
            header=header(make, now),
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist),
        )
        out.append((now, message))
    return out


def write_bag(path: Path, topics: Topics, late: float = 0.0) -> Path:
    """A bag of ROS 1 (.bag) or 2 (a folder: with mcap in its name by that storage, else by sqlite).

    - `late`: how long after its time a message was recorded [s].
    """
    one = path.suffix == ".bag"
    store = ros_types(1 if one else 2)
    if one:
        writer = rosbags.rosbag1.Writer(path)
        encode = store.serialize_ros1
    else:
        kinds = rosbags.rosbag2.StoragePlugin
        kind = kinds.MCAP if "mcap" in path.name else kinds.SQLITE3
        writer = rosbags.rosbag2.Writer(path, version=9, storage_plugin=kind)
        encode = store.serialize_cdr
    with writer:
        ends = {
            name: writer.add_connection(name, kind, typestore=store) for name, (kind, _) in topics.items()
        }
        recorded = [(t, name, message) for name, (_, found) in topics.items() for t, message in found]
        for t, name, message in sorted(recorded, key=lambda one: one[0]):
            writer.write(ends[name], nanoseconds(t + late), encode(message, topics[name][0]))
    return path


def bag_of(log: Log, path: Path) -> None:
    """Writes `/odom` (nav_msgs/Odometry) and `/thrusters` (sensor_msgs/JointState) at the log's times."""
    make = maker(ros_types(2))
    channels = dict(zip(map(str, CHANNELS), np.nan_to_num(log.channels).T, strict=True))
    commands = np.zeros((len(log.t), 0)) if log.commands is None else log.commands

    def columns(names: str) -> np.ndarray:
        return np.stack([channels[name] for name in names.split()], axis=1)

    attitude = Rotation.from_euler("ZYX", columns("psi theta phi"))
    moved = odometry(make, log.t, columns("x y z"), attitude, columns("u v w"), columns("p q r"))
    names, kind = list(log.command_names), "sensor_msgs/msg/JointState"
    pushed = [
        (t, make(kind, header=header(make, t), name=names, effort=row.copy()))
        for t, row in zip(log.t, commands, strict=True)
    ]
    write_bag(path, {"/odom": ("nav_msgs/msg/Odometry", moved), "/thrusters": (kind, pushed)})
