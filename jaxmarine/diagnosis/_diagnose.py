"""The whole diagnosis: search, settle, say what is unknown, extend, measure the gain."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from .._precision import need_double
from .._progress import AGAIN, LEARNING, PREDICTING, SETTLING, Progress, silent
from ..effects import CATALOGUE, AbstractEffect
from ..fitting import AbstractShares, disagreement, tell_missed
from ..logs import Log, merged, together
from ..networks import LearnedWrench
from ..vehicle import Placed, Vehicle
from ._amid import disturbed, refine_fully
from ._answer import extended_by, findings_of, groups, recalibrated, standard_errors, weighed
from ._criteria import DEFAULT, Criteria
from ._disturbed import in_words, known, without_current
from ._dropped import SHARPER, SPOILT, UNNAMED, USELESS, WORSE, gone
from ._explanation import Model
from ._gain import HORIZON
from ._innovations import log_score, remembered
from ._innovations import told as doubt
from ._judge import Judged, judged
from ._knots import missing_wrench
from ._learn import learn
from ._noises import missed_by
from ._plausible import excesses, told
from ._prepare import Opened, fitted, opened_with, sharpened
from ._result import Alternative, Diagnosis, Dropped, Finding, Gain, MissingWrench, Predictions, Verdict
from ._search import Found, Round, search
from ._settle import settled
from ._shared import opened_over
from ._supplied import unsupplied
from ._unnamed import Answer, Unnamed, nats_of, with_unknown
from ._workbench import Workbench
from ._worth import buys_nothing, gain_at_home, measured_gain, with_band

# By whether something has a name, and whether something acts that has none.
VERDICTS: dict[tuple[bool, bool], Verdict] = {
    (False, False): "nothing_found",
    (True, False): "explained",
    (True, True): "partly_explained",
    (False, True): "unexplained",
}
# Evidence [nats] of what leaves a vehicle that runs away without it.
CERTAIN = 1e6


# Many small products of matrices: threads of the linear algebra would only wait for one another, on a
# busy machine for several times the work.
@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(
    vehicle: Vehicle,
    train: Sequence[Log] | Log | AbstractShares,
    test: Sequence[Log] | Log,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    window: float | None = None,
    progress: Progress = silent,
    criteria: Criteria = DEFAULT,
) -> Diagnosis:
    """Shows what a vehicle gets wrong on its logs, names the cause, extends it and measures the gain.

    - `train`: logs in order of time; or shares of them that lie elsewhere (`jaxmarine.fleets.shared`), of
      which it is not told what they determine.
    - `test`: the logs on which the gain is measured. They name nothing, but names that buy nothing on them
      are dropped.
    - `catalogue`: the effects that are suspected; `(*CATALOGUE, YourEffect)` adds one of your own.
    - `window`: length of the windows [s]; default 4 s, less for short logs, more for slow sampling.
    - `progress`: called with a few words at each stage; what they say of the share that is done, and of the
      time that is left, `jaxmarine.diagnosis.Estimate` tells.
    - `criteria`: when something is said.

    Raises `InputError` where the logs are too short, too slowly sampled or without motion, where the vehicle
    runs away along them, where no test log measures what they measure, where the craft can have none of the
    suspected effects, and where these have more parameters or begin at more times than there is room for; of
    shares also for what is answered in one process alone (`_shared.opened_over`);
    `ValueError` in single precision.
    """
    need_double("A diagnosis")
    how = test, catalogue, window, progress, criteria
    shared = isinstance(train, AbstractShares)
    opened = opened_over(vehicle, train, *how) if shared else opened_with(vehicle, train, *how)
    way = _answered(opened, progress)
    bench, answer, model, now = way.bench, way.answer, way.answer.model, way.answer.judged
    # Where nothing is found the file is what is measured, even if its coefficients were refitted.
    changed = bool(model.members or opened.exchanged or (answer.dense and answer.unknown))
    terms, learned, unlearned = _learned(bench, answer, changed, opened.tests, progress)
    changed = changed or bool(terms)
    extended = unsupplied(extended_by(bench, model, answer.dense).place(*terms), vehicle)
    progress(PREDICTING)
    measured = way.measured or learned or measured_gain(bench, model, changed, terms, opened.tests)
    std = standard_errors(bench, now, answer.dense)
    connected = bench.as_connected() if opened.exchanged else bench
    named = _exchanges(connected, now, opened) + findings_of(bench, now, way.rounds, std)
    logs, tests = bench.data.logs, opened.tests
    missing = missing_wrench(now.knots)
    unexplained = _unexplained(bench, answer, terms, missing, (vehicle, extended))
    missed = _missed(bench, model)
    diagnosis = Diagnosis(
        verdict=VERDICTS[bool(named), bool(unexplained)],
        findings=named + unexplained,
        gain=measured[0],
        white=now.white,
        depends_on=tuple(dict.fromkeys(name for one in answer.unknown for name in one.signals)),
        vehicle=vehicle,
        extended=extended,
        recalibrated=recalibrated(bench, now, std) if answer.dense else (),
        rounds=tuple(weighed(bench, one) for one in way.rounds),
        groups=groups(named),
        misfit_before=2 * (Unnamed(connected) if opened.exchanged else way.rival).start.cost / bench.samples,
        misfit_after=float(now.knots.chi2.sum()) / bench.samples,
        predictions=with_band(bench, model, changed, terms, measured[1]),
        missing_before=missing_wrench(way.rival.judged.knots),
        missing_after=missing,
        catalogue=tuple(catalogue),
        check=bench.check(model),
        train=tuple(log.name for log in logs),
        tests=tuple(log.name for log in tests),
        disturbance=None if now.disturbance is None else known(now.disturbance),
        doubted=_doubt(bench, model, named),
        contradicted=None if now.white or shared else disagreement(extended, logs, bench.noise),
        rejected=tuple(dict.fromkeys(one for log in (*logs, *tests) for one in log.rejected)),
        dropped=_left_out((*way.lost, *answer.dropped), named),
        missed=missed is not None,
        clocks={log.name: log.clock for log in (*logs, *tests)},
    )
    said = (*way.told, *unlearned, *_not_scored(diagnosis.gain), *_remarks(diagnosis, answer, changed))
    notes = (*opened.gross, *diagnosis.warnings, *opened.notes, *([missed] if missed else []), *said)
    return dataclasses.replace(diagnosis, notes=merged(notes))


@dataclasses.dataclass(frozen=True)
class _Way:
    """The way to an answer.

    - `bench`: with the noises that it leaves; `rival`: the file beside what has no name.
    - `rounds`: all that was weighed; `lost`: what was found with coarser noises, and not again.
    - `measured`: the gain, where it was asked for; `told`: what is to be said of it.
    """

    bench: Workbench
    rival: Unnamed
    answer: Answer
    rounds: tuple[Round, ...] = ()
    lost: tuple[Dropped, ...] = ()
    measured: tuple[Gain, Predictions] | None = None
    told: tuple[str, ...] = ()


def _answered(opened: Opened, progress: Progress) -> _Way:
    """Names, unknown dependences, or both, and how they were come by."""
    if opened.nameless:
        rival = Unnamed(opened.bench, _begun(opened).beside)
        return _Way(opened.bench, rival, rival.answer)
    bench, rival, found, lost = _searched(opened, progress)
    answer, rounds = _chosen(bench, rival, found, progress)
    answer, measured, told = _worthwhile(bench, rival, answer, opened.tests, progress)
    return _Way(bench, rival, answer, rounds, lost, measured, tuple(told))


def _missed(bench: Workbench, model: Model) -> str | None:
    """What the model misses, where sensors were taken for no better than that."""
    if not bench.raised:
        return None
    names = [log.name for log in bench.data.logs]
    return tell_missed(bench.vehicle, names, missed_by(bench, model), bench.own_noise, bench.data.length)


def _left_out(dropped: Sequence[Dropped], findings: Sequence[Finding]) -> tuple[Dropped, ...]:
    """Each once, by the reason for which it went first; without what was found again."""
    stays = {finding.label for finding in findings}
    once = {one.label: one for one in reversed(dropped) if one.label not in stays}
    return tuple(reversed(once.values()))


def _searched(opened: Opened, progress: Progress) -> tuple[Workbench, Unnamed, Found, tuple[Dropped, ...]]:
    """What the search finds, on the workbench with the noises that it leaves.

    And what it found before that and did not find again.
    """
    bench, begun = fitted(opened.bench, _begun(opened))
    rival = Unnamed(bench, begun.beside)
    with bench.preparing(begun):
        found = search(bench, begun, progress, rival.beats)
    sharper = sharpened(bench, found.model)
    if sharper is None:
        return bench, rival, found, ()
    progress(AGAIN)
    first = found.model
    begun = refine_fully(sharper, first)
    rival = Unnamed(sharper, begun.beside)
    found = search(sharper, begun, progress, rival.beats)
    return sharper, rival, found, gone(sharper, first, found.model, SHARPER)


def _begun(opened: Opened) -> Model:
    """The model to start from, beside a disturbance where commands answer one."""
    return disturbed(opened.bench, opened.begun) if opened.feedback else opened.begun


def _chosen(
    bench: Workbench, rival: Unnamed, found: Found, progress: Progress
) -> tuple[Answer, tuple[Round, ...]]:
    """Names, unknown dependences, or both: what explains the logs better; and all that was weighed."""
    if rival.beats(found.model, found.stats) or rival.beats_one(found.model, found.stats):
        return _without_names(bench, rival, found.model, (), UNNAMED), found.rounds
    progress(SETTLING)
    model, dense, rounds, dropped = settled(bench, found)
    now = judged(bench, model)
    # Several names together may take the shape of anything, and add to what is unknown like one shape more.
    several = len(model.members) > 1 and not now.white
    if several and rival.likelier(nats_of(bench, now, ()), now.phi):
        return _without_names(bench, rival, model, dropped, UNNAMED), rounds
    return _completed(bench, rival, now, dense, dropped, progress), rounds


def _completed(
    bench: Workbench,
    rival: Unnamed,
    now: Judged,
    dense: bool,
    dropped: tuple[Dropped, ...],
    progress: Progress,
) -> Answer:
    """Names with what else the logs depend on; or that alone, where it is likelier."""
    followed = (lambda: rival.answer.unknown) if dense else tuple
    answer = with_unknown(bench, now, dense, progress, followed)
    if dropped:
        answer = dataclasses.replace(answer, dropped=dropped + answer.dropped)
    if not answer.changed or answer.judged.white:
        return answer
    # Coefficients that were refitted without what is unknown have followed it.
    own, bends = nats_of(bench, answer.judged, answer.unknown), bool(answer.model.members)
    if rival.likelier(own, answer.judged.phi, bends):
        return _without_names(bench, rival, answer.model, answer.dropped, UNNAMED)
    return answer


def _without_names(
    bench: Workbench, rival: Unnamed, named: Model, dropped: tuple[Dropped, ...], reason: str
) -> Answer:
    """The answer without names, which knows what was named before and why that went."""
    more = gone(bench, named, rival.answer.model, reason)
    return dataclasses.replace(rival.answer, dropped=dropped + more)


def _worthwhile(
    bench: Workbench,
    rival: Unnamed,
    answer: Answer,
    tests: Sequence[Log],
    progress: Progress,
    named: str = "what was named at first",
) -> tuple[Answer, tuple[Gain, Predictions] | None, list[str]]:
    """The answer, without names where these do not predict better, the least likely first, and notes of that.

    And the gain, where it was asked for.

    - `named`: what the notes call the names.
    """
    what = named.capitalize() if answer.model.members else "The file as it was refitted at first"
    if gain_at_home(bench, answer.model, answer.dense) > 1.0:
        worse = f"{what} predicts the training log worse than the file over {HORIZON:g} s; it was dropped."
        return _without_names(bench, rival, answer.model, answer.dropped, WORSE), None, [worse]
    if not answer.model.members or answer.unknown:
        return answer, None, []
    measured, names = measured_gain(bench, answer.model, True, (), tests), together([t.name for t in tests])
    more = _likelier_by(bench, rival, answer.model, tests)
    idle = buys_nothing(measured[0], bench.criteria.worth)
    if idle or (more is not None and more < 0):
        how = "buys nothing on" if idle else "makes less likely, one step ahead, what was measured in"
        # One that only the training logs ask for may spoil what the others are worth.
        least = _without_least(bench, answer.model)
        if least is not None:
            dropped = gone(bench, answer.model, least, SPOILT)
            with_it = f"With {dropped[-1].label} {named} {how} {names}; it was dropped."
            now = judged(bench, least)
            fewer = _completed(bench, rival, now, answer.dense, answer.dropped + dropped, progress)
            left = "what is named without it"
            answer, kept, notes = _worthwhile(bench, rival, fewer, tests, progress, left)
            return answer, kept, [with_it, *notes]
        told = [f"{what} {how} {names}; it was dropped."]
        return _without_names(bench, rival, answer.model, answer.dropped, USELESS), None, told
    return answer, measured, [] if more is None else [_one_step_ahead(names, more)]


def _without_least(bench: Workbench, whole: Model) -> Model | None:
    """The model without the name that costs the training logs least likelihood; None where none can go."""
    if len(whole.members) < 2:
        return None
    fewer = [bench.likeliest(bench.without_member(whole, i)) for i in range(len(whole.members))]
    return min((one for one in fewer if bench.stands(one, whole)), key=lambda one: one.cost, default=None)


def _learned(
    bench: Workbench, answer: Answer, changed: bool, tests: Sequence[Log], progress: Progress
) -> tuple[tuple[Placed, ...], tuple[Gain, Predictions] | None, list[str]]:
    """Networks for what is unknown, where they are of use, the gain where it was asked for, and notes.

    - `changed`: there is something to predict with beside them.
    """
    if not answer.unknown:
        return (), None, []
    progress(LEARNING)
    learned = learn(answer.judged.knots, answer.unknown, bench.vehicle.drive_names)
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
    if not terms:
        return (), None, notes
    measured = measured_gain(bench, answer.model, True, terms, tests)
    without = measured_gain(bench, answer.model, changed, (), tests)
    if measured[0].ratio > without[0].ratio:
        names = together([test.name for test in tests])
        notes.append(f"What was learned of it predicts {names} worse than nothing; it was left out.")
        return (), without, notes
    return terms, measured, notes


def _exchanges(connected: Workbench, now: Judged, opened: Opened) -> tuple[Finding, ...]:
    """A finding for each pair of columns that are exchanged; their evidence is that of all together.

    - `connected`: the workbench with the columns as filed.
    """
    if not opened.exchanged:
        return ()
    without = connected.refine(now.model)
    # Where the vehicle runs away along the log with the columns as filed, it is as good as certain.
    saved = min(2 * (without.cost - now.model.cost), 2 * CERTAIN * now.phi)
    own = 0.5 * saved / now.phi
    alternatives = []
    for one in opened.instead:
        behind = (connected.as_connected(one).refine(now.model).cost - now.model.cost) / now.phi
        close = behind < connected.criteria.close
        alternatives.append(Alternative(one.effect.name, one.target, own - behind, close))
    return tuple(
        Finding(
            effect=one.effect.name,
            target=one.target,
            since=None,
            since_log=None,
            parameters={},
            log_evidence=own,
            alternatives=tuple(alternatives),
        )
        for one in opened.exchanged
    )


def _unexplained(
    bench: Workbench,
    answer: Answer,
    terms: tuple[Placed, ...],
    missing: MissingWrench,
    vehicles: tuple[Vehicle, Vehicle],
) -> tuple[Finding, ...]:
    """A finding for each axis on which something unknown acts, or more than a disturbance can be.

    - `vehicles`: as filed, and extended.
    """
    now = answer.judged
    found = tuple(
        Finding(
            effect=LearnedWrench.name,
            target=one.dof,
            since=None,
            since_log=None,
            parameters={},
            log_evidence=0.5 * one.saved / (now.plain_phi if now.disturbance is None else 1.0),
            signals=one.signals,
            learned=one.dof in {term.target for term in terms},
        )
        for one in answer.unknown
    )
    if now.white:
        return found
    axes = {one.target for one in found}
    beyond, steerable = without_current(missing, bench, answer.model, vehicles[1]), bench.criteria.steerable
    return found + excesses(beyond, vehicles, bench.data.logs, now.plain_phi, axes, bench.quiet, steerable)


def _not_scored(gain: Gain) -> list[str]:
    """A note per test log of which starts are wrong."""
    return [
        f"{one.log}: at {one.count} of {one.of} starts of a prediction both models are off by far more than "
        f"the sensors where it begins ({', '.join(one.quantities)}); "
        + ("these are not scored." if gain.sound else "they say little of what comes after.")
        for one in gain.unscored
    ]


def _doubt(bench: Workbench, model: Model, findings: Sequence[Finding]) -> str | None:
    """Why no name is certain, where names stand beside a disturbance whose innovations are no noise."""
    if model.beside is None or not findings:
        return None
    dependence = remembered(bench, model)
    return None if dependence is None else doubt(dependence)


def _likelier_by(bench: Workbench, rival: Unnamed, model: Model, tests: Sequence[Log]) -> float | None:
    """Nats per number that test logs are likelier one step ahead by a model than by the file.

    Each beside its own disturbance; None without one, and where the craft runs away along a test log. Under
    feedback the error over a horizon flatters what copies the controller; this does not.
    """
    if model.beside is None:
        return None
    on = bench.on(tests)
    more = log_score(on, model) - log_score(on, rival.judged.model)
    return more if np.isfinite(more) else None


def _one_step_ahead(names: str, more: float) -> str:
    """What test logs say of names beside a disturbance; `more`: as of `_likelier_by`."""
    return (
        "One step ahead, each beside the disturbance that suits it, the extended vehicle makes what "
        f"{names} measured likelier than the file does, by {more:.3g} nats per number; under feedback this "
        "says more than the error over a horizon."
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
    if diagnosis.disturbance is not None:
        notes.append(in_words(diagnosis.disturbance))
    notes += [told(one) for one in diagnosis.findings if one.excess is not None]
    if diagnosis.contradicted is not None:
        notes.append(diagnosis.contradicted)
    if diagnosis.far:
        notes.append(
            f"What is left is {np.sqrt(diagnosis.misfit_after):.0f} times the sensor noise: check the axes, "
            "signs and units of the logs, and the names of the thrusters, before anything else."
        )
    return notes
