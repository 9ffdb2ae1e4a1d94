"""Curves and points of a diagnosis, as both the page and the pictures draw them.

Angles are shown in degrees, because that is what a compass and a log display show.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from .._angles import ANGLES, wrap_to_pi
from .._types import (
    ALL_CHANNELS,
    ATTITUDE,
    CHANNEL_UNITS,
    DOFS,
    POSITION,
    RATE,
    TABLE,
    VELOCITY,
    WRENCH,
)
from ..diagnosis import Diagnosis, MissingWrench, Predictions, Weighed
from ..logs import moment

GROUP_TITLES = {one.kind: one.title for one in TABLE}
CHANNEL_TITLES = {name: title for one in TABLE for name, title in zip(one.channels, one.titles, strict=True)}
_UNITS = {str(name): unit for name, unit in CHANNEL_UNITS.items()}
_DEGREES = 180.0 / np.pi
_STEPS = 150  # that are drawn of one prediction
_STARTS = 3  # of predictions that are drawn


def shown_unit(channel: str) -> str:
    """The unit in which a channel is shown."""
    return _UNITS[channel].replace("rad", "°")


def shown_scale(channel: str) -> float:
    """What a channel is multiplied by to be in its shown unit."""
    return _DEGREES if "rad" in _UNITS[channel] else 1.0


SCALES = np.array([shown_scale(name) for name in ALL_CHANNELS])


def finite(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """The values with everything that cannot be drawn as NaN."""
    values = np.asarray(values, float)
    return np.where(np.isfinite(values), values, np.nan)


def thinned(count: int, limit: int) -> Int[np.ndarray, " kept"]:
    """At most `limit` indices out of `count`, evenly spread, both ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def difference(predicted: np.ndarray, measured: np.ndarray) -> Float[np.ndarray, "..."]:
    """Predicted minus measured channels; angles the short way round."""
    out = finite(predicted) - finite(measured)
    return np.where(ANGLES[: out.shape[-1]], wrap_to_pi(out), out)


@dataclasses.dataclass(frozen=True)
class GroupError:
    """Root-mean-square prediction error of one sensor kind against the horizon [s], in `unit`.

    `errors` holds one curve before and one after, as `Course.curves` does.
    """

    title: str
    unit: str
    horizon: Float[np.ndarray, " steps"]
    errors: dict[str, Float[np.ndarray, " steps"]]
    noise: float


def errors_by_horizon(predictions: Predictions) -> tuple[GroupError, ...]:
    """One curve per sensor kind that the test log holds."""
    times, begin = predictions.times, predictions.begin
    if times.size == 0 or begin >= times.shape[1]:
        return ()
    horizon = np.median(times[:, begin:] - times[:, begin : begin + 1], axis=0)
    scales = SCALES[: len(predictions.noise)]
    before = difference(predictions.before, predictions.measured)[:, begin:] * scales
    after = difference(predictions.after, predictions.measured)[:, begin:] * scales
    noise = finite(predictions.noise) * scales
    out = []
    for one in TABLE[: len(scales) // 3]:
        columns = [ALL_CHANNELS.index(name) for name in one.channels]
        measured = np.atleast_1d(np.isfinite(before[..., columns]).any(axis=(0, 1)))
        if measured.any():
            columns = [column for column, kept in zip(columns, measured, strict=True) if kept]
            out.append(
                GroupError(
                    title=one.title,
                    unit=shown_unit(one.channels[0]),
                    horizon=horizon,
                    errors={
                        "before": _bridged(horizon, _rms(before[..., columns])),
                        "after": _bridged(horizon, _rms(after[..., columns])),
                    },
                    noise=float(_rms(noise[None, None, columns])[0]),
                )
            )
    return tuple(out)


def _rms(errors: Float[np.ndarray, "starts steps channels"]) -> Float[np.ndarray, " steps"]:
    """Over starts and channels, leaving out what is not there."""
    count = np.isfinite(errors).sum(axis=(0, 2))
    total = np.nansum(errors**2, axis=(0, 2))
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _bridged(
    horizon: Float[np.ndarray, " steps"], curve: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, " steps"]:
    """The curve with lines over steps at which a sensor that is slower than the log was not read."""
    known = np.isfinite(curve)
    return np.interp(horizon, horizon[known], curve[known]) if known.any() else curve


def _misfits(predictions: Predictions) -> Float[np.ndarray, "starts channels"]:
    """Mean square error before, in units of the noise, per start and channel; NaN: not measured."""
    begin = predictions.begin
    errors = difference(predictions.before, predictions.measured)[:, begin:] / predictions.noise
    count = np.isfinite(errors).sum(axis=1)
    total = np.nansum(finite(errors) ** 2, axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def typical_starts(predictions: Predictions) -> tuple[int, ...]:
    """The starts whose error before is nearest to the median, in order of time; apart, where they can be."""
    misfit = _misfits(predictions)
    known = np.flatnonzero(np.isfinite(misfit).any(axis=1))
    if known.size == 0:
        return ()
    size = np.log(np.nanmean(misfit[known], axis=1) + 1e-12)
    ranked = known[np.argsort(np.abs(size - np.median(size)), kind="stable")].tolist()
    times = predictions.times
    chosen: list[int] = []
    for start in ranked:
        if all(times[start, 0] > times[i, -1] or times[start, -1] < times[i, 0] for i in chosen):
            chosen.append(start)
    chosen += [start for start in ranked if start not in chosen]
    return tuple(sorted(chosen[:_STARTS], key=lambda i: times[i, 0]))


def measured_channels(predictions: Predictions) -> tuple[str, ...]:
    """The channels that the test log holds."""
    measured = np.atleast_1d(np.isfinite(predictions.measured).any(axis=(0, 1)))
    return tuple(name for name, there in zip(ALL_CHANNELS, measured, strict=False) if there)


def telling_channel(predictions: Predictions) -> str | None:
    """The measured position, attitude or velocity that is worst predicted before."""
    misfit = _misfits(predictions)
    shown = [name for name in measured_channels(predictions) if name in POSITION + ATTITUDE + VELOCITY + RATE]
    sizes = {name: _mean(misfit[:, ALL_CHANNELS.index(name)]) for name in shown}
    return max(sizes, key=lambda name: sizes[name], default=None)


def _mean(values: np.ndarray) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else -np.inf


@dataclasses.dataclass(frozen=True)
class Course:
    """One prediction: `measured`, `before` and `after`, all channels in shown units.

    `ahead` [s] counts from where the prediction begins; `start` is that moment of the log in words.
    `band`: half the width of that about the last model's, NaN before the start.
    """

    start: str
    ahead: Float[np.ndarray, " steps"]
    curves: dict[str, Float[np.ndarray, "steps channels"]]
    band: Float[np.ndarray, "steps channels"] | None = None


def course(predictions: Predictions, start: int, clock: float = 0.0) -> Course:
    """The prediction from one start; angles without jumps, the three curves on the same turn.

    - `clock`: what the log's own clock shows at its start [s].
    """
    times = predictions.times[start]
    begin = float(times[predictions.begin])
    before = finite(predictions.before[start])
    # Curves are made continuous from the prediction on, which has no gaps, and hung onto it.
    smooth = before.copy()
    for column in np.flatnonzero(ANGLES[: before.shape[1]]):
        if np.isfinite(before[:, column]).all():
            smooth[:, column] = np.unwrap(before[:, column])
    measured = smooth - difference(before, predictions.measured[start])
    after = smooth + difference(predictions.after[start], before)
    curves = {"measured": measured, "before": smooth, "after": after}
    kept = thinned(times.size, _STEPS)
    scales = SCALES[: before.shape[1]]
    shown = {name: curve[kept] * scales for name, curve in curves.items()}
    band = None
    if predictions.band is not None:
        none = np.full((predictions.begin, predictions.band.shape[1]), np.nan)
        band = np.concatenate([none, predictions.band])[kept] * scales
    return Course(moment(begin, clock, ".4g"), times[kept] - begin, shown, band)


@dataclasses.dataclass(frozen=True)
class Axis:
    """One degree of freedom as it is shown."""

    index: int
    title: str
    symbol: str
    unit: str
    velocity_title: str
    velocity_scale: float


def free_axes(dof: tuple[str, ...]) -> tuple[Axis, ...]:
    """The degrees of freedom that can move."""
    out = []
    for i, name in enumerate(DOFS):
        if name in dof:
            channel = (VELOCITY + RATE)[i]
            out.append(
                Axis(
                    index=i,
                    title=f"{name.capitalize()} {'force' if i < 3 else 'moment'} {WRENCH[i]}",
                    symbol=WRENCH[i],
                    unit="N" if i < 3 else "N m",
                    velocity_title=f"{CHANNEL_TITLES[channel]} [{shown_unit(channel)}]",
                    velocity_scale=shown_scale(channel),
                )
            )
    return tuple(out)


def known(missing: MissingWrench, axis: int, log: int | None = None) -> Bool[np.ndarray, " knots"]:
    """Where the missing wrench of that axis is known (in that log, where one is named)."""
    there = np.isfinite(missing.wrench[:, axis]) & np.isfinite(missing.t)
    return there if log is None else there & (missing.log == log)


def tested(diagnosis: Diagnosis) -> str:
    """The test log that figures show, in words."""
    several = len(diagnosis.tests) > 1
    return f"the longest test log, {diagnosis.predictions.log}" if several else "the test log"


def compared(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Which models a figure shows: where nothing was added, before and after are one."""
    return ("before",) if diagnosis.verdict == "nothing_found" else ("before", "after")


def lacking(diagnosis: Diagnosis) -> dict[str, MissingWrench]:
    """The missing wrench of each model that is shown."""
    both = {"before": diagnosis.missing_before, "after": diagnosis.missing_after}
    return {name: both[name] for name in compared(diagnosis)}


def beginnings(diagnosis: Diagnosis, log: int) -> tuple[float, ...]:
    """The times [s] in that training log from which findings act."""
    return tuple(
        finding.since
        for finding in diagnosis.findings
        if finding.since is not None and (finding.since_log or diagnosis.train[0]) == diagnosis.train[log]
    )


def taken_suspects(diagnosis: Diagnosis) -> tuple[Weighed | None, ...]:
    """Per round of the search, the suspect that became a finding, at its best."""
    left = [finding.label for finding in diagnosis.findings]
    out: list[Weighed | None] = []
    for weighed in diagnosis.rounds:
        best = {suspect.label: suspect for suspect in reversed(weighed)}
        taken = next((label for label in left if label in best), None)
        if taken is not None:
            left.remove(taken)
        out.append(None if taken is None else best[taken])
    return tuple(out)


def leading(suspects: tuple[Weighed, ...], taken: Weighed | None, limit: int) -> tuple[Weighed, ...]:
    """The first `limit` of a round; the one that was taken is always among them."""
    head = suspects[:limit]
    if taken is None or any(suspect is taken for suspect in head):
        return head
    return (*head[:-1], taken)
