"""What a disturbance in the model is worth where nothing was fitted: likelihoods one step ahead.

usage: python -m experiments.one_step_ahead --vehicle FILE --train LOG … --test LOG … --out DIR [--map MAP]

Two models of the same fitted craft say how likely each measured number of the test logs is, all before it
known: one whose errors are white noise of the sensors, and one beside a disturbance on each axis (a
Gauss-Markov wrench), whose sizes and memories are estimated from the training logs. Windows begin with any
state. What the sensors' noise is nobody says of most measured craft, so that both take the share of what the
file misses (`SHARES`) that makes the training logs likeliest.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from jaxtyping import Float
from rich.progress import track

import jaxmarine as jm
from experiments._study import study, write_results
from jaxmarine.diagnosis._amid import disturbed
from jaxmarine.diagnosis._explanation import Model
from jaxmarine.diagnosis._innovations import log_score
from jaxmarine.diagnosis._prepare import opened_with
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.effects import LinearDamping

# Of what the file misses, the sensors' own noise being the least.
SHARES = (1.0, 0.3, 0.1, 0.03, 0.01)
WHITE, BESIDE = "white noise", "beside a disturbance"
# A disturbance of this share of the usual size is none.
NOTHING = 1e-6
Row = dict[str, Any]


def with_noise(bench: Workbench, noise: Float[np.ndarray, " channels"]) -> Workbench:
    """The workbench with another noise of its channels, every sample counting for one."""
    return bench._like(noise=noise).on(bench.data.logs)


def nats(bench: Workbench, model: Model) -> float:
    """Logarithm of the density of each measured number [nats], in SI units, all before it known."""
    measured = (np.asarray(bench.cut.windows.weight) > 0).sum(axis=(0, 1))
    own = np.log(bench.noise[measured > 0]) @ measured[measured > 0] / measured.sum()
    return log_score(bench, model, weathers=1) - float(own)


def without(model: Model) -> Model:
    """The model beside a disturbance that does nothing: errors are white noise."""
    assert model.beside is not None
    still = dataclasses.replace(model.beside.force, size=NOTHING * model.beside.force.size)
    return dataclasses.replace(model, beside=dataclasses.replace(model.beside, force=still))


def scores(bench: Workbench, tests: Sequence[jm.Log]) -> dict[str, dict[str, float]]:
    """Nats per number of training and test logs by the file, of either model."""
    begun, on = disturbed(bench, bench.frozen(bench.start())), bench.on(tests)
    models = {WHITE: without(begun), BESIDE: bench.likeliest(begun)}
    return {name: {"train": nats(bench, one), "test": nats(on, one)} for name, one in models.items()}


def compared(vehicle: jm.Vehicle, train: Sequence[jm.Log], test: Sequence[jm.Log]) -> Row:
    """Of either model the share of the noise that makes the training logs likeliest, and its nats."""
    opened = opened_with(vehicle, train, test, (LinearDamping,), None)
    every: Row = {}
    for share in track(SHARES, "noises", transient=True):
        noise = np.fmax(share * opened.bench.noise, opened.bench.own_noise)
        every[f"{share:g}"] = scores(with_noise(opened.bench, noise), opened.tests)
    best = {name: max(every, key=lambda share: every[share][name]["train"]) for name in (WHITE, BESIDE)}
    return {
        "best": {name: {"share": share, **every[share][name]} for name, share in best.items()},
        "all": every,
    }


def table(found: Row) -> str:
    """The likeliest of either model as Markdown."""
    lines = ["| | share of what is missed | nats per number, training | test |", "|---" * 4 + "|"]
    lines += [
        f"| {name} | {one['share']} | {one['train']:.2f} | {one['test']:.2f} |"
        for name, one in found["best"].items()
    ]
    return "\n".join(lines) + "\n"


def main(
    vehicle: Annotated[Path, typer.Option(help="Fitted vehicle file.")],
    train: Annotated[list[Path], typer.Option(help="Log that it was fitted to; repeat it.")],
    test: Annotated[list[Path], typer.Option(help="Log that nothing was fitted to; repeat it.")],
    out: Annotated[Path, typer.Option(help="Folder for results.")],
    columns: Annotated[Path | None, typer.Option("--map", help="What the logs' columns are.")] = None,
) -> None:
    """Says how likely test logs are one step ahead, with and without a disturbance in the model."""
    with study(out, quick=False):
        craft = jm.load_vehicle(vehicle)
        logs = [[jm.read_log(path, craft, columns) for path in paths] for paths in (train, test)]
        found = compared(craft, *logs)
        write_results(out, found, table(found))
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
