"""One sample ahead: how likely a model makes it, and whether what it leaves is noise whatever came before."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from .._types import ALL_CHANNELS
from ..fitting import Affine, estimated, innovations, path_lines, whitened
from ._explanation import Model
from ._workbench import SLOTS, Workbench

# Times that windows are followed, each time from where the one before lets one expect them to begin.
PASSES = 3
# Times that the disturbance of logs is looked at which a model is scored on: as it was, and estimated twice.
WEATHERS = 3
# What came before, in octaves of samples.
PAST = tuple(slice(first, 2 * first) for first in (1, 2, 4, 8, 16))


@dataclasses.dataclass(frozen=True)
class Remembered:
    """The innovations of a channel that go most with something before.

    - `on`: the command, or None for the channel's own innovations; `ago` [s], from when to when.
    - `nats`: what it is worth to know it, with the odds of having tried all others.
    """

    channel: str
    on: str | None
    ago: tuple[float, float]
    nats: float


def remembered(bench: Workbench, model: Model) -> Remembered | None:
    """What the innovations of a model beside its disturbance depend on most, where that is certain.

    One number at a time: the mean of a past command, or of past innovations, over an octave of time. White
    noise of size one depends on none of them. The evidence is Schwarz's, with odds for how many were tried.
    """
    names, logs = bench.vehicle.command_names, bench.data.logs
    commands = [log.commanded(names) for log in logs]
    given = {name: [c[:, i] for c in commands if c is not None] for i, name in enumerate(names)}
    given = {name: of_logs for name, of_logs in given.items() if len(of_logs) == len(logs)}
    found = [
        (_evidence(white, source, ago), channel, on, ago)
        for channel, white in _of_channels(bench, model).items()
        for on, source in ({None: white} | given).items()
        for ago in PAST
    ]
    nats, channel, on, ago = max(found, key=lambda one: one[0])
    nats -= math.log(len(found))
    if nats < bench.criteria.close:
        return None
    dt = float(np.median([log.dt for log in logs]))
    return Remembered(channel, on, (ago.start * dt, (ago.stop - 1) * dt), nats)


def log_score(bench: Workbench, model: Model, weathers: int = WEATHERS) -> float:
    """Logarithm of the density of each measured number in units of its noise [nats], all before it known.

    Given the sizes and memories of the disturbance that suit these logs best: their weather is not that
    of the others, and a model is not to blame for it.

    - `model`: of another workbench, beside a disturbance; what begins has begun.
    - `weathers`: times that the disturbance is looked at; with one it is as of the model.
    """
    assert model.beside is not None
    fine, begun = bench.fine, tuple(dataclasses.replace(member, since=None) for member in model.members)
    force = dataclasses.replace(model.beside.force, gap=fine.begin.gap, joined=fine.begin.joined)
    theta = jnp.asarray(bench.theta(dataclasses.replace(model, members=begun)))
    # As wide as that of a refinement, whose program this is then.
    nothing = Affine(theta, jnp.zeros((theta.shape[1], SLOTS)), jnp.ones((len(theta), SLOTS)))
    problem, path = bench.problem(begun, fine.problem), fine.path
    group, covariance = jnp.zeros(len(fine.group), int), model.beside.covariance
    scores = []
    for time in range(weathers):
        if time:
            every = path_lines(problem, nothing, force, path)
            force, covariance, _ = estimated(bench.spread, every, force, fine.unit, covariance, far=True)
        found = innovations(problem, nothing, force, path, group, 1)
        for _ in range(PASSES - 1):
            found = innovations(problem, nothing, force, found.path, group, 1)
        path = found.path
        minus_twice = float(np.asarray(found.minus_twice)[: fine.count].sum())
        scores.append(-0.5 * (minus_twice / bench.samples + float(np.log(2 * np.pi))))
    return max(filter(np.isfinite, scores), default=-np.inf)


def whiten(bench: Workbench, model: Model) -> Float[np.ndarray, "windows steps rows"]:
    """What each sample says that none before it did, in standard deviations; NaN where none was taken.

    Rows are the channels that are measured; only beside a disturbance.
    """
    assert model.beside is not None
    (problem, affine), beside = bench.along(model), model.beside
    white = np.asarray(whitened(problem, affine, beside.force, beside.path))
    white = white[: bench.fine.count]
    taken = np.asarray(problem.windows.weight)[: bench.fine.count][..., np.array(problem.channels)] > 0
    return np.where(taken, white, np.nan)


def _of_channels(bench: Workbench, model: Model) -> dict[str, list[Float[np.ndarray, " samples"]]]:
    """The innovations of each measured channel over the samples of each log, NaN where there are none."""
    white, problem = whiten(bench, model), bench.fine.problem
    log, step = (np.asarray(a)[: len(white)] for a in (problem.windows.log, problem.windows.step))
    out = dict[str, list[np.ndarray]]()
    for row, channel in enumerate(problem.channels):
        of_logs = [np.full(len(one.t), np.nan) for one in bench.data.logs]
        for i, series in enumerate(of_logs):
            here = log == i
            series[step[here]] = white[here][..., row]
        out[ALL_CHANNELS[channel]] = of_logs
    return out


def _evidence(
    white: list[Float[np.ndarray, " samples"]], source: list[Float[np.ndarray, " samples"]], ago: slice
) -> float:
    """Nats that it is worth to know the mean of a source so many samples ago; NaN counts as none."""
    taps = np.zeros(ago.stop)
    taps[ago] = 1 / (ago.stop - ago.start)
    known = [lfilter(taps, 1.0, np.nan_to_num(past - np.nanmean(past))) for past in source]
    now, past = np.concatenate(white), np.concatenate(known)
    now, past = now[np.isfinite(now)], past[np.isfinite(now)]
    if not past.any():
        return -math.inf
    return float(0.5 * ((now @ past) ** 2 / (past @ past) - math.log(len(now))))


def told(one: Remembered) -> str:
    """What the innovations' dependence means for names, and what to log instead, in two sentences."""
    begin, end = one.ago
    when = f"{begin:.2g} s" if begin == end else f"{begin:.2g} to {end:.2g} s"
    if one.on is None:
        return (
            f"What the model leaves of {one.channel} still goes with what it left of it {when} before (by "
            f"{one.nats:.3g} nats): something acts that neither the model nor its disturbance has, so that "
            "no cause is called more than positive."
        )
    return (
        f"What the model leaves of {one.channel} still goes with the command of {one.on} {when} before (by "
        f"{one.nats:.3g} nats): commands answer disturbances that the model does not have, so that no cause "
        "is called more than positive. Log the set-points of the autopilot, or some minutes steered by hand."
    )
