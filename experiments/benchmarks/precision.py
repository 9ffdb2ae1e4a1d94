"""Which results change in single precision, by how much, and what would it save?

usage: python -m experiments.benchmarks.precision --out DIR [--rounds 7] [--quick]

The ROV Tethra, 300 s at 10 Hz. Every stage runs by turns in double precision and in single, for which jax
itself is switched (`jax.enable_x64(False)`) and all arrays that the stage is given are rounded, so that
nothing inside can be double; the type of the results is checked. `fit`, `least_squares` and `diagnose`
refuse single precision: their stages are the functions below them, which do not ask. What leads to a stage
is calculated in double, and so is what numpy does after it.

Differences are in units of what cannot be known better: predictions in the noise of their sensors, parameters
in their standard errors. Derivatives are taken where double precision ends, and compared by the step
that they ask for there: by so much would a fit end elsewhere. A stage is safe where that is below `SAFE`, and
worth it where it also runs `FASTER`. Writes results.json and results.md.
"""

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxmarine as jm
from experiments._study import write_results
from experiments.benchmarks import gradient, levenberg_marquardt, rollout
from experiments.benchmarks._forms import Dive
from experiments.benchmarks._rounds import Missing, Run, Table, benchmark, compared, machine, spelt
from experiments.benchmarks._windows import DT, Fitting, fitting, logged
from experiments.benchmarks.diagnosis import FACTOR, FEW
from experiments.benchmarks.least_squares import by_loop, drawn, normal_equations
from jaxmarine._compiled import compiled
from jaxmarine.diagnosis._prepare import workbench
from jaxmarine.diagnosis._score import Reduced, savings
from jaxmarine.diagnosis._search import EARLIEST, SHORTLIST, shortlist
from jaxmarine.examples import hidden
from jaxmarine.fitting import Statistics, Task, linearise, noise_of, refine_windows, solve_linear, wrapped
from jaxmarine.fitting._estimate import units
from jaxmarine.fitting._free import set_free
from jaxmarine.fitting._least_squares import _regression, members_of, resample_linear
from jaxmarine.fitting._one_step import groups_of, one_step, scatter_of

DOUBLE, SINGLE = "double", "single"
# Share of the noise, of a standard error or of the cost that may change, and by how much faster it must be.
SAFE, FASTER = 0.01, 1.3
# A log that goes on for long [s], and far from its origin [m].
LATE, FAR = 3600.0, 1000.0

# How far one result is from another, in a stage's unit.
Measure = Callable[[Any, Any], float]


@dataclasses.dataclass(frozen=True)
class Stage:
    """Double and single precision by turns; the table's differences are in `unit`.

    - `remark`: what one number does not say.
    """

    table: Table
    unit: str
    remark: str = ""

    @property
    def off(self) -> float | None:
        """None where the stage did not run in single precision."""
        return self.table.timings[SINGLE].difference if SINGLE in self.table.timings else None

    @property
    def faster(self) -> float | None:
        """How many times."""
        return self.table.ratio(DOUBLE, SINGLE)

    @property
    def verdict(self) -> str:
        if self.off is None or self.faster is None:
            return self.table.skipped[SINGLE]
        # Not a number is not safe.
        if not self.off < SAFE:
            return "not safe"
        return "safe, worth it" if self.faster >= FASTER else "safe, saves little"

    @property
    def row(self) -> str:
        times = {name: spelt(float(np.median(t.seconds))) for name, t in self.table.timings.items()}
        off = "–" if self.off is None else _share(self.off, self.unit)
        faster = "–" if self.faster is None else f"{self.faster:.2f}"
        verdict = "; ".join(filter(None, (self.verdict, self.remark)))
        parts = (self.table.title, times[DOUBLE], times.get(SINGLE, "–"), faster, off, verdict)
        return f"| {' | '.join(parts)} |"


def _share(off: float, unit: str) -> str:
    return f"{off:.3g} times {unit}" if off >= 1 else f"{100 * off:.2g} % of {unit}"


def here(tree: Any) -> Any:
    """The same with its arrays in the precision that is on."""
    return jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a)) if isinstance(a, (jax.Array, np.ndarray)) else a, tree
    )


def stage(
    title: str,
    make: Callable[[], Run],
    off_by: Measure,
    unit: str,
    rounds: int,
    remark: Callable[[Any, Any], str] = lambda single, double: "",
) -> Stage:
    """One stage in both precisions.

    - `make`: makes it ready, called with the precision on, and so is what it returns.
    - `remark`: from the results of single and double precision.
    """
    runs: dict[str, Run] = {}
    results: dict[str, Any] = {}

    def maker(name: str, double: bool) -> Callable[[], Run]:
        with jax.enable_x64(double):
            made = make()

        def run():
            with jax.enable_x64(double):
                return jax.block_until_ready(made())

        runs[name], results[name] = run, run()
        kinds = {np.asarray(leaf).dtype for leaf in jax.tree.leaves(results[name])}
        floats = {kind for kind in kinds if np.issubdtype(kind, np.floating)}

        def ready() -> Run:
            if floats != {np.dtype(np.float64 if double else np.float32)}:
                raise Missing(f"falls back to {DOUBLE}")
            return run

        return ready

    makers = {name: maker(name, name == DOUBLE) for name in (DOUBLE, SINGLE)}
    table = compared(title, makers, results[DOUBLE], DOUBLE, rounds, off_by=off_by)
    return Stage(table, unit, remark(results[SINGLE], results[DOUBLE]))


# --- predictions --------------------------------------------------------------------------------------


def in_noise(vehicle: jm.Vehicle) -> Measure:
    """How far the readings of states [..., 13] are apart, in units of their noise; accelerations left out."""
    plant, noise = vehicle.plant(), vehicle.stated_noise[:12]

    @jax.jit
    @jax.vmap
    def shown(row):
        return plant.readings(rollout.state_of(row), jnp.zeros(6))

    def off(rows, others):
        readings, reference = (shown(jnp.asarray(np.reshape(r, (-1, 13)), float)) for r in (rows, others))
        return float(np.abs(np.asarray(wrapped(readings - reference))[:, :12] / noise).max())

    return off


def roll_outs(steps: int, vehicles: int, rounds: int) -> list[Stage]:
    """Of one vehicle, with and without all that `simulate` does besides; of many, for at most 10 s."""
    alone, many = Dive.of(1, steps), Dive.of(vehicles, min(steps, 100))
    filed = alone.vehicle.plant()

    def one() -> Run:
        plant, start, wrenches = here((filed, alone.starts[0], alone.wrenches[0]))
        run = eqx.filter_jit(rollout.held)
        return lambda: run(plant, start, wrenches)

    def whole() -> Run:
        return rollout.simulated(dataclasses.replace(alone, vehicle=here(alone.vehicle)))

    def all_of_them() -> Run:
        turned = many.starts.T, np.moveaxis(many.wrenches, 0, -1)
        plant, starts, wrenches = here((filed, *turned))
        run = jax.jit(lambda *given: jnp.moveaxis(rollout.held_many(*given), 1, -1))
        return lambda: run(plant, starts, wrenches)

    off, unit = in_noise(alone.vehicle), "the noise"
    return [
        stage(f"Roll-out, {DT * steps:.0f} s", one, off, unit, rounds),
        stage(f"The same by `simulate`, {DT * steps:.0f} s", whole, off, unit, rounds),
        stage(f"Roll-out of {vehicles} vehicles, {DT * many.steps:.0f} s", all_of_them, off, unit, rounds),
    ]


# --- windows ------------------------------------------------------------------------------------------


@compiled
def statistics_of(case: Fitting) -> Statistics:
    return linearise(case.problem, case.affine, case.delta)


@eqx.filter_jit
def step_of(stats: Statistics):
    """The Gauss-Newton step of the parameters, the windows' initial states eliminated."""
    _, g, h = stats.reduced()
    return -jax.scipy.linalg.solve(h.sum(0), g.sum(0), assume_a="pos")


def windows(seconds: float, steps: int, rounds: int) -> list[Stage]:
    """The stages of a fit of 24 coefficients, at its end; all of the fit; and where numbers are large."""
    log = logged(seconds)
    start = fitting(log, steps)
    nothing = jnp.zeros(len(start.theta))

    def fit(given: Fitting):
        # No prior: the log determines all.
        return refine_windows(Task(given.problem, given.affine, here(nothing)), here(nothing), given.delta)

    found = fit(start)
    case = dataclasses.replace(start, theta=start.theta + found.z, delta=found.delta)
    stats = statistics_of(case)
    std = np.sqrt(np.diag(np.linalg.inv(stats.reduced()[2].sum(0))))
    # Where the initial states are held, as the loss of `gradient` holds them.
    h = np.asarray(stats.h_zz.sum(0))

    def in_errors(step, reference):
        return float(np.abs((np.asarray(step, float) - reference) / std).max())

    def in_held_errors(g, reference):
        inverse = np.linalg.inv(h)
        return float(np.abs(inverse @ (g - reference) / np.sqrt(np.diag(inverse))).max())

    def residual_off(residuals, reference):
        return float(np.abs(np.asarray(residuals, float) - reference).max())

    # As another log would have them: later, and not begun at the origin.
    away = np.where(np.arange(18) < 2, FAR, 0.0)
    far = fitting(dataclasses.replace(log, t=log.t + LATE, channels=log.channels + away), steps)
    far = dataclasses.replace(far, theta=case.theta, delta=case.delta)

    def residuals(case: Fitting) -> Callable[[], Run]:
        def make() -> Run:
            given = here(case)
            return lambda: gradient.residuals(given.theta, given)

        return make

    def reverse() -> Run:
        given, step = here(case), jax.checkpoint(gradient.held)
        run = eqx.filter_jit(jax.grad(lambda theta, case: gradient.loss(theta, case, step)))
        return lambda: run(given.theta, given)

    def system() -> Run:
        given = here(case)
        return lambda: statistics_of(given)

    def step() -> Run:
        given = here(case)
        return lambda: step_of(statistics_of(given))

    def whole() -> Run:
        given = here(start)

        def run():
            out = fit(given)
            return out.z, out.steps

        return run

    def in_double(stats: Statistics):
        return np.asarray(step_of(jax.tree.map(lambda a: jnp.asarray(a, float), stats)))

    count, error = len(case.delta), "a standard error"
    return [
        stage(f"Residuals, {count} windows", residuals(case), residual_off, "the noise", rounds),
        stage(
            f"The same {LATE / 3600:.0f} h later and {FAR / 1e3:.0f} km away",
            residuals(far),
            residual_off,
            "the noise",
            rounds,
        ),
        stage("Reverse gradient of their loss", reverse, in_held_errors, error, rounds),
        stage(
            "Gauss-Newton system, p = 24",
            system,
            lambda stats, reference: in_errors(in_double(stats), in_double(reference)),
            error,
            rounds,
        ),
        stage("The same and its step", step, in_errors, error, rounds),
        stage(
            "Fit from its start to its end",
            whole,
            lambda out, reference: in_errors(out[0], np.asarray(reference[0])),
            error,
            rounds,
            lambda single, double: f"{int(single[1])} steps, {int(double[1])} in {DOUBLE}",
        ),
    ]


# --- samples ------------------------------------------------------------------------------------------


def networks(hidden: int, samples: int, epochs: int, rounds: int) -> list[Stage]:
    """Costs of six networks after so many epochs."""
    given = levenberg_marquardt.networks_of(hidden), levenberg_marquardt.samples_of(samples)

    def make() -> Run:
        starts, data = here(given)
        return lambda: levenberg_marquardt.by_normal_equations(starts, data, epochs)

    def off(costs, reference):
        return float(np.abs(np.asarray(costs, float) / reference - 1.0).max())

    return [stage(f"LM of six networks, {epochs} epochs", make, off, "the cost", rounds)]


def equations(seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses and damping of a dive by the equations of motion, as `least_squares` weighs them.

    Regressors [samples, 6, columns], right side [samples, 6] and the window of 4 s that each sample is in.
    """
    vehicle, logs = jm.load_vehicle(jm.packaged_vehicle("tethra")), (logged(seconds),)
    freed, scales = set_free(
        vehicle, lambda v: (v.damping.linear, v.damping.quadratic, v.added_mass), linear=True
    )
    task = one_step(freed, units(freed, scales), logs, noise_of(vehicle, logs))
    matrix, right, _ = (np.asarray(part) for part in _regression(task))
    known = np.asarray(task.samples.weight > 0)
    rest = right - matrix @ np.asarray(solve_linear(*_rows(matrix, right)).values)
    weight = known / scatter_of(rest, known)
    group = groups_of(logs, known.shape[1], 4.0)
    return (matrix * weight[..., None])[0], (right * weight)[0], group[0]


def _rows(matrix: np.ndarray, right: np.ndarray):
    return jnp.asarray(matrix.reshape(-1, matrix.shape[-1])), jnp.asarray(right.ravel())


def least_squares(seconds: float, resamples: int, rounds: int) -> list[Stage]:
    """Linear least squares in two ways, and the bootstrap of their standard errors."""
    matrix, right, group = equations(seconds)
    members, count = members_of(group), matrix.shape[-1]
    std = np.asarray(solve_linear(*_rows(matrix, right)).std)
    keys = jax.random.split(jax.random.key(0), resamples)

    def by_qr(rows, wanted):
        return solve_linear(rows, wanted).values

    def solved(by) -> Callable[[], Run]:
        def make() -> Run:
            rows, wanted = _rows(matrix, right)
            run = jax.jit(by)
            return lambda: run(rows, wanted)

        return make

    def in_errors(values, reference):
        return float(np.abs((np.asarray(values, float) - reference) / std).max())

    def bootstrap() -> Run:
        rows, wanted, groups = here((matrix, right, members))
        return lambda: resample_linear(rows, wanted, groups, keys)

    def scatter_off(draws, _):
        """From numpy's loop over the same draws: each precision makes its own random numbers."""
        with jax.enable_x64(draws.dtype == np.float64):
            counts = drawn(keys, len(members))
        exact = by_loop(matrix, right, group, counts)
        return float(np.abs(np.std(np.asarray(draws, float), axis=0) / np.std(exact, axis=0) - 1.0).max())

    number = np.linalg.cond(matrix.reshape(-1, count))
    size = f"{count} columns, condition {number:.0f}"
    error = "a standard error"
    return [
        stage(f"Least squares, {size}", solved(by_qr), in_errors, error, rounds),
        stage("The same by normal equations, refined", solved(normal_equations), in_errors, error, rounds),
        stage(f"Bootstrap, {resamples} resamples", bootstrap, scatter_off, error, rounds),
    ]


# --- diagnosis ----------------------------------------------------------------------------------------


def screening(seconds: float, catalogue: Any, rounds: int) -> Stage:
    """What every suspect would save by one linearisation, for every window from which it may begin.

    The root of a saving is the suspect's size in units of its standard error.
    """
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    log, _ = hidden(vehicle, "thruster_gain", "port_h", {"factor": FACTOR}, (seconds, 20.0))
    bench = workbench(vehicle, (log,), catalogue, None)
    model = bench.refine(bench.start())
    known, precision, offset = bench.known(model)
    owns = tuple(bench.own(i) for i in bench.open(model))

    def make() -> Run:
        own = copy.copy(bench)
        own._problem = here(bench._problem)
        begun = dataclasses.replace(model, delta=here(model.delta))

        def run():
            # A model that it has not met, or it would remember the answer.
            found = own.screen(dataclasses.replace(begun))
            return found.chi2, found.g, found.h

        return run

    def stats(found) -> Reduced:
        return Reduced(*(np.asarray(part, float) for part in found))

    def sizes(found) -> np.ndarray:
        table = savings(stats(found), known, precision, offset, owns, EARLIEST)
        return np.sqrt(np.maximum(table[np.isfinite(table)], 0.0))

    def off(found, reference):
        return float(np.abs(sizes(found) - sizes(reference)).max())

    def ranked(single, double):
        first, others = (list(shortlist(bench, model, stats(one))[0])[:SHORTLIST] for one in (single, double))
        same = sum(a == b for a, b in zip(first, others, strict=True))
        middle = float(np.median(np.abs(sizes(single) - sizes(double))))
        return (
            f"{_share(middle, 'a standard error')} in the median; {same} of the first {len(others)} in place"
        )

    title = f"Screening, {bench.layout.size} parameters, {bench.count} windows"
    return stage(title, make, off, "a standard error", rounds, ranked)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 7,
    quick: Annotated[bool, typer.Option("--quick", help="Short logs, few vehicles, two rounds.")] = False,
) -> None:
    """Times every stage in double and in single precision, and compares their results."""
    seconds, steps, vehicles, catalogue = (32.0, 8, 8, FEW) if quick else (300.0, 50, 1000, jm.CATALOGUE)
    hidden_nodes, samples, epochs, resamples, rounds = (
        (1, 60, 8, 5, 2) if quick else (5, 10_000, 50, 200, rounds)
    )
    with benchmark(out, quick):
        stages = [
            *roll_outs(round(seconds / DT), vehicles, rounds),
            *windows(seconds, steps, rounds),
            *networks(hidden_nodes, samples, epochs, rounds),
            *least_squares(seconds, resamples, rounds),
            screening(seconds, catalogue, rounds),
        ]
        lines = [
            "| stage | double | single | times faster | largest difference | verdict |",
            "|---|---|---|---|---|---|",
            *(one.row for one in stages),
        ]
        results = {
            "machine": machine(),
            "tables": [dataclasses.asdict(one.table) for one in stages],
            "stages": [
                {"stage": one.table.title, "unit": one.unit, "faster": one.faster, "off": one.off}
                | {"verdict": one.verdict, "remark": one.remark}
                for one in stages
            ],
        }
        text = "\n".join(lines) + "\n"
        write_results(out, results, text)
        print(text)


if __name__ == "__main__":
    typer.run(main)
