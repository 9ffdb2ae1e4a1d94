"""Contenders timed by turns in one process, warm, with what they got wrong beside what they took."""

import contextlib
import dataclasses
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.progress import track
from threadpoolctl import threadpool_limits

from experiments._study import study, write_results

# A pytree of arrays that can be compared with a reference.
Run = Callable[[], Any]

VERSIONS = ("jax", "diffrax", "optimistix", "equinox", "numpy", "scipy", "casadi", "numba")


class Uncompared(NamedTuple):
    """A result of another kind than the reference: that of a pass which is the unit of the ratios."""

    value: Any


class Missing(Exception):
    """What a contender needs is not on this machine."""


def threads() -> int:
    """Threads that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def benchmark(out: Path, quick: bool) -> Iterator[None]:
    """As `study`, but contenders that calculate by numpy have the threads that XLA takes for itself."""
    with study(out, quick), threadpool_limits(threads(), "blas"):
        yield


def machine() -> dict[str, Any]:
    """Where the times come from."""
    info = Path("/proc/cpuinfo")
    names = (
        [line.partition(":")[2].strip() for line in info.read_text().splitlines()] if info.exists() else []
    )
    versions = {}
    for name in VERSIONS:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "processor": names[4] if len(names) > 4 else platform.machine(),
        "threads": threads(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        **versions,
    }


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of every round, and by how much the result differs from the reference (`difference`)."""

    seconds: tuple[float, ...]
    difference: float | None


@dataclasses.dataclass(frozen=True)
class Table:
    """Contenders for one question.

    - `against`: the one whose time is the unit of the ratios.
    - `unit`: what is counted; a run has `per` of them.
    - `skipped`: contenders that this machine does not have, and why.
    """

    title: str
    timings: Mapping[str, Timing]
    against: str
    unit: str = "run"
    per: int = 1
    skipped: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def ratio(self, name: str, against: str) -> float | None:
        """Median over rounds: what slows the machine for a while slows both. None where one was skipped."""
        if name not in self.timings or against not in self.timings:
            return None
        mine, other = (np.array(self.timings[n].seconds) for n in (name, against))
        return float(np.median(mine / other))

    def markdown(self) -> str:
        lines = [
            f"### {self.title}",
            "",
            f"| | time per {self.unit}, median (range) | times {self.against} | difference |",
            "|---|---|---|---|",
        ]
        for name, timing in self.timings.items():
            low, middle, high = (f(timing.seconds) / self.per for f in (np.min, np.median, np.max))
            ratio = self.ratio(name, self.against)
            shown = "–" if ratio is None else f"{ratio:.3g}"
            times = f"{spelt(middle)} ({spelt(low)} to {spelt(high)})"
            off = "–" if timing.difference is None else f"{timing.difference:.1e}"
            lines.append(f"| {name} | {times} | {shown} | {off} |")
        lines += [f"| {name} | skipped: {why} | – | – |" for name, why in self.skipped.items()]
        return "\n".join(lines) + "\n"


@dataclasses.dataclass(frozen=True)
class Target:
    """A ratio of two contenders of a table that is to be at most `most`; `times` the second one, where given.

    - `against`: None: the contender's time itself [s].
    """

    what: str
    table: Table
    name: str
    against: str | None
    most: float
    times: float = 1.0

    @property
    def ratio(self) -> float | None:
        """None where a contender was skipped."""
        if self.against is None:
            return float(np.median(self.table.timings[self.name].seconds))
        ratio = self.table.ratio(self.name, self.against)
        return None if ratio is None else ratio / self.times


def spelt(seconds: float) -> str:
    """With the unit that it is read best in."""
    for size, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def difference(result: Any, reference: Any) -> float:
    """The largest difference of any array, in units of that array's largest number in the reference."""
    parts = zip(jax.tree.leaves(result), jax.tree.leaves(reference), strict=True)
    pairs = [(np.asarray(a, float), np.asarray(b, float)) for a, b in parts]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def compared(
    title: str,
    makers: Mapping[str, Callable[[], Run]],
    reference: Any,
    against: str,
    rounds: int,
    unit: str = "run",
    per: int = 1,
    off_by: Callable[[Any, Any], float] = difference,
) -> Table:
    """Every contender that can be made, run once for its result and the warmth, then by turns.

    - `makers`: make a contender ready; they raise `Missing` or `ModuleNotFoundError` where they cannot.
    - `reference`: what all of them should come to; `off_by`: by how much a result misses it.
    """
    ready: dict[str, Run] = {}
    skipped: dict[str, str] = {}
    off: dict[str, float | None] = {}
    for name, make in track(makers.items(), title, transient=True):
        try:
            run = make()
        except (Missing, ModuleNotFoundError) as error:
            skipped[name] = str(error)
            continue
        result = jax.block_until_ready(run())
        off[name] = None if isinstance(result, Uncompared) else off_by(result, reference)
        ready[name] = run
    seconds: dict[str, list[float]] = {name: [] for name in ready}
    for _ in track(range(rounds), title, transient=True):
        for name, run in ready.items():
            start = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name].append(time.perf_counter() - start)
    timings = {name: Timing(tuple(seconds[name]), off[name]) for name in ready}
    return Table(title, timings, against, unit, per, skipped)


def report(
    out: Path, tables: Sequence[Table], targets: Sequence[Target] = (), more: Mapping[str, Any] | None = None
) -> None:
    """Writes results.json, with what there is `more`, and results.md, and prints the latter."""
    reached = [{"what": one.what, "ratio": one.ratio, "at_most": one.most} for one in targets]
    results = {
        "machine": machine(),
        "tables": [dataclasses.asdict(table) for table in tables],
        "targets": reached,
        **(more or {}),
    }
    text = "\n".join(table.markdown() for table in tables)
    if reached:
        text += "\n| target | ratio | at most |\n|---|---|---|\n"
        for one in reached:
            ratio = "not measured" if one["ratio"] is None else f"{one['ratio']:.3g}"
            text += f"| {one['what']} | {ratio} | {one['at_most']:.3g} |\n"
    write_results(out, results, text)
    print(text)
