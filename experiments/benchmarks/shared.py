"""What does a diagnosis over workers take: memory of a place that has logs, and what travels?

usage: python -m experiments.benchmarks.shared --out DIR [--quick]

CyberShip II with a weak thruster, logs of 300 s at 10 Hz, four kinds of causes. A diagnosis over two places
in this process, of which every question and every answer is pickled and counted, beside the diagnosis of the
same logs in one process. Memory is what a process holds that is one place and asks itself: it reads, opens,
refines, screens and judges some logs, in a process of its own for each number of them. From these follows
what one log more takes, and what 1000 logs on 8 workers would take, if nothing else came in their way: so
many were not tried. Writes results.json and results.md.
"""

import collections
import dataclasses
import gc
import itertools
import math
import multiprocessing
import pickle
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import psutil
import typer

import jaxmarine as jm
from experiments._study import study, write_results
from experiments.benchmarks._rounds import machine
from jaxmarine.diagnosis._judge import judged
from jaxmarine.diagnosis._knots import missing_wrench
from jaxmarine.diagnosis._shared import opened_over
from jaxmarine.diagnosis._workbench import GROUPS
from jaxmarine.effects import AddedMass, LinearDamping, QuadraticDamping, ThrusterGain
from jaxmarine.examples import hidden
from jaxmarine.fitting import AbstractShares, Share, Shares
from jaxmarine.logs import read_logs
from jaxmarine.vehicle import Vehicle

HERE = Path(__file__).parent / "shared"
CRAFT, TARGET, FACTOR = "cybership2", "port", 0.7
CATALOGUE = (ThrusterGain, LinearDamping, QuadraticDamping, AddedMass)
PLACES = 2
# Questions of a step of a refinement.
STEP = ("cost", "sums", "step")
# What is extrapolated to: logs, and workers.
MANY, WORKERS = 1000, 8


@dataclasses.dataclass(frozen=True)
class Size:
    """How large a run is: logs of the diagnosis, of a place by turns, and their lengths [s]."""

    logs: int = 4
    of_a_place: tuple[int, ...] = (2, 8, 16)
    length: float = 300.0
    test: float = 150.0


QUICK = Size(2, (1, 2), 30.0, 30.0)


class Counted(AbstractShares):
    """Shares, and how often they were asked what, with the bytes of questions and answers of all of them."""

    def __init__(self, shares: AbstractShares):
        self._shares = shares
        self.asked = collections.Counter[str]()
        self.questions = collections.Counter[str]()
        self.answers = collections.Counter[str]()

    def ask(self, question: str, *given: Any, each: Sequence[tuple] | None = None) -> list[Any]:
        answers = self._shares.ask(question, *given, each=each)
        kind = kind_of(question, given)
        self.asked[kind] += 1
        own = each or [()] * len(answers)
        self.questions[kind] += sum(len(pickle.dumps((question, *given, *more))) for more in own)
        self.answers[kind] += sum(len(pickle.dumps(answer)) for answer in answers)
        return answers


def kind_of(question: str, given: Sequence[Any]) -> str:
    """The question, or of a diagnosis the innermost function that it hands over."""
    names = [one.__name__ for one in given if callable(one) and hasattr(one, "__name__")]
    return names[-1] if names else question


def craft() -> Vehicle:
    return jm.load_vehicle(jm.packaged_vehicle(CRAFT))


def recorded(folder: Path, size: Size) -> list[Path]:
    """Files of training logs, and behind them that of a test log, with one weak thruster in all of them."""
    vehicle, paths, test = craft(), list[Path](), None
    for i in range(max(size.logs, *size.of_a_place)):
        lengths = size.length, size.test
        log, test = hidden(vehicle, "thruster_gain", TARGET, {"factor": FACTOR}, lengths, seed=10 * i)
        paths.append(folder / f"train{i}.csv")
        jm.write_log(log, paths[-1])
    assert test is not None
    jm.write_log(test, folder / "test.csv")
    return [*paths, folder / "test.csv"]


# --- what travels ---------------------------------------------------------------------------------------


def travelled(paths: Sequence[Path], count: int) -> dict[str, Any]:
    """A diagnosis over places: what was asked and answered, and how far it is from that of one process."""
    vehicle = craft()
    *train, test = read_logs([*paths[:count], paths[-1]], vehicle)
    parts = np.array_split(np.arange(count), PLACES)
    shares = Counted(Shares([Share(vehicle, [train[i] for i in part]) for part in parts]))
    over = jm.diagnose(vehicle, shares, test, CATALOGUE)
    one = jm.diagnose(vehicle, train, test, CATALOGUE)
    return {
        "logs": count,
        "places": PLACES,
        "steps": shares.asked["cost"],
        "asked": dict(shares.asked),
        "questions": dict(shares.questions),
        "answers": dict(shares.answers),
        "apart": apart(over, one),
    }


def apart(over: jm.Diagnosis, one: jm.Diagnosis) -> dict[str, Any]:
    """The names of both, and the largest relative difference of evidence, sizes and gain where they agree."""
    names = [[finding.label for finding in each.findings] for each in (over, one)]
    out: dict[str, Any] = {"found": names[0], "in_one_process": names[1]}
    if names[0] != names[1]:
        return out
    pairs = list(zip(over.findings, one.findings, strict=True))
    evidence = [(a.log_evidence, b.log_evidence) for a, b in pairs]
    sizes = [(a.parameters[name].value, b.parameters[name].value) for a, b in pairs for name in b.parameters]
    gains = [(over.gain.ratio, one.gain.ratio)]
    return out | {"evidence": off(evidence), "size": off(sizes), "gain": off(gains)}


def off(pairs: Sequence[tuple[float, float]]) -> float:
    """The largest relative difference of pairs; of none it is nothing."""
    return max((abs(a - b) / abs(b) for a, b in pairs), default=0.0)


def by_step(counts: Mapping[str, int]) -> tuple[int, int]:
    """Bytes of the steps of refinements, and of all else."""
    steps = sum(counts.get(kind, 0) for kind in STEP)
    return steps, sum(counts.values()) - steps


# --- what is held ---------------------------------------------------------------------------------------


def placed(out: Path, paths: Sequence[Path], count: int, quick: bool) -> dict[str, Any]:
    """What a process holds that is a place of so many logs and asks itself; to be called in one of its own.

    Memory of the process [bytes] at each stage, and the arrays that who asks has of the logs [bytes].
    """
    memory = dict[str, int]()

    def stage(name: str) -> None:
        gc.collect()
        memory[name] = psutil.Process().memory_info().rss

    with study(out, quick):
        vehicle = craft()
        *train, test = read_logs([*paths[:count], paths[-1]], vehicle)
        stage("read")
        bench = opened_over(vehicle, Shares([Share(vehicle, train)]), test, CATALOGUE, None).bench
        stage("opened")
        model = bench.refine(bench.start(), 3)
        stage("refined")
        screened = bench.screen(model)
        stage("screened")
        # Two models are at hand, as in a search.
        both = [judged(bench, one) for one in (model, bench.refine(model, 2))]
        missing = missing_wrench(both[-1].knots)
        stage("judged")
        asks = {"outline": bench.data, "places": bench.places, "screening": screened, "missing": missing}
        arrays = {name: bytes_of(part) for name, part in asks.items()}
    return {"logs": count, "windows": bench.count, "memory": memory, "arrays": arrays}


def bytes_of(held: Any) -> int:
    """Of all arrays in what is held, each buffer once: what is broadcast takes no more than what it shows."""
    buffers = [_buffer(array) for array in _arrays(held)]
    return sum({one.ctypes.data: one.nbytes for one in buffers}.values())


def _arrays(held: Any) -> Iterator[np.ndarray]:
    if isinstance(held, np.ndarray | jax.Array):
        yield np.asarray(held)
    elif dataclasses.is_dataclass(held):
        for field in dataclasses.fields(held):
            yield from _arrays(getattr(held, field.name))
    elif isinstance(held, Mapping | list | tuple):
        for part in held.values() if isinstance(held, Mapping) else held:
            yield from _arrays(part)


def _buffer(array: np.ndarray) -> np.ndarray:
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def line(runs: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Memory of a place without logs, and of one log more [bytes], by the fewest and the most logs."""
    few, many = (min(runs, key=_logs), max(runs, key=_logs))
    each = (many["memory"]["judged"] - few["memory"]["judged"]) / (many["logs"] - few["logs"])
    return few["memory"]["judged"] - each * few["logs"], each


def _logs(run: Mapping[str, Any]) -> int:
    return run["logs"]


def asking(runs: Sequence[Mapping[str, Any]]) -> float:
    """Arrays of who asks, for each log of the run with most of them [bytes]."""
    most = max(runs, key=_logs)
    return sum(most["arrays"].values()) / most["logs"]


def groups_of(logs: int, windows: int) -> int:
    """Groups that windows are screened in, each log with so many of them: some in a row from `GROUPS` on."""
    return logs * math.ceil(windows / math.ceil(logs * windows / GROUPS))


def on_paper(results: Mapping[str, Any]) -> dict[str, Any]:
    """Of many logs on some workers: memory and answers of each worker, arrays of who asks [bytes].

    Steps are taken to be as many as they were here, memory to grow as between the two largest runs,
    statistics of groups with these, all else with the logs.
    """
    travel, runs = results["travelled"], results["placed"]
    most = max(runs, key=_logs)
    windows = most["windows"] // most["logs"]
    base, each = line(sorted(runs, key=_logs)[-2:])
    own = math.ceil(MANY / WORKERS)
    steps, rest = by_step(travel["answers"])
    groups = groups_of(MANY, windows)
    grouped = travel["answers"]["of_groups"] / groups_of(travel["logs"], windows)
    beside = (rest - travel["answers"]["of_groups"]) / travel["logs"]
    held = most["arrays"]["screening"]
    others = (sum(most["arrays"].values()) - held) / most["logs"]
    return {
        "logs": MANY,
        "workers": WORKERS,
        "groups": groups,
        "memory": base + own * each,
        "answers": steps / travel["places"] + own * beside + groups / WORKERS * grouped,
        "asking": MANY * others + groups * held / groups_of(most["logs"], windows),
    }


# --- what the pages have --------------------------------------------------------------------------------


def facts(results: Mapping[str, Any]) -> list[str]:
    """What the pages say."""
    travel, runs, paper, length = (results[part] for part in ("travelled", "placed", "on_paper", "length"))
    base, each = line(runs)
    counts = [str(run["logs"]) for run in runs]
    told = f"{', '.join(counts[:-1])} and {counts[-1]} logs"
    (steps, rest), (asked, other) = (by_step(travel[part]) for part in ("answers", "questions"))
    places, logs, count = travel["places"], travel["logs"], travel["steps"]
    found = travel["apart"]
    alike = found["found"] == found["in_one_process"]
    within = max(found.get(name, 0.0) for name in ("evidence", "size", "gain"))
    return [
        f"{each / 1e6:.0f} MB for each log of {length:g} s beside {base / 1e9:.2f} GB for imports and "
        f"programs ({told}, {len(CATALOGUE)} kinds of causes)",
        f"each of {count} steps of refinements sends {steps / count / places / 1e3:.1f} kB from each place, "
        f"{steps / places / 1e6:.1f} MB from each in all",
        f"all else that is answered comes to {rest / logs / 1e6:.2f} MB for each log, "
        f"{travel['answers']['of_groups'] / logs / 1e6:.2f} MB of it statistics of groups of windows",
        f"what is asked comes to {(asked + other) / places / 1e6:.1f} MB to each place, "
        f"{asked / places / 1e6:.1f} MB of it in steps",
        f"outline, places, screening and missing wrench take {asking(runs) / 1e6:.1f} MB for each log in the "
        "process that asks",
        f"names what one process names, evidence, size and gain within {within:.0e} of its own"
        if alike
        else f"names {found['found']} where one process names {found['in_one_process']}",
        " and ".join(
            f"{line(pair)[1] / 1e6:.0f} MB from {pair[0]['logs']} to {pair[1]['logs']} logs"
            for pair in itertools.pairwise(runs)
        ),
        f"{paper['logs']} such logs on {paper['workers']} workers would take {paper['memory'] / 1e9:.1f} GB "
        f"of each worker, have {paper['answers'] / 1e6:.0f} MB of answers from each, and take "
        f"{paper['asking'] / 1e9:.1f} GB in the process that asks",
    ]


def memory_table(results: Mapping[str, Any]) -> str:
    """What a place holds at each stage, by its number of logs."""
    runs = results["placed"]
    stages = list(runs[0]["memory"])
    lines = [
        f"| logs | windows | {' | '.join(stages)} | arrays of who asks |",
        "|---" * (len(stages) + 3) + "|",
    ]
    for run in runs:
        cells = [f"{memory / 1e6:.0f} MB" for memory in run["memory"].values()]
        cells.append(f"{sum(run['arrays'].values()) / 1e6:.1f} MB")
        lines.append(f"| {run['logs']} | {run['windows']} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def travel_table(results: Mapping[str, Any], most: int = 8) -> str:
    """What is asked, by the bytes of both ways, the largest first."""
    travel = results["travelled"]
    both = collections.Counter(travel["questions"]) + collections.Counter(travel["answers"])
    lines = ["| asked | times | questions | answers |", "|---|---|---|---|"]
    for kind, _ in both.most_common(most):
        sent, back = (f"{travel[part][kind] / 1e3:.0f} kB" for part in ("questions", "answers"))
        lines.append(f"| `{kind}` | {travel['asked'][kind]} | {sent} | {back} |")
    return "\n".join(lines) + "\n"


def text_of(results: Mapping[str, Any]) -> str:
    said = "\n".join(f"- {one}" for one in facts(results))
    return f"{memory_table(results)}\n{travel_table(results)}\n{said}\n\nThe last line is extrapolated.\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    quick: Annotated[bool, typer.Option("--quick", help="Two logs of 30 s.")] = False,
) -> None:
    """Counts what a diagnosis over workers takes and sends."""
    size = QUICK if quick else Size()
    with study(out, quick), tempfile.TemporaryDirectory() as folder:
        runs, paths = [], recorded(Path(folder), size)
        for count in size.of_a_place:
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
                runs.append(alone.submit(placed, out, paths, count, quick).result())
        results = {
            "machine": machine(),
            "length": size.length,
            "placed": runs,
            "travelled": travelled(paths, size.logs),
        }
        results["on_paper"] = on_paper(results)
        write_results(out, results, text_of(results))
    print(text_of(results))


if __name__ == "__main__":
    typer.run(main)
