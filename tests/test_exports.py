"""Exported vehicles, run by the programs that they are for, against `simulate` under the same commands."""

import dataclasses
import functools
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from jaxmarine._errors import InputError
from jaxmarine._types import CHANNELS
from jaxmarine.cli import app
from jaxmarine.effects import FluidMemory, GyroBias, InputDelay, SteadyCurrent
from jaxmarine.exports import FORMATS, export
from jaxmarine.logs import Log
from jaxmarine.physics import Slider
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed, Vehicle
from jaxmarine.vehicle_io import packaged_vehicle
from tests.crafts import packaged

# Steps that `simulate` does not cut for any of these craft.
T = np.arange(0.0, 5.0, 0.05)


# All targets here take the same steps as `simulate`; what remains is rounding.
ROUNDING = 1e-9


def remembering() -> Vehicle:
    """An ROV with slow thrusters, a dead zone, fluid memory and a current."""
    vehicle = packaged("tethra")
    one = jnp.ones_like(vehicle.thrusters.lag)
    thrusters = dataclasses.replace(vehicle.thrusters, lag=0.3 * one, deadband=0.05 * one)
    memory = Placed(FluidMemory(jnp.full(6, 20.0), jnp.full(6, 0.8)))
    current = Placed(SteadyCurrent(jnp.asarray(0.2), jnp.asarray(-0.1), jnp.asarray(0.0)), since=-1.0)
    return dataclasses.replace(vehicle, thrusters=thrusters).place(memory, current)


def sliding() -> Vehicle:
    """The same with a mass that slides fore and aft."""
    ahead = jnp.array([1.0, 0.0, 0.0])
    slider = Slider(
        jnp.asarray(4.0), 0.1 * ahead, ahead, jnp.asarray(0.3), jnp.asarray(0.5), name="trim_mass"
    )
    return dataclasses.replace(remembering(), slider=slider)


@functools.cache
def driven(name: str) -> tuple[Vehicle, np.ndarray, np.ndarray, np.ndarray]:
    """A vehicle, its commands, its start, and what `simulate` makes of them."""
    vehicle = {"remembering": remembering, "sliding": sliding}.get(name, lambda: packaged(name))()
    count = len(vehicle.command_names)
    levels = np.random.default_rng(3).uniform(-0.8, 0.8, (len(T) // 20, count))
    commands = np.repeat(levels * np.minimum(vehicle.command_limits, 10.0), 20, axis=0)
    start = np.array([1.0, -2.0, 3.0, 0.1, -0.2, 0.5, *(0.2,) * 6]) * np.tile(vehicle.free, 2)
    log = Log(T, np.full((len(T), len(CHANNELS)), np.nan), commands, None, vehicle.command_names, "log.csv")
    track = simulate(vehicle, log, initial_state(vehicle, start[:3], start[3:6], start[6:]))
    return vehicle, commands, start, np.asarray(track.channels)[:, :12]


def told(path: Path) -> dict:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("model.json"))


# What somebody runs who has jax and not jaxmarine.
_ALONE = """
import sys
sys.modules["jaxmarine"] = None  # importing it would fail
import zipfile, jax, numpy as np
jax.config.update("jax_enable_x64", True)
given = np.load(sys.argv[2])
with zipfile.ZipFile(sys.argv[1]) as archive:
    start, step, shown = (
        jax.export.deserialize(archive.read(f"{name}.stablehlo")).call for name in ("start", "step", "shown")
    )
T, commands, begin = given["t"], given["commands"], given["start"]
first = start(begin[:3], begin[3:6], begin[6:], commands[0])
none, dt = np.zeros(6), T[1] - T[0]


@jax.jit
def run(state, inputs):
    return jax.lax.scan(lambda now, one: (step(now, one[1], none, one[0], dt), shown(now)), state, inputs)


_, rows = run(first, (T, commands))
slope = jax.jit(jax.grad(lambda command: step(first, command, none, 0.0, dt)[7]))(commands[0])
np.savez(sys.argv[3], rows=rows, slope=slope)
"""


def test_stablehlo_runs_without_jaxmarine(tmp_path):
    vehicle, commands, start, track = driven("sliding")
    export(vehicle, tmp_path / "model.zip", "stablehlo")
    np.savez(tmp_path / "given.npz", t=T, commands=commands, start=start)
    paths = [str(tmp_path / one) for one in ("model.zip", "given.npz", "got.npz")]
    subprocess.run([sys.executable, "-c", _ALONE, *paths], check=True, cwd=tmp_path)
    got = np.load(tmp_path / "got.npz")
    assert np.abs(got["rows"] - track).max() < ROUNDING
    assert np.abs(got["slope"]).max() > 0.0


@pytest.mark.parametrize("name", ["remembering", "kvlcc2"])
def test_casadi_steps_as_simulate(name, tmp_path):
    import casadi

    vehicle, commands, start, track = driven(name)
    export(vehicle, tmp_path / "model.zip", "casadi")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        begin, step, rates, shown = (
            casadi.Function.deserialize(archive.read(f"{one}.casadi").decode())
            for one in ("start", "step", "rates", "shown")
        )
    state = begin(start[:3], start[3:6], start[6:], commands[0])
    rows = []
    for t, command in zip(T, commands, strict=True):
        rows.append(shown(state).full().ravel())
        state = step(state, command, np.zeros(6), t, T[1] - T[0])
    assert np.abs(np.array(rows) - track).max() < ROUNDING
    # The derivative is that of short steps.
    short = 1e-5
    held = commands[0], np.zeros(6), 0.0
    slope = ((step(state, *held, short) - state) / short).full().ravel()
    known = np.array([not one.startswith("actual_") for one in told(tmp_path / "model.zip")["state"]])
    exact = rates(state, *held).full().ravel()
    assert np.allclose(slope[known], exact[known], rtol=1e-3, atol=1e-3)


def test_an_fmu_runs_as_simulate(tmp_path):
    import fmpy

    vehicle, commands, start, track = driven("kvlcc2")
    export(vehicle, tmp_path / "ship.fmu", "fmi3")
    described = fmpy.read_model_description(str(tmp_path / "ship.fmu"), validate=True)
    assert described.fmiVersion == "3.0" and described.coSimulation is not None
    names = ("X", "Y", "Z", "K", "M", "N", *vehicle.command_names)
    rows = [(t, *(0.0,) * 6, *row) for t, row in zip(T, commands, strict=True)]
    shown = CHANNELS[:12]
    got = fmpy.simulate_fmu(
        str(tmp_path / "ship.fmu"),
        stop_time=float(T[-1]),
        step_size=float(T[1]),
        output_interval=float(T[1]),
        start_values={f"{name}_start": value for name, value in zip(shown, start, strict=True)},
        input=np.array(rows, [("time", float), *((name, float) for name in names)]),
        output=list(shown),
    )
    assert np.allclose(got["time"], T)
    assert np.abs(np.array([[row[name] for name in shown] for row in got]) - track).max() < ROUNDING


def test_what_is_left_behind_is_said_and_written(tmp_path):
    vehicle = remembering().place(
        Placed(InputDelay(jnp.asarray(0.2))), Placed(GyroBias(*(jnp.asarray(0.01) for _ in range(3))))
    )
    notes = export(vehicle, tmp_path / "model.zip", "casadi")
    assert any("`steady_current` (-1 s)" in note for note in notes)
    assert any("`gyro_bias`" in note for note in notes)
    assert any("port_h (0.2 s)" in note for note in notes)
    assert told(tmp_path / "model.zip")["notes"] == list(notes)
    assert "sliding mass" in " ".join(export(sliding(), tmp_path / "slides.zip", "casadi"))


def test_the_command_line_exports_and_says_what_is_wrong(tmp_path):
    rov = str(packaged_vehicle("tethra"))
    done = CliRunner().invoke(app, ["export", rov, "--to", "casadi", "--out", str(tmp_path / "rov.zip")])
    assert done.exit_code == 0 and "Exported vehicle" in done.output
    assert told(tmp_path / "rov.zip")["vehicle"] == "tethra"
    with pytest.raises(InputError, match=f"known are {', '.join(FORMATS)}"):
        export(packaged("tethra"), tmp_path / "x", "step")


def test_a_missing_package_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxmarine.exports.casadi.NEEDS", "no_such_package")
    with pytest.raises(InputError, match=r"needs the package no_such_package.*jaxmarine\[exports\]"):
        export(packaged("tethra"), tmp_path / "x", "casadi")
