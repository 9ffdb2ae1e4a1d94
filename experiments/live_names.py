"""Does a craft that is watched get the names that its log gets afterwards?

usage: python -m experiments.live_names --cases DIR --rows FILE --out DIR [--most N] [--quick]

Logs that hide nothing or one effect, as `experiments.blind_matrix` draws them into a folder (`--cases`), are
watched row by row; beside it stands what `diagnose` named of each, as the matrix' rows (`--rows`) have it. It
goes on where it was cut. Writes results.json and results.md.
"""

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import track

import jaxmarine as jm
from experiments._study import program, study, wilson, write_results
from experiments.blind_matrix import GROUPS, group
from experiments.live import names_of, watched
from jaxmarine.fleets._history import label_of

HERE = Path(__file__).parent / "live_names"
KINDS = ("null", "single")
Row = dict[str, Any]


def watched_case(folder: Path, graded: Row) -> Row:
    """What is named of a log while it grows, beside what `diagnose` named of it."""
    vehicle = jm.load_vehicle(folder / "vehicle.toml")
    begun = time.process_time()
    named = names_of(watched(vehicle, jm.read_log(folder / "train.csv", vehicle)))
    return {
        "case": graded["case"],
        "kind": graded["kind"],
        "vehicle": graded["vehicle"],
        "steering": graded["steering"],
        "disturbance": graded["disturbance"],
        "hidden": graded["hidden"],
        "diagnosed": [label_of({"effect": one[0], "target": one[1]}) for one in graded["found"]],
        "named": named,
        "seconds": round(time.process_time() - begun, 1),
        "program": program(),
    }


def summary(rows: list[Row]) -> list[Row]:
    """Of either way to steer: how many logs, on how many the names are the same, how they differ."""
    out = []
    for steered in GROUPS:
        for kind in KINDS:
            some = [row for row in rows if group(row) == steered and row["kind"] == kind]
            differ = [row for row in some if {*named(row)} != {*row["diagnosed"]}]
            out.append(
                {
                    "steered": steered,
                    "kind": kind,
                    "logs": len(some),
                    "same": len(some) - len(differ),
                    "silent": sum(not row["named"] for row in differ),
                    "more": sum({*named(row)} > {*row["diagnosed"]} for row in differ),
                }
            )
    return out


def named(row: Row) -> list[str]:
    return [one["label"] for one in row["named"]]


def table(rows: list[Row]) -> str:
    """What stands in `docs/live.md`, as Markdown."""
    out = ["| steered by | hidden | logs | same names | a watch names nothing | and more | otherwise |"]
    out.append("| --- | --- | --- | --- | --- | --- | --- |")
    for one in summary(rows):
        if one["logs"]:
            low, high = wilson(one["same"], one["logs"])
            other = one["logs"] - one["same"] - one["silent"] - one["more"]
            hidden = "nothing" if one["kind"] == "null" else "one effect"
            out.append(
                f"| {one['steered']} | {hidden} | {one['logs']} | {one['same']} ({low:.0%} to {high:.0%}) | "
                f"{one['silent']} | {one['more']} | {other} |"
            )
    return "\n".join(out) + "\n"


def main(
    cases: Annotated[Path, typer.Option(help="Folder of logs as `blind_matrix` draws them.")],
    rows: Annotated[Path, typer.Option(help="Its rows: results.json.")],
    out: Annotated[Path, typer.Option(help="Where rows and results are written.")],
    most: Annotated[int, typer.Option(help="Logs that are watched at most.")] = 60,
    quick: Annotated[bool, typer.Option("--quick", help="Two logs.")] = False,
) -> None:
    """Watches logs whose diagnosis is known."""
    graded = [row for row in json.loads(rows.read_text())["rows"] if row["kind"] in KINDS]
    there = [row for row in graded if (cases / row["case"]).exists()][: 2 if quick else most]
    with study(out, quick):
        found = []
        for one in track(there, "watching"):
            kept = out / f"{one['case']}.json"
            if not kept.exists():
                kept.write_text(json.dumps(watched_case(cases / one["case"], one), indent=1) + "\n")
            found.append(json.loads(kept.read_text()))
        write_results(out, {"program": program(), "table": summary(found), "rows": found}, table(found))
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
