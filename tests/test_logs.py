"""Logs: reading and writing, noise, first guesses of the motion."""

import gzip
import types
from pathlib import Path

import equinox as eqx
import hypothesis
import hypothesis.extra.numpy as arrays_of
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from jaxmarine._errors import InputError
from jaxmarine._types import ATTITUDE, CHANNELS, DOFS
from jaxmarine.logs import (
    ColumnMap,
    Log,
    estimate_noise,
    read_columns,
    read_log,
    sensor_noise,
    smooth_states,
    write_log,
)
from jaxmarine.vehicle_file import read_vehicle_file
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle

PLANAR = types.SimpleNamespace(
    dof=("surge", "sway", "yaw"),
    command_names=("port", "star"),
    command_limits=np.array([1.0, 1.2]),
)
FULL = types.SimpleNamespace(dof=DOFS, command_names=("main",), command_limits=np.ones(1))


def planar_table(rows: int = 12) -> pd.DataFrame:
    t = 0.1 * np.arange(rows)
    names = ("x", "y", "psi", "u", "v", "r")
    motion = {name: np.sin(t + number) for number, name in enumerate(names)}
    return pd.DataFrame({"t": t} | motion | {"port": 0.5 * np.sin(t), "star": np.cos(t)})


def saved(table: pd.DataFrame, folder: Path, name: str = "run.csv") -> Path:
    table.to_csv(folder / name, index=False)
    return folder / name


def test_rows_that_are_there_twice_or_swapped_are_put_in_order(tmp_path):
    table = planar_table(20)
    rows = [0, 1, 2, 4, 3, 5, 6, 7, 7, 8, *range(9, 20)]
    log = read_log(saved(table.iloc[rows], tmp_path), PLANAR)
    good = read_log(saved(table, tmp_path, "good.csv"), PLANAR)
    assert np.array_equal(log.t, good.t) and np.array_equal(log.channels, good.channels, equal_nan=True)
    assert np.array_equal(log.commands, good.commands)
    assert any("there twice count once (1 of 21)" in note for note in log.notes)
    assert any("another order are sorted by `t` (1 of 21 times back)" in note for note in log.notes)
    assert not any("twice" in note or "order" in note for note in good.notes)


@pytest.mark.parametrize("change", ["another sample", "a wrong time", "a clock that was set"])
def test_times_that_are_wrong_otherwise_are_refused(tmp_path, change):
    table = planar_table(40)
    if change == "another sample":  # of the same time
        table.loc[7, "t"] = table.loc[6, "t"]
    elif change == "a wrong time":
        table.loc[7, "t"] = table.loc[2, "t"] + 0.04
    else:
        table.loc[20:, "t"] -= 1.95
    with pytest.raises(InputError, match="must strictly increase"):
        read_log(saved(table, tmp_path), PLANAR)


def log_of(t: np.ndarray, **channels: np.ndarray) -> Log:
    values = np.full((len(t), len(CHANNELS)), np.nan)
    for name, samples in channels.items():
        values[:, CHANNELS.index(name)] = samples
    return Log(
        t=t,
        channels=values,
        commands=np.zeros((len(t), 1)),
        wrench=None,
        command_names=("main",),
        name="made",
    )


# --- reading ---------------------------------------------------------------------------------


def test_a_file_written_by_hand_is_read_as_it_stands(tmp_path):
    rows = [f"{k / 2},1.5,{k},,0.25,-1" for k in range(10)]
    path = tmp_path / "hand.csv"
    path.write_text("t,u,v,r,port,star\n" + "\n".join(rows).replace("0.0,1.5,0,,", "0,1.5,0,2e-1,"))
    log = read_log(path, PLANAR)
    assert log.name == "hand.csv"
    assert log.command_names == ("port", "star")
    assert log.measured == ("u", "v", "r")
    assert np.array_equal(log.t, np.arange(10) / 2)
    assert np.array_equal(log.channels[:, CHANNELS.index("v")], np.arange(10))
    r = log.channels[:, CHANNELS.index("r")]
    assert r[0] == 0.2 and np.isnan(r[1:]).all()
    assert log.commands is not None and log.wrench is None
    assert np.array_equal(log.commands[3], [0.25, -1.0])
    assert log.duration == 4.5 and log.dt == 0.5
    assert log.notes == ()


@pytest.mark.parametrize(
    "names,enough",
    [
        ("x y psi", True),
        ("u v r", True),
        ("u v psi", True),
        ("x y r", False),
        ("u psi r", False),
        ("psi", False),
    ],
)
def test_translation_and_rotation_are_each_seen(tmp_path, names, enough):
    """A Doppler log and a compass will do; positions need a heading, and no axis may go unseen."""
    table = planar_table()[["t", "port", "star", *names.split()]]
    if enough:
        assert {*read_log(saved(table, tmp_path), PLANAR).measured} == {*names.split()}
    else:
        with pytest.raises(InputError, match="for whose rates the attitude may stand"):
            read_log(saved(table, tmp_path), PLANAR)


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz", "RUN.CSV", "run.parquet"])
def test_all_formats_give_the_same_log(tmp_path, name):
    table = planar_table()
    reference = read_log(saved(table, tmp_path), PLANAR)
    path = tmp_path / name
    if name.endswith("parquet"):
        table.to_parquet(path)
    elif name.endswith("gz"):
        path.write_bytes(gzip.compress((tmp_path / "run.csv").read_bytes()))
    else:
        saved(table, tmp_path, name)
    log = read_log(path, PLANAR)
    assert np.array_equal(log.t, reference.t)
    assert np.array_equal(log.channels, reference.channels, equal_nan=True)
    assert np.array_equal(log.commands, reference.commands)


def test_a_parquet_file_may_hold_time_as_its_row_label(tmp_path):
    planar_table().set_index("t").to_parquet(tmp_path / "run.parquet")
    assert np.array_equal(read_log(tmp_path / "run.parquet", PLANAR).t, planar_table()["t"])


def test_spaces_and_a_byte_order_mark_do_no_harm(tmp_path):
    text = planar_table().to_csv(index=False).replace(",", " , ")
    (tmp_path / "run.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    log = read_log(tmp_path / "run.csv", PLANAR)
    assert log.measured == ("x", "y", "psi", "u", "v", "r")


finite = st.floats(-1e9, 1e9, allow_subnormal=False)


@hypothesis.given(
    steps=arrays_of.arrays(float, 11, elements=st.floats(1e-3, 1e3)),
    channels=arrays_of.arrays(float, (12, 18), elements=finite | st.just(float("nan"))),
    commands=arrays_of.arrays(float, (12, 1), elements=st.floats(-1, 1)),
    by_wrench=st.booleans(),
    kind=st.sampled_from([".csv", ".parquet"]),
)
@hypothesis.settings(max_examples=40)
def test_what_is_written_is_read_back(tmp_path_factory, steps, channels, commands, by_wrench, kind):
    channels[0] = 1.0  # every channel has a sample
    log = Log(
        t=np.concatenate([[0.0], np.cumsum(steps)]),
        channels=channels,
        commands=None if by_wrench else commands,
        wrench=100 * commands * np.arange(1, 7) if by_wrench else None,
        command_names=("main",),
        name="original",
    )
    path = tmp_path_factory.mktemp("log") / f"copy{kind}"
    write_log(log, path)
    again = read_log(path, FULL)
    assert again.name == path.name
    assert np.array_equal(again.t, log.t)
    assert np.array_equal(again.channels, log.channels, equal_nan=True)
    driving, expected = (again.wrench, log.wrench) if by_wrench else (again.commands, log.commands)
    assert np.array_equal(driving, expected)
    assert [found.name for found in path.parent.iterdir()] == [path.name]


@hypothesis.given(
    scale=st.floats(0.01, 100) | st.floats(-100, -0.01),
    offset=st.floats(-100, 100),
)
@hypothesis.settings(max_examples=20)
def test_a_column_map_gives_scale_times_raw_plus_offset(tmp_path_factory, scale, offset):
    table = planar_table().rename(columns={"psi": "heading", "u": "speed"})
    path = saved(table, tmp_path_factory.mktemp("map"))
    columns = ColumnMap.model_validate(
        {"columns": {"psi": {"from": "heading", "scale": scale, "offset": offset}, "u": "speed"}}
    )
    log = read_log(path, PLANAR, columns)
    psi = log.channels[:, CHANNELS.index("psi")]
    assert np.allclose(psi, table["heading"] * scale + offset, rtol=1e-14, atol=1e-14)
    assert np.array_equal(log.channels[:, CHANNELS.index("u")], table["speed"])


@pytest.mark.parametrize(
    "column,unit",
    [("t", "s"), ("x", "m"), ("psi", "rad"), ("u", "m/s"), ("r", "rad/s"), ("du", "m/s^2"), ("dr", "rad/s²")],
)
def test_si_units_in_a_column_map_change_nothing(tmp_path, column, unit):
    path = saved(planar_table().assign(du=0.1, dr=-0.2), tmp_path)
    columns = ColumnMap.model_validate({"columns": {column: {"from": column, "unit": unit}}})
    plain, mapped = read_log(path, PLANAR), read_log(path, PLANAR, columns)
    assert np.array_equal(mapped.t, plain.t)
    assert np.array_equal(mapped.channels, plain.channels, equal_nan=True)


def test_a_column_map_is_read_from_its_file_and_wins_over_own_names(tmp_path):
    table = planar_table().assign(north=7.0)
    (tmp_path / "map.toml").write_text('[columns]\nx = "north"\nu = "v"\nv = { from = "u", scale = -1 }\n')
    log = read_log(saved(table, tmp_path), PLANAR, tmp_path / "map.toml")
    assert np.all(log.channels[:, CHANNELS.index("x")] == 7.0)
    assert np.array_equal(log.channels[:, CHANNELS.index("u")], table["v"])
    assert np.array_equal(log.channels[:, CHANNELS.index("v")], -table["u"])
    assert log.notes == ("Columns that nothing knows are ignored: `x`.",)


def test_a_mapped_column_does_not_serve_under_its_own_name_too(tmp_path):
    columns = ColumnMap.model_validate({"columns": {"du": "u"}})
    log = read_log(saved(planar_table(), tmp_path), PLANAR, columns)
    assert "du" in log.measured and "u" not in log.measured


def test_unknown_columns_are_noted_and_ignored(tmp_path):
    table = planar_table().assign(voltage=12.0, mode="auto")
    log = read_log(saved(table, tmp_path), PLANAR)
    assert log.notes == ("Columns that nothing knows are ignored: `voltage`, `mode`.",)


def test_empty_command_cells_hold_the_last_command(tmp_path):
    table = planar_table()
    table["port"] = [np.nan, 0.2, np.nan, np.nan, -0.4, *[np.nan] * 7]
    log = read_log(saved(table, tmp_path), PLANAR)
    assert log.commands is not None
    assert log.commands[:, 0].tolist() == [0, 0.2, 0.2, 0.2, -0.4, *[-0.4] * 7]
    assert len(log.notes) == 1 and "`port` has 10 empty cells" in log.notes[0]


def test_a_saturation_above_one_widens_the_range_of_commands(tmp_path):
    table = planar_table()
    table.loc[3, "star"] = -1.2
    log = read_log(saved(table, tmp_path), PLANAR)
    assert log.commands is not None and log.commands[3, 1] == -1.2
    table["port"] = table["star"]
    with pytest.raises(InputError, match=r"`port` is -1.2 in data row 4"):
        read_log(saved(table, tmp_path), PLANAR)


def test_a_rounded_scale_is_no_command_beyond_the_range(tmp_path):
    # 0.0274 stands for 1 / 36.5 and makes full thrust 1.0001
    columns = ColumnMap.model_validate({"columns": {"port": {"from": "newton", "scale": 0.0274}}})
    table = planar_table().drop(columns="port").assign(newton=36.5)
    log = read_log(saved(table, tmp_path), PLANAR, columns)
    assert log.commands is not None and np.all(log.commands[:, 0] == 1.0)
    assert "taken for rounding" in log.notes[0]


def test_commands_drive_where_a_wrench_stands_beside_them(tmp_path):
    table = planar_table().assign(X=1.0, Y=2.0, N=3.0)
    log = read_log(saved(table, tmp_path), PLANAR)
    assert log.wrench is None and log.commands is not None
    assert log.notes == ("The commands drive; the wrench `X`, `Y`, `N` is ignored.",)


def test_a_wrench_drives_where_a_command_is_missing(tmp_path):
    table = planar_table().drop(columns="star").assign(X=1.0, Y=2.0, N=3.0)
    log = read_log(saved(table, tmp_path), PLANAR)
    assert log.commands is None and log.wrench is not None
    assert np.array_equal(log.wrench[0], [1, 2, 0, 0, 0, 3])
    assert "`star` is missing; `port` is ignored" in log.notes[0]


@pytest.mark.parametrize("kept", [("x", "y", "psi"), ("u", "v", "r")])
def test_position_or_velocity_is_enough(tmp_path, kept):
    log = read_log(saved(planar_table()[["t", *kept, "port", "star"]], tmp_path), PLANAR)
    assert log.measured == kept


def test_an_empty_channel_that_is_not_needed_counts_as_not_measured(tmp_path):
    log = read_log(saved(planar_table().assign(u=np.nan), tmp_path), PLANAR)
    assert "u" not in log.measured
    assert log.notes == ("Column `u` has no value and counts as not measured.",)


def test_roll_in_degrees_is_suspected(tmp_path):
    log = read_log(saved(planar_table().assign(phi=20.0), tmp_path), PLANAR)
    assert "degrees" in log.notes[0]


# --- the log ---------------------------------------------------------------------------------


def test_split_and_between_share_no_sample_and_keep_the_time():
    log = log_of(np.arange(10) / 2, u=np.arange(10.0))
    before, after = log.split(at=2.0)
    assert before.t.tolist() == [0, 0.5, 1, 1.5]
    assert after.t.tolist() == [2, 2.5, 3, 3.5, 4, 4.5]
    assert after.channels[0, CHANNELS.index("u")] == 4.0
    assert log.between(1.0, 2.0).t.tolist() == [1.0, 1.5]
    with pytest.raises(InputError, match=r"fewer than two samples.*between 0 s and 4.5 s"):
        log.split(at=100.0)


def test_a_log_is_a_pytree_of_its_arrays():
    log = log_of(np.arange(10) / 2, u=np.arange(10.0))
    assert [leaf.shape for leaf in jax.tree.leaves(log)] == [(10,), (10, 18), (10, 1)]
    total = eqx.filter_jit(lambda log: jnp.nansum(log.channels) + log.t[-1])(log)
    assert total == 45.0 + 4.5


@pytest.mark.parametrize(
    "change",
    [
        {"commands": None},
        {"wrench": np.zeros((10, 6))},
        {"commands": np.zeros((9, 1))},
        {"channels": np.zeros((9, 18))},
        {"commands": None, "wrench": np.zeros((9, 6))},
    ],
)
def test_a_log_of_unequal_parts_cannot_be_made(change):
    parts = {
        "t": np.arange(10.0),
        "channels": np.zeros((10, 18)),
        "commands": np.zeros((10, 1)),
        "wrench": None,
        "command_names": ("main",),
        "name": "",
    }
    # with shape checks on, as in tests, jaxtyping sees some of them first
    with pytest.raises((ValueError, jaxtyping.TypeCheckError)):
        Log(**(parts | change))


# --- noise -----------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", ["even", "uneven"])
def test_white_noise_on_a_smooth_motion_is_measured(spacing):
    rng = np.random.default_rng(1)
    t = 0.1 * np.arange(4000)
    if spacing == "uneven":
        t = t + rng.uniform(-0.03, 0.03, t.shape)
    log = log_of(
        t,
        x=3e3 + 50 * np.sin(0.1 * t) + rng.normal(0, 0.3, t.shape),
        u=np.sin(2 * t) + rng.normal(0, 0.01, t.shape),
        psi=np.angle(np.exp(1j * (0.5 * t + rng.normal(0, 0.02, t.shape)))),  # wraps
    )
    noise = estimate_noise(log)
    expected = dict.fromkeys(CHANNELS, np.nan) | {"x": 0.3, "u": 0.01, "psi": 0.02}
    assert np.allclose(noise, list(expected.values()), rtol=0.1, equal_nan=True)


def test_a_heading_that_flips_between_plus_and_minus_pi_is_not_noisy():
    rng = np.random.default_rng(7)
    t = 0.1 * np.arange(2000)
    psi = np.pi + 0.02 * np.sin(t) + rng.normal(0, 0.01, t.shape)
    noise = estimate_noise(log_of(t, psi=np.angle(np.exp(1j * psi))))
    assert noise[CHANNELS.index("psi")] == pytest.approx(0.01, rel=0.1)


def test_gaps_outliers_and_jumps_do_not_count_as_noise():
    rng = np.random.default_rng(2)
    t = 0.1 * np.arange(4000)
    held = np.repeat(rng.uniform(-1, 1, 400), 10)
    values = 5 * held + rng.normal(0, 0.01, t.shape)
    values[rng.choice(4000, 40)] = 1e3
    values[rng.choice(4000, 400)] = np.nan
    values[1000:1500] = np.nan
    log = eqx.tree_at(lambda log: log.commands, log_of(t, du=values), held[:, None])
    assert estimate_noise(log)[CHANNELS.index("du")] == pytest.approx(0.01, rel=0.15)


def test_accelerations_under_ever_changing_commands_still_get_a_noise():
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(2000)
    log = log_of(t, du=np.sin(t) + rng.normal(0, 0.05, t.shape))
    log = eqx.tree_at(lambda log: log.commands, log, np.sin(t)[:, None])
    assert estimate_noise(log)[CHANNELS.index("du")] == pytest.approx(0.05, rel=0.1)


def test_a_coarse_sensor_is_at_least_as_noisy_as_its_rounding():
    t = 0.05 * np.arange(2000)
    log = log_of(t, z=np.round(0.3 * np.sin(0.2 * t), 1))
    noise = estimate_noise(log)
    assert 0.1 / np.sqrt(12) * 0.99 <= noise[CHANNELS.index("z")] < 0.1


def test_a_stuck_sensor_counts_only_with_a_stated_noise():
    t = 0.05 * np.arange(2000)
    log = log_of(t, z=np.sin(t), w=np.zeros_like(t))
    assert np.isnan(estimate_noise(log)[CHANNELS.index("w")])
    assert sensor_noise(log, {"velocity": 0.01})[CHANNELS.index("w")] == 0.01
    # Nothing was measured there, whatever the file states.
    assert np.isnan(sensor_noise(log, {"rate": 0.01})[CHANNELS.index("p")])


def test_a_sensor_slower_than_the_log_is_judged_by_its_own_samples():
    rng = np.random.default_rng(4)
    t = 0.05 * np.arange(8000)
    held = np.repeat(np.sin(0.05 * t[::10]) + rng.normal(0, 0.02, 800), 10)
    assert estimate_noise(log_of(t, x=held))[0] == pytest.approx(0.02, rel=0.15)


def test_stated_noise_wins_where_the_channel_is_measured():
    rng = np.random.default_rng(5)
    t = 0.1 * np.arange(500)
    log = log_of(t, x=rng.normal(0, 1.0, t.shape), u=rng.normal(0, 2.0, t.shape))
    noise = sensor_noise(log, {"position": 0.25, "attitude": 0.5, "velocity": None})
    assert noise[CHANNELS.index("x")] == 0.25
    assert noise[CHANNELS.index("u")] == estimate_noise(log)[CHANNELS.index("u")]
    assert np.isfinite(noise).sum() == 2
    assert np.array_equal(sensor_noise(log, None), estimate_noise(log), equal_nan=True)


# --- states ----------------------------------------------------------------------------------


def corkscrew(t: np.ndarray) -> dict[str, np.ndarray]:
    """A motion with known position, attitude and body velocity; scipy turns, jax differentiates."""

    def pose(t):
        angles = jnp.stack([0.4 * jnp.sin(0.5 * t), 0.3 * jnp.cos(0.4 * t), 2.0 + 0.6 * t])
        return jnp.concatenate([jnp.stack([jnp.sin(t), jnp.cos(0.7 * t), 0.2 * t]), angles])

    value, slope = jax.vmap(lambda t: jax.jvp(pose, (t,), (jnp.ones_like(t),)))(jnp.asarray(t))
    value, slope = np.array(value), np.array(slope)  # copies, as scipy wants to write

    def turns(t: np.ndarray) -> Rotation:
        angles = np.array(jax.vmap(pose)(jnp.asarray(t)))[:, :2:-1]
        return Rotation.from_euler("ZYX", angles)

    turn, step = turns(t), 1e-5
    rate = (turns(t - step).inv() * turns(t + step)).as_rotvec() / (2 * step)
    velocity = turn.inv().apply(slope[:, :3])
    return dict(zip(CHANNELS, np.concatenate([value, velocity, rate], axis=1).T, strict=False))


@pytest.mark.parametrize(
    "measured",
    [
        CHANNELS[:12],
        CHANNELS[:6],
        ("x", "y", "z", *ATTITUDE, "u", "v", "w"),
        ("z", "phi", "theta", "psi", "u", "v", "p", "q", "r"),
    ],
)
def test_states_follow_a_known_motion(measured):
    t = 0.05 * np.arange(400)
    truth = corkscrew(t)
    shown = {name: truth[name] for name in measured}
    shown["psi"] = np.angle(np.exp(1j * shown["psi"]))  # as sensors give it
    shown["z"] = np.where(np.arange(400) % 5 == 2, np.nan, shown["z"])
    states = smooth_states(log_of(t, **shown), DOFS)
    expected = np.stack([truth[name] for name in CHANNELS[6:12]], axis=1)
    inner = slice(5, -5)  # at its ends a local fit stands on one side
    assert np.max(np.abs(states.nu - expected)[inner]) < 0.02
    psi = np.unwrap(truth["psi"])
    turns = np.round((states.attitude[0, 2] - psi[0]) / (2 * np.pi)) * 2 * np.pi
    assert np.max(np.abs(states.attitude[:, 2] - turns - psi)) < 0.01
    assert np.max(np.abs(states.position[:, 2] - truth["z"])[inner]) < 0.01
    travelled = states.position - states.position[0]
    for axis, name in enumerate("xy"):
        assert np.max(np.abs(travelled[:, axis] - truth[name] + truth[name][0])) < 0.05


def test_attitude_from_rates_alone_turns_as_the_craft_did():
    t = 0.05 * np.arange(400)
    truth = corkscrew(t)
    states = smooth_states(log_of(t, **{name: truth[name] for name in CHANNELS[6:12]}), DOFS)
    angles = np.stack([truth["psi"], truth["theta"], truth["phi"]], axis=1)
    true_turn = Rotation.from_euler("ZYX", angles)
    turn = Rotation.from_euler("ZYX", states.attitude[:, ::-1])
    since_start = true_turn[0].inv() * true_turn
    assert np.max((turn.inv() * since_start).magnitude()) < 0.01


def test_heading_from_rates_stands_on_the_measured_roll_and_pitch():
    t = 0.05 * np.arange(400)
    truth = corkscrew(t)
    shown = {name: truth[name] for name in ("phi", "theta", *CHANNELS[6:12])}
    shown["p"] = shown["p"] + 0.05  # a biased gyro turns nothing that is measured
    states = smooth_states(log_of(t, **shown), DOFS)
    inner = slice(5, -5)
    assert np.max(np.abs(states.attitude[:, 0] - truth["phi"])[inner]) < 0.01
    turned = truth["psi"] - truth["psi"][0]
    assert np.max(np.abs(states.attitude[:, 2] - turned)) < 0.1


def test_states_from_velocities_alone_start_at_zero_and_add_up():
    # a circle: u = 2 m/s and r = 0.5 rad/s turn on a radius of 4 m
    t = 0.1 * np.arange(300)
    one = np.ones_like(t)
    states = smooth_states(log_of(t, u=2 * one, v=0 * one, r=0.5 * one), ("surge", "sway", "yaw"))
    assert np.allclose(states.attitude[:, 2], 0.5 * t, atol=1e-9)
    assert np.allclose(states.position[:, 0], 4 * np.sin(0.5 * t), atol=0.01)
    assert np.allclose(states.position[:, 1], 4 * (1 - np.cos(0.5 * t)), atol=0.01)


def test_a_loop_through_vertical_pitch_closes():
    t = 0.01 * np.arange(629)
    zero = np.zeros_like(t)
    rates = {"u": zero, "v": zero, "w": zero, "p": zero, "q": zero + 1.0, "r": zero}
    states = smooth_states(log_of(t, **rates), DOFS)
    last = Rotation.from_euler("ZYX", states.attitude[-1, ::-1])
    assert last.magnitude() == pytest.approx(abs(6.28 - 2 * np.pi), abs=1e-6)


def test_locked_degrees_of_freedom_are_zero():
    rng = np.random.default_rng(6)
    t = 0.1 * np.arange(100)
    log = log_of(t, **{name: rng.normal(size=100) for name in CHANNELS})
    states = smooth_states(log, ("surge", "yaw"))
    assert np.all(states.nu[:, 1:5] == 0) and np.all(states.nu[:, [0, 5]] != 0)
    assert np.all(states.attitude[:, :2] == 0)
    # surge and yaw together go east as well, but never down
    assert np.all(states.position[:, 2] == 0) and np.any(states.position[:, 1] != 0)


@hypothesis.given(
    seen=st.sets(st.sampled_from(CHANNELS), min_size=1),
    dof=st.sets(st.sampled_from(DOFS), min_size=1),
    holes=st.floats(0, 0.95),
    seed=st.integers(0, 1000),
)
@hypothesis.settings(max_examples=60)
def test_states_and_noise_are_finite_whatever_is_measured(seen, dof, holes, seed):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.5, 40))
    channels = {name: rng.normal(size=40) for name in sorted(seen)}
    for values in channels.values():
        values[1:][rng.random(39) < holes] = np.nan
    log = log_of(t, **channels)
    states = smooth_states(log, tuple(dof))
    for part in (states.position, states.attitude, states.nu):
        assert np.isfinite(part).all()
    noise = estimate_noise(log)
    # A single sample has no noise, as a constant has none.
    varying = [name for name, values in channels.items() if np.isfinite(values).sum() > 1]
    assert np.array_equal(np.isfinite(noise), np.isin(CHANNELS, varying))
    assert np.all(noise[np.isfinite(noise)] > 0)


# --- recordings ------------------------------------------------------------------------------


def test_simulated_recordings_show_the_noise_that_they_were_given(shared):
    for folder in sorted((shared / "cases").glob("*/")):
        vehicle = read_vehicle_file(folder / "vehicle.toml")
        log = read_log(folder / "train.csv", vehicle)
        assert all("is wrapped" in note for note in log.notes)
        stated = sensor_noise(log, vehicle.sensors.stated())
        ratio = estimate_noise(log) / stated
        # Commands of a feedback change at every sample, and accelerations and fast craft with them: the
        # estimate can only err upwards then.
        held = np.mean((np.diff(log.commands, axis=0) != 0).any(axis=1)) < 0.5
        assert np.nanmin(ratio) > 0.85 and np.nanmax(ratio) < (1.2 if held else 4.0), folder.name


def test_boat_recordings_are_read_through_a_column_map(shared, tmp_path):
    (tmp_path / "map.toml").write_text(
        '[columns]\nx = "north"\ny = "east"\n'
        'port = { from = "thrust_left", scale = 0.0274 }\n'
        'star = { from = "thrust_right", scale = 0.0274 }\n'
    )
    columns = read_columns(tmp_path / "map.toml")
    paths = sorted((shared / "data" / "vtec-s3-usv").glob("*/*.csv"))
    assert len(paths) == 17
    for path in paths:
        log = read_log(path, PLANAR, columns)
        assert log.measured == ("x", "y", "psi", "u", "v", "r")
        assert "Columns that nothing knows are ignored: `cmd_age`." in log.notes


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("psi", np.linspace(0.0, 900.0, 60) % 360.0, "`psi` jumps by more than a turn: is it in degrees?"),
        ("phi", np.full(60, 3.13), "`phi` is about 3.1 rad most of the time, as of a vehicle on its back"),
    ],
)
def test_an_attitude_that_is_hardly_meant_is_told(tmp_path, name, values, said):
    vehicle = load_vehicle(packaged_vehicle("tethra"))
    t = 0.1 * np.arange(60)
    table = {"t": t, **dict.fromkeys((*CHANNELS[:12], *vehicle.command_names), np.zeros(60)), name: values}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    assert any(said in note for note in read_log(tmp_path / "log.csv", vehicle).notes)
