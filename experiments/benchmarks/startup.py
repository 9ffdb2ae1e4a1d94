"""How long until something happens: imports, the command line's help, compilation with and without its cache?

usage: python -m experiments.benchmarks.startup --out DIR [--rounds 7] [--quick]

Every time is that of a process of its own. What Python needs by itself is in all of them. The Gauss-Newton
program is that of `gradient` with 24 parameters; what it comes to is compared between the processes.
Writes results.json and results.md.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from experiments.benchmarks._rounds import Run, Table, Uncompared, benchmark, compared, report

IMPORTS = {
    "python alone": "pass",
    "import jax, diffrax": "import jax, diffrax",
    "import jaxmarine": "import jaxmarine",
    "import jaxmarine, all that it has": "import jaxmarine as jm; jm.diagnose, jm.simulate, jm.write_report",
    "jaxmarine --help": "import sys; sys.argv[1:] = ['--help']; from jaxmarine.cli import main; main()",
}

# Prints the seconds of tracing, compiling and running, and the curvature that comes out.
PROGRAM = """
import json, time
import jax
jax.config.update("jax_enable_x64", True)
from experiments.benchmarks._windows import fitting, logged
from experiments.benchmarks.gradient import gauss_newton_of
case = fitting(logged(16.0), 40)
marks = [time.perf_counter()]
traced = jax.jit(gauss_newton_of).lower(case)
marks.append(time.perf_counter())
program = traced.compile()
marks.append(time.perf_counter())
curvature, _ = jax.block_until_ready(program(case))
marks.append(time.perf_counter())
seconds = [after - before for before, after in zip(marks, marks[1:])]
print(json.dumps({"seconds": seconds, "curvature": curvature.diagonal().tolist()}))
"""


def child(code: str, **environment: str) -> str:
    """What a fresh interpreter prints."""
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return ran.stdout


def imports(rounds: int) -> Table:
    """Processes that import and end."""

    def ready(code: str) -> Callable[[], Run]:
        return lambda: lambda: Uncompared(len(child(code)))

    makers = {name: ready(code) for name, code in IMPORTS.items()}
    return compared("Start of a process", makers, None, "import jax, diffrax", rounds)


def compilation(rounds: int) -> tuple[Table, dict[str, list[float]]]:
    """A process that needs the Gauss-Newton program; and medians of tracing, compiling and running [s]."""
    parts: dict[str, list[list[float]]] = {}

    def ready(name: str, cache: str) -> Callable[[], Run]:
        def run():
            printed = child(
                PROGRAM,
                JAX_COMPILATION_CACHE_DIR=cache,
                JAX_ENABLE_COMPILATION_CACHE=str(bool(cache)),
                JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
                JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES="-1",
            )
            told = json.loads(printed)
            parts.setdefault(name, []).append(told["seconds"])
            return np.array(told["curvature"])

        return lambda: run

    with tempfile.TemporaryDirectory() as cache:
        makers = {
            "compiled anew": ready("compiled anew", ""),
            # The run that warms a contender up fills the cache.
            "from the persistent cache": ready("from the persistent cache", cache),
        }
        reference = np.array(json.loads(child(PROGRAM))["curvature"])
        table = compared(
            "A process with the Gauss-Newton program", makers, reference, "compiled anew", rounds
        )
    return table, {name: np.median(rows[1:], axis=0).tolist() for name, rows in parts.items()}


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 7,
    quick: Annotated[bool, typer.Option("--quick", help="One round.")] = False,
) -> None:
    """Times imports and compilation."""
    rounds = 1 if quick else rounds
    with benchmark(out, quick):
        started = imports(rounds)
        compiled, parts = compilation(rounds)
        report(out, [started, compiled], more={"tracing, compiling, running [s]": parts})


if __name__ == "__main__":
    typer.run(main)
