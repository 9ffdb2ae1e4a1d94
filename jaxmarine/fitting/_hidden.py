"""Hidden layers of networks inside a vehicle, trained by reverse gradients where Gauss-Newton has no room.

Forces are linear in the last layer of a network, or nearly so, as they are in mass and damping: of those
Gauss-Newton finds the minimum in a few steps, and their information is small. Of the layers before there are
thousands of numbers, whose information is larger than a memory; they go down the gradient, all others with
them. Error bars are those of what Gauss-Newton fits, at the hidden layers as they are trained.

After Golub and Pereyra (1973), SIAM J. Numer. Anal. 10, 413-432 (what is linear is solved for); Kristiadi,
Hein and Hennig (2020), ICML (Laplace's approximation in the last layer).
"""

import dataclasses
import re
from collections.abc import Sequence
from typing import Any, Self, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._compiled import compiled
from ..logs import Log
from ..simulation import substeps
from ..vehicle import Vehicle
from ._affine import Affine
from ._estimate import Estimate, Units
from ._free import Freed, Select, named_leaves, stated_widths
from ._one_step import OneStep, one_step, weighed_by_scatter
from ._rollout import predict
from ._solver import Task, refine_windows
from ._trajectory import segments, window_task
from ._weights import scaled
from ._windows import cut

# Weights in hidden layers, above which gradients train them: with 456 Gauss-Newton takes as long, or two
# thirds, and half as much memory more (two runs of `experiments/many_weights.py`). Both grow as its square.
MANY = 450
# Updates of a training, windows and samples in each, the largest step in widths of the prior, and the slope,
# in nats per width, below which a weight is not worth such a step: thousands of weights that do not matter
# would else wander off by the noise of the batches, and cost more than all others gain (measured: 5000 gained
# nothing by steps of 1e-2, and 40 to 300 nats by these).
UPDATES, WINDOWS, SAMPLES, RATE, SLOPE = 1000, 16, 256, 3e-3, 10.0
# Steps of the initial states of windows before it.
_STARTS = 4
# A layer among others: by its place among a network's `layers`, or by the number in the names of its arrays.
_LAYER = re.compile(r"^(.*)\.(?:layers\[(\d+)\].*|(?:weight|bias)_(\d+))$")


@dataclasses.dataclass(frozen=True)
class Hidden:
    """The freed leaves of hidden layers.

    - `places`: among the leaves of the vehicle; `width`: of each entry's prior, 0 where it is held, and where
      it has none its size; `precision`: 1 where there is a prior, else 0.
    """

    places: tuple[int, ...]
    width: tuple[Float[np.ndarray, "..."], ...]
    precision: tuple[Float[np.ndarray, "..."], ...]

    @property
    def count(self) -> int:
        return sum(width.size for width in self.width)


def hidden_layers(vehicle: Vehicle, free: Select, prior: float | PyTree | None) -> Hidden:
    """What `free` names of the layers before the last; nothing where it names nothing else.

    - `prior`: as of `fit`; a number is relative to each weight, and to 1 of one that is zero.
    """
    layers = [_layer(path) for path, _ in jax.tree_util.tree_flatten_with_path(vehicle)[0]]
    last: dict[str, int] = {}
    for network, layer in filter(None, layers):
        last[network] = max(last.get(network, 0), layer)
    places, _ = named_leaves(vehicle, free)
    leaves = jax.tree.leaves(vehicle)
    stds = stated_widths(prior, [leaves[place] for place in places], free, vehicle)
    found, widths, precisions = [], [], []
    for place, std in zip(places, stds, strict=True):
        layer = layers[place]
        if layer is None or layer[1] == last[layer[0]]:
            continue
        size = np.abs(np.asarray(leaves[place], float))
        size = np.where(size > 0, size, 1.0)
        if isinstance(prior, float | int):
            std = float(prior) * size
        found.append(place)
        widths.append(np.where(np.isfinite(std), std, size))
        precisions.append(np.isfinite(std) * 1.0)
    if len(found) == len(places):
        return Hidden((), (), ())
    return Hidden(tuple(found), tuple(widths), tuple(precisions))


def _layer(path) -> tuple[str, int] | None:
    """The network that a leaf belongs to, and the number of its layer; None of other leaves."""
    found = _LAYER.match(jax.tree_util.keystr(path))
    return None if found is None else (found[1], int(found[2] or found[3]))


class Unknowns(eqx.Module):
    """What is trained, each number in widths of its prior: `z` as of `Units`, `layers` leaf by leaf."""

    z: Float[Array, " z"]
    layers: tuple[Array, ...]


class Training(eqx.Module):
    """A loss as a function of all that is trained: half a chi-square with the prior.

    - `task`: of the fit beside it; `delta` [windows, 12]: the initial states of its windows, held.
    - `start`, `width`, `precision`: of the hidden leaves, which stand at `places` of the vehicle.
    - `count`: of windows (or samples, one-step); `batch`: how many of them an update takes.
    """

    task: Task | OneStep
    delta: Float[Array, "windows 12"] | None
    start: tuple[Array, ...]
    width: tuple[Array, ...]
    precision: tuple[Array, ...]
    places: tuple[int, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)
    batch: int = eqx.field(static=True)

    @classmethod
    def of(cls, hidden: Hidden, task: Task | OneStep, delta: Array | None, count: int, most: int) -> Self:
        """From the vehicle of the task; `most`: windows or samples in an update, if there are so many."""
        problem: Any = task.problem
        leaves = jax.tree.leaves(problem.plant_of.freed.vehicle)
        start = tuple(jnp.asarray(leaves[place]) for place in hidden.places)
        width, precision = (tuple(map(jnp.asarray, a)) for a in (hidden.width, hidden.precision))
        return cls(task, delta, start, width, precision, hidden.places, count, min(most, count))

    def freed(self, layers: tuple[Array, ...]) -> Freed:
        """What is free beside the hidden layers, with these in the vehicle."""
        problem: Any = self.task.problem
        freed = problem.plant_of.freed
        leaves, structure = jax.tree.flatten(freed.vehicle)
        for place, start, width, layer in zip(self.places, self.start, self.width, layers, strict=True):
            leaves[place] = start + width * layer
        return dataclasses.replace(freed, vehicle=jax.tree.unflatten(structure, leaves))

    def __call__(self, at: Unknowns, batch: Int[Array, " batch"] | None = None) -> Float[Array, ""]:
        """At some windows (or samples, one-step), as if all were like these; None: at all of them."""
        task = eqx.tree_at(lambda t: t.problem.plant_of.freed, self.task, self.freed(at.layers))
        if isinstance(task, OneStep):
            residual = task.residuals(at.z, batch)
        else:
            problem, delta = task.problem, self.delta
            if batch is not None:
                some = jax.tree.map(lambda a: a[batch], (problem.windows, delta))
                problem, delta = eqx.tree_at(lambda p: p.windows, problem, some[0]), some[1]
            residual = predict(problem, task.affine(at.z), delta)[1]
        share = 1.0 if batch is None else self.count / len(batch)
        prior = self.task.precision @ at.z**2
        prior += sum((p * y**2).sum() for p, y in zip(self.precision, at.layers, strict=True))
        return 0.5 * (share * (residual**2).sum() + prior)


@compiled
def descended(training: Training, start: Unknowns, batches: Int[Array, "updates batch"]):
    """The unknowns after an update by each batch, with the loss of everything before and after.

    By Adam with a rate that falls to nothing as half a cosine: noise of the batches dies out with it.
    After Kingma and Ba (2015), ICLR; Loshchilov and Hutter (2017), ICLR.
    """
    # Imported where it is needed: that takes 0.15 s, and hardly any fit needs it.
    import optax

    # Its annotations know no modules of Equinox.
    rules = cast(Any, optax)
    schedule = rules.cosine_decay_schedule(RATE, len(batches))
    # A batch from which a simulation runs away changes nothing.
    rule = rules.apply_if_finite(rules.adam(schedule, eps=SLOPE), len(batches))

    def update(carry, batch):
        now, state = carry
        change, state = rule.update(jax.grad(training)(now, batch), state, now)
        return (rules.apply_updates(now, change), state), None

    (end, _), _ = jax.lax.scan(update, (start, rule.init(start)), batches)
    return end, training(start), training(end)


@dataclasses.dataclass(frozen=True)
class Trained:
    """What training leaves: `freed` with the trained layers, `z` of all else, and how it went, in words."""

    freed: Freed
    z: Float[np.ndarray, " z"]
    told: str


def by_windows(
    hidden: Hidden,
    freed: Freed,
    units: Units,
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    window: float,
    held: bool,
    near: Estimate,
) -> Training:
    """By trajectories, with the weights and initial states of the fit `near`, which holds hidden layers."""
    acting = segments(freed.vehicle, logs)
    data = cut(freed.vehicle, logs, noise, window, segments=acting.of_samples)
    split = max(substeps(freed(jnp.asarray(raw)), data.hold) for raw in (freed.start, near.raw))
    task = window_task(freed, units, data, acting, split, held, data.speeds)
    # A window of another log that begins at the same time as one that was left out is no loss.
    kept = ~np.isin(data.starts, near.rejected)
    own = np.asarray(task.problem.windows.weight)
    task = task.weighed(scaled(own, near.weighed, logs[0].dt) * kept[:, None, None])
    # An empty map holds z, so that the initial states alone are fitted.
    there = Affine(task.affine(jnp.asarray(near.z)), jnp.zeros_like(task.affine.columns), task.affine.acts)
    nothing = jnp.zeros((data.windows.count, 12)), jnp.zeros(len(near.z))
    delta = refine_windows(dataclasses.replace(task, affine=there), nothing[1], nothing[0], _STARTS).delta
    # Reverse mode takes a loop only where its length is a number.
    task = dataclasses.replace(task, problem=dataclasses.replace(task.problem, split=split))
    return Training.of(hidden, task, delta, data.windows.count, WINDOWS)


def by_samples(
    hidden: Hidden,
    freed: Freed,
    units: Units,
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    near: Estimate,
) -> Training:
    """By one step, with axes that weigh by what the fit `near` leaves of them, which holds hidden layers."""
    task = weighed_by_scatter(one_step(freed, units, logs, noise), jnp.asarray(near.z))
    return Training.of(hidden, task, None, task.problem.records.t.size, SAMPLES)


def train(training: Training, z: Float[np.ndarray, " z"]) -> Trained:
    """From z and the layers as they are, which are what is left where it gains nothing."""
    start = Unknowns(jnp.asarray(z), tuple(jnp.zeros_like(a) for a in training.start))
    rng, shape = np.random.default_rng(0), (UPDATES, training.batch)
    epochs = -(-UPDATES * training.batch // training.count)
    order = np.concatenate([rng.permutation(training.count) for _ in range(epochs)])
    end, before, after = descended(training, start, jnp.asarray(np.resize(order, shape)))
    gained = float(before - after)
    if not gained > 0:
        end, gained = start, 0.0
    told = f"hidden layers trained by {UPDATES} updates, which gained {gained:.3g} nats"
    return Trained(training.freed(end.layers), np.asarray(end.z), told)
