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
from ._feedback import answers

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
# An axis answers where its largest answer by the file is above this share of the largest of its kind.
_LEAST = 0.05
# Factors by which an axis may answer more or less than filed, and of how much two in three are: thrust over
# inertia of a guessed file.
_FACTORS, _USUAL = np.exp(np.linspace(-6.0, 6.0, 121)), np.log(2.0)
# Nats beyond the number of readings that are tried, and within which two are not told apart: odds of 1 to
# 150, and of 1 to 20.
_MARGIN, _CLOSE = 5.0, 3.0


class Responses(NamedTuple):
    """Momentum that axes gain per impulse of each thruster [N/N, N m/N], of thrusters that were commanded.

    - `names`; `measured`, `filed` [axes, thrusters]; zero on axes that are locked.
    - `covariance` [axes, thrusters, thrusters]: by the scatter over blocks of the logs.
    - `known` [axes]: which axes move.
    - `shown` [thrusters, thrusters]: `measured` is what the commands show of the true answers. Of many
      thrusters a pilot never moves some combination, of whose answer nothing is measured.
    - `spread`: of the logarithm of the factor by which an axis answers more or less than filed.
    """

    names: tuple[str, ...]
    measured: Float[np.ndarray, "6 thrusters"]
    filed: Float[np.ndarray, "6 thrusters"]
    covariance: Float[np.ndarray, "6 thrusters thrusters"]
    known: np.ndarray
    shown: Float[np.ndarray, "thrusters thrusters"]
    spread: float


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


def responses(vehicle: Vehicle, logs: Sequence[Log]) -> Responses | None:
    """Of logs of commands; None where they are too short to tell, or where nothing was commanded.

    Of thrusters alone: what others give hangs on the flow, and has no answer of one size.
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

    def regressed(offset: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        columns = np.concatenate([pushed[offset], around], axis=1)
        # Without units, and without what the others tell already.
        scale = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
        q, r = np.linalg.qr(columns / scale)
        solved = np.linalg.pinv(r, rcond=1e-6)
        inverse, own = solved @ q.T, scale[:count]
        slopes = inverse @ gained
        rest = gained - columns / scale @ slopes
        shown = (solved @ r)[:count, :count] / own[:, None] * own
        return inverse[:count] / own[:, None], slopes[:count] / own[:, None], rest, shown

    fits = [regressed(i) for i in range(len(_OFFSETS))]
    best = min(fits, key=lambda fit: np.log(np.maximum(fit[2][:, known].std(axis=0), 1e-12)).sum())
    inverse, slopes, rest, shown = best
    # What each block adds to the slopes by its residuals, whose sum is zero.
    block = np.arange(len(gained)) * BLOCKS // len(gained)
    starts = np.searchsorted(block, np.arange(BLOCKS))
    added = np.add.reduceat(inverse.T[:, :, None] * rest[:, None, :], starts, axis=0)
    lasting = np.einsum("bja,bka->ajk", added, added) * BLOCKS / (BLOCKS - 1)
    alone = np.einsum("jt,kt,a->ajk", inverse, inverse, rest.var(axis=0))
    # Of some blocks the scatter is a rough number: never less than that of stretches one by one.
    filed = np.asarray(vehicle.plant().allocation)[:, used] * vehicle.free[:, None]
    names = tuple(name for name, one in zip(vehicle.thruster_names, used, strict=True) if one)
    # Where commands answer what was measured, less is seen of what axes answer, down to nothing.
    spread = np.inf if any(map(answers, logs)) else _USUAL
    return Responses(names, slopes.T, filed, lasting + alone, known, shown, spread)


def read_otherwise(seen: Responses) -> tuple[Reading, ...]:
    """Ways to read columns and axes that responses prefer to the file's, the likeliest first.

    Mostly none. One mistake or two of these: two columns exchanged, one or all of the wrong sign, a whole
    axis of it. Each says what the answers would be but for a factor of each axis, which mass and thrust of
    the file leave open. Those that come as near as odds of 1 to 20 are given too, unless they take a mistake
    more.
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
    price = np.log(len(single))
    ways: dict[Hypothesis, int] = {eye: 0}
    for mistakes, these in ((1, single), (2, double)):
        for way in these:
            ways.setdefault(way, mistakes)
    left = {way: _unlikely(seen, _read(seen, way)) for way in ways}
    # What not even the likeliest of them explains is how far answers scatter (overdispersion).
    likeliest = _read(seen, min(left, key=lambda way: left[way]))
    freedom = max(len(moving) * (count - 1), 1)
    phi = max(2 * _unlikely(seen._replace(spread=np.inf), likeliest) / freedom, 1.0)
    found = {
        way: ((left[eye] - left[way]) / phi - mistakes * price, mistakes)
        for way, mistakes in ways.items()
        if not np.allclose(_read(seen, way), seen.filed)
    }
    best = max(found.values(), default=(-np.inf, 0))
    if best[0] < _MARGIN:
        return ()
    near = [
        (way, odds)
        for way, (odds, mistakes) in found.items()
        if best[0] - odds < _CLOSE and mistakes <= best[1]
    ]
    return tuple(_named(seen.names, way, odds) for way, odds in sorted(near, key=lambda one: -one[1]))


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


def _unlikely(seen: Responses, expected: Float[np.ndarray, "6 thrusters"]) -> float:
    """Minus the logarithm of the likelihood of the responses, each axis with a factor above zero."""
    total = 0.0
    for axis in np.flatnonzero(_answers(seen)):
        got, rows = seen.measured[axis], seen.shown @ expected[axis]
        filed = np.abs(seen.filed[axis])
        filed *= np.linalg.norm(got) / np.linalg.norm(filed)
        # Of each answer what lies between measured and filed, the same for all readings.
        size = np.maximum((np.abs(got) + filed) / 2, _SMALL * np.sqrt((got**2).mean()))
        covariance = seen.covariance[axis] + np.diag((_OFF * size) ** 2)
        weighed = np.linalg.solve(covariance, np.stack([got, rows], axis=1))
        square = (
            got @ weighed[:, 0] - 2 * _FACTORS * (rows @ weighed[:, 0]) + _FACTORS**2 * (rows @ weighed[:, 1])
        )
        total += 0.5 * float((square + (np.log(_FACTORS) / seen.spread) ** 2).min())
    return total
