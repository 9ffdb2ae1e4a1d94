"""The study of a measured boat: its errors are none where the model is the one that made the log."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import measured_blueboat as study
from jaxmarine._types import CHANNELS
from jaxmarine.effects import VelocityLeverArm
from jaxmarine.logs import Log, read_columns
from jaxmarine.vehicle import Placed
from jaxmarine.vehicle_io import load_vehicle
from tests.boats import NOISE, boat, record, steps

EXACT = dict.fromkeys(NOISE, 0.0)


def test_the_model_that_made_a_log_predicts_it_with_any_sensor():
    """Also where the log shows the velocity of another point, not of its own."""
    elsewhere = boat().place(Placed(VelocityLeverArm(*map(jnp.asarray, (1.0, 0.2, 0.0))), None))
    log = record(elsewhere, steps(200), noise=EXACT)
    assert study.rms([study.predicted(elsewhere, log)], [log]) == pytest.approx([0.0] * 3, abs=1e-6)
    # A metre ahead in turns of some tenths of a radian per second.
    assert study.rms([study.predicted(boat(), log)], [log])[1] > 0.01


def test_a_held_start_misses_by_what_comes_after_it():
    t = 0.1 * np.arange(101)
    channels = np.full((101, 18), np.nan)
    channels[:, [CHANNELS.index(name) for name in "uvr"]] = np.stack([0.2 * t, 0 * t + 0.3, 0 * t], axis=1)
    log = Log(t, channels, np.zeros((101, 2)), None, ("left", "right"), "ramp.csv")
    # Two horizons of 5 s: root mean square of 0.2 m/s² times 0 to 4.9 s.
    expected = 0.2 * np.sqrt(np.mean((0.1 * np.arange(50)) ** 2))
    assert study.rms([study.held(log)], [log]) == pytest.approx([expected, 0.0, 0.0], abs=1e-12)


def test_an_interval_is_as_wide_as_predictions_differ():
    """Of errors that are alike within a prediction of 5 s, by the linearised spread of their mean square."""
    size = np.abs(np.random.default_rng(1).normal(1.0, 0.3, (60, 3)))
    channels = np.zeros((60 * 50 + 20, 18))
    log = Log(0.1 * np.arange(len(channels)), channels, np.zeros((len(channels), 2)), None, ("l", "r"), "log")
    missed = np.full((len(channels), 3), np.nan)
    missed[: 60 * 50] = np.repeat(size, 50, axis=0)
    low, high = np.array(study.within([missed], [log])).T
    root = np.sqrt((size**2).mean(axis=0))
    spread = (size**2).std(axis=0) / np.sqrt(60) / (2 * root)
    # Of ten thousand draws, and of a root that is not quite linear.
    np.testing.assert_allclose((high - low) / (2 * 1.96 * spread), 1.0, atol=0.1)
    assert ((low < root) & (root < high)).all()


def test_the_guess_and_its_maps_are_files_that_are_read():
    guess = load_vehicle(study.GUESS)
    assert guess.dof == ("surge", "sway", "yaw") and guess.thruster_names == ("left", "right")
    for path in (study.AS_NAMED, study.COLUMNS):
        read_columns(path)
    assert not {*study.TRAIN} & {*study.TEST}


def test_the_table_of_the_page_is_that_of_the_results():
    results = json.loads((study.HERE / "results.json").read_text())
    page = (study.HERE / "README.md").read_text()
    for name, values in results["rms"].items():
        assert f"| {name} | " + " | ".join(f"{x:.3f}" for x in values) + " |" in page
    (low, high), _, _ = results["within"][f"jaxmarine fit, also {', '.join(study.OF_BOATS)}"]
    assert low < study.TRIAL["trial: also gains, dead band, damping with |u| r"][0] < high
    assert f"the error in u itself is known to {low:.3f} to {high:.3f} m/s (95 %)" in " ".join(page.split())


def test_the_page_has_what_wind_and_coupling_are_worth():
    folder = study.HERE
    page, worth = (folder / "README.md").read_text(), json.loads((folder / "worth.json").read_text())
    rows = {"effects": "fit with effects", "wind_push": "and a push of the wind", "coupling": "and coupling"}
    for name, words in rows.items():
        assert f"| {words} | " + " | ".join(f"{x:.4f}" for x in worth[name]) + " |" in page
    assert worth["coupling"][1] / worth["effects"][1] < 8.02 / 9
