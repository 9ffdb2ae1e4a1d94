"""How long does a roll-out take, of one vehicle and of a thousand?

usage: python -m experiments.benchmarks.rollout --out DIR [--rounds 15] [--quick]

The ROV Tethra under an operator's wrenches, held over steps of 0.1 s. The reference is scipy's DOP853 at
1e-12, begun anew at every hold; all others but Tsit5 take one classical Runge-Kutta step per hold and
differ from it by that method's error. Writes results.json and results.md.
"""

import functools
from pathlib import Path
from typing import Annotated

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import typer

import jaxmarine as jm
from experiments.benchmarks._forms import (
    DT,
    Dive,
    by_c,
    by_casadi,
    by_jax,
    by_jax_batch_last,
    by_numba,
    rates,
    rk4,
)
from experiments.benchmarks._rounds import Run, Table, Target, benchmark, compared, report
from jaxmarine._compiled import compiled
from jaxmarine.simulation import RungeKutta4, hold, hold_many
from jaxmarine.vehicle import Input, Plant, State


def exact(dive: Dive, vehicle: int) -> np.ndarray:
    """States at the ends of all holds, by scipy: [steps, 13]."""
    state, states = dive.starts[vehicle], []

    def slopes(_, s, tau):
        return rates(dive.model, s, tau, xp=np)

    for tau in dive.wrenches[vehicle]:
        solved = scipy.integrate.solve_ivp(
            slopes, (0.0, DT), state, "DOP853", args=(tau,), rtol=1e-12, atol=1e-14
        )
        state = solved.y[:, -1]
        states.append(state)
    return np.array(states)


# --- the package, and other ways to say the same in jax ---------------------------------------------


# Rows [13, ...] and wrenches [6, ...]; batches lie behind.


def state_of(row) -> State:
    return State(row[:3], row[3:7], row[7:13], row[13:])


def row_of(state: State):
    return jnp.concatenate([state.position, state.attitude, state.velocity])


def input_of(plant: Plant, tau) -> Input:
    nothing = jnp.zeros(plant.drive.max_thrust.shape)
    return Input(nothing, nothing, tau, jnp.zeros(()))


def held(plant: Plant, start, wrenches):
    """The package's step, hold by hold."""

    def step(state, tau):
        after = hold(plant, state, input_of(plant, tau), DT)
        return after, row_of(after)

    return jax.lax.scan(step, state_of(start), wrenches)[1]


def held_many(plant: Plant, starts, wrenches):
    """The package's step for many vehicles: starts [13, vehicles], wrenches [steps, 6, vehicles]."""
    dt = jnp.full(starts.shape[1:], DT)
    # Records are of one vehicle when they are made; here each array has the vehicles behind.
    behind = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    inputs_of, states_of = behind(functools.partial(input_of, plant)), behind(state_of)

    def step(states, tau):
        after = hold_many(plant, states, inputs_of(tau), dt)
        return after, row_of(after)

    return jax.lax.scan(step, states_of(starts), wrenches)[1]


def by_hand(plant: Plant, start, wrenches):
    """The package's rates, stepped by hand: what diffrax' way of stepping costs is the difference."""

    def step(row, tau):
        after = rk4(lambda s: row_of(plant.rates(state_of(s), input_of(plant, tau))), row)
        return after, after

    return jax.lax.scan(step, start, wrenches)[1]


def solved(plant: Plant, start, wrenches, solver, controller):
    """One `diffeqsolve` over all; the wrench is looked up by time.

    At the end of a step the last stage sees the next wrench: the error of this form is not the solver's.
    """

    def slopes(t, row, args):
        plant, wrenches = args
        # Times such as 3 * 0.1 are rounded.
        index = jnp.floor(t / DT + 1e-9).astype(int)
        return row_of(plant.rates(state_of(row), input_of(plant, wrenches[index])))

    ends = DT * jnp.arange(1, len(wrenches) + 1)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(slopes),
        solver,
        0.0,
        ends[-1],
        DT,
        start,
        (plant, wrenches),
        saveat=diffrax.SaveAt(ts=ends),
        stepsize_controller=controller,
        max_steps=None,
    ).ys


def simulated(dive: Dive) -> Run:
    """The whole call that a user makes, which also shows what the sensors see."""
    # The state after the last hold is not in the trajectory: one sample more.
    wrenches = np.concatenate([dive.wrenches[0], dive.wrenches[0][-1:]])
    t = DT * np.arange(len(wrenches))
    names = dive.vehicle.command_names
    log = jm.Log(t, np.full((len(t), 18), np.nan), None, wrenches, names, "dive")
    start = state_of(jnp.asarray(dive.starts[0]))
    return lambda: jax.vmap(row_of)(jm.simulate(dive.vehicle, log, start).states)[1:]


# --- the questions ------------------------------------------------------------------------------------


def one_vehicle(steps: int, rounds: int) -> Table:
    dive = Dive.of(1, steps)
    plant = dive.vehicle.plant()
    start, wrenches = jnp.asarray(dive.starts[0]), jnp.asarray(dive.wrenches[0])
    adaptive = diffrax.PIDController(rtol=1e-6, atol=1e-8)

    def jitted(function, *more):
        run = eqx.filter_jit(function)
        return lambda: lambda: run(plant, start, wrenches, *more)

    def by_c_alone() -> Run:
        run = by_c(dive)
        return lambda: run()[0]

    makers = {
        "C": by_c_alone,
        "casadi, compiled by gcc": lambda: by_casadi(dive),
        "numba": lambda: by_numba(dive),
        "jax, equations by hand": lambda: lambda: by_jax(dive.model, start, wrenches),
        "its rates, RK4 by hand": jitted(by_hand),
        "jaxmarine, hold": jitted(held),
        "jaxmarine, simulate": lambda: simulated(dive),
        "diffeqsolve, constant step": jitted(solved, RungeKutta4(), diffrax.ConstantStepSize()),
        "diffeqsolve, Tsit5": jitted(solved, diffrax.Tsit5(), adaptive),
    }
    return compared("One vehicle", makers, exact(dive, 0), "C", rounds, "step", steps)


def many_vehicles(vehicles: int, steps: int, rounds: int) -> Table:
    dive = Dive.of(vehicles, steps)
    plant = dive.vehicle.plant()
    starts, wrenches = jnp.asarray(dive.starts), jnp.asarray(dive.wrenches)
    # What three vehicles of different operators come to stands for all.
    some = np.array([0, vehicles // 2, vehicles - 1])
    reference = np.stack([exact(dive, vehicle) for vehicle in some])

    def shown(run, pick=lambda states: states[some]) -> Run:
        """Only some states are compared; the others are calculated all the same."""
        return lambda: pick(run())

    def behind(function, model):
        turned = starts.T, jnp.moveaxis(wrenches, 0, -1)
        return shown(lambda: function(model, *turned), lambda s: jnp.moveaxis(s[..., some], -1, 0))

    def by_vmap() -> Run:
        run = jax.jit(jax.vmap(held, in_axes=(None, 0, 0)))
        return shown(lambda: run(plant, starts, wrenches))

    makers = {
        "scalar C": lambda: shown(by_c(dive)),
        "jax, equations by hand, vehicles last": lambda: behind(by_jax_batch_last, dive.model),
        "jaxmarine, vmap of hold": by_vmap,
        "jaxmarine, hold_many": lambda: behind(compiled(held_many), plant),
    }
    title = f"{vehicles} vehicles"
    return compared(title, makers, reference, "scalar C", rounds, "step of a vehicle", vehicles * steps)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 15,
    quick: Annotated[bool, typer.Option("--quick", help="Few steps, few vehicles, two rounds.")] = False,
) -> None:
    """Times roll-outs of one vehicle and of a thousand."""
    steps, vehicles, rounds = (20, 8, 2) if quick else (1000, 1000, rounds)
    with benchmark(out, quick):
        tables = [one_vehicle(steps, rounds), many_vehicles(vehicles, min(steps, 100), rounds)]
        alone, many = tables
        ours = "jaxmarine, hold"
        targets = [
            Target("one vehicle, against C", alone, ours, "C", 8.0),
            Target("one vehicle, against a hand-written scan", alone, ours, "its rates, RK4 by hand", 1.2),
            Target("1000 vehicles, against scalar C", many, "jaxmarine, hold_many", "scalar C", 1.0),
        ]
        report(out, tables, targets)


if __name__ == "__main__":
    typer.run(main)
