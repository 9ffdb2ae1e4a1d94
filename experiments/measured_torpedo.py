"""A measured torpedo under its autopilot: what its log can tell of it, and what it cannot.

usage: python -m experiments.measured_torpedo --data DIR --out DIR
       python -m experiments.measured_torpedo --quick --out DIR

Runs `jaxmarine check`, `fit` and `diagnose` from a guessed vehicle file on the turns of a survey of a torpedo
with four fins (`torpedo/README.md` says where its files are found), and measures the errors of open-loop
predictions of turns that nothing was fitted to. `--quick`: two simulated runs, written as the recorder wrote
its own, by the right map alone; no choice among effects and no diagnosis.
"""

import dataclasses
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import typer
from jaxtyping import Float

import jaxmarine as jm
from experiments._study import number, save_figure, short, study, write_results
from experiments.measured_blueboat import command, repeated, started, told
from jaxmarine._angles import wrap_to_pi
from jaxmarine._types import CHANNELS as NAMES
from jaxmarine.logs import smooth_states

HERE = Path(__file__).parent / "torpedo"
GUESS = HERE / "torpedo.toml"
AS_NAMED, COLUMNS = HERE / "as_named.toml", HERE / "columns.toml"
# What is read of each of the recorder's files.
RECORDED = {
    "share_pid_attitude_control_node.fins": ("port", "starboard", "top", "bottom"),
    "share_pathfinder_dvl_node.velocity": ("v_x", "v_y"),
    "share_pid_attitude_control_node.pitch_pid": ("pitch_input",),
    "share_pid_attitude_control_node.yaw_pid": ("yaw_input",),
}
# A shaft speed is not logged: one that the guessed screw has at the speed that is seen [rev/s].
TURNS = 18.0
# Where the runs begin by the recorder's clock, some seconds before a turn, and how long they are [s].
TRAIN, TEST, LENGTH = (3115, 3805, 4475, 5235), (5885, 6685, 7305), 60.0
HALVES = (slice(0, None, 2), slice(1, None, 2))
FREED = ("added_mass", "damping", "surface", "steady_current", "hull_lift")
# What may be the reason where a fit of these damps sway beyond any hull: one of them beside the others.
BESIDE = ("turning_lift", "velocity_misalignment", "velocity_lever_arm")
SWAY = "damping.linear[sway]"
CHOSEN = "velocity_lever_arm"
FITS = {"jaxmarine fit": (), f"jaxmarine fit, also {CHOSEN}": (CHOSEN,)}
PRIOR = "0.5"
CHANNELS, UNITS = ("u", "v", "psi"), ("m/s", "m/s", "rad")
PLACES = np.array([NAMES.index(name) for name in CHANNELS])
HORIZONS, EVERY = (5.0, 20.0), 5.0  # [s]; a prediction starts so often
# The current of the simulated runs [m/s].
CURRENT = {"north": -0.1, "east": 0.25}

Shown = Float[np.ndarray, "samples 3"]
Rows = dict[str, dict[str, list[float]]]


# --- the recorder's files ------------------------------------------------------------------------


def clock(file: str) -> str:
    return "t_" + file.rpartition(".")[2]


def recording(data: Path) -> list[pd.DataFrame]:
    """What is read of each file, beside a clock of its own: a title stands above the names, units below."""
    tables = []
    for file, columns in RECORDED.items():
        table = pd.read_csv(data / f"{file}.dat", skiprows=[0, 2], index_col=False, skipinitialspace=True)
        table.columns = table.columns.str.replace("\\", "")
        table = table[["time", *columns]].apply(pd.to_numeric, errors="coerce").dropna()
        tables.append(table.rename(columns={"time": clock(file)}))
    return tables


def run(tables: Sequence[pd.DataFrame], begin: float, folder: Path) -> Path:
    """A stretch of the recording as one CSV, in whose rows each clock has gone on by itself."""
    path = folder / f"at_{begin:g}.csv"
    parts = [stretch(table, begin) for table in tables]
    pd.concat([parts[0].assign(turns=TURNS), *parts[1:]], axis=1).to_csv(path, index=False)
    return path


def stretch(table: pd.DataFrame, begin: float) -> pd.DataFrame:
    """The rows of a run, numbered anew."""
    t = table.iloc[:, 0]
    return table[(t >= begin) & (t < begin + LENGTH)].reset_index(drop=True)


# --- errors --------------------------------------------------------------------------------------


def smoothed(log: jm.Log) -> jm.Log:
    """The log with poses and velocities smoothed: its rate of turn was not measured."""
    track = smooth_states(log, ("surge", "sway", "yaw"))
    channels = log.channels.copy()
    channels[:, :12] = np.concatenate([track.position, track.attitude, track.nu], axis=1)
    return dataclasses.replace(log, channels=channels)


def simulated(vehicle: jm.Vehicle, part: jm.Log) -> Shown:
    """What a vehicle would have shown, from the state of the first sample on."""
    return np.asarray(jm.simulate(vehicle, part, started(vehicle, part)).channels)[:, PLACES]


def held(part: jm.Log) -> Shown:
    """Speed and heading as at the start."""
    return np.tile(part.channels[0, PLACES], (len(part.t), 1))


def turning(part: jm.Log) -> Shown:
    """The same, but going on to turn as at the start."""
    out = held(part)
    out[:, 2] += part.channels[0, NAMES.index("r")] * (part.t - part.t[0])
    return out


def parts(log: jm.Log, horizon: float, every: float) -> list[tuple[jm.Log, slice]]:
    """Stretches of the smoothed log at least as long, and their rows; all of a log have as many."""
    smooth, count = smoothed(log), round(horizon / log.dt)
    firsts = np.searchsorted(log.t, np.arange(log.t[0], log.t[-1] - horizon, every))
    rows = [slice(int(first), int(first) + count) for first in firsts if first + count < len(log.t)]
    return [(smooth.between(float(log.t[one.start]), float(log.t[one.stop])), one) for one in rows]


def rms(predict: Any, logs: Sequence[jm.Log], horizon: float) -> list[float]:
    """Of predictions over their whole length, which begin every few seconds in what was smoothed."""
    errors = []
    for log in logs:
        for part, rows in parts(log, horizon, EVERY):
            error = predict(part) - log.channels[rows][:, PLACES]
            error[:, 2] = wrap_to_pi(error[:, 2])
            errors.append(error[part.t - part.t[0] <= horizon])
    return np.sqrt(np.nanmean(np.concatenate(errors) ** 2, axis=0)).tolist()


def scored(models: dict[str, jm.Vehicle], logs: Sequence[jm.Log]) -> Rows:
    """Errors of the models on runs, and of what they have to do better than."""
    ways: dict[str, Any] = {"held": held, "held, turning on": turning}
    ways |= {name: lambda part, model=model: simulated(model, part) for name, model in models.items()}
    return {
        name: {f"{horizon:g}": rms(way, logs, horizon) for horizon in HORIZONS} for name, way in ways.items()
    }


def restarted(vehicle: jm.Vehicle, log: jm.Log) -> Shown:
    """What a vehicle would have shown, begun anew after each of the longer horizons."""
    out = np.full((len(log.t), len(CHANNELS)), np.nan)
    # Three of them fit into a run.
    for part, rows in parts(log, HORIZONS[-1], 0.99 * HORIZONS[-1]):
        out[rows] = simulated(vehicle, part)
    return out


def figure(models: dict[str, jm.Vehicle], logs: Sequence[jm.Log], path: Path) -> None:
    """Speeds and heading of each run, measured and predicted."""
    plot, axes = plt.subplots(3, len(logs), figsize=(4.2 * len(logs), 6.5), sharex="col", squeeze=False)
    for column, log in enumerate(logs):
        t = log.t - log.t[0]
        measured, turn = log.channels[:, PLACES].copy(), CHANNELS.index("psi")
        # A heading that does not jump by a turn, and of the numbers that one has those that are next to it.
        there = np.isfinite(measured[:, turn])
        measured[there, turn] = np.unwrap(measured[there, turn])
        shown = {"measured": measured}
        for name, vehicle in models.items():
            shown[name] = restarted(vehicle, log)
            shown[name][:, turn] = measured[:, turn] + wrap_to_pi(shown[name][:, turn] - measured[:, turn])
        for color, (name, values) in zip(("0.6", "C0", "C1", "C2"), shown.items(), strict=False):
            for row in range(3):
                axes[row, column].plot(t, values[:, row], color=color, lw=1.2, label=name)
        axes[0, column].set_title(log.name.removesuffix(".csv").replace("_", " ") + " s", fontsize=9)
        axes[-1, column].set_xlabel("time from the run's start (s)")
    for row, (name, unit) in enumerate(zip(CHANNELS, UNITS, strict=True)):
        axes[row, 0].set_ylabel(f"{name} ({unit})")
    # Above the panels, which it would hide.
    plot.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper center", ncol=4, fontsize=8)
    plot.tight_layout(rect=(0.0, 0.0, 1.0, 0.93))
    save_figure(plot, path)


# --- commands ------------------------------------------------------------------------------------


def checked(train: Sequence[Path], columns: Path) -> list[str]:
    """What `check` says of the guessed file, without tables and notes."""
    said, _ = command("check", "--vehicle", GUESS, "--columns", columns, *train)
    return [one for one in said.splitlines() if one.startswith(("first", "next", "What"))]


def fitted(train: Sequence[Path], beside: Sequence[str], out: Path) -> dict[str, list[float]]:
    """Of each coefficient what the file says, what the fit finds and its error, between windows as well."""
    said, _ = command(
        *("fit", "--vehicle", GUESS, "--columns", COLUMNS, *repeated("--train", train)),
        *(*repeated("--free", (*FREED, *beside)), "--prior", PRIOR, "--out", out),
    )
    rows = [line.split() for line in said.splitlines()]
    return {row[0]: [float(row[i]) for i in (1, 2, 4)] for row in rows if numbers(row)}


def numbers(row: list[str]) -> bool:
    """Whether this is a coefficient's line of the table that `fit` prints."""
    return len(row) == 5 and all(re.fullmatch(r"[-+.\de]+", word) for word in row[1:])


def left_out(train: Sequence[Path], logs: Sequence[jm.Log], out: Path) -> dict[str, list[dict[str, Any]]]:
    """By what is freed beside: fits to either half of the training runs, and errors on the other half."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for beside in ("", *BESIDE):
        for half, (here, there) in enumerate((HALVES, HALVES[::-1])):
            path = out / f"half_{half}_{beside}.toml"
            fit = fitted(train[here], [beside] if beside else [], path)
            own = {name: fit[name] for name in fit if name == SWAY or name.startswith(beside or SWAY)}
            rms = scored({"fit": jm.load_vehicle(path)}, logs[there])["fit"]
            rows.setdefault(beside or "nothing", []).append({"fit": own, "rms": rms})
    return rows


def overall(rows: dict[str, list[float]]) -> float:
    """One number of a model: the geometric mean of its errors over channels and horizons."""
    return float(np.exp(np.mean(np.log(list(rows.values())))))


# --- a run that is simulated ---------------------------------------------------------------------


def pretended(folder: Path, begins: Sequence[float]) -> Path:
    """A folder with turns of the guessed torpedo in a current, in the recorder's files."""
    folder.mkdir(exist_ok=True)
    truth = folder / "truth.toml"
    current = "".join(f"{name} = {value}\n" for name, value in CURRENT.items())
    truth.write_text(f'{GUESS.read_text()}\n[[effect]]\neffect = "steady_current"\n{current}')
    runs = [pretended_run(jm.load_vehicle(truth), begin) for begin in begins]
    for file, columns in RECORDED.items():
        # The fins' samples lie between those of the sensors.
        first = 0 if "top" in columns else 1
        rows = pd.concat([table.iloc[first::2] for table in runs])[["time", *columns]]
        head = f"simulated\n{','.join(rows.columns)},\n{'-,' * len(rows.columns)}\n"
        lines = [",".join(f"{x:.8f}" for x in row) + ",\n" for row in rows.to_numpy()]
        (folder / f"{file}.dat").write_text(head.replace("_input", "\\_input") + "".join(lines))
    return folder


def pretended_run(vehicle: jm.Vehicle, begin: float) -> pd.DataFrame:
    """All columns of one run, whose rudders swing from one random angle to the next."""
    rng = np.random.default_rng(int(begin))
    t = begin + 0.05 * np.arange(round(LENGTH / 0.05))
    corners = begin + np.arange(0.0, LENGTH + 3.0, 3.0)
    rudder = np.interp(t, corners, rng.uniform(-0.3, 0.3, len(corners)))
    of = {"propeller": np.full_like(t, TURNS), "rudder_top": rudder, "rudder_bottom": rudder}
    commands = np.column_stack([of[name] for name in vehicle.command_names])
    log = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, "simulated")
    state = jm.initial_state(vehicle, velocity=(1.5, 0, 0, 0, 0, 0))
    shown = np.asarray(jm.simulate(vehicle, log, state).channels)
    noise = rng.normal(0.0, (0.02, 0.02, 0.001), (len(t), 3))
    u, v, psi = (shown[:, PLACES] + noise).T
    columns = {"time": t, "port": 0 * t - 0.1, "starboard": 0 * t + 0.1, "top": rudder, "bottom": -rudder}
    return pd.DataFrame(columns | {"v_x": u, "v_y": v, "pitch_input": 0 * t, "yaw_input": psi % (2 * np.pi)})


# --- what is written -----------------------------------------------------------------------------


def error_table(rows: Rows) -> str:
    """Errors of all models by the length of the predictions."""
    heads = " | ".join(f"{name} [{unit}]" for name, unit in zip(CHANNELS, UNITS, strict=True))
    lines = [f"| model | over [s] | {heads} |", "|---" * (2 + len(CHANNELS)) + "|"]
    for model, by_horizon in rows.items():
        for horizon, row in by_horizon.items():
            lines.append(f"| {model} | {horizon} | " + " | ".join(f"{x:.3f}" for x in row) + " |")
    return "\n".join(lines) + "\n"


def half_table(rows: dict[str, list[dict[str, Any]]]) -> str:
    """Each candidate's two fits: damping in sway, what the candidate itself is, and the errors."""
    heads = " | ".join(f"{name}, {horizon:g} s" for horizon in HORIZONS for name in CHANNELS)
    lines = [f"| freed beside | {SWAY} | of its own | {heads} | mean |", "|---" * 10 + "|"]
    for beside, halves in rows.items():
        for one in halves:
            told = {name: f"{number(value)} ± {number(std)}" for name, (_, value, std) in one["fit"].items()}
            own = [f"{name.rpartition('.')[2]} {value}" for name, value in told.items() if name != SWAY]
            errors = " | ".join(f"{x:.3f}" for row in one["rms"].values() for x in row)
            cells = f"{beside} | {told[SWAY]} | {', '.join(own)} | {errors} | {overall(one['rms']):.3f}"
            lines.append(f"| {cells} |")
    return "\n".join(lines) + "\n"


def fit_table(fits: dict[str, dict[str, list[float]]]) -> str:
    """Coefficients of each fit with their standard errors beside those of the guessed file."""
    names = list(dict.fromkeys(name for fit in fits.values() for name in fit))
    lines = [f"| coefficient | guessed | {' | '.join(fits)} |", "|---" * (2 + len(fits)) + "|"]
    for name in names:
        guessed = next(fit[name][0] for fit in fits.values() if name in fit)
        cells = [
            f"{number(fit[name][1])} ± {number(fit[name][2])}" if name in fit else "" for fit in fits.values()
        ]
        lines.append(f"| {name} | {number(guessed)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def markdown(results: dict[str, Any]) -> str:
    """All tables."""
    parts = ["Test runs:\n", error_table(results["rms"])]
    if "left_out" in results:
        parts += ["Training runs, left out by halves:\n", half_table(results["left_out"])]
    return "\n".join([*parts, fit_table(results["fits"])])


def fins_and_pitch(tables: Sequence[pd.DataFrame]) -> dict[str, float]:
    """How far fins of a pair ever stand apart, and by how much pitch scatters in the training runs [rad]."""
    fins, _, pitch, _ = tables
    return {
        "planes_apart": float((fins["port"] + fins["starboard"]).abs().max()),
        "rudders_apart": float((fins["top"] + fins["bottom"]).abs().max()),
        "pitch_scatter": float(np.std(np.concatenate([stretch(pitch, begin).iloc[:, 1] for begin in TRAIN]))),
    }


def file_of(model: str, out: Path) -> Path:
    """Where a fit leaves its model."""
    return out / (re.sub(r"\W+", "_", model) + ".toml")


def diagnosed(model: str, train: Sequence[Path], test: Sequence[Path], out: Path) -> dict[str, Any]:
    """What `diagnose` says of a fit."""
    report = out / f"report_{file_of(model, out).stem}"
    command(
        *("diagnose", "--vehicle", file_of(model, out), "--columns", COLUMNS),
        *(*repeated("--train", train), *repeated("--test", test), "--out", report),
    )
    return told(report) | {"missing": missing(report)}


def missing(report: Path) -> dict[str, list[float]]:
    """What no cause explains: how large it is, and from when to when after the start of its log [s]."""
    findings = json.loads((report / "diagnosis.json").read_text())["findings"]
    return {
        f"{one['effect']}:{one['target']} in {found['log']}": [
            found["rms"],
            found["begin"] - found["log_begin"],
            found["end"] - found["log_begin"],
        ]
        for one in findings
        if (found := one.get("excess"))
    }


def main(
    out: Annotated[Path, typer.Option(help="Folder for runs, models, results and figures.")],
    data: Annotated[Path | None, typer.Option(help="Folder with the recorder's files.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Two simulated runs.")] = False,
) -> None:
    """From the recorder's files to a fitted torpedo and its errors."""
    begins = (TRAIN[:1], TEST[:1]) if quick else (TRAIN, TEST)
    fits = dict([*FITS.items()][:1]) if quick else FITS
    with study(out, quick):
        folder = pretended(out / "pretended", sum(begins, ())) if quick else data
        if folder is None:
            raise SystemExit("--data: is needed but for --quick; torpedo/README.md says where to find it.")
        tables, guess = recording(folder), jm.load_vehicle(GUESS)
        train, test = ([run(tables, begin, out) for begin in those] for those in begins)
        learned, logs = ([jm.read_log(one, guess, COLUMNS) for one in those] for those in (train, test))
        results: dict[str, Any] = {
            "check": checked(train, COLUMNS),
            "fits": {name: fitted(train, beside, file_of(name, out)) for name, beside in fits.items()},
        }
        if not quick:
            results["check_as_named"] = checked(train, AS_NAMED)
            results |= fins_and_pitch(tables) | {"left_out": left_out(train, learned, out)}
            results["diagnosis"] = {name: diagnosed(name, train, test, out) for name in fits}
        models = {"guessed file": guess} | {name: jm.load_vehicle(file_of(name, out)) for name in fits}
        results["rms"] = scored(models, logs)
        write_results(out, short(results), markdown(results))
        figure(models, logs, out / "test")
    print(markdown(results))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    typer.run(main)
