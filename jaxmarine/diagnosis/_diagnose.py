"""The whole diagnosis: search, settle, say what is unknown, extend, measure the gain."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from .._precision import need_double
from .._progress import Progress, silent
from ..effects import CATALOGUE, AbstractEffect
from ..logs import Log
from ..networks import LearnedWrench
from ..vehicle import Placed, Vehicle
from ._answer import extended_by, findings_of, groups, recalibrated, standard_errors, weighed
from ._gain import HORIZON
from ._judge import judged
from ._kinematics import disagreement
from ._knots import missing_wrench
from ._learn import learn
from ._model import Model, Workbench
from ._plausible import excesses, told
from ._prepare import opened_with, sharpened
from ._result import Diagnosis, Finding, Gain, Predictions, Verdict
from ._search import Found, Round, search
from ._settle import settled
from ._unnamed import ALONE, WITH_UNKNOWN, Answer, Unnamed, left_over, with_unknown
from ._worth import buys_nothing, gain_at_home, measured_gain


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

    - `train`: logs in order of time; `test`: the log on which the gain is measured. It names nothing, but
      names that buy nothing on it are dropped.
    - `catalogue`: the effects that are suspected; `(*CATALOGUE, YourEffect)` adds one of your own.
    - `window`: length of the windows [s]; default 4 s, less for short logs, more for slow sampling.
    - `progress`: called with a few words at each stage.

    Raises `InputError` where the logs are too short, too slowly sampled or without motion, where the vehicle
    runs away along them, where the test log measures nothing that they measure, and where effects have more
    parameters or begin at more times than there is room for; `ValueError` in single precision.
    """
    need_double("A diagnosis")
    opened = opened_with(vehicle, train, test, catalogue, window, progress)
    bench, rival, found = _searched(opened.bench, opened.begun, progress)
    answer, rounds = _chosen(bench, rival, found, progress)
    answer, measured, dropped = _worthwhile(bench, rival, answer, opened.test)
    model, now = answer.model, answer.judged
    terms, unlearned = _learned(bench, answer, progress)
    extended = extended_by(bench, model, answer.dense).place(*terms)
    progress("predicting the test log")
    # Where nothing is found the file is what is measured, even if its coefficients were refitted.
    changed = bool(model.members or terms or (answer.dense and answer.unknown))
    measured = measured or measured_gain(bench, model, changed, terms, opened.test)
    std = standard_errors(bench, now, answer.dense)
    findings = findings_of(bench, now, rounds, std)
    logs, test = bench.data.logs, opened.test
    apart = None if now.white else disagreement(extended, logs, bench.noise)
    missing = missing_wrench(now.knots)
    unexplained = _unexplained(answer, terms)
    if not now.white:
        known = {one.target for one in unexplained}
        unexplained += excesses(missing, (vehicle, extended), logs, now.phi, known, bench.quiet)
    verdicts: dict[tuple[bool, bool], Verdict] = {
        (False, False): "nothing_found",
        (True, False): "explained",
        (True, True): "partly_explained",
        (False, True): "unexplained",
    }
    diagnosis = Diagnosis(
        verdict=verdicts[bool(findings), bool(unexplained)],
        findings=findings + unexplained,
        gain=measured[0],
        white=now.white,
        depends_on=tuple(dict.fromkeys(name for one in answer.unknown for name in one.signals)),
        vehicle=vehicle,
        extended=extended,
        recalibrated=recalibrated(bench, now, std) if answer.dense else (),
        rounds=tuple(weighed(bench, one) for one in rounds),
        groups=groups(findings),
        misfit_before=2 * rival.start.cost / bench.samples,
        misfit_after=float(now.stats.chi2.sum()) / bench.samples,
        predictions=measured[1],
        missing_before=missing_wrench(rival.judged.knots),
        missing_after=missing,
        catalogue=tuple(catalogue),
        check=bench.check(now.model),
        train=tuple(log.name for log in logs),
        test=test.name,
        contradicted=apart,
        rejected=tuple(dict.fromkeys(one for log in (*logs, test) for one in log.rejected)),
    )
    notes = (*opened.notes, *dropped, *unlearned, *_remarks(diagnosis, answer, changed))
    return dataclasses.replace(diagnosis, notes=tuple(dict.fromkeys(notes)))


def _searched(bench: Workbench, begun: Model, progress: Progress) -> tuple[Workbench, Unnamed, Found]:
    """What the search finds, on the workbench with the noises that it leaves."""
    rival = Unnamed(bench)
    found = search(bench, bench.fitted(begun), progress, rival.beats)
    sharper = sharpened(bench, found.model)
    if sharper is None:
        return bench, rival, found
    progress("searching again, with sensors as exact as what was found leaves them")
    rival = Unnamed(sharper)
    return sharper, rival, search(sharper, sharper.fitted(begun), progress, rival.beats)


def _chosen(
    bench: Workbench, rival: Unnamed, found: Found, progress: Progress
) -> tuple[Answer, tuple[Round, ...]]:
    """Names, unknown dependences, or both: what explains the logs better; and all that was weighed."""
    if rival.beats(found.model):
        return rival.answer, found.rounds
    progress("settling what was found")
    model, dense, rounds = settled(bench, found)
    answer = with_unknown(bench, judged(bench, model), dense, progress)
    share = WITH_UNKNOWN if answer.unknown else ALONE
    if answer.changed and not answer.judged.white and rival.leaves_less(left_over(bench, answer), share):
        answer = rival.answer
    return answer, rounds


def _worthwhile(
    bench: Workbench, rival: Unnamed, answer: Answer, test: Log
) -> tuple[Answer, tuple[Gain, Predictions] | None, list[str]]:
    """The answer, or the one without names where names do not predict better, and a note of that.

    And the gain, where it was asked for.
    """
    what = "What was named at first" if answer.model.members else "The file as it was refitted at first"
    if gain_at_home(bench, answer.model, answer.dense) > 1.0:
        worse = f"{what} predicts the training log worse than the file over {HORIZON:g} s; it was dropped."
        return rival.answer, None, [worse]
    if not answer.model.members or answer.unknown:
        return answer, None, []
    measured = measured_gain(bench, answer.model, True, (), test)
    if buys_nothing(measured[0]):
        return rival.answer, None, [f"{what} buys nothing on {test.name}; it was dropped."]
    return answer, measured, []


def _learned(bench: Workbench, answer: Answer, progress: Progress) -> tuple[tuple[Placed, ...], list[str]]:
    """Networks for what is unknown, where they are of use, and notes where there are none."""
    if not answer.unknown:
        return (), []
    progress("learning what is missing")
    learned = learn(answer.judged.knots, answer.unknown, bench.vehicle.thruster_names)
    terms = tuple(Placed(term, term.target) for term in learned)
    notes = [
        f"{one.dof}: much more is missing where {', '.join(one.signals)} is large, but no signal tells "
        "its value; it is not learned."
        if one.size_only
        else f"{one.dof}: what is missing hangs on the past of {', '.join(one.signals)}, or on the time "
        "over several logs; it is not learned."
        for one in answer.unknown
        if one.dof not in {term.target for term in learned}
    ]
    home = (bench, answer.model, answer.dense)
    if terms and gain_at_home(*home, terms) > gain_at_home(*home):
        terms = ()
        notes.append("What was learned of it predicts the training log worse than nothing; it was left out.")
    return terms, notes


def _unexplained(answer: Answer, terms: tuple[Placed, ...]) -> tuple[Finding, ...]:
    """A finding for each axis on which something unknown acts."""
    return tuple(
        Finding(
            effect=LearnedWrench.name,
            target=one.dof,
            since=None,
            since_log=None,
            parameters={},
            log_evidence=0.5 * one.saved / answer.judged.phi,
            signals=one.signals,
            learned=one.dof in {term.target for term in terms},
        )
        for one in answer.unknown
    )


def _remarks(diagnosis: Diagnosis, answer: Answer, changed: bool) -> list[str]:
    """What a reader must know before believing the answer; `changed`: there is something to predict with."""
    notes = []
    low, high = diagnosis.gain.ratio_ci95 or (0.0, np.inf)
    if low > 1.0:
        notes.append(
            f"The extended vehicle predicts {diagnosis.test} worse than the file does; do not use it to "
            "predict."
        )
    elif changed and high >= 1.0:
        notes.append(
            f"{diagnosis.test} does not confirm this: it is not certain that the extended vehicle predicts "
            "it better than the file does."
        )
    if diagnosis.recalibrated:
        notes.append(
            "Many coefficients of the file are off together; they were refitted and stand as recalibrated."
        )
    notes += [
        f"{one.dof}: {', '.join(one.tied)} would explain the missing wrench as well as one of "
        f"{', '.join(one.signals)}; these logs cannot tell which."
        for one in answer.unknown
        if one.tied
    ]
    notes += [told(one) for one in diagnosis.findings if one.excess is not None]
    if diagnosis.contradicted is not None:
        notes.append(diagnosis.contradicted)
    if diagnosis.far:
        notes.append(
            f"What is left is {np.sqrt(diagnosis.misfit_after):.0f} times the sensor noise: check the axes, "
            "signs and units of the logs, and the names of the thrusters, before anything else."
        )
    return notes
