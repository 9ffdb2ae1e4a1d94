"""What a log can tell: how strongly it moves each axis, and which coefficients that determines.

The information matrix of one linearisation at the vehicle file stands for all fits of the log: nothing is
fitted but the windows' initial states.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._errors import InputError, runaway
from .._precision import need_double
from .._types import DOFS
from ..logs import Log
from ..simulation import substeps
from ..vehicle import Vehicle, reach
from ._advice import MEND, advice
from ._coverage import AxisCoverage, coverage
from ._estimate import Units
from ._free import set_free
from ._gross import gross_errors
from ._noise import noise_of
from ._review import reviewed
from ._rollout import predict
from ._solver import Refined, Task, refine_windows
from ._trajectory import FINE, ROUGH, segments, spurious, window_task
from ._uncertainty import UNDETERMINED, Combination, named
from ._weights import largest, overdispersion, scaled
from ._windows import cut

# Standard error, relative to the typical size, from which a number counts as not determined.
KNOWN = UNDETERMINED**-0.5
# Least eigenvalue of the scaled information: errors of more than a hundred sizes are all the same.
_FLOOR = 1e-4
# Precision of coefficients that are held, in units of their typical size.
_HELD = 1e12

Kind = Literal["added_mass", "damping.linear", "damping.quadratic"]
_KINDS: tuple[Kind, ...] = ("added_mass", "damping.linear", "damping.quadratic")
_BARS = " ▁▂▃▄▅▆▇█"
# Lines of undetermined combinations that a printed check shows.
_SHOWN = 3


@dataclasses.dataclass(frozen=True)
class Coefficient:
    """A diagonal coefficient of the vehicle file, and its standard error if this log were fitted.

    `size` is what the error is judged by: the value, of added mass the whole inertia of the axis, and where
    the file says zero a typical one. `value`, `std` and `size` in SI units.
    """

    name: str  # such as damping.linear[surge]
    kind: Kind
    dof: str
    value: float
    size: float
    std: float

    @property
    def relative(self) -> float:
        """Standard error over typical size."""
        return self.std / self.size

    @property
    def determined(self) -> bool:
        """Whether the standard error is below a third of the typical size."""
        return self.relative < KNOWN


@dataclasses.dataclass(frozen=True)
class AxisCheck:
    """What a log tells of one axis.

    - `coverage`: velocities and accelerations seen.
    - `inertia`, `linear`, `quadratic`: relative standard errors of the axis' coefficients.
    - `damping`: that of the whole damping force at the axis' root-mean-square velocity.
    - `scatter`: how much more than by sensor noise a fit of this file would scatter from window to window;
      about 1 where the file explains the log, more where it misses something: errors grow by as much.
    - `driven`: whether a thruster acts along the axis (always, where the log has a wrench).
    """

    dof: str
    coverage: AxisCoverage
    inertia: float
    linear: float
    quadratic: float
    damping: float
    scatter: float
    driven: bool

    @property
    def excited(self) -> Literal["yes", "partly", "no"]:
        """`no`: neither inertia nor damping force is known to a third; `yes`: every coefficient is."""
        if min(self.inertia, self.damping) >= KNOWN:
            return "no"
        return "yes" if max(self.inertia, self.linear, self.quadratic) < KNOWN else "partly"


@dataclasses.dataclass(frozen=True, repr=False)
class Check:
    """What logs can tell of a vehicle. `print(check)` shows the table and what to do next.

    - `axes`: per free axis the motion seen, and how well it determines the axis.
    - `coefficients`: added mass, linear and quadratic damping of each axis (diagonal) with the standard
      errors that a fit of all of them together would have, thrust taken as known and the model as right.
    - `information` [coefficients]: eigenvalues of the information in units of typical sizes, rising;
      `undetermined`: the combinations below 9, whose standard error is above a third.
    - `misfit`: chi-square per sample of the file, 1 for noise alone.
    - `advice`: what to do next, sentence by sentence.
    - `logs`: their names; `duration` [s]; `windows` of the length `window` [s].
    - `notes`: what was found in the logs, accidents that were left out and clocks that differ.
    - `gross`: what is grossly wrong, such as columns that are exchanged or sensors that contradict one
      another: to be mended before anything else is believed.
    """

    vehicle: str
    logs: tuple[str, ...]
    duration: float
    windows: int
    window: float
    axes: tuple[AxisCheck, ...]
    coefficients: tuple[Coefficient, ...]
    information: Float[np.ndarray, " coefficients"]
    undetermined: tuple[Combination, ...]
    misfit: float
    advice: tuple[str, ...]
    notes: tuple[str, ...] = ()
    gross: tuple[str, ...] = ()

    def __getitem__(self, dof: str) -> AxisCheck:
        """The axis of that name, such as `pitch`."""
        return {axis.dof: axis for axis in self.axes}[dof]

    def __repr__(self) -> str:
        determined = sum(c.determined for c in self.coefficients)
        logs = ", ".join(self.logs) if len(self.logs) < 3 else f"{len(self.logs)} logs"
        head = (
            f"What {logs} can tell of {self.vehicle}: {determined} of "
            f"{len(self.coefficients)} coefficients ({self.duration:.0f} s, {self.windows} windows of "
            f"{self.window:g} s)"
        )
        lines = [f"first: {one}" for one in self.gross] + ([""] if self.gross else [])
        lines += [head, "", *_table(self.axes), ""]
        lines += [f"not determined by the data: {one}" for one in self.undetermined[:_SHOWN]]
        more = len(self.undetermined) - _SHOWN
        lines += [f"... and {more} more such combinations"] if more > 0 else []
        lines += [f"note: {note}" for note in self.notes]
        lines += [f"next: {sentence}" for sentence in self.advice]
        return "\n".join(lines)


def check(vehicle: Vehicle, logs: Log | Sequence[Log], *, window: float = 4.0) -> Check:
    """How strongly and where logs excite a vehicle, which coefficients they determine, what to do next.

    After the thesis, sec. 5.3, which recommends tools that evaluate a data set.

    - `logs`: one or several, in the order in which they were recorded.
    - `window` [s]: length of the windows, as in `fit`.

    A coefficient counts as determined where the standard error that a fit of all diagonal added masses and
    dampings would give it is below a third of its typical size; an axis as not excited where neither its
    inertia nor its damping force is. Information that only the noise in the initial states pretends is left
    out. Sensors whose noise the vehicle does not state are taken to be no better than the file predicts them
    in the median window, so that filtered measurements do not seem to tell everything. Raises
    `InputError` where the logs are shorter than two windows.
    """
    logs = (logs,) if isinstance(logs, Log) else tuple(logs)
    if not logs:
        raise InputError("A check needs at least one log.")
    need_double("A check")
    gross = tuple(one.told for one in gross_errors(vehicle, logs))
    logs, notes = reviewed(vehicle, logs)
    freed, scales = _diagonals(vehicle)
    acting = segments(vehicle, logs)
    noise = noise_of(vehicle, logs)
    data = cut(vehicle, logs, noise, window, segments=acting.of_samples)
    split = substeps(vehicle, data.hold)
    count = len(freed.names)
    units = Units(np.eye(count), _HELD / scales.size**2, np.ones(count, bool))
    task = window_task(freed, units, data, acting, split, False, data.speeds)
    estimated = np.isfinite(noise) & ~vehicle.states_noise(len(noise))
    weighed = _Weighed(task, estimated, logs[0].dt)
    begin = jnp.zeros(count), jnp.zeros((data.windows.count, 12))
    # As roughly as a fit solves before it weighs, where other weights follow.
    refined = refine_windows(weighed.at_first(), *begin, rtol=ROUGH if estimated.any() else FINE)
    if np.isfinite(refined.cost) and estimated.any():
        task = weighed.after(refined)
        refined = refine_windows(task, refined.z, refined.delta)
    if not np.isfinite(refined.cost):
        raise runaway(logs[0].name, vehicle.name)
    found = evaluated(vehicle, logs, task, refined, freed.names, window)
    return dataclasses.replace(found, notes=notes, gross=gross, advice=(MEND,) if gross else found.advice)


def evaluated(
    vehicle: Vehicle, logs: Sequence[Log], task: Task, refined: Refined, names: Sequence[str], window: float
) -> Check:
    """The check from windows whose initial states are fitted already.

    - `names`: of the first z of the task, each a diagonal coefficient in its own units (`coefficient_name`);
      an axis is judged where all three of its coefficients are among them.
    """
    chi2, scores, information = (np.asarray(a) for a in refined.stats.reduced())
    weight = np.asarray(task.problem.windows.weight) > 0
    used = weight.any(axis=(1, 2))
    freed, scales = _diagonals(vehicle)
    places = [freed.names.index(name) for name in names]
    size, value = scales.size[places], np.asarray(freed.start)[places]
    n = len(names)
    outer = np.outer(size, size)
    there = information.sum(0)[:n, :n] * outer
    eigenvalues, vectors = np.linalg.eigh(there - spurious(task, refined)[:n, :n] * outer)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    covariance = (vectors / np.maximum(eigenvalues, _FLOOR)) @ vectors.T
    scatter = _scatter(scores[used, :n] * size, there)
    coefficients = tuple(
        Coefficient(name, kind, dof, float(v), float(s), float(s * np.sqrt(c)))
        for name, (kind, dof), v, s, c in zip(
            names, map(_parts, names), value, size, np.diag(covariance), strict=True
        )
    )
    axes = tuple(
        _axis(one, coefficients, covariance, scatter, _driven(vehicle, logs, one.dof))
        for one in coverage(logs, vehicle.dof)
        if sum(c.dof == one.dof for c in coefficients) == len(_KINDS)
    )
    misfit = float(chi2[used].sum() / weight.sum())
    return Check(
        vehicle=vehicle.name,
        logs=tuple(log.name for log in logs),
        duration=sum(log.duration for log in logs),
        windows=int(used.sum()),
        window=window,
        axes=axes,
        coefficients=coefficients,
        information=eigenvalues,
        undetermined=tuple(
            Combination(float(one), named(tuple(names), vector))
            for one, vector in zip(eigenvalues, vectors.T, strict=True)
            if one < UNDETERMINED
        ),
        misfit=misfit,
        advice=advice(axes, KNOWN, bool(vehicle.prior)),
    )


class _Weighed:
    """A task with the noise of some channels raised, as a fit weighs them.

    `at_first` to what a channel changes by: under the jitter of an estimator's output alone, initial states
    are pulled beyond where a linearisation holds. `after` a solve to what the file leaves in it.
    """

    def __init__(self, task: Task, channels: np.ndarray, dt: float):
        self.task, self.channels, self.dt = task, channels, dt
        self.own = np.asarray(task.problem.windows.weight)
        self.most = largest(np.asarray(task.problem.windows.measured), self.own)

    def at_first(self) -> Task:
        return self._raised(self.most)

    def after(self, refined: Refined) -> Task:
        residual = predict(self.task.problem, self.task.affine.theta, refined.delta)[1]
        return self._raised(overdispersion(residual, self.own, self.most))

    def _raised(self, factor: np.ndarray) -> Task:
        return self.task.weighed(scaled(self.own, np.where(self.channels, factor, 1.0), self.dt))


def coefficient_name(kind: str, dof: str) -> str:
    """`damping.linear[surge]`: the name of a diagonal coefficient, as a fit calls it."""
    return f"{kind}[{dof}]"


def _parts(name: str) -> tuple[Kind, str]:
    kind, _, dof = name.removesuffix("]").partition("[")
    return next(k for k in _KINDS if k == kind), dof


def _diagonals(vehicle: Vehicle):
    """The diagonal coefficients as raw numbers in their own units, and their typical sizes."""
    return set_free(
        vehicle,
        lambda v: (v.added_mass, v.damping.linear, v.damping.quadratic),
        entries="diagonal",
        linear=True,
    )


def _scatter(scores: np.ndarray, information: np.ndarray) -> Float[np.ndarray, " coefficients"]:
    """Standard error by the scatter of the windows' scores over the one by the information.

    The scores' mean is what a fit would remove (to first order), their scatter is what it would leave.
    """
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    steps = (scores - scores.mean(0)) @ inverse
    variance = (steps**2).sum(0) * len(steps) / max(len(steps) - 1, 1)
    return np.sqrt(variance / np.maximum(np.diag(inverse), np.finfo(float).tiny))


def _axis(
    seen: AxisCoverage,
    coefficients: Sequence[Coefficient],
    covariance: np.ndarray,
    scatter: np.ndarray,
    driven: bool,
) -> AxisCheck:
    inertia, linear, quadratic = own = [
        next(i for i, c in enumerate(coefficients) if (c.kind, c.dof) == (kind, seen.dof)) for kind in _KINDS
    ]
    # Damping force per velocity at the root-mean-square velocity, as shares of its two parts.
    shares = np.zeros(len(coefficients))
    shares[linear] = coefficients[linear].size
    shares[quadratic] = coefficients[quadratic].size * seen.velocity_rms
    shares /= shares.sum()
    determined = [i for i in own if coefficients[i].determined]
    return AxisCheck(
        dof=seen.dof,
        coverage=seen,
        inertia=coefficients[inertia].relative,
        linear=coefficients[linear].relative,
        quadratic=coefficients[quadratic].relative,
        damping=float(np.sqrt(shares @ covariance @ shares)),
        scatter=float(np.median(scatter[determined])) if determined else 1.0,
        driven=driven,
    )


def _driven(vehicle: Vehicle, logs: Sequence[Log], dof: str) -> bool:
    if any(log.wrench is not None for log in logs):
        return True
    pushes = np.abs(np.asarray(vehicle.plant().allocation)) * np.asarray(vehicle.thrusters.max_thrust)
    if reach(vehicle.plant())[DOFS.index(dof)] > 0.0:
        return True
    # Directions in a file are rounded.
    return bool(pushes[DOFS.index(dof)].max(initial=0.0) > 1e-3 * pushes.max(initial=0.0))


def sparkline(shares: Sequence[float]) -> str:
    """Time spent in equal parts of a range, as bars."""
    most = max(shares)
    return "".join(_BARS[int(np.ceil(share / most * (len(_BARS) - 1)))] for share in shares)


def percent(relative: float) -> str:
    """A relative standard error for a table."""
    return f"{100 * relative:.2g} %" if relative < 1 else "> 100 %"


def _table(axes: Sequence[AxisCheck]) -> list[str]:
    seen = []
    for axis in axes:
        low, high = axis.coverage.velocity_range
        bars = sparkline(axis.coverage.velocity_shares)
        seen.append(f"{low:>8.2g} {bars} {high:<7.2g} rms {axis.coverage.velocity_rms:.2g}")
    title = "velocity seen (m/s, rad/s)"
    width = max(map(len, [title, *seen]))
    head = f"{'axis':<6} {title:<{width}} {'inertia':>8} {'damping':>8} "
    head += f"{'linear':>8} {'quadr.':>8} {'scatter':>8}  excited"
    rows = []
    for axis, moved in zip(axes, seen, strict=True):
        errors = (axis.inertia, axis.damping, axis.linear, axis.quadratic)
        cells = [*(f"{percent(e):>8}" for e in errors), f"{axis.scatter:>8.2g}"]
        rows.append(f"{axis.dof:<6} {moved:<{width}} {' '.join(cells)}  {axis.excited}")
    return [head, "-" * len(head), *rows]
