"""The command line: help with examples, one sentence for what cannot be used, files as promised."""

import _thread
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest

import jaxmarine as jm
from jaxmarine._progress import FITTING, in_round
from jaxmarine.cli import Kind, _progress, _say, _say_gain, _stoppable, _Stopped
from jaxmarine.diagnosis import BeforeAfter, Gain, LogGain
from jaxmarine.examples import DEMOS, operator, recorded
from jaxmarine.vehicle_io import cause_named

from .shell import exit_code

COMMANDS = ("diagnose", "fleet", "simulate", "fit", "check", "plan", "pool", "init", "demo")


@pytest.fixture
def jaxmarine(capsys) -> Callable[..., tuple[int, str, str]]:
    """Runs a command line in this process: exit code, stdout, stderr."""

    def run(*words: str | Path) -> tuple[int, str, str]:
        code = exit_code(*words)
        out, err = capsys.readouterr()
        return code, out, err

    return run


@pytest.fixture(scope="module")
def ship() -> jm.Vehicle:
    return jm.load_vehicle(jm.packaged_vehicle("cybership2"))


@pytest.fixture(scope="module")
def dive(ship) -> jm.Log:
    """Twenty seconds of CyberShip II under an operator, with noise."""
    t = np.arange(0.0, 20.0, 0.1)
    return recorded(ship, operator(3, t, seed=1), t, seed=2, name="dive.csv")


@pytest.fixture
def folder(tmp_path, ship, dive) -> Path:
    """A good vehicle file and a good log, to be spoilt by a test."""
    jm.save_vehicle(ship, tmp_path / "ship.toml")
    jm.write_log(dive, tmp_path / "dive.csv")
    return tmp_path


# --- help ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example(jaxmarine, command):
    code, out, err = jaxmarine(command, "--help")
    assert code == 0 and not err
    assert f"Example: jaxmarine {command} --" in " ".join(out.split())


def test_the_bare_command_lists_what_there_is(jaxmarine):
    code, out, _ = jaxmarine("--help")
    assert code == 0
    assert all(command in out for command in COMMANDS)


def test_a_shell_sees_one_sentence_and_exit_code_2(tmp_path):
    """In a process of its own, as a user's shell starts it."""
    program = [sys.executable, "-c", "from jaxmarine.cli import main; main()"]
    wrong = [*program, "simulate", "--vehicle", "nowhere.toml", "--log", "nowhere.csv"]
    done = subprocess.run(wrong, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 2 and not done.stdout
    expected = "nowhere.toml: cannot be read, because there is no such file; check the path."
    assert one_sentence(done.stderr) == expected
    assert not list(tmp_path.iterdir())


def test_compiled_programs_are_kept_in_the_users_cache(tmp_path):
    """In a process of its own, since the setting is read when JAX compiles first."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
    code = "from jaxmarine._start import prepare; prepare(); import jax; jax.jit(lambda x: x + 1)(1.0)"
    done = subprocess.run(
        [sys.executable, "-c", code], env=kept | {"XDG_CACHE_HOME": str(tmp_path)}, timeout=300
    )
    assert done.returncode == 0
    assert any((tmp_path / "jaxmarine").iterdir())


def test_the_version_is_told(jaxmarine):
    assert jaxmarine("--version") == (0, f"jaxmarine {version('jaxmarine')}\n", "")


# --- what cannot be used -------------------------------------------------------------------------


def one_sentence(err: str) -> str:
    text = err.rstrip("\n")
    assert text and "\n" not in text, err
    assert text.endswith((".", "?", ")")), err
    assert "Traceback" not in err and "Error" not in err
    return text


def call(command: str, folder: Path) -> list[str | Path]:
    """The command line with the folder's files, everything written below `out`."""
    vehicle, log, out = folder / "ship.toml", folder / "dive.csv", folder / "out"
    words: list[str | Path] = [command, "--vehicle", vehicle]
    if command == "check":
        return [*words, log]
    if command == "simulate":
        return [*words, "--log", log, "--out", folder / "out.csv"]
    if command == "fit":
        return [*words, "--train", log, "--free", "damping", "--out", folder / "out.toml"]
    return [*words, "--train", log, "--test", log, "--out", out]


def spoil_log(change: Callable[[pd.DataFrame], pd.DataFrame | None]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        table = pd.read_csv(folder / "dive.csv")
        changed = change(table)
        (table if changed is None else changed).to_csv(folder / "dive.csv", index=False)

    return spoil


def spoil_vehicle(old: str, new: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        file = folder / "ship.toml"
        text = jm.packaged_vehicle("cybership2").read_text()
        assert text.count(old) == 1
        file.write_text(text.replace(old, new))

    return spoil


def beyond(table: pd.DataFrame) -> None:
    table.loc[7, "port"] = 1.2


def backwards(table: pd.DataFrame) -> None:
    table.loc[5, "t"] = 0.25


def empty(table: pd.DataFrame) -> pd.DataFrame:
    return table[["t", "x", "y", "psi", "star", "port", "bow"]].assign(psi=np.nan)


BAD = {
    "missing log": (
        lambda folder: (folder / "dive.csv").unlink(),
        "dive.csv: cannot be read, because there is no such file",
    ),
    "missing vehicle": (
        lambda folder: (folder / "ship.toml").unlink(),
        "ship.toml: cannot be read, because there is no such file",
    ),
    "wrong column": (spoil_log(lambda table: table.rename(columns={"port": "prt"})), "lacks `port`"),
    "command beyond its range": (spoil_log(beyond), "command `port` is 1.2 in data row 8"),
    "time goes back": (spoil_log(backwards), "is 0.25 s in data row 6, after 0.4 s"),
    "channel empty": (spoil_log(empty), "`psi` has no value in any row"),
    "matrix of wrong shape": (
        spoil_vehicle("    [0.0, -0.1052, 0.0, 0.0, 0.0, 1.9],\n", ""),
        "`damping.linear` must be 6 rows of 6 numbers",
    ),
    "negative mass": (spoil_vehicle("mass = 23.8", "mass = -23.8"), "`body.mass` is -23.8"),
    "inertia not positive definite": (
        spoil_vehicle("[0.0, 0.0, 1.76]", "[0.0, 0.0, -1.76]"),
        "`body.inertia` must be positive definite",
    ),
}


@pytest.mark.parametrize("command", ["diagnose", "simulate", "fit", "check"])
@pytest.mark.parametrize("spoil,fragment", BAD.values(), ids=BAD)
def test_what_cannot_be_used_is_said_in_one_sentence(jaxmarine, folder, command, spoil, fragment):
    spoil(folder)
    before = sorted(folder.rglob("*"))
    code, out, err = jaxmarine(*call(command, folder))
    assert code == 2 and not out
    assert fragment in one_sentence(err)
    assert sorted(folder.rglob("*")) == before, "nothing is written"


@pytest.mark.parametrize("command", ["diagnose", "fit", "check"])
def test_a_log_shorter_than_two_windows_is_refused(jaxmarine, folder, command):
    spoil_log(lambda table: table.head(20))(folder)
    before = sorted(folder.rglob("*"))
    code, out, err = jaxmarine(*call(command, folder))
    assert code == 2 and not out
    assert "dive.csv: is shorter than two windows of" in one_sentence(err)
    assert sorted(folder.rglob("*")) == before


def test_a_column_map_that_does_not_fit_is_refused(jaxmarine, folder):
    (folder / "map.toml").write_text('[columns]\nport = "left"\n')
    for command in ("diagnose", "simulate", "fit", "check"):
        code, _, err = jaxmarine(*call(command, folder), "--columns", folder / "map.toml")
        assert code == 2
        assert "has no column `left`" in one_sentence(err)


@pytest.mark.parametrize("out", ["nowhere/out.csv", "out.txt"])
def test_a_log_is_not_written_where_it_cannot_be(jaxmarine, folder, out):
    words = call("simulate", folder)[:-1]
    code, _, err = jaxmarine(*words, folder / out)
    assert code == 2
    assert out.split("/")[-1] in one_sentence(err)


@pytest.mark.parametrize("command", ["simulate", "fit"])
@pytest.mark.parametrize("out", ["nowhere/out.csv", "dive.csv/out.csv", "."])
def test_where_a_result_cannot_be_written_is_said_before_the_work(jaxmarine, folder, command, out):
    # A log that would be refused were it read.
    (folder / "dive.csv").write_text("no log")
    code, said, err = jaxmarine(*call(command, folder)[:-1], folder / out)
    assert code == 2 and not said
    assert one_sentence(err).endswith("is no file that can be written; choose another --out.")


@pytest.mark.parametrize("command", ["diagnose", "fit"])
def test_time_in_milliseconds_is_noticed(jaxmarine, folder, command):
    spoil_log(lambda table: table.assign(t=1000 * table.t))(folder)
    code, said, err = jaxmarine(*call(command, folder))
    assert code == 2 and not said
    assert "dive.csv: has a sample every 100 s" in one_sentence(err)


def test_a_window_of_ones_own_does_not_let_slow_sampling_pass(jaxmarine, folder):
    spoil_log(lambda table: table.assign(t=50 * table.t))(folder)
    code, said, err = jaxmarine(*call("diagnose", folder), "--window", "100")
    assert code == 2 and not said
    assert "dive.csv: has a sample every 5 s" in one_sentence(err)


def test_what_reading_a_log_left_out_is_said(jaxmarine, folder):
    spoil_log(lambda table: table.assign(humidity=11.7))(folder)
    code, out, err = jaxmarine(*call("simulate", folder))
    assert code == 0 and not err
    assert "`humidity`" in out


def test_what_is_fitted_has_a_known_name(jaxmarine, folder):
    code, _, err = jaxmarine(*call("fit", folder), "--free", "colour")
    assert code == 2
    assert "choose from damping" in one_sentence(err)


def test_an_effect_that_is_fitted_has_a_target_of_the_vehicle(jaxmarine, folder):
    code, _, err = jaxmarine(*call("fit", folder), "--free", "thruster_gain:keel")
    assert code == 2
    assert "Effect `thruster_gain:keel` has the target `keel`" in one_sentence(err)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--free", "linear"], "names a coefficient twice"),
        (["--free", "coupling"], "names a coefficient twice"),
        (["--free", "all"], "names a coefficient twice"),
        (["--prior", "0"], "--prior 0: is no width"),
        (["--prior", "nan"], "--prior nan: is no width"),
    ],
)
def test_what_no_fit_can_have_is_a_sentence(jaxmarine, folder, words, sentence):
    code, said, err = jaxmarine(*call("fit", folder), *words)
    assert code == 2 and not said
    assert sentence in one_sentence(err)


# --- what is written -----------------------------------------------------------------------------


def test_simulate_writes_the_log_of_the_vehicle(jaxmarine, folder, ship, dive):
    code, out, err = jaxmarine(*call("simulate", folder))
    assert code == 0 and not err
    assert "out.csv" in out
    written = jm.read_log(folder / "out.csv", ship)
    np.testing.assert_array_equal(written.t, dive.t)
    np.testing.assert_array_equal(written.commands, dive.commands)
    # From the log's first state, which is at rest: the noise is all that differs at first.
    error = np.abs(written.channels - dive.channels)[:20]
    limit = 8 * np.nanstd(np.diff(dive.channels, axis=0), axis=0)
    moving = np.isfinite(error).all(0)
    assert moving.sum() >= 9
    assert (error[:, moving] < limit[moving] + 1e-9).all()


def test_simulate_reads_foreign_columns_and_writes_parquet(jaxmarine, folder, ship):
    table = pd.read_csv(folder / "dive.csv")
    table["left"] = 100.0 * table.pop("port")
    table.to_csv(folder / "dive.csv", index=False)
    (folder / "map.toml").write_text('[columns]\nport = {from = "left", scale = 0.01}\n')
    words = [*call("simulate", folder)[:-1], folder / "out.parquet"]
    code, _, err = jaxmarine(*words, "--columns", folder / "map.toml")
    assert code == 0 and not err
    written = jm.read_log(folder / "out.parquet", ship)
    assert written.commands is not None
    np.testing.assert_allclose(written.commands[:, 1], table["left"] / 100.0, rtol=1e-12)


def test_fit_writes_the_vehicle_that_made_the_log(jaxmarine, folder, ship):
    thrust = np.asarray(ship.thrusters.max_thrust)
    wrong = dataclasses.replace(
        ship, thrusters=dataclasses.replace(ship.thrusters, max_thrust=0.7 * ship.thrusters.max_thrust)
    )
    jm.save_vehicle(wrong, folder / "ship.toml")
    words = call("fit", folder)
    words[words.index("damping")] = "thrust"
    code, out, err = jaxmarine(*words)
    assert code == 0 and not err
    assert "thrusters.max_thrust[port]" in out and "converged" in out
    fitted = jm.load_vehicle(folder / "out.toml")
    # Twenty noisy seconds determine the thrust to about one part in a hundred.
    np.testing.assert_allclose(fitted.thrusters.max_thrust, thrust, rtol=0.03)
    np.testing.assert_array_equal(fitted.damping.linear, ship.damping.linear)
    assert fitted.name == "cybership2"


@pytest.mark.slow
def test_fit_frees_an_effect_that_the_file_does_not_have(jaxmarine, folder, ship):
    """The log is of thrusters as filed, so that a file with more thrust in one needs a gain below one there.

    And nothing else acts on the hull: a constant wrench begins at zero, where no prior holds it.
    """
    more = ship.thrusters.max_thrust.at[0].divide(0.8)
    wrong = dataclasses.replace(ship, thrusters=dataclasses.replace(ship.thrusters, max_thrust=more))
    jm.save_vehicle(wrong, folder / "ship.toml")
    words = [*call("fit", folder), "--prior", "0.3"]
    name = f"thruster_gain:{ship.thruster_names[0]}"
    words[words.index("damping")] = name
    code, out, err = jaxmarine(*words, "--free", "constant_wrench:surge")
    assert code == 0 and not err
    assert f"{name}.factor" in out and "constant_wrench:surge.value" in out
    placed = jm.load_vehicle(folder / "out.toml").placed
    factor, wrench = placed[0].effect.parameters()["factor"], placed[1].effect.parameters()["value"]
    np.testing.assert_allclose(factor[0], 0.8, rtol=0.03)
    np.testing.assert_array_equal(factor[1:], 1.0)
    assert abs(wrench[0]) < 0.02 * more[0]


@pytest.mark.slow
def test_fit_frees_thrust_astern_and_the_curve_by_themselves(jaxmarine, folder, ship):
    """The log is of symmetric thrust, which the file spoils astern."""
    thrust = np.asarray(ship.thrusters.max_thrust)
    astern = dataclasses.replace(ship.thrusters, max_thrust_reverse=0.8 * ship.thrusters.max_thrust)
    jm.save_vehicle(dataclasses.replace(ship, thrusters=astern), folder / "ship.toml")
    words = call("fit", folder)
    words[words.index("damping")] = "reverse_thrust"
    code, out, err = jaxmarine(*words, "--free", "curve")
    assert code == 0 and not err
    assert "thrusters.max_thrust_reverse[port]" in out and "thrusters.quadratic[port]" in out
    fitted = jm.load_vehicle(folder / "out.toml").thrusters
    np.testing.assert_array_equal(fitted.max_thrust, thrust)
    # Of twenty seconds, in which a curve is worth little less than a factor.
    np.testing.assert_allclose(fitted.reverse, thrust, rtol=0.1)
    np.testing.assert_allclose(fitted.quadratic, 0.0, atol=0.1)


@pytest.mark.parametrize(
    ("free", "entries", "leaves"),
    # Of `all` four of thrusters too, and six numbers of a hull's lift, which the file does not have; a
    # current has three, and lift is free once.
    [
        (("coupling",), "coupled", 3),
        (("all",), "coupled", 13),
        (("steady_current", "all", "hull_lift"), "coupled", 16),
        (("linear",), "diagonal", 1),
    ],
)
def test_fit_frees_what_couples_axes_where_it_is_asked_for(
    jaxmarine, folder, ship, monkeypatch, free, entries, leaves
):
    asked = []

    def fit(vehicle, logs, select, **options):
        asked.append((len(jax.tree.leaves(select(vehicle))), options["entries"], options["prior"]))
        return SimpleNamespace(converged=False, result="as nothing was fitted.")

    monkeypatch.setattr("jaxmarine.fitting.fit", fit)
    words = call("fit", folder)
    place = words.index("--free")
    words[place : place + 2] = [word for name in free for word in ("--free", name)]
    assert jaxmarine(*words)[0] == 2
    assert asked == [(leaves, entries, 0.3 if "all" in free else None)]


def test_a_demo_that_is_stopped_has_written_nothing(jaxmarine, folder, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxmarine.diagnosis.diagnose", stopped)
    monkeypatch.setattr(os, "_exit", sys.exit)
    code, _, err = jaxmarine("demo", "--out", folder / "demo")
    assert code == 130 and err == "Stopped; nothing was written.\n"
    assert not (folder / "demo").exists()


def test_ctrl_c_ends_a_running_program_at_once(folder):
    """While it compiles or computes, which no Python handler interrupts."""
    words = [
        "diagnose",
        "--vehicle",
        "ship.toml",
        "--train",
        "dive.csv",
        "--test",
        "dive.csv",
        "--out",
        "new",
    ]
    # A shell has what it runs in the background ignore Ctrl-C, which is inherited.
    program = (
        "import signal, sys, jaxmarine.cli as c; signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"sys.argv = ['jaxmarine', *{words}]; c.main()"
    )
    running = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=folder,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # A compiler of its own: programs from the cache might be done before they are stopped.
        env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")},
    )
    assert running.stdout is not None
    while "fitting" not in running.stdout.readline():
        assert running.poll() is None
    time.sleep(1.0)
    stopped = time.monotonic()
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=30)
    # Well under a second on an idle machine; other tests run beside this one.
    assert time.monotonic() - stopped < 3.0
    assert running.returncode == 130 and err == "Stopped; nothing was written.\n"
    assert not (folder / "new").exists()


def test_what_was_found_before_a_stop_is_said(request):
    stop = threading.Event()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))

    def work(tell):
        tell("round 1: scoring")
        tell("found thruster_lag")
        _thread.interrupt_main()
        stop.wait(10.0)

    with pytest.raises(_Stopped, match=r"^nothing was written\. Found so far, not settled: thruster_lag\.$"):
        _stoppable(work, lambda words: None)
    stop.set()


def test_a_log_that_cannot_be_used_is_left_out_of_several_and_named(jaxmarine, folder):
    (folder / "late.csv").write_text("t,u\n0,1\n0,2\n")
    vehicle = ("--vehicle", folder / "ship.toml")
    code, out, err = jaxmarine("check", folder / "late.csv", folder / "dive.csv", *vehicle)
    assert code == 0 and not err
    assert out.startswith(f"Left out: {folder / 'late.csv'}: ")
    alone = jaxmarine("check", folder / "dive.csv", *vehicle)[1]
    assert out.splitlines()[1:] == alone.splitlines()
    code, _, err = jaxmarine("check", folder / "late.csv", folder / "late.csv", *vehicle)
    assert code == 2 and err.startswith(f"{folder / 'late.csv'}: ") and err.count("\n") == 1


def test_a_line_of_results_stays_one_line_in_a_pipe(capsys):
    line = "  waves: " + ", ".join(f"north = {i}.25 ± 0.01 N" for i in range(20))
    _say(line)
    assert capsys.readouterr().out == f"{line}\n"


def test_what_is_predicted_worse_is_the_first_line_of_a_gain(capsys):
    per_log = (LogGain("a.csv", 0.5, (0.4, 0.6), True, 40), LogGain("b.csv", 0.9, None, False, 20))
    worse = BeforeAfter(0.6, 1.1, (1.7, 1.95), worse=True)
    gain = Gain(5.0, None, worse, 0.63, (0.5, 0.8), False, 60, channels={"u": worse}, per_log=per_log)
    warned = ("Predicted worse than by the vehicle file on a.csv and b.csv, for certain: ...",)
    _say_gain(SimpleNamespace(gain=gain, warnings=warned, test="a.csv and b.csv"))
    assert capsys.readouterr().out.splitlines() == [
        *warned,
        "5 s prediction error on a.csv and b.csv: 0.630 of what it was (95 %: 0.500 to 0.800), not held out",
        "  velocity: 0.6 to 1.1 m/s, 1.833 of it (95 %: 1.700 to 1.950); u 1.833",
        "  a.csv: 0.500 (95 %: 0.400 to 0.600)",
        "  b.csv: 0.900 (too short for an interval), not held out",
    ]


def test_without_a_terminal_stages_are_lines_with_the_share_and_the_time_left(capsys):
    with _progress("diagnosing") as tell:
        tell(FITTING)
        tell(in_round(2, 6, "scoring 83 suspects"))
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"{FITTING} ..."
    assert re.fullmatch(r"round 2 of at most 6: scoring 83 suspects \.\.\. 14 % done, about 5 s left", second)


@pytest.mark.slow
@pytest.mark.parametrize("craft", DEMOS)
def test_the_demos_find_what_they_hide(jaxmarine, folder, craft):
    shown = DEMOS[craft]
    code, out, _ = jaxmarine("demo", "--craft", craft, "--out", folder / "demo")
    assert code == 0
    assert "Verdict: explained" in out and shown.told in out
    (finding,) = json.loads((folder / "demo" / "diagnosis.json").read_text())["findings"]
    assert (finding["effect"], finding["target"]) == (shown.effect, shown.target)
    for name, value in shown.parameters.items():
        found = finding["parameters"][name]
        # Within its error, and two parts in a hundred of what that leaves out.
        assert found["value"] == pytest.approx(value, abs=4 * found["std"] + 0.02 * abs(value))
    made = {path.name for path in (folder / "demo").iterdir()}
    assert made >= {"train.csv", "test.csv", "vehicle.toml", "extended.toml", "diagnosis.json", "index.html"}
    page = (folder / "demo" / "index.html").read_text()
    vehicle = jm.load_vehicle(folder / "demo" / "vehicle.toml")
    assert all(f"<dt>{one.title}</dt>" in page for one in vehicle.actuators)


@pytest.mark.parametrize("craft", DEMOS)
def test_the_logs_of_a_demo_hide_what_it_says(craft):
    """The craft with the effect leaves noise in the first part of the log, the craft as filed leaves more."""
    shown = dataclasses.replace(DEMOS[craft], duration=(40.0, 40.0))
    vehicle = shown.vehicle()
    train, test = shown.logs(vehicle)
    assert train.dt == pytest.approx(shown.dt) and not np.array_equal(train.commands, test.commands)
    told = " ".join(f"{name}={value}" for name, value in shown.parameters.items())
    cause = cause_named(vehicle, f"{shown.effect}:{shown.target} {told}")
    # The neutral effect is the file, in the shape of the program that made the logs.
    crafts = [
        vehicle.place(cause),
        vehicle.place(jm.Placed(type(cause.effect).neutral(vehicle), cause.target)),
    ]
    used = np.isfinite(vehicle.stated_noise) & (np.tile(vehicle.free, 3) > 0)
    chi2 = []
    for one in crafts:
        off = np.asarray(jm.simulate(one, train, jm.initial_state(one)).channels) - train.channels
        off[:, 3:6] = (off[:, 3:6] + np.pi) % (2 * np.pi) - np.pi
        chi2.append(float((off / vehicle.stated_noise)[:, used].var()))
    assert chi2[0] == pytest.approx(1.0, abs=0.1) and chi2[1] > 2.0
    # The number in the sentence is the one that is hidden.
    assert all(f"{value:g}" in shown.told for value in shown.parameters.values())


def test_a_kind_of_craft_that_there_is_not_is_refused(jaxmarine, folder):
    code, _, err = jaxmarine("demo", "--craft", "plane", "--out", folder / "demo")
    assert code == 2 and "'plane' is not one of" in err and not (folder / "demo").exists()


def test_the_command_line_knows_every_demo():
    assert [kind.value for kind in Kind] == list(DEMOS)


def test_help_does_not_wait_for_the_compiler():
    """Neither the command line's help nor the package itself imports jax, which takes seconds."""
    program = (
        "import sys, jaxmarine.cli; sys.argv = ['jaxmarine', '--help']\n"
        "try: jaxmarine.cli.main()\n"
        "except SystemExit as end: sys.exit(end.code or 3 * ('jax' in sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert all(command in run.stdout for command in COMMANDS)


def test_every_public_name_is_there():
    assert {"diagnose", "fit", "simulate", "CATALOGUE"} < set(jm.__all__)
    assert all(getattr(jm, name) is not None for name in jm.__all__)
