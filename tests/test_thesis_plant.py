"""The thesis' plant, its operator and its noise, and the allocation of thrust."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from experiments.thesis import plant
from jaxmarine._types import CHANNELS

VEHICLE = plant.tethra()


@pytest.fixture(scope="module")
def log() -> jm.Log:
    return plant.dive(VEHICLE, 40.0, 3)


def test_allocation_gives_the_wrench_that_was_asked_for():
    # One newton of surge needs half from each horizontal thruster, a moment of yaw a pair 0.7 m apart.
    commands = np.array(jm.allocate(VEHICLE, jnp.array([10.0, 0, 6.0, 2.8, 0, 7.0]), plant.STICKS))
    expected = np.array([5.0 - 10.0, 5.0 + 10.0, 3.0 + 5.0, 3.0 - 5.0]) / 120.0
    assert commands == pytest.approx(expected, abs=1e-12)


def test_allocation_keeps_within_the_limits():
    commands = np.array(jm.allocate(VEHICLE, jnp.array([[1e4, 0, 0, 0, 0, 0], [0, 0, -1e4, 0, 0, 0]])))
    assert np.abs(commands).max() == 1.0


def test_plant_is_the_printed_one():
    """(5.18) and (5.24) digit by digit; the restoring moment of the listing's W, B, r_g and r_b."""
    mass = np.diag([231.0, 231, 231, 52, 50, 53])
    linear = np.diag([116.0, 116, 116, 26, 25, 26])
    mass[0, 4], mass[4, 0], mass[1, 3], mass[3, 1] = -52, -52, 52, 52
    linear[0, 4], linear[4, 0], linear[1, 3], linear[3, 1] = -15, -15, 15, 15
    true = plant.truth(VEHICLE)
    assert np.array_equal(true["M"], mass)
    assert np.array_equal(true["D_l"], linear)
    assert np.array_equal(true["D_q"], np.diag([100.0, 100, 100, 30, 30, 30]))
    level = jm.Log(
        np.array([0.0, 0.1]), np.zeros((2, 18)), np.zeros((2, 4)), None, VEHICLE.thruster_names, ""
    )
    tilted = dataclasses.replace(level, channels=np.tile(np.eye(18)[3] * 0.01, (2, 1)))
    # 399 N m per radian of roll (errata of the listing), and 124.8 N upwards.
    stiffness = -(plant.forces(VEHICLE, tilted) - plant.forces(VEHICLE, level))[0, 3] / 0.01
    assert stiffness == pytest.approx(399.0, abs=0.5)
    assert plant.forces(VEHICLE, level)[0, 2] == pytest.approx(-124.8, abs=1e-9)


def test_thrusters_lie_where_mass_and_centres_are_counted_from():
    """Table 5.2 about the plane of the horizontal thrusters: full surge does not pitch about `o`."""
    built = jm.load_vehicle(jm.packaged_vehicle("tethra_geometry"))
    file = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    np.testing.assert_allclose(file.thrusters.position, built.thrusters.position, atol=1e-12)
    for craft in file, VEHICLE:
        wrench = craft.plant().allocation @ (np.array([1.0, 1.0, 0.0, 0.0]) * craft.thrusters.max_thrust)
        np.testing.assert_allclose(wrench, [240.0, 0, 0, 0, 0, 0], atol=1e-9)


def test_forces_close_the_equations_of_motion(log):
    """M nu' + C nu + D nu = tau - g along a dive, with C written out from the momentum by hand."""
    nu, nu_dot = log.channels[:, 6:12], log.channels[:, 12:]
    true = {name: np.array(matrix) for name, matrix in plant.truth(VEHICLE).items()}
    momentum = nu @ true["M"].T
    a, b = momentum[:, :3], momentum[:, 3:]
    gyro = np.concatenate([np.cross(nu[:, 3:], a), np.cross(nu[:, :3], a) + np.cross(nu[:, 3:], b)], axis=1)
    drag = nu @ true["D_l"].T + (np.abs(nu) * nu) @ true["D_q"].T
    left = nu_dot @ true["M"].T + gyro + drag
    # The centre of gravity's x of 5 mm is in g, not in the printed M; rounding alone is left.
    assert np.abs(left - plant.forces(VEHICLE, log)).max() < 1e-4


def test_operator_moves_all_axes_and_stays_near():
    levels = plant.sticks(np.arange(10000) * plant.DT, seed=0)
    assert np.abs(levels).max() <= 1.0
    # Opposite holds cancel: what is left of the mean is the last, unfinished pair.
    assert np.abs(levels.mean(axis=0)).max() < 6.0 / 1000.0
    assert np.array_equal(levels, plant.sticks(np.arange(10000) * plant.DT, seed=0))
    assert not np.array_equal(levels, plant.sticks(np.arange(10000) * plant.DT, seed=1))


def test_an_idle_stick_gives_no_moment(log):
    without = plant.dive(VEHICLE, 40.0, 3, idle=("roll",))
    full = np.asarray(VEHICLE.plant().allocation * VEHICLE.thrusters.max_thrust[None])
    rolling, still = (np.asarray(one.commands) @ full.T for one in (log, without))
    assert np.abs(rolling[:, 3]).max() > 5.0  # [N m]
    np.testing.assert_allclose(still[:, 3], 0.0, atol=1e-9)
    assert without.channels[:, 9].std() < 0.5 * log.channels[:, 9].std()  # [rad/s]


def test_pool_pushes_back_and_takes_energy():
    motion_in = dict(nu=jnp.array([0.5, 0, 0, 0, 0, 0.0]), position=jnp.array([12.05, 0.0, 0.0]))
    effect = plant.pool().effect

    def wrench(nu, position):
        from jaxmarine.effects import Motion

        none = jnp.zeros(())
        motion = Motion(
            jnp.asarray(position),
            jnp.eye(3),
            jnp.asarray(nu),
            jnp.asarray(nu),
            jnp.zeros(0),
            none,
            jnp.zeros(4),
        )
        return np.array(effect(motion))

    inwards = wrench(**motion_in)
    # Four corners 5 cm deep at 0.5 m/s: 4 (4000 0.05 + 400 0.5) N, back into the pool.
    assert inwards[0] == pytest.approx(-4 * (4000 * 0.05 + 400 * 0.5))
    assert np.abs(wrench(np.zeros(6), np.zeros(3))).max() == 0.0
    # On the way out the damper takes from the spring, but a wall never pulls.
    assert wrench([-0.3, 0, 0, 0, 0, 0.0], [12.05, 0, 0.0])[0] == pytest.approx(-4 * (200 - 120))
    assert wrench([-2.0, 0, 0, 0, 0, 0.0], [12.05, 0, 0.0])[0] == 0.0


def test_noise_has_the_size_of_the_text(log):
    shown = plant.noisy(log, "text", seed=0).channels
    error = shown - log.channels
    assert np.nanmax(np.abs(error[:, 12:15])) <= 0.5
    # A uniform error of half-width a has the standard deviation a / sqrt(3); 1200 samples tell it to 3 %.
    assert error[:, 12:15].std() == pytest.approx(0.5 / 3**0.5, rel=0.05)
    assert error[:, 15:].std() == pytest.approx(0.05 / 3**0.5, rel=0.05)
    assert (np.abs(error[:, 6:12]) <= 1.0001e-3 * np.abs(log.channels[:, 6:12])).all()
    assert np.array_equal(shown[:, 3:6], log.channels[:, 3:6])
    assert np.isnan(shown[:, :3]).all()


def test_noise_of_the_listing_is_in_proportion(log):
    shown = plant.noisy(log, "listing", seed=0).channels[1:]
    ratio = shown[:, 6:] / log.channels[1:, 6:]
    assert np.abs(ratio[:, :6] - 1).max() <= 0.1
    assert 0.45 < np.abs(ratio[:, 6:9] - 1).max() <= 0.5
    assert np.abs(ratio[:, 9:] - 1).max() <= 0.05
    force = plant.forces(VEHICLE, log)
    spoilt = plant.noisy_forces(force, "listing", 0)
    assert 0.45 < np.abs(spoilt[1:, 0] / force[1:, 0] - 1).max() <= 0.5
    assert plant.noisy_forces(force, "text", 0) is force


def test_realistic_noise_is_that_of_the_sensors(log):
    shown = plant.noisy(log, "realistic", seed=0).channels
    error = shown - log.channels
    expected = [0.02] * 3 + [0.005] * 3 + [0.01] * 6
    # 400 samples tell a standard deviation to 3.5 %; four times that.
    assert error[:, :12].std(axis=0) == pytest.approx(expected, rel=0.15)
    assert np.isnan(shown[:, 12:]).all()
    assert len(CHANNELS) == shown.shape[1]
