"""How a network inside the physics is best trained, over how many weights it has.

usage: python -m experiments.many_weights --out DIR [--quick]

The ship and the logs are those of `nonlinear_damping`: CyberShip II with a pod, lift, cross-flow and wave
drag, by a file whose inertia is 30 % too large. Mass, linear and quadratic damping and a network of the
velocities with two hidden layers are fitted to one log by trajectories: by Gauss-Newton in all numbers, or by
gradients in the hidden layers. Measured are processor time and memory of the fit, compilation included, the
error of predictions over 10 s on a log that was not fitted, and how much of its true velocities a band of
vehicles drawn from the fit holds. Every fit has a process of its own. What Gauss-Newton has no room for is
told by the memory of its information alone: windows times weights squared. It goes on where it was cut.
"""

import concurrent.futures
import dataclasses
import functools
import json
import multiprocessing
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
import typer
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.nonlinear_damping import (
    AXES,
    DT,
    Course,
    _sizes,
    course,
    craft,
    errors,
    free,
    heavier,
    log_of,
    sailed,
    scored,
    true_plant,
)
from jaxmarine.fitting import noise_of
from jaxmarine.networks import mlp_damping

HERE = Path(__file__).parent / "weights"
WINDOW = 4.0  # [s]
SPREAD = 1.0  # prior of a weight, over the root of how many are summed: forces of their typical size
BAND, DRAWS, SINCE = 0.9, 100, 1.0  # a band's share of the draws, how many, from when on it is judged [s]
MOST = 600  # weights that Gauss-Newton is asked for: of 513 it takes some minutes


@dataclasses.dataclass(frozen=True)
class Size:
    """Nodes in each hidden layer (0: no network), lengths of the logs [s], and steps of a fit."""

    widths: tuple[int, ...] = (0, 67, 19, 4)
    duration: float = 200.0
    unseen: float = 100.0
    steps: int = 20


QUICK = Size(widths=(2,), duration=30.0, unseen=30.0, steps=3)


def start_of(log: jm.Log, width: int) -> jm.Vehicle:
    """The file with a network that changes nothing yet."""
    vehicle = heavier(craft())
    if not width:
        return vehicle
    nu, size = _sizes(vehicle, log)
    key = jax.random.key(0)
    term = mlp_damping(AXES, np.abs(nu).max(axis=0), size, key, width=width, depth=2, seen=nu)
    return vehicle.place(jm.Placed(term))


def width_of(name: str, leaf: Any) -> Any:
    """Of the prior: none of mass and damping; of weights so that a sum of many is as large as one of few.

    After Neal (1996), Bayesian Learning for Neural Networks.
    """
    shape = np.shape(leaf)
    wide = SPREAD / np.sqrt(shape[1] if len(shape) == 2 else 1.0) if name == "network" else np.inf
    return np.full(shape, wide)


def most_memory() -> float:
    """What this process has taken at most, so far [MB]; what `getrusage` tells begins at its parent's."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (peak,) = (line for line in lines if line.startswith("VmHWM:"))
    return float(peak.split()[1]) / 1024


def measured(width: int, solver: Any, size: Size, quick: bool) -> dict[str, Any]:
    """One fit, in a process that does nothing else."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_disable_most_optimizations", quick)
    truth = true_plant()
    log = log_of(truth, sailed(size.duration, 100), 200)
    start = start_of(log, width)
    prior = {
        name: jax.tree.map(functools.partial(width_of, name), part) for name, part in free(start).items()
    }
    noise = noise_of(start, [log])
    before, cpu, clock = most_memory(), time.process_time(), time.time()
    fit = jm.fit(
        start,
        log,
        free,
        solver=solver,
        prior=prior,
        entries="diagonal",
        window=WINDOW,
        max_steps=size.steps,
        noise=noise,
        throw=False,
    )
    taken, clock = time.process_time() - cpu, time.time() - clock
    more = most_memory() - before
    run = course(truth, sailed(size.unseen, 300))
    every = np.ones(len(run.t) // 50, bool)
    return {
        "width": width,
        "weights": weights_of(start),
        "solver": solver,
        "cpu_s": taken,
        "wall_s": clock,
        "memory_mb": more,
        "held": held(fit, run),
        "distance_10s": scored(fit.vehicle, run, every)["distance_10s"],
        "mass_surge": float(fit.vehicle.mass_matrix[0, 0] / truth.mass_matrix[0, 0]),
        "reduced_chi2": fit.reduced_chi2,
        "converged": fit.converged,
        "result": fit.result,
    }


def held(fit: jm.Fit, run: Course) -> float:
    """Share of the true velocities [u, v, r] that a band about the mean of drawn vehicles holds.

    Their scatter is taken as normal; predictions start in the true state, and from `SINCE` on they count. A
    drawn vehicle that runs away leaves a band that holds nothing.
    """
    drawn = fit.draw(DRAWS, jax.random.key(1))
    off = np.array([errors(vehicle, run)[1] for vehicle in drawn])[:, :, round(SINCE / DT) :]
    reach = scipy.stats.norm.ppf(0.5 + BAND / 2) * off.std(axis=0, ddof=1)
    return float((np.abs(off.mean(axis=0)) <= reach).mean())


def weights_of(vehicle: jm.Vehicle) -> int:
    """How many the network has."""
    return sum(jnp.size(leaf) for leaf in jax.tree.leaves(free(vehicle)["network"]))


def table(rows: list[dict[str, Any]]) -> str:
    """A line per fit."""
    lines = [
        f"| weights | by | CPU s | memory MB | unseen: m after 10 s | a band of {100 * BAND:.0f} % holds |"
    ]
    lines.append("|---|---|---|---|---|---|")
    for row in rows:
        by = row["solver"].replace("_", "-").replace("gauss-newton", "Gauss-Newton")
        cells = (f"{row['cpu_s']:.0f}", f"{row['memory_mb']:.0f}", f"{row['distance_10s']:.3f}")
        cells = (*cells, f"{100 * row['held']:.0f} %")
        lines.append(f"| {row['weights']} | {by} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    quick: Annotated[bool, typer.Option("--quick", help="A small network, a short log, few steps.")] = False,
) -> None:
    """Compares Gauss-Newton with gradients over the number of weights."""
    size, kept = QUICK if quick else Size(), out / "results.json"
    rows: list[dict[str, Any]] = json.loads(kept.read_text())["rows"] if kept.exists() else []
    with study(out, quick), Progress(transient=True) as bar:
        asked = [
            (width, solver)
            for width in size.widths
            for solver in (("gauss_newton", "gradients") if width else ("gauss_newton",))
            if solver == "gradients" or width**2 + 8 * width < MOST
        ]
        done = {(row["width"], row["solver"]) for row in rows}
        for width, solver in bar.track([one for one in asked if one not in done], description="fits"):
            with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
                rows.append(alone.submit(measured, width, solver, size, quick).result())
            rows.sort(key=lambda row: (row["width"], row["solver"]))
            information = size.duration / WINDOW * rows[-1]["weights"] ** 2 * 8 / 1e9
            results = {"duration_s": size.duration, "last_information_gb": information, "rows": rows}
            write_results(out, results, table(rows))


if __name__ == "__main__":
    typer.run(main)
