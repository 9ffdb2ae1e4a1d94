"""Five states of a small AUV told apart by the heave of its measured dives, with calibrated confidence.

usage: python -m experiments.measured_auv_faults --data DIR --out DIR [--quick]
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx
import pandas as pd
from jaxtyping import Array, Float, Int

import jaxmarine as jm
from experiments._study import save_figure, study, write_results
from jaxmarine._types import Scalar
from jaxmarine.effects import (
    CATALOGUE,
    Craft,
    Deadband,
    Payload,
    Readings,
    SensorEffect,
    Suspect,
    ThrusterGain,
    ThrusterLag,
    ThrustCurve,
    place,
)
from jaxmarine.physics import step_lengths
from jaxmarine.simulation import hold, initial_state, inputs
from jaxmarine.vehicle_io import suspect_named

HERE = Path(__file__).parent / "haizhe"
STATES = ("Normal", "AddWeight", "PressureGain_constant", "PropellerDamage_slight", "PropellerDamage_bad")
DT = 0.05  # [s]
IDLE = 1100  # [µs] the command before the start
BLOCK = 4  # samples that are averaged to one observation
BLOCKS = 45  # observations after the start
SAMPLES = 1 + BLOCK * BLOCKS  # the last sample before the start, and those that are used
TIMES = DT * np.concatenate([[-0.5], BLOCK * np.arange(BLOCKS) + (BLOCK - 1) / 2])  # [s] of the observations
VOLTS = 12.0  # [V] at which the thrust is that of the file
PAUSE = 600.0  # [s] without a run: a new session (battery, ballast, tank at rest)
KNOTS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0])  # [s] of the unmodelled force


class DepthBias(SensorEffect):
    """The depth is read too large by a constant. Neutral: 0. Source: sensor offset, the file's README."""

    name = "depth_bias"
    units = {"value": "m"}
    confused_with = ()

    value: Scalar

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        del craft
        return cls(jnp.zeros(()))

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        return (Suspect(cls, None, {"value": (0,)}),) if "heave" in craft.dof else ()

    def __call__(self, readings: Readings, rotation) -> Readings:
        del rotation
        return dataclasses.replace(readings, position=readings.position.at[2].add(self.value))


# name: (mean, standard deviation) of the prior
PRIOR = {
    "log thrust": (np.log(0.4), 0.7),
    "log linear damping": (np.log(0.5), 0.7),
    "log quadratic damping": (np.log(3.0), 1.0),
    "net buoyancy": (0.2, 0.2),
    "dead zone": (0.3, 0.2),
    "log lag": (np.log(0.2), 0.7),
    "voltage exponent": (2.0, 1.0),
    "payload": (0.0, 0.05),
    "gain, slight": (1.0, 0.2),
    "gain, bad": (1.0, 0.2),
    "depth bias": (0.0, 0.2),
} | {f"force at {t:g} s": (0.0, 1.0 if t < 1 else 0.2) for t in KNOTS}
NAMES = tuple(PRIOR)
MEAN, STD = np.array(list(PRIOR.values())).T
LOG_THRUST, VOLTAGE = NAMES.index("log thrust"), NAMES.index("voltage exponent")
FORCES = slice(len(NAMES) - len(KNOTS), len(NAMES))
HYPER = {
    "white": 0.02, "start depth": 0.02, "start speed": 0.02, "trim": 0.02, "session": 0.02, "drift": 0.02,
    "drift time": 3.0, "wave": 0.005,
}


@dataclasses.dataclass(frozen=True)
class Runs:
    """Runs of known states: commands [µs] from the last sample before the start on, depth in blocks [m]."""

    name: tuple[str, ...]
    state: Int[np.ndarray, " runs"]
    session: Int[np.ndarray, " runs"]
    command: Float[np.ndarray, "runs samples"]
    depth: Float[np.ndarray, "runs blocks"]
    before: Float[np.ndarray, " runs"]
    volts: Float[np.ndarray, " runs"]

    def __len__(self):
        return len(self.name)

    @property
    def level(self):
        return np.median(self.command[:, 1:], axis=1)

    def __getitem__(self, rows):
        return Runs(tuple(np.array(self.name)[rows]), *(getattr(self, f.name)[rows] for f in dataclasses.fields(self)[1:]))


def read(data: Path, part: str) -> Runs:
    rows = []
    for state, label in enumerate(STATES):
        table = pd.read_csv(data / f"{part}_{label}.csv.gz")
        cut = []
        for name, run in table.groupby("run", sort=False):
            command = run.pwm1.to_numpy(float)
            start = int((command > IDLE).argmax())
            depth = run.depth.to_numpy(float)
            used = slice(start, start + BLOCK * BLOCKS)
            blocks = depth[used].reshape(BLOCKS, BLOCK).mean(axis=1)
            clock = int(run.time.iloc[0])
            seconds = 3600 * (clock // 10000) + 60 * (clock // 100 % 100) + clock % 100
            cut.append((seconds, name, np.append(IDLE, command[used]), np.append(depth[:start].mean(), blocks), start, run.voltage.to_numpy()[used].mean()))
        cut.sort(key=lambda r: r[0])
        rows += [(state, *r) for r in cut]
    state, seconds, name, command, depth, before, volts = zip(*rows, strict=True)
    return Runs(tuple(name), np.array(state), np.array(seconds), np.array(command), np.array(depth), np.array(before, float), np.array(volts))


def sessions(state, seconds):
    """Numbers of sessions: runs of a state with no longer pause among them."""
    order = np.lexsort((seconds, state))
    new = (np.diff(state[order], prepend=-1) != 0) | (np.diff(seconds[order], prepend=0) > PAUSE)
    out = np.empty(len(order), int)
    out[order] = np.cumsum(new) - 1
    return out


def weights():
    """[samples, knots] linear interpolation"""
    t = DT * (np.arange(SAMPLES) - 1)
    return np.stack([np.interp(t, KNOTS, row) for row in np.eye(len(KNOTS))], axis=1)


def vehicle_of(start: jm.Vehicle, theta, state) -> jm.Vehicle:
    p = dict(zip(NAMES, theta, strict=True))
    is_ = {label: (state == k) * 1.0 for k, label in enumerate(STATES)}
    v = eqx.tree_at(
        lambda v: (v.thrusters.max_thrust, v.damping.linear, v.damping.quadratic, v.body.buoyancy),
        start,
        (
            jnp.exp(p["log thrust"])[None],
            start.damping.linear.at[2, 2].set(jnp.exp(p["log linear damping"])),
            start.damping.quadratic.at[2, 2].set(jnp.exp(p["log quadratic damping"])),
            start.body.weight + p["net buoyancy"],
        ),
    )
    gain = 1.0 + is_["PropellerDamage_slight"] * (p["gain, slight"] - 1) + is_["PropellerDamage_bad"] * (p["gain, bad"] - 1)
    placed = []
    for effect, target, values in (
        (ThrustCurve, None, {"quadratic": 1.0}),
        (Deadband, None, {"width": p["dead zone"]}),
        (ThrusterLag, None, {"time_constant": jnp.exp(p["log lag"])}),
        (ThrusterGain, "lift", {"factor": gain}),
        (Payload, None, {"mass": is_["AddWeight"] * p["payload"]}),
        (DepthBias, None, {"value": is_["PressureGain_constant"] * p["depth bias"]}),
    ):
        s = suspect_named(start, effect.name, target, (*CATALOGUE, DepthBias))
        placed.append(jm.Placed(place(s, start, values), target))
    return v.place(*placed)


def heave(start, theta, w0, force, state, command):
    """Depth blocks"""
    plant = vehicle_of(start, theta, state).plant()
    t = jnp.asarray(DT * (np.arange(SAMPLES) - 1))
    wrench = jnp.zeros((SAMPLES, 6)).at[:, 2].set(jnp.asarray(weights()) @ (theta[FORCES] + force))
    over, _ = inputs(plant, t, ((command - IDLE) / 100.0)[:, None], wrench)
    begin = eqx.tree_at(lambda s: s.velocity, initial_state(start), jnp.zeros(6).at[2].set(w0))

    def step(s, now):
        over, dt = now
        return hold(plant, s, over, dt), plant.readings(s, jnp.zeros(6))[2]

    depth = jax.lax.scan(step, begin, (over, step_lengths(t)))[1]
    return jnp.concatenate([depth[:1], depth[1:].reshape(BLOCKS, BLOCK).mean(axis=1)])


@eqx.filter_jit
def _slopes(start, theta, state, command):
    def of(x):
        return heave(start, x[: len(NAMES)], x[len(NAMES)], jnp.zeros(len(KNOTS)), state, command)

    x = jnp.append(theta, 0.0)
    def one(dx):
        return jax.jvp(of, (x,), (dx,))
    y, j = jax.vmap(one, out_axes=(None, 1))(jnp.eye(len(x)))
    return y, j


CHUNK = 32

@eqx.filter_jit
def _chunk(start, theta, state, command):
    return jax.vmap(lambda s, c: _slopes(start, theta, s, c))(state, command)


def linearised(start, theta, state, command):
    """unique pairs, in chunks"""
    pairs, back = np.unique(np.column_stack([state, command]), axis=0, return_inverse=True)
    short = -len(pairs) % CHUNK
    padded = np.concatenate([pairs, np.repeat(pairs[-1:], short, axis=0)])
    out = [_chunk(start, jnp.asarray(theta), jnp.asarray(p[:, 0].astype(int)), jnp.asarray(p[:, 1:])) for p in np.split(padded, len(padded) // CHUNK)]
    y, j = (np.concatenate([np.asarray(o[k]) for o in out])[back] for k in range(2))
    return y, j


# ---- likelihood
@dataclasses.dataclass(frozen=True)
class Linear:
    """rows: residual y - mean at theta; slopes"""
    residual: Any  # [runs, obs]
    by_theta: Any  # [runs, obs, P]
    by_speed: Any  # [runs, obs]
    by_force: Any  # [runs, obs, knots]
    before: Any


def linear(start, theta, state, command, runs: Runs) -> Linear:
    y, j = linearised(start, theta, state, command)
    p = len(NAMES)
    volts = np.log(runs.volts / VOLTS)
    j[:, :, VOLTAGE] = j[:, :, LOG_THRUST] * volts[:, None]
    y = y + theta[VOLTAGE] * j[:, :, VOLTAGE]
    return Linear(runs.depth - y, j[:, :, :p], j[:, :, p], j[:, :, FORCES], runs.before)


def covariance(hyper, lin: Linear):
    """[runs, obs, obs] of what differs from run to run"""
    h = dict(zip(HYPER, jnp.exp(hyper), strict=True))
    gap = jnp.abs(KNOTS[:, None] - KNOTS)
    force = h["trim"] ** 2 + h["drift"] ** 2 * jnp.exp(-gap / h["drift time"])
    after = np.arange(BLOCKS + 1) > 0
    white = h["white"] ** 2 * jnp.where(jnp.asarray(after), 1 / BLOCK, 1 / jnp.asarray(lin.before)[:, None])
    wave = h["wave"] ** 2 * jnp.exp(-np.abs(TIMES[:, None] - TIMES) / 0.6)
    return (
        jnp.einsum("rok,kl,rpl->rop", lin.by_force, force, lin.by_force)
        + h["start speed"] ** 2 * lin.by_speed[:, :, None] * lin.by_speed[:, None, :]
        + h["start depth"] ** 2 + wave
        + white[:, :, None] * jnp.eye(BLOCKS + 1)
    )


@functools.partial(jax.jit, static_argnums=3)
def information(hyper, lin: Linear, session, count: int):
    """Per session: (H, h, log p at delta=0) over theta with session's force eliminated"""
    k = covariance(hyper, lin)
    chol = jnp.linalg.cholesky(k)
    common = lin.by_force.sum(axis=2)
    a = jnp.concatenate([lin.by_theta, common[:, :, None], lin.residual[:, :, None]], axis=2)
    a = jax.vmap(lambda c, b: jax.scipy.linalg.solve_triangular(c, b, lower=True))(chol, a)
    g = jnp.einsum("roi,roj->rij", a, a)
    logdet = 2 * jnp.log(jnp.diagonal(chol, axis1=1, axis2=2)).sum(axis=1)
    g = jax.ops.segment_sum(g, session, count)
    logdet = jax.ops.segment_sum(logdet, session, count)
    n = jax.ops.segment_sum(jnp.ones(len(session)), session, count) * (BLOCKS + 1)
    var = jnp.exp(2 * hyper[list(HYPER).index("session")])
    f = g[:, :, -2]
    scale = 1 + var * f[:, -2]
    g = g - var * f[:, :, None] * f[:, None, :] / scale[:, None, None]
    p = len(NAMES)
    return g[:, :p, :p], g[:, :p, -1], -0.5 * (g[:, -1, -1] + logdet + jnp.log(scale) + n * jnp.log(2 * jnp.pi))


HYPER_PRIOR = 1.0


def evidence(hyper, args):
    theta, lin, session, count = args
    big, small, logp = information(hyper, lin, session, count)
    ahead = (MEAN - theta) / STD**2
    prec = big.sum(0) + jnp.diag(STD**-2.0)
    b = small.sum(0) + ahead
    chol = jnp.linalg.cholesky(prec)
    x = jax.scipy.linalg.solve_triangular(chol, b, lower=True)
    out = logp.sum() + 0.5 * x @ x - jnp.log(jnp.diagonal(chol)).sum() - jnp.log(STD).sum() - 0.5 * (((MEAN - theta) / STD) ** 2).sum()
    return -(out - 0.5 * (((hyper - jnp.log(jnp.array(list(HYPER.values())))) / HYPER_PRIOR) ** 2).sum())


jax.tree_util.register_dataclass(Linear, data_fields=[f.name for f in dataclasses.fields(Linear)], meta_fields=[])

@functools.partial(jax.jit, static_argnums=(4,5))
def best_hyper(hyper, theta, lin, session, count, steps):
    return optx.minimise(lambda h, a: evidence(h, (*a, count)), optx.BFGS(1e-4, 1e-4), hyper, (theta, lin, session), max_steps=steps, throw=False)


def merit(hyper, theta, lin, session, count):
    return float(information(hyper, lin, session, count)[2].sum()) - 0.5 * (((MEAN - theta) / STD) ** 2).sum()


def fit(start, runs, session, rounds=8, steps=30, verbose=True):
    theta, hyper = MEAN.copy(), jnp.log(jnp.array(list(HYPER.values())))
    count = int(session.max()) + 1
    session = jnp.asarray(session)
    lin = linear(start, theta, runs.state, runs.command, runs)
    for k in range(rounds):
        if k:
            hyper = best_hyper(hyper, jnp.asarray(theta), lin, session, count, steps).value
        big, small, logp = information(hyper, lin, session, count)
        prec = np.asarray(big.sum(0)) + np.diag(STD**-2)
        move = np.linalg.solve(prec, np.asarray(small.sum(0)) + (MEAN - theta) / STD**2)
        gain = float(move @ prec @ move)
        old = merit(hyper, theta, lin, session, count)
        share = 1.0
        for _ in range(6):
            new = linear(start, theta + share * move, runs.state, runs.command, runs)
            now = merit(hyper, theta + share * move, new, session, count)
            if now > old - 0.01:
                break
            share /= 2
        else:
            share = 0.0
        if share: theta, lin = theta + share * move, new
        if verbose: print(k, old, now, "share", share, "promise", round(gain, 3), dict(zip(HYPER, np.exp(hyper).round(4).tolist())), flush=True)
        if k > 2 and gain < 0.1: break
    return theta, hyper, lin, np.linalg.inv(prec)
