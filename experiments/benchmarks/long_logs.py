"""What does a whole diagnosis take of a long log, in time and in memory?

usage: python -m experiments.benchmarks.long_logs --out DIR [--hours 10 ...] [--quick]

The ROV Tethra with a weak thruster, at 10 Hz, the full catalogue; each log in a process of its own, whose
peak of resident memory is what counts: the log, its windows, every compiled program and the report's
numbers are in it. The time has compilation in it, unless JAX_COMPILATION_CACHE_DIR has the programs. The
truth of the thruster's factor is the reference. Writes results.json and results.md.
"""

import dataclasses
import multiprocessing
import resource
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer
from rich.progress import track

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.benchmarks._rounds import machine, spelt
from experiments.benchmarks.diagnosis import FACTOR
from jaxmarine.examples import hidden

# Of the log on which the gain is measured [s].
TEST = 150.0


@dataclasses.dataclass(frozen=True)
class Run:
    """A diagnosis of a log of some length [s]: what it took [s], its peak of memory [bytes], its answer."""

    length: float
    seconds: float
    peak: int
    found: tuple[str, ...]
    factor: float | None


def diagnosed(length: float) -> Run:
    """To be called in a process of its own."""
    jax.config.update("jax_enable_x64", True)
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    logs = hidden(vehicle, "thruster_gain", "port_h", {"factor": FACTOR}, (length, TEST))
    began = time.perf_counter()
    findings = jm.diagnose(vehicle, *logs).findings
    seconds = time.perf_counter() - began
    factors = [f.parameters["factor"].value for f in findings if f.label == "thruster_gain:port_h"]
    # Linux counts it in kibibytes.
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return Run(length, seconds, peak, tuple(f.label for f in findings), factors[0] if factors else None)


def exponent(runs: Sequence[Run], of: str) -> float | None:
    """Slope over the length of the log, both logarithmic, of the two longest."""
    if len(runs) < 2:
        return None
    low, high = sorted(runs, key=lambda run: run.length)[-2:]
    return float(np.log(getattr(high, of) / getattr(low, of)) / np.log(high.length / low.length))


def table(runs: Sequence[Run]) -> str:
    lines = ["| log | diagnosis | peak of memory | found | factor (true: 0.72) |", "|---|---|---|---|---|"]
    for run in runs:
        factor = "–" if run.factor is None else f"{run.factor:.4f}"
        lines.append(
            f"| {run.length / 3600:.3g} h | {spelt(run.seconds)} | {run.peak / 1e9:.2f} GB | "
            f"{', '.join(run.found)} | {factor} |"
        )
    powers = [exponent(runs, of) for of in ("seconds", "peak")]
    if None not in powers:
        lines += [
            "",
            "Between the two longest, time grows to the power {:.2f}, memory {:.2f}.".format(*powers),
        ]
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and table.")],
    hours: Annotated[list[float] | None, typer.Option(min=0.01, help="Lengths of the logs [h].")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One log of 40 s.")] = False,
) -> None:
    """Diagnoses logs of several lengths."""
    lengths = [40.0] if quick else [3600.0 * one for one in hours or (1 / 12, 1.0, 10.0)]
    runs = []
    with study(out, quick):
        for length in track(lengths, "long logs", transient=True):
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
                runs.append(alone.submit(diagnosed, length).result())
            write_results(
                out, {"machine": machine(), "runs": [dataclasses.asdict(run) for run in runs]}, table(runs)
            )
    print(table(runs))


if __name__ == "__main__":
    typer.run(main)
