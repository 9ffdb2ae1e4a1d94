"""Does the plant agree with another simulator? Its runs against that one's logs.

usage: python -m experiments.blind.check_reference CASES_DIR

CASES_DIR: a folder of cases in the format of `cases.py` that another program has simulated. The plant is run
on their true parameters, open loop from rest. Prints the chi-square per sample of every channel, per case and
log; noise alone gives 1. Cases of unknown effects, wrong files and disturbances are left out.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .plant import Effect, Model, observed, simulate
from .vehicle import Array, Vehicle, load

LOGS = ("train.csv", "test.csv")


def hidden(answer: dict[str, Any]) -> list[Effect]:
    """The effects that an answer states."""
    return [
        Effect(f["accept"][0][0], f["accept"][0][1], f["parameters"], f["since"]) for f in answer["findings"]
    ]


def predicted(vehicle: Vehicle, effects: list[Effect], commands: Array, since: bool, heading: float) -> Array:
    """All 18 signals of an open-loop run from rest, (K, 18); `since`: effects may begin within."""
    starts = sorted({0, *(round(e.since * 10) for e in effects if since and e.since is not None)})
    schedule = [
        (
            k,
            Model(
                vehicle,
                [e for e in effects if not since or e.since is None or 10 * e.since <= k + 1e-6],
            ),
        )
        for k in starts
    ]
    start = np.zeros((13, 1))
    start[5] = heading
    run = simulate(schedule, commands[:, :, None], start, len(commands))
    seen = effects if since else [replace(e, since=None) for e in effects]
    return observed(seen, 0.1 * np.arange(len(commands)), run.signals())[:, :, 0]


def compare(case: Path, log: str) -> dict[str, float]:
    """Mean squared normalised difference per channel."""
    vehicle = load(case / "vehicle.toml")
    answer = json.loads((case / "answer.json").read_text())
    data = pd.read_csv(case / log)
    commands = data[list(vehicle.names)].to_numpy()
    heading = answer["options"].get("headings", [0.0, 0.0])[LOGS.index(log)]
    model = predicted(vehicle, hidden(answer), commands, log == "train.csv", heading)
    out = {}
    for name, row in vehicle.signals():
        error = data[name].to_numpy() - model[:, row]
        if name in ("phi", "theta", "psi"):
            error = (error + np.pi) % (2.0 * np.pi) - np.pi
        out[name] = float(np.mean((error / vehicle.noise[row]) ** 2))
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path)
    for case in sorted(x for x in parser.parse_args().cases.iterdir() if x.is_dir()):
        answer = json.loads((case / "answer.json").read_text())
        options = answer["options"]
        if "unknown" in answer or options.get("misfit") or options.get("disturbance"):
            continue
        for log in LOGS:
            chi = compare(case, log)
            print(f"{case.name:14s} {log:9s} " + " ".join(f"{k}={v:.3g}" for k, v in chi.items()))


if __name__ == "__main__":
    main()
