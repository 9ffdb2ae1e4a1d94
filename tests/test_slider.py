"""The sliding mass against the momenta of two bodies, conservation, and a plain integration of its servo."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxmarine as jm
from jaxmarine._errors import InputError
from jaxmarine.actuators import KINDS, Slide, Slider
from jaxmarine.fitting import Affine, Problem, cut, linearise, predict, start_precision
from jaxmarine.fitting._free import set_free
from jaxmarine.physics import rotation
from jaxmarine.simulation import substeps
from jaxmarine.vehicle import Input, inverse_dynamics
from tests.crafts import brick, packaged

SLIDER = Slider(
    mass=jnp.asarray(1.7),
    position=jnp.array([-0.5, 0.05, 0.02]),
    direction=jnp.array([0.6, 0.0, 0.8]),
    travel=jnp.asarray(0.2),
    time_constant=jnp.asarray(0.3),
    names=("slider",),
)


def in_vacuum(mass: float = 10.0) -> jm.Vehicle:
    """Hull and slider without water and weight; the file's masses have the slider at command 0."""
    hull = mass - SLIDER.mass
    place, hull_cog = np.asarray(SLIDER.position), np.array([0.1, -0.05, 0.08])
    cog = (hull * hull_cog + SLIDER.mass * place) / mass
    vehicle = brick(mass=mass, weight=0.0, buoyancy=0.0, cog=cog)
    inertia = np.diag([2.0, 3.0, 4.0]) + SLIDER.mass * ((place @ place) * np.eye(3) - np.outer(place, place))
    lever = mass * np.cross(cog, np.eye(3)).T  # m S(cog)
    matrix = np.block([[mass * np.eye(3), -lever], [lever, np.asarray(inertia)]])
    body = dataclasses.replace(vehicle.body, matrix=jnp.asarray(matrix))
    return dataclasses.replace(vehicle, body=body, gravity=jnp.asarray(0.0), masses=(SLIDER,))


def momenta(vehicle: jm.Vehicle, nu, offset, rate) -> np.ndarray:
    """Linear and angular momentum about `o` in body axes, summed over the hull and the slider."""
    v, w = nu[:3], nu[3:]
    start = np.asarray(SLIDER.position)
    hull = float(vehicle.body.mass - SLIDER.mass)
    hull_cog = (float(vehicle.body.mass) * np.asarray(vehicle.body.cog) - SLIDER.mass * start) / hull
    at = start + offset * np.asarray(SLIDER.direction)
    slides = v + np.cross(w, at) + rate * np.asarray(SLIDER.direction)
    p = hull * (v + np.cross(w, hull_cog)) + SLIDER.mass * slides
    h = np.diag([2.0, 3.0, 4.0]) @ w + hull * np.cross(hull_cog, v) + SLIDER.mass * np.cross(at, slides)
    return np.concatenate([p, h])


def moving(t: float) -> np.ndarray:
    """Some velocities over time."""
    return np.array([np.sin((1.0 + 0.3 * i) * t + i) for i in range(6)])


def test_the_wrench_is_the_change_of_the_two_bodies_momenta():
    vehicle = in_vacuum()
    slide = Slide(*map(jnp.asarray, (0.05, 0.3, -0.2, 1.0, 0.3)))
    step = 1e-5

    def at(t):
        offset, rate, _ = (float(x) for x in slide(jnp.asarray(t)))
        return momenta(vehicle, moving(t), offset, rate)

    worst = 0.0
    for t in (1.0, 1.2, 1.7):
        change = (at(t + step) - at(t - step)) / (2 * step)
        if t == 1.0:  # the hold begins here: one-sided, second order
            change = (-3 * at(t) + 4 * at(t + step) - at(t + 2 * step)) / (2 * step)
        p, h, nu = at(t)[:3], at(t)[3:], moving(t)
        force = change[:3] + np.cross(nu[3:], p)
        moment = change[3:] + np.cross(nu[3:], h) + np.cross(nu[:3], p)
        nu_dot = (moving(t + step) - moving(t - step)) / (2 * step)
        state = jm.initial_state(vehicle, velocity=nu)
        wrench = inverse_dynamics(vehicle, state, jnp.asarray(nu_dot), t, (slide,))
        worst = max(worst, np.abs(np.concatenate([force, moment]) - wrench).max())
        # The slider's own share is there to be seen: without V and b the error would be this large.
        share = SLIDER.reaction(slide, jnp.asarray(t), jnp.asarray(nu))
        assert np.abs(share).max() > 0.3
    assert worst < 1e-6  # differences of step 1e-5 leave 1e-8


def test_forward_dynamics_inverts_them():
    vehicle = in_vacuum()
    slide = Slide(*map(jnp.asarray, (0.05, 0.3, -0.2, 1.0, 0.3)))
    state, nu_dot = jm.initial_state(vehicle, velocity=moving(0.3)), jnp.asarray(moving(2.0))
    wrench = inverse_dynamics(vehicle, state, nu_dot, 1.3, (slide,))
    drive = Input(jnp.zeros(0), jnp.zeros(0), wrench, jnp.asarray(1.3), moving=(slide,))
    assert np.allclose(jm.forward_dynamics(vehicle, state, drive), nu_dot, rtol=0, atol=1e-12)


@pytest.mark.slow  # compiles a roll-out; the test above has the same physics
def test_a_free_body_keeps_its_momentum_while_the_mass_slides():
    """In a roll-out: whatever the slider does, momenta in earth axes about a fixed point stay."""
    vehicle = in_vacuum()
    t = np.arange(0.0, 4.0, 0.05)
    commands = np.sign(np.sin(3.0 * t))[:, None]
    start = jm.initial_state(vehicle, velocity=0.3 * moving(0.5))
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "log")
    states = jm.simulate(vehicle, log, start).states
    slides = SLIDER.moves(jnp.asarray(t), jnp.asarray(commands))
    offsets, rates, _ = jax.vmap(lambda s: s(s.since))(slides)
    assert np.ptp(offsets) > 0.3  # it goes from end to end

    def in_earth_axes(k):
        turn = np.asarray(rotation(states.attitude[k]))
        body = momenta(vehicle, np.asarray(states.velocity[k]), float(offsets[k]), float(rates[k]))
        p = turn @ body[:3]
        return np.concatenate([p, turn @ body[3:] + np.cross(np.asarray(states.position[k]), p)])

    all_of_them = np.array([in_earth_axes(k) for k in range(len(t))])
    moved = np.abs(np.asarray(states.velocity) - np.asarray(states.velocity[0])).max()
    assert moved > 0.1
    # Fourth order at 0.05 s and 1 rad/s.
    assert np.abs(all_of_them - all_of_them[0]).max() < 1e-5


def test_the_servo_is_a_critically_damped_second_order_lag():
    t = np.arange(0.0, 3.0, 0.2)
    commands = np.where(t < 1.0, 0.0, np.where(t < 2.0, 1.0, -0.5))
    slides = SLIDER.moves(jnp.asarray(t), jnp.asarray(commands)[:, None])
    travel, pace = 0.2, 1 / 0.3

    def rates(_, x, goal):
        return [x[1], pace**2 * (goal - x[0]) - 2 * pace * x[1]]

    x = [0.0, 0.0]
    for k, start in enumerate(t[:-1]):
        got = [float(a) for a in jax.tree.map(lambda a, k=k: a[k], slides)(jnp.asarray(start + 0.2))]
        goal = (travel * commands[k],)
        x = scipy.integrate.solve_ivp(rates, (0, 0.2), x, args=goal, rtol=1e-10, atol=1e-12).y[:, -1]
        assert np.allclose(got[:2], x, rtol=0, atol=1e-9)
        assert got[2] == pytest.approx(rates(0, x, *goal)[1], abs=1e-7)


def minesniper() -> jm.Vehicle:
    return dataclasses.replace(packaged("minesniper"), masses=(SLIDER,))


def at_rest(goal: float) -> Slide:
    return Slide(*map(jnp.asarray, (goal, 0.0, goal, 0.0, 0.3)))


def test_a_slider_at_rest_changes_nothing():
    """At command 0 the vehicle is that of the file without a slider, in forward and inverse dynamics."""
    vehicle, plain = minesniper(), packaged("minesniper")
    state = jm.initial_state(vehicle, attitude=(0.3, -0.5, 1.0), velocity=moving(0.2))
    drive = Input(jnp.ones(3), jnp.ones(3), jnp.ones(6), jnp.asarray(2.0), moving=(at_rest(0.0),))
    without = Input(jnp.ones(3), jnp.ones(3), jnp.ones(6), jnp.asarray(2.0))
    expected = jm.forward_dynamics(plain, state, without)
    assert np.allclose(jm.forward_dynamics(vehicle, state, drive), expected, rtol=1e-11, atol=1e-11)
    assert np.array_equal(jm.forward_dynamics(vehicle, state, without), expected)


def test_a_mass_slid_forward_holds_the_bow_down_at_the_angle_of_its_moment():
    rail = dataclasses.replace(SLIDER, direction=jnp.array([1.0, 0.0, 0.0]))
    vehicle = dataclasses.replace(minesniper(), masses=(rail,))
    # m_b g s cos(theta) + W z_g sin(theta) = 0
    angle = np.arctan(-1.7 * 9.81 * 0.1 / (392.4 * 0.025))
    state = jm.initial_state(vehicle, attitude=(0, angle, 0.7))
    still = inverse_dynamics(vehicle, state, jnp.zeros(6), 1.0, (at_rest(0.1),))
    assert np.abs(still).max() < 1e-12
    level = inverse_dynamics(vehicle, jm.initial_state(vehicle), jnp.zeros(6), 1.0, (at_rest(0.1),))
    assert level[4] == pytest.approx(1.7 * 9.81 * 0.1)  # it takes a moment bow up to stay level


@pytest.mark.slow  # compiles for long
def test_windows_differentiate_through_the_sliding_mass():
    vehicle = minesniper()
    t = np.arange(0.0, 6.0, 0.1)
    rng = np.random.default_rng(1)
    commands = np.repeat(rng.uniform(-0.8, 0.8, (12, 4)), 5, axis=0)
    blank = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "log")
    channels = np.asarray(jm.simulate(vehicle, blank, jm.initial_state(vehicle)).channels)
    log = dataclasses.replace(blank, channels=channels)
    noise = np.where(np.arange(18) < 6, 0.01, np.nan)
    data = cut(vehicle, [log], noise, 2.0)

    def plant_of(theta, segment):
        del segment
        linear = vehicle.damping.linear + jnp.diag(theta)
        damping = dataclasses.replace(vehicle.damping, linear=linear)
        return dataclasses.replace(vehicle, damping=damping).plant()

    split = jnp.asarray(substeps(vehicle, 0.1))
    problem = Problem(
        plant_of,
        data.records,
        data.windows,
        jnp.asarray(start_precision(vehicle.free)),
        tuple(range(12)),
        split,
    )
    affine = Affine(jnp.zeros((1, 6)), jnp.eye(6), jnp.ones((1, 6)))
    nothing = jnp.zeros((data.windows.count, 12))
    # The truth, from starts that are the smoothed ones: positions within a few noises.
    _, residual = eqx.filter_jit(predict)(problem, jnp.zeros((1, 6)), nothing)
    assert np.abs(residual).max() < 5.0
    stats = eqx.filter_jit(linearise)(problem, affine, nothing)

    def chi2(theta):
        return (eqx.filter_jit(predict)(problem, theta[None], nothing)[1] ** 2).sum()

    for i in range(6):
        step = 0.1 * jnp.zeros(6).at[i].set(1.0)
        slope = (chi2(step) - chi2(-step)) / 0.2
        # The gradient of the recursion is that of the midpoint rule, dt² of the motion's change.
        assert 2 * stats.g_z[:, i].sum() == pytest.approx(
            float(slope), rel=2e-2, abs=1e-2 * float(chi2(jnp.zeros(6)))
        )


TABLE = """
[slider]
name = "slider"
mass = 1.7
position = [-0.5, 0.0, 0.0]
direction = [2.0, 0.0, 0.0]
travel = 0.1
time_constant = 0.5
"""


def test_the_table_is_read_written_and_has_a_column(tmp_path):
    text = jm.packaged_vehicle("minesniper").read_text()
    (tmp_path / "a.toml").write_text(text + TABLE)
    vehicle = jm.load_vehicle(tmp_path / "a.toml")
    (slider,) = vehicle.masses
    assert np.array_equal(slider.direction, [1.0, 0.0, 0.0])
    jm.save_vehicle(vehicle, tmp_path / "b.toml")
    again = jm.load_vehicle(tmp_path / "b.toml")
    assert all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(vehicle), jax.tree.leaves(again), strict=True)
    )
    assert again.command_names == ("star", "port", "vertical", "slider")

    t = np.arange(0.0, 2.0, 0.1)
    channels = np.full((len(t), 18), np.nan)
    channels[:, :6] = 0.0
    log = jm.Log(t, channels, np.full((len(t), 4), 0.25), None, again.command_names, "log.csv")
    jm.write_log(log, tmp_path / "log.csv")
    assert np.array_equal(jm.read_log(tmp_path / "log.csv", again).commands, log.commands)
    # A log without its column is a good file, but not one of this vehicle.
    without = dataclasses.replace(log, commands=log.commands[:, :3], command_names=again.thruster_names)
    jm.write_log(without, tmp_path / "c.csv")
    with pytest.raises(InputError, match="slider"):
        jm.read_log(tmp_path / "c.csv", again)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mass = 1.7", "mass = 41.0", "below `body.mass`"),
        ('name = "slider"', 'name = "port"', "as a thruster's is"),
        ('name = "slider"', 'name = "theta"', "names something else"),
        ("[2.0, 0.0, 0.0]", "[0.0, 0.0, 0.0]", "must not be zero"),
        ("time_constant = 0.5", "time_constant = 0", "time_constant"),
    ],
)
def test_a_slider_that_cannot_be_is_refused(tmp_path, old, new, message):
    text = jm.packaged_vehicle("minesniper").read_text() + TABLE.replace(old, new)
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        jm.load_vehicle(tmp_path / "a.toml")


class Twin(Slider):
    """A second sliding mass, as somebody else's kind."""

    key = "twin"
    title = "Second sliding mass"


def test_a_kind_of_masses_of_ones_own_is_read_and_moves(tmp_path):
    text = jm.packaged_vehicle("minesniper").read_text() + '[[effect]]\neffect = "hull_lift"\nY_uv = 5.0\n'
    half = TABLE.replace("1.7", "0.85")
    (tmp_path / "one.toml").write_text(text + TABLE)
    (tmp_path / "two.toml").write_text(text + half + half.replace("slider", "twin"))
    kinds = (*KINDS, Twin)
    one, two = jm.load_vehicle(tmp_path / "one.toml"), jm.load_vehicle(tmp_path / "two.toml", kinds=kinds)
    assert two.command_names == ("star", "port", "vertical", "slider", "twin")
    assert two.command_limits.tolist() == [1.0] * 5
    jm.save_vehicle(two, tmp_path / "again.toml")
    again = jm.load_vehicle(tmp_path / "again.toml", kinds=kinds)
    assert jax.tree.structure(two) == jax.tree.structure(again)
    (tmp_path / "same.toml").write_text(text + half + half.replace("[slider]", "[twin]"))
    with pytest.raises(InputError, match="as another actuator's is"):
        jm.load_vehicle(tmp_path / "same.toml", kinds=kinds)
    # Two halves that move alike are one mass.
    t = np.arange(0.0, 8.0, 0.1)
    commands = np.zeros((len(t), 4))
    commands[:, 3] = np.where(t < 2.0, 0.0, np.where(t < 5.0, 1.0, -0.6))
    commands[:, 0] = 0.3
    tracks = []
    for craft, columns in ((one, commands), (two, commands[:, [0, 1, 2, 3, 3]])):
        log = jm.Log(t, np.full((len(t), 18), np.nan), columns, None, craft.command_names, "log")
        tracks.append(np.asarray(jm.simulate(craft, log, jm.initial_state(craft)).channels))
    assert np.abs(tracks[0][:, 4]).max() > 0.05  # it pitches
    np.testing.assert_allclose(tracks[1], tracks[0], rtol=0, atol=1e-10)
    # One that moves alone is not.
    lone = jm.Log(
        t, log.channels, np.append(commands, np.zeros((len(t), 1)), 1), None, two.command_names, "log"
    )
    track = np.asarray(jm.simulate(two, lone, jm.initial_state(two)).channels)
    assert np.abs(track - tracks[0])[:, 4].max() > 0.01


def test_what_is_fitted_of_a_slider_has_its_name():
    craft = minesniper()
    freed, _ = set_free(craft, lambda v: (v.masses[0].mass, v.masses[0].direction))
    assert freed.names == ("slider.mass", *(f"slider.direction[{i}]" for i in range(3)))
