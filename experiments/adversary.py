"""What fools the diagnosis? Logs with tricks that no effect of the catalogue is.

usage: python -m experiments.adversary --out DIR [--seed 1] [--fresh] [--quick]

A boat's logs are made by the independent simulator (`experiments/blind`) and then tampered with: columns
exchanged, sensors late, noise misstated, causes that come and go, cancel one another or act in one log
only. Each trick states which answers are honest; any other name is one that it was fooled into, and so is
blame of sensors that are right. It goes on where it was cut and writes results.json and results.md. All of
seed 1 lies in DIR/seed_1. `--fresh`: tricks whose honest answers were written down before any of them was
run; nothing was mended on them.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tomli_w
import typer
from rich.progress import track

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.blind.cases import make_case, with_noise
from experiments.blind.outside import on
from experiments.blind.plant import Effect, Outside
from experiments.blind.vehicle import Array, load

HERE = Path(__file__).parent / "tricks"  # the fresh ones
MENDED = HERE / "mended"  # what fooled it at first was mended on these
SHIP = "cybership2"
TRAIN, TEST = 300.0, 150.0
WEAK = Effect("thruster_gain", "port", {"factor": 0.6})
Tables = tuple[pd.DataFrame, pd.DataFrame]  # of the training and of the test log
NOTHING, REFUSED, BLAMED = "nothing found", "refused", "sensors blamed"


@dataclass(frozen=True)
class Trick:
    """A trick: what is hidden, what is done to the logs and to the file, and which answers are honest.

    - `honest`: any of these alone or together: names, `NOTHING`, `REFUSED`, `BLAMED` (sensors are said to
      contradict one another, or to come at different times).
    - `signals`: it is honest, too, that the cause is unknown and depends on one of these, if there are any.
    """

    text: str
    honest: tuple[str, ...]
    hidden: tuple[Effect | Outside, ...] = ()
    logs: Callable[[Tables, np.random.Generator], Tables] = lambda tables, rng: tables
    signals: tuple[str, ...] = ()
    noise: float = 1.0  # factor on the noise that the file states
    test_only: bool = False  # nothing is hidden in the training log
    train_only: bool = False  # nothing is hidden in the test log

    @property
    def answers(self) -> tuple[str, ...]:
        """The honest answers in words."""
        return (*self.honest, *([f"unknown: {', '.join(self.signals)}"] if self.signals else []))


def both(change: Callable[[pd.DataFrame], pd.DataFrame]) -> Callable[[Tables, np.random.Generator], Tables]:
    """The same done to both logs."""
    return lambda tables, rng: (change(tables[0]), change(tables[1]))


def exchanged(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(port=log["star"], star=log["port"])


def late(columns: list[str], samples: int) -> Callable[[pd.DataFrame], pd.DataFrame]:
    """Columns that come some samples after the others."""

    def change(log: pd.DataFrame) -> pd.DataFrame:
        moved = {name: log[name].shift(samples) for name in columns}
        return log.assign(**moved).iloc[samples:].reset_index(drop=True)

    return change


def outliers(tables: Tables, rng: np.random.Generator) -> Tables:
    """One position in a hundred is 5 m off."""

    def change(log: pd.DataFrame) -> pd.DataFrame:
        off = 5.0 * rng.normal(size=(len(log), 2)) * (rng.random((len(log), 1)) < 0.01)
        return log.assign(x=log["x"] + off[:, 0], y=log["y"] + off[:, 1])

    return change(tables[0]), change(tables[1])


def jittered(tables: Tables, rng: np.random.Generator) -> Tables:
    """Stamps that are off by up to a fifth of a sample."""
    first, second = (log.assign(t=log["t"] + rng.uniform(-0.02, 0.02, len(log))) for log in tables)
    return first, second


def drifting_heading(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(psi=log["psi"] + 0.002 * log["t"])


def between(start: float, end: float, force: float) -> Outside:
    """A push to starboard that comes and goes."""

    def push(t: Array | float, s: Array, nu: Array) -> Array:
        return np.where((np.asarray(t) >= start) & (np.asarray(t) < end), force, 0.0) + 0.0 * nu[0]

    return Outside("push", ("sway",), ("t",), on("sway", push))


def wind(north: float) -> Outside:
    """A constant force in earth axes: a current would drag with the speed through the water."""

    def wrench(t: Array | float, s: Array, nu: Array) -> Array:
        out = np.zeros_like(nu)
        out[0], out[1] = north * np.cos(s[5]), -north * np.sin(s[5])
        return out

    return Outside("wind", ("surge", "sway"), ("psi",), wrench)


def tricks() -> dict[str, Trick]:
    """All tricks, by a short name."""
    pose = ["x", "y", "psi"]
    # What the catalogue has got since a trick was thought of is honest too where it is what was done.
    turned, place = "sensor_delay:attitude", "sensor_delay:position"
    reversed_ = both(lambda log: log.assign(port=-log["port"]))
    rounded = both(lambda log: log.assign(x=log["x"].round(1), y=log["y"].round(1), psi=log["psi"].round(2)))
    degrees = both(lambda log: log.assign(psi=np.rad2deg(log["psi"])))
    percent = both(
        lambda log: log.assign(port=100 * log["port"], star=100 * log["star"], bow=100 * log["bow"])
    )
    asleep = both(lambda log: pd.concat([log.iloc[:1]] * len(log), ignore_index=True).assign(t=log["t"]))
    heavier = (
        Effect("thruster_gain", "all", {"factor": 1.3}),
        Effect("linear_damping", "surge", {"value": 0.3 * 1.33}),
    )
    return {
        "reversed": Trick("one propeller turns the other way", ("thruster_gain:port",), logs=reversed_),
        "exchanged": Trick(
            "two thrusters' columns are exchanged",
            ("exchanged_thrusters:star+port",),
            logs=both(exchanged),
            signals=("port", "star"),
        ),
        "late pose": Trick("the pose comes 0.5 s late", (BLAMED, place, turned), logs=both(late(pose, 5))),
        "late heading": Trick("the heading comes 0.5 s late", (BLAMED, turned), logs=both(late(["psi"], 5))),
        "outliers": Trick("one position in a hundred is 5 m off", (NOTHING,), logs=outliers),
        "jitter": Trick("stamps are off by up to a fifth of a sample", (NOTHING,), logs=jittered),
        "noise understated": Trick("the file states a third of the noise", (NOTHING,), noise=1 / 3),
        "noise overstated": Trick("the file states three times the noise", (NOTHING,), noise=3.0),
        "rounded": Trick("positions in steps of 0.1 m, heading of 0.01 rad", (NOTHING,), logs=rounded),
        "heading drifts": Trick(
            "the heading drifts by 0.002 rad/s",
            ("gyro_bias", BLAMED),
            logs=both(drifting_heading),
            signals=("t", "psi"),
        ),
        "degrees": Trick("the heading in degrees", (REFUSED, BLAMED), logs=degrees),
        "percent": Trick("commands in percent", (REFUSED,), logs=percent),
        "asleep": Trick("one sample repeated for ever", (REFUSED, NOTHING), logs=asleep),
        "in one log": Trick("a weak propeller in the test log only", (NOTHING,), (WEAK,), test_only=True),
        "late cause": Trick(
            "a propeller weakens 12 s before the end",
            ("thruster_gain:port", NOTHING),
            (Effect("thruster_gain", "port", {"factor": 0.6}, since=TRAIN - 12.0),),
        ),
        "comes and goes": Trick(
            "a push from 100 to 200 s",
            ("constant_wrench:sway",),
            (between(100.0, 200.0, 1.0),),
            signals=("t",),
        ),
        "wind": Trick("a constant force in earth axes", ("wind_push",), (wind(1.0),)),
        "cancelling": Trick(
            "more thrust and more drag in surge", ("thruster_gain:all", "linear_damping:surge"), heavier
        ),
    }


def gap(log: pd.DataFrame) -> pd.DataFrame:
    """Forty seconds that were not logged."""
    return log.loc[(log["t"] < 60.0) | (log["t"] >= 100.0)].reset_index(drop=True)


def frozen(log: pd.DataFrame) -> pd.DataFrame:
    """Sway's speed stays what it was for a minute."""
    stuck = (log["t"] >= 50.0) & (log["t"] < 110.0)
    return log.assign(v=log["v"].where(~stuck, log.loc[stuck, "v"].iloc[0]))


def fresh_tricks() -> dict[str, Trick]:
    """Tricks on which nothing was mended, by a short name."""
    mirrored = both(lambda log: log.assign(v=-log["v"]))
    fast = both(lambda log: log.assign(t=1.03 * log["t"]))
    degrees = both(lambda log: log.assign(r=np.rad2deg(log["r"])))
    coarse = both(lambda log: log.assign(**{n: (4 * log[n]).round() / 4 for n in ("port", "star", "bow")}))
    turned = both(lambda log: log.assign(psi=log["psi"] + 0.3))
    one_lost = both(lambda log: log.assign(bow=0.0))
    spikes = both(lambda log: log.assign(u=log["u"].where(log.index % 97 != 0, 0.0)))
    return {
        "gap": Trick("forty seconds are not logged", (NOTHING,), logs=both(gap)),
        "frozen": Trick("the speed of sway is stuck for a minute", (NOTHING, BLAMED), logs=both(frozen)),
        "mirrored": Trick("sway counted to port", (BLAMED, REFUSED), logs=mirrored),
        "fast clock": Trick(
            "a clock that is 3 % fast", (NOTHING, BLAMED, "velocity_scale", "velocity_scale:all"), logs=fast
        ),
        "degrees of yaw": Trick("the rate of yaw in degrees", (BLAMED, REFUSED), logs=degrees),
        "coarse commands": Trick(
            "commands logged in quarters", (NOTHING,), logs=coarse, signals=("port", "star", "bow")
        ),
        "turned compass": Trick(
            "a heading that is 0.3 rad off",
            (BLAMED, "compass_deviation", "velocity_misalignment"),
            logs=turned,
        ),
        "unlogged thruster": Trick(
            "the bow thruster's command is not logged",
            (NOTHING,),
            logs=one_lost,
            signals=("t", "psi", "port", "star"),
        ),
        "dropouts": Trick("one speed in a hundred is zero", (NOTHING,), logs=spikes),
        "weak at first": Trick(
            "a weak propeller in the training log only",
            ("thruster_gain:port", NOTHING),
            (WEAK,),
            train_only=True,
        ),
    }


def tampered(trick: Trick, folder: Path, seed: int) -> None:
    """Writes vehicle.toml, train.csv and test.csv."""
    make_case(folder, SHIP, trick.hidden, seed, duration_train=TRAIN, duration_test=TEST)
    tables = pd.read_csv(folder / "train.csv"), pd.read_csv(folder / "test.csv")
    if trick.test_only or trick.train_only:
        clean = folder / "clean"
        make_case(clean, SHIP, (), seed, duration_train=TRAIN, duration_test=TEST)
        without = pd.read_csv(clean / "train.csv"), pd.read_csv(clean / "test.csv")
        tables = (without[0], tables[1]) if trick.test_only else (tables[0], without[1])
    train, test = trick.logs(tables, np.random.default_rng(seed))
    train.to_csv(folder / "train.csv", index=False)
    test.to_csv(folder / "test.csv", index=False)
    (folder / "vehicle.toml").write_text(tomli_w.dumps(with_noise(load(SHIP).raw, trick.noise)))


def answered(folder: Path) -> dict[str, Any]:
    """What the diagnosis says of the logs in a folder."""
    try:
        vehicle = jm.load_vehicle(folder / "vehicle.toml")
        train, test = (jm.read_log(folder / name, vehicle) for name in ("train.csv", "test.csv"))
        found = jm.diagnose(vehicle, train, test)
    except jm.InputError as error:
        return {"refused": str(error).replace(f"{folder}/", "")}
    except Exception as error:  # what a user would see as a traceback is an answer that fooled it
        return {"crashed": repr(error)}
    labels = [f.label for f in found.findings]
    return {
        "verdict": found.verdict,
        "names": [label for label in labels if not label.startswith("unknown")],
        "unknown": [label.partition(":")[2] for label in labels if label.startswith("unknown")],
        "depends_on": list(found.depends_on),
        "ratio": found.gain.ratio,
        "contradicted": found.contradicted,
        "notes": list(found.notes),
    }


def blamed(said: dict[str, Any]) -> bool:
    """Whether sensors are said to contradict one another, or to come at different times.

    Those that did at the start, before an effect of theirs was taken first, stand among the notes alone. So
    does everything in answers that were kept without `contradicted`.
    """
    words = ["contradict one another"]
    if "contradicted" not in said:
        words += ["contradict what", "than the velocities"]
    notes = said.get("notes", ())
    return bool(said.get("contradicted")) or any(word in note for note in notes for word in words)


def is_honest(trick: Trick, said: dict[str, Any]) -> bool:
    """Whether nothing is said but what is honest."""
    if "crashed" in said:
        return False
    if "refused" in said:
        return REFUSED in trick.honest
    if blamed(said) and BLAMED not in trick.honest:
        return False
    if said["verdict"] == "nothing_found":
        return NOTHING in trick.honest or blamed(said)
    told = not said["unknown"] or bool({*trick.signals} & {*said["depends_on"]})
    return told and set(said["names"]) <= set(trick.honest)


def table(results: dict[str, Any]) -> str:
    lines = ["| trick | honest would be | said | honest |", "|---|---|---|---|"]
    for one in results.values():
        said = one["said"]
        words = [*said.get("names", []), *(f"unknown:{axis}" for axis in said.get("unknown", []))]
        text = ", ".join(words) or said.get("verdict", "crashed" if "crashed" in said else "refused").replace(
            "_", " "
        )
        if blamed(said):
            text += f", {BLAMED}"
        if said.get("depends_on"):
            text += f" (of {', '.join(said['depends_on'])})"
        row = (one["text"], " or ".join(one["honest"]), text, "yes" if one["fair"] else "no")
        lines.append("| " + " | ".join(row) + " |")
    fair = sum(one["fair"] for one in results.values())
    return "\n".join([*lines, "", f"{fair} of {len(results)} answers are honest."]) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for logs and results.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of all logs.")] = 1,
    fresh: Annotated[bool, typer.Option("--fresh", help="Those that nothing was mended on.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Three tricks.")] = False,
) -> None:
    """Tries to fool the diagnosis and writes down what did."""
    chosen = fresh_tricks() if fresh else tricks()
    if quick:
        some = ("mirrored", "gap", "dropouts") if fresh else ("reversed", "degrees", "outliers")
        chosen = {name: chosen[name] for name in some}
    results: dict[str, Any] = {}
    out = out / f"{'fresh' if fresh else 'seed'}_{seed}"
    with study(out, False):
        for name, trick in track(chosen.items(), "tricks", transient=True):
            folder = out / name.replace(" ", "_")
            kept = folder / "said.json"
            if not kept.exists():
                tampered(trick, folder, seed)
                kept.write_text(json.dumps(answered(folder), indent=1) + "\n")
            said = json.loads(kept.read_text())
            fair = is_honest(trick, said)
            results[name] = {"text": trick.text, "honest": trick.answers, "said": said, "fair": fair}
    write_results(out, results, table(results))
    print((out / "results.md").read_text())


if __name__ == "__main__":
    typer.run(main)
