"""What does a diagnosis cost: its screening, all of it, and a second start on the machine?

usage: python -m experiments.benchmarks.diagnosis --out DIR [--rounds 3] [--quick]

The ROV Tethra with a weak thruster, 300 s at 10 Hz, the full catalogue. The screening is compared with
forward tangents through the solver for all parameters and initial states; its own sensitivities are those
of the midpoint of a step, and fluid memory follows the measured velocity. The whole diagnosis is asked for
the thruster's factor, whose truth is the reference. Starts are processes of the command line, with a cache
of compiled programs that is empty at the first. Writes results.json and results.md.
"""

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxmarine as jm
from experiments.benchmarks._rounds import Table, Target, Timing, benchmark, compared, difference, report
from jaxmarine._compiled import compiled
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._workbench import SEGMENTS
from jaxmarine.effects import AddedMass, LinearDamping, QuadraticDamping, ThrusterGain
from jaxmarine.examples import hidden
from jaxmarine.fitting import Problem, predict

FACTOR = 0.72
# The catalogue of a quick run.
FEW = (AddedMass, LinearDamping, QuadraticDamping, ThrusterGain)
TANGENTS, OURS, WHOLE = "forward tangents", "jaxmarine, screen", "jaxmarine, diagnose, warm"
FIRST, SECOND = "first start", "second start"
COMMAND = "from jaxmarine.cli import main; main()"


@compiled
def by_tangents(problem: Problem, theta, delta):
    """Chi-square, gradient and information of the parameters, each window's initial state eliminated."""

    def residual(theta, moved):
        return predict(problem, jnp.tile(theta[None], (SEGMENTS, 1)), delta + moved[None])[1]

    error = residual(theta, jnp.zeros(12)).reshape(len(delta), -1)
    by_theta, by_start = jax.jacfwd(residual, argnums=(0, 1))(theta, jnp.zeros(12))

    def eliminated(error, by_theta, by_start):
        inverse = jnp.linalg.inv(by_start.T @ by_start + jnp.diag(problem.start_precision))
        g, h = by_start.T @ error, by_start.T @ by_theta
        return (
            error @ error - g @ inverse @ g,
            by_theta.T @ error - h.T @ inverse @ g,
            by_theta.T @ by_theta - h.T @ inverse @ h,
        )

    flat = [a.reshape(*error.shape, -1) for a in (by_theta, by_start)]
    return jax.lax.map(lambda one: eliminated(*one), (error, *flat))


def screening(vehicle: jm.Vehicle, log: jm.Log, catalogue: Sequence[Any], rounds: int) -> Table:
    """The statistics of every suspect, at the vehicle as filed."""
    bench = workbench(vehicle, (log,), catalogue, None)
    model = bench.start()
    problem, theta, size = bench.problem(()), jnp.asarray(bench.layout.neutral), bench.layout.size

    def screened():
        # A model that it has not met, or it would remember the answer.
        found = bench.screen(dataclasses.replace(model))
        return found.chi2, found.g[:, :size], found.h[:, :size, :size]

    def tangents():
        # The arrays are filled up with windows that weigh nothing.
        return [part[: bench.count] for part in by_tangents(problem, theta, model.delta)]

    makers = {TANGENTS: lambda: tangents, OURS: lambda: screened}
    title = f"Screening, {size} parameters, {bench.count} windows"
    return compared(title, makers, tangents(), TANGENTS, rounds)


def factor(findings: Sequence[Any]) -> float:
    """Of the weak thruster; one where it was not found."""
    found = {f["effect"]: f for f in findings}
    return found["thruster_gain"]["parameters"]["factor"]["value"] if "thruster_gain" in found else 1.0


def whole(vehicle: jm.Vehicle, logs: tuple[jm.Log, jm.Log], catalogue: Sequence[Any], rounds: int) -> Table:
    """The whole diagnosis in one process, whose programs are compiled."""

    def run():
        findings = jm.diagnose(vehicle, *logs, catalogue=catalogue).findings
        return np.array(factor([dataclasses.asdict(finding) for finding in findings]))

    makers: dict[str, Any] = {WHOLE: lambda: run}
    return compared("Whole diagnosis, compiled", makers, np.array(FACTOR), WHOLE, rounds)


def starts(logs: tuple[jm.Log, jm.Log], out: Path, rounds: int) -> Table:
    """The command line, from the first start on the machine on."""
    folder = (out / f"cache-{time.time_ns()}").absolute()
    folder.mkdir()
    for log, name in zip(logs, ("train", "test"), strict=True):
        jm.write_log(log, folder / f"{name}.csv")
    arguments = ["--vehicle", str(jm.packaged_vehicle("tethra")), "--train", str(folder / "train.csv")]
    arguments += ["--test", str(folder / "test.csv"), "--out", str(folder / "report")]
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    seconds: list[float] = []
    off = 0.0
    for _ in range(1 + rounds):
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", COMMAND, "diagnose", *arguments],
            env={**environment, "XDG_CACHE_HOME": str(folder)},
            capture_output=True,
            check=True,
        )
        seconds.append(time.perf_counter() - began)
        told = json.loads((folder / "report" / "diagnosis.json").read_text(encoding="utf-8"))
        off = max(off, difference(np.array(factor(told["findings"])), np.array(FACTOR)))
    timings = {FIRST: Timing((seconds[0],), off), SECOND: Timing(tuple(seconds[1:]), off)}
    return Table("Whole diagnosis by the command line", timings, FIRST)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 3,
    quick: Annotated[bool, typer.Option("--quick", help="A short log, four effects, no starts.")] = False,
) -> None:
    """Times the diagnosis of a weak thruster."""
    seconds, catalogue, rounds = (40.0, FEW, 1) if quick else (300.0, jm.CATALOGUE, rounds)
    with benchmark(out, quick):
        vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
        logs = hidden(
            vehicle, "thruster_gain", "port_h", {"factor": FACTOR}, (seconds, max(seconds / 3, 20.0))
        )
        tables = [screening(vehicle, logs[0], catalogue, rounds), whole(vehicle, logs, catalogue, rounds)]
        targets = []
        if not quick:
            tables.append(starts(logs, out, rounds))
            targets.append(Target("whole diagnosis, second start [s]", tables[-1], SECOND, None, 20.0))
        report(out, tables, targets)


if __name__ == "__main__":
    typer.run(main)
