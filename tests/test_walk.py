"""What the pages show is so: their Python runs as written, their tables are those of the code."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmarine as jm
from docs import hooks
from jaxmarine.effects import place
from jaxmarine.logs import _sources
from jaxmarine.vehicle import Input
from jaxmarine.vehicle_file import AddedMass, Body, Damping, Environment, Sensors, Thruster

from .conftest import ROOT


def page(name: str) -> str:
    return (ROOT / name).read_text()


def blocks(language: str, name: str) -> list[str]:
    """A page's blocks of code in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page(name), re.MULTILINE | re.DOTALL)


def run(text: str, after: dict | None = None) -> dict:
    """The names that a block of code leaves, `after` those of the one before it."""
    names = after or {"__name__": "walk"}
    exec(compile(text, "walk", "exec"), names)
    return names


# Numbers to two of the printed digits, which other processors keep.
NUMBER = r"-?\d+\.\d+"


def agrees(printed: str, promised: str) -> None:
    """The same words, and numbers to some digits."""
    assert re.sub(NUMBER, "#", printed) == re.sub(NUMBER, "#", promised)
    told = [[float(x) for x in re.findall(NUMBER, text)] for text in (printed, promised)]
    np.testing.assert_allclose(told[0], told[1], rtol=0.05, atol=2e-3)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    # A recipe adds a reader, which is none of the other tests.
    monkeypatch.setattr(_sources, "RECORDINGS", dict(_sources.RECORDINGS))
    return tmp_path


def test_the_steps_of_a_diagnosis_name_its_modules():
    steps = page("docs/diagnosis.md").partition("## Diagnosis, step by step")[2].partition("\n## ")[0]
    modules = {path.name for path in (ROOT / "jaxmarine" / "diagnosis").glob("_[a-z]*.py")}
    # What the answer consists of, and how a plan is made, are no steps of a diagnosis.
    told = set(re.findall(r"`(_\w+\.py)`", steps)) | {"_result.py", "_plan.py"}
    assert modules == told


def test_the_walk_runs_as_written_and_prints_what_it_says(folder, capsys, monkeypatch):
    walk, after = blocks("python", "docs/getting-started.md")
    names = run(walk)
    agrees(capsys.readouterr().out, blocks("text", "docs/getting-started.md")[0])

    (finding,) = names["diagnosis"].findings
    assert finding.label == "thruster_gain:port_h"
    factor = finding.parameters["factor"]
    assert abs(factor.value - 0.72) < 3 * factor.std
    assert names["fit"].reduced_chi2 > 3.0  # no damping can stand in for the thruster
    (placed,) = jm.load_vehicle(folder / "extended.toml").placed
    assert float(placed.effect.parameters()["factor"][1]) == factor.value
    assert {"index.html", "diagnosis.json", "figures"} <= set(os.listdir(folder / "report"))

    run(after, names)
    vehicle, state, wrench = (names[name] for name in ("vehicle", "state", "wrench"))
    assert float(names["track"]["u"][0]) == 0.2
    drive = Input(jnp.zeros(4), jnp.zeros(4), wrench, jnp.asarray(0.0))
    np.testing.assert_allclose(jm.forward_dynamics(vehicle, state, drive), 0.0, atol=1e-12)
    # The thrusters cannot make all of it: what is missing is none that any of them pushes along.
    pushes = np.asarray(vehicle.plant().allocation)
    made = pushes @ (names["commands"] * vehicle.thrusters.max_thrust)
    np.testing.assert_allclose(pushes.T @ (made - wrench), 0.0, atol=1e-9)

    figure = extended(3)["heading_errors"](names["diagnosis"])
    before, after = (max(np.abs(line.get_ydata()).max() for line in ax.lines) for ax in figure.axes)
    assert after < 0.5 * before  # of the heading, which a weak port thruster turns

    # The README has the same walk with less on the way: the diagnosis of the same logs is not made twice.
    def diagnosed(vehicle, train, held_out):
        assert eqx.tree_equal(vehicle, names["vehicle"])
        for given, before in ((train, names["train"]), (held_out, names["held_out"])):
            np.testing.assert_array_equal(given.t, before.t)
            np.testing.assert_array_equal(given.channels, before.channels)
        return names["diagnosis"]

    monkeypatch.setattr(jm, "diagnose", diagnosed)
    (folder / "extended.toml").unlink()
    capsys.readouterr()
    (short,) = blocks("python", "README.md")
    run(short)
    agrees(capsys.readouterr().out, blocks("text", "README.md")[0])
    assert (folder / "extended.toml").exists()


def extended(recipe: int) -> dict:
    """The names after recipes of the page: an effect (0), an actuator, a reader and a figure of one's own."""
    names = {"__name__": "recipes"}
    for text in blocks("python", "docs/extending.md")[: recipe + 1]:
        run(text, names)
    return names


def test_an_effect_of_ones_own_is_suspected_and_acts(folder):
    names = extended(0)
    cubic = names["CubicDrag"]
    assert names["catalogue"] == (*jm.CATALOGUE, cubic)
    craft = jm.load_vehicle(jm.packaged_vehicle("cybership2"))
    (suspect,) = cubic.suspects(craft)
    assert set(suspect.slots) == set(cubic.units)

    still = jm.initial_state(craft, velocity=(1.5, 0, 0, 0, 0, 0))
    count = len(craft.thruster_names)
    t = np.arange(0.0, 2.0, 0.1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), np.zeros((len(t), count)), None, craft.thruster_names, "-")

    def speed(coefficient: float):
        effect = place(suspect, craft, {"coefficient": coefficient})
        return jm.simulate(craft.place(jm.Placed(effect)), log, still)["u"]

    assert jnp.array_equal(speed(0.0), jm.simulate(craft, log, still)["u"])  # neutral
    assert jnp.all(speed(2.0)[1:] < speed(0.0)[1:])
    # It is written, and read again where the reader is told of it.
    effect = place(suspect, craft, {"coefficient": 2.0})
    jm.save_vehicle(craft.place(jm.Placed(effect)), folder / "own.toml")
    again = jm.load_vehicle(folder / "own.toml", names["catalogue"])
    assert jnp.array_equal(jm.simulate(again, log, still)["u"], speed(2.0))


def test_an_actuator_of_ones_own_brakes(folder):
    names = extended(1)
    boat, *_ = (text for text in blocks("toml", "docs/files.md") if text.startswith("schema"))
    (flap,) = blocks("toml", "docs/extending.md")
    Path("boat.toml").write_text(f"{boat}\n{flap}")
    craft = jm.load_vehicle("boat.toml", kinds=names["KINDS"] + (names["Flaps"],))
    assert craft.command_names == ("port", "starboard", "brake")
    t = np.arange(0.0, 30.0, 0.1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), np.ones((len(t), 3)), None, craft.command_names, "-")
    run = jm.simulate(craft, log, jm.initial_state(craft))
    # In the end 80 N of thrust meet 20 u + (75 + 40) u² of drag.
    assert float(run["u"][-1]) == pytest.approx((-20 + (20**2 + 4 * 115 * 80) ** 0.5) / 230, rel=1e-3)


def test_a_watch_in_python_is_told_rows_as_the_page_shows(capsys):
    (text,) = blocks("python", "docs/live.md")
    craft = jm.load_vehicle(jm.packaged_vehicle("cybership2"))
    still = {"x": 0.0, "y": 0.0, "psi": 0.1} | dict.fromkeys(craft.command_names, 0.0)
    rows = [still | {"t": t} for t in (0.0, 0.1, 0.1, 0.2)]
    left = run(text, {"vehicle": craft, "rows": rows})
    # A time that comes twice is left out, and said.
    assert "0.1 s" in capsys.readouterr().out and left["watch"].named == ()
    assert left["watch"].extended == craft


# Of a package with one more line in the table of sensors.
ONE_MORE = """
import jax, numpy as np
from scipy.spatial.transform import Rotation
jax.config.update("jax_enable_x64", True)
import jaxmarine as jm
text = jm.packaged_vehicle("tethra").read_text()
open("rov.toml", "w").write(text.replace("[sensors]", "[sensors]\\nmagnetic_field = 0.3"))
rov = jm.load_vehicle("rov.toml")
assert dict(rov.sensors)["magnetic_field"] == 0.3
t = np.arange(0.0, 2.0, 0.1)
commands = np.tile([0.3, -0.3, 0.1, 0.2], (len(t), 1))
blank = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, rov.command_names, "-")
start = jm.initial_state(rov, attitude=(0.1, -0.2, 0.7))
run = jm.simulate(rov, blank, start, sensors=("magnetic_field",))
shown = ("x", "y", "z", "phi", "theta", "psi", "bx", "by", "bz")
table = {"t": t} | {name: run[name] for name in shown}
table |= dict(zip(rov.command_names, commands.T))
import pandas
log = jm.read_log(pandas.DataFrame(table), rov)
turned = Rotation.from_euler("ZYX", np.array([run[name] for name in ("psi", "theta", "phi")]).T)
from jaxmarine._types import ALL_CHANNELS
seen = log.channels[:, [ALL_CHANNELS.index(name) for name in ("bx", "by", "bz")]]
np.testing.assert_allclose(seen, turned.inv().apply([18.0, 0.0, 46.0]), atol=1e-9)
assert np.ptp(seen[:, 0]) > 0.1
"""


@pytest.mark.slow
def test_a_sensor_of_ones_own_is_one_line_of_a_table(tmp_path):
    (line,) = blocks("py", "docs/extending.md")
    shutil.copytree(ROOT / "jaxmarine", tmp_path / "jaxmarine", ignore=shutil.ignore_patterns("__pycache__"))
    types = tmp_path / "jaxmarine" / "_types.py"
    before, head, after = types.read_text().partition("\nTABLE = (\n")
    inside, end, after = after.partition("\n)\n")
    types.write_text(before + head + inside + f"\n{line.rstrip()}," + end + after, encoding="utf-8")
    subprocess.run([sys.executable, "-c", ONE_MORE], cwd=tmp_path, check=True)


def test_a_reader_of_ones_own_reads(folder):
    names = extended(2)
    assert _sources.RECORDINGS[".lines"] is names["Lines"]
    boat, *_ = (text for text in blocks("toml", "docs/files.md") if text.startswith("schema"))
    Path("boat.toml").write_text(boat)
    craft = jm.load_vehicle("boat.toml")
    t = np.arange(0.0, 30.0, 0.1)
    speed = {"ahead": 1.0 + 0.5 * np.sin(t), "aside": 0.1 * np.cos(t), "turn": 10.0 * np.sin(0.5 * t)}
    series = speed | {"left": 0.5 + 0.0 * t, "right": -0.5 + 0.0 * t}
    lines = [
        f"{ti} {name} {value}" for name, values in series.items() for ti, value in zip(t, values, strict=True)
    ]
    Path("run.lines").write_text("\n".join(lines))
    columns = {"u": "ahead", "v": "aside", "port": "left", "starboard": "right"}
    wanted = "\n".join(f'{name} = "{path}"' for name, path in columns.items())
    Path("map.toml").write_text(f'[columns]\n{wanted}\nr = {{from = "turn", unit = "deg/s"}}\n')
    log = jm.read_log("run.lines", craft, "map.toml")
    u, v, r = (log.channels[:, i] for i in (6, 7, 11))
    np.testing.assert_allclose(u, speed["ahead"], atol=1e-9)
    np.testing.assert_allclose(v, speed["aside"], atol=1e-9)
    np.testing.assert_allclose(r, np.deg2rad(speed["turn"]), atol=1e-9)
    Path("map.toml").write_text('[columns]\nu = "astern"\n')
    with pytest.raises(jm.InputError, match="has no `astern`; it has ahead, aside, turn, left, right"):
        jm.read_log("run.lines", craft, "map.toml")


def test_the_table_of_the_catalogue_is_that_of_the_code():
    table = hooks.table()
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines() if "`" in row]
    rows = [row for row in rows if len(row) == 5]
    assert [re.match(r"\[`(\w+)`\]", row[1])[1] for row in rows] == [effect.name for effect in jm.CATALOGUE]
    for row, effect in zip(rows, jm.CATALOGUE, strict=True):
        assert set(re.findall(r"`(\w+)`", row[3])) == set(effect.units), effect.name
        units = set(re.findall(r"\[([^]]+)\]", row[3]))
        assert units == set(effect.units.values()), effect.name
        assert re.findall(r"`([^`]+)`", row[4]) == list(effect.confused_with), effect.name


def test_the_room_list_names_what_is_there():
    rooms = page("docs/extending.md").split("jaxmarine/\n", 1)[1].split("```")[0]
    named = set(re.findall(r"\b(\w+\.py|\w+/)", rooms))
    there = {path.name for path in (ROOT / "jaxmarine").glob("*.py")}
    there |= {f"{path.name}/" for path in (ROOT / "jaxmarine").iterdir() if path.is_dir()}
    assert there - {"__pycache__/"} <= named
    vehicles = {path.stem for path in (ROOT / "jaxmarine" / "vehicles").glob("*.toml")}
    assert all(name in rooms for name in vehicles)


def test_the_vehicle_of_the_page_drives_ahead_under_equal_commands(folder):
    Path("boat.toml").write_text(
        next(text for text in blocks("toml", "docs/files.md") if text.startswith("schema"))
    )
    boat = jm.load_vehicle("boat.toml")
    t = np.arange(0.0, 20.0, 0.1)
    log = jm.Log(t, np.full((len(t), 18), np.nan), np.ones((len(t), 2)), None, boat.thruster_names, "-")
    run = jm.simulate(boat, log, jm.initial_state(boat))
    # In the end 80 N of thrust meet 20 u + 75 u² of drag.
    assert float(run["u"][-1]) == pytest.approx((-20 + (20**2 + 4 * 75 * 80) ** 0.5) / 150, rel=1e-3)
    assert abs(float(run["psi"][-1])) < 1e-9


def test_the_table_of_the_vehicle_file_has_every_key_and_default():
    section = page("docs/files.md").split("## Vehicle file")[1].split("What a diagnosis has found")[0]
    section = section.partition("Propellers, rudders and fins")[0]
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in section.splitlines() if row[:1] == "|"]
    keys = [(set(re.findall(r"`(\w+)`", row[0])), row[3]) for row in rows]
    top = {"schema", "name", "dof"}
    told = set().union(*(names for names, _ in keys))
    tables = (Environment, Body, AddedMass, Damping, Thruster, Sensors)
    assert told == top.union(*(table.model_fields for table in tables))
    begins = [row[0].split("`")[1] for row in rows[2:]]
    of_thrusters = keys[2:][begins.index("[[thruster]]") : begins.index("[sensors]")]
    for field, info in Thruster.model_fields.items():
        if not info.is_required():
            (default,) = [given for names, given in of_thrusters if field in names]
            if field in ("swivel", "nominal_voltage"):
                assert default == "none"
            elif info.default is None:
                assert default.strip("`") in Thruster.model_fields  # as that one
            else:
                assert float(default) == info.default
    environment = [given for names, given in keys if "density" in names]
    assert environment == [", ".join(f"{info.default:g}" for info in Environment.model_fields.values())]
