"""Causes that a log leaves open, told apart by a planned manoeuvre.

usage: python -m experiments.told_apart --out DIR [--draws 12] [--severity 1.3 8] [--quick]

Pairs of causes are drawn, not chosen. For every draw the catalogue of `experiments/blind` gives a cause on a
vehicle, of a severity and with parameters at random, and random commands give a first log of it. Its rival is
the suspect of the whole catalogue that imitates it best there: which leaves the least chi-square of that log
when it is refitted beside the file's coefficients, at the values of that refit. `plan` then proposes a
manoeuvre that tells the two apart, and the vehicle with the drawn cause is simulated on it and on two random
manoeuvres of the same length in the same box: one whose commands have the root mean square of the planned
ones, and a gentle one, from which the plan began. All logs are of a plant that shares no code with the
package, with the file's noise, and are diagnosed with the whole catalogue. A draw that has no such manoeuvres
is drawn again, which is counted. It goes on where it was cut. Writes results.json, results.md and the figure
evidence.
"""

import dataclasses
import json
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Array, Float
from rich.progress import Progress
from scipy.optimize import brentq

import jaxmarine as jm
from experiments._study import decided, discordant, in_a_line, save_figure, study, wilson, write_results
from experiments.blind import cases, catalogue, excitation
from experiments.blind.plant import Effect
from experiments.blind.vehicle import load
from experiments.rivals import starts
from jaxmarine.diagnosis import Box, plan
from jaxmarine.diagnosis._climb import climbed
from jaxmarine.diagnosis._explanation import Member, Model
from jaxmarine.diagnosis._plan import HOLD, RANDOM, STAY, WALL, _Causes, _causes, _Flown, _improved, _leaving
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._search import ROUGH, STEPS
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.effects import CATALOGUE, place
from jaxmarine.vehicle_io import suspect_named

HERE = Path(__file__).parent / "pairs"
Row = dict[str, Any]
KINDS = {
    "planned": "planned",
    "random": "random, as strong",
    "gentle": "random, gentle",
}
OUTCOMES = ("decides", "undecided", "wrong")
SHIP, DURATION, BOX = "cybership2", 24.0, Box(speed=0.5, radius=8.0)  # [s], [m/s], [m]
SEVERITY = cases.SEVERITIES["singles"]  # drawn evenly on a logarithmic scale
ATTEMPTS = 6  # to draw a cause that has a rival, a plan and random manoeuvres


@dataclasses.dataclass(frozen=True)
class Pair:
    """A cause that was drawn, and the rival that imitates it best.

    - `hidden`: the cause for the independent plant; `causes`: both for the package, the true one first.
    - `severity`: of the draw; `left` [nats]: by which the first log prefers the truth, refitted likewise.
    """

    hidden: Effect
    causes: tuple[jm.Placed, jm.Placed]
    severity: float
    left: float

    @property
    def labels(self) -> tuple[str, str]:
        true, rival = (_label(cause) for cause in self.causes)
        return true, rival


def _label(cause: jm.Placed) -> str:
    return cause.effect.name if cause.target is None else f"{cause.effect.name}:{cause.target}"


class Undrawn(Exception):
    """A draw that gives no pair, or no manoeuvres for it."""


# --- a pair ---------------------------------------------------------------------------------------


def drawn(craft: jm.Vehicle, folder: Path, between: tuple[float, float], seed: list[int]) -> Pair:
    """A cause of a severity between two, at random, with its rival; its first log is left in the folder."""
    rng = np.random.default_rng(seed)
    severity = float(np.exp(rng.uniform(*np.log(between))))
    truth = load(SHIP)
    name = str(rng.choice(catalogue.names(truth)))
    found = cases.named(truth, name, severity, "rich", rng, DURATION)
    if found is None:
        raise Undrawn(f"{name} of severity {severity:.2f} is none of this vehicle")
    # It acts from the start: two causes are to be told apart, not when one began.
    hidden = dataclasses.replace(found, since=None)
    true = suspect_named(craft, hidden.effect, hidden.target)
    if not true.slots:
        raise Undrawn(f"{name} has no size at which another could imitate it")
    commands = excitation.commands(truth, round(DURATION / cases.DT), rng)
    log = recorded(hidden, commands, folder / "first.csv", [*seed, 1])
    bench = workbench(craft, (log,), CATALOGUE, None)
    label = [s.label for s in bench.layout.suspects].index(true.label)
    rival, left = imitation(bench, label)
    values = {n: x for n, x in hidden.parameters.items() if n in true.slots}
    cause = jm.Placed(place(true, craft, values), true.target)
    return Pair(hidden, (cause, rival), severity, left)


def imitation(bench: Workbench, true: int) -> tuple[jm.Placed, float]:
    """The suspect that leaves the least chi-square but for the true one, refitted, and nats behind that."""
    model = bench.refine(bench.start())

    def refitted(suspect: int) -> Model:
        begun = [bench.with_member(model, Member(suspect), value) for value in starts(bench, suspect)]
        tried = [climbed(bench, bench.refine(one, STEPS, ROUGH), STEPS, ROUGH) for one in begun]
        # The model without it where it cannot be fitted.
        sound = [one for one in tried if np.isfinite(one.cost) and bench.sound(one)]
        return min(sound, key=lambda one: one.cost, default=model)

    others = [refitted(i) for i in bench.open(model) if i != true]
    best = min((one for one in others if one.members), key=lambda one: one.cost, default=None)
    if best is None:
        raise Undrawn("nothing can be fitted to its first log")
    best = bench.refine(best)
    (member,), (own,) = best.members, bench.slices(best.members)
    suspect = bench.layout.suspects[member.suspect]
    effect = place(suspect, bench.vehicle, bench.layout.values(member.suspect, best.z[own]))
    return jm.Placed(effect, suspect.target), best.cost - bench.refine(refitted(true)).cost


# --- random manoeuvres ----------------------------------------------------------------------------


class AsStrong(eqx.Module):
    """The price of leaving the box and of commands of another root mean square than `rms` [1]."""

    rms: Float[Array, ""]

    def __call__(self, corners: Float[Array, "corners columns"], causes: _Causes) -> tuple[Array, None]:
        commands = causes.commands(corners)
        off = jnp.sqrt((commands**2).mean()) / self.rms - 1.0
        return _leaving(causes.sizes(causes.flown(commands)[0])) + WALL * off**2, None


def of_strength(
    causes: _Causes, corners: Float[Array, "corners columns"], rms: float
) -> Float[Array, "corners columns"] | None:
    """Corners times the factor at which their commands have this root mean square; None where none has it."""

    def off(exponent: float) -> float:
        return float(jnp.sqrt((causes.commands(np.exp(exponent) * corners) ** 2).mean())) - rms

    # At either end commands are next to nothing, or at their limits.
    if off(5.0) < 0.0:
        return None
    exponent: Any = brentq(off, -5.0, 5.0, xtol=1e-12)
    return float(np.exp(exponent)) * corners


def as_strong(causes: _Causes, rms: float, shape: tuple[int, ...], seed: list[int]) -> _Flown:
    """A random manoeuvre of this root mean square of its commands, moved into the box.

    The first of as many as a plan draws that stays in it.
    """
    rng = np.random.default_rng(seed)
    for _ in range(RANDOM):
        begun = jnp.asarray(rng.normal(size=shape))
        moved = of_strength(causes, _improved(AsStrong(jnp.asarray(rms)), STAY, causes, begun), rms)
        if moved is not None and (flown := _Flown.of(causes, moved)).safe:
            return flown
    raise Undrawn(f"no random manoeuvre of {rms:.2f} stays in the box")


# --- one draw -------------------------------------------------------------------------------------


def recorded(
    hidden: Effect, commands: Float[np.ndarray, "times columns"], path: Path, seed: list[int]
) -> jm.Log:
    """The log of the vehicle with a cause, from rest on a random heading, as read from a file."""
    rng = np.random.default_rng(seed)
    truth = load(SHIP)
    try:
        run = cases.roll_out(truth, [hidden], commands.round(6), float(rng.uniform(-np.pi, np.pi)))
    except cases.Unruly as error:
        raise Undrawn(str(error)) from error
    path.write_text(cases.table(truth, run, truth.noise, rng), encoding="utf-8")
    return jm.read_log(path, jm.load_vehicle(cases.FOLDER / f"{SHIP}.toml"))


def outcome(found: jm.Diagnosis, true: str, rival: str) -> str:
    """`decides`: the truth alone is named, and the rival is not marked indistinguishable from it.

    `undecided`: nothing is named, or one cause and the truth is it or marked; `wrong`: all else.
    """
    if not found.findings:
        return "undecided"
    named, *others = found.findings
    if others:
        return "wrong"
    close = [a.label for a in named.alternatives if a.indistinguishable]
    if named.label == true and rival not in close:
        return "decides"
    return "undecided" if true in (named.label, *close) else "wrong"


def evidence(found: jm.Diagnosis, true: str, rival: str) -> float | None:
    """Nats by which the truth is preferred to the rival; None unless one is named, the other beside it."""
    if not found.findings:
        return None
    named = found.findings[0]
    behind = {a.label: named.log_evidence - a.log_evidence for a in named.alternatives}
    if named.label == rival:
        return -behind[true] if true in behind else None
    return behind.get(rival) if named.label == true else None


def root_mean_square(commands: Float[np.ndarray, "times columns"]) -> float:
    return float(np.sqrt((commands**2).mean()))


def row(seed: int, severity: tuple[float, float], out: Path) -> Row:
    """One draw, from its file where it was done before."""
    folder = out / f"draw_{seed:02d}"
    path = folder / "row.json"
    if path.exists():
        return json.loads(path.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    undrawn = []
    for attempt in range(ATTEMPTS):
        try:
            found = judged(folder, severity, [seed, attempt])
        except Undrawn as error:
            undrawn.append(str(error))
            continue
        whole = {"seed": seed, "undrawn": undrawn, **found}
        path.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
        return whole
    raise SystemExit(f"Draw {seed} gives no pair: {'; '.join(undrawn)}.")


def judged(folder: Path, severity: tuple[float, float], seed: list[int]) -> Row:
    """A pair, and what diagnoses of its manoeuvres say and were expected to."""
    craft = jm.load_vehicle(cases.FOLDER / f"{SHIP}.toml")
    began = time.process_time()
    pair = drawn(craft, folder, severity, seed)
    chosen = time.process_time()
    # All plans are of one program.
    try:
        made = plan(craft, pair.causes, DURATION, BOX, seed[0], families=CATALOGUE)
    except jm.InputError as error:
        raise Undrawn(str(error)) from error
    planned = made.log.commands
    if not made.random:
        raise Undrawn("no gentle manoeuvre stays in the box")
    gentle, other = made.random[0].commands, made.random[-1].commands
    assert planned is not None and gentle is not None and other is not None
    problem = _causes(craft, pair.causes, DURATION, BOX, CATALOGUE)
    corners = (round(DURATION / HOLD), planned.shape[1])
    strong = as_strong(problem, root_mean_square(planned), corners, seed)
    spent = time.process_time() - chosen
    flown = {
        "planned": (planned, made.evidence),
        "random": (np.asarray(problem.commands(strong.corners)), 0.5 * strong.apart),
        # The first that was drawn, whatever it tells; the last one for the test log.
        "gentle": (gentle, made.random_evidence[0]),
    }

    def log(name: str, commands: Float[np.ndarray, "times columns"]) -> jm.Log:
        return recorded(pair.hidden, commands, folder / f"{name}.csv", [*seed, zlib.crc32(name.encode())])

    test = log("test", other)
    true, rival = pair.labels
    out: Row = {
        "true": in_words(pair.causes[0], craft),
        "rival": in_words(pair.causes[1], craft),
        "severity": pair.severity,
        "left_nats": pair.left,
        "draw_cpu_s": chosen - began,
        "plan_cpu_s": spent,
    }
    for kind, (commands, expected) in flown.items():
        began = time.process_time()
        found = jm.diagnose(craft, log(kind, commands), test)
        out[kind] = {
            "outcome": outcome(found, true, rival),
            "named": [f.label for f in found.findings],
            "marked": [list(group[1:]) for group in found.groups],
            "expected_nats": expected,
            "found_nats": evidence(found, true, rival),
            "command_rms": root_mean_square(commands),
            "cpu_s": time.process_time() - began,
        }
    return out


def in_words(cause: jm.Placed, craft: jm.Vehicle) -> str:
    """Its label and its parameters, to three digits."""
    suspect = next(s for s in type(cause.effect).suspects(craft) if s.target == cause.target)
    values = zip(suspect.slots, suspect.values(cause.effect), strict=True)
    return " ".join([_label(cause), *(f"{name}={value:.3g}" for name, value in values)])


# --- the results ----------------------------------------------------------------------------------

CLAIMS = {
    "a planned manoeuvre decides more often than a random one as strong": ("planned", "random"),
    "a random manoeuvre as strong decides more often than a gentle one": ("random", "gentle"),
}


def summary(rows: Sequence[Row]) -> Row:
    """Per kind of manoeuvre how often each outcome, and median evidences; what of the claims holds."""
    out: Row = {"of": len(rows), "undrawn": sum(len(r["undrawn"]) for r in rows)}
    for kind in KINDS:
        here = [r[kind] for r in rows]
        counts = {o: sum(h["outcome"] == o for h in here) for o in OUTCOMES}
        told = [h["found_nats"] for h in here if h["found_nats"] is not None]
        out[kind] = {
            **counts,
            "decides_ci95": wilson(counts["decides"], len(rows)),
            "expected_nats": float(np.median([h["expected_nats"] for h in here])),
            "found_nats": float(np.median(told)) if told else None,
            "command_rms": float(np.median([h["command_rms"] for h in here])),
        }
    right = {kind: [r[kind]["outcome"] == "decides" for r in rows] for kind in KINDS}
    pairs = {words: (right[one], right[other]) for words, (one, other) in CLAIMS.items()}
    return out | {"claims": discordant(pairs), "nats": decided(nats(rows))}


def nats(rows: Sequence[Row]) -> dict[str, list[tuple[float, float]]]:
    """Evidence of the weaker manoeuvre and of the stronger one, draw by draw.

    As a plan expects it, and as it was found where both diagnoses list the rival and prefer the truth.
    """
    out = {}
    for one, other in CLAIMS.values():
        for kind in ("expected_nats", "found_nats"):
            both = [(r[other][kind], r[one][kind]) for r in rows]
            words = f"{KINDS[other]}: less {kind.partition('_')[0]} evidence than {KINDS[one]}"
            known = [(a, b) for a, b in both if None not in (a, b) and min(a, b) > 0.0]
            if known:
                out[words] = known
    return out


def table(found: Row, rows: Sequence[Row]) -> str:
    """One line per kind of manoeuvre, one per claim, and one per draw, as Markdown."""
    lines = [
        "| manoeuvre | decides (95 % interval) | undecided | wrong | expected nats | found nats "
        "| rms command |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, title in KINDS.items():
        one = found[kind]
        low, high = one["decides_ci95"]
        told = "–" if one["found_nats"] is None else f"{one['found_nats']:.1f}"
        share = f"{one['decides']} of {found['of']} ({100 * low:.0f} to {100 * high:.0f} %)"
        cells = (title, share, one["undecided"], one["wrong"], f"{one['expected_nats']:.1f}", told)
        lines.append("| " + " | ".join(map(str, (*cells, f"{one['command_rms']:.2f}"))) + " |")
    lines += ["", *(in_a_line(claim) for claim in found["claims"])]
    for one in found["nats"]:
        share = f"{one['ratio']:.2g} times as much, median of {one['dives']} draws"
        lines.append(f"- {one['claim']}: {one['verdict']} ({share}; p = {one['p_holm']:.2g}, by Holm)")
    lines.append("")
    lines += ["| drawn, severity | imitated by, nats behind | " + " | ".join(KINDS.values()) + " |"]
    lines += ["|---" * (2 + len(KINDS)) + "|"]
    for r in rows:
        said = [f"{r[kind]['outcome']}, {r[kind]['expected_nats']:.1f} nats expected" for kind in KINDS]
        pair = f"`{r['true']}`, {r['severity']:.1f}", f"`{r['rival']}`, {r['left_nats']:.1f}"
        lines.append("| " + " | ".join((*pair, *said)) + " |")
    return "\n".join(lines) + "\n"


def figure(rows: Sequence[Row], out: Path) -> None:
    """Expected evidence of every draw, and the commands and the track of one planned manoeuvre."""
    plot, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained", width_ratios=[1.4, 1.6, 1])
    # From the pair that a plan tells apart least.
    order = sorted(rows, key=lambda r: r["planned"]["expected_nats"])
    for kind, color in zip(KINDS, ("#1f6fb5", "#c2620a", "0.5"), strict=True):
        nats = [max(r[kind]["expected_nats"], 1e-2) for r in order]
        axes[0].plot(range(len(order)), nats, "o", ms=4, color=color, alpha=0.8, label=KINDS[kind])
    axes[0].axhline(3.0, color="0.6", lw=1, ls="--")
    axes[0].set(yscale="log", ylabel="expected evidence [nats]", xlabel="draw, by what its plan tells")
    shown = order[len(order) // 2]
    craft = jm.load_vehicle(cases.FOLDER / f"{SHIP}.toml")
    log = jm.read_log(out / f"draw_{shown['seed']:02d}" / "planned.csv", craft)
    assert log.commands is not None
    title = " or ".join(shown[one].split()[0] for one in ("true", "rival"))
    axes[1].plot(log.t, log.commands, lw=1.2, label=craft.command_names)
    axes[1].set(xlabel="t [s]", ylabel="command [1]", ylim=(-1.05, 1.35), title=title)
    x, y = np.asarray(log.channels)[:, :2].T
    axes[2].plot(y, x, color="#1f6fb5", lw=1.2)
    axes[2].plot(y[:1], x[:1], "o", ms=4, color="black")
    axes[2].set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title="its track")
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    axes[1].legend(frameon=False, fontsize=8, loc="upper center", ncols=len(craft.command_names))
    save_figure(plot, out / "evidence")


def main(
    out: Annotated[Path, typer.Option(help="Folder for logs, results, table and figure.")],
    draws: Annotated[int, typer.Option(min=1, help="Pairs to draw.")] = 12,
    severity: Annotated[
        tuple[float, float], typer.Option(help="Least and largest severity of what is drawn.")
    ] = SEVERITY,
    quick: Annotated[bool, typer.Option("--quick", help="One draw.")] = False,
) -> None:
    """Plans manoeuvres that tell causes apart, and diagnoses logs of them and of random ones."""
    draws = 1 if quick else draws
    with study(out, quick), Progress(transient=True) as bar:
        rows = []
        for seed in bar.track(range(draws), description="drawing pairs"):
            rows.append(row(seed, severity, out))
        found = summary(rows)
        write_results(out, {"draws": found, "rows": rows}, table(found, rows))
        figure(rows, out)
    print(table(found, rows))


if __name__ == "__main__":
    typer.run(main)
