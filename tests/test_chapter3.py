"""The controllers of chapter 3: their laws against closed forms, a plant that is the file's, a quick run."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from experiments import chapter3
from experiments.thesis import controllers
from experiments.thesis.controllers import AXES, DT, Axes, Seen
from jaxmarine.examples import hidden

from .boats import boat
from .conftest import ROOT

FILE = chapter3.craft()


def seen(**given) -> Seen:
    values = dict.fromkeys(Seen.__dataclass_fields__, jnp.zeros(4))
    return Seen(**(values | {name: jnp.asarray(value, float) for name, value in given.items()}))


def test_pd_alone_places_both_poles_of_the_mass():
    """m e'' = -d e' - k e with k = m w², d = 2 m w: both poles at -w."""
    axes = Axes.of(FILE)
    for mass, k, d in zip(*map(np.asarray, (axes.mass, axes.stiffness, axes.damping)), strict=True):
        # Twice the same root: rounding moves it by the root of the precision.
        np.testing.assert_allclose(np.roots([mass, d, k]), -controllers.FREQUENCY, atol=1e-7)


def test_the_linear_quadratic_loop_is_stable_and_costs_least():
    """Its gain against others near it: the cost over the samples from one start."""
    axes = Axes.of(FILE)
    gain = np.asarray(controllers.LQ.of(axes).gain)

    def cost(gain, mass, linear, most):
        """By 200 steps of Euler in each hold, of the axis as its differential equations say."""
        fine, x, total = 200, np.array([0.0, 1.0, 0.0]), 0.0
        for _ in range(200):
            wrench = gain @ x
            total += ((x / [0.3, 0.1, 0.3]) ** 2).sum() + (wrench / (most / 3)) ** 2
            for _ in range(fine):
                slope = np.array([x[1], x[2], -(linear * x[2] + wrench) / mass])
                x = x + DT / fine * slope
        return total

    numbers = (float(axes.mass[0]), float(axes.linear[0]), controllers.MOST[0])
    best = cost(gain[0], *numbers)
    assert np.isfinite(best)
    for change in np.eye(3):
        for share in 0.9, 1.1:
            assert best < cost(gain[0] * (1 + (share - 1) * change), *numbers)


@pytest.mark.parametrize("bias", [0.0, 3.0])
def test_self_tuning_finds_mass_damping_and_bias(bias):
    """Of an axis with half the file's gain and twice its damping, from exact samples."""
    axes, rng = Axes.of(FILE), np.random.default_rng(0)
    tuned = controllers.SelfTuning(axes)
    memory, nu = tuned.begin(None), np.zeros(4)
    mass, linear, quadratic = (np.asarray(x) for x in (axes.mass, axes.linear, axes.quadratic))
    call = eqx.filter_jit(tuned)
    # The first call only knows where it begins.
    _, memory = call(memory, seen(nu=nu))
    for _ in range(400):
        wrench = rng.uniform(-1.0, 1.0, 4) * controllers.MOST * 0.3
        slope = (0.5 * wrench - 2.0 * linear * nu - quadratic * np.abs(nu) * nu + bias) / mass
        after = nu + DT * slope
        _, memory = call(memory, seen(before=wrench, nu_before=nu, nu=after))
        nu = after
    found = np.asarray(memory[0])
    np.testing.assert_allclose(found[:, 0], 0.5, rtol=0.03)
    np.testing.assert_allclose(found[:, 3], bias / mass, atol=0.05)


def test_an_adaptive_law_ends_at_the_axis_that_it_is_given():
    """Exact plant of the law's own form, much heavier than the file and pushed: the error dies away."""
    axes = Axes.of(FILE)
    adaptive = controllers.ModelReference(axes)
    mass, linear = 1.5 * np.asarray(axes.mass), 2.0 * np.asarray(axes.linear)
    memory, call = adaptive.begin(None), eqx.filter_jit(adaptive)
    where, nu, late, early = np.zeros(4), np.zeros(4), [], []
    for k in range(1500):
        t = k * DT
        want = 0.3 * np.sin(0.3 * t) * np.ones(4)
        speed, push = 0.09 * np.cos(0.3 * t) * np.ones(4), -0.027 * np.sin(0.3 * t) * np.ones(4)
        wrench, memory = call(memory, seen(off=want - where, slip=speed - nu, nu=nu, wanted=speed, push=push))
        drag = linear * nu + np.asarray(axes.quadratic) * np.abs(nu) * nu
        nu = nu + DT * (np.asarray(wrench) - drag + 5.0 * np.array([1, 1, 1, 0.1])) / mass
        where = where + DT * nu
        (early if t < 10.0 else late if t > 250.0 else []).append(np.abs(want - where).max())
    assert max(late) < 0.2 * max(early)


def test_without_trouble_the_plant_is_the_file():
    case, _ = chapter3.drawn(0, chapter3.QUICK)
    still = eqx.tree_at(lambda c: c.current, case, jnp.zeros(2))
    none = jnp.zeros(())
    plain, same = FILE.plant(), chapter3.troubled(FILE, still, none, none).plant()
    laden = chapter3.troubled(FILE, still, none, jnp.ones(())).plant()
    assert eqx.tree_equal(plain.load.rigid, same.load.rigid) and eqx.tree_equal(plain.drive, same.drive)
    mass, volume = np.asarray(case.payload)
    more = float(laden.load.weight - plain.load.weight)
    assert more == pytest.approx(9.81 * mass)
    assert float(laden.load.buoyancy - plain.load.buoyancy) == pytest.approx(
        float(FILE.density) * 9.81 * volume
    )
    weedy = chapter3.troubled(FILE, still, jnp.ones(()), none).plant()
    one = np.asarray(chapter3.pushed(weedy, jnp.ones(8)) / chapter3.pushed(plain, jnp.ones(8)))
    assert sorted(one)[0] == pytest.approx(chapter3.WEED) and (np.sort(one)[1:] == 1.0).all()


def test_commands_of_a_wrench_give_it_back():
    allocate = chapter3.Allocator.of(FILE)
    wrench = jnp.array([20.0, -10.0, 30.0, 3.0])
    np.testing.assert_allclose(allocate.effect @ allocate(wrench), wrench, atol=1e-9)
    assert float(jnp.abs(allocate(100.0 * wrench)).max()) == 1.0
    assert list(AXES) == [0, 1, 2, 5]


def test_the_page_says_what_was_found():
    found = json.loads((chapter3.HERE / "results.json").read_text())
    assert len(found["controllers"]["PID"]["failed"]) == found["seeds"] == 20
    assert chapter3.claims(found["controllers"], chapter3.CLAIMS) == found["claims"]
    assert chapter3.claims(found["named"], chapter3.NAMED_CLAIMS) == found["named_claims"]
    assert chapter3.markdown(found) in (ROOT / "experiments" / "README.md").read_text()


@pytest.mark.slow  # compiles the predictive controller
def test_a_quick_run_holds_its_path(tmp_path):
    app = typer.Typer()
    app.command()(chapter3.main)
    ran = CliRunner().invoke(app, ["--out", str(tmp_path), "--quick"], catch_exceptions=False)
    assert ran.exit_code == 0
    rows = json.loads((tmp_path / "results.json").read_text())["controllers"]
    # 15 s with all that happens: none is lost, and what looks ahead is nearer in each dive.
    ahead, pid = rows[chapter3.FILED], rows["PID"]
    assert not any(ahead["failed"]) and not any(pid["failed"])
    assert (np.array(ahead["rms_m"]) < pid["rms_m"]).all()
    assert max(rows["MPC with the file"]["deepest_m"]) < chapter3.DEEPEST + 0.1


@pytest.mark.slow
def test_a_vehicle_has_the_causes_that_were_named_and_is_diagnosed_once(tmp_path, monkeypatch):
    train, test = hidden(boat(), "thruster_gain", "port", {"factor": 0.7}, (40.0, 30.0))
    vehicle, found = chapter3.diagnosed(boat(), train, test, tmp_path / "kept")
    assert found["verdict"] == "explained" and list(found["names"]) == ["thruster_gain:port"]
    factor = found["names"]["thruster_gain:port"]["factor"]
    assert factor == pytest.approx(0.7, abs=0.02)
    (placed,) = vehicle.placed
    np.testing.assert_allclose(placed.effect.parameters()["factor"], [factor, 1.0, 1.0])

    def again(*_):
        raise AssertionError("diagnosed once more")

    monkeypatch.setattr(chapter3.jm, "diagnose", again)
    kept, words = chapter3.diagnosed(boat(), train, test, tmp_path / "kept")
    assert words == found and kept.placed[0].effect.parameters()["factor"][0] == factor
