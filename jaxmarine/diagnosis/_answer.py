"""From the settled model to the answer: extended vehicle, findings, what could not be told apart."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects import place
from ..fitting import with_swell
from ..vehicle import Placed, Vehicle
from ._amid import price, widened
from ._climb import climbed
from ._couplings import couplings
from ._explanation import Member, Model
from ._filed import refiled
from ._judge import Judged
from ._result import Alternative, Finding, Parameter, Recalibrated, Weighed
from ._score import lasting, root, solve
from ._search import STEPS, Round, evidence, putting_back
from ._workbench import EXACT, ROUGH, Workbench

# Causes listed beside a finding that may be marked as no worse, and others; the report shows its whole round.
MOST_CLOSE, OTHERS = 2, 4
# By what share evidence may be too large: it is compared in nats, and hundreds of them are as sure as can be.
SHOWN = 0.01
# Standard errors by the scatter of some tens of windows are so much larger than true ones at times.
BY_CHANCE = 1.4


def extended_by(bench: Workbench, model: Model, dense: bool) -> Vehicle:
    """The vehicle with the members placed in it and, where `dense`, its coefficients recalibrated."""
    vehicle = bench.vehicle
    if dense:
        vehicle = refiled(vehicle, bench.base, model.z[: len(bench.base)])
    placed = []
    for member, where in zip(model.members, bench.slices(model.members), strict=True):
        suspect = bench.layout.suspects[member.suspect]
        effect = place(suspect, vehicle, _stated(bench, member, model.z[where]))
        placed.append(Placed(effect, suspect.target, *_since(bench, member)))
    return vehicle.place(*placed) if placed else vehicle


def _since(bench: Workbench, member: Member) -> tuple[float | None, str | None]:
    """Since when a member acts [s], and of which log; None: always."""
    begins = member.since
    return (None, None) if begins is None else (begins.time, bench.data.logs[begins.log].name)


def _stated(bench: Workbench, member: Member, z: np.ndarray) -> dict[str, float]:
    """A member's parameters, phases in (-pi/2, pi/2]: half a turn more is an amplitude of the other sign."""
    effect = bench.layout.suspects[member.suspect].effect
    values = bench.layout.values(member.suspect, z)
    for phase in effect.phases:
        turns = math.ceil(values[phase] / math.pi - 0.5)
        values[phase] -= turns * math.pi
        for name in effect.amplitudes:
            values[name] *= (-1) ** turns
    return values


def spread(
    g: Float[np.ndarray, "windows z"],
    h: Float[np.ndarray, "z z"],
    precision: Float[np.ndarray, " z"],
    off: Float[np.ndarray, " z"],
    white: bool,
) -> Float[np.ndarray, "z z"]:
    """Covariance of z, by what noise makes of the windows and by what the file is off.

    - Noise as stated, or the windows' own scatter: where that is larger than by chance, and wherever more is
      left than sensor noise (not `white`).
    - The file's coefficients are pulled back to what is filed: z ends short by that pull times what the file
      is `off` by, zero where nothing is pulled. However heavy the prior is, it makes nothing better known.
    """
    inverse = solve(h + np.diag(precision), np.eye(len(h)))
    half = inverse @ root(h)
    by_noise = half @ half.T
    ratio = np.sqrt(len(g) * lasting(g @ inverse) / np.maximum(np.diag(by_noise), 1e-300))
    factor = np.where(white & (ratio < BY_CHANCE), 1.0, np.maximum(ratio, 1.0))
    pull = inverse * (precision * off)
    return by_noise * np.outer(factor, factor) + pull @ pull.T


def _covariance(bench: Workbench, now: Judged, dense: bool) -> np.ndarray:
    """Covariance of z; where more is left than sensor noise, with what the coefficients of the file that are
    held may be off by."""
    known, precision, _ = bench.known(now.model)
    priors, bends = np.array([c.prior for c in bench.base]), ~bench.held(now.model)
    off = np.zeros(len(precision))
    off[: len(priors)] = astray_by(bench, now.model) * priors * bends
    h = known.T @ now.stats.h.sum(0) @ known
    covariance = spread(now.stats.g @ known, h, precision, off, now.white)
    return covariance if now.white else covariance + _considered(bench, now, dense)


def _considered(bench: Workbench, now: Judged, dense: bool) -> np.ndarray:
    """What coefficients that stay as filed, but may be off, add to the covariance of z.

    They are considered, not estimated (Schmidt 1966): the terms off the diagonals, and those on them unless
    they were recalibrated (`dense`). z is off by `shift` times what they are off by, of which prior and logs
    say a mean and a covariance.
    """
    count = len(bench.base)
    times, share = astray_by(bench, now.model), wrong_by(bench, now.model)
    g, h = now.knots.summed(couplings(bench.vehicle, now.knots.places))
    width = now.knots.width
    filed = [] if dense else np.flatnonzero(~bench.stood_for(now.model))
    estimated = np.arange(0 if dense else count, width)
    doubted = np.array([*filed, *range(width, len(h))], dtype=int)
    size = np.array([*(times * bench.base[j].prior for j in filed), *np.full(len(h) - width, share)])
    across = h[np.ix_(estimated, doubted)] * size
    shift = solve(h[np.ix_(estimated, estimated)] + np.diag(now.knots.precision[estimated]), across)
    told = size[:, None] * h[np.ix_(doubted, doubted)] * size - across.T @ shift
    # What is held has its gradient from the logs alone: its prior would hide that.
    pulled = g[estimated] + (now.knots.precision * now.knots.offset)[estimated]
    slope = size * g[doubted] - shift.T @ pulled
    half = root(told / now.phi)
    covariance = np.linalg.inv(half @ half.T + np.eye(len(told)))
    mean = -covariance @ slope / now.phi
    out = np.zeros((width, width))
    out[np.ix_(estimated, estimated)] = shift @ (covariance + np.outer(mean, mean)) @ shift.T
    return out


def wrong_by(bench: Workbench, model: Model) -> float:
    """By what share the coefficients of the file are off."""
    return bench.criteria.file_error * astray_by(bench, model)


def astray_by(bench: Workbench, model: Model) -> float:
    """How many times their prior the coefficients of the file are off, by the spread of recalibrated ones."""
    shares = [abs(z) / c.prior for c, z in zip(bench.base, model.z, strict=False) if c.value]
    return max(1.0, 1.48 * float(np.median(shares)) if shares else 0.0)


def standard_errors(bench: Workbench, now: Judged, dense: bool) -> Float[np.ndarray, " z"]:
    """Of z; `dense`: the file's coefficients were recalibrated."""
    return np.sqrt(np.diag(_covariance(bench, now, dense)))


def findings_of(
    bench: Workbench, now: Judged, rounds: Sequence[Round], std: Float[np.ndarray, " z"]
) -> tuple[Finding, ...]:
    """Each member with its parameters, its evidence beside the others, and what else it could be."""
    model, phi = now.model, now.phi
    named = {member.suspect for member in model.members}
    out = []
    for i, (member, where) in enumerate(zip(model.members, bench.slices(model.members), strict=True)):
        suspect = bench.layout.suspects[member.suspect]
        values = _stated(bench, member, model.z[where])
        parameters = {
            name: Parameter(value, float(s), suspect.effect.units[name])
            for (name, value), s in zip(values.items(), std[where], strict=True)
        }
        own = evidence(bench, member, _saved_by(bench, now, i, where), phi)
        since, since_log = _since(bench, member)
        out.append(
            Finding(
                effect=suspect.effect.name,
                target=suspect.target,
                since=since,
                since_log=since_log,
                parameters=parameters,
                log_evidence=own,
                alternatives=alternatives(bench, member, named, phi, rounds, own),
            )
        )
    return tuple(out)


def _saved_by(bench: Workbench, now: Judged, which: int, where: slice) -> float:
    """Chi-square that a member saves beside all others; `where`: its parameters in z."""
    model = now.model
    without = bench.likeliest(bench.without_member(model, which), STEPS, ROUGH)
    left = ROUGH * max(bench.samples, 2 * without.cost)
    if model.beside is not None and left > SHOWN * (without.cost - model.cost):
        # What is left to gain would count as evidence.
        without = bench.likeliest(without, STEPS, EXACT)
    without = climbed(bench, without, STEPS, ROUGH)
    if bench.layout.suspects[model.members[which].suspect].effect.swings:
        without = _swelling(bench, without)
    saved = 2 * (without.cost + price(bench, without) - model.cost - price(bench, model))
    if np.isfinite(saved):
        return saved
    # Without it the vehicle cannot be simulated along the log: the linearisation still tells.
    return float(putting_back(bench, model, now.stats, where).sum())


def _swelling(bench: Workbench, model: Model) -> Model:
    """The model beside a swell, which stands for what swings, if it is likelier so than without one."""
    if model.beside is None or model.beside.force.swells or not np.isfinite(model.cost):
        return model
    wider = widened(bench, model, with_swell)
    return min(model, wider, key=lambda one: one.cost + price(bench, one))


def alternatives(
    bench: Workbench, member: Member, named: set[int], phi: float, rounds: Sequence[Round], beside: float
) -> tuple[Alternative, ...]:
    """What else was weighed in the round in which the member was taken, less what is named itself.

    - `beside`: the member's evidence beside all others; those of the round are shifted to it.
    """
    pairs = [
        (r.trials, t) for r in rounds if r.accepted for t in r.trials if t.member.suspect == member.suspect
    ]
    if not pairs:
        return ()
    # The round that it won, if it did not join in the place of that round's winner.
    trials, own = next((pair for pair in pairs if pair[0][0] is pair[1]), pairs[0])
    won = evidence(bench, own.member, own.saved, phi)
    out, said = [], set(named)
    for trial in trials:
        suspect = bench.layout.suspects[trial.member.suspect]
        if trial.member.suspect in said:
            continue
        said.add(trial.member.suspect)
        behind = won - evidence(bench, trial.member, trial.saved, phi)
        # No more than some are said to be as good as the finding: a list of all would say nothing.
        close = behind < bench.criteria.close and sum(a.indistinguishable for a in out) < MOST_CLOSE
        out.append(Alternative(suspect.effect.name, suspect.target, beside - behind, close))
    out.sort(key=lambda a: not a.indistinguishable)
    return tuple(out[: MOST_CLOSE + OTHERS])


def groups(findings: Sequence[Finding]) -> tuple[tuple[str, ...], ...]:
    """Labels that the logs cannot tell apart, each group with its finding first."""
    out = []
    for finding in findings:
        same = [a.label for a in finding.alternatives if a.indistinguishable]
        if same:
            out.append((finding.label, *same))
    return tuple(out)


def weighed(bench: Workbench, one: Round) -> tuple[Weighed, ...]:
    """A round's ranking for the report."""
    out = []
    for trial in one.trials:
        since, since_log = _since(bench, trial.member)
        out.append(
            Weighed(
                label=bench.layout.suspects[trial.member.suspect].label,
                log_evidence=evidence(bench, trial.member, trial.saved, one.phi),
                saved_chi2=float(trial.saved),
                parameters=trial.parameters(bench),
                since=since,
                since_log=since_log,
            )
        )
    return tuple(out)


def recalibrated(bench: Workbench, now: Judged, std: Float[np.ndarray, " z"]) -> tuple[Recalibrated, ...]:
    """The file's coefficients that no member stands for, with what they were refitted to."""
    taken = bench.stood_for(now.model)
    return tuple(
        Recalibrated(c.label, c.value, c.value + float(z), float(s), c.unit)
        for c, z, s, stood_for in zip(bench.base, now.model.z, std, taken, strict=False)
        if not stood_for
    )
