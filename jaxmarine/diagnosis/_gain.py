"""What an extension buys: open-loop predictions of logs that were not fitted."""

import dataclasses
import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtrit

from .._types import ALL_CHANNELS, ATTITUDE, POSITION, RATE, VELOCITY
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
from ._result import FAR, BeforeAfter, Gain, LogGain, Predictions, Unscored
from ._saturated import SaturatedPlant

# Of a prediction, and at least: of the run-in before it, and of the stretch over which starts lie [s].
HORIZON, RUN_IN, OF_STARTS = 5.0, 2.0, 2.0
LEAST = HORIZON + RUN_IN + OF_STARTS  # [s] of a log on which a gain is measured
STARTS = 60  # predictions at most
MOST_STRETCHES = 10
# Windows of the training whose program also serves the starts, mostly filled up; beside more of them, and
# beside several logs, it is quicker to compile another one with room for all starts, which all logs share.
MOST_FILLED, ROOM = 640, STARTS + 10
RUNAWAY = 1e6  # standard deviations of the noise at which a prediction counts as having run away
# Share of a sensor's noise by which an error must have grown, root mean square, to be told: where a model was
# as good as the sensor this makes it larger by an eighth, as much as the estimate of a noise may be off.
SHOWS = 0.5
# A start's state is looked at over the last so many seconds before it. It is wrong where it is off by so many
# standard deviations of the noise (the noise itself leaves 1, what disturbs a vehicle 2 or 3) and by so many
# times what the starts are off by usually.
LAST, BEYOND, USUAL = 0.5, 5.0, 3.0
FEWEST = 5  # starts of which a gain is made, if others are wrong
QUANTITIES = {"position": POSITION, "attitude": ATTITUDE, "velocity": VELOCITY, "rate": RATE}

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


def run_in_of(log: Log, window: float) -> float:
    """Seconds before a start from which its state is estimated: a window's length, less in a short log."""
    return min(window, max(RUN_IN, log.duration - HORIZON - OF_STARTS))


def stride_of(log: Log, run_in: float) -> float:
    """Seconds from one start to the next, for as many as there are at most."""
    return max(log.dt, (log.duration - run_in - HORIZON) / STARTS)


def predictions(
    candidates: Sequence[Candidate],
    log: Log,
    noise: np.ndarray,
    run_in: float,
    step: float,
    segment: np.ndarray,
    room: Room,
    slots: int,
    stride: float | None = None,
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, int]:
    """Times, predicted channels of each candidate, measured channels, and where the prediction begins.

    - `step`: the longest of the training's integration [s].
    - `room`, `slots`: those of the training, whose program estimates the starts where the log fits into it.
    - `stride`: time from one start to the next [s]; default that of `STARTS` of them.

    Each candidate estimates the state at a start by itself, from the `run_in` seconds before it; what
    lies after the start is not looked at.
    """
    length = run_in + HORIZON
    stride = stride_of(log, run_in) if stride is None else stride
    vehicle = candidates[0].vehicle
    data = cut(vehicle, [log], noise, length, stride, [segment])
    own = Room.of(data.records, data.windows)
    if not room.holds(own):
        room = own
    elif room.windows > MOST_FILLED or room.logs > 1:
        room = dataclasses.replace(room, logs=1, windows=max(own.windows, ROOM))
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
        parts = plant, records, windows, precision, channels, split
        problem = Problem(*parts, apart=False, axes=one.vehicle.axes)
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
    """Predictions [starts, steps, channels] with the phase that fits the data before each start best.

    - `tried` [phases, starts, steps, channels]: the predictions with phases spread evenly over a turn.
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


def _stretches(times: Float[np.ndarray, "starts steps"]) -> int:
    """How many stretches of a log have little in common: none is shorter than a prediction with its run-in.

    And no more than ten, so that those of a long log are longer than what disturbs it lasts.
    """
    return min(int((times[-1, -1] - times[0, 0]) / (times[0, -1] - times[0, 0])), MOST_STRETCHES)


@dataclasses.dataclass(frozen=True)
class _Sums:
    """Squared errors before and after, and how many there are, summed over the steps of each start.

    Of several columns (channels) the mean squares are added up: that is the length of a vector. `stretches`:
    the starts of each stretch of a log.
    """

    before: Float[np.ndarray, "starts columns"]
    after: Float[np.ndarray, "starts columns"]
    seen: Int[np.ndarray, "starts columns"]
    stretches: tuple[Int[np.ndarray, " _"], ...]

    def of(self, columns: Sequence[int]) -> "_Sums":
        parts = {name: getattr(self, name)[:, columns] for name in ("before", "after", "seen")}
        return dataclasses.replace(self, **parts)

    def within(self, starts: Int[np.ndarray, " some"]) -> tuple[float, float]:
        """The mean squares over some starts."""
        count = np.maximum(self.seen[starts].sum(0), 1)
        before, after = (float((sums[starts].sum(0) / count).sum()) for sums in (self.before, self.after))
        return before, after

    def ratio(self) -> tuple[float, tuple[float, float] | None]:
        """Root of the ratio of after to before, and its interval, None from less than two stretches.

        Jackknife of its logarithm over stretches of neighbouring starts, with Student's quantile (Tukey 1958;
        Künsch 1989 for stretches).
        """

        def log_ratio(starts: np.ndarray) -> float:
            before, after = self.within(starts)
            return 0.5 * float(np.log(after) - np.log(before))

        everything, count = np.concatenate(self.stretches), len(self.stretches)
        # Where nothing was wrong there is no ratio.
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = log_ratio(everything)
            without = [log_ratio(np.setdiff1d(everything, part)) for part in self.stretches if count > 1]
        if count < 2 or not np.isfinite(without).all():
            return float(np.exp(whole)), None
        half = stdtrit(count - 1, 0.975) * np.sqrt((count - 1) ** 2 / count * np.var(without, ddof=1))
        return float(np.exp(whole)), (float(np.exp(whole - half)), float(np.exp(whole + half)))

    def error(self, noise: Float[np.ndarray, " columns"]) -> BeforeAfter | None:
        """Root-mean-square lengths and their ratio, None where nothing was measured.

        - `noise`: standard deviation of the sensor of each column.
        """
        seen = self.seen.any(axis=0)
        if not seen.any():
            return None
        before, after = self.within(np.concatenate(self.stretches))
        interval = self.ratio()[1]
        certain = interval is not None and interval[0] > 1.0
        shows = after - before > (SHOWS * np.sqrt((noise[seen] ** 2).sum())) ** 2
        return BeforeAfter(float(np.sqrt(before)), float(np.sqrt(after)), interval, bool(certain and shows))


def _sums(predicted: Sequence[Predictions]) -> _Sums:
    """Those of each channel over the starts of all logs; no stretch reaches from one log into another."""
    before, after, seen, stretches, first = [], [], [], [], 0
    for one in predicted:
        here = slice(one.begin, None)
        errors = [_missed(p[:, here], one.measured[:, here], one.noise) for p in (one.before, one.after)]
        before.append(np.nansum(errors[0] ** 2, axis=1))
        after.append(np.nansum(errors[1] ** 2, axis=1))
        seen.append(np.isfinite(errors[0]).sum(axis=1))
        count = len(one.times)
        stretches += np.array_split(first + np.arange(count), max(_stretches(one.times), 1))
        first += count
    return _Sums(np.concatenate(before), np.concatenate(after), np.concatenate(seen), tuple(stretches))


def _in_noise(sums: _Sums, noise: Float[np.ndarray, " channels"]) -> _Sums:
    """One column: all channels together, each in units of its noise."""
    scale = np.where(np.isfinite(noise), noise, np.inf) ** 2
    before, after = ((each / scale).sum(1, keepdims=True) for each in (sums.before, sums.after))
    return _Sums(before, after, np.ones_like(sums.seen[:, :1]), sums.stretches)


def _off_at_start(one: Predictions) -> Float[np.ndarray, "starts quantities"]:
    """How far each start's state is off, in units of the noise: by the model of the two that meets it better.

    Root mean square over the channels of a quantity and the last samples before the prediction begins.
    """
    step = float(np.median(np.diff(one.times, axis=1)))
    here = slice(max(one.begin - max(round(LAST / step), 1), 0), one.begin)
    out = np.full((2, len(one.times), len(QUANTITIES)), np.nan)
    for model, predicted in enumerate((one.before, one.after)):
        error = _missed(predicted[:, here], one.measured[:, here], one.noise) / one.noise
        for i, names in enumerate(QUANTITIES.values()):
            squares = error[..., [ALL_CHANNELS.index(name) for name in names]] ** 2
            count = np.isfinite(squares).sum(axis=(1, 2))
            mean = np.nansum(squares, axis=(1, 2)) / np.maximum(count, 1)
            out[model, :, i] = np.sqrt(np.where(count > 0, mean, np.nan))
    worst = np.nan_to_num(out).max(axis=2)
    return np.where((worst[1] < worst[0])[:, None], out[1], out[0])


def _scored(predicted: Sequence[Predictions]) -> tuple[list[Predictions], tuple[Unscored, ...], bool]:
    """The predictions without starts of which the state is wrong, what goes, and whether enough is left.

    What is wrong at the start grows over the prediction and hides what the models do. A start goes, for both
    models, where its state is off by far more than the noise (`BEYOND`) and than at the usual start
    (`USUAL`), in the data that lie before it; what comes after it is not looked at. It is judged by the model
    that meets those data better: a wrong vehicle file misses them because it is wrong, which is what the gain
    is to show, and the extended vehicle then meets them. Where both miss them at most starts, sensors or
    forces are at work that neither model has, no start is the odd one, and the gain says little (`FAR`).
    """
    off = [np.nan_to_num(_off_at_start(one)) for one in predicted]
    worst = [one.max(axis=1) for one in off]
    usual = float(np.median(np.concatenate(worst)))
    wrong = [one > max(BEYOND, USUAL * usual) for one in worst]
    names = np.array(list(QUANTITIES))
    unscored = []
    for one, gone, each in zip(predicted, wrong, off, strict=True):
        if gone.any():
            blamed = np.bincount(each[gone].argmax(axis=1), minlength=len(names))
            order = [int(i) for i in np.argsort(-blamed, kind="stable") if blamed[i]]
            unscored.append(Unscored(one.log, int(gone.sum()), len(gone), tuple(names[order].tolist())))
    if sum(int((~gone).sum()) for gone in wrong) < FEWEST:
        return list(predicted), tuple(unscored), False
    parts = ("times", "measured", "before", "after")
    left = [
        dataclasses.replace(one, **{name: getattr(one, name)[~gone] for name in parts})
        for one, gone in zip(predicted, wrong, strict=True)
        if not gone.all()
    ]
    return left, tuple(unscored), usual <= FAR


def gain(
    predicted: Sequence[Predictions], noise: Float[np.ndarray, " channels"], held_out: Sequence[bool]
) -> tuple[Gain, Predictions]:
    """The gain over all test logs with its intervals, and the predictions on the longest of them.

    - `noise`: standard deviation of each channel's sensor alone, beside which an error that grows must show;
      what the errors are weighed by stands in the predictions.
    - `held_out`: of each log whether it is no training log.
    """
    scored, unscored, sound = _scored(predicted)
    sums = _sums(scored)
    weights = np.fmax.reduce([one.noise for one in predicted])
    ratio, interval = _in_noise(sums, weights).ratio()
    apart = dict(zip((one.log for one in predicted), held_out, strict=True))
    per_log = [(one, _in_noise(_sums([one]), weights).ratio()) for one in scored]
    each = {name: sums.of([i]).error(noise[[i]]) for i, name in enumerate(ALL_CHANNELS[: len(noise)])}
    quantities = {
        quantity: sums.of(columns).error(noise[columns])
        for quantity, names in QUANTITIES.items()
        for columns in [[ALL_CHANNELS.index(name) for name in names]]
    }
    return (
        Gain(
            horizon=HORIZON,
            **quantities,
            channels={name: error for name, error in each.items() if error is not None},
            ratio=ratio,
            ratio_ci95=interval,
            held_out=all(held_out),
            starts=sum(len(one.times) for one in scored),
            per_log=tuple(
                LogGain(one.log, *found, held_out=apart[one.log], starts=len(one.times))
                for one, found in per_log
            ),
            unscored=unscored,
            sound=sound,
        ),
        max(scored, key=lambda one: one.times[-1, -1] - one.times[0, 0]),
    )
