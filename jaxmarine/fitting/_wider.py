"""A disturbance with a swell, a drift or a current more, from where their numbers are looked for, or less."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._disturbance import Disturbance
from ._logarithms import DRIFT_MEMORY, FLOW_MEMORY, SWELL_ANGLE, USUAL_FLOW, USUAL_MEMORY, kinds_of
from ._windows import PLANE

# From a disturbance to wider ones of a kind, from which the likeliest is looked for.
Wider = Callable[[Disturbance], list[Disturbance]]
# Periods of a swell from which its own is looked for [s], and what it leaves of a wrench's size meanwhile.
PERIODS, LEFT = (2.0, 3.2, 5.0, 8.0, 13.0), 1 / 3
# How much longer than the wrench that it stands for a drift may last.
LONGER = (1.0, 3.0, 10.0)
# Sizes of a current from which its own is looked for [m/s].
CURRENTS = (0.02, 0.06, 0.2)


def wider_by(force: Disturbance) -> list[Wider]:
    """By what a disturbance can be wider that it does not have."""
    plane = len({*range(PLANE)} & {*force.axes})
    able = True, plane == PLANE, plane > 0
    each = zip((with_swell, with_drift, with_current), able, force.kind, strict=True)
    return [one for one, can, has in each if can and not has]


def with_swell(force: Disturbance) -> list[Disturbance]:
    """A swell in the place of the wrench on each axis, of several periods."""
    small = dataclasses.replace(
        force,
        size=force.size.at[force.parts.own].multiply(LEFT),
        time=force.time.at[force.parts.own].max(USUAL_MEMORY.median),
    )
    at, size = force.parts.swell.start, force.size[force.parts.own]
    each = [2 * np.pi / period for period in PERIODS]
    return [_inserted(small, at, size, SWELL_ANGLE.median / frequency, frequency) for frequency in each]


def with_drift(force: Disturbance) -> list[Disturbance]:
    """A drift in the place of the wrench ahead and abeam, of several memories."""
    plane = np.flatnonzero(np.array(force.axes) < PLANE)
    size, time = jnp.sqrt((force.size[plane] ** 2).mean()), jnp.exp(jnp.log(force.time[plane]).mean())
    small = dataclasses.replace(force, size=force.size.at[plane].multiply(LEFT))
    return [drifting(small, size, time * longer) for longer in LONGER]


def with_current(force: Disturbance) -> list[Disturbance]:
    """A current of several sizes, as all that disturbs slowly or beside that."""
    swings = force.frequency > 0
    small = dataclasses.replace(force, size=jnp.where(swings, 1.0, LEFT) * force.size)
    return [flowing(one, size) for one in (small, force) for size in CURRENTS]


def drifting(
    force: Disturbance, size: float | Array, time: float | Array = DRIFT_MEMORY.median
) -> Disturbance:
    """The disturbance with a drift of some size [N] and memory [s] beside it."""
    return dataclasses.replace(_inserted(force, force.parts.drift.start, size, time), drifts=True)


def flowing(force: Disturbance, size: float = USUAL_FLOW.median) -> Disturbance:
    """The disturbance with a current of some size [m/s] and of a usual memory beside it."""
    wider = _inserted(force, force.parts.current.start, size, FLOW_MEMORY.median)
    return dataclasses.replace(wider, flows=True)


def _inserted(
    force: Disturbance, at: int, size: float | Array, time: float | Array, frequency: float = 0.0
) -> Disturbance:
    """With parts of such sizes before one of its parts."""
    count = len(jnp.atleast_1d(size))
    return dataclasses.replace(
        force,
        size=jnp.insert(force.size, at, size),
        time=jnp.insert(force.time, at, jnp.full(count, time)),
        frequency=jnp.insert(force.frequency, at, jnp.full(count, frequency)),
    )


def without_swell(
    force: Disturbance, covariance: Float[np.ndarray, "logarithms logarithms"]
) -> tuple[Disturbance, Float[np.ndarray, "some some"]]:
    """The disturbance without the swell that it has, and what is known of the logarithms that are left."""
    kept = np.delete(np.arange(len(covariance)), kinds_of(force).swell)
    size, time, frequency = (
        jnp.delete(one, force.parts.swell) for one in (force.size, force.time, force.frequency)
    )
    calm = dataclasses.replace(force, size=size, time=time, frequency=frequency)
    return calm, covariance[np.ix_(kept, kept)]
