"""Speed through the water and specific force: kinds of sensors that only some logs have."""

import dataclasses

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import jaxmarine as jm
from jaxmarine._types import ALL_CHANNELS, ALL_SENSORS, ALWAYS, CHANNELS, TABLE, width_of
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.effects import CATALOGUE, CompassDeviation, GyroBias, LinearDamping, SteadyCurrent
from jaxmarine.examples import hidden, recorded
from jaxmarine.fitting import (
    Affine,
    cut,
    predict,
)
from jaxmarine.logs import Log, alike, sensor_noise
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed, Vehicle
from tests.crafts import brick, log_of, packaged, random_commands, random_start
from tests.test_linearise import by_recursion, saturated_problem

WATER, FORCE = ("u_water", "v_water", "w_water"), ("fx", "fy", "fz")
BOTH = ("water_velocity", "specific_force")


def current(north: float, east: float, down: float = 0.0) -> Placed:
    return Placed(SteadyCurrent(jnp.asarray(north), jnp.asarray(east), jnp.asarray(down)))


def with_sensors(vehicle: Vehicle, **noise: float) -> Vehicle:
    """The vehicle with these kinds of sensors alone, and their noise."""
    return dataclasses.replace(vehicle, sensors=tuple(noise.items()))


def only(log: Log, *names: str) -> Log:
    """A log that measures these channels alone."""
    there = np.isin(ALL_CHANNELS[: log.channels.shape[1]], names)
    return dataclasses.replace(log, channels=np.where(there, log.channels, np.nan))


# --- what they show ---------------------------------------------------------------------------


def test_a_craft_at_rest_shows_gravity_and_the_water_that_passes():
    vehicle = brick().place(current(0.3, -0.2, 0.1))
    g, t = 9.81, np.arange(0.0, 0.5, 0.1)
    pose = np.array([0.3, -0.4, 1.9])
    phi, theta, _ = pose
    start = initial_state(vehicle, attitude=pose)
    track = simulate(vehicle, log_of(vehicle, t), start, sensors=BOTH)
    # The neutral brick without drag is not moved by the current but for what its added mass, zero, would do.
    expected = -g * np.array([-np.sin(theta), np.cos(theta) * np.sin(phi), np.cos(theta) * np.cos(phi)])
    shown = np.array([track[name][0] for name in FORCE])
    assert np.allclose(shown, expected, atol=1e-9)
    flow = Rotation.from_euler("ZYX", pose[::-1]).inv().apply([0.3, -0.2, 0.1])
    assert np.allclose([track[name][0] for name in WATER], -flow, atol=1e-12)
    level = simulate(vehicle, log_of(vehicle, t), initial_state(vehicle), sensors=BOTH)
    assert np.allclose([level[name][0] for name in FORCE], [0.0, 0.0, -g], atol=1e-9)


def test_they_are_second_and_first_differences_of_the_position():
    """In earth axes: f = R' (p'' - g) and v - v_c = R' (p' - v_c), of a craft that turns in a current."""
    vehicle = packaged("tethra").place(current(0.2, -0.1, 0.05))
    dt = 0.01
    t = dt * np.arange(300)
    start, _ = random_start(vehicle, 3)
    commands = random_commands(vehicle, len(t), 400, seed=2)  # held: no jump of the acceleration
    track = simulate(vehicle, log_of(vehicle, t, commands), start, sensors=BOTH)
    place = np.stack([track[name] for name in ("x", "y", "z")], axis=1)
    turn = Rotation.from_euler("ZYX", np.stack([track[n] for n in ("psi", "theta", "phi")], axis=1))
    inner = turn[1:-1].inv()
    fell = (place[2:] - 2 * place[1:-1] + place[:-2]) / dt**2 - [0.0, 0.0, 9.81]
    moved = (place[2:] - place[:-2]) / (2 * dt) - [0.2, -0.1, 0.05]
    for names, expected in ((FORCE, inner.apply(fell)), (WATER, inner.apply(moved))):
        shown = np.stack([track[name] for name in names], axis=1)[1:-1]
        # Differences are off by the square of the step times the next derivatives.
        assert np.abs(shown - expected).max() < 1e-3
    assert np.abs(track["fx"]).max() > 0.3


def test_other_sensors_errors_do_not_touch_them():
    zero = jnp.zeros(())
    spoilt = packaged("tethra").place(Placed(GyroBias(zero + 0.1, zero, zero)))
    plain, t = packaged("tethra"), np.arange(0.0, 2.0, 0.1)
    start = initial_state(plain, velocity=(0.5, 0, 0.1, 0, 0.1, 0.2))
    one, other = (simulate(v, log_of(v, t), start, sensors=BOTH) for v in (plain, spoilt))
    assert np.abs(one["p"] - other["p"]).max() > 0.05
    assert np.array_equal(one.channels[:, ALWAYS:], other.channels[:, ALWAYS:])


def test_they_are_simulated_where_they_are_asked_for():
    vehicle, t = packaged("tethra"), np.arange(0.0, 1.0, 0.1)
    log, start = log_of(vehicle, t), initial_state(vehicle)
    plain = simulate(vehicle, log, start)
    assert plain.channels.shape[1] == ALWAYS
    with pytest.raises(ValueError, match="was not simulated"):
        plain["fx"]
    with pytest.raises(ValueError, match="none of position"):
        simulate(vehicle, log, start, sensors=("waterspeed",))
    more = simulate(vehicle, log, start, sensors=("water_velocity",))
    assert more.channels.shape[1] == ALWAYS + 3
    assert np.array_equal(more.channels[:, :ALWAYS], plain.channels)
    # A log that measures them asks as well.
    wide = alike([log], ALWAYS + 6)[0]
    assert simulate(vehicle, wide, start).channels.shape[1] == len(ALL_CHANNELS)


# --- one table --------------------------------------------------------------------------------


def test_the_table_has_every_channel_once():
    assert ALL_CHANNELS[:ALWAYS] == CHANNELS and len(set(ALL_CHANNELS)) == len(ALL_CHANNELS) == 24
    assert tuple(ALL_SENSORS) == tuple(one.kind for one in TABLE) and [*ALL_SENSORS][-2:] == [*BOTH]
    assert width_of([False] * 24) == ALWAYS and width_of([True] * 18) == ALWAYS
    assert width_of(name == "v_water" for name in ALL_CHANNELS) == 21
    assert width_of(name == "fx" for name in ALL_CHANNELS) == 24


# --- in files ---------------------------------------------------------------------------------


def table(vehicle: Vehicle, rows: int = 200, **more) -> pd.DataFrame:
    rng, t = np.random.default_rng(0), 0.1 * np.arange(rows)
    motion = {name: np.sin(0.3 * t + i) for i, name in enumerate(("u", "v", "r", "psi"))}
    commands = dict.fromkeys(vehicle.command_names, 0.1 * np.sin(t))
    return pd.DataFrame({"t": t} | motion | commands | {k: f(t, rng) for k, f in more.items()})


def test_they_are_read_with_their_noise_and_written():
    vehicle = packaged("blueboat")
    frame = table(
        vehicle,
        u_water=lambda t, rng: np.sin(0.2 * t) + 0.03 * rng.standard_normal(len(t)),
        v_water=lambda t, rng: np.cos(0.2 * t) + 0.03 * rng.standard_normal(len(t)),
        fx=lambda t, rng: np.sin(0.2 * t) + 0.2 * rng.standard_normal(len(t)),
    )
    log = jm.read_log(frame, vehicle)
    assert log.channels.shape[1] == 24 and set(log.measured) >= {"u_water", "v_water", "fx"}
    noise = dict(zip(ALL_CHANNELS, sensor_noise(log), strict=True))
    assert noise["u_water"] == pytest.approx(0.03, rel=0.2) and noise["fx"] == pytest.approx(0.2, rel=0.2)
    assert np.isnan(noise["w_water"])
    stated = sensor_noise(log, {"specific_force": 0.5, "water_velocity": None})
    assert stated[ALL_CHANNELS.index("fx")] == 0.5
    assert stated[ALL_CHANNELS.index("u_water")] == noise["u_water"]


def test_a_log_without_them_is_as_wide_as_ever(tmp_path):
    vehicle = packaged("blueboat")
    log = jm.read_log(table(vehicle), vehicle)
    assert log.channels.shape[1] == ALWAYS
    jm.write_log(log, tmp_path / "again.csv")
    assert jm.read_log(tmp_path / "again.csv", vehicle).channels.shape[1] == ALWAYS
    # An empty column counts as not measured, and a note says so.
    empty = jm.read_log(table(vehicle, fz=lambda t, rng: np.nan * t), vehicle)
    assert empty.channels.shape[1] == ALWAYS and any("fz" in note for note in empty.notes)


@pytest.mark.parametrize(
    ("shown", "said"), [(-9.7, False), (-8.0, False), (9.8, True), (-1.0, True), (0.0, True), (-32.2, True)]
)
def test_an_accelerometer_in_other_units_or_of_the_other_sign_is_told(shown, said):
    """Of a craft that mostly lies level; in g, in feet, with gravity taken off or counted upwards."""
    vehicle = packaged("blueboat")
    log = jm.read_log(table(vehicle, fz=lambda t, rng: shown + 0.2 * rng.standard_normal(len(t))), vehicle)
    told = [str(note) for note in log.notes if "`fz`" in note]
    assert bool(told) == said and all("is it in g, of the other sign, or without gravity?" in n for n in told)


def test_a_log_with_them_survives_a_file(tmp_path):
    vehicle = packaged("blueboat")
    log = jm.read_log(table(vehicle, v_water=lambda t, rng: rng.standard_normal(len(t))), vehicle)
    jm.write_log(log, tmp_path / "log.csv")
    again = jm.read_log(tmp_path / "log.csv", vehicle)
    assert again.channels.shape[1] == 21 and np.allclose(again.channels, log.channels, equal_nan=True)


def test_a_column_map_gives_their_units_and_axes(tmp_path):
    vehicle = packaged("tethra")
    t = 0.1 * np.arange(60)
    seen = {name: np.sin(0.3 * t + i) for i, name in enumerate((*"uvwpqr", *WATER, *FORCE))}
    foreign = {"t": t} | dict.fromkeys(vehicle.command_names, 0.1 * np.sin(t))
    foreign |= {f"my_{name}": values for name, values in seen.items()}
    path = tmp_path / "map.toml"
    names = [f'{name} = "my_{name}"' for name in seen if name != "u_water"]
    path.write_text(
        "[columns]\n"
        + "\n".join(names)
        + '\nu_water = {from = "my_u_water", unit = "kn"}\n[frame]\nbody = "flu"\n'
    )
    log = jm.read_log(pd.DataFrame(foreign), vehicle, path)
    at = {name: log.channels[:, i] for i, name in enumerate(ALL_CHANNELS)}
    assert np.allclose(at["u_water"], seen["u_water"] * 1852 / 3600)
    for name in ("v_water", "w_water", "fy", "fz"):
        assert np.allclose(at[name], -seen[name]), name
    assert np.allclose(at["fx"], seen["fx"])


def test_the_vehicle_file_states_their_noise(tmp_path):
    vehicle = with_sensors(packaged("blueboat"), velocity=0.02, specific_force=0.3)
    jm.save_vehicle(vehicle, tmp_path / "v.toml")
    again = jm.load_vehicle(tmp_path / "v.toml")
    assert dict(again.sensors) == {"velocity": 0.02, "specific_force": 0.3}
    assert len(again.stated_noise) == 24 and again.stated_noise[-1] == 0.3
    assert len(packaged("blueboat").stated_noise) == ALWAYS
    text = (tmp_path / "v.toml").read_text()
    (tmp_path / "v.toml").write_text(text.replace("specific_force = 0.3", "specific_force = -1.0"))
    with pytest.raises(jm.InputError, match=r"specific_force.*positive number"):
        jm.load_vehicle(tmp_path / "v.toml")
    log = recorded(vehicle, np.zeros((50, 2)), 0.1 * np.arange(50), 0, "run.csv")
    assert set(log.measured) == {"u", "v", "w", *FORCE}


# --- in fits ----------------------------------------------------------------------------------

SEEN = ("psi", "u", "v", "r", "u_water", "v_water")


def drifting() -> tuple[Vehicle, Log]:
    """The boat, and a log of it in a current: velocities over ground and through the water, no positions."""
    boat = with_sensors(packaged("blueboat"), attitude=0.005, velocity=0.02, rate=0.01, water_velocity=0.03)
    log = hidden(boat, "steady_current", None, {"north": 0.25, "east": -0.15}, (60.0, 30.0), seed=4)[0]
    return boat, only(log, *SEEN)


@pytest.mark.slow
def test_a_current_is_seen_without_positions():
    """Even by a craft that does not feel the water: by the mean of R (u - u_water, v - v_water).

    Each window begins with a velocity of its own, so that the mean of its velocity is known from the sensor
    alone, and the current as well as this mean, whose standard error follows from the noise. Without a log of
    the water it is not determined.
    """
    craft = brick(dof=("surge", "sway", "yaw"))
    craft = with_sensors(craft, attitude=0.005, velocity=0.02, rate=0.01, water_velocity=0.03)
    t, rng = 0.1 * np.arange(400), np.random.default_rng(5)
    wrench = np.repeat(rng.normal(size=(20, 6)) * [3.0, 3.0, 0.0, 0.0, 0.0, 0.5], 20, axis=0)
    truth = craft.place(current(0.25, -0.15))
    asked = log_of(craft, t, wrench=wrench)
    shown = np.asarray(simulate(truth, asked, initial_state(truth), sensors=("water_velocity",)).channels)
    shown = shown + craft.stated_noise * rng.standard_normal(shown.shape)
    log = only(log_of(craft, t, wrench=wrench, channels=shown), *SEEN)

    at = {name: log.channels[:, ALL_CHANNELS.index(name)] for name in SEEN}
    u, v = at["u"] - at["u_water"], at["v"] - at["v_water"]
    north = np.cos(at["psi"]) * u - np.sin(at["psi"]) * v
    east = np.sin(at["psi"]) * u + np.cos(at["psi"]) * v
    error = np.hypot(0.02, 0.03) / np.sqrt(len(t))
    assert np.ptp(at["psi"]) > np.pi
    start = craft.place(current(0.0, 0.0))

    def free(vehicle: Vehicle):
        return vehicle.placed[-1].effect.north, vehicle.placed[-1].effect.east

    found = jm.fit(start, log, free=free)
    for one, mean, true in zip(found.parameters, (north.mean(), east.mean()), (0.25, -0.15), strict=True):
        assert abs(one.value - mean) < error, one
        assert abs(one.value - true) < 4 * error, one
        assert one.std_model == pytest.approx(error, rel=0.15)
    blind = jm.fit(start, only(log, "psi", "u", "v", "r"), free=free, throw=False)
    assert len(blind.undetermined) == 2


@pytest.mark.slow
def test_logs_with_and_without_them_are_fitted_together():
    boat, log = drifting()
    plain = dataclasses.replace(
        log, channels=only(log, "psi", "u", "v", "r").channels[:, :ALWAYS], name="b.csv"
    )
    start = boat.place(current(0.0, 0.0))
    found = jm.fit(start, [plain, log], free=lambda v: v.placed[-1].effect.north)
    assert len(found.noise) == 21
    assert found.parameters[0].value == pytest.approx(0.25, abs=0.02)
    seen = jm.check(boat, [plain, log])
    assert len(seen.logs) == 2


def test_a_diagnosis_uses_them():
    boat, log = drifting()
    bench = workbench(boat, [log], CATALOGUE, None)
    used = {ALL_CHANNELS[i] for i in bench.problem(()).channels}
    # The compass is a channel without which the current has no direction.
    assert used == {*SEEN}


@eqx.filter_jit
def by_forward_mode(problem, theta, delta):
    def residuals(z, move):
        out = predict(problem, theta + z[None], delta + move[None])[1]
        return out.reshape(out.shape[0], -1)

    z, move = jnp.zeros(theta.shape[-1]), jnp.zeros(12)
    by_z, by_move = jax.jacfwd(residuals, argnums=(0, 1))(z, move)
    return residuals(z, move), by_move, by_z


@pytest.mark.slow
def test_their_slopes_are_those_of_forward_mode():
    """By the current, which they show, the damping, which they feel, and the compass, which they do not."""
    vehicle, dt, length = packaged("cybership2"), 0.05, 2.0
    families = tuple(cls.neutral(vehicle) for cls in (SteadyCurrent, LinearDamping, CompassDeviation))
    neutral, unravel = jax.flatten_util.ravel_pytree(families)
    theta = neutral + 0.05 * jnp.asarray(np.random.default_rng(1).uniform(0.2, 1.0, neutral.shape))
    t = dt * np.arange(round(3 * length / dt))
    commands = random_commands(vehicle, len(t), 10, seed=0)
    start, _ = random_start(vehicle, 0, speed=0.2)
    whole = vehicle.place(*(Placed(effect) for effect in unravel(theta)))
    shown = simulate(whole, log_of(vehicle, t, commands), start, sensors=BOTH).channels
    seen = only(log_of(vehicle, t, commands, channels=shown), *"uvr", "psi", *WATER, *FORCE)
    noise = np.where(np.isfinite(seen.channels).any(axis=0), 0.02, np.nan)
    data = cut(vehicle, [seen], noise, length)
    problem = saturated_problem(vehicle, families, data)
    assert {ALL_CHANNELS[i] for i in problem.channels} == {*"uvr", "psi", "u_water", "v_water", "fx", "fy"}
    delta = 1e-2 * np.random.default_rng(3).normal(size=(data.windows.count, 12))
    affine = Affine(theta[None], jnp.eye(len(theta)), jnp.ones((1, len(theta))))
    stats = jax.tree.map(np.asarray, by_recursion(problem, affine, jnp.asarray(delta)))
    residual, by_move, by_z = map(np.asarray, by_forward_mode(problem, theta[None], jnp.asarray(delta)))
    precision = np.asarray(problem.start_precision)
    x_z = np.einsum("wrx,wrz->wxz", by_move, by_z)
    z_z = np.einsum("wrz,wry->wzy", by_z, by_z)
    g_z = np.einsum("wrz,wr->wz", by_z, residual)
    size_x = np.sqrt(np.einsum("wrx,wrx->wx", by_move, by_move) + precision)
    size_z = np.linalg.norm(by_z, axis=1)
    size_r = np.linalg.norm(residual, axis=1)[:, None]
    tiny = 1e-9
    # As of the others: an error of the order of dt² times the change of the dynamics within a step.
    assert (np.abs(stats.h_zz - z_z) <= 0.02 * size_z[:, :, None] * size_z[:, None] + tiny).all()
    assert (np.abs(stats.h_xz - x_z) <= 0.02 * size_x[:, :, None] * size_z[:, None] + tiny).all()
    assert (np.abs(stats.g_z - g_z) <= 0.02 * size_r * size_z + tiny).all()
    assert (size_z[:, :2] > 1.0).all()
