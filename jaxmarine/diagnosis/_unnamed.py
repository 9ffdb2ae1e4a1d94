"""What names cannot explain: unknown dependences beside named members, or in the place of all of them."""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float

from .._progress import LOOKING, Progress
from .._types import RATE, VELOCITY
from ..logs import Log, smooth_states
from ..simulation import initial_state, simulate
from ..vehicle import Vehicle
from ._amid import refine_fully
from ._answer import extended_by, wrong_by
from ._couplings import couplings
from ._dropped import STOOD_IN, gone, needless
from ._explanation import Beside, Model
from ._judge import Judged, judged
from ._knots import Knots
from ._result import Dropped
from ._score import Reduced, rows, totals
from ._search import dispersion, mean_dispersion, nats, needed
from ._settle import pruned
from ._signals import Signals, samples_at
from ._unknown import (
    Dependence,
    acting,
    as_given,
    cost_of_removal,
    dependences,
    likely,
    nats_beside,
    size_only,
)
from ._workbench import Workbench


@dataclasses.dataclass(frozen=True)
class Answer:
    """What the logs are explained by: a judged model and unknown dependences.

    - `dense`: the file's coefficients were recalibrated.
    - `dropped`: what was found on the way and does not stand in it.
    """

    judged: Judged
    unknown: tuple[Dependence, ...]
    dense: bool
    dropped: tuple[Dropped, ...] = ()

    @property
    def model(self) -> Model:
        return self.judged.model

    @property
    def changed(self) -> bool:
        """Whether something of the file is changed by it, before anything unknown is learned."""
        return bool(self.model.members) or self.dense


def with_unknown(
    bench: Workbench,
    now: Judged,
    dense: bool,
    progress: Progress,
    of_file: Callable[[], Sequence[Dependence]] = tuple,
) -> Answer:
    """What the residual depends on, and the model without members that only stood in for that.

    - `of_file`: of a file that was refitted what it depends on as filed, which is tried beside a disturbance
      too: the refit has followed that, and little of it is left to see.
    """
    dropped: tuple[Dropped, ...] = ()
    while not now.white:
        progress(LOOKING)
        vehicle = extended_by(bench, now.model, dense)
        now, unknown = _dependences(bench, now, vehicle, of_file)
        if not (unknown or now.model.members or dense):
            unknown = size_only(
                now.left, now.phi, _undisturbed(bench, vehicle), bench.freedom, bench.criteria
            )
        spurious = _stand_in(bench, now, unknown)
        if spurious is None:
            return Answer(now, unknown, dense, dropped)
        whole, now = now.model, judged(bench, bench.likeliest(bench.without_member(now.model, spurious)))
        # What was found beside a stand-in may have mended what that spoilt.
        model = pruned(bench, now.model)
        dropped += gone(bench, whole, now.model, STOOD_IN) + needless(bench, now.model, model)
        if model is not now.model:
            now = judged(bench, model)
    return Answer(now, (), dense, dropped)


def _dependences(
    bench: Workbench, now: Judged, vehicle: Vehicle, of_file: Callable[[], Sequence[Dependence]] = tuple
) -> tuple[Judged, tuple[Dependence, ...]]:
    """On what the residual depends, and what was judged, amid the disturbance that suits the logs then."""
    # Coefficients of the file may be off before anything is unknown: coupling terms, which no refit has
    # touched, and beside named causes those that were held to name them.
    held = now.model.frozen and not now.model.members
    _, precision, _ = bench.known(dataclasses.replace(now.model, frozen=held))
    missing = dataclasses.replace(now.knots, precision=precision)
    bent = missing.beside(couplings(bench.vehicle, now.knots.places), wrong_by(bench, now.model))
    undisturbed, criteria = _undisturbed(bench, vehicle), bench.criteria
    found = dependences(bent, now.plain_phi, undisturbed, bench.freedom, criteria)
    if now.model.beside is None:
        return now, found
    met = {(one.axis, one.signals) for one in found}
    proposed = (*found, *(one for one in of_file() if (one.axis, one.signals) not in met))
    found, left = likely(dataclasses.replace(now.left, precision=precision), proposed, criteria)
    return dataclasses.replace(now, left=dataclasses.replace(left, precision=now.left.precision)), found


def _undisturbed(bench: Workbench, vehicle: Vehicle) -> Signals | None:
    """Velocities at the knots as simulated from the commands over whole logs, None where that fails."""
    places = bench.places
    longest = max(len(log.t) for log in bench.data.logs)
    out = np.concatenate(bench.keeper.each(bench, _simulated, vehicle, longest))
    names = (*VELOCITY, *RATE)
    if not np.isfinite(out).all():
        return None
    over_ground = {name: out[..., i] for i, name in enumerate(names)}
    return places.through_water(np.asarray(vehicle.plant().water), over_ground)


def _simulated(bench: Workbench, vehicle: Vehicle, longest: int) -> Float[np.ndarray, "windows knots 6"]:
    """Velocities [m/s, rad/s] at the knots of the logs that lie here.

    - `longest`: samples of the longest of all logs.
    """
    logs, number = bench.data.logs, np.asarray(bench.cut.windows.log)
    sample = samples_at(bench.cut, bench.knots)
    out = np.zeros((*sample.shape, 6))
    for i, log in enumerate(logs):
        track = smooth_states(log, vehicle.dof)
        start = initial_state(vehicle, track.position[0], track.attitude[0], track.nu[0])
        later = {*(other.name for other in logs[i + 1 :]), *bench.part.later}
        begun = tuple(p for p in vehicle.placed if p.since is None or p.since_log not in later)
        # All as long as the longest, or each would compile a program of its own.
        run = simulate(dataclasses.replace(vehicle, placed=begun), _going_on(log, longest), start)
        out[number == i] = np.asarray(run.states.velocity)[sample[number == i]]
    return out


def _going_on(log: Log, samples: int) -> Log:
    """A log that goes on as its last sample was, until it has so many."""
    more = samples - len(log.t)
    longer = jax.tree.map(lambda a: np.pad(a, [(0, more)] + [(0, 0)] * (a.ndim - 1), mode="edge"), log)
    after = log.t[-1] + log.dt * np.arange(1, more + 1)
    return dataclasses.replace(longer, t=np.concatenate([log.t, after]))


class Unnamed:
    """The vehicle file with nothing but unknown dependences: what any names have to do better than.

    Where they do not, nothing that was named or recalibrated is the cause: it took the shape of what is
    unknown. All is computed when it is first asked for.

    - `beside`: a disturbance from which its own is estimated, None where it is judged beside white noise.
    """

    def __init__(self, bench: Workbench, beside: Beside | None = None):
        self.bench, self.beside = bench, beside

    @functools.cached_property
    def start(self) -> Model:
        return self.bench.refine(self.bench.frozen(self.bench.start()))

    @functools.cached_property
    def judged(self) -> Judged:
        bench, start = self.bench, self.start
        if self.beside is None:
            return judged(bench, start)
        return judged(bench, refine_fully(bench, dataclasses.replace(start, beside=self.beside, cost=np.inf)))

    @functools.cached_property
    def answer(self) -> Answer:
        return Answer(*_dependences(self.bench, self.judged, self.bench.vehicle), False)

    def beats(self, model: Model, stats: Reduced) -> bool:
        """`likelier` than several members alone, before it is known what else the logs depend on.

        Of one it is asked only beside what else is unknown: a true name alone may leave much to that.
        """
        if len(model.members) < 2:
            return False
        return self._likelier_than(model, stats)

    def beats_one(self, model: Model, stats: Reduced) -> bool:
        """`likelier` than one member with what else is unknown, before it is settled.

        To settle what only stands in for something unknown takes longer than the search. It is asked beside a
        disturbance alone, where the search has moved beginnings to their best times already.
        """
        if model.beside is None or len(model.members) != 1 or not self._likelier_than(model, stats):
            return False
        if not self._likelier_with_rest(model):
            return False
        # Settling would hold the file where that is likelier.
        bench = self.bench
        return self._likelier_with_rest(bench.likeliest(bench.frozen(bench.as_filed(model))))

    def _likelier_with_rest(self, model: Model) -> bool:
        """`likelier` than a model with what else the logs depend on; not where it leaves noise alone."""
        now = judged(self.bench, model)
        if now.white:
            return False
        now, unknown = _dependences(self.bench, now, extended_by(self.bench, model, dense=False))
        return self.likelier(nats_of(self.bench, now, unknown), now.phi)

    def _likelier_than(self, model: Model, stats: Reduced) -> bool:
        """`likelier` than a model alone."""
        phi = dispersion(self.bench, model, stats)
        return self.likelier(nats(self.bench, model, stats, phi), phi)

    def likelier(self, named: float, phi: float, bends: bool = True) -> bool:
        """Whether the file with unknown dependences makes the logs likelier than an answer that has `named`.

        In nats, both at the dispersion `phi` of the answer, in which what it does not explain still stands.

        - `bends`: the file's coefficients may bend within their prior, as beside names they may; a file that
          was refitted itself has been compared with that already. The answer has them as filed all the same.
        """
        if not self.answer.unknown:
            return False
        return bool(nats_of(self.bench, self.answer.judged, self.answer.unknown, phi, bends) > named)


def nats_of(
    bench: Workbench,
    now: Judged,
    unknown: tuple[Dependence, ...],
    phi: float | None = None,
    bends: bool = True,
) -> float:
    """Logarithm of the marginal likelihood of a judged model with unknown dependences, but for a constant.

    Of coefficients of the file that are held, the better of that and of bending within their prior, by the
    linearisation where they are held.

    - `phi`: dispersion of the scores, that of the model by default.
    """
    phi = now.phi if phi is None else phi
    # Beside a disturbance scores scatter as their information says, or a linearisation promises too much.
    by = phi if now.disturbance is None else max(phi, now.phi)
    ways = [now.model]
    if bends and now.model.frozen:
        # Of this weight, so that the prior stays that of the file where all else counts a part of it.
        ways.append(dataclasses.replace(now.model, frozen=False, weight=by))
    return max(_nats_with(bench, now, way, unknown, phi, by) for way in ways)


def _nats_with(
    bench: Workbench, now: Judged, way: Model, unknown: tuple[Dependence, ...], phi: float, by: float
) -> float:
    _, precision, _ = bench.known(way)
    missing = dataclasses.replace(now.left, precision=precision)
    return nats(bench, way, now.stats, phi) + nats_beside(missing, as_given(missing, unknown), by)


def _stand_in(bench: Workbench, now: Judged, unknown: tuple[Dependence, ...]) -> int | None:
    """The member that unknown dependences leave least to, if that is less than a finding must save."""
    if not unknown or not now.model.members:
        return None
    members, slices = now.model.members, bench.slices(now.model.members)
    scatters = _scatters_beside(now.knots, slices, unknown)
    least = [needed(bench, member, phi) for member, phi in zip(members, scatters, strict=True)]
    more = np.array(cost_of_removal(now.knots, slices, unknown)) - least
    worst = int(np.argmin(more))
    return worst if more[worst] < 0 else None


def _of_known(stats: Reduced, n: int) -> tuple[Float[np.ndarray, "windows z"], Float[np.ndarray, "z z"]]:
    """Gradient of the first `n` columns in each window, and their information in all."""
    return stats.g[:, :n], stats.h[:, :n, :n].sum(0)


def _scatters_beside(k: Knots, members: list[slice], unknown: tuple[Dependence, ...]) -> list[float]:
    """Dispersion of the scores of members, where their parameters lie in z, once dependences have acted."""
    z, columns = np.arange(k.width), np.eye(k.width)
    parts = acting(k, unknown).stats.each(_of_known, k.width)
    g, (h,) = rows([own for own, _ in parts]), totals([part[1:] for part in parts])
    out = []
    for where in members:
        mine = (z >= where.start) & (z < where.stop)
        out.append(mean_dispersion(g, h, columns[:, mine], columns[:, ~mine], k.precision[~mine], 1.0))
    return out
