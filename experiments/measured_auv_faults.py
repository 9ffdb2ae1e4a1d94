"""Five states of a small AUV told apart by the heave of its measured dives, with a confidence that is earned.

usage: python -m experiments.measured_auv_faults --out DIR [--data DIR] [--quick]

A heave model per unit mass is fitted to the runs of `train_*`, all states together: the hull and the thrust
are common, each state adds one effect (a payload, a weaker thruster, a biased depth sensor). A run's evidence
for a state is its likelihood given its command, with everything integrated out that differs from run to run
(start, trim, drifting force, session) and with the uncertainty of the fit. No state's usual command is in it.
It is set against guessing from the command level, from the start depth, and by chance. Writes results.json,
results.md and the figures heave and confidence.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx
import pandas as pd
import typer
from jaxtyping import Array, Float, Int
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

import jaxmarine as jm
from experiments._study import save_figure, study, wilson, write_results
from jaxmarine._types import Matrix3, Scalar
from jaxmarine.effects import (
    CATALOGUE,
    Craft,
    Readings,
    SensorEffect,
    Suspect,
    place,
)
from jaxmarine.physics import step_lengths
from jaxmarine.simulation import hold, initial_state, inputs
from jaxmarine.vehicle_io import suspect_named

HERE = Path(__file__).parent / "haizhe"
DATA = Path(__file__).parents[2] / "shared" / "data" / "haizhe-auv"
STATES = ("Normal", "AddWeight", "PressureGain_constant", "PropellerDamage_slight", "PropellerDamage_bad")
SHORT = ("normal", "weight", "pressure", "slight", "bad")
DT = 0.05  # [s]
IDLE = 1100.0  # [µs] the command before the start
PER_UNIT = 100.0  # [µs] per unit of command: commands reach 0.8 to 1.05
BLOCK = 4  # samples that are averaged to one observation: nothing in heave is faster than 0.2 s
BLOCKS = 45  # observations from the start on; every run is that long
SAMPLES = 1 + BLOCK * BLOCKS  # the last sample before the start, and those that are used
CLOCK = DT * np.arange(-1, SAMPLES - 1)  # [s] from the start
TIMES = np.append(CLOCK[0], CLOCK[1:].reshape(BLOCKS, BLOCK).mean(axis=1))  # [s] of the observations
VOLTS = 12.0  # [V] at which thrust is that of the file
PAUSE = 600.0  # [s] without a run: what follows is another session, with a fresh battery or another trim
KNOTS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])  # [s] of forces over time
WAVE_TIME = 0.6  # [s] over which errors of the depth that are no motion are alike
GROUND = 0.78  # [m] runs that go down to some 0.82 m stay there: the floor of the tank, which is no heave
UNSEEN = 10.0  # [m] noise of an observation that is not used
CHUNK = 16  # simulations at once: one shape, one compilation
CONFIDENT = 0.9
SHARED_LEVELS = (1198.0, 1202.0)  # [µs] commands that all states but AddWeight have in common
# What is alike to heave under a nearly constant command: normal and damaged propellers.
GROUPS = np.array([0, 1, 2, 0, 0])

# Mean and standard deviation of the priors. Forces are per unit mass, logarithms of SI units.
PRIOR = {
    "log thrust": (np.log(0.4), 0.7),  # N/kg at command 1
    "log linear damping": (np.log(0.5), 0.7),  # 1/s
    "log quadratic damping": (np.log(3.0), 1.0),  # 1/m
    "net buoyancy": (0.2, 0.2),  # N/kg
    "dead zone": (0.3, 0.2),  # command; with thrust as its square it says how steep thrust is
    "log lag": (np.log(0.2), 0.7),  # s
    "voltage exponent": (2.0, 1.0),  # thrust as the square of the speed, and this as the voltage
    "payload": (0.0, 0.05),  # kg/kg, AddWeight
    "gain, slight": (1.0, 0.2),
    "gain, bad": (1.0, 0.2),
    "depth bias": (0.0, 0.2),  # m, PressureGain_constant
    # N/kg, in all runs alike: what holds it at the surface, water set in motion, all that is missing.
    **{f"force at {t:g} s": (0.0, 1.0 if t < 1.0 else 0.2) for t in KNOTS},
}
NAMES = tuple(PRIOR)
MEAN, STD = np.array(list(PRIOR.values())).T
LOG_THRUST, VOLTAGE = NAMES.index("log thrust"), NAMES.index("voltage exponent")
FORCES = slice(len(NAMES) - len(KNOTS), len(NAMES))
# Where the search begins: thrust that about equals the buoyancy, and the order of magnitude of the damping.
START = np.concatenate([[-0.4, 0.0, 2.4, 0.15, 0.33, -1.3], MEAN[6:]])
# Standard deviations of what differs from run to run, and a time constant: where their search begins.
SCATTER = {
    "depth noise": 0.02,  # m, of a sample
    "depth wave": 0.005,  # m, alike over WAVE_TIME
    "start depth": 0.02,  # m
    "start speed": 0.02,  # m/s
    "trim of a run": 0.02,  # N/kg, constant
    "trim of a session": 0.02,  # N/kg, constant
    "drift": 0.05,  # N/kg, alike over the drift time
    "drift time": 3.0,  # s
}
LOG_SCATTER = np.log(list(SCATTER.values()))
LOG_WIDTH = 1.0  # standard deviation of the priors of their logarithms
SESSION = list(SCATTER).index("trim of a session")

# Rows of the table that are looked up again.
MODEL, LEVEL = "model, test", "command level alone, test"
LEFT_OUT = "model, training runs, each session left out"

Theta = Float[np.ndarray, " parameters"]


class DepthBias(SensorEffect):
    """The depth is read too large by `value`. Neutral: 0. Source: offset of a pressure sensor."""

    name = "depth_bias"
    units = {"value": "m"}
    shown_by = "rest at the surface"
    advice = "zero the pressure sensor at the surface"

    value: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(jnp.zeros(()))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return (Suspect(cls, None, {"value": (0,)}),) if "heave" in craft.dof else ()

    def __call__(self, readings: Readings, rotation: Matrix3) -> Readings:
        del rotation
        return dataclasses.replace(readings, position=readings.position.at[2].add(self.value))


# --- runs ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Runs:
    """Runs from their start on, the first sample with a command.

    - `state`: index into `STATES`; `clock` [s] of the day at which a run began.
    - `command` [µs]: of the last sample before the start and of all later ones.
    - `depth` [m]: mean before the start, then means of blocks; `samples`: how many there are in each, 0
      from the block on that is near the ground. What is before it does not know what comes.
    - `volts`: mean of the battery's voltage.
    """

    state: Int[np.ndarray, " runs"]
    clock: Float[np.ndarray, " runs"]
    command: Float[np.ndarray, "runs samples"]
    depth: Float[np.ndarray, "runs observations"]
    samples: Float[np.ndarray, "runs observations"]
    volts: Float[np.ndarray, " runs"]

    def __getitem__(self, rows: Any) -> "Runs":
        return Runs(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    @property
    def level(self) -> Float[np.ndarray, " runs"]:
        """Median of the command [µs]."""
        return np.median(self.command[:, 1:], axis=1)

    def at_one_level(self, level: float) -> "Runs":
        """The same runs as if all had had the same command: what heave says without it."""
        command = np.full_like(self.command, level)
        command[:, 0] = IDLE
        return dataclasses.replace(self, command=command)


def joined(parts: Sequence[Runs]) -> Runs:
    """Several sets of runs as one."""
    return Runs(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Runs)))


def read(data: Path, part: str) -> Runs:
    """The runs of `train` or `test`, cut to the same length from the start on."""
    rows = []
    for state, label in enumerate(STATES):
        table = pd.read_csv(data / f"{part}_{label}.csv.gz")
        for _, run in table.groupby("run", sort=False):
            command, depth = run["pwm1"].to_numpy(float), run["depth"].to_numpy(float)
            start = int((command > IDLE).argmax())
            used = slice(start, start + BLOCK * BLOCKS)
            blocks = depth[used].reshape(BLOCKS, BLOCK).mean(axis=1)
            above = np.logical_and.accumulate(blocks < GROUND)
            hours, rest = divmod(int(run["time"].iloc[0]), 10_000)
            minutes, seconds = divmod(rest, 100)
            rows.append(
                (
                    state,
                    3600.0 * hours + 60.0 * minutes + seconds,
                    np.append(IDLE, command[used]),
                    np.append(depth[:start].mean(), blocks),
                    np.append(start, BLOCK * above).astype(float),
                    run["voltage"].to_numpy(float)[used].mean(),
                )
            )
    return Runs(*(np.array(column) for column in zip(*rows, strict=True)))


def sessions(runs: Runs) -> Int[np.ndarray, " runs"]:
    """Numbers of sessions: runs of one state, without a pause in between.

    The logs have no date: two sessions of different days at the same time of the day are taken for one.
    """
    order = np.lexsort((runs.clock, runs.state))
    other = np.diff(runs.state[order], prepend=-1) != 0
    late = np.diff(runs.clock[order], prepend=0.0) > PAUSE
    out = np.empty(len(order), int)
    out[order] = np.cumsum(other | late) - 1
    return out


# --- model ---------------------------------------------------------------------------------------


def in_state(start: jm.Vehicle, theta: Float[Array, " parameters"], state: Int[Array, ""]) -> jm.Vehicle:
    """The vehicle with parameters `theta` (names in `PRIOR`) in one of the states."""
    p = dict(zip(NAMES, theta, strict=True))
    is_state = {label: jnp.where(state == k, 1.0, 0.0) for k, label in enumerate(STATES)}
    vehicle = eqx.tree_at(
        lambda v: (v.thrusters.max_thrust, v.damping.linear, v.damping.quadratic, v.body.buoyancy),
        start,
        (
            jnp.exp(p["log thrust"])[None],
            start.damping.linear.at[2, 2].set(jnp.exp(p["log linear damping"])),
            start.damping.quadratic.at[2, 2].set(jnp.exp(p["log quadratic damping"])),
            start.body.weight + p["net buoyancy"],
        ),
    )
    lost = is_state["PropellerDamage_slight"] * (1.0 - p["gain, slight"])
    lost += is_state["PropellerDamage_bad"] * (1.0 - p["gain, bad"])
    placed = []
    for name, target, values in (
        ("thrust_curve", None, {"quadratic": 1.0}),
        ("deadband", None, {"width": p["dead zone"]}),
        ("thruster_lag", None, {"time_constant": jnp.exp(p["log lag"])}),
        ("thruster_gain", "lift", {"factor": 1.0 - lost}),
        ("payload", None, {"mass": is_state["AddWeight"] * p["payload"]}),
        ("depth_bias", None, {"value": is_state["PressureGain_constant"] * p["depth bias"]}),
    ):
        suspect = suspect_named(start, name, target, (*CATALOGUE, DepthBias))
        placed.append(jm.Placed(place(suspect, start, values), target))
    return vehicle.place(*placed)


def depths(
    start: jm.Vehicle,
    theta: Float[Array, " parameters"],
    speed: Float[Array, ""],
    force: Float[Array, " knots"],
    state: Int[Array, ""],
    command: Float[Array, " samples"],
) -> Float[Array, " observations"]:
    """Depth as `Runs.depth` [m] of a run that begins at depth 0 with a speed [m/s].

    - `force` [N/kg]: of this run, at `KNOTS`, besides that of all runs.
    """
    plant = in_state(start, theta, state).plant()
    t = jnp.asarray(CLOCK)
    at_knots = jnp.asarray(np.stack([np.interp(CLOCK, KNOTS, row) for row in np.eye(len(KNOTS))], axis=1))
    wrench = jnp.zeros((SAMPLES, 6)).at[:, 2].set(at_knots @ (theta[FORCES] + force))
    over, _ = inputs(plant, t, ((command - IDLE) / PER_UNIT)[:, None], wrench)
    begin = eqx.tree_at(lambda s: s.velocity, initial_state(start), jnp.zeros(6).at[2].set(speed))

    def step(state, now):
        over, dt = now
        return hold(plant, state, over, dt), plant.readings(state, jnp.zeros(6))[2]

    depth = jax.lax.scan(step, begin, (over, step_lengths(t)))[1]
    return jnp.append(depth[0], depth[1:].reshape(BLOCKS, BLOCK).mean(axis=1))


@eqx.filter_jit
def _slopes(start, theta, state, command):
    """Depths of a chunk of runs, and their slopes by parameters and start speed."""

    def one(state, command):
        def of(x):
            return depths(start, x[:-1], x[-1], jnp.zeros(len(KNOTS)), state, command)

        x = jnp.append(theta, 0.0)
        return jax.vmap(lambda dx: jax.jvp(of, (x,), (dx,)), out_axes=(None, 1))(jnp.eye(len(x)))

    return jax.vmap(one)(state, command)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Linear:
    """The model of runs in given states, linear about parameters: measured minus predicted, and slopes."""

    residual: Float[Array, "runs observations"]
    by_theta: Float[Array, "runs observations parameters"]
    by_speed: Float[Array, "runs observations"]
    samples: Float[Array, "runs observations"]

    @property
    def by_force(self) -> Float[Array, "runs observations knots"]:
        """Slopes by a run's own force: that of all runs acts alike."""
        return self.by_theta[:, :, FORCES]


def linear(start: jm.Vehicle, theta: Theta, runs: Runs, state: Int[np.ndarray, " runs"]) -> Linear:
    """Simulates each command and state that there is once."""
    pairs, back = np.unique(np.column_stack([state, runs.command]), axis=0, return_inverse=True)
    padded = np.concatenate([pairs, np.repeat(pairs[-1:], -len(pairs) % CHUNK, axis=0)])
    chunks = [
        _slopes(start, jnp.asarray(theta), jnp.asarray(chunk[:, 0].astype(int)), jnp.asarray(chunk[:, 1:]))
        for chunk in np.split(padded, len(padded) // CHUNK)
    ]
    depth, slope = (np.concatenate([np.asarray(c[k]) for c in chunks])[back] for k in range(2))
    # Thrust goes with a power of the voltage; so small a change of it is linear in the thrust's logarithm.
    slope[:, :, VOLTAGE] = slope[:, :, LOG_THRUST] * np.log(runs.volts / VOLTS)[:, None]
    depth = depth + theta[VOLTAGE] * slope[:, :, VOLTAGE]
    parts = runs.depth - depth, slope[:, :, :-1], slope[:, :, -1], runs.samples
    return Linear(*map(jnp.asarray, parts))


def force_covariance(scatter: dict[str, Any]) -> Float[Array, "knots knots"]:
    """Of a run's own force at the knots [N²/kg²], without the session's."""
    gap = np.abs(KNOTS[:, None] - KNOTS)
    return scatter["trim of a run"] ** 2 + scatter["drift"] ** 2 * jnp.exp(-gap / scatter["drift time"])


def covariance(log_scatter: Float[Array, " scatters"], model: Linear) -> Float[Array, "runs obs obs"]:
    """Of the residuals of single runs [m²], for known parameters and a known force of the session."""
    s = dict(zip(SCATTER, jnp.exp(log_scatter), strict=True))
    own = model.by_force @ force_covariance(s) @ model.by_force.mT
    fast = s["start speed"] ** 2 * model.by_speed[:, :, None] * model.by_speed[:, None, :]
    gap = np.abs(TIMES[:, None] - TIMES)
    wave = s["start depth"] ** 2 + s["depth wave"] ** 2 * jnp.exp(-gap / WAVE_TIME)
    used = model.samples > 0
    variance = jnp.where(used, s["depth noise"] ** 2 / jnp.where(used, model.samples, 1.0), UNSEEN**2)
    noise = variance[:, :, None] * jnp.eye(BLOCKS + 1)[None]
    return own + fast + wave[None] + noise


# --- fit -----------------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="count")
def information(log_scatter, model: Linear, session, count: int):
    """What each session says of a change of the parameters: precision, precision times mean, log p at none.

    Exact for the linear model: starts, forces of the runs and noise are in the covariance, the force of the
    session, one number, is integrated out.
    """
    root = jnp.linalg.cholesky(covariance(log_scatter, model))
    trim = model.by_force.sum(axis=2, keepdims=True)
    columns = jnp.concatenate([model.by_theta, trim, model.residual[:, :, None]], axis=2)
    white = jax.scipy.linalg.solve_triangular(root, columns, lower=True)
    products = jax.ops.segment_sum(white.mT @ white, session, count)
    logs = 2.0 * jnp.log(jnp.diagonal(root, axis1=1, axis2=2)) + jnp.log(2.0 * jnp.pi)
    logs = jax.ops.segment_sum(logs.sum(axis=1), session, count)
    variance = jnp.exp(2.0 * log_scatter[SESSION])
    by_trim = products[:, :, -2]
    spread = 1.0 + variance * by_trim[:, -2]
    left = products - (variance / spread)[:, None, None] * by_trim[:, :, None] * by_trim[:, None, :]
    inner = slice(0, len(NAMES))
    return left[:, inner, inner], left[:, inner, -1], -0.5 * (left[:, -1, -1] + logs + jnp.log(spread))


@functools.partial(jax.jit, static_argnames=("count", "steps"))
def likeliest_scatter(log_scatter, theta, model: Linear, session, count: int, steps: int):
    """The scatters of largest evidence, the parameters integrated out."""

    def loss(log_scatter, _):
        precision, weighted, log_p = information(log_scatter, model, session, count)
        root = jnp.linalg.cholesky(precision.sum(axis=0) + jnp.diag(STD**-2.0))
        ahead = weighted.sum(axis=0) + (MEAN - theta) / STD**2
        move = jax.scipy.linalg.solve_triangular(root, ahead, lower=True)
        prior = 0.5 * (((log_scatter - LOG_SCATTER) / LOG_WIDTH) ** 2).sum()
        return prior - log_p.sum() - 0.5 * move @ move + jnp.log(jnp.diagonal(root)).sum()

    solver = optx.BFGS(rtol=1e-6, atol=1e-3)
    return optx.minimise(loss, solver, log_scatter, max_steps=steps, throw=False).value


@dataclasses.dataclass(frozen=True)
class Fitted:
    """The fit: parameters, logarithms of the scatters, and what each session said of the parameters."""

    start: jm.Vehicle
    theta: Theta
    log_scatter: Float[np.ndarray, " scatters"]
    precision: Float[np.ndarray, "sessions parameters parameters"]
    weighted: Float[np.ndarray, "sessions parameters"]

    def posterior(self, without: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the change of `theta`, and covariance, from all sessions or all but one."""
        kept = np.arange(len(self.precision)) != (-1 if without is None else without)
        cov = np.linalg.inv(self.precision[kept].sum(axis=0) + np.diag(STD**-2.0))
        return cov @ (self.weighted[kept].sum(axis=0) + (MEAN - self.theta) / STD**2), cov


def fitted(
    start: jm.Vehicle, runs: Runs, session: Int[np.ndarray, " runs"], rounds: int, steps: int
) -> Fitted:
    """The likeliest parameters and scatters, in turns.

    `jm.fit` is not used for it: to it errors are independent from sample to sample and each window has a
    start of its own, while here nearly all of the error is a force that stays for seconds, for a run or for a
    session. Taken as noise it would make every answer far too sure. Effects, plant and integration are the
    package's.
    """
    count = int(session.max()) + 1
    theta, scatter = START.copy(), jnp.asarray(LOG_SCATTER)
    model = linear(start, theta, runs, runs.state)

    def cost(theta, model):
        log_p = information(scatter, model, session, count)[2]
        return -float(log_p.sum()) + 0.5 * (((MEAN - theta) / STD) ** 2).sum()

    for k in range(rounds):
        if k:  # the first step only comes near
            scatter = likeliest_scatter(scatter, theta, model, session, count, steps)
        precision, weighted, _ = information(scatter, model, session, count)
        now = Fitted(start, theta, np.asarray(scatter), np.asarray(precision), np.asarray(weighted))
        move, cov = now.posterior()
        promise = float(move @ np.linalg.solve(cov, move))
        if k > 2 and promise < 0.05:  # a fifth of a standard deviation
            return now
        before, share = cost(theta, model), 1.0
        while True:
            after = linear(start, theta + share * move, runs, runs.state)
            # The slopes that make the covariance stay: the step is the minimum for these.
            held = dataclasses.replace(model, residual=after.residual)
            if cost(theta + share * move, held) < before + 0.05 or share < 0.05:
                break
            share /= 2.0
        theta, model = theta + share * move, after
    precision, weighted, _ = information(scatter, model, session, count)
    return Fitted(start, theta, np.asarray(scatter), np.asarray(precision), np.asarray(weighted))


# --- evidence ------------------------------------------------------------------------------------


@jax.jit
def _log_evidence(log_scatter, model: Linear, mean, cov):
    trim = model.by_force.sum(axis=2)
    total = covariance(log_scatter, model) + model.by_theta @ cov @ model.by_theta.mT
    total += jnp.exp(2.0 * log_scatter[SESSION]) * trim[:, :, None] * trim[:, None, :]
    root = jnp.linalg.cholesky(total)
    off = model.residual[:, :, None] - model.by_theta @ mean[:, :, None]
    white = jax.scipy.linalg.solve_triangular(root, off, lower=True)[:, :, 0]
    return -0.5 * (white**2).sum(axis=1) - jnp.log(jnp.diagonal(root, axis1=1, axis2=2)).sum(axis=1)


def log_evidence(
    fit: Fitted, runs: Runs, without: Int[np.ndarray, " runs"] | None = None
) -> Float[np.ndarray, "runs states"]:
    """Log-likelihood of each run in each state given its command, up to a constant of the run.

    The run's session is taken as one that was not seen. `without`: the session that a run is scored without.
    """
    if without is None:
        of_run = [fit.posterior()] * len(runs.state)
    else:
        each = {number: fit.posterior(int(number)) for number in np.unique(without)}
        of_run = [each[number] for number in without]
    # All states at once, which simulates whole chunks.
    each_run = np.tile(np.arange(len(runs.state)), len(STATES))
    states = np.repeat(np.arange(len(STATES)), len(runs.state))
    model = linear(fit.start, fit.theta, runs[each_run], states)
    mean, cov = (jnp.asarray(np.stack(part)[each_run]) for part in zip(*of_run, strict=True))
    return np.asarray(_log_evidence(fit.log_scatter, model, mean, cov)).reshape(len(STATES), -1).T


def probabilities(
    log_p: Float[np.ndarray, "runs states"], trust: float = 1.0
) -> Float[np.ndarray, "runs states"]:
    """Posterior probabilities; all states are as likely beforehand. `trust`: power of the evidence."""
    return np.exp(log_softmax(trust * log_p, axis=1))


def trust_in(log_p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"]) -> float:
    """The power of the evidence of least log loss, at most 1: what the model is off by makes it too sure.

    Source: temperature scaling; Guo, Pleiss, Sun and Weinberger (2017), On calibration of modern neural
    networks.
    """

    def loss(trust: float) -> float:
        return -float(log_softmax(trust * log_p, axis=1)[np.arange(len(state)), state].mean())

    found: Any = minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded")
    return float(found.x)


@eqx.filter_jit
def _simulated(start, theta, speed, force, state, command):
    return jax.vmap(functools.partial(depths, start))(theta, speed, force, state, command)


def simulated(fit: Fitted, runs: Runs, rng: np.random.Generator) -> Runs:
    """Runs with the states and commands of these, and all else drawn from what was fitted.

    By the simulation itself, which is not linear. Each run has parameters and a session of its own.
    """
    count = len(runs.state)
    s = dict(zip(SCATTER, np.exp(fit.log_scatter), strict=True))
    mean, cov = fit.posterior()
    theta = rng.multivariate_normal(fit.theta + mean, cov, count)
    exponent = theta[:, VOLTAGE] * np.log(runs.volts / VOLTS)
    theta[:, LOG_THRUST] += exponent
    own = rng.multivariate_normal(np.zeros(len(KNOTS)), np.asarray(force_covariance(s)), count)
    own += s["trim of a session"] * rng.standard_normal((count, 1))
    speed = s["start speed"] * rng.standard_normal(count)
    clean = _simulated(fit.start, *map(jnp.asarray, (theta, speed, own, runs.state, runs.command)))
    wave = s["depth wave"] ** 2 * np.exp(-np.abs(TIMES[:, None] - TIMES) / WAVE_TIME)
    off = rng.multivariate_normal(np.zeros(BLOCKS + 1), wave, count)
    off += s["start depth"] * rng.standard_normal((count, 1))
    off += s["depth noise"] * rng.standard_normal(off.shape) / np.sqrt(np.maximum(runs.samples, 1.0))
    return dataclasses.replace(runs, depth=np.asarray(clean) + off)


# --- baselines -----------------------------------------------------------------------------------


def by_level(train: Runs, runs: Runs) -> Float[np.ndarray, "runs states"]:
    """Log density of the command level in each state's training runs.

    Kernels of 1 µs, the step of the commands, and a hundredth spread evenly for levels that were not seen.
    """
    off = runs.level[:, None] - train.level
    kernel = np.exp(-0.5 * off**2) / np.sqrt(2.0 * np.pi)
    density = np.stack([kernel[:, train.state == k].mean(axis=1) for k in range(len(STATES))], axis=1)
    return np.log(0.99 * density + 0.01 / np.ptp(train.level))


def by_start(train: Runs, runs: Runs) -> Float[np.ndarray, "runs states"]:
    """Log density of the depth before the start: normal, with a mean per state and one spread."""
    first = train.depth[:, 0]
    mean = np.array([first[train.state == k].mean() for k in range(len(STATES))])
    return -0.5 * ((runs.depth[:, :1] - mean) / (first - mean[train.state]).std()) ** 2


# --- how good it is ------------------------------------------------------------------------------


def confusion(p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"]) -> list[list[int]]:
    """Runs by true state (rows) and likeliest state (columns)."""
    out = np.zeros(2 * p.shape[1:], int)
    np.add.at(out, (state, p.argmax(axis=1)), 1)
    return out.tolist()


def judged(p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"], session) -> dict[str, Any]:
    """Accuracy, log loss [nats], Brier score (0 to 2) and calibration, with 95 % intervals.

    Whole sessions are drawn again for the intervals: runs of one session are alike. `surprise`: log loss
    minus what the answers themselves expect, 0 where they are as sure as they may be.
    """
    told = np.log(np.maximum(p[np.arange(len(p)), state], 1e-12))
    per_run = {
        "accuracy": (p.argmax(axis=1) == state).astype(float),
        "log_loss": -told,
        "brier": ((p - np.eye(p.shape[1])[state]) ** 2).sum(axis=1),
        "surprise": -told + (p * np.log(np.maximum(p, 1e-12))).sum(axis=1),
    }
    _, member = np.unique(session, return_inverse=True)
    sizes = np.bincount(member)
    times = np.random.default_rng(0).multinomial(len(sizes), np.full(len(sizes), 1.0 / len(sizes)), 2000)
    out: dict[str, Any] = {"runs": len(p)}
    for name, values in per_run.items():
        means = (times @ np.bincount(member, values)) / (times @ sizes)
        out[name] = [float(values.mean()), *np.quantile(means, [0.025, 0.975]).tolist()]
    sure = p.max(axis=1) > CONFIDENT
    right = int(per_run["accuracy"][sure].sum())
    bounds = wilson(right, int(sure.sum()))
    out |= {"inconclusive": float(1.0 - sure.mean()), "confident": int(sure.sum()), "confident_right": right}
    return out | {"confident_right_share_95": bounds, "confusion": confusion(p, state)}


def merged(p: Float[np.ndarray, "runs states"]) -> Float[np.ndarray, "runs groups"]:
    """Probabilities of the groups, between which heave may tell."""
    return np.stack([p[:, g == GROUPS].sum(axis=1) for g in range(GROUPS.max() + 1)], axis=1)


def reliability(
    p: Float[np.ndarray, "runs states"], state: Int[np.ndarray, " runs"]
) -> list[dict[str, float]]:
    """Share of true among the states that were given a probability in a range, with Wilson's 95 %."""
    told, true = p.ravel(), (np.arange(p.shape[1]) == state[:, None]).ravel()
    edges = np.array([0.0, 0.02, 0.1, 0.25, 0.4, 0.6, 0.8, 0.95, 1.0])
    out = []
    for low, high in itertools.pairwise(edges):
        inside = (told >= low) & ((told < high) | (high == 1.0))
        if inside.any():
            hits, count = int(true[inside].sum()), int(inside.sum())
            low_true, high_true = wilson(hits, count)
            out.append({"told": float(told[inside].mean()), "true": hits / count, "count": count})
            out[-1] |= {"low": low_true, "high": high_true}
    return out


# --- what is written -----------------------------------------------------------------------------


def markdown(results: dict[str, Any]) -> str:
    """The tables of scores, the confusion matrices, parameters and scatters."""
    lines = [
        "| answer | runs | accuracy | log loss | Brier | surprise | inconclusive | confident, right |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in results["scores"].items():
        cells = [
            "{:.2f} ({:.2f} to {:.2f})".format(*row[k]) for k in ("accuracy", "log_loss", "brier", "surprise")
        ]
        sure = f"{row['confident_right']} of {row['confident']}" if row["confident"] else "none"
        lines.append(
            f"| {name} | {row['runs']} | " + " | ".join(cells) + f" | {row['inconclusive']:.2f} | {sure} |"
        )
    for name in (MODEL, LEFT_OUT, LEVEL):
        lines += ["", f"| {name}: true \\ likeliest | " + " | ".join(SHORT) + " |", "|---" * 6 + "|"]
        rows = zip(SHORT, results["scores"][name]["confusion"], strict=True)
        lines += [f"| {label} | " + " | ".join(map(str, row)) + " |" for label, row in rows]
    lines += ["", f"Power of the evidence, from training runs left out: {results['trust']:.2f}"]
    lines += ["", "| parameter | value | standard deviation |", "|---|---|---|"]
    lines += [f"| {name} | {value:.3f} | {std:.3f} |" for name, (value, std) in results["parameters"].items()]
    lines += ["", "| scatter | value |", "|---|---|"]
    lines += [f"| {name} | {value:.4f} |" for name, value in results["scatter"].items()]
    return "\n".join(lines) + "\n"


def heave_figure(fit: Fitted, runs: Runs, path: Path) -> None:
    """Measured depths per state, and what the model expects in that state and in the normal one."""
    plot, axes = plt.subplots(1, 5, figsize=(14, 3.4), sharex=True, sharey=True, layout="constrained")
    for k, ax in enumerate(axes):
        these = runs[runs.state == k]
        ax.plot(TIMES, these.depth.T, color="0.75", lw=0.5)
        for state, color, label in ((0, "#c2620a", "as if normal"), (k, "#1f6fb5", "in its state")):
            model = linear(fit.start, fit.theta, these, np.full(len(these.state), state))
            mean = (these.depth - np.asarray(model.residual)).mean(axis=0)
            ax.plot(TIMES, mean, color=color, lw=1.8, label=label)
        ax.set(title=STATES[k].replace("_", "\n"), xlabel="t [s]")
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].set(ylabel="depth [m]", ylim=(1.0, -0.1))
    axes[1].legend(frameon=False, fontsize=8)
    save_figure(plot, path)


def confidence_figure(told: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Mean probability that each true state was given (first of `told`), and the reliability of all."""
    plot, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    p, state = next(iter(told.values()))
    mean = np.stack([p[state == k].mean(axis=0) for k in range(len(STATES))])
    axes[0].imshow(mean, cmap="Blues", vmin=0, vmax=1)
    for i, row in enumerate(mean):
        for j, value in enumerate(row):
            axes[0].text(
                j, i, f"{value:.2f}", ha="center", va="center", color="white" if value > 0.6 else "0.2"
            )
    axes[0].set_xticks(range(5), SHORT)
    axes[0].set_yticks(range(5), SHORT)
    axes[0].set(xlabel="state", ylabel="true state", title=f"mean probability: {next(iter(told))}")
    axes[1].plot([0, 1], [0, 1], color="0.7", lw=1)
    for k, (name, (p, state)) in enumerate(told.items()):
        rows = reliability(p, state)
        x, y, low, high = (np.array([row[key] for row in rows]) for key in ("told", "true", "low", "high"))
        bars = np.abs(np.stack([y - low, high - y]))
        shift = 0.006 * (k - 1)
        color = ("#1f6fb5", "#2a9d5c", "#c2620a")[k]
        axes[1].errorbar(x + shift, y, bars, fmt="o-", ms=4, lw=1, color=color, label=name)
    axes[1].set(
        xlabel="probability told", ylabel="share true", title="reliability, all states", aspect="equal"
    )
    axes[1].legend(frameon=False, fontsize=8)
    axes[1].spines[["top", "right"]].set_visible(False)
    save_figure(plot, path)


def studied(data: Path, out: Path, quick: bool) -> dict[str, Any]:
    """Fits, scores, and writes what was found."""
    train, test = read(data, "train"), read(data, "test")
    if quick:
        train, test = train[::10], test[::5]
    # Sessions of the training runs get the first numbers; a test run may lie in one that no training run has.
    together = sessions(joined([train, test]))
    known, of_train = np.unique(together[: len(train.state)], return_inverse=True)
    of_test = together[len(train.state) :]
    seen = np.where(np.isin(of_test, known), np.searchsorted(known, of_test), -1)
    rounds, steps = (4, 6) if quick else (14, 60)
    start = jm.load_vehicle(HERE / "haizhe.toml")
    fit = fitted(start, train, of_train, rounds, steps)

    raw_test, raw_train = log_evidence(fit, test), log_evidence(fit, train, of_train)
    trust = trust_in(raw_train, train.state)
    p_test, p_train = probabilities(raw_test, trust), probabilities(raw_train, trust)
    level = by_level(train, test)
    shared = (test.level >= SHARED_LEVELS[0]) & (test.level <= SHARED_LEVELS[1])
    told = {
        "test": (p_test, test.state),
        "training runs, each session left out": (p_train, train.state),
        "test, command level alone": (probabilities(level), test.state),
    }
    answers = {
        MODEL: (p_test, test.state, of_test),
        "model, test, its session left out": (
            probabilities(log_evidence(fit, test, seen), trust),
            test.state,
            of_test,
        ),
        LEFT_OUT: (p_train, train.state, of_train),
        "model, test, evidence taken in full": (probabilities(raw_test), test.state, of_test),
        "chance": (np.full_like(p_test, 0.2), test.state, of_test),
        "start depth alone, test": (probabilities(by_start(train, test)), test.state, of_test),
        LEVEL: (probabilities(level), test.state, of_test),
        "model and command level, test": (probabilities(np.log(p_test) + level), test.state, of_test),
        "model, test at shared levels": (p_test[shared], test.state[shared], of_test[shared]),
        "command level alone, test at shared levels": (
            probabilities(level[shared]),
            test.state[shared],
            of_test[shared],
        ),
        "model, test, three groups": (merged(p_test), GROUPS[test.state], of_test),
        "command level alone, test, three groups": (
            merged(probabilities(level)),
            GROUPS[test.state],
            of_test,
        ),
        "model, training runs left out, three groups": (merged(p_train), GROUPS[train.state], of_train),
    }

    # Given that the propellers are all that is in question, is anything known of them?
    alike = GROUPS[test.state] == 0
    among = p_test[alike][:, np.flatnonzero(GROUPS == 0)]
    answers["model, test, normal and damaged among themselves"] = (
        among / among.sum(axis=1, keepdims=True),
        np.searchsorted(np.flatnonzero(GROUPS == 0), test.state[alike]),
        of_test[alike],
    )

    if not quick:
        # Does the level of the command leak? Simulated, with levels dealt out to the states at random; and as
        # measured, with every run fitted and scored as if it had had the same command.
        rng = np.random.default_rng(0)
        dealt = dataclasses.replace(train, command=rng.permutation(train.command))
        for name, runs in (
            ("", simulated(fit, train, rng)),
            (", levels dealt out", simulated(fit, dealt, rng)),
        ):
            singles = np.arange(len(runs.state))
            answers["model, simulated" + name] = (probabilities(log_evidence(fit, runs)), runs.state, singles)
            answers["command level alone, simulated" + name] = (
                probabilities(by_level(train, runs)),
                runs.state,
                singles,
            )
        one = float(np.median(train.level))
        blind = fitted(start, train.at_one_level(one), of_train, rounds, steps)
        answers["model without the command, test"] = (
            probabilities(log_evidence(blind, test.at_one_level(one)), trust),
            test.state,
            of_test,
        )

    move, cov = fit.posterior()
    results = {
        "scores": {name: judged(*answer) for name, answer in answers.items()},
        "reliability": {name: reliability(*answer) for name, answer in told.items()},
        "parameters": dict(
            zip(NAMES, np.column_stack([fit.theta + move, np.diag(cov) ** 0.5]).tolist(), strict=True)
        ),
        "scatter": dict(zip(SCATTER, np.exp(fit.log_scatter).tolist(), strict=True)),
        "trust": trust,
        "sessions": {label: len(np.unique(of_train[train.state == k])) for k, label in enumerate(STATES)},
        "test_probabilities": p_test.tolist(),
        "test_states": test.state.tolist(),
    }
    write_results(out, results, markdown(results))
    heave_figure(fit, train, out / "heave.png")
    confidence_figure(told, out / "confidence.png")
    return results


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, tables and figures.")],
    data: Annotated[Path, typer.Option(help="Folder with the measured runs.")] = DATA,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A tenth of the training runs, a fifth of the others, no controls."),
    ] = False,
) -> None:
    """Tells the states of measured dives apart, and measures with what right."""
    if not data.is_dir():
        print(f"Skipped: the measured runs are not at {data}; say with --data where they are.")
        return
    with study(out, quick):
        results = studied(data, out, quick)
    print(markdown(results))


if __name__ == "__main__":
    typer.run(main)
