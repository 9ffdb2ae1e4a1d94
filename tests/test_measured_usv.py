"""The measured boat: the script's quick run, and what its page says."""

import json
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from experiments import measured_usv as usv
from jaxmarine.fitting import answers

from .conftest import ROOT


def test_a_candidate_has_one_surge_drag_only():
    start = usv.start_of(jm.load_vehicle(usv.HERE / "vtec_s3.toml"))
    for candidate in usv.CANDIDATES:
        vehicle, prior = candidate.begin(start), candidate.prior()
        linear, quadratic = (vehicle.damping.linear[0, 0], vehicle.damping.quadratic[0, 0])
        # At 0.5 m/s both are the same 4 N.
        shaped = vehicle.plant().pushed(jnp.zeros(2), 0.5 * jnp.eye(6)[0])[0]
        assert float(0.5 * linear + 0.25 * quadratic - shaped) == pytest.approx(4.0)
        free = [bool(prior[f"{name} damping"][0, 0] > 0) for name in ("linear", "quadratic")]
        assert free == 2 * [not candidate.shaped]
        assert (prior["surge drag"] > 0).all() == candidate.shaped
        assert (linear == 0) == candidate.shaped


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
    boat = jm.load_vehicle(tmp_path / "fitted.toml")
    runs = usv.read(data, "train", boat)[-2:]
    np.testing.assert_allclose(usv.rms(usv.errors(boat, runs)), fitted, rtol=1e-6)
    assert np.linalg.eigvalsh(boat.mass_matrix[np.ix_(usv.AXES, usv.AXES)]).min() > 0
    assert (tmp_path / "test.png").stat().st_size > 10_000


def test_runs_under_guidance_are_seen_to_be_under_feedback(shared):
    """All were steered by a controller, as their folder says; that of path following hides it better."""
    data = shared / "data" / "vtec-s3-usv"
    if not data.is_dir():
        pytest.skip("the measured runs of ../shared/data/vtec-s3-usv are not on this machine")
    boat = jm.load_vehicle(usv.HERE / "vtec_s3.toml")
    runs = [run for folder in ("train", "test", "defects") for run in usv.read(data, folder, boat)]
    told = [run.name for run in runs if answers(run)]
    assert len(runs) == 17 and len(told) >= 14
    assert {run.name for run in runs if "guidance" in run.name} <= set(told)


def test_directions_of_length_one_push_as_longer_ones_did():
    def of(v):
        return v.thrusters.direction, v.thrusters.advance_loss

    boat = usv.start_of(jm.load_vehicle(usv.HERE / "vtec_s3.toml"))
    long = jnp.array([[1.0, -0.3, 0.0], [1.0, 0.2, 0.0]])
    boat = eqx.tree_at(of, boat, (long, jnp.array([9.0, 12.0])))
    unit, nu = usv._unit(boat), jnp.array([0.8, 0.1, 0, 0, 0, 0.5])
    np.testing.assert_allclose(jnp.linalg.norm(of(unit)[0], axis=1), 1.0)
    share = jnp.array([0.5, -0.3])
    pushed, same = (v.plant().pushed(share * v.thrusters.max_thrust, nu) for v in (boat, unit))
    np.testing.assert_allclose(same, pushed, rtol=1e-12)


def test_the_squared_error_lies_where_a_run_was_spoilt():
    """A boat at rest that is measured to move for 2 s of 20 s: all of its error is within one horizon."""
    boat = usv.start_of(jm.load_vehicle(usv.HERE / "vtec_s3.toml"))
    t = 0.05 * np.arange(400)
    channels = np.full((400, 18), np.nan)
    channels[:, [*usv.PLACES, usv.PSI]] = 0.0
    channels[240:280, usv.PLACES[0]] = 1.0
    quiet, spoilt = (
        jm.Log(t, own, np.zeros((400, 2)), None, boat.command_names, name)
        for name, own in (("quiet", np.where(channels == 1.0, 0.0, channels)), ("spoilt", channels))
    )
    found = usv.densest(boat, [quiet, spoilt])
    assert found["run"] == "spoilt" and found["share"] == pytest.approx(1.0)
    assert found["begin"] <= 12.0 and found["begin"] + usv.HORIZON >= 14.0


FOUND = json.loads((usv.HERE / "results.json").read_text())
PAGE = (usv.HERE / "README.md").read_text()


def test_the_pages_show_the_tables_of_the_results():
    for table in usv.error_table(FOUND), usv.candidate_table(FOUND), usv.diagnosis_table(FOUND):
        assert f"\n\n{table}\n" in PAGE
    # The page has no table beside them but that of the runs and their bags.
    assert sum(line.startswith("| ---") for line in PAGE.splitlines()) == 4
    scored = FOUND["scored_rms"]
    heads = ("model", "u [m/s]", "v [m/s]", "r [rad/s]")
    rows = [
        [words, *(f"{x:.3f}" for x in scored[name])]
        for words, name in (
            ("fitted by trajectories", "fitted"),
            ("the team's model", "vtec_s3.toml"),
        )
    ]
    trust = (ROOT / "docs" / "trust.md").read_text()
    assert f"\n\n{usv.table(heads, rows)}\n" in trust


def test_the_page_says_what_was_found():
    lines = " ".join(PAGE.split())
    left_out = FOUND["cross_validation_rms"]
    assert FOUND["candidate"] == min(left_out, key=lambda name: usv.merit(left_out[name])) == "all terms"
    for name in "no advance loss", "no turn lift":
        assert (np.array(left_out[name]) > left_out["all terms"])[[0, 2]].all()
    assert f"fits {len(FOUND['parameters'])} numbers to the eleven runs" in lines
    drags = [FOUND["parameters"][f"surge_drag.drag[{k}]"] for k in range(6)]
    drag = [value for _, value, _ in drags]
    assert ", ".join(f"{d:.1f}" for d in drag[:5]) + f" and {drag[5]:.1f} N s/m" in lines
    assert {round(np.exp(std / value)) for _, value, std in drags[:3]} == {2, 3}
    densest = FOUND["densest"]
    assert densest["run"] == "20210611_133412_guidance_exp4.csv"
    words = "{:.0f} % lies in 5 s of one run, 13:34 on 11 June from {:.1f} s on"
    assert words.format(100 * densest["share"], densest["begin"]) in lines
    answers = {answer["run"]: answer for answer in FOUND["diagnoses"]}
    # Of the three defective runs the cause that is known comes first, of the others nothing is named.
    first = [(f["effect"], f["target"]) for run in usv.KNOWN for f in answers[run]["findings"][:1]]
    assert first == [("velocity_in_earth_axes", None), ("thruster_gain", "all"), ("thruster_gain", "all")]
    assert {a["verdict"] for run, a in answers.items() if run not in usv.KNOWN} == {"nothing_found"}
    last = [f["effect"] for f in answers["20210608_145654_guidance_exp0.csv"]["findings"][1:]]
    assert last == ["thruster_gain"] and "stops following its commands as well is not known" in lines
