"""What does Levenberg-Marquardt cost for six small networks, per epoch and to the same error?

usage: python -m experiments.benchmarks.levenberg_marquardt --out DIR [--rounds 7] [--quick]

Six 12-5-1 networks learn the six accelerations of the ROV Tethra from velocity and force, on 10,000 samples
with noise. Per epoch the unit is one product J'J for all six, which every method of this kind needs. To the
same cost: scipy's solver says what can be reached; each contender goes on to within 1 % of the worst that
any of them reaches, jaxmarine in the fewest epochs that suffice for all six together. Writes results.json and
results.md.
"""

import bisect
import contextlib
import functools
from pathlib import Path
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import scipy.optimize
import typer
from jaxtyping import Array, Float

import jaxmarine as jm
from experiments.benchmarks._rounds import Run, Table, Target, Uncompared, benchmark, compared, report
from jaxmarine._compiled import compiled
from jaxmarine.fitting import fit_samples, levenberg_marquardt
from jaxmarine.fitting._subnets import Perceptron, perceptron
from jaxmarine.simulation import initial_state
from jaxmarine.vehicle import Input

PRODUCT, OURS, QR, SCIPY = "one einsum J'J", "jaxmarine, fit_samples", "optimistix, QR", "scipy, MINPACK"


class Samples(NamedTuple):
    """Velocity and force, and the accelerations in turns; all scaled to one."""

    x: Float[Array, "samples 12"]
    y: Float[Array, "samples 6"]


def samples_of(count: int) -> Samples:
    """Of any motion within 1 m/s and rad/s and any force within the thrusters' reach, with 2 % of noise."""
    vehicle = jm.load_vehicle(jm.packaged_vehicle("tethra"))
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (count, 12))
    size = np.repeat([200.0, 60.0], 3)
    nothing = jnp.zeros(len(vehicle.thruster_names))

    def acceleration(x):
        drive = Input(nothing, nothing, jnp.asarray(size) * x[6:], jnp.zeros(()))
        return jm.forward_dynamics(vehicle, initial_state(vehicle, velocity=x[:6]), drive)

    y = np.asarray(jax.jit(jax.vmap(acceleration))(jnp.asarray(x)))
    y = (y - y.mean(0)) / y.std(0) + 0.02 * rng.normal(size=y.shape)
    return Samples(jnp.asarray(x), jnp.asarray(y))


def networks_of(hidden: int) -> Perceptron:
    """Six beginnings, stacked."""
    return jax.vmap(lambda key: perceptron(12, hidden, 1, key))(jax.random.split(jax.random.key(0), 6))


def missed(net: Perceptron, sample):
    x, y = sample
    return net(x) - y[None]


# --- contenders: costs of the six networks after so many epochs ------------------------------------


@compiled
def by_normal_equations(starts: Perceptron, samples: Samples, epochs: int):
    """The package's; never content, so that it takes all epochs."""

    def one(start, y):
        alone = jax.tree.map(lambda a: a[None], start)
        return fit_samples(missed, alone, (samples.x, y), rtol=-1.0, max_steps=epochs).costs[0]

    return jax.vmap(one, in_axes=(0, 1))(starts, samples.y)


@eqx.filter_jit
def by_optimistix(starts: Perceptron, samples: Samples, epochs: int):
    """optimistix' own, which factorises the Jacobian."""

    def one(start, y):
        alone = jax.tree.map(lambda a: a[None], start)
        found = levenberg_marquardt(
            lambda net, _: jax.vmap(missed, in_axes=(None, 0))(net, (samples.x, y)),
            alone,
            rtol=0.0,
            atol=0.0,
            max_steps=epochs,
        )
        return found.costs[0]

    return jax.vmap(one, in_axes=(0, 1))(starts, samples.y)


@eqx.filter_jit
def product(jacobians: Float[Array, "networks weights samples"]):
    return jnp.einsum("nws,nvs->nwv", jacobians, jacobians)


class Enough(Exception):
    """The cost is low enough."""


def by_scipy(starts: Perceptron, samples: Samples, evaluations: int, wanted=(0.0,) * 6) -> np.ndarray:
    """MINPACK's with the exact Jacobian, network by network, until a cost or so many evaluations."""
    costs = []
    for k, enough in enumerate(wanted):
        start = jax.tree.map(lambda a, k=k: a[k], starts)
        flat, _ = jax.flatten_util.ravel_pytree(start)
        residual, slope = _flat_functions(start)
        args = (samples.x, samples.y[:, k])
        least = np.inf

        def watched(weights, args=args, residual=residual, enough=enough):
            nonlocal least
            value = np.asarray(residual(weights, *args))
            least = min(least, 0.5 * float(value @ value))
            if least <= enough:
                raise Enough
            return value

        def jacobian(weights, args=args, slope=slope):
            return np.asarray(slope(weights, *args))

        with contextlib.suppress(Enough):
            scipy.optimize.least_squares(
                watched,
                np.asarray(flat),
                jacobian,
                method="lm",
                max_nfev=evaluations,
            )
        costs.append(least)
    return np.array(costs)


@functools.cache
def _compiled(structure, shapes):
    """Residuals of all samples from flat weights, and their Jacobian."""
    like = jax.tree.unflatten(structure, [jnp.zeros(shape) for shape in shapes])
    _, unravel = jax.flatten_util.ravel_pytree(like)

    def residual(weights, x, y):
        return jax.vmap(missed, in_axes=(None, 0))(unravel(weights), (x, y))[:, 0]

    def slope(weights, x, y):
        return jax.vmap(jax.grad(lambda w, x, y: missed(unravel(w), (x, y))[0]), (None, 0, 0))(weights, x, y)

    return jax.jit(residual), jax.jit(slope)


def _flat_functions(net: Perceptron):
    leaves, structure = jax.tree.flatten(net)
    return _compiled(structure, tuple(leaf.shape for leaf in leaves))


# --- the questions ------------------------------------------------------------------------------------


def per_epoch(starts: Perceptron, samples: Samples, epochs: int, rounds: int) -> Table:
    """Time of an epoch; after few epochs the costs differ from scipy's, as each damps in its own way."""
    weights = sum(leaf[0].size for leaf in jax.tree.leaves(starts))
    jacobians = jnp.asarray(np.random.default_rng(0).normal(size=(6, weights, len(samples.x))))

    def products() -> Run:
        def run():
            return Uncompared([jax.block_until_ready(product(jacobians)) for _ in range(epochs)])

        return run

    makers = {
        PRODUCT: products,
        OURS: lambda: lambda: by_normal_equations(starts, samples, epochs),
        QR: lambda: lambda: by_optimistix(starts, samples, epochs),
    }
    title = f"Six networks of {weights} weights, {len(samples.x)} samples, per epoch"
    reference = by_scipy(starts, samples, epochs)
    return compared(title, makers, reference, PRODUCT, rounds, "epoch", epochs)


def to_equal_cost(starts: Perceptron, samples: Samples, most: int, rounds: int) -> Table:
    """Time to costs within 1 % of what each of the two can reach; the difference is what is left above."""
    reached = np.maximum(by_scipy(starts, samples, most), by_normal_equations(starts, samples, most))
    wanted = 1.01 * reached
    epochs = 1 + bisect.bisect_left(
        range(1, most),
        True,
        key=lambda epochs: bool((np.asarray(by_normal_equations(starts, samples, epochs)) <= wanted).all()),
    )
    makers = {
        SCIPY: lambda: lambda: np.maximum(by_scipy(starts, samples, most, tuple(wanted)), wanted),
        f"{OURS} ({epochs} epochs)": lambda: (
            lambda: np.maximum(by_normal_equations(starts, samples, epochs), wanted)
        ),
    }
    title = f"Six networks to the same cost, {len(samples.x)} samples"
    return compared(title, makers, wanted, SCIPY, rounds)


def main(
    out: Annotated[Path, typer.Option(help="Folder for results and tables.")],
    rounds: Annotated[int, typer.Option(min=1, help="Times that everything is timed.")] = 7,
    quick: Annotated[bool, typer.Option("--quick", help="Tiny networks, few samples, two rounds.")] = False,
) -> None:
    """Times Levenberg-Marquardt on six networks."""
    hidden, count, epochs, most, rounds = (1, 60, 8, 8, 2) if quick else (5, 10_000, 20, 256, rounds)
    with benchmark(out, quick):
        starts, samples = networks_of(hidden), samples_of(count)
        epoch = per_epoch(starts, samples, epochs, rounds)
        equal = to_equal_cost(starts, samples, most, rounds)
        _, ours = equal.timings
        targets = [
            Target("LM epoch of six nets, against one einsum J'J", epoch, OURS, PRODUCT, 1.3),
            Target("LM epoch of six nets, against optimistix with QR", epoch, OURS, QR, 1 / 15),
            Target("LM to the same cost, against scipy", equal, ours, SCIPY, 1 / 5),
        ]
        report(out, [epoch, equal], targets)


if __name__ == "__main__":
    typer.run(main)
