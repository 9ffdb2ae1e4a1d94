"""The study of a measured ship: its readers, its errors, its page."""

import json

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


def test_the_table_of_the_page_is_that_of_the_results():
    results = json.loads((study.HERE / "results.json").read_text())
    page = (study.HERE / "README.md").read_text()
    for tables in results["rms"].values():
        for name, rows in tables.items():
            for horizon, values in rows.items():
                assert f"| {name} | {horizon} | " + " | ".join(f"{x:.3f}" for x in values) + " |" in page
    assert not {*study.TRAIN} & {*study.TURNS, *study.ZIGZAGS}
