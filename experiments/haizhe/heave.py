"""A heave model per unit mass, fitted to the runs of all states together, and the evidence for a state.

Hull and thrust are common, each state adds one effect. All that differs from run to run (start, trim,
drifting force, session) is integrated out.
"""

import dataclasses
import functools
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

import jaxmarine as jm
from experiments.haizhe.runs import BLOCK, BLOCKS, CLOCK, IDLE, SAMPLES, STATES, TIMES, Runs
from jaxmarine._types import Matrix3, Scalar
from jaxmarine.effects import CATALOGUE, Craft, Readings, SensorEffect, Suspect, place
from jaxmarine.physics import step_lengths
from jaxmarine.simulation import hold, initial_state, inputs
from jaxmarine.vehicle_io import suspect_named

PER_UNIT = 100.0  # [µs] per unit of command: commands reach 0.8 to 1.05
VOLTS = 12.0  # [V] at which thrust is that of the file
KNOTS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])  # [s] of forces over time
WAVE_TIME = 0.6  # [s] over which errors of the depth that are no motion are alike
UNSEEN = 10.0  # [m] noise of an observation that is not used
CHUNK = 16  # simulations at once: one shape, one compilation

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

    Source: temperature scaling; after Guo, Pleiss, Sun and Weinberger (2017), On calibration of modern neural
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
