"""Causes that a log cannot tell apart, told apart by a planned manoeuvre.

usage: python -m experiments.told_apart --out DIR [--seeds 20] [--quick]

Three pairs of causes, each at values at which one imitates the other. For every seed `plan` proposes a
manoeuvre that tells them apart. The vehicle with one of them (in turns) is simulated on it and on a random
manoeuvre of the same length in the same box, by a plant that shares no code with the package
(`experiments/blind`), with the file's noise; both logs are diagnosed with the whole catalogue. It goes on
where it was cut. Writes results.json, results.md and the figure evidence.
"""

import dataclasses
import json
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Float
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import save_figure, study, wilson, write_results
from experiments.blind import cases
from experiments.blind.plant import Effect
from experiments.blind.vehicle import load
from jaxmarine.diagnosis import Box, Manoeuvre, plan
from jaxmarine.vehicle_io import cause_named

Row = dict[str, Any]
KINDS = ("planned", "random")
OUTCOMES = ("decides", "undecided", "wrong")


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two causes in words, on which vehicle, told apart within `duration` [s] and in which box.

    - `beside`: a third cause that the plan is to keep apart from both.
    """

    ship: str
    causes: tuple[str, str]
    duration: float
    box: Box
    beside: tuple[str, ...] = ()

    @property
    def file(self) -> Path:
        return cases.FOLDER / f"{self.ship}.toml"

    @property
    def labels(self) -> tuple[str, str]:
        first, second = (words.split()[0] for words in self.causes)
        return first, second


# Values at which the second imitates the first best on random manoeuvres; sizes at which these leave it open.
PAIRS = {
    "delay_lag": Pair(
        "cybership2",
        ("input_delay delay=0.15", "thruster_lag time_constant=0.15"),
        16.0,
        Box(speed=0.4, radius=3.0),
    ),
    "tether_inflow": Pair(
        "cybership2",
        ("tether_drag coefficient=2.0", "inflow_loss per_speed=0.3"),
        40.0,
        Box(speed=0.4, radius=4.0),
        # A cable behind a ship that hardly drifts is little but drag ahead.
        beside=("quadratic_damping:surge value=2.0",),
    ),
    "buoyancy_wrench": Pair(
        "tethra",
        ("buoyancy force=8.0", "constant_wrench:heave value=-8.0"),
        40.0,
        Box(speed=0.5, radius=4.0, tilt=0.4),
    ),
}


# --- one seed -------------------------------------------------------------------------------------


def hidden(words: str) -> Effect:
    """A cause in words for the independent plant."""
    label, *assignments = words.split()
    effect, _, target = label.partition(":")
    return Effect(effect, target or None, {n: float(x) for n, x in (a.split("=") for a in assignments)})


def recorded(
    pair: Pair, words: str, commands: Float[np.ndarray, "times columns"], path: Path, seed: list[int]
) -> jm.Log:
    """The log of the vehicle with a cause, from rest on a random heading, as read from a file."""
    rng = np.random.default_rng(seed)
    truth = load(pair.file)
    run = cases.roll_out(truth, [hidden(words)], commands.round(6), float(rng.uniform(-np.pi, np.pi)))
    path.write_text(cases.table(truth, run, truth.noise, rng), encoding="utf-8")
    return jm.read_log(path, jm.load_vehicle(pair.file))


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


def judged(pair: Pair, number: int, made: Manoeuvre, folder: Path, seed: int) -> Row:
    """What diagnoses of the planned and of a random manoeuvre say, and were expected to."""
    craft = jm.load_vehicle(pair.file)
    true, rival = pair.labels[number], pair.labels[1 - number]
    # The first that was drawn, whatever it tells; the last one for the test log.
    flown = {"planned": (made.log, made.evidence), "random": (made.random[0], made.random_evidence[0])}

    def log(name: str, commands: Float[np.ndarray, "times columns"] | None) -> jm.Log:
        assert commands is not None
        key = [seed, zlib.crc32(name.encode())]
        return recorded(pair, pair.causes[number], commands, folder / f"{name}.csv", key)

    test = log("test", made.random[-1].commands)
    out: Row = {"true": true}
    for kind, (manoeuvre, expected) in flown.items():
        assert manoeuvre.commands is not None
        began = time.process_time()
        found = jm.diagnose(craft, log(kind, manoeuvre.commands), test)
        out[kind] = {
            "outcome": outcome(found, true, rival),
            "named": [f.label for f in found.findings],
            "marked": [list(group[1:]) for group in found.groups],
            "expected_nats": expected,
            "found_nats": evidence(found, true, rival),
            "command_rms": float(np.sqrt((manoeuvre.commands**2).mean())),
            "cpu_s": time.process_time() - began,
        }
    return out


def row(name: str, seed: int, out: Path) -> Row:
    """One pair and seed, from its file where it was done before."""
    folder = out / f"{name}_{seed:02d}"
    path = folder / "row.json"
    if path.exists():
        return json.loads(path.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    pair = PAIRS[name]
    craft = jm.load_vehicle(pair.file)
    began = time.process_time()
    causes = [cause_named(craft, words) for words in (*pair.causes, *pair.beside)]
    made = plan(craft, causes, pair.duration, pair.box, seed)
    spent = time.process_time() - began
    if not made.random:
        raise jm.InputError(f"{name}: no random manoeuvre of seed {seed} stays in the box.")
    found = {"pair": name, "seed": seed, "plan_cpu_s": spent, **judged(pair, seed % 2, made, folder, seed)}
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return found


# --- the results ----------------------------------------------------------------------------------


def summary(rows: Sequence[Row]) -> Row:
    """Per pair: how often each outcome, with Wilson intervals, and median evidences."""
    out: Row = {}
    for name in dict.fromkeys(r["pair"] for r in rows):
        own = [r for r in rows if r["pair"] == name]
        out[name] = {"of": len(own)}
        for kind in KINDS:
            here = [r[kind] for r in own]
            counts = {o: sum(h["outcome"] == o for h in here) for o in OUTCOMES}
            told = [h["found_nats"] for h in here if h["found_nats"] is not None]
            out[name][kind] = {
                **counts,
                "decides_ci95": wilson(counts["decides"], len(own)),
                "expected_nats": float(np.median([h["expected_nats"] for h in here])),
                "found_nats": float(np.median(told)) if told else None,
                "command_rms": float(np.median([h["command_rms"] for h in here])),
            }
    return out


def table(found: Row) -> str:
    """One line per pair and kind of manoeuvre."""
    lines = [
        "| pair | vehicle, s | manoeuvre | decides (95 % interval) | undecided | wrong | expected nats "
        "| found nats | rms command |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, of in found.items():
        pair = PAIRS[name]
        for kind in KINDS:
            one = of[kind]
            low, high = one["decides_ci95"]
            told = "–" if one["found_nats"] is None else f"{one['found_nats']:.1f}"
            cells = (
                "`" + "`, `".join(pair.causes) + "`",
                f"{pair.ship}, {pair.duration:g}",
                kind,
                f"{one['decides']} of {of['of']} ({100 * low:.0f} to {100 * high:.0f} %)",
                one["undecided"],
                one["wrong"],
                f"{one['expected_nats']:.1f}",
                told,
                f"{one['command_rms']:.2f}",
            )
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def figure(rows: Sequence[Row], out: Path) -> None:
    """Expected evidence of every seed, and the commands and the track of one planned manoeuvre."""
    names = list(dict.fromkeys(r["pair"] for r in rows))
    plot, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained", width_ratios=[1.4, 1.6, 1])
    for k, (kind, color) in enumerate(zip(KINDS, ("#1f6fb5", "#c2620a"), strict=True)):
        for i, name in enumerate(names):
            nats = [r[kind]["expected_nats"] for r in rows if r["pair"] == name]
            at = i + 0.3 * (k - 0.5) + np.linspace(-0.08, 0.08, len(nats))
            axes[0].plot(at, nats, "o", ms=4, color=color, alpha=0.7, label=kind if i == 0 else None)
    axes[0].axhline(3.0, color="0.6", lw=1, ls="--")
    axes[0].set(yscale="log", ylabel="expected evidence [nats]", xlim=(-0.6, len(names) - 0.4))
    axes[0].set_xticks(range(len(names)), ["\n".join(PAIRS[name].labels) for name in names], fontsize=8)
    pair = PAIRS[names[0]]
    craft = jm.load_vehicle(pair.file)
    log = jm.read_log(out / f"{names[0]}_{rows[0]['seed']:02d}" / "planned.csv", craft)
    assert log.commands is not None
    axes[1].plot(log.t, log.commands, lw=1.2, label=craft.command_names)
    axes[1].set(xlabel="t [s]", ylabel="command [1]", ylim=(-1.05, 1.35), title=" or ".join(pair.labels))
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
    seeds: Annotated[int, typer.Option(min=1, help="Manoeuvres for each pair.")] = 20,
    quick: Annotated[bool, typer.Option("--quick", help="One seed of the first pair.")] = False,
) -> None:
    """Plans manoeuvres that tell causes apart, and diagnoses logs of them and of random ones."""
    names, seeds = (list(PAIRS)[:1], 1) if quick else (list(PAIRS), seeds)
    with study(out, quick), Progress(transient=True) as bar:
        rows = []
        for name in names:
            for seed in bar.track(range(seeds), description=name):
                rows.append(row(name, seed, out))
            # The next pair's programs are others.
            jax.clear_caches()
        found = summary(rows)
        write_results(out, {"pairs": found, "rows": rows}, table(found))
        figure(rows, out)
    print(table(found))


if __name__ == "__main__":
    typer.run(main)
