"""Simulations against closed forms, other solvers, energy, symmetry, and an independent plant."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from experiments.blind import plant as blind
from experiments.blind import vehicle as blind_vehicle
from jaxmarine._types import CHANNELS
from jaxmarine.effects import (
    ConstantWrench,
    FluidMemory,
    SteadyCurrent,
    VelocityScale,
    Waves,
)
from jaxmarine.fitting import (
    Affine,
    Problem,
    Task,
    cut,
    measured_channels,
    predict,
    refine_windows,
    start_precision,
)
from jaxmarine.logs import read_log, sensor_noise
from jaxmarine.physics import rotation
from jaxmarine.simulation import gates, hold, hold_many, initial_state, inputs, simulate, substeps
from jaxmarine.vehicle import Input, Placed, State
from jaxmarine.vehicle_io import load_vehicle, packaged_vehicle
from tests.crafts import (
    SIMULATED,
    brick,
    independent,
    independent_run,
    log_of,
    packaged,
    placed,
    random_commands,
    random_start,
    unwrapped,
)

T = np.arange(0.0, 10.0, 0.1)


def test_single_precision_rounds_and_no_more():
    def track():
        # Loaded anew: a vehicle has the precision that it was loaded in.
        vehicle = load_vehicle(packaged_vehicle("tethra"))
        log = log_of(vehicle, T, random_commands(vehicle, len(T), 20, 0))
        return simulate(vehicle, log, coasting(vehicle)).channels

    with jax.enable_x64(False):
        single = track()
    double = track()
    assert single.dtype == np.float32 and double.dtype == np.float64
    # A hundred roundings of up to ten to 2^-24 of it.
    off = np.abs(unwrapped(np.asarray(single, float) - double))[:, :12].max()
    assert 0.0 < off < 100 * 10 * 2.0**-24


# --- solvers ----------------------------------------------------------------------------------


def smooth_tethra():
    """Without |nu| nu, which is no smooth function where a velocity changes its sign."""
    vehicle = packaged("tethra")
    return eqx.tree_at(lambda v: v.damping.quadratic, vehicle, jnp.zeros((6, 6)))


def coasting(vehicle):
    return initial_state(vehicle, attitude=(0.4, -0.3, 0.2), velocity=(0.8, -0.5, 0.3, 0.4, -0.3, 0.5))


def stepped(vehicle, start, parts: int):
    """Velocities every 0.1 s for 4 s, with as many steps in between."""
    plant = vehicle.plant()
    count = len(vehicle.thruster_names)
    nothing = Input(jnp.zeros(count), jnp.zeros(count), jnp.zeros(6), jnp.zeros(()))

    def sample(state, _):
        after = jax.lax.fori_loop(0, parts, lambda _, s: hold(plant, s, nothing, 0.1 / parts), state)
        return after, state.velocity

    return jax.jit(lambda start: jax.lax.scan(sample, start, None, length=41)[1])(start)


@pytest.fixture(scope="module")
def decays():
    """The same free decay by two adaptive methods, one explicit and one implicit."""
    vehicle = smooth_tethra()
    log = log_of(vehicle, T[:41])
    return {
        solver: simulate(vehicle, log, coasting(vehicle), solver())
        for solver in (diffrax.Tsit5, diffrax.Kvaerno5)
    }


def test_the_explicit_method_is_of_fourth_order(decays):
    vehicle = smooth_tethra()
    exact = decays[diffrax.Tsit5].states.velocity
    errors = [np.abs(stepped(vehicle, coasting(vehicle), parts) - exact).max() for parts in (1, 2, 4)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert errors[-1] > 1e-7  # still far above the reference's own error
    assert np.abs(orders - 4.0).max() < 0.2


def test_explicit_implicit_and_stepped_solutions_agree(decays):
    vehicle = smooth_tethra()
    stepping = simulate(vehicle, log_of(vehicle, T[:41]), coasting(vehicle))
    explicit, implicit = decays[diffrax.Tsit5], decays[diffrax.Kvaerno5]
    # Tolerance 1e-8 in each of forty calls.
    assert np.abs(explicit.channels - implicit.channels).max() < 1e-6
    # Order four at 0.1 s, where the fastest oscillation takes 1.7 s.
    assert np.abs(explicit.channels - stepping.channels)[:, :12].max() < 1e-3


class Tabulated(diffrax.AbstractERK):
    """The classical method by its tableau and diffrax' own steps."""

    tableau = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


def by_tableau(plant, state, drive, dt, split: int) -> State:
    """`hold` as diffrax does it."""

    def rates(t, state, args):
        drive = args
        thrust = drive.thrust + drive.slope * (t - drive.middle)
        return plant.rates(state, Input(thrust, drive.command, drive.wrench, t))

    method, dt = Tabulated(scan_kind="lax"), dt / split
    for k in range(split):
        t = drive.t + k * dt
        step = method.step(
            diffrax.ODETerm(rates), t, t + dt, state, drive, solver_state=False, made_jump=True
        )
        state = step[0]
    return state


def test_holds_of_one_and_of_many_are_those_of_the_tableau():
    vehicle = packaged("tethra")
    late = blind.Effect("thruster_lag", None, {"time_constant": 0.15})
    vehicle = vehicle.place(*(placed(vehicle, e) for e in (*EVERYTHING, late)))
    commands = jnp.asarray(random_commands(vehicle, 3, 1, seed=8))
    over, _ = inputs(vehicle.plant(), jnp.asarray([0.0, 0.1, 0.25]), commands, jnp.ones((3, 6)))
    starts = [random_start(vehicle, seed)[0] for seed in range(3)]
    starts = [dataclasses.replace(s, memory=0.9 * s.velocity) for s in starts]
    states = jax.tree.map(lambda *parts: jnp.stack(parts), *starts)
    plants = jax.tree.map(lambda a: jnp.stack([a, 1.02 * a, 0.97 * a]), vehicle.plant())
    dt = jnp.asarray([0.1, 0.15, 0.12])

    @jax.jit
    def run(plants, states, over, dt):
        def last(tree):
            return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), tree)

        first = jax.tree.map(lambda a: a[0], plants)
        many = hold_many(last(plants), last(states), last(over), dt, 2, alike=False)
        same = hold_many(first, last(states), last(over), dt, 2)
        expected = jax.vmap(lambda *one: by_tableau(*one, 2))(plants, states, over, dt)
        alike = jax.vmap(lambda *one: by_tableau(first, *one, 2))(states, over, dt)
        one = hold(*jax.tree.map(lambda a: a[1], (plants, states, over, dt)), 2)
        return (last(expected), many), (last(alike), same), (jax.tree.map(lambda a: a[1], expected), one)

    for expected, found in run(plants, states, over, dt):
        for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
            # The same steps; sums of stages and of forces in another order.
            np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-12)


def test_a_hold_is_differentiated_in_reverse_as_forwards():
    vehicle = packaged("tethra")
    plant, count = vehicle.plant(), len(vehicle.thruster_names)
    start, drive = coasting(vehicle), Input(jnp.ones(count), jnp.zeros(count), jnp.ones(6), jnp.zeros(()))

    def after(velocity, thrust):
        state, pushed = (
            dataclasses.replace(start, velocity=velocity),
            dataclasses.replace(drive, thrust=thrust),
        )
        return (hold(plant, state, pushed, 0.1, 2).velocity ** 2).sum()

    at = start.velocity, drive.thrust
    slopes = jax.jit(jax.grad(after, argnums=(0, 1)))(*at)
    forwards = jax.jit(jax.jacfwd(after, argnums=(0, 1)))(*at)
    for a, b in zip(slopes, forwards, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-13)
        assert np.abs(a).max() > 1e-4


def test_a_hold_is_cut_as_finely_as_the_fastest_mode_needs():
    vehicle = brick(linear=np.array([1000.0, 1, 1, 1, 1, 1]))  # 100 per second
    assert substeps(vehicle, 0.1) >= 100.0 * 0.1 / 0.8
    late = vehicle.place(Placed(FluidMemory(jnp.ones(6), jnp.full(6, 0.01))))
    calm = brick().place(*late.placed)
    for stiff in (vehicle, calm):
        start = initial_state(stiff, velocity=(0.1, 0, 0, 0, 0, 0))
        track = simulate(stiff, log_of(stiff, T[:40]), start)
        assert np.abs(track["u"]).max() <= 0.1 and np.isfinite(track.channels).all()


# --- closed forms -----------------------------------------------------------------------------


def test_coast_down_matches_the_closed_form():
    """m u' = -d u|u| gives u0 / (1 + d u0 t / m), here with added mass, forwards and in reverse."""
    vehicle = brick(quadratic=np.array([8.0, 0, 0, 0, 0, 0]), added=np.array([6.0, 0, 0, 0, 0, 0]))
    for u0 in (1.5, -1.5):
        start = initial_state(vehicle, velocity=(u0, 0, 0, 0, 0, 0))
        track = simulate(vehicle, log_of(vehicle, T), start, diffrax.Tsit5())
        exact = u0 / (1.0 + 8.0 * abs(u0) * T / 16.0)
        travelled = np.sign(u0) * 16.0 / 8.0 * np.log(1.0 + 8.0 * abs(u0) * T / 16.0)
        assert np.allclose(track["u"], exact, rtol=1e-7)
        assert np.allclose(track["x"], travelled, rtol=1e-7, atol=1e-7)


def test_two_fluid_memories_on_an_axis_have_a_lag_each():
    """m u' = -m_1 - m_2 with tau_i m_i' = gain_i u - m_i is linear: by the matrix exponential.

    The second has a gain on one axis only, and one in sway between them leaves both alone.
    """
    mass, gains, lags = 10.0, (6.0, 9.0), (0.4, 2.5)
    system = np.array(
        [
            [0.0, -1 / mass, -1 / mass],
            [gains[0] / lags[0], -1 / lags[0], 0],
            [gains[1] / lags[1], 0, -1 / lags[1]],
        ]
    )
    surge = jnp.zeros(6).at[0].set(1.0)
    first, second = (
        Placed(FluidMemory(gain * surge, 1.0 + (lag - 1.0) * surge), "surge")
        for gain, lag in zip(gains, lags, strict=True)
    )
    between = Placed(FluidMemory(jnp.roll(surge, 1), jnp.full(6, 7.0)), "sway")
    exact = np.array([(expm(system * t) @ [1.0, 0.0, 0.0])[0] for t in T])
    for memories in (first, second), (second, between, first):
        vehicle = brick().place(*memories)
        start = initial_state(vehicle, velocity=(1.0, 0, 0, 0, 0, 0))
        track = simulate(vehicle, log_of(vehicle, T), start, diffrax.Tsit5())
        assert np.allclose(track["u"], exact, rtol=0, atol=1e-6)
    # Far from both of one lag, whichever that is.
    for lag in lags:
        shared = brick().place(Placed(FluidMemory(sum(gains) * surge, 1.0 + (lag - 1.0) * surge)))
        track = simulate(shared, log_of(shared, T), initial_state(shared, velocity=(1.0, 0, 0, 0, 0, 0)))
        assert np.abs(track["u"] - exact).max() > 0.02


def test_terminal_velocity_of_a_heavy_body():
    vehicle = brick(weight=98.1 + 12.0, quadratic=np.array([0, 0, 30.0, 0, 0, 0]), linear=np.full(6, 1.0))
    track = simulate(vehicle, log_of(vehicle, np.arange(0.0, 30.0, 0.1)), initial_state(vehicle))
    exact = (-1.0 + np.sqrt(1.0 + 4.0 * 30.0 * 12.0)) / 60.0  # 30 w^2 + w = 12
    assert track["w"][-1] == pytest.approx(exact, rel=1e-9)
    # m w' = 12 - w - 30 w^2, with a and b the roots: the way there as a closed form.
    b = (-1.0 - np.sqrt(1.0 + 4.0 * 30.0 * 12.0)) / 60.0
    growth = np.exp(-30.0 * (exact - b) * np.asarray(track.t) / 10.0)
    way = (exact - exact * growth) / (1.0 - exact / b * growth)
    assert np.allclose(track["w"], way, atol=1e-4)  # order four at 0.1 s


def test_drifting_bodies_follow_the_current():
    vehicle = brick(linear=np.full(6, 20.0), added=np.full(6, 5.0)).place(
        Placed(SteadyCurrent(jnp.asarray(0.3), jnp.asarray(-0.2), jnp.asarray(0.1)))
    )
    start = initial_state(vehicle, attitude=(0.3, 0.4, 1.0))
    track = simulate(vehicle, log_of(vehicle, np.arange(0.0, 30.0, 0.1)), start)
    turn = np.asarray(rotation(track.states.attitude[-1]))
    assert np.allclose(turn @ track.states.velocity[-1, :3], [0.3, -0.2, 0.1], atol=1e-6)


def test_waves_go_on_within_a_hold():
    """m x'' = F sin(2 pi t / T), sampled so coarsely that a held force would be far off."""
    amplitude, period = 4.0, 2.0
    waves = Waves(jnp.asarray(amplitude), jnp.asarray(0.0), jnp.asarray(period), jnp.asarray(0.0))
    vehicle = brick().place(Placed(waves))
    t = np.arange(0.0, 10.0, 0.1)
    track = simulate(vehicle, log_of(vehicle, t), initial_state(vehicle))
    w = 2 * np.pi / period
    exact = amplitude / 10.0 / w * (1.0 - np.cos(w * t))
    assert np.abs(track["u"] - exact).max() < 1e-6  # Simpson's rule; held, it would be 2e-2


def test_a_wrench_drives_like_the_thrusters_that_make_it():
    vehicle = packaged("tethra")
    commands = random_commands(vehicle, 60, 5, seed=1)
    wrench = (np.asarray(commands) * np.asarray(vehicle.thrusters.max_thrust)) @ np.asarray(
        vehicle.plant().allocation
    ).T
    start, _ = random_start(vehicle, 2)
    by_thrust = simulate(vehicle, log_of(vehicle, T[:60], commands), start)
    by_wrench = simulate(vehicle, log_of(vehicle, T[:60], wrench=wrench), start)
    assert np.allclose(by_thrust.channels, by_wrench.channels, rtol=0, atol=1e-12)


def test_a_gap_in_the_log_is_one_long_hold():
    """As if the missing samples had been there, with the command of the last one before them."""
    vehicle = packaged("tethra")
    t = np.arange(0.0, 20.0, 0.1)
    commands = random_commands(vehicle, len(t), 40, seed=2)
    commands[60:140] = commands[60]
    kept = np.r_[0:61, 140:200]
    start = initial_state(vehicle)
    whole = simulate(vehicle, log_of(vehicle, t, commands), start).channels[kept]
    gappy = simulate(vehicle, log_of(vehicle, t[kept], commands[kept]), start).channels
    # Both are of the fourth order in steps of about 0.1 s; the accelerations last jumped 8 s apart.
    assert np.allclose(gappy, whole, atol=1e-3)


def test_a_clock_may_count_from_1970():
    """Times of 1.7e9 s are rounded to 2.4e-7 s, and nothing else changes: a delay neither."""
    vehicle = packaged("tethra")
    vehicle = vehicle.place(placed(vehicle, blind.Effect("input_delay", None, {"delay": 0.25})))
    commands = random_commands(vehicle, len(T), 10, seed=3)
    start = initial_state(vehicle)
    plain = simulate(vehicle, log_of(vehicle, T, commands), start).channels
    late = simulate(vehicle, log_of(vehicle, T + 1.7e9, commands), start).channels
    assert np.allclose(late, plain, atol=1e-4)


# --- energy and symmetry ----------------------------------------------------------------------


@pytest.mark.parametrize("name", SIMULATED)
def test_energy_never_grows_in_still_water_without_thrust(name):
    vehicle = packaged(name)
    damping = np.asarray(vehicle.damping.linear)
    assert np.linalg.eigvalsh(damping + damping.T).min() > -1e-12  # the premise
    start, _ = random_start(vehicle, 3, speed=0.2)
    track = simulate(vehicle, log_of(vehicle, T[:50]), start)
    nu, position = np.asarray(track.states.velocity), np.asarray(track.states.position)
    down = np.asarray(jax.vmap(rotation)(track.states.attitude))[:, 2]
    kinetic = 0.5 * np.einsum("ti,ij,tj->t", nu, vehicle.mass_matrix, nu)
    body = vehicle.body
    weight = -body.weight * (position[:, 2] + down @ body.cog)
    buoyancy = body.buoyancy * (position[:, 2] + down @ body.cob)
    energy = np.asarray(kinetic + weight + buoyancy)
    lost = energy[0] - energy[-1]
    assert lost > 0.05 * kinetic[0]
    assert np.diff(energy).max() < 1e-6 * lost


def test_a_turned_world_with_its_current_turned_is_the_same_to_the_body():
    angle, current = 1.234, np.array([0.3, -0.1, 0.05])
    turn = Rotation.from_euler("z", angle).as_matrix()
    tracks = []
    for by, water in ((0.0, current), (angle, turn @ current)):
        vehicle = packaged("tethra").place(Placed(SteadyCurrent(*map(jnp.asarray, water))))
        start = initial_state(vehicle, (0, 0, 0), (0.2, -0.1, 0.5 + by), (0.5, 0.1, 0, 0, 0, 0.2))
        commands = random_commands(vehicle, 80, 8, seed=4)
        tracks.append(simulate(vehicle, log_of(vehicle, T[:80], commands), start))
    one, other = tracks
    assert np.allclose(one.channels[:, 6:], other.channels[:, 6:], rtol=0, atol=1e-12)
    assert np.allclose(one.channels[:, :3] @ turn.T, other.channels[:, :3], rtol=0, atol=1e-12)


def loop_by_scipy(vehicle, wrench, until):
    """The same motion with a rotation matrix as attitude, in NumPy and scipy's solver."""
    other = independent(vehicle.name)
    mass, inverse = other.rigid + other.added, np.linalg.inv(other.rigid + other.added)

    def rates(t, s):
        turn, nu = s[3:12].reshape(3, 3), s[12:]
        f_g, f_b = other.weight * turn[2], -other.buoyancy * turn[2]
        restoring = np.concatenate([f_g + f_b, np.cross(other.cog, f_g) + np.cross(other.cob, f_b)])
        force = wrench + restoring - other.linear @ nu - other.quadratic @ (np.abs(nu) * nu)
        force -= blind.coriolis(mass, nu)
        x, y, z = nu[3:]
        spin = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.concatenate([turn @ nu[:3], (turn @ spin).ravel(), inverse @ force])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(6)])
    out = solve_ivp(rates, (0, until), start, t_eval=T, rtol=1e-10, atol=1e-12)
    return out.y.T


def test_a_loop_passes_90_degrees_of_pitch_without_a_jump():
    vehicle = packaged("tethra")
    wrench = np.array([40.0, 0.0, 0.0, 5.0, 900.0, 3.0])
    log = log_of(vehicle, T, wrench=np.tile(wrench, (len(T), 1)))
    track = simulate(vehicle, log, initial_state(vehicle), diffrax.Tsit5())
    exact = loop_by_scipy(vehicle, wrench, T[-1])
    turns = np.asarray(jax.vmap(rotation)(track.states.attitude))
    assert turns[:, 2, 2].min() < -0.9  # upside down in between
    assert np.abs(turns.reshape(-1, 9) - exact[:, 3:12]).max() < 1e-6
    assert np.abs(track.states.velocity - exact[:, 12:]).max() < 1e-6
    assert np.abs(track.states.position - exact[:, :3]).max() < 1e-6
    attitude = np.asarray(track.states.attitude)
    assert np.linalg.norm(np.diff(attitude, axis=0), axis=1).max() < 0.5  # no jump
    assert np.isfinite(track.channels).all()
    # The stepped solution does the same, to its own error.
    stepping = simulate(vehicle, log, initial_state(vehicle))
    assert np.abs(stepping.states.velocity - exact[:, 12:]).max() < 1e-2


def test_locked_axes_never_move():
    vehicle = packaged("cybership2")
    pushing = ConstantWrench(jnp.array([0.1, 0.2, 50.0, 20.0, 30.0, 0.1]))
    current = SteadyCurrent(jnp.asarray(0.1), jnp.asarray(0.1), jnp.asarray(0.4))
    vehicle = vehicle.place(Placed(pushing), Placed(current))
    commands = random_commands(vehicle, 100, 5, seed=5)
    track = simulate(vehicle, log_of(vehicle, T, commands), initial_state(vehicle))
    locked = [CHANNELS.index(name) for name in ("z", "phi", "theta", "w", "p", "q")]
    assert np.array_equal(track.channels[:, locked], np.zeros((len(T), 6)))
    assert np.abs(track["u"]).max() > 0.05


# --- the independent plant --------------------------------------------------------------------

# One of each kind; all fit a model ship and are felt by a vehicle ten times as heavy.
EVERYTHING = [
    blind.Effect("steady_current", None, {"north": 0.2, "east": -0.1}),
    blind.Effect("payload", None, {"mass": 0.5, "x": 0.1, "y": 0.05, "z": 0.0}),
    blind.Effect("added_mass", "sway", {"value": 2.0}),
    blind.Effect("tether_drag", None, {"coefficient": 3.0}),
    blind.Effect("hull_lift", None, {"Y_uv": 5.0, "N_uv": 1.0}),
    blind.Effect("waves", None, {"north": 0.5, "east": 0.3, "period": 4.0, "phase": 0.7}),
    blind.Effect("fluid_memory", "sway", {"gain": 4.0, "time_constant": 0.8}),
    blind.Effect("inflow_loss", None, {"per_speed": 0.3}),
    blind.Effect("deadband", None, {"width": 0.05}),
    blind.Effect("velocity_lever_arm", None, {"x": 0.3, "y": -0.2}),
]
# Of the independent plant; the minesniper's roll and the remotely operated vehicles are stiff.
STEP = {
    "tethra": 0.01,
    "tethra_geometry": 0.01,
    "minesniper": 0.005,
    "bluerov2_heavy": 0.005,
    "cybership2": 0.02,
}


@pytest.mark.parametrize("name", SIMULATED)
def test_the_stepped_file_is_the_independent_plant(name):
    vehicle = packaged(name)
    commands = random_commands(vehicle, 50, 10, seed=6)
    start, rows = random_start(vehicle, 7, speed=0.1)
    track = simulate(vehicle, log_of(vehicle, T[:50], commands), start)
    expected = independent_run(name, [], T[:50], commands, rows, STEP[name])
    assert np.abs(expected[:, 6:12]).max() > 0.1
    # Steps of 0.1 s and finer, as the fastest mode needs; see `simulation.substeps`.
    assert np.abs(unwrapped(track.channels - expected))[:, :12].max() < 2e-3


@pytest.mark.parametrize("name", SIMULATED)
def test_the_plant_with_effects_is_the_independent_plant(name):
    vehicle = packaged(name)
    commands = random_commands(vehicle, 50, 10, seed=6)
    loaded = vehicle.place(*(placed(vehicle, e) for e in EVERYTHING))
    start, rows = random_start(vehicle, 7, speed=0.1)
    start = dataclasses.replace(start, memory=jnp.zeros(6))
    track = simulate(loaded, log_of(loaded, T[:50], commands), start, diffrax.Tsit5())
    expected = independent_run(name, EVERYTHING, T[:50], commands, rows, STEP[name])
    error = np.abs(unwrapped(track.channels - expected))
    # The other's steps, which the kinks of |nu| nu and of the inflow make less than fourth order:
    # halved, they change its own result by as much.
    assert error[:, :12].max() < 1e-5
    assert error.max() < 3e-4


def test_effects_begin_when_they_are_told():
    since, vehicle = 3.3, packaged("tethra")
    effects = [
        blind.Effect("constant_wrench", "yaw", {"value": 40.0}, since),
        blind.Effect("thruster_gain", "port_h", {"factor": 0.4}, since),
        blind.Effect("velocity_scale", None, {"factor": 1.3}, since),
    ]
    late = vehicle.place(*(placed(vehicle, e) for e in effects))
    t = 0.1 * np.arange(60)
    commands = random_commands(vehicle, 60, 10, seed=8)
    start, rows = random_start(vehicle, 9)
    track = simulate(late, log_of(late, t, commands), start)
    expected = independent_run("tethra", effects, t, commands, rows, 0.01)
    assert np.abs(unwrapped(track.channels - expected))[:, :12].max() < 1e-3  # as without effects
    before = simulate(vehicle, log_of(vehicle, t, commands), start).channels[t < since - 1e-9]
    assert np.array_equal(track.channels[t < since - 1e-9], before)


def test_the_independent_plant_follows_damping_that_is_faster_than_its_step():
    """Minesniper's roll at 0.4 rad/s is braked at 300 times its speed a second, its step is 0.025 s.

    A step of 0.025 s would make it run away; at half the speed it settles on a roll that no damping allows.
    """
    craft = blind_vehicle.load("minesniper")
    commands = np.zeros((40, len(craft.names), 1))
    commands[:, 0] = 0.4
    start = np.zeros((13, 1))
    start[[2, 6, 9, 10, 11], 0] = 3.0, 0.9, 0.4, -0.1, 0.3
    schedule = [(0, blind.Model(craft))]
    runs = [blind.simulate(schedule, commands, start, 40, step=step) for step in (0.025, 0.001)]
    assert np.abs(runs[0].states - runs[1].states).max() < 1e-4  # of 0.4 rad/s


def test_gates_follow_time_log_and_order():
    vehicle = packaged("tethra")
    scale = VelocityScale(jnp.asarray(1.1))
    vehicle = vehicle.place(
        Placed(scale),
        Placed(scale, None, 0.3),
        Placed(scale, None, 0.3, "b.csv"),
    )
    log = {name: log_of(vehicle, 0.1 * np.arange(6), name=name) for name in ("a.csv", "b.csv")}
    from_three = np.array([0, 0, 0, 1, 1, 1])  # 3 * 0.1 is above 0.3 by rounding, others are below
    assert np.array_equal(gates(vehicle, log["b.csv"])[:, 0], np.ones(6))
    assert np.array_equal(gates(vehicle, log["b.csv"])[:, 1], from_three)
    assert np.array_equal(gates(vehicle, log["b.csv"])[:, 2], from_three)
    assert np.array_equal(gates(vehicle, log["a.csv"])[:, 2], np.ones(6))
    assert np.array_equal(gates(vehicle, log["a.csv"], ("a.csv",))[:, 2], np.zeros(6))


def test_inputs_broadcast_constants_of_the_drive():
    vehicle = packaged("tethra")
    commands = jnp.asarray(random_commands(vehicle, 20, 2, seed=10))
    wrench = jnp.zeros((20, 6))
    over, at = inputs(vehicle.plant(), jnp.asarray(T[:20]), commands, wrench)
    assert np.array_equal(over.thrust, 120.0 * commands)
    assert np.array_equal(at.thrust, over.thrust)


# --- recordings of another simulator ----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("part", ["train", "test"])
def test_predictions_of_a_true_vehicle_leave_only_noise(shared, part):
    """5 s predictions of a log that hides nothing, initial states fitted window by window."""
    folder = shared / "cases" / "nothing"
    if not folder.is_dir():
        pytest.skip("the folder ../shared has no case without a hidden effect")
    vehicle = load_vehicle(folder / "vehicle.toml")
    log = read_log(folder / f"{part}.csv", vehicle).between(0.0, 150.0)
    noise = sensor_noise(log, dict(vehicle.sensors))
    data = cut(vehicle, [log], noise, 5.0)
    problem = Problem(
        lambda theta, segment: vehicle.plant(),
        data.records,
        data.windows,
        jnp.asarray(start_precision(vehicle.free)),
        measured_channels(data.windows),
    )
    nothing = Affine(jnp.zeros((1, 1)), jnp.zeros((1, 1)), jnp.ones((1, 1)))
    task = Task(problem, nothing, jnp.ones(1))
    start = jnp.zeros((data.windows.count, 12))
    fitted = refine_windows(task, jnp.zeros(1), start)
    assert fitted.converged
    residuals = residuals_of(vehicle, data.windows, data.records, fitted.delta)
    used = np.asarray(data.windows.weight) > 0
    free = used.sum() / (used.sum() - 12 * data.windows.count)
    pooled = (residuals[used] ** 2).mean() * free
    assert 0.97 < pooled < 1.03
    per_channel = (residuals**2).sum((0, 1)) / used.sum((0, 1)) * free
    assert per_channel.min() > 0.88 and per_channel.max() < 1.12


def residuals_of(vehicle, windows, records, delta):
    """Weighted differences by the simulation itself, window by window."""
    problem = Problem(lambda theta, segment: vehicle.plant(), records, windows, jnp.ones(12), ())
    return np.asarray(eqx.filter_jit(predict)(problem, jnp.zeros((1, 1)), delta)[1])
