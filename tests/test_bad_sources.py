"""Recordings that cannot be used are refused in one sentence that says what, where and what to do."""

import builtins
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io

from jaxmarine.logs import ColumnMap, read_log

from . import recordings as made
from .recordings import BOAT
from .test_bad_input import refusal

TIMES = made.times(0.1)


def numbers(version: int, start: float = 0.0, stamps: Callable[[float], float] = lambda t: t) -> made.Topics:
    """A boat's topics: its motion with headers, its commands without."""
    make = made.maker(made.ros_types(version))
    rows = []
    for t in TIMES:
        seconds = stamps(t)
        whole = 0 if seconds < 0 else made.EPOCH + int(seconds)
        part = 0 if seconds < 0 else round(seconds % 1 * 1e9)
        stamp = make("builtin_interfaces/msg/Time", sec=whole, nanosec=part)
        vector = make("geometry_msgs/msg/Vector3", x=np.sin(t), y=np.cos(t), z=0.1 * t)
        header = make("std_msgs/msg/Header", stamp=stamp, frame_id="boat")
        rows.append((t, make("geometry_msgs/msg/Vector3Stamped", header=header, vector=vector)))
    pushed = [(start + t, make("std_msgs/msg/Float64MultiArray", data=np.array([0.1, -0.1]))) for t in TIMES]
    return {
        "/motion": ("geometry_msgs/msg/Vector3Stamped", rows),
        "/push": ("std_msgs/msg/Float64MultiArray", pushed),
        "/silent": ("std_msgs/msg/Float64", []),
    }


NAMES = {
    "u": "/motion.vector.x",
    "v": "/motion.vector.y",
    "r": "/motion.vector.z",
    "left": "/push.data[0]",
    "right": "/push.data[1]",
}


def mapped(**changes: object) -> ColumnMap:
    """The map of those topics with other entries; `time` and `frame` are tables of their own."""
    tables = {name: changes.pop(name) for name in ("time", "frame") if name in changes}
    return ColumnMap.model_validate({"columns": NAMES | changes} | tables)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return made.write_bag(tmp_path_factory.mktemp("bag") / "run.bag", numbers(1))


BAD_PATHS = {
    "no such topic": (
        {"u": "/motoin.vector.x"},
        "has no topic `/motoin`, which the column map names; did you mean `/motion`?",
    ),
    "half a topic": ({"u": "/mot.vector.x"}, "has no topic `/mot`"),
    "no such field": ({"u": "/motion.vector.xx"}, "there is no field `xx`; known are x, y, z."),
    "near field": ({"u": "/motion.vectr.x"}, "did you mean `vector`?"),
    "below a number": ({"u": "/motion.vector.x.y"}, "there are no fields below `/motion.vector.x`."),
    "a hidden attribute": ({"u": "/motion.__class__.x"}, "there is no field `__class__`"),
    "a whole message": (
        {"u": "/motion"},
        "is no number but a message with the fields header, vector; name one of them.",
    ),
    "a whole vector": ({"u": "/motion.vector"}, "a message with the fields x, y, z"),
    "a whole array": (
        {"left": "/push.data"},
        "is no number but an array of 2; name an entry, the first by [0].",
    ),
    "text": ({"u": "/motion.header.frame_id"}, "is no number but 'boat'"),
    "an index without array": ({"u": "/motion.vector[0]"}, "[0] stands behind no array"),
    "beyond the array": ({"left": "/push.data[7]"}, "`left` (`/push.data[7]` in the file) has no value"),
    "no entry of that name": ({"left": "/push.data[name=bow]"}, "has no value"),
    "bad syntax": ({"u": "/motion.vector..x"}, "`/motion.vector..x` is no path from `..x` on"),
    "an open bracket": ({"left": "/push.data[0"}, "is no path from `[0` on"),
    "no message": ({"u": "/silent.data"}, "topic `/silent` has no message"),
    "time of a message": ({"t": "/motion.header.stamp.sec"}, "cannot give those of `t`"),
    "another clock": ({"u": {"from": "/motion.vector.x", "clock": "/push"}}, "cannot give those of `u`"),
    "half a quaternion": ({"qw": "/motion.vector.x"}, "lacks `qx`, without which `qw` cannot be used"),
    "no quaternion": (
        {name: "/motion.vector.z" for name in ("qw", "qx", "qy", "qz")},
        "quaternions have lengths up to 3.98 instead of 1",
    ),
    "the same twice": (
        {"attitude": "/motion.vector", "psi": "/motion.vector.z"},
        "gives both `qw` and `psi`, which measure",
    ),
    "a component twice": ({"velocity": "/motion.vector"}, "gives `u` twice"),
    "world velocity without heading": ({"frame": {"velocity": "world"}}, "no `psi` is mapped"),
    "half a place": ({"latitude": "/motion.vector.x"}, "lacks `longitude`"),
    "a place in radians": (
        {"latitude": {"from": "/motion.vector.x", "unit": "rad"}, "longitude": "/motion.vector.x"},
        "gives `latitude` in rad; it is in degrees",
    ),
    "a speed in degrees": (
        {"u": {"from": "/motion.vector.x", "unit": "deg"}},
        "gives `u` in deg; it is in m/s, so name one of m/s, cm/s, mm/s, kn, and give a scale",
    ),
    "a vector of another quantity": (
        {"velocity": {"from": "/motion.vector", "unit": "deg/s"}},
        "gives `velocity` in deg/s; it is in m/s",
    ),
    "a command with a unit": (
        {"left": {"from": "/push.data[0]", "unit": "us"}},
        "gives `left` in us; it has no unit, so leave the unit out, and give a scale",
    ),
    "times in metres": (
        {"u": {"from": "/motion.vector.x", "clock": {"from": "/motion.vector.y", "unit": "m"}}},
        "gives `u.clock` in m; it is in s",
    ),
    "integers for degrees": (
        {"latitude": {"from": "/motion.vector.x", "scale": 1e7}, "longitude": "/motion.vector.x"},
        "exceeds what degrees can be; scale them, as by 1e-7",
    ),
    "degrees for radians": (
        {"theta": {"from": "/motion.vector.y", "scale": 57.3}, "frame": {"body": "flu"}},
        "`theta` is up to 57.3 rad, which no pitch is",
    ),
    "never a fix": (
        {name: {"from": "/push.data[0]", "offset": -0.1} for name in ("latitude", "longitude")},
        "never have a fix",
    ),
    "command in pulses": ({"left": {"from": "/push.data[0]", "offset": 1500.0}}, "outside [-1, 1]"),
    "too coarse": ({"time": {"dt": 10.0}}, "has 2 rows, but a log needs at least 10"),
    "too fine": ({"time": {"dt": 1e-9}}, "would have 2e+10 rows"),
}


@pytest.mark.parametrize("changes,fragment", BAD_PATHS.values(), ids=BAD_PATHS)
def test_a_bad_path_into_a_bag_is_refused(bag, changes, fragment):
    message = refusal(lambda: read_log(bag, BOAT, mapped(**changes)))
    assert fragment in message and str(bag) in message


def test_a_bag_without_a_map_tells_what_it_holds(bag):
    message = refusal(lambda: read_log(bag, BOAT))
    assert "needs a column map" in message and "`/motion`, `/push`, `/silent`" in message


BAD_TIMES = {
    "a clock that was set": (
        lambda t: t if t < 5 else t - 4,
        0.0,
        "goes back by 3.9 s, 4.9 s after it begins",
    ),
    "one time for all": (lambda t: 3.0, 0.0, "all 200 samples of `u`"),
    "clocks apart": (lambda t: t + 1000, 0.0, "so that they share no time"),
    "one stamp far off": (lambda t: t + 4e8 * (t > 19.85), 0.0, "rows, as its times span 4e+08 s"),
    "commands after all is over": (lambda t: t, 25.0, "so that they share no time"),
}


@pytest.mark.parametrize("stamps,start,fragment", BAD_TIMES.values(), ids=BAD_TIMES)
def test_bad_times_in_a_bag_are_refused(tmp_path, stamps, start, fragment):
    path = made.write_bag(tmp_path / "run.bag", numbers(1, start, stamps))
    assert fragment in refusal(lambda: read_log(path, BOAT, mapped()))


def test_headers_left_at_zero_give_way_to_the_times_of_recording(tmp_path):
    log = read_log(made.write_bag(tmp_path / "run.bag", numbers(1, stamps=lambda t: -1.0)), BOAT, mapped())
    assert len(log.t) == 200
    assert any("`/motion`, `/push` have no time of their own" in note for note in log.notes)


# --- damaged files ---------------------------------------------------------------------------


def dataflash() -> bytes:
    return bytes(made.dataflash().data)


def telemetry() -> bytes:
    return made.telemetry(lambda k: 0.0)


ROV_MAPS = {
    "run.bin": "ardusub_dataflash.toml",
    "run.tlog": "ardusub_telemetry.toml",
    "run.mat": "matlab.toml",
    "run.bag": "ros_odometry.toml",
    "run.db3": "ros_odometry.toml",
    "run.mcap": "ros_odometry.toml",
}


@pytest.mark.parametrize(
    "content", [b"", b"#", b"\x00" * 4096, b"t,u,v\n0,1,2\n" * 200, bytes(range(256)) * 32]
)
@pytest.mark.parametrize("name", ROV_MAPS)
def test_what_is_no_recording_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    message = refusal(lambda: read_log(tmp_path / name, made.ROV, made.MAPS / ROV_MAPS[name]))
    assert message.startswith(str(tmp_path / name))


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """A good file of each format."""
    folder = tmp_path_factory.mktemp("whole")
    scipy.io.savemat(folder / "run.mat", made.matlab())
    bags = {
        "run.bag": made.write_bag(folder / "run.bag", made.odometry(1)),
        "run.db3": next(made.write_bag(folder / "sqlite", made.odometry(2)).glob("*.db3")),
        "run.mcap": next(made.write_bag(folder / "mcap", made.odometry(2)).glob("*.mcap")),
        "run.mat": folder / "run.mat",
    }
    return {"run.bin": dataflash(), "run.tlog": telemetry()} | {
        name: path.read_bytes() for name, path in bags.items()
    }


@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.99])
@pytest.mark.parametrize("name", ROV_MAPS)
def test_a_file_that_is_cut_off_is_refused_or_read_as_far_as_it_goes(tmp_path, whole, name, share):
    (tmp_path / name).write_bytes(whole[name][: int(share * len(whole[name]))])

    def read():
        return read_log(tmp_path / name, made.ROV, made.MAPS / ROV_MAPS[name])

    # what was written message by message is good up to the cut; what has an index at its end is not
    if name in ("run.bin", "run.tlog") and share > 0.1:
        assert read().t[-1] - read().t[0] < made.LENGTH * share + 0.5
    else:
        refusal(read)


@pytest.mark.parametrize("name", ROV_MAPS)
def test_damaged_bytes_give_a_sentence_or_a_log(tmp_path, whole, name):
    rng = np.random.default_rng(11)
    for _ in range(4):
        data = np.frombuffer(whole[name], np.uint8).copy()
        at = rng.integers(0, len(data), 20)
        data[at] = rng.integers(0, 256, 20)
        (tmp_path / name).write_bytes(data.tobytes())
        try:
            log = read_log(tmp_path / name, made.ROV, made.MAPS / ROV_MAPS[name])
        except ValueError:
            refusal(lambda: read_log(tmp_path / name, made.ROV, made.MAPS / ROV_MAPS[name]))
        else:
            assert np.all(np.diff(log.t) > 0)


BAD_SETS = {
    "names that leave the folder": ("run.db3", "../../run.db3", "missing"),
    "a version to come": ("version: 9", "version: 99", "version 99 not supported"),
    "another storage": ("sqlite3", "tape", "Storage plugin 'tape' not supported"),
    "no metadata": ("rosbag2_bagfile_information", "other", "metadata key is missing"),
    "nested without end": ("rosbag2_bagfile_information", "[" * 1000, "cannot be read as a ROS bag"),
}


@pytest.mark.parametrize("old,new,fragment", BAD_SETS.values(), ids=BAD_SETS)
def test_a_bad_folder_of_a_bag_is_refused(tmp_path, old, new, fragment):
    folder = made.write_bag(tmp_path / "run", numbers(2))
    (folder / "run.db3").rename(tmp_path / "outside.db3" if "leave" in fragment else folder / "run.db3")
    text = (folder / "metadata.yaml").read_text()
    assert old in text
    (folder / "metadata.yaml").write_text(text.replace(old, new))
    if "missing" in fragment and old == "run.db3":
        (folder / "run.db3").rename(tmp_path / "run.db3")
    assert fragment in refusal(lambda: read_log(folder, BOAT, mapped()))


def test_a_type_that_nobody_defines_is_refused(tmp_path):
    import sqlite3

    folder = made.write_bag(tmp_path / "run", numbers(2))
    base = sqlite3.connect(folder / "run.db3")
    base.executescript(
        "UPDATE schema SET schema_version = 3; DROP TABLE message_definitions;"
        "UPDATE topics SET type = 'our_msgs/msg/Motion' WHERE name = '/motion';"
    )
    base.close()
    message = refusal(lambda: read_log(folder / "run.db3", BOAT, mapped()))
    assert "topic `/motion` holds our_msgs/msg/Motion, a type that the bag does not define" in message


def test_code_in_a_definition_is_not_run(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(builtins, "owned", lambda: ran.append(1), raising=False)
    folder = made.write_bag(tmp_path / "run_mcap", numbers(2))
    file = next(folder.glob("*.mcap"))
    whole = file.read_bytes()
    assert b"float64 x\n" in whole
    for attack in (b"owned()  #", b'"""\nowned()', b"a=owned() #"):
        file.write_bytes(whole.replace(b"float64 x\n", attack[:10]))
        refusal(lambda: read_log(file, BOAT, mapped()))
    assert not ran


def test_an_mcap_file_that_claims_a_terabyte_is_refused(tmp_path):
    folder = made.write_bag(tmp_path / "run_mcap", made.odometry(2))
    file = next(folder.glob("*.mcap"))
    data = bytearray(file.read_bytes())
    at, summary = 0, struct.unpack("<Q", data[-28:-20])[0]
    while summary + at < len(data) - 37:
        kind, size = struct.unpack_from("<BQ", data, summary + at)
        if kind == 8:  # an entry of the index; its last number is how long the chunk is when unpacked
            struct.pack_into("<Q", data, summary + at + 9 + size - 8, 10**12)
        at += 9 + size
    file.write_bytes(bytes(data))
    for path in (file, folder):
        message = refusal(lambda: read_log(path, made.ROV, made.MAPS / "ros_odometry.toml"))  # noqa: B023
        assert "claims a chunk of 1000 GB" in message


def test_a_missing_library_is_named_with_what_installs_it(bag, monkeypatch):
    plain = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("rosbags"):
            raise ModuleNotFoundError("No module named 'rosbags'", name="rosbags")
        return plain(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    message = refusal(lambda: read_log(bag, BOAT, mapped()))
    assert "needs the library rosbags" in message and "pip install 'jaxmarine[bags]'" in message


# --- ArduPilot -------------------------------------------------------------------------------

BAD_MESSAGES = {
    "no such message": (
        "ATT.Roll",
        "ATTT.Roll",
        "has no message `ATTT`, which the column map names; did you mean `ATT`?",
    ),
    "no such field": ("ATT.Roll", "ATT.Rol", "there is no field `Rol`; did you mean `Roll`?"),
    "no such instance": (
        "XKF1[0].PN",
        "XKF1[5].PN",
        "has no `XKF1[5]`, which the column map names; `XKF1` has the instances 0, 1",
    ),
    "no instances": ("ATT.Roll", "ATT[0].Roll", "`ATT` has no instances"),
    "no time": ("ATT.Roll", "TEXT.Name", "message `TEXT` has no time"),
    "text": ('unit = "deg"}', 'unit = "grad"}', "is 'grad', which is no unit of a map"),
}


@pytest.mark.parametrize("old,new,fragment", BAD_MESSAGES.values(), ids=BAD_MESSAGES)
def test_a_bad_path_into_a_dataflash_log_is_refused(tmp_path, old, new, fragment):
    (tmp_path / "log.bin").write_bytes(dataflash())
    text = (made.MAPS / "ardusub_dataflash.toml").read_text()
    assert old in text
    (tmp_path / "map.toml").write_text(text.replace(old, new, 1))
    assert fragment in refusal(lambda: read_log(tmp_path / "log.bin", made.ROV, tmp_path / "map.toml"))


# --- tables ----------------------------------------------------------------------------------


def test_a_new_matlab_file_is_told_how_to_save(tmp_path):
    (tmp_path / "run.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF")
    assert "save(name, '-v7')" in refusal(lambda: read_log(tmp_path / "run.mat", BOAT))


BAD_CLOCKS = {
    "no clock": ({"x": "x"}, {}, "has no column `t`"),
    "own clock missing": (
        {"t": "time", "x": {"from": "x", "clock": "tx"}},
        {},
        "has no column `tx`, which the column map names for `x.clock`",
    ),
    "no time for one": ({"x": {"from": "x", "clock": "time"}}, {}, "has no times for `y`"),
    "other lengths": ({"t": "time", "x": "short"}, {}, "has 90 values, but its times `time` are 200"),
    "turned rows that go back": ({"t": "back"}, {"world": "enu"}, "must strictly increase"),
    "bad axes": ({"t": "time"}, {"world": "seu"}, "must be"),
}


@pytest.mark.parametrize("columns,frame,fragment", BAD_CLOCKS.values(), ids=BAD_CLOCKS)
def test_bad_clocks_of_tables_are_refused(tmp_path, columns, frame, fragment):
    t = TIMES
    names = dict.fromkeys(("x", "y", "psi", "left", "right"), 0 * t)
    table = names | {"time": t, "back": t[::-1].copy(), "short": t[:90]}
    scipy.io.savemat(tmp_path / "run.mat", table)
    lines = [f"{name} = {_toml(one)}" for name, one in columns.items()]
    axes = [f'{name} = "{one}"' for name, one in frame.items()]
    (tmp_path / "map.toml").write_text("\n".join(["[columns]", *lines, "[frame]", *axes]))
    assert fragment in refusal(lambda: read_log(tmp_path / "run.mat", BOAT, tmp_path / "map.toml"))


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f'{key} = "{one}"' for key, one in value.items()) + "}"
    return f'"{value}"'


def test_a_data_frame_with_two_columns_of_one_name_is_refused():
    frame = pd.DataFrame(np.zeros((20, 2)), columns=["u", "u"])
    assert "DataFrame: has 2 columns named `u`" in refusal(lambda: read_log(frame, BOAT))
