"""The thesis' control study: Tethra on a spiral dive by feedforward, and with feedback (sec. 5.3, ch. 3).

usage: python -m experiments.tethra_control --out DIR [--seeds 12] [--quick]

Case I identifies from ideal data, case II from noisy data. Case III mounts a 60 kg sonar under way, which
changes the damping, and learns it while the craft dives. The last table has feedback too, in current and
noise. Writes results.json, results.md and figures 5.7 to 5.13.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

import jaxmarine as jm
from experiments._study import claim_table, decided, save_figure, study, write_results
from experiments.thesis import plant
from jaxmarine import control
from jaxmarine._types import DOFS
from jaxmarine.effects import Payload, SteadyCurrent
from jaxmarine.networks import mlp_damping

HERE = Path(__file__).parent / "tethra" / "control"
DT = plant.DT
# The text's depths, 0.3 m to 2 m; the caption of fig. 5.7 says 1.5 m to 3.5 m. Nothing in the model depends
# on depth. Radius, speed and length are not stated: four turns within the pool.
RADIUS, SPEED, DEPTHS, RAMP = 2.0, 0.3, (0.3, 2.0), 10.0  # [m], [m/s], [m], [s]

# What a fit starts from: mass 20 % and inertia 30 % too large, damping 30 % to 50 % too small.
GUESS_MASS = np.diag([277.0, 277.0, 277.0, 68.0, 65.0, 69.0])
GUESS_LINEAR = np.diag([80.0, 80.0, 80.0, 15.0, 15.0, 15.0])
GUESS_QUADRATIC = np.diag([60.0, 60.0, 60.0, 15.0, 15.0, 15.0])

# Deviations by which a fit weighs what is measured: attitude exact but for rounding, velocities off by
# up to 0.1 % of some 0.3 m/s, accelerations by up to 0.5 m/s² and 0.05 rad/s² (sec. 5.3.1, uniform).
NOISE = np.array([np.nan] * 3 + [1e-4] * 3 + [1.7e-4] * 3 + [1e-4] * 3 + [0.29] * 3 + [0.029] * 3)
# For acceleration ML from noisy logs, which takes slopes of the velocities instead: off by some 1e-3 m/s².
SLOPES = np.where(np.arange(len(NOISE)) < 12, NOISE, np.nan)
WIDTH = 3.0  # of the prior of a weight, whose inputs and outputs are scaled
# Windows with an initial state of their own [s]: of the log that is identified from, and under way.
STRETCH, PIECE = 10.0, 2.5

# Case III. A torpedo below the frame, neutral in water: 60 kg that displace their own weight.
SONAR = {"mass": 60.0, "volume": 60.0 / 1025.0, "x": 0.1, "y": 0.0, "z": 0.1}
# By how much it multiplies damping per axis ("parameters changing up to a factor 10").
DRAG = np.array([3.0, 10.0, 10.0, 2.0, 6.0, 6.0])
EVERY = 5.0  # [s] between updates
SETTLED = 30.0  # [s] after the change from which the velocity is judged

# Feedback: as stiff as leaves two samples' delay harmless; in a current that nobody told the controller of.
FREQUENCY, CURRENT = 1.0, 0.1  # [rad/s], [m/s]


@dataclasses.dataclass(frozen=True)
class Size:
    """How much of everything: data to identify from [s], the network's hidden units, the dive [s] and when
    the sonar is mounted [s]."""

    data: float
    network_data: float
    hidden: int
    dive: float
    change: float


FULL = Size(data=1000.0, network_data=400.0, hidden=8, dive=180.0, change=60.0)
QUICK = Size(data=30.0, network_data=30.0, hidden=2, dive=45.0, change=10.0)

# All are ours, the last a perceptron beside guessed damping, with the grey box's mass, by trajectories.
# The thesis' own networks are in `tethra_networks`.
ML, TRAJECTORY, NETWORK = "grey box, acceleration ML", "grey box, trajectory loss", "perceptron beside"
MEASURED = "grey box, ML of measured accelerations"
# The thesis' control law (5.26) with models of its own, fig. 5.8.
THESIS = ("exact model", "all parameters +10 %", "exact model, four thrusters")
BARE = "PD and restoring forces"
KEPT = ("rms_m", "max_m", "velocity_rms")  # of each seed
# Case, the model whose error is to be lower, the one it is compared with, and which error.
CLAIMS = (
    *(
        (
            f"thesis, by models of ours: updates bring the craft nearer, {name}",
            *("II", f"{name}, updated under way", name, "rms_m"),
        )
        for name in (ML, NETWORK)
    ),
    *(
        (f"thesis, by models of ours: {words}, {name}", case, f"{name}, learning", f"{name}, stale", error)
        for words, case, error in (
            ("learning lowers the velocity error", "III, late", "velocity_rms"),
            ("learning brings the craft nearer", "III", "rms_m"),
        )
        for name in (TRAJECTORY, NETWORK)
    ),
    *(
        (
            f"thesis (8.1), by models of ours: beside PD a model gains on restoring forces alone, {name}",
            *("augmented", f"PD and {name}", BARE, "rms_m"),
        )
        for name in (ML, TRAJECTORY, NETWORK)
    ),
    ("ours: the trajectory loss is better than acceleration ML", "II", TRAJECTORY, ML, "rms_m"),
    ("ours: ML of slopes is better than of measured accelerations", "II", ML, MEASURED, "rms_m"),
    ("ours: the perceptron is better than the grey box", "II", NETWORK, TRAJECTORY, "rms_m"),
    (
        "ours: the perceptron is better than the grey box",
        *("III, late", f"{NETWORK}, learning", f"{TRAJECTORY}, learning", "velocity_rms"),
    ),
    (
        "ours: the perceptron is better than the grey box",
        *("augmented", f"PD and {NETWORK}", f"PD and {TRAJECTORY}", "rms_m"),
    ),
)
Errors = dict[str, Any]


# --- vehicles -------------------------------------------------------------------------------------


def tethra(hidden: int) -> jm.Vehicle:
    """The plant, with places for the sonar and for a network of damping, neither of which does anything yet.

    As every model has both, with a network or without, the same programs serve them all.
    """
    craft, one = plant.tethra(), np.ones(len(DOFS))
    untrained = mlp_damping(DOFS, one, one, jax.random.key(0), width=hidden)
    return craft.place(jm.Placed(Payload.neutral(craft)), jm.Placed(untrained))


def _sonar(vehicle: jm.Vehicle) -> Any:
    return vehicle.placed[-2].effect


def _term(vehicle: jm.Vehicle) -> Any:
    return vehicle.placed[-1].effect


def mounted(vehicle: jm.Vehicle) -> jm.Vehicle:
    """With the sonar's mass and displacement, which the controller is told of; damping as before."""
    return eqx.tree_at(_sonar, vehicle, Payload(**{name: jnp.asarray(x, float) for name, x in SONAR.items()}))


def dragging(vehicle: jm.Vehicle) -> jm.Vehicle:
    """With the sonar's damping, which nobody is told of: coupling grows with what it couples."""
    root = np.sqrt(np.outer(DRAG, DRAG))
    return eqx.tree_at(
        lambda v: (v.damping.linear, v.damping.quadratic),
        vehicle,
        (root * vehicle.damping.linear, DRAG[:, None] * vehicle.damping.quadratic),
    )


def dynamics(vehicle: jm.Vehicle) -> Any:
    """What is identified: mass (C follows from it), linear and quadratic damping."""
    return vehicle.added_mass, vehicle.damping.linear, vehicle.damping.quadratic


def drag(vehicle: jm.Vehicle) -> Any:
    """What is learned under way."""
    return vehicle.damping.linear, vehicle.damping.quadratic


def guess(vehicle: jm.Vehicle) -> jm.Vehicle:
    """The craft as known before any data: rough mass and damping, without any coupling."""
    values = (GUESS_MASS - np.asarray(vehicle.body.matrix), GUESS_LINEAR, GUESS_QUADRATIC)
    return eqx.tree_at(dynamics, vehicle, tuple(jnp.asarray(value) for value in values))


def enlarged(vehicle: jm.Vehicle, share: float) -> jm.Vehicle:
    """All parameters of M, C and D larger by a share, as in fig. 5.8."""
    added = (1 + share) * vehicle.mass_matrix - vehicle.body.matrix
    rest = [(1 + share) * matrix for matrix in dynamics(vehicle)[1:]]
    return eqx.tree_at(dynamics, vehicle, (added, *rest))


# --- identification -------------------------------------------------------------------------------

_SIZE = np.diag(GUESS_LINEAR)


def grey_box(
    start: jm.Vehicle,
    log: jm.Log,
    loss: Literal["trajectory", "one_step"],
    noise: Float[np.ndarray, "18"] = NOISE,
) -> jm.Vehicle:
    """M, all of D_l and the diagonal of D_q, by trajectories or by maximum likelihood of accelerations."""
    anything = np.full((6, 6), np.inf)
    prior = (anything, anything, np.where(np.eye(6) > 0, np.inf, 0.0))
    fit = jm.fit(start, log, dynamics, loss=loss, prior=prior, window=STRETCH, noise=noise, throw=False)
    return fit.vehicle


def weights(vehicle: jm.Vehicle) -> Any:
    """The weights of the damping network."""
    layers = _term(vehicle).network.layers
    return [layer.weight for layer in layers], [layer.bias for layer in layers[:-1]]


def network(mass: jm.Vehicle, start: jm.Vehicle, log: jm.Log, hidden: int, seed: int) -> jm.Vehicle:
    """The mass of one vehicle with the damping of the start, and a network that learns what that lacks."""
    speed = np.abs(log.channels[:, 6:12]).max(axis=0)
    force = np.diag(GUESS_LINEAR) * speed
    term = mlp_damping(DOFS, speed, force, jax.random.key(seed), width=hidden)
    begun = eqx.tree_at(lambda v: (v.added_mass, _term(v)), start, (mass.added_mass, term))
    prior = jax.tree.map(lambda w: np.full(w.shape, WIDTH), weights(begun))
    return jm.fit(
        begun, log, weights, prior=prior, window=STRETCH, noise=NOISE, max_steps=40, throw=False
    ).vehicle


def identified(
    truth: jm.Vehicle, log: jm.Log, noise: Float[np.ndarray, "18"], size: Size, seed: int
) -> dict[str, jm.Vehicle]:
    """The models of a log, which is of the true craft; `noise` says what accelerations are taken from."""
    ml = grey_box(guess(truth), log, "one_step", noise)
    trajectory = grey_box(ml, log, "trajectory")
    short = log.between(log.t[0], log.t[0] + size.network_data)
    net = network(trajectory, guess(truth), short, size.hidden, seed)
    return {ML: ml, TRAJECTORY: trajectory, NETWORK: net}


# Learns linear and quadratic damping, also beside a network, which stays as it was identified. Damping may
# grow to several times its size; coupling is held closer to what is known.
LEARNER = control.Learner(
    drag,
    (np.sqrt(np.outer(_SIZE, _SIZE)) * np.where(np.eye(6) > 0, 5.0, 1.0), 5.0 * GUESS_QUADRATIC),
    NOISE,
    piece=PIECE,
)


# --- runs -----------------------------------------------------------------------------------------


def dive(size: Size) -> control.Path:
    """The spiral of fig. 5.7."""
    return control.spiral(RADIUS, SPEED, DEPTHS, size.dive, RAMP)


def times(path: control.Path) -> Float[np.ndarray, " times"]:
    return np.arange(round(path.duration / DT)) * DT


def at_rest(reference: control.Reference) -> jm.State:
    """The state in which the reference begins."""
    return jax.tree.map(lambda a: np.asarray(a)[0], reference.states)


def wrench_for(model: jm.Vehicle, path: control.Path, t: Float[np.ndarray, " times"]) -> Array:
    """Feedforward for holds that begin at t."""
    return control.feedforward(model, path.at(t + DT / 2))


def followed(truth: jm.Vehicle, model: jm.Vehicle, path: control.Path) -> control.Run:
    """The craft on the path, by the model's feedforward alone."""
    t = times(path)
    reference = path.at(t)
    return control.follow(truth, reference, wrench_for(model, path, t), at_rest(reference))


def through_thrusters(truth: jm.Vehicle, path: control.Path) -> jm.Trajectory:
    """The same with the exact model through the four thrusters: delay, lag, no thrust in sway and pitch."""
    t = times(path)
    reference = path.at(t)
    commands = jm.allocate(truth, wrench_for(truth, path, t), plant.STICKS)
    log = jm.Log(t, np.full((len(t), 18), np.nan), np.asarray(commands), None, truth.thruster_names, "dive")
    return jm.simulate(truth, log, at_rest(reference))


def measured(run: control.Run, craft: jm.Vehicle, seed: int) -> jm.Log:
    """A run as the text's sensors show it."""
    t = np.asarray(run.trajectory.t)
    log = jm.Log(
        t, np.array(run.trajectory.channels), None, np.array(run.wrench), craft.thruster_names, "dive"
    )
    return plant.noisy(log, "text", seed)


@dataclasses.dataclass(frozen=True)
class Dive:
    """A dive under learning: what the craft did, and the verdict on each update."""

    trajectory: jm.Trajectory
    verdicts: tuple[str, ...]


def learning(
    truth: jm.Vehicle,
    model: jm.Vehicle,
    learner: control.Learner | None,
    path: control.Path,
    change: float,
    seed: int,
) -> Dive:
    """The dive in stretches, with the sonar mounted at `change` [s]; without a learner the model is stale.

    Mass and displacement of the sonar are known from the change on, and what was learned about the craft
    before it is kept as the prior, while the window begins anew.
    """
    known = control.Learned(model)
    state = at_rest(path.at(np.zeros(1)))
    count = round(EVERY / DT)
    parts, verdicts = [], []
    for k in range(round(path.duration / EVERY)):
        t = (k * count + np.arange(count + 1)) * DT
        if abs(t[0] - change) < DT / 2:
            truth = dragging(mounted(truth))
            known = control.Learned(mounted(known.vehicle))
        run = control.follow(truth, path.at(t), wrench_for(known.vehicle, path, t), state)
        run = jax.tree.map(np.asarray, run)
        state = jax.tree.map(lambda a: a[-1], run.trajectory.states)
        run = jax.tree.map(lambda a: a[:-1], run)
        parts.append(run.trajectory)
        if learner is not None:
            ahead = np.asarray(path.at(t + EVERY).states.velocity)
            known = learner.update(known, measured(run, truth, 1000 * seed + k), ahead)
            verdicts.append(known.verdict)
    return Dive(jax.tree.map(lambda *a: np.concatenate(a), *parts), tuple(verdicts))


# --- errors ---------------------------------------------------------------------------------------


def errors(trajectory: jm.Trajectory, path: control.Path, since: float = 0.0) -> Errors:
    """(5.27) and (5.28) per axis [m], and the rms of the velocity error's length [m/s], from a time on."""
    t = np.asarray(trajectory.t)
    later = t >= since - DT / 2
    reference = path.at(t)
    off = np.asarray(trajectory.states.position - reference.states.position)[later]
    slip = np.asarray(trajectory.states.velocity - reference.states.velocity)[later]
    return {
        "rms_m": np.sqrt((off**2).mean(axis=0)).tolist(),
        "max_m": np.abs(off).max(axis=0).tolist(),
        "velocity_rms": float(np.sqrt((slip[:, :3] ** 2).sum(axis=1).mean())),
    }


# --- cases ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Cases:
    """What the cases share, and what they find: `rows` of errors, and the first seed's dives to draw."""

    truth: jm.Vehicle
    path: control.Path
    size: Size
    rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    drawn: dict[tuple[str, str], jm.Trajectory] = dataclasses.field(default_factory=dict)

    def note(self, case: str, model: str, seed: int, trajectory: jm.Trajectory, **more: Any) -> None:
        row = {"case": case, "model": model, "seed": seed}
        self.rows.append(row | errors(trajectory, self.path) | more)
        if seed == 0:
            self.drawn[case, model] = trajectory

    def note_learning(self, case: str, model: str, seed: int, run: Dive) -> None:
        """With how many updates were taken or not, and why; a window that is not full offers none."""
        offered = [verdict for verdict in run.verdicts if not verdict.startswith("the window")]
        self.note(case, model, seed, run.trajectory, updates=Counter(offered))


def ideal(cases: Cases) -> None:
    """Case I: the exact model, one that is 10 % off, and models identified from ideal data."""
    truth, size = cases.truth, cases.size
    log = plant.dive(truth, size.data, 0)
    known = {"exact model": truth, "all parameters +10 %": enlarged(truth, 0.1)}
    for name, model in (known | identified(truth, log, NOISE, size, 0)).items():
        cases.note("I", name, 0, followed(truth, model, cases.path).trajectory)
    cases.note("I", "exact model, four thrusters", 0, through_thrusters(truth, cases.path))
    reference = cases.path.at(times(cases.path))
    early = control.follow(truth, reference, control.feedforward(truth, reference), at_rest(reference))
    cases.note("I", "exact model, read as a hold begins", 0, early.trajectory)


def noisy(cases: Cases, seed: int) -> dict[str, jm.Vehicle]:
    """Case II: models identified from the text's noise, as they are and updated under way."""
    truth, size = cases.truth, cases.size
    log = plant.noisy(plant.dive(truth, size.data, seed), "text", seed)
    models = identified(truth, log, SLOPES, size, seed)
    measured_ml = grey_box(guess(truth), log, "one_step", NOISE)
    for name, model in ({MEASURED: measured_ml} | models).items():
        cases.note("II", name, seed, followed(truth, model, cases.path).trajectory)
    for name in (ML, NETWORK):
        run = learning(truth, models[name], LEARNER, cases.path, np.inf, seed)
        cases.note_learning("II", f"{name}, updated under way", seed, run)
    return models


def changed(cases: Cases, models: dict[str, jm.Vehicle], seed: int) -> None:
    """Case III: the sonar, with a model whose damping is stale and with one that learns."""
    change = cases.size.change
    for name in (TRAJECTORY, NETWORK):
        for learner, words in ((None, "stale"), (LEARNER, "learning")):
            run = learning(cases.truth, models[name], learner, cases.path, change, seed)
            cases.note_learning("III", f"{name}, {words}", seed, run)
            late = errors(run.trajectory, cases.path, change + SETTLED)
            cases.rows.append({"case": "III, late", "model": f"{name}, {words}", "seed": seed, **late})


def augmented(cases: Cases, models: dict[str, jm.Vehicle], seed: int) -> None:
    """Feedback with and without feedforward, in a current from a random direction and realistic noise."""
    rng = np.random.default_rng([seed, 3])
    towards, t = rng.uniform(0.0, 2 * np.pi), times(cases.path)
    flow = [CURRENT * np.cos(towards), CURRENT * np.sin(towards), 0.0]
    truth = cases.truth.place(jm.Placed(SteadyCurrent(*map(jnp.asarray, flow))))
    noise = np.repeat([plant.REALISTIC[kind] for kind in ("position", "attitude", "velocity", "rate")], 3)
    seen = jnp.asarray(noise * rng.standard_normal((len(t), 12)))
    feedback = control.pole_placement(guess(cases.truth).mass_matrix, FREQUENCY)
    reference = cases.path.at(t)
    halfway = cases.path.at(t + DT / 2)
    still = eqx.tree_at(lambda r: (r.states.velocity, r.acceleration), halfway, replace_fn=jnp.zeros_like)
    wrenches = {
        "PD": jnp.zeros((len(t), 6)),
        BARE: control.feedforward(cases.truth, still),
        **{f"PD and {name}": control.feedforward(models[name], halfway) for name in models},
        "PD and exact model": control.feedforward(cases.truth, halfway),
    }
    for name, wrench in wrenches.items():
        run = control.follow(truth, reference, wrench, at_rest(reference), feedback, seen)
        cases.note("augmented", name, seed, run.trajectory)


# --- what is written ------------------------------------------------------------------------------


def kept(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per case and model the errors of each seed, to four digits, of which all tables are made."""
    out = []
    for case, model in dict.fromkeys((row["case"], row["model"]) for row in rows):
        own = [row for row in rows if (row["case"], row["model"]) == (case, model)]
        one = {name: jax.tree.map(lambda x: float(f"{x:.4g}"), [row[name] for row in own]) for name in KEPT}
        if own[0].get("updates"):
            one["updates"] = [dict(row["updates"]) for row in own]
        out.append({"case": case, "model": model} | one)
    return out


def targets(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What was to be reached, by the worst seed."""
    found = {(run["case"], run["model"]): run for run in runs}

    def worst(case: str, model: str, name: str) -> float:
        return float(np.max(found[case, model][name]))

    new, old = (
        np.array(found["III, late", f"{NETWORK}, {words}"]["velocity_rms"]) for words in ("learning", "stale")
    )
    late = worst("III, late", f"{TRAJECTORY}, learning", "velocity_rms")
    out = [
        ("case I, grey box, rms [m]", worst("I", TRAJECTORY, "rms_m"), 1e-3),
        ("case II, trajectory loss, rms [m]", worst("II", TRAJECTORY, "rms_m"), 1e-2),
        ("case II, acceleration ML, rms [m]", worst("II", ML, "rms_m"), 0.3),
        ("case III, grey box, velocity from 30 s on [m/s]", late, 1e-3),
        ("case III, network, velocity as a share of the stale one's", float((new / old).max()), 0.2),
    ]
    return [{"target": words, "value": value, "bound": bound} for words, value, bound in out]


def claims(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each claim over seeds; positions count by the length of their rms."""
    found = {(run["case"], run["model"]): run for run in runs}

    def size(case: str, model: str, error: str) -> list[float]:
        each = np.array(found[case, model][error])
        return np.linalg.norm(each.reshape(len(each), -1), axis=1).tolist()

    return decided(
        {
            f"{words} (case {case})" if case != "augmented" else f"{words} (augmented)": list(
                zip(size(case, better, error), size(case, worse, error), strict=True)
            )
            for words, case, better, worse, error in CLAIMS
        }
    )


def counted(runs: list[dict[str, Any]]) -> Counter[str]:
    """How many updates were taken, and why others were not."""
    return sum((Counter(one) for run in runs for one in run.get("updates", ())), Counter())


def markdown(runs: list[dict[str, Any]]) -> str:
    """Errors per case as medians over seeds, what was to be reached, and the claims."""
    lines = [
        "| case | model | whose | rms x, y, z m | largest x, y, z m | velocity m/s | worst rms m |",
        "|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        cells = [
            run["case"],
            run["model"],
            "thesis" if run["model"] in THESIS else "ours",
            _three(np.median(run["rms_m"], axis=0)),
            _three(np.median(run["max_m"], axis=0)),
            f"{np.median(run['velocity_rms']):.2g}",
            f"{np.max(run['rms_m']):.2g}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| to be reached, by the worst seed | value | at most | met |", "|---|---|---|---|"]
    for row in targets(runs):
        met = "yes" if row["value"] <= row["bound"] else "no"
        lines.append(f"| {row['target']} | {row['value']:.2g} | {row['bound']:g} | {met} |")
    told = ", ".join(f"{count} {verdict}" for verdict, count in counted(runs).most_common())
    return "\n".join([*lines, "", f"Updates under way: {told}.", "", claim_table(claims(runs))])


def _three(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.2g}" for value in values)


FIGURES = {
    "5.7": ("Reference", []),
    "5.8": (
        "Exact model, and all parameters 10 % larger",
        [("I", "exact model"), ("I", "all parameters +10 %")],
    ),
    "5.9": ("Case I: identified from ideal data", [("I", ML), ("I", NETWORK), ("I", TRAJECTORY)]),
    "5.10": ("Case II: identified from noisy data", [("II", ML), ("II", NETWORK), ("II", TRAJECTORY)]),
    "5.11": (
        "Case II: updated under way",
        [("II", f"{ML}, updated under way"), ("II", f"{NETWORK}, updated under way")],
    ),
    "5.12": (
        "Case III: damping changed, stale",
        [("III", f"{TRAJECTORY}, stale"), ("III", f"{NETWORK}, stale")],
    ),
    "5.13": (
        "Case III: damping changed, learning",
        [("III", f"{TRAJECTORY}, learning"), ("III", f"{NETWORK}, learning")],
    ),
}
# Each with gaps of its own, through which one that it covers can be seen.
STYLES = tuple(
    {"color": colour, "ls": dashes}
    for colour, dashes in zip(
        ("#1f6fb5", "#c2620a", "#3c8d40", "#8a4fb0", "#7d8590", "#b03a48"),
        ("-", (0, (6, 2)), (0, (2, 2)), (0, (6, 2, 2, 2)), (0, (4, 4)), (0, (1, 3))),
        strict=True,
    )
)


def figures(cases: Cases, out: Path) -> None:
    """Figures 5.7 to 5.13, the velocity errors of case III, and the position errors with feedback."""
    for number, (title, wanted) in FIGURES.items():
        save_figure(_two_views(cases, title, wanted), out / f"figure_{number.replace('.', '_')}")
    t = times(cases.path)
    reference = cases.path.at(t)
    for case, name, title, unit in (
        ("III", "case_iii_velocity", "Case III: velocity error", "m/s"),
        ("augmented", "augmented", "With feedback: position error", "m"),
    ):
        figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
        keys = [key for key in cases.drawn if key[0] == case]
        for style, key in zip(STYLES, keys, strict=False):
            states = cases.drawn[key].states
            off = (
                states.velocity[:, :3] - reference.states.velocity[:, :3]
                if case == "III"
                else states.position - reference.states.position
            )
            ax.semilogy(t[1:], np.linalg.norm(off, axis=1)[1:], **style, lw=1.5, label=key[1])
        if case == "III":
            ax.axvline(cases.size.change, color="black", ls=":", lw=1, label="sonar mounted")
        ax.set(title=title, xlabel="time [s]", ylabel=f"length of the error [{unit}]")
        ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        save_figure(figure, out / name)


def _two_views(cases: Cases, title: str, keys: list[tuple[str, str]]) -> Figure:
    """Horizontal projection and depth over time, the reference as a broad band beneath."""
    figure, (plan, depth) = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
    t = times(cases.path)
    wanted = np.asarray(cases.path.at(t).states.position)
    plan.plot(wanted[:, 1], wanted[:, 0], color="0.8", lw=5)
    depth.plot(t, wanted[:, 2], color="0.8", lw=5, label="reference")
    for style, key in zip(STYLES, keys, strict=False):
        position = np.asarray(cases.drawn[key].states.position)
        plan.plot(position[:, 1], position[:, 0], **style, lw=1.4)
        depth.plot(t, position[:, 2], **style, lw=1.4, label=key[1])
    plan.set(xlabel="y, east [m]", ylabel="x, north [m]", aspect="equal")
    depth.set(xlabel="time [s]", ylabel="depth [m]")
    depth.invert_yaxis()
    depth.legend(frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def write(cases: Cases, out: Path) -> None:
    """Numbers, tables and figures of what there is so far."""
    runs = kept(cases.rows)
    write_results(out, {"runs": runs, "claims": claims(runs)}, markdown(runs))
    figures(cases, out)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and figures.")],
    seeds: Annotated[int, typer.Option(min=1, help="Operators and noises of the cases with noise.")] = 12,
    quick: Annotated[
        bool, typer.Option(help="A minute of data, a short dive, two hidden units, one seed.")
    ] = False,
) -> None:
    """Tethra on a spiral dive: by feedforward, learning under way, and with feedback."""
    size = QUICK if quick else FULL
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    with study(out, quick), bar:
        task = bar.add_task("case I")
        cases = Cases(tethra(size.hidden), dive(size), size)
        ideal(cases)
        for seed in range(1 if quick else seeds):
            bar.update(task, description=f"cases II and III, seed {seed}")
            models = noisy(cases, seed)
            changed(cases, models, seed)
            augmented(cases, models, seed)
            write(cases, out)
    console.print((out / "results.md").read_text(encoding="utf-8"), markup=False, soft_wrap=True)


if __name__ == "__main__":
    typer.run(main)
