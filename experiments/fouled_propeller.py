"""A fouled propeller: the thrust curve and the lag of every thruster learned from a log.

usage: python -m experiments.fouled_propeller --out DIR [--seeds N] [--quick]

CyberShip II sails with something in its starboard propeller: thrust against command has a dead zone, is
weaker, astern more than ahead, and comes later. Its file knows nothing of that, its damping is wrong too,
and nobody says which propeller it is. A small network of the command for each thruster, in the thruster
stage, and a lag for each are fitted with the damping to the trajectories (thesis, sec. 8.4).
"""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import save_figure, spread, study, write_results
from jaxmarine._types import CHANNELS, SENSORS
from jaxmarine.examples import operator
from jaxmarine.fitting import noise_of
from jaxmarine.networks import LearnedThrust, learned_thrust
from jaxmarine.physics import thrust

FOULED = 0  # the starboard propeller
DEAD = 0.12  # [1] dead zone of the fouled propeller
AHEAD, ASTERN = 0.8, 0.45  # [1] what is left of its thrust at full command
POWER = 1.4  # [1] of the command beyond the dead zone
LAG, SLOW = 0.2, 0.7  # [s] of a clean propeller and of the fouled one
FILE = 0.8  # the damping of the file, as a share of the true one
# What a camera system in a basin and a cheap inertial sensor give; accelerations are not measured.
NOISE = {"position": 0.02, "attitude": 0.005, "velocity": 0.01, "rate": 0.01}
WINDOW = 8.0  # [s] several times the lag that is looked for
TARGET = 0.05  # of the largest thrust
HERE = Path(__file__).parent / "fouled"


def curve(command: Float[np.ndarray, " commands"]) -> Float[np.ndarray, " commands"]:
    """Thrust of the fouled propeller over that of a clean one at full command.

    A dead zone as in Bessa et al. (2006), unequal ahead and astern, and a power of the command between
    the linear and the quadratic law, after Fossen (2021). The numbers are made up.
    """
    beyond = np.maximum(np.abs(command) - DEAD, 0.0) / (1.0 - DEAD)
    return np.where(command > 0, AHEAD, -ASTERN) * beyond**POWER


def craft() -> jm.Vehicle:
    """The ship as it is, but for the fouled curve, which its commands are sent through."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("cybership2"))
    lag = np.full(len(vehicle.thruster_names), LAG)
    lag[FOULED] = SLOW
    vehicle = eqx.tree_at(lambda v: v.thrusters.lag, vehicle, jnp.asarray(lag))
    return dataclasses.replace(vehicle, sensors=tuple(NOISE.items()))


def believed(truth: jm.Vehicle) -> jm.Vehicle:
    """What the file says: every propeller clean, the damping too small."""
    lag = jnp.full_like(truth.thrusters.lag, LAG)
    return eqx.tree_at(
        lambda v: (v.thrusters.lag, v.damping.linear, v.damping.quadratic),
        truth,
        (lag, FILE * truth.damping.linear, FILE * truth.damping.quadratic),
    )


def recorded(truth: jm.Vehicle, duration: float, seed: int) -> jm.Log:
    """A log of the ship at 10 Hz: what was commanded, and what was measured of what happened."""
    t = np.arange(0.0, duration, 0.1)
    commands = operator(len(truth.thruster_names), t, seed, strength=1.0)
    acting = commands.copy()
    acting[:, FOULED] = curve(commands[:, FOULED])
    empty = jm.Log(t, np.full((len(t), len(CHANNELS)), np.nan), acting, None, truth.thruster_names, "log")
    clean = np.asarray(jm.simulate(truth, empty, jm.initial_state(truth)).channels)
    noise = np.array([NOISE.get(kind, np.nan) for kind, names in SENSORS.items() for _ in names])
    channels = clean + noise * np.random.default_rng(1000 + seed).standard_normal(clean.shape)
    return dataclasses.replace(empty, channels=channels, commands=commands)


def extended(vehicle: jm.Vehicle, log: jm.Log) -> jm.Vehicle:
    """The vehicle with a network in each thruster that changes nothing yet."""
    assert log.commands is not None
    low, high = log.commands.min(axis=0), log.commands.max(axis=0)
    return vehicle.place(jm.Placed(learned_thrust(vehicle.thruster_names, low, high)))


def term(vehicle: jm.Vehicle) -> LearnedThrust:
    """The learned thrust in the vehicle."""
    effect: Any = vehicle.placed[-1].effect
    return effect


def free(v: jm.Vehicle) -> tuple:
    """What is fitted."""
    effect: Any = v.placed[-1].effect
    return v.damping.linear, v.damping.quadratic, effect.network, effect.lag


def fitted(start: jm.Vehicle, log: jm.Log, steps: int) -> jm.Fit:
    """Networks, lags and damping by the trajectory loss."""
    effect = term(start)
    # Of the damping, what the file has; of the networks, steps that may move by about their distance.
    damping = [0.5 * np.abs(np.asarray(d)) for d in (start.damping.linear, start.damping.quadratic)]
    networks = tuple(jnp.full_like(a, std) for a, std in zip(effect.network, (3.0, 3.0, 0.3), strict=True))
    prior = (*damping, networks, jnp.full_like(effect.lag, 0.5))
    # The noise is known, and all models are to weigh it alike.
    noise = noise_of(start, [log])
    return jm.fit(start, log, free, prior=prior, window=WINDOW, max_steps=steps, throw=False, noise=noise)


def steady(
    vehicle: jm.Vehicle, command: Float[np.ndarray, " commands"]
) -> Float[np.ndarray, "commands thrusters"]:
    """Thrust [N] of each thruster after the lag, for commands that are held."""
    return np.asarray(_steady(vehicle, jnp.asarray(command)))


@eqx.filter_jit
def _steady(vehicle: jm.Vehicle, command):
    count = len(vehicle.thruster_names)
    commands = jnp.broadcast_to(command[:, None], (len(command), count))
    without_lag = dataclasses.replace(vehicle.plant().drive, lag=jnp.zeros(count))
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), without_lag)
    return thrust(drive, jnp.arange(float(len(command))), commands).instant


def true_thrust(
    truth: jm.Vehicle, command: Float[np.ndarray, " commands"]
) -> Float[np.ndarray, "commands thrusters"]:
    """The same of the ship as it is."""
    shares = np.repeat(command[:, None], len(truth.thruster_names), axis=1)
    shares[:, FOULED] = curve(command)
    return shares * np.asarray(truth.thrusters.max_thrust)


def judged(truth: jm.Vehicle, fit: jm.Fit, log: jm.Log) -> dict[str, Any]:
    """Errors of each curve, evenly over the commands' range and over those visited; of lag and damping."""
    assert log.commands is not None
    largest = np.asarray(truth.thrusters.max_thrust)
    out: dict[str, Any] = {"steps": fit.steps, "converged": fit.converged}
    out["reduced_chi2"] = fit.reduced_chi2
    stds = {p.name: p.std_model for p in fit.parameters}
    for i, name in enumerate(truth.thruster_names):
        grid = np.linspace(log.commands[:, i].min(), log.commands[:, i].max(), 201)
        visited = np.sort(log.commands[:, i])
        rows: dict[str, float] = {"from": grid[0], "to": grid[-1]}
        for model, vehicle in (("file", fit.start), ("learned", fit.vehicle)):
            for kind, at in (("grid", grid), ("visited", visited)):
                error = (steady(vehicle, at) - true_thrust(truth, at))[:, i] / largest[i]
                rows[f"{model}_rms_{kind}"] = float(np.sqrt((error**2).mean()))
                rows[f"{model}_worst_{kind}"] = float(np.abs(error).max())
        slopes = np.diff(steady(fit.vehicle, grid)[:, i]) / np.diff(grid) / largest[i]
        rows["least_slope"] = float(slopes.min())
        lags = [float(v.plant().drive.lag[i]) for v in (truth, fit.start, fit.vehicle)]
        rows |= dict(zip(("lag_true", "lag_file", "lag_learned"), lags, strict=True))
        rows["lag_std"] = next((std for label, std in stds.items() if label.endswith(f"lag[{i}]")), np.nan)
        out[name] = {key: float(value) for key, value in rows.items()}
    return out


def table(runs: list[dict[str, Any]], names: tuple[str, ...]) -> str:
    """One line per thruster: median and range over the seeds."""

    def cell(name: str, key: str, scale: float, digits: int) -> str:
        return spread([scale * run[name][key] for run in runs], digits)

    lines = [
        "| thruster | file: rms % | learned: rms % | learned: worst % | lag true s | lag learned s |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        cells = [
            cell(name, "file_rms_grid", 100, 1),
            cell(name, "learned_rms_grid", 100, 2),
            cell(name, "learned_worst_grid", 100, 1),
            f"{runs[0][name]['lag_true']:.2f}",
            cell(name, "lag_learned", 1, 3),
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def figure(truth: jm.Vehicle, fits: list[jm.Fit], logs: list[jm.Log], path: Path) -> None:
    """True, file's and learned thrust of each thruster against its command."""
    plot, axes = plt.subplots(1, len(truth.thruster_names), figsize=(11, 3.4), layout="constrained")
    for i, (ax, name) in enumerate(zip(axes, truth.thruster_names, strict=True)):
        for k, (fit, log) in enumerate(zip(fits, logs, strict=True)):
            assert log.commands is not None
            grid = np.linspace(log.commands[:, i].min(), log.commands[:, i].max(), 301)
            learned = f"learned, {len(fits)} logs" if k == 0 else None
            ax.plot(grid, steady(fit.vehicle, grid)[:, i], color="#1f6fb5", lw=1.2, alpha=0.7, label=learned)
        grid = np.linspace(-1, 1, 401)
        ax.plot(grid, true_thrust(truth, grid)[:, i], color="black", ls="--", lw=1.4, label="true")
        ax.plot(grid, steady(fits[0].start, grid)[:, i], color="#c2620a", lw=1.2, label="file")
        ax.set(title=name, xlabel="command [1]", ylabel="thrust [N]")
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    save_figure(plot, path)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, table and figure.")],
    seeds: Annotated[int, typer.Option(min=1, help="Logs, each with its own operator and noise.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="One short log, few steps.")] = False,
) -> None:
    """Learns the thrust and the lag of every propeller from a log in which one is fouled."""
    duration, steps, seeds = (120.0, 15, 1) if quick else (600.0, 60, seeds)
    with study(out, quick):
        truth = craft()
        fits, logs, runs = [], [], []
        with Progress(transient=True) as bar:
            for seed in bar.track(range(seeds), description="logs"):
                began = time.process_time()
                log = recorded(truth, duration, seed)
                fit = fitted(extended(believed(truth), log), log, steps)
                logs.append(log)
                fits.append(fit)
                runs.append(judged(truth, fit, log) | {"seed": seed, "cpu_s": time.process_time() - began})
        jm.save_vehicle(fits[0].vehicle, out / "learned.toml")
        names = truth.thruster_names
        worst = max(run[names[FOULED]]["learned_rms_grid"] for run in runs)
        results = {"runs": runs, "duration_s": duration, "target": TARGET, "met": bool(worst <= TARGET)}
        write_results(out, results, table(runs, names))
        figure(truth, fits, logs, out / "thrust")


if __name__ == "__main__":
    typer.run(main)
