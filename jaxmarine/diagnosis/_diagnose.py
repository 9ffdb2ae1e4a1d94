"""The whole diagnosis: search, settle, say what is unknown, extend, measure the gain."""

from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from .._errors import InputError
from .._precision import need_double
from .._progress import Progress, silent
from ..effects import CATALOGUE, AbstractEffect
from ..fitting import reviewed
from ..logs import Log
from ..vehicle import Placed, Vehicle
from ._answer import extended_by, findings_of, groups, recalibrated, standard_errors, weighed
from ._judge import judged
from ._kinematics import disagreement
from ._knots import knots, missing_wrench
from ._learn import learn
from ._prepare import begun_with, moving, named_apart, rescaled, sharpened, stuck, workbench
from ._result import FAR, Diagnosis, Finding, Verdict
from ._search import search
from ._settle import settled
from ._unnamed import ALONE, WITH_UNKNOWN, Unnamed, left_over, with_unknown
from ._worth import LEAST, buys_nothing, gain_at_home, measured_gain


# Many small products of matrices: threads of the linear algebra would only wait for one another, on a
# busy machine for several times the work.
@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(
    vehicle: Vehicle,
    train: Sequence[Log] | Log,
    test: Log,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    window: float | None = None,
    progress: Progress = silent,
) -> Diagnosis:
    """Shows what a vehicle gets wrong on its logs, names the cause, extends it and measures the gain.

    - `train`: logs in order of time; `test`: the log on which the gain is measured.
    - `catalogue`: the effects that are suspected; `(*CATALOGUE, YourEffect)` adds one of your own.
    - `window`: length of the windows [s]; default 4 s, less for short logs, more for slow sampling.
    - `progress`: called with a few words at each stage.

    Raises `InputError` where the logs are too short, too slowly sampled or without motion, where the vehicle
    runs away along them, where the test log measures nothing that they measure, and where effects have more
    parameters or begin at more times than there is room for; `ValueError` in single precision.
    """
    logs = (train,) if isinstance(train, Log) else tuple(train)
    if not logs:
        raise InputError("A diagnosis needs at least one training log.")
    need_double("A diagnosis")
    notes = [note for log in (*logs, test) for note in log.notes]
    logs, test, doubled = named_apart(logs, test)
    notes += doubled
    moving(logs)
    (*logs, test), told = reviewed(vehicle, (*logs, test))
    logs, notes = tuple(logs), [*notes, *told]
    bench = workbench(vehicle, logs, catalogue, window)
    notes += stuck(bench)
    if test.duration < LEAST:
        raise InputError(
            f"{test.name}: is shorter than a prediction with its run-in ({LEAST:g} s); use a longer test log."
        )
    if not (np.isfinite(test.channels).any(axis=0) & np.isfinite(bench.noise)).any():
        raise InputError(
            f"{test.name}: measures nothing that {logs[0].name} measures; use a test log with its channels."
        )
    progress("fitting the vehicle file")
    begun, told = begun_with(bench)
    notes += told
    bench = rescaled(bench, begun)
    base = bench.fitted(begun)
    rival = Unnamed(bench)
    found = search(bench, base, progress, rival.better)
    sharper = sharpened(bench, found.model)
    if sharper is not None:
        progress("searching again, with sensors as exact as what was found leaves them")
        bench = sharper
        base, rival = bench.fitted(begun), Unnamed(bench)
        found = search(bench, base, progress, rival.better)
    rounds = found.rounds
    if rival.better(found.model):
        now, unknown, dense = rival.judged, rival.dependences, False
    else:
        progress("settling what was found")
        model, dense, rounds = settled(bench, found)
        now, unknown = with_unknown(bench, judged(bench, model), dense, progress)
        rest, share = left_over(bench, now, unknown), WITH_UNKNOWN if unknown else ALONE
        if (now.model.members or dense) and not now.white and rival.leaves_less(rest, share):
            now, unknown, dense = rival.judged, rival.dependences, False
    at_home = gain_at_home(bench, now.model, dense)
    if at_home > 1.0:
        now, unknown, dense, at_home = rival.judged, rival.dependences, False, 1.0
        notes.append(
            "What was named at first predicts the training log worse than the file over 5 s; it was dropped."
        )
    if now.model.members and not unknown and buys_nothing(bench, now.model, test):
        now, unknown, dense, at_home = rival.judged, rival.dependences, False, 1.0
        notes.append(f"What was named at first buys nothing on {test.name}; it was dropped.")
    model, start = now.model, rival.start

    extended = extended_by(bench, model, dense)
    terms: tuple[Placed, ...] = ()
    if unknown:
        progress("learning what is missing")
        learned = learn(now.knots, unknown, vehicle.thruster_names)
        terms = tuple(Placed(term, term.target) for term in learned)
        notes += [
            f"{one.dof}: much more is missing where {', '.join(one.signals)} is large, but no signal tells "
            "its value; it is not learned."
            if one.size_only
            else f"{one.dof}: what is missing hangs on the past of {', '.join(one.signals)}, or on the time "
            "over several logs; it is not learned."
            for one in unknown
            if one.dof not in {term.target for term in learned}
        ]
        if terms and gain_at_home(bench, model, dense, terms) > at_home:
            terms = ()
            notes.append(
                "What was learned of it predicts the training log worse than nothing; it was left out."
            )
    extended = extended.place(*terms)
    progress("predicting the test log")
    # Where nothing is found the file is what is measured, even if its coefficients were refitted.
    changed = bool(model.members or terms or (dense and unknown))
    measured = measured_gain(bench, model, changed, terms, test)
    low, high = measured[0].ratio_ci95 or (0.0, np.inf)
    if low > 1.0:
        notes.append(
            f"The extended vehicle predicts {test.name} worse than the file does; do not use it to predict."
        )
    elif changed and high >= 1.0:
        notes.append(
            f"{test.name} does not confirm this: it is not certain that the extended vehicle predicts it "
            "better than the file does."
        )
    std = standard_errors(bench, now, dense)
    findings = findings_of(bench, now, rounds, std) + tuple(
        Finding(
            effect="unknown",
            target=one.dof,
            since=None,
            since_log=None,
            parameters={},
            log_evidence=0.5 * one.saved / now.phi,
            signals=one.signals,
            learned=one.dof in {term.target for term in terms},
        )
        for one in unknown
    )
    if dense:
        notes.append(
            "Many coefficients of the file are off together; they were refitted and stand as recalibrated."
        )
    notes += [
        f"{one.dof}: {', '.join(one.tied)} would explain the missing wrench as well as one of "
        f"{', '.join(one.signals)}; these logs cannot tell which."
        for one in unknown
        if one.tied
    ]
    apart = None if now.white else disagreement(extended, logs, bench.noise)
    if apart is not None:
        notes.append(apart)
    misfit = float(now.stats.chi2.sum()) / bench.samples
    if misfit > FAR**2:
        notes.append(
            f"What is left is {np.sqrt(misfit):.0f} times the sensor noise: check the axes, signs and units "
            "of the logs, and the names of the thrusters, before anything else."
        )
    named = any(f.effect != "unknown" for f in findings)
    verdicts: dict[tuple[bool, bool], Verdict] = {
        (False, False): "nothing_found",
        (True, False): "explained",
        (True, True): "partly_explained",
        (False, True): "unexplained",
    }
    return Diagnosis(
        verdict=verdicts[named, bool(unknown)],
        findings=findings,
        gain=measured[0],
        white=now.white,
        depends_on=tuple(dict.fromkeys(name for one in unknown for name in one.signals)),
        vehicle=vehicle,
        extended=extended,
        recalibrated=recalibrated(bench, now, std) if dense else (),
        rounds=tuple(weighed(bench, one) for one in rounds),
        groups=groups(findings),
        misfit_before=2 * start.cost / bench.samples,
        misfit_after=misfit,
        predictions=measured[1],
        missing_before=missing_wrench(knots(bench, start)),
        missing_after=missing_wrench(now.knots),
        check=bench.check(now.model),
        train=tuple(log.name for log in logs),
        test=test.name,
        contradicted=apart,
        notes=tuple(dict.fromkeys(notes)),
        rejected=tuple(dict.fromkeys(one for log in (*logs, test) for one in log.rejected)),
    )
