"""Damping of a torpedo-shaped craft with a sliding mass, learned from acoustic positions (thesis, ch. 7).

usage: python -m experiments.minesniper --out DIR [--seeds N] [--quick]

The measured runs of the thesis are not public, so a synthetic craft stands for them: the packaged
Minesniper with its sliding mass and another damping than the printed (7.5). Logs hold commands, position and
attitude only. Six radial-basis networks are grown on the force that the printed damping lacks, by the largest
saving and, as the thesis does it, by the worst sample; least squares of the same force and a trajectory-loss
fit, both of the printed form, stand beside them, and perceptrons and radial-basis networks that stand alone
for the whole damping. Open-loop predictions of the training runs and
of a test run, which goes where training did not, are compared with where the craft was.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import matplotlib.ticker
import numpy as np
import scipy.ndimage
import scipy.spatial.distance
import typer
from jaxtyping import Array, Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import claim_table, decided, save_figure, short, spread, study, write_results
from jaxmarine._types import DOFS, Wrench
from jaxmarine.actuators import Slider
from jaxmarine.effects import Craft, Motion, Suspect, WrenchEffect, place
from jaxmarine.fitting import noise_of
from jaxmarine.fitting._subnets import train_damping
from jaxmarine.logs import Kinematics, differentiate
from jaxmarine.networks import NetworkDamping, RBFDamping, basis_of, grow, rbf_damping
from jaxmarine.physics import from_euler
from jaxmarine.simulation import inputs
from jaxmarine.vehicle_io import suspect_named

DT = 0.1  # [s]
HORIZON = 10.0  # [s]
STRETCH = 5.0  # [s] of a run that is left out at a time
UNITS = ("m/s",) * 3 + ("rad/s",) * 3
FORCES = ("X [N]", "Y [N]", "Z [N]", "K [N m]", "M [N m]", "N [N m]")

# Thesis (7.5). The packaged file has its linear part made symmetric, because as printed it is not
# positive semidefinite.
PRINTED_LINEAR = np.diag([0.0, 83.0, 85.0, 1.0, 9.5, 6.8])
PRINTED_LINEAR[1, 5], PRINTED_LINEAR[5, 1] = -20.0, -17.0
PRINTED_LINEAR[2, 4], PRINTED_LINEAR[4, 2] = 30.0, 27.0
PRINTED_QUADRATIC = np.diag([7.0, 100.0, 250.0, 50.0, 90.0, 90.0])

# The synthetic craft, assumed: more drag ahead, less linear and more quadratic drag in sway, and body lift of
# a torpedo hull after Prestero (2001): c = 1.2 on the frontal square of 0.17 m, at 0.32 m behind `o`.
TRUE_LINEAR = np.diag([2.0, 50.0, 50.0, 0.6, 16.0, 14.0])
TRUE_LINEAR[1, 5], TRUE_LINEAR[5, 1] = -8.0, -12.0
TRUE_LINEAR[2, 4], TRUE_LINEAR[4, 2] = 12.0, 10.0
TRUE_QUADRATIC = np.diag([10.0, 220.0, 180.0, 20.0, 60.0, 60.0])
TRUE_LIFT = {"Y_uv": 18.0, "N_uv": -5.7, "Z_uw": 18.0, "M_uw": 5.7}

# 1.7 kg in the rear half (thesis, sec. 7.2); rail, travel and servo are assumed.
SLIDER = {"mass": 1.7, "position": [-0.5, 0.0, 0.0], "direction": [1.0, 0.0, 0.0]}
SLIDER |= {"travel": 0.1, "time_constant": 0.5}

# Ranges of the operator's sticks: ahead, turn, vertical thruster, sliding mass. The test goes further.
STICKS = ((0.35, 0.65), (-0.4, 0.4), (-0.4, 0.4), (-0.5, 0.5))
TEST_STICKS = ((0.2, 1.0), (-0.8, 0.8), (-0.9, 0.9), (-0.9, 0.9))
SPEED, TEST_SPEED = 0.9, 0.5  # [m/s] at the start

PRINTED, RBF, LS = "printed damping (7.5)", "RBF beside (7.5)", "least squares, form of (7.5)"
FIT, TRUE = "trajectory loss", "true damping"
# Grown by the worst sample: as sec. 2.1.3 has it, with its other width, and as `RBF` in all else.
AS_PRINTED, BY_SPREAD = "RBF beside (7.5), as printed", "RBF beside (7.5), as printed, width (2.2)"
BY_WORST = "RBF beside (7.5), worst sample"
# What sec. 7.1 warns of, and fig. 7.3: networks that stand for the whole damping.
PERCEPTRON, ALONE = "perceptrons alone (7.1)", "RBF alone (fig. 7.3)"
STYLES = {PRINTED: ("C1", "-"), PERCEPTRON: ("C4", ":"), ALONE: ("C5", "--"), RBF: ("C0", "--")}
STYLES |= {BY_WORST: ("C9", "--"), AS_PRINTED: ("C6", "-."), BY_SPREAD: ("C8", ":")}
STYLES |= {FIT: ("C2", "-."), LS: ("C3", ":"), TRUE: ("0.6", "-")}
RUNS = {"train": "training", "test": "test"}
WHOSE = {PRINTED: "thesis", PERCEPTRON: "thesis", AS_PRINTED: "thesis", BY_SPREAD: "thesis"}
WHOSE |= {ALONE: "thesis, growth ours", RBF: "thesis, growth ours", BY_WORST: "ours, growth the thesis'"}
WHOSE |= {FIT: "ours", LS: "ours", TRUE: "truth"}
# Which of two models is less off, on which runs, over which horizons.
BOTH = ("5 s", "10 s")
CLAIMS = (
    (
        "thesis, fig. 7.3, by growth of ours: radial-basis networks alone are less off than (7.5)",
        (ALONE, PRINTED),
        "train",
        ("10 s",),
    ),
    ("ours: so are they beside (7.5)", (RBF, PRINTED), "train", ("10 s",)),
    (
        "thesis, fig. 7.4: networks as printed beside (7.5) are less off than it where training was not",
        (AS_PRINTED, PRINTED),
        "test",
        BOTH,
    ),
    ("ours: so are those grown by the largest saving", (RBF, PRINTED), "test", BOTH),
    (
        "thesis, sec. 7.1: (7.5) is less off there than perceptrons alone",
        (PRINTED, PERCEPTRON),
        "test",
        BOTH,
    ),
    (
        "thesis, sec. 7.1, by growth of ours: so are radial-basis networks alone",
        (ALONE, PERCEPTRON),
        "test",
        BOTH,
    ),
    ("ours: (7.5) is less off there than radial-basis networks alone", (PRINTED, ALONE), "test", BOTH),
    ("ours: beside (7.5) they are less off than alone", (RBF, ALONE), "test", BOTH),
    ("ours: beside (7.5) they are less off than grown as printed", (RBF, AS_PRINTED), "test", BOTH),
    ("ours: than grown as printed with width (2.2)", (RBF, BY_SPREAD), "test", BOTH),
    (
        "ours: growth by the largest saving is less off than by the worst sample, all else alike",
        (RBF, BY_WORST),
        "test",
        BOTH,
    ),
    ("ours: a trajectory loss is less off than networks beside (7.5)", (FIT, RBF), "test", BOTH),
    ("ours: a trajectory loss is less off than least squares", (FIT, LS), "test", BOTH),
)
# What left-out stretches choose the ridge among: a share of the squares of each column.
RIDGES = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
CENTRES, SIGMA = 500, np.sqrt(5.0)  # thesis, sec. 7.2 and 2.1.3
DECAY = 1e-6  # of weights, in samples of unit force: without any, rounding decides where kernels are alike


@dataclasses.dataclass(frozen=True)
class Size:
    """Lengths of the two training runs and of the test run [s], seconds between starts, steps of the fit.

    - `others`: with the networks that stand for the whole damping, and those grown in yet other ways.
    """

    train: float = 25.0
    test: float = 15.0
    between: float = 2.5
    steps: int = 30
    others: bool = True


QUICK = Size(train=10.0, test=10.0, steps=8, others=False)
HERE = Path(__file__).parent / "sniper"


# --- craft and logs ------------------------------------------------------------------------------


def craft(linear: np.ndarray, quadratic: np.ndarray, lift: dict[str, float] | None = None) -> jm.Vehicle:
    """The packaged craft with its sliding mass, the given damping and hull lift (none: of size zero)."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("minesniper"))
    slider = Slider(**{name: jnp.asarray(value) for name, value in SLIDER.items()}, names=("slider",))
    vehicle = dataclasses.replace(vehicle, masses=(slider,))
    damping = (jnp.asarray(linear), jnp.asarray(quadratic))
    vehicle = eqx.tree_at(lambda v: (v.damping.linear, v.damping.quadratic), vehicle, damping)
    suspect = suspect_named(vehicle, "hull_lift", None)
    return vehicle.place(jm.Placed(place(suspect, vehicle, lift or {})))


def truth() -> jm.Vehicle:
    """The synthetic craft."""
    return craft(TRUE_LINEAR, TRUE_QUADRATIC, TRUE_LIFT)


def sticks(t: np.ndarray, ranges: Sequence[tuple[float, float]], rng: np.random.Generator) -> np.ndarray:
    """Each stick held for 2 to 6 s somewhere in its range, slewed within 0.3 s."""
    out = np.zeros((len(t), len(ranges)))
    for i, (low, high) in enumerate(ranges):
        at = 0
        while at < len(t):
            held = int(rng.uniform(2.0, 6.0) / DT)
            out[at : at + held, i] = rng.uniform(low, high)
            at += held
    return scipy.ndimage.uniform_filter1d(out, 3, axis=0, mode="nearest")


@dataclasses.dataclass(frozen=True)
class Run:
    """A log of commands, positions and attitudes, the true channels, and the motion found from the log."""

    log: jm.Log
    clean: Float[np.ndarray, "times 18"]
    motion: Kinematics


def recorded(vehicle: jm.Vehicle, name: str, length: float, test: bool, rng: np.random.Generator) -> Run:
    """A run of the craft under an operator, as an acoustic system sees it."""
    t = np.arange(0.0, length + DT / 2, DT)
    ahead, turn, vertical, slider = sticks(t, TEST_STICKS if test else STICKS, rng).T
    commands = np.clip(np.stack([ahead - turn, ahead + turn, vertical, slider], axis=1), -1.0, 1.0)
    blank = jm.Log(t, np.full((len(t), 18), np.nan), commands, None, vehicle.command_names, name)
    speed = TEST_SPEED if test else SPEED
    start = jm.initial_state(vehicle, velocity=(speed, 0, 0, 0, 0, 0))
    clean = np.asarray(jm.simulate(vehicle, blank, start).channels)
    stated = dict(vehicle.sensors)
    noise = np.repeat([stated["position"], stated["attitude"]], 3)
    channels = np.full_like(clean, np.nan)
    channels[:, :6] = clean[:, :6] + noise * rng.standard_normal((len(t), 6))
    log = dataclasses.replace(blank, channels=channels)
    return Run(log, clean, differentiate(log, vehicle.dof, noise_of(vehicle, [log])))


# --- identification ------------------------------------------------------------------------------


@eqx.filter_jit
def _lacking(vehicle: jm.Vehicle, t, commands, position, attitude, nu, nu_dot):
    plant = vehicle.plant()
    over, at = inputs(plant, t, commands, jnp.zeros((len(t), 6)))
    # A differentiated position knows the mean force about a sample, not the jump at it.
    before = jnp.concatenate([over.thrust[:1], over.thrust[:-1]])
    at = dataclasses.replace(at, thrust=0.5 * (before + over.thrust))
    states = jm.State(position, jax.vmap(from_euler)(attitude), nu, jnp.zeros((len(t), 0)))
    return jax.vmap(plant.balance)(states, nu_dot, at)


def lacking(vehicle: jm.Vehicle, run: Run) -> Float[np.ndarray, "times 6"]:
    """The wrench that the vehicle lacks for the motion found from the log: (7.3), with M, C, g, V and b."""
    motion = run.motion
    parts = (run.log.t, run.log.commands, motion.position, motion.attitude, motion.nu, motion.nu_dot)
    return np.asarray(_lacking(vehicle, *map(jnp.asarray, parts)))


def ridged(nu: np.ndarray, force: np.ndarray, ridge: float) -> Float[np.ndarray, "6 12"]:
    """Linear and quadratic damping that the force lacks, in the pattern of (7.5), with a ridge."""
    columns = np.concatenate([nu, np.abs(nu) * nu], axis=1)
    out = np.zeros((6, 12))
    for axis, there in enumerate(np.concatenate([PRINTED_LINEAR, PRINTED_QUADRATIC], axis=1) != 0):
        own = columns[:, there]
        size = np.maximum(np.sqrt((own**2).sum(axis=0)), 1e-12)  # an axis may be idle
        design = np.concatenate([own / size, np.sqrt(ridge) * np.eye(len(size))])
        right = np.concatenate([force[:, axis], np.zeros(len(size))])
        out[axis, there] = np.linalg.lstsq(design, right, rcond=None)[0] / size
    return out


def least_squares(nu: np.ndarray, force: np.ndarray, parts: np.ndarray) -> tuple[jm.Vehicle, float]:
    """The printed damping and what least squares add to its own numbers, and the ridge.

    It is the one that predicts the force on stretches of the training runs best that are left out, in shares
    of each axis' own spread.
    """
    columns, size = np.concatenate([nu, np.abs(nu) * nu], axis=1), np.sqrt((force**2).mean(axis=0))

    def left_out(ridge: float) -> float:
        errors = [
            columns[parts == part] @ ridged(nu[parts != part], force[parts != part], ridge).T
            - force[parts == part]
            for part in np.unique(parts)
        ]
        return float(((np.concatenate(errors) / size) ** 2).mean())

    ridge = min(RIDGES, key=left_out)
    found = ridged(nu, force, ridge)
    return craft(PRINTED_LINEAR - found[:, :6], PRINTED_QUADRATIC - found[:, 6:]), ridge


def alone(runs: Sequence[Run], parts: np.ndarray, seed: int) -> dict[str, jm.Vehicle]:
    """The whole damping (7.3) as six perceptrons, and as six radial-basis networks, with none beside."""
    bare = craft(np.zeros((6, 6)), np.zeros((6, 6)))
    nu = np.concatenate([run.motion.nu for run in runs])
    force = np.concatenate([lacking(bare, run) for run in runs])
    networks, _ = train_damping(jnp.asarray(nu), jnp.asarray(-force), jax.random.key(seed))
    terms = {
        PERCEPTRON: NetworkDamping(networks=networks, inputs=DOFS),
        ALONE: rbf_damping(DOFS, nu, force, parts),
    }
    return {name: bare.place(jm.Placed(term)) for name, term in terms.items()}


def trajectory_loss(vehicle: jm.Vehicle, runs: Sequence[Run], steps: int) -> jm.Fit:
    """The printed damping's own numbers, fitted to the positions and attitudes themselves."""
    return jm.fit(
        vehicle,
        [run.log for run in runs],
        lambda v: (v.damping.linear, v.damping.quadratic),
        entries="nonzero",
        prior=2.0,  # what is not excited stays near its start
        max_steps=steps,
        throw=False,
        noise=noise_of(vehicle, [run.log for run in runs]),
    )


def stretches(log: jm.Log) -> np.ndarray:
    """The stretch of about `STRETCH` seconds that each sample lies in."""
    return np.arange(len(log.t)) * max(2, round(log.duration / STRETCH)) // len(log.t)


def identified(
    runs: Sequence[Run], size: Size, seed: int
) -> tuple[dict[str, jm.Vehicle], RBFDamping, dict[str, Any]]:
    """The vehicles to be compared, the networks, and what their making tells."""
    printed = craft(PRINTED_LINEAR, PRINTED_QUADRATIC)
    nu = np.concatenate([run.motion.nu for run in runs])
    force = np.concatenate([lacking(printed, run) for run in runs])
    parts = np.concatenate([stretches(run.log) + 100 * k for k, run in enumerate(runs)])
    began = time.process_time()
    term = rbf_damping(DOFS, nu, force, parts)
    grown = time.process_time() - began
    fit = trajectory_loss(printed, runs, size.steps)
    squares, ridge = least_squares(nu, force, parts)
    others = {}
    if size.others:
        others = alone(runs, parts, seed)
        others[BY_WORST] = printed.place(jm.Placed(regrown(term, nu, force)))
        others[BY_SPREAD] = printed.place(jm.Placed(as_printed(nu, force, spread_width)))
    vehicles = {
        PRINTED: printed,
        **others,
        LS: squares,
        RBF: printed.place(jm.Placed(term)),
        AS_PRINTED: printed.place(jm.Placed(as_printed(nu, force, lambda _: SIGMA))),
        FIT: fit.vehicle,
        TRUE: truth(),
    }
    notes = {
        "rbf_choice_cpu_s": grown,
        "ridge": ridge,
        "rbf_width": np.asarray(term.width).tolist(),
        "rbf_reach": np.asarray(term.reach).tolist(),
        "rbf_centres": (np.asarray(term.weights) != 0).sum(axis=1).tolist(),
        "fit_result": fit.result,
        "fit_reduced_chi2": fit.reduced_chi2,
    }
    return vehicles, term, notes | five_hundred(nu, force)


def five_hundred(nu: np.ndarray, force: np.ndarray) -> dict[str, Any]:
    """Six networks grown to 500 centres (or all samples): time, and what raw inputs make of them.

    The rms of the relative residual on the samples that they were grown on, at 60 centres and at the end; and
    at 60 centres by the worst sample.
    """
    y = force / np.sqrt((force**2).mean(axis=0))
    out: dict[str, Any] = {}
    for name, x, width in (("scaled", nu / nu.std(axis=0), 2.0), ("raw", nu, SIGMA)):
        began = time.process_time()
        basis = basis_of(x, x, width)
        gram, right = basis.T @ basis + DECAY * np.eye(len(x)), basis.T @ y
        grown = [grow(gram, right[:, a], CENTRES) for a in range(6)]
        out[f"grow_{name}_cpu_s"] = time.process_time() - began
        out["grow_centres"] = len(grown[0].order)
        left = np.array([g.predicted(basis[:, g.order]) - y[:, [a]] for a, g in enumerate(grown)])
        rms = np.sqrt((left**2).mean(axis=(0, 1)))
        out[f"residual_{name}_60"], out[f"residual_{name}_all"] = float(rms[59]), float(rms[-1])
        worst = [by_worst_sample(y[:, a], 60, lambda own, b=basis: b[:, own]) for a in range(6)]
        left = np.array([basis[:, own] @ weights - y[:, a] for a, (own, weights) in enumerate(worst)])
        out[f"residual_{name}_worst_60"] = float(np.sqrt((left**2).mean()))
    return out


# --- growth by the worst sample (thesis, sec. 2.1.3) ------------------------------------------------


class Gaussians(WrenchEffect):
    """Networks of (2.1), one for each axis: nothing holds them to zero at rest or where nothing was seen."""

    name = "gaussians"
    units = {}

    centres: Float[Array, "axes units axes"]
    weights: Float[Array, "axes units"]
    width: Float[Array, " axes"]

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return ()

    def __call__(self, motion: Motion) -> Wrench:
        away = ((motion.nu_r[None, None] - self.centres) ** 2).sum(-1) / (2.0 * self.width[:, None] ** 2)
        return (self.weights * jnp.exp(-away)).sum(-1)


def by_worst_sample(
    y: Float[np.ndarray, " samples"], count: int, columns: Callable[[list[int]], np.ndarray]
) -> tuple[list[int], Float[np.ndarray, " count"]]:
    """Centres, each at the sample whose error was the worst, and their weights.

    - `columns`: the basis functions with centres at given samples, at all samples.

    No sample becomes a centre twice, or where kernels are wide the first would be taken again and again.
    """
    chosen, weights, error = list[int](), np.zeros(0), y
    for _ in range(count):
        size = np.abs(error)
        size[chosen] = -1.0
        chosen.append(int(np.argmax(size)))
        own = columns(chosen)
        weights = np.linalg.solve(own.T @ own + DECAY * np.eye(len(chosen)), own.T @ y)
        error = y - own @ weights
    return chosen, weights


def spread_width(centres: Float[np.ndarray, "centres axes"]) -> float:
    """(2.2); a single centre has no distance to another, and one m/s or rad/s stands for it."""
    apart = scipy.spatial.distance.pdist(centres).max() if len(centres) > 1 else 1.0
    return apart / np.sqrt(2.0 * len(centres))


def as_printed(
    nu: np.ndarray, force: np.ndarray, width: Callable[[Float[np.ndarray, "centres axes"]], float]
) -> Gaussians:
    """Six networks as the thesis grows them: raw velocities, as many centres; `width`: for given centres."""

    def kernels(own: list[int]) -> np.ndarray:
        away = scipy.spatial.distance.cdist(nu, nu[own], "sqeuclidean")
        return np.exp(-away / (2.0 * width(nu[own]) ** 2))

    size = np.sqrt((force**2).mean(axis=0))
    grown = [by_worst_sample(y, min(CENTRES, len(nu)), kernels) for y in (force / size).T]
    centres = np.array([nu[own] for own, _ in grown])
    return Gaussians(
        centres=jnp.asarray(centres),
        weights=jnp.asarray(size[:, None] * np.array([weights for _, weights in grown])),
        width=jnp.asarray([width(own) for own in centres]),
    )


def regrown(term: RBFDamping, nu: np.ndarray, force: np.ndarray) -> RBFDamping:
    """Networks of as many centres, as wide and with the same reach, but grown by the worst sample."""
    x, y = nu / np.asarray(term.input_scale), force / np.asarray(term.output_scale)
    centres, weights = np.zeros(term.centres.shape), np.zeros(term.weights.shape)
    for a, width in enumerate(np.asarray(term.width)):
        count = int((term.weights[a] != 0).sum())
        own, found = by_worst_sample(y[:, a], count, lambda own, h=width: basis_of(x, x[own], h))
        centres[a, :count], weights[a, :count] = x[own], found
    return eqx.tree_at(lambda t: (t.centres, t.weights), term, (jnp.asarray(centres), jnp.asarray(weights)))


# --- predictions ---------------------------------------------------------------------------------


def prediction(vehicle: jm.Vehicle, run: Run, begin: float) -> Float[np.ndarray, "times 18"]:
    """Open loop from the motion found at `begin` [s] on, for the horizon."""
    first = round(begin / DT)
    log = run.log.between(begin - DT / 2, begin + HORIZON + DT / 2)
    start = jm.initial_state(vehicle, *(a[first] for a in (run.motion.position, run.motion.attitude)))
    start = dataclasses.replace(start, velocity=jnp.asarray(run.motion.nu[first]))
    return np.asarray(jm.simulate(vehicle, log, start).channels)


def errors(vehicle: jm.Vehicle, runs: Sequence[Run], between: float) -> Float[np.ndarray, " times"]:
    """Root mean square distance [m] from where the craft was, over starts and runs, per sample."""
    squares = []
    for run in runs:
        for begin in np.arange(0.0, run.log.duration - HORIZON + DT / 2, between):
            path = prediction(vehicle, run, begin)[:, :3]
            first = round(begin / DT)
            squares.append(((path - run.clean[first : first + len(path), :3]) ** 2).sum(axis=1))
    return np.sqrt(np.mean(squares, axis=0))


def diagonal(nu: np.ndarray, force: np.ndarray) -> Float[np.ndarray, "2 6"]:
    """Linear and quadratic damping of each axis that fit the force on it best (thesis, sec. 7.2)."""
    out = np.zeros((2, 6))
    for a in range(6):
        columns = np.stack([nu[:, a], np.abs(nu[:, a]) * nu[:, a]], axis=1)
        out[:, a] = np.linalg.lstsq(columns, -force[:, a], rcond=None)[0]
    return out


def forces(term: RBFDamping, nu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Damping of (7.5) and of the networks beside it, at given velocities; and how well these are known."""

    def one(nu):
        still = jnp.zeros(3), jnp.eye(3)
        return term(Motion(*still, nu, nu, jnp.zeros(0), jnp.zeros(()), jnp.zeros(3)))

    own = -(nu @ PRINTED_LINEAR.T + (np.abs(nu) * nu) @ PRINTED_QUADRATIC.T)
    known = jax.vmap(term.known)(jnp.asarray(nu / np.asarray(term.input_scale)))
    return own + np.asarray(jax.vmap(one)(jnp.asarray(nu))), np.asarray(known)


@dataclasses.dataclass(frozen=True)
class Trial:
    """One seed: its runs, the vehicles, errors over the horizon, and numbers."""

    train: list[Run]
    test: Run
    vehicles: dict[str, jm.Vehicle]
    error: dict[str, dict[str, np.ndarray]]
    damping: Float[np.ndarray, "2 6"]
    numbers: dict[str, Any]


def trial(seed: int, size: Size) -> Trial:
    """Records, identifies and predicts with one seed."""
    rng, vehicle = np.random.default_rng(seed), truth()
    train = [recorded(vehicle, f"train {k}", size.train, False, rng) for k in (1, 2)]
    test = recorded(vehicle, "test", size.test, True, rng)
    vehicles, term, numbers = identified(train, size, seed)
    error = {
        what: {name: errors(v, runs, size.between) for name, v in vehicles.items()}
        for what, runs in (("train", train), ("test", [test]))
    }
    nu = np.concatenate([run.motion.nu for run in train])
    found = diagonal(nu, forces(term, nu)[0])
    at = {f"{h:g} s": round(h / DT) for h in (5.0, HORIZON)}
    numbers |= {
        "seed": seed,
        "error_m": {
            what: {
                name: {h: float(path[k]) if np.isfinite(path[k]) else None for h, k in at.items()}
                for name, path in paths.items()
            }
            for what, paths in error.items()
        },
        "velocity_error": np.sqrt(
            np.mean(np.concatenate([(r.motion.nu - r.clean[:, 6:12]) ** 2 for r in train]), axis=0)
        ).tolist(),
        "acceleration_error": np.sqrt(
            np.mean(np.concatenate([(r.motion.nu_dot - r.clean[:, 12:]) ** 2 for r in train]), axis=0)
        ).tolist(),
        "diagonal_linear": found[0].tolist(),
        "diagonal_quadratic": found[1].tolist(),
        "fastest": np.abs(nu).max(axis=0).tolist(),
        "test_samples_known": forces(term, test.clean[:, 6:12])[1].mean(axis=0).tolist(),
    }
    return Trial(train, test, vehicles, error, found, short(numbers))


# --- what is written -----------------------------------------------------------------------------


def told(values: Sequence[float]) -> str:
    """Median and range; or how many are no number, because a prediction ran away."""
    away = np.count_nonzero(~np.isfinite(values))
    if away:
        return f"ran away in {away} of {len(values)}"
    return spread(values, 3)


def gathered(results: Sequence[dict], what: str, name: str, horizon: str) -> list[float]:
    found = [r["error_m"][what][name][horizon] for r in results]
    return [np.inf if error is None else error for error in found]


def claims(results: Sequence[dict]) -> list[dict[str, Any]]:
    """`CLAIMS`, decided by pairs of the same seed; what ran away is worse than what did not."""
    return decided(
        {
            f"{words}, {RUNS[what]}, {horizon}": list(
                zip(*(gathered(results, what, name, horizon) for name in names), strict=True)
            )
            for words, names, what, horizons in CLAIMS
            for horizon in horizons
        }
    )


def bars(results: Sequence[dict]) -> dict[str, Any]:
    """What the thesis says of its figures, and the bars of this script, as numbers over seeds."""

    def ratio(what: str, horizon: str, name: str = RBF) -> list[float]:
        pairs = zip(
            gathered(results, what, name, horizon), gathered(results, what, PRINTED, horizon), strict=True
        )
        return [a / b for a, b in pairs]

    slope, bend = (np.array([r[f"diagonal_{part}"] for r in results]) for part in ("linear", "quadratic"))
    turns = np.where((slope > 0) & (bend < 0), -slope / np.where(bend < 0, bend, -1.0), np.inf).min(axis=0)
    return {
        "train_10_s_rbf_over_printed": ratio("train", "10 s"),
        "test_5_s_rbf_over_printed": ratio("test", "5 s"),
        "test_10_s_rbf_over_printed": ratio("test", "10 s"),
        "train_10_s_trajectory_loss_over_printed": ratio("train", "10 s", FIT),
        "test_10_s_trajectory_loss_over_printed": ratio("test", "10 s", FIT),
        "seeds_with_negative_damping_at_rest": dict(zip(DOFS, (slope < 0).sum(axis=0).tolist(), strict=True)),
        # Where damping that brakes about rest begins to drive [m/s, rad/s], the least of the seeds.
        "drives_from": {dof: float(speed) for dof, speed in zip(DOFS, turns, strict=True) if speed < np.inf},
        "least_eigenvalue_of_printed_linear": float(
            np.linalg.eigvalsh((PRINTED_LINEAR + PRINTED_LINEAR.T) / 2).min()
        ),
        "grow_cpu_s": [r["grow_scaled_cpu_s"] for r in results],
    }


def table(results: Sequence[dict]) -> str:
    """The errors of all models, and whose they are."""
    lines = [
        "| model | whose | training, 5 s | training, 10 s | test, 5 s | test, 10 s |",
        "|---|---|---|---|---|---|",
    ]
    for name in STYLES:
        if name in results[0]["error_m"]["test"]:
            cells = [told(gathered(results, w, name, h)) for w in ("train", "test") for h in ("5 s", "10 s")]
            lines.append(f"| {name} | {WHOSE[name]} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def markdown(results: Sequence[dict], decisions: list[dict[str, Any]]) -> str:
    """The errors of all models, the claims, and the bars beside what was found."""
    lines = [f"Position error [m], median over {len(results)} seeds (lowest to highest).", "", table(results)]
    if decisions:
        lines += [claim_table(decisions)]
    found = bars(results)
    negative = found["seeds_with_negative_damping_at_rest"]
    worst = {key: max(found[f"{key}_rbf_over_printed"]) for key in ("train_10_s", "test_5_s", "test_10_s")}
    lines += [
        "| thesis, sec. 7.2, and bars | found here |",
        "|---|---|",
        "| fig. 7.3: RBF predicts the training runs correctly up to 10 s; bar: a quarter of (7.5) | "
        f"worst seed {worst['train_10_s']:.3f} of the error of (7.5) |",
        "| fig. 7.4: not accurate on the test run, but better than (7.5); bar: half at 5 s | "
        f"worst seed {worst['test_5_s']:.3f} |",
        f"| bar: never worse at 10 s | worst seed {worst['test_10_s']:.3f} |",
        "| fig. 7.5: negative damping about rest in roll and pitch, others plausible | seeds with a "
        "negative slope at rest: " + ", ".join(f"{dof} {n}" for dof, n in negative.items()) + " |",
        "| 500 centres a network | chosen by left-out stretches: "
        + ", ".join(f"{dof} {told([r['rbf_centres'][a] for r in results])}" for a, dof in enumerate(DOFS))
        + " |",
        f"| six networks grown to {results[0]['grow_centres']} centres; bar: 10 s | "
        f"{told(found['grow_cpu_s'])} s of one core |",
        "| raw inputs, width sqrt(5): relative residual with 60 centres, with all | "
        f"{told([r['residual_raw_60'] for r in results])}, "
        f"{told([r['residual_raw_all'] for r in results])} |",
        "| scaled inputs, width 2: the same | "
        f"{told([r['residual_scaled_60'] for r in results])}, "
        f"{told([r['residual_scaled_all'] for r in results])} |",
        "| growth by the worst sample, 60 centres: raw inputs, width sqrt(5); scaled inputs, width 2 | "
        f"{told([r['residual_raw_worst_60'] for r in results])}, "
        f"{told([r['residual_scaled_worst_60'] for r in results])} |",
        "| (7.5): a damping matrix | least eigenvalue of its linear part's symmetric part "
        f"{found['least_eigenvalue_of_printed_linear']:.3f}: not dissipative |",
    ]
    return "\n".join(lines) + "\n"


def _saved(plot, out: Path, name: str, top: float = 1.0) -> None:
    plot.tight_layout(rect=(0.0, 0.0, 1.0, top))
    save_figure(plot, out / name)


def tracks(out: Path, name: str, runs: Sequence[Run], vehicles: dict[str, jm.Vehicle]) -> None:
    """Measured and predicted tracks in the horizontal plane, with a dot every second."""
    plot, axes = plt.subplots(1, len(runs), figsize=(5.5 * len(runs), 5.0), squeeze=False)
    every = round(1.0 / DT)
    for ax, run in zip(axes[0], runs, strict=True):
        count = round(HORIZON / DT) + 1
        seen = run.log.channels[:count]
        ax.plot(seen[:, 1], seen[:, 0], ":", color="k", lw=1.2, label="measured")
        ax.plot(seen[::every, 1], seen[::every, 0], ".", color="k")
        for model, vehicle in vehicles.items():
            color, style = STYLES[model]
            path = prediction(vehicle, run, 0.0)
            ax.plot(path[:, 1], path[:, 0], style, color=color, lw=1.2, label=model)
            ax.plot(path[::every, 1], path[::every, 0], ".", color=color)
        ax.set_title(f"{run.log.name}, first {HORIZON:g} s", fontsize=10)
        ax.set_xlabel("east (m)")
        ax.set_ylabel("north (m)")
        ax.set_aspect("equal", adjustable="datalim")
    axes[0, 0].legend(fontsize=8)
    _saved(plot, out, name)


def curves(out: Path, name: str, lines: dict[str, tuple[np.ndarray, str, str]], reach: np.ndarray) -> None:
    """Damping over the speed on each axis, from linear and quadratic parts [2, 6]."""
    plot, axes = plt.subplots(2, 3, figsize=(10.5, 5.6))
    for a, ax in enumerate(axes.flat):
        speed = np.linspace(-reach[a], reach[a], 101)
        for label, (parts, color, style) in lines.items():
            force = parts[0, a] * speed + parts[1, a] * np.abs(speed) * speed
            ax.plot(speed, force, style, color=color, lw=1.2, label=label)
        ax.axhline(0.0, color="0.8", lw=0.6, zorder=0)
        ax.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(5))
        ax.set_xlabel(f"{DOFS[a]} ({UNITS[a]})")
        ax.set_ylabel(f"damping {FORCES[a].replace('[', '(').replace(']', ')')}")
    plot.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper center", ncols=3, fontsize=8)
    _saved(plot, out, name, top=0.93)


def horizons(out: Path, trials: Sequence[Trial]) -> None:
    """Error over the horizon, median over seeds, training and test."""
    plot, axes = plt.subplots(1, 2, figsize=(10.0, 4.8), sharey=True)
    for ax, what in zip(axes, ("train", "test"), strict=True):
        for name in (name for name in STYLES if name in trials[0].vehicles):
            color, style = STYLES[name]
            # Where half of the predictions have run away, the line ends.
            paths = np.nan_to_num(np.array([t.error[what][name] for t in trials]), nan=np.inf)
            ax.semilogy(
                DT * np.arange(paths.shape[1]), np.median(paths, axis=0), style, color=color, label=name
            )
        ax.set_title({"train": "training runs", "test": "test run"}[what], fontsize=10)
        ax.set_xlabel("time since the start of the prediction (s)")
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("position error (m)")
    plot.legend(*axes[0].get_legend_handles_labels(), loc="upper center", ncols=3, fontsize=8)
    _saved(plot, out, "error_over_horizon", top=0.83)


def figures(out: Path, trials: Sequence[Trial]) -> None:
    """Figures 7.2 to 7.6 of the first seed, and the errors of all."""
    first = trials[0]
    both = {name: first.vehicles[name] for name in (PRINTED, AS_PRINTED, RBF, FIT)}
    tracks(out, "figure_7_2", first.train, {PRINTED: first.vehicles[PRINTED]})
    tracks(out, "figure_7_3", first.train, both)
    tracks(out, "figure_7_4", [first.test], both)
    reach = np.abs(np.concatenate([run.clean[:, 6:12] for run in first.train])).max(axis=0)
    nu = np.concatenate([run.clean[:, 6:12] for run in first.train])
    lift = np.asarray(jax.vmap(_lift)(jnp.asarray(nu)))
    true = lift - (nu @ TRUE_LINEAR.T + (np.abs(nu) * nu) @ TRUE_QUADRATIC.T)
    exact = (diagonal(nu, true), "0.6", "-")
    # More are not told apart.
    found = {
        f"networks, seed {t.numbers['seed']}": (t.damping, f"C{k}", "--") for k, t in enumerate(trials[:5])
    }
    curves(out, "figure_7_5", {"truth, same extraction": exact} | found, reach)
    printed = np.stack([np.diag(PRINTED_LINEAR), np.diag(PRINTED_QUADRATIC)])
    curves(out, "figure_7_6", {"truth, same extraction": exact, PRINTED: (printed, *STYLES[PRINTED])}, reach)
    horizons(out, trials)


def _lift(nu):
    still = jnp.zeros(3), jnp.eye(3)
    motion = Motion(*still, nu, nu, jnp.zeros(0), jnp.zeros(()), jnp.zeros(3))
    effect: Any = truth().placed[0].effect
    return effect(motion)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, tables and figures.")],
    seeds: Annotated[int, typer.Option(help="How many seeds, from 0 on.")] = 12,
    quick: Annotated[
        bool, typer.Option("--quick", help="One seed, short runs, few steps of the fit.")
    ] = False,
) -> None:
    """Damping of the Minesniper from acoustic positions (thesis, ch. 7)."""
    with study(out, quick):
        trials = []
        with Progress() as progress:
            for seed in progress.track(range(1 if quick else seeds), description="seeds"):
                trials.append(trial(seed, QUICK if quick else Size()))
                results = [t.numbers for t in trials]
                decisions = [] if quick else claims(results)
                report = {"quick": quick, "claims": decisions, "bars": short(bars(results)), "seeds": results}
                write_results(out, report, markdown(results, decisions))
        jm.save_vehicle(trials[0].vehicles[RBF], out / "minesniper_rbf.toml")
        figures(out, trials)


if __name__ == "__main__":
    typer.run(main)
