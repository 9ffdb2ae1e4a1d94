"""Defects of sisters told over many dives: how often by chance, and how soon.

usage: python -m experiments.fleet_drift --out DIR [--fleets 20] [--quick]

Fleets of 100 craft of one class with 100 dives each. A dive is the Gaussian summary of a fit: four
coefficients of the hull, which sisters nearly share, and four thrusters' gains, which they do not, as shares
of the file's. Errors of hull and thrusters go together; the number of each dive differs, and dives scatter by
more than is stated. Five craft of each fleet get a defect at some dive from the tenth on: one parameter steps
by so many errors of one dive. Draws with numpy alone; of the package come pooling and alarms. Writes
results.json and results.md.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.stats import chi2

from experiments._study import study, wilson, write_results
from jaxmarine.fleets._drift import Alarm, alarms, change_point
from jaxmarine.fleets._sisters import Class, craft_of, pooled

HULL, THRUSTERS = 4, 4
COUNT = HULL + THRUSTERS
SPREAD = np.repeat([0.02, 0.08], [HULL, THRUSTERS])  # of sisters, standard deviation as a share
SCATTER = 0.02  # from dive to dive beyond what is stated
STATED = 0.03  # median standard error of a dive
DIFFER = 0.3  # of the logarithm of a dive's standard error
TOGETHER = 0.6  # correlation of each thruster's error with the hull's
DEFECTS, FIRST, SOON = 5, 10, 3
# In errors of one dive. One that a dive can tell alone has 5: less than one in 10^5 of eight parameters by
# chance.
STEPS = (3.0, 4.0, 5.0, 6.0, 8.0)
ALONE = 5.0
HERE = Path(__file__).parent / "fleet"


@dataclasses.dataclass(frozen=True)
class Defect:
    craft: int
    parameter: int
    dive: int
    size: float


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Summaries of a fleet, what is true of its craft before defects, and the defects."""

    values: np.ndarray  # (craft, dives, parameters)
    covariance: np.ndarray  # (craft, dives, parameters, parameters)
    truth: np.ndarray  # (craft, parameters)
    defects: tuple[Defect, ...]


def simulated(
    rng: np.random.Generator, craft: int, dives: int, step: float, heavy: bool = False
) -> Simulated:
    """A fleet; `heavy`: dives scatter with the tails of a t distribution of four degrees."""
    correlation = np.eye(COUNT)
    for i in range(HULL):
        correlation[i, HULL + i] = correlation[HULL + i, i] = TOGETHER
    std = STATED * np.exp(DIFFER * rng.normal(size=(craft, dives, 1)))
    std = np.broadcast_to(std, (craft, dives, COUNT))
    covariance = std[..., :, None] * correlation * std[..., None, :]
    truth = rng.normal(1.0, SPREAD, (craft, COUNT))
    values = np.repeat(truth[:, None], dives, axis=1)
    defects = []
    for one in rng.choice(craft, DEFECTS, replace=False):
        parameter, dive = int(rng.integers(COUNT)), int(rng.integers(FIRST, dives - SOON))
        # What one dive tells of this parameter, were all others known.
        error = covariance[one, dive] + SCATTER**2 * np.eye(COUNT)
        size = step / np.sqrt(np.linalg.inv(error)[parameter, parameter]) * rng.choice([-1.0, 1.0])
        values[one, dive:, parameter] += size
        defects.append(Defect(int(one), parameter, dive, float(size)))
    scatter = rng.standard_t(4, values.shape) / np.sqrt(2) if heavy else rng.normal(size=values.shape)
    noise = np.einsum("ij,cdj->cdi", np.linalg.cholesky(correlation), rng.normal(size=values.shape)) * std
    return Simulated(values + SCATTER * scatter + noise, covariance, truth, tuple(defects))


def false_alarms(fleet: Simulated, told: list[list[Alarm]]) -> tuple[int, int]:
    """Alarms of craft that have no defect, or none yet, and dives in which there could be one."""
    begins = {one.craft: one.dive for one in fleet.defects}
    dives = int(fleet.values.shape[1])
    until = [int(begins.get(craft, dives)) for craft in range(len(told))]
    count = sum(alarm.dive < end for own, end in zip(told, until, strict=True) for alarm in own)
    return count, sum(until)


def found(fleet: Simulated, told: list[list[Alarm]]) -> list[dict[str, Any]]:
    """Of each defect when it was told, by the right name, and since when it seems to be."""
    out = []
    for one in fleet.defects:
        after = [alarm for alarm in told[one.craft] if alarm.dive >= one.dive]
        right = [alarm for alarm in after if alarm.parameter == one.parameter]
        variance = fleet.covariance[one.craft, :, one.parameter, one.parameter] + SCATTER**2
        change = change_point(fleet.values[one.craft, :, one.parameter], np.sqrt(variance))
        out.append(
            {
                "dives": right[0].dive - one.dive + 1 if right else None,
                "other": bool(after) and after[0].parameter != one.parameter,
                "nats": change.nats,
                "off": change.dive - one.dive,
            }
        )
    return out


def pooling(fleet: Simulated, common: Class) -> tuple[float, float]:
    """Root mean square error of the first dive's parameters: alone, and with what sisters say."""
    well = [i for i in range(len(fleet.truth)) if i not in {one.craft for one in fleet.defects}]
    alone = fleet.values[well, 0] - fleet.truth[well]
    with_sisters = np.array([craft_of(common, fleet.values[i, :1], fleet.covariance[i, :1])[0] for i in well])
    return float(np.sqrt((alone**2).mean())), float(np.sqrt(((with_sisters - fleet.truth[well]) ** 2).mean()))


def rate(count: int, dives: int) -> list[float]:
    """Alarms per 1000 dives, and its 95 % interval (Garwood 1936)."""
    ends = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0, chi2.ppf(0.975, 2 * count + 2) / 2
    return [1000 * float(x) / dives for x in (count, *ends)]


def measured(fleets: int, craft: int, dives: int, step: float, heavy: bool = False) -> dict[str, Any]:
    """What is told of so many fleets with steps of one size."""
    rng = np.random.default_rng([int(10 * step), heavy])
    false = possible = 0
    told_of, errors, classes = [], [], []
    for _ in range(fleets):
        fleet = simulated(rng, craft, dives, step, heavy)
        common = pooled(list(fleet.values), list(fleet.covariance))
        told = [alarms(common, *one) for one in zip(fleet.values, fleet.covariance, strict=True)]
        more, where = false_alarms(fleet, told)
        false, possible = false + more, possible + where
        told_of += found(fleet, told)
        errors.append(pooling(fleet, common))
        classes.append(common)
    soon = sum(one["dives"] is not None and one["dives"] <= SOON for one in told_of)
    return {
        "step": step,
        "heavy": heavy,
        "dives": possible,
        "false": false,
        "false_per_1000": rate(false, possible),
        "defects": len(told_of),
        "soon": soon,
        "soon_share": [soon / len(told_of), *wilson(soon, len(told_of))],
        "median_dives": float(np.median([one["dives"] or np.inf for one in told_of])),
        "other_first": sum(one["other"] for one in told_of),
        "median_nats": float(np.median([one["nats"] for one in told_of])),
        "begin_within_one": sum(abs(one["off"]) <= 1 for one in told_of),
        "spread": np.mean([one.spread for one in classes], axis=0).tolist(),
        "scatter": np.mean([one.scatter for one in classes], axis=0).tolist(),
        "first_dive_error": np.mean(errors, axis=0).tolist(),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as the README has them."""
    lines = [
        "| step, errors of one dive | false alarms per 1000 dives | told within 3 dives | median dives | "
        "begins within one dive |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        low, high = row["false_per_1000"][1:]
        lines.append(
            f"| {row['step']:g}{', scatter with heavy tails' if row['heavy'] else ''} "
            f"| {row['false_per_1000'][0]:.2f} ({low:.2f} to {high:.2f}) | {row['soon']} of {row['defects']} "
            f"| {row['median_dives']:g} | {row['begin_within_one']} |"
        )
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    fleets: Annotated[int, typer.Option(min=1, help="Fleets for each size of the defects.")] = 20,
    quick: Annotated[bool, typer.Option("--quick", help="One small fleet.")] = False,
) -> None:
    """Measures false alarms, and how soon defects are told."""
    with study(out, quick):
        size = (1, 30, 40) if quick else (fleets, 100, 100)
        cases = [(ALONE, False)] if quick else [*((step, False) for step in STEPS), (ALONE, True)]
        rows = [measured(*size, step, heavy) for step, heavy in cases]
        write_results(out, {"rows": rows}, table(rows))


if __name__ == "__main__":
    typer.run(main)
