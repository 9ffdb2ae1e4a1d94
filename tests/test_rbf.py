"""Radial-basis damping: its greedy growth against dense least squares, its fallback, its files."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from threadpoolctl import threadpool_limits

import jaxmarine as jm
from jaxmarine._errors import InputError
from jaxmarine._types import DOFS
from jaxmarine.effects import Motion
from jaxmarine.networks import RBFDamping, basis_of, grow, rbf_damping
from jaxmarine.networks import _rbf as rbf
from tests.crafts import packaged


def motion(nu) -> Motion:
    nu = jnp.asarray(nu, float)
    return Motion(jnp.zeros(3), jnp.eye(3), nu, nu, jnp.zeros(0), jnp.zeros(()), jnp.zeros(0))


def some_term(seed: int = 0) -> RBFDamping:
    rng = np.random.default_rng(seed)
    return RBFDamping(
        centres=jnp.asarray(rng.normal(size=(2, 5, 2))),
        weights=jnp.asarray(rng.normal(size=(2, 5))),
        width=jnp.array([0.7, 1.2]),
        seen=jnp.asarray(rng.normal(size=(9, 2))),
        reach=jnp.array([0.5, 0.8]),
        input_scale=jnp.array([0.4, 0.2]),
        output_scale=jnp.array([10.0, 3.0]),
        inputs=("surge", "yaw"),
    )


# --- growth -----------------------------------------------------------------------------------


def test_the_factor_that_grows_gives_dense_least_squares_at_every_step():
    rng = np.random.default_rng(0)
    design, target, decay = rng.normal(size=(60, 25)), rng.normal(size=60), 0.3
    grown = grow(design.T @ design + decay * np.eye(25), design.T @ target, 25)
    padded = np.concatenate([target, np.zeros(25)])
    augmented = np.concatenate([design, np.sqrt(decay) * np.eye(25)])

    def dense(columns):
        weights = np.linalg.lstsq(augmented[:, columns], padded, rcond=None)[0]
        return weights, ((augmented[:, columns] @ weights - padded) ** 2).sum()

    path = grown.predicted(design[:, grown.order])
    cost = target @ target
    assert sorted(grown.order) == list(range(25))
    for k in range(1, 26):
        taken = list(grown.order[:k])
        weights, left = dense(taken)
        assert np.allclose(grown.weights(k), weights, rtol=0, atol=1e-12)
        assert np.allclose(path[:, k - 1], design[:, taken] @ weights, rtol=0, atol=1e-12)
        cost -= grown.solution[k - 1] ** 2
        assert cost == pytest.approx(left, abs=1e-11)
        # No other column would have lowered the cost more.
        others = set(range(25)) - set(taken[:-1])
        assert left <= min(dense([*taken[:-1], j])[1] for j in others) + 1e-11


def test_columns_that_are_alike_are_no_trouble():
    """Kernels of neighbouring samples are equal to rounding; the fit stays that of least squares."""
    x = np.sort(np.random.default_rng(1).uniform(-1, 1, (200, 1)), axis=0)
    basis, target = basis_of(x, x, 1.0), np.sin(3 * x[:, 0])
    grown = grow(basis.T @ basis + 1e-6 * np.eye(200), basis.T @ target, 200)
    weights = grown.weights(200)
    penalised = ((basis[:, grown.order] @ weights - target) ** 2).sum() + 1e-6 * (weights**2).sum()
    best = np.linalg.solve(basis.T @ basis + 1e-6 * np.eye(200), basis.T @ target)
    least = ((basis @ best - target) ** 2).sum() + 1e-6 * (best**2).sum()
    assert np.isfinite(weights).all()
    assert penalised == pytest.approx(least, rel=1e-3)


def test_a_column_costs_one_product_with_a_vector():
    """500 columns of 1000 cost about as much as their Cholesky factor row by row, which 500 solves do not."""
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(1000, 6)), rng.normal(size=1000)
    basis = basis_of(x, x, 2.0)
    gram, right = basis.T @ basis + 1e-3 * np.eye(1000), basis.T @ y

    def row_by_row():
        rows = np.zeros((500, 1000))
        for k in range(500):
            row = gram[k] - rows[:k, k] @ rows[:k]
            rows[k] = row / np.sqrt(row[k])

    def cpu(run) -> float:
        began = time.process_time()
        run()
        return time.process_time() - began

    counted = []
    # In turn, so that both are at their best at least once on a busy machine; waiting threads count as work.
    with threadpool_limits(limits=1, user_api="blas"):
        times = [
            (cpu(lambda: counted.append(len(grow(gram, right, 500).order))), cpu(row_by_row))
            for _ in range(5)
        ]
    assert counted == 5 * [500]
    spent, least = np.min(times, axis=0)
    # Measured: 1.6 times, for what each column would save is kept too. A solve for each would be 450 times.
    assert spent < 8.0 * least


# --- the effect -------------------------------------------------------------------------------


def test_the_force_is_the_sum_that_its_text_says():
    term = some_term()
    for nu in np.random.default_rng(3).normal(size=(5, 6)) * 0.4:
        x = nu[[0, 5]] / np.array([0.4, 0.2])
        expected = np.zeros(6)
        for a, place in enumerate((0, 5)):
            h, r = float(term.width[a]), float(term.reach[a])

            def phi(d, h=h):
                return np.exp(-(d**2) / (2 * h**2))

            total = 0.0
            for c, w in zip(np.asarray(term.centres[a]), np.asarray(term.weights[a]), strict=True):
                psi = phi(np.linalg.norm(x - c)) - phi(np.linalg.norm(c)) * phi(np.linalg.norm(x))
                total += w * psi
            unseen = 1.0
            for point in np.asarray(term.seen):
                unseen *= 1 - np.exp(-((x - point) ** 2).sum() / (2 * r**2))
            expected[place] = float(term.output_scale[a]) * (1 - unseen) * total
        assert np.allclose(term(motion(nu)), expected, rtol=0, atol=1e-12)
    # Growth and effect have the same basis.
    column = basis_of(x[None], np.asarray(term.centres[1]), 1.2)[0] @ np.asarray(term.weights[1])
    assert 3.0 * (1 - unseen) * column == pytest.approx(float(term(motion(nu))[5]), abs=1e-12)


def test_there_is_no_force_at_rest_and_none_far_away_and_the_way_between_is_smooth():
    term = some_term()
    assert np.array_equal(term(motion(np.zeros(6))), np.zeros(6))

    def along(s):
        return term(motion(s * jnp.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.1])))

    s = np.linspace(0.0, 12.0, 1201)
    force = np.asarray(jax.jit(jax.vmap(along))(jnp.asarray(s)))
    assert np.abs(force).max() > 1.0
    assert np.abs(force[s > 10.0]).max() < 1e-12
    # Twice differentiable: the second differences of a step of 0.01 stay those of the second derivative.
    bend = np.asarray(jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(along))))(jnp.asarray(s)))
    assert np.allclose(np.diff(force, n=2, axis=0) / 1e-4, bend[1:-1], rtol=0, atol=1e-2 * np.abs(bend).max())
    # At a velocity that was seen, where one factor of the product is zero, too.
    seen = jnp.zeros(6).at[jnp.array([0, 5])].set(term.seen[0] * term.input_scale)
    assert np.isfinite(jax.jit(jax.jacrev(lambda nu: term(motion(nu))))(seen)).all()


def learned() -> tuple[RBFDamping, np.ndarray, np.ndarray]:
    """A term grown on a cubic drag and a product, of velocities about 1 m/s ahead; these, and the forces."""
    rng = np.random.default_rng(4)
    nu = np.zeros((180, 6))
    nu[:, [0, 1]] = rng.normal(size=(180, 2)) * 0.2 + [1.0, 0.0]
    force = np.stack([-3 * nu[:, 0] ** 3, -4 * nu[:, 0] * nu[:, 1]], axis=1)
    force += 0.05 * rng.standard_normal(force.shape)
    return rbf_damping(("surge", "sway"), nu[:, :2], force, np.arange(180) // 30, 60), nu, force


def test_it_learns_a_force_where_data_are_and_leaves_the_vehicle_alone_elsewhere():
    term, nu, force = learned()
    # At velocities that it was not grown on, among those that were.
    new = np.zeros((300, 6))
    new[:, :2] = np.random.default_rng(40).uniform([0.7, -0.3], [1.3, 0.3], (300, 2))
    inside = np.asarray(jax.vmap(lambda v: term(motion(v)))(jnp.asarray(new)))
    true = np.stack([-3 * new[:, 0] ** 3, -4 * new[:, 0] * new[:, 1]], axis=1)
    spline = scipy.interpolate.RBFInterpolator(nu[:, :2], force, smoothing=0.1)(new[:, :2])

    def off(found):
        return np.sqrt(((found - true) ** 2).mean(axis=0))

    # A thin-plate spline whose smoothing was chosen by the truth (0.02 N): it fades nowhere, ours does
    # between velocities seen. Measured 1.9 and 0.6 times its error; without any network 160 and 64 times.
    assert (off(inside[:, :2]) < 3.0 * off(spline)).all()
    assert np.abs(inside[:, 2:]).max() == 0.0
    away = term(motion([-3.0, 2.0, 0, 0, 0, 0]))
    assert np.abs(away).max() < 1e-10


def test_the_error_on_left_out_stretches_is_that_of_fits_without_them():
    rng = np.random.default_rng(5)
    x, y, stretch = rng.normal(size=(40, 2)), rng.normal(size=(40, 1)), np.arange(40) // 10
    errors = rbf._left_out(x, y, stretch, 1.0, 0.1, 6)[0.5]
    assert errors[0, 0] == pytest.approx((y**2).mean())
    total = 0.0
    for part in range(4):
        rest, test = stretch != part, stretch == part
        basis = basis_of(x[rest], x[rest], 1.0)
        grown = grow(basis.T @ basis + 0.1 * np.eye(30), basis.T @ y[rest, 0], 6)
        centres = x[rest][grown.order]
        free = basis[:, grown.order]
        weights = np.linalg.solve(free.T @ free + 0.1 * np.eye(6), free.T @ y[rest, 0])
        for point, value in zip(x[test], y[test, 0], strict=True):
            unseen = np.prod(1 - np.exp(-((point - x[rest]) ** 2).sum(axis=1) / (2 * 0.5**2)))
            total += ((1 - unseen) * (basis_of(point[None], centres, 1.0)[0] @ weights) - value) ** 2
    assert errors[0, 6] == pytest.approx(total / 40, rel=1e-9)


# --- files ------------------------------------------------------------------------------------


def test_a_vehicle_with_networks_survives_its_file(tmp_path):
    vehicle = packaged("minesniper").place(jm.Placed(some_term()))
    jm.save_vehicle(vehicle, tmp_path / "a.toml")
    again = jm.load_vehicle(tmp_path / "a.toml")
    effect = again.placed[0].effect
    assert isinstance(effect, RBFDamping) and effect.inputs == ("surge", "yaw")
    nu = motion([0.3, 0.1, 0.0, 0.0, 0.0, 0.1])
    assert np.array_equal(effect(nu), some_term()(nu))
    # What is placed acts in the equations of motion.
    state = jm.initial_state(vehicle, velocity=nu.nu)
    plain, with_it = packaged("minesniper").plant(), again.plant()
    drive = jm.vehicle.Input(jnp.zeros(3), jnp.zeros(3), jnp.zeros(6), jnp.zeros(()))
    lacking = plain.balance(state, jnp.zeros(6), drive) - with_it.balance(state, jnp.zeros(6), drive)
    assert np.allclose(lacking, some_term()(nu), rtol=0, atol=1e-12)


def test_arrays_that_do_not_fit_together_are_refused(unchecked, tmp_path):
    term = dataclasses.replace(some_term(), width=jnp.ones(3))
    jm.save_vehicle(packaged("minesniper").place(jm.Placed(term)), tmp_path / "a.toml")
    with pytest.raises(InputError, match="no file of arrays"):
        jm.load_vehicle(tmp_path / "a.toml")
    assert DOFS[0] in (tmp_path / "a.toml").read_text()
