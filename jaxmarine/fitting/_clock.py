"""Whether the clock of what was commanded is that of what was measured: estimated, never put right."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..logs import Log, StateTrack
from ._driven import Driven

# The momentum that a vehicle gains is compared over stretches of this length [s], and offsets up to the
# largest are tried, so many per second.
STRETCH, _LARGEST, _PER_SECOND = 0.5, 2.0, 20
# Stretches per number that is regressed, blocks of stretches for the standard error.
FEWEST, BLOCKS = 8, 20
# An offset is one where it is so many standard errors from none, takes this part of the scatter that is left
# (its logarithm, on the average over the axes), and is no less than this share of a sample and this time [s],
# which smoothing and rounding of times may pretend. Effects that the regression lacks, such as waves and
# velocities in other axes, pretend offsets of up to 12 standard errors that take 0.09 of it.
_SIGMAS, _TAKES, _SHARE, _LEAST = 10.0, 0.1, 0.5, 0.05


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """By how much the motion comes after the commands as logged, beyond what the vehicle file says [s].

    - `seconds`, and its standard error `std` by the scatter over stretches of the log.
    - `significant`: whether it is more than chance, smoothing and rounding of times make.

    What is positive may be a delay or a lag of the thrusters as well; what is negative no vehicle does.
    """

    seconds: float
    std: float
    significant: bool


def clock_offset(log: Log, track: StateTrack, drive: Driven) -> ClockOffset | None:
    r"""The offset at which the commands explain the motion best; None where the log cannot tell.

    - `track`, `drive`: the log's smoothed motion, and the wrenches along it.

    The likelihood over an input delay $\delta$: what each velocity gains over half a second is regressed on
    the impulse of the commands at $t - \delta$ and on integrals of what else acts (velocities, their squares
    and products, tilt). All coefficients are free, so that a wrong vehicle file does not look like a delay.
    The standard error is that of a jackknife over blocks (after Efron and Tibshirani 1993).
    """
    edges = np.arange(log.t[0] + _LARGEST, log.t[-1] - _LARGEST, STRETCH)
    force = drive.commanded[:, np.ptp(drive.commanded, axis=0) > 0]
    free = np.ptp(track.nu, axis=0) > 0
    if not free.any():
        return None
    around = integrals(log.t, others(track, free), edges)
    if not force.shape[1] or len(around) < max(BLOCKS, FEWEST * (around.shape[1] + force.shape[1])):
        return None
    gained = np.diff(np.stack([np.interp(edges, log.t, nu) for nu in track.nu.T[free]], axis=1), axis=0)
    offsets = np.arange(-_LARGEST, _LARGEST + 1e-9, 1 / _PER_SECOND)
    block = np.arange(len(around)) * BLOCKS // len(around)
    scale = np.append(_size(around), np.append(_size(force), _size(gained)))
    sums = np.array([_sums(around, impulses(log.t, force, edges - d), gained, scale, block) for d in offsets])
    whole = _cost(sums.sum(axis=1), gained.shape[1], len(around))
    best = _lowest(offsets, whole)
    if best is None:
        return None
    less = [_cost(sums.sum(axis=1) - sums[:, b], gained.shape[1], len(around)) for b in range(BLOCKS)]
    left_out = [_lowest(offsets, cost) for cost in less]
    known = np.array([one for one in left_out if one is not None])
    std = float(np.sqrt((BLOCKS - 1) * np.mean((known - known.mean()) ** 2)))
    takes = (whole[np.argmin(np.abs(offsets))] - whole.min()) / (len(around) * gained.shape[1])
    significant = (
        len(known) == BLOCKS
        and abs(best) > max(_SIGMAS * std, _SHARE * log.dt, _LEAST)
        and bool(takes > _TAKES)
    )
    return ClockOffset(best, std, significant)


def told(offset: ClockOffset) -> str:
    """A sentence on an offset between the clocks; its `size` and `std` [s] are for `str.format`."""
    size = "{size:.2f} ± {std:.2f} s"
    if offset.seconds > 0:
        return (
            f"the motion follows the commands {size} later than the vehicle file says: a delay or lag, or "
            "clocks that differ. No time was shifted."
        )
    return (
        f"the motion comes {size} before the commands that drive it: the clocks of commands and sensors "
        "differ. No time was shifted."
    )


def others(track: StateTrack, free: np.ndarray) -> Float[np.ndarray, "times others"]:
    """What acts besides the commands."""
    nu = track.nu[:, free]
    linear, angular = track.nu[:, :3], track.nu[:, 3:]
    products = (linear[:, :, None] * angular[:, None, :]).reshape(len(nu), 9)
    tilt = np.sin(track.attitude[:, :2])
    every = np.concatenate([np.ones((len(nu), 1)), nu, nu * np.abs(nu), products, tilt], axis=1)
    return every[:, np.append(True, every[:, 1:].std(axis=0) > 0)]


def _size(columns: np.ndarray) -> np.ndarray:
    return np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-12)


def integrals(t: np.ndarray, values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Of what changes from sample to sample along lines, between the edges."""
    return _between(t, np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2, edges)


def impulses(t: np.ndarray, held: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Integrals of what holds from sample to sample, which grow along lines in between."""
    return _between(t, np.diff(t)[:, None] * held[:-1], edges)


def _between(t: np.ndarray, steps: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """What steps from sample to sample add up to between the edges."""
    total = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)])
    return np.diff(np.stack([np.interp(edges, t, one) for one in total.T], axis=1), axis=0)


def _sums(around, impulses, gained, scale, block) -> Float[np.ndarray, "blocks numbers numbers"]:
    """Products of all columns, summed over each block of stretches."""
    columns = np.concatenate([around, impulses, gained], axis=1) / scale
    products = columns[:, :, None] * columns[:, None, :]
    starts = np.searchsorted(block, np.arange(BLOCKS))
    return np.add.reduceat(products, starts, axis=0)


def _cost(
    sums: Float[np.ndarray, "offsets n n"], targets: int, stretches: int
) -> Float[np.ndarray, " offsets"]:
    """Minus the logarithm of the likelihood, each axis with a scatter of its own."""
    regressed = sums.shape[1] - targets
    left = sums[:, :regressed, :regressed] + 1e-9 * stretches * np.eye(regressed)
    right = sums[:, :regressed, regressed:]
    explained = np.einsum("oij,oij->oj", right, np.linalg.solve(left, right))
    total = np.einsum("oii->oi", sums)[:, regressed:]
    rest = np.maximum(total - explained, 1e-12 * total)
    return 0.5 * stretches * np.log(rest).sum(axis=1)


def _lowest(offsets: np.ndarray, cost: np.ndarray) -> float | None:
    """The lowest point of the parabola through the lowest three; None at an end."""
    k = int(np.argmin(cost))
    if not 0 < k < len(offsets) - 1:
        return None
    bend, slope, _ = np.polyfit(offsets[k - 1 : k + 2] - offsets[k], cost[k - 1 : k + 2], 2)
    return float(offsets[k] - 0.5 * slope / bend) if bend > 0 else float(offsets[k])
