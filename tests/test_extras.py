"""Without extras the package simulates, fits and diagnoses; one sentence names an extra that is missing."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import version

import pytest

import jaxmarine as jm

from .conftest import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# How a package is imported, where its name does not tell.
IMPORTED = {"tomli-w": "tomli_w", "mkdocstrings[python]": "mkdocstrings"}


def packages(requirements: list[str]) -> set[str]:
    """What some requirements are imported as."""
    names = (re.split(r"[<>=]", one)[0] for one in requirements)
    return {IMPORTED.get(name, name.replace("-", "_")) for name in names if not name.startswith("jaxmarine")}


EXTRAS = {name: packages(requirements) for name, requirements in PROJECT["optional-dependencies"].items()}
OPTIONAL = set().union(*EXTRAS.values())


def child(code: str, missing: set[str]) -> subprocess.CompletedProcess[str]:
    """A Python of its own, to which some packages are not installed."""
    blocked = f"import sys\nsys.modules.update(dict.fromkeys({sorted(missing)}))\n"
    return subprocess.run([sys.executable, "-c", blocked + code], capture_output=True, text=True, timeout=600)


IN_MEMORY = """
import jax
import numpy as np
import jaxmarine as jm
from jaxmarine.examples import operator, recorded

jax.config.update("jax_enable_x64", True)
vehicle = jm.load_vehicle(jm.packaged_vehicle("cybership2"))
t = np.arange(0.0, {seconds}, 0.1)
"""
CORE = (
    IN_MEMORY.format(seconds=2.0)
    + """
commands = np.full((len(t), len(vehicle.command_names)), 0.1)
log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "made")
track = jm.simulate(vehicle, log, jm.initial_state(vehicle))
assert track["x"][-1] > 0
jm.save_vehicle(vehicle, PATH)
assert jm.load_vehicle(PATH).name == vehicle.name
print(jm.__version__, jm.fit.__name__, jm.check.__name__, jm.diagnose.__name__, jm.control.follow.__name__)
"""
)
WHOLE = (
    IN_MEMORY.format(seconds=60.0)
    + """
log = recorded(vehicle, operator(3, t, seed=1), t, seed=2, name="made")
train, test = log.split(at=40.0)
print(jm.fit(vehicle, train, free=lambda v: v.damping.linear, entries="diagonal").result)
print(jm.diagnose(vehicle, train, test).verdict)
"""
)


def test_the_core_needs_no_extra(tmp_path):
    done = child(CORE.replace("PATH", repr(str(tmp_path / "vehicle.toml"))), OPTIONAL)
    assert done.stdout == f"{version('jaxmarine')} fit check diagnose follow\n", done.stderr


@pytest.mark.slow
def test_a_fit_and_a_diagnosis_need_no_extra():
    done = child(WHOLE, OPTIONAL)
    assert done.stdout == "converged\nnothing_found\n", done.stderr


def sentence(what: str, package: str, extra: str) -> str:
    return (
        f"{what} needs the package {package}, which is not installed; run `pip install 'jaxmarine[{extra}]'`."
    )


@pytest.mark.parametrize(
    ("name", "package", "what", "extra"),
    [
        ("read_log", "pandas", "A log in a file", "files"),
        ("write_log", "pyarrow", "A log in a file", "files"),
        ("logs.read_table", "pandas", "A log in a file", "files"),
        ("write_report", "jinja2", "A report", "report"),
        ("reports", "matplotlib", "A report", "report"),
        ("fleet", "pandas", "A fleet", "fleet"),
    ],
)
def test_python_names_the_extra_that_is_missing(name, package, what, extra):
    done = child(
        f"import jaxmarine\ntry:\n    jaxmarine.{name}\nexcept ImportError as e:\n    print(e)", {package}
    )
    assert done.stdout == sentence(what, package, extra) + "\n", done.stderr
    assert package in EXTRAS[extra] or extra == "fleet"


@pytest.mark.parametrize(
    ("package", "what", "extra"),
    [
        ("typer", "The command line", "cli"),
        ("rich", "The command line", "cli"),
        ("pandas", "A log in a file", "files"),
        ("jinja2", "A report", "report"),
    ],
)
def test_the_command_line_names_the_extra_that_is_missing(tmp_path, package, what, extra):
    """Before the work, not after it."""
    words = ["jaxmarine", "demo", "--out", str(tmp_path / "report")]
    done = child(f"sys.argv = {words}\nfrom jaxmarine.__main__ import main\nmain()", {package})
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == sentence(what, package, extra) + "\n"
    assert not list(tmp_path.iterdir())


def test_the_version_is_one():
    done = child("import jaxmarine; print(jaxmarine.__version__, 'jax' in sys.modules)", set())
    assert done.stdout == f"{version('jaxmarine')} False\n"
    assert PROJECT["version"] == jm.__version__ == version("jaxmarine")
