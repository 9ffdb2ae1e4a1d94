"""What an extension buys: open-loop predictions of a log that was not fitted."""

import dataclasses
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from .._types import CHANNELS, POSITION, VELOCITY
from ..effects import AbstractEffect
from ..fitting import (
    Affine,
    Problem,
    Room,
    Task,
    Windows,
    cut,
    measured_channels,
    predict,
    refine_windows,
    start_precision,
    wrapped,
)
from ..logs import Log
from ..vehicle import Vehicle
from ._result import BeforeAfter, Gain, Predictions
from ._saturated import SaturatedPlant

# Of a prediction, and at least: of the run-in before it, and of the stretch over which starts lie [s].
HORIZON, RUN_IN, OF_STARTS = 5.0, 2.0, 2.0
LEAST = HORIZON + RUN_IN + OF_STARTS  # [s] of a log on which a gain is measured
STARTS = 60  # predictions at most
MOST_STRETCHES = 10
# Windows of the training whose program also serves the starts, mostly filled up; beside more of them it is
# quicker to compile another one, which the starts in training and test log share.
MOST_FILLED = 640
RUNAWAY = 1e6  # standard deviations of the noise at which a prediction counts as having run away


# Phases that a wave is tried with; what lies between is interpolated by trigonometric polynomials.
PHASES = 8


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A model to predict with: a vehicle, the catalogue's families in it, their parameters per segment.

    - `gates` [segments, placed]: which effects of the vehicle itself act in a segment.
    - `phases`: which of the parameters are phases of the log's clock.
    """

    vehicle: Vehicle
    families: tuple[AbstractEffect, ...]
    theta: np.ndarray
    gates: np.ndarray
    phases: tuple[int, ...] = ()

    @property
    def swings(self) -> bool:
        """Whether something in it has a phase that another log does not know."""
        return bool(self.phases) or any(placed.effect.phases for placed in self.vehicle.placed)

    def turned(self, angle: float) -> "Candidate":
        """The same with all phases later by an angle [rad]."""
        theta = self.theta.copy()
        theta[:, list(self.phases)] += angle
        placed = tuple(
            dataclasses.replace(
                p,
                effect=dataclasses.replace(
                    p.effect, **{name: getattr(p.effect, name) + angle for name in p.effect.phases}
                ),
            )
            for p in self.vehicle.placed
        )
        vehicle = dataclasses.replace(self.vehicle, placed=placed)
        return dataclasses.replace(self, vehicle=vehicle, theta=theta)


def predictions(
    candidates: Sequence[Candidate],
    log: Log,
    noise: np.ndarray,
    run_in: float,
    step: float,
    segment: np.ndarray,
    room: Room,
    slots: int,
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, int]:
    """Times, predicted channels of each candidate, measured channels, and where the prediction begins.

    - `step`: the longest of the training's integration [s].
    - `room`, `slots`: those of the training, whose program estimates the starts where the log fits into it.

    Each candidate estimates the state at a start by itself, from the `run_in` seconds before it; what
    lies after the start is not looked at.
    """
    length = run_in + HORIZON
    stride = max(log.dt, (log.duration - length) / STARTS)
    vehicle = candidates[0].vehicle
    data = cut(vehicle, [log], noise, length, stride, [segment])
    own = Room.of(data.records, data.windows)
    if not room.holds(own):
        room = own
    elif room.windows > MOST_FILLED:
        room = dataclasses.replace(room, windows=own.windows)
    records, windows = room.filled(data.records, data.windows)
    channels = measured_channels(data.windows)
    begin = round(run_in / length * windows.step.shape[1])
    split = jnp.asarray(math.ceil(data.hold / step - 0.01))
    names = ("step", "measured", "weight")
    seen = dataclasses.replace(windows, **{name: getattr(windows, name)[:, :begin] for name in names})
    precision = jnp.asarray(start_precision(vehicle.free))

    def shown(one: Candidate) -> np.ndarray:
        plant = SaturatedPlant(one.vehicle, one.families, jnp.asarray(one.gates))
        theta = jnp.asarray(one.theta)
        problem = Problem(plant, records, windows, precision, channels, split, apart=False)
        # No parameter is free here, only the states at the starts.
        task = Task(
            dataclasses.replace(problem, windows=seen),
            Affine(theta, jnp.zeros((theta.shape[1], slots)), jnp.ones((len(theta), slots))),
            jnp.ones(slots),
        )
        started = refine_windows(task, jnp.zeros(slots), jnp.zeros((windows.count, 12)), 10, rtol=1e-5)
        return np.asarray(predict(problem, theta, started.delta)[0])[: data.windows.count]

    turns = 2 * np.pi * np.arange(PHASES) / PHASES
    out = [
        _in_phase(np.array([shown(one.turned(turn)) for turn in turns]), data.windows, begin)
        if one.swings
        else shown(one)
        for one in candidates
    ]
    times = log.t[np.asarray(data.windows.step)]
    measured = np.where(np.asarray(data.windows.weight) > 0, np.asarray(data.windows.measured), np.nan)
    return times, out, measured, begin


def _in_phase(tried: np.ndarray, windows: Windows, begin: int) -> np.ndarray:
    """Predictions [starts, steps, 18] with the phase that fits the data before each start best.

    - `tried` [phases, starts, steps, 18]: the predictions with phases spread evenly over a turn.
    """
    tried = tried[0] + np.asarray(wrapped(tried - tried[0]))
    error = np.asarray(wrapped(tried - np.asarray(windows.measured))) * np.asarray(windows.weight)
    # All that lies before a start: the run-ins of the starts up to it, which stand in order of time.
    past = np.cumsum((error[:, :, :begin] ** 2).sum(axis=(2, 3)), axis=1)
    count = len(tried)
    angles = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)
    away = angles[:, None] - 2 * np.pi * np.arange(count) / count
    # Trigonometric interpolation: 1 at its own phase, 0 at the others tried.
    order = np.arange(1, count // 2)
    share = (1.0 + 2.0 * np.cos(order * away[..., None]).sum(-1) + np.cos(count / 2 * away)) / count
    best = np.argmin(share @ past, axis=0)
    return np.einsum("sk,kstc->stc", share[best], tried)


def _missed(predicted: np.ndarray, measured: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Errors of predictions, NaN only where nothing was measured: one that runs away is far off."""
    error = np.asarray(wrapped(predicted - measured))
    most = RUNAWAY * noise
    error = np.where(np.isfinite(error), np.clip(error, -most, most), most)
    return np.where(np.isfinite(measured), error, np.nan)


def _rms(error: np.ndarray, names: tuple[str, ...]) -> float | None:
    """Root mean square length of the vector of those channels, None where none was measured."""
    columns = [CHANNELS.index(name) for name in names]
    squares = error[..., columns] ** 2
    seen = np.isfinite(squares).sum(axis=(0, 1))
    if not seen.any():
        return None
    return float(np.sqrt((np.nansum(squares, axis=(0, 1)) / np.maximum(seen, 1)).sum()))


def _stretches(times: Float[np.ndarray, "starts steps"]) -> int:
    """How many stretches of a log have little in common: none is shorter than a prediction with its run-in.

    And no more than ten, so that those of a long log are longer than what disturbs it lasts.
    """
    return min(int((times[-1, -1] - times[0, 0]) / (times[0, -1] - times[0, 0])), MOST_STRETCHES)


def _ratio(
    before: Float[np.ndarray, " starts"], after: Float[np.ndarray, " starts"], stretches: int
) -> tuple[float, tuple[float, float] | None]:
    """Root of the ratio of two sums over starts, and its interval, None from less than two stretches.

    Jackknife of its logarithm over stretches of neighbouring starts, with Student's quantile (Tukey 1958;
    Künsch 1989 for stretches).
    """

    def log_ratio(kept: np.ndarray) -> float:
        return 0.5 * float(np.log(after[kept].sum() / before[kept].sum()))

    everything = np.arange(len(before))
    whole = log_ratio(everything)
    if stretches < 2:
        return float(np.exp(whole)), None
    left_out = np.array_split(everything, stretches)
    without = np.array([log_ratio(np.setdiff1d(everything, part)) for part in left_out])
    half = stdtrit(stretches - 1, 0.975) * np.sqrt((stretches - 1) ** 2 / stretches * without.var(ddof=1))
    return float(np.exp(whole)), (float(np.exp(whole - half)), float(np.exp(whole + half)))


def gain(
    times: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    measured: np.ndarray,
    begin: int,
    noise: np.ndarray,
    held_out: bool,
) -> tuple[Gain, Predictions]:
    """The gain with its interval, for which the starts are cut into stretches of time."""
    errors = [_missed(p[:, begin:], measured[:, begin:], noise) for p in (before, after)]
    scaled = [np.nansum((e / noise) ** 2, axis=(1, 2)) for e in errors]

    def pair(names: tuple[str, ...]) -> BeforeAfter | None:
        values = [_rms(e, names) for e in errors]
        return None if values[0] is None or values[1] is None else BeforeAfter(values[0], values[1])

    whole, interval = _ratio(scaled[0], scaled[1], _stretches(times))
    return (
        Gain(
            horizon=HORIZON,
            position=pair(POSITION),
            velocity=pair(VELOCITY),
            ratio=whole,
            ratio_ci95=interval,
            held_out=held_out,
            starts=len(times),
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
