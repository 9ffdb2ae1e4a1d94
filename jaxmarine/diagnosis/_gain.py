"""What an extension buys: open-loop predictions of a log that was not fitted."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._types import CHANNELS, POSITION, VELOCITY
from ..effects import AbstractEffect
from ..fitting import Affine, Problem, Room, Task, cut, predict, refine_windows, start_precision
from ..logs import Log
from ..vehicle import Vehicle
from ._model import SLOTS
from ._result import BeforeAfter, Gain, Predictions
from ._saturated import SaturatedPlant

HORIZON = 5.0  # [s]
STARTS = 60  # predictions at most
RESAMPLES = 1000


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A model to predict with: a vehicle, the catalogue's families in it, their parameters per segment."""

    vehicle: Vehicle
    families: tuple[AbstractEffect, ...]
    theta: np.ndarray


@eqx.filter_jit
def _predicted(problem, theta, delta):
    return predict(problem, theta, delta)[0]


def predictions(
    candidates: Sequence[Candidate],
    log: Log,
    noise: np.ndarray,
    run_in: float,
    split: int,
    segment: np.ndarray,
    room: Room,
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, int]:
    """Times, predicted channels of each candidate, measured channels, and where the prediction begins.

    `room`: that of the training, whose program estimates the starts where the log fits into it.

    Each candidate estimates the state at a start by itself, from the `run_in` seconds before it; what
    lies after the start is not looked at.
    """
    length = run_in + HORIZON
    stride = max(log.dt, (log.duration - length) / STARTS)
    vehicle = candidates[0].vehicle
    data = cut(vehicle, [log], noise, length, stride, [segment])
    own = Room.of(data.records, data.windows)
    room = room if room.holds(own) else own
    records, windows = room.filled(data.records, data.windows)
    weight = np.asarray(data.windows.weight)
    accelerations = bool((weight[..., 12:] > 0).any())
    begin = round(run_in / length * windows.step.shape[1])
    names = ("step", "measured", "weight")
    seen = dataclasses.replace(windows, **{name: getattr(windows, name)[:, :begin] for name in names})
    precision = jnp.asarray(start_precision(vehicle.free))
    out = []
    for one in candidates:
        gates = jnp.ones((len(one.theta), len(one.vehicle.placed)))
        plant = SaturatedPlant(one.vehicle, one.families, gates)
        theta = jnp.asarray(one.theta)
        # No parameter is free here, only the states at the starts.
        task = Task(
            Problem(plant, records, seen, precision, accelerations, jnp.asarray(split)),
            Affine(theta, jnp.zeros((theta.shape[1], SLOTS)), jnp.ones((len(theta), SLOTS))),
            jnp.ones(SLOTS),
            jnp.zeros(SLOTS),
        )
        started = refine_windows(task, jnp.zeros(SLOTS), jnp.zeros((windows.count, 12)), 10, rtol=1e-5)
        problem = Problem(plant, records, windows, precision, accelerations, jnp.asarray(split))
        shown = np.asarray(_predicted(problem, theta, started.delta))
        out.append(shown[: data.windows.count])
    times = log.t[np.asarray(data.windows.step)]
    measured = np.where(weight > 0, np.asarray(data.windows.measured), np.nan)
    return times, out, measured, begin


def _errors(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    error = predicted - measured
    turn = slice(3, 6)
    error[..., turn] = (error[..., turn] + np.pi) % (2 * np.pi) - np.pi
    return error


def _rms(error: np.ndarray, names: tuple[str, ...]) -> float | None:
    """Root mean square length of the vector of those channels, None where none was measured."""
    columns = [CHANNELS.index(name) for name in names]
    squares = error[..., columns] ** 2
    seen = np.isfinite(squares).sum(axis=(0, 1))
    if not seen.any():
        return None
    return float(np.sqrt((np.nansum(squares, axis=(0, 1)) / np.maximum(seen, 1)).sum()))


def gain(
    times: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    measured: np.ndarray,
    begin: int,
    noise: np.ndarray,
    held_out: bool,
) -> tuple[Gain, Predictions]:
    """The gain with a bootstrap interval over starts in blocks as long as a prediction."""
    errors = [_errors(p[:, begin:].copy(), measured[:, begin:]) for p in (before, after)]
    scaled = [np.nansum((e / noise) ** 2, axis=(1, 2)) for e in errors]

    def pair(names: tuple[str, ...]) -> BeforeAfter | None:
        values = [_rms(e, names) for e in errors]
        return None if values[0] is None or values[1] is None else BeforeAfter(values[0], values[1])

    def ratio(index) -> float:
        return float(np.sqrt(scaled[1][index].sum() / scaled[0][index].sum()))

    starts = len(times)
    rng = np.random.default_rng(0)
    stride = float(np.median(np.diff(times[:, 0]))) if starts > 1 else HORIZON
    block = max(1, min(math.ceil(HORIZON / stride), starts // 3))
    firsts = rng.integers(0, starts, (RESAMPLES, -(-starts // block)))
    drawn = (firsts[:, :, None] + np.arange(block)) % starts
    ratios = [ratio(index) for index in drawn.reshape(RESAMPLES, -1)]
    low, high = np.quantile(ratios, [0.025, 0.975])
    whole = ratio(np.arange(starts))
    return (
        Gain(
            horizon=HORIZON,
            position=pair(POSITION),
            velocity=pair(VELOCITY),
            ratio=whole,
            ratio_ci95=(float(low), float(high)),
            held_out=held_out,
            starts=starts,
        ),
        Predictions(
            times,
            begin,
            measured,
            before,
            after,
            np.where(np.isfinite(measured).any((0, 1)), noise, np.nan),
        ),
    )
