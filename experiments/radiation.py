"""Added mass that depends on the frequency of the waves, and what a constant one costs (thesis, sec. 3.1.1).

usage: python -m experiments.radiation --out DIR [--seeds 12] [--quick]

"The added mass matrix is a function of the wave frequency"; the thesis takes the limit of low frequencies.
Here a BlueROV2 Heavy heaves below the surface, driven by a wave-like force with the spectrum of JONSWAP
(Hasselmann et al. 1973) in a long or a short sea. The truth is Cummins' (1962) equation with a convolution,
integrated by numpy alone. The package's radiation model has two states, those of two fluid memories whose
gains cancel in steady motion:

    mu = g (lag(nu, T1) - lag(nu, T2)),   K(s) = g (T2 - T1) s / ((1 + T1 s) (1 + T2 s)),

a linear state-space model with the zero at s = 0 and the relative degree of one that radiation has (Perez and
Fossen 2008), passive for g > 0 and T2 > T1. A constant added mass and the model are fitted in one sea and
predict the other.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import claim_table, decided, spread, study, write_results
from experiments.blind.disturbances import components
from jaxmarine.effects import FluidMemory

HERE = Path(__file__).parent / "waves"
HEAVE = 2
DT, FINE = 0.1, 5  # [s] between samples, steps of the truth in each
SEAS = {"long": 9.0, "short": 2.5}  # peak periods [s]
FORCE = 20.0  # [N] standard deviation of what drives the craft
# The kernel K(s) = EXTRA OMEGA² s / (s² + 2 ZETA OMEGA s + OMEGA²): 15 kg more at rest than at infinity, and
# a potential damping of up to 12 N s/m at 2 rad/s. Its poles are real, as those of the model are.
OMEGA, ZETA, EXTRA = 2.0, 1.25, 15.0  # [rad/s], [1], [kg]
NOISE = 0.005, 0.005  # [m], [m/s]
AHEAD = 5.0  # [s]
# Spreads of the prior: of mass and linear damping, of a memory's gain and time constant.
WIDE = 20.0, 20.0, 30.0, 0.5  # [kg], [N s/m], [N s/m], [s]
MODELS = ("constant added mass", "radiation of two states")


def kernel(t: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """The true retardation function [N/m]: force for a velocity of one, as long ago."""
    apart = OMEGA * np.sqrt(ZETA**2 - 1.0)
    fast, slow = ZETA * OMEGA + apart, ZETA * OMEGA - apart
    return EXTRA * OMEGA**2 * (fast * np.exp(-fast * t) - slow * np.exp(-slow * t)) / (fast - slow)


def ogilvie(t, k, omega: float) -> tuple[float, float]:
    """What a retardation function adds to the mass [kg] and damps [N s/m] at a frequency (Ogilvie 1964)."""
    return (
        -float(np.trapezoid(k * np.sin(omega * t), t)) / omega,
        float(np.trapezoid(k * np.cos(omega * t), t)),
    )


def craft(model: str) -> jm.Vehicle:
    """The file's craft in heave alone, neutral, with or without radiation to be found."""
    file = jm.load_vehicle(jm.packaged_vehicle("bluerov2_heavy"))
    vehicle = dataclasses.replace(
        file, dof=("heave",), body=dataclasses.replace(file.body, buoyancy=file.body.weight)
    )
    if model == MODELS[0]:
        return vehicle
    return vehicle.place(*(jm.Placed(memory) for memory in memories(1.0, 0.3, 1.5)))


def memories(gain: float, fast: float, slow: float) -> tuple[FluidMemory, FluidMemory]:
    """The radiation model of heave: gain [N s/m], time constants [s]."""
    nothing, one = jnp.zeros(6), jnp.ones(6)
    first, second = (
        FluidMemory(nothing.at[HEAVE].set(g), one.at[HEAVE].set(t)) for g, t in ((gain, fast), (-gain, slow))
    )
    return first, second


def true_run(vehicle: jm.Vehicle, force: Float[np.ndarray, " fine"], dt: float):
    """Depth and speed of Cummins' equation under a force, by Heun's method and the trapezoidal rule."""
    mass = float(vehicle.body.matrix[HEAVE, HEAVE] + vehicle.added_mass[HEAVE, HEAVE])
    linear, quadratic = (float(d[HEAVE, HEAVE]) for d in (vehicle.damping.linear, vehicle.damping.quadratic))
    k = kernel(np.arange(0.0, 10.0, dt)) * dt
    z, w = np.zeros(len(force)), np.zeros(len(force))

    def slope(i: int, speed: float, past: float) -> float:
        memory = past + 0.5 * k[0] * speed
        return (force[i] - memory - linear * speed - quadratic * abs(speed) * speed) / mass

    for i in range(len(force) - 1):
        count = min(i, len(k) - 1)
        now = float(k[1 : count + 1] @ w[i - count : i][::-1])
        count = min(i + 1, len(k) - 1)
        after = float(k[1 : count + 1] @ w[i + 1 - count : i + 1][::-1])
        first = slope(i, w[i], now)
        second = slope(i, w[i] + dt * first, after)
        w[i + 1] = w[i] + 0.5 * dt * (first + second)
        z[i + 1] = z[i] + 0.5 * dt * (w[i] + w[i + 1])
    return z, w


def logged(vehicle: jm.Vehicle, period: float, duration: float, seed: list[int]) -> jm.Log:
    """A log of depth and speed, with noise, in a sea of this peak period."""
    rng = np.random.default_rng(seed)
    omega, amplitude = components(period, rng)
    t = np.arange(round(duration / DT)) * DT
    push = FORCE * np.cos(omega * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, len(omega))) @ amplitude
    z, w = (a[::FINE] for a in true_run(vehicle, np.repeat(push, FINE), DT / FINE))
    channels = np.zeros((len(t), 18))
    channels[:, 12:] = np.nan
    channels[:, 2] = z + NOISE[0] * rng.standard_normal(len(t))
    channels[:, 6 + HEAVE] = w + NOISE[1] * rng.standard_normal(len(t))
    wrench = np.zeros((len(t), 6))
    wrench[:, HEAVE] = push
    return jm.Log(t, channels, None, wrench, vehicle.command_names, f"{period:g} s")


def fitted(model: str, log: jm.Log) -> jm.Vehicle:
    """Added mass and linear damping, or added mass at infinity and the radiation, by trajectories."""
    start = craft(model)

    def free(vehicle: jm.Vehicle):
        effects = [placed.effect for placed in vehicle.placed if isinstance(placed.effect, FluidMemory)]
        return (vehicle.added_mass, vehicle.damping.linear), [(e.gain, e.time_constant) for e in effects]

    noise = np.full(18, np.nan)
    noise[[2, 6 + HEAVE]] = NOISE
    own, effects = free(start)
    # Wide, and what a window cannot tell from linear damping or added mass stays where it was.
    wide = [(jnp.full(6, WIDE[2]), jnp.full(6, WIDE[3])) for _ in effects]
    prior = tuple(jnp.full((6, 6), std) for std in WIDE[: len(own)]), wide
    return jm.fit(
        start, log, free, window=AHEAD, noise=noise, prior=prior, entries="diagonal", throw=False
    ).vehicle


def added(vehicle: jm.Vehicle, omega: float) -> tuple[float, float]:
    """Added mass [kg] and linear damping [N s/m] of heave at a frequency."""
    mass, damping = (float(a[HEAVE, HEAVE]) for a in (vehicle.added_mass, vehicle.damping.linear))
    for effect in (placed.effect for placed in vehicle.placed):
        if isinstance(effect, FluidMemory):
            shown = float(effect.gain[HEAVE]) / (1.0 + 1j * omega * float(effect.time_constant[HEAVE]))
            mass, damping = mass + shown.imag / omega, damping + shown.real
    return mass, damping


def trial(seed: int, duration: float) -> dict[str, Any]:
    """Both models fitted in each sea: what they predict of a new run of each, and say of the added mass."""
    truth = craft(MODELS[0])
    fit_on, new = (
        {
            sea: logged(truth, period, duration, [seed, part, k])
            for k, (sea, period) in enumerate(SEAS.items())
        }
        for part in (0, 1)
    )
    t = np.arange(0.0, 40.0, 0.002)
    errors, masses = {}, {}
    for model in MODELS:
        for sea, log in fit_on.items():
            found = fitted(model, log)
            for other, run in new.items():
                shown = np.asarray(jm.simulate(found, run, jm.initial_state(found)).channels)
                off = (shown - run.channels)[:, 6 + HEAVE]
                errors[f"{model}, found in the {sea} sea, predicts the {other} one"] = float(
                    np.sqrt((off**2).mean()) / run.channels[:, 6 + HEAVE].std()
                )
            for other, period in SEAS.items():
                omega = 2.0 * np.pi / period
                more, _ = ogilvie(t, kernel(t), omega)
                true = float(truth.added_mass[HEAVE, HEAVE]) + more
                masses[f"{model}, found in the {sea} sea, at the peak of the {other} one"] = (
                    added(found, omega)[0] / true
                )
    return {"seed": seed, "errors": errors, "masses": masses}


def claims(rows: list[dict]) -> list[dict]:
    """Whether the model carries over to the other sea better, and is no worse in its own."""
    pairs = {}
    for sea in SEAS:
        for other in SEAS:
            names = [f"{model}, found in the {sea} sea, predicts the {other} one" for model in MODELS[::-1]]
            words = (
                f"radiation predicts the {other} sea better than a constant mass, both found in the {sea} one"
            )
            pairs[words] = [(row["errors"][names[0]], row["errors"][names[1]]) for row in rows]
    return decided(pairs)


def table(results: dict[str, Any]) -> str:
    """Claims by the error of the speed over a whole run, as a share of its spread; then added masses."""
    lines = [claim_table(results["claims"]), "| added mass, found over true | median (range) |", "|---|---|"]
    for name in results["rows"][0]["masses"]:
        lines.append(f"| {name} | {spread([row['masses'][name] for row in results['rows']], 2)} |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    seeds: Annotated[int, typer.Option(min=1, help="Seas of each kind.")] = 12,
    quick: Annotated[bool, typer.Option("--quick", help="One seed, half a minute each.")] = False,
) -> None:
    """What a constant added mass costs in waves of another length."""
    seeds, duration = (1, 30.0) if quick else (seeds, 120.0)
    with study(out, quick), Progress(transient=True) as bar:
        rows: list[dict[str, Any]] = []
        for seed in bar.track(range(seeds), description="seas"):
            rows.append(trial(seed, duration))
            results = {"claims": claims(rows), "rows": rows}
            write_results(out, results, table(results))


if __name__ == "__main__":
    typer.run(main)
