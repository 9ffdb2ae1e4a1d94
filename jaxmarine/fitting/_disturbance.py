"""What disturbs a craft, as random processes with a memory: a wrench on each axis, a swell, a drift, and
a current.

    d' = -d / time + w,    standard deviation `size`

is the wrench on an axis (Gauss, Markov). A swell on it also turns with a frequency: it is the first component
of a pair

    p' = -p / time + [[0, -frequency], [frequency, 0]] p + b w,    standard deviation `size` of it,

with such a b that it has no part which lasts: waves push to and fro. It is white noise through the filter

    s / (s^2 + 2 s / time + 1 / time^2 + frequency^2)

A drift is a force to the north and to the east: two numbers like the first. Wind and waves push so for longer
than a craft keeps its heading; the wrench on each axis turns with the hull, as turbulence about it does. A
current is the water's velocity to the north and to the east. What it does turns with the heading too, and
grows with the craft's speed, as no force does.

Between two samples a craft is moved by what pushed on the average, which at the first of them is known in
part only: of a disturbance that forgets within a sample's time hardly anything is (`Disturbance.over`). The
mean is all that is told of a hold: that an early push moves a craft farther than a late one is left out. It
shows where positions are known better than to a tenth of what a push moves a craft in a sample's time.

Source: after Van Loan (1978) on what is new in a process and in its integral over a step, and Fossen (2021)
on slowly varying forces as a Gauss-Markov bias in earth axes, and on a filter of second order for waves.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..physics import rotation
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


# Of wind, waves and water: sizes [full thrust] and memories [s]; of a swell how long it stays in step with
# itself [s], and the frequency [rad/s] of one with a period of 5 s.
USUAL_SIZE, USUAL_MEMORY = Usual(0.02, 3.0), Usual(4.0, 1.0)
SWELL_MEMORY, SWELL_FREQUENCY = Usual(10.0, 1.0), Usual(2 * np.pi / 5, 0.7)
# Of a drift its memory [s], between that of a wrench and that of a current.
DRIFT_MEMORY = Usual(12.0, 1.0)
# Of a current that wanders: size [m/s], and memory [s].
USUAL_FLOW, FLOW_MEMORY = Usual(0.06, 1.0), Usual(40.0, 1.0)


# Places in [-1, 1] and their weights, for integrals over a hold (Gauss, Legendre): exact to a thousandth of a
# disturbance's variance where it remembers a thirtieth of a hold and turns less than two turns in one.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


class Disturbance(eqx.Module):
    """A Gauss-Markov wrench on the hull, a swell, a drift, and a current.

    - `size`: standard deviation [N, N m, m/s]; `time`: in which it forgets all but 1/e [s]; `frequency`
      [rad/s], 0 of what does not swing. First of the wrench on each axis, then of the swell, of the drift and
      of the current, if there are such; of the last two alike to the north and to the east.
    - `gap`: from the end of the last hold of the window before to the first sample of each window [s], many
      memories where a log begins; `joined`: whether a window goes on in the state of the one before.
    - `axes`: those on which it acts; `drifts`, `flows`: whether there is a drift, and a current.
    """

    size: Float[Array, " parts"]
    time: Float[Array, " parts"]
    frequency: Float[Array, " parts"]
    gap: Float[Array, " windows"]
    joined: Bool[Array, " windows"]
    axes: tuple[int, ...] = eqx.field(static=True)
    drifts: bool = eqx.field(static=True, default=False)
    flows: bool = eqx.field(static=True, default=False)

    @property
    def swells(self) -> bool:
        return len(self.size) - self.drifts - self.flows > len(self.axes)

    @property
    def kind(self) -> tuple[bool, bool, bool]:
        """Whether there is a swell, a drift, and a current."""
        return self.swells, self.drifts, self.flows

    @property
    def _pairs(self) -> slice:
        """Parts that are the swell's."""
        return slice(len(self.axes), len(self.axes) * (2 if self.swells else 1))

    @property
    def states(self) -> int:
        return len(self.axes) * (3 if self.swells else 1) + PLANE * (self.drifts + self.flows)

    def shared_with(self, narrower: "Disturbance") -> Int[np.ndarray, " states"]:
        """Indices of those of its states that one has as well which lacks some of its kinds."""
        kinds = zip((True, *narrower.kind), (True, *self.kind), strict=True)
        lengths = len(self.axes), 2 * len(self.axes), PLANE, PLANE
        kept = [np.full(length * own, has) for (has, own), length in zip(kinds, lengths, strict=True)]
        return np.flatnonzero(np.concatenate(kept))

    def output(self, plane: Float[Array, "axes plane"]) -> Float[Array, "pushes states"]:
        """From its states to the wrench on its axes, and to the water's velocity.

        - `plane`: as of `by_plane`.
        """
        wrench = [jnp.eye(len(self.axes))]
        if self.swells:
            wrench.append(jnp.kron(wrench[0], jnp.array([[1.0, 0.0]])))
        if self.drifts:
            wrench.append(plane)
        flow = jnp.eye(PLANE) if self.flows else jnp.zeros((PLANE, 0))
        return jax.scipy.linalg.block_diag(jnp.concatenate(wrench, axis=1), flow)

    @property
    def spread(self) -> Float[Array, "states states"]:
        """Covariance of its states, after many memories."""
        return self._blocks(self.size**2, self._swell)

    @property
    def _swell(self) -> Float[Array, "2 2 pairs"]:
        """Covariance of the swell's pairs, which follows from their `_kick`."""
        turns = 1.0 / (self.frequency[self._pairs] * self.time[self._pairs])
        whole, lead = self.size[self._pairs] ** 2, 1.0 + 2.0 * turns**2
        both = jnp.stack([whole, whole * turns, whole * turns, whole * lead])
        return both.reshape(2, 2, *turns.shape)

    def after(self, dt: Float[Array, ""], states: Float[Array, "states columns"]):
        """What is left of its states [states, columns] after some time [s]."""
        n, stays = len(self.axes), jnp.exp(-self._rate * dt)
        own, pairs, last = jnp.split(states, [n, n + 2 * len(stays[self._pairs])])
        pairs = jnp.einsum("ija,ajc->aic", self._turns(stays), pairs.reshape(-1, 2, states.shape[1]))
        in_plane = jnp.repeat(stays.real[len(stays) - self.drifts - self.flows :], PLANE)
        left = stays.real[:n, None] * own, pairs.reshape(-1, states.shape[1]), in_plane[:, None] * last
        return jnp.concatenate(left)

    def new(self, dt: Float[Array, ""]) -> Float[Array, "states states"]:
        """Covariance of what is new in its states after some time [s]."""
        left, swell = self._turns(jnp.exp(-self._rate * dt)), self._swell
        stays = jnp.einsum("ija,jka,lka->ila", left, swell, left)
        return self._blocks(self.size**2 * -jnp.expm1(-2 * dt / self.time), swell - stays)

    @property
    def _rate(self) -> Complex[Array, " parts"]:
        """A part, a pair as one complex number, goes on as exp(-rate t)."""
        return 1.0 / self.time - 1j * self.frequency

    @property
    def _kick(self) -> Complex[Array, " parts"]:
        """What a number that is new, of size one in a second, adds to each part.

        To a pair in such a direction that nothing of it is left in its first number where it changes slowly.
        """
        own = self.size * jnp.sqrt(2.0 / self.time) + 0j
        swings = self.frequency > 0
        swell = 2j * self.size * self._rate / (jnp.where(swings, self.frequency, 1.0) * jnp.sqrt(self.time))
        return jnp.where(swings, swell, own)

    def over(self, dt: Float[Array, ""]) -> "Hold":
        """What its states are on the average over a hold of some length [s], which is not nothing.

        What is new in a part some time before the hold's end adds to the end as exp(-rate t), and to the mean
        as that does on the average.
        """
        rate, kick = self._rate, self._kick

        def adds(t):
            """To the mean, of one that is new so long before the end."""
            return -jnp.expm1(-rate * t) / (rate * dt)

        def both(t):
            """Products of what is new so long before the end in the mean, and at the end, with the former."""
            end, mean = kick * jnp.exp(-rate * t), kick * adds(t)
            parts = [jnp.stack([one.real, one.imag]) for one in (mean, end)]
            return [one[:, None] * parts[0][None] for one in parts]

        # The weights are of an integral from -1 to 1.
        within = [
            0.5 * dt * jnp.tensordot(WEIGHTS, one, 1) for one in jax.vmap(both)(0.5 * dt * (1.0 + NODES))
        ]
        new = [self._blocks(one[0, 0], one[:, :, self._pairs]) for one in within]
        return Hold(self._matrix(adds(dt)), *new)

    def _turns(self, of_parts: Complex[Array, " parts"]) -> Float[Array, "2 2 pairs"]:
        """Complex factors of its parts as matrices on the swell's pairs."""
        pairs = of_parts[self._pairs]
        return jnp.stack([pairs.real, -pairs.imag, pairs.imag, pairs.real]).reshape(2, 2, *pairs.shape)

    def _matrix(self, of_parts: Complex[Array, " parts"]) -> Float[Array, "states states"]:
        """Complex factors of its parts as a matrix on its states."""
        return self._blocks(of_parts.real, self._turns(of_parts))

    def _blocks(
        self, single: Float[Array, " parts"], pairs: Float[Array, "2 2 pairs"]
    ) -> Float[Array, "states states"]:
        """A matrix on its states, of a number for each part, or of 2 x 2 for each pair of a swell."""
        last = single[len(single) - self.drifts - self.flows :]
        blocks = [jnp.diag(single[: len(self.axes)]), *jnp.moveaxis(pairs, -1, 0)]
        return jax.scipy.linalg.block_diag(*blocks, *(one * jnp.eye(PLANE) for one in last))


class Hold(NamedTuple):
    """The mean of a disturbance over a hold: by its first states, and what is new in it.

    - `variance` of what is new in the mean; `covariance` of what is new in the states at the end with that.
    """

    mean: Float[Array, "states states"]
    variance: Float[Array, "states states"]
    covariance: Float[Array, "states states"]


@dataclasses.dataclass(frozen=True)
class Logarithms:
    """Sizes, memories and frequency of a disturbance as free numbers without units.

    In order: how much is new per root of a second on each axis [full thrust], which logs tell best, and its
    memory [s]; then of a swell its size on each axis [full thrust], and for all axes its memory [s] and its
    frequency [rad/s]; of a drift as of an axis; last of a current its size [m/s] and its memory [s].
    """

    axes: int

    def of(self, force: Disturbance, unit: np.ndarray) -> Float[np.ndarray, " logarithms"]:
        n, size = self.axes, np.asarray(force.size / self._units(force, unit))
        time, frequency = np.asarray(force.time), np.asarray(force.frequency)
        swell = [size[n : 2 * n], time[n : n + 1], frequency[n : n + 1]] if force.swells else []
        at = len(size) - force.flows - 1
        drift = [size[at : at + 1] / np.sqrt(time[at]), time[at : at + 1]] if force.drifts else []
        flow = [size[-1:], time[-1:]] if force.flows else []
        return np.log(np.concatenate([size[:n] / np.sqrt(time[:n]), time[:n], *swell, *drift, *flow]))

    def set(self, force: Disturbance, unit: Array, values: Float[Array, " logarithms"]) -> Disturbance:
        n, values = self.axes, jnp.exp(values)
        size, time, frequency = values[:n] * jnp.sqrt(values[n : 2 * n]), values[n : 2 * n], jnp.zeros(n)
        if force.swells:
            size = jnp.concatenate([size, values[2 * n : 3 * n]])
            time = jnp.concatenate([time, jnp.full(n, values[3 * n])])
            frequency = jnp.concatenate([frequency, jnp.full(n, values[3 * n + 1])])
        if force.drifts:
            at = len(values) - 2 * force.flows - 2
            new, memory = values[at], values[at + 1]
            size, time = jnp.append(size, new * jnp.sqrt(memory)), jnp.append(time, memory)
            frequency = jnp.append(frequency, 0.0)
        if force.flows:
            size, time = jnp.append(size, values[-2]), jnp.append(time, values[-1])
            frequency = jnp.append(frequency, 0.0)
        size = size * self._units(force, unit)
        return dataclasses.replace(force, size=size, time=time, frequency=frequency)

    def _of_kinds(
        self,
        force: Disturbance,
        own: list[float],
        swell: list[float],
        drift: list[float],
        flow: list[float],
    ) -> Float[np.ndarray, " logarithms"]:
        """A number for each, by its kind: of a swell three, of all others two."""
        n = self.axes
        some = [np.repeat(own, n)]
        some += [np.repeat(swell, [n, 1, 1])] if force.swells else []
        return np.concatenate([*some, *([drift] * force.drifts), *([flow] * force.flows)])

    def new(self, force: Disturbance) -> Float[np.ndarray, " logarithms"]:
        """Of each size, how many numbers are new at a time that are as large as it; 0 of all others."""
        return self._of_kinds(force, [1.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0], [2.0, 0.0])

    def _units(self, force: Disturbance, unit: Array | np.ndarray) -> Array:
        """Of each part's size: the full thrust of its axis, or of the stronger one; of a current 1 m/s."""
        wrenches = jnp.tile(jnp.asarray(unit), 2 if force.swells else 1)
        out = [wrenches]
        if force.drifts:
            plane = [unit[i] for i, axis in enumerate(force.axes) if axis < PLANE]
            out.append(jnp.max(jnp.stack(plane))[None])
        return jnp.concatenate([*out, *([jnp.ones(1)] * force.flows)])

    def unusual(self, force: Disturbance, unit: Array) -> Float[Array, ""]:
        """Minus twice the logarithm of the prior's density."""
        n, size = self.axes, force.size / self._units(force, unit)
        wrenches = size[: len(size) - force.flows]
        out = USUAL_SIZE.unusual(wrenches).sum() + USUAL_MEMORY.unusual(force.time[:n]).sum()
        if force.swells:
            out += SWELL_MEMORY.unusual(force.time[n]) + SWELL_FREQUENCY.unusual(force.frequency[n])
        if force.drifts:
            out += DRIFT_MEMORY.unusual(force.time[len(size) - force.flows - 1])
        if force.flows:
            out += USUAL_FLOW.unusual(size[-1]) + FLOW_MEMORY.unusual(force.time[-1])
        return out


def count_of(force: Disturbance) -> int:
    """How many `Logarithms` a disturbance has."""
    meaning = Logarithms(len(force.axes))
    return len(meaning.of(force, np.ones(meaning.axes)))


def unlearned(force: Disturbance) -> Float[np.ndarray, "logarithms logarithms"]:
    """Covariance by the curvature, as of `estimated`, that is usual of the `Logarithms` in some minutes.

    It is as of sizes that are known to 10 %, memories to 20 %, and periods to 1.5 %, as they were where
    disturbances were seen well; of a current, which is seen worse, to 30 %. A search for what is known less
    well may end some nats too soon, and goes on where it is done in turn with other numbers.
    """
    size, memory, period, flow = 0.1**2, 0.2**2, 0.015**2, 0.3**2
    meaning = Logarithms(len(force.axes))
    return 0.5 * np.diag(
        meaning._of_kinds(force, [size, memory], [size, memory, period], [size, memory], [flow, flow])
    )


def unusual(force: Disturbance, unit: Float[np.ndarray, " axes"]) -> float:
    """Minus twice the logarithm of the prior's density of a disturbance, but for a constant; 0 at its most.

    - `unit`: as of `estimated`.
    """
    return float(Logarithms(len(force.axes)).unusual(force, jnp.asarray(unit)))


def by_plane(
    axes: tuple[int, ...], attitude: Float[Array, "*samples 4"]
) -> Float[Array, "*samples axes plane"]:
    """What a force to the north and one to the east are on some of the six axes of a craft."""
    turns = jnp.vectorize(rotation, signature="(q)->(i,j)")(attitude)[..., :PLANE, :]
    on_six = jnp.pad(jnp.swapaxes(turns, -1, -2), [(0, 0)] * (attitude.ndim - 1) + [(0, 3), (0, 0)])
    return on_six[..., np.array(axes), :]


def without_swell(
    force: Disturbance, covariance: Float[np.ndarray, "logarithms logarithms"]
) -> tuple[Disturbance, Float[np.ndarray, "some some"]]:
    """The disturbance without the swell that it has, and what is known of the `Logarithms` that are left."""
    n = len(force.axes)
    parts, logarithms = np.arange(len(force.size)), np.arange(len(covariance))
    left = (parts < n) | (parts >= 2 * n)
    kept = (logarithms < 2 * n) | (logarithms >= 3 * n + 2)
    some = {name: getattr(force, name)[left] for name in ("size", "time", "frequency")}
    return dataclasses.replace(force, **some), covariance[np.ix_(kept, kept)]


def drifting(
    force: Disturbance, size: float | Array, time: float | Array = DRIFT_MEMORY.median
) -> Disturbance:
    """The disturbance with a drift of some size [N] and memory [s] beside it."""
    at = len(force.size) - force.flows
    return dataclasses.replace(
        force,
        size=jnp.insert(force.size, at, size),
        time=jnp.insert(force.time, at, time),
        frequency=jnp.insert(force.frequency, at, 0.0),
        drifts=True,
    )


def flowing(force: Disturbance, size: float = USUAL_FLOW.median) -> Disturbance:
    """The disturbance with a current of some size [m/s] and of a usual memory beside it."""
    return dataclasses.replace(
        force,
        size=jnp.append(force.size, size),
        time=jnp.append(force.time, FLOW_MEMORY.median),
        frequency=jnp.append(force.frequency, 0.0),
        flows=True,
    )
