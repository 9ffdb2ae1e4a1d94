"""Exported vehicles, run by the programs that they are for, against `simulate` under the same commands."""

import dataclasses
import functools
import importlib.util
import itertools
import json
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jaxmarine._errors import InputError
from jaxmarine._types import CHANNELS
from jaxmarine.actuators import Flow, Slider, Surfaces, SurgeDrag
from jaxmarine.actuators._surface import HullTable, SurfaceTable
from jaxmarine.cli import app
from jaxmarine.effects import (
    CATALOGUE,
    ConstantWrench,
    CoupledAddedMass,
    CoupledDamping,
    FluidMemory,
    GyroBias,
    InputDelay,
    LinearDamping,
    Payload,
    SteadyCurrent,
    place,
)
from jaxmarine.exports import FORMATS, export
from jaxmarine.exports.casadi import functions
from jaxmarine.logs import Log
from jaxmarine.networks import learned_thrust, learned_wrench, mlp_damping, rbf_damping
from jaxmarine.simulation import initial_state, simulate
from jaxmarine.vehicle import Placed, Vehicle
from jaxmarine.vehicle_io import packaged_vehicle, suspect_named
from tests.crafts import packaged

from .conftest import ROOT

# Steps that `simulate` does not cut for any of these craft.
T = np.arange(0.0, 5.0, 0.05)


# All targets here take the same steps as `simulate`; what remains is rounding.
ROUNDING = 1e-9


def remembering() -> Vehicle:
    """An ROV with slow thrusters, a dead zone, thrust lost to the flow, fluid memory and a current.

    Of its dampings one is of any shape over the speed, another learned.
    """
    vehicle = packaged("tethra")
    one = jnp.ones_like(vehicle.thrusters.lag)
    thrusters = dataclasses.replace(
        vehicle.thrusters, lag=0.3 * one, deadband=0.05 * one, advance_loss=8.0 * one
    )
    knots = {"speed": jnp.array([0.0, 0.1, 0.3]), "drag": jnp.array([10.0, 80.0, 30.0])}
    drag = SurgeDrag(**knots, names=("surge_drag",))
    memory = Placed(FluidMemory(jnp.full(6, 20.0), jnp.full(6, 0.8)))
    current = Placed(SteadyCurrent(jnp.asarray(0.2), jnp.asarray(-0.1), jnp.asarray(0.0)), since=-1.0)
    axes = ("surge", "sway", "yaw")
    network = mlp_damping(axes, np.full(3, 0.8), np.full(3, 20.0), jax.random.key(0))
    weights = network.network.layers[-1].weight
    # As if it had been fitted: the last layer begins at zero.
    network = eqx.tree_at(lambda n: n.network.layers[-1].weight, network, 0.5 * jnp.ones_like(weights))
    vehicle = dataclasses.replace(vehicle, thrusters=thrusters, actuators=(drag,))
    return vehicle.place(memory, current, Placed(network))


def sliding() -> Vehicle:
    """The same with a mass that slides fore and aft."""
    ahead = jnp.array([1.0, 0.0, 0.0])
    slider = Slider(
        jnp.asarray(4.0), 0.1 * ahead, ahead, jnp.asarray(0.3), jnp.asarray(0.5), names=("trim_mass",)
    )
    return dataclasses.replace(remembering(), masses=(slider,))


@functools.cache
def driven(name: str) -> tuple[Vehicle, np.ndarray, np.ndarray, np.ndarray]:
    """A vehicle, its commands, its start, and what `simulate` makes of them."""
    ours = {one.__name__: one for one in (remembering, sliding, forgetful, simple)}
    vehicle = ours[name]() if name in ours else packaged(name)
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


def imported(path: Path):
    """A module that was written."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
slope = jax.grad(lambda state: shown(state)[2])(first)
np.savez(sys.argv[3], rows=rows, slope=slope)
"""


@pytest.mark.parametrize("name", ["remembering", pytest.param("sliding", marks=pytest.mark.slow)])
def test_stablehlo_runs_without_jaxmarine(name, tmp_path):
    vehicle, commands, start, track = driven(name)
    export(vehicle, tmp_path / "model.zip", "stablehlo")
    np.savez(tmp_path / "given.npz", t=T, commands=commands, start=start)
    paths = [str(tmp_path / one) for one in ("model.zip", "given.npz", "got.npz")]
    subprocess.run([sys.executable, "-c", _ALONE, *paths], check=True, cwd=tmp_path)
    got = np.load(tmp_path / "got.npz")
    assert np.abs(got["rows"] - track).max() < ROUNDING
    assert np.array_equal(got["slope"], np.eye(len(got["slope"]))[2])  # of the depth


@pytest.mark.parametrize(
    "name", ["remembering", *(pytest.param(name, marks=pytest.mark.slow) for name in ("kvlcc2", "remus100"))]
)
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


def test_an_fmu_runs_as_simulate(tmp_path, monkeypatch):
    import fmpy

    vehicle, commands, start, track = driven("kvlcc2")
    export(vehicle, tmp_path / "ship.fmu", "fmi3")
    described = fmpy.read_model_description(str(tmp_path / "ship.fmu"), validate=True)
    assert described.fmiVersion == "3.0" and described.coSimulation is not None
    # Of newton metres and revolutions in the SI's own units, as a tool converts them.
    units = {one.name: one.unit for one in described.modelVariables}
    assert [units[name] for name in ("time", "x", "psi", "u", "r", "u_start", "X", "N")] == [
        *("s", "m", "rad", "m/s", "rad/s", "m/s", "N", "N m")
    ]
    assert [units[name] for name in vehicle.command_names] == ["rev/s", "rad"]
    base = {one.name: one.baseUnit for one in described.unitDefinitions}
    assert (base["N m"].kg, base["N m"].m, base["N m"].s, base["N m"].factor) == (1, 2, -2, 1.0)
    turn = base["rev/s"]
    assert (turn.rad, turn.s, turn.m) == (1, -1, 0) and turn.factor == pytest.approx(2.0 * np.pi, rel=1e-15)
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
    # As the page has it.
    (tmp_path / "ship.fmu").rename(tmp_path / "rov.fmu")
    monkeypatch.chdir(tmp_path)
    left = run_of_the_page(1, vehicle.command_names[0])
    held = np.zeros((201, len(vehicle.command_names)))
    held[:, 0] = 0.4
    blank = Log(np.arange(201) / 10, np.full((201, 18), np.nan), held, None, vehicle.command_names, "held")
    begin = initial_state(vehicle, velocity=np.array([0.2, 0, 0, 0, 0, 0]))
    assert np.abs(left["out"]["u"] - np.asarray(simulate(vehicle, blank, begin)["u"])).max() < ROUNDING


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


def run_of_the_page(which: int, port: str = "port") -> dict:
    """What a block of Python on the page of exports leaves, run where one is; `port`: a thruster's name."""
    page = (ROOT / "docs" / "exports.md").read_text()
    blocks = re.findall(r"^```py\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    left: dict = {}
    exec(blocks[which].replace('"port"', f'"{port}"'), left)
    return left


def test_the_command_line_exports_and_says_what_is_wrong(tmp_path, monkeypatch):
    rov = str(packaged_vehicle("tethra"))
    done = CliRunner().invoke(app, ["export", rov, "--to", "casadi", "--out", str(tmp_path / "rov.zip")])
    assert done.exit_code == 0 and "Exported vehicle" in done.output
    monkeypatch.chdir(tmp_path)
    left = run_of_the_page(0)
    assert left["told"]["vehicle"] == "tethra" and left["rates"].n_in() == 4
    with pytest.raises(InputError, match=f"known are {', '.join(FORMATS)}"):
        export(packaged("tethra"), tmp_path / "x", "step")


def test_a_missing_package_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxmarine.exports.casadi.NEEDS", ("no_such_package",))
    with pytest.raises(InputError, match=r"needs the package no_such_package.*jaxmarine\[exports\]"):
        export(packaged("tethra"), tmp_path / "x", "casadi")


def test_mujoco_moves_the_hull_as_simulate(tmp_path, monkeypatch):
    import mujoco

    vehicle, commands, start, track = driven("simple")
    export(vehicle, tmp_path / "model.zip", "mujoco")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        archive.extractall(tmp_path)
    module = imported(tmp_path / "hull.py")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "vehicle.xml"))
    data = mujoco.MjData(model)
    flip = np.array([1.0, -1.0, -1.0])
    # North-west-up and forward-left-up; scipy's quaternions have their scalar last.
    data.qpos[:3] = flip * start[:3]
    turn = flip[:, None] * Rotation.from_euler("ZYX", start[5:2:-1]).as_matrix() * flip
    data.qpos[3:] = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    data.qvel[:3], data.qvel[3:] = turn @ (flip * start[6:9]), flip * start[9:]
    places = []
    mujoco.set_mjcb_passive(module.Hull(tmp_path, model))
    try:
        for command in commands:
            places.append(flip * data.qpos[:3])
            data.ctrl[:] = command
            for _ in range(round(T[1] / model.opt.timestep)):
                mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
    # MuJoCo's Runge-Kutta takes steps of a fifth of those of `simulate`, whose own error this is.
    assert np.abs(np.array(places) - track[:, :3]).max() < 1e-5
    # As the page has it.
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    try:
        left = run_of_the_page(2)
        moving = mujoco.MjData(left["model"])
        moving.qvel[0] = 1.0
        mujoco.mj_step(left["model"], moving)
        assert 0.0 < moving.qvel[0] < 1.0
    finally:
        mujoco.set_mjcb_passive(None)
    assert "without lag" in " ".join(export(remembering(), tmp_path / "slow.zip", "mujoco"))


def forgetful() -> Vehicle:
    """`remembering` without what plain parameters cannot hold, and with what they can hold beside."""
    vehicle = remembering()
    none = jnp.zeros_like(vehicle.thrusters.lag)
    current = vehicle.placed[1]
    more = Placed(LinearDamping(jnp.asarray([5.0, 4.0, 3.0, 0.2, 0.3, 0.4])))
    push = Placed(ConstantWrench(jnp.asarray([1.0, -2.0, 0.5, 0.1, 0.0, 0.2])))
    water = Placed(CoupledAddedMass(jnp.asarray([0.0, 6.0, 0.0, 0.0, 9.0, 0.0])))
    thrusters = dataclasses.replace(vehicle.thrusters, advance_loss=none)
    return dataclasses.replace(
        vehicle, thrusters=thrusters, actuators=(), placed=(current, more, push, water)
    )


@pytest.mark.parametrize("name", ["simple", pytest.param("forgetful", marks=pytest.mark.slow)])
def test_the_module_for_python_vehicle_simulator_moves_as_simulate(name, tmp_path):
    vehicle, commands, start, track = driven(name)
    notes = export(vehicle, tmp_path / "rov.py", "pvs")
    written = (tmp_path / "rov.py").read_text(encoding="utf-8")
    assert all(note in written for note in notes)
    rov = imported(tmp_path / "rov.py").tethra()
    eta, nu, thrust = start[:6].copy(), start[6:].copy(), rov.thrust(commands[0])
    places, dt = [], 1e-3
    for command in commands:
        places.append(np.append(eta, nu))
        for _ in range(round(T[1] / dt)):
            turned = Rotation.from_euler("ZYX", eta[5:2:-1])
            # After Fossen (2021): rates of roll, pitch and yaw.
            tan, cos = np.tan(eta[4]), np.cos(eta[4])
            sin_phi, cos_phi = np.sin(eta[3]), np.cos(eta[3])
            rows = [
                [1, sin_phi * tan, cos_phi * tan],
                [0, cos_phi, -sin_phi],
                [0, sin_phi / cos, cos_phi / cos],
            ]
            moved = np.append(turned.apply(nu[:3]), np.array(rows) @ nu[3:])
            nu, thrust = rov.dynamics(eta, nu, thrust, command, dt)
            eta = eta + dt * moved
    # Euler's method at a millisecond.
    assert np.abs(np.array(places) - track).max() < 5e-3


# Runge-Kutta's method at a hundredth of a second, with a command for every twentieth. It begins, as
# `simulate` does, with the thrusts that the first command asks for.
_OCTAVE = """
commands = dlmread('commands.csv'); x = dlmread('start.csv'); dt = 0.01; track = [];
rates = {name}(x, commands(1, :)'); x(13:end) = {lag} * rates(13:end);
for k = 1:rows(commands)
    track(k, :) = [x(7:12); x(1:6)]';
    for i = 1:5
        a = {name}(x, commands(k, :)', 0, 0);
        b = {name}(x + dt / 2 * a, commands(k, :)', 0, 0);
        c = {name}(x + dt / 2 * b, commands(k, :)', 0, 0);
        x = x + dt / 6 * (a + 2 * b + 2 * c + {name}(x + dt * c, commands(k, :)'));
    end
end
dlmwrite('track.csv', track, 'precision', '%.12g');
"""


@pytest.mark.skipif(shutil.which("octave-cli") is None, reason="Octave, which runs it, is not installed")
@pytest.mark.parametrize("name", ["forgetful", pytest.param("simple", marks=pytest.mark.slow)])
def test_the_function_for_mss_moves_as_simulate(name, tmp_path):
    vehicle, commands, start, track = driven(name)
    notes = export(vehicle, tmp_path / "rov.m", "mss")
    written = (tmp_path / "rov.m").read_text(encoding="utf-8")
    assert all(note in written for note in notes)
    lag = np.asarray(vehicle.plant().drive.lag)
    np.savetxt(tmp_path / "commands.csv", commands, delimiter=",")
    np.savetxt(tmp_path / "start.csv", [*start[6:], *start[:6], *np.zeros(np.sum(lag > 0))])
    script = ["octave-cli", "--norc", "--quiet", "--eval", _OCTAVE.format(name="rov", lag=lag.max())]
    subprocess.run(script, cwd=tmp_path, check=True, capture_output=True, timeout=60)
    moved = np.loadtxt(tmp_path / "track.csv", delimiter=",")
    # `simulate` takes five times longer steps, whose error this is.
    assert np.abs(moved - track).max() < 2e-5


def test_a_function_of_matlab_needs_a_name_that_can_be_called(tmp_path):
    for name in ("my-rov.m", "2nd.m", "rov.txt"):
        with pytest.raises(InputError, match="Matlab calls a function by its file"):
            export(packaged("tethra"), tmp_path / name, "mss")


def test_plain_parameters_say_what_they_lack(tmp_path):
    said = " ".join(export(packaged("kvlcc2"), tmp_path / "ship.py", "pvs"))
    assert "Propellers are left out: prop" in said and "Control surfaces" in said
    said = " ".join(export(remembering(), tmp_path / "rov.py", "pvs"))
    assert "Fluid memory acts at once" in said and "left out: `mlp_damping`" in said
    assert "takes no thrust, as `advance_loss` has it" in said and "are left out: surge_drag." in said


def simple() -> Vehicle:
    """An ROV with what Gazebo holds: a payload, and damping and added mass between axes."""
    vehicle = packaged("tethra")
    joins = np.zeros((6, 6))
    joins[1, 5], joins[5, 1], joins[4, 2] = 3.0, -2.0, 1.5
    payload = Payload(*(jnp.asarray(one) for one in (5.0, 0.004, 0.2, 0.1, -0.1)))
    pair = CoupledAddedMass(jnp.asarray([0.0, 4.0, 0.0, 0.0, 3.0, 0.0]))
    return vehicle.place(*map(Placed, (payload, pair, CoupledDamping(jnp.asarray(joins)))))


def gazebo(root: ET.Element):
    """The acceleration of the hull by the documentation of SDF 1.11 and of Gazebo's plug-ins.

    Forward-left-up, at the link's origin. Hydrodynamics: forces `xU` U and `xUabsU` |U| U, as they stand. The
    engine has body and `fluid_added_mass` as one spatial inertia. Buoyancy: the weight of displaced water at
    the collision's centre. Thruster: what it is told, along the joint's axis, at the rotor.
    """

    def numbers(path: str, of: ET.Element = root) -> np.ndarray:
        return np.array([float(one) for one in str(of.findtext(path)).split()])

    def skew(a: np.ndarray) -> np.ndarray:
        return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])

    inertial = root.find(".//link[@name='base_link']/inertial")
    water = root.find(".//plugin[@name='gz::sim::systems::Hydrodynamics']")
    assert inertial is not None and water is not None
    mass, cog = numbers("mass", inertial)[0], numbers("pose", inertial)[:3]
    whole, added = np.zeros((6, 6)), np.zeros((6, 6))
    for i, j in itertools.combinations_with_replacement(range(3), 2):
        whole[3 + i, 3 + j] = whole[3 + j, 3 + i] = numbers(f"inertia/i{'xyz'[i]}{'xyz'[j]}", inertial)[0]
    for i, j in itertools.combinations_with_replacement(range(6), 2):
        entry = numbers(f"fluid_added_mass/{'xyzpqr'[i]}{'xyzpqr'[j]}", inertial)[0]
        added[i, j] = added[j, i] = entry
    whole[:3, :3], whole[:3, 3:], whole[3:, :3] = mass * np.eye(3), -mass * skew(cog), mass * skew(cog)
    whole[3:, 3:] += -mass * skew(cog) @ skew(cog)
    whole += added
    assert water.findtext("disable_added_mass") == water.findtext("disable_coriolis") == "true"
    gravity, density = numbers(".//gravity"), numbers(".//uniform_fluid_density")[0]
    volume = 4 / 3 * np.pi * numbers(".//sphere/radius")[0] ** 3
    centre = numbers(".//collision/pose")[:3]
    thrusters = []
    for plugin in root.findall(".//plugin[@name='gz::sim::systems::Thruster']"):
        joint = root.find(f".//joint[@name='{plugin.findtext('joint_name')}']")
        assert joint is not None
        place = numbers(f".//link[@name='{joint.findtext('child')}']/pose")[:3]
        axis = numbers("axis/xyz", joint)
        thrusters.append(np.append(axis, np.cross(place, axis)))

    def acceleration(turn: np.ndarray, nu: np.ndarray, thrusts: np.ndarray) -> np.ndarray:
        wrench = np.array(thrusters).T @ thrusts
        for element in water:
            if element.tag[0] in "xyzkmn" and element.tag[1:2].isupper():
                i, j = "xyzkmn".index(element.tag[0]), "UVWPQR".index(element.tag[1])
                speed = nu[j] * np.abs(nu[j]) if "abs" in element.tag else nu[j]
                wrench[i] += float(str(element.text)) * speed
        down = turn.T @ gravity
        wrench[:3] += (mass - density * volume) * down
        wrench[3:] += np.cross(mass * cog - density * volume * centre, down)
        a, b = np.split(whole @ nu, 2)
        v, w = np.split(nu, 2)
        spin = np.append(np.cross(w, a), np.cross(v, a) + np.cross(w, b))
        return np.linalg.solve(whole, wrench - spin)

    return acceleration


def test_the_world_for_gazebo_moves_by_its_documentation_as_simulate(tmp_path):
    vehicle, commands, start, track = driven("simple")
    notes = export(vehicle, tmp_path / "rov.sdf", "sdf")
    written = (tmp_path / "rov.sdf").read_text(encoding="utf-8")
    assert all(note in written for note in notes)
    acceleration = gazebo(ET.fromstring(written))
    flip = np.array([1.0, -1.0, -1.0])
    turn = flip[:, None] * Rotation.from_euler("ZYX", start[5:2:-1]).as_matrix() * flip
    state = np.concatenate([flip * start[:3], turn.ravel(), np.tile(flip, 1) * start[6:9], flip * start[9:]])
    most = np.asarray(vehicle.thrusters.max_thrust)

    def rates(t: float, y: np.ndarray, thrusts: np.ndarray) -> np.ndarray:
        turn, nu = y[3:12].reshape(3, 3), y[12:]
        p, q, r = nu[3:]
        spun = turn @ np.array([[0, -r, q], [r, 0, -p], [-q, p, 0]])
        return np.concatenate([turn @ nu[:3], spun.ravel(), acceleration(turn, nu, thrusts)])

    places = []
    # One command holds for twenty samples.
    for command in commands[::20]:
        run = solve_ivp(rates, (0.0, 20 * T[1]), state, args=(most * command,), rtol=1e-8, atol=1e-10)
        places.append(np.concatenate([flip * state[:3], flip * state[12:15], flip * state[15:]]))
        state = run.y[:, -1]
    # The error of steps of `simulate`.
    assert np.abs(np.array(places) - track[::20][:, [0, 1, 2, 6, 7, 8, 9, 10, 11]]).max() < 1e-5


def finned() -> Vehicle:
    """An ROV with a rudder, a plane that is weak and off and sees half of the flow, a skeg, and two stuck."""
    hull = HullTable(straightening=(0.5, 0.5))
    tables = [
        SurfaceTable(
            name="rudder", position=(-0.6, 0.02, 0.1), axis=(0.0, 0.0, -1.0), area=0.02, lift_slope=2.5,
            max_angle=0.5,
        ),
        SurfaceTable(
            name="plane", position=(-0.5, 0.2, 0.0), axis=(0.0, 1.0, 0.2), area=0.03, aspect_ratio=2.0,
            hull=hull,
        ),
        SurfaceTable(
            name="skeg", position=(-0.7, 0.0, -0.1), axis=(0.0, 0.3, 1.0), area=0.01, lift_slope=2.0,
            fixed=True,
        ),
        SurfaceTable(
            name="stuck", position=(0.4, -0.2, 0.0), axis=(0.0, 1.0, 0.0), area=0.01, lift_slope=3.0
        ),
        SurfaceTable(
            name="skew", position=(0.3, 0.1, 0.0), axis=(0.0, 0.0, 1.0), area=0.01, lift_slope=3.0,
            hull=HullTable(straightening=(0.0, 0.0)),
        ),
    ]  # fmt: skip
    vehicle = dataclasses.replace(packaged("tethra"), actuators=(Surfaces.of(tables),))
    causes = [
        ("surface_gain", "plane", {"factor": 0.5}),
        ("surface_offset", "plane", {"angle": 0.01}),
        ("surface_stuck", "stuck", {"angle": -0.015}),
        ("surface_stuck", "skew", {"angle": 0.03}),
    ]
    placed = [
        Placed(place(suspect_named(vehicle, effect, target), vehicle, values), target)
        for effect, target, values in causes
    ]
    return vehicle.place(*placed)


def lifted(root: ET.Element, nu: np.ndarray, angles: dict[str, float]) -> np.ndarray:
    """The wrench of all plug-ins LiftDrag by their documentation: forward-left-up, at the link's origin.

    The angle of attack, to which `a0` adds, lies between `forward` and the part of the velocity at `cp` that
    is in the plane of `forward` and `upward`. cl is `cla` times it, times the square of the cosine of the
    sweep, and `control_joint_rad_to_cl` times the joint's angle; the lift, at right angles to that part, is
    cl times the dynamic pressure times `area`. Turned by more than a right angle, a `reversible` one meets
    the flow with its other edge.
    """
    out = np.zeros(6)
    for plugin in root.findall(".//plugin[@name='gz::sim::systems::LiftDrag']"):

        def read(tag: str, plugin=plugin) -> np.ndarray:
            return np.array([float(one) for one in str(plugin.findtext(tag)).split()])

        assert plugin.findtext("link_name") == "base_link" and plugin.findtext("reversible") == "true"
        forward, upward, cp = read("forward"), read("upward"), read("cp")
        velocity = nu[:3] + np.cross(nu[3:], cp)
        span = np.cross(forward, upward)
        sweep = span @ velocity / np.linalg.norm(velocity)
        part = velocity - (velocity @ span) * span
        lift = np.cross(span, part) / np.linalg.norm(part)
        turn = np.arccos(np.clip(lift @ upward, -1.0, 1.0))
        attack = read("a0")[0] + (turn if lift @ forward >= 0.0 else -turn)
        attack = (attack + np.pi / 2) % np.pi - np.pi / 2
        cl = read("cla")[0] * attack * (1.0 - sweep**2)
        joint = plugin.findtext("control_joint_name")
        if joint is not None:
            about = root.find(f".//joint[@name='{joint}']")
            assert about is not None and about.findtext("parent") == "base_link"
            axis = [float(one) for one in str(about.findtext("axis/xyz")).split()]
            # Turned right-handed about it the leading edge goes the way of the lift.
            np.testing.assert_allclose(np.cross(axis, forward), upward, atol=1e-12)
            low, high = (float(str(about.findtext(f"axis/limit/{end}"))) for end in ("lower", "upper"))
            cl += read("control_joint_rad_to_cl")[0] * np.clip(angles[joint], low, high)
        force = 0.5 * read("air_density")[0] * (part @ part) * read("area")[0] * cl * lift
        out += np.append(force, np.cross(cp, force))
    return out


@pytest.mark.parametrize("ahead", [1.5, -1.5])
def test_surfaces_lift_in_gazebo_as_in_the_file_at_small_angles(tmp_path, ahead):
    vehicle, rng = finned(), np.random.default_rng(5)
    notes = " ".join(export(vehicle, tmp_path / "rov.sdf", "sdf"))
    assert "without drag" in notes and "Control surfaces are left out" not in notes
    root = ET.parse(tmp_path / "rov.sdf").getroot()
    flip = np.array([1.0, -1.0, -1.0] * 2)
    (surfaces,) = vehicle.plant().actuators
    aside, angles = rng.normal(size=6) * [0.0, 1.0, 1.0, 1.0, 1.0, 1.0], rng.normal(size=4)

    def wrenches(small: float) -> tuple[np.ndarray, np.ndarray]:
        nu, state = small * aside, small * angles
        nu[0] = ahead
        still = jnp.zeros(4)
        flow = Flow(jnp.asarray(nu), vehicle.density, jnp.asarray(nu), jnp.eye(3), still, {})
        joints = {f"{name}_joint": float(a) for name, a in zip(surfaces.columns, state, strict=True)}
        return np.asarray(surfaces.wrench(jnp.asarray(state), flow)), flip * lifted(root, flip * nu, joints)

    # What stands off anyway is small: an offset of 0.01, those that are stuck at -0.015 and 0.03 rad.
    for small in (0.02, 0.01):
        ours, theirs = wrenches(small)
        lift = np.abs(ours[1:3]).max()
        # Angles of up to 0.04 rad: lift is the same to their square, and drag, which turns the hull by arms
        # of 0.2 m, is of one order more.
        off = np.abs(ours - theirs)
        assert off[1:3].max() < 2e-3 * lift and off[0] < 0.05 * lift and off[3:].max() < 0.2 * 0.05 * lift
    joint = root.find(".//joint[@name='rudder_joint']/axis/limit")
    assert joint is not None and (joint.findtext("lower"), joint.findtext("upper")) == ("-0.5", "0.5")
    drivers = root.findall(".//plugin[@name='gz::sim::systems::JointPositionController']")
    assert [(one.findtext("joint_name"), one.findtext("initial_position")) for one in drivers] == [
        ("rudder_joint", None), ("plane_joint", None), ("stuck_joint", "-0.015"), ("skew_joint", "0.03"),
    ]  # fmt: skip


def test_gazebo_says_what_surfaces_lose(tmp_path):
    notes = " ".join(export(packaged("remus100"), tmp_path / "auv.sdf", "sdf"))
    assert "Propellers are left out" in notes and "without drag" in notes and "`hull`" not in notes
    hull = HullTable(straightening=(0.4, 0.6), lift_increase=0.3)
    behind = SurfaceTable(
        name="rudder",
        position=(-0.6, 0, 0),
        axis=(0, 0, -1),
        area=0.02,
        lift_slope=2.5,
        behind="p",
        hull=hull,
    )
    vehicle = dataclasses.replace(packaged("tethra"), actuators=(Surfaces.of([behind]),))
    off = place(suspect_named(vehicle, "surface_offset", "rudder"), vehicle, {"angle": 0.5})
    vehicle = vehicle.place(Placed(off, "rudder"))
    notes = " ".join(export(vehicle, tmp_path / "rov.sdf", "sdf"))
    assert "not a propeller's stream" in notes and "(`hull`)" in notes
    # Of half a radian on what sees half of the flow it would take the flow to come from behind.
    assert "offset of surfaces is left out: rudder" in notes


def test_gazebo_has_no_locked_axes(tmp_path):
    with pytest.raises(InputError, match="locked in heave"):
        export(packaged("kvlcc2"), tmp_path / "ship.sdf", "sdf")


@pytest.mark.slow
def test_every_effect_of_the_catalogue_is_written_as_expressions():
    vehicle = packaged("tethra")
    names, rng = vehicle.thruster_names, np.random.default_rng(0)
    for effect in CATALOGUE:
        for suspect in effect.suspects(vehicle)[:1]:
            values = dict.fromkeys(suspect.slots, 0.05)
            vehicle = vehicle.place(Placed(place(suspect, vehicle, values), suspect.target))
    wrench = learned_wrench("heave", ("w", "q"), names, -np.ones(2), np.ones(2), 5.0, jax.random.key(1))
    speeds = rng.normal(size=(40, 2))
    steady = rbf_damping(("surge", "yaw"), speeds, speeds * np.abs(speeds), np.zeros(40, int), 5)
    for term in (wrench, steady, learned_thrust(names, -np.ones(4), np.ones(4))):
        noise = jax.tree.map(lambda a: a + 0.1 * rng.normal(size=a.shape), term)
        vehicle = vehicle.place(Placed(noise))
    model, made = functions(vehicle)
    state = rng.normal(size=len(model.state_names))
    state[3:7] = 0.9, 0.1, -0.3, 0.3
    state[3:7] /= np.linalg.norm(state[3:7])
    given = (state, rng.uniform(-0.8, 0.8, len(names)), rng.normal(size=6), 1.3)
    exact = np.asarray(jax.jit(lambda *a: model.rates(*a))(*map(jnp.asarray, given)))
    assert np.allclose(made["rates"](*given).full().ravel(), exact, rtol=1e-9, atol=1e-9)
