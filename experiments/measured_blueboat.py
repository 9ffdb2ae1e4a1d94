"""A measured boat that nobody prepared: from a guessed file to a fitted and a diagnosed model, by commands.

usage: python -m experiments.measured_blueboat --data DIR --out DIR [--quick]

Runs `jaxmarine check`, `fit` and `diagnose` on runs of a BlueBoat (`blueboat/README.md` says where they are
found) as one would by hand, and measures the errors of open-loop predictions on four runs that nothing was
fitted to. `--quick`: two runs, no diagnosis.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Float
from scipy.stats import bootstrap

import jaxmarine as jm
from experiments._study import save_figure, study, write_results
from jaxmarine._types import CHANNELS as NAMES

HERE = Path(__file__).parent / "blueboat"
GUESS = HERE / "boat.toml"
AS_NAMED, COLUMNS = HERE / "as_named.toml", HERE / "columns.toml"
TRAIN = (216, 218, 221, 222, 223, 224, 226, 228, 232, 233, 235, 239)
TEST = (220, 225, 230, 234)
QUICK = (226, 233)
FREED = ("added_mass", "damping", "thrust", "reverse_thrust")
# What a boat commonly has beside that: lift of its hull in turns, a dead zone of its motor controllers, and
# thrust that is not linear in the command.
OF_BOATS = ("turning_lift", "hull_lift", "deadband", "curve")
# Once the effects are named, the shape of the thrust as well.
FREED_AGAIN = (*FREED, "curve")
PRIOR = "0.5"
CHANNELS, UNITS = ("u", "v", "r"), ("m/s", "m/s", "rad/s")
PLACES = np.array([NAMES.index(name) for name in CHANNELS])
HORIZON = 5.0  # [s]
# What a throw-away trial of some hundred lines reached on the same four runs.
TRIAL = {
    "trial: asymmetric thrust": (0.102, 0.065, 0.085),
    "trial: also gains, dead band, damping with |u| r": (0.085, 0.065, 0.046),
}

Errors = Float[np.ndarray, "samples 3"]


def runs(data: Path, numbers: Sequence[int]) -> list[Path]:
    return [data / f"fixed_{number:08d}.csv" for number in numbers]


def command(*words: str | Path) -> tuple[str, float]:
    """What a `jaxmarine` command prints, and how long it took [s]; raises where it refuses."""
    began = time.perf_counter()
    call = [sys.executable, "-c", "from jaxmarine.cli import main; main()", *map(str, words)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    print(f"$ jaxmarine {' '.join(map(str, words))}\n{done.stdout}{done.stderr}", flush=True)
    if done.returncode:
        raise SystemExit(f"jaxmarine {words[0]} ended with {done.returncode}: {done.stderr}")
    return done.stdout, time.perf_counter() - began


def repeated(option: str, values: Sequence[str | Path]) -> list[str | Path]:
    return [word for value in values for word in (option, value)]


# --- errors --------------------------------------------------------------------------------------


def started(vehicle: jm.Vehicle, log: jm.Log) -> jm.State:
    """The state at the first sample, as measured; what sensors of the vehicle add to it is taken off."""
    channels = np.nan_to_num(log.channels[0])
    true = channels.copy()
    for _ in range(2):  # once is enough for sensors that add what does not depend on what they show
        state = jm.initial_state(vehicle, true[:3], true[3:6], true[6:12])
        shown = np.asarray(vehicle.plant().readings(state, jnp.zeros(6)))
        true = true + np.where(np.isfinite(log.channels[0]), channels - shown, 0.0)
    return jm.initial_state(vehicle, true[:3], true[3:6], true[6:12])


def predicted(vehicle: jm.Vehicle, log: jm.Log) -> Errors:
    """u, v, r of simulations that restart from the measured state every `HORIZON`, but for a rest."""
    steps = round(HORIZON / log.dt)
    out = np.full((len(log.t), 3), np.nan)
    for first in range(0, len(log.t) - steps, steps):
        part = log.between(log.t[first], log.t[first + steps])
        out[first : first + steps] = np.asarray(jm.simulate(vehicle, part, started(vehicle, part)).channels)[
            :, PLACES
        ]
    return out


def held(log: jm.Log) -> Errors:
    """The start velocity, held over each horizon: what a model has to do better than."""
    steps = round(HORIZON / log.dt)
    out = np.full((len(log.t), 3), np.nan)
    for first in range(0, len(log.t) - steps, steps):
        out[first : first + steps] = np.nan_to_num(log.channels[first, PLACES])
    return out


def rms(predictions: Sequence[Errors], logs: Sequence[jm.Log]) -> list[float]:
    """Root mean square error per channel over all samples of all logs."""
    errors = np.concatenate([p - log.channels[:, PLACES] for p, log in zip(predictions, logs, strict=True)])
    return np.sqrt(np.nanmean(errors**2, axis=0)).tolist()


def within(predictions: Sequence[Errors], logs: Sequence[jm.Log]) -> list[list[float]]:
    """95 % intervals of `rms`, by a bootstrap of whole predictions (after Efron 1979)."""
    each = []
    for one, log in zip(predictions, logs, strict=True):
        square, steps = (one - log.channels[:, PLACES]) ** 2, round(HORIZON / log.dt)
        whole = len(square) - (len(square) - 1) % steps - 1
        each.append(np.nanmean(square[:whole].reshape(-1, steps, len(CHANNELS)), axis=1))

    def of(squares: np.ndarray, axis: int) -> np.ndarray:
        return np.sqrt(np.nanmean(squares, axis=axis))

    drawn = bootstrap((np.concatenate(each),), of, axis=0, method="percentile", rng=np.random.default_rng(0))
    return np.stack([drawn.confidence_interval.low, drawn.confidence_interval.high], axis=-1).tolist()


def figure(models: dict[str, jm.Vehicle], logs: Sequence[jm.Log], path: Path) -> None:
    """Measured and predicted velocities of each run."""
    plot, axes = plt.subplots(3, len(logs), figsize=(4.2 * len(logs), 6.5), sharex="col", squeeze=False)
    for column, log in enumerate(logs):
        t = log.t - log.t[0]
        for row, (name, unit) in enumerate(zip(CHANNELS, UNITS, strict=True)):
            axes[row, column].plot(t, log.channels[:, PLACES[row]], color="0.5", lw=1.5, label="measured")
            axes[row, column].set_ylabel(f"{name} ({unit})")
        for number, (label, vehicle) in enumerate(models.items()):
            model = predicted(vehicle, log)
            for row in range(3):
                axes[row, column].plot(t, model[:, row], color=f"C{number}", lw=1.0, label=label)
        axes[0, column].set_title(log.name.removesuffix(".csv"), fontsize=9)
        axes[-1, column].set_xlabel("time from the log's start (s)")
    # Above the panels, which it would hide.
    plot.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper center", ncol=4, fontsize=8)
    plot.tight_layout(rect=(0.0, 0.0, 1.0, 0.93))
    save_figure(plot, path)


# --- what is written -----------------------------------------------------------------------------


def told(report: Path) -> dict[str, Any]:
    """Verdict and findings of a report: of each parameter its value and standard error."""
    whole = json.loads((report / "diagnosis.json").read_text())
    return {
        "verdict": whole["verdict"],
        "findings": {
            one["effect"] + (f":{one['target']}" if one["target"] else ""): {
                name: [p["value"], p["std"]] for name, p in one["parameters"].items()
            }
            for one in whole["findings"]
        },
    }


def markdown(results: dict[str, Any]) -> str:
    """The tables of errors and findings."""
    rows = {**results["rms"], **{name: list(values) for name, values in TRIAL.items()}}
    lines = [f"Errors over {HORIZON:g} s on {results['scored_on']}.", ""]
    lines += ["| model | u m/s | v m/s | r rad/s |", "|---|---|---|---|"]
    lines += [f"| {name} | " + " | ".join(f"{x:.3f}" for x in row) + " |" for name, row in rows.items()]
    for which in ("diagnosis", "diagnosis of the fit with effects"):
        if which in results:
            lines += [
                "",
                f"{which.capitalize()}: {results[which]['verdict']}",
                "",
                "| found | |",
                "|---|---|",
            ]
            for name, parameters in results[which]["findings"].items():
                values = ", ".join(f"{k} = {value:.3g} ± {std:.1g}" for k, (value, std) in parameters.items())
                lines.append(f"| {name} | {values} |")
    lines += ["", "| command | seconds |", "|---|---|"]
    lines += [f"| {name} | {seconds:.0f} |" for name, seconds in results["seconds"].items()]
    return "\n".join(lines) + "\n"


def errors(models: dict[str, jm.Vehicle], logs: Sequence[jm.Log]) -> dict[str, Any]:
    """Of each model the root mean square errors, and the intervals that hold them."""
    every = {name: [predicted(vehicle, log) for log in logs] for name, vehicle in models.items()}
    every = {"start velocity held": [held(log) for log in logs], **every}
    return {
        "scored_on": ", ".join(Path(log.name).stem for log in logs),
        "rms": {name: rms(one, logs) for name, one in every.items()},
        "within": {name: within(one, logs) for name, one in every.items()},
    }


def main(
    data: Annotated[Path, typer.Option(help="Folder with the runs as CSV.")],
    out: Annotated[Path, typer.Option(help="Folder for models, results and figures.")],
    quick: Annotated[bool, typer.Option("--quick", help="Two runs, no diagnosis.")] = False,
) -> None:
    """From sixteen files and a guess to a fitted and a diagnosed model."""
    train, test = runs(data, QUICK if quick else TRAIN), runs(data, QUICK if quick else TEST)
    columns: list[str | Path] = ["--columns", COLUMNS]
    seconds = {}
    with study(out, quick):
        said, _ = command("check", "--vehicle", GUESS, "--columns", AS_NAMED, *train)
        checked, seconds["check"] = command("check", "--vehicle", GUESS, *columns, *train)
        fitted, extended = out / "fitted.toml", out / "report" / "extended.toml"
        _, seconds["fit"] = command(
            *("fit", "--vehicle", GUESS, *columns, *repeated("--train", train)),
            *(*repeated("--free", FREED), "--prior", PRIOR, "--out", fitted),
        )
        whole = out / "fitted_as_a_boat.toml"
        _, seconds["fit with effects"] = command(
            *("fit", "--vehicle", GUESS, *columns, *repeated("--train", train)),
            *(*repeated("--free", (*FREED, *OF_BOATS)), "--prior", PRIOR, "--out", whole),
        )
        models = {"guessed file": jm.load_vehicle(GUESS), "jaxmarine fit": jm.load_vehicle(fitted)}
        models[f"jaxmarine fit, also {', '.join(OF_BOATS)}"] = jm.load_vehicle(whole)
        results: dict[str, Any] = {"check_as_named": said.splitlines(), "check": checked.splitlines()}
        if not quick:
            for name, of, report in (
                ("diagnose", fitted, out / "report"),
                ("diagnose with effects", whole, out / "report_of_a_boat"),
            ):
                _, seconds[name] = command(
                    *("diagnose", "--vehicle", of, *columns, *repeated("--train", train)),
                    *(*repeated("--test", test), "--out", report),
                )
            again = out / "fitted_again.toml"
            _, seconds["fit again"] = command(
                *("fit", "--vehicle", extended, *columns, *repeated("--train", train)),
                *(*repeated("--free", FREED_AGAIN), "--prior", PRIOR, "--out", again),
            )
            models["jaxmarine diagnose"] = jm.load_vehicle(extended)
            models["diagnosed and fitted again"] = jm.load_vehicle(again)
            models["jaxmarine diagnose, of the fit with effects"] = jm.load_vehicle(
                out / "report_of_a_boat" / "extended.toml"
            )
            results["diagnosis"] = told(out / "report")
            results["diagnosis of the fit with effects"] = told(out / "report_of_a_boat")
        logs = [jm.read_log(path, models["guessed file"], COLUMNS) for path in test]
        results |= errors(models, logs) | {"seconds": seconds}
        write_results(out, results, markdown(results))
        figure(models, logs, out / "test.png")
    print(markdown(results))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    typer.run(main)
