"""The pool: a flight is what the simulation says, its log is a log, and its page is for this machine alone."""

import contextlib
import functools
import http.client
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from jaxmarine.effects import place
from jaxmarine.examples import operator
from jaxmarine.pool import CRAFTS, Pool, serve
from jaxmarine.pool._basin import DT, STEPS
from jaxmarine.pool._faults import faults_of, with_faults
from jaxmarine.simulation import substeps

from .browser import CHROMIUM, browser, until
from .conftest import ROOT

ROV = CRAFTS["rov"]
WEAK = "thruster_gain:port_h"


def pool(folder: Path, **given) -> Pool:
    """A flight of the ROV, of which a test is the clock."""
    return Pool(ROV, folder, **({"seed": 0, "noisy": False, "clock": lambda: 0.0} | given))


def flown(flight: Pool, commands: np.ndarray) -> None:
    for row in commands:
        flight.steer(dict(zip(flight.columns, row.tolist(), strict=True)))
        flight.step()


# --- the craft in the water ----------------------------------------------------------------------


def test_a_flight_with_faults_is_what_the_simulation_says(tmp_path):
    """A weak thruster from 2 s on and a current from 4 s on, by an adaptive method and the catalogue itself."""
    flight = pool(tmp_path)
    commands = operator(4, np.arange(80) * DT, seed=1)
    flown(flight, commands[:20])
    flight.switch(WEAK, True, {"factor": 0.4})
    flown(flight, commands[20:40])
    flight.switch("steady_current", True, {})
    flown(flight, commands[40:])
    flight.close()
    log = jm.read_log(flight.log.path, flight.vehicle)
    assert log.commands is not None
    # What was first asked for acts from the second sample on; nothing else is changed on the way.
    np.testing.assert_allclose(log.commands[1:], commands[1:], rtol=1e-8)
    assert not log.commands[0].any()
    faults, placed = faults_of(flight.vehicle, ROV.push), []
    for label, since, values in ((WEAK, 2.0, {"factor": 0.4}), ("steady_current", 4.0, None)):
        suspect = faults[label].suspect
        values = values or {name: size.value for name, size in faults[label].sizes.items()}
        placed.append(jm.Placed(place(suspect, flight.vehicle, values), suspect.target, since=since))
    start = jm.initial_state(flight.vehicle, position=(0.0, 0.0, ROV.depth))
    track = jm.simulate(flight.vehicle.place(*placed), log, start, diffrax.Tsit5())
    # Nine digits in the log, a relative 1e-8 in a step of the adaptive method, of which there are some hundreds.
    np.testing.assert_allclose(log.channels, track.channels, rtol=1e-6, atol=1e-7)


def test_a_fault_changes_the_force_as_its_effect_says(tmp_path):
    """By the contract's own formulas, in the order of the contract."""
    flight = pool(tmp_path)
    most = float(flight.vehicle.thrusters.max_thrust[flight.columns.index("port_h")])

    def given(command: float) -> float:
        flown(flight, np.array([[0.0, command, 0.0, 0.0]] * 2))
        return flight.view()["given"]["port_h"]

    plain = given(0.6)
    assert plain == pytest.approx(most * 0.6)
    flight.switch(WEAK, True, {"factor": 0.4})
    assert given(0.6) == pytest.approx(0.4 * plain)
    flight.switch("deadband", True, {"width": 0.1})
    assert given(0.6) == pytest.approx(0.4 * most * 0.5)
    assert given(0.05) == 0.0
    # What is set once stays, and what is switched off acts no longer.
    flight.switch(WEAK, True, {})
    assert given(0.6) == pytest.approx(0.4 * most * 0.5)
    flight.switch(WEAK, False, {})
    assert given(0.6) == pytest.approx(most * 0.5)
    flight.close()
    rows = flight.switched.path.read_text().splitlines()
    assert rows[0] == "t,fault,on,size"
    assert rows[1] == f"0.2,{WEAK},1,factor=0.4" and rows[-1] == f"1.0,{WEAK},0,factor=0.4"


@pytest.mark.parametrize("kind", CRAFTS)
def test_a_sample_is_cut_finely_enough(kind):
    craft = CRAFTS[kind]
    vehicle = craft.vehicle()
    faults = faults_of(vehicle, craft.push)
    drag = {label: one for label, one in faults.items() if "damping" in label or "tether" in label}
    largest = {label: {name: size.high for name, size in one.sizes.items()} for label, one in drag.items()}
    assert drag
    assert substeps(with_faults(vehicle, drag, largest), DT, 3.0) <= STEPS


# --- what is recorded ----------------------------------------------------------------------------


def test_a_flight_leaves_a_log_that_can_be_checked(tmp_path):
    """With the noise of the file: its columns are the contract's, and its scatter is what the file states."""
    flight = pool(tmp_path, noisy=True)
    flown(flight, operator(4, np.arange(40) * DT, seed=1))
    held = np.tile(np.zeros(4), (60, 1))
    flown(flight, held)
    flight.close()
    vehicle = jm.load_vehicle(flight.vehicle_file)
    log = jm.read_log(flight.log.path, vehicle)
    assert len(log.t) == flight.log.count == 100
    np.testing.assert_allclose(np.diff(log.t), DT, rtol=1e-9)
    assert not log.notes


def test_each_flight_has_files_of_its_own_and_one_that_nobody_flew_has_none(tmp_path):
    first = pool(tmp_path)
    flown(first, np.zeros((1, 4)))
    second = pool(tmp_path)
    for flight in first, second:
        flight.close()
    assert first.log.path != second.log.path
    assert {path.name for path in tmp_path.iterdir()} == {"flight-1.csv", "vehicle.toml"}
    (tmp_path / "vehicle.toml").write_text("another's")
    with pytest.raises(jm.InputError, match="another craft's"):
        pool(tmp_path)


def test_who_says_nothing_for_long_drives_no_further(tmp_path):
    now = 0.0
    flight = pool(tmp_path, clock=lambda: now)
    flown(flight, np.full((2, 4), 0.5))
    assert set(flight.view()["commands"].values()) == {0.5}
    now = 3.1
    flight.step()
    assert set(flight.view()["commands"].values()) == {0.0}
    flight.close()
