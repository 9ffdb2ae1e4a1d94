"""Can the diagnosis be trusted? Hundreds of logs with a known answer, graded.

usage: python -m experiments.blind_matrix --out DIR [--blocks 25] [--feedback 0.5] [--geared 0] [--jobs 2]
                                          [--seed 1] [--quick]

A block is 24 logs: 6 with nothing hidden, 8 with one effect, 4 with two, 3 with an effect outside the
catalogue, 3 with one effect, a vehicle file that is 15 % wrong and a disturbance. Vehicles, effects,
magnitudes, noise and manoeuvres are drawn at random from shuffled decks. A share of the logs is steered by
controllers (a pilot, station keeping, tracking) that act on the noisy samples, in calm water, gusts, slow
forces, waves or a current that wanders. `--geared` draws craft with a propeller and a rudder, with four
fins, and with thrusters that turn for a share of the logs. Of those steered by sticks a third of the logs
with nothing hidden and a fifth of those with effects are disturbed too. The simulator and its step are not
those of the diagnosis
(`experiments/blind`). It goes on where it was cut. Writes results.json, results.md and the figures
reliability and detection.
"""

import itertools
import json
import multiprocessing
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Annotated, Any

import jax
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import program, save_figure, wilson, write_results
from experiments.blind import cases, grading
from jaxmarine.diagnosis import gain_of
from jaxmarine.effects import place
from jaxmarine.vehicle_io import suspect_named

BLOCK = {"nulls": 6, "singles": 8, "pairs": 4, "outside": 3, "misfit": 3}
NOISES = (0.5, 1.0, 2.0)
# Magnitudes: from hardly to be seen to gross; what counts is 30 % more prediction error and above.
SEVERITY = {"singles": (1.05, 8.0)}
DETECTABLE = 1.3
# Kinds of logs that hide causes of the catalogue.
NAMED = {"single": "one effect", "pair": "two effects", "misfit": "wrong file, disturbed"}
SURE = 0.99
UNNAMED = "an unnamed one"  # program of rows that do not state theirs
SHIPS = ("bluerov2_heavy", "cybership2", "minesniper", "otter", "tethra")
CHUNK = 15  # logs for one process: its programs are compiled once for a vehicle
Row = dict[str, Any]

GROUPS = ("sticks", "feedback")
HERE = Path(__file__).parent / "blind"  # rows that pages show: `by_sticks`, `fed_back`

# What is to be reached, in the order of the table: text, kind, graded by, share of either group.
TARGETS = (
    ("one effect: first name right, or said to be indistinguishable from it", "single", "first", 0.98, 0.95),
    ("one effect: whole answer right", "single", "whole", 0.96, 0.90),
    ("two effects: both and nothing else", "pair", "whole", 0.92, 0.85),
    ("nothing hidden: `nothing_found`", "null", "whole", 0.98, 0.96),
    ("outside the catalogue: said to be unknown", "outside", "first", 0.95, 0.90),
    ("outside the catalogue: a right signal named", "outside", "signal", 0.95, 0.90),
    ("wrong file, disturbed: first structural name right", "misfit", "first", 0.96, 0.92),
    ("wrong file, disturbed: whole answer right", "misfit", "whole", 0.90, 0.85),
)
# Share of parameters whose 95 % interval is to hold the truth.
COVERED = {"sticks": (0.93, 0.97), "feedback": (0.92, 0.98)}


# --- the logs -------------------------------------------------------------------------------------


def written(
    out: Path,
    block: int,
    seed: int,
    ships: Sequence[str],
    content: dict[str, int],
    feedback: float,
    geared: float = 0.0,
) -> None:
    """Writes the cases of a block that are not there yet: all, or none of them."""
    done = out / f"block_{block:02d}.done"
    if done.exists():
        return
    counts = [content[kind] for kind in cases.KINDS]
    plan = cases.Plan(*counts, train=300.0, test=150.0, noises=NOISES, feedback=feedback, geared=geared)
    designer = cases.Designer(plan, ships, seed=seed * 1000 + block)
    for kind, count in content.items():
        low, high = SEVERITY.get(kind, cases.SEVERITIES.get(kind, (1.0, 1.0)))
        for number, severity in enumerate(cases.spread_severities(count, low, high, designer.rng)):
            folder = out / f"{kind.removesuffix('s')}_{block:02d}_{number}"
            designer.write(folder, kind, block * count + number, float(severity))
    done.touch()


# --- one log --------------------------------------------------------------------------------------


def true_gain(vehicle: jm.Vehicle, train: jm.Log, test: jm.Log, answer: Row) -> float:
    """Held-out error ratio of the true structure, refitted from the true values."""
    causes = []
    for hidden in answer["findings"]:
        suspect = suspect_named(vehicle, *hidden["accept"][0])
        values = {name: x for name, x in hidden["parameters"].items() if name in suspect.slots}
        effect = place(suspect, vehicle, values)
        causes.append(jm.Placed(effect, suspect.target, hidden["since"], train.name))
    return gain_of(vehicle, train, test, causes).ratio


def sure(answer: Row, diagnosis: Row) -> Row:
    """How sure the evidences are of the first name, and whether it is right by itself.

    `probability`: that it is the right one of those weighed; None where nothing was named.
    """
    first = grading.first_judged(answer, diagnosis)
    if first is None or first["effect"] == "unknown":
        return {"probability": None, "own_name": False}
    others = [a["log_evidence"] - first["log_evidence"] for a in first["alternatives"]]
    return {
        "probability": float(1.0 / (1.0 + np.exp(np.clip(others, -700, 700)).sum())),
        "own_name": any(grading.own_name(first, h) for h in answer.get("findings", ())),
    }


def row(folder: Path) -> Row:
    """One case, diagnosed and graded."""
    answer = json.loads((folder / "answer.json").read_text())
    vehicle = jm.load_vehicle(folder / "vehicle.toml")
    train, test = (jm.read_log(folder / name, vehicle) for name in ("train.csv", "test.csv"))
    began = time.perf_counter()
    diagnosis = jm.diagnose(vehicle, train, test).to_json()
    seconds = time.perf_counter() - began
    options = answer["options"]
    kept = ("vehicle", "excitation", "severity", "floor", "noise", "disturbance", "outside")
    true_ratio = true_gain(vehicle, train, test, answer) if answer.get("findings") else None
    return {
        "case": folder.name,
        "kind": grading.kind(answer),
        **{name: options.get(name) for name in kept},
        "steering": options.get("steering", GROUPS[0]),
        "hidden": [f["accept"][0] for f in answer.get("findings", [])] or options.get("outside"),
        **grading.grade(answer, diagnosis),
        "since": grading.timely(answer, diagnosis),
        "verdict": diagnosis["verdict"],
        "found": [[f["effect"], f["target"], f["log_evidence"]] for f in diagnosis["findings"]],
        "depends_on": diagnosis["residual_after"]["depends_on"],
        **sure(answer, diagnosis),
        "parameters": grading.parameter_errors(answer, diagnosis),
        "ratio": diagnosis["gain"]["ratio"],
        "true_ratio": true_ratio,
        "seconds": round(seconds, 2),
    }


def graded(folders: Sequence[Path]) -> int:
    """Diagnoses some cases of one vehicle and leaves a row beside each."""
    jax.config.update("jax_enable_x64", True)
    by = program()
    for folder in folders:
        whole = json.dumps({**row(folder), "program": by}, indent=1) + "\n"
        (folder / "row.json").write_text(whole)
    return len(folders)


def chunks(out: Path) -> Iterator[list[Path]]:
    """Cases without a row, some of one vehicle at a time."""
    waiting: dict[str, list[Path]] = {}
    for answer in sorted(out.glob("*/answer.json")):
        if not (answer.parent / "row.json").exists():
            ship = json.loads(answer.read_text())["options"]["vehicle"]
            waiting.setdefault(ship, []).append(answer.parent)
    for folders in waiting.values():
        for k in range(0, len(folders), CHUNK):
            yield folders[k : k + CHUNK]


# --- what comes of it -----------------------------------------------------------------------------


def detectable(r: Row) -> bool:
    return r["kind"] == "null" or r["severity"] >= DETECTABLE


def group(r: Row) -> str:
    """By what a log is steered; rows that do not state it are of sticks."""
    return GROUPS[r.get("steering", GROUPS[0]) != GROUPS[0]]


def strict(r: Row) -> bool:
    """Whether exactly the hidden causes are named, by their own names and targets."""
    return Counter((effect, target) for effect, target, _ in r["found"]) == Counter(map(tuple, r["hidden"]))


def share(rows: Sequence[Row], key: str) -> Row:
    """How many are right, of how many, with Wilson's interval of 95 %."""
    right, count = sum(bool(r[key]) for r in rows), len(rows)
    low, high = wilson(right, count)
    return {"right": right, "of": count, "low": low, "high": high}


def parameters(rows: Sequence[Row]) -> tuple[list[float], list[bool]]:
    """Relative errors of parameters that are not zero, and whether the 95 % interval holds the truth."""
    errors, covered = [], []
    for r in rows:
        for p in r["parameters"]:
            off = abs(p["value"] - p["true"])
            covered.append(off <= 1.96 * p["std"])
            if p["true"]:
                errors.append(off / abs(p["true"]))
    return errors, covered


def summary(rows: Sequence[Row]) -> Row:
    """All numbers of the table."""
    seen = [r for r in rows if detectable(r)]
    out: Row = {"logs": len(rows), "detectable": len(seen), "targets": []}
    for text, kind, key, *leasts in TARGETS:
        target: Row = {"text": text}
        for steered, least in zip(GROUPS, leasts, strict=True):
            found = share([r for r in seen if r["kind"] == kind and group(r) == steered], key)
            met = found["of"] > 0 and found["right"] >= least * found["of"]
            target[steered] = {**found, "wanted": [least], "met": met}
        out["targets"].append(target)
    holding: Row = {"text": "95 % intervals of parameters: hold the truth"}
    for steered, (least, most) in COVERED.items():
        held = [{"held": h} for h in parameters([r for r in seen if group(r) == steered])[1]]
        found = share(held, "held")
        met = found["of"] > 0 and least <= found["right"] / found["of"] <= most
        holding[steered] = {**found, "wanted": [least, most], "met": met}
    out["targets"].append(holding)
    named = [{**r, "strict": strict(r)} for r in seen if r["kind"] in NAMED]
    out["strict"] = share(named, "strict")
    out["strict_of"] = {kind: share([r for r in named if r["kind"] == kind], "strict") for kind in NAMED}
    weighed = [r for r in seen if r["probability"] is not None]
    sure_ones = [r for r in weighed if r["probability"] >= SURE]
    out["sure"] = {"weighed": len(weighed), **share(sure_ones, "own_name")}
    weak = [r for r in rows if not detectable(r)]
    raised = float(np.median([r["severity"] for r in weak])) - 1.0 if weak else None
    out["weak"] = {"raised_median": raised, **share(weak, "first")}
    errors = parameters(seen)[0]
    out["parameter_error_median"] = float(np.median(errors)) if errors else None
    ratios = [r["ratio"] / r["true_ratio"] for r in seen if r["true_ratio"]]
    out["held_out_over_true_median"] = float(np.median(ratios)) if ratios else None
    begun = [r for r in seen if r["since"] is not None]
    out["since_within_12_s"] = share(begun, "since")
    out["seconds_median"] = float(np.median([r["seconds"] for r in rows])) if rows else None
    out["programs"] = sorted({r.get("program", UNNAMED) for r in rows})
    out["missed"] = [r for r in seen if not r["whole"]]
    return out


def _rate(one: Row, digits: int) -> str:
    """A share in per cent with its interval."""

    def percent(x: float) -> str:
        return f"{100 * x:.{digits}f}"

    rate = percent(one["right"] / one["of"]) if one["of"] else "–"
    return f"{rate} ({percent(one['low'])} to {percent(one['high'])})"


def _wanted(one: Row) -> str:
    """The share that is wanted, or its least and most, in per cent."""
    return " to ".join(f"{100 * x:.0f}" for x in one["wanted"])


def table(s: Row) -> str:
    """The summary as Markdown."""

    def percent(x: float) -> str:
        return f"{100 * x:.1f}"

    lines = [f"{s['logs']} logs, {s['detectable']} of them with nothing hidden or detectable.", ""]
    if len(s["programs"]) > 1:
        lines += [f"Their rows come from {len(s['programs'])} programs: {', '.join(s['programs'])}.", ""]

    def cells(t: Row) -> list[str]:
        return [f"{t['right']} of {t['of']}", _rate(t, 1), _wanted(t), "yes" if t["met"] else "no"]

    titles = (f"{steered} | % (95 % interval) | wanted % | met" for steered in GROUPS)
    lines += [f"| | {' | '.join(titles)} |", "|---" * (1 + 4 * len(GROUPS)) + "|"]
    for t in s["targets"]:
        beside = [cell for steered in GROUPS for cell in cells(t[steered])]
        lines.append(f"| {t['text']} | {' | '.join(beside)} |")
    exact = s["strict"]
    interval = f"{percent(exact['low'])} to {percent(exact['high'])} %"
    each = ", ".join(f"{NAMED[kind]} {one['right']} of {one['of']}" for kind, one in s["strict_of"].items())
    lines += [
        "",
        "A name is right, too, where a cause said to be indistinguishable from it is the truth, or where "
        "both do the same; beside a wrong file false names of damping and added mass are forgiven.",
        "",
        "- Exactly the hidden causes, by their own names, and nothing else, with nothing forgiven: "
        f"{exact['right']} of {exact['of']} ({interval}); {each}.",
    ]
    if s["parameter_error_median"] is not None:
        median = percent(s["parameter_error_median"])
        lines.append(f"- Error of named effects' parameters, median: {median} %.")
    if s["held_out_over_true_median"] is not None:
        ratio = s["held_out_over_true_median"]
        lines.append(f"- 5 s error on held-out data over that of the true structure, median: {ratio:.3f}.")
    begun = s["since_within_12_s"]
    lines.append(f"- Beginnings within 12 s: {begun['right']} of {begun['of']}.")
    sure, weak = s["sure"], s["weak"]
    lines.append(
        f"- Among the causes that are listed, the evidences call {sure['of']} of {sure['weighed']} first "
        f"names {100 * SURE:.0f} % sure and more, of which {sure['right']} are right."
    )
    if weak["of"]:
        lines.append(
            f"- Of {weak['of']} effects that raise the error by less than {100 * (DETECTABLE - 1):.0f} % "
            f"(median {100 * weak['raised_median']:.0f} %), {weak['right']} are named."
        )
    return "\n".join(lines) + "\n\n" + missed_table(s)


def missed_table(s: Row) -> str:
    """The logs that can be seen and are not answered wholly right, as Markdown."""
    lines = [
        "| not right | vehicle | steered by | severity | hidden | found | depends on |",
        "|---" * 7 + "|",
    ]
    for r in s["missed"]:
        hidden = [h if isinstance(h, str) else ":".join(filter(None, h)) for h in r["hidden"] or ["nothing"]]
        found = [":".join(filter(None, f[:2])) for f in r["found"]] or [r["verdict"]]
        steered = r.get("steering", GROUPS[0])
        if group(r) != GROUPS[0]:
            steered += f", {r['disturbance']}"
        names = map(", ".join, (hidden, found, r["depends_on"]))
        line = (r["case"], r["vehicle"], steered, f"{r['severity']:.2f}", *names)
        lines.append("| " + " | ".join(line) + " |")
    return "\n".join(lines) + "\n"


def table_of(s: Row, steered: str) -> str:
    """What was wanted and met of logs steered in one way, as Markdown."""
    lines = ["| | right | of | % (95 % interval) | wanted % |", "|---" * 5 + "|"]
    for t in s["targets"]:
        one = t[steered]
        cells = (t["text"], str(one["right"]), str(one["of"]), _rate(one, 0), _wanted(one))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _marked(ax, x: float, found: Row) -> None:
    """A share with its interval and the number of logs."""
    rate = found["right"] / found["of"]
    reach = np.clip([[rate - found["low"]], [found["high"] - rate]], 0.0, 1.0)
    ax.errorbar([x], [rate], reach, fmt="o", color="#1f6fb5", capsize=3)
    ax.annotate(f"{found['of']}", (x, rate), xytext=(6, -12), textcoords="offset points", fontsize=8)


def reliability(rows: Sequence[Row], path: Path) -> None:
    """How often the first name is right by itself against how sure the evidences are of it."""
    said = [r for r in rows if r["probability"] is not None and detectable(r)]
    plot, ax = plt.subplots(figsize=(5, 4), layout="constrained")
    ax.plot([0, 1], [0, 1], color="0.6", lw=1)
    for low, high in itertools.pairwise([0.0, 0.5, 0.9, 0.99, 1.0 + 1e-9]):
        inside = [r for r in said if low <= r["probability"] < high]
        if inside:
            _marked(ax, float(np.mean([r["probability"] for r in inside])), share(inside, "own_name"))
    ax.set(
        xlabel="probability of the first name, by the evidences",
        ylabel="share of first names that are right",
        xlim=(0, 1.02),
        ylim=(0, 1.05),
    )
    ax.spines[["top", "right"]].set_visible(False)
    save_figure(plot, path)


def detection(rows: Sequence[Row], path: Path) -> None:
    """How often one hidden effect is named, over its severity."""
    singles = [r for r in rows if r["kind"] == "single"]
    plot, ax = plt.subplots(figsize=(5.5, 4), layout="constrained")
    ax.axvline(DETECTABLE, color="0.6", lw=1, ls="--")
    for low, high in itertools.pairwise([*np.geomspace(1.0, 10.0, 10), np.inf]):
        inside = [r for r in singles if low <= r["severity"] < high]
        if inside:
            middle = float(np.exp(np.mean(np.log([r["severity"] for r in inside]))))
            _marked(ax, middle, share(inside, "first"))
    ax.set(
        xscale="log",
        xlabel="5 s prediction error with the effect left out, over the floor",
        ylabel="share named first",
        ylim=(0, 1.05),
    )
    ax.set_xticks([1.1, 1.3, 2, 3, 5, 8, 12], ["1.1", "1.3", "2", "3", "5", "8", "12"])
    ax.minorticks_off()
    ax.spines[["top", "right"]].set_visible(False)
    save_figure(plot, path)


def main(
    out: Annotated[Path, typer.Option(help="Folder for cases, rows, results and figures.")],
    blocks: Annotated[int, typer.Option(min=1, help="Blocks of 24 logs.")] = 25,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all draws; another one gives other logs.")] = 1,
    feedback: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of the logs that a controller steers.")
    ] = 0.5,
    geared: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Share of the logs of craft with propellers, surfaces or azimuths."
        ),
    ] = 0.0,
    quick: Annotated[bool, typer.Option("--quick", help="Three logs of one craft.")] = False,
) -> None:
    """Draws logs that hide something, diagnoses and grades them."""
    drawn = (f"_{feedback:g}" if feedback else "") + (f"_geared_{geared:g}" if geared else "")
    folder = out / (f"cases_{seed}{drawn}" + ("_quick" if quick else ""))
    folder.mkdir(parents=True, exist_ok=True)
    ships, content = SHIPS, BLOCK
    if quick:
        ships, blocks = ("cybership2",), 1
        content = {"nulls": 1, "singles": 1, "pairs": 0, "outside": 1, "misfit": 0}
    spawn = multiprocessing.get_context("spawn")
    # A process ends after each of its tasks: compiled programs of hundreds of logs would be too many maps.
    pool = ProcessPoolExecutor(jobs, mp_context=spawn, max_tasks_per_child=1)
    with Progress(transient=True) as bar, pool:
        drawing = bar.add_task("drawing logs", total=blocks)
        drawn = [
            pool.submit(written, folder, block, seed, ships, content, feedback, geared)
            for block in range(blocks)
        ]
        for future in as_completed(drawn):
            future.result()
            bar.advance(drawing)
        waiting = list(chunks(folder))
        diagnosing = bar.add_task("diagnosing", total=sum(map(len, waiting)))
        for future in as_completed([pool.submit(graded, folders) for folders in waiting]):
            bar.advance(diagnosing, future.result())
    rows = [json.loads(path.read_text()) for path in sorted(folder.glob("*/row.json"))]
    found = summary(rows)
    write_results(out, {"seed": seed, **found, "rows": rows}, table(found))
    reliability(rows, out / "reliability.png")
    detection(rows, out / "detection.png")
    print((out / "results.md").read_text())
    counts = Counter(r["kind"] for r in rows)
    print(", ".join(f"{kind} {count}" for kind, count in sorted(counts.items())))


if __name__ == "__main__":
    typer.run(main)
