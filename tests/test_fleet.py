"""Fleets of logs: nothing is lost, nothing is done twice, and answers are those of one by one.

The tests' own process opens no connection, so fleets run in processes of their own.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import jaxmarine as jm
from jaxmarine._program import program
from jaxmarine.examples import hidden
from jaxmarine.fleets import _engine, _work
from jaxmarine.fleets._folder import Folder
from jaxmarine.fleets._job import Job, Outcome, job_of
from jaxmarine.fleets._page import page
from jaxmarine.fleets._rows import COLUMNS
from jaxmarine.fleets._table import read_entries
from jaxmarine.fleets._told import notices

from .boats import boat
from .fleet_work import child, environment
from .shell import exit_code
from .test_bad_input import refusal
from .test_report import EVIL, read

# A fleet whose logs say what becomes of them, with the scheduler that is named, and its table as it stands
# then.
RUN = """
import sys
if __name__ == "__main__":
    from jaxmarine.fleets._fleet import run
    from tests.fleet_work import told
    table, out, scheduler, workers, limit = sys.argv[1:]
    done = run(table, out, told, scheduler or None, int(workers), float(limit))
    print(done.again, *sorted(done.verdicts.items()))
"""
COMMAND = "from jaxmarine.cli import main; main()"


def table_of(folder: Path, logs: dict[str, str]) -> Path:
    """A table of logs by their names, which hold what is to become of them."""
    (folder / "boat.toml").write_text("schema = 1\n")
    for name, words in logs.items():
        (folder / f"{name}.txt").write_text(words)
    rows = [
        {
            "craft": "anna",
            "date": f"2026-03-{i:02}",
            "vehicle": "boat.toml",
            "train": f"{name}.txt",
            "test": "*.toml",
        }
        for i, name in enumerate(logs, start=1)
    ]
    pd.DataFrame(rows).to_csv(folder / "table.csv", index=False)
    return folder / "table.csv"


def ran(table: Path, out: Path, scheduler: str = "", workers: int = 2, limit: float = 60.0) -> str:
    """What a run prints at its end; its workers begin with imports made, which take longer than the work."""
    begins = {"DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
    done = child(RUN, table, out, scheduler, str(workers), str(limit), **begins)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def tries(table: Path, name: str) -> int:
    """How often a log was begun with."""
    return len((table.parent / f"{name}.tries").read_text())


# --- the table -------------------------------------------------------------------------------------


def entries(folder: Path, text: str):
    (folder / "table.csv").write_text(text)
    return read_entries(folder / "table.csv", folder / "scratch")


def test_a_row_names_files_by_paths_and_globs_beside_the_table(tmp_path):
    for name in ("b2.csv", "b1.csv", "a.csv", "t.csv", "v.toml"):
        (tmp_path / name).write_text("")
    (entry,) = entries(tmp_path, "vehicle,train,test\nv.toml,b*.csv; a.csv,t.csv\n")
    vehicle, train, test = entry.files()
    assert [Path(path).name for path in (vehicle, *train, *test)] == [
        "v.toml",
        "b1.csv",
        "b2.csv",
        "a.csv",
        "t.csv",
    ]
    assert all(Path(path).is_absolute() for path in train)
    assert (entry.name, entry.craft, entry.date) == ("b", "v", None)


def test_logs_without_a_name_get_one_each(tmp_path):
    found = entries(
        tmp_path, "vehicle,train,test,name\nv,Dive.csv,t,\nv,dive.csv,t,\nv,x,t,dive-2\nv,x,t,7\n"
    )
    assert [one.name for one in found] == ["Dive", "dive-3", "dive-2", "7"]
    assert len({one.slug for one in found}) == 4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("vehicle,train\nv,a\n", "lacks the column `test`"),
        ("vehicle,train,test,carft\nv,a,t,x\n", "unknown column `carft`; did you mean `craft`?"),
        ("vehicle,train,test,name\nv,a,t,x y\nv,a,t,X_y\n", "two logs named `x y`"),
        ("vehicle,train,test,date\nv,a,t,soon\n", "the date of `a` is 'soon'"),
        ("vehicle,train,test\n", "no rows"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_in_a_sentence(tmp_path, text, said):
    assert said in refusal(lambda: entries(tmp_path, text))


def test_files_of_an_object_store_are_fetched(tmp_path):
    import fsspec

    store = fsspec.filesystem("memory")
    store.pipe("/fleet/table.csv", b"vehicle,train,test\nv.toml,*/a.csv,memory://fleet/two/b.csv\n")
    for name in ("v.toml", "one/a.csv", "two/a.csv", "two/b.csv"):
        store.pipe(f"/fleet/{name}", b"schema = 1\n")
    (entry,) = read_entries("memory://fleet/table.csv", tmp_path)
    job = job_of(entry, program())
    assert [path.removeprefix("memory://").lstrip("/") for path in job.train] == [
        "fleet/one/a.csv",
        "fleet/two/a.csv",
    ]
    before = job.key
    store.pipe("/fleet/two/b.csv", b"schema = 2\n")
    assert job_of(entry, program()).key != before
    assert "names no file" in refusal(
        lambda: entries(tmp_path, "vehicle,train,test\nmemory://no,a,b\n")[0].files()
    )


def test_a_key_is_that_of_contents_and_names(tmp_path):
    table = table_of(tmp_path, {"a": "fine"})
    (entry,) = read_entries(table, tmp_path)
    first = job_of(entry, program()).key
    os.utime(tmp_path / "a.txt", (0, 0))
    assert job_of(entry, program()).key == first
    (tmp_path / "a.txt").write_text("weak 0.9")
    second = job_of(entry, program()).key
    assert len({first, second, job_of(entry, "another").key}) == 3


# --- nothing is lost -------------------------------------------------------------------------------


def test_every_log_is_a_row_whatever_happens_to_it(tmp_path):
    logs = {"weak": "weak 0.8", "broken": "broken", "raises": "raises", "late": "late", "kills": "kills"}
    table = table_of(
        tmp_path, {**logs, "once": "kills-once", "gone": "fine", **{f"fine{i}": "fine" for i in range(5)}}
    )
    (tmp_path / "gone.txt").unlink()
    out = tmp_path / "out"
    assert ran(table, out, limit=4.0) == "0 ('error', 5) ('explained', 1) ('nothing_found', 6)"
    rows = pd.read_parquet(out / "fleet.parquet").set_index("name")
    assert list(rows.columns) == [name for name in COLUMNS if name != "name"]
    assert list(rows.index) == [*logs, "once", "gone", *(f"fine{i}" for i in range(5))]
    errors = rows["error"].dropna()
    assert errors["broken"] == "broken: is broken; mend it."
    assert "ZeroDivisionError: no number" in errors["raises"]
    assert "longer than 4 s" in errors["late"]
    assert "killed or out of memory" in errors["kills"]
    assert "names no file" in errors["gone"]
    assert all(sentence.count("\n") == 0 for sentence in errors)
    # A worker that dies is not the log's fault the first time; one that waited behind it is counted as well.
    assert all(2 <= tries(table, name) <= 3 for name in ("late", "kills", "once"))
    weak = rows.loc["weak"]
    assert weak["report"] == "logs/weak/index.html" and (out / weak["report"]).read_text() == "<p>a report"
    assert (out / "logs" / "weak" / "figures" / "a.png").exists()

    # Once more: what was answered is not done again, what was lost is.
    for name in ("late", "kills"):
        (tmp_path / f"{name}.txt").write_text("fine")
    (tmp_path / "fine0.txt").write_text("weak 0.7")
    assert ran(table, out) == "7 ('error', 3) ('explained', 2) ('nothing_found', 7)"
    assert [tries(table, name) for name in ("weak", "broken", "raises")] == [1, 1, 2]


@pytest.mark.slow
def test_a_scheduler_by_its_address_goes_on_after_a_run_was_killed(tmp_path):
    table = table_of(tmp_path, {f"log{i}": "weak 0.9" for i in range(6)} | {"late": "late"})
    at = tmp_path / "scheduler.json"
    started = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(at), *words],
            env=environment(),
            stderr=subprocess.DEVNULL,
        )
        for kind, *words in (
            ("scheduler", "--port", "0", "--no-dashboard"),
            ("worker", "--nthreads", "2", "--no-dashboard", "--local-directory", str(tmp_path)),
        )
    ]
    try:
        while not at.exists():
            time.sleep(0.1)
        address = json.loads(at.read_text())["address"]
        out = tmp_path / "out"
        first = subprocess.Popen(
            [sys.executable, "-c", RUN, table, out, address, "1", "600"],
            env=environment(),
            stderr=subprocess.DEVNULL,
        )
        while len(list(out.glob("logs/*/outcome.json"))) < 6:
            assert first.poll() is None
            time.sleep(0.1)
        second = child(COMMAND, "fleet", table, "--out", out)
        assert second.returncode == 2
        assert f"{out}: another run writes into this folder" in second.stderr
        first.send_signal(signal.SIGKILL)
        first.wait()
        (tmp_path / "late.txt").write_text("fine")
        assert ran(table, out, address) == "6 ('explained', 6) ('nothing_found', 1)"
        assert tries(table, "log0") == 1
    finally:
        for one in started:
            one.terminate()
            one.wait()


def test_a_worker_that_is_late_ends_whether_or_not_it_can_say_so(monkeypatch):
    ended = threading.Event()

    def cut_off(*_):
        raise OSError("the scheduler is gone")

    def leave(_: int) -> None:
        ended.set()
        threading.Event().wait()  # a process that ends says no more

    worker = SimpleNamespace(log_event=cut_off)
    monkeypatch.setattr(_engine, "_distributed", lambda: SimpleNamespace(get_worker=lambda: worker))
    monkeypatch.setattr(_engine.os, "_exit", leave)

    def waits(_: Job) -> Outcome:
        return Outcome(error=None if ended.wait(20.0) else "nothing has ended it")

    job = Job("key", "log", "vehicle", (), (), (), "program")
    assert _engine._within(waits, job, 0.05).error is None


def test_an_outcome_half_written_is_none(tmp_path):
    folder = Folder(tmp_path / "out")
    with folder.held():
        folder.keep("a", "key", Outcome(({"verdict": "explained"},), {"index.html": b"x"}))
        known = folder.known("a", "key")
        assert known is not None and known.rows == ({"verdict": "explained"},)
        assert folder.known("a", "other") is None and folder.known("b", "key") is None
        outcome = folder.report("a") / "outcome.json"
        outcome.write_bytes(outcome.read_bytes()[:-9])
        assert folder.known("a", "key") is None
        folder.keep("a", "key", Outcome(error="lost", final=False))
        assert folder.known("a", "key") is None
        assert not (folder.report("a") / "index.html").exists()


# --- the page --------------------------------------------------------------------------------------


def row(name: str, craft: str, day: int, size: float | None = None, error: str | None = None):
    what = {"name": name, "craft": craft, "date": pd.Timestamp(2026, 3, day), "error": error}
    what |= {"report": None if error else f"logs/{name}/index.html"}
    if error:
        return what
    what |= {"kind": "boat", "verdict": "nothing_found", "gain": 1.0}
    if size is None:
        return what
    finding = {"effect": "thruster_gain", "target": "port", "parameters": ["factor"], "sizes": [size]}
    return what | finding | {"std": [0.01], "units": ["1"], "verdict": "explained", "gain": 0.4}


def test_the_page_says_which_craft_has_what_since_when(tmp_path):
    rows = [
        row("d", "anna", 4, 0.7),
        row("a", "anna", 1, 0.9),
        row("b", "anna", 2),
        row("x", "anna", 5, error=f"x: is broken {EVIL}."),
        row("c", "anna", 3, 0.8),
        row("e", "berta", 3),
        row("f", "clara", 3, error="f: is broken."),
    ]
    (tmp_path / "index.html").write_text(page(rows), "utf-8")
    text = (tmp_path / "index.html").read_text("utf-8")
    shown = read(tmp_path / "index.html")
    assert EVIL not in text and EVIL in shown.text
    crafts, logs = re.findall(r"<tbody>(.*?)</tbody>", text, re.DOTALL)
    anna, berta, clara = crafts.split("</tr>")[:3]
    # Without a break since the third, as the log of the second shows nothing and the last one is not usable.
    assert re.findall(r'href="([^"]*)">([^<]*)<', anna) == [
        ("logs/d/index.html", "2026-03-04"),
        ("logs/c/index.html", "2026-03-03"),
    ]
    assert "0.700 ± 0.010" in anna and "nothing" in berta and "no log could be used" in clara
    assert logs.count("</tr>") == 7
    assert text.count("<svg") == 1


def test_the_page_gives_alarm_of_what_is_new_and_of_what_has_changed():
    rng = np.random.default_rng(0)
    steady = [row(f"b{day}", "berta", day, 0.8 + 0.01 * rng.normal()) for day in range(1, 25)]
    falls = [
        row(f"a{day}", "anna", day, 0.8 - 0.1 * (day > 15) + 0.01 * rng.normal()) for day in range(1, 25)
    ]
    new = [row(f"c{day}", "clara", day, 0.8 if day > 3 else None) for day in range(1, 6)]
    told = notices([*steady, *falls, *new])
    assert [(one.craft, one.first["name"]) for one in told] == [("clara", "c4"), ("anna", "a16")]
    assert told[0].nats is None and told[1].nats is not None and told[1].nats > 100
    shown = page([*steady, *falls, *new])
    assert "has left its level" in shown and "New: " in shown


# --- the command -----------------------------------------------------------------------------------


def test_the_command_refuses_in_a_sentence(tmp_path, capsys):
    assert exit_code("fleet", tmp_path / "no.csv", "--out", tmp_path / "out") == 2
    assert "no such file" in capsys.readouterr().err
    table = table_of(tmp_path, {"a": "fine"})
    assert exit_code("fleet", table, "--scheduler", "tcp://x:1", "--workers", "2") == 2
    assert "--workers: a scheduler has workers of its own" in capsys.readouterr().err
    assert exit_code("fleet", table, "--scheduler", "nonsense", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert said.startswith("--scheduler nonsense: does not answer") and said.count("\n") == 1


@pytest.mark.slow
def test_the_command_makes_rows_of_logs_that_cannot_be_used(tmp_path):
    jm.save_vehicle(boat(), tmp_path / "boat.toml")
    (tmp_path / "short.csv").write_text("t,u\n0,1\n")
    (tmp_path / "table.csv").write_text("vehicle,train,test\nboat.toml,short.csv,short.csv\nno.toml,a,b\n")
    done = child(COMMAND, "fleet", tmp_path / "table.csv", "--out", tmp_path / "out", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert "2 could not be used; the table and the page say why" in done.stdout
    rows = pd.read_parquet(tmp_path / "out" / "fleet.parquet")
    assert "short.csv: has 1 row, but a log needs at least 10" in rows["error"][0]
    assert "no.toml: names no file" in rows["error"][1]
    assert "has 1 row" in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.slow
def test_answers_are_those_of_one_by_one(tmp_path):
    jm.save_vehicle(boat(), tmp_path / "boat.toml")
    for name, factor in (("weak", 0.7), ("fine", 1.0)):
        train, test = hidden(boat(), "thruster_gain", "port", {"factor": factor}, (40.0, 30.0))
        jm.write_log(train, tmp_path / f"{name}.csv")
        jm.write_log(test, tmp_path / f"{name}-test.csv")
    lines = [f"{name},boat.toml,{name}.csv,{name}-test.csv" for name in ("weak", "fine")]
    (tmp_path / "table.csv").write_text(
        "\n".join(["name,vehicle,train,test", *lines, "gone,boat.toml,gone.csv,x"])
    )
    done = child(COMMAND, "fleet", tmp_path / "table.csv", "--out", tmp_path / "out", "--workers", "2")
    assert done.returncode == 0, done.stderr
    alone = ["--vehicle", "boat.toml", "--train", "weak.csv", "--test", "weak-test.csv", "--out", "alone"]
    words = [tmp_path / word if "." in word or word == "alone" else word for word in alone]
    assert exit_code("diagnose", *words) == 0
    for file in ("diagnosis.json", "extended.toml", "index.html"):
        both = [(tmp_path / folder / file).read_bytes() for folder in ("alone", "out/logs/weak")]
        assert both[0] == both[1], file
    rows = pd.read_parquet(tmp_path / "out" / "fleet.parquet").set_index("name")
    assert rows["effect"].tolist()[0] == "thruster_gain" and rows["verdict"]["fine"] == "nothing_found"
    assert rows["sizes"]["weak"][0] == pytest.approx(0.7, abs=0.02)
    assert "names no file" in rows["error"]["gone"]


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="memory maps are counted on Linux only")
def test_programs_are_let_go_where_memory_maps_run_out(monkeypatch):
    def maps() -> int:
        return len(Path("/proc/self/maps").read_bytes().splitlines())

    def compile_some() -> None:
        for size in range(2, 12):
            jax.jit(lambda x: jnp.sin(x @ x).sum())(jnp.eye(size)).block_until_ready()

    compile_some()
    monkeypatch.setattr(_work, "_MAPS", 10**9)
    monkeypatch.setattr(_work, "_MEMORY", 10**15)
    many = maps()
    _work._let_go()
    # A map or two may go for other reasons.
    assert maps() > many - 10
    monkeypatch.setattr(_work, "_MAPS", 0)
    _work._let_go()
    # Each program holds some, which another diagnosis would add to.
    assert maps() <= many - 10
    # And where memory does. What stays without programs is no reason to let them go again.
    compile_some()
    many = maps()
    monkeypatch.setattr(_work, "_MAPS", 10**9)
    monkeypatch.setattr(_work, "_MEMORY", _work._memory() / 2)
    monkeypatch.setattr(_work._STAYED, "memory", 0.0)
    _work._let_go()
    assert maps() <= many - 10
    compile_some()
    many = maps()
    _work._let_go()
    assert maps() > many - 10
