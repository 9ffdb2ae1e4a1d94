"""How a vehicle answers each of its thrusters, as a log shows it and as its file says.

Nothing is simulated and nothing of the file is fitted: what each axis gains in momentum over half a second is
regressed on each thruster's own impulse beside all that else acts, all coefficients free. A wrong damping or
mass then does not look like a wrong sign, nor the other way round.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._types import DOFS
from ..actuators import Supply
from ..logs import Log, smooth_states
from ..vehicle import Vehicle
from ._clock import BLOCKS, FEWEST, STRETCH, impulses, integrals, others
from ._driven import thrusts

# Pairs of velocities along axes, and of rates about them.
_MUNK = ((0, 1), (0, 2), (1, 2), (3, 4), (3, 5), (4, 5))
# By how much thrust and inertia of a file are commonly off, of the answer of an axis: a guessed file's may be
# by a third, and thrust astern is often two thirds of that ahead.
_OFF = 1 / 3
# An answer that is a smaller share of its axis' others than this is off by as much as one of this share: what
# couples axes, and directions that are rounded.
_SMALL = 0.3
# Offsets between commands and motion that are tried [s].
_OFFSETS = np.arange(-0.5, 1.55, 0.1)
# Velocities and rates have sensors of their own, and each a time that it comes late by.
_KINDS = (slice(0, 3), slice(3, 6))
# An axis answers where its largest answer by the file is above this share of the largest of its kind.
_LEAST = 0.05
# Factors by which an axis may answer more or less than filed, and of how much two in three are: thrust over
# inertia of a guessed file.
_FACTORS, USUAL = np.exp(np.linspace(-6.0, 6.0, 121)), np.log(2.0)
# Of impulses, combinations smaller than this share of the largest are how commands are rounded: a microsecond
# of a pulse's four hundred.
_TOLD = 1e-2
# Explained over unexplained variance, per number (F), that noise alone exceeds once in some million.
_MOVES = 3.0
# Nats beyond the number of readings that are tried, and within which two are not told apart: odds of 1 to
# 150, and of 1 to 20.
_MARGIN, _CLOSE = 5.0, 3.0


class Responses(NamedTuple):
    """Momentum that axes gain per impulse of each thruster [N/N, N m/N], of thrusters that were commanded.

    - `names`; `measured`, `filed` [axes, thrusters]; zero on axes that are locked.
    - `covariance` [axes, thrusters, thrusters]: by the scatter over blocks of the logs.
    - `known` [axes]: which axes move.
    - `shown` [axes, thrusters, thrusters]: `measured` is what the commands show of the true answers. Of many
      thrusters a pilot never moves some combination, of whose answer nothing is measured.
    """

    names: tuple[str, ...]
    measured: Float[np.ndarray, "6 thrusters"]
    filed: Float[np.ndarray, "6 thrusters"]
    covariance: Float[np.ndarray, "6 thrusters thrusters"]
    known: np.ndarray
    shown: Float[np.ndarray, "6 thrusters thrusters"]


class Reading(NamedTuple):
    """One way to read the columns and axes, and how much likelier it makes the responses than the file's.

    - `exchanged`: pairs of thrusters each of whose columns holds the other's command.
    - `turned`: thrusters whose commands have the wrong sign; `columns`: those of the log that hold them.
    - `axes`: those of which the log, or the file, has the wrong sign.
    - `odds` [nats]: less what it costs that it was chosen among so many.
    """

    exchanged: tuple[tuple[str, str], ...]
    turned: tuple[str, ...]
    columns: tuple[str, ...]
    axes: tuple[str, ...]
    odds: float


def responses(vehicle: Vehicle, logs: Sequence[Log], apart: bool = False) -> Responses | None:
    """Of logs of commands; None where they are too short to tell, or where nothing was commanded.

    Of thrusters alone: what others give hangs on the flow, and has no answer of one size.

    - `apart`: whether what commands are late by is found for velocities and for rates by themselves, whose
      sensors may come late. Else it is one for all axes, which tells it better.
    """
    logs = [log for log in logs if log.commands is not None and not np.ptp(log.t) < 4 * STRETCH]
    # What a sagging battery takes from all thrusters is less than what their file is commonly off.
    others_push = any(not isinstance(one, Supply) for one in vehicle.actuators)
    if not logs or not vehicle.thruster_names or others_push:
        return None
    mass, parts = np.asarray(vehicle.mass_matrix), []
    for log in logs:
        track, force = smooth_states(log, vehicle.dof), thrusts(vehicle, log)
        edges = np.arange(log.t[0] - _OFFSETS.min(), log.t[-1] - _OFFSETS.max(), STRETCH)
        if len(edges) < 2:
            continue
        nu = np.stack([np.interp(edges, log.t, one) for one in track.nu.T], axis=1)
        # Beside what acts on a clock's resolution: the moments that added masses make of two velocities.
        more = [track.nu[:, i] * track.nu[:, j] for i, j in _MUNK]
        acting = np.concatenate([others(track, vehicle.free > 0), np.stack(more, axis=1)], axis=1)
        around = integrals(log.t, acting, edges)
        pushed = np.array([impulses(log.t, force, edges - offset) for offset in _OFFSETS])
        parts.append((np.diff(nu, axis=0) @ mass.T, around, pushed))
    if not parts:
        return None
    gained, around = (np.concatenate([part[i] for part in parts]) for i in range(2))
    pushed = np.concatenate([part[2] for part in parts], axis=1)
    used, there = pushed.std(axis=(0, 1)) > 0, np.abs(around).max(axis=0) > 0
    around, pushed = around[:, there], pushed[:, :, used]
    count = pushed.shape[2]
    if not count or len(gained) < max(BLOCKS, FEWEST * (around.shape[1] + count)):
        return None
    known = (gained.std(axis=0) > 0) & (vehicle.free > 0)
    if not known.any():
        return None

    fits = [_regressed(one, around, gained) for one in pushed]
    found = [_best(fits, kind, known) for kind in (_KINDS if apart else (slice(0, 6),))]
    slopes, rest, covariance, shown = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # A channel that shows nothing but noise is no axis that does not answer.
    freedom = count + around.shape[1]
    explained = (gained**2).sum(axis=0) - (rest**2).sum(axis=1)
    known &= explained / freedom > _MOVES * (rest**2).sum(axis=1) / (len(gained) - freedom)
    filed = np.asarray(vehicle.plant().allocation)[:, used] * vehicle.free[:, None]
    names = tuple(name for name, one in zip(vehicle.thruster_names, used, strict=True) if one)
    return Responses(names, slopes, filed, covariance, known, shown)


def _best(fits: Sequence[tuple[np.ndarray, ...]], kind: slice, known: np.ndarray):
    """Slopes, rest and covariance of some axes at the offset that suits them, and what is shown there."""
    own = np.arange(6)[kind][known[kind]]
    inverse, slopes, rest, shown = min(
        fits, key=lambda fit: np.log(np.maximum(fit[2][:, own].std(axis=0), 1e-12)).sum()
    )
    slopes, rest = slopes.T[kind], rest.T[kind]
    # What each block adds to the slopes by its residuals, whose sum is zero.
    block = np.arange(rest.shape[1]) * BLOCKS // rest.shape[1]
    starts = np.searchsorted(block, np.arange(BLOCKS))
    added = np.add.reduceat(inverse[None] * rest[:, None], starts, axis=2)
    lasting = np.einsum("ajb,akb->ajk", added, added) * BLOCKS / (BLOCKS - 1)
    alone = np.einsum("jt,kt,a->ajk", inverse, inverse, rest.var(axis=1))
    # Of some blocks the scatter is a rough number: never less than that of stretches one by one.
    return slopes, rest, lasting + alone, np.repeat(shown[None], len(rest), axis=0)


def _regressed(
    pushed: Float[np.ndarray, "rows thrusters"],
    around: Float[np.ndarray, "rows others"],
    gained: Float[np.ndarray, "rows 6"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Momentum on impulses beside others: what maps it to slopes, these, the rest, and what is shown."""
    own = _sizes(pushed)
    u, size, ways = np.linalg.svd(pushed / own, full_matrices=False)
    told = size > _TOLD * size[0]
    columns = np.concatenate([u[:, told], around], axis=1)
    # Without units, and without what the others tell already.
    scale = _sizes(columns)
    q, r = np.linalg.qr(columns / scale)
    inverse = np.linalg.pinv(r, rcond=1e-6) @ q.T / scale[:, None]
    rest = gained - columns @ (inverse @ gained)
    inverse = (ways[told].T / size[told] / own[:, None]) @ inverse[: told.sum()]
    return inverse, inverse @ gained, rest, ways[told].T @ ways[told] / own[:, None] * own


def _sizes(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    return np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)


def read_otherwise(seen: Responses, spread: float = USUAL) -> tuple[Reading, ...]:
    """Ways to read columns and axes that responses prefer to the file's, the likeliest first.

    Mostly none. One mistake or two of these: two columns exchanged, one or all of the wrong sign, a whole
    axis of it. Each says what the answers would be but for a factor of each axis, which mass and thrust of
    the file leave open. Those that come as near as odds of 1 to 20 are given too, unless they take a mistake
    more.

    - `spread`: of the logarithms of the axes' factors; of all axes together the file says nothing, as what
      a full command is may have any unit.
    """
    count, moving = len(seen.names), np.flatnonzero(_answers(seen)).tolist()
    eye = (tuple(range(count)), (1,) * count, (1,) * 6)
    single = [
        *((_exchanged(eye[0], i, j), *eye[1:]) for i, j in itertools.combinations(range(count), 2)),
        *((eye[0], _turned(eye[1], [i]), eye[2]) for i in range(count)),
        *([(eye[0], (-1,) * count, eye[2])] if count > 1 else []),
        *((*eye[:2], _turned(eye[2], [axis])) for axis in moving),
    ]
    # The first of two is the exchange: signs are those of columns after it.
    double = [
        (
            tuple(a[0][k] for k in b[0]),
            tuple(np.multiply(a[1], b[1]).tolist()),
            tuple(np.multiply(a[2], b[2]).tolist()),
        )
        for a, b in itertools.combinations(single, 2)
    ]
    ways: dict[Hypothesis, int] = {eye: 0}
    for mistakes, these in ((1, single), (2, double)):
        for way in these:
            ways.setdefault(way, mistakes)
    seen, price = _scaled(seen, moving), np.log(len(single))
    expected = np.stack([_read(seen, way) for way in ways])
    left = _unlikely(seen, expected, spread)
    # What not even the likeliest of them explains is how far answers scatter (overdispersion).
    freedom = max(float((np.trace(seen.shown[moving], axis1=1, axis2=2) - 1).sum()), 1.0)
    phi = 2 * float(_unlikely(seen, expected[left.argmin()], np.inf)) / freedom
    if phi > 1:
        left = _unlikely(seen, expected, spread, phi)
    # The file's own comes first.
    odds = {way: left[0] - one - ways[way] * price for way, one in zip(ways, left.tolist(), strict=True)}
    best = max(ways, key=lambda way: (odds[way], -ways[way]))
    if odds[best] < _MARGIN:
        return ()
    near = [way for way in ways if odds[best] - odds[way] < _CLOSE and ways[way] <= ways[best]]
    return tuple(
        _named(seen.names, way, odds[way]) for way in sorted(near, key=lambda way: -round(odds[way], 2))
    )


def confirmed(readings: Sequence[Reading], others: Sequence[Reading]) -> tuple[Reading, ...]:
    """Those readings that others say too, with the smaller odds."""
    odds = {one._replace(odds=0.0): one.odds for one in others}
    both = [(one, odds.get(one._replace(odds=0.0))) for one in readings]
    found = [one._replace(odds=min(one.odds, other)) for one, other in both if other is not None]
    return tuple(sorted(found, key=lambda one: -round(one.odds, 2)))


# Of each column the thruster that it drives, the sign of its command, and the sign of each axis.
Hypothesis = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


def _read(seen: Responses, way: Hypothesis) -> Float[np.ndarray, "6 thrusters"]:
    """The answers of the file, if columns and axes are read this way."""
    return np.array(way[2])[:, None] * seen.filed[:, list(way[0])] * np.array(way[1])


def _exchanged(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    out = list(order)
    out[i], out[j] = order[j], order[i]
    return tuple(out)


def _turned(signs: tuple[int, ...], places: list[int]) -> tuple[int, ...]:
    return tuple(-sign if i in places else sign for i, sign in enumerate(signs))


def _named(names: tuple[str, ...], way: Hypothesis, odds: float) -> Reading:
    order, signs, axes = way
    # Chains of exchanges become pairs one after another.
    pairs, now = [], list(range(len(order)))
    for i, wanted in enumerate(order):
        if now[i] != wanted:
            j = now.index(wanted)
            pairs.append((names[i], names[j]))
            now[i], now[j] = now[j], now[i]
    wrong = [i for i, sign in enumerate(signs) if sign < 0]
    return Reading(
        exchanged=tuple(pairs),
        turned=tuple(names[order[i]] for i in wrong),
        columns=tuple(names[i] for i in wrong),
        axes=tuple(DOFS[i] for i, sign in enumerate(axes) if sign < 0),
        odds=float(odds),
    )


def opposite(seen: Responses) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Axes and thrusters between which an answer has not the filed sign, by three standard errors."""
    std = np.sqrt(np.einsum("ajj->aj", seen.covariance))
    large = np.abs(seen.filed) > 0.1 * np.abs(seen.filed).max(axis=1, keepdims=True)
    wrong = large & (seen.measured * seen.filed < 0) & (np.abs(seen.measured) > 3 * std)
    wrong &= _answers(seen)[:, None]
    return (
        tuple(dof for dof, bad in zip(DOFS, wrong.any(axis=1), strict=True) if bad),
        tuple(name for name, bad in zip(seen.names, wrong.any(axis=0), strict=True) if bad),
    )


def _answers(seen: Responses) -> np.ndarray:
    """Which axes some thruster pushes, by the file."""
    size = np.abs(seen.filed).max(axis=1)
    kind = np.repeat([size[:3].max(), size[3:].max()], 3)
    return seen.known & (size > _LEAST * kind)


def _scaled(seen: Responses, moving: list[int]) -> Responses:
    """With the file's answers as large as the measured ones, in the median over the axes."""

    def sizes(answers: Float[np.ndarray, "6 thrusters"]) -> Float[np.ndarray, " axes"]:
        return np.linalg.norm(answers[moving], axis=1)

    filed = sizes(np.einsum("ajk,ak->aj", seen.shown, seen.filed))
    ratio = float(np.median(sizes(seen.measured)[filed > 0] / filed[filed > 0])) if filed.any() else 0.0
    return seen._replace(filed=(ratio or 1.0) * seen.filed)


def _unlikely(
    seen: Responses, expected: Float[np.ndarray, "*ways 6 thrusters"], spread: float, phi: float = 1.0
) -> Float[np.ndarray, "*ways"]:
    """Minus the logarithm of the likelihood of the responses, each axis with a factor above zero.

    - `spread`: of the factors' logarithms; `phi`: dispersion of the answers.
    """
    total = np.zeros(expected.shape[:-2])
    for axis in np.flatnonzero(_answers(seen)):
        got, rows = seen.measured[axis], expected[..., axis, :] @ seen.shown[axis].T
        filed = np.abs(seen.filed[axis])
        filed *= np.linalg.norm(got) / np.linalg.norm(filed)
        # Of each answer what lies between measured and filed, the same for all readings.
        size = np.maximum((np.abs(got) + filed) / 2, _SMALL * np.sqrt((got**2).mean()))
        precision = np.linalg.inv(seen.covariance[axis] + np.diag((_OFF * size) ** 2))
        along = np.einsum("...j,jk,...k->...", rows, precision, rows)[..., None]
        across = (rows @ (precision @ got))[..., None]
        square = got @ precision @ got - 2 * _FACTORS * across + _FACTORS**2 * along
        total += 0.5 * (square / phi + (np.log(_FACTORS) / spread) ** 2).min(axis=-1)
    return total
