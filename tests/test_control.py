"""Paths, feedforward, feedback and learning under way."""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import jaxmarine as jm
from jaxmarine import control
from jaxmarine.control import _learner
from jaxmarine.physics import rotation, to_euler


@pytest.fixture(scope="module")
def tethra() -> jm.Vehicle:
    return jm.load_vehicle(jm.packaged_vehicle("tethra"))


@pytest.fixture(scope="module")
def twisted() -> control.Path:
    """A path that turns about every axis at once."""
    rng = np.random.default_rng(0)
    return control.plan(np.array([0.0, 3.0, 5.0, 9.0, 12.0]), rng.uniform(-0.8, 0.8, (5, 6)))


# --- path -----------------------------------------------------------------------------------------


def test_velocities_and_accelerations_are_the_slopes_of_the_path(twisted):
    t, h = np.linspace(0.3, 11.7, 60), 1e-4
    before, at, after = (twisted.at(t + shift) for shift in (-h, 0.0, h))
    turn = jax.vmap(rotation)
    # Central differences of cubics: h² times a third derivative of about 1, and rounding of 1e-16 / h.
    way = (after.states.position - before.states.position) / (2 * h)
    np.testing.assert_allclose(
        np.einsum("tij,tj->ti", turn(at.states.attitude), at.states.velocity[:, :3]), way, atol=1e-7
    )
    # R' dR/dt is the cross product matrix of the rates.
    change = (turn(after.states.attitude) - turn(before.states.attitude)) / (2 * h)
    spin = np.einsum("tji,tjk->tik", turn(at.states.attitude), change)
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    np.testing.assert_allclose(at.states.velocity[:, 3:], rates, atol=1e-7)
    slope = (after.states.velocity - before.states.velocity) / (2 * h)
    np.testing.assert_allclose(at.acceleration, slope, atol=1e-6)


def test_a_path_meets_its_way_points_and_rests_at_both_ends(twisted):
    at = twisted.at(np.array([-1.0, 0.0, 5.0, 12.0, 20.0]))
    wanted = np.random.default_rng(0).uniform(-0.8, 0.8, (5, 6))[[0, 0, 2, 4, 4]]
    np.testing.assert_allclose(at.states.position, wanted[:, :3], atol=1e-12)
    np.testing.assert_allclose(jax.vmap(to_euler)(at.states.attitude), wanted[:, 3:], atol=1e-12)
    for end in 0, 1, 3, 4:
        np.testing.assert_allclose(at.states.velocity[end], 0.0, atol=1e-12)
    np.testing.assert_array_equal(at.acceleration[jnp.array([0, 4])], 0.0)


def test_a_spiral_dives_on_its_circle_heading_along_it():
    path = control.spiral(radius=2.0, speed=0.3, depths=(0.3, 2.0), duration=100.0, ramp=10.0)
    t = np.linspace(0.0, 100.0, 1001)
    at = path.at(t)
    x, y, depth = np.asarray(at.states.position).T
    # Way points every second of 0.15 rad: the spline leaves the circle by 2 * 0.15^4 / 384 = 3e-6 m;
    # where the acceleration jumps at the ramps' ends it is an order worse.
    np.testing.assert_allclose(np.hypot(x, y - 2.0), 2.0, atol=2e-4)
    np.testing.assert_allclose(depth[[0, 500, 1000]], [0.3, 2.0, 0.3], atol=1e-12)
    assert (np.diff(depth[:500]) > -1e-12).all() and (np.diff(depth[501:]) < 1e-12).all()
    u, v = np.asarray(at.states.velocity)[:, :2].T
    np.testing.assert_allclose(u[150:850], 0.3, rtol=2e-3)
    assert np.abs(v).max() < 1e-3
    # One ramp's worth of way is lost at the two ends together.
    turned = np.unwrap(np.arctan2(x, 2.0 - y))[-1]
    assert turned == pytest.approx(0.15 * 90.0, abs=1e-9)


@pytest.mark.parametrize(
    ("t", "pose"),
    [([0.0], np.zeros((1, 6))), ([0.0, 0.0], np.zeros((2, 6))), ([0.0, 1.0], np.full((2, 6), np.nan))],
)
def test_a_path_of_bad_way_points_is_refused(t, pose):
    with pytest.raises(jm.InputError, match="way points"):
        control.plan(np.array(t), pose)


# --- feedforward ----------------------------------------------------------------------------------


def test_steady_surge_needs_the_drag_of_its_speed(tethra):
    t = np.array([0.0, 10.0, 20.0])
    path = control.plan(t, np.stack([0.4 * t, *5 * [0 * t]], axis=1))
    tau = control.feedforward(tethra, path.at(np.array([10.0])))[0]
    # A cubic through these points from rest to rest passes the middle without acceleration, at 0.6 m/s.
    np.testing.assert_allclose(tau, [116 * 0.6 + 100 * 0.36, 0, 0, 0, -15 * 0.6, 0], atol=1e-9)


def _on_a_spiral(vehicle: jm.Vehicle, late: float = 0.05) -> tuple[control.Run, control.Reference]:
    """The vehicle under its own feedforward, read `late` seconds after the beginning of each hold."""
    path = control.spiral(radius=2.0, speed=0.3, depths=(0.3, 2.0), duration=40.0, ramp=10.0)
    t = np.arange(400) * 0.1
    reference = path.at(t)
    start = jax.tree.map(lambda a: a[0], reference.states)
    wrench = control.feedforward(vehicle, path.at(t + late))
    return control.follow(vehicle, reference, wrench, start), reference


def test_the_exact_model_tracks_up_to_the_hold_of_its_wrench(tethra):
    off = []
    for late in 0.05, 0.0:
        run, reference = _on_a_spiral(tethra, late)
        off.append(float(jnp.abs(run.trajectory.states.position - reference.states.position).max()))
    # Held about its middle a wrench is right to second order, dt² / 24 times its curvature: of 0.3 m/s over
    # 40 s that leaves some 1e-5 m. Read at the beginning it is late by dt / 2, a way of 0.3 m/s * 0.05 s.
    assert off[0] < 1e-4
    assert off[1] == pytest.approx(0.015, rel=0.3)


# --- feedback -------------------------------------------------------------------------------------


def _bare(vehicle: jm.Vehicle) -> jm.Vehicle:
    """Mass alone: no damping, weight or lever arms, so that the axes are decoupled."""
    mass = jnp.diag(jnp.array([200.0, 210.0, 220.0, 50.0, 55.0, 60.0]))
    nothing = jnp.zeros((6, 6))
    return eqx.tree_at(
        lambda v: (v.body.matrix, v.body.weight, v.body.buoyancy, v.damping.linear, v.damping.quadratic),
        vehicle,
        (mass, jnp.zeros(()), jnp.zeros(()), nothing, nothing),
    )


@pytest.fixture(scope="module")
def held(tethra) -> jm.Vehicle:
    return _bare(tethra)


def _hold_station(vehicle, feedback, start, errors=None) -> jm.Trajectory:
    path = control.plan(np.array([0.0, 20.0]), np.zeros((2, 6)))
    reference = path.at(np.arange(1000) * 0.01)
    return control.follow(vehicle, reference, jnp.zeros((1000, 6)), start, feedback, errors).trajectory


@pytest.mark.parametrize(("place", "channel"), [((0.3, 0, 0), "x"), ((0, 0, -0.2), "z")])
def test_placed_poles_give_the_response_of_second_order(held, place, channel):
    frequency = 1.5
    feedback = control.pole_placement(held.mass_matrix, frequency)
    shown = _hold_station(held, feedback, jm.initial_state(held, place))
    t = np.asarray(shown.t)
    exact = sum(place) * (1.0 + frequency * t) * np.exp(-frequency * t)
    # The hold delays the feedback by dt / 2 on average: a share of frequency * dt / 2 = 0.0075.
    np.testing.assert_allclose(shown[channel], exact, atol=0.0075 * 0.3)


def test_feedback_turns_the_shorter_way_and_goes_where_its_sensor_says(held):
    feedback = control.pole_placement(held.mass_matrix, 1.5)
    turned = jm.initial_state(held, attitude=(0, 0, 0.4))
    opposite = eqx.tree_at(lambda s: s.attitude, turned, -turned.attitude)
    for start in turned, opposite:
        yaw = _hold_station(held, feedback, start)["psi"]
        assert 0.0 < float(yaw[100]) < 0.4
        assert abs(float(yaw[-1])) < 1e-4
    # A position that is measured 0.1 m too far north puts the craft 0.1 m south.
    errors = jnp.zeros((1000, 12)).at[:, 0].set(0.1)
    settled = _hold_station(held, feedback, jm.initial_state(held), errors)
    assert float(settled["x"][-1]) == pytest.approx(-0.1, abs=1e-4)


# --- through the craft's own actuators ----------------------------------------------------------------


def torpedo_on_a_line(craft: jm.Vehicle, depth: float, heading: float) -> control.Run:
    """The torpedo, 3 m above a straight line and off its heading, steered onto it by propeller and fins."""
    speed, end = 1.5, 90.0
    there = np.array([np.cos(heading), np.sin(heading)]) * speed * end
    ends = np.array([[0, 0, depth, 0, 0, heading], [*there, depth, 0, 0, heading]])
    reference = control.Path(CubicSpline([0.0, end], ends)).at(np.arange(0.0, end, 0.2))
    # Way and speed by the propeller, heading by rudders; planes pitch it by 0.05 rad for a metre of depth.
    stiffness, damping = jnp.zeros((6, 6)), jnp.zeros((6, 6))
    for i, k, d in (0, 3.0, 20.0), (4, 12.0, 8.0), (5, 6.0, 8.0):
        stiffness, damping = stiffness.at[i, i].set(k), damping.at[i, i].set(d)
    feedback = control.Feedback(stiffness.at[4, 2].set(-0.6), damping)
    start = jm.initial_state(craft, (0, 0, depth - 3.0), (0, 0, 0), (1.2, 0, 0, 0, 0, 0))
    wrench = control.feedforward(craft, reference)
    return control.follow(craft, reference, wrench, start, feedback, steered=("surge", "pitch", "yaw"))


def test_a_torpedo_holds_depth_and_heading_by_its_fins():
    craft = jm.load_vehicle(jm.packaged_vehicle("remus100"))
    run = torpedo_on_a_line(craft, 8.0, 0.4)
    z, psi, u = (np.asarray(run.trajectory[name]) for name in ("z", "psi", "u"))
    assert (z[0], psi[0]) == (5.0, 0.0)
    # Without an integral a small trim is left: 0.005 rad of pitch are worth 0.1 m.
    np.testing.assert_allclose(z[-50:], 8.0, atol=0.12)
    np.testing.assert_allclose(psi[-50:], 0.4, atol=0.005)
    np.testing.assert_allclose(u[-50:], 1.5, atol=0.01)
    assert run.commands is not None and run.commands.shape == (450, 5)
    assert np.abs(np.asarray(run.commands)[:, 1:]).max() <= 0.2618 + 1e-12
    # Its commands drive a simulation the same way: the actuators did it, and nothing else.
    t, commands = np.asarray(run.trajectory.t), np.asarray(run.commands)
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, craft.command_names, "-")
    state = jax.tree.map(lambda a: a[30], run.trajectory.states)
    again = jm.simulate(craft, log.between(t[30], t[100]), state)
    np.testing.assert_allclose(again["z"][-1], z[30 + len(again.t) - 1], atol=0.05)


def test_a_late_actuator_is_not_steered_by():
    craft = jm.load_vehicle(jm.packaged_vehicle("remus100"))
    late = eqx.tree_at(lambda v: v.actuators[0].delay, craft, craft.actuators[0].delay + 0.5)
    with pytest.raises(ValueError, match="without delay"):
        torpedo_on_a_line(late, 8.0, 0.4)


# --- learning -------------------------------------------------------------------------------------


def test_a_hull_dissipates_as_its_matrices_say(tethra):
    rng = np.random.default_rng(3)
    velocities = jnp.asarray(rng.normal(size=(40, 6)))
    assert control.dissipates(tethra, velocities)
    # Sway alone gives energy below 0.5 m/s, where -50 v² + 100 |v|³ is negative.
    pushing = eqx.tree_at(lambda v: v.damping.linear, tethra, tethra.damping.linear.at[1, 1].set(-50.0))
    sway = jnp.zeros((2, 6)).at[:, 1].set(jnp.array([0.4, 0.6]))
    assert not control.dissipates(pushing, sway[:1])
    assert control.dissipates(pushing, sway[1:])


def _log_of(vehicle: jm.Vehicle) -> jm.Log:
    run, _ = _on_a_spiral(vehicle)
    t, channels = np.asarray(run.trajectory.t), np.array(run.trajectory.channels)
    return jm.Log(t, channels, None, np.array(run.wrench), vehicle.thruster_names, "spiral")


def test_an_update_is_taken_only_where_it_predicts_better(tethra, monkeypatch):
    log = _log_of(tethra)
    noise = np.array([np.nan] * 3 + [1e-3] * 9 + [np.nan] * 6)
    learner = control.Learner(lambda v: v.damping.linear, 1.0, noise, learned=10.0, judged=5.0)

    def scaled(share: float) -> jm.Vehicle:
        return eqx.tree_at(lambda v: v.damping.linear, tethra, share * tethra.damping.linear)

    def offer(vehicle: jm.Vehicle):
        """Puts another result in the place of the fit, and keeps what it was asked to learn from."""
        asked = []

        def fit(before, past, *args, **kwargs):
            asked.append((before, past))
            return SimpleNamespace(vehicle=vehicle)

        monkeypatch.setattr(_learner, "fit", fit)
        return asked

    # Surging as fast as the log does, and faster.
    ahead, faster = np.array([[0.3, 0, 0, 0, 0, 0]]), np.array([[1.2, 0, 0, 0, 0, 0]])
    stale = scaled(0.8)
    begun = learner.update(control.Learned(stale), log.between(10.0, 20.0), ahead)
    assert not begun.accepted and begun.vehicle is stale and "not full" in begun.verdict

    asked = offer(tethra)
    better = learner.update(begun, log.between(20.0, 27.0), ahead)
    assert better.accepted and better.vehicle is tethra
    # It learned from ten seconds, at the last good model, and not from the five that judge.
    (before, past), *_ = asked
    assert before is stale
    assert past.t[0] == pytest.approx(12.0) and past.t[-1] == pytest.approx(21.9)
    assert better.recent is not None and len(better.recent.t) == 150

    # Right at 0.3 m/s, 206 - 200 * 0.3 = 116 + 100 * 0.3, but from 1.03 m/s on it pushes.
    bent = eqx.tree_at(
        lambda v: (v.damping.linear, v.damping.quadratic),
        tethra,
        (tethra.damping.linear.at[0, 0].set(206.0), tethra.damping.quadratic.at[0, 0].set(-200.0)),
    )
    offer(bent)
    assert learner.update(begun, log.between(20.0, 27.0), ahead).accepted
    assert "energy" in learner.update(begun, log.between(20.0, 27.0), faster).verdict

    for poisoned, word in ((scaled(0.9), "worse"), (scaled(-1.0), "energy"), (scaled(np.nan), "diverged")):
        offer(poisoned)
        after = learner.update(better, log.between(27.0, 29.9), ahead)
        assert word in after.verdict and after.vehicle is tethra
