"""How does the cost grow with the log, the catalogue, the batch of vehicles and the networks?

usage: python -m experiments.benchmarks.growth --out DIR [--rounds 5] [--quick]

Four curves of time and memory, each with the exponent that its larger half shows: of a Gauss-Newton system
over the length of the log (1 min to 10 h at 10 Hz, 24 parameters) and over the number of effects (10 to 60,
a log of 300 s), of a roll-out of 100 steps over the number of vehicles (1 to 10,000), and of a Gauss-Newton
system and a reverse gradient over the weights of a network (50 to 5,000, ten windows of 4 s). Memory is
what the compiled program asks for: arguments, results and temporaries. What asks for more than half of the
machine's is not run.

A system is compared with one forward tangent through the solver along its own gradient, a roll-out with the
equations written by hand. Writes results.json, results.md and the figure growth.
"""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from jaxtyping import Array, Float
from rich.progress import track

import jaxmarine as jm
from experiments._study import save_figure, write_results
from experiments.benchmarks._forms import Dive, by_jax
from experiments.benchmarks._rounds import benchmark, difference, machine, spelt
from experiments.benchmarks._windows import Fitting, Networks, fitting, logged
from experiments.benchmarks.gradient import gauss_newton_of, held, loss, residuals
from experiments.benchmarks.rollout import held_many
from jaxmarine.effects import Craft, Motion, WrenchEffect

WINDOW = 40  # samples
SYSTEM = "Gauss-Newton system"


class Drag(WrenchEffect):
    """A drag with some power of the speed, to fill a catalogue up: X_i = -value_i |nu_i|^power sign(nu_i)."""

    name: ClassVar[str] = "drag"

    value: Float[Array, "6"]
    power: float = eqx.field(static=True)

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        raise NotImplementedError("A drag needs its power.")

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[()]:
        del craft
        return ()

    def __call__(self, motion: Motion) -> Float[Array, "6"]:
        # From 1.5 on the slope at rest is finite.
        return -self.value * jnp.sign(motion.nu_r) * jnp.abs(motion.nu_r) ** self.power


@dataclasses.dataclass(frozen=True)
class Point:
    """One size: seconds of every round (none where it was not run), bytes, difference from the check."""

    size: int
    seconds: tuple[float, ...]
    bytes: int
    difference: float | None


@dataclasses.dataclass(frozen=True)
class Curve:
    """What grows with what: `over` names the sizes of the points."""

    what: str
    over: str
    points: tuple[Point, ...]

    def exponent(self, of: Callable[[Point], float]) -> float | None:
        """Slope of the larger half, both logarithmic: what does not grow weighs on the smaller one."""
        run = [p for p in self.points if p.seconds]
        upper = run[len(run) // 2 :] if len(run) > 2 else run
        if len(upper) < 2:
            return None
        slope, _ = np.polyfit(np.log([p.size for p in upper]), np.log([of(p) for p in upper]), 1)
        return float(slope)

    @property
    def exponents(self) -> dict[str, float | None]:
        return {"time": self.exponent(median), "memory": self.exponent(lambda p: p.bytes)}


def median(point: Point) -> float:
    return float(np.median(point.seconds))


def limit() -> float:
    """Half of the memory that the programs run in [bytes]."""
    stats = jax.devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return 0.5 * stats["bytes_limit"]
    return 0.5 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def measured(
    size: int, function: Callable[..., Any], args: Sequence[Any], rounds: int, off: Callable[[Any], float]
) -> Point:
    """Compiled, and run where there is room; `off` says how far a result is from another way's."""
    program = jax.jit(function).lower(*args).compile()
    asked: Any = program.memory_analysis()
    total = asked.argument_size_in_bytes + asked.output_size_in_bytes + asked.temp_size_in_bytes
    if total > limit():
        return Point(size, (), total, None)
    found = off(jax.block_until_ready(program(*args)))
    seconds = []
    for _ in range(rounds):
        start = perf_counter()
        jax.block_until_ready(program(*args))
        seconds.append(perf_counter() - start)
    return Point(size, tuple(seconds), total, found)


# --- the curves ---------------------------------------------------------------------------------------


def along(case: Fitting, gradient) -> float:
    """By how much the slope of the loss along the gradient differs from that of a forward tangent."""
    direction = jnp.asarray(gradient / jnp.linalg.norm(gradient))

    @jax.jit
    def slope(case, direction):
        return jax.jvp(lambda theta: 0.5 * (residuals(theta, case) ** 2).sum(), (case.theta,), (direction,))[
            1
        ]

    return difference(gradient @ direction, slope(case, direction))


def system(size: int, case: Fitting, rounds: int) -> Point:
    return measured(size, gauss_newton_of, (case,), rounds, lambda found: along(case, found[1]))


def reverse(size: int, case: Fitting, rounds: int) -> Point:
    gradient = jax.grad(lambda theta, case: loss(theta, case, jax.checkpoint(held)))
    return measured(size, gradient, (case.theta, case), rounds, lambda found: along(case, found))


def over_length(lengths: Sequence[int], rounds: int) -> Iterator[Point]:
    for seconds in lengths:
        yield system(seconds, fitting(logged(seconds), WINDOW), rounds)


def over_effects(counts: Sequence[int], seconds: float, rounds: int) -> Iterator[Point]:
    log = logged(seconds)
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    # Those of actuators that this craft has not got have no numbers.
    known = [
        one
        for one in (cls.neutral(vehicle) for cls in jm.CATALOGUE)
        if any(map(jnp.size, jax.tree.leaves(one)))
    ]
    for count in counts:
        families = known[:count]
        more = [Drag(jnp.zeros(6), 1.5 + 0.1 * k) for k in range(count - len(families))]
        yield system(count, fitting(log, WINDOW, [*families, *more]), rounds)


def over_vehicles(counts: Sequence[int], steps: int, rounds: int) -> Iterator[Point]:
    for count in counts:
        dive = Dive.of(count, steps)
        starts, wrenches = jnp.asarray(dive.starts), jnp.asarray(dive.wrenches)
        args = dive.vehicle.plant(), starts.T, jnp.moveaxis(wrenches, 0, -1)
        last = by_jax(dive.model, starts[-1], wrenches[-1])
        yield measured(
            count, held_many, args, rounds, lambda found, last=last: difference(found[..., -1], last)
        )


def over_weights(hidden: Sequence[int], of: Callable[..., Point], rounds: int) -> Iterator[Point]:
    log = logged(WINDOW)  # ten windows
    for units in hidden:
        case = fitting(log, WINDOW, [Networks.of(1, units, 6)])
        yield of(len(case.theta), case, rounds)


# --- the results --------------------------------------------------------------------------------------


def table(curves: Sequence[Curve]) -> str:
    lines = []
    for curve in curves:
        time, memory = ("–" if e is None else f"{e:.2f}" for e in curve.exponents.values())
        lines += [
            f"### {curve.what} over {curve.over}: time to the power {time}, memory {memory}",
            "",
            f"| {curve.over} | time, median (range) | memory [MB] | difference |",
            "|---|---|---|---|",
        ]
        for p in curve.points:
            times, off = "not run: too much memory", "–"
            if p.seconds:
                times = f"{spelt(median(p))} ({spelt(min(p.seconds))} to {spelt(max(p.seconds))})"
                off = f"{p.difference:.1e}"
            lines.append(f"| {p.size} | {times} | {p.bytes / 1e6:.3g} | {off} |")
        lines.append("")
    return "\n".join(lines)


def figure(curves: Sequence[Curve], out: Path) -> None:
    """Time above, memory below; one column for what the cost grows with."""
    overs = list(dict.fromkeys(curve.over for curve in curves))
    plot, axes = plt.subplots(2, len(overs), figsize=(3.2 * len(overs), 5.6), layout="constrained")
    for curve in curves:
        upper, lower = axes[:, overs.index(curve.over)]
        run = [p for p in curve.points if p.seconds]
        rows = ((upper, run, median, "time"), (lower, curve.points, lambda p: p.bytes / 1e6, "memory"))
        for ax, points, of, kind in rows:
            exponent = curve.exponents[kind]
            label = curve.what if exponent is None else f"{curve.what}: {exponent:.2f}"
            ax.loglog([p.size for p in points], [of(p) for p in points], "o-", ms=4, lw=1.2, label=label)
            ax.legend(frameon=False, fontsize=8)
            sizes = [p.size for p in points]
            if max(sizes) < 10 * min(sizes):
                # Less than a decade has no room for labels of its own.
                ax.set_xticks(sizes, [str(size) for size in sizes])
                ax.xaxis.set_minor_formatter("")
            ax.spines[["top", "right"]].set_visible(False)
        lower.set_xlabel(curve.over)
    axes[0, 0].set_ylabel("time [s]")
    axes[1, 0].set_ylabel("memory [MB]")
    save_figure(plot, out / "growth")


def main(
    out: Annotated[Path, typer.Option(help="Folder for results, table and figure.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="Two small sizes of each, one round.")] = False,
) -> None:
    """Times what grows."""
    lengths, effects, seconds, vehicles, steps, hidden = (
        ((8, 16), (1, 2), 8.0, (1, 4), 5, (1, 2))
        if quick
        else (
            (60, 600, 3600, 10_800, 36_000),
            (10, 20, 30, 45, 60),
            300.0,
            (1, 10, 100, 1000, 10_000),
            100,
            (2, 8, 26, 83, 262),
        )
    )
    rounds = 1 if quick else rounds
    questions = (
        (SYSTEM, "length of the log [s]", over_length(lengths, rounds)),
        (SYSTEM, "effects", over_effects(effects, seconds, rounds)),
        ("roll-out", "vehicles", over_vehicles(vehicles, steps, rounds)),
        (SYSTEM, "weights", over_weights(hidden, system, rounds)),
        ("reverse gradient", "weights", over_weights(hidden, reverse, rounds)),
    )
    with benchmark(out, quick):
        curves = []
        for what, over, points in questions:
            curves.append(Curve(what, over, tuple(track(points, over, len(lengths), transient=True))))
            # Programs of other sizes are not needed again.
            jax.clear_caches()
        found = [{**dataclasses.asdict(curve), "exponents": curve.exponents} for curve in curves]
        write_results(out, {"machine": machine(), "curves": found}, table(curves))
        figure(curves, out)
    print(table(curves))


if __name__ == "__main__":
    typer.run(main)
