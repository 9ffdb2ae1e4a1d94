"""Tables 6.1 to 6.7 of the thesis, redone: its networks against its least squares, and against fair methods.

    python -m experiments.tethra_tables --out DIR [--seeds N] [--quick]

Every seed is another dive, other noise and other starts of the networks. What a seed has given lies in
`DIR/parts`, so that a run that was cut goes on where it was. Errors are (6.3) to (6.5) in per cent.
"""

import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.progress import Progress

import jaxmarine as jm
from experiments._study import claim_table, decided, number, save_figure, short, study, write_results
from experiments.thesis import baselines, plant
from experiments.thesis.baselines import Estimate
from jaxmarine.fitting import damping_matrices, damping_targets
from jaxmarine.fitting._subnets import mass_of, train_acceleration, train_damping
from jaxmarine.logs import smooth_states

# The craft's two planes of symmetry but for height: surge goes with pitch, sway with roll.
PATTERN = np.eye(6) + np.eye(6, k=4) * [0, 0, 0, 0, 1, 0] + np.eye(6, k=-4) * [1, 0, 0, 0, 0, 0]
PATTERN += np.eye(6, k=2) * [0, 0, 0, 1, 0, 0] + np.eye(6, k=-2) * [0, 1, 0, 0, 0, 0]
ALL = np.arange(6)
DRIVEN = np.array([0, 2, 5])  # surge, heave, yaw: table 6.3
HERE = Path(__file__).parent / "tethra" / "tables"
MATRICES = ("M", "D_l", "D_q")
KINDS = ("diagonal", "off_diagonal", "zero")
TEXT, LONGER, HIT, REALISTIC = "text, 1000 s", "text, 2000 s", "collisions, 1000 s", "realistic, 1000 s"
LISTING, LISTING_LONGER = "listing, 1000 s", "listing, 2000 s"
THREE = f"{TEXT}, surge, heave and yaw"  # the same matrices by these axes alone: table 6.3
NETWORKS, LS, GIVEN = "networks", "LS (6.1)", "LS_2, mass of the networks"
ZEROS, KNOWN = "networks, zeros set (6.6)", "networks, true mass"
WINDOW = 3.0  # [s]
ROUNDING = 1e-12  # by sample: what sums of some thousand terms differ by between machines
ELSEWHERE = f"networks, forces off by {ROUNDING:g}"
SECOND = 1000  # added to a dive's seed for the operator who goes on with it

Printed = Mapping[str, Mapping[str, tuple]]

# Printed errors in per cent: table or section -> case, method -> matrix -> diagonal, off-diagonal, zero.
# Of table 6.7 what does not stand in 6.5 as well.
PRINTED: dict[str, tuple[str, Printed]] = {
    "table 6.2": (
        TEXT,
        {
            NETWORKS: {"M": (10, 9, 6), "D_l": (56, 147, 8), "D_q": (97,)},
            LS: {"M": (18, 23, 10), "D_l": (281, 2060, 60), "D_q": (723,)},
        },
    ),
    "table 6.3": (
        THREE,
        {
            NETWORKS: {"M": (10, 0, 6), "D_l": (31, 0, 2), "D_q": (20,)},
            LS: {"M": (18, 0, 6), "D_l": (87, 0, 15), "D_q": (82,)},
        },
    ),
    "table 6.5": (
        LONGER,
        {
            NETWORKS: {"M": (8, 8, 4), "D_l": (12, 20, 6), "D_q": (20,)},
            LS: {"M": (22, 23, 7), "D_l": (173, 1273, 56), "D_q": (62,)},
        },
    ),
    "sec. 6.2.3": (TEXT, {ZEROS: {"D_l": (31,), "D_q": (31,)}, KNOWN: {"D_l": (10,), "D_q": (25,)}}),
    "table 6.7": (LONGER, {GIVEN: {"D_l": (24, 107, 6), "D_q": (63,)}}),
}
# Diagonals of the matrices that the tables print.
DIAGONALS: dict[str, tuple[str, Printed]] = {
    "table 6.1": (
        TEXT,
        {
            NETWORKS: {
                "M": (255, 222, 236, 51, 49, 53),
                "D_l": (121, 129, 114, 30, 11, 18),
                "D_q": (93, 104, 100, 1, 52, 36),
            },
            LS: {
                "M": (273, 260, 233, 55, 51, 53),
                "D_l": (217, -23, 116, -47, 8, 26),
                "D_q": (18, 105, 96, 247, 131, 30),
            },
        },
    ),
    "table 6.4": (
        LONGER,
        {
            NETWORKS: {
                "M": (249, 229, 231, 52, 50, 53),
                "D_l": (113, 128, 115, 25, 22, 29),
                "D_q": (102, 98, 101, 36, 25, 26),
            },
            LS: {
                "M": (282, 263, 234, 56, 51, 53),
                "D_l": (217, -26, 116, -19, 13, 26),
                "D_q": (38, 90, 101, 48, 15, 30),
            },
        },
    ),
    "table 6.6": (LONGER, {GIVEN: {"D_l": (112, 128, 115, 22, 19, 22), "D_q": (103, 98, 101, 49, 39, 32)}}),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """One kind of data, and which methods beyond the linear ones and the networks it is given to."""

    name: str
    duration: float  # [s] of each operator
    noise: plant.Noise
    operators: int = 1  # one after the other: a second one goes on with the dive of the first
    walls: bool = False
    variants: bool = False  # networks with other masses
    fits: tuple[str, ...] = ()


FULL = (
    Case(TEXT, 1000.0, "text", variants=True, fits=("ml", "trajectory", "reduced")),
    Case(HIT, 1000.0, "text", walls=True, fits=("ml", "trajectory", "rejecting")),
    Case(REALISTIC, 1000.0, "realistic", fits=("ml", "trajectory")),
    Case(LONGER, 1000.0, "text", operators=2),
    Case(LISTING, 1000.0, "listing", fits=("trajectory",)),
    Case(LISTING_LONGER, 1000.0, "listing", operators=2),
)
QUICK = (
    Case(TEXT, 60.0, "text", variants=True),
    Case(HIT, 60.0, "text", walls=True, fits=("rejecting",)),
)


@dataclasses.dataclass(frozen=True)
class Data:
    """A log, and the arrays that methods without a simulation take."""

    log: jm.Log
    nu: Any
    nu_dot: Any
    force: Any
    noise: np.ndarray


def data_of(vehicle: jm.Vehicle, case: Case, seed: int) -> Data:
    """The measured dive of a seed; noise differs between cases and seeds, the first operator's does not."""
    moving = vehicle.place(plant.pool()) if case.walls else vehicle
    seeds = [seed + SECOND * k for k in range(case.operators)]
    clean = plant.dive(moving, case.duration, *seeds)
    count = len(clean.t) // len(seeds)

    def measured(k: int) -> jm.Log:
        part = slice(k * count, (k + 1) * count)
        of_one = dataclasses.replace(
            clean, t=clean.t[part], channels=clean.channels[part], commands=np.asarray(clean.commands)[part]
        )
        return plant.noisy(of_one, case.noise, seeds[k])

    channels = np.concatenate([measured(k).channels for k in range(len(seeds))])
    log = dataclasses.replace(clean, channels=channels)
    noise = np.full(18, np.nan)
    if case.noise == "realistic":
        # Accelerations are slopes of smoothed velocities; so is the attitude that g is taken from.
        track = smooth_states(log, vehicle.dof)
        nu, nu_dot = track.nu, np.gradient(track.nu, log.t, axis=0)
        channels = log.channels.copy()
        channels[:, 3:6] = track.attitude
        force = plant.forces(vehicle, dataclasses.replace(log, channels=channels))
        noise[:12] = [0.02] * 3 + [0.005] * 3 + [0.01] * 6
    else:
        nu, nu_dot = log.channels[:, 6:12], log.channels[:, 12:]
        parts = np.split(plant.forces(vehicle, log), len(seeds))
        spoilt = [plant.noisy_forces(part, case.noise, one) for part, one in zip(parts, seeds, strict=True)]
        force = np.concatenate(spoilt)
        share = 1e-3 if case.noise == "text" else 0.1
        size = np.sqrt((nu**2).mean(axis=0))
        noise[3:6] = 1e-4  # the attitude is exact: what is left is of the integration
        noise[6:12] = share * size / np.sqrt(3.0)
    return Data(log, jnp.asarray(nu), jnp.asarray(nu_dot), jnp.asarray(force), noise)


# --- methods -------------------------------------------------------------------------------------


def by_networks(data: Data, true, variants: bool, seed: int, epochs: int) -> dict[str, Estimate]:
    """The thesis' method, and what becomes of it with other masses."""
    keys = jax.random.split(jax.random.key(seed))
    nets, _ = train_acceleration(data.nu, data.nu_dot, data.force, keys[0], 5, epochs, 1)
    masses = {
        NETWORKS: mass_of(nets, data.nu, data.force, intercept=False),
        "networks, intercept": mass_of(nets, data.nu, data.force),
    }
    if variants:
        masses[ZEROS] = masses[NETWORKS] * PATTERN
        masses["networks, symmetric with zeros"] = mass_of(
            nets, data.nu, data.force, symmetric=True, pattern=PATTERN
        )
        masses[KNOWN] = true["M"]
    out = {}
    for name, mass in masses.items():
        targets = damping_targets(jnp.asarray(mass), data.nu, data.nu_dot, data.force)
        damping, _ = train_damping(data.nu, targets, keys[1], epochs=epochs)
        linear, quadratic = damping_matrices(data.nu, jax.vmap(damping)(data.nu))
        found = None if name == KNOWN else np.asarray(mass)
        out[name] = Estimate(found, np.asarray(linear), np.asarray(quadratic))
    return out


def by_least_squares(data: Data, true, networks: Estimate) -> dict[str, Estimate]:
    arrays = (data.nu, data.nu_dot, data.force)
    return {
        LS: baselines.ls_of_the_thesis(*arrays),
        GIVEN: baselines.ls_with_mass(*arrays, networks.mass),
        "LS_2, true mass": baselines.ls_with_mass(*arrays, true["M"]),
        "LS with Coriolis": baselines.ls_with_coriolis(*arrays),
        "inverse LS": baselines.inverse_ls(*arrays),
        "two-stage LS": baselines.two_stage_ls(*arrays),
    }


def by_fits(vehicle: jm.Vehicle, data: Data, case: Case) -> tuple[dict[str, Estimate], dict]:
    """Maximum likelihood, always from the same guess, never from another method's result."""
    start = baselines.start_of(vehicle)
    everything = data.noise.copy()
    everything[12:] = 1.0  # the fit weighs accelerations by their own scatter
    out, how = {}, {}

    def keep(name: str, fit: jm.Fit):
        out[name] = baselines.estimate_of(fit.vehicle)
        how[name] = {
            "converged": fit.converged,
            "steps": fit.steps,
            "reduced_chi2": fit.reduced_chi2,
            "windows_rejected": len(fit.rejected),
        }

    if "ml" in case.fits:
        keep("acceleration ML", baselines.acceleration_ml(start, data.log, everything))
    if "trajectory" in case.fits:
        keep("trajectory", baselines.trajectory(start, data.log, data.noise, WINDOW, False, 40))
    if "rejecting" in case.fits:
        keep("trajectory, rejecting", baselines.trajectory(start, data.log, data.noise, WINDOW, True, 40))
    if "reduced" in case.fits:
        fewer = dataclasses.replace(start, dof=("surge", "heave", "yaw"))
        keep("acceleration ML, 3 dof", baselines.acceleration_ml(fewer, data.log, everything))
    return out, how


def part(vehicle: jm.Vehicle, case: Case, seed: int, epochs: int) -> dict:
    """All methods on one case of one seed: matrices, errors, how the solves ended, CPU time."""
    began = time.process_time()
    true = plant.truth(vehicle)
    data = data_of(vehicle, case, seed)
    estimates = by_networks(data, true, case.variants, seed, epochs)
    if case.variants:
        # What another machine would make of the same data, as its rounding is another one.
        rounding = ROUNDING * np.random.default_rng(seed).standard_normal(data.force.shape)
        elsewhere = dataclasses.replace(data, force=data.force * (1 + rounding))
        estimates[ELSEWHERE] = by_networks(elsewhere, true, False, seed, epochs)[NETWORKS]
    estimates |= by_least_squares(data, true, estimates[NETWORKS])
    fitted, how = by_fits(vehicle, data, case)
    estimates |= fitted
    matrices = {
        name: {
            key: None if value is None else np.asarray(value).tolist()
            for key, value in zip(MATRICES, (e.mass, e.linear, e.quadratic), strict=True)
        }
        for name, e in estimates.items()
    }
    return {
        "case": case.name,
        "seed": seed,
        "excitation": {
            "nu_std": np.asarray(data.nu).std(axis=0).tolist(),
            "nu_dot_std": np.asarray(data.nu_dot).std(axis=0).tolist(),
        },
        "matrices": matrices,
        "errors": {name: compared(found, true, ALL) for name, found in matrices.items()},
        "driven_errors": {name: compared(found, true, DRIVEN) for name, found in matrices.items()},
        "fits": how,
        "cpu_s": time.process_time() - began,
    }


def compared(found: Mapping[str, Any], true, axes: np.ndarray) -> dict:
    """Errors of the matrices that were found, on some axes."""
    block = np.ix_(axes, axes)
    return {
        key: baselines.errors(np.asarray(value)[block], np.asarray(true[key])[block])
        for key, value in found.items()
        if value is not None
    }


# --- what is written -----------------------------------------------------------------------------


def by_dive(parts: list[dict]) -> dict[str, Any]:
    """What is kept of every dive: errors, those diagonals that are printed, and how the solves ended.

    Case -> method -> matrix -> kind -> dives; what the errors are of is (6.3) to (6.5).
    """
    cases = {
        name: [p for p in parts if p["case"] == name] for name in dict.fromkeys(p["case"] for p in parts)
    }
    kept = {name: _errors([p["errors"] for p in own]) for name, own in cases.items()}
    kept[THREE] = _errors([p["driven_errors"] for p in cases[TEXT]])
    diagonals = {
        table: {
            method: {
                matrix: [np.diag(p["matrices"][method][matrix]).tolist() for p in cases[case]]
                for matrix in matrices
            }
            for method, matrices in methods.items()
        }
        for table, (case, methods) in DIAGONALS.items()
        if case in cases
    }
    fits = {
        name: {
            fit: {what: [p["fits"][fit][what] for p in own] for what in own[0]["fits"][fit]}
            for fit in own[0]["fits"]
        }
        for name, own in cases.items()
    }
    return short({"errors": kept, "diagonals": diagonals, "fits": fits})


def _errors(own: list[dict]) -> dict:
    """Method -> matrix -> kind -> dives, of the kinds that the model's matrix has."""
    return {
        method: {
            matrix: {
                kind: [p[method][matrix][kind] for p in own]
                for kind in (KINDS[:1] if matrix == "D_q" else KINDS)
                if own[0][method][matrix][kind] is not None
            }
            for matrix in own[0][method]
        }
        for method in own[0]
    }


def over_dives(values: list[float]) -> list[float]:
    """Median, least and largest; what has diverged counts as infinite."""
    good = np.where(np.isfinite(values), values, np.inf)
    return [float(f(good)) for f in (np.median, np.min, np.max)]


def errors_table(found: Mapping[str, Any]) -> list[str]:
    """Each as the median, with the least and largest in brackets."""
    lines = ["| method | M diag / off / zero | D_l diag / off / zero | D_q diag |", "|---|---|---|---|"]
    for method, matrices in found.items():
        cells = []
        for matrix in MATRICES:
            three = [map(number, over_dives(values)) for values in matrices.get(matrix, {}).values()]
            cells.append(" / ".join(f"{middle} ({low}..{high})" for middle, low, high in three) or "given")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return lines


def matrix_lines(name: str, values) -> list[str]:
    rows = [" ".join(f"{x:8.1f}" for x in row) for row in values]
    return [f"{name}:", "```text", *rows, "```"]


Side = tuple[str, str]  # case and method
ON = ("diagonal",)
IGNORED = 1.1  # collisions that leave at most a tenth more error are ignored, others are a problem


def each(
    words: str, better: Side, worse: Side, matrices=MATRICES, kinds=ON, share: float = 1.0
) -> tuple[tuple[str, tuple, tuple, float], ...]:
    """A claim for each matrix and kind: the error of one method is below a share of another's."""
    where = {"diagonal": "", "off_diagonal": ", off the diagonal", "zero": ", zero elements"}
    return tuple(
        (f"{words}: {matrix}{where[kind]}", (*better, matrix, kind), (*worse, matrix, kind), share)
        for matrix in matrices
        for kind in kinds
        if matrix != "D_q" or kind == "diagonal"
    )


CLAIMS = (
    *each("table 6.2: networks are better than LS (6.1)", (TEXT, NETWORKS), (TEXT, LS), kinds=KINDS),
    *each(
        "table 6.3: networks are better than LS (6.1) on surge, heave and yaw", (THREE, NETWORKS), (THREE, LS)
    ),
    *each("table 6.5: networks are better than LS (6.1) after 2000 s", (LONGER, NETWORKS), (LONGER, LS)),
    *each("sec. 6.2.2: more data help networks, text noise", (LONGER, NETWORKS), (TEXT, NETWORKS)),
    *each(
        "sec. 6.2.2: more data help networks, listing noise", (LISTING_LONGER, NETWORKS), (LISTING, NETWORKS)
    ),
    *each("sec. 6.2.3: zeros of M set to zero (6.6) help", (TEXT, ZEROS), (TEXT, NETWORKS), MATRICES[1:]),
    *each("sec. 6.2.3: the true mass helps", (TEXT, KNOWN), (TEXT, NETWORKS), MATRICES[1:]),
    *each(
        "table 6.7: networks are better than LS_2 with the same mass",
        (LONGER, NETWORKS),
        (LONGER, GIVEN),
        MATRICES[1:],
    ),
    *each(
        "sec. 6.3: networks ignore collisions (a tenth worse at most)",
        (HIT, NETWORKS),
        (TEXT, NETWORKS),
        share=IGNORED,
    ),
    *each(
        "sec. 6.3: collisions pose problems for LS (6.1) (over a tenth worse)",
        (TEXT, LS),
        (HIT, LS),
        share=1 / IGNORED,
    ),
    *each("ours: networks are better than inverse LS", (TEXT, NETWORKS), (TEXT, "inverse LS"), ("M",)),
    *each("ours: networks are better than two-stage LS", (TEXT, NETWORKS), (TEXT, "two-stage LS"), ("M",)),
)


def claims(errors: Mapping[str, Any]) -> list[dict]:
    """The claims, decided by pairs, dive by dive."""

    def at(case: str, method: str, matrix: str, kind: str) -> list[float]:
        return errors.get(case, {}).get(method, {}).get(matrix, {}).get(kind, [])

    # A run that was cut has more dives of one case than of another.
    pairs = {words: list(zip(at(*better), at(*worse), strict=False)) for words, better, worse, _ in CLAIMS}
    shares = {words: share for words, *_, share in CLAIMS}
    return decided({words: own for words, own in pairs.items() if own}, shares)


# What stands beside the table of all methods on the text's data: case and method.
OTHER = (
    (HIT, NETWORKS),
    (HIT, LS),
    (HIT, "trajectory"),
    (HIT, "trajectory, rejecting"),
    (REALISTIC, NETWORKS),
    (REALISTIC, "two-stage LS"),
    (REALISTIC, "trajectory"),
    (LISTING, NETWORKS),
    (LISTING_LONGER, NETWORKS),
    (LISTING, "trajectory"),
    (LONGER, NETWORKS),
    (LONGER, GIVEN),
    (THREE, "acceleration ML"),
    (THREE, "acceleration ML, 3 dof"),
)


def overview(errors: Mapping[str, Any]) -> str:
    """Medians over dives: all methods on the text's data, some on other data, and with three axes alone."""

    def row(words: str, found: Mapping[str, Any]) -> str:
        cells = [
            " / ".join(number(over_dives(found[m][kind])[0]) for kind in kinds if kind in found.get(m, {}))
            or "given"
            for m, kinds in zip(MATRICES, (KINDS, KINDS[:2], KINDS[:1]), strict=True)
        ]
        return f"| {words} | " + " | ".join(cells) + " |"

    lines = ["| method | M diag / off / zero | D_l diag / off | D_q diag |", "|---|---|---|---|"]
    lines += [row(name, found) for name, found in errors[TEXT].items() if "3 dof" not in name]
    lines += ["", *lines[:2]]
    lines += [
        row(f"{case}: {name}", errors[case][name]) for case, name in OTHER if name in errors.get(case, {})
    ]
    return "\n".join(lines) + "\n"


def beside_printed(errors: Mapping[str, Any]) -> str:
    """Our medians over dives, each followed by the error that the thesis prints."""
    lines = [
        "| ours *printed* | M diag / off / zero | D_l diag / off / zero | D_q diag |",
        "|---|---|---|---|",
    ]

    def cell(ours: Mapping[str, list[float]], printed: tuple) -> str:
        both = zip(KINDS, printed, strict=False)
        return " / ".join(
            f"{number(over_dives(ours[kind])[0]) if kind in ours else '–'} *{x}*" for kind, x in both
        )

    for table, (case, methods) in PRINTED.items():
        for method, printed in methods.items():
            if method in errors.get(case, {}):
                found = errors[case][method]
                cells = [cell(found[m], printed[m]) if m in printed else "given" for m in MATRICES]
                lines.append(f"| {table}: {method} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def diagonals_table(diagonals: Mapping[str, Any]) -> str:
    """The diagonals of the printed matrices and below them ours, element by element medians over dives."""
    lines = ["| diagonal of | M | D_l | D_q |", "|---|---|---|---|"]
    for table, found in diagonals.items():
        for method, ours in found.items():
            rows = {"printed": DIAGONALS[table][1][method], "ours": ours}
            for words, matrices in rows.items():
                cells = [
                    " ".join(f"{x:.0f}" for x in np.median(np.atleast_2d(matrices[m]), axis=0))
                    if m in matrices
                    else "given"
                    for m in MATRICES
                ]
                lines.append(f"| {table}: {method}, {words} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


TARGETS = (
    (TEXT, "two-stage LS", "M", "diagonal", 8.0),
    (TEXT, "acceleration ML", "M", "diagonal", 3.0),
    (TEXT, "acceleration ML", "D_l", "diagonal", 20.0),
    (TEXT, "trajectory", "M", "diagonal", 0.1),
    (TEXT, "trajectory", "D_l", "diagonal", 0.5),
    (TEXT, "trajectory", "D_l", "off_diagonal", 2.0),
    (TEXT, "trajectory", "D_q", "diagonal", 2.0),
    (REALISTIC, "trajectory", "M", "diagonal", 1.0),
    (REALISTIC, "trajectory", "D_l", "diagonal", 5.0),
    (REALISTIC, "trajectory", "D_l", "off_diagonal", 20.0),
    (REALISTIC, "trajectory", "D_q", "diagonal", 30.0),
    (HIT, "trajectory, rejecting", "M", "diagonal", 0.1),
    (HIT, "trajectory, rejecting", "D_l", "diagonal", 0.5),
    (HIT, "trajectory, rejecting", "D_l", "off_diagonal", 2.0),
    (HIT, "trajectory, rejecting", "D_q", "diagonal", 2.0),
)


def reached(errors: Mapping[str, Any]) -> list[dict]:
    """The bars for classical methods, and what was measured."""
    out = []
    for case, method, matrix, kind, bar in TARGETS:
        if method in errors.get(case, {}):
            middle, low, high = over_dives(errors[case][method][matrix][kind])
            out.append(
                {
                    "case": case,
                    "method": method,
                    "what": f"{matrix} {kind}",
                    "bar": bar,
                    "median": middle,
                    "least": low,
                    "largest": high,
                    "met": bool(middle <= bar),
                }
            )
    return out


def remarks(results: Mapping[str, Any]) -> str:
    """What the page says below the claims, from what was kept of the dives."""
    errors, fits = results["errors"], results["fits"]

    def off(case: str, method: str, matrix: str = "M") -> np.ndarray:
        return np.array(errors[case][method][matrix]["diagonal"])

    def middle(case: str, method: str, matrix: str = "M") -> str:
        return number(float(np.median(off(case, method, matrix))))

    more = [c for c in results["claims"] if c["claim"].startswith("sec. 6.2.2")]
    wins = sorted(c["wins"] for c in more)
    rounded = off(TEXT, ELSEWHERE) / off(TEXT, NETWORKS)
    far = np.abs(rounded - 1) > 0.1
    plain, constant = off(TEXT, NETWORKS), off(TEXT, "networks, intercept")
    six, three = off(THREE, "acceleration ML"), off(THREE, "acceleration ML, 3 dof")
    rejected = fits[HIT]["trajectory, rejecting"]["windows_rejected"]
    windows = int(next(case.duration for case in FULL if case.name == HIT) / WINDOW)
    lines = [
        f"LS (6.1) is a weak opponent: its M is off by {middle(TEXT, LS)} %, with the Coriolis forces by "
        f"{middle(TEXT, 'LS with Coriolis')} %, with the noisy accelerations on the left (inverse LS) by "
        f"{middle(TEXT, 'inverse LS')} %. Collisions find little left to spoil: {middle(HIT, LS)} %.",
        f"More data (sec. 6.2.2) are better in {wins[0]} to {wins[-1]} of {len(plain)} dives.",
        "Rounding decides where the networks' training ends, so that their rows vary between machines. With "
        "forces that are off by a part in 10^12, as sums are from one machine to another, the "
        f"largest error of M of a dive changes by {100 * np.median(np.abs(rounded - 1)):.2g} % in the "
        f"median, but in {far.sum()} of {len(far)} dives by more than a tenth ({rounded.min():.2f} to "
        f"{rounded.max():.2f} times).",
        f"In collisions {min(rejected)} to {max(rejected)} of {windows} windows are rejected.",
        "An intercept helps the mass without noise (a test). Here it changes little: M is off by "
        f"{middle(TEXT, 'networks, intercept')} instead of {middle(TEXT, NETWORKS)} %, and better in "
        f"{(constant < plain).sum()} of {len(plain)} dives.",
        f"A model of surge, heave and yaw alone (sec. 4.3.6) finds M worse than one of six axes in "
        f"{(three > six).sum()} of {len(six)} dives, in the median {np.median(three / six):.2g} times.",
    ]
    return "".join(f"- {line}\n" for line in lines)


def markdown(results: Mapping[str, Any], parts: list[dict]) -> str:
    errors = results["errors"]
    counts = {c: len(next(iter(found.values()))["D_l"]["diagonal"]) for c, found in errors.items()}
    lines = ["# Tethra, tables 6.1 to 6.7", ""]
    lines += ["Errors in per cent: median (least..largest) over seeds. " + json.dumps(counts), ""]
    lines += [overview(errors), beside_printed(errors), diagonals_table(results["diagonals"])]
    lines += [claim_table(results["claims"])]
    if len(errors) > len(FULL) and results["fits"][HIT]:
        lines += [remarks(results)]
    lines += ["| bar | at most | median (least..largest) | met |", "|---|---|---|---|"]
    for r in results["bars"]:
        word = f"{number(r['median'])} ({number(r['least'])}..{number(r['largest'])})"
        met = "yes" if r["met"] else "no"
        lines.append(f"| {r['case']}: {r['method']}, {r['what']} | {r['bar']:g} | {word} | {met} |")
    for table, (case, methods) in DIAGONALS.items():
        own = [p for p in parts if p["case"] == case]
        if own:
            lines += ["", f"## The first seed of {table} ({case})"]
            for method in methods:
                for matrix, values in own[0]["matrices"][method].items():
                    if values is not None:
                        lines += matrix_lines(f"{method}, {matrix}", values)
    for case, found in errors.items():
        # A model of three axes says nothing of the others.
        whole = {k: v for k, v in found.items() if case == THREE or "3 dof" not in k}
        lines += ["", f"## All methods: {case}", "", *errors_table(whole)]
    return "\n".join(lines) + "\n"


def figure(parts: list[dict], out: Path) -> None:
    """Every seed's error on the diagonals, method by method, without and with collisions."""
    cases = ["text, 1000 s", "collisions, 1000 s", "realistic, 1000 s"]
    cases = [c for c in cases if any(p["case"] == c for p in parts)]
    names: list[str] = []
    for p in parts:
        names += [n for n in p["errors"] if n not in names and "3 dof" not in n and "set" not in n]
    plot, axes = plt.subplots(1, 3, figsize=(12, 0.35 * len(names) + 1.8), sharey=True)
    for ax, matrix in zip(axes, MATRICES, strict=True):
        for k, (case, colour) in enumerate(zip(cases, ("C0", "C1", "C2"), strict=False)):
            own = [p["errors"] for p in parts if p["case"] == case]
            for row, name in enumerate(names):
                values = [e[name][matrix]["diagonal"] for e in own if matrix in e.get(name, {})]
                label = case.split(",")[0] if row == 0 else None
                height = np.full(len(values), row + 0.22 * (k - 1))
                ax.plot(values, height, "o", ms=3.5, color=colour, alpha=0.8)
                if label:
                    ax.plot([], [], "o", ms=3.5, color=colour, label=label)
        ax.set_xscale("log")
        ax.set_xlabel(f"largest error on the diagonal of {matrix} (%)")
        ax.grid(axis="x", lw=0.4, color="0.8")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[-1].legend(fontsize=8)
    plot.tight_layout()
    save_figure(plot, out / "errors")


def write(parts: list[dict], out: Path) -> None:
    """The results as numbers and tables; called after every part."""
    kept = by_dive(parts)
    results = {
        "claims": claims(kept["errors"]),
        "bars": reached(kept["errors"]),
        **kept,
        "cpu_s": round(sum(p["cpu_s"] for p in parts)),
    }
    write_results(out, results, markdown(results, parts))


def main(
    out: Path = typer.Option(..., help="folder for results, tables and figure"),
    seeds: int = typer.Option(5, help="dives"),
    fits: bool = typer.Option(True, help="maximum likelihood and trajectories too, minutes for each dive"),
    quick: bool = typer.Option(False, help="one dive of a minute, fewer cases and epochs"),
) -> None:
    """Redoes the thesis' tables 6.1 to 6.7 and says claim by claim what holds."""
    cases, seeds, epochs = (QUICK, 1, 10) if quick else (FULL, seeds, 50)
    with study(out, quick):
        (out / "parts").mkdir(exist_ok=True)
        vehicle, parts = plant.tethra(), []
        with Progress() as progress:
            bar = progress.add_task("dives", total=seeds * len(cases))
            for seed in range(seeds):
                for case in cases if fits else (dataclasses.replace(case, fits=()) for case in cases):
                    name = case.name.replace(", ", "_").replace(" ", "")
                    path = out / "parts" / f"{name}_{case.duration:g}s_{epochs}_{len(case.fits)}_{seed}.json"
                    if not path.exists():
                        path.write_text(json.dumps(part(vehicle, case, seed, epochs)))
                    parts.append(json.loads(path.read_text()))
                    write(parts, out)
                    progress.advance(bar)
        figure(parts, out)


if __name__ == "__main__":
    typer.run(main)
