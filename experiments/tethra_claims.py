"""What the thesis says of its networks beside its tables, decided by pairs of dives (ch. 2, 4, 6, app. A).

usage: python -m experiments.tethra_claims --out DIR [--seeds 12] [--quick]

Six networks or one (4.3.5), series-parallel or parallel training (fig. 2.3), a network for each part of the
model or one for all, with NN_3 = g(eta) (4.5), axes that only restoring forces excite and a torpedo of four
axes (4.3.6), velocities with biased and correlated noise and what each method costs (6.3), and the ways to
train of appendix A. Every seed is another dive of Tethra, other noise and other starts. What a seed has given
lies in `DIR/parts`, so that a run that was cut goes on where it was.
"""

import dataclasses
import functools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Array, Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import claim_table, decided, number, short, study, write_results
from experiments.thesis import baselines, plant, training
from jaxmarine.fitting import damping_matrices, damping_targets, fit_samples, levenberg_marquardt
from jaxmarine.fitting._subnets import mass_of, train_acceleration, train_damping
from jaxmarine.networks import Perceptron, perceptron
from jaxmarine.networks._subnets import with_magnitudes
from jaxmarine.physics import coriolis, from_euler, rotation

HERE = Path(__file__).parent / "tethra" / "claims"
HIDDEN = 5  # of the thesis
ONE = 22  # units of one network of six outputs with as many weights as six of five units: 424 and 426
DRIVEN = np.array([0, 2, 5])
TORPEDO = np.array([0, 3, 4, 5])  # forces in surge, moments in roll, pitch and yaw (4.3.6)
# Wrench that the torpedo is given [N, N m]: up to some 1.5 m/s, and half a radian about its restoring moment.
FULL = np.array([15.0, 0.0, 0.0, 2.0, 4.0, 4.0])
RATES = (0.01, 0.03, 0.1, 0.3, 1.0)  # of steepest descent; a hundredth of them sample by sample
DECAYS = (1e-6, 1e-5, 1e-4, 1e-3)
METHODS = ("networks", "LS (6.1)", "LS_2, mass of the networks", "inverse LS", "two-stage LS")
AHEAD = 5.0  # [s] of a free run from a true state
DIVERGED = 1e12

Errors = dict[str, float]
Kept = dict[str, list[float]]  # of every dive


@dataclasses.dataclass(frozen=True)
class Size:
    """Data to identify from and to judge by [s], epochs, of every how many samples networks are trained."""

    data: float = 400.0
    judged: float = 100.0
    epochs: int = 50
    thinned: int = 4
    run: float = 40.0  # [s] of the record that parallel training runs along


QUICK = Size(data=20.0, judged=10.0, epochs=2, thinned=2, run=5.0)


@dataclasses.dataclass(frozen=True)
class Motion:
    """Samples of a dive: attitude, velocity, acceleration, tau - g, and tau."""

    attitude: Array
    nu: Array
    nu_dot: Array
    force: Array
    tau: Array

    @classmethod
    def of(cls, vehicle: jm.Vehicle, log: jm.Log) -> "Motion":
        force = plant.forces(vehicle, log)
        restoring = jax.vmap(lambda a: _restoring(vehicle, a))(jnp.asarray(log.channels[:, 3:6]))
        shown = jnp.asarray(log.channels)
        return cls(
            shown[:, 3:6], shown[:, 6:12], shown[:, 12:18], jnp.asarray(force), jnp.asarray(force) + restoring
        )

    def every(self, k: int) -> "Motion":
        return Motion(*(getattr(self, f.name)[::k] for f in dataclasses.fields(self)))


def _restoring(vehicle: jm.Vehicle, attitude: Array) -> Array:
    return vehicle.plant().load.restoring(rotation(from_euler(attitude))[2])


def relative(found: Array | np.ndarray, true: Array | np.ndarray) -> Float[np.ndarray, " axes"]:
    """Root mean square error of each axis over the spread of what is true."""
    off = np.sqrt(((np.asarray(found) - np.asarray(true)) ** 2).mean(axis=0))
    return off / np.asarray(true).std(axis=0)


class Clock:
    """CPU seconds of what was timed, by name; a solve is awaited."""

    def __init__(self):
        self.seconds: dict[str, float] = {}

    def __call__(self, name: str, what: Callable[[], Any]) -> Any:
        began = time.process_time()
        out = jax.block_until_ready(what())
        self.seconds[name] = time.process_time() - began
        return out


# --- six networks or one (4.3.5) ------------------------------------------------------------------


def _scaled(x: Array) -> tuple[Array, Array, Array]:
    mean, size = x.mean(axis=0), x.std(axis=0)
    return (x - mean[None]) / size[None], mean, size


def six_or_one(seen: Motion, ahead: Motion, size: Size, key) -> Errors:
    """The acceleration, of the axis that is predicted worst, as a share of that axis' spread.

    One network has its outputs of size one, or in m/s² and rad/s², as the thesis warns.
    """
    epochs = size.epochs // 2  # the one of 424 weights is dear
    inputs = jnp.concatenate([seen.nu, seen.force], axis=1)
    x, mean, width = _scaled(inputs)
    _, level, spread = _scaled(seen.nu_dot)
    fresh = (jnp.concatenate([ahead.nu, ahead.force], axis=1) - mean[None]) / width[None]
    out = {}
    names = ("six networks", "one, outputs of size one", "one, outputs in m/s² and rad/s²")
    for name, common in zip(names, (spread, spread, jnp.full(6, spread.max())), strict=True):
        y = (seen.nu_dot - level[None]) / common[None]
        if name == names[0]:
            nets, _ = train_acceleration(seen.nu, seen.nu_dot, seen.force, key, HIDDEN, epochs, 1)
            shown = jax.vmap(nets)(ahead.nu, ahead.force)
        else:
            start = jax.tree.map(lambda a: a[None], perceptron(12, ONE, 6, key))
            net = fit_samples(_shown, start, (x, y), max_steps=epochs).best
            shown = level[None] + common[None] * jax.vmap(net)(fresh)
        out[f"worst axis: {name}"] = float(relative(shown, ahead.nu_dot).max())
    # By back propagation, which the text is about.
    for name, common in zip(names[1:], (spread, jnp.full(6, spread.max())), strict=True):
        y = (seen.nu_dot - level[None]) / common[None]
        net = _descended(perceptron(12, ONE, 6, key), x, y, size)
        shown = level[None] + common[None] * jax.vmap(net)(fresh)
        out[f"worst axis, steepest descent: {name}"] = float(relative(shown, ahead.nu_dot).max())
    nets = [
        _descended(
            perceptron(12, HIDDEN, 1, k), x, ((seen.nu_dot - level[None]) / spread[None])[:, [i]], size
        )
        for i, k in enumerate(jax.random.split(key, 6))
    ]
    shown = level[None] + spread[None] * jnp.concatenate([jax.vmap(net)(fresh) for net in nets], axis=1)
    out[f"worst axis, steepest descent: {names[0]}"] = float(relative(shown, ahead.nu_dot).max())
    return out


def _shown(net: Perceptron, sample) -> Array:
    return net(sample[0]) - sample[1]


def _descended(net: Perceptron, x: Array, y: Array, size: Size) -> Perceptron:
    """By steepest descent, twenty times as many epochs, at the rate that leaves the least loss."""
    flat, unravel = jax.flatten_util.ravel_pytree(net)
    miss = _miss(x.shape[1], y.shape[1], net.weight_1.shape[0])
    ends = [training.steepest_descent(miss, flat, (x, y), rate, 20 * size.epochs) for rate in RATES]
    return unravel(_least(miss, ends, (x, y)))


@functools.cache
def _miss(inputs: int, outputs: int, hidden: int) -> training.Miss:
    """Errors of a perceptron from its flat weights: one function for each shape, which compiles once."""
    _, unravel = jax.flatten_util.ravel_pytree(perceptron(inputs, hidden, outputs, jax.random.key(0)))
    return lambda w, samples: (jax.vmap(unravel(w))(samples[0]) - samples[1]).ravel()


def _least(miss: training.Miss, ends: list, samples) -> Array:
    """The weights of least loss; none that have diverged."""
    costs = [float(training.loss(miss, w, samples)) for w in ends]
    return ends[int(np.argmin(np.nan_to_num(costs, nan=np.inf)))]


# --- series-parallel or parallel (fig. 2.3) -------------------------------------------------------


def one_step_or_free(truth: Motion, ahead: Motion, size: Size, seed: int, key) -> Errors:
    """nu(k+1) = F[nu(k), f(k)] (2.3), its error in free runs of some seconds on another dive.

    Series-parallel training is given the measured velocity at each step, parallel training its own.
    """
    steps = round(size.run / plant.DT)
    out = {}
    noise = np.repeat([plant.REALISTIC["velocity"], plant.REALISTIC["rate"]], 3)
    for words, share in (("no noise", 0.0), ("noise", 1.0)):
        off = share * noise * np.random.default_rng([seed, 9]).standard_normal((steps + 1, 6))
        shown = truth.nu[: steps + 1] + off
        y, mean, width = _scaled(shown)
        u, push, wide = _scaled(truth.force[: steps + 1])
        flat, unravel = jax.flatten_util.ravel_pytree(perceptron(12, 8, 6, key))

        def free(w, data, unravel=unravel):
            y, u = data

            def step(now, u):
                after = unravel(w)(jnp.concatenate([now, u]))
                return after, after

            return jax.lax.scan(step, y[0], u[:-1])[1] - y[1:]

        def one_step(w, data, unravel=unravel):
            y, u = data
            return jax.vmap(unravel(w))(jnp.concatenate([y, u], axis=1)[:-1]) - y[1:]

        def trained(miss, start, data=(y, u)):
            return levenberg_marquardt(miss, start[None], data, max_steps=size.epochs).values[0]

        series = trained(one_step, flat)
        found = {
            "series-parallel": series,
            "parallel": trained(free, flat),
            "parallel, from series-parallel": trained(free, series),
        }
        run = round(AHEAD / plant.DT)
        count = min(len(ahead.nu) // run, 20)
        fresh = tuple(
            ((a[: count * run] - m[None]) / s[None]).reshape(count, run, 6)
            for a, m, s in ((ahead.nu, mean, width), (ahead.force, push, wide))
        )
        for name, w in found.items():
            missed = jax.vmap(lambda y, u, w=w: free(w, (y, u)))(*fresh)
            out[f"{AHEAD:g} s free, {words}: {name}"] = float(jnp.sqrt((missed**2).mean()))
    return out


# --- a network for each part (4.5) ----------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Scales:
    nu: Array
    tilt: Array
    force: Array
    nu_dot: Array


def by_parts(seen: Motion, ahead: Motion, vehicle: jm.Vehicle, size: Size, key) -> Errors:
    """A mass, a network for the damping and NN_3 = g(eta), or one network for all; 218 and 226 weights.

    From tau, which no restoring force has been taken from; NN_3 is given the vertical in body axes. Errors of
    nu', g(eta) and D(nu) nu are means over axes.
    """
    first, second, third = jax.random.split(key, 3)

    def tilt(motion: Motion) -> Array:
        return jax.vmap(lambda a: rotation(from_euler(a))[2])(motion.attitude)

    level, guess = jnp.array([0.0, 0.0, 1.0]), jnp.array([250.0] * 3 + [60.0] * 3)  # [kg, kg m²]
    sizes = _Scales(
        seen.nu.std(axis=0),
        jnp.maximum((tilt(seen) - level[None]).std(axis=0), 1e-3),
        jnp.maximum(seen.tau.std(axis=0), guess * seen.nu_dot.std(axis=0)),
        seen.nu_dot.std(axis=0),
    )

    def samples(motion: Motion):
        leaning = (tilt(motion) - level[None]) / sizes.tilt[None]
        return motion.nu, leaning, motion.tau, motion.nu_dot

    def lacked(net: Perceptron, x: Array) -> Array:
        return net(x) - net(jnp.zeros_like(x))

    def parts(y, sample):
        inverse, drag, lean, still = y
        nu, leaning, tau, _ = sample
        mass = jnp.linalg.inv(jnp.diag(sizes.nu_dot) @ inverse @ jnp.diag(1.0 / sizes.force))
        kinetic = 0.5 * (mass + mass.T)
        felt = sizes.force * lacked(drag, with_magnitudes(nu / sizes.nu))
        g = sizes.force * (lacked(lean, leaning) + still)
        return jnp.linalg.solve(mass, tau - coriolis(kinetic, nu) - felt - g), felt, g

    def one(net, sample):
        nu, leaning, tau, _ = sample
        x = jnp.concatenate([nu / sizes.nu, leaning, tau / sizes.force])
        return sizes.nu_dot * net(x)

    start = (
        jnp.diag(sizes.force / (sizes.nu_dot * guess)),
        perceptron(12, 6, 6, first),
        perceptron(3, 5, 6, second),
        jnp.zeros(6),
    )
    lone = perceptron(15, 10, 6, third)

    def missed(shown):
        return lambda y, sample: (shown(y, sample) - sample[3]) / sizes.nu_dot

    def trained(shown, start):
        starts = jax.tree.map(lambda a: a[None], start)
        return fit_samples(missed(shown), starts, samples(seen), max_steps=size.epochs).best

    found, alone = trained(lambda y, s: parts(y, s)[0], start), trained(one, lone)
    fresh = samples(ahead)
    nu_dot, felt, g = jax.vmap(lambda s: parts(found, s))(fresh)
    true_g = jax.vmap(lambda a: _restoring(vehicle, a))(ahead.attitude)
    true_felt = damping_targets(vehicle.mass_matrix, ahead.nu, ahead.nu_dot, ahead.force)
    # On the axes whose restoring force changes by more than a newton, or newton metre.
    moves = np.asarray(true_g).std(axis=0) > 1.0
    return {
        "nu': a network for each part": float(relative(nu_dot, ahead.nu_dot).mean()),
        "nu': one network for all": float(
            relative(jax.vmap(lambda s: one(alone, s))(fresh), ahead.nu_dot).mean()
        ),
        "g(eta): NN_3": float(relative(g[:, moves], true_g[:, moves]).mean()),
        "D(nu) nu: its network": float(relative(felt, true_felt).mean()),
    }


# --- axes without a drive (4.3.6) -----------------------------------------------------------------


def undriven(size: Size, seed: int, key) -> Errors:
    """The mass of sway, which no thruster drives, with and without a roll that leans the buoyancy aside."""
    buoyant = plant.tethra()
    neutral = dataclasses.replace(
        buoyant, body=dataclasses.replace(buoyant.body, weight=buoyant.body.buoyancy)
    )
    out = {}
    for name, vehicle, idle in (
        ("buoyant, rolling", buoyant, ()),
        ("buoyant, no roll", buoyant, ("roll",)),
        ("neutral, rolling", neutral, ()),
    ):
        log = plant.noisy(plant.dive(vehicle, size.data, seed, idle=idle), "tenth", seed)
        motion = Motion.of(vehicle, log).every(size.thinned)
        arrays = motion.nu, motion.nu_dot, motion.force
        nets, _ = train_acceleration(*arrays, key, HIDDEN, size.epochs, 1)
        mass = {
            "networks": mass_of(nets, motion.nu, motion.force),
            "two-stage LS": baselines.two_stage_ls(*arrays).mass,
        }
        for method, found in mass.items():
            assert found is not None
            true = float(vehicle.mass_matrix[1, 1])
            out[f"mass of sway, {method}: {name}"] = abs(float(found[1, 1]) / true - 1.0)
    return out


def torpedo(size: Size, seed: int) -> Errors:
    """nu' of a torpedo's four driven axes on a new dive, by least squares of these alone or of all six."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("minesniper"))
    found = {}
    runs = []
    for part, duration in ((0, size.data), (1, size.judged)):
        count = round(duration / plant.DT)
        rng = np.random.default_rng([seed, part, 6])
        held = np.repeat(rng.uniform(-1.0, 1.0, (count // 20 + 1, 6)), 20, axis=0)[:count] * FULL
        blank = np.full((count, 18), np.nan)
        t = np.arange(count) * plant.DT
        log = jm.Log(t, blank, None, held, vehicle.command_names, "torpedo")
        track = np.asarray(jm.simulate(vehicle, log, jm.initial_state(vehicle)).channels)
        if part == 0:
            # A tenth of what the text adds to accelerations: this craft's own are as small.
            off = np.random.default_rng([seed, 7]).uniform(-1.0, 1.0, (count, 6))
            track = track.copy()
            track[:, 12:] += 0.1 * np.array([0.5] * 3 + [0.05] * 3) * off
        restoring = jax.vmap(lambda a: _restoring(vehicle, a))(jnp.asarray(track[:, 3:6]))
        runs.append((track[:, 6:12], track[:, 12:], held - np.asarray(restoring)))
    for name, axes in (("four axes", TORPEDO), ("six axes", np.arange(6))):
        columns = []
        for nu, _, force in runs:
            own = nu[:, axes]
            products = [own[:, i] * own[:, j] for i in range(len(axes)) for j in range(i + 1)]
            columns.append(np.column_stack([force[:, axes], own, np.abs(own) * own, *products]))
        solved = np.linalg.lstsq(columns[0], runs[0][1][:, TORPEDO], rcond=None)[0]
        off = relative(columns[1] @ solved, runs[1][1][:, TORPEDO])
        found[f"torpedo, nu' of its four axes: {name}"] = float(off.mean())
    return found


# --- noise that stays (6.3) -----------------------------------------------------------------------


def identified(motion: Motion, size: Size, key, clock: Clock) -> dict[str, baselines.Estimate]:
    """By the thesis' networks, its least squares, and fair ones."""
    arrays = motion.nu, motion.nu_dot, motion.force
    first, second = jax.random.split(key)

    def by_networks():
        nets, _ = train_acceleration(*arrays, first, HIDDEN, size.epochs, 1)
        mass = mass_of(nets, motion.nu, motion.force, intercept=False)
        targets = damping_targets(mass, *arrays)
        nets, _ = train_damping(motion.nu, targets, second, epochs=size.epochs)
        return mass, *damping_matrices(motion.nu, jax.vmap(nets)(motion.nu))

    networks = baselines.Estimate(*map(np.asarray, clock("networks", by_networks)))
    return {
        "networks": networks,
        "LS (6.1)": clock("LS (6.1)", lambda: baselines.ls_of_the_thesis(*arrays)),
        "LS_2, mass of the networks": clock(
            "LS_2, mass of the networks", lambda: baselines.ls_with_mass(*arrays, networks.mass)
        ),
        "inverse LS": clock("inverse LS", lambda: baselines.inverse_ls(*arrays)),
        "two-stage LS": clock("two-stage LS", lambda: baselines.two_stage_ls(*arrays)),
    }


def lasting_noise(vehicle: jm.Vehicle, clean: jm.Log, size: Size, seed: int, key, clock: Clock) -> Errors:
    """Errors of M and D_l, largest on the diagonal and `MeanError` in per cent, and how D_l's grows."""
    true, out = plant.truth(vehicle), {}
    for kind in ("white", "coloured"):
        # The force is known; the velocities alone are off.
        measured = Motion.of(vehicle, plant.noisy(clean, kind, seed)).every(size.thinned)
        for method, found in identified(measured, size, key, clock).items():
            for matrix, value in (("M", found.mass), ("D_l", found.linear)):
                if value is not None:
                    off = baselines.errors(value, true[matrix])
                    for what in ("diagonal", "mean"):
                        out[f"{matrix} {what} %, {kind}: {method}"] = float(off[what] or 0.0)
    for method in ("networks", "LS (6.1)", "LS_2, mass of the networks", "two-stage LS"):
        worse = out[f"D_l mean %, coloured: {method}"] / out[f"D_l mean %, white: {method}"]
        out[f"D_l mean, coloured over white: {method}"] = worse
    return out


# --- how to train (app. A) ------------------------------------------------------------------------


def ways_to_train(seen: Motion, ahead: Motion, size: Size, key, clock: Clock) -> Errors:
    """nu' of surge, heave and yaw, their mean, by networks of the thesis' size that start alike."""
    x, mean, width = _scaled(jnp.concatenate([seen.nu, seen.force], axis=1))
    y, level, spread = _scaled(seen.nu_dot)
    fresh = (jnp.concatenate([ahead.nu, ahead.force], axis=1) - mean[None]) / width[None]
    miss, epochs = _miss(12, 1, HIDDEN), size.epochs
    _, unravel = jax.flatten_util.ravel_pytree(perceptron(12, HIDDEN, 1, key))
    three = 3 * len(x) // 4
    ways: dict[str, list[float]] = {}
    seconds: dict[str, float] = {}
    left = []

    for axis, own in zip(DRIVEN, jax.random.split(key, len(DRIVEN)), strict=True):
        data = x, y[:, [axis]]
        known, rest = (
            jax.tree.map(lambda a, p=part: a[p], data) for part in (slice(three), slice(three, None))
        )
        start, _ = jax.flatten_util.ravel_pytree(perceptron(12, HIDDEN, 1, own))

        def decayed(data, decay, start=start):
            return training.marquardt(miss, start, data, decay, epochs)

        def chosen(known=known, rest=rest, data=data, decayed=decayed):
            """The decay that predicts the last quarter best, then from all samples."""
            costs = [float(training.loss(miss, decayed(known, decay), rest)) for decay in DECAYS]
            return decayed(data, DECAYS[int(np.argmin(costs))])

        def descended(count, data=data, start=start):
            ends = [training.steepest_descent(miss, start, data, rate, count) for rate in RATES]
            return _least(miss, ends, data)

        def in_turn(data=data, start=start, own=own):
            ends = [training.sequential(miss, start, data, 0.01 * rate, own, epochs) for rate in RATES]
            return _least(miss, ends, data)

        def by_newton(decay, data=data, start=start):
            return training.newton(miss, start, data, decay, epochs)

        lm = clock("Levenberg-Marquardt", lambda decayed=decayed, data=data: decayed(data, 0.0))
        part = decayed(known, 0.0)
        less, kept = training.pruned(miss, part, known, rest)
        left.append(float(kept.sum()))
        found = {
            "Levenberg-Marquardt": lm,
            "weight decay": clock("weight decay", chosen),
            "steepest descent": clock("steepest descent", lambda descended=descended: descended(epochs)),
            "steepest descent, 20 times the epochs": clock(
                "steepest descent, 20 times the epochs", lambda descended=descended: descended(20 * epochs)
            ),
            "sample by sample": clock("sample by sample", in_turn),
            "Newton": clock("Newton", lambda by_newton=by_newton: by_newton(0.0)),
            "Newton, weight decay 0.01": clock(
                "Newton, weight decay 0.01", lambda by_newton=by_newton: by_newton(0.01)
            ),
            "three quarters of the samples": part,
            "the same, pruned": less,
        }
        for name, w in found.items():
            shown = level[axis] + spread[axis] * jax.vmap(unravel(w))(fresh)[:, 0]
            off = float(relative(shown[:, None], ahead.nu_dot[:, [axis]])[0])
            ways.setdefault(name, []).append(off if np.isfinite(off) else np.inf)
            seconds[name] = seconds.get(name, 0.0) + clock.seconds.pop(name, 0.0)
    clock.seconds |= {name: value for name, value in seconds.items() if value}
    out = {f"app. A: {name}": float(np.mean(values)) for name, values in ways.items()}
    return out | {"app. A: weights left of 71": float(np.mean(left))}


# --- the claims -----------------------------------------------------------------------------------

FREE = f"{AHEAD:g} s free"
# Whose it is, what is claimed, the error that is to be lower, the one it is compared with, times what.
CLAIMS: tuple[tuple[str, str, str, float], ...] = (
    (
        "4.3.5: six networks err less than one, its outputs in m/s² and rad/s²",
        "worst axis: six networks",
        "worst axis: one, outputs in m/s² and rad/s²",
        1.0,
    ),
    (
        "4.3.5: six networks err less than one, its outputs of size one",
        "worst axis: six networks",
        "worst axis: one, outputs of size one",
        1.0,
    ),
    (
        "4.3.5: the first by steepest descent",
        "worst axis, steepest descent: six networks",
        "worst axis, steepest descent: one, outputs in m/s² and rad/s²",
        1.0,
    ),
    (
        "4.3.5: normalised outputs mend it, steepest descent",
        "worst axis, steepest descent: one, outputs of size one",
        "worst axis, steepest descent: one, outputs in m/s² and rad/s²",
        1.0,
    ),
    (
        "fig. 2.3: series-parallel learns better than parallel, no noise",
        f"{FREE}, no noise: series-parallel",
        f"{FREE}, no noise: parallel",
        1.0,
    ),
    (
        "fig. 2.3: series-parallel learns better than parallel, 1 cm/s of noise",
        f"{FREE}, noise: series-parallel",
        f"{FREE}, noise: parallel",
        1.0,
    ),
    (
        "ours: parallel after series-parallel is better still, 1 cm/s of noise",
        f"{FREE}, noise: parallel, from series-parallel",
        f"{FREE}, noise: series-parallel",
        1.0,
    ),
    (
        "4.2: a network for each part, (4.5), is better than one for all",
        "nu': a network for each part",
        "nu': one network for all",
        1.0,
    ),
    (
        "4.3.6: a roll shows the mass of sway, networks",
        "mass of sway, networks: buoyant, rolling",
        "mass of sway, networks: buoyant, no roll",
        1.0,
    ),
    (
        "4.3.6: a roll shows the mass of sway, two-stage LS",
        "mass of sway, two-stage LS: buoyant, rolling",
        "mass of sway, two-stage LS: buoyant, no roll",
        1.0,
    ),
    (
        "4.3.6: it does so less where the craft is neutral, networks",
        "mass of sway, networks: buoyant, rolling",
        "mass of sway, networks: neutral, rolling",
        1.0,
    ),
    (
        "4.3.6: it does so less where the craft is neutral, two-stage LS",
        "mass of sway, two-stage LS: buoyant, rolling",
        "mass of sway, two-stage LS: neutral, rolling",
        1.0,
    ),
    (
        "4.3.6: four axes of a torpedo are modelled as well without the other two (a tenth worse at most)",
        "torpedo, nu' of its four axes: four axes",
        "torpedo, nu' of its four axes: six axes",
        1.1,
    ),
    (
        "6.3: lasting noise of velocity harms networks' D_l less than that of LS (6.1)",
        "D_l mean, coloured over white: networks",
        "D_l mean, coloured over white: LS (6.1)",
        1.0,
    ),
    (
        "6.3: with it networks find D_l better than LS (6.1)",
        "D_l mean %, coloured: networks",
        "D_l mean %, coloured: LS (6.1)",
        1.0,
    ),
    (
        "ours: with it networks find D_l better than two-stage LS",
        "D_l mean %, coloured: networks",
        "D_l mean %, coloured: two-stage LS",
        1.0,
    ),
    (
        "A.2: Levenberg-Marquardt is better than steepest descent, 20 times its epochs",
        "app. A: Levenberg-Marquardt",
        "app. A: steepest descent, 20 times the epochs",
        1.0,
    ),
    (
        "A.1.1: batch converges better than sample by sample, as many epochs",
        "app. A: steepest descent",
        "app. A: sample by sample",
        1.0,
    ),
    (
        "A.2.2: Newton's method converges better than steepest descent",
        "app. A: Newton",
        "app. A: steepest descent",
        1.0,
    ),
    (
        "A.2.3: weight decay helps Newton's method",
        "app. A: Newton, weight decay 0.01",
        "app. A: Newton",
        1.0,
    ),
    ("A.2.3: weight decay lowers the error", "app. A: weight decay", "app. A: Levenberg-Marquardt", 1.0),
    (
        "A.2.3: pruning lowers the error",
        "app. A: the same, pruned",
        "app. A: three quarters of the samples",
        1.0,
    ),
)


def claims(errors: Kept) -> list[dict]:
    """Each claim, over dives."""
    pairs = {words: list(zip(errors[one], errors[two], strict=True)) for words, one, two, _ in CLAIMS}
    return decided(pairs, {words: share for words, *_, share in CLAIMS})


def part(seed: int, size: Size) -> dict[str, Any]:
    """All errors of one seed, and the seconds of the methods."""
    vehicle, clock = plant.tethra(), Clock()
    clean, other = (plant.dive(vehicle, t, s) for t, s in ((size.data, seed), (size.judged, seed + 5000)))
    measured = Motion.of(vehicle, plant.noisy(clean, "tenth", seed)).every(size.thinned)
    truth, ahead = Motion.of(vehicle, clean), Motion.of(vehicle, other)
    keys = jax.random.split(jax.random.key(seed), 6)
    parts = {
        "4.3.5": lambda: six_or_one(measured, ahead, size, keys[0]),
        "fig. 2.3": lambda: one_step_or_free(truth, ahead, size, seed, keys[1]),
        "4.5": lambda: by_parts(measured, ahead, vehicle, size, keys[2]),
        "4.3.6": lambda: undriven(size, seed, keys[3]) | torpedo(size, seed),
        "6.3": lambda: lasting_noise(vehicle, clean, size, seed, keys[4], clock),
        "app. A": lambda: ways_to_train(measured, ahead, size, keys[5], clock),
    }
    errors: Errors = {}
    for name, found in parts.items():
        errors |= clock(f"all of {name}", found)
    # What has diverged is written as a number.
    errors = {name: float(np.nan_to_num(x, nan=DIVERGED, posinf=DIVERGED)) for name, x in errors.items()}
    return {"seed": seed, "errors": errors, "seconds": clock.seconds}


def table(results: dict[str, Any]) -> str:
    """The claims, then each method by its errors and what it costs, and each way to train; medians."""
    errors, seconds = (
        {name: float(np.median(values)) for name, values in results[kind].items()}
        for kind in ("errors", "seconds")
    )

    def found(matrix: str, kind: str, method: str) -> str:
        names = [f"{matrix} {what} %, {kind}: {method}" for what in ("diagonal", "mean")]
        return " / ".join(number(errors[name]) for name in names) if names[0] in errors else "given"

    lines = [claim_table(results["claims"])]
    heads = ("velocities off by 1 cm/s: largest / `MeanError` %", "M, white", "D_l, white", "M, lasting")
    lines += ["| " + " | ".join((*heads, "D_l, lasting", "CPU s")) + " |", "|---|---|---|---|---|---|"]
    for method in METHODS:
        cells = [found(matrix, kind, method) for kind in ("white", "coloured") for matrix in ("M", "D_l")]
        lines.append(f"| {method} | " + " | ".join(cells) + f" | {seconds[method]:.2g} |")
    lines += ["", "| way to train, 50 epochs | error of nu', share of its spread | CPU s |", "|---|---|---|"]
    for name, error in errors.items():
        way = name.removeprefix("app. A: ")
        if way != name and not way.startswith("weights left"):
            cost = f"{seconds[way]:.2g}" if way in seconds else "–"
            lines.append(f"| {way} | {number(error)} | {cost} |")
    return "\n".join(lines) + "\n"


def remarks(results: dict[str, Any]) -> str:
    """What the page says below the tables, from what was kept of the dives."""
    errors = {name: np.array(values) for name, values in results["errors"].items()}
    dives = len(next(iter(errors.values())))

    def middle(name: str, times: float = 1.0) -> str:
        return number(times * float(np.median(errors[name])))

    def better(one: str, other: str) -> str:
        return f"{(errors[one] < errors[other]).sum()} of {dives} dives"

    def times(one: str, other: str) -> str:
        return f"{np.median(errors[one] / errors[other]):.2g}"

    def diverged(name: str) -> str:
        return f"{(errors[name] >= DIVERGED).sum()} of {dives} dives"

    six, one = "worst axis: six networks", "worst axis: one, outputs in m/s² and rad/s²"
    series, parallel, after = (
        f"{FREE}, noise: {name}" for name in ("series-parallel", "parallel", "parallel, from series-parallel")
    )
    methods = ("networks", "two-stage LS", "LS (6.1)")
    grown = {name: f"D_l mean, coloured over white: {name}" for name in methods}
    lasting = {name: f"D_l mean %, coloured: {name}" for name in methods}
    decayed = errors["app. A: Newton, weight decay 0.01"]
    pruned, whole = "app. A: the same, pruned", "app. A: three quarters of the samples"
    neutral = "mass of sway, networks: neutral, rolling", "mass of sway, two-stage LS: neutral, rolling"
    lines = [
        "Six networks (4.3.5): the text speaks of back propagation with outputs of unlike size, and there it "
        "is right; normalised outputs mend it as well, as it says too. By Levenberg-Marquardt, which the "
        "thesis trains with, one network of as many weights (424 and 426) is better in "
        f"{better(one, six)}, also with outputs in m/s² and rad/s².",
        "Fig. 2.3: from random weights parallel training has learned next to nothing after 50 epochs: its "
        f"error is {middle(parallel)} with noise and {middle(parallel.replace('noise', 'no noise'))} without "
        "it, where 1 is that of the mean. From the series-parallel result it makes "
        f"{middle(after)} of {middle(series)}.",
        "NN_3 = g(eta) of (4.5), learned beside a mass and a network for the damping from tau, attitude and "
        f"motion alone, is right within {middle('g(eta): NN_3', 100)} % of its spread, the damping within "
        f"{middle('D(nu) nu: its network', 100)} %; one network for all has no g(eta) to show.",
        "Without a roll the networks' mass of sway is off by "
        f"{middle('mass of sway, networks: buoyant, no roll', 100)} %. In a neutral craft nothing pushes in "
        "sway, and there is no number at all, as the thesis says of it: ∞ with networks in "
        f"{diverged(neutral[0])}, with two-stage least squares in {diverged(neutral[1])}.",
        "A torpedo (the packaged Minesniper) of four axes is in the median "
        + times("torpedo, nu' of its four axes: four axes", "torpedo, nu' of its four axes: six axes")
        + " times worse than with sway and heave, which are not driven, but count.",
        f"Noise that lasts (6.3) multiplies the `MeanError` of D_l by {middle(grown['networks'])} with "
        f"networks, by {middle(grown['two-stage LS'])} with two-stage least squares, by "
        f"{middle(grown['LS (6.1)'])} with (6.1). With it two-stage least squares is still "
        f"{times(lasting['networks'], lasting['two-stage LS'])} times better than the networks.",
        f"Newton's method by (A.19) diverges on {diverged('app. A: Newton')}. With decay (H + 2 lambda I, "
        "lambda 0.01) it no longer does, which is all that the test shows: its error of "
        f"{decayed.min():.3g} to {decayed.max():.3g} is no better than that of the mean, which is 1.",
        "Sample by sample is better than batch after as many epochs in "
        f"{better('app. A: sample by sample', 'app. A: steepest descent')}, the reverse of A.1.1; rates are "
        "the best of five each.",
        "Pruning (by saliency, as far as left-out samples allow; the thesis names it and does not use it) "
        f"leaves {middle('app. A: weights left of 71')} of 71 weights at an error of {middle(pruned)} "
        f"instead of {middle(whole)}.",
    ]
    return "".join(f"- {line}\n" for line in lines)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    seeds: Annotated[int, typer.Option(min=1, help="Dives.")] = 12,
    quick: Annotated[bool, typer.Option("--quick", help="One short dive, two epochs.")] = False,
) -> None:
    """Decides what the thesis says of its networks beside its tables."""
    size, seeds = (QUICK, 1) if quick else (Size(), seeds)
    with study(out, quick), Progress(transient=True) as bar:
        (out / "parts").mkdir(exist_ok=True)
        parts = []
        for seed in bar.track(range(seeds), description="dives"):
            path = out / "parts" / f"{size.data:g}s_{size.epochs}_{seed}.json"
            if not path.exists():
                path.write_text(json.dumps(part(seed, size)) + "\n", encoding="utf-8")
            parts.append(json.loads(path.read_text()))
            kept = {
                kind: short({name: [p[kind][name] for p in parts] for name in parts[0][kind]})
                for kind in ("errors", "seconds")
            }
            results = {"claims": claims(kept["errors"]), **kept}
            write_results(out, results, table(results) + ("" if quick else "\n" + remarks(results)))


if __name__ == "__main__":
    typer.run(main)
