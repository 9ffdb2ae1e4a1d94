"""Classical terms against closed forms, scipy, point masses and brute force."""

import itertools

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmarine.physics import (
    Drive,
    Load,
    attitude_rate,
    compose,
    coriolis,
    damping,
    from_euler,
    norm,
    rigid_body_matrix,
    rotation,
    skew,
    small_turn,
    thrust,
    to_euler,
    to_euler_matrix,
)

SEEDS = st.integers(0, 2**32 - 1)
ANGLE = st.floats(-np.pi, np.pi)
PITCH = st.floats(-np.pi / 2, np.pi / 2)

from_euler_ = jax.jit(from_euler)
rotation_ = jax.jit(rotation)
to_euler_ = jax.jit(to_euler)
coriolis_ = jax.jit(coriolis)
thrust_ = eqx.filter_jit(thrust)


def scipy_turn(phi: float, theta: float, psi: float) -> Rotation:
    return Rotation.from_euler("ZYX", [psi, theta, phi])


# --- frames -----------------------------------------------------------------------------------


@hypothesis.given(ANGLE, PITCH, ANGLE, st.floats(0.1, 10.0))
def test_rotation_is_that_of_scipy_whatever_the_quaternions_length(phi, theta, psi, length):
    turn = np.asarray(rotation_(length * from_euler_(jnp.array([phi, theta, psi]))))
    assert np.abs(turn @ turn.T - np.eye(3)).max() < 1e-14
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-14)
    assert np.abs(turn - scipy_turn(phi, theta, psi).as_matrix()).max() < 1e-14


@hypothesis.given(ANGLE, st.floats(-1.57, 1.57), ANGLE)
def test_euler_angles_survive_the_quaternion(phi, theta, psi):
    back = np.asarray(to_euler_(from_euler_(jnp.array([phi, theta, psi]))))
    error = (back - [phi, theta, psi] + np.pi) % (2 * np.pi) - np.pi
    # 1 / cos(1.57) magnifies the rounding of the matrix in roll and yaw.
    assert np.abs(error).max() < 1e-15 / np.cos(theta) + 4e-15
    assert abs(back[1]) <= np.pi / 2


@hypothesis.given(ANGLE, st.sampled_from([-np.pi / 2, np.pi / 2]), ANGLE)
def test_at_a_pitch_of_90_degrees_the_angles_still_give_the_same_rotation(phi, theta, psi):
    turn = rotation_(from_euler_(jnp.array([phi, theta, psi])))
    again = rotation_(from_euler_(to_euler_(from_euler_(jnp.array([phi, theta, psi])))))
    assert np.abs(np.asarray(turn - again)).max() < 2e-8  # the floor under cos(theta) is 1e-9


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_euler_angles_have_a_finite_derivative_at_90_degrees(side, away):
    attitude = from_euler(jnp.array([0.3, side * (np.pi / 2 - away), -0.7]))
    forward, backward = jax.jacfwd(to_euler)(attitude), jax.jacrev(to_euler)(attitude)
    assert np.isfinite(forward).all() and np.isfinite(backward).all()
    exact = rotation(from_euler(jnp.array([0.0, side * np.pi / 2, 0.4])))
    exact = jnp.where(jnp.abs(exact) < 1e-15, 0.0, exact)
    assert np.isfinite(jax.jacfwd(to_euler_matrix)(exact)).all()


def test_composition_and_skew_are_those_of_matrices():
    rng = np.random.default_rng(0)
    a, b = (from_euler(jnp.asarray(x)) for x in rng.uniform(-1.5, 1.5, (2, 3)))
    assert np.abs(rotation(compose(a, b)) - rotation(a) @ rotation(b)).max() < 1e-15
    x, y = rng.normal(size=(2, 3))
    assert np.abs(skew(jnp.asarray(x)) @ y - np.cross(x, y)).max() < 1e-15
    assert norm(jnp.asarray(x)) == pytest.approx(np.linalg.norm(x), rel=1e-15)


def test_attitude_rate_is_the_rate_of_the_rotation_matrix():
    rng = np.random.default_rng(1)
    attitude, omega = from_euler(jnp.asarray(rng.uniform(-1.5, 1.5, 3))), rng.normal(size=3)
    rate = attitude_rate(attitude, jnp.asarray(omega))
    _, turning = jax.jvp(rotation, (attitude,), (rate,))
    assert np.abs(turning - rotation(attitude) @ skew(jnp.asarray(omega))).max() < 1e-14


def test_a_small_turn_is_a_rotation_vector():
    small = np.array([1e-4, -2e-4, 3e-4])
    exact = Rotation.from_rotvec(small).as_matrix()
    assert np.abs(rotation(small_turn(jnp.asarray(small))) - exact).max() < 1e-11  # third order
    by_angles = jax.jacfwd(lambda a: rotation(small_turn(a)))(jnp.zeros(3))
    assert np.abs(by_angles[:, :, 2] - skew(jnp.array([0.0, 0.0, 1.0]))).max() < 1e-15


def test_the_norm_has_gradient_zero_at_rest():
    assert np.array_equal(jax.grad(norm)(jnp.zeros(3)), np.zeros(3))


# --- rigid body, added mass, restoring --------------------------------------------------------


def point_masses(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 5.0, 7), rng.normal(size=(7, 3))


@hypothesis.given(SEEDS)
@hypothesis.settings(max_examples=20)
def test_rigid_body_matrix_holds_the_momentum_of_point_masses(seed):
    masses, places = point_masses(seed)
    squared = (masses[:, None, None] * places[:, :, None] * places[:, None, :]).sum(0)
    inertia = np.trace(squared) * np.eye(3) - squared
    matrix = rigid_body_matrix(
        jnp.asarray(masses.sum()),
        jnp.asarray(inertia),
        jnp.asarray(masses @ places / masses.sum()),
    )
    v, w = np.random.default_rng(seed + 1).normal(size=(2, 3))
    velocities = v + np.cross(w, places)
    momentum = masses @ velocities
    spin = (masses[:, None] * np.cross(places, velocities)).sum(0)
    got = matrix @ np.concatenate([v, w])
    assert np.allclose(got, np.concatenate([momentum, spin]), rtol=1e-12, atol=1e-12)
    # The energy is that of the points as well.
    energy = 0.5 * (masses * (velocities**2).sum(1)).sum()
    assert 0.5 * np.concatenate([v, w]) @ got == pytest.approx(energy, rel=1e-12)


def symmetric(seed: int) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(6, 6))
    return a + a.T


def fossen_coriolis_matrix(m: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """C(nu) written out by blocks, after Fossen (2021)."""

    def s(a):
        return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])

    first = m[:3, :3] @ nu[:3] + m[:3, 3:] @ nu[3:]
    second = m[3:, :3] @ nu[:3] + m[3:, 3:] @ nu[3:]
    return np.block([[np.zeros((3, 3)), -s(first)], [-s(first), -s(second)]])


@hypothesis.given(SEEDS)
def test_coriolis_is_fossens_matrix_and_does_no_work(seed):
    matrix, nu = symmetric(seed), np.random.default_rng(seed + 1).normal(size=6)
    got = np.asarray(coriolis_(jnp.asarray(matrix), jnp.asarray(nu)))
    size = np.abs(matrix).max() * (nu @ nu)
    assert np.allclose(got, fossen_coriolis_matrix(matrix, nu) @ nu, rtol=0, atol=1e-14 * size)
    assert abs(nu @ got) < 1e-14 * size * np.linalg.norm(nu) * 6


@hypothesis.given(SEEDS)
@hypothesis.settings(max_examples=30)
def test_restoring_wrench_is_weight_and_buoyancy_at_their_points(seed):
    """By hand: -[R'f; r x R'f], also row 6, where the thesis' (4.7) has a wrong sign."""
    rng = np.random.default_rng(seed)
    weight, buoyancy = rng.uniform(50.0, 150.0, 2)
    cog, cob = rng.normal(size=(2, 3))
    phi, theta, psi = rng.uniform(-np.pi, np.pi, 3)
    turn = scipy_turn(phi, theta, psi).as_matrix()
    f_g, f_b = turn.T @ [0.0, 0.0, weight], turn.T @ [0.0, 0.0, -buoyancy]
    by_hand = -np.concatenate([f_g + f_b, np.cross(cog, f_g) + np.cross(cob, f_b)])
    load = Load(
        rigid=jnp.zeros((6, 6)),
        added=jnp.zeros((6, 6)),
        weight=jnp.asarray(weight),
        weight_moment=jnp.asarray(weight * cog),
        buoyancy=jnp.asarray(buoyancy),
        buoyancy_moment=jnp.asarray(buoyancy * cob),
        density=jnp.asarray(1025.0),
        gravity=jnp.asarray(9.81),
    )
    got = np.asarray(load.restoring(jnp.asarray(turn[2])))
    assert np.allclose(got, by_hand, rtol=0, atol=1e-11)
    x, y, _ = weight * cog - buoyancy * cob
    row_6 = -x * np.cos(theta) * np.sin(phi) - y * np.sin(theta)
    assert got[5] == pytest.approx(row_6, abs=1e-11)


def test_damping_is_elementwise_and_takes_power():
    rng = np.random.default_rng(2)
    linear, quadratic, nu = rng.normal(size=(6, 6)), rng.normal(size=(6, 6)), rng.normal(size=6)
    got = damping(jnp.asarray(linear), jnp.asarray(quadratic), jnp.asarray(nu))
    by_hand = [
        sum(linear[i, j] * nu[j] + quadratic[i, j] * abs(nu[j]) * nu[j] for j in range(6)) for i in range(6)
    ]
    assert np.allclose(got, by_hand, rtol=1e-13, atol=1e-13)
    matrix = linear @ linear.T
    for nu in rng.normal(size=(20, 6)):
        nothing = jnp.zeros((6, 6))
        assert nu @ np.asarray(damping(jnp.asarray(matrix), nothing, jnp.asarray(nu))) > 0.0


# --- actuators --------------------------------------------------------------------------------

TIMES = np.arange(40) * 0.1
NAMES = ("delay", "deadband", "saturation", "quadratic", "gain", "lag", "inflow", "max_thrust")
NAMES += ("max_thrust_reverse",)
PLAIN = {"delay": 0, "deadband": 0, "saturation": 1, "quadratic": 0, "gain": 1, "lag": 0}
PLAIN |= {"inflow": 0, "max_thrust": 50, "max_thrust_reverse": 50}


def drive_of(samples: int, **constants) -> Drive:
    """Two thrusters with the same constants at every sample."""
    values = PLAIN | constants
    return Drive(**{name: jnp.broadcast_to(jnp.asarray(values[name], float), (samples, 2)) for name in NAMES})


def staircase(seed: int, samples: int = len(TIMES)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    levels = rng.uniform(-1.0, 1.0, (samples, 2)) * (rng.random((samples, 2)) < 0.7)
    return levels


def brute_force(t, commands, parts=400, **constants):
    """Mean over each hold, value at each sample, and slope over each hold, by small steps in time."""
    k = PLAIN | constants
    ends = np.append(t, 2 * t[-1] - t[-2])
    lag = np.broadcast_to(np.asarray(k["lag"], float), (2,))
    means, at, slopes, state = [], [], [], None
    for first, last in itertools.pairwise(ends):
        h = (last - first) / parts
        total, moment = np.zeros(2), np.zeros(2)
        for part in range(parts):
            now = first + (part + 0.5) * h
            delayed = now - np.broadcast_to(np.asarray(k["delay"], float), (2,))
            index = np.clip(np.searchsorted(t, delayed, side="right") - 1, 0, len(t) - 1)
            c = commands[index, np.arange(2)]
            most = np.where(c < 0, k["max_thrust_reverse"], k["max_thrust"])
            c = np.sign(c) * np.maximum(np.abs(c) - k["deadband"], 0.0)
            c = np.clip(c, -np.asarray(k["saturation"]), k["saturation"])
            c = (1.0 - k["quadratic"]) * c + k["quadratic"] * c * np.abs(c)
            goal = most * np.asarray(k["gain"]) * c
            if state is None:
                state = np.array(goal)
            if part == 0:
                at.append(np.where(lag > 0.0, state, goal))
            # The exact answer over a small step; its mean by the midpoint.
            away = state - goal
            rate = np.where(lag > 0.0, 1.0 / np.where(lag > 0.0, lag, 1.0), np.inf)
            now_thrust = goal + away * np.exp(-0.5 * h * rate)
            total += now_thrust
            moment += now_thrust * (part + 0.5 - 0.5 * parts)
            state = goal + away * np.exp(-h * rate)
        means.append(total / parts)
        # The straight line with the same first moment about the middle.
        slopes.append(12.0 * moment / parts**3 / h)
    return np.array(means), np.array(at), np.array(slopes)


CHAINS = {
    "delay": {"delay": [0.3, 0.1]},
    "deadband": {"deadband": [0.1, 0.3]},
    "saturation": {"saturation": [0.5, 0.8]},
    "curve": {"quadratic": [0.6, -0.3]},
    "gain": {"gain": [0.5, -0.2]},
    "reverse": {"max_thrust_reverse": [35, 60]},
    # A curve that turns small commands round: the propeller still turns as it is told to.
    "reverse with a curve": {"max_thrust_reverse": [35, 60], "quadratic": [1.6, 1.0], "lag": [0.2, 0]},
    "lag": {"lag": [0.15, 0.6]},
    "all": {
        "delay": [0.2, 0.4],
        "deadband": [0.05, 0.1],
        "saturation": [0.5, 0.6],
        "quadratic": [0.4, 0.2],
        "gain": [0.7, 1.2],
        "max_thrust_reverse": [40, 30],
        "lag": [0.3, 0.0],
    },
}


@pytest.mark.parametrize("chain", CHAINS)
def test_thrust_is_that_of_small_steps(chain):
    commands = staircase(3)
    constants = {name: np.array(value) for name, value in CHAINS[chain].items()}
    push = thrust_(drive_of(len(TIMES), **constants), jnp.asarray(TIMES), jnp.asarray(commands))
    mean_by_hand, at_by_hand, slope_by_hand = brute_force(TIMES, commands, **constants)
    # The midpoint rule over 400 parts of a hold errs by (0.1 / 0.15 / 400)^2 / 24 of 50 N.
    assert np.abs(push.mean - mean_by_hand).max() < 1e-5
    assert np.abs(push.instant - at_by_hand).max() < 1e-9
    # Slopes reach 50 N / 0.1 s; the sum over 400 parts errs by 1/400^2 of that.
    assert np.abs(push.slope - slope_by_hand).max() < 5e-3


def test_delay_between_samples_and_uneven_sampling():
    rng = np.random.default_rng(4)
    t = np.cumsum(rng.uniform(0.03, 0.17, 40))
    commands = staircase(5)
    constants = {"delay": np.array([0.237, 0.061]), "gain": np.array([0.8, 1.1])}
    push = thrust_(drive_of(40, **constants), jnp.asarray(t), jnp.asarray(commands))
    by_hand, at, slope = brute_force(t, commands, parts=1000, **constants)
    # A change of command falls into one of 1000 parts: 2 * 55 N / 1000.
    assert np.abs(push.mean - by_hand).max() < 0.12
    assert np.abs(push.mean - by_hand).mean() < 0.03
    assert np.abs(push.instant - at).max() < 1e-9
    # The same part, at most half a hold (0.015 s at least) from its middle: 6 * 0.11 N / 0.03 s.
    assert np.abs(push.slope - slope).max() < 22.0
    assert np.abs(push.slope - slope).mean() < 1.0


def test_delay_and_lag_of_zero_change_nothing_at_all():
    for t in (TIMES, np.cumsum(np.random.default_rng(6).uniform(0.03, 0.17, 40))):
        commands = staircase(7)
        push = thrust_(drive_of(40), jnp.asarray(t), jnp.asarray(commands))
        assert np.array_equal(push.mean, 50.0 * commands)
        assert np.array_equal(push.instant, 50.0 * commands)
        assert not np.any(push.slope)


def test_a_lag_leaves_no_thrust_behind():
    """Over a long rest the impulse is that of the commands: only later."""
    commands = np.zeros((40, 2))
    commands[2:10] = 0.6
    push = thrust_(drive_of(40, lag=np.array([0.1, 0.3])), jnp.asarray(TIMES), jnp.asarray(commands))
    assert np.allclose(push.mean.sum(0), 50.0 * commands.sum(0), rtol=1e-4)  # exp(-3 s / 0.3 s)


@pytest.mark.parametrize("name", [n for n in NAMES if n != "inflow"])
def test_thrust_has_the_derivative_of_finite_differences(name):
    commands = jnp.asarray(staircase(8))
    values = PLAIN | {"delay": 0.23, "deadband": 0.07, "saturation": 0.6, "quadratic": 0.3}
    values |= {"gain": 0.8, "lag": 0.2, "max_thrust_reverse": 35}

    def at(value):
        drive = drive_of(len(TIMES), **(values | {name: value}))
        return thrust(drive, jnp.asarray(TIMES), commands)

    value, step = jnp.asarray(float(values[name])), 1e-6
    slope = jax.jit(jax.jacfwd(at))(value)
    between = jax.tree.map(
        lambda a, b: (a - b) / (2 * step), jax.jit(at)(value + step), jax.jit(at)(value - step)
    )
    # Rounding over 2e-6; the slope is a small difference of first moments, times 12 / dt³.
    for part, atol in ("mean", 1e-5), ("slope", 1e-2), ("instant", 1e-5):
        exact, difference = getattr(slope, part), getattr(between, part)
        assert np.abs(exact).max() > 0.0
        assert np.allclose(exact, difference, rtol=1e-5, atol=atol)


def test_derivatives_at_zero_are_finite_and_one_sided():
    commands = jnp.asarray(staircase(9))

    def at(delay, lag, deadband):
        drive = drive_of(len(TIMES), delay=delay, lag=lag, deadband=deadband)
        return thrust(drive, jnp.asarray(TIMES), commands).mean

    zero = jnp.zeros(())
    slopes = jax.jacfwd(at, argnums=(0, 1, 2))(zero, zero, zero)
    assert all(np.isfinite(slope).all() for slope in slopes)
    later = (at(jnp.asarray(1e-6), zero, zero) - at(zero, zero, zero)) / 1e-6
    assert np.allclose(slopes[0], later, rtol=1e-6, atol=1e-6)
    # Silent thrusters know nothing of a dead zone.
    assert np.array_equal(slopes[2][commands == 0], np.zeros(int((commands == 0).sum())))


@pytest.mark.parametrize("quadratic", [0.0, 0.5, 1.0])
def test_derivatives_at_a_command_of_zero_are_finite(quadratic):
    def at(command, reverse, quadratic):
        drive = drive_of(3, max_thrust_reverse=reverse, quadratic=quadratic)
        return thrust(drive, jnp.asarray(TIMES[:3]), command * jnp.ones((3, 2))).mean

    slopes = jax.jacfwd(at, argnums=(0, 1, 2))(jnp.zeros(()), jnp.asarray(35.0), jnp.asarray(quadratic))
    # Thrust is zero there whatever these are; the command acts as one ahead.
    for slope, expected in zip(slopes, (50.0 * (1.0 - quadratic), 0.0, 0.0), strict=True):
        np.testing.assert_allclose(slope, expected, atol=1e-12)
