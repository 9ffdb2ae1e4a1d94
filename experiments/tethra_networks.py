"""Cases I to III of the thesis with its own networks, in a vehicle (thesis, sec. 5.3).

usage: python -m experiments.tethra_networks --out DIR [--seeds N] [--quick]

Six networks learn the acceleration, the mass is read from them, six more learn the damping; all of it is then
a vehicle, whose feedforward steers the spiral dive of `tethra_control`. As printed, and with what mends it:
an intercept and symmetry for the mass, networks that brake at every velocity. In case III a sonar is mounted
under way that multiplies the damping. Networks as printed and those that brake learn all of their weights
online in cases II and III, the latter in case III with feedback too. What a seed has given lies in
`DIR/parts`, so that a run that was cut goes on where it was.
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Array, Float
from rich.progress import Progress

import jaxmarine as jm
from experiments import tethra_control as study_of_control
from experiments._study import claim_table, decided, short, spread, study, write_results
from experiments.tethra_control import DT, at_rest, dragging, errors, guess, measured, mounted, wrench_for
from experiments.thesis import plant
from jaxmarine import control
from jaxmarine.effects import Payload
from jaxmarine.fitting import damping_targets, fit_samples, identify_by_networks
from jaxmarine.fitting._subnets import Form, mass_of, train_acceleration
from jaxmarine.networks import NetworkDamping

HERE = Path(__file__).parent / "tethra" / "networks"
# The method as printed, and mended: whether the mass has an intercept and is symmetric, the damping's form.
WAYS: dict[str, tuple[bool, bool, Form]] = {
    "networks as printed": (False, False, "free"),
    "networks, mass with intercept, symmetric": (True, True, "free"),
    "the same, damping that brakes": (True, True, "dissipative"),
}
PLAIN, MENDED, BRAKING = WAYS
WINDOW, JUDGED = 15.0, 5.0  # [s] that an update learns from, and that judge it
THINNED = 4  # one of so many samples trains the networks that brake
REHEARSED = 200  # velocities of the first log at which an update keeps what was known
SHARE = 0.3  # their weight
# Tables 5.3 to 5.5, rms per axis [m]; case I, and case II online, from the text ("less than a millimeter").
PRINTED = {
    ("I", "networks as printed"): (0.001, 0.001, 0.001),
    ("II", "networks as printed"): (0.29, 0.20, 0.24),
    ("II", "networks as printed, learning"): (0.001, 0.001, 0.001),
    ("III", "networks as printed, stale"): (1.96, 2.28, 0.35),
    ("III", "networks as printed, learning"): (0.31, 0.25, 0.042),
}
COUNTS = ("taken", "offered", "judged", "regretted")
KEPT = ("rms_m", "late_velocity_rms", *COUNTS)  # of each dive
# Case, the model whose error is to be lower, the one it is compared with, and which error.
CLAIMS = (
    ("ours: an intercept and symmetry help", "I", MENDED, PLAIN, "rms_m"),
    ("ours: with noise too", "II", MENDED, PLAIN, "rms_m"),
    ("ours: networks that brake are better, with noise", "II", BRAKING, MENDED, "rms_m"),
    *(
        (f"{whose}: learning online lowers {what}", case, f"{way}, learning", f"{way}{before}", error)
        for whose, way in (("thesis", PLAIN), ("thesis, by networks of ours that brake", BRAKING))
        for case, before in (("II", ""), ("III", ", stale"))
        for what, error in (("the late velocity error", "late_velocity_rms"), ("the way off", "rms_m"))
    ),
    *(
        (
            "ours: learning online, those that brake are better",
            case,
            f"{BRAKING}, learning",
            f"{PLAIN}, learning",
            "rms_m",
        )
        for case in ("II", "III")
    ),
    (
        "ours: under feedback too, the way off",
        "III",
        f"{BRAKING}, learning, with feedback",
        f"{BRAKING}, stale, with feedback",
        "rms_m",
    ),
)
RUN_AWAY = 1.0  # [m/s] rms of the late velocity error: over three times the speed of the dive


@dataclasses.dataclass(frozen=True)
class Size:
    """Data to identify from [s], epochs of training, the dive [s], when the sonar is mounted [s]."""

    data: float = 1000.0
    epochs: int = 50
    dive: float = 180.0
    change: float = 60.0


QUICK = Size(data=60.0, epochs=8, dive=45.0, change=10.0)


def craft() -> jm.Vehicle:
    """The plant, with a place for the sonar."""
    bare = plant.tethra()
    return bare.place(jm.Placed(Payload.neutral(bare)), jm.Placed(Payload.neutral(bare)))


def _arrays(vehicle: jm.Vehicle, log: jm.Log) -> tuple[Array, Array, Array]:
    """Velocities, accelerations and tau - g of a log, as the method takes them."""
    force = plant.forces(vehicle, log) if log.wrench is None else _forces(vehicle, log)
    return jnp.asarray(log.channels[:, 6:12]), jnp.asarray(log.channels[:, 12:]), jnp.asarray(force)


def _forces(vehicle: jm.Vehicle, log: jm.Log) -> Float[np.ndarray, "times 6"]:
    """tau - g where the wrench itself acted."""
    blank = np.zeros((len(log.t), len(vehicle.thruster_names)))
    return np.asarray(log.wrench) + plant.forces(
        vehicle, dataclasses.replace(log, commands=blank, wrench=None)
    )


def identified(truth: jm.Vehicle, log: jm.Log, size: Size, seed: int) -> dict[str, jm.Vehicle]:
    """The vehicles of a log by the networks, all ways; those of the acceleration are trained once."""
    arrays, base = _arrays(truth, log), dataclasses.replace(truth, placed=truth.placed[:-1])
    first, second = jax.random.split(jax.random.key(seed))
    networks, _ = train_acceleration(*arrays, first, 5, size.epochs, 1)
    out = {}
    for way, (intercept, symmetric, form) in WAYS.items():
        mass = mass_of(networks, arrays[0], arrays[2], intercept, symmetric)
        # The many weights of D(nu) = L L' + K make its epochs dear; noise is averaged over fewer samples.
        every = THINNED if form == "dissipative" else 1
        found = identify_by_networks(
            *(a[::every] for a in arrays), key=second, mass=mass, form=form, epochs=size.epochs
        )
        out[way] = found.vehicle(base)
    return out


def networks_of(vehicle: jm.Vehicle) -> NetworkDamping:
    effect = vehicle.placed[-1].effect
    assert isinstance(effect, NetworkDamping)
    return effect


# --- learning under way ---------------------------------------------------------------------------


@eqx.filter_jit
def _retrained(term: NetworkDamping, nu, targets, known) -> NetworkDamping:
    """All weights, from where they are, on a window and on what the networks showed at known velocities."""
    held = jax.vmap(term.networks)(known)
    every = jnp.concatenate([nu, known]), jnp.concatenate([targets, held])
    size = jnp.std(targets, axis=0) + 1e-2 * jnp.abs(held).max(axis=0)
    weight = jnp.concatenate([jnp.ones(len(nu)), jnp.full(len(known), SHARE)])

    def miss(net, sample):
        velocity, force, share = sample
        shown = eqx.tree_at(lambda n: n.networks, term.networks, net)(velocity)
        return share * (shown - force) / size

    starts = jax.tree.map(lambda a: a[None], term.networks.networks)
    found = fit_samples(miss, starts, (*every, weight), max_steps=10)
    return eqx.tree_at(lambda t: t.networks.networks, term, found.best)


@dataclasses.dataclass
class Online:
    """Retrains the damping networks on the newest motion; kept is an update that explains what came later.

    An update is bounded by ten steps, by what is rehearsed, and by the last `JUDGED` seconds, to whose forces
    it has to be nearer than what it replaces. No proof: `RUN_AWAY` counts failures, and `regretted` the
    updates, of `judged`, that were farther from what came next than what they replaced. Networks of the form
    L L' + K brake at every velocity whatever their weights, so that the model cannot give energy to the hull;
    those as printed may.
    Accelerations are slopes of the velocities, whose noise is far below that of the accelerations.
    """

    known: Float[np.ndarray, "points 6"]
    log: jm.Log | None = None
    replaced: NetworkDamping | None = None
    taken: int = 0
    offered: int = 0
    judged: int = 0
    regretted: int = 0

    def forget(self) -> None:
        """For a craft that is another one from here on."""
        self.log = self.replaced = None

    def update(self, vehicle: jm.Vehicle, log: jm.Log) -> jm.Vehicle:
        if self.replaced is not None:
            # What has come since no decision has seen: was the last update right?
            before, after = self._missed((self.replaced, networks_of(vehicle)), *_felt(vehicle, log))
            self.judged += 1
            self.regretted += not after < before
            self.replaced = None
        if self.log is not None:
            values: dict[str, Any] = {
                name: np.concatenate([getattr(self.log, name), getattr(log, name)])
                for name in ("t", "channels", "wrench")
            }
            log = dataclasses.replace(log, **values)
        count, judged = round((WINDOW + JUDGED) / DT), round(JUDGED / DT)
        cut = {name: getattr(log, name)[-count:] for name in ("t", "channels", "wrench")}
        self.log = dataclasses.replace(log, **cut)
        if len(self.log.t) < count:
            return vehicle
        nu, targets = _felt(vehicle, self.log)
        before = networks_of(vehicle)
        after = _retrained(before, nu[:-judged], targets[:-judged], jnp.asarray(self.known))
        old, new = self._missed((before, after), nu[-judged:], targets[-judged:])
        self.offered += 1
        if not new < old:
            return vehicle
        self.taken += 1
        self.replaced = before
        return eqx.tree_at(networks_of, vehicle, after)

    @staticmethod
    def _missed(terms: tuple[NetworkDamping, NetworkDamping], nu, targets) -> list[float]:
        return [float(((jax.vmap(term.networks)(nu) - targets) ** 2).sum()) for term in terms]


def _felt(vehicle: jm.Vehicle, log: jm.Log) -> tuple[Array, Array]:
    """Velocities of a log, and the damping forces that its motion shows; the inertia is known."""
    nu, _, force = _arrays(vehicle, log)
    # That of the sonar stands in the payload.
    mass = vehicle.plant().load.rigid + vehicle.plant().load.added
    return nu, damping_targets(mass, nu, jnp.gradient(nu, DT, axis=0), force)


def flown(
    truth: jm.Vehicle,
    model: jm.Vehicle,
    online: Online | None,
    path,
    change: float,
    seed: int,
    feedback=None,
) -> jm.Trajectory:
    """Case II or III in stretches, as `tethra_control.learning`, with or without feedback of the true state.

    At `change` [s] the sonar is mounted; infinite: it never is.
    """
    state, parts = at_rest(path.at(np.zeros(1))), []
    every = study_of_control.EVERY
    count = round(every / DT)
    for k in range(round(path.duration / every)):
        t = (k * count + np.arange(count + 1)) * DT
        if abs(t[0] - change) < DT / 2:
            truth, model = dragging(mounted(truth)), mounted(model)
            if online is not None:
                online.forget()
        run = control.follow(truth, path.at(t), wrench_for(model, path, t), state, feedback)
        run = jax.tree.map(np.asarray, run)
        state = jax.tree.map(lambda a: a[-1], run.trajectory.states)
        run = jax.tree.map(lambda a: a[:-1], run)
        parts.append(run.trajectory)
        if online is not None:
            model = online.update(model, measured(run, truth, 1000 * seed + k))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def trial(truth: jm.Vehicle, path, size: Size, seed: int) -> list[dict[str, Any]]:
    """All cases of one seed."""
    clean = plant.dive(truth, size.data, seed)
    noisy = plant.noisy(clean, "text", seed)
    rows: list[dict[str, Any]] = []

    def note(case: str, model: str, trajectory, more=None):
        late = errors(trajectory, path, size.change + study_of_control.SETTLED) if case != "I" else {}
        row = {"case": case, "model": model, "seed": seed, **errors(trajectory, path), **(more or {})}
        rows.append(row | {"late_velocity_rms": late.get("velocity_rms")})

    models = {}
    for case, log in (("I", clean), ("II", noisy)):
        for way, model in identified(truth, log, size, seed).items():
            models[case, way] = model
            note(case, way, study_of_control.followed(truth, model, path).trajectory)
    feedback = control.pole_placement(guess(truth).mass_matrix, study_of_control.FREQUENCY)
    known = noisy.channels[:: max(1, len(noisy.t) // REHEARSED), 6:12][:REHEARSED]

    def learn(case: str, way: str, words: str, change: float, back=None):
        online = Online(known)
        run = flown(truth, models["II", way], online, path, change, seed, back)
        note(case, f"{way}, {words}", run, {name: getattr(online, name) for name in COUNTS})

    for way in (PLAIN, BRAKING):
        learn("II", way, "learning", np.inf)
        note("III", f"{way}, stale", flown(truth, models["II", way], None, path, size.change, seed))
        learn("III", way, "learning", size.change)
    learn("III", BRAKING, "learning, with feedback", size.change, feedback)
    run = flown(truth, models["II", BRAKING], None, path, size.change, seed, feedback)
    note("III", f"{BRAKING}, stale, with feedback", run)
    return rows


def gathered(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per case and model what each seed gave, in the order of the seeds."""
    out = []
    for case, model in sorted(
        dict.fromkeys((row["case"], row["model"]) for row in rows), key=lambda one: one[0]
    ):
        own = [row for row in rows if (row["case"], row["model"]) == (case, model)]
        given = {name: short([row[name] for row in own]) for name in KEPT if own[0].get(name) is not None}
        out.append({"case": case, "model": model} | given)
    return out


def sizes(values: list) -> Float[np.ndarray, " seeds"]:
    """Errors of each seed by their length; what is no number has run away."""
    own = np.array(values, float).reshape(len(values), -1)
    return np.nan_to_num(np.linalg.norm(own, axis=1), nan=np.inf)


def ran_away(run: dict[str, Any]) -> int:
    return int((sizes(run["late_velocity_rms"]) > RUN_AWAY).sum())


def claims(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each claim over seeds; positions count by the length of their rms."""
    found = {(one["case"], one["model"]): one for one in runs}
    return decided(
        {
            f"{words} (case {case})": list(
                zip(*(sizes(found[case, model][error]) for model in (better, worse)), strict=True)
            )
            for words, case, better, worse, error in CLAIMS
        }
    )


def table(results: dict[str, Any]) -> str:
    """Median rms per axis beside what the thesis prints, the worst seed's, and late velocities."""
    lines = ["| case | model | rms x, y, z m | printed | worst m | late velocity, rms m/s | ran away |"]
    lines.append("|---|---|---|---|---|---|---|")
    for one in results["runs"]:
        rms = np.nan_to_num(np.array(one["rms_m"], float), nan=np.inf)
        found, printed = (
            ", ".join(f"{x:.2g}" for x in values)
            for values in (np.median(rms, axis=0), PRINTED.get((one["case"], one["model"]), ()))
        )
        late, away = "", ""
        if one["case"] != "I":
            late = spread(sizes(one["late_velocity_rms"]).tolist(), 4)
            away = f"{ran_away(one)} of {len(rms)}"
        cells = [one["case"], one["model"], found, printed, f"{rms.max():.2g}", late, away]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n\n" + claim_table(results["claims"])


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and table.")],
    seeds: Annotated[int, typer.Option(min=1, help="Operators and noises.")] = 20,
    quick: Annotated[bool, typer.Option("--quick", help="A minute of data, a short dive, one seed.")] = False,
) -> None:
    """The thesis' cases I to III with its own networks."""
    size, seeds = (QUICK, 1) if quick else (Size(), seeds)
    with study(out, quick), Progress(transient=True) as bar:
        truth, rows = craft(), []
        path = control.spiral(
            study_of_control.RADIUS,
            study_of_control.SPEED,
            study_of_control.DEPTHS,
            size.dive,
            study_of_control.RAMP,
        )
        (out / "parts").mkdir(exist_ok=True)
        for seed in bar.track(range(seeds), description="seeds"):
            kept = out / "parts" / f"{size.data:g}s_{size.epochs}_{seed}.json"
            if not kept.exists():
                kept.write_text(json.dumps(trial(truth, path, size, seed)), encoding="utf-8")
            rows += json.loads(kept.read_text())
            runs = gathered(rows)
            results = {"runs": runs, "claims": claims(runs)}
            write_results(out, results, table(results))


if __name__ == "__main__":
    typer.run(main)
