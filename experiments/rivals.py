"""What would one use instead? The diagnosis against seven rivals, on logs with a known answer.

usage: python -m experiments.rivals --cases DIR --out DIR [--count 40] [--seed 1] [--jobs 1] [--quick]
                                    [--calibrate] [--without METHOD]

DIR is a folder of such logs that `blind_matrix` or `blind.cases` wrote. A sample of them, with the matrix'
shares of kinds and only what is detectable, goes to every method; each draws on the same catalogue, windows
and compiled programs where it can. It goes on where it was cut. Writes results.json and results.md.
`--calibrate` says instead how much the Kalman filters make of logs in which nothing is hidden, which is what
their thresholds were set by. Sparse regression needs `pip install '.[rivals]'`.
"""

import dataclasses
import json
import multiprocessing
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.progress import Progress
from scipy.stats import median_abs_deviation
from threadpoolctl import threadpool_limits

import jaxmarine as jm
from experiments import filters
from experiments._study import discordant, in_a_line, study, write_results
from experiments.blind import grading
from experiments.blind.catalogue import DAMP
from experiments.blind_matrix import BLOCK, Row, detectable, share
from jaxmarine._compiled import compiled
from jaxmarine._types import CHANNELS, DOFS, RATE, VELOCITY
from jaxmarine.diagnosis._explanation import Member, Model
from jaxmarine.diagnosis._knots import Knots, knots
from jaxmarine.diagnosis._learn import _inputs, learn
from jaxmarine.diagnosis._noises import noise_left
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._score import Reduced, solve
from jaxmarine.diagnosis._search import ROUGH, STEPS, needed, penalty
from jaxmarine.diagnosis._unknown import Dependence
from jaxmarine.diagnosis._workbench import SEGMENTS, Workbench
from jaxmarine.diagnosis._worth import measured_gain
from jaxmarine.effects import CATALOGUE
from jaxmarine.fitting import Affine, linearise
from jaxmarine.fitting._coverage import acceleration_of
from jaxmarine.fitting._one_step import OneStep, Samples
from jaxmarine.logs import smooth_states
from jaxmarine.networks import LearnedWrench
from jaxmarine.physics import from_euler

HERE = Path(__file__).parent / "instead"
ROUNDS = 3  # causes that a forward selection may name
# Acceleration, root mean square over all samples in units of the noise, that a column must add to stay in the
# sparse regression, and the ridge's pull as a share of a column's own information: of 33 settings what
# did best on twelve logs that are not of the matrix.
THRESHOLD, RIDGE = 0.5, 0.03
STEP = 1e-4  # of a parameter, for the acceleration that it adds
# Residual, in units of the noise, from which a channel counts as badly fitted.
BAD = 1.1
# Nats from which filters name a cause: of the bank beyond chance among all suspects, of the augmented state
# -log p. By six logs with nothing hidden that are of no sample (`--calibrate`): either names something in two
# of them, as the other rivals that name causes did in six of fifteen.
BANK, AUGMENTED = 17.0, 23.0
IN_CATALOGUE = ("single", "pair", "misfit")


@dataclasses.dataclass(frozen=True)
class Case:
    """A log with a known answer."""

    name: str
    vehicle: jm.Vehicle
    train: jm.Log
    test: jm.Log
    answer: Row

    def bench(self) -> Workbench:
        return workbench(self.vehicle, (self.train,), CATALOGUE, None)


def opened(folder: Path) -> Case:
    vehicle = jm.load_vehicle(folder / "vehicle.toml")
    train, test = (jm.read_log(folder / name, vehicle) for name in ("train.csv", "test.csv"))
    return Case(folder.name, vehicle, train, test, json.loads((folder / "answer.json").read_text()))


def said(names: Sequence[tuple[str, str | None]], ratio: float | None = None) -> Row:
    """What a rival says, as far as `Diagnosis.to_json` has it too."""
    return {
        "verdict": "explained" if names else "nothing_found",
        "findings": [{"effect": effect, "target": target} for effect, target in names],
        "residual_after": {"depends_on": []},
        "gain": {"ratio": ratio},
    }


def named(bench: Workbench, suspects: Sequence[int]) -> list[tuple[str, str | None]]:
    return [(s.effect.name, s.target) for s in (bench.layout.suspects[i] for i in suspects)]


def fitted(bench: Workbench, model: Model, test: jm.Log) -> Row:
    """What a model with members says, and what they buy on the test log."""
    ratio = measured_gain(bench, model, bool(model.members), (), test)[0].ratio
    return said(named(bench, [m.suspect for m in model.members]), ratio)


def starts(bench: Workbench, suspect: int) -> list[np.ndarray]:
    """Where a suspect's fit begins, its parameters minus neutral; neutral itself if it has a slope there."""
    s, neutral = bench.layout.suspects[suspect], bench.layout.neutral_of(suspect)
    values = [np.array([start[name] for name in s.slots]) for start in s.starts]
    return [value - neutral for value in values] or [np.zeros(len(neutral))]


# --- the methods ----------------------------------------------------------------------------------


def ours(case: Case, rounds: int) -> Row:
    del rounds
    return jm.diagnose(case.vehicle, case.train, case.test).to_json()


def sparse(case: Case, rounds: int) -> Row:
    """Sequentially thresholded least squares of the accelerations that the model misses.

    After Brunton, Proctor and Kutz (2016), here with the catalogue as library. Columns that add nothing to
    the acceleration at a measured state, those of sensor effects, cannot be named.
    """
    del rounds
    try:
        from pysindy.optimizers import STLSQ  # pyrefly: ignore[missing-import]
    except ImportError:
        message = "The sparse regression needs pysindy; install it with `pip install '.[rivals]'`."
        raise SystemExit(message) from None
    bench = case.bench()
    missed, added, of = library(bench)
    size = np.sqrt((added**2).mean(axis=0))
    regression = STLSQ(threshold=THRESHOLD, alpha=RIDGE * len(missed))
    with warnings.catch_warnings():
        # It warns where no coefficient is left, which is an answer.
        warnings.simplefilter("ignore", UserWarning)
        coefficients = np.ravel(regression.fit(added / size, missed[:, None]).coef_)
    pushed = {
        i: float(np.linalg.norm((added / size)[:, of == i] @ coefficients[of == i]))
        for i in np.unique(of[coefficients != 0])
    }
    return said(named(bench, sorted(pushed, key=lambda i: -pushed[i])))


def library(bench: Workbench) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Missed accelerations [samples], what columns add to them [samples, columns], each one's suspect.

    Of one log, in units of what scatters from one sample to the next: the noise of the acceleration, and what
    that of the states makes of it. A column is a small step of a parameter, or a start of a suspect that has
    no slope at neutral.
    """
    (log,), vehicle, layout = bench.data.logs, bench.vehicle, bench.layout
    track, free = smooth_states(log, vehicle.dof), vehicle.free > 0
    acceleration = acceleration_of(log, track.nu)
    samples = Samples(
        position=jnp.asarray(track.position)[None],
        attitude=jax.vmap(from_euler)(jnp.asarray(track.attitude))[None],
        velocity=jnp.asarray(track.nu)[None],
        acceleration=jnp.asarray(np.nan_to_num(acceleration))[None],
        weight=jnp.ones((1, len(log.t), 6)),
        instant=bool(np.isfinite(bench.noise[12:][free]).all()),
    )
    problem = dataclasses.replace(bench.problem(()), records=bench.cut.records, windows=bench.cut.windows)
    eye, neutral = jnp.eye(layout.size), jnp.asarray(layout.neutral)
    task = OneStep(
        problem, samples, neutral, eye, jnp.ones(layout.size), 1, tuple(np.flatnonzero(free).tolist())
    )
    seen = np.isfinite(acceleration).all(axis=1)

    def errors(change: np.ndarray) -> np.ndarray:
        return np.asarray(_errors(task, jnp.asarray(change)))[0][seen][:, free]

    base = errors(np.zeros(layout.size))
    noise = median_abs_deviation(np.diff(base, axis=0), axis=0, scale=0.6745) / np.sqrt(2)
    added, of = [], []
    for i, columns in enumerate(layout.columns):
        begun = bool(layout.suspects[i].starts)
        for step in starts(bench, i) if begun else STEP * np.eye(columns.shape[1]):
            more = (base - errors(columns @ step)) / noise
            # What rounding leaves of nothing is not a push.
            if np.isfinite(more).all() and np.abs(more).max() > 1e-6:
                added.append(more.ravel())
                of.append(i)
    return (base / noise).ravel(), np.array(added).T, np.array(of)


@eqx.filter_jit
def _errors(task: OneStep, change):
    return task.errors(change)


def by_bic(case: Case, rounds: int) -> Row:
    """Every candidate refitted, the one of least BIC taken, until none lowers it (Schwarz 1978)."""
    bench = case.bench()
    model = bench.refine(bench.start())
    for _ in range(rounds):
        tried = [
            bench.refine(bench.with_member(model, Member(i), value), STEPS, ROUGH)
            for i in bench.open(model)
            for value in starts(bench, i)
        ]
        tried = [one for one in tried if np.isfinite(one.cost) and bench.sound(one)]
        best = min(tried, key=lambda one: _bic(bench, one), default=model)
        if _bic(bench, best) >= _bic(bench, model):
            break
        model = bench.refine(best)
    return fitted(bench, model, case.test)


def _bic(bench: Workbench, model: Model) -> float:
    return 2 * model.cost + sum(penalty(bench, member) for member in model.members)


def by_score(case: Case, rounds: int) -> Row:
    """The score test as it is written down, g' h^-1 g of each suspect by itself beside the file as it is.

    What a refit of the windows' initial states or the file's coefficients would take away is not taken away,
    and how the scores scatter is not looked at (Rao 1948).
    """
    bench = case.bench()
    model = bench.refine(bench.frozen(bench.start()))
    for _ in range(rounds):
        g, h = _plain(bench, model)
        worth = {}
        for i in bench.open(model):
            own = bench.layout.columns[i]
            worth[i] = float(own.T @ g @ solve(own.T @ h @ own, own.T @ g))
        best = max(worth, key=lambda i: worth[i])
        if worth[best] < needed(bench, Member(best), 1.0):
            break
        # Neutral has a score or it would not lead, so that the fit begins there.
        width = bench.layout.columns[best].shape[1]
        more = bench.refine(bench.with_member(model, Member(best), np.zeros(width)))
        if not np.isfinite(more.cost):
            break
        model = more
    return fitted(bench, model, case.test)


def _plain(bench: Workbench, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and information of the catalogue's parameters, nothing eliminated."""
    size = bench.layout.size
    affine = Affine(jnp.asarray(bench.theta(model)), jnp.eye(size), jnp.ones((SEGMENTS, size)))
    assert isinstance(model.delta, jax.Array)
    stats = compiled(linearise)(bench.problem(model.members), affine, model.delta)
    g, h = (np.asarray(a)[: bench.count].sum(axis=0) for a in (stats.g_z, stats.h_zz))
    return g, h


class Named(NamedTuple):
    """What a bank of filters would name beside what it has named, and how much better that is [nats].

    - `begun`, `left`: suspects with the parameters that filters begin from, and that they end with.
    """

    begun: Sequence[tuple[int, np.ndarray]]
    left: Sequence[tuple[int, np.ndarray]]
    nats: float


def next_of_bank(watched: filters.Watched, known: Sequence[tuple[int, np.ndarray]]) -> Named:
    """The cause of most evidence beside those known; better than chance among all suspects by so much."""
    bench = watched.bench
    suspects = [(i, value) for i in range(len(bench.layout.suspects)) for value in starts(bench, i)]
    taken = {i for i, _ in known}
    tried = [known, *([*known, one] for one in suspects if one[0] not in taken)]
    asked = [(members, watched.hypothesis(members)) for members in tried]
    # What is wider than a filter is not asked.
    asked = [(members, one) for members, one in asked if one is not None]
    if len(asked) == 1:
        return Named(known, [], -np.inf)
    worth, z = filters.evidences(watched, [one for _, one in asked])
    best = 1 + int(np.argmax(worth[1:]))
    begun = asked[best][0]
    ends = np.cumsum([len(value) for _, value in begun])
    left = [(i, own) for (i, _), own in zip(begun, np.split(z[best], ends)[:-1], strict=True)]
    return Named(begun, left, float(worth[best] - worth[0] - np.log(len(bench.layout.suspects))))


def by_bank(case: Case, rounds: int) -> Row:
    """A Kalman filter for each cause, the one of most evidence named, then for each beside it, and so on."""
    bench = case.bench()
    watched = filters.Watched(bench)
    found = Named((), (), 0.0)
    for _ in range(rounds):
        more = next_of_bank(watched, found.begun)
        if more.nats < BANK:
            break
        found = more
    return believed(bench, found.left, case.test)


def by_augmented(case: Case, rounds: int) -> Row:
    """One Kalman filter with the parameters of all causes in its state; those off neutral are named."""
    bench = case.bench()
    nats, z = filters.significances(filters.Watched(bench))
    off = [int(i) for i in np.argsort(-nats)[:rounds] if nats[i] > AUGMENTED]
    values = np.split(z, np.cumsum([columns.shape[1] for columns in bench.layout.columns]))
    return believed(bench, [(i, values[i]) for i in off], case.test)


def believed(bench: Workbench, known: Sequence[tuple[int, np.ndarray]], test: jm.Log) -> Row:
    """Causes with the parameters that a filter left them with, and what these buy on the test log."""
    model = bench.frozen(bench.start())
    for i, value in known:
        model = bench.with_member(model, Member(i), value)
    return fitted(bench, model, test)


def black_box(case: Case, rounds: int) -> Row:
    """A network of all velocities and commands on every free axis, beside the recalibrated file."""
    del rounds
    bench = case.bench()
    model = bench.refine(bench.start())
    k, names = knots(bench, model), case.vehicle.thruster_names
    signals = tuple(name for name in (*VELOCITY, *RATE, *names) if name in k.places.signals)
    # It knows no shapes; none at all would stand for a dependence that is not to be learned.
    shapeless = np.zeros((*k.places.t.shape, 1))
    terms = []
    # Axis by axis: all at once are more weights than the normal equations of a small machine hold.
    for axis in np.flatnonzero(case.vehicle.free):
        (term,) = learn(k, (Dependence(int(axis), signals, (), 0.0, shapeless, False),), names)
        terms.append(jm.Placed(term, term.target))
        k = _with_term(k, int(axis), term, signals)
    return said((), measured_gain(bench, model, True, terms, case.test)[0].ratio)


def _with_term(k: Knots, axis: int, term: LearnedWrench, signals: tuple[str, ...]) -> Knots:
    """What the knots still lack beside a learned term."""
    force = jax.vmap(jax.vmap(lambda x: term.force(x, term.network)))(jnp.asarray(_inputs(k, signals)))
    push = np.zeros((*k.places.t.shape, 6))
    push[..., axis] = np.asarray(force)
    push = push.reshape(len(push), -1)
    assert isinstance(k.stats, Reduced)
    bent = np.einsum("wij,wj->wi", k.stats.h[:, :, k.width :], push)
    return dataclasses.replace(k, stats=dataclasses.replace(k.stats, g=k.stats.g + bent))


def worst_channel(case: Case, rounds: int) -> Row:
    """The axis of the channel that the file as it is fits worst, positions north and east left aside."""
    del rounds
    bench = case.bench()
    missed = noise_left(bench, bench.refine(bench.frozen(bench.start()))) / bench.own_noise
    missed[[CHANNELS.index("x"), CHANNELS.index("y")]] = np.nan
    worst = int(np.nanargmax(missed))
    return said([("axis", DOFS[worst % 6])] if missed[worst] > BAD else [])


def made_of_nothing(case: Case) -> Row:
    """How surely the filters would name a cause [nats], in a log in which nothing is hidden."""
    watched = filters.Watched(case.bench())
    nats = next_of_bank(watched, ()).nats, float(filters.significances(watched)[0].max())
    return {"case": case.name, **dict(zip(("bank", "augmented"), nats, strict=True))}


# --- how they are graded --------------------------------------------------------------------------


def by_name(case: Case, answer: Row) -> Row:
    """As the diagnosis is, with how many of the causes named are none."""
    hidden = case.answer.get("findings", [])
    aside = DAMP if grading.kind(case.answer) == "misfit" else ()
    causes = [f for f in answer["findings"] if f["effect"] != "unknown"]
    wrong = [f for f in causes if not any(grading.matches(f, h) for h in hidden)]
    return {
        **grading.grade(case.answer, answer),
        "named": bool(causes),
        "wrong": sum(f["effect"] not in aside for f in wrong),
    }


def by_axis(case: Case, answer: Row) -> Row:
    """Whether the axis is the cause's, or a thruster's that acts on it; None where the cause has neither."""
    axes = [f["target"] for f in answer["findings"]]
    accepted = [target for f in case.answer.get("findings", []) for _, target in f["accept"]]
    targets = case.answer.get("unknown") or [target for target in accepted if target]
    kind = grading.kind(case.answer)
    hidden = kind != "null"
    right = any(_acts_on(case.vehicle, target, axis) for target in targets for axis in axes)
    known = right if targets else None
    return {
        "first": known if hidden else not axes,
        "whole": None if hidden else not axes,
        "named": None if kind == "outside" else bool(axes),
        "wrong": len(axes) if not hidden else int(bool(axes) and known is False),
    }


def _acts_on(vehicle: jm.Vehicle, target: str, axis: str) -> bool:
    arms = np.abs(np.asarray(vehicle.plant().allocation))[DOFS.index(axis)]
    if target in vehicle.thruster_names:
        return bool(arms[vehicle.thruster_names.index(target)] > 1e-3)
    return bool(arms.any()) if target == "all" else target.partition("<-")[0] == axis


def not_graded(case: Case, answer: Row) -> Row:
    del case, answer
    return {"first": None, "whole": None, "named": None, "wrong": None}


@dataclasses.dataclass(frozen=True)
class Method:
    title: str
    run: Callable[[Case, int], Row]
    graded: Callable[[Case, Row], Row] = by_name


METHODS = {
    "ours": Method("`jaxmarine.diagnose`", ours),
    "sparse": Method("sparse regression of accelerations (pysindy)", sparse),
    "bic": Method("refit every candidate, compare BIC", by_bic),
    "score": Method("score, nothing eliminated", by_score),
    "bank": Method("bank of Kalman filters, one for each cause", by_bank),
    "augmented": Method("Kalman filter of the state and all causes", by_augmented),
    "black_box": Method("black-box residual networks", black_box, not_graded),
    "worst_channel": Method("worst-fitting channel (an axis, not a cause)", worst_channel, by_axis),
}


# --- the study ------------------------------------------------------------------------------------


def sampled(folder: Path, count: int, seed: int) -> list[Path]:
    """Cases with the matrix' shares of kinds, of those detectable; fewer where a kind runs out."""
    kinds: dict[str, list[Path]] = {kind.removesuffix("s"): [] for kind in BLOCK}
    for path in sorted(folder.glob("*/answer.json")):
        answer = json.loads(path.read_text())
        kind = grading.kind(answer)
        if detectable({"kind": kind, "severity": answer["options"]["severity"]}):
            kinds[kind].append(path.parent)
    rng = np.random.default_rng(seed)
    chosen = []
    # Ends of equal stretches, so that the kinds add up to the count.
    ends = np.round(np.cumsum([0, *BLOCK.values()]) * count / sum(BLOCK.values())).astype(int)
    for paths, wanted in zip(kinds.values(), np.diff(ends), strict=True):
        chosen += [paths[i] for i in rng.permutation(len(paths))[:wanted]]
    return sorted(chosen)


def row(case: Case, key: str, rounds: int) -> Row:
    """What one method says of one log. Processor time, since other work may share the machine."""
    began = time.process_time()
    answer = METHODS[key].run(case, rounds)
    seconds = time.process_time() - began
    return {
        "case": case.name,
        "kind": grading.kind(case.answer),
        "vehicle": case.vehicle.name,
        "method": key,
        "found": [[f["effect"], f["target"]] for f in answer["findings"]],
        **METHODS[key].graded(case, answer),
        "ratio": answer["gain"]["ratio"],
        "seconds": round(seconds, 2),
    }


def compared(folders: Sequence[Path], out: Path, rounds: int, methods: Sequence[str]) -> int:
    """All methods on some logs of one vehicle, whose programs are compiled once; a file for each row."""
    jax.config.update("jax_enable_x64", True)
    with threadpool_limits(1, "blas"):
        for folder in folders:
            (out / folder.name).mkdir(parents=True, exist_ok=True)
            for key in methods:
                path = out / folder.name / f"{key}.json"
                if not path.exists():
                    path.write_text(json.dumps(row(opened(folder), key, rounds), indent=1) + "\n")
    return len(folders)


def summary(rows: Sequence[Row]) -> Row:
    """The numbers of one method."""

    def of(kinds: Sequence[str], key: str) -> Row:
        return share([r for r in rows if r["kind"] in kinds and r[key] is not None], key)

    wrong, ratios = ([r[key] for r in rows if r[key] is not None] for key in ("wrong", "ratio"))
    return {
        "first": of(IN_CATALOGUE, "first"),
        "whole": of(IN_CATALOGUE, "whole"),
        "unknown": of(("outside",), "first"),
        "outside_named": of(("outside",), "named"),
        "false": of(("null",), "named"),
        "wrong": sum(wrong) if wrong else None,
        "seconds": float(np.median([r["seconds"] for r in rows])) if rows else None,
        "ratio": float(np.median(ratios)) if ratios else None,
    }


def claims(rows: Sequence[Row]) -> list[Row]:
    """Whether the diagnosis answers right more often than each rival that names causes, on the same logs.

    The whole answer; of what is outside the catalogue that it is said to be unknown.
    """

    def right(key: str) -> list[bool]:
        own = sorted((r for r in rows if r["method"] == key), key=lambda r: r["case"])
        return [bool(r["first"] if r["kind"] == "outside" else r["whole"]) for r in own]

    met = {r["method"] for r in rows} - {"ours"}
    rivals = [key for key, method in METHODS.items() if method.graded is by_name and key in met]
    return discordant(
        {f"right more often than {METHODS[key].title}": (right("ours"), right(key)) for key in rivals}
    )


COLUMNS = {
    "first": "first name right",
    "whole": "whole answer right",
    "unknown": "outside the catalogue: said to be unknown, or its axis",
    "outside_named": "... named as an effect of it",
    "false": "nothing hidden, yet named",
    "wrong": "wrong names in all",
    "seconds": "CPU s, median",
    "ratio": "gain ratio, median",
}


def table(found: dict[str, Row]) -> str:
    """One line per method, as Markdown."""

    def cell(key: str, value: Any) -> str:
        if value is None or (isinstance(value, dict) and not value["of"]):
            return "–"
        if isinstance(value, dict):
            low, high = 100 * value["low"], 100 * value["high"]
            return f"{value['right']} of {value['of']} ({low:.0f} to {high:.0f} %)"
        return {"wrong": "{:d}", "seconds": "{:.1f}", "ratio": "{:.3f}"}[key].format(value)

    lines = ["| | " + " | ".join(COLUMNS.values()) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for key, numbers in found.items():
        cells = [cell(column, numbers[column]) for column in COLUMNS]
        lines.append(f"| {METHODS[key].title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def told(results: Row) -> str:
    """The table and the claims, as Markdown."""
    return table(results["methods"]) + "\n" + "\n".join(map(in_a_line, results["claims"])) + "\n"


def thresholds(folder: Path, out: Path) -> None:
    """Writes and prints what the filters make of each log of a folder that hides nothing."""
    with study(out, False):
        opened_ones = (opened(path.parent) for path in sorted(folder.glob("*/answer.json")))
        rows = [made_of_nothing(case) for case in opened_ones if grading.kind(case.answer) == "null"]
    (out / "thresholds.json").write_text(json.dumps(rows, indent=1) + "\n")
    for row in rows:
        print(f"{row['case']}: bank {row['bank']:.1f}, augmented {row['augmented']:.1f} nats")


def main(
    cases: Annotated[Path, typer.Option(help="Folder of logs that blind_matrix wrote.")],
    out: Annotated[Path, typer.Option(help="Folder for rows and the table.")],
    count: Annotated[int, typer.Option(min=1, help="Logs in the sample.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the sample.")] = 1,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Three logs, one round of each search.")] = False,
    without: Annotated[list[str] | None, typer.Option(help="Methods that are left out, by key.")] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Only what filters make of logs with nothing hidden.")
    ] = False,
) -> None:
    """Compares the diagnosis with what one would use instead."""
    if calibrate:
        thresholds(cases, out)
        return
    count, rounds, place = (3, 1, out / "rows_quick") if quick else (count, ROUNDS, out / "rows")
    methods = [key for key in METHODS if key not in (without or ())]
    folders = sampled(cases, count, seed)
    ships: dict[str, list[Path]] = {}
    for folder in folders:
        ship = json.loads((folder / "answer.json").read_text())["options"]["vehicle"]
        ships.setdefault(ship, []).append(folder)
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1)
    with Progress(transient=True) as bar, pool:
        comparing = bar.add_task("comparing", total=len(folders))
        tasks = [pool.submit(compared, some, place, rounds, methods) for some in ships.values()]
        for future in as_completed(tasks):
            bar.advance(comparing, future.result())
    paths = [place / folder.name / f"{key}.json" for folder in folders for key in methods]
    rows = [json.loads(path.read_text()) for path in paths]
    found = {key: summary([r for r in rows if r["method"] == key]) for key in methods}
    results = {"seed": seed, "count": len(folders), "methods": found, "claims": claims(rows), "rows": rows}
    write_results(out, results, told(results))
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
