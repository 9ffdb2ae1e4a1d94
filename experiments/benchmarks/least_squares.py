"""What do linear least squares and their bootstrap cost?

usage: python -m experiments.benchmarks.least_squares --out DIR [--rounds 7] [--quick]

A regression with 20 columns on 10,000 samples of six axes, in the units of columns that span three powers
of ten; 200 resamples of 100 windows. The reference is numpy's `lstsq`; every bootstrap takes the same
draws. Writes results.json and results.md.
"""

from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jaxtyping import Array, Float, PRNGKeyArray

from experiments.benchmarks._rounds import Run, Table, Target, benchmark, compared, report
from jaxmarine.fitting import solve_linear
from jaxmarine.fitting._least_squares import members_of, resample_linear

OURS, LOOP = "jaxmarine", "numpy, a loop of lstsq"


def regression(samples: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Regressors [samples, 6, columns] and right side [samples, 6]; noise of a tenth of the signal."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(samples, 6, columns)) * np.geomspace(1.0, 1e3, columns)
    values = rng.normal(size=columns) / np.geomspace(1.0, 1e3, columns)
    return matrix, matrix @ values + 0.1 * rng.normal(size=(samples, 6))


@jax.jit
def normal_equations(matrix: Float[Array, "rows p"], right: Float[Array, " rows"]):
    """By Cholesky, with one step of refinement that takes back most of the squared condition number."""
    factor = jax.scipy.linalg.cho_factor(matrix.T @ matrix)
    values = jax.scipy.linalg.cho_solve(factor, matrix.T @ right)
    return values + jax.scipy.linalg.cho_solve(factor, matrix.T @ (right - matrix @ values))


def solve(samples: int, columns: int, rounds: int) -> Table:
    """One solution."""
    matrix, right = regression(samples, columns)
    rows, wanted = matrix.reshape(-1, columns), right.ravel()
    on_device, beside = jnp.asarray(rows), jnp.asarray(wanted)
    ours = jax.jit(lambda a, b: solve_linear(a, b).values)

    def by_numpy():
        return np.linalg.lstsq(rows, wanted, rcond=None)[0]

    makers = {
        "numpy, lstsq": lambda: by_numpy,
        OURS: lambda: lambda: ours(on_device, beside),
        "normal equations, refined": lambda: lambda: normal_equations(on_device, beside),
    }
    title = f"Least squares, {len(rows)} rows, {columns} columns"
    return compared(title, makers, by_numpy(), "numpy, lstsq", rounds)


def drawn(keys: PRNGKeyArray, windows: int) -> np.ndarray:
    """How often `resample_linear` draws each window: [keys, windows]. By the precision that is on."""
    counts = np.zeros((len(keys), windows))
    for row, key in zip(counts, keys, strict=True):
        np.add.at(row, np.asarray(jax.random.randint(key, (windows,), 0, windows)), 1.0)
    return counts


def by_loop(matrix: np.ndarray, right: np.ndarray, group: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """numpy's `lstsq` once per draw; `group`: the window of each sample."""
    out = []
    for count in counts:
        weight = np.sqrt(count)[group]
        rows = (matrix * weight[:, None, None]).reshape(-1, matrix.shape[-1])
        out.append(np.linalg.lstsq(rows, (right * weight[:, None]).ravel(), rcond=None)[0])
    return np.array(out)


def bootstrap(samples: int, columns: int, windows: int, resamples: int, rounds: int) -> Table:
    """All resamples of windows."""
    matrix, right = regression(samples, columns)
    keys = jax.random.split(jax.random.key(0), resamples)
    counts = drawn(keys, windows)
    group = np.arange(samples) * windows // samples

    def loop():
        return by_loop(matrix, right, group, counts)

    def ours() -> Run:
        given = jnp.asarray(matrix), jnp.asarray(right), jnp.asarray(members_of(group)), keys
        return lambda: resample_linear(*given)

    def of_windows() -> Run:
        """One Gram matrix per window, weighed by how often it was drawn: squares the condition number."""

        @jax.jit
        def run(matrix, right, counts):
            size = samples // windows
            blocks, sides = matrix.reshape(windows, 6 * size, columns), right.reshape(windows, 6 * size)
            gram = jnp.einsum("wsi,wsj->wij", blocks, blocks)
            moment = jnp.einsum("wsi,ws->wi", blocks, sides)
            h = jnp.einsum("rw,wij->rij", counts, gram)
            return jnp.linalg.solve(h, (counts @ moment)[..., None])[..., 0]

        given = jnp.asarray(matrix), jnp.asarray(right), jnp.asarray(counts)
        return lambda: run(*given)

    makers = {LOOP: lambda: loop, OURS: ours, "Gram matrices of windows": of_windows}
    title = f"Bootstrap, {resamples} resamples of {windows} windows"
    return compared(title, makers, loop(), LOOP, rounds)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 7,
    quick: Annotated[bool, typer.Option("--quick", help="Few samples and resamples, two rounds.")] = False,
) -> None:
    """Times linear least squares and their bootstrap."""
    samples, columns, windows, resamples, rounds = (
        (60, 3, 10, 5, 2) if quick else (10_000, 20, 100, 200, rounds)
    )
    with benchmark(out, quick):
        tables = [
            solve(samples, columns, rounds),
            bootstrap(samples, columns, windows, resamples, min(rounds, 3)),
        ]
        targets = [
            Target(f"{resamples} bootstrap resamples, against a numpy loop", tables[1], OURS, LOOP, 1 / 50)
        ]
        report(out, tables, targets)


if __name__ == "__main__":
    typer.run(main)
