"""A measured ship: a model tanker's zigzags in one basin, fitted by commands, predict its turns in another.

usage: python -m experiments.measured_kvlcc2 --data DIR --out DIR
       python -m experiments.measured_kvlcc2 --quick --out DIR

Runs `jaxmarine check` and `jaxmarine fit --free all --prior 0.5` from a guessed vehicle file on zigzags of
the tanker KVLCC2 (`kvlcc2/README.md` says where they are found), and measures the errors of open-loop
predictions on runs that nothing was fitted to. `--quick`: the same way with two short simulated runs,
written as the basins wrote theirs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import pandas as pd
import typer
from jaxtyping import Float

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.measured_blueboat import command, repeated, started
from jaxmarine._angles import wrap_to_pi
from jaxmarine._types import CHANNELS

HERE = Path(__file__).parent / "kvlcc2"
GUESS = HERE / "ship.toml"
MAPS = {"hsva": HERE / "hsva.toml", "marin": HERE / "marin.toml"}
AS_THEY_COME = HERE / "as_they_come.toml"
FOLDERS = {"hsva": Path("kvlcc2_hsva", "raw_data"), "marin": Path("kvlcc2")}
HEADS = {
    "hsva": (
        "time north east heading along_north along_east turning rolling rudder_angle revolutions force torque"
    ),
    "marin": (
        "ship_time north east rolled heading along_north along_east rolling turning rudder_angle revolutions"
    ),
}
FILES = {"hsva": "HSVA_CPMC_KVLCC2_Z_{}.dat", "marin": "MARIN_FREE_KVLCC2_{}_m.dat"}
# All zigzags of HSVA but the one that their repository left out to choose its model by.
FIRST = ("05_01", "10_01", "10_05", "10_10_P", "10_10_S", "15_01", "15_05", "20_05")
TRAIN = [("hsva", run) for run in (*FIRST, "20_10_P", "20_10_S", "25_05", "30_05")]
TURNS = [("marin", run) for run in ("tc_35", "tc_-35")]
ZIGZAGS = [("marin", run) for run in ("zz_10", "zz_-10", "zz_20", "zz_-20")] + [("hsva", "35_05")]
# MARIN's model was sampled at 50 Hz; the times that are printed have three digits.
SAMPLING = 0.02  # [s]
PRIOR = "0.5"
HORIZONS, EVERY = (5.0, 30.0, 100.0), 10.0  # [s]; a prediction starts so often, where the run is long enough
COLUMNS = {"position": "m", "heading": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
X, Y, PSI, U, V, R = (CHANNELS.index(name) for name in ("x", "y", "psi", "u", "v", "r"))
# Advance and tactical diameter [m] of MARIN's turns, measured and predicted, as their repository prints them
# (docs/paper/06.20_results_kvlcc2.ipynb, tab_kvlcc2_advance): its regression on the same zigzags and that of
# 35 degrees.
PRINTED = {"tc_35": ((21.59, 21.21), (21.72, 23.07)), "tc_-35": ((22.54, 22.10), (23.55, 24.29))}

Run = tuple[str, str]
Errors = Float[np.ndarray, "samples 5"]


# --- the basins' files ---------------------------------------------------------------------------


def table(path: Path, basin: str) -> pd.DataFrame:
    """The numbers of a run under names of ours; lines that hold something else are skipped."""
    heads = HEADS[basin].split()
    rows = []
    for line in path.read_text(encoding="cp1252").splitlines():
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            continue
        if len(row) == len(heads):
            rows.append(row)
    out = pd.DataFrame(rows, columns=heads)
    return out.assign(time=SAMPLING * np.arange(len(out))) if basin == "marin" else out


def contract_log(data: Path, run: Run, out: Path) -> Path:
    """A run as a log of the contract, written by the public reader and writer."""
    basin, name = run
    path = out / f"{basin}_{name}.csv"
    raw = table(data / FOLDERS[basin] / FILES[basin].format(name), basin)
    jm.write_log(jm.read_log(raw, jm.load_vehicle(GUESS), MAPS[basin]), path)
    return path


# --- errors --------------------------------------------------------------------------------------


def starts(log: jm.Log, horizon: float) -> np.ndarray:
    """Samples at which predictions of this length [s] begin."""
    return np.arange(0, len(log.t) - round(horizon / log.dt), round(EVERY / log.dt))


def missed(predicted: Float[np.ndarray, "samples 18"], log: jm.Log) -> Errors:
    """Distance, heading, u, v and r by which a prediction misses a log."""
    error = predicted - log.channels
    distance = np.hypot(error[:, X], error[:, Y])
    return np.column_stack([distance, wrap_to_pi(error[:, PSI]), error[:, [U, V, R]]])


def errors(vehicle: jm.Vehicle, log: jm.Log, horizon: float) -> Errors:
    """Of predictions that begin in the measured state, over their whole length."""
    out = [np.zeros((0, len(COLUMNS)))]
    for first in starts(log, horizon):
        part = log.between(float(log.t[first]), float(log.t[first + round(horizon / log.dt)]))
        out.append(missed(np.asarray(jm.simulate(vehicle, part, started(vehicle, part)).channels), part))
    return np.concatenate(out)


def held(log: jm.Log, horizon: float) -> Errors:
    """Of going on as at the start, on a circle if it turns."""
    out = [np.zeros((0, len(COLUMNS)))]
    for first in starts(log, horizon):
        part = log.between(float(log.t[first]), float(log.t[first + round(horizon / log.dt)]))
        channels, t = np.tile(part.channels[0], (len(part.t), 1)), part.t - part.t[0]
        u, v, r = channels[0, [U, V, R]]
        channels[:, PSI] += r * t
        middle = channels[:, PSI] - 0.5 * r * t
        # The chord of the circle.
        along = t * np.sinc(0.5 * r * t / np.pi)
        channels[:, X] += along * (u * np.cos(middle) - v * np.sin(middle))
        channels[:, Y] += along * (u * np.sin(middle) + v * np.cos(middle))
        out.append(missed(channels, part))
    return np.concatenate(out)


def rms(each: Sequence[Errors]) -> list[float]:
    return np.sqrt(np.nanmean(np.concatenate(each) ** 2, axis=0)).tolist()


def manoeuvre(x, y, psi) -> tuple[float, float]:
    """Advance and tactical diameter [m]: ahead at 90 and aside at 180 degrees from the first heading."""
    turned = np.abs(np.unwrap(psi) - psi[0])
    quarter, half = (int(np.argmax(turned > angle)) for angle in (0.5 * np.pi, np.pi))
    ahead = (x - x[0]) * np.cos(psi[0]) + (y - y[0]) * np.sin(psi[0])
    aside = (y - y[0]) * np.cos(psi[0]) - (x - x[0]) * np.sin(psi[0])
    return float(ahead[quarter]), abs(float(aside[half]))


def circles(vehicle: jm.Vehicle, log: jm.Log) -> tuple[tuple[float, float], tuple[float, float]]:
    """Advance and tactical diameter of a turn, measured and predicted from its start on."""
    found = np.asarray(jm.simulate(vehicle, log, started(vehicle, log)).channels)
    return manoeuvre(*log.channels[:, [X, Y, PSI]].T), manoeuvre(*found[:, [X, Y, PSI]].T)


# --- a run that is simulated ---------------------------------------------------------------------


def pretended(folder: Path, run: Run, amplitude: float, seconds: float) -> None:
    """A zigzag of the packaged kvlcc2 in HSVA's columns, with rudder angles that change every 10 s [deg]."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("kvlcc2"))
    t = 0.05 * np.arange(round(seconds / 0.05))
    rudder = np.where((t // 10) % 2 == 0, amplitude, -amplitude)
    commands = np.column_stack([np.full_like(t, 10.23), np.deg2rad(-rudder)])
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "zigzag.csv")
    state = jm.initial_state(vehicle, velocity=(1.18, 0, 0, 0, 0, 0))
    rng = np.random.default_rng(0)
    channels = np.asarray(jm.simulate(vehicle, log, state).channels)
    x, y, psi, u, v, r = (channels + 1e-3 * rng.standard_normal(channels.shape))[:, [X, Y, PSI, U, V, R]].T
    north, east = u * np.cos(psi) - v * np.sin(psi), u * np.sin(psi) + v * np.cos(psi)
    nothing = np.zeros_like(t)
    rows = [
        t,
        x,
        y,
        np.rad2deg(psi),
        north,
        east,
        np.rad2deg(r),
        nothing,
        rudder,
        commands[:, 0],
        nothing,
        nothing,
    ]
    text = "\n".join(" ".join(f"{value:.9f}" for value in row) for row in np.column_stack(rows))
    path = folder / FOLDERS["hsva"] / FILES["hsva"].format(run[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f" simulated\n KVLCC2\n Z{amplitude:g}°\n\n{text}\n", encoding="cp1252")


# --- what is written -----------------------------------------------------------------------------


def error_table(models: dict[str, dict[str, list[float]]]) -> str:
    """Errors of all models on one kind of runs, by the length of the predictions."""
    heads = " | ".join(f"{name} [{unit}]" for name, unit in COLUMNS.items())
    lines = [f"| model | over [s] | {heads} |", "|---" * (2 + len(COLUMNS)) + "|"]
    for model, rows in models.items():
        for horizon, row in rows.items():
            lines.append(f"| {model} | {horizon} | " + " | ".join(f"{x:.3f}" for x in row) + " |")
    return "\n".join(lines) + "\n"


def turn_table(turned: dict[str, Any]) -> str:
    """Advance and tactical diameter of each turn, ours and theirs."""
    lines = [
        "| turn | whose | advance [m]: measured, predicted | tactical diameter [m] |",
        "|---|---|---|---|",
    ]
    for name, ours in turned.items():
        theirs = tuple(zip(*PRINTED[name], strict=True))
        for whose, (measured, predicted) in (("jaxmarine fit", ours), ("theirs, as printed", theirs)):
            cells = [
                f"{true:.2f}, {said:.2f} ({said / true - 1:+.1%})"
                for true, said in zip(measured, predicted, strict=True)
            ]
            lines.append(f"| {name} | {whose} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def markdown(results: dict[str, Any]) -> str:
    """Tables of errors, turns and times."""
    parts = [f"{kind}:\n\n{error_table(models)}" for kind, models in results["rms"].items()]
    if results["circles"]:
        parts.append(turn_table(results["circles"]))
    times = [f"| {name} | {seconds:.0f} |" for name, seconds in results["seconds"].items()]
    return "\n".join([*parts, "| command | seconds |", "|---|---|", *times]) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for logs, models and results.")],
    data: Annotated[Path | None, typer.Option(help="Folder with kvlcc2 and kvlcc2_hsva.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Two simulated runs.")] = False,
) -> None:
    """From the basins' text to a fitted ship and its errors."""
    train, groups = TRAIN, {"turns in another basin": TURNS, "zigzags": ZIGZAGS}
    horizons = HORIZONS
    with study(out, quick):
        if quick:
            data, train, horizons = out / "pretended", [("hsva", "20_05")], HORIZONS[:2]
            groups = {"zigzags": [("hsva", "35_05")]}
            pretended(data, train[0], 20.0, 80.0)
            pretended(data, groups["zigzags"][0], 35.0, 60.0)
        if data is None:
            raise SystemExit(
                "--data: is needed but for --quick; kvlcc2/README.md says where the runs are found."
            )
        raw, seconds = out / "as_they_come.csv", {}
        table(data / FOLDERS["hsva"] / FILES["hsva"].format(train[0][1]), "hsva").to_csv(raw, index=False)
        said, _ = command("check", "--vehicle", GUESS, "--columns", AS_THEY_COME, raw)
        logs = [contract_log(data, run, out) for run in train]
        checked, seconds["check"] = command("check", "--vehicle", GUESS, *logs)
        fitted = out / "fitted.toml"
        _, seconds["fit"] = command(
            *("fit", "--vehicle", GUESS, *repeated("--train", logs)),
            *("--free", "all", "--prior", PRIOR, "--out", fitted),
        )
        models = {"guessed file": jm.load_vehicle(GUESS), "jaxmarine fit": jm.load_vehicle(fitted)}
        table_of: dict[str, Any] = {}
        for kind, runs in groups.items():
            those = [jm.read_log(contract_log(data, run, out), models["guessed file"]) for run in runs]
            rows = {
                "velocity of the start held": {
                    f"{h:g}": rms([held(log, h) for log in those]) for h in horizons
                }
            }
            for name, vehicle in models.items():
                rows[name] = {f"{h:g}": rms([errors(vehicle, log, h) for log in those]) for h in horizons}
            table_of[kind] = rows
        fit = models["jaxmarine fit"]
        turns = [] if quick else [name for _, name in TURNS]
        turned = {name: circles(fit, jm.read_log(out / f"marin_{name}.csv", fit)) for name in turns}
        results = {
            "check_as_they_come": [line for line in said.splitlines() if line.startswith("first")],
            "check": [line for line in checked.splitlines() if line.startswith(("first", "next", "What"))],
            "rms": table_of,
            "circles": turned,
            "seconds": seconds,
        }
        write_results(out, results, markdown(results))
    print(markdown(results))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    typer.run(main)
