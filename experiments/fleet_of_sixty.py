"""A fleet of sixty logs by its page alone, two files broken and a worker killed; and a worker's long life.

usage: python -m experiments.fleet_of_sixty --out DIR [--quick]

Ten craft of three packaged classes dive six times, a minute each; from some dive on a thruster of four of
them gives 0.7 of its thrust, and nothing is hidden in the others. Two files are then spoilt, `jaxmarine fleet
TABLE` is run, and one of its worker processes is killed in the middle of a log. Counted are rows, sentences
and the alarms of the page; three logs are also diagnosed one by one, and compared digit by digit.

Beside it one worker diagnoses many short logs of several lengths and classes one after the other: how many
memory maps it holds, of which Linux gives a process 65530, and how much memory.

Writes results.json and results.md; logs, table and what the fleet comes to lie in `fleet`.
"""

import dataclasses
import html
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import numpy as np
import pandas as pd
import psutil
import typer

import jaxmarine as jm
from experiments._study import short, study, write_results
from jaxmarine._program import program
from jaxmarine.examples import hidden
from jaxmarine.fleets._engine import worked
from jaxmarine.fleets._job import Job, Outcome, job_of
from jaxmarine.fleets._table import read_entries

HERE = Path(__file__).parent / "fleet_of_sixty"
DIVES, EVERY = 6, pd.Timedelta(days=7)
BEGUN = pd.Timestamp(2026, 3, 1)
LENGTHS = (60.0, 30.0)  # of a training and a test log [s]
FACTOR = 0.7
WORKERS = 2
# A worker is killed so long [s] after this share of all logs had been answered: in the middle of the next.
SHARE, AMID = 1 / 3, 3.0
# Of the worker that lives long: its classes, lengths [s] of its logs, and Linux' limit of memory maps.
AGED = ("milliampere", "cybership2", "tethra")
AGED_LENGTHS = (30.0, 45.0, 60.0)
LIMIT = 65530


@dataclasses.dataclass(frozen=True)
class Craft:
    """A craft of a packaged class, and the thruster that is weak from one of its dives on."""

    name: str
    kind: str
    weak: str | None = None
    since: int = 1

    def hides(self, dive: int) -> str | None:
        """What its log of a dive should be named for."""
        return f"thruster_gain:{self.weak}" if self.weak and dive >= self.since else None


FLEET = (
    Craft("anna", "tethra", "port_h", 4),
    Craft("berta", "tethra"),
    Craft("clara", "tethra"),
    Craft("dora", "milliampere", "aft", 3),
    Craft("emma", "milliampere"),
    Craft("frida", "milliampere"),
    Craft("greta", "cybership2", "port", 5),
    Craft("hanna", "cybership2", "star", 1),
    Craft("ida", "cybership2"),
    Craft("jana", "cybership2"),
)
# Logs whose training file breaks off after five rows, and whose test file is a picture.
CUT, PICTURE = "ida-2", "greta-2"


def dates(dive: int) -> pd.Timestamp:
    return BEGUN + (dive - 1) * EVERY


def recorded(folder: Path, fleet: Sequence[Craft], dives: int) -> Path:
    """Logs, vehicle files and the table of a fleet."""
    rows = []
    for kind in dict.fromkeys(craft.kind for craft in fleet):
        shutil.copy(jm.packaged_vehicle(kind), folder / f"{kind}.toml")
    for dive in range(1, dives + 1):
        for i, craft in enumerate(fleet):
            vehicle, name = jm.load_vehicle(folder / f"{craft.kind}.toml"), f"{craft.name}-{dive}"
            factor = {"factor": FACTOR if craft.hides(dive) else 1.0}
            target = craft.weak or vehicle.thruster_names[0]
            logs = hidden(vehicle, "thruster_gain", target, factor, LENGTHS, seed=10 * (100 * i + dive))
            row = {"craft": craft.name, "date": f"{dates(dive):%Y-%m-%d}", "vehicle": f"{craft.kind}.toml"}
            for log, part, file in zip(logs, ("train", "test"), (name, f"{name}-test"), strict=True):
                jm.write_log(log, folder / f"{file}.csv")
                row[part] = f"{file}.csv"
            rows.append(row)
    pd.DataFrame(rows).to_csv(folder / "dives.csv", index=False)
    return folder / "dives.csv"


def spoil(folder: Path) -> None:
    """Breaks two files."""
    log = folder / f"{CUT}.csv"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:6]))
    (folder / f"{PICTURE}-test.csv").write_bytes(b"\x89PNG\r\n\x1a\n" + np.random.default_rng(0).bytes(4000))


def command(folder: Path, *words: str, **environment: str) -> subprocess.Popen[bytes]:
    """A command of the package in a folder, what it says beside it."""
    with (folder / f"{words[0]}.log").open("ab") as said:
        whole = [sys.executable, "-m", "jaxmarine", *words]
        return subprocess.Popen(
            whole, cwd=folder, stdout=said, stderr=said, env={**os.environ, **environment}
        )


def answered(trials: Path) -> set[str]:
    return {path.parent.name for path in trials.glob("logs/*/outcome.json")}


def workers_of(fleet: psutil.Process) -> list[psutil.Process]:
    """The processes that diagnose."""
    return [one for one in fleet.children() if "spawn_main" in " ".join(one.cmdline())]


def run_fleet(folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """Runs the command and kills a worker; which logs were under way then, and when all was done [s]."""
    began, trials = time.time(), folder / "trials"
    running = command(folder, "fleet", "dives.csv", "--out", "trials", "--workers", str(WORKERS))
    while len(answered(trials)) < SHARE * len(names):
        if running.poll() is not None:
            raise RuntimeError((folder / "fleet.log").read_text())
        time.sleep(0.2)
    time.sleep(AMID)
    before = answered(trials)
    victim = workers_of(psutil.Process(running.pid))[0]
    victim.send_signal(signal.SIGKILL)
    if running.wait() != 0:
        raise RuntimeError((folder / "fleet.log").read_text())
    under_way = [name for name in names if name not in before][:WORKERS]
    return {"answered": len(before), "under_way": under_way, "minutes": (time.time() - began) / 60}


def labels(rows: pd.DataFrame) -> list[str]:
    return [
        effect if pd.isna(target) else f"{effect}:{target}"
        for effect, target in zip(rows["effect"], rows["target"], strict=True)
        if not pd.isna(effect)
    ]


def rows_of(table: pd.DataFrame, fleet: Sequence[Craft]) -> Iterator[dict[str, Any]]:
    """What was hidden in each log, and what its rows say."""
    craft = {one.name: one for one in fleet}
    for name, rows in table.groupby("name", sort=False):
        owner, dive = craft[str(rows["craft"].iloc[0])], int(str(name).rpartition("-")[2])
        found, first = labels(rows), rows.iloc[0]
        out = {"log": name, "kind": owner.kind, "hidden": owner.hides(dive), "found": found}
        if len(found) == 1 and first["effect"] == "thruster_gain":
            out |= {"size": float(first["sizes"][0]), "std": float(first["std"][0])}
        used = pd.isna(first["error"])
        yield out | (
            {"gain": first["gain"], "error": None} if used else {"error": re.sub(r"\S*/", "", first["error"])}
        )


def right(row: dict[str, Any]) -> bool:
    """Whether the name is that of what was hidden, and stands alone; of what has nothing hidden, no name."""
    return row["error"] is None and row["found"] == ([row["hidden"]] if row["hidden"] else [])


def alarms_of(page: str) -> list[list[str]]:
    """Craft, what and since when, as the page has them."""
    found = re.search(r'<table class="sortable" id="alarm">.*?<tbody>(.*?)</tbody>', page, re.DOTALL)
    rows = re.findall(r"<tr>(.*?)</tr>", found[1], re.DOTALL) if found else []
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", row, re.DOTALL) for row in rows]
    return [[html.unescape(re.sub(r"<[^>]*>", "", cell)).strip() for cell in row][:3] for row in cells]


def numbers(said: Any) -> list[float]:
    """All numbers of a JSON, in their order."""
    if isinstance(said, dict | list):
        parts = said.values() if isinstance(said, dict) else said
        return [x for part in parts for x in numbers(part)]
    return [float(said)] if isinstance(said, int | float) else []


def alone(folder: Path, name: str, row: dict[str, Any]) -> dict[str, Any]:
    """A log diagnosed by itself: whether the same to the last digit, and by how much it is off on all cores.

    A worker has one thread, and a sum that several share is rounded in another way.
    """
    files = ["--train", f"{name}.csv", "--test", f"{name}-test.csv"]
    for out, environment in ((f"alone/{name}", {"NPROC": "1"}), (f"cores/{name}", {})):
        words = ("--vehicle", f"{row['kind']}.toml", *files, "--out", out)
        command(folder, "diagnose", *words, **environment).wait()
    one, cores, fleet = (folder / part / name for part in ("alone", "cores", "trials/logs"))
    same = all(
        (one / file).read_bytes() == (fleet / file).read_bytes()
        for file in ("diagnosis.json", "extended.toml", "index.html")
    )
    said, other = (json.loads((where / "diagnosis.json").read_text()) for where in (one, cores))
    of_table = [row["gain"], *(row[part] for part in ("size", "std") if part in row)]
    values = [value for finding in said["findings"] for value in finding["parameters"].values()]
    of_file = [said["gain"]["ratio"], *(value[part] for value in values for part in ("value", "std"))]
    a, b = np.array(numbers(said)), np.array(numbers(other))
    return {
        "same": same and of_table == of_file,
        "off": float(np.max(np.abs(a - b) / np.maximum(np.abs(a), 1e-300))),
        "cores": len(os.sched_getaffinity(0)),
    }


def fleet_part(folder: Path, fleet: Sequence[Craft], dives: int) -> dict[str, Any]:
    """The fleet from its logs to what is counted of it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    table = recorded(folder, fleet, dives)
    names = [Path(train).stem for train in pd.read_csv(table)["train"]]
    spoil(folder)
    killed = run_fleet(folder, names)
    trials = folder / "trials"
    rows = list(rows_of(pd.read_parquet(trials / "fleet.parquet"), fleet))
    of = {row["log"]: row for row in rows}
    weak = next(name for name in reversed(names) if of[name]["hidden"])
    usable = [name for name in (*killed["under_way"], weak) if of[name]["error"] is None]
    return {
        "killed": killed,
        "logs": rows,
        "alarms": alarms_of((trials / "index.html").read_text("utf-8")),
        "alone": {name: alone(folder, name, of[name]) for name in usable},
    }


# --- a worker that lives long ------------------------------------------------------------------------


def lived(job: Job) -> Outcome:
    """A diagnosis, with what its process holds while and after it: memory maps, and memory [bytes]."""
    from jaxmarine.fleets import _work

    over, most = threading.Event(), [0]

    def watch() -> None:
        while not over.wait(1.0):
            most.append(_work._maps())

    watching = threading.Thread(target=watch)
    watching.start()
    began = time.process_time()
    try:
        outcome = _work.diagnosed(job)
    finally:
        over.set()
        watching.join()
    took = {
        "worker": psutil.Process().pid,
        "cpu": time.process_time() - began,
        "most": max(most),
        "maps": _work._maps(),
        "memory": _work._memory(),
    }
    return dataclasses.replace(outcome, rows=(took,), files={})


def aged(count: int, kinds: Sequence[str], lengths: Sequence[float]) -> dict[str, Any]:
    """One worker that diagnoses so many logs, class and length drawn for each."""
    rng, rows, names, logs = np.random.default_rng(1), [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        vehicles = {kind: jm.load_vehicle(jm.packaged_vehicle(kind)) for kind in kinds}
        for kind in kinds:
            shutil.copy(jm.packaged_vehicle(kind), folder / f"{kind}.toml")
        for i in range(count):
            kind, length = str(rng.choice(list(kinds))), float(rng.choice(lengths))
            vehicle, lasting = vehicles[kind], (length, LENGTHS[1])
            weak = (vehicle.thruster_names[0], {"factor": rng.uniform(0.6, 1.0)})
            train, test = hidden(vehicle, "thruster_gain", *weak, lasting, seed=10 * i)
            jm.write_log(train, folder / f"{i}.csv")
            jm.write_log(test, folder / f"{i}-test.csv")
            rows.append({"vehicle": f"{kind}.toml", "train": f"{i}.csv", "test": f"{i}-test.csv"})
            names.append(f"{kind} {length:g} s")
        pd.DataFrame(rows).to_csv(folder / "dives.csv", index=False)
        by = program()
        jobs = {one.slug: job_of(one, by) for one in read_entries(folder / "dives.csv", folder)}
        for _, outcome in worked(jobs, lived, workers=1):
            logs.append(outcome.rows[0] | {"error": outcome.error})
    return {
        "logs": names,
        "workers": len({one["worker"] for one in logs}),
        "errors": sum(one["error"] is not None for one in logs),
        **{part: [one[part] for one in logs] for part in ("cpu", "most", "maps", "memory")},
    }


def emptied(jobs: Sequence[Job]) -> dict[str, Any]:
    """What a process holds after some logs, and once it has let go; and the first log before and after."""
    from jaxmarine.fleets import _work

    def cpu(job: Job) -> float:
        began = time.process_time()
        _work.diagnosed(job)
        return time.process_time() - began

    first = [cpu(job) for job in jobs]
    held = [_work._maps(), _work._memory()]
    with mock.patch.object(_work, "_MAPS", 0):
        _work._let_go()
    return {"held": held, "left": [_work._maps(), _work._memory()], "cpu": [first[0], cpu(jobs[0])]}


def given_back(folder: Path) -> dict[str, Any]:
    """What comes back of a log of each class, whose programs were compiled by the fleet before."""
    by = program()
    first = {one.vehicle: one for one in reversed(read_entries(folder / "dives.csv", folder))}
    jobs = [job_of(one, by) for one in reversed(first.values())]
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(emptied, jobs).result()


def kept(path: Path, make: Callable[..., dict[str, Any]], *given: Any) -> dict[str, Any]:
    """A part of the study, made where it was not before."""
    if not path.exists():
        path.write_text(json.dumps(short(make(*given))))
    return json.loads(path.read_text())


# --- what the page has ---------------------------------------------------------------------------------


def fleet_table(results: dict[str, Any]) -> str:
    """Of each class how many answers are right."""
    lines = ["| class | craft | logs used | weak thruster named, alone | nothing hidden, nothing named |"]
    lines.append("|---|---|---|---|---|")
    for kind in dict.fromkeys(row["kind"] for row in results["logs"]):
        own = [row for row in results["logs"] if row["kind"] == kind and row["error"] is None]
        craft = {row["log"].rpartition("-")[0] for row in results["logs"] if row["kind"] == kind}
        weak, quiet = ([row for row in own if (row["hidden"] is None) is none] for none in (False, True))
        cells = [kind, len(craft), len(own)]
        cells += [f"{sum(map(right, part))} of {len(part)}" for part in (weak, quiet)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def facts(results: dict[str, Any]) -> list[str]:
    """What the page says of the rows, and of memory."""
    logs, killed, each, worker = (results[part] for part in ("logs", "killed", "alone", "worker"))
    used = [row for row in logs if row["error"] is None]
    grew = {craft.name: f"{dates(craft.since):%Y-%m-%d}" for craft in FLEET if craft.weak and craft.since > 1}
    told = {craft: since for craft, _, since in results["alarms"]}
    answered = sum(row["log"] in killed["under_way"] for row in used)
    same, off = sum(one["same"] for one in each.values()), max(one["off"] for one in each.values())
    cores, memory = max(one["cores"] for one in each.values()), np.array(worker["memory"]) / 1e9
    held, left, (before, after) = (results["given_back"][part] for part in ("held", "left", "cpu"))
    return [
        f"{sum(map(right, used))} of the {len(used)} logs that could be used have the right answer",
        f"{len(logs) - len(used)} rows have a sentence instead",
        f"{len(told)} alarms for the {len(grew)} craft whose thruster grew weak, "
        f"{sum(told.get(craft) == date for craft, date in grew.items())} of them since the right dive",
        f"killed when {killed['answered']} logs had been answered; {answered} of the "
        f"{len(killed['under_way'])} logs that were under way then have their answer",
        f"{same} of {len(each)} logs diagnosed one by one on one core are the same in every digit",
        f"on {cores} cores no number of theirs is off by more than {off:.0e} of it",
        f"{len(worker['logs'])} logs of {len(set(worker['logs']))} kinds: at most {max(worker['most'])} "
        f"memory maps of {LIMIT}, and {memory.min():.2f} to {memory.max():.2f} GB after a log",
        f"after a log of each class a process held {held[0]} memory maps and {held[1] / 1e9:.2f} GB, "
        f"and once it had let its programs go {left[0]} and {left[1] / 1e9:.2f} GB",
        f"the first log took {before:.0f} CPU seconds before that and {after:.0f} after it",
    ]


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    logs: Annotated[int, typer.Option(min=4, help="Logs of the worker that lives long.")] = 100,
    quick: Annotated[
        bool, typer.Option("--quick", help="Three craft, two dives, a worker of four logs.")
    ] = False,
) -> None:
    """Runs a fleet as its page says, hinders it, and counts; then wears a worker."""
    with study(out, False):
        (out / "parts").mkdir(exist_ok=True)
        fleet = [one for one in FLEET if one.kind == "cybership2"][:3] if quick else FLEET
        many = (4, AGED[1:2], AGED_LENGTHS[-1:]) if quick else (logs, AGED, AGED_LENGTHS)
        results = kept(out / "parts" / "fleet.json", fleet_part, out / "fleet", fleet, 2 if quick else DIVES)
        results["worker"] = kept(out / "parts" / "worker.json", aged, *many)
        results["given_back"] = kept(out / "parts" / "given_back.json", given_back, out / "fleet")
        said = "\n".join(f"- {one}" for one in facts(results))
        text = f"{fleet_table(results)}\n{said}\n"
        write_results(out, results, text)


if __name__ == "__main__":
    typer.run(main)
