"""The study of a measured ship: its readers, its errors, its page."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxmarine as jm
from experiments import measured_kvlcc2 as study

RUN = ("hsva", "20_05")


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> tuple[jm.Log, jm.Vehicle]:
    """A simulated zigzag in the basin's text, read by the map."""
    folder = tmp_path_factory.mktemp("basin")
    study.pretended(folder, RUN, 20.0, 40.0)
    truth = jm.load_vehicle(jm.packaged_vehicle("kvlcc2"))
    return jm.read_log(study.contract_log(folder, RUN, folder), truth), truth


def test_a_run_comes_back_through_the_basins_text_and_the_true_ship_predicts_it(logs):
    log, truth = logs
    assert log.dt == pytest.approx(0.1) and log.duration == pytest.approx(39.9, abs=0.2)
    # Degrees, the rudder's sign and velocities along the axes of the earth: any of them wrong misses by more.
    # Between two changes of the rudder, whose state at a start is not logged.
    steady = log.between(13.0, 19.5)
    missed = study.rms([study.errors(truth, steady, 5.0)])
    assert missed[0] < 0.01 and max(missed[1:]) < 0.005
    assert study.rms([study.held(steady, 5.0)])[1] > 0.01


def test_a_start_that_is_held_goes_on_along_its_circle():
    t, r = 0.1 * np.arange(101), 0.2
    channels = np.full((101, 18), np.nan)
    channels[:, [study.U, study.V, study.R]] = [1.0, 0.0, r]
    channels[:, study.PSI], channels[:, study.X] = r * t, np.sin(r * t) / r
    channels[:, study.Y] = (1 - np.cos(r * t)) / r
    log = jm.Log(t, channels, np.zeros((101, 2)), None, ("propeller", "rudder"), "circle.csv")
    assert study.rms([study.held(log, 5.0)]) == pytest.approx([0.0] * 5, abs=1e-12)
    # A whole circle of radius 5 m: a radius ahead at a quarter, two aside at the half.
    angle = np.linspace(0.0, 6.0, 601)
    found = study.manoeuvre(5.0 * np.sin(angle), 5.0 * (1 - np.cos(angle)), angle)
    assert found == pytest.approx((5.0, 10.0), abs=0.01)


RESULTS = json.loads((study.HERE / "results.json").read_text())
PAGE = (study.HERE / "README.md").read_text()


def test_the_page_shows_the_tables_of_the_results():
    tables = [study.error_table(models) for models in RESULTS["rms"].values()]
    for table in (*tables, study.turn_table(RESULTS["circles"])):
        assert f"\n\n{table}\n" in PAGE
    assert sum(line.startswith("|---") for line in PAGE.splitlines()) == 3
    # Theirs as printed, and how far they are off, by hand.
    assert "| tc_35 | theirs, as printed | 21.59, 21.21 (-1.8%) | 21.72, 23.07 (+6.2%) |" in PAGE
    assert "| tc_-35 | theirs, as printed | 22.54, 22.10 (-2.0%) | 23.55, 24.29 (+3.1%) |" in PAGE


def test_the_page_says_what_was_found():
    lines = " ".join(PAGE.split())
    assert not {*study.TRAIN} & {*study.TURNS, *study.ZIGZAGS} and len(study.TRAIN) == 12
    assert "to twelve zigzags of HSVA, 1910 s" in lines and "(1910 s," in RESULTS["check"][0]
    told = " ".join(RESULTS["check_as_they_come"])
    assert "the column of rudder has the wrong sign" in told and "velocities are in earth axes" in told
    assert not any(line.startswith("first") for line in RESULTS["check"])
    # Ours turns more tightly than the ship, both ways.
    for (_, diameter), (_, predicted) in RESULTS["circles"].values():
        assert predicted < diameter
    assert f"The fit took {RESULTS['seconds']['fit']:.0f} s" in lines


def test_the_guessed_file_is_as_wrong_as_the_page_says():
    guessed, packaged = (
        tomllib.loads(Path(path).read_text()) for path in (study.GUESS, jm.packaged_vehicle("kvlcc2"))
    )

    def numbers(file: dict) -> np.ndarray:
        damping, propeller = np.array(file["damping"]["quadratic"]), file["propeller"][0]
        own = np.diag(damping) if damping.ndim == 2 else damping
        named = [*propeller["kt"], propeller["wake_fraction"], file["surface"][0]["lift_slope"]]
        return np.array([*np.array(file["added_mass"]["matrix"])[[0, 1, 5]], *own[[0, 1, 5]], *named])

    off = np.abs(numbers(guessed) / numbers(packaged) - 1)
    assert ((off > 0.2) & (off < 0.5)).all()
