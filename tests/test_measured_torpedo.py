"""The study of a measured torpedo: its reader, its errors, its page."""

import json

import numpy as np
import pytest

import jaxmarine as jm
from experiments import measured_torpedo as study
from jaxmarine.guesses import guess_vehicle

HEADING = study.CHANNELS.index("psi")


def test_a_run_comes_back_through_the_recorders_files_and_the_true_torpedo_predicts_it(tmp_path):
    data = study.pretended(tmp_path / "data", study.TRAIN[:1])
    path = study.run(study.recording(data), study.TRAIN[0], tmp_path)
    truth = jm.load_vehicle(data / "truth.toml")
    log = jm.read_log(path, truth, study.COLUMNS)
    assert log.dt == pytest.approx(0.1) and log.duration == pytest.approx(study.LENGTH, abs=0.3)
    commands = log.commanded(truth.command_names)
    assert commands is not None and truth.command_names == ("propeller", "rudder_top", "rudder_bottom")
    np.testing.assert_allclose(commands[:, 1], commands[:, 2])
    rows = study.scored({"truth": truth}, [log])
    # The log's own jitter is 0.02 m/s; of the heading most is that of the rate with which a start begins.
    assert max(rows["truth"]["5"]) < 0.03
    for held in ("held", "held, turning on"):
        assert rows[held]["5"][HEADING] > 5 * rows["truth"]["5"][HEADING]


def test_the_guess_is_the_commands_but_for_what_was_cut(tmp_path):
    whole = tmp_path / "whole.toml"
    sizes = {"mass": 47.556, "length": 2.194, "beam": 0.1753, "draft": 0.1753, "speed": 2.0}
    guess_vehicle(whole, "auv", **sizes, name="torpedo")
    guess = jm.load_vehicle(study.GUESS)
    assert guess.dof == ("surge", "sway", "yaw")
    assert guess.command_names == ("propeller", "rudder_top", "rudder_bottom")
    own = [
        line for line in study.GUESS.read_text().splitlines() if line not in whole.read_text().splitlines()
    ]
    assert [line for line in own if not line.startswith("#")] == ['dof = ["surge", "sway", "yaw"]']
    assert not {*study.TRAIN} & {*study.TEST}


@pytest.mark.slow
def test_a_quick_study_finds_the_current(tmp_path):
    study.main(tmp_path, quick=True)
    results = json.loads((tmp_path / "results.json").read_text())
    fit = results["fits"]["jaxmarine fit"]
    for name, true in study.CURRENT.items():
        # 600 samples of 0.02 m/s on either side of turns: 0.002 m/s is what the fit says itself.
        assert fit[f"steady_current.{name}"][1] == pytest.approx(true, abs=0.01)
    # The two rudders act as one and to the side that the file says.
    top, bottom = (fit[f"surface.lift_slope[rudder_{name}]"][1] for name in ("top", "bottom"))
    assert top == pytest.approx(bottom, rel=1e-3) and top > 0
    assert not any(line.startswith("first") for line in results["check"])
    # Of the current alone: what is left of a fit that knows it is the jitter of the log.
    u, v, psi = results["rms"]["jaxmarine fit"]["20"]
    assert max(u, v) < 0.025 and psi < 0.03
    assert results["rms"]["guessed file"]["20"][0] > 0.1


RESULTS = json.loads((study.HERE / "results.json").read_text())
PAGE = (study.HERE / "README.md").read_text()
LINES = " ".join(PAGE.split())
PLAIN, PLACED = study.FITS


def test_the_page_shows_the_tables_of_the_results():
    tables = (
        study.error_table(RESULTS["rms"]),
        study.half_table(RESULTS["left_out"]),
        study.fit_table(RESULTS["fits"]),
    )
    for table in tables:
        assert f"\n\n{table}\n" in PAGE
    assert sum(line.startswith("|---") for line in PAGE.splitlines()) == len(tables)


def test_the_page_says_what_can_be_told():
    assert "Yaw answers opposite to rudder_bottom" in RESULTS["check_as_named"][0]
    assert not any(line.startswith("first") for line in RESULTS["check"])
    assert "3 of 9 coefficients can be told" in LINES and ": 3 of 9 coefficients" in RESULTS["check"][0]
    rms = RESULTS["rms"]
    plain, turning, held, guess = (rms[name] for name in (PLAIN, "held, turning on", "held", "guessed file"))
    u, v, psi = range(3)
    for words in (
        f"to {plain['5'][psi]:.3f} rad, where turning on as at the start misses by {turning['5'][psi]:.3f} ",
        f"the guess by {guess['5'][psi]:.3f} rad; over 20 s to {plain['20'][psi]:.3f} rad "
        f"({turning['20'][psi]:.3f} and {guess['20'][psi]:.3f}).",
        f"by {plain['20'][v]:.3f} m/s, where keeping that of the start misses by {held['20'][v]:.3f} m/s.",
        f"({rms[PLACED]['5'][v]:.3f} m/s for {plain['5'][v]:.3f} m/s over 5 s)",
        f"({rms[PLACED]['20'][psi]:.3f} rad for {plain['20'][psi]:.3f} rad over 20 s)",
        f"({plain['5'][u]:.3f} m/s for {held['5'][u]:.3f} m/s)",
    ):
        assert words in LINES
    assert all(0.18 < fit["steady_current.east"][1] < 0.19 for fit in RESULTS["fits"].values())


def test_the_page_says_which_cause_was_taken_and_why():
    guess, damped, error = RESULTS["fits"][PLAIN][study.SWAY]
    assert f"with {damped:.0f} ± {error:.0f} N s/m, {damped / guess:.0f} times the guess" in LINES
    fit = RESULTS["fits"][PLACED]
    _, ahead, error = fit["velocity_lever_arm.x"]
    assert f"the log {ahead:.2f} ± {error:.2f} m ahead" in LINES
    _, aside, beside = fit["velocity_lever_arm.y"]
    # Of a hull 2.194 m long and 0.1753 m wide.
    outside = f"{(ahead - 2.194 / 2) / error:.1f} and {(abs(aside) - 0.1753 / 2) / beside:.1f}"
    assert f"whose side 0.09 m off, by {outside} standard errors" in LINES
    assert f"sway is {fit[study.SWAY][1]:.1f} N s/m" in LINES
    halves = RESULTS["left_out"]
    means = {name: [study.overall(one["rms"]) for one in rows] for name, rows in halves.items()}
    pairs = zip(means[study.CHOSEN], means["nothing"], strict=True)
    assert f"({', '.join(f'{own:.3f} for {other:.3f}' for own, other in pairs)})" in LINES
    for own, lift, other in zip(means[study.CHOSEN], means["turning_lift"], means["nothing"], strict=True):
        assert own < other < lift
    for name in ("turning_lift", study.CHOSEN):
        assert all(one["fit"][study.SWAY][1] < guess for one in halves[name])
    turned = halves["velocity_misalignment"]
    assert all(one["fit"][study.SWAY][1] > 10 * guess for one in turned)
    assert f"({min(means['velocity_misalignment']):.3f})" in LINES
    assert min(map(min, means.values())) == means["velocity_misalignment"][0]
    assert min(means, key=lambda name: np.prod(means[name])) == "velocity_misalignment"
    _, angle, error = turned[1]["fit"]["velocity_misalignment.yaw"]
    assert f"from none ({angle:.3g} ± {error} rad)" in LINES and angle < error


def test_the_page_says_what_the_diagnoses_found():
    plain, placed = (RESULTS["diagnosis"][name] for name in study.FITS)
    assert plain["verdict"] == "unexplained" and [*plain["findings"]] == ["unknown:sway"]
    size, begin, end = plain["missing"]["unknown:sway in at_5235.csv"]
    assert (
        f"force of {size:.0f} N is missing in sway from {begin:.1f} to {end:.1f} s of the run at 5235 s"
        in LINES
    )
    assert placed == {"verdict": "nothing_found", "findings": {}, "missing": {}}


def test_the_page_says_what_cannot_be_told():
    assert f"constant one, {study.TURNS:g} rev/s" in LINES
    assert RESULTS["planes_apart"] == RESULTS["rudders_apart"] == 0.0
    assert f"{RESULTS['pitch_scatter']:.4f} rad over the training turns" in LINES
    assert study.TEST[-1] - study.TRAIN[0] < 71 * 60
