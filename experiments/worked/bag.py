"""A log as a recorder of ROS 2 would have written it, in the axes of ROS, which are not those of a log."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from jaxmarine._types import CHANNELS
from jaxmarine.logs import Log

# North-east-down to east-north-up, and forward-starboard-down to forward-left-up.
_WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_BODY = np.diag([1.0, -1.0, -1.0])
_STORE = get_typestore(Stores.ROS2_HUMBLE)
_BEGIN = 1_760_000_000  # [s] since 1970


def _message(kind: str, **given: Any) -> Any:
    """A message, with every number that is not given zero."""
    fields: dict[str, Any] = {}
    inner: Any
    for name, (nature, inner) in _STORE.fielddefs[kind][1]:
        if name in given:
            fields[name] = given[name]
        elif nature.name == "BASE":
            fields[name] = "" if inner[0] == "string" else 0
        elif nature.name == "NAME":
            fields[name] = _message(inner)
        else:
            fields[name] = np.zeros(inner[1] if nature.name == "ARRAY" else 0)
    return _STORE.types[kind](**fields)


def _vector(kind: str, values: np.ndarray, names: str = "xyz") -> Any:
    return _message(f"geometry_msgs/msg/{kind}", **dict(zip(names, map(float, values), strict=True)))


def write_bag(log: Log, path: Path) -> None:
    """Writes `/odom` (nav_msgs/Odometry) and `/thrusters` (sensor_msgs/JointState) at the log's times."""
    channels = np.nan_to_num(log.channels)
    commands = np.zeros((len(log.t), 0)) if log.commands is None else log.commands

    place_of = {str(name): i for i, name in enumerate(CHANNELS)}

    def columns(names: str) -> np.ndarray:
        return channels[:, [place_of[name] for name in names.split()]]

    attitude = Rotation.from_euler("ZYX", columns("psi theta phi")).as_matrix()
    turned = Rotation.from_matrix(_WORLD @ attitude @ _BODY).as_quat()
    place, velocity, rate = columns("x y z") @ _WORLD.T, columns("u v w") @ _BODY, columns("p q r") @ _BODY

    def odometry(i: int, header: Any) -> Any:
        pose = _message(
            "geometry_msgs/msg/Pose",
            position=_vector("Point", place[i]),
            orientation=_vector("Quaternion", turned[i], "xyzw"),
        )
        twist = _message(
            "geometry_msgs/msg/Twist",
            linear=_vector("Vector3", velocity[i]),
            angular=_vector("Vector3", rate[i]),
        )
        return _message(
            "nav_msgs/msg/Odometry",
            header=header,
            pose=_message("geometry_msgs/msg/PoseWithCovariance", pose=pose),
            twist=_message("geometry_msgs/msg/TwistWithCovariance", twist=twist),
        )

    def thrusters(i: int, header: Any) -> Any:
        names = list(log.command_names)
        return _message("sensor_msgs/msg/JointState", header=header, name=names, effort=commands[i].copy())

    topics: dict[str, tuple[str, Callable[[int, Any], Any]]] = {
        "/odom": ("nav_msgs/msg/Odometry", odometry),
        "/thrusters": ("sensor_msgs/msg/JointState", thrusters),
    }
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, (kind, message) in topics.items():
            end = writer.add_connection(topic, kind, typestore=_STORE)
            for i, t in enumerate(log.t):
                nanoseconds = _BEGIN * 10**9 + round(float(t) * 1e9)
                stamp = _message(
                    "builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9
                )
                header = _message("std_msgs/msg/Header", stamp=stamp)
                writer.write(end, nanoseconds, _STORE.serialize_cdr(message(i, header), kind))
