"""Propellers and control surfaces: forces against closed forms and finite differences, files, diagnosis."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import scipy.integrate

import jaxmarine as jm
from jaxmarine import InputError
from jaxmarine._tables import Number, Table
from jaxmarine.actuators import KINDS, AbstractActuators, Flow, Supply, servo
from jaxmarine.effects import (
    ActuatorEffect,
    ConstantWrench,
    LinearDamping,
    SurfaceGain,
    SurfaceOffset,
    SurfaceStuck,
    Suspect,
    ThrusterGain,
    Voltage,
    Wake,
    place,
)
from jaxmarine.examples import hidden, operated, recorded
from jaxmarine.fitting import gross_errors
from jaxmarine.fitting._free import set_free
from jaxmarine.networks import learned_thrust
from jaxmarine.physics import UNLIMITED, Drive, thrust
from jaxmarine.vehicle import Input, reach
from jaxmarine.vehicle_io import cause_named, suspect_named

SHIP = """
schema = 1
name = "ship"
dof = ["surge", "sway", "yaw"]
[environment]
density = 1000.0
[body]
mass = 160.0
inertia = [[10, 0, 0], [0, 45, 0], [0, 0, 45]]
cog = [0, 0, 0]
cob = [0, 0, 0]
[added_mass]
matrix = [8, 110, 0, 0, 0, 30]
[damping]
linear = [4, 30, 0, 0, 0, 30]
quadratic = [12, 160, 0, 0, 0, 60]
[[propeller]]
name = "prop"
position = [-1.4, 0, 0.1]
direction = [1, 0, 0]
diameter = 0.15
kt = [0.29, -0.28, -0.14]
kt_reverse = [0.2, -0.1, 0.05]
kq = [0.03, -0.02, -0.01]
wake_fraction = 0.3
thrust_deduction = 0.2
astern_side_force = 0.1
max_speed = 20.0
[[surface]]
name = "rudder"
position = [-1.5, 0, 0.1]
axis = [0, 0, -1]
area = 0.03
lift_slope = 2.4
behind = "prop"
slipstream = {share = 0.9, gain = 0.5, wake_ratio = 1.05}
hull = {steering_deduction = 0.3, lift_increase = 0.3, lift_position = -0.6, straightening = [0.4, 0.6]}
max_angle = 0.7
max_rate = 0.4
[sensors]
position = 0.02
attitude = 0.003
velocity = 0.01
rate = 0.003
"""


def read(folder, text: str = SHIP, **more) -> jm.Vehicle:
    (folder / "craft.toml").write_text(text, encoding="utf-8")
    return jm.load_vehicle(folder / "craft.toml", **more)


@pytest.fixture(scope="module")
def ship(tmp_path_factory) -> jm.Vehicle:
    return read(tmp_path_factory.mktemp("ship"))


def pushed(vehicle: jm.Vehicle, n: float, delta: float, nu) -> np.ndarray:
    return np.asarray(vehicle.plant().pushed(jnp.array([n, delta]), jnp.asarray(nu, float)))


def by_the_book(n, delta, u, v, r):
    """X, Y, N as Yasukawa and Yoshimura (2015) write them, with J and alpha."""
    rho, d, w, t = 1000.0, 0.15, 0.3, 0.2
    j = (1 - w) * u / (n * d)
    kt = 0.29 - 0.28 * j - 0.14 * j**2
    x_prop = (1 - t) * rho * n**2 * d**4 * kt
    u_r = 1.05 * (1 - w) * u
    u_r *= np.sqrt(0.9 * (1 + 0.5 * (np.sqrt(1 + 8 * kt / (np.pi * j**2)) - 1)) ** 2 + 0.1)
    drift = v - 1.5 * r
    v_r = -(0.4 if drift < 0 else 0.6) * drift
    alpha = delta - np.arctan2(v_r, u_r)
    normal = 0.5 * rho * 0.03 * (u_r**2 + v_r**2) * 2.4 * np.sin(alpha)
    x = x_prop - 0.7 * normal * np.sin(delta)
    return x, -1.3 * normal * np.cos(delta), -(-1.5 + 0.3 * -0.6) * normal * np.cos(delta)


@pytest.mark.parametrize(
    "motion", [(12.0, 0.3, 0.8, 0.1, 0.2), (9.0, -0.5, 1.1, -0.2, 0.1), (15, 0.1, 0.4, 0, 0)]
)
def test_propeller_and_rudder_are_those_of_the_book(ship, motion):
    n, delta, u, v, r = motion
    found = pushed(ship, n, delta, [u, v, 0, 0, 0, r])
    # The root of the mixed squares is smooth below 1 mm/s: one part in 2 u_R² / 1e-6.
    np.testing.assert_allclose(found[[0, 1, 5]], by_the_book(n, delta, u, v, r), rtol=1e-5)


def test_a_propeller_astern(ship):
    found = pushed(ship, -8.0, 0.0, [-0.5, 0, 0, 0, 0, 0])
    back = 1000 * 0.15**4 * (0.2 * 64 - 0.1 * 8 * -0.5 / 0.15 + 0.05 * (0.5 / 0.15) ** 2)
    assert found[0] == pytest.approx(-back)
    # Without a race the rudder lies in the wake; straight it gives nothing.
    assert found[1] == pytest.approx(0.1 * back)
    assert found[5] == pytest.approx(-1.4 * 0.1 * back)
    # The side force acts below `o`, and the shaft is braked by the water.
    assert found[3] == pytest.approx(-0.1 * 0.1 * back + 1000 * 0.15**5 * 0.03 * 64)


def test_signs(ship):
    ahead = [1.0, 0, 0, 0, 0, 0]
    assert pushed(ship, 12.0, 0.2, ahead)[5] > 0 > pushed(ship, 12.0, 0.2, ahead)[1]
    # In the race a rudder steers at rest; without it, it does not.
    assert pushed(ship, 12.0, 0.2, np.zeros(6))[5] > 0
    assert not np.any(pushed(ship, 0.0, 0.2, np.zeros(6)))
    # A rudder amidships brakes drift and turns.
    assert pushed(ship, 12.0, 0.0, [1, 0.2, 0, 0, 0, 0])[1] < 0
    assert pushed(ship, 12.0, 0.0, [1, 0, 0, 0, 0, 0.2])[5] < 0


@pytest.mark.parametrize("n", [-5.0, 0.0, 7.0])
@pytest.mark.parametrize("u", [-0.6, 0.0, 0.9])
@pytest.mark.parametrize("delta", [0.0, 0.3])
def test_derivatives_are_finite_and_those_of_differences(ship, n, u, delta):
    plant = ship.plant()

    def force(x):
        return plant.pushed(x[:2], x[2:])

    x = np.array([n, delta, u, 0.1, 0, 0, 0, 0.05]) if u else np.array([n, delta, 0, 0, 0, 0, 0, 0])
    slopes = np.asarray(jax.jacfwd(force)(jnp.asarray(x)))
    assert np.isfinite(slopes).all()
    assert np.isfinite(np.asarray(jax.jacrev(force)(jnp.asarray(x)))).all()
    if not (n and u):
        return  # on the border between ahead and astern the two sides differ
    for i in (0, 1, 2, 3, 7):
        step = 1e-6 * np.eye(8)[i]
        after, before = (np.asarray(force(jnp.asarray(at))) for at in (x + step, x - step))
        by_difference = (after - before) / 2e-6
        np.testing.assert_allclose(slopes[:, i], by_difference, rtol=1e-5, atol=1e-5)


def test_a_fin_is_half_rho_a_v_squared_lift_slope(tmp_path):
    fin = """
[[surface]]
name = "fin"
position = [-0.6, 0.0, 0.2]
axis = [0.0, 1.0, 0.0]
area = 0.01
aspect_ratio = 2.0
"""
    craft = read(tmp_path, SHIP[: SHIP.index("[[propeller]]")] + fin)
    assert craft.command_names == ("fin",)
    slope, u, w, q = 6.13 * 2 / 4.25, 1.5, 0.2, 0.1
    found = np.asarray(craft.plant().pushed(jnp.array([0.3]), jnp.array([u, 0, w, 0, q, 0])))
    # At the fin the water comes from below and ahead; positive deflection about +y lifts the leading edge.
    here_u, here_w = u + q * 0.2, w - q * -0.6
    alpha = 0.3 - np.arctan2(-here_w, here_u)
    normal = 0.5 * 1000 * 0.01 * (here_u**2 + here_w**2) * slope * np.sin(alpha)
    x, z = -normal * np.sin(0.3), -normal * np.cos(0.3)
    np.testing.assert_allclose(found, [x, 0, z, 0, 0.2 * x + 0.6 * z, 0], rtol=1e-9, atol=1e-12)


def test_a_limited_rate_is_that_of_small_steps():
    """Lag and rate limit together, against an integration of state' = clip((goal - state) / lag)."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.15, 60))
    goals = np.repeat(rng.uniform(-0.6, 0.6, (6, 2)), 10, axis=0)
    lag, rate = np.array([0.0, 0.3]), np.array([0.4, 0.7])
    one, zero = jnp.ones((60, 2)), jnp.zeros((60, 2))
    drive = Drive(zero, zero, one, zero, one, zero + lag[None], zero, one, one, rate=zero + rate[None])
    push = thrust(drive, jnp.asarray(t), jnp.asarray(goals))
    for i in range(2):
        state = goals[0, i]
        for k, dt in enumerate(np.diff(t)):
            assert push.instant[k, i] == pytest.approx(state, abs=1e-6)

            def slope(_, y, i=i, k=k):
                away = goals[k, i] - y[0]
                return [np.clip(away / max(lag[i], 1e-6), -rate[i], rate[i]), y[0]]

            run = scipy.integrate.solve_ivp(slope, (0, dt), [state, 0], method="LSODA", rtol=1e-9, atol=1e-12)
            assert push.mean[k, i] == pytest.approx(run.y[1, -1] / dt, abs=1e-5)
            state = run.y[0, -1]
    free = dataclasses.replace(drive, rate=None)
    unlimited = dataclasses.replace(drive, rate=zero + UNLIMITED)
    ways = [thrust(one, jnp.asarray(t), jnp.asarray(goals)) for one in (free, unlimited)]
    for a, b in zip(*map(jax.tree.leaves, ways), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_files_round_trip(ship, tmp_path):
    jm.save_vehicle(ship, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert again.command_names == ("prop", "rudder")
    for a, b in zip(jax.tree.leaves(ship), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert jax.tree.structure(ship) == jax.tree.structure(again)


WRONG = {
    "no propeller": ('behind = "prop"', 'behind = "propp"', "did you mean"),
    "name twice": ('name = "rudder"', 'name = "prop"', "another actuator's"),
    "no slope": ("lift_slope = 2.4\n", "", "needs one of `lift_slope`"),
    "chord along the stock": ("axis = [0, 0, -1]", "axis = [1, 0, 0]", "right angles"),
    "no diameter": ("diameter = 0.15", "diameter = 0.0", "`propeller[1].diameter`"),
    "pulls at rest": ("kt = [0.29", "kt = [-0.29", "must begin with a positive number"),
    "unknown key": ("max_rate = 0.4", "max_rat = 0.4", "max_rat"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, case):
    old, new, told = WRONG[case]
    assert old in SHIP
    with pytest.raises(InputError, match=r"craft\.toml") as error:
        read(tmp_path, SHIP.replace(old, new))
    assert told.lower() in str(error.value).lower() and "\n" not in str(error.value)


def test_reach_is_full_thrust_and_full_rudder(ship):
    most = reach(ship.plant())
    assert most[0] > 0.8 * 1000 * 0.15**4 * 0.29 * 400 - 1e-6
    assert most[1] > 10 and most[5] > 10 and not most[[2, 3, 4]].any()


@pytest.mark.parametrize(("n", "delta", "u"), [(15.0, 0.4, 0.8), (12.0, -0.2, 1.0), (18.0, 0.0, 0.0)])
def test_allocated_shaft_speed_and_rudder_give_the_wrench_of_the_book(ship, n, delta, u):
    velocity = [u, 0, 0, 0, 0, 0]
    x, _, yaw = by_the_book(n, delta, max(u, 1e-9), 0.0, 0.0)
    # What inverse dynamics ask for stands beside what a propeller that does not turn brakes.
    idle = 0.8 * 1000 * 0.15**2 * -0.14 * (0.7 * u) ** 2
    wanted = jnp.array([x - idle, 0, 0, 0, 0, yaw])
    found = jm.allocate(ship, jnp.stack([wanted, wanted]), ("surge", "yaw"), jnp.asarray(velocity, float))
    np.testing.assert_allclose(found, [[n, delta]] * 2, rtol=1e-4, atol=1e-4)


def test_without_flow_a_fin_is_left_where_it_is(tmp_path):
    fin = "\n".join(SHIP[SHIP.index("[[surface]]") : SHIP.index("[sensors]")].splitlines()[:5])
    craft = read(tmp_path, BARE + fin + "\nlift_slope = 2.4\nmax_angle = 0.7\n")
    turn = jnp.array([0.0, 0, 0, 0, 0, 5.0])
    begin = jnp.array([0.1])
    assert jm.allocate(craft, turn, ("yaw",), begin=begin) == begin
    # At a crawl it goes to its limit, and at speed where it gives 1.5 rho A / 2 u² f sin(d) cos(d).
    crawl, fast = (jm.allocate(craft, turn, ("yaw",), jnp.zeros(6).at[0].set(u)) for u in (0.1, 1.5))
    assert crawl == pytest.approx(0.7)
    assert 1.5 * 15 * 1.5**2 * 2.4 * np.sin(2 * float(fast[0])) / 2 == pytest.approx(5.0)


def test_azimuths_are_turned_to_give_a_wrench():
    ferry = jm.load_vehicle(jm.packaged_vehicle("milliampere"))
    wanted = np.array([[100.0, 150.0, 0, 0, 0, -80.0], [-50.0, 20.0, 0, 0, 0, 200.0]])
    found = np.asarray(jm.allocate(ferry, jnp.asarray(wanted)))
    (fore, aft), (fore_angle, aft_angle) = 500 * found[:, :2].T, found[:, 2:].T
    x = fore * np.cos(fore_angle) + aft * np.cos(aft_angle)
    sides = fore * np.sin(fore_angle), aft * np.sin(aft_angle)
    given = np.stack([x, sides[0] + sides[1], 1.8 * (sides[0] - sides[1])], axis=1)
    np.testing.assert_allclose(given, wanted[:, [0, 1, 5]], atol=1e-3)


def test_acceleration_is_that_of_the_forces(ship):
    """One instant by hand: nothing but propeller and rudder acts on a ship at rest."""
    plant, state = ship.plant(), jm.initial_state(ship)
    acting = jnp.array([10.0, 0.4])
    found = plant.acceleration(state, Input(acting, acting, jnp.zeros(6), jnp.zeros(())))
    x, y, n = (plant.pushed(acting, jnp.zeros(6))[i] for i in (0, 1, 5))
    np.testing.assert_allclose(found[jnp.array([0, 1, 5])], [x / 168, y / 270, n / 75], rtol=1e-9)


def test_flow_names_its_streams(ship):
    propellers = ship.actuators[0]
    flow = Flow(jnp.zeros(6), jnp.asarray(1000.0), jnp.zeros(6), jnp.eye(3), jnp.zeros(0), {})
    stream = propellers.streams(jnp.array([10.0]), flow)["prop"]
    assert stream.inflow == 0.0 and stream.loading == pytest.approx(8 * 0.29 * 100 * 0.15**2 / np.pi)
    assert propellers.streams(jnp.array([-10.0]), flow)["prop"].loading == 0.0


FEW = (
    SurfaceGain,
    SurfaceOffset,
    SurfaceStuck,
    Wake,
    ThrusterGain,
    ConstantWrench,
    LinearDamping,
)
HIDDEN = {
    "offset": ("surface_offset", "rudder", {"angle": 0.06}),
    "stuck": ("surface_stuck", "rudder", {"angle": -0.1}),
    "weak": ("surface_gain", "rudder", {"factor": 0.6}),
    "propeller": ("thruster_gain", "prop", {"factor": 0.8}),
    "wake": ("wake", "prop", {"fraction": 0.25}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", HIDDEN)
def test_what_is_hidden_in_propeller_and_rudder_is_found(ship, case):
    effect, target, values = HIDDEN[case]
    logs = hidden(ship, effect, target, values, (60.0, 40.0))
    found = jm.diagnose(ship, *logs, catalogue=FEW)
    assert [finding.label for finding in found.findings] == [f"{effect}:{target}"]
    for name, parameter in found.findings[0].parameters.items():
        assert parameter.value == pytest.approx(values[name], abs=4 * parameter.std + 1e-3)
    assert found.verdict == "explained"


BARE = SHIP[: SHIP.index("[[propeller]]")] + SHIP[SHIP.index("[sensors]") :]


def test_drag_across_the_flow_is_that_of_strips(tmp_path):
    craft = read(tmp_path, BARE + "[cross_flow]\nlength = 3.0\ndraft = 0.2\ncoefficient = 0.6\n")
    assert craft.command_names == ()
    x = np.linspace(-1.5, 1.5, 20001)
    for v, r in ((0.3, 0.1), (-0.2, 0.4), (0.0, 0.3), (0.4, 0.0)):
        across = v + x * r
        strips = -0.5 * 1000 * 0.2 * 0.6 * np.abs(across) * across
        found = np.asarray(craft.plant().pushed(jnp.zeros(0), jnp.array([1.0, v, 0, 0, 0, r])))
        by_strips = [np.trapezoid(strips, x), np.trapezoid(strips * x, x)]
        np.testing.assert_allclose(found[[1, 5]], by_strips, rtol=0.01, atol=1e-3)
        assert not found[[0, 2, 3, 4]].any()


def coasting(tmp_path, across: str, turn: str, terms: dict[tuple[str, str, str], float]) -> jm.Vehicle:
    """A body of 50 kg and 4 kg m² that moves across and turns, with nothing but these terms to brake it."""
    text = (
        'schema = 1\nname = "body"\ndof = ["' + f'{across}", "{turn}"]\n' + "[body]\nmass = 50.0\n"
        "inertia = [[4, 0, 0], [0, 4, 0], [0, 0, 4]]\ncog = [0, 0, 0]\ncob = [0, 0, 0]\n"
        "[added_mass]\nmatrix = [0, 0, 0, 0, 0, 0]\n"
        "[damping]\nlinear = [0, 0, 0, 0, 0, 0]\nquadratic = [0, 0, 0, 0, 0, 0]\n"
        "[sensors]\nvelocity = 0.002\nrate = 0.001\n"
    )
    keys = ("axis", "size", "velocity")
    for axes, value in terms.items():
        named = "".join(f'{key} = "{axis}"\n' for key, axis in zip(keys, axes, strict=True))
        text += f"[[cross_damping]]\n{named}value = {value}\n"
    return read(tmp_path, text)


def left_alone(craft: jm.Vehicle, across: float, turn: float) -> np.ndarray:
    """Its velocity across and turn [m/s, rad/s] over 10 s."""
    velocity = np.zeros(6)
    velocity[list(craft.axes)] = across, turn
    t = np.arange(0.0, 10.01, 0.1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), None, np.zeros((len(t), 6)), (), "left")
    run = jm.simulate(craft, log, jm.initial_state(craft, velocity=velocity))
    return np.asarray(run.channels)[:, 6:12][:, list(craft.axes)]


PAIRS = [("sway", "yaw"), ("heave", "pitch")]


@pytest.mark.parametrize(("across", "turn"), PAIRS)
@pytest.mark.parametrize(("v", "r"), [(0.6, 0.4), (-0.6, 0.4), (0.6, -0.4)])
def test_damping_between_axes_is_that_of_closed_forms(tmp_path, across, turn, v, r):
    t = np.arange(0.0, 10.01, 0.1)
    # m v' = -a |r| v - b |v| r, with r as it was.
    a, b = 30.0, 12.0
    force = {(across, turn, across): a, (across, across, turn): b}
    found = left_alone(coasting(tmp_path, across, turn, force), v, r)
    by_hand = v * np.exp(-(a * abs(r) + b * r * np.sign(v)) * t / 50.0)
    np.testing.assert_allclose(found, np.stack([by_hand, np.full_like(t, r)], axis=1), rtol=1e-6)
    # I r' = -a |v| r - b |r| v, with v as it was.
    a, b = 2.0, 0.7
    moment = {(turn, across, turn): a, (turn, turn, across): b}
    found = left_alone(coasting(tmp_path, across, turn, moment), v, r)
    by_hand = r * np.exp(-(a * abs(v) + b * v * np.sign(r)) * t / 4.0)
    np.testing.assert_allclose(found, np.stack([np.full_like(t, v), by_hand], axis=1), rtol=1e-6)


CROSS = {
    "sway<-|yaw|sway": 25.0,
    "sway<-|sway|yaw": -40.0,
    "yaw<-|yaw|sway": -15.0,
    "yaw<-|sway|yaw": 50.0,
}


def crossed(tmp_path, values: dict[str, float], text: str = SHIP) -> jm.Vehicle:
    """A craft, the ship if no other is given, with these terms."""
    terms = ""
    for name, value in values.items():
        axis, size, velocity = name.replace("<-|", " ").replace("|", " ").split()
        terms += (
            f'[[cross_damping]]\naxis = "{axis}"\nsize = "{size}"\nvelocity = "{velocity}"\nvalue = {value}\n'
        )
    return read(tmp_path, text.replace("[sensors]", terms + "[sensors]"))


def test_damping_between_axes_is_written_and_checked(tmp_path):
    craft = crossed(tmp_path, CROSS)
    jm.save_vehicle(craft, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert jax.tree.structure(craft) == jax.tree.structure(again)
    np.testing.assert_array_equal(again.actuators[2].value, list(CROSS.values()))
    # What moves one axis alone is in the file's matrices.
    nu = jnp.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
    assert not np.asarray(craft.actuators[2].wrench(jnp.zeros(0), resting(nu))).any()
    slopes = jax.jacfwd(lambda nu: craft.actuators[2].wrench(jnp.zeros(0), resting(nu)))(jnp.zeros(6))
    assert np.isfinite(np.asarray(slopes)).all()
    text = (tmp_path / "again.toml").read_text()
    for wrong, told in (('axis = "sway"', "did you mean"), ("value = 25.0\n", "cross_damping[1].value")):
        with pytest.raises(InputError) as error:
            read(tmp_path, text.replace(wrong, wrong.replace("sway", "swy") if "axis" in wrong else "", 1))
        assert told in str(error.value)
    with pytest.raises(InputError, match="another actuator's"):
        read(tmp_path, text.replace('size = "yaw"\nvelocity = "sway"', 'size = "sway"\nvelocity = "yaw"', 1))


def resting(nu_r) -> Flow:
    return Flow(nu_r, jnp.asarray(1000.0), nu_r, jnp.eye(3), jnp.zeros(0), {})


@pytest.mark.slow
def test_damping_between_axes_that_the_file_has_as_zero_is_fitted(tmp_path):
    text = jm.packaged_vehicle("cybership2").read_text()
    hidden_terms = {
        "sway<-|yaw|sway": 8.0,
        "sway<-|sway|yaw": -6.0,
        "yaw<-|yaw|sway": -1.5,
        "yaw<-|sway|yaw": 2.5,
    }
    true, file = crossed(tmp_path, hidden_terms, text), crossed(tmp_path, dict.fromkeys(CROSS, 0.0), text)
    t, rng = np.arange(0.0, 240.0, 0.2), np.random.default_rng(3)
    commands = np.repeat(rng.uniform(-0.9, 0.9, (len(t) // 25, 3)), 25, axis=0)
    log = recorded(true, commands, t, seed=2, name="log.csv")

    def free(v):
        return v.actuators[0].value, v.damping.quadratic

    fit = jm.fit(file, log, free, prior=0.5, entries="diagonal")
    assert fit.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    for name, value in hidden_terms.items():
        one = fit[f"cross_damping.value[{name}]"]
        assert one.start == 0.0 and one.value == pytest.approx(value, abs=4 * one.std_model)
        # It is known: the prior alone leaves half of what the axes' own damping makes usual, 10 and 2.7.
        assert one.std_model < 0.3 * abs(value)


DRAG = "[surge_drag]\nspeed = [0.0, 0.2, 0.6, 1.0]\ndrag = [5.0, 2.0, 8.0, 7.0]\n"


def test_surge_drag_is_linear_between_its_speeds_and_constant_beyond_them(tmp_path):
    craft = read(tmp_path, BARE + DRAG)
    assert craft.command_names == ()
    plant = craft.plant()
    # D(0.1) = (5 + 2) / 2, D(0.3) = 2 + 6 / 4, D(0.8) = (8 + 7) / 2; beyond 1 m/s it is 7, astern as ahead.
    for u, force in (0.1, -0.35), (0.3, -1.05), (0.8, -6.0), (-0.8, 6.0), (1.5, -10.5), (0.0, 0.0):
        found = plant.pushed(jnp.zeros(0), jnp.array([u, 0.1, 0, 0, 0, 0.4]))
        np.testing.assert_allclose(found, [force, 0, 0, 0, 0, 0], atol=1e-12)
    slope = jax.jacfwd(lambda nu: plant.pushed(jnp.zeros(0), nu))(jnp.zeros(6))
    np.testing.assert_allclose(slope[0, 0], -5.0)
    jm.save_vehicle(craft, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert all(map(np.array_equal, jax.tree.leaves(craft), jax.tree.leaves(again)))


@pytest.mark.parametrize(
    "wrong", [("0.0, ", ""), ("0.6", "0.1"), (", 7.0", ""), ("2.0, 8", "-2.0, 8"), ("5.0", "nan")]
)
def test_surge_drag_is_checked(tmp_path, wrong):
    with pytest.raises(InputError, match="surge_drag"):
        read(tmp_path, BARE + DRAG.replace(*wrong))


@pytest.mark.slow
def test_thrust_lost_to_the_flow_and_surge_drag_are_fitted(tmp_path):
    """Of a boat that went ahead and astern, from a file without the one and with a flat shape."""
    text = jm.packaged_vehicle("cybership2").read_text()
    flat = "[surge_drag]\nspeed = [0.0, 0.3, 0.6]\ndrag = [2.0, 2.0, 2.0]\n"
    file = read(tmp_path, text.replace("[sensors]", flat + "[sensors]"))
    lossy = eqx.tree_at(lambda v: v.thrusters.advance_loss, file, jnp.array([1.5, 1.0, 0.0]))
    true = eqx.tree_at(lambda v: v.actuators[0].drag, lossy, jnp.array([3.0, 1.0, 4.0]))
    t, rng = np.arange(0.0, 600.0, 0.2), np.random.default_rng(3)
    commands = np.repeat(rng.uniform(-0.9, 0.9, (len(t) // 50, 3)), 50, axis=0) * [1.0, 1.0, 0.2]
    log = recorded(true, commands, t, seed=2, name="log.csv")
    held = np.array([np.inf, np.inf, 0.0])
    fit = jm.fit(
        file,
        log,
        lambda v: (v.thrusters.advance_loss, v.actuators[0].drag),
        prior=(held, np.full(3, np.inf)),
    )
    assert fit.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    truth = {"thrusters.advance_loss[star]": 1.5, "thrusters.advance_loss[port]": 1.0}
    truth |= {f"surge_drag.drag[{i}]": value for i, value in enumerate((3.0, 1.0, 4.0))}
    for name, value in truth.items():
        assert fit[name].value == pytest.approx(value, abs=4 * fit[name].std_model)
        assert fit[name].std_model < 0.25 * value


HULL = """
[hull_polynomial]
length = 3.0
draft = 0.2
surge = [0.022, -0.04, 0.002, 0.011, 0.771]
sway = [-0.315, 0.083, -1.607, 0.379, -0.391, 0.008]
yaw = [-0.137, -0.049, -0.03, -0.294, 0.055, -0.013]
"""


def by_polynomials(u, v, r):
    """Surge, sway and yaw of `HULL` as they are printed, for a ship that goes ahead."""
    speed = np.hypot(u, v)
    a, b, size = v / speed, r * 3.0 / speed, 0.5 * 1000 * 3.0 * 0.2 * speed**2
    x = -0.022 - 0.04 * a**2 + 0.002 * a * b + 0.011 * b**2 + 0.771 * a**4
    y = -0.315 * a + 0.083 * b - 1.607 * a**3 + 0.379 * a**2 * b - 0.391 * a * b**2 + 0.008 * b**3
    n = -0.137 * a - 0.049 * b - 0.03 * a**3 - 0.294 * a**2 * b + 0.055 * a * b**2 - 0.013 * b**3
    return np.array([size * x, size * y, 3.0 * size * n])


def test_a_hull_of_polynomials_has_those_of_the_book(tmp_path):
    craft = read(tmp_path, BARE + HULL)
    assert craft.command_names == ()
    plant = craft.plant()

    def pushed(nu):
        return plant.pushed(jnp.zeros(0), nu)

    def found(u, v, r):
        wrench = np.asarray(pushed(jnp.array([u, v, 0.0, 0.0, 0.0, r])))
        assert not wrench[2:5].any()
        return wrench[[0, 1, 5]]

    for u, v, r in ((1.2, 0.0, 0.0), (1.0, -0.3, 0.2), (0.6, 0.25, -0.15), (0.7, 0.5, 0.1), (0.4, -0.1, 0.0)):
        # A fiftieth of the turning speed counts as speed.
        np.testing.assert_allclose(found(u, v, r), by_polynomials(u, v, r), rtol=2e-4, atol=1e-3)
        # Astern it is the mirror image: surge, turn and moment have the other sign.
        x, y, n = by_polynomials(u, v, -r)
        np.testing.assert_allclose(found(-u, v, r), [-x, y, -n], rtol=2e-4, atol=1e-3)
    assert found(-1.0, 0.0, 0.0)[0] > 0.0 > found(1.0, 0.0, 0.0)[0]
    # At rest there is nothing, on the spot something bounded, and slopes are finite and those of differences.
    assert not found(0.0, 0.0, 0.0).any()
    assert np.abs(found(0.0, 0.0, 0.5)).max() < 0.5 * 1000 * 3.0**2 * 0.2 * 1.5**2
    slopes = jax.jacfwd(pushed)
    for nu in (
        np.zeros(6),
        [0, 0, 0, 0, 0, 0.3],
        [0, 0.2, 0, 0, 0, 0],
        [0.01, 0.2, 0, 0, 0, 0.1],
        [0.8, 0.1, 0, 0, 0, 0.2],
    ):
        nu = jnp.asarray(np.array(nu, float))
        slope = np.asarray(slopes(nu))
        assert np.isfinite(slope).all()
        if nu.any():
            for j in (0, 1, 5):
                step = jnp.zeros(6).at[j].set(1e-8)
                difference = np.asarray(pushed(nu + step) - pushed(nu - step)) / 2e-8
                np.testing.assert_allclose(slope[:, j], difference, rtol=1e-5, atol=1e-3)


@pytest.fixture(scope="module")
def hull_of_polynomials(tmp_path_factory) -> jm.Vehicle:
    """The ship with polynomials beside its damping."""
    return read(tmp_path_factory.mktemp("hull"), SHIP.replace("[sensors]", HULL + "[sensors]"))


@pytest.mark.parametrize("wrong", [("0.022, ", ""), ("draft = 0.2", "draft = 0.0"), ("-0.049", "nan")])
def test_a_hull_of_polynomials_is_written_and_checked(hull_of_polynomials, tmp_path, wrong):
    jm.save_vehicle(hull_of_polynomials, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert all(map(np.array_equal, jax.tree.leaves(hull_of_polynomials), jax.tree.leaves(again)))
    with pytest.raises(InputError, match="hull_polynomial"):
        read(tmp_path, BARE + HULL.replace(*wrong))


@pytest.mark.slow
def test_numbers_of_a_hull_of_polynomials_are_fitted(hull_of_polynomials):
    craft = hull_of_polynomials

    def free(v):
        return v.actuators[2].sway, v.actuators[2].yaw

    t = np.arange(0.0, 60.0, 0.1)
    log = recorded(craft, operated(craft, t, seed=1), t, seed=2, name="log.csv")
    begin = eqx.tree_at(free, craft, tuple(0.7 * one for one in free(craft)))
    fit = jm.fit(begin, log, free, prior=0.5)
    truth = np.concatenate(free(craft))
    assert fit.parameters[7].name == "hull_polynomial.yaw[1]"
    for parameter, true in zip(fit.parameters, truth, strict=True):
        assert parameter.value == pytest.approx(true, abs=4 * parameter.std_model)
    # What the log shows best is known thrice as well as it was guessed, and the guess was wrong.
    for k in (0, 6):
        assert fit.parameters[k].std_model < 0.5 * abs(fit.parameters[k].start) / 3
        assert abs(fit.parameters[k].start - truth[k]) > 2 * fit.parameters[k].std_model


def test_drift_and_turn_take_the_propeller_out_of_the_wake(tmp_path):
    craft = read(
        tmp_path,
        SHIP.replace("wake_fraction = 0.3", "wake_fraction = 0.3\nwake_decay = 4.0\nwake_arm = -1.2"),
    )
    jm.save_vehicle(craft, tmp_path / "again.toml")
    craft, plain = jm.load_vehicle(tmp_path / "again.toml"), read(tmp_path, SHIP)
    n, u, v, r = 12.0, 0.9, -0.2, 0.15
    drift = np.arctan2(-v, u) + 1.2 * r / np.hypot(u, v)
    lower = eqx.tree_at(
        lambda ship: ship.actuators[0].wake_fraction, plain, jnp.array([0.3 * np.exp(-4.0 * drift**2)])
    )
    acting = jnp.array([n, 0.2])
    for nu in ([u, v, 0, 0, 0, r], [u, -v, 0, 0, 0, -r]):
        nu = jnp.array(nu, float)
        found, by_hand = (np.asarray(one.plant().pushed(acting, nu)) for one in (craft, lower))
        np.testing.assert_allclose(found, by_hand, rtol=1e-12)
        assert np.abs(found - np.asarray(plain.plant().pushed(acting, nu))).max() > 0.5
    for nu in ([u, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]):
        nu = jnp.array(nu, float)
        same = (np.asarray(one.plant().pushed(acting, nu)) for one in (craft, plain))
        np.testing.assert_allclose(*same, rtol=1e-12)
    for nu in ([0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.4], [1e-9, 0, 0, 0, 0, 0.4], [0, 0.1, 0, 0, 0, 0]):
        slope = jax.jacfwd(lambda nu: craft.plant().pushed(acting, nu))(jnp.array(nu, float))
        assert np.isfinite(np.asarray(slope)).all()


WIND = """
[wind]
frontal_area = 0.4
lateral_area = 1.2
length = 3.0
centre = [0.2, -0.5]
surge = [-0.6]
sway = [-0.8, 0.1]
yaw = [-0.05]
"""


def test_wind_pushes_where_it_blows(tmp_path):
    craft = read(tmp_path, BARE + WIND)
    assert craft.command_names == ("wind_speed", "wind_direction")
    plant, heading = craft.plant(), 0.7
    turn = jnp.array(
        [[np.cos(heading), -np.sin(heading), 0], [np.sin(heading), np.cos(heading), 0], [0, 0, 1]]
    )
    nu = jnp.array([1.0, 0.2, 0, 0, 0, 0])
    found = np.asarray(plant.pushed(jnp.array([6.0, 2.0]), nu, nu, turn))
    # Apparent: the wind's own velocity less the craft's, both in body axes, and where that comes from.
    blows = -6.0 * np.array([np.cos(2.0 - heading), np.sin(2.0 - heading)]) - np.array([1.0, 0.2])
    angle, size = np.arctan2(-blows[1], -blows[0]), 0.5 * 1.225 * (blows @ blows)
    x = size * 0.4 * -0.6 * np.cos(angle)
    y = size * 1.2 * (-0.8 * np.sin(angle) + 0.1 * np.sin(2 * angle))
    n = size * 1.2 * 3.0 * -0.05 * np.sin(angle) + 0.2 * y
    np.testing.assert_allclose(found, [x, y, 0, 0.5 * y, -0.5 * x, n], rtol=1e-9)
    slopes = jax.jacfwd(lambda nu: plant.pushed(jnp.zeros(2), nu, nu, turn))(jnp.zeros(6))
    assert np.isfinite(np.asarray(slopes)).all()


def blown(folder) -> tuple[jm.Vehicle, pd.DataFrame]:
    """A craft with wind, and its log with the apparent one: half a turn at speed, in a wind from 2 rad."""
    craft = read(folder, BARE + WIND)
    t = np.arange(0, 10, 0.1)
    psi = 0.3 + 0.2 * t
    u, v = 1.0 + 0.02 * t, np.full_like(t, 0.2)
    over = [-6.0 * np.cos(2.0 - psi) - u, -6.0 * np.sin(2.0 - psi) - v]
    table = {"t": t, "psi": psi, "u": u, "v": v, "r": np.full_like(t, 0.2)}
    table |= {"apparent_wind_speed": np.hypot(*over), "apparent_wind_angle": np.arctan2(-over[1], -over[0])}
    return craft, pd.DataFrame(table)


def test_the_wind_may_be_measured_on_the_craft(tmp_path):
    craft, table = blown(tmp_path)
    log = jm.read_log(table, craft)
    assert log.commands is not None
    np.testing.assert_allclose(log.commands[:, 0], 6.0, rtol=1e-3)
    np.testing.assert_allclose(np.cos(log.commands[:, 1] - 2.0), 1.0, rtol=1e-6)
    # What is logged is what blows at the craft, whatever the true wind was.
    k = 40
    psi, speed, angle = (table[name][k] for name in ("psi", "apparent_wind_speed", "apparent_wind_angle"))
    c, s = np.cos(psi), np.sin(psi)
    nu = jnp.array([table["u"][k], 0.2, 0, 0, 0, 0.2])
    turn = jnp.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    found = np.asarray(craft.plant().pushed(jnp.asarray(log.commands[k]), nu, nu, turn))
    assert found[0] == pytest.approx(-0.5 * 1.225 * speed**2 * 0.4 * 0.6 * np.cos(angle), rel=1e-3)
    in_degrees = jm.logs.ColumnMap.model_validate(
        {"columns": {"apparent_wind_angle": {"from": "awa", "unit": "deg"}}}
    )
    other = table.drop(columns="apparent_wind_angle").assign(awa=np.rad2deg(table["apparent_wind_angle"]))
    again = jm.read_log(other, craft, in_degrees).commands
    assert again is not None
    np.testing.assert_allclose(again, log.commands)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda table: table.assign(wind_speed=6.0, wind_direction=2.0), "leave out one of the pairs"),
        (lambda table: table.drop(columns="apparent_wind_angle"), "without `apparent_wind_angle`"),
        (lambda table: table.drop(columns="psi"), "lacks `psi`"),
        (lambda table: table.assign(apparent_wind_angle=90.0), "give m/s and radians"),
        (lambda table: table.assign(apparent_wind_angle=np.nan), "has no value"),
    ],
)
def test_a_wind_that_cannot_be_used_is_refused_in_one_sentence(tmp_path, change, told):
    craft, table = blown(tmp_path)
    with pytest.raises(InputError, match=told) as error:
        jm.read_log(change(table), craft)
    assert "\n" not in str(error.value)


AZIMUTH = """
[[thruster]]
name = "pod"
position = [-1.4, 0.3, 0.1]
direction = [1, 0, 0]
max_thrust = 50.0
lag = 0.2
swivel = [0, 0, 1]
[[thruster]]
name = "bow"
position = [1.2, 0, 0.1]
direction = [0, 1, 0]
max_thrust = 20.0
"""


def test_a_thruster_swivels(tmp_path):
    craft = read(tmp_path, BARE + AZIMUTH)
    assert craft.command_names == ("pod", "bow", "pod_angle")
    found = np.asarray(craft.plant().pushed(jnp.array([40.0, 10.0, 0.5]), jnp.zeros(6)))
    x, y = 40 * np.cos(0.5), 40 * np.sin(0.5)
    # Clockwise from above about an axis that points down: to starboard.
    np.testing.assert_allclose(found[[0, 1, 5]], [x, y + 10, -1.4 * y - 0.3 * x + 12], rtol=1e-9)
    jm.save_vehicle(craft, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert jax.tree.structure(again) == jax.tree.structure(craft)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), again, craft))


def test_thrust_goes_with_the_battery(tmp_path):
    supplied = AZIMUTH.replace("lag = 0.2", "nominal_voltage = 16.0\nvoltage_exponent = 1.5")
    craft = read(tmp_path, BARE + supplied)
    assert craft.command_names == ("pod", "bow", "pod_angle", "battery")
    found = np.asarray(craft.plant().pushed(jnp.array([40.0, 10.0, 0.5, 14.0]), jnp.zeros(6)))
    push = 40 * (14 / 16) ** 1.5
    np.testing.assert_allclose(found[:2], [push * np.cos(0.5), push * np.sin(0.5) + 10], rtol=1e-9)
    jm.save_vehicle(craft, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml")
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), again, craft))


def drained(craft: jm.Vehicle, exponent: float, folder, seconds: float, seed: int) -> pd.DataFrame:
    """A log of a craft on a battery that sinks from 17 to 13 V, its thrust with a power of that over 15 V."""
    battery = Supply.unfiled(craft.thruster_names, 15.0)
    truth = dataclasses.replace(craft, actuators=(*craft.actuators, battery))
    truth = truth.place(cause_named(truth, f"voltage exponent={exponent}"))
    t = np.arange(0.0, seconds, 0.1)
    commands = operated(truth, t, seed)
    commands[:, -1] = np.linspace(17.0, 13.0, len(t))
    jm.write_log(recorded(truth, commands, t, seed, "log"), folder / "log.csv")
    return pd.read_csv(folder / "log.csv")


def test_thrust_by_the_battery_is_a_power_of_its_voltage(tmp_path):
    craft = read(tmp_path, BARE + AZIMUTH.replace("lag = 0.2", "nominal_voltage = 16.0"))
    worn = craft.place(cause_named(craft, "voltage exponent=0.5"))
    found = np.asarray(worn.plant().pushed(jnp.array([40.0, 10.0, 0.0, 14.0]), jnp.zeros(6)))
    np.testing.assert_allclose(found[:2], [40 * (14 / 16) ** 1.5, 10], rtol=1e-9)


def test_the_voltage_is_read_beside_the_commands(tmp_path):
    craft = read(tmp_path, BARE + AZIMUTH)
    table = drained(craft, 1.5, tmp_path, 5.0, 1)
    log = jm.read_log(table.assign(battery=table["battery"].mask(table["t"] < 1.0)), craft)
    assert log.commands is not None and log.commands.shape[1] == 3 and log.battery is not None
    assert not any("battery" in note for note in log.notes)
    np.testing.assert_allclose(log.battery[:11], table["battery"][10])
    # A vehicle whose thrust hangs on it takes it from there, and says so where it lacks.
    supplied = read(tmp_path, BARE + AZIMUTH.replace("lag = 0.2", "nominal_voltage = 15.0"))
    log = jm.read_log(table, craft)
    np.testing.assert_array_equal(
        log.commanded(supplied.command_names), jm.read_log(table, supplied).commands
    )
    part = log.between(1.0, 2.0).battery
    assert part is not None and part.shape == (10,)
    with pytest.raises(InputError, match="battery"):
        dataclasses.replace(log, battery=None).commanded(supplied.command_names)


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [0.0, 1.5])
def test_thrust_that_sinks_with_the_battery_is_found(tmp_path, exponent):
    craft = read(tmp_path, BARE + AZIMUTH)
    logs = [jm.read_log(drained(craft, exponent, tmp_path, s, i), craft) for i, s in enumerate((120.0, 60.0))]
    found = jm.diagnose(craft, *logs, catalogue=(*FEW, Voltage))
    assert [finding.label for finding in found.findings] == ["voltage"] * bool(exponent)
    if not exponent:
        assert found.extended.command_names == craft.command_names
        return
    parameter = found.findings[0].parameters["exponent"]
    assert parameter.value == pytest.approx(exponent, abs=4 * parameter.std)
    jm.save_vehicle(found.extended, tmp_path / "extended.toml")
    again = jm.load_vehicle(tmp_path / "extended.toml")
    start = jm.initial_state(again)
    one, other = (jm.simulate(craft, logs[1], start)["u"] for craft in (found.extended, again))
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_propeller_swivels(tmp_path):
    craft = read(tmp_path, SHIP.replace("max_speed = 20.0", "max_speed = 20.0\nswivel = [0, 0, 1]"))
    assert craft.command_names == ("prop", "prop_angle", "rudder")
    straight = np.asarray(craft.plant().pushed(jnp.array([10.0, 0.0, 0.0]), jnp.zeros(6)))
    turned = np.asarray(craft.plant().pushed(jnp.array([10.0, 0.4, 0.0]), jnp.zeros(6)))
    np.testing.assert_allclose(turned[:2], straight[0] * np.array([np.cos(0.4), np.sin(0.4)]), rtol=1e-9)


class FlapTable(Table):
    """A flap that brakes by its opening."""

    name: str
    drag: Number


class Flaps(AbstractActuators):
    """One's own kind, in one place: X = -drag opening² u |u|."""

    key = "flap"
    title = "Brake flaps"
    table = FlapTable

    drag: jax.Array
    delay: jax.Array
    lag: jax.Array
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, tables):
        zero = jnp.zeros(len(tables))
        return cls(
            jnp.array([one.drag for one in tables]), zero, zero + 0.3, tuple(one.name for one in tables)
        )

    def tables(self):
        return [{"name": n, "drag": float(d)} for n, d in zip(self.names, self.drag, strict=True)]

    @property
    def columns(self):
        return self.names

    @property
    def units(self):
        return ("1",) * len(self.names)

    @property
    def limits(self):
        return np.ones(len(self.names))

    @property
    def usual(self):
        return np.outer(np.ones(len(self.names)), [0.0, 1.0])

    def servo(self):
        return servo(jnp.ones(len(self.names)), self.delay, self.lag)

    def streams(self, state, flow):
        return {}

    def wrench(self, state, flow):
        u = flow.nu_r[0]
        return jnp.zeros(6).at[0].set(-(self.drag * state**2).sum() * u * jnp.abs(u))


class FlapLoose(ActuatorEffect):
    """A flap brakes `factor` times as much. Neutral: 1."""

    name = "flap_loose"
    units = {"factor": "1"}
    factor: jax.Array

    @classmethod
    def neutral(cls, craft):
        return cls(jnp.ones(()))

    @classmethod
    def suspects(cls, craft):
        there = any(isinstance(one, Flaps) for one in craft.actuators)
        return (Suspect(cls, None, {"factor": (0,)}),) if there else ()

    def changed(self, actuators):
        if not isinstance(actuators, Flaps):
            return actuators
        return dataclasses.replace(actuators, drag=actuators.drag * self.factor)


def test_a_kind_of_ones_own_is_read_and_driven(tmp_path):
    text = SHIP + '[[flap]]\nname = "brake"\ndrag = 40.0\n'
    with pytest.raises(InputError, match="flap"):
        read(tmp_path, text)
    craft = read(tmp_path, text, kinds=(*KINDS, Flaps))
    assert craft.command_names == ("prop", "rudder", "brake")
    assert craft.command_units == ("rev/s", "rad", "1")
    jm.save_vehicle(craft, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml", kinds=(*KINDS, Flaps))
    assert jax.tree.structure(again) == jax.tree.structure(craft)
    t = np.arange(0, 60, 0.1)
    runs = {}
    for opened in (0.0, 0.8):
        commands = np.stack([np.full_like(t, 12.0), 0 * t, np.where(t > 40, opened, 0.0)], axis=1)
        log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, craft.command_names, "log")
        runs[opened] = np.asarray(jm.simulate(craft, log, jm.initial_state(craft))["u"])
    np.testing.assert_array_equal(runs[0.0][:400], runs[0.8][:400])
    assert runs[0.8][-1] < 0.8 * runs[0.0][-1]


@pytest.mark.slow
def test_a_kind_of_ones_own_is_diagnosed(tmp_path):
    craft = read(tmp_path, SHIP + '[[flap]]\nname = "brake"\ndrag = 40.0\n', kinds=(*KINDS, Flaps))
    catalogue = (SurfaceGain, ThrusterGain, LinearDamping, FlapLoose)
    logs = hidden(craft, "flap_loose", None, {"factor": 0.5}, (60.0, 40.0), catalogue=catalogue)
    found = jm.diagnose(craft, *logs, catalogue=catalogue)
    assert [finding.label for finding in found.findings] == ["flap_loose"]
    parameter = found.findings[0].parameters["factor"]
    assert parameter.value == pytest.approx(0.5, abs=4 * parameter.std)
    jm.write_report(found, tmp_path / "report")
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    assert "Brake flaps" in page and "flap loose" in page.lower()


def test_a_craft_of_all_kinds_is_driven(tmp_path):
    """Thrusters, one of which swivels, beside propeller, rudder and wind: every column acts on its own."""
    craft = read(tmp_path, SHIP + AZIMUTH + WIND)
    names = ("pod", "bow", "pod_angle", "prop", "rudder", "wind_speed", "wind_direction")
    assert craft.command_names == names
    assert craft.command_units == ("1", "1", "rad", "rev/s", "rad", "m/s", "rad")
    learned = jm.Placed(learned_thrust(craft.thruster_names, -np.ones(2), np.ones(2)))
    base = np.array([0.5, 0.2, 0.3, 10.0, 0.2, 4.0, 1.0])

    def end(vehicle, commands) -> np.ndarray:
        t = np.arange(0, 5, 0.1)
        log = jm.Log(t, np.full((50, 18), np.nan), np.tile(commands, (50, 1)), None, names, "log")
        return np.asarray(jm.simulate(vehicle, log, jm.initial_state(vehicle)).channels)[-1, :12]

    as_filed = end(craft, base)
    # Networks without weight change nothing, whatever stands beside the thrusters.
    np.testing.assert_allclose(end(craft.place(learned), base), as_filed, rtol=1e-12)
    for i in range(len(names)):
        changed = end(craft, base * (1 - 0.5 * np.eye(len(names))[i]))
        assert np.abs(changed - as_filed).max() > 1e-4, names[i]
    weak = place(suspect_named(craft, "thruster_gain", "all"), craft, {"factor": 0.0})
    none = end(craft.place(jm.Placed(weak, "all")), base * [1, 1, 1, 1, 1, 0, 1])
    assert np.abs(none).max() < 1e-9


def test_a_fit_of_what_kinds_tell_turns_no_thrust_and_no_lift_round(tmp_path):
    craft = read(tmp_path, SHIP + WIND)
    for number, one in enumerate(craft.actuators):
        for field in one.told:

            def free(vehicle, number=number, field=field):
                return getattr(vehicle.actuators[number], field)

            freed, scales = set_free(craft, free, prior=0.3)
            raw = freed.start - 50.0 * scales.prior
            leaf = np.asarray(free(freed(raw))).reshape(len(np.atleast_1d(free(craft))), -1)
            if field in ("kt", "kt_reverse", "lift_slope"):
                assert (leaf[:, 0] > 0).all(), field
            else:
                assert (leaf < 0).any(), field


def test_a_log_beyond_the_limits_is_refused(ship):
    t = np.arange(0, 3, 0.1)
    table = {"t": t, **dict.fromkeys(("u", "v", "r"), 0 * t), "prop": 0 * t + 12.0, "rudder": 0 * t}
    assert jm.read_log(pd.DataFrame(table), ship).commands[0].tolist() == [12.0, 0.0]
    for name, value in (("prop", 21.0), ("rudder", 20.0)):
        with pytest.raises(InputError, match=f"`{name}` is {value:g}"):
            jm.read_log(pd.DataFrame(table | {name: 0 * t + value}), ship)
    with pytest.raises(InputError, match="rudder"):
        jm.read_log(pd.DataFrame({key: table[key] for key in table if key != "rudder"}), ship)


@pytest.fixture(scope="module")
def sailed(ship) -> jm.Log:
    return hidden(ship, "surface_gain", "rudder", {"factor": 1.0}, (60.0, 20.0))[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "told"), [(None, None), (1, "Yaw answers opposite to rudder"), (0, "answers opposite to prop")]
)
def test_a_column_of_the_wrong_sign_is_told_by_check(ship, sailed, column, told):
    assert sailed.commands is not None
    signs = np.where(np.arange(2) == column, -1.0, 1.0)
    # A file is off: here by a third less lift and twice the damping.
    wrong = eqx.tree_at(lambda v: v.actuators[1].lift_slope, ship, jnp.array([1.6]))
    wrong = eqx.tree_at(lambda v: v.damping.linear, wrong, 2.0 * ship.damping.linear)
    log = dataclasses.replace(sailed, commands=sailed.commands * signs)
    gross = [one.told for one in gross_errors(wrong, [log])]
    assert len(gross) == (column is not None)
    if told:
        assert told in gross[0] and "has the wrong sign" in gross[0] and "\n" not in gross[0]
        assert jm.check(wrong, log).gross[0] == gross[0]


NAMED = ["propeller.wake_fraction[prop]", "surface.lift_slope[rudder]"]


@pytest.mark.slow
def test_numbers_of_propeller_and_rudder_are_fitted(ship):
    train, _ = hidden(ship, "surface_gain", "rudder", {"factor": 1.0}, (60.0, 20.0))
    wrong = eqx.tree_at(lambda v: v.actuators[1].lift_slope, ship, jnp.array([3.2]))
    wrong = eqx.tree_at(lambda v: v.actuators[0].wake_fraction, wrong, jnp.array([0.1]))
    fit = jm.fit(wrong, train, lambda v: (v.actuators[0].wake_fraction, v.actuators[1].lift_slope))
    assert [p.name for p in fit.parameters] == NAMED
    for parameter, truth in zip(fit.parameters, (0.3, 2.4), strict=True):
        assert parameter.value == pytest.approx(truth, abs=4 * parameter.std_model)
