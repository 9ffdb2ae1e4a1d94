"""What a model of the search is worth: its gain on a log."""

import contextlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from .._errors import InputError
from .._precision import need_double
from ..effects import CATALOGUE, AbstractEffect, ExchangedThrusters
from ..logs import Log
from ..vehicle import Placed, Vehicle
from ._amid import refine_fully
from ._bands import ahead_of, banded, errors_of
from ._explanation import Beginning, Member, Model
from ._gain import LEAST, Candidate, gain, predictions, run_in_of, stride_of
from ._prepare import opened_with
from ._result import Gain, Predictions
from ._workbench import SLOTS, Workbench, filled


@threadpool_limits.wrap(limits=1, user_api="blas")
def gain_of(
    vehicle: Vehicle,
    train: Sequence[Log] | Log,
    test: Sequence[Log] | Log,
    causes: Sequence[Placed],
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
) -> Gain:
    """What given causes buy on the test logs, refitted from their values: what naming them is worth.

    As `diagnose` measures it, without a search. Raises what that raises, and `InputError` where the catalogue
    lacks a cause or one begins in a log that is not given.
    """
    need_double("A gain")
    # Columns that are exchanged are no suspect with a number: all else is fitted beside them.
    exchanged = [cause for cause in causes if isinstance(cause.effect, ExchangedThrusters)]
    opened = opened_with(vehicle.place(*exchanged), train, test, catalogue, None)
    bench, names = opened.bench.against(vehicle), [log.name for log in opened.bench.data.logs]
    model = bench.start()
    for cause in causes:
        if isinstance(cause.effect, ExchangedThrusters):
            continue
        i = bench.layout.place_of(cause)
        value = bench.layout.suspects[i].values(cause.effect)
        since = None
        if cause.since is not None:
            if cause.since_log not in (None, *names):
                raise InputError(
                    f"Cause `{cause.effect.name}` begins in {cause.since_log}; the training logs are "
                    f"{', '.join(names)}."
                )
            since = Beginning(names.index(cause.since_log) if cause.since_log else 0, cause.since)
        model = bench.with_member(model, Member(i, since), value - bench.layout.neutral_of(i))
    return measured_gain(bench, refine_fully(bench, model), bool(causes), (), opened.tests)[0]


def gain_at_home(bench: Workbench, model: Model, dense: bool, terms: Sequence[Placed] = ()) -> float:
    """The error over that of the file on the longest training log; 1 where nothing changes or it is short.

    A window is forgiving: what is fitted to a few seconds may be unstable when it acts for longer.

    - `dense`: the file's coefficients were recalibrated.
    """
    logs = bench.data.logs
    longest = max(range(len(logs)), key=lambda i: logs[i].duration)
    changed = bool(model.members or terms or dense)
    if logs[longest].duration < LEAST or not changed:
        return 1.0
    found = bench.keeper.each(bench, _ratio_on, longest, model, changed, terms)
    return next(ratio for ratio in found if ratio is not None)


def _ratio_on(
    bench: Workbench, number: int, model: Model, changed: bool, terms: Sequence[Placed]
) -> float | None:
    """The error over that of the file on the training log of a number, None where that lies elsewhere."""
    own = number - bench.part.first
    if not 0 <= own < len(bench.data.logs):
        return None
    return measured_gain(bench, model, changed, terms, bench.data.logs[own])[0].ratio


def buys_nothing(gain: Gain, least: float) -> bool:
    """Whether what was named saves less than a share of the error, `least`, on a log that was not fitted.

    What makes it larger for sure is another matter: the cause may be absent there.
    """
    low, high = gain.ratio_ci95 or (0.0, np.inf)
    return gain.held_out and gain.ratio > 1 - least and low <= 1.0 <= high


def measured_gain(
    bench: Workbench, model: Model, changed: bool, terms: Sequence[Placed], test: Sequence[Log] | Log
) -> tuple[Gain, Predictions]:
    """The gain on the test logs of the model and of terms that were learned; `changed`: beside the file."""
    tests = (test,) if isinstance(test, Log) else tuple(test)
    # Equally far apart in all logs, so that each counts by how long it is.
    stride = max(stride_of(log, run_in_of(log, bench.data.length)) for log in tests)
    predicted = [_predicted(bench, model, changed, terms, log, stride) for log in tests]
    return gain(predicted, bench.own_noise, [bench.twin(log) is None for log in tests])


def with_band(
    bench: Workbench, model: Model, changed: bool, terms: Sequence[Placed], shown: Predictions
) -> Predictions:
    """Predictions of a test log with the band that the training logs tell."""
    home = bench.keeper.each(bench, _errors_at_home, model, changed, terms, ahead_of(shown))
    return banded(shown, [errors for part in home for errors in part])


def _errors_at_home(
    bench: Workbench,
    model: Model,
    changed: bool,
    terms: Sequence[Placed],
    ahead: Float[np.ndarray, " steps"],
) -> list[Float[np.ndarray, "_ steps channels"]]:
    """Those of predictions of the training logs that lie here, at times [s] after the starts."""
    home = []
    for log in bench.data.logs:
        if log.duration < LEAST:
            continue
        # Gaps and accidents may leave no stretch that is long enough.
        with contextlib.suppress(InputError):
            stride = stride_of(log, run_in_of(log, bench.data.length))
            home.append(errors_of(_predicted(bench, model, changed, terms, log, stride), ahead))
    return home


def _predicted(
    bench: Workbench, model: Model, changed: bool, terms: Sequence[Placed], test: Log, stride: float
) -> Predictions:
    """Of one test log, by the file and by the model."""
    stretches = bench.stretches(model.members, test)
    gates = filled(stretches.gates)
    neutral = np.tile(bench.layout.neutral, (len(gates), 1))
    own = gates[:, : len(bench.filed.placed)]
    candidates = [Candidate(bench.filed, bench.families, neutral, own)]
    if changed:
        vehicle = bench.vehicle.place(*terms)
        gates = np.concatenate([gates, np.ones((len(gates), len(terms)))], axis=1)
        theta, phases = bench.theta(model, stretches), bench.phases(model.members)
        candidates.append(Candidate(vehicle, bench.families, theta, gates, phases))
    times, predicted, measured, begin = predictions(
        candidates,
        test,
        bench.noise,
        run_in_of(test, bench.data.length),
        bench.data.hold / bench.split,
        stretches.of_samples[0],
        bench.room,
        SLOTS,
        stride,
    )
    seen = np.isfinite(measured).any((0, 1))
    noise = np.where(seen, bench.noise, np.nan)
    return Predictions(times, begin, measured, predicted[0], predicted[-1], noise, test.name)
