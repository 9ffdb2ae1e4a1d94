"""Identification by small networks, and the Levenberg-Marquardt that trains them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from experiments.thesis import baselines
from jaxmarine import control
from jaxmarine.fitting import damping_matrices, damping_targets, fit_samples, identify_by_networks
from jaxmarine.fitting._levenberg_marquardt import BATCH
from jaxmarine.fitting._subnets import mass_of, train_acceleration
from jaxmarine.simulation import initial_state
from jaxmarine.vehicle import inverse_dynamics
from jaxmarine.vehicle_io import load_vehicle, save_vehicle
from tests.crafts import packaged

MASS = np.diag([231.0, 231, 231, 52, 50, 53])
MASS[0, 4] = MASS[4, 0] = -52.0
MASS[1, 3] = MASS[3, 1] = 52.0
LINEAR = np.diag([116.0, 116, 116, 26, 25, 26])
QUADRATIC = np.array([100.0, 100, 100, 30, 30, 30])


def coriolis(nu):
    """C(nu) nu of Kirchhoff's equations, written out."""
    p = nu @ MASS.T
    return np.concatenate(
        [
            np.cross(nu[:, 3:], p[:, :3]),
            np.cross(nu[:, :3], p[:, :3]) + np.cross(nu[:, 3:], p[:, 3:]),
        ],
        axis=1,
    )


@pytest.fixture(scope="module")
def motion():
    """Velocities about a mean, accelerations without relation to them, and the forces that go with both."""
    rng = np.random.default_rng(5)
    nu = rng.normal(size=(1500, 6)) * [0.3, 0.15, 0.2, 0.1, 0.1, 0.3] + [0.15, 0, 0, 0, 0, 0.05]
    nu_dot = rng.normal(size=(1500, 6)) * 0.2
    drag = nu @ LINEAR.T + np.abs(nu) * nu * QUADRATIC
    return nu, nu_dot, nu_dot @ MASS.T + coriolis(nu) + drag, drag


# The last of three batches is not full.
@pytest.mark.parametrize("count", [80, 2 * BATCH + 2])
def test_one_step_on_a_linear_model_is_least_squares(count):
    """With the damping going to zero (A.28) is the normal equation: a few steps reach numpy's lstsq."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(count, 3)), rng.normal(size=count)
    found = fit_samples(
        lambda p, s: (s[0] @ p - s[1])[None], jnp.zeros((1, 3)), (jnp.asarray(x), jnp.asarray(y))
    )
    expected, rest, *_ = np.linalg.lstsq(x, y, rcond=None)
    # It ends where a step promises less than 1e-12 of the cost, so parameters are right to its root.
    assert np.asarray(found.best) == pytest.approx(expected, abs=1e-6)
    assert float(found.costs[0]) == pytest.approx(0.5 * rest[0], rel=1e-10)


@pytest.mark.slow
def test_curved_residuals_reach_the_minimum_of_scipy():
    rng = np.random.default_rng(1)
    x = np.linspace(0.0, 3.0, 60)
    y = 2.0 * np.exp(-1.3 * x) + 0.01 * rng.normal(size=60)
    found = fit_samples(
        lambda p, s: (p["a"] * jnp.exp(-p["b"] * s[0]) - s[1])[None],
        {"a": jnp.array([1.0, 5.0]), "b": jnp.array([0.1, 3.0])},
        (jnp.asarray(x), jnp.asarray(y)),
    )
    expected = scipy.optimize.least_squares(lambda p: p[0] * np.exp(-p[1] * x) - y, [1.0, 0.1], xtol=1e-12)
    assert bool(found.converged.all())
    for start in range(2):
        value = [float(found.values["a"][start]), float(found.values["b"][start])]
        assert value == pytest.approx(expected.x, rel=1e-5)


def test_targets_are_the_damping(motion):
    """Noise-free, (4.12) gives D(nu) nu to rounding: forces are some hundred newtons."""
    nu, nu_dot, force, drag = map(jnp.asarray, motion)
    assert np.abs(damping_targets(jnp.asarray(MASS), nu, nu_dot, force) - drag).max() < 1e-10


def test_matrices_are_extracted_exactly(motion):
    linear, quadratic = damping_matrices(jnp.asarray(motion[0]), jnp.asarray(motion[3]))
    assert np.asarray(linear) == pytest.approx(LINEAR, abs=1e-8)
    assert np.diag(np.asarray(quadratic)) == pytest.approx(QUADRATIC, abs=1e-8)


@pytest.fixture(scope="module")
def trained(motion):
    nu, nu_dot, force, _ = map(jnp.asarray, motion)
    return train_acceleration(nu, nu_dot, force, jax.random.key(0), 5, 30, 1)[0]


def test_intercept_gives_the_better_mass(motion, trained):
    """At a mean surge of 0.15 m/s the drag of the mean motion is taken for mass without it."""
    nu, _, force, _ = map(jnp.asarray, motion)
    error = {
        intercept: baselines.errors(mass_of(trained, nu, force, intercept), MASS)["diagonal"]
        for intercept in (True, False)
    }
    assert error[True] < 0.6 * error[False]
    # Networks of five nodes do not hold the equations of motion better than to some per cent.
    assert error[True] < 10.0


def test_structure_of_the_mass_is_kept(motion, trained):
    nu, _, force, _ = map(jnp.asarray, motion)
    pattern = (MASS != 0).astype(float)
    mass = np.asarray(mass_of(trained, nu, force, symmetric=True, pattern=pattern))
    # The inverse of a matrix with blocks has the same blocks, but for rounding.
    assert np.abs(mass[pattern == 0]).max() < 1e-9 * mass.max()
    assert np.abs(mass - mass.T).max() < 1e-9 * mass.max()


def test_an_axis_that_never_moves_is_refused(motion):
    nu, nu_dot, force, _ = map(jnp.asarray, motion)
    with pytest.raises(ValueError, match="heave, roll"):
        identify_by_networks(nu.at[:, 2:4].set(0.0), nu_dot, force, key=jax.random.key(2))


@pytest.mark.parametrize("form", ["zero_at_rest", pytest.param("dissipative", marks=pytest.mark.slow)])
def test_damping_is_as_its_form_says(motion, form, tmp_path):
    """No force at rest; and, where asked for, power taken at every velocity, far outside the data too."""
    nu, nu_dot, force, drag = map(jnp.asarray, motion)
    found = identify_by_networks(
        nu[:400],
        nu_dot[:400],
        force[:400],
        key=jax.random.key(2),
        mass=jnp.asarray(MASS),
        form=form,
        epochs=15,
    )
    assert found.acceleration is None
    assert np.abs(found.damping(jnp.zeros(6))).max() == 0.0
    shown = jax.vmap(found.damping)(nu)
    # 15 epochs, then samples that the network has not seen.
    assert float(((shown - drag)[400:] ** 2).mean() / (drag**2).mean()) < 0.05

    # In a vehicle: the equations of motion with what was found, written out, and the same from its file.
    craft = packaged("tethra")
    vehicle = found.vehicle(craft)
    save_vehicle(vehicle, tmp_path / "found.toml")
    for one in vehicle, load_vehicle(tmp_path / "found.toml"):
        for k in (450, 451):
            state = dataclasses.replace(initial_state(craft), velocity=nu[k])
            wrench = inverse_dynamics(one, state, nu_dot[k])
            at_rest = inverse_dynamics(craft, initial_state(craft), jnp.zeros(6))
            expected = nu_dot[k] @ MASS.T + coriolis(nu[k : k + 1])[0] + found.damping(nu[k]) + at_rest
            assert np.asarray(wrench) == pytest.approx(np.asarray(expected), abs=1e-9)
    if form == "dissipative":
        assert control.dissipates(vehicle, nu)
        far = 5.0 * np.random.default_rng(3).normal(size=(500, 6))
        assert float((jax.vmap(found.damping)(jnp.asarray(far)) * far).sum(axis=1).min()) >= 0.0


def test_baselines_are_exact_without_noise(motion):
    """All but (6.1), which leaves the Coriolis forces out and cannot be."""
    nu, nu_dot, force, _ = map(jnp.asarray, motion)
    for method in (baselines.ls_with_coriolis, baselines.inverse_ls, baselines.two_stage_ls):
        found = method(nu, nu_dot, force)
        assert found.mass == pytest.approx(MASS, abs=1e-6)
        assert found.linear == pytest.approx(LINEAR, abs=1e-6)
        assert np.diag(found.quadratic) == pytest.approx(QUADRATIC, abs=1e-5)
    assert np.abs(baselines.ls_of_the_thesis(nu, nu_dot, force).mass - MASS).max() > 1.0


def test_errors_are_those_that_the_thesis_prints():
    """Table 6.2 from table 6.1: 10, 9 (9.6, cut off) and 6 % for the mass of the networks."""
    printed = np.array(
        [
            [255, 2, -3, 2, -53, 0],
            [0, 222, 0, 47, 0, -1],
            [15, 1, 236, 1, -14, 0],
            [0, 52, 0, 51, 0, 1],
            [-54, -2, 3, -2, 49, 0],
            [0, 1, 0, 2, 0, 53.0],
        ]
    )
    found = baselines.errors(printed, MASS)
    assert [int(found[kind]) for kind in ("diagonal", "off_diagonal", "zero")] == [10, 9, 6]
