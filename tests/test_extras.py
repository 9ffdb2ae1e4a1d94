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


# The package anew for each case, without one that it needs; all others are imported once: that takes seconds.
EACH = """
def act(case):
    ...


for package, case in CASES:
    for name in [name for name in sys.modules if name.partition(".")[0] == "jaxmarine"]:
        del sys.modules[name]
    known = sys.modules.pop(package, None)
    sys.modules[package] = None
    act(case)
    if known is None:
        del sys.modules[package]
    else:
        sys.modules[package] = known
"""


def each(act: str, cases: list[tuple[str, str]]) -> subprocess.CompletedProcess[str]:
    """A Python that acts on each case, (missing package, what), by the body of `act(case)`."""
    return child(EACH.replace("...", act.strip()).replace("CASES", repr(cases)), set())


def test_python_names_the_extra_that_is_missing():
    cases = [
        ("read_log", "pandas", "A log in a file", "files"),
        ("write_log", "pyarrow", "A log in a file", "files"),
        ("logs.read_table", "pandas", "A log in a file", "files"),
        ("write_report", "jinja2", "A report", "report"),
        ("reports", "matplotlib", "A report", "report"),
        ("fleet", "pandas", "A fleet", "fleet"),
    ]
    act = """
    import functools
    import jaxmarine
    try:
        functools.reduce(getattr, case.split("."), jaxmarine)
    except ImportError as error:
        print(error)
    """
    done = each(act, [(package, name) for name, package, _, _ in cases])
    told = [sentence(what, package, extra) for _, package, what, extra in cases]
    assert done.stdout.splitlines() == told, done.stderr
    assert all(package in EXTRAS[extra] or extra == "fleet" for _, package, _, extra in cases)


def test_the_command_line_names_the_extra_that_is_missing(tmp_path):
    """Before the work, not after it."""
    cases = [
        ("typer", "The command line", "cli"),
        ("rich", "The command line", "cli"),
        ("pandas", "A log in a file", "files"),
        ("jinja2", "A report", "report"),
    ]
    act = """
    sys.argv = ["jaxmarine", "demo", "--out", case]
    from jaxmarine.__main__ import main
    try:
        main()
    except SystemExit as end:
        print(end.code)
    """
    done = each(act, [(package, str(tmp_path / "report")) for package, _, _ in cases])
    assert done.stdout.split() == ["2"] * len(cases)
    assert done.stderr.splitlines() == [sentence(what, package, extra) for package, what, extra in cases]
    assert not list(tmp_path.iterdir())


def test_the_version_is_one():
    done = child("import jaxmarine; print(jaxmarine.__version__, 'jax' in sys.modules)", set())
    assert done.stdout == f"{version('jaxmarine')} False\n"
    assert PROJECT["version"] == jm.__version__ == version("jaxmarine")
