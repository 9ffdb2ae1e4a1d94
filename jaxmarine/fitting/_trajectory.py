"""The trajectory loss: windows rolled out from their own initial states, against all channels."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._types import ALL_CHANNELS
from ..logs import Log
from ..simulation import gates, substeps
from ..vehicle import Vehicle
from ._affine import Affine
from ._estimate import Estimate, Units
from ._free import Freed, FreedPlant
from ._linearise import Statistics
from ._rollout import Problem, measured_channels, predict, start_precision
from ._solver import Refined, Task, refine_windows
from ._weights import largest, overdispersion, scaled, settled
from ._windows import Cut, cut

# Costly windows lie so many robust standard deviations above the median.
_COSTLY = 5.0
# Steps of the initial states in a judgement of the windows, and of everything between two of them: from far
# off the first ten may go into finding the damping. How many judgements keep but the better half, and how
# many there are at most.
_JUDGING, _BETWEEN, _HALVING, _JUDGEMENTS = 4, 16, 4, 12
# Solves at most, each with the weights that the one before asks for: from far off two or three find the
# model, and as many more its weights.
WEIGHINGS = 8
# Windows that a start which runs away is first mended over are no shorter than this [s], and have half of
# these samples at least.
_SHORTEST, _FEWEST = 0.5, 16
# Steps of each but the last, and the share of the cost that one must promise: the next has other weights. The
# last ends where a step promises nothing any more.
ROUGH_STEPS, ROUGH, FINE = 12, 1e-3, 1e-9
# A solve that damping has slowed in a curved valley ends where a damped step promises nothing, though one
# without promises more than this (half a chi-square): it begins anew with little damping, so often at most.
_PROMISES, _ANEW = 0.05, 8
# How many times finer the integration may become for a fitted vehicle stiffer than its start.
FINEST = 10


@dataclasses.dataclass(frozen=True)
class Segments:
    """Which placed effects act: per log and sample the segment, per segment the gates."""

    of_samples: tuple[np.ndarray, ...]
    gates: Float[np.ndarray, "segments placed"]


def segments(vehicle: Vehicle, logs: Sequence[Log], later: Sequence[str] = ()) -> Segments:
    """Segments of logs in the order in which they were recorded; `later`: names of those after them."""
    names = [*(log.name for log in logs), *later]
    rows = []
    for g, log in enumerate(logs):
        row, before = gates(vehicle, log), gates(vehicle, log, earlier=(log.name,))
        for i, placed in enumerate(vehicle.placed):
            if placed.since_log in names[g + 1 :]:
                row[:, i] = before[:, i]
        rows.append(row)
    unique, index = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    ends = np.cumsum([len(row) for row in rows])[:-1]
    return Segments(tuple(np.split(index.ravel(), ends)), unique)


def fit_trajectory(
    freed: Freed,
    units: Units,
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    window: float,
    max_steps: int,
    held: bool,
    reject: bool,
    weigh: bool,
    z: Float[np.ndarray, " z"],
) -> Estimate:
    """Minimises the chi-square of the windows over z and all initial states, unless those are held, from z.

    - `reject`: leaves out costly windows, see `_without_costly`.
    - `weigh`: channels count by what the model leaves in them, where that is more than `noise`.
    """
    vehicle = freed.vehicle
    acting = segments(vehicle, logs)
    best = None
    data = cut(vehicle, logs, noise, window, segments=acting.of_samples)
    split, steps = substeps(vehicle, data.hold), 0
    if z.any():
        begun = freed(jnp.asarray(np.asarray(freed.start) + units.map @ z))
        split = max(split, substeps(begun, data.hold))
    while True:
        task = window_task(freed, units, data, acting, split, held, data.speeds)
        solved = _solved(task, jnp.asarray(z), logs[0].dt, max_steps, reject, weigh)
        steps += solved.steps
        now = _estimate(freed, units, data, task, solved, steps)
        if not now.finite and not z.any() and window > max(2 * _SHORTEST, _FEWEST * data.hold):
            # The start runs away before a window has ended; over shorter ones it may be mended.
            nearer = fit_trajectory(freed, units, logs, noise, window / 2, max_steps, held, reject, weigh, z)
            steps += nearer.steps
            if nearer.finite and nearer.z.any():
                z = nearer.z
                split = max(split, min(substeps(freed(jnp.asarray(nearer.raw)), data.hold), FINEST * split))
                continue
        if not now.finite:
            # Finer steps from a point far off may fail where coarse ones had ended.
            return now if best is None else best
        # The fitted vehicle may be stiffer than its start.
        needed = min(substeps(freed(jnp.asarray(now.raw)), data.hold), FINEST * split)
        if needed <= split or best is not None:
            return now
        split, z, best = needed, now.z, now


@dataclasses.dataclass(frozen=True)
class _Solved:
    """Where a solve ended, the task as it was weighed there, factors of the noise, and steps in all.

    - `residual`: in units of the sensors' own noise, NaN where nothing was measured or used.
    """

    task: Task
    refined: Refined
    factor: Float[np.ndarray, " channels"]
    steps: int
    residual: Float[np.ndarray, "windows steps channels"]


def _solved(task: Task, z, dt: float, max_steps: int, reject: bool, weigh: bool) -> _Solved:
    """Solves with weights that the solution confirms.

    What a channel weighs and what the model leaves in it are found by turns: first each weighs by how much
    it changes, under which a file that is far off is pulled gently; then by what the last solve left.
    Source: the relaxation of the noise's covariance in output-error fits, after Maine and Iliff (1986).
    """
    windows = task.problem.windows
    own, delta = np.asarray(windows.weight), jnp.zeros((windows.count, 12))
    most = largest(np.asarray(windows.measured), own) if weigh else np.ones(own.shape[2])
    factor, last, steps, weighings = most, not weigh, 0, 0
    while True:
        weighings += 1
        last = last or weighings == WEIGHINGS
        weighed = task.weighed(scaled(own, factor, dt))
        if reject:
            weighed, z, delta = _without_costly(weighed, z, delta)
        how = (max_steps, FINE) if last else (min(ROUGH_STEPS, max_steps), ROUGH)
        refined = refine_windows(weighed, z, delta, *how)
        steps += int(refined.steps)
        for _ in range(_ANEW if last else 0):
            if not (refined.converged and _promise(weighed, refined) > _PROMISES):
                break
            refined = refine_windows(weighed, refined.z, refined.delta, *how)
            steps += int(refined.steps)
        z, delta = refined.z, refined.delta
        used = own * (np.asarray(weighed.problem.windows.weight) > 0)
        residual = np.asarray(predict(task.weighed(used).problem, task.affine(z), delta)[1])
        if last or not np.isfinite(refined.cost):
            break
        before, factor = factor, overdispersion(residual, used, most)
        # Whoever allows few steps does not want them spent on weights.
        last = settled(before, factor) or steps >= max_steps
    return _Solved(weighed, refined, factor, steps, np.where(used > 0, residual, np.nan))


def _promise(task: Task, refined: Refined) -> float:
    """Half the chi-square that one more step without damping promises."""
    _, scores, information = refined.stats.reduced()
    slope = np.asarray(scores).sum(0) + np.asarray(task.precision) * np.asarray(refined.z)
    curvature = np.asarray(information).sum(0) + np.diag(np.asarray(task.precision))
    if not np.isfinite(curvature).all():
        return 0.0
    return 0.5 * float(slope @ np.linalg.lstsq(curvature, slope)[0])


def window_task(
    freed: Freed,
    units: Units,
    data: Cut,
    acting: Segments,
    split: int,
    held: bool,
    speeds: Float[np.ndarray, "6"],
) -> Task:
    """The task of all windows.

    - `held`: each begins in the state that was measured.
    - `speeds`: of the craft in all windows, these and others, see `start_precision`.
    """
    vehicle, count = freed.vehicle, len(acting.gates)
    problem = Problem(
        FreedPlant(freed, jnp.asarray(acting.gates)),
        data.records,
        data.windows,
        jnp.asarray(start_precision(np.zeros(6) if held else vehicle.free, speeds)),
        measured_channels(data.windows),
        jnp.asarray(split),
        axes=vehicle.axes,
    )
    return Task(
        problem,
        Affine(
            jnp.tile(freed.start[None], (count, 1)),
            jnp.asarray(units.map),
            jnp.ones((count, units.map.shape[1])),
        ),
        jnp.asarray(units.precision),
    )


def _without_costly(task: Task, z, delta):
    """The task without the windows that cost far more than the median one, and where to go on from.

    Something acted in them that no parameter stands for: a collision, a snagged cable, a sensor's fault.
    By turns all windows are judged with z held, and z is refined on those that were found good. At first
    these are the better half, because a fit that the bad ones have bent no longer shows them; then all that
    do not stand out, until the same ones do. Source: concentration steps and reweighting of least trimmed
    squares (Rousseeuw and Van Driessen 2006, Data Mining and Knowledge Discovery 12, 29-45).
    """
    full, kept = task, np.zeros(len(delta), bool)
    for judgement in range(_JUDGEMENTS):
        # An empty map holds z, so that the initial states alone are fitted.
        empty = Affine(full.affine(z), jnp.zeros_like(full.affine.columns), full.affine.acts)
        held = dataclasses.replace(full, affine=empty)
        judged = refine_windows(held, jnp.zeros_like(z), delta, _JUDGING)
        delta, cost = judged.delta, np.asarray(judged.stats.reduced()[0])
        middle = np.median(cost)
        scatter = 1.4826 * np.median(np.abs(cost - middle))
        limit = middle if judgement < _HALVING else middle + _COSTLY * scatter
        before, kept = kept, cost <= limit
        task = full.weighed(full.problem.windows.weight * jnp.asarray(kept)[:, None, None])
        if judgement > _HALVING and (kept == before).all():
            break
        refined = refine_windows(task, z, delta, _BETWEEN)
        z, delta = refined.z, refined.delta
    return task, z, delta


def _estimate(freed: Freed, units: Units, data: Cut, task: Task, solved: _Solved, steps: int) -> Estimate:
    refined, residual = solved.refined, solved.residual
    weighed_chi2, scores, information = refined.stats.reduced()
    # Components of the initial states that the data hold, rather than their weak prior.
    pull = np.asarray(task.problem.start_precision)
    try:
        loose = np.einsum("wii,i->", np.linalg.inv(np.asarray(refined.stats.h_xx)), pull)
    except np.linalg.LinAlgError:  # of a roll-out that diverged; the cost says so
        loose = 0.0
    seen = np.isfinite(residual)
    z = np.asarray(refined.z)
    weight = np.asarray(solved.task.problem.windows.weight)
    return Estimate(
        z=z,
        raw=np.asarray(freed.start) + units.map @ z,
        scores=np.asarray(scores),
        information=np.asarray(information),
        spurious=spurious(solved.task, refined),
        chi2=float(np.nansum(residual**2)) if np.isfinite(refined.cost) else np.inf,
        weighed_chi2=float(weighed_chi2.sum()),
        freedom=int(seen.sum()) - (12 * data.windows.count - float(loose)) - len(z),
        steps=steps,
        converged=bool(refined.converged) and bool(np.isfinite(refined.cost)),
        result=optx.RESULTS[refined.result] or "converged",  # pyrefly: ignore[bad-index]
        rejected=data.starts[(weight == 0).all(axis=(1, 2))],
        weighed=solved.factor,
        left=_root_mean_square(residual),
        worst=_worst(data, task, solved),
    )


def _root_mean_square(residual: np.ndarray) -> Float[np.ndarray, " channels"]:
    """Of each channel, NaN where it was not measured."""
    count = np.isfinite(residual).sum(axis=(0, 1))
    return np.sqrt(np.where(count > 0, np.nansum(residual**2, axis=(0, 1)) / np.maximum(count, 1), np.nan))


def _worst(data: Cut, task: Task, solved: _Solved) -> str:
    """Where a fit that fails goes wrong most: log, time and channel of the largest residual, as weighed.

    One that diverged has moved nothing: then where the start does.
    """
    windows = solved.task.problem.windows
    weight, own = np.asarray(windows.weight), np.asarray(task.problem.windows.weight)
    used = weight > 0
    error = (solved.residual * weight / np.where(used, own, 1.0)) ** 2
    error = np.where(used, np.nan_to_num(error, nan=np.inf, posinf=np.inf), 0.0)
    window = int(np.argmax(error.sum(axis=(1, 2))))
    channel = ALL_CHANNELS[int(np.argmax(error[window].sum(axis=0)))]
    log = data.logs[int(np.asarray(windows.log)[window])]
    return f"{log.name} from t = {data.starts[window]:.6g} s on, in `{channel}`"


def spurious(task: Task, refined: Refined) -> np.ndarray:
    """Information that the noise in the estimated initial states pretends.

    A vehicle at rest seems to move by what its initial states were fitted to noise, and that seems
    to determine its parameters. As much noise once more adds as much information once more:
    the mean over two opposite draws, which cancel to first order, less what is there.
    """
    there = np.asarray(refined.stats.reduced()[2].sum(0))
    if not np.isfinite(there).all():
        return there
    draws = np.random.default_rng(0).normal(size=refined.delta.shape)
    try:
        moved = drawn(task, refined.stats, draws)
    except np.linalg.LinAlgError:  # of a roll-out that diverged
        return there
    both = []
    for sign in (1.0, -1.0):
        # One step leaves the statistics where it began, by a program that is compiled already.
        probe = refine_windows(task, refined.z, refined.delta + sign * moved, 1)
        both.append(np.asarray(probe.stats.reduced()[2].sum(0)))
    return pretended(np.mean(both, axis=0) - there)


def drawn(task: Task, stats: Statistics, draws: Float[np.ndarray, "windows 12"]) -> Array:
    """Changes of the initial states by their noise, from standard normal draws."""
    factor = np.linalg.cholesky(np.linalg.inv(np.asarray(stats.h_xx)))
    # Windows that were rejected, or that only fill up an array, have nothing that would hold their draws.
    used = np.any(np.asarray(task.problem.windows.weight) > 0, axis=(1, 2))
    return jnp.asarray(np.einsum("wij,wj->wi", factor, draws) * used[:, None])


def pretended(more: Float[np.ndarray, "z z"]) -> Float[np.ndarray, "z z"]:
    """The part of an information that is one, and not negative."""
    # Draws from which a roll-out diverges tell nothing.
    values, vectors = np.linalg.eigh(np.where(np.isfinite(more).all(), more, 0.0))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T
