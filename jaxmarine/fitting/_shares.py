"""A fit of logs that lie in several places: each keeps its own, and what the solver asks for is summed there.

A diagnosis asks questions of its own (`Share.answer`), and steps by the same loop (`refine_shares`).

What travels is the step of the parameters one way, and the gradient, the information and a few sums of each
share the other; at the end the gradient and information of every window, by which errors are judged. The
solver is that of one process, its loop written out, and comes to the same within rounding.
"""

import abc
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compiled import compiled
from ..logs import Log
from ..simulation import substeps
from ..vehicle import Vehicle
from ._damped import LOST
from ._estimate import Estimate, Units
from ._free import Freed
from ._linearise import Statistics, linearise
from ._noise import noises_of
from ._review import reviewed
from ._rollout import predict
from ._solver import LEAST_DAMPING, Task, followed, softened, step_of, worth_of
from ._trajectory import (
    FINE,
    FINEST,
    ROUGH,
    ROUGH_STEPS,
    WEIGHINGS,
    drawn,
    pretended,
    segments,
    window_task,
)
from ._trust import Trust
from ._weights import Products, changes, largest_of, overdispersion_of, scaled, settled
from ._windows import cut


@compiled
def _linearised(task: Task, z, delta) -> Statistics:
    return linearise(task.problem, task.affine.at(z), delta)


@compiled
def _sums(found: Statistics, damping) -> tuple[Array, Array]:
    """Gradient and information of z, the damped initial states eliminated."""
    _, g, h = softened(found, damping).reduced()
    return g.sum(0), h.sum(0)


@compiled
def _followed(found: Statistics, d_z, damping):
    return followed(found, softened(found, damping), d_z)


_NUMBERS = itertools.count()


class Kept:
    """Something that each share keeps for a caller, who holds no more of it than its number."""

    def __init__(self):
        self.number = next(_NUMBERS)


class Share:
    """Some of the logs of a fit, in order of time, with the initial states of their windows.

    Its methods are the questions of a solver; what they return is all that leaves the place where it lies.

    - `given`: the logs as they were given; `logs`: these, `reviewed`.
    - `kept`: what questions of others (`answer`) keep here, by the numbers of `Kept`.
    """

    def __init__(self, vehicle: Vehicle, logs: Sequence[Log]):
        self.vehicle, self.given = vehicle, tuple(logs)
        self.logs, self.notes = reviewed(vehicle, logs)
        self.kept: dict[int, Any] = {}

    def answer(self, question: Callable[..., Any], *given: Any) -> Any:
        """The answer to a question that is not of a fit: a function of this share and of what is given."""
        return question(self, *given)

    def look(self) -> dict[str, Any]:
        """Names, sampling [s] and noise [logs, channels] of the logs, and what is to be noted of them."""
        return {
            "names": [log.name for log in self.logs],
            "dt": [log.dt for log in self.logs],
            "noise": noises_of(self.vehicle, self.logs),
            "notes": self.notes,
        }

    def cut(
        self, noise: np.ndarray, window: float, dt: float, later: Sequence[str]
    ) -> tuple[float, int, int, np.ndarray]:
        """Cuts windows: the longest hold [s], their count, steps and speeds; `later`: logs after these."""
        self.acting = segments(self.vehicle, self.logs, later)
        self.data = cut(self.vehicle, self.logs, noise, window, segments=self.acting.of_samples, dt=dt)
        windows = self.data.windows
        return self.data.hold, windows.count, int(windows.step.shape[1]), self.data.speeds

    def begin(
        self, freed: Freed, units: Units, split: int, held: bool, speeds: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Begins with all windows as they were measured; what channels change by, and how many windows."""
        self.task = window_task(freed, units, self.data, self.acting, split, held, speeds)
        self.own = np.asarray(self.task.problem.windows.weight)
        self.delta = jnp.zeros((self.data.windows.count, 12))
        return changes(np.asarray(self.task.problem.windows.measured), self.own)

    def weigh(self, factor: np.ndarray, dt: float) -> None:
        """Weighs the channels anew."""
        self.take(self.task.weighed(scaled(self.own, factor, dt)), self.delta)

    def take(self, task: Task, delta: Float[Array, "windows 12"]) -> None:
        """Takes up a task that is to be solved next, from these initial states."""
        self.weighed, self.delta, self.tried = task, delta, delta

    def cost(self, z: np.ndarray) -> tuple[float, bool]:
        """The chi-square at z and the initial states that are tried, and whether a step can start there."""
        self.stats_tried = _linearised(self.weighed, jnp.asarray(z), self.tried)
        found = self.stats_tried
        usable = jnp.isfinite(found.h_zz).all() & jnp.isfinite(found.h_xx).all()
        return float(found.chi2.sum()), bool(usable)

    def sums(self, taken: bool, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and information of z where the windows are, with the step tried last if it is taken."""
        if taken:
            self.delta, self.stats = self.tried, self.stats_tried
        g, h = _sums(self.stats, jnp.asarray(damping))
        return np.asarray(g), np.asarray(h)

    def step(self, d_z: np.ndarray, damping: float) -> float:
        """Steps as far as a step of z asks for, to be tried; the decrease that it promises without prior."""
        d_x, decrease = _followed(self.stats, jnp.asarray(d_z), jnp.asarray(damping))
        self.tried = self.delta + d_x
        return float(decrease)

    def left(self, z: np.ndarray) -> np.ndarray:
        """Products of what the model leaves, by lag [steps, 2, channels]."""
        task = self.task
        self.residual = np.asarray(predict(task.problem, task.affine(jnp.asarray(z)), self.delta)[1])
        products = Products(self.residual, self.own)
        return np.stack([products(lag) for lag in range(products.steps)])

    def end(self, z: np.ndarray, before: int, count: int) -> dict[str, Any]:
        """What errors are judged by; `before`: how many windows others have before these, `count` of all."""
        chi2, scores, information = (np.asarray(part) for part in self.stats.reduced())
        h_xx, both = np.asarray(self.stats.h_xx), []
        loose = np.zeros(12)
        try:
            loose = np.einsum("wii->i", np.linalg.inv(h_xx))
            draws = np.random.default_rng(0).normal(size=(count, 12))[before : before + len(h_xx)]
            moved = drawn(self.weighed, self.stats, draws)
            for sign in (1.0, -1.0):
                more = _linearised(self.weighed, jnp.asarray(z), self.delta + sign * moved)
                both.append(np.asarray(more.reduced()[2].sum(0)))
        except np.linalg.LinAlgError:  # of a roll-out that diverged
            pass
        there = information.sum(0)
        return {
            "weighed_chi2": float(chi2.sum()),
            "scores": scores,
            "information": information,
            "more": np.mean(both, axis=0) - there if both else np.zeros_like(there),
            "loose": float(loose @ np.asarray(self.task.problem.start_precision)),
        }


class AbstractShares(abc.ABC):
    """The shares of a fit, in order of time, wherever they lie."""

    @abc.abstractmethod
    def ask(self, question: str, *given: Any, each: Sequence[tuple] | None = None) -> list[Any]:
        """What every share answers to one of the questions of `Share`.

        - `given`: the same for all; `each`: what comes behind it, for each share its own.
        """


class Shares(AbstractShares):
    """Shares in this process."""

    def __init__(self, shares: Sequence[Share]):
        self._shares = tuple(shares)

    def ask(self, question: str, *given: Any, each: Sequence[tuple] | None = None) -> list[Any]:
        own = each or [()] * len(self._shares)
        return [getattr(one, question)(*given, *more) for one, more in zip(self._shares, own, strict=True)]


def fit_shares(
    freed: Freed,
    units: Units,
    shares: AbstractShares,
    looks: Sequence[dict[str, Any]],
    noise: Float[np.ndarray, " channels"],
    window: float,
    max_steps: int,
    held: bool,
    weigh: bool,
) -> Estimate:
    """`fit_trajectory` over shares; `looks`: what they say of their logs."""
    dt = float(np.median([one for look in looks for one in look["dt"]]))
    names = [look["names"] for look in looks]
    later = [([name for own in names[i + 1 :] for name in own],) for i in range(len(names))]
    holds, counts, lengths, each = zip(*shares.ask("cut", noise, window, dt, each=later), strict=True)
    hold, speeds = max(holds), np.sqrt(np.average(np.square(each), axis=0, weights=counts))
    z, best, steps = np.zeros(len(units.precision)), None, 0
    split = substeps(freed.vehicle, hold)
    while True:
        now = _solved(
            freed, units, shares, counts, max(lengths), z, split, dt, max_steps, held, weigh, speeds
        )
        steps += now.steps
        now = dataclasses.replace(now, steps=steps)
        if not now.finite:
            return now if best is None else best
        # The fitted vehicle may be stiffer than its start.
        needed = min(substeps(freed(jnp.asarray(now.raw)), hold), FINEST * split)
        if needed <= split or best is not None:
            return now
        split, z, best = needed, now.z, now


def _solved(
    freed: Freed,
    units: Units,
    shares: AbstractShares,
    counts: Sequence[int],
    length: int,
    z: np.ndarray,
    split: int,
    dt: float,
    max_steps: int,
    held: bool,
    weigh: bool,
    speeds: np.ndarray,
) -> Estimate:
    """Solves with weights that the solution confirms, as in one process (`_trajectory`)."""
    begun = shares.ask("begin", freed, units, split, held, speeds)
    most = largest_of(*np.sum(begun, axis=0)) if weigh else np.ones(len(begun[0][0]))
    factor, last, steps, weighings = most, not weigh, 0, 0
    while True:
        weighings += 1
        last = last or weighings == WEIGHINGS
        shares.ask("weigh", factor, dt)
        how = (max_steps, FINE) if last else (min(ROUGH_STEPS, max_steps), ROUGH)
        ended = refine_shares(shares, units.precision, z, *how)
        z, steps = ended.z, steps + ended.steps
        products = np.sum(shares.ask("left", z), axis=0)
        if last or not np.isfinite(ended.cost):
            break
        before, factor = factor, overdispersion_of(lambda lag: products[lag], length, most)  # noqa: B023
        last = settled(before, factor) or steps >= max_steps
    return _estimate(freed, units, shares, counts, ended, products, factor, steps)


class Ended(NamedTuple):
    """Where a refinement over shares ended; `cost`, `promised`, `damping`: as of `Refined`."""

    z: Float[np.ndarray, " z"]
    cost: float
    promised: float
    damping: float
    steps: int
    converged: bool


def refine_shares(
    shares: AbstractShares,
    precision: Float[np.ndarray, " z"],
    z: Float[np.ndarray, " z"],
    limit: int,
    rtol: float,
    damping: float = LEAST_DAMPING,
) -> Ended:
    """`refine_windows` of the tasks that shares have taken up: its loop, shares asked at each step."""
    trust, d_z, steps = Trust.start(damping), np.zeros_like(z), 0
    while True:
        at, steps = z + d_z, steps + 1
        tried = shares.ask("cost", at)
        chi2, usable = sum(one[0] for one in tried), all(one[1] for one in tried)
        cost = 0.5 * (chi2 + float(precision @ at**2))
        better, trust = trust.judged(jnp.asarray(cost if usable else np.inf))
        z = at if better else z
        damping = float(trust.damping)
        answers = shares.ask("sums", bool(better), damping)
        g, h = (jnp.asarray(np.sum(parts, axis=0)) for parts in zip(*answers, strict=True))
        d_z = np.asarray(step_of(g, h, jnp.asarray(precision), jnp.asarray(z), damping))
        prior = (precision * z) @ d_z + 0.5 * d_z @ (precision * d_z)
        decrease = sum(shares.ask("step", d_z, damping)) - float(prior)
        trust = trust.promised(jnp.asarray(decrease))
        cost = float(trust.cost)
        ended = 2 * decrease < worth_of(rtol, cost) or not np.isfinite(decrease) or damping > LOST
        if ended or steps >= limit:
            return Ended(z, cost, decrease, damping, steps, ended)


def _estimate(
    freed: Freed,
    units: Units,
    shares: AbstractShares,
    counts: Sequence[int],
    ended: Ended,
    products: np.ndarray,
    factor: np.ndarray,
    steps: int,
) -> Estimate:
    z, converged = ended.z, ended.converged
    begins = np.cumsum([0, *counts[:-1]]).tolist()
    ends = shares.ask("end", z, each=[(begin, sum(counts)) for begin in begins])
    seen, square = products[0]
    finite = bool(np.isfinite(ended.cost))
    return Estimate(
        z=z,
        raw=np.asarray(freed.start) + units.map @ z,
        scores=np.concatenate([one["scores"] for one in ends]),
        information=np.concatenate([one["information"] for one in ends]),
        spurious=pretended(np.sum([one["more"] for one in ends], axis=0)),
        chi2=float(square.sum()) if finite else np.inf,
        weighed_chi2=sum(one["weighed_chi2"] for one in ends),
        freedom=int(seen.sum()) - (12 * sum(counts) - sum(one["loose"] for one in ends)) - len(z),
        steps=steps,
        converged=converged and finite,
        result="converged" if converged else "the maximum number of steps was reached",
        weighed=factor,
        left=np.sqrt(np.where(seen > 0, square / np.maximum(seen, 1), np.nan)),
    )
