"""Learned terms: where they are silent, their derivatives, their files; and the scripts that fit them."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import fouled_propeller, nonlinear_damping
from experiments._study import claim_table
from jaxmarine import InputError
from jaxmarine.effects import Motion
from jaxmarine.networks import Seen, learned_thrust, learned_wrench, mlp_damping
from jaxmarine.physics import thrust
from jaxmarine.simulation import initial_state
from jaxmarine.vehicle import Input, Placed, Vehicle, forward_dynamics
from jaxmarine.vehicle_io import load_vehicle, save_vehicle
from tests.crafts import packaged, random_commands

from .conftest import ROOT

AXES = ("surge", "sway", "yaw")
PLACES = np.array([0, 1, 5])


def data(seed: int = 0) -> np.ndarray:
    """Velocities of a craft that drifts as it turns: sway goes with yaw."""
    rng = np.random.default_rng(seed)
    u, r = 0.3 + 0.1 * rng.normal(size=2000), 0.2 * rng.normal(size=2000)
    return np.stack([u, -0.3 * r + 0.01 * rng.normal(size=2000), r], axis=1)


def trained(term, seed: int = 1):
    """The term with random numbers for its weights."""
    rng = np.random.default_rng(seed)
    leaves = jax.tree.leaves(term.network)
    return eqx.tree_at(
        lambda t: jax.tree.leaves(t.network), term, [jnp.asarray(rng.normal(size=a.shape)) for a in leaves]
    )


def damping_term():
    return mlp_damping(
        AXES, np.array([0.6, 0.2, 0.7]), np.array([2.0, 3.0, 1.0]), jax.random.key(0), seen=data()
    )


def motion(nu) -> Motion:
    nu = jnp.zeros(6).at[PLACES].set(jnp.asarray(nu))
    return Motion(jnp.zeros(3), jnp.eye(3), nu, nu, jnp.zeros(0), jnp.zeros(()), jnp.zeros(3))


# --- the gate ---------------------------------------------------------------------------------


def test_the_gate_is_open_where_the_data_are_and_shut_half_as_far_again():
    seen, samples = Seen.of(data()), data()
    gate = np.asarray(jax.vmap(seen)(jnp.asarray(samples)))
    # By construction of the 99.9 % quantile, up to one of 2000 samples.
    assert abs(np.mean(gate == 1.0) - 0.999) < 0.001
    assert gate.min() > 0.0
    # Distances by numpy's own covariance: on the line to any sample the border lies at the same one.
    off = samples - samples.mean(axis=0)
    distance = np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(np.cov(off.T)), off))
    border = np.quantile(distance, 0.999)
    for k in range(5):
        along = off[k] / distance[k] * border
        for times, value in ((0.99, 1.0), (1.51, 0.0), (10.0, 0.0)):
            # 1e-3: the widening of an axis and n - 1 for n move the border by less than that.
            assert float(seen(jnp.asarray(samples.mean(axis=0) + times * along))) == pytest.approx(
                value, abs=1e-3
            )
    # Sway against yaw was never seen, though each by itself was.
    assert float(seen(jnp.array([0.3, 0.1, 0.35]))) == 0.0
    assert float(seen(jnp.array([0.3, -0.1, 0.35]))) == 1.0


def test_the_gate_has_a_continuous_slope_and_curvature():
    seen = Seen.within(np.array([0.5, 0.2, 0.4]))
    line = jax.vmap(lambda x: seen(x * jnp.array([1.0, 0.3, -0.5])))
    x = jnp.linspace(0.0, 2.0, 4001)
    values = np.asarray(line(x))
    assert values[0] == 1.0 and values[-1] == 0.0 and (np.diff(values) <= 1e-15).all()
    step = float(x[1])
    slope, bend = np.diff(values) / step, np.diff(values, 2) / step**2
    exact = np.asarray(jax.vmap(jax.grad(lambda x: seen(x * jnp.array([1.0, 0.3, -0.5]))))(x[:-1] + step / 2))
    # Central differences err by step² times the third derivative, which is below 1e3 here.
    np.testing.assert_allclose(slope, exact, atol=1e3 * step**2)
    # A jump of the curvature would stay as large as the curvature however fine the step is.
    assert np.abs(np.diff(bend)).max() < 0.05 * np.abs(bend).max()


def test_beyond_the_velocities_seen_a_trained_network_leaves_the_classical_vehicle_to_the_last_bit():
    bare = packaged("cybership2")
    vehicle = bare.place(Placed(trained(damping_term())))
    rest = Input(jnp.zeros(3), jnp.zeros(3), jnp.zeros(6), jnp.zeros(()))

    def balance(v: Vehicle, nu):
        state = dataclasses.replace(
            initial_state(bare), velocity=jnp.zeros(6).at[PLACES].set(jnp.asarray(nu))
        )
        return np.asarray(v.plant().balance(state, jnp.zeros(6), rest))

    for nu in ([-0.8, 0.0, 0.0], [0.3, 0.4, 0.0], [2.0, 0.0, 1.0]):
        np.testing.assert_array_equal(balance(vehicle, nu), balance(bare, nu))
    for nu in ([0.3, 0.0, 0.0], [0.35, -0.05, 0.2]):
        assert np.abs(balance(vehicle, nu) - balance(bare, nu)).max() > 0.1
    # Untrained, it is the physics everywhere.
    start = bare.place(Placed(damping_term()))
    np.testing.assert_array_equal(balance(start, [0.35, -0.05, 0.2]), balance(bare, [0.35, -0.05, 0.2]))


def test_derivatives_of_the_damping_network_agree_with_differences():
    flat, unravel = jax.flatten_util.ravel_pytree(trained(damping_term()))

    @jax.jit
    def force(s, nu, way, turn):
        return unravel(flat + s * way)(motion(nu + s * turn))

    slope = jax.jit(lambda *given: jax.jvp(lambda s: force(s, *given), (0.0,), (1.0,))[1])
    rng, step = np.random.default_rng(3), 1e-5
    # Within, in the fade and beyond; a step of 1e-5 against forces of one: errors of 1e-9.
    for nu in ([0.3, 0.0, 0.1], [0.3, -0.18, 0.62], [0.3, 0.4, 0.0]):
        for _ in range(3):
            given = (
                jnp.asarray(nu),
                jnp.asarray(rng.normal(size=flat.shape)),
                jnp.asarray(rng.normal(size=3)),
            )
            by_difference = (force(step, *given) - force(-step, *given)) / (2 * step)
            np.testing.assert_allclose(slope(*given), by_difference, rtol=1e-5, atol=1e-5)


# --- thrust -----------------------------------------------------------------------------------

TIMES = np.arange(60) * 0.1


def thrust_term(seed: int | None = 2):
    term = learned_thrust(("star", "port", "bow"), np.array([-0.8, -0.9, -0.9]), np.array([0.7, 0.9, 0.9]))
    if seed is None:
        return term
    rng = np.random.default_rng(seed)
    return dataclasses.replace(
        trained(term, seed), weight=jnp.asarray(0.2 * rng.normal(size=(8, 3))), lag=jnp.array([0.5, 0.0, 0.1])
    )


def pushed(vehicle: Vehicle, commands):
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), vehicle.plant().drive)
    return thrust(drive, jnp.asarray(TIMES), commands)


def ship(lag: float = 0.2, deadband: float = 0.1) -> Vehicle:
    ship = packaged("cybership2")
    return eqx.tree_at(
        lambda v: (v.thrusters.lag, v.thrusters.deadband), ship, (jnp.full(3, lag), jnp.full(3, deadband))
    )


def test_an_untrained_thrust_is_that_of_the_file_to_the_last_bit():
    commands = jnp.asarray(random_commands(ship(), len(TIMES), 4, seed=5))
    plain, extended = pushed(ship(), commands), pushed(ship().place(Placed(thrust_term(None))), commands)
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(extended), strict=True):
        np.testing.assert_array_equal(a, b)


def test_learned_thrust_is_the_curve_that_its_docstring_states():
    term = thrust_term()
    vehicle = ship(lag=0.0).place(Placed(dataclasses.replace(term, lag=jnp.zeros(3))))
    commands = np.repeat(np.linspace(-1.0, 1.0, len(TIMES))[:, None], 3, axis=1)
    commands[0] = 0.0
    found = np.asarray(pushed(vehicle, jnp.asarray(commands)).instant)
    c = np.clip(commands, np.asarray(term.low), np.asarray(term.high))
    learned = sum(
        np.asarray(w) * (np.tanh(np.asarray(a) * c + np.asarray(b)) - np.tanh(np.asarray(b)))
        for a, b, w in zip(term.slope, term.bias, term.weight, strict=True)
    )
    # The file's dead zone of 0.1 is that of its own curve; the network sees the command before it.
    file = np.sign(commands) * np.maximum(np.abs(commands) - 0.1, 0.0)
    np.testing.assert_allclose(found, np.asarray(vehicle.thrusters.max_thrust) * (file + learned), rtol=1e-12)
    np.testing.assert_array_equal(found[0], np.zeros(3))


def test_the_learned_lag_adds_to_that_of_the_file():
    lag = dataclasses.replace(thrust_term(None), lag=jnp.array([0.5, 0.0, -0.3]))
    commands = jnp.zeros((len(TIMES), 3)).at[10:].set(0.6)
    found = np.asarray(pushed(ship(deadband=0.0).place(Placed(lag)), commands).instant)
    since, most = TIMES[11:] - TIMES[10], 0.6 * np.asarray(packaged("cybership2").thrusters.max_thrust)
    # A step through a first-order lag of 0.7, 0.2 and none.
    exact = np.stack([1 - np.exp(-since / 0.7), 1 - np.exp(-since / 0.2), np.ones_like(since)], axis=1)
    np.testing.assert_allclose(found[11:], most * exact, rtol=1e-9)


def test_derivatives_of_the_learned_thrust_agree_with_differences():
    commands = jnp.asarray(random_commands(ship(), len(TIMES), 4, seed=6))
    flat, unravel = jax.flatten_util.ravel_pytree(thrust_term())
    way = jnp.asarray(np.random.default_rng(7).normal(size=flat.shape))

    @jax.jit
    def mean(s):
        return pushed(ship().place(Placed(unravel(flat + s * way))), commands).mean

    step = 1e-6
    exact = jax.jvp(mean, (0.0,), (1.0,))[1]
    # Thrusts of 1 N with rounding of 1e-16 over a step of 1e-6, and a curvature of about 10.
    np.testing.assert_allclose(exact, (mean(step) - mean(-step)) / (2 * step), rtol=1e-6, atol=1e-8)
    assert np.abs(exact).max() > 0.1


# --- files ------------------------------------------------------------------------------------


def test_a_vehicle_with_learned_terms_moves_the_same_from_its_file(tmp_path):
    # Whole predictions from a stored vehicle are compared in the quick run below.
    vehicle = ship().place(Placed(trained(damping_term())), Placed(thrust_term()))
    save_vehicle(vehicle, tmp_path / "ship.toml")
    again = load_vehicle(tmp_path / "ship.toml")
    assert eqx.tree_equal(again, vehicle)
    state = dataclasses.replace(initial_state(vehicle), velocity=jnp.array([0.3, 0.02, 0, 0, 0, 0.1]))
    push = pushed(vehicle, jnp.asarray(random_commands(vehicle, len(TIMES), 5, seed=8))).mean[-1]
    drive = Input(push, jnp.zeros(3), jnp.zeros(6), jnp.zeros(()))
    moved = [np.asarray(forward_dynamics(v, state, drive)) for v in (vehicle, again, ship())]
    np.testing.assert_array_equal(*moved[:2])
    assert np.abs(moved[0] - moved[2]).max() > 0.01


@pytest.mark.parametrize("change", [('"bow"', '"stern"'), ('"star", "port", "bow"', '"star"')])
def test_a_learned_thrust_for_other_thrusters_is_refused(tmp_path, change):
    save_vehicle(ship().place(Placed(thrust_term())), tmp_path / "ship.toml")
    text = (tmp_path / "ship.toml").read_text()
    head, entry = text.split("[[effect]]")
    compact = " ".join(entry.split()).replace("[ ", "[").replace(", ]", "]")
    assert change[0] in compact
    lines = compact.replace(*change)
    for key in ("arrays", "inputs"):
        lines = lines.replace(f" {key} =", f"\n{key} =")
    (tmp_path / "ship.toml").write_text(f"{head}[[effect]]\n{lines}\n")
    with pytest.raises(InputError, match="all thrusters"):
        load_vehicle(tmp_path / "ship.toml")


def wrench_term():
    reach = np.ones(4)  # u, sine and cosine of psi, a command
    return learned_wrench(
        "yaw", ("u", "psi", "bow"), ("star", "port", "bow"), -reach, reach, 2.0, jax.random.key(0)
    )


@pytest.mark.parametrize("term", [damping_term(), thrust_term(), wrench_term()], ids=lambda term: term.name)
def test_every_array_of_a_learned_term_must_have_its_shape(term):
    names = tuple(term.arrays())
    restored = type(term).restored(term.arrays(), ship(), "yaw", term.inputs)
    assert eqx.tree_equal(restored, term)
    for name in names:
        cut = term.arrays() | {name: np.zeros((*term.arrays()[name].shape, 2))}
        with pytest.raises((ValueError, KeyError)):
            type(term).restored(cut, ship(), "yaw", term.inputs)
    with pytest.raises((ValueError, KeyError)):
        type(term).restored(dict(list(term.arrays().items())[1:]), ship(), "yaw", term.inputs)
    with pytest.raises(ValueError, match="are not"):
        type(term).restored(term.arrays() | {"more": np.zeros(2)}, ship(), "yaw", term.inputs)


def test_a_thrust_learned_on_one_side_of_zero_is_still_zero_at_zero():
    term = learned_thrust(("star", "port", "bow"), np.array([0.3, 0.0, -0.8]), np.array([0.8, 0.0, -0.2]))
    term = dataclasses.replace(term, weight=jnp.full((8, 3), 0.05))
    vehicle = ship().place(Placed(term))
    still = pushed(vehicle, jnp.zeros((len(TIMES), 3))).mean
    assert np.array_equal(still, np.zeros_like(still))
    assert np.isfinite(pushed(vehicle, jnp.full((len(TIMES), 3), 0.4)).mean).all()


def test_an_axis_that_never_moved_makes_no_nan():
    idle = np.array([0.5, 0.0, 0.3])
    term = trained(mlp_damping(AXES, idle, np.ones(3), jax.random.key(0)))
    for nu in (np.zeros(3), idle, np.array([0.2, 0.1, 0.0])):
        assert np.isfinite(term(motion(nu))).all()
    assert np.isfinite(float(Seen.of(np.tile(idle, (50, 1)))(jnp.asarray(idle))))


# --- the plant of `nonlinear_damping` ---------------------------------------------------------


def test_cross_flow_is_the_integral_over_the_length():
    drag = nonlinear_damping.CrossFlow(jnp.asarray(28.7))
    half = 0.6275
    # Sideways alone k L |v| v; turning alone k |r| r 2 int x³ dx. The kink at x = 0 costs a Gauss rule 1e-3.
    np.testing.assert_allclose(drag(motion([0.5, -0.2, 0.0]))[1], 28.7 * 2 * half * 0.04, rtol=1e-12)
    np.testing.assert_allclose(drag(motion([0.0, 0.0, 0.4]))[5], -28.7 * 0.16 * half**4 / 2, rtol=1e-3)
    x = np.linspace(-half, half, 200_001)
    both = 28.7 * np.abs(0.1 + 0.4 * x) * (0.1 + 0.4 * x)
    exact = [-np.trapezoid(both, x), -np.trapezoid(x * both, x)]
    np.testing.assert_allclose(np.asarray(drag(motion([0.0, 0.1, 0.4])))[[1, 5]], exact, rtol=5e-3)


def test_the_pod_loses_two_thirds_of_its_drag_coefficient_and_always_brakes():
    pod, wave = nonlinear_damping.Pod(jnp.asarray(7.7)), nonlinear_damping.WaveDrag(jnp.asarray(2.0))
    for u, coefficient in ((0.01, 1.2), (0.27, 0.8), (0.9, 0.4)):
        np.testing.assert_allclose(pod(motion([u, 0, 0]))[0], -7.7 * coefficient * u**2, rtol=0.01)
    np.testing.assert_allclose(wave(motion([-0.5, 0, 0]))[0], 2.0 * 0.5**4, rtol=1e-12)
    rng = np.random.default_rng(0)
    for nu in rng.normal(size=(20, 3)) * [0.5, 0.2, 0.4]:
        assert float(pod(motion(nu)) @ motion(nu).nu_r) < 0.0
    assert np.isfinite(jax.jacfwd(lambda nu: pod(motion(nu)))(jnp.zeros(3))).all()


# --- the scripts ------------------------------------------------------------------------------


def test_the_page_says_what_the_studies_found():
    page = (ROOT / "experiments" / "README.md").read_text()
    found = json.loads((fouled_propeller.HERE / "results.json").read_text())
    assert fouled_propeller.table(found["runs"], fouled_propeller.craft().thruster_names) in page
    worst = max(run["star"]["learned_rms_grid"] for run in found["runs"])
    assert len(found["runs"]) == 5 and found["met"] == (worst <= fouled_propeller.TARGET)
    chi2 = [run["reduced_chi2"] for run in found["runs"] if not run["converged"]]
    assert len(chi2) == 4
    assert f"60 steps were over (reduced chi-squares of {min(chi2):.3f} to {max(chi2):.3f})." in page
    found = json.loads((nonlinear_damping.HERE / "results.json").read_text())
    assert len(found["runs"]) == 12 and nonlinear_damping.claims(found["runs"]) == found["claims"]
    assert nonlinear_damping.tables(found["runs"]) in page and claim_table(found["claims"]) in page
    said = " ".join(page.split())

    def off(where: str, *models: str) -> np.ndarray:
        """Metres of the best of these models after 10 s, log by log."""
        runs = found["runs"]
        return np.array([min(run[where][model]["distance_10s"] for model in models) for run in runs])

    classical, network = ("classical, one_step", "classical, trajectory"), "hybrid, trajectory"
    gain = off("inside", *classical) / off("inside", network)
    assert (
        f"{np.median(gain):.1f} times in the median ({gain.min():.2f} to {gain.max():.2f} against the better"
    ) in said
    far = off("beyond", classical[1]) / off("beyond", network)
    assert f"fitted by trajectories is: {far.min():.2f} to {far.max():.2f} times better." in said
    near, far = (off(w, "lumped, trajectory") / off(w, "single, trajectory") for w in ("inside", "beyond"))
    assert (
        f"A lumped network is {np.median(near):.1f} times worse within ({near.min():.2f} to "
        f"{near.max():.2f}); beyond, that is not decided ({far.min():.2f} to {far.max():.2f})."
    ) in said


@pytest.mark.slow
def test_a_quick_run_finds_the_fouled_propeller(tmp_path):
    fouled_propeller.main(tmp_path, seeds=1, quick=True)
    run = json.loads((tmp_path / "results.json").read_text())["runs"][0]
    star = run["star"]
    assert star["learned_rms_grid"] < fouled_propeller.TARGET < 0.2 < star["file_rms_grid"]
    assert abs(star["lag_learned"] - star["lag_true"]) < 4 * star["lag_std"] < 0.25
    # The clean ones stay within what the noise of a short log leaves open.
    assert run["port"]["learned_rms_visited"] < 0.05 and run["bow"]["learned_rms_visited"] < 0.05
    stored = load_vehicle(tmp_path / "learned.toml")
    grid = np.linspace(star["from"], star["to"], 201)
    off = (
        fouled_propeller.steady(stored, grid) - fouled_propeller.true_thrust(fouled_propeller.craft(), grid)
    )[:, 0]
    np.testing.assert_allclose(np.sqrt((off**2).mean()) / 2.0, star["learned_rms_grid"], rtol=1e-9)
    assert (tmp_path / "thrust.svg").exists()


@pytest.mark.slow
def test_a_quick_run_of_the_nonlinear_damping_ends_with_every_model(tmp_path):
    nonlinear_damping.main(tmp_path, seeds=1, quick=True)
    run = json.loads((tmp_path / "results.json").read_text())["runs"][0]
    # A minute of sailing and few steps are enough for the networks to predict better.
    fits = run["fits"]
    for loss in ("one_step", "trajectory"):
        assert np.isfinite(fits[f"hybrid, {loss}"]["reduced_chi2"])
    # On a sailing that nothing was fitted to: 0.035 against 0.107 m, where the full study has a third.
    off = {name: one["distance_10s"] for name, one in run["inside"].items()}
    assert off["hybrid, trajectory"] < 0.6 * off["classical, trajectory"]
    assert set(nonlinear_damping.SHOWN) < set(run["inside"]) == set(run["beyond"])
    wrong = run["mass_error_percent"]["wrong mass, trajectory"]["diagonal"]
    assert wrong == pytest.approx(100 * nonlinear_damping.HEAVY, rel=1e-6)
    assert run["mass_error_percent"]["single, trajectory"]["diagonal"] < 0.5 * wrong
    # The stored vehicle is the one that was scored.
    truth = nonlinear_damping.true_plant()
    stored = load_vehicle(tmp_path / "hybrid.toml")
    sailed = nonlinear_damping.course(truth, nonlinear_damping.sailed(60.0, 300))
    again = nonlinear_damping.scored(stored, sailed, np.ones(6, bool))
    assert again == pytest.approx(run["inside"]["hybrid, trajectory"], rel=1e-9)
    for name in ("forces", "errors", "adam"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000 and (tmp_path / f"{name}.svg").exists()
