"""The whole diagnosis: search, settle, say what is unknown, extend, measure the gain."""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from .._errors import InputError
from .._types import CHANNELS, RATE, SENSORS, VELOCITY
from ..effects import CATALOGUE, AbstractEffect, place
from ..fitting import cut, noise_of
from ..logs import Log, smooth_states
from ..simulation import initial_state, simulate, substeps
from ..vehicle import Damping, Placed, Vehicle
from ._coefficients import settle
from ._gain import HORIZON, Candidate, gain, predictions
from ._knots import Knots, knots, missing_wrench
from ._learn import learn
from ._model import Beginning, Member, Model, Workbench
from ._result import Alternative, Diagnosis, Finding, Parameter, Recalibrated, Verdict, Weighed
from ._saturated import saturate
from ._score import Reduced, solve
from ._search import ROUGH, STEPS, Found, Round, dispersion, needed, penalty, putting_back, search
from ._signals import Signals
from ._unknown import Dependence, cost_of_removal, dependences

WINDOW = 4.0  # [s]
# Statistics over windows need some of them: short logs are cut into shorter windows, down to these.
FEWEST_WINDOWS = 16
SHORTEST = 1.0  # [s]
FEWEST_SAMPLES = 12  # of a window
FEWEST = 6  # windows of a diagnosis
# A member whose removal costs less than this share beside the unknown dependences only stood in for them;
# all of them did where an unknown dependence alone leaves less than this share of what they leave.
STAND_IN = 0.35
# Difference in chi-square per dispersion below which two causes are not told apart (odds of 1 to 20).
CLOSE = 6.0
# Suspects beaten in a round that are weighed once more in the end.
RIVALS = 3

Progress = Callable[[str], None]


def _silent(text: str) -> None:
    del text


# Many small products of matrices: threads of the linear algebra would only wait for one another, on a
# busy machine for several times the work.
@threadpool_limits.wrap(limits=1, user_api="blas")
def diagnose(
    vehicle: Vehicle,
    train: Sequence[Log] | Log,
    test: Log,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    window: float | None = None,
    progress: Progress = _silent,
) -> Diagnosis:
    """Shows what a vehicle gets wrong on its logs, names the cause, extends it and measures the gain.

    - `train`: logs in order of time; `test`: the log on which the gain is measured.
    - `catalogue`: the effects that are suspected; `(*CATALOGUE, YourEffect)` adds one of your own.
    - `window`: length of the windows [s]; default 4 s, less for short logs, more for slow sampling.
    - `progress`: called with a few words at each stage.

    Raises `InputError` where the logs are too short.
    """
    logs = (train,) if isinstance(train, Log) else tuple(train)
    notes = [note for log in (*logs, test) for note in log.notes]
    bench = _workbench(vehicle, logs, catalogue, window)
    if test.duration < HORIZON + 4.0:
        raise InputError(
            f"{test.name}: is shorter than a prediction with its run-in ({HORIZON + 4.0:g} s); "
            "use a longer test log."
        )
    if not (np.isfinite(test.channels).any(axis=0) & np.isfinite(bench.noise)).any():
        raise InputError(
            f"{test.name}: measures nothing that {logs[0].name} measures; use a test log with its channels."
        )
    progress("fitting the vehicle file")
    bench = _rescaled(bench)
    base = bench.refine(bench.start())
    found = search(bench, base, progress)
    progress("settling what was found")
    model, dense = _settled(bench, found)
    now, unknown = _with_unknown(bench, _judged(bench, model), dense, progress)
    start = bench.refine(bench.frozen(bench.start()))
    if now.model.members and not now.white:
        alone = _judged(bench, start)
        left = _dependences(bench, alone, bench.vehicle)
        if _left_over(bench, alone, left) < STAND_IN * _left_over(bench, now, unknown):
            # Nothing that was named is the cause: it only took the shape of what is unknown.
            now, unknown, dense = alone, left, False
    model = now.model

    extended = _extended(bench, model, dense)
    final = Candidate(vehicle, bench.families, bench.theta(model))
    if unknown:
        progress("learning what is missing")
        terms = learn(now.knots, unknown, vehicle.thruster_names)
        placed = tuple(Placed(term, term.target) for term in terms)
        extended = extended.place(*placed)
        final = dataclasses.replace(final, vehicle=vehicle.place(*placed))
    progress("predicting the test log")
    measured = _measured_gain(bench, model, final, test, changed=bool(model.members or unknown))
    findings = _findings(bench, now, found.rounds) + tuple(
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
        recalibrated=_recalibrated(bench, now) if dense else (),
        rounds=tuple(_weighed(bench, one) for one in found.rounds),
        groups=_groups(findings),
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
    length = np.clip(sum(log.duration for log in logs) / FEWEST_WINDOWS, SHORTEST, WINDOW)
    return float(max(length, FEWEST_SAMPLES * dt))


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
    return Workbench(vehicle, families, layout, data, noise, split)


def _rescaled(bench: Workbench) -> Workbench:
    """The workbench with the noise of sensors that the file does not state raised to the residual.

    A filtered measurement looks far less noisy than any model can predict it; weighted by that noise it
    would outweigh all others. From what a channel changes by within a window, which is the most that it
    can be missed by, down to the residual of the file as it is, and of the file recalibrated.
    """
    stated = {channel for kind, _ in bench.vehicle.sensors for channel in SENSORS[kind]}
    free = [i for i, name in enumerate(CHANNELS) if name not in stated and np.isfinite(bench.noise[i])]
    if not free:
        return bench
    own = bench.noise[free]
    seen = np.asarray(bench.data.windows.weight) > 0
    values = np.ma.masked_array(bench.data.windows.measured, ~seen)
    most = np.fmax(own, values.std(axis=1).mean(axis=0).filled(0.0)[free])
    bench = _weighted(bench, free, most)
    for model in (bench.frozen(bench.start()), bench.start()):
        missed = (bench.residual_rms(bench.refine(model)) * bench.noise)[free]
        bench = _weighted(bench, free, np.fmin(most, np.fmax(own, missed)))
    # Such residuals are alike from sample to sample: each weighs as little against the priors as their
    # scores scatter.
    model = bench.refine(bench.start())
    alike = np.sqrt(dispersion(bench, model, bench.screen(model)))
    return _weighted(bench, free, alike * bench.noise[free])


def _weighted(bench: Workbench, channels: list[int], noise: np.ndarray) -> Workbench:
    """The workbench with another noise of some channels."""
    now = bench.noise.copy()
    now[channels] = noise
    windows = bench.data.windows
    weight = np.asarray(windows.weight) * np.nan_to_num(bench.noise / now, nan=1.0)
    windows = dataclasses.replace(windows, weight=jnp.asarray(weight))
    data = dataclasses.replace(bench.data, windows=windows)
    return Workbench(bench.vehicle, bench.families, bench.layout, data, now, bench.split)


# --- settling ------------------------------------------------------------------------------------


def _pruned(bench: Workbench, model: Model, phi: float) -> Model:
    """The model without members that are not needed beside the others."""
    i = 0
    while i < len(model.members):
        less = bench.refine(bench.without_member(model, i))
        if 2 * (less.cost - model.cost) < needed(bench, model.members[i], phi):
            model, i = less, 0
        else:
            i += 1
    return model


def _reweighed(bench: Workbench, model: Model, rounds: Sequence[Round], phi: float) -> Model:
    """Each member against those that it beat in its round, now that the other members are known."""
    if len(model.members) == 1:
        return model
    for i, member in enumerate(model.members):
        trials = [r.trials for r in rounds if r.accepted and r.trials[0].member.suspect == member.suspect]
        for trial in trials[0][1 : 1 + RIVALS] if trials else ():
            if trial.member.suspect in {m.suspect for m in model.members}:
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


@dataclasses.dataclass(frozen=True)
class _Judged:
    """A model with what its residual says.

    - `phi`: dispersion of the windows' scores; `knots`: the missing wrench.
    - `white`: whether only sensor noise is left: its size is right, and the scores scatter like it.
    """

    model: Model
    stats: Reduced
    phi: float
    knots: Knots
    white: bool


def _judged(bench: Workbench, model: Model) -> _Judged:
    stats = bench.screen(model)
    phi = dispersion(bench, model, stats)
    size = 1.0 + 5.0 * np.sqrt(2.0 / bench.samples) + 0.01
    white = bool(stats.chi2.sum() / bench.samples < size and phi < 1.6)
    return _Judged(model, stats, phi, knots(bench, model), white)


def _settled(bench: Workbench, found: Found) -> tuple[Model, bool]:
    """What the search found, without what is not needed, and whether the whole file was recalibrated."""
    phi = dispersion(bench, found.model, found.stats)
    model, dense = settle(bench, _pruned(bench, found.model, phi), phi)
    model = _beginnings_refined(bench, model)
    phi = dispersion(bench, model, bench.screen(model))
    return _pruned(bench, _reweighed(bench, model, found.rounds, phi), phi), dense


# --- what is unknown -----------------------------------------------------------------------------


def _with_unknown(
    bench: Workbench, now: _Judged, dense: bool, progress: Progress
) -> tuple[_Judged, tuple[Dependence, ...]]:
    """What the residual depends on, and the model without members that only stood in for that."""
    while not now.white:
        progress("looking for what the residual depends on")
        unknown = _dependences(bench, now, _extended(bench, now.model, dense))
        spurious = _stand_in(bench, now, unknown)
        if spurious is None:
            return now, unknown
        now = _judged(bench, bench.refine(bench.without_member(now.model, spurious)))
    return now, ()


def _dependences(bench: Workbench, now: _Judged, vehicle: Vehicle) -> tuple[Dependence, ...]:
    return dependences(now.knots, now.phi, _undisturbed(bench, vehicle))


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
    return {name: out[..., i] for i, name in enumerate(names)} if np.isfinite(out).all() else None


def _left_over(bench: Workbench, now: _Judged, unknown: tuple[Dependence, ...]) -> float:
    """Chi-square beyond the noise that a model and unknown dependences leave; infinite without any."""
    if not unknown and not now.model.members:
        return np.inf
    return max(2 * now.model.cost - sum(one.saved for one in unknown) - bench.samples, 0.0)


def _stand_in(bench: Workbench, now: _Judged, unknown: tuple[Dependence, ...]) -> int | None:
    """The member that an unknown dependence replaces best, if one does."""
    if not unknown or not now.model.members:
        return None
    costs = cost_of_removal(now.knots, bench.slices(now.model.members), unknown)
    shares = [beside / max(alone, 1e-9) for alone, beside in costs]
    worst = int(np.argmin(shares))
    return worst if shares[worst] < STAND_IN else None


# --- the answer ----------------------------------------------------------------------------------


def _extended(bench: Workbench, model: Model, dense: bool) -> Vehicle:
    vehicle = bench.vehicle
    if dense:
        change = {
            "added_mass": np.zeros(6),
            "linear_damping": np.zeros(6),
            "quadratic_damping": np.zeros(6),
        }
        for c, z in zip(bench.base, model.z, strict=False):
            change[c.label.split(":")[0]][c.axis] = z
        vehicle = dataclasses.replace(
            vehicle,
            added_mass=vehicle.added_mass + np.diag(change["added_mass"]),
            damping=Damping(
                vehicle.damping.linear + np.diag(change["linear_damping"]),
                vehicle.damping.quadratic + np.diag(change["quadratic_damping"]),
            ),
        )
    placed = []
    for member, where in zip(model.members, bench.slices(model.members), strict=True):
        suspect = bench.layout.suspects[member.suspect]
        values = bench.layout.neutral_of(member.suspect) + model.z[where]
        effect = place(suspect, vehicle, dict(zip(suspect.slots, values.tolist(), strict=True)))
        since = None if member.since is None else member.since.time
        name = None if member.since is None else bench.data.logs[member.since.log].name
        placed.append(Placed(effect, suspect.target, since, name))
    return vehicle.place(*placed) if placed else vehicle


def _covariance(bench: Workbench, now: _Judged) -> np.ndarray:
    """Covariance of z: of the model, or of the windows' own scatter where that disagrees by half."""
    known, precision, _ = bench.known(now.model)
    g = now.stats.g @ known
    h = known.T @ now.stats.h.sum(0) @ known + np.diag(precision)
    inverse = solve(h, np.eye(len(h)))
    scores = (g - g.mean(0)) @ inverse
    model_std = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    scatter_std = np.sqrt((scores**2).sum(0) * len(g) / max(len(g) - 1, 1))
    ratio = scatter_std / np.maximum(model_std, 1e-300)
    factor = np.where((ratio > 0.7) & (ratio < 1.4), 1.0, np.maximum(ratio, 1.0))
    return inverse * np.outer(factor, factor)


def _findings(bench: Workbench, now: _Judged, rounds: Sequence[Round]) -> tuple[Finding, ...]:
    model, phi = now.model, now.phi
    std = np.sqrt(np.diag(_covariance(bench, now)))
    named = {member.suspect for member in model.members}
    out = []
    for i, (member, where) in enumerate(zip(model.members, bench.slices(model.members), strict=True)):
        suspect = bench.layout.suspects[member.suspect]
        values = bench.layout.neutral_of(member.suspect) + model.z[where]
        units = suspect.effect.units
        parameters = {
            name: Parameter(float(value), float(s), units[name])
            for name, value, s in zip(suspect.slots, values, std[where], strict=True)
        }
        without = bench.refine(bench.without_member(model, i), STEPS, ROUGH)
        saved = 2 * (without.cost - model.cost)
        if not np.isfinite(saved):
            # Without it the vehicle cannot be simulated along the log: the linearisation still tells.
            saved = float(putting_back(bench, model, now.stats, where).sum())
        evidence = 0.5 * (saved / phi - penalty(bench, member))
        since = member.since
        out.append(
            Finding(
                effect=suspect.effect.name,
                target=suspect.target,
                since=None if since is None else since.time,
                since_log=None if since is None else bench.data.logs[since.log].name,
                parameters=parameters,
                log_evidence=float(evidence),
                alternatives=_alternatives(bench, member, named, phi, rounds, float(evidence)),
            )
        )
    return tuple(out)


def _alternatives(
    bench: Workbench, member: Member, named: set[int], phi: float, rounds: Sequence[Round], evidence: float
) -> tuple[Alternative, ...]:
    """What else was weighed in the round in which the member was taken, less what is named itself."""
    pairs = [
        (r.trials, t) for r in rounds if r.accepted for t in r.trials if t.member.suspect == member.suspect
    ]
    if not pairs:
        return ()
    # The round that it won, if it did not join in the place of that round's winner.
    trials, own = next((pair for pair in pairs if pair[0][0] is pair[1]), pairs[0])
    out, said = [], set(named)
    for trial in trials:
        suspect = bench.layout.suspects[trial.member.suspect]
        if trial.member.suspect in said:
            continue
        said.add(trial.member.suspect)
        behind = 0.5 * (
            (own.saved - trial.saved) / phi + penalty(bench, trial.member) - penalty(bench, own.member)
        )
        close = 2 * behind < CLOSE
        out.append(Alternative(suspect.effect.name, suspect.target, evidence - float(behind), bool(close)))
    close = [a for a in out if a.indistinguishable][:2]
    return tuple(close + [a for a in out if a not in close and not a.indistinguishable][:4])


def _groups(findings: Sequence[Finding]) -> tuple[tuple[str, ...], ...]:
    out = []
    for finding in findings:
        same = [
            a.effect if a.target is None else f"{a.effect}:{a.target}"
            for a in finding.alternatives
            if a.indistinguishable
        ]
        if same:
            out.append((finding.label, *same))
    return tuple(out)


def _weighed(bench: Workbench, one: Round) -> tuple[Weighed, ...]:
    out = []
    for trial in one.trials:
        since = trial.member.since
        out.append(
            Weighed(
                label=bench.layout.suspects[trial.member.suspect].label,
                log_evidence=float(0.5 * (trial.saved / one.phi - penalty(bench, trial.member))),
                saved_chi2=float(trial.saved),
                parameters=trial.parameters(bench),
                since=None if since is None else since.time,
            )
        )
    return tuple(out)


def _recalibrated(bench: Workbench, now: _Judged) -> tuple[Recalibrated, ...]:
    std = np.sqrt(np.diag(_covariance(bench, now)))
    taken = {bench.layout.suspects[m.suspect].label for m in now.model.members}
    return tuple(
        Recalibrated(c.label, c.value, c.value + float(z), float(s), c.unit)
        for c, z, s in zip(bench.base, now.model.z, std, strict=False)
        if c.label not in taken
    )


def _same(a: Log, b: Log) -> bool:
    return a.channels.shape == b.channels.shape and bool(
        np.array_equal(a.channels, b.channels, equal_nan=True)
    )


def _measured_gain(bench: Workbench, model: Model, final: Candidate, test: Log, changed: bool):
    """The gain on the test log, which comes last in time; unless it is a training log itself."""
    logs = bench.data.logs
    twin = next((i for i, log in enumerate(logs) if _same(log, test)), None)
    passed = bench.passed(model.members, test, len(logs) if twin is None else twin)
    segments = final.theta.shape[0]
    before = Candidate(bench.vehicle, bench.families, np.tile(bench.layout.neutral, (segments, 1)))
    run_in = min(bench.data.length, max(2.0, test.duration - HORIZON - 2.0))
    candidates = [before, final] if changed else [before]
    times, predicted, measured, begin = predictions(
        candidates, test, bench.noise, run_in, bench.split, passed, bench.room
    )
    return gain(times, predicted[0], predicted[-1], measured, begin, bench.noise, twin is None)
