"""Sway and yaw that the hull joins and the file does not: found by a fit, and named by a diagnosis."""

import functools
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

import jaxmarine as jm
from experiments.blind import plant as blind
from experiments.blind import vehicle as blind_vehicle

# Added mass [kg m] and linear damping [N s], of a hull whose centre in the water lies ahead of `o`.
ADDED, SWAY_BY_YAW, YAW_BY_SWAY = 1.5, 0.8, -0.5


@functools.cache
def craft_and_logs(added: float, sway_by_yaw: float, yaw_by_sway: float) -> tuple[jm.Vehicle, jm.Log, jm.Log]:
    """CyberShip II without a number between axes, and logs of the independent plant that has these."""
    text = jm.packaged_vehicle("cybership2").read_text().replace("-0.1079", "0.0").replace("-0.1052", "0.0")
    table = tomllib.loads(text)
    for i, j, linear in (1, 5, sway_by_yaw), (5, 1, yaw_by_sway):
        table["added_mass"]["matrix"][i][j] = added
        table["damping"]["linear"][i][j] = linear
    with tempfile.TemporaryDirectory() as folder:
        file, true = Path(folder) / "file.toml", Path(folder) / "true.toml"
        file.write_text(text)
        true.write_text(tomli_w.dumps(table))
        craft, plant = jm.load_vehicle(file), blind.Model(blind_vehicle.load(true), [])
    return craft, driven(craft, plant, 240.0, 3), driven(craft, plant, 120.0, 5)


def driven(craft: jm.Vehicle, plant: blind.Model, duration: float, seed: int) -> jm.Log:
    """Under thrusts that are drawn anew every five seconds."""
    dt, hold, rng = 0.2, 25, np.random.default_rng(seed)
    t = np.arange(0.0, duration, dt)
    commands = np.repeat(rng.uniform(-0.9, 0.9, (len(t) // hold, 3)), hold, axis=0)
    rest = np.zeros((13, 1))
    run = blind.simulate([(0, plant)], commands[:, :, None], rest, len(t), t0=0.0, thrust=0.0, dt=dt, step=dt)
    clean = blind.observed([], t, run.signals())[:, :, 0]
    channels = clean + craft.stated_noise * rng.standard_normal(clean.shape)
    return jm.Log(t, channels, commands, None, craft.thruster_names, f"log{seed}.csv")


@pytest.mark.slow
def test_a_coupling_that_the_file_lacks_is_fitted_within_its_interval():
    craft, log, _ = craft_and_logs(ADDED, SWAY_BY_YAW, YAW_BY_SWAY)
    found = jm.fit(craft, log, lambda v: (v.added_mass, v.damping.linear), prior=0.3, entries="coupled")
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.1)
    truth = {
        "added_mass[yaw,sway]": ADDED,
        "damping.linear[sway<-yaw]": SWAY_BY_YAW,
        "damping.linear[yaw<-sway]": YAW_BY_SWAY,
    }
    for name, true in truth.items():
        one = found[name]
        assert one.start == 0.0 and abs(one.value - true) < 3 * one.std_model, one
        # It is known, and not what the prior left of it.
        assert one.std_model < 0.2 * abs(true)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ((ADDED, 0.0, 0.0), {"coupled_added_mass:sway+yaw"}),
        ((0.0, SWAY_BY_YAW, 0.0), {"coupled_damping:sway<-yaw"}),
        ((ADDED, 0.0, YAW_BY_SWAY), {"coupled_added_mass:sway+yaw", "coupled_damping:yaw<-sway"}),
    ],
)
def test_a_coupling_that_the_file_lacks_is_named_and_no_memory_of_the_water(hidden, named):
    craft, train, test = craft_and_logs(*hidden)
    diagnosis = jm.diagnose(craft, train, test)
    assert {finding.label for finding in diagnosis.findings} == named
    assert diagnosis.verdict == "explained"
    labels = ("coupled_added_mass:sway+yaw", "coupled_damping:sway<-yaw", "coupled_damping:yaw<-sway")
    values = dict(zip(labels, hidden, strict=True))
    for finding in diagnosis.findings:
        value = finding.parameters["value"]
        assert value.value == pytest.approx(values[finding.label], abs=4 * value.std)
    # The matrix of the extended vehicle is symmetric, as a file has it.
    added = np.asarray(diagnosis.extended.plant().load.added)
    np.testing.assert_array_equal(added, added.T)
