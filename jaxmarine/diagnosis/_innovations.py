"""Whether what an accepted model leaves is noise: white, and independent of past commands."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from .._types import ALL_CHANNELS
from ._model import Model, Workbench

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
        for channel, white in _innovations(bench, model).items()
        for on, source in ({None: white} | given).items()
        for ago in PAST
    ]
    nats, channel, on, ago = max(found, key=lambda one: one[0])
    nats -= math.log(len(found))
    if nats < bench.criteria.close:
        return None
    dt = float(np.median([log.dt for log in logs]))
    return Remembered(channel, on, (ago.start * dt, (ago.stop - 1) * dt), nats)


def _innovations(bench: Workbench, model: Model) -> dict[str, list[Float[np.ndarray, " samples"]]]:
    """The innovations of each measured channel over the samples of each log, NaN where there are none."""
    white, problem = bench.whitened(model), bench.fine.problem
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
