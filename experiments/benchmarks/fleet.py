"""What does a fleet cost: per log, per core, and per task of the scheduler?

usage: python -m experiments.benchmarks.fleet --out DIR [--logs 8] [--quick]

Logs of the ROV Tethra with weak thrusters, 300 s at 10 Hz, the full catalogue, on one and on two workers of
this machine. The first logs of each worker load its programs and are not counted. Tasks that do nothing show
what the scheduler takes of each. From these numbers follows what more cores would do, if nothing else came in
their way. Writes results.json and results.md.
"""

import dataclasses
import json
import os
import pickle
import resource
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.benchmarks._rounds import machine
from jaxmarine._program import program
from jaxmarine.examples import hidden
from jaxmarine.fleets._engine import worked
from jaxmarine.fleets._job import Job, Outcome, job_of
from jaxmarine.fleets._table import read_entries

# Bytes that a network and a file system give per second, each way: a gigabit.
NETWORK = 125e6
CORES = (1, 100, 10_000)
# CPU seconds per log that are wanted.
WANTED = 6.0


def timed(job: Job) -> Outcome:
    """A diagnosis with what it took of its worker: CPU [s], memory maps, peak of memory and size [bytes]."""
    from jaxmarine.fleets._work import diagnosed

    began = time.process_time()
    outcome = diagnosed(job)
    maps = Path("/proc/self/maps")
    took = {
        "cpu": time.process_time() - began,
        "maps": len(maps.read_bytes().splitlines()) if maps.exists() else 0,
        # Linux counts it in kibibytes.
        "peak": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "bytes": len(pickle.dumps(outcome)),
        "worker": os.getpid(),
        "at": time.time(),
    }
    return dataclasses.replace(outcome, rows=(took, *outcome.rows))


def nothing(job: Job) -> Outcome:
    """Work that takes no time."""
    del job
    return Outcome()


def jobs_of(folder: Path, count: int, lengths: tuple[float, float]) -> dict[str, Job]:
    """A fleet of one class, each craft with a thruster of its own weakness."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    jm.save_vehicle(vehicle, folder / "tethra.toml")
    rows = []
    for i in range(count):
        factor = {"factor": 0.6 + 0.3 * i / count}
        logs = hidden(vehicle, "thruster_gain", "port_h", factor, lengths, seed=10 * i)
        for log, kind in zip(logs, ("train", "test"), strict=True):
            jm.write_log(log, folder / f"{kind}{i}.csv")
        rows.append({"vehicle": "tethra.toml", "train": f"train{i}.csv", "test": f"test{i}.csv"})
    pd.DataFrame(rows).to_csv(folder / "table.csv", index=False)
    by = program()
    return {one.slug: job_of(one, by) for one in read_entries(folder / "table.csv", folder)}


def on_workers(jobs: dict[str, Job], workers: int) -> dict[str, Any]:
    """CPU per log and logs per second, without each worker's first log."""
    took = []
    for name, outcome in worked(jobs, timed, workers=workers):
        if outcome.error is not None:
            raise RuntimeError(f"{name}: {outcome.error}")
        took.append(outcome.rows[0])
    by_worker: dict[int, list[dict[str, Any]]] = {}
    for one in took:
        by_worker.setdefault(one["worker"], []).append(one)
    warm = [one for own in by_worker.values() for one in own[1:]]
    pace = sum((len(own) - 1) / (own[-1]["at"] - own[0]["at"]) for own in by_worker.values() if len(own) > 1)
    return {
        "workers": workers,
        "logs": len(took),
        "cpu_per_log": float(np.median([one["cpu"] for one in warm])),
        "logs_per_second": pace,
        "bytes_per_log": float(np.median([one["bytes"] for one in took])),
        "maps": max(one["maps"] for one in took),
        "peak": max(one["peak"] for one in took),
    }


def overhead(count: int) -> float:
    """Seconds of the scheduler, the client and the worker per task that does nothing."""
    job = Job("", "nothing", "", (), (), (), "")
    arrivals = [time.perf_counter() for _ in worked({str(i): job for i in range(count)}, nothing, workers=1)]
    return (arrivals[-1] - arrivals[0]) / (count - 1)


def on_paper(cpu: float, task: float, size: float) -> list[dict[str, Any]]:
    """Logs per second with more cores, and what holds them up."""
    out = []
    for cores in CORES:
        limits = {"cores": cores / cpu, "scheduler": 1 / task, "network": NETWORK / size}
        first = min(limits, key=lambda name: limits[name])
        out.append({"cores": cores, "logs_per_second": limits[first], "held_by": first, "limits": limits})
    return out


def text_of(results: dict[str, Any]) -> str:
    """The tables of the results."""
    (one, two), paper = results["workers"], results["on_paper"]
    lines = [
        "| workers | CPU seconds per log | logs per minute | bytes per log | memory | memory maps |",
        "|---|---|---|---|---|---|",
        *(
            f"| {run['workers']} | {run['cpu_per_log']:.1f} | {60 * run['logs_per_second']:.2f} "
            f"| {run['bytes_per_log'] / 1e6:.2f} MB | {run['peak'] / 1e9:.2f} GB | {run['maps']} |"
            for run in (one, two)
        ),
        "",
        f"Efficiency of two workers: {two['logs_per_second'] / (2 * one['logs_per_second']):.2f}; "
        f"{1e3 * results['overhead']:.1f} ms per task that does nothing; wanted {WANTED:g} CPU s per log.",
        "",
        "| cores | logs per second | held by |",
        "|---|---|---|",
        *(f"| {row['cores']} | {row['logs_per_second']:.3g} | {row['held_by']} |" for row in paper),
    ]
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    logs: Annotated[int, typer.Option(min=4, help="Logs on each number of workers.")] = 8,
    quick: Annotated[bool, typer.Option("--quick", help="Short logs.")] = False,
) -> None:
    """Measures a fleet on this machine, and says what more cores would do."""
    with study(out, False), tempfile.TemporaryDirectory() as folder:
        jobs = jobs_of(Path(folder), 4 if quick else logs, (40.0, 30.0) if quick else (300.0, 150.0))
        size = sum(Path(path).stat().st_size for job in jobs.values() for path in (*job.train, *job.test))
        runs = [on_workers(jobs, workers) for workers in (1, 2)]
        task = overhead(100 if quick else 1000)
        results = {
            "machine": machine(),
            "workers": runs,
            "read_per_log": size / len(jobs),
            "overhead": task,
            "on_paper": on_paper(runs[0]["cpu_per_log"], task, runs[0]["bytes_per_log"] + size / len(jobs)),
        }
        write_results(out, json.loads(json.dumps(results)), text_of(results))


if __name__ == "__main__":
    typer.run(main)
