"""The whole diagnosis: search, settle, say what is unknown, extend, measure the gain."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from .._errors import InputError
from .._precision import need_double
from .._types import CHANNELS, RATE, VELOCITY
from ..effects import CATALOGUE, AbstractEffect
from ..fitting import cut, noise_of
from ..logs import Log, smooth_states
from ..simulation import initial_state, simulate, substeps
from ..vehicle import Placed, Vehicle
from ._answer import extended_by, findings_of, groups, recalibrated, standard_errors, weighed
from ._coefficients import settle
from ._gain import HORIZON, Candidate, gain, predictions
from ._judge import Judged, judged
from ._kinematics import contradiction, disagreement
from ._knots import knots, missing_wrench
from ._learn import learn
from ._model import SLOTS, Beginning, Member, Model, Workbench, filled, same_log
from ._progress import Progress, silent
from ._result import Diagnosis, Finding, Gain, Verdict
from ._saturated import saturate
from ._search import (
    FEW_STEPS,
    MARGIN,
    ROUGH,
    STEPS,
    Found,
    Round,
    dispersion,
    needed,
    own_dispersion,
    penalty,
    search,
)
from ._signals import Signals
from ._unknown import Dependence, cost_of_removal, dependences, explained

WINDOW = 4.0  # [s]
# Statistics over windows need some of them: short logs are cut into shorter windows, down to these.
FEWEST_WINDOWS = 16
SHORTEST = 1.0  # [s]
FEWEST_SAMPLES = 12  # of a window
SLOWEST = 2.0  # [s] between samples
FEWEST = 6  # windows of a diagnosis
LEAST = HORIZON + 4.0  # [s] of a log on which a gain is measured
HARMS = 0.95  # a member goes where predictions without it have less than this share of the error
# A member whose removal costs less than this share beside the unknown dependences only stood in for them;
# all of them did where unknown dependences alone leave less than the second share of what they leave, or
# than the third one of what they leave together with unknown dependences, or the last one of what more than
# two of them leave.
STAND_IN, ALONE, WITH_UNKNOWN, CROWD = 0.35, 0.6, 0.7, 0.8
# Chi-square that a shape of an unknown dependence may save by chance, in units of what a sample has left;
# and what is left per sample, beyond the noise, from which it is asked whether names are of any use.
DEAR, PLENTY = 10.0, 0.5
# A member is kept without more than a few steps of a refit where those promise that its removal costs this
# many times what it must save.
OBVIOUS = 10.0
# Suspects beaten in a round that are weighed once more in the end.
RIVALS = 3


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

    Raises `InputError` where the logs are too short, too slowly sampled or without motion, where the test
    log measures nothing that they measure, and where effects have more parameters or begin at more times
    than there is room for.
    """
    logs = (train,) if isinstance(train, Log) else tuple(train)
    if not logs:
        raise InputError("A diagnosis needs at least one training log.")
    need_double("A diagnosis")
    notes = [note for log in (*logs, test) for note in log.notes]
    logs, test, doubled = _named_apart(logs, test)
    notes += doubled
    _moving(logs)
    bench = _workbench(vehicle, logs, catalogue, window)
    notes += _stuck(bench)
    if test.duration < LEAST:
        raise InputError(
            f"{test.name}: is shorter than a prediction with its run-in ({LEAST:g} s); use a longer test log."
        )
    if not (np.isfinite(test.channels).any(axis=0) & np.isfinite(bench.noise)).any():
        raise InputError(
            f"{test.name}: measures nothing that {logs[0].name} measures; use a test log with its channels."
        )
    progress("fitting the vehicle file")
    begun, told = _begun(bench)
    notes += told
    bench = _rescaled(bench, begun)
    base = bench.fitted(begun)
    rival = _Unnamed(bench)
    found = search(bench, base, progress, rival.better)
    rounds = found.rounds
    if rival.better(found.model):
        now, unknown, dense = rival.judged, rival.dependences, False
    else:
        progress("settling what was found")
        model, dense, rounds = _settled(bench, found)
        now, unknown = _with_unknown(bench, judged(bench, model), dense, progress)
        rest, share = _left_over(bench, now, unknown), WITH_UNKNOWN if unknown else ALONE
        if (now.model.members or dense) and not now.white and rival.leaves_less(rest, share):
            now, unknown, dense = rival.judged, rival.dependences, False
    at_home = _gain_at_home(bench, now.model, dense)
    if at_home > 1.0:
        now, unknown, dense, at_home = rival.judged, rival.dependences, False, 1.0
        notes.append(
            "What was named at first predicts the training log worse than the file over 5 s; it was dropped."
        )
    model, start = now.model, rival.start

    extended = extended_by(bench, model, dense)
    terms: tuple[Placed, ...] = ()
    if unknown:
        progress("learning what is missing")
        learned = learn(now.knots, unknown, vehicle.thruster_names)
        terms = tuple(Placed(term, term.target) for term in learned)
        notes += [
            f"{one.dof}: what is missing hangs on the past of {', '.join(one.signals)}, or on the time over "
            "several logs; it is not learned."
            for one in unknown
            if one.dof not in {term.target for term in learned}
        ]
        if terms and _gain_at_home(bench, model, dense, terms) > at_home:
            terms = ()
            notes.append(
                "What was learned of it predicts the training log worse than nothing; it was left out."
            )
    extended = extended.place(*terms)
    progress("predicting the test log")
    # Where nothing is found the file is what is measured, even if its coefficients were refitted.
    changed = bool(model.members or terms or (dense and unknown))
    measured = _measured_gain(bench, model, changed, terms, test)
    if measured[0].ratio_ci95[0] > 1.0:
        notes.append(
            f"The extended vehicle predicts {test.name} worse than the file does; do not use it to predict."
        )
    std = standard_errors(bench, now, dense)
    findings = findings_of(bench, now, rounds, std) + tuple(
        Finding("unknown", one.dof, None, None, {}, 0.5 * one.saved / now.phi) for one in unknown
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
        misfit_after=float(now.stats.chi2.sum()) / bench.samples,
        predictions=measured[1],
        missing_before=missing_wrench(knots(bench, start)),
        missing_after=missing_wrench(now.knots),
        check=bench.check(now.model),
        train=tuple(log.name for log in logs),
        test=test.name,
        notes=tuple(dict.fromkeys(notes)),
    )


# --- preparation ---------------------------------------------------------------------------------


def _window(logs: Sequence[Log], window: float | None) -> float:
    if window is not None:
        return window
    dt = float(np.median([log.dt for log in logs]))
    if dt > SLOWEST:
        raise InputError(
            f"{logs[0].name}: has a sample every {dt:g} s, too few to see how a vehicle moves; give t in "
            f"seconds, or take a log with a sample every {SLOWEST:g} s or faster."
        )
    return window_length(sum(log.duration for log in logs), dt)


def window_length(duration: float, dt: float) -> float:
    """Seconds of a window of logs that last so long together, with a sample every `dt` s."""
    return float(max(np.clip(duration / FEWEST_WINDOWS, SHORTEST, WINDOW), FEWEST_SAMPLES * dt))


def _speeds(logs: Sequence[Log]) -> Float[np.ndarray, "6"]:
    """The fastest that the logs go on each axis [m/s, rad/s], 1 where it was not measured."""
    speeds = np.abs(np.concatenate([log.channels[:, 6:12] for log in logs]))
    return np.where(np.isfinite(speeds).any(0), np.nan_to_num(speeds).max(0), 1.0)


def _workbench(vehicle: Vehicle, logs: Sequence[Log], catalogue, window: float | None) -> Workbench:
    noise = noise_of(vehicle, logs)
    split = substeps(vehicle, float(np.median([log.dt for log in logs])), _speeds(logs))
    data = cut(vehicle, logs, noise, _window(logs, window))
    if data.windows.count < FEWEST:
        names = ", ".join(log.name for log in logs)
        raise InputError(
            f"{names}: gives {data.windows.count} windows of {data.length:g} s, a diagnosis needs {FEWEST}; "
            "use a longer log or a shorter window."
        )
    families, layout = saturate(vehicle, catalogue)
    bench = Workbench(vehicle, families, layout, data, noise, split)
    room = SLOTS - len(bench.base)
    for suspect in layout.suspects:
        if len(suspect.slots) > room:
            raise InputError(
                f"Effect {suspect.label} has {len(suspect.slots)} parameters, a diagnosis of {vehicle.name} "
                f"fits at most {room} at once; use an effect with fewer."
            )
    return bench


def _named_apart(logs: Sequence[Log], test: Log) -> tuple[tuple[Log, ...], Log, list[str]]:
    """The logs with names of their own, by which a beginning says in which log it lies; and notes of changes.

    A test log keeps the name of the training log that it is.
    """
    met, out, notes = dict[str, int](), [], []
    for log in (*logs, test):
        twin = next((one for one in out if log is test and same_log(one, log)), None)
        count = met[log.name] = met.get(log.name, 0) + 1
        if count > 1 and twin is None:
            name = f"{log.name} ({count})"
            notes.append(f"Another log is called {log.name} too; this one is `{name}` here.")
            log = dataclasses.replace(log, name=name)
        out.append(log)
    return tuple(out[:-1]), out[-1], notes


def _moving(logs: Sequence[Log]) -> None:
    """Refuses training logs in which nothing changes: whatever explained them would be made up."""
    seen = np.concatenate([log.channels for log in logs])
    measured = seen[:, np.isfinite(seen).any(axis=0)]
    if measured.size and (np.nanmax(measured, axis=0) == np.nanmin(measured, axis=0)).all():
        names = ", ".join(log.name for log in logs)
        raise InputError(f"{names}: no channel ever changes; use a log in which the vehicle moves.")


def _stuck(bench: Workbench) -> list[str]:
    """A note on channels that are measured but cannot be used, on axes that move."""
    measured = np.isfinite(np.concatenate([log.channels for log in bench.data.logs])).any(axis=0)
    useless = measured & np.isnan(bench.noise) & (np.tile(bench.vehicle.free, 3) > 0)
    names = [name for name, bad in zip(CHANNELS, useless, strict=True) if bad]
    if not names:
        return []
    return [
        f"{', '.join(names)} never changes in the training logs, and the vehicle file does not state its "
        "noise under [sensors]; it was not used."
    ]


def _unstated(bench: Workbench) -> list[int]:
    """Channels that are used and whose noise the vehicle file does not state."""
    unstated = np.isnan(bench.vehicle.stated_noise)
    return np.flatnonzero(unstated & np.isfinite(bench.noise)).tolist()


def _begun(bench: Workbench) -> tuple[Model, list[str]]:
    """The model to start from, and a note where it has more than the vehicle file.

    A sensor that grossly contradicts the others is told at once where noises are estimated: the estimate
    would take its error for noise. Where they are stated, the search weighs it with all other causes.
    """
    model, suspects = bench.start(), bench.layout.suspects
    proven = contradiction(bench.vehicle, bench.data.logs, suspects) if _unstated(bench) else None
    if proven is None:
        return model, []
    i, values = proven
    value = np.array([values[name] for name in suspects[i].slots]) - bench.layout.neutral_of(i)
    note = (
        f"Positions, attitude and velocities contradict one another as {suspects[i].label} would make "
        "them, whatever forces act; it was taken first."
    )
    return bench.with_member(model, Member(i), value), [note]


def _rescaled(bench: Workbench, begun: Model) -> Workbench:
    """The workbench with the noise of sensors that the file does not state raised to the residual.

    A filtered measurement looks far less noisy than any model can predict it; weighted by that noise it
    would outweigh all others. From what a channel changes by within a window, which is the most that it
    can be missed by, down to the residual of the file as it is, and of the file recalibrated.
    """
    free = _unstated(bench)
    if not free:
        return bench
    own = bench.noise[free]
    seen = np.asarray(bench.data.windows.weight) > 0
    values = np.ma.masked_array(bench.data.windows.measured, ~seen)
    most = np.fmax(own, values.std(axis=1).mean(axis=0).filled(0.0)[free])
    bench = _weighted(bench, free, most)
    for model in (bench.frozen(begun), begun):
        missed = (bench.residual_rms(bench.refine(model)) * bench.noise)[free]
        bench = _weighted(bench, free, np.fmin(most, np.fmax(own, missed)))
    # Such residuals are alike from sample to sample: each weighs as little against the priors as their
    # scores scatter.
    model = bench.fitted(begun)
    alike = np.sqrt(dispersion(bench, model, bench.screen(model)))
    return _weighted(bench, free, alike * bench.noise[free])


def _weighted(bench: Workbench, channels: list[int], noise: np.ndarray) -> Workbench:
    """The workbench with another noise of some channels."""
    now = bench.noise.copy()
    now[channels] = noise
    return bench.reweighed(now)


# --- settling ------------------------------------------------------------------------------------


def _pruned(bench: Workbench, model: Model) -> Model:
    """The model without members that are not needed beside the others, or mean nothing beside them."""
    if not model.members:
        return model
    stats = bench.screen(model)
    phi, sound = dispersion(bench, model, stats), bench.sound(model)
    for i, where in enumerate(bench.slices(model.members)):
        least = needed(bench, model.members[i], own_dispersion(bench, model, stats, where, phi))
        less = bench.refine(bench.without_member(model, i), FEW_STEPS, ROUGH)
        if sound and 2 * (less.promised - model.cost) > OBVIOUS * least:
            continue
        less = bench.refine(less)
        idle = 2 * (less.cost - model.cost) < least
        if idle or (not sound and bench.sound(less)):
            return _pruned(bench, less)
    return model


def _reweighed(bench: Workbench, model: Model, rounds: Sequence[Round], phi: float) -> Model:
    """Each member against those that it beat in its round, now that the other members are known."""
    if len(model.members) == 1:
        return model
    for i, member in enumerate(model.members):
        trials = [r.trials for r in rounds if r.accepted and r.trials[0].member.suspect == member.suspect]
        for trial in trials[0][1 : 1 + RIVALS] if trials else ():
            suspect, less = trial.member.suspect, bench.without_member(model, i)
            if suspect in {m.suspect for m in model.members} or suspect not in bench.open(less):
                continue
            if trial.member.since is not None and not bench.may_begin(less, suspect):
                continue
            value = trial.model.z[bench.slices(trial.model.members)[-1]]
            other = bench.refine(bench.with_other(model, i, trial.member, value), STEPS)
            price = penalty(bench, trial.member) - penalty(bench, model.members[i])
            if bench.sound(other) and 2 * (other.cost - model.cost) / phi + price < 0:
                model = other
    return model


def _beginnings_refined(bench: Workbench, model: Model) -> Model:
    """Moves each beginning to the time that costs least, from coarse to fine."""
    for i, member in enumerate(model.members):
        if member.since is None:
            continue
        log = bench.data.logs[member.since.log]
        step = bench.data.length / 2
        while step >= 0.9 * log.dt:
            best = model
            for shift in (-step, step):
                time = float(np.clip(model.members[i].since.time + shift, log.t[0], log.t[-1]))  # pyright: ignore
                time = float(log.t[np.argmin(np.abs(log.t - time))])
                moved = dataclasses.replace(member, since=Beginning(member.since.log, time))
                members = tuple(moved if j == i else m for j, m in enumerate(model.members))
                trial = bench.refine(dataclasses.replace(model, members=members), max_steps=6)
                if trial.cost < best.cost - 1e-6:
                    best = trial
            if best is model:
                step /= 2
            model = best
    return model


def _settled(bench: Workbench, found: Found) -> tuple[Model, bool, tuple[Round, ...]]:
    """What the search found, without what is not needed, and whether the whole file was recalibrated.

    And all that was weighed, in the search and in the place of single coefficients.
    """
    phi = dispersion(bench, found.model, found.stats)
    model, dense, more = settle(bench, _pruned(bench, found.model), phi)
    model = _beginnings_refined(bench, model)
    phi = dispersion(bench, model, bench.screen(model))
    rounds = found.rounds + more
    model = _pruned(bench, _reweighed(bench, model, rounds, phi))
    return _without_harm(bench, model, dense), dense, rounds


def _without_harm(bench: Workbench, model: Model, dense: bool) -> Model:
    """The model without members beside which it predicts the training log worse over 5 s than without them.

    Windows are shorter, and a member that takes up what is left in them may run away over more.
    """
    if len(model.members) < 2:
        return model
    own = _gain_at_home(bench, model, dense)
    for i in reversed(range(len(model.members))):
        less = bench.refine(bench.without_member(model, i))
        if _gain_at_home(bench, less, dense) < HARMS * own:
            return _without_harm(bench, _pruned(bench, less), dense)
    return model


# --- what is unknown -----------------------------------------------------------------------------


def _with_unknown(
    bench: Workbench, now: Judged, dense: bool, progress: Progress
) -> tuple[Judged, tuple[Dependence, ...]]:
    """What the residual depends on, and the model without members that only stood in for that."""
    while not now.white:
        progress("looking for what the residual depends on")
        unknown = _dependences(bench, now, extended_by(bench, now.model, dense))
        spurious = _stand_in(bench, now, unknown)
        if spurious is None:
            return now, unknown
        now = judged(bench, bench.refine(bench.without_member(now.model, spurious)))
        # What was found beside a stand-in may have mended what that spoilt.
        model = _pruned(bench, now.model)
        if model is not now.model:
            now = judged(bench, model)
    return now, ()


def _dependences(bench: Workbench, now: Judged, vehicle: Vehicle) -> tuple[Dependence, ...]:
    return dependences(now.knots, now.phi, _undisturbed(bench, vehicle), float(bench.samples))


def _undisturbed(bench: Workbench, vehicle: Vehicle) -> Signals | None:
    """Velocities at the knots as simulated from the commands over whole logs, None where that fails."""
    places = bench.places
    out = np.zeros((*places.t.shape, 6))
    logs = bench.data.logs
    for i, log in enumerate(logs):
        track = smooth_states(log, vehicle.dof)
        start = initial_state(vehicle, track.position[0], track.attitude[0], track.nu[0])
        later = {other.name for other in logs[i + 1 :]}
        begun = tuple(p for p in vehicle.placed if p.since is None or p.since_log not in later)
        run = simulate(dataclasses.replace(vehicle, placed=begun), log, start)
        here = places.log == i
        nu = np.asarray(run.states.velocity)
        for axis in range(6):
            out[here, :, axis] = np.interp(places.t[here], log.t, nu[:, axis])
    names = (*VELOCITY, *RATE)
    if not np.isfinite(out).all():
        return None
    over_ground = {name: out[..., i] for i, name in enumerate(names)}
    return places.through_water(np.asarray(vehicle.plant().water), over_ground)


class _Unnamed:
    """The vehicle file with nothing but unknown dependences: what any names have to do better than.

    Where they do not, nothing that was named or recalibrated is the cause: it took the shape of what is
    unknown. All is computed when it is first asked for.
    """

    def __init__(self, bench: Workbench):
        self.bench = bench

    @functools.cached_property
    def start(self) -> Model:
        return self.bench.refine(self.bench.frozen(self.bench.start()))

    @functools.cached_property
    def judged(self) -> Judged:
        return judged(self.bench, self.start)

    @functools.cached_property
    def dependences(self) -> tuple[Dependence, ...]:
        return _dependences(self.bench, self.judged, self.bench.vehicle)

    @functools.cached_property
    def rest(self) -> float:
        """Chi-square beyond the noise that is left, if the file's coefficients may change as well."""
        _, precision, _ = self.bench.known(dataclasses.replace(self.start, frozen=False))
        free = dataclasses.replace(self.judged.knots, precision=precision)
        return max(2 * self.start.cost - explained(free, self.dependences) - self.bench.samples, 0.0)

    def better(self, model: Model) -> bool:
        """Whether several members leave clearly more than unknown dependences alone would."""
        rest, count = 2 * model.cost - self.bench.samples, len(model.members)
        share = ALONE if count == 2 else CROWD
        return count > 1 and rest > PLENTY * self.bench.samples and self.leaves_less(rest, share)

    def leaves_less(self, rest: float, share: float) -> bool:
        """Whether it leaves less than a share of `rest`, and not by chance."""
        if not self.dependences:
            return False
        shapes = sum(one.features.shape[-1] for one in self.dependences)
        chance = DEAR * (shapes + MARGIN) * (self.rest / self.bench.samples + 1.0)
        return self.rest < min(share * rest, rest - chance)


def _left_over(bench: Workbench, now: Judged, unknown: tuple[Dependence, ...]) -> float:
    """Chi-square beyond the noise that a model leaves together with unknown dependences."""
    saved = explained(now.knots, unknown) - explained(now.knots, ())
    return max(2 * now.model.cost - saved - bench.samples, 0.0)


def _stand_in(bench: Workbench, now: Judged, unknown: tuple[Dependence, ...]) -> int | None:
    """The member that an unknown dependence replaces best, if one does."""
    if not unknown or not now.model.members:
        return None
    costs = cost_of_removal(now.knots, bench.slices(now.model.members), unknown)
    shares = [beside / max(alone, 1e-9) for alone, beside in costs]
    worst = int(np.argmin(shares))
    return worst if shares[worst] < STAND_IN else None


# --- the gain ------------------------------------------------------------------------------------


@threadpool_limits.wrap(limits=1, user_api="blas")
def gain_of(
    vehicle: Vehicle,
    train: Sequence[Log] | Log,
    test: Log,
    causes: Sequence[Placed],
) -> Gain:
    """What given causes buy on the test log, refitted from their values: what naming them is worth.

    As `diagnose` measures it, without a search; raises `InputError` where the catalogue lacks a cause or a
    cause begins in a log that is not given.
    """
    logs = (train,) if isinstance(train, Log) else tuple(train)
    bench = _workbench(vehicle, logs, CATALOGUE, None)
    names = [log.name for log in logs]
    model = bench.start()
    for cause in causes:
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
    return _measured_gain(bench, bench.refine(model), bool(causes), (), test)[0]


def _gain_at_home(bench: Workbench, model: Model, dense: bool, terms: Sequence[Placed] = ()) -> float:
    """The error over that of the file on the longest training log; 1 where nothing changes or it is short.

    A window is forgiving: what is fitted to a few seconds may be unstable when it acts for longer.

    - `dense`: the file's coefficients were recalibrated.
    """
    log = max(bench.data.logs, key=lambda log: log.duration)
    changed = bool(model.members or terms or dense)
    if log.duration < LEAST or not changed:
        return 1.0
    return _measured_gain(bench, model, changed, terms, log)[0].ratio


def _measured_gain(bench: Workbench, model: Model, changed: bool, terms: Sequence[Placed], test: Log):
    """The gain on the test log of the model and of terms that were learned; `changed`: beside the file."""
    stretches = bench.stretches(model.members, test)
    gates = filled(stretches.gates)
    neutral = np.tile(bench.layout.neutral, (len(gates), 1))
    candidates = [Candidate(bench.vehicle, bench.families, neutral, gates)]
    if changed:
        vehicle = bench.vehicle.place(*terms)
        gates = np.concatenate([gates, np.ones((len(gates), len(terms)))], axis=1)
        theta, phases = bench.theta(model, stretches), bench.phases(model.members)
        candidates.append(Candidate(vehicle, bench.families, theta, gates, phases))
    run_in = min(bench.data.length, max(2.0, test.duration - HORIZON - 2.0))
    times, predicted, measured, begin = predictions(
        candidates,
        test,
        bench.noise,
        run_in,
        bench.split,
        stretches.of_samples[0],
        bench.room,
        bench.slots(0),
    )
    held_out = bench.twin(test) is None
    return gain(times, predicted[0], predicted[-1], measured, begin, bench.noise, held_out)
