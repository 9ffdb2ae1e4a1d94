"""From logs to a workbench: named apart, checked, cut into windows, their noise at least what is missed."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from .._errors import InputError
from .._progress import FITTING, Progress, silent
from .._types import ALL_CHANNELS, AXES, MOTION
from ..effects import AbstractEffect, ExchangedThrusters
from ..fitting import (
    FINEST,
    USUAL_MEMORY,
    GrossError,
    answers,
    contradiction,
    cut,
    misconnected,
    noise_of,
    reviewed,
    settled,
)
from ..logs import Log, Note, alike
from ..simulation import substeps
from ..vehicle import Placed, Vehicle
from ._amid import refine_fully
from ._criteria import DEFAULT, Criteria
from ._explanation import Member, Model
from ._filed import refiled
from ._gain import HORIZON, LEAST, run_in_of, stride_of
from ._noises import largest_noise, noise_left
from ._saturated import saturate
from ._supplied import supplied
from ._workbench import SLOTS, Workbench, same_log

WINDOW = 4.0  # [s]
# Statistics over windows need some of them: short logs are cut into shorter windows, down to these.
FEWEST_WINDOWS = 16
SHORTEST = 1.0  # [s]
FEWEST_SAMPLES = 12  # of a window
SLOWEST = 2.0  # [s] between samples
FEWEST = 6  # windows of a diagnosis
# A noise that is estimated anew counts where it is so many times smaller.
NEWS = 1.5
# Noises that are estimated anew, each by what the one before leaves, so many times at most.
WEIGHINGS = 8
# Usual memories of a disturbance in which its size is told to a third of itself, as are numbers that forget
# each other by then (1 / sqrt(9)); in less a cause and a disturbance are not told apart.
TELLS = 9.0


def window_of(logs: Sequence[Log], window: float | None) -> float:
    """Seconds of a window: those that are asked for, or as suits logs."""
    dt = float(np.median([log.dt for log in logs]))
    if dt > SLOWEST:
        raise InputError(
            f"{logs[0].name}: has a sample every {dt:g} s, too few to see how a vehicle moves; give t in "
            f"seconds, or take a log with a sample every {SLOWEST:g} s or faster."
        )
    return window_length(sum(log.duration for log in logs), dt) if window is None else window


def window_length(duration: float, dt: float) -> float:
    """Seconds of a window of logs that last so long together, with a sample every `dt` s."""
    return float(max(np.clip(duration / FEWEST_WINDOWS, SHORTEST, WINDOW), FEWEST_SAMPLES * dt))


def fastest(logs: Sequence[Log]) -> Float[np.ndarray, "6"]:
    """The fastest that logs go on each axis [m/s, rad/s], -1 where it was not measured."""
    speeds = np.abs(np.concatenate([log.channels[:, MOTION] for log in logs]))
    return np.where(np.isfinite(speeds).any(0), np.nan_to_num(speeds).max(0), -1.0)


def _fastest_in(bench: Workbench) -> Float[np.ndarray, "6"]:
    return fastest(bench.data.logs)


def speeds_of(parts: Sequence[Float[np.ndarray, "6"]]) -> Float[np.ndarray, "6"]:
    """Speeds [m/s, rad/s] at which a craft is integrated, by the `fastest` of its logs; 1 if not measured."""
    most = np.max(parts, axis=0)
    return np.where(most < 0, 1.0, most)


@dataclasses.dataclass(frozen=True)
class Opened:
    """What a diagnosis begins with: a workbench, the model to start from, the test logs, what to tell.

    - `gross`: sentences on gross errors, which come before all else.
    - `exchanged`: columns that are, which the workbench's vehicle has exchanged already; `instead`: other
      pairs that answer as it does, where it is one.
    - `nameless`: whether something that no effect is makes all names worthless.
    - `feedback`: whether commands answer what was measured, and with it what disturbs the craft, in logs
      that are long enough to tell that.
    """

    bench: Workbench
    begun: Model
    tests: tuple[Log, ...]
    gross: tuple[str, ...]
    notes: tuple[str, ...]
    exchanged: tuple[Placed, ...] = ()
    instead: tuple[Placed, ...] = ()
    nameless: bool = False
    feedback: bool = False


def opened_with(
    vehicle: Vehicle,
    train: Sequence[Log] | Log,
    test: Sequence[Log] | Log,
    catalogue: Sequence[type[AbstractEffect]],
    window: float | None,
    progress: Progress = silent,
    criteria: Criteria = DEFAULT,
) -> Opened:
    """Logs that were checked and reviewed, on a workbench with noises as large as what the file misses.

    Arguments and errors are those of `diagnose`.
    """
    logs = (train,) if isinstance(train, Log) else tuple(train)
    if not logs:
        raise InputError("A diagnosis needs at least one training log.")
    tests = tests_of(test)
    every = alike((*logs, *tests))
    logs, tests = every[: len(logs)], every[len(logs) :]
    vehicle = supplied(vehicle, logs, tests, catalogue)
    notes = [note for log in (*logs, *tests) for note in log.notes]
    logs, tests, doubled = named_apart(logs, tests)
    moving(logs)
    wrong = [one for one in misconnected(vehicle, logs) if suspected(one, catalogue)]
    causes = tuple(cause for one in wrong for cause in one.causes)
    # A log is judged by the vehicle that is connected as it was.
    every, reviews = reviewed(vehicle.place(*causes), (*logs, *tests))
    logs, tests = every[: len(logs)], every[len(logs) :]
    exchanged = _exchanges(causes)
    bench = workbench(vehicle.place(*exchanged), logs, catalogue, window, vehicle, criteria)
    tests, left_out = predictable(bench, tests)
    progress(FITTING)
    begun, told = begun_with(bench, [cause for cause in causes if cause not in exchanged])
    answered = [log for log in logs if answers(log)]
    amid = sum(log.duration for log in logs) >= TELLS * USUAL_MEMORY.median
    notes = [
        *notes,
        *doubled,
        *reviews,
        *left_out,
        *stuck(bench),
        *told,
        *(_said(log, amid) for log in answered),
    ]
    gross = tuple(one.told for one in wrong)
    nameless = any(not one.causes for one in wrong)
    return Opened(
        bench=rescaled(bench, begun),
        begun=begun,
        tests=tests,
        gross=gross,
        notes=tuple(notes),
        exchanged=exchanged,
        instead=_exchanges(cause for one in wrong for cause in one.instead) if len(exchanged) == 1 else (),
        nameless=nameless,
        feedback=bool(answered) and amid,
    )


def tests_of(test: Sequence[Log] | Log) -> tuple[Log, ...]:
    """The test logs; refuses none."""
    tests = (test,) if isinstance(test, Log) else tuple(test)
    if not tests:
        raise InputError("A diagnosis needs at least one test log.")
    return tests


def _exchanges(causes: Iterable[Placed]) -> tuple[Placed, ...]:
    return tuple(cause for cause in causes if isinstance(cause.effect, ExchangedThrusters))


def _said(log: Log, amid: bool) -> Note:
    """`amid`: whether what disturbs is part of the model."""
    words = "commands answer what was measured, as those of an autopilot do; " + (
        "what disturbs the craft is estimated with all else, or what it does would be taken for what the "
        "thrusters do."
        if amid
        else "the logs are too short to tell what disturbs the craft, which may be taken for what the "
        "thrusters do; log longer."
    )
    return Note.of(log.name, f"{{log}}: its {words}", f"{{logs}}: their {words}")


def predictable(bench: Workbench, tests: Sequence[Log]) -> tuple[tuple[Log, ...], list[str]]:
    """The test logs that can be predicted, and a note on each of the others; raises where there is none."""
    usable, wrong = [], []
    for test in tests:
        try:
            if test.duration < LEAST:
                raise InputError(
                    f"{test.name}: is shorter than a prediction with its run-in ({LEAST:g} s); use a longer "
                    "test log."
                )
            if not (np.isfinite(test.channels).any(axis=0) & np.isfinite(bench.noise)).any():
                raise InputError(
                    f"{test.name}: measures nothing that {bench.data.logs[0].name} measures; use a test log "
                    "with its channels."
                )
            # Gaps and accidents may leave no stretch that is long enough.
            run_in = run_in_of(test, bench.data.length)
            cut(bench.vehicle, [test], bench.noise, run_in + HORIZON, stride_of(test, run_in))
        except InputError as error:
            wrong.append(error)
        else:
            usable.append(test)
    if not usable:
        raise wrong[0]
    return tuple(usable), [f"Left out of the gain: {error}" for error in wrong]


def suspected(wrong: GrossError, catalogue: Sequence[type[AbstractEffect]]) -> bool:
    """Whether all its causes are among those that a diagnosis may name."""
    return all(type(cause.effect) in catalogue for cause in wrong.causes)


def workbench(
    vehicle: Vehicle,
    logs: Sequence[Log],
    catalogue,
    window: float | None,
    filed: Vehicle | None = None,
    criteria: Criteria = DEFAULT,
) -> Workbench:
    """The workbench of a vehicle and its training logs; raises `InputError` where they are too short.

    - `catalogue`, `window`, `criteria`: as `diagnose` takes them; `filed`: the vehicle that a gain is
      measured against, if it is another one.
    """
    noise = noise_of(vehicle, logs)
    data = cut(vehicle, logs, noise, window_of(logs, window))
    enough(logs, data.windows.count, data.length)
    families, layout = saturate(vehicle, catalogue)
    split = substeps(vehicle, data.hold, speeds_of([fastest(logs)]))
    bench = Workbench(vehicle, families, layout, data, noise, split, filed=filed, criteria=criteria)
    return roomy(bench)


def enough(logs: Sequence[Log], windows: int, length: float) -> None:
    """Refuses logs that give too few windows of a length [s]."""
    if windows < FEWEST:
        names = ", ".join(log.name for log in logs)
        raise InputError(
            f"{names}: gives {windows} windows of {length:g} s, a diagnosis needs {FEWEST}; "
            "use a longer log or a shorter window."
        )


def roomy(bench: Workbench) -> Workbench:
    """The workbench; refuses an effect that has more parameters than it has room for."""
    vehicle, room = bench.vehicle, SLOTS - len(bench.base)
    for suspect in bench.layout.suspects:
        if len(suspect.slots) > room:
            raise InputError(
                f"Effect {suspect.label} has {len(suspect.slots)} parameters, a diagnosis of {vehicle.name} "
                f"fits at most {room} at once; use an effect with fewer."
            )
    return bench


def named_apart(
    logs: Sequence[Log], tests: Sequence[Log]
) -> tuple[tuple[Log, ...], tuple[Log, ...], list[str]]:
    """The logs with names of their own, by which a beginning says in which log it lies; and notes of changes.

    A test log keeps the name of the training log that it is.
    """
    out, notes = list[Log](), []
    for number, log in enumerate((*logs, *tests)):
        twin = next((one for one in out[: len(logs)] if number >= len(logs) and same_log(one, log)), None)
        name, count = log.name if twin is None else twin.name, 1
        while twin is None and name in {one.name for one in out}:
            count += 1
            name = f"{log.name} ({count})"
        if count > 1:
            notes.append(f"Another log is called {log.name} too; this one is `{name}` here.")
        out.append(dataclasses.replace(log, name=name))
    return tuple(out[: len(logs)]), tuple(out[len(logs) :]), notes


def moving(logs: Sequence[Log]) -> None:
    """Refuses training logs in which nothing changes: whatever explained them would be made up."""
    seen = np.concatenate([log.channels for log in logs])
    measured = seen[:, np.isfinite(seen).any(axis=0)]
    if measured.size and (np.nanmax(measured, axis=0) == np.nanmin(measured, axis=0)).all():
        names = ", ".join(log.name for log in logs)
        raise InputError(f"{names}: no channel ever changes; use a log in which the vehicle moves.")


def stuck(bench: Workbench) -> list[str]:
    """A note on channels that are measured but cannot be used, on axes that move."""
    measured = np.any([np.isfinite(log.channels).any(axis=0) for log in bench.data.logs], axis=0)
    free = bench.vehicle.free[np.array(AXES[: len(bench.noise)])] > 0
    useless = measured & np.isnan(bench.noise) & free
    names = [name for name, bad in zip(ALL_CHANNELS, useless, strict=False) if bad]
    if not names:
        return []
    return [
        f"{', '.join(names)} never changes in the training logs, and the vehicle file does not state its "
        "noise under [sensors]; it was not used."
    ]


def unstated(bench: Workbench) -> list[int]:
    """Channels that are used and whose noise the vehicle file does not state."""
    unstated = ~bench.vehicle.states_noise(len(bench.noise))
    return np.flatnonzero(unstated & np.isfinite(bench.noise)).tolist()


def begun_with(bench: Workbench, causes: Sequence[Placed] = ()) -> tuple[Model, list[str]]:
    """The model to start from, and a note where it has more than the vehicle file and `causes`.

    A sensor that grossly contradicts the others is told at once where noises are estimated: the estimate
    would take its error for noise. Where they are stated, the search weighs it with all other causes.
    """
    model, suspects = bench.start(), bench.layout.suspects
    for cause in causes:
        i = bench.layout.place_of(cause)
        value = suspects[i].values(cause.effect) - bench.layout.neutral_of(i)
        model = bench.with_member(model, Member(i), value)
    proven = contradiction(bench.vehicle, bench.data.logs, suspects) if unstated(bench) else None
    if proven is None:
        return model, []
    i = proven.suspect
    value = np.array([proven.values[name] for name in suspects[i].slots]) - bench.layout.neutral_of(i)
    note = (
        f"Positions, attitude and velocities contradict one another as {suspects[i].label} would make "
        "them, whatever forces act; it was taken first."
    )
    return bench.with_member(model, Member(i), value), [note]


def rescaled(bench: Workbench, begun: Model) -> Workbench:
    """The workbench with the noise of sensors that the file does not state raised to what the file leaves.

    A filtered measurement looks far less noisy than any model can predict it; weighted by that noise it
    would outweigh all others. From what a channel changes by within a window, which is the most that it
    can be missed by, down to the residual of the file as it is, and of the file recalibrated.
    """
    free = unstated(bench)
    if not free:
        return bench
    bench = _weighted(bench, free, largest_noise(bench))
    for model in (bench.frozen(begun), begun):
        bench = _weighted(bench, free, noise_left(bench, bench.refine(model)))
    return bench


def fitted(bench: Workbench, model: Model) -> tuple[Workbench, Model]:
    """The model refined, on a workbench that integrates as finely as it then asks for.

    A vehicle may be stiffer than its file, and runs away in steps that suit the file.
    """
    finest, speeds = FINEST * bench.split, speeds_of(bench.keeper.each(bench, _fastest_in))
    while True:
        model = refine_fully(bench, model)
        now = refiled(bench.vehicle, bench.base, model.z[: len(bench.base)])
        needed = min(substeps(now, bench.data.hold, speeds), finest)
        if needed <= bench.split:
            return bench, model
        bench = bench.finer(needed)


def sharpened(bench: Workbench, model: Model) -> Workbench | None:
    """The workbench with those noises lowered to the residual of what was found; None where that is no news.

    The file's residual had in it what the model's members explain, beside which nothing small shows.
    """
    free = unstated(bench)
    if not free or not model.members:
        return None
    least = np.fmin(bench.noise, noise_left(bench, model))
    if (bench.noise < NEWS * least)[free].all():
        return None
    # Refined with other weights the model leaves less of what these had hidden.
    for _ in range(WEIGHINGS):
        bench, before = _weighted(bench, free, least), least
        model = bench.refine(model)
        least = np.fmin(before, noise_left(bench, model))
        if settled(before[free], least[free]):
            break
    return bench


def _weighted(bench: Workbench, channels: list[int], noise: np.ndarray) -> Workbench:
    """The workbench with another noise of some channels."""
    now = bench.noise.copy()
    now[channels] = noise[channels]
    return bench.reweighed(now)
