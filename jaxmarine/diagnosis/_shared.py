"""A diagnosis of logs that lie elsewhere: they are asked, and only what they answer travels."""

import collections
import dataclasses
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Array, Bool, Float

from .._errors import InputError
from .._progress import FITTING, Progress, silent
from .._types import ALL_CHANNELS
from ..effects import AbstractEffect
from ..fitting import (
    AbstractShares,
    Cut,
    Kept,
    Share,
    answers,
    cut,
    median_noise,
    misconnected,
    noises_of,
    refine_shares,
    reviewed,
    widened,
)
from ..logs import Log, Rejected, alike
from ..simulation import substeps
from ..vehicle import Vehicle
from ._criteria import DEFAULT, Criteria
from ._explanation import Model
from ._keeper import AbstractKeeper, Outline, Part, Reached
from ._prepare import (
    Opened,
    begun_with,
    enough,
    fastest,
    named_apart,
    predictable,
    roomy,
    speeds_of,
    stuck,
    suspected,
    tests_of,
    unstated,
    window_of,
)
from ._saturated import saturate
from ._score import AbstractStatistics, Reduced
from ._supplied import lacks_battery
from ._workbench import SPARSEST, Workbench, same_log

Result = TypeVar("Result")

# Logs of a share as a diagnosis reviews them, and what is to be said of them.
_Reviewed = tuple[tuple[Log, ...], tuple[str, ...]]

_ONE_PROCESS = "diagnose these logs in one process"


class _Outlined(NamedTuple):
    """What is told of a log: all but its samples. `most`: the largest wrench [N, N m], where it has one."""

    t: Float[np.ndarray, " times"]
    measured: Bool[np.ndarray, " channels"]
    columns: int
    most: Float[np.ndarray, "6"] | None
    command_names: tuple[str, ...]
    name: str
    notes: tuple[str, ...]
    rejected: tuple[Rejected, ...]

    def log(self) -> Log:
        """A log whose channels are zero where they are measured, in no more memory than its times take."""
        times = len(self.t)
        row = np.where(self.measured, 0.0, np.nan)
        commands, wrench = np.zeros((1, self.columns)), self.most
        return Log(
            t=self.t,
            channels=np.broadcast_to(row, (times, len(row))),
            commands=np.broadcast_to(commands, (times, self.columns)) if wrench is None else None,
            wrench=None if wrench is None else np.broadcast_to(wrench, (times, 6)),
            command_names=self.command_names,
            name=self.name,
            notes=self.notes,
            rejected=self.rejected,
        )


class _Look(NamedTuple):
    """What a share tells of its logs before they are cut.

    - `noise` [logs, channels], `low`, `high` [channels]: of all that was measured; `fastest`: as of
      `_prepare`.
    - `answered`: names of logs under feedback; `twins`: of test logs that lie there.
    - `supplied`: whether each has the voltage of its battery; `wrong`: sentences on gross errors.
    """

    logs: tuple[_Outlined, ...]
    noise: Float[np.ndarray, "logs channels"]
    low: Float[np.ndarray, " channels"]
    high: Float[np.ndarray, " channels"]
    fastest: Float[np.ndarray, "6"]
    notes: tuple[str, ...]
    answered: tuple[str, ...]
    twins: tuple[str, ...]
    supplied: bool
    wrong: tuple[str, ...]


def opened_over(
    vehicle: Vehicle,
    shares: AbstractShares,
    test: Sequence[Log] | Log,
    catalogue: Sequence[type[AbstractEffect]],
    window: float | None,
    progress: Progress = silent,
    criteria: Criteria = DEFAULT,
) -> Opened:
    """`opened_with` logs that lie elsewhere.

    Raises `InputError` too for what is answered in one process alone: logs under feedback or with gross
    errors, sensors whose noise the vehicle does not state, a battery that its file lacks, test logs that are
    training logs, and logs of one name.
    """
    tests = tests_of(test)
    desk = _Desk(shares)
    there = desk.keep(_reviewed, vehicle)
    looks: list[_Look] = desk.ask(_looked, there, vehicle, tests, tuple(catalogue))
    every = alike((*(one.log() for look in looks for one in look.logs), *tests))
    logs, tests = every[: -len(tests)], every[-len(tests) :]
    names, width = [log.name for log in logs], every[0].channels.shape[1]
    _allowed(vehicle, looks, names, tests, catalogue, width)
    noise = median_noise(np.concatenate([widened(look.noise, width) for look in looks]), names)
    _, tests, doubled = named_apart(logs, tests)
    tests, reviews = reviewed(vehicle, tests)
    bench = _workbench(desk, there, vehicle, looks, logs, noise, catalogue, window, criteria)
    free = unstated(bench)
    if free:
        raise InputError(
            f"{vehicle.name}: does not state the noise of every sensor that {_several(names)} show, which is "
            f"estimated by what the file misses there; state it under [sensors], or {_ONE_PROCESS}."
        )
    tests, left_out = predictable(bench, tests)
    progress(FITTING)
    begun, told = begun_with(bench)
    notes = [note for log in (*logs, *tests) for note in log.notes]
    notes += [*doubled, *(note for look in looks for note in look.notes), *reviews]
    untold = (
        "Of logs that lie on workers it is not told what they determine, nor whether what their sensors show "
        "contradicts itself."
    )
    return Opened(bench, begun, tests, (), tuple([*notes, *left_out, *stuck(bench), *told, untold]))


def _allowed(
    vehicle: Vehicle,
    looks: Sequence[_Look],
    names: Sequence[str],
    tests: Sequence[Log],
    catalogue: Sequence[type[AbstractEffect]],
    width: int,
) -> None:
    """Refuses logs in which nothing moves, and what is not answered over shares."""
    low, high = (
        reduced([widened(getattr(look, name), width) for look in looks])
        for name, reduced in (("low", np.fmin.reduce), ("high", np.fmax.reduce))
    )
    measured = np.isfinite(low)
    if measured.any() and (low == high)[measured].all():
        raise InputError(f"{_several(names)}: no channel ever changes; use logs in which the vehicle moves.")
    twice = [name for name, count in collections.Counter(names).items() if count > 1]
    if twice:
        raise InputError(
            f"{', '.join(twice)}: is the name of several logs that lie on workers; give each its own name."
        )
    twins = [name for look in looks for name in look.twins]
    if twins:
        raise InputError(
            f"{', '.join(twins)}: is a training log that lies on a worker too; test on another log, or "
            f"{_ONE_PROCESS}."
        )
    answered = [name for look in looks for name in look.answered]
    if answered:
        raise InputError(
            f"{_several(answered)}: commands answer what was measured, as those of an autopilot do, and a "
            f"disturbance is not estimated over workers; {_ONE_PROCESS}, or leave them out."
        )
    wrong = [sentence for look in looks for sentence in look.wrong]
    if wrong:
        raise InputError(f"{_several(names)}: {wrong[0].rstrip('.')}; mend it first, or {_ONE_PROCESS}.")
    supplied = all(look.supplied for look in looks) and all(map(_supplied, tests))
    if supplied and lacks_battery(vehicle, catalogue):
        raise InputError(
            f"{vehicle.name}: has no battery in its file, but {_several(names)} have its voltage, on which "
            f"its thrust may hang; leave `Voltage` out of the catalogue, or {_ONE_PROCESS}."
        )


def _several(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _supplied(log: Log) -> bool:
    return log.commands is not None and log.battery is not None


def _workbench(
    desk: "_Desk",
    reviews: Kept,
    vehicle: Vehicle,
    looks: Sequence[_Look],
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    catalogue: Sequence[type[AbstractEffect]],
    window: float | None,
    criteria: Criteria,
) -> Workbench:
    """`_prepare.workbench` of windows that lie on shares, one workbench on each."""
    dt, length = float(np.median([log.dt for log in logs])), window_of(logs, window)
    cuts = desk.keep(_cut, reviews, vehicle, noise, length, dt)
    parts = desk.ask(_cut_up, cuts)
    windows = [len(part.log) for part in parts]
    enough(logs, sum(windows), length)
    short = next((look for look, count in zip(looks, windows, strict=True) if count < SPARSEST), None)
    if short is not None:
        raise InputError(
            f"{_several([one.name for one in short.logs])}: gives fewer than {SPARSEST} windows on its "
            "worker; use fewer workers, so that each has more of the logs."
        )
    firsts, befores = (
        np.cumsum([0, *counts])[:-1].tolist() for counts in ([len(one.logs) for one in looks], windows)
    )
    outline = Outline(
        logs=tuple(logs),
        log=np.concatenate([first + part.log for first, part in zip(firsts, parts, strict=True)]),
        starts=np.concatenate([part.starts for part in parts]),
        steps=parts[0].steps,
        seen=np.sum([part.seen for part in parts], axis=0),
        length=length,
        hold=max(part.hold for part in parts),
        speeds=np.sqrt(np.average([part.speeds**2 for part in parts], axis=0, weights=windows)),
    )
    names = [log.name for log in logs]
    own = [
        (Part(first, tuple(names[first + len(look.logs) :]), before, sum(windows), dt),)
        for first, before, look in zip(firsts, befores, looks, strict=True)
    ]
    split = substeps(vehicle, outline.hold, speeds_of([look.fastest for look in looks]))
    given = vehicle, tuple(catalogue), noise, split, criteria, outline.hold
    there = OnShares(desk, desk.keep(_bench, cuts, *given, each=own))
    families, layout = saturate(vehicle, catalogue)
    return roomy(Workbench(vehicle, families, layout, outline, noise, split, criteria=criteria, keeper=there))


# Numbers of what shares need not keep any more, until they are asked the next time.
_GONE = weakref.WeakKeyDictionary[AbstractShares, collections.deque[int]]()


class _Desk:
    """Shares that are asked, and what they keep for this process for as long as it holds a `Kept` of it."""

    def __init__(self, shares: AbstractShares):
        self.shares = shares
        # Of a diagnosis before this one too, which asks no more.
        self._gone = _GONE.setdefault(shares, collections.deque[int]())

    def ask(
        self, of: Callable[..., Any], *given: Any, each: Sequence[tuple[Any, ...]] | None = None
    ) -> list[Any]:
        """What a function of the share, and of what is given, says at each; `each`: behind that its own."""
        gone = [self._gone.popleft() for _ in range(len(self._gone))]
        return self.shares.ask("answer", _asked, gone, of, *given, each=each)

    def keep(
        self, of: Callable[..., Any], *given: Any, each: Sequence[tuple[Any, ...]] | None = None
    ) -> Kept:
        """What it says, which stays there."""
        kept = Kept()
        weakref.finalize(kept, self._gone.append, kept.number)
        self.ask(_keep, kept.number, of, *given, each=each)
        return kept


class OnShares(AbstractKeeper):
    """Shares, each of which has a workbench of its own windows.

    What they say of groups of windows, and gradients and information of all of them, travels; the windows'
    initial states stay.
    """

    def __init__(self, desk: _Desk, bench: Kept):
        self._desk, self.bench = desk, bench

    def each(self, bench: Workbench, of: Callable[..., Result], *given: Any) -> list[Result]:
        return self._desk.ask(_applied, of, *map(_there, (bench, *given)))

    def keep(self, bench: Workbench, of: Callable[..., Any], *given: Any) -> Kept:
        return self._desk.keep(_applied, of, *map(_there, (bench, *given)))

    def of_windows(self, bench: Workbench, found: Kept) -> "_Elsewhere":
        del bench
        kept = self._desk.keep(_of_windows, found)
        return _Elsewhere(self._desk, kept, self._desk.ask(_count_of, kept))

    def refined(
        self, bench: Workbench, model: Model, z: Array, max_steps: int, rtol: float, damping: float
    ) -> Reached:
        self._desk.ask(_begin, self.bench, model)
        held = np.asarray(bench.task_prior(model))
        ended = refine_shares(self._desk.shares, held, np.asarray(z), max_steps, rtol, damping)
        return Reached(ended.z, self._desk.keep(_reached), ended.cost, ended.promised, ended.damping)

    def remade(self, of: Callable[..., Any], *given: Any) -> "OnShares":
        return OnShares(self._desk, self._desk.keep(_applied, of, self.bench, *given))


class _Elsewhere(AbstractStatistics):
    """Statistics of each window that shares keep.

    - `counts`: windows of each share.
    """

    def __init__(self, desk: _Desk, kept: Kept, counts: Sequence[int]):
        self._desk, self._kept, self._counts = desk, kept, counts

    def each(self, of: Callable[..., Result], *given: Any, along: Sequence[Any] = ()) -> list[Result]:
        return self._desk.ask(_along, self._kept, of, given, each=self._dealt(along))

    def keep(self, of: Callable[..., Reduced], *given: Any, along: Sequence[Any] = ()) -> "_Elsewhere":
        kept = self._desk.keep(_along, self._kept, of, given, each=self._dealt(along))
        return _Elsewhere(self._desk, kept, self._counts)

    def lay(self, values: Float[np.ndarray, "windows ..."]) -> Kept:
        return self._desk.keep(_laid, each=self._dealt([values]))

    def _dealt(self, along: Sequence[Any]) -> list[tuple[Any, ...]]:
        """What is given along the windows, share by share."""
        ends = np.cumsum(self._counts)[:-1]
        columns = [
            [one] * len(self._counts) if isinstance(one, Kept) else np.split(one, ends) for one in along
        ]
        return list(zip(*columns, strict=True)) if columns else [()] * len(self._counts)


def _there(given: Any) -> Any:
    """What stands for a workbench where its windows lie; all else is given as it is."""
    if not isinstance(given, Workbench):
        return given
    assert isinstance(given.keeper, OnShares)
    return given.keeper.bench


# --- what shares do ------------------------------------------------------------------------------


def _asked(share: Share, gone: Sequence[int], of: Callable[..., Any], *given: Any) -> Any:
    """Forgets what is `gone`, and answers."""
    for number in gone:
        share.kept.pop(number, None)
    return of(share, *(_here(share, one) for one in given))


def _here(share: Share, given: Any) -> Any:
    """What is given, and what is kept in the place of what stands for it."""
    if isinstance(given, Kept):
        return share.kept[given.number]
    if isinstance(given, Model):
        return dataclasses.replace(given, delta=_here(share, given.delta))
    return given


def _keep(share: Share, number: int, of: Callable[..., Any], *given: Any) -> None:
    share.kept[number] = of(share, *given)


def _applied(share: Share, of: Callable[..., Any], *given: Any) -> Any:
    del share
    return of(*given)


def _of_windows(share: Share, found: tuple[Reduced, Reduced]) -> Reduced:
    del share
    return found[1]


def _count_of(share: Share, stats: Reduced) -> int:
    del share
    return len(stats.chi2)


def _along(share: Share, stats: Reduced, of: Callable[..., Any], given: Sequence[Any], *along: Any) -> Any:
    del share
    return of(stats, *along, *given)


def _laid(share: Share, given: Result) -> Result:
    del share
    return given


def _reviewed(share: Share, vehicle: Vehicle) -> _Reviewed:
    return reviewed(vehicle, alike(share.given))


def _looked(
    share: Share,
    found: _Reviewed,
    vehicle: Vehicle,
    tests: Sequence[Log],
    catalogue: Sequence[type[AbstractEffect]],
) -> _Look:
    logs, notes = found
    given = alike((*share.given, *tests))[: len(logs)]
    channels = np.concatenate([log.channels for log in logs])
    return _Look(
        logs=tuple(map(_outlined, logs)),
        noise=noises_of(vehicle, logs),
        low=np.fmin.reduce(channels),
        high=np.fmax.reduce(channels),
        fastest=fastest(logs),
        notes=notes,
        answered=tuple(log.name for log in logs if answers(log)),
        twins=tuple(test.name for test in tests for log in given if same_log(log, test)),
        supplied=all(map(_supplied, logs)),
        wrong=tuple(one.told for one in misconnected(vehicle, given) if suspected(one, catalogue)),
    )


def _outlined(log: Log) -> _Outlined:
    return _Outlined(
        t=log.t,
        measured=np.isin(ALL_CHANNELS[: log.channels.shape[1]], log.measured),
        columns=0 if log.commands is None else log.commands.shape[1],
        most=None if log.wrench is None else np.abs(log.wrench).max(axis=0),
        command_names=log.command_names,
        name=log.name,
        notes=log.notes,
        rejected=log.rejected,
    )


def _cut(
    share: Share,
    found: _Reviewed,
    vehicle: Vehicle,
    noise: Float[np.ndarray, " channels"],
    length: float,
    dt: float,
) -> Cut:
    del share
    return cut(vehicle, found[0], noise, length, dt=dt)


def _cut_up(share: Share, data: Cut) -> Outline:
    """The outline of a cut, without its logs."""
    del share
    return dataclasses.replace(Outline.of(data), logs=())


def _bench(
    share: Share,
    data: Cut,
    vehicle: Vehicle,
    catalogue: Sequence[type[AbstractEffect]],
    noise: Float[np.ndarray, " channels"],
    split: int,
    criteria: Criteria,
    hold: float,
    part: Part,
) -> Workbench:
    """`hold` [s]: the longest of all logs, by whose steps all are predicted."""
    del share
    families, layout = saturate(vehicle, catalogue)
    data = dataclasses.replace(data, hold=hold)
    return Workbench(vehicle, families, layout, data, noise, split, criteria=criteria, part=part)


def _begin(share: Share, bench: Workbench, model: Model) -> None:
    """Takes up the task of a model."""
    assert not isinstance(model.delta, Kept)
    share.take(bench.task(model), model.delta)


def _reached(share: Share) -> Array:
    """The initial states at which a refinement ended."""
    return share.delta
