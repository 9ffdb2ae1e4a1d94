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
from experiments._study import claim_table, decided, number, save_figure, study, write_results
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
WINDOW = 3.0  # [s]
ROUNDING = 1e-12  # by sample: what sums of some thousand terms differ by between machines
ELSEWHERE = f"networks, forces off by {ROUNDING:g}"
SECOND = 1000  # added to a dive's seed for the operator who goes on with it

# Printed errors: method -> matrix -> diagonal, off-diagonal, zero (tables 6.2, 6.3, 6.5, 6.7).
PRINTED = {
    "6.2": {
        "networks": {"M": (10, 9, 6), "D_l": (56, 147, 8), "D_q": (97, None, None)},
        "LS (6.1)": {"M": (18, 23, 10), "D_l": (281, 2060, 60), "D_q": (723, None, None)},
    },
    "6.3": {
        "networks": {"M": (10, 0, 6), "D_l": (31, 0, 2), "D_q": (20, None, None)},
        "LS (6.1)": {"M": (18, 0, 6), "D_l": (87, 0, 15), "D_q": (82, None, None)},
    },
    "6.5": {
        "networks": {"M": (8, 8, 4), "D_l": (12, 20, 6), "D_q": (20, None, None)},
        "LS (6.1)": {"M": (22, 23, 7), "D_l": (173, 1273, 56), "D_q": (62, None, None)},
    },
    "6.7": {
        "networks": {"D_l": (12, 20, 6), "D_q": (20, None, None)},
        "LS (6.1)": {"D_l": (173, 1273, 55), "D_q": (62, None, None)},
        "LS_2, mass of the networks": {"D_l": (24, 107, 6), "D_q": (63, None, None)},
    },
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
    Case("text, 1000 s", 1000.0, "text", variants=True, fits=("ml", "trajectory", "reduced")),
    Case("collisions, 1000 s", 1000.0, "text", walls=True, fits=("ml", "trajectory", "rejecting")),
    Case("realistic, 1000 s", 1000.0, "realistic", fits=("ml", "trajectory")),
    Case("text, 2000 s", 1000.0, "text", operators=2),
    Case("listing, 1000 s", 1000.0, "listing", fits=("trajectory",)),
    Case("listing, 2000 s", 1000.0, "listing", operators=2),
)
QUICK = (
    Case("text, 1000 s", 60.0, "text", variants=True),
    Case("collisions, 1000 s", 60.0, "text", walls=True, fits=("rejecting",)),
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
        "networks": mass_of(nets, data.nu, data.force, intercept=False),
        "networks, intercept": mass_of(nets, data.nu, data.force),
    }
    if variants:
        masses["networks, zeros set (6.6)"] = masses["networks"] * PATTERN
        masses["networks, symmetric with zeros"] = mass_of(
            nets, data.nu, data.force, symmetric=True, pattern=PATTERN
        )
        masses["networks, true mass"] = true["M"]
    out = {}
    for name, mass in masses.items():
        targets = damping_targets(jnp.asarray(mass), data.nu, data.nu_dot, data.force)
        damping, _ = train_damping(data.nu, targets, keys[1], epochs=epochs)
        linear, quadratic = damping_matrices(data.nu, jax.vmap(damping)(data.nu))
        known = name.endswith("true mass")
        out[name] = Estimate(None if known else np.asarray(mass), np.asarray(linear), np.asarray(quadratic))
    return out


def by_least_squares(data: Data, true, networks: Estimate) -> dict[str, Estimate]:
    arrays = (data.nu, data.nu_dot, data.force)
    return {
        "LS (6.1)": baselines.ls_of_the_thesis(*arrays),
        "LS_2, mass of the networks": baselines.ls_with_mass(*arrays, networks.mass),
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
        estimates[ELSEWHERE] = by_networks(elsewhere, true, False, seed, epochs)["networks"]
    estimates |= by_least_squares(data, true, estimates["networks"])
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


def over_seeds(parts: list[dict], case: str, of: str = "errors") -> dict:
    """Median, least and largest error over seeds: method -> matrix -> kind."""
    own = [p[of] for p in parts if p["case"] == case]
    out: dict[str, Any] = {}
    for method in own[0] if own else ():
        out[method] = {}
        for matrix in own[0][method]:
            out[method][matrix] = {}
            for kind in KINDS:
                values = [p[method][matrix][kind] for p in own]
                if None not in values:
                    good = np.where(np.isfinite(values), values, np.inf)
                    out[method][matrix][kind] = [float(f(good)) for f in (np.median, np.min, np.max)]
    return out


def cell(values: Mapping[str, list[float]]) -> str:
    """Diagonal / off-diagonal / zero, each as median, with the least and largest in brackets."""
    words = []
    for kind in KINDS:
        if kind in values:
            middle, low, high = values[kind]
            words.append(f"{number(middle)} ({number(low)}..{number(high)})")
    return " / ".join(words)


def errors_table(found: dict, printed: Mapping[str, Any] | None = None) -> list[str]:
    lines = ["| method | M diag / off / zero | D_l diag / off / zero | D_q diag |", "|---|---|---|---|"]
    for method, by_matrix in found.items():
        row = []
        for m in MATRICES:
            values = by_matrix.get(m, {})
            keep = {k: v for k, v in values.items() if m != "D_q" or k == "diagonal"}
            row.append(cell(keep) or "given")
        lines.append(f"| {method} | " + " | ".join(row) + " |")
        if printed and method in printed:
            words = []
            for m in MATRICES:
                values = [str(x) for x in printed[method].get(m, ()) if x is not None]
                words.append(" / ".join(values) or "-")
            lines.append(f"| *{method}, printed* | " + " | ".join(f"*{w}*" for w in words) + " |")
    return lines


def matrix_lines(name: str, values) -> list[str]:
    rows = [" ".join(f"{x:8.1f}" for x in row) for row in values]
    return [f"{name}:", "```text", *rows, "```"]


TEXT, LONGER, HIT = "text, 1000 s", "text, 2000 s", "collisions, 1000 s"
# What the thesis claims: the error of one method (case, method, matrix) is below a share of another's.
# "Ignored" collisions are taken as at most a tenth more error.
CLAIMS = (
    ("networks find M better than LS (6.1)", (TEXT, "networks", "M"), (TEXT, "LS (6.1)", "M"), 1.0),
    ("networks find D_l better than LS (6.1)", (TEXT, "networks", "D_l"), (TEXT, "LS (6.1)", "D_l"), 1.0),
    ("ours: networks find M better than inverse LS", (TEXT, "networks", "M"), (TEXT, "inverse LS", "M"), 1.0),
    (
        "ours: networks find M better than two-stage LS",
        (TEXT, "networks", "M"),
        (TEXT, "two-stage LS", "M"),
        1.0,
    ),
    ("more data helps networks find M, text noise", (LONGER, "networks", "M"), (TEXT, "networks", "M"), 1.0),
    (
        "more data helps networks find D_l, text noise",
        (LONGER, "networks", "D_l"),
        (TEXT, "networks", "D_l"),
        1.0,
    ),
    (
        "more data helps networks find M, listing noise",
        ("listing, 2000 s", "networks", "M"),
        ("listing, 1000 s", "networks", "M"),
        1.0,
    ),
    (
        "zero elements of M set to zero help D_l (6.6)",
        (TEXT, "networks, zeros set (6.6)", "D_l"),
        (TEXT, "networks", "D_l"),
        1.0,
    ),
    ("the true mass helps D_l", (TEXT, "networks, true mass", "D_l"), (TEXT, "networks", "D_l"), 1.0),
    (
        "networks find D_l better than LS_2 with the same mass (6.7)",
        (LONGER, "networks", "D_l"),
        (LONGER, "LS_2, mass of the networks", "D_l"),
        1.0,
    ),
    (
        "networks find D_q better than LS_2 with the same mass (6.7)",
        (LONGER, "networks", "D_q"),
        (LONGER, "LS_2, mass of the networks", "D_q"),
        1.0,
    ),
    ("networks ignore collisions (M)", (HIT, "networks", "M"), (TEXT, "networks", "M"), 1.1),
)


def claims(parts: list[dict]) -> list[dict]:
    """What the thesis claims, decided by pairs, dive by dive; errors are on the diagonal."""
    errors = {(p["case"], p["seed"]): p["errors"] for p in parts}
    seeds = sorted({p["seed"] for p in parts})

    def at(seed: int, case: str, method: str, matrix: str) -> float | None:
        found = errors.get((case, seed), {}).get(method, {}).get(matrix)
        return None if found is None else found["diagonal"]

    pairs, shares = {}, {}
    for words, better, worse, share in CLAIMS:
        own = [(at(seed, *better), at(seed, *worse)) for seed in seeds]
        own = [(a, share * b) for a, b in own if a is not None and b is not None]
        if own:
            pairs[words], shares[words] = own, share
    found = decided(pairs)
    for one in found:
        one["against"] /= shares[one["claim"]]
    return found


# What stands beside the table of all methods on the text's data: case and method.
OTHER = (
    (HIT, "networks"),
    (HIT, "trajectory"),
    (HIT, "trajectory, rejecting"),
    ("realistic, 1000 s", "networks"),
    ("realistic, 1000 s", "two-stage LS"),
    ("realistic, 1000 s", "trajectory"),
    ("listing, 1000 s", "networks"),
    ("listing, 2000 s", "networks"),
    ("listing, 1000 s", "trajectory"),
    (LONGER, "networks"),
    (LONGER, "LS_2, mass of the networks"),
)


def overview(results: Mapping[str, Any]) -> str:
    """Medians over dives: all methods on the text's data, some on other data, and with three axes alone."""

    def row(words: str, found: Mapping[str, Any]) -> str:
        cells = [
            " / ".join(number(found[m][kind][0]) for kind in kinds if kind in found.get(m, {})) or "given"
            for m, kinds in zip(MATRICES, (KINDS, KINDS[:2], KINDS[:1]), strict=True)
        ]
        return f"| {words} | " + " | ".join(cells) + " |"

    tables, driven = results["tables"], results["driven_tables"]
    lines = ["| method | M diag / off / zero | D_l diag / off | D_q diag |", "|---|---|---|---|"]
    lines += [row(name, found) for name, found in tables[TEXT].items() if "3 dof" not in name]
    for name, printed in PRINTED["6.2"].items():
        cells = [
            " / ".join(f"*{x}*" for x in printed[m][:keep] if x is not None)
            for m, keep in zip(MATRICES, (3, 2, 1), strict=True)
        ]
        lines.append(f"| *printed: {name}* | " + " | ".join(cells) + " |")
    lines += ["", *lines[:2]]
    lines += [
        row(f"{case}: {name}", tables[case][name]) for case, name in OTHER if name in tables.get(case, {})
    ]
    lines += [
        row(f"on surge, heave and yaw: {name}", driven[TEXT][name])
        for name in ("acceleration ML", "acceleration ML, 3 dof")
        if name in driven[TEXT]
    ]
    return "\n".join(lines) + "\n"


TARGETS = (
    ("text, 1000 s", "two-stage LS", "M", "diagonal", 8.0),
    ("text, 1000 s", "acceleration ML", "M", "diagonal", 3.0),
    ("text, 1000 s", "acceleration ML", "D_l", "diagonal", 20.0),
    ("text, 1000 s", "trajectory", "M", "diagonal", 0.1),
    ("text, 1000 s", "trajectory", "D_l", "diagonal", 0.5),
    ("text, 1000 s", "trajectory", "D_l", "off_diagonal", 2.0),
    ("text, 1000 s", "trajectory", "D_q", "diagonal", 2.0),
    ("realistic, 1000 s", "trajectory", "M", "diagonal", 1.0),
    ("realistic, 1000 s", "trajectory", "D_l", "diagonal", 5.0),
    ("realistic, 1000 s", "trajectory", "D_l", "off_diagonal", 20.0),
    ("realistic, 1000 s", "trajectory", "D_q", "diagonal", 30.0),
    ("collisions, 1000 s", "trajectory, rejecting", "M", "diagonal", 0.1),
    ("collisions, 1000 s", "trajectory, rejecting", "D_l", "diagonal", 0.5),
    ("collisions, 1000 s", "trajectory, rejecting", "D_l", "off_diagonal", 2.0),
    ("collisions, 1000 s", "trajectory, rejecting", "D_q", "diagonal", 2.0),
)


def reached(tables: dict) -> list[dict]:
    """The bars for classical methods, and what was measured."""
    out = []
    for case, method, matrix, kind, bar in TARGETS:
        if method in tables.get(case, {}):
            middle, low, high = tables[case][method][matrix][kind]
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


def markdown(results: dict, parts: list[dict]) -> str:
    tables, text, longer = results["tables"], "text, 1000 s", "text, 2000 s"
    counts = {c: sum(p["case"] == c for p in parts) for c in tables}
    lines = ["# Tethra, tables 6.1 to 6.7", ""]
    lines += ["Errors in per cent: median (least..largest) over seeds. " + json.dumps(counts), ""]
    lines += [overview(results), claim_table(results["claims"])]
    lines += ["| bar | at most | median (least..largest) | met |", "|---|---|---|---|"]
    for r in results["bars"]:
        word = f"{number(r['median'])} ({number(r['least'])}..{number(r['largest'])})"
        met = "yes" if r["met"] else "no"
        lines.append(f"| {r['case']}: {r['method']}, {r['what']} | {r['bar']:g} | {word} | {met} |")
    for title, case, methods in (
        ("Table 6.1", text, ("LS (6.1)", "networks")),
        ("Table 6.4", longer, ("LS (6.1)", "networks")),
        ("Table 6.6", longer, ("LS_2, mass of the networks",)),
    ):
        own = [p for p in parts if p["case"] == case]
        if own:
            lines += ["", f"## {title}, the first seed ({case})"]
            for method in methods:
                for matrix, values in own[0]["matrices"][method].items():
                    if values is not None:
                        lines += matrix_lines(f"{method}, {matrix}", values)
    for title, case, of in (
        ("6.2", text, "tables"),
        ("6.3", text, "driven_tables"),
        ("6.5", longer, "tables"),
        ("6.7", longer, "tables"),
    ):
        found = {k: v for k, v in results[of].get(case, {}).items() if k in PRINTED[title]}
        if found:
            lines += ["", f"## Table {title} ({case})", "", *errors_table(found, PRINTED[title])]
    for case, found in tables.items():
        # A model of three axes says nothing of the others.
        whole = {k: v for k, v in found.items() if "3 dof" not in k}
        lines += ["", f"## All methods: {case}", "", *errors_table(whole)]
        driven = results["driven_tables"][case]
        only = {
            k: v for k, v in driven.items() if k in ("networks", "acceleration ML", "acceleration ML, 3 dof")
        }
        lines += ["", "Surge, heave and yaw alone:", "", *errors_table(only)]
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
    cases = list(dict.fromkeys(p["case"] for p in parts))
    tables = {c: over_seeds(parts, c) for c in cases}
    results = {
        "tables": tables,
        "driven_tables": {c: over_seeds(parts, c, "driven_errors") for c in cases},
        "claims": claims(parts),
        "bars": reached(tables),
        # Of the same dive, as measured and with other rounding: the largest error on the diagonal of M.
        "rounding": [
            [p["errors"][name]["M"]["diagonal"] for name in ("networks", ELSEWHERE)]
            for p in parts
            if ELSEWHERE in p["errors"]
        ],
        "fits": [{"case": p["case"], "seed": p["seed"], "fits": p["fits"]} for p in parts],
        "cpu_s": sum(p["cpu_s"] for p in parts),
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
