"""A disturbance as free numbers without units: the logarithms of its sizes, memories and frequency.

In order: how much is new per root of a second on each axis [full thrust], which logs tell best, and its
memory [s]; then of a swell its size on each axis [full thrust], and for all axes its memory [s] and its
frequency [rad/s]; of a drift as of an axis; last of a current its size [m/s] and its memory [s].

- `unit` [N, N m]: the full thrust of each axis of the disturbance, or what stands for it.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._disturbance import Disturbance, Kinds
from ._processes import Swell
from ._windows import PLANE


class Usual(NamedTuple):
    """What is usual of a number: its median, and the standard deviation of its logarithm.

    Weak: a log that tells more has its own way within a few standard deviations.
    """

    median: float
    spread: float

    def unusual(self, value: Array) -> Array:
        """Minus twice the logarithm of the density of the number's logarithm, but for a constant."""
        return (jnp.log(value / self.median) / self.spread) ** 2


# Of wind, waves and water: sizes [full thrust] and memories [s]; of a swell the frequency [rad/s] of one with
# a period of 5 s, and through what angle [rad] it turns in its memory so that of all such spectra its is
# likest that which JONSWAP found on the average (by Whittle's likelihood, beside noise of a hundredth).
USUAL_SIZE, USUAL_MEMORY = Usual(0.02, 3.0), Usual(4.0, 1.0)
SWELL_ANGLE, SWELL_FREQUENCY = Usual(3.5, 1.0), Usual(2 * np.pi / 5, 0.7)
# Of a drift its memory [s], between that of a wrench and that of a current.
DRIFT_MEMORY = Usual(12.0, 1.0)
# Of a current that wanders: size [m/s], and memory [s].
USUAL_FLOW, FLOW_MEMORY = Usual(0.06, 1.0), Usual(40.0, 1.0)


def kinds_of(force: Disturbance) -> Kinds:
    """Which logarithms are of each kind."""
    n = len(force.axes)
    return Kinds.one_by_one(2 * n, (n + 2) * force.swells, 2 * force.drifts, 2 * force.flows)


def count_of(force: Disturbance) -> int:
    """How many logarithms a disturbance has."""
    return kinds_of(force).current.stop


def logarithms_of(force: Disturbance, unit: Float[np.ndarray, " axes"]) -> Float[np.ndarray, " logarithms"]:
    size, parts = np.asarray(force.size / _units(force, unit)), force.parts
    time, frequency = np.asarray(force.time), np.asarray(force.frequency)
    new, first = size / np.sqrt(time), slice(parts.swell.start, parts.swell.start + force.swells)
    each = [
        *(new[parts.own], time[parts.own]),
        *(size[parts.swell], time[first], frequency[first]),
        *(new[parts.drift], time[parts.drift]),
        *(size[parts.current], time[parts.current]),
    ]
    return np.log(np.concatenate(each))


def with_logarithms(
    force: Disturbance, unit: Float[Array, " axes"], values: Float[Array, " logarithms"]
) -> Disturbance:
    """A disturbance of the same kind with other numbers."""
    n = len(force.axes)
    own, swell, drift, current = (jnp.exp(values[place]) for place in kinds_of(force))
    size, time = [own[:n] * jnp.sqrt(own[n:])], [own[n:]]
    frequency = jnp.zeros_like(force.frequency)
    if force.swells:
        size.append(swell[:n])
        time.append(jnp.repeat(swell[n], n))
        frequency = frequency.at[force.parts.swell].set(swell[n + 1])
    if force.drifts:
        size.append(drift[:1] * jnp.sqrt(drift[1:]))
        time.append(drift[1:])
    if force.flows:
        size.append(current[:1])
        time.append(current[1:])
    size = jnp.concatenate(size) * _units(force, unit)
    return dataclasses.replace(force, size=size, time=jnp.concatenate(time), frequency=frequency)


def new_of(force: Disturbance) -> Float[np.ndarray, " logarithms"]:
    """Of each size, how many numbers are new at a time that are as large as it; 0 of all others."""
    swell = [float(Swell.STATES), 0.0, 0.0]
    return _by_kinds(force, [1.0, 0.0], swell, [2.0, 0.0], [2.0, 0.0])


def unlearned(force: Disturbance) -> Float[np.ndarray, "logarithms logarithms"]:
    """Covariance by the curvature, as of `estimated`, that is usual of the logarithms in some minutes.

    It is as of sizes that are known to 10 %, memories to 20 %, and periods to 1.5 %, as they were where
    disturbances were seen well; of a current, which is seen worse, to 30 %. A search for what is known less
    well may end some nats too soon, and goes on where it is done in turn with other numbers.
    """
    size, memory, period, flow = 0.1**2, 0.2**2, 0.015**2, 0.3**2
    each = [size, memory], [size, memory, period], [size, memory], [flow, flow]
    return 0.5 * np.diag(_by_kinds(force, *each))


def improbable(force: Disturbance, unit: Float[Array, " axes"]) -> Float[Array, ""]:
    """Minus twice the logarithm of the prior's density of a disturbance, up to a constant; 0 at its most."""
    parts, size = force.parts, force.size / _units(force, unit)
    out = USUAL_SIZE.unusual(size[: parts.drift.stop]).sum()
    out += USUAL_MEMORY.unusual(force.time[parts.own]).sum()
    if force.swells:
        time, frequency = (one[parts.swell.start] for one in (force.time, force.frequency))
        out += SWELL_ANGLE.unusual(time * frequency) + SWELL_FREQUENCY.unusual(frequency)
    out += DRIFT_MEMORY.unusual(force.time[parts.drift]).sum()
    out += USUAL_FLOW.unusual(size[parts.current]).sum()
    return out + FLOW_MEMORY.unusual(force.time[parts.current]).sum()


def unusual(force: Disturbance, unit: Float[np.ndarray, " axes"]) -> float:
    """`improbable` as a number."""
    return float(improbable(force, jnp.asarray(unit)))


def _by_kinds(
    force: Disturbance, own: list[float], swell: list[float], drift: list[float], flow: list[float]
) -> Float[np.ndarray, " logarithms"]:
    """A number for each, by its kind: of a swell three, of all others two."""
    n = len(force.axes)
    some = [np.repeat(own, n)]
    some += [np.repeat(swell, [n, 1, 1])] if force.swells else []
    return np.concatenate([*some, *([drift] * force.drifts), *([flow] * force.flows)])


def _units(force: Disturbance, unit: Array | np.ndarray) -> Float[Array, " parts"]:
    """Of each part's size: the full thrust of its axis, or of the stronger one; of a current 1 m/s."""
    wrenches = jnp.tile(jnp.asarray(unit), 2 if force.swells else 1)
    out = [wrenches]
    if force.drifts:
        plane = [unit[i] for i, axis in enumerate(force.axes) if axis < PLANE]
        out.append(jnp.max(jnp.stack(plane))[None])
    return jnp.concatenate([*out, *([jnp.ones(1)] * force.flows)])
