"""The measured boat: the script's quick run, and the effects that it adds to the catalogue."""

import json
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from experiments import measured_usv as usv
from jaxmarine.effects import CATALOGUE, Motion


def _motion(nu, command=(0.0, 0.0), psi: float = 0.0) -> Motion:
    """The boat on heading `psi` in still water."""
    turn = jnp.array([[np.cos(psi), -np.sin(psi), 0.0], [np.sin(psi), np.cos(psi), 0.0], [0.0, 0.0, 1.0]])
    nu = jnp.asarray(nu)
    return Motion(
        position=jnp.zeros(3),
        rotation=turn,
        nu=nu,
        nu_r=nu,
        lagged=jnp.zeros(0),
        t=jnp.zeros(()),
        command=jnp.asarray(command),
    )


def test_propellers_lose_to_the_flow_where_they_are():
    loss = usv.AdvanceLoss(jnp.array(10.0))
    # Each command of 0.5 at 0.8 m/s loses 10 * 0.5 * 0.8 = 4 N, ahead as well as astern.
    for command in (0.5, 0.5), (-0.5, -0.5), (0.5, -0.5):
        np.testing.assert_allclose(
            loss(_motion([0.8, 0, 0, 0, 0, 0], command)), [-8, 0, 0, 0, 0, 0], atol=1e-12
        )
    # In a turn to starboard the port propeller advances, 0.205 m off the middle: 2 * 5 * 0.205² N m.
    turning = loss(_motion([0, 0, 0, 0, 0, 1.0], (0.5, 0.5)))
    np.testing.assert_allclose(turning, [0, 0, 0, 0, 0, -0.42025], atol=1e-12)
    # A port propeller alone pulls the bow to port by what it loses ahead.
    alone = loss(_motion([1.0, 0, 0, 0, 0, 0], (0.5, 0.0)))
    np.testing.assert_allclose(alone, [-5, 0, 0, 0, 0, -5 * 0.205], atol=1e-12)


def test_the_wind_pushes_along_its_heading():
    wind = usv.SteadyWind(jnp.array(3.0), jnp.array(4.0))
    for psi, push in (0.0, 3.0), (np.pi / 2, 4.0), (np.pi, -3.0), (np.arctan2(4, 3), 5.0):
        np.testing.assert_allclose(
            wind(_motion(np.zeros(6), psi=psi)), [push, 0, 0, 0, 0, 0], rtol=0, atol=1e-6
        )


def test_surge_drag_is_linear_between_its_knots_and_constant_beyond_them():
    drag = usv.SurgeDrag(jnp.log(jnp.array([5.0, 2.0, 1.0, 8.0, 6.0, 7.0])))
    # D(0.1) = (5 + 2) / 2, D(0.5) = (1 + 8) / 2, D(0.75) = 8 - 0.75 * 2; beyond 1 m/s it is 7.
    for u, force in (0.1, -0.35), (0.5, -2.25), (0.75, -4.875), (-0.75, 4.875), (1.5, -10.5):
        np.testing.assert_allclose(drag(_motion([u, 0.1, 0, 0, 0, 0.4])), [force, 0, 0, 0, 0, 0], rtol=1e-6)


def test_a_candidate_has_one_surge_drag_only():
    start = usv.start_of(jm.load_vehicle(usv.HERE / "vtec_s3.toml"))
    moving = _motion([0.5, 0, 0, 0, 0, 0])
    for candidate in usv.CANDIDATES:
        vehicle, prior = candidate.begin(start), candidate.prior()
        shape = vehicle.placed[-1].effect
        assert isinstance(shape, usv.SurgeDrag)
        linear, quadratic = (vehicle.damping.linear[0, 0], vehicle.damping.quadratic[0, 0])
        # At 0.5 m/s both are the same 4 N.
        total = float(0.5 * linear + 0.25 * quadratic - shape(moving)[0])
        assert total == pytest.approx(4.0)
        free = [bool(prior[f"{name} damping"][0, 0] > 0) for name in ("linear", "quadratic")]
        assert free == 2 * [not candidate.shaped]
        assert (prior["surge drag"] > 0).all() == candidate.shaped
        assert (linear == 0) == candidate.shaped


@pytest.mark.parametrize("effect", usv.OWN)
def test_what_the_script_adds_does_nothing_at_its_neutral_value(effect):
    craft = jm.load_vehicle(usv.HERE / "vtec_s3.toml")
    moving = _motion([0.8, 0.1, 0, 0, 0, 0.5], (0.5, -0.3), psi=1.0)
    np.testing.assert_array_equal(effect.neutral(craft)(moving), np.zeros(6))


def test_a_quick_run_fits_its_runs_far_better_than_the_published_model(shared, tmp_path, monkeypatch):
    data = shared / "data" / "vtec-s3-usv"
    if not data.is_dir():
        pytest.skip("the measured runs of ../shared/data/vtec-s3-usv are not on this machine")
    monkeypatch.setattr(sys, "argv", ["measured_usv", "--data", str(data), "--out", str(tmp_path), "--quick"])
    usv.main()

    results = json.loads((tmp_path / "results.json").read_text())
    fitted, published = (np.array(results["scored_rms"][name]) for name in ("fitted", "vtec_s3.toml"))
    assert results["scored_on"] == "train"
    # Sway is hardly more than its start and the disturbances; surge and yaw are what thrust moves.
    assert (fitted < [0.05, 0.055, 0.09]).all()
    assert (fitted < np.array([0.3, 0.85, 0.5]) * published).all()

    # The stored file is that boat: it predicts the same, and its inertia is positive.
    boat = jm.load_vehicle(tmp_path / "fitted.toml", (*CATALOGUE, *usv.OWN))
    runs = usv.read(data, "train", boat)[-2:]
    np.testing.assert_allclose(usv.rms(usv.errors(boat, runs)), fitted, rtol=1e-6)
    assert np.linalg.eigvalsh(boat.mass_matrix[np.ix_(usv.AXES, usv.AXES)]).min() > 0
    assert (tmp_path / "test.png").stat().st_size > 10_000


def test_the_page_says_what_was_found():
    found = json.loads((usv.HERE / "results.json").read_text())
    page = (usv.HERE / "README.md").read_text()
    left_out = found["cross_validation_rms"]
    rows = {
        "fitted | `test/`": found["scored_rms"]["fitted"],
        "the same from `vtec_s3.toml` | `test/`": found["scored_rms"]["vtec_s3.toml"],
        "fitted | `train/`, each run left out": left_out[found["candidate"]],
        "the same with linear and quadratic surge drag | `train/`, each run left out": left_out[
            "linear and quadratic surge drag"
        ],
        "terms of the vehicle file only | `train/`, each run left out": left_out[
            "terms of the vehicle file only"
        ],
        "fitted | `train/`, as fitted": found["train_rms"]["fitted"],
        "the team's model from `vtec_s3.toml` | `train/`": found["train_rms"]["vtec_s3.toml"],
    }
    for words, errors in rows.items():
        assert f"| {words} | " + " | ".join(f"{x:.3f}" for x in errors) + " |" in page
    lines = " ".join(page.split())
    for errors in (
        left_out["no advance loss"],
        left_out["no turn lift"],
        found["scored_rms"]["fitted, whole runs"],
    ):
        assert "{:.3f}, {:.3f} and {:.3f}".format(*errors) in lines
    drag = [np.exp(found["parameters"][f"surge_drag.log_{k}"][1]) for k in range(6)]
    assert ", ".join(f"{d:.1f}" for d in drag[:5]) + f" and {drag[5]:.1f} N s/m" in lines
    for answer in found["diagnoses"]:
        if answer["findings"]:
            assert f"| {answer['verdict']} | {usv.named(answer)} |" in page
        else:
            assert answer["verdict"] == "nothing_found"
    # Of the three defective runs the cause that is known comes first.
    first = [a["findings"][0] for a in found["diagnoses"] if a["findings"]]
    assert [(f["effect"], f["target"]) for f in first] == [
        ("velocity_in_earth_axes", None),
        ("thruster_gain", "all"),
        ("thruster_gain", "all"),
    ]
