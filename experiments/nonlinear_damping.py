"""Where networks earn their keep: damping that is neither linear nor quadratic.

usage: python -m experiments.nonlinear_damping --out DIR [--seeds N] [--quick]

CyberShip II carries a pod whose drag falls in a step with the flow regime, and its hull has lift, drag of
the cross-flow along its length and wave drag. The best linear plus quadratic damping is fitted to a log,
then held, and a network fitted beside it, by the one-step and then by the trajectory loss. Measured is the
error of predictions over 10 s on logs that were not fitted, within the velocities seen and beyond them.

Besides: the inertia, free and positive definite beside the network; one lumped network of velocities and
commands, parallel to a model with a wrong mass (thesis, sec. 4.1), against networks for single
parameters (sec. 4.2); mini-batches with Adam against Levenberg-Marquardt.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import optax
import typer
from jaxtyping import Array, Bool, Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import ScalarEffect, claim_table, decided, save_figure, spread, study, write_results
from jaxmarine._types import CHANNELS, Scalar, Wrench
from jaxmarine.effects import HullLift, Motion
from jaxmarine.examples import operator, recorded
from jaxmarine.fitting import noise_of
from jaxmarine.logs import smooth_states
from jaxmarine.networks import MLPDamping, Seen, learned_wrench, mlp_damping
from jaxmarine.physics import damping, from_euler, step_lengths, thrust
from jaxmarine.simulation import hold, inputs, substeps
from jaxmarine.vehicle import Input, State

HERE = Path(__file__).parent / "damping"
AXES = ("surge", "sway", "yaw")
PLACES = np.array([0, 1, 5])
DT, HORIZON = 0.2, 10.0  # [s]
HEAVY = 0.3  # the wrong file has so much more inertia on each axis
WIDTH, HIDDEN = 16, 6  # of the damping network, of each lumped one
SPREAD = 3.0  # prior of the weights
HELD = 1e-6  # prior of what is not fitted, in its own units: so small that it stays
LEVELS = (0.1, 0.05, 0.02)  # of what there is to save: costs at which the solvers are compared
RATES = (3e-3, 1e-2, 3e-2)  # of Adam at the start
SOLVERS = {"lm": "Levenberg-Marquardt"} | {
    f"adam_{rate:g}": f"Adam from a rate of {rate:g}" for rate in RATES
}
BATCH, BLOCK = 128, 10  # samples in a mini-batch, steps of Levenberg-Marquardt between two looks


@dataclasses.dataclass(frozen=True)
class Size:
    """Length of a log [s], steps of a fit, epochs of Adam and blocks of Levenberg-Marquardt."""

    duration: float = 1000.0
    steps: int = 30
    epochs: int = 3000
    blocks: int = 12


QUICK = Size(duration=60.0, steps=8, epochs=20, blocks=1)


# --- the plant -----------------------------------------------------------------------------------


class CrossFlow(ScalarEffect):
    """Drag of the flow across each section: Y = -k int |v + x r| (v + x r) dx, N with the arm x. Neutral: 0.

    - `per_length` k [N s²/m³]: rho T C_D / 2 with draft T; over the length of 1.255 m.

    A product of |v + x r|, which no |v| v and |r| r add up to. Source: strip theory, after
    Faltinsen (1990) and Fossen (2021). With T = 0.08 m and C_D = 0.7 it has the sway drag of the file.
    """

    name = "cross_flow"
    units = {"per_length": "N s²/m³"}

    per_length: Scalar

    def __call__(self, motion: Motion) -> Wrench:
        x, weight = np.polynomial.legendre.leggauss(12)
        x, weight = jnp.asarray(0.6275 * x), jnp.asarray(0.6275 * weight)
        across = motion.nu_r[1] + x * motion.nu_r[5]
        drag = self.per_length * weight * jnp.abs(across) * across
        return jnp.zeros(6).at[1].set(-drag.sum()).at[5].set(-(x * drag).sum())


class WaveDrag(ScalarEffect):
    """Surge drag with the fourth power of the speed: X = -coefficient |u|³ u. Neutral: 0.

    Source: wave resistance grows far faster than with the square below its hump; after Faltinsen (2005).
    """

    name = "wave_drag"
    units = {"coefficient": "N s⁴/m⁴"}

    coefficient: Scalar

    def __call__(self, motion: Motion) -> Wrench:
        u = motion.nu_r[0]
        return jnp.zeros(6).at[0].set(-self.coefficient * jnp.abs(u) ** 3 * u)


class Pod(ScalarEffect):
    """An upright cylinder under the bow, whose drag falls where its flow turns turbulent. Neutral: 0.

    F = -area_drag C(|V|) |V| V at x = 0.3 m, C from 1.2 to 0.4 about |V| = 0.27 m/s within some 0.2 m/s: the
    drag crisis at a Reynolds number of 6e4 for a rough cylinder of 0.25 m in fresh water.

    - `area_drag` [N s²/m²]: rho d h / 2 of diameter d and height h; 0.06 m high it is 7.7.

    Source: after Achenbach (1971), J. Fluid Mech. 46, 321-335 (rough cylinders); Hoerner (1965).
    """

    name = "pod"
    units = {"area_drag": "N s²/m²"}

    area_drag: Scalar

    def __call__(self, motion: Motion) -> Wrench:
        arm, critical, within = 0.3, 0.27, 0.1
        u, v = motion.nu_r[0], motion.nu_r[1] + arm * motion.nu_r[5]
        squared = u**2 + v**2
        moving = squared > 0
        # A plain root has no slope at rest.
        speed = jnp.where(moving, jnp.sqrt(jnp.where(moving, squared, 1.0)), 0.0)
        drag = self.area_drag * (0.8 - 0.4 * jnp.tanh((speed - critical) / within)) * speed
        return jnp.zeros(6).at[0].set(-drag * u).at[1].set(-drag * v).at[5].set(-arm * drag * v)


OWN = (CrossFlow, WaveDrag, Pod)


def craft() -> jm.Vehicle:
    """CyberShip II as its file has it, with the noise that the file states."""
    return jm.load_vehicle(jm.packaged_vehicle("cybership2"))


def true_plant() -> jm.Vehicle:
    """The ship as it is: of the file's quadratic damping only that of surge."""
    vehicle = craft()
    quadratic = jnp.zeros((6, 6)).at[0, 0].set(vehicle.damping.quadratic[0, 0])
    vehicle = eqx.tree_at(lambda v: v.damping.quadratic, vehicle, quadratic)
    lift = HullLift(*(jnp.asarray(x) for x in (10.0, 3.0, 0.0, 0.0)))
    terms = (lift, CrossFlow(jnp.asarray(28.7)), WaveDrag(jnp.asarray(1.0)), Pod(jnp.asarray(7.7)))
    return vehicle.place(*(jm.Placed(term) for term in terms))


def sailed(duration: float, seed: int, beyond: bool = False) -> Float[np.ndarray, "times thrusters"]:
    """Commands of an operator; `beyond`: who sails faster than in training, ahead and astern."""
    t = np.arange(0.0, duration, DT)
    sticks = operator(3, t, seed, strength=1.0)
    if beyond:
        ahead = np.where((t // 30.0) % 3 < 2, 1.0, -1.0)
        sticks = np.clip(sticks * [0.3, 0.3, 1.0] + ahead[:, None] * [1.0, 1.0, 0.0], -1.0, 1.0)
    return sticks


def log_of(truth: jm.Vehicle, commands: Float[np.ndarray, "times thrusters"], seed: int) -> jm.Log:
    """What is measured while the ship sails under commands; accelerations are not."""
    log = recorded(truth, commands, DT * np.arange(len(commands)), seed, "log")
    return dataclasses.replace(log, channels=np.where(np.arange(18) < 12, log.channels, np.nan))


# --- the models ----------------------------------------------------------------------------------


def extended(vehicle: jm.Vehicle, log: jm.Log, seed: int) -> jm.Vehicle:
    """The vehicle with a damping network that changes nothing yet."""
    nu, size = _sizes(vehicle, log)
    term = mlp_damping(AXES, np.abs(nu).max(axis=0), size, jax.random.key(seed), width=WIDTH, seen=nu)
    return vehicle.place(jm.Placed(term))


def parallel(vehicle: jm.Vehicle, log: jm.Log, seed: int) -> jm.Vehicle:
    """The vehicle with one lumped network per axis instead, of velocities and commands (thesis, fig. 4.2)."""
    assert log.commands is not None
    nu, size = _sizes(vehicle, log)
    signals = np.concatenate([nu, log.commands], axis=1)
    ends, names = (signals.min(axis=0), signals.max(axis=0)), ("u", "v", "r", *log.command_names)
    keys = jax.random.split(jax.random.key(seed), len(AXES))
    placed = tuple(
        jm.Placed(learned_wrench(axis, names, log.command_names, *ends, float(scale), key, HIDDEN), axis)
        for axis, scale, key in zip(AXES, size, keys, strict=True)
    )
    return dataclasses.replace(vehicle, placed=placed)


def _sizes(vehicle: jm.Vehicle, log: jm.Log):
    """Velocities of the log, and forces that brake them within some seconds [N, N m]."""
    nu = smooth_states(log, vehicle.dof).nu[:, PLACES]
    mass = np.diag(np.asarray(vehicle.mass_matrix))[PLACES]
    return nu, 0.2 * mass * np.abs(nu).max(axis=0)


def network(vehicle: jm.Vehicle) -> MLPDamping:
    """The damping network of a vehicle."""
    effect: Any = vehicle.placed[0].effect
    return effect


def free(v: jm.Vehicle) -> dict[str, Any]:
    """All that is ever fitted; which part of it a fit may move, its prior says."""
    effects: list[Any] = [placed.effect for placed in v.placed]
    return {
        "mass": v.added_mass,
        "damping": (v.damping.linear, v.damping.quadratic),
        "network": tuple(effect.network for effect in effects),
    }


def fitted(start: jm.Vehicle, log: jm.Log, parts: tuple[str, ...], loss: Any, steps: int) -> jm.Fit:
    """The named parts fitted, the others held; one set of free numbers, so that one program serves all."""
    wide = {"mass": np.inf, "damping": np.inf, "network": SPREAD}

    def std(name: str, leaves: Any) -> Any:
        return jax.tree.map(lambda a: np.full(np.shape(a), wide[name] if name in parts else HELD), leaves)

    prior = {name: std(name, leaves) for name, leaves in free(start).items()}
    # The noise is known, and all models are to weigh it alike.
    noise = noise_of(start, [log])
    return jm.fit(start, log, free, loss=loss, prior=prior, max_steps=steps, throw=False, noise=noise)


def trained(start: jm.Vehicle, log: jm.Log, parts: tuple[str, ...], steps: int) -> dict[str, jm.Fit]:
    """By the one-step loss, and from there by the trajectory loss."""
    # The one-step loss only has to begin: its minimum is off by the noise of the velocities.
    first = fitted(start, log, parts, "one_step", max(2, steps // 4))
    return {"one_step": first, "trajectory": fitted(first.vehicle, log, parts, "trajectory", steps)}


def heavier(vehicle: jm.Vehicle) -> jm.Vehicle:
    """The vehicle by a file whose inertia is wrong."""
    more = HEAVY * jnp.diag(jnp.diag(vehicle.mass_matrix) * vehicle.free)
    return eqx.tree_at(lambda v: v.added_mass, vehicle, vehicle.added_mass + more)


def endless(vehicle: jm.Vehicle) -> jm.Vehicle:
    """The same with its damping network nowhere faded out."""
    everywhere = Seen(jnp.zeros(3), jnp.zeros((3, 3)))
    effect = eqx.tree_at(lambda e: e.seen, network(vehicle), everywhere)
    return dataclasses.replace(vehicle, placed=(jm.Placed(effect),))


# --- errors --------------------------------------------------------------------------------------


@eqx.filter_jit
def _predicted(vehicle: jm.Vehicle, t, commands, states: State, restart, split: int):
    plant = vehicle.plant()
    over, _ = inputs(plant, t, commands, jnp.zeros((len(t), 6)))

    def step(state, now):
        over, dt, measured, restart = now
        state = jax.tree.map(lambda a, b: jnp.where(restart, a, b), measured, state)
        return hold(plant, state, over, dt, split), (state.position, state.velocity)

    start = jax.tree.map(lambda a: a[0], states)
    return jax.lax.scan(step, start, (over, step_lengths(t), states, restart))[1]


@dataclasses.dataclass(frozen=True)
class Course:
    """A run of the true ship without noise: what predictions are compared with."""

    t: Float[np.ndarray, " times"]
    commands: Float[np.ndarray, "times thrusters"]
    states: State

    @property
    def nu(self) -> Float[np.ndarray, "times 3"]:
        return np.asarray(self.states.velocity)[:, PLACES]


def course(truth: jm.Vehicle, commands: Float[np.ndarray, "times thrusters"]) -> Course:
    """The run under these commands, from rest."""
    t = DT * np.arange(len(commands))
    empty = jm.Log(t, np.full((len(t), len(CHANNELS)), np.nan), commands, None, truth.thruster_names, "run")
    return Course(t, commands, jm.simulate(truth, empty, jm.initial_state(truth)).states)


def errors(vehicle: jm.Vehicle, run: Course) -> tuple[Float[np.ndarray, "starts steps"], ...]:
    """Distance [m] and errors of velocity [starts, steps, 3] of predictions that start in the true state."""
    every = round(HORIZON / DT)
    position, velocity = _predicted(
        vehicle,
        jnp.asarray(run.t),
        jnp.asarray(run.commands),
        run.states,
        jnp.asarray(np.arange(len(run.t)) % every == 0),
        max(2, substeps(craft(), DT)),
    )
    off = np.asarray(position - run.states.position)[:, :2]
    off_nu = np.asarray(velocity - run.states.velocity)[:, PLACES]
    whole = len(run.t) // every * every
    distance = np.linalg.norm(off, axis=1)[:whole].reshape(-1, every)
    return distance, off_nu[:whole].reshape(-1, every, 3)


def scored(vehicle: jm.Vehicle, run: Course, kept: Bool[np.ndarray, " starts"]) -> dict[str, float]:
    """Root mean square errors over the chosen starts: distance at the last sample, velocities all along."""
    distance, off_nu = errors(vehicle, run)
    with np.errstate(over="ignore", invalid="ignore"):
        rms = np.sqrt((off_nu[kept] ** 2).mean(axis=(0, 1)))
        out = {"distance_10s": float(np.sqrt((distance[kept, -1] ** 2).mean()))}
    return out | dict(zip(("u", "v", "r"), rms.tolist(), strict=True))


def unseen(vehicle: jm.Vehicle, run: Course) -> Float[np.ndarray, " starts"]:
    """The share of each prediction's true path that the network has not seen (gate below a half)."""
    gate = np.asarray(jax.vmap(network(vehicle).seen)(jnp.asarray(run.nu)))
    every = round(HORIZON / DT)
    whole = len(gate) // every * every
    return (gate[:whole].reshape(-1, every) < 0.5).mean(axis=1)


def mass_errors(truth: jm.Vehicle, vehicle: jm.Vehicle) -> dict[str, float]:
    """Largest error of the total mass matrix [%]: of the diagonal, and of the rest against its size."""
    block = np.ix_(PLACES, PLACES)
    true, found = (np.asarray(v.mass_matrix)[block] for v in (truth, vehicle))
    size = np.sqrt(np.outer(np.diag(true), np.diag(true)))
    off = 100 * np.abs(found - true) / size
    return {"diagonal": float(np.diag(off).max()), "off_diagonal": float((off - np.diag(np.diag(off))).max())}


# --- mini-batches --------------------------------------------------------------------------------


def samples(vehicle: jm.Vehicle, log: jm.Log) -> tuple[Array, Array, Array]:
    """Velocities, the wrench that the vehicle lacks at each sample, and the inverse mass matrix."""
    track = smooth_states(log, vehicle.dof)
    slope = np.gradient(track.nu, log.t, axis=0)
    motion = map(jnp.asarray, (track.position, track.attitude, track.nu, slope))
    missing, inverse = _missing(vehicle, jnp.asarray(log.t), jnp.asarray(log.commands), *motion)
    return jnp.asarray(track.nu[:, PLACES]), missing, inverse


@eqx.filter_jit
def _missing(vehicle: jm.Vehicle, t, commands, position, attitude, nu, nu_dot):
    plant = vehicle.plant()
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    mean = thrust(drive, t, commands).mean
    # A slope about a sample lies half in the hold before it.
    push = 0.5 * (jnp.concatenate([mean[:1], mean[:-1]]) + mean)

    def one(position, attitude, nu, nu_dot, push, command, t):
        state = State(position, from_euler(attitude), nu, jnp.zeros(0))
        return plant.balance(state, nu_dot, Input(push, command, jnp.zeros(6), t))

    missing = jax.vmap(one)(position, attitude, nu, nu_dot, push, commands, t)
    return missing[:, PLACES], plant.inverse_mass[np.ix_(PLACES, PLACES)]


def residual(weights: Any, args: Any) -> tuple[Array, Any]:
    """Errors of acceleration in units of their spread, and the prior: the one-step loss of the network."""
    term, velocity, missing, inverse, scale = args
    term = eqx.tree_at(lambda one: one.network, term, weights)
    force = jax.vmap(lambda nu: term(_moving(nu)))(velocity)[:, PLACES]
    return (missing - force) @ inverse.T / scale, jax.tree.map(lambda w: w / SPREAD, weights)


def _moving(nu: Float[Array, "3"]) -> Motion:
    nu = jnp.zeros(6).at[PLACES].set(nu)
    return Motion(jnp.zeros(3), jnp.eye(3), nu, nu, jnp.zeros(0), jnp.zeros(()), jnp.zeros(3))


def cost(weights: Any, args: Any) -> Array:
    """Half the sum of the squares."""
    return 0.5 * optax.tree.norm(residual(weights, args), squared=True)


@eqx.filter_jit
def _epochs(weights: Any, args: Any, rate: Array, keys: Array):
    """Adam on shuffled mini-batches, its rate falling by a cosine; the whole cost after each epoch."""
    term, velocity, missing, *rest = args
    batches = len(velocity) // BATCH
    adam = optax.adam(optax.cosine_decay_schedule(1.0, len(keys) * batches))

    def part_of_cost(weights, rows):
        error, prior = residual(weights, (term, velocity[rows], missing[rows], *rest))
        return 0.5 * len(velocity) / BATCH * (error**2).sum() + 0.5 * optax.tree.norm(prior, squared=True)

    def step(carry, rows):
        weights, state = carry
        change, state = adam.update(jax.grad(part_of_cost)(weights, rows), state)
        return (optax.apply_updates(weights, optax.tree.scale(rate, change)), state), None

    def epoch(carry, key):
        rows = jax.random.permutation(key, len(velocity))[: batches * BATCH].reshape(batches, BATCH)
        carry, _ = jax.lax.scan(step, carry, rows)
        return carry, cost(carry[0], args)

    return jax.lax.scan(epoch, (weights, adam.init(weights)), keys)[1]


@eqx.filter_jit
def _descended(starts: Any, args: Any):
    """Some steps of Levenberg-Marquardt."""
    return jm.levenberg_marquardt(residual, starts, args, max_steps=BLOCK, rtol=1e-6, atol=1e-6)


def against_adam(start: jm.Vehicle, log: jm.Log, epochs: int, blocks: int) -> dict[str, Any]:
    """Cost over CPU time of Levenberg-Marquardt and of Adam at several rates, on the same one-step loss.

    To see its course Levenberg-Marquardt is stopped every `BLOCK` steps, and goes on with fresh damping.
    """
    velocity, missing, inverse = samples(start, log)
    term = network(start)
    weights = term.network
    scale = (missing @ inverse.T).std(axis=0)
    args = (term, velocity, missing, inverse, scale[None])
    out: dict[str, Any] = {"first": float(cost(weights, args)), "samples": len(velocity)}

    values = jax.tree.map(lambda a: a[None], weights)
    run = _compiled(_descended, values, args)
    costs, seconds, began = [], [], time.process_time()
    for _ in range(blocks):
        found = jax.block_until_ready(run(values, args))
        values = found.values
        costs.append(float(found.costs[0]))
        seconds.append(time.process_time() - began)
    out["lm"] = {"costs": costs, "cpu_s": seconds}
    for rate in RATES:
        given = (weights, args, jnp.asarray(rate), jax.random.split(jax.random.key(1), epochs))
        run = _compiled(_epochs, *given)
        began = time.process_time()
        costs = np.asarray(jax.block_until_ready(run(*given)))
        passed = (time.process_time() - began) * np.arange(1, epochs + 1) / epochs
        out[f"adam_{rate:g}"] = {"costs": costs.tolist(), "cpu_s": passed.tolist()}
    return out


def _compiled(jitted: Any, *given: Any) -> Any:
    """The compiled program, so that its time is that of running alone."""
    return jitted.lower(*given).compile()


def excess(adam: dict[str, Any], name: str) -> Float[np.ndarray, " points"]:
    """Cost above the least that any of them has reached, as a share of what there is to save."""
    solvers = [key for key in adam if isinstance(adam[key], dict)]
    least = min(min(adam[key]["costs"]) for key in solvers)
    return (np.array(adam[name]["costs"]) - least) / (adam["first"] - least)


def told_of(adam: dict[str, Any]) -> dict[str, Any]:
    """Per solver the CPU time [s] at which the excess is first below each of `LEVELS`, and what is left."""
    out = {}
    for name in SOLVERS:
        left, seconds = excess(adam, name), np.array(adam[name]["cpu_s"])
        first = {f"{level:g}": seconds[left <= level][:1].tolist() for level in LEVELS}
        out[name] = {
            "cpu_s": {level: found[0] if found else None for level, found in first.items()},
            "left": float(left[-1]),
        }
    return out


# --- one seed ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """What a seed has left: the vehicles by name, the runs, the courses of training, and the numbers."""

    vehicles: Mapping[str, jm.Vehicle]
    inside: Course
    beyond: Course
    adam: dict[str, Any]
    numbers: dict[str, Any]


def case(truth: jm.Vehicle, seed: int, size: Size) -> Case:
    """Everything for one log."""
    log = log_of(truth, sailed(size.duration, 100 + seed), 200 + seed)
    inside = course(truth, sailed(size.duration, 300 + seed))
    beyond = course(truth, sailed(size.duration, 400 + seed, beyond=True))
    start, steps = extended(craft(), log, seed), size.steps

    classical = trained(start, log, ("damping",), steps)
    hybrid = trained(classical["trajectory"].vehicle, log, ("network",), steps)
    # Beside a wrong mass the damping is fitted once more, then a lumped network, or the mass and the network.
    wrong = {"trajectory": fitted(heavier(start), log, ("damping",), "trajectory", steps)}
    lumped = trained(parallel(wrong["trajectory"].vehicle, log, seed), log, ("network",), steps)
    single = trained(wrong["trajectory"].vehicle, log, ("mass", "network"), steps)
    named = {
        "classical": classical,
        "hybrid": hybrid,
        "wrong mass": wrong,
        "lumped": lumped,
        "single": single,
    }
    fits = {f"{name}, {loss}": fit for name, by in named.items() for loss, fit in by.items()}
    vehicles = {"file": start} | {name: fit.vehicle for name, fit in fits.items()}
    for name in ("hybrid", "single"):
        vehicles[f"{name}, no fading"] = endless(vehicles[f"{name}, trajectory"])

    adam = against_adam(classical["trajectory"].vehicle, log, size.epochs, size.blocks)
    away = unseen(start, beyond) > 0.5
    everywhere = np.ones(len(unseen(start, inside)), bool)
    numbers: dict[str, Any] = {
        "seed": seed,
        "inside": {name: scored(v, inside, everywhere) for name, v in vehicles.items()},
        "beyond": {name: scored(v, beyond, away) for name, v in vehicles.items()},
        "beyond_starts": int(away.sum()),
        "inside_unseen": float(unseen(start, inside).mean()),
        "mass_error_percent": {
            name: mass_errors(truth, vehicles[name])
            for name in ("wrong mass, trajectory", "single, one_step", "single, trajectory")
        },
        "fits": {
            name: {"steps": fit.steps, "converged": fit.converged, "reduced_chi2": fit.reduced_chi2}
            for name, fit in fits.items()
        },
        "adam": told_of(adam),
    }
    return Case(vehicles, inside, beyond, adam, numbers)


# --- what is written -----------------------------------------------------------------------------

SHOWN = {
    "classical, one_step": "linear + quadratic, one-step",
    "classical, trajectory": "linear + quadratic, trajectory",
    "hybrid, one_step": "with network, one-step",
    "hybrid, trajectory": "with network, trajectory",
    "hybrid, no fading": "the same, not faded out",
    "wrong mass, trajectory": "wrong mass, linear + quadratic",
    "lumped, one_step": "wrong mass, lumped network, one-step",
    "lumped, trajectory": "wrong mass, lumped network, trajectory",
    "single, one_step": "mass and damping network, one-step",
    "single, trajectory": "mass and damping network, trajectory",
    "single, no fading": "the same, not faded out",
}


# Which model is nearer to the truth after 10 s, within the velocities seen or beyond them.
CLAIMS = (
    (
        "ours: a network beside the classical law is better",
        "inside",
        "hybrid, trajectory",
        "classical, trajectory",
    ),
    ("ours: and elsewhere", "beyond", "hybrid, trajectory", "classical, trajectory"),
    ("ours: it is better where it is not faded out", "beyond", "hybrid, no fading", "hybrid, trajectory"),
    (
        "thesis, sec. 4.2: networks of single parameters are better than a lumped one",
        "inside",
        "single, trajectory",
        "lumped, trajectory",
    ),
    ("thesis, sec. 4.2: and elsewhere", "beyond", "single, trajectory", "lumped, trajectory"),
)


def claims(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """`CLAIMS`, decided by pairs of the same log."""
    return decided(
        {
            f"{words} ({'within' if where == 'inside' else 'beyond'})": [
                (run[where][better]["distance_10s"], run[where][than]["distance_10s"]) for run in runs
            ]
            for words, where, better, than in CLAIMS
        }
    )


def tables(runs: Sequence[dict[str, Any]]) -> str:
    """Errors, inertia, and the cost of training."""
    lines = ["| model | within: m after 10 s | u mm/s | v mm/s | r mrad/s | beyond: m after 10 s |"]
    lines.append("|---|---|---|---|---|---|")
    for name, title in SHOWN.items():
        inner = [run["inside"][name] for run in runs]
        cells = [spread([one["distance_10s"] for one in inner], 3)]
        cells += [f"{1e3 * np.median([one[channel] for one in inner]):.1f}" for channel in "uvr"]
        cells.append(spread([run["beyond"][name]["distance_10s"] for run in runs], 3))
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    lines += ["", "| inertia | diagonal off by % | rest off by % |", "|---|---|---|"]
    for name in runs[0]["mass_error_percent"]:
        cells = [
            spread([run["mass_error_percent"][name][part] for run in runs], 2)
            for part in ("diagonal", "off_diagonal")
        ]
        lines.append(f"| {SHOWN[name]} | " + " | ".join(cells) + " |")
    titles = " | ".join(f"to {100 * level:g} %, CPU s" for level in LEVELS)
    lines += ["", f"| one-step loss of the network | {titles} | left at the end % |"]
    lines.append("|---" * (len(LEVELS) + 2) + "|")
    for name, title in SOLVERS.items():
        own, cells = [run["adam"][name] for run in runs], []
        for level in LEVELS:
            times = [one["cpu_s"][f"{level:g}"] for one in own if one["cpu_s"][f"{level:g}"] is not None]
            some = "" if len(times) == len(runs) else f", {len(times)} of {len(runs)}"
            cells.append(spread(times, 1) + some if times else "never")
        cells.append(spread([100 * one["left"] for one in own], 1))
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


STYLE = {
    "true": {"color": "black", "ls": "--"},
    "classical, trajectory": {"color": "#c2620a"},
    "hybrid, trajectory": {"color": "#1f6fb5"},
    "hybrid, no fading": {"color": "#1f6fb5", "ls": ":"},
    "lumped, trajectory": {"color": "#a02c5a"},
    "single, trajectory": {"color": "#2a8c4a"},
}


def force(vehicle: jm.Vehicle, nu: Float[Array, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Damping force on the hull at these velocities, without commands [N, N m]."""
    return np.asarray(_force(vehicle, nu))


@eqx.filter_jit
def _force(vehicle: jm.Vehicle, nu: Float[Array, "points 3"]):
    plant = vehicle.plant()

    def one(nu):
        motion = _moving(nu)
        out = -damping(plant.damping.linear, plant.damping.quadratic, motion.nu_r)
        return (out + sum(effect(motion) for effect in plant.wrenches))[PLACES]

    return jax.vmap(one)(nu)


def draw_forces(truth: jm.Vehicle, first: Case, out: Path) -> None:
    """Surge force over surge speed, sway force over sway at speed, yaw moment over yaw rate at speed."""
    plot, axes = plt.subplots(1, 3, figsize=(11, 3.7), layout="constrained")
    seen = network(first.vehicles["hybrid, trajectory"]).seen
    cases = ((0, 0.9, "u [m/s]", "X [N]"), (1, 0.4, "v [m/s], u = 0.2 m/s", "Y [N]"))
    cases += ((2, 0.6, "r [rad/s], u = 0.2 m/s", "N [N m]"),)
    for ax, (axis, reach, label, what) in zip(axes, cases, strict=True):
        grid = np.linspace(-reach, reach, 241)
        nu = np.zeros((len(grid), 3))
        nu[:, 0] = 0.2
        nu[:, axis] = grid
        points = jnp.asarray(nu)
        inside = np.asarray(jax.vmap(seen)(points)) > 0.5
        if inside.any():
            ax.axvspan(grid[inside].min(), grid[inside].max(), color="0.9", label="seen")
        named = {"true": truth} | {name: first.vehicles[name] for name in list(STYLE)[1:4]}
        for name, vehicle in named.items():
            label_of = SHOWN.get(name, name).replace("the same", "with network")
            ax.plot(grid, force(vehicle, points)[:, axis], lw=1.3, label=label_of, **STYLE[name])
        true = force(truth, points)[:, axis]
        ax.set_ylim(1.3 * true.min(), 1.3 * true.max())
        ax.set(xlabel=label, ylabel=what)
        ax.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    plot.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, fontsize=8)
    save_figure(plot, out / "forces")


def draw_errors(cases: Sequence[Case], out: Path) -> None:
    """Distance to the truth over the horizon, rms over starts, median over seeds."""
    plot, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    ahead = DT * np.arange(round(HORIZON / DT))
    for ax, where in zip(axes, ("within the velocities seen", "beyond them"), strict=True):
        for name in list(STYLE)[1:]:
            rows = []
            for one in cases:
                run = one.inside if where.startswith("within") else one.beyond
                distance = errors(one.vehicles[name], run)[0]
                if run is one.beyond:
                    distance = distance[unseen(one.vehicles["file"], run) > 0.5]
                rows.append(np.sqrt((distance**2).mean(axis=0)))
            label = SHOWN[name].replace("the same", "with network")
            ax.plot(ahead, np.median(rows, axis=0), lw=1.3, label=label, **STYLE[name])
        ax.set(title=where, xlabel="horizon [s]", ylabel="rms distance to the truth [m]")
        ax.set_ylim(bottom=0.0)
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=7)
    save_figure(plot, out / "errors")


def draw_adam(adam: dict[str, Any], out: Path) -> None:
    """Excess of the cost over CPU time."""
    plot, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
    for name, title in SOLVERS.items():
        style: dict[str, Any] = {"color": "black", "marker": "."} if name == "lm" else {}
        ax.plot(adam[name]["cpu_s"], np.maximum(excess(adam, name), 1e-4), lw=1.2, label=title, **style)
    for level in LEVELS:
        ax.axhline(level, color="0.6", ls=":", lw=0.8)
    ax.set(xscale="log", yscale="log", xlabel="CPU time [s]", ylabel="cost left to save [1]")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8)
    save_figure(plot, out / "adam")


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, tables and figures.")],
    seeds: Annotated[int, typer.Option(min=1, help="Logs, each with an operator and noise of its own.")] = 12,
    quick: Annotated[bool, typer.Option("--quick", help="One short log, few steps.")] = False,
) -> None:
    """Measures what networks gain where damping is neither linear nor quadratic."""
    size, seeds = (QUICK, 1) if quick else (Size(), seeds)
    with study(out, quick):
        truth = true_plant()
        cases = []
        with Progress(transient=True) as bar:
            for seed in bar.track(range(seeds), description="logs"):
                cases.append(case(truth, seed, size))
                runs = [one.numbers for one in cases]
                decisions = claims(runs)
                results = {"duration_s": size.duration, "claims": decisions, "runs": runs}
                write_results(out, results, tables(runs) + "\n" + claim_table(decisions))
        jm.save_vehicle(cases[0].vehicles["hybrid, trajectory"], out / "hybrid.toml")
        draw_forces(truth, cases[0], out)
        draw_errors(cases, out)
        draw_adam(cases[0].adam, out)


if __name__ == "__main__":
    typer.run(main)
