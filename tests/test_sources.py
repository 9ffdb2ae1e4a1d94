"""Recordings as they come: every format, other axes and units, clocks of their own."""

import datetime
import shutil

import numpy as np
import pandas as pd
import pytest
import scipy.io
from scipy.spatial.transform import Rotation

from jaxmarine._types import ATTITUDE, CHANNELS, POSITION, RATE, VELOCITY
from jaxmarine.logs import ColumnMap, Log, read_log
from jaxmarine.logs._grid import on_one_clock
from jaxmarine.logs._sources import Series

from . import recordings as made
from .recordings import BOAT, MAPS, ROV, truth


def start_of(log: Log) -> float:
    """The truth's time of the log's time 0 [s], as its notes tell it to the microsecond."""
    note = next((note for note in log.notes if note.startswith("Time 0 of the log is ")), None)
    if note is None:
        return 0.0
    moment = datetime.datetime.fromisoformat(note.removeprefix("Time 0 of the log is ").removesuffix(" UTC."))
    return moment.replace(tzinfo=datetime.UTC).timestamp() - made.EPOCH


def errors(log: Log, start: float | None = None) -> dict[str, float]:
    """Largest error of each measured channel, `start` being the truth's time of the log's time 0 [s]."""
    exact = truth(log.t + (start_of(log) if start is None else start))
    found = {}
    for name in log.measured:
        off = log.channels[:, CHANNELS.index(name)] - exact[name]
        off = np.angle(np.exp(1j * off)) if name in ATTITUDE else off
        found[name] = float(np.nanmax(np.abs(off)))
    return found


def samples(log: Log, name: str) -> int:
    return int(np.count_nonzero(np.isfinite(log.channels[:, CHANNELS.index(name)])))


def applied(log: Log, start: float | None = None) -> np.ndarray:
    """What was commanded on the average from each row to the next, by sums over a fine grid."""
    start = start_of(log) if start is None else start
    fine = np.linspace(0.0, 1.0, 2001)[:-1] + 0.5 / 2000
    step = np.diff(log.t, append=2 * log.t[-1] - log.t[-2])
    return np.stack(
        [made.commands(start + t + fine * dt).mean(axis=0) for t, dt in zip(log.t, step, strict=True)]
    )


# --- ROS -------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["run.bag", "run_sqlite", "run_mcap"])
def bag(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / request.param
    return made.write_bag(path, made.odometry(1 if path.suffix else 2), late=0.013)


def test_a_bag_in_the_axes_of_ros_is_read_as_what_happened(bag):
    log = read_log(bag, ROV, MAPS / "ros_odometry.toml")
    assert log.measured == CHANNELS[:12]
    # Rows are the 50 Hz samples of the gyroscope, so that 20 Hz ones are up to 0.01 s off; the largest
    # slopes are 1.8 m/s, 1 rad/s, 1.1 m/s² and 0.3 rad/s².
    assert start_of(log) == pytest.approx(0.003, abs=1e-6)
    worst = errors(log)
    assert max(worst[name] for name in RATE) < 1e-5  # times since 1970 are told to 0.2 µs
    assert max(worst[name] for name in POSITION) < 0.018
    assert max(worst[name] for name in ATTITUDE) < 0.01
    assert max(worst[name] for name in VELOCITY) < 0.012
    # nothing is invented: as many samples as were recorded after the first row, in a gap none
    assert samples(log, "r") == len(log.t) == 1000
    assert samples(log, "x") == 360 and samples(log, "z") == 80
    quiet = (log.t > 8.0) & (log.t < 9.98)
    assert np.isnan(log.channels[quiet, 0]).all() and np.isfinite(log.channels[quiet, 9]).all()
    assert np.allclose(log.commands, applied(log), atol=1e-3)
    assert any("`z` are sampled every 0.25 s" in note for note in log.notes)


def test_single_files_of_a_ros_2_bag_are_read_like_its_folder(tmp_path):
    folder = made.write_bag(tmp_path / "run_mcap", made.odometry(2))
    whole = read_log(folder, ROV, MAPS / "ros_odometry.toml")
    alone = read_log(next(folder.glob("*.mcap")), ROV, MAPS / "ros_odometry.toml")
    assert np.array_equal(whole.channels, alone.channels, equal_nan=True)
    folder = made.write_bag(tmp_path / "run_sqlite", made.odometry(2))
    alone = read_log(next(folder.glob("*.db3")), ROV, MAPS / "ros_odometry.toml")
    assert np.array_equal(whole.channels, alone.channels, equal_nan=True)


def test_the_times_of_recording_can_be_asked_for(tmp_path):
    path = made.write_bag(tmp_path / "run.bag", made.odometry(1), late=0.25)
    text = (MAPS / "ros_odometry.toml").read_text() + '\n[time]\nstamp = "bag"\n'
    (tmp_path / "map.toml").write_text(text)
    log = read_log(path, ROV, tmp_path / "map.toml")
    assert start_of(log) == pytest.approx(0.253, abs=1e-6)


def test_messages_without_headers_are_averaged_onto_the_spacing_that_is_asked_for(tmp_path):
    make = made.maker(made.ros_types(1))
    pose, velocity, pushed = made.times(0.0071), made.times(0.017, 0.001), made.times(0.0137)
    topics = {
        "/vectornav/ins_2d/NED_pose": (
            "geometry_msgs/msg/Pose2D",
            [
                (
                    t,
                    make(
                        "geometry_msgs/msg/Pose2D", x=np.sin(t), y=np.cos(t), theta=np.angle(np.exp(1j * t))
                    ),
                )
                for t in pose
            ],
        ),
        "/vectornav/ins_2d/local_vel": (
            "geometry_msgs/msg/Vector3",
            [(t, make("geometry_msgs/msg/Vector3", x=np.sin(t), y=0.1 * t, z=np.cos(t))) for t in velocity],
        ),
    }
    for name, side in (("left", 0), ("right", 1)):
        topics[f"/usv_control/controller/{name}_thruster"] = (
            "std_msgs/msg/Float64",
            [(t, make("std_msgs/msg/Float64", data=36.5 * np.sin(t + side))) for t in pushed],
        )
    log = read_log(made.write_bag(tmp_path / "boat.bag", topics), BOAT, MAPS / "vtec_s3_usv.toml")
    assert np.allclose(np.diff(log.t), 0.05) and log.measured == ("x", "y", "psi", "u", "v", "r")
    exact = dict(x=np.sin, y=np.cos, psi=lambda t: t, u=np.sin, v=lambda t: 0.1 * t, r=np.cos)
    for name, of in exact.items():
        # Averages by a line over 0.05 s: half a curvature times the mean square distance, 1e-4 s².
        off = log.channels[2:-2, CHANNELS.index(name)] - of(log.t[2:-2])
        assert np.max(np.abs(np.angle(np.exp(1j * off)))) < 3e-4, name
    middle = log.t[:-1] + 0.025  # a command that changes every 0.0137 s is 0.007 s late
    assert np.allclose(log.commands[:-1, 1], np.sin(middle - 0.0137 / 2 + 1), atol=6e-3)
    assert any("have no time of their own" in note for note in log.notes)


def test_the_entry_of_an_array_is_found_by_a_name_in_it(tmp_path):
    make = made.maker(made.ros_types(2))

    def transform(child: str, x: float):
        move = make("geometry_msgs/msg/Transform", translation=make("geometry_msgs/msg/Vector3", x=x))
        return make("geometry_msgs/msg/TransformStamped", child_frame_id=child, transform=move)

    rows = [
        (t, make("tf2_msgs/msg/TFMessage", transforms=[transform("camera", -1.0), transform("base", t)]))
        for t in made.times(0.1)
    ]
    rows[5] = (rows[5][0], make("tf2_msgs/msg/TFMessage", transforms=[transform("camera", -1.0)]))
    turned = [(t, make("std_msgs/msg/Float64", data=0.0)) for t in made.times(0.1)]
    kinds = {"/tf": ("tf2_msgs/msg/TFMessage", rows), "/zero": ("std_msgs/msg/Float64", turned)}
    names = dict.fromkeys(("y", "psi", "left", "right"), "/zero.data")
    place = "/tf.transforms[child_frame_id=base].transform.translation.x"
    log = read_log(
        made.write_bag(tmp_path / "run", kinds),
        BOAT,
        ColumnMap.model_validate({"columns": names | {"x": place}}),
    )
    assert samples(log, "x") == len(log.t) - 1
    assert np.nanmax(np.abs(log.channels[:, 0] - log.t)) < 1e-6


def test_a_bag_before_iron_needs_no_definitions_of_common_messages(tmp_path):
    import sqlite3

    folder = made.write_bag(tmp_path / "run_sqlite", made.odometry(2))
    file = next(folder.glob("*.db3"))
    whole = read_log(file, ROV, MAPS / "ros_odometry.toml")
    base = sqlite3.connect(file)
    base.executescript("UPDATE schema SET schema_version = 3; DROP TABLE message_definitions;")
    base.close()
    assert np.array_equal(
        read_log(file, ROV, MAPS / "ros_odometry.toml").channels, whole.channels, equal_nan=True
    )


# --- ArduPilot -------------------------------------------------------------------------------


def test_a_dataflash_log_is_read_in_degrees_pulses_and_world_velocities(tmp_path):
    (tmp_path / "00000001.BIN").write_bytes(made.dataflash().data)
    log = read_log(tmp_path / "00000001.BIN", ROV, MAPS / "ardusub_dataflash.toml")
    assert log.measured == CHANNELS[:12] and log.t[0] == pytest.approx(30.0)
    worst = errors(log, start=-30.0)
    # hundredths of a degree; 10 Hz samples stand in 25 Hz rows up to 0.02 s off, at slopes as above
    assert max(worst[name] for name in ATTITUDE) < np.radians(0.0051)
    assert max(worst[name] for name in POSITION) < 0.036
    assert max(worst[name] for name in VELOCITY) < 0.024
    assert max(worst[name] for name in RATE) < 1e-3
    assert samples(log, "u") == 199 or samples(log, "u") == 200
    assert np.allclose(log.commands, applied(log, -30.0), atol=0.08)  # the PWM is told every 0.1 s only
    assert np.mean(np.abs(log.commands - applied(log, -30.0))) < 0.01


def test_the_library_of_ardupilot_reads_the_same_numbers(tmp_path):
    from pymavlink.DFReader import DFReader_binary

    from jaxmarine.logs._sources._dataflash import DataFlash

    path = tmp_path / "log.bin"
    path.write_bytes(made.dataflash().data)
    wanted = ["ATT.Yaw", "XKF1[0].VD", "XKF1[1].VD", "IMU[1].GyrZ", "RCOU.C8"]
    found = DataFlash(path, "header").read(wanted)
    log, theirs = DFReader_binary(str(path), zero_time_base=True), {name: [] for name in wanted}
    while (message := log.recv_match(type=["ATT", "XKF1", "IMU", "RCOU"], strict=True)) is not None:
        for name in wanted:
            head, column = name.split(".")
            instance = message.fmt.instance_field
            if head == message.get_type() + (f"[{getattr(message, instance)}]" if instance else ""):
                theirs[name].append((1e-6 * message.TimeUS, getattr(message, column)))
    log.close()
    for name in wanted:
        assert np.allclose(np.stack(found[name], axis=1), theirs[name], rtol=1e-12, atol=0), name


def test_an_instance_is_the_one_that_is_asked_for(tmp_path):
    (tmp_path / "log.bin").write_bytes(made.dataflash().data)
    text = (MAPS / "ardusub_dataflash.toml").read_text()
    (tmp_path / "map.toml").write_text(
        text.replace("IMU[0].GyrX", "IMU[1].GyrX").replace("IMU[0].GyrY", "IMU.GyrY")
    )
    log = read_log(tmp_path / "log.bin", ROV, tmp_path / "map.toml")
    off = log.channels - np.stack(list(truth(log.t - 30.0).values()) + [np.nan + log.t] * 6, axis=1)
    assert np.nanmedian(off[:, CHANNELS.index("p")]) == pytest.approx(1.0, abs=1e-3)
    assert np.nanmedian(off[:, CHANNELS.index("q")]) == pytest.approx(0.0, abs=1e-3)
    assert "Message `IMU` has the instances 0, 1; `IMU[0]` is read." in log.notes


def test_telemetry_is_read_without_the_delays_of_its_link(tmp_path):
    late = np.random.default_rng(5).exponential(0.03, 1000)
    (tmp_path / "run.tlog").write_bytes(made.telemetry(lambda k: late[k]))
    log = read_log(tmp_path / "run.tlog", ROV, MAPS / "ardusub_telemetry.toml")
    worst = errors(log)
    assert max(worst[name] for name in (*ATTITUDE, *RATE)) < 1e-3  # times in ms, at 1 rad/s
    first = truth(np.array([0.02]))  # of GPS positions, about which the others count; altitudes in mm
    assert max(abs(worst[name]) for name in ("x", "y")) < 5.0  # they start at zero
    for name in POSITION:
        seen = log.channels[:, CHANNELS.index(name)] + first[name]
        # integers of 1e-7 degrees are 0.011 m; samples are 0.02 s off at up to 1.5 m/s
        assert np.nanmax(np.abs(seen - truth(log.t + start_of(log))[name])) < 0.045, name
    assert max(worst[name] for name in VELOCITY) < 0.01 + 0.02 * 1.1
    assert np.mean(np.abs(log.commands - applied(log))) < 0.01
    assert any("comes from 2 senders; system 1, component 1" in note for note in log.notes)


def test_telemetry_by_times_of_reception_is_late(tmp_path):
    (tmp_path / "run.tlog").write_bytes(made.telemetry(lambda k: 0.1 * (k % 2)))
    text = (MAPS / "ardusub_telemetry.toml").read_text() + '\n[time]\nstamp = "bag"\n'
    (tmp_path / "map.toml").write_text(text)
    assert errors(read_log(tmp_path / "run.tlog", ROV, tmp_path / "map.toml"))["psi"] > 0.05


# --- tables ----------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
def test_a_matlab_file_with_several_clocks(tmp_path, compressed):
    scipy.io.savemat(tmp_path / "run.mat", made.matlab(), do_compression=compressed)
    log = read_log(tmp_path / "run.mat", ROV, MAPS / "matlab.toml")
    worst = errors(log)
    assert max(worst[name] for name in (*ATTITUDE, *RATE)) < 1e-6
    assert max(worst[name] for name in VELOCITY) < 0.05 * 1.1  # 2.5 Hz ones stand in 10 Hz rows
    assert samples(log, "psi") == 200 and samples(log, "u") == 50
    assert np.allclose(log.commands, applied(log), atol=1e-3)


def test_a_matlab_file_in_our_names_needs_no_map(tmp_path):
    t = made.times(0.1)
    columns = {name: truth(t)[name] for name in ("x", "y", "psi")} | {
        "t": t[:, None],
        "left": 0 * t,
        "right": 0 * t,
    }
    scipy.io.savemat(tmp_path / "run.mat", columns | {"about": "calm"})
    with pytest.raises(ValueError, match="lacks"):
        read_log(tmp_path / "run.mat", ROV)
    assert max(errors(read_log(tmp_path / "run.mat", BOAT)).values()) < 1e-9


@pytest.mark.parametrize("kind", ["csv", "parquet", "frame"])
def test_a_foreign_table_in_other_axes_keeps_its_rows(tmp_path, kind):
    table = pd.DataFrame(made.foreign_table()).assign(mood="good")
    table.loc[40, "quat_x"] = np.nan
    source = tmp_path / f"run.{kind}"
    if kind == "csv":
        table.to_csv(source, index=False)
    elif kind == "parquet":
        table.to_parquet(source)
    log = read_log(table if kind == "frame" else source, ROV, MAPS / "foreign_csv.toml")
    assert log.name == ("DataFrame" if kind == "frame" else source.name)
    assert np.allclose(log.t, made.times(0.1), atol=1e-12)
    assert max(errors(log).values()) < 1e-6
    assert np.isnan(log.channels[40, 3:6]).all() and samples(log, "psi") == len(log.t) - 1
    assert np.allclose(log.commands, made.commands(log.t + 1e-6), atol=1e-9)
    assert log.notes == (
        "Columns that nothing knows are ignored: `mood`.",
        "Column `psi` is wrapped 2 times; it counts modulo a turn.",
    )


def test_a_data_frame_in_our_names_is_a_log():
    t = made.times(0.1)
    frame = pd.DataFrame(truth(t) | dict.fromkeys(made.THRUSTERS, 0.5)).set_index(pd.Index(t, name="t"))
    log = read_log(frame, ROV)
    assert np.array_equal(log.t, t) and log.measured == CHANNELS[:12]


# --- axes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("world", ["ned", "enu"])
@pytest.mark.parametrize("body", ["frd", "flu"])
@pytest.mark.parametrize("by", ["euler", "quaternion"])
def test_every_pair_of_axes_is_turned_by_rotations(world, body, by):
    t = made.times(0.1)
    seen = truth(t)
    outer, inner = {"ned": np.eye(3), "enu": made.ENU}[world], {"frd": np.eye(3), "flu": made.FLU}[body]
    turns = Rotation.from_matrix(outer @ made.attitude(t).as_matrix() @ inner)
    frame = {"t": t} | dict.fromkeys(made.THRUSTERS, 0.0 * t)
    for names, axes in ((POSITION, outer), (RATE, inner)):
        frame |= dict(zip(names, axes @ np.stack([seen[name] for name in names]), strict=True))
    # the velocity along the file's world axes
    along = outer @ made.attitude(t).apply(np.stack([seen[name] for name in VELOCITY], axis=1)).T
    frame |= dict(zip(VELOCITY, along, strict=True))
    if by == "euler":
        frame |= dict(zip(ATTITUDE, turns.as_euler("ZYX").T[::-1], strict=True))
        columns = {}
    else:
        frame |= dict(zip(("a.w", "a.x", "a.y", "a.z"), turns.as_quat(scalar_first=True).T, strict=True))
        columns = {"attitude": "a"}
    columns = {"columns": columns, "frame": {"world": world, "body": body, "velocity": "world"}}
    log = read_log(pd.DataFrame(frame), ROV, ColumnMap.model_validate(columns))
    assert log.measured == CHANNELS[:12]
    assert max(errors(log).values()) < 1e-6


def test_latitudes_are_metres_north_of_the_first_fix():
    # Oracle: cartesian coordinates about the earth's centre, turned into the horizon of the first fix.
    t = made.times(0.1)
    lat, lon = -33.0 + 0.003 * np.sin(0.3 * t), 179.999 + 0.002 * np.sin(0.2 * t)  # across the date line
    a, flat = 6378137.0, 1 / 298.257223563
    p, m = np.radians(lat), np.radians(lon)
    bend = a / np.sqrt(1 - flat * (2 - flat) * np.sin(p) ** 2)
    centre = np.stack(
        [bend * np.cos(p) * np.cos(m), bend * np.cos(p) * np.sin(m), bend * (1 - flat) ** 2 * np.sin(p)]
    )
    north = [-np.sin(p[0]) * np.cos(m[0]), -np.sin(p[0]) * np.sin(m[0]), np.cos(p[0])]
    east = [-np.sin(m[0]), np.cos(m[0]), 0.0]
    exact = np.array([north, east]) @ (centre - centre[:, :1])
    wrapped = np.where(lon > 180, lon - 360, lon)
    frame = {"lat": lat, "lon": wrapped, "h": 10 - t, "psi": 0 * t, "t": t, "left": 0 * t, "right": 0 * t}
    # Degrees are what these columns are given in, so that the unit may be named or not.
    names = {"latitude": {"from": "lat", "unit": "deg"}, "longitude": "lon", "altitude": "h"}
    log = read_log(pd.DataFrame(frame), BOAT, ColumnMap.model_validate({"columns": names}))
    # 390 m away a meridian has turned by 4e-5 rad
    assert np.max(np.abs(log.channels[:, :2].T - exact)) < 0.02
    assert np.allclose(log.channels[:, 2], t)


# --- one clock -------------------------------------------------------------------------------


def test_a_fast_sensor_is_averaged_without_delay_and_its_noise_falls():
    rng = np.random.default_rng(0)
    fast = np.sort(rng.uniform(0, 200, 20_000))
    noisy = Series(fast, np.sin(fast) + rng.normal(0, 0.1, len(fast)))
    t, columns, _ = on_one_clock({"u": noisy}, ["u"], [], 0.1, "made")
    off = columns["u"] - np.sin(t)
    ahead = np.nanmean(off * np.cos(t)) / np.mean(np.cos(t) ** 2)  # seconds by which it leads
    assert abs(ahead) < 4 * 0.1 / np.sqrt(10) / np.sqrt(len(t) / 2)
    assert 0.9 < np.nanstd(off) / (0.1 / np.sqrt(10)) < 1.25  # a line costs little more than a mean
    assert abs(np.corrcoef(off[1:], off[:-1])[0, 1]) < 4 / np.sqrt(len(t))  # white, as none is used twice


def test_samples_to_one_side_of_their_rows_are_no_delay():
    # ten samples a row that lie from 0.05 s before it to 0.04 s behind: a plain mean would be 0.005 s early
    fast = Series(0.01 * np.arange(2000), 3.0 * 0.01 * np.arange(2000))
    t, columns, _ = on_one_clock({"u": fast}, ["u"], [], 0.1, "made")
    assert np.allclose(columns["u"][1:-1], 3.0 * t[1:-1], atol=1e-9)


def test_a_slow_sensor_has_as_many_samples_as_it_took():
    fast, slow = 0.05 * np.arange(400), 0.33 * np.arange(1, 60)
    series = {"u": Series(fast, fast), "x": Series(slow, np.cos(slow))}
    t, columns, notes = on_one_clock(series, ["u", "x"], [], None, "made")
    assert np.array_equal(t, fast) and np.array_equal(columns["u"], fast)
    seen = np.isfinite(columns["x"])
    assert np.count_nonzero(seen) == len(slow)
    assert np.max(np.abs(t[seen] - slow)) <= 0.025 + 1e-9
    # to first order: 0.025² / 2, and a slope over 0.66 s that is 2 % small; 0.025 if it stood as it was
    assert np.max(np.abs(columns["x"][seen] - np.cos(t[seen]))[1:-1]) < 9e-4
    assert any("`x` are sampled every 0.33 s" in note for note in notes)


def test_samples_in_the_nearest_row_keep_their_noise_and_its_independence():
    rng = np.random.default_rng(1)
    fast, slow = 0.05 * np.arange(40_000), np.sort(0.125 * np.arange(15_900) + rng.uniform(0, 0.02, 15_900))
    series = {"psi": Series(fast, fast), "u": Series(slow, rng.normal(0, 1.0, len(slow)))}
    _, columns, _ = on_one_clock(series, ["psi", "u"], [], None, "made")
    noise = columns["u"][np.isfinite(columns["u"])]
    assert np.std(noise) == pytest.approx(1.0, abs=0.03)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.05


def test_a_command_is_neither_late_nor_lost():
    t = 0.1 * np.arange(100)
    changes = np.array([0.0, 1.03, 1.05, 4.0, 7.77])
    series = {"u": Series(t, t), "port": Series(changes, np.array([0.0, 1.0, -0.5, 0.25, 0.8]))}
    rows, columns, _ = on_one_clock(series, ["u"], ["port"], None, "made")
    port = dict(zip(np.round(rows, 6), columns["port"], strict=True))
    assert port[0.9] == 0.0 and port[1.1] == -0.5 and port[3.9] == -0.5 and port[4.0] == 0.25
    assert port[1.0] == pytest.approx(0.2 * 1.0 + 0.5 * -0.5) and port[7.7] == pytest.approx(
        0.7 * 0.25 + 0.3 * 0.8
    )
    assert port[9.9] == 0.8


def test_a_gap_of_the_fastest_sensor_leaves_rows_for_the_others():
    fast = 0.1 * np.arange(200)
    series = {"u": Series(fast[(fast < 5) | (fast > 12)], np.ones(130)[: np.sum((fast < 5) | (fast > 12))])}
    series["x"] = Series(0.5 * np.arange(40), np.arange(40.0))
    t, columns, _ = on_one_clock(series, ["u", "x"], [], None, "made")
    assert np.max(np.diff(t)) < 0.15
    assert np.count_nonzero(np.isfinite(columns["x"])) == 40
    assert np.isnan(columns["u"][(t > 5.05) & (t < 11.95)]).all()


def test_swapped_and_repeated_samples_are_put_right_and_told(tmp_path):
    topics = dict(made.odometry(1))
    kind, rows = topics["/imu"]
    stamps = [message.header for _, message in rows]
    rows[100][1].header, rows[101][1].header = stamps[101], stamps[100]
    rows[100][1].angular_velocity, rows[101][1].angular_velocity = (
        rows[101][1].angular_velocity,
        rows[100][1].angular_velocity,
    )
    topics["/imu"] = (kind, [*rows[:300], rows[299], *rows[300:]])
    log = read_log(made.write_bag(tmp_path / "run.bag", topics), ROV, MAPS / "ros_odometry.toml")
    assert max(errors(log)[name] for name in RATE) < 1e-5
    assert any("out of order" in note for note in log.notes) and any("left out" in note for note in log.notes)


def test_an_angle_is_averaged_across_its_wrap():
    fast = 0.01 * np.arange(3000)
    psi = Series(fast, np.angle(np.exp(1j * 2 * fast)))
    t, columns, _ = on_one_clock({"psi": psi}, ["psi"], [], 0.1, "made")
    assert np.max(np.abs(np.angle(np.exp(1j * (columns["psi"] - 2 * t))))) < 1e-9


def test_a_half_copied_folder_is_no_bag(tmp_path):
    folder = made.write_bag(tmp_path / "run", made.odometry(2))
    shutil.copy(folder / "metadata.yaml", tmp_path / "metadata.yaml")
    with pytest.raises(ValueError, match="missing"):
        read_log(tmp_path, ROV, MAPS / "ros_odometry.toml")
