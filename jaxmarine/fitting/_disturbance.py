"""What disturbs a craft, as random processes with a memory: a wrench on each axis, a swell, and a current.

    d' = -d / time + w,    standard deviation `size`

is the wrench on an axis (Gauss, Markov). A swell on it also turns with a frequency: it is the first component
of a pair

    p' = -p / time + [[0, -frequency], [frequency, 0]] p + w,    standard deviation `size` of each.

A current is the water's velocity to the north and to the east: two numbers like the first. What a current
does to a craft turns with its heading and grows with its speed, as no wrench does.

Between two samples a craft is moved by what pushed on the average, which at the first of them is known in
part only: of a disturbance that forgets within a sample's time hardly anything is (`Disturbance.over`). The
mean is all that is told of a hold: that an early push moves a craft farther than a late one is left out. It
shows where positions are known better than to a tenth of what a push moves a craft in a sample's time.

Source: after Van Loan (1978) on what is new in a process and in its integral over a step.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ._windows import FLOW


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
# Of a current that wanders: size [m/s], and memory [s].
USUAL_FLOW, FLOW_MEMORY = Usual(0.06, 1.0), Usual(40.0, 1.0)


# Places in [-1, 1] and their weights, for integrals over a hold (Gauss, Legendre): exact to a thousandth of a
# disturbance's variance where it remembers a thirtieth of a hold and turns less than two turns in one.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)


class Disturbance(eqx.Module):
    """A Gauss-Markov wrench on the hull, a swell, and a current.

    - `size`: standard deviation [N, N m, m/s]; `time`: in which it forgets all but 1/e [s]; `frequency`
      [rad/s], 0 of what does not swing. First of the wrench on each axis, then of the swell, if there is one,
      last of the current, if there is one, alike to the north and to the east.
    - `gap`: from the end of the last hold of the window before to the first sample of each window [s], many
      memories where a log begins; `joined`: whether a window goes on in the state of the one before.
    - `axes`: those on which it acts; `flows`: whether there is a current.
    """

    size: Float[Array, " parts"]
    time: Float[Array, " parts"]
    frequency: Float[Array, " parts"]
    gap: Float[Array, " windows"]
    joined: Bool[Array, " windows"]
    axes: tuple[int, ...] = eqx.field(static=True)
    flows: bool = eqx.field(static=True, default=False)

    @property
    def swells(self) -> bool:
        return len(self.size) - self.flows > len(self.axes)

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether there is a swell, and a current."""
        return self.swells, self.flows

    @property
    def states(self) -> int:
        return len(self.axes) * (3 if self.swells else 1) + FLOW * self.flows

    @property
    def output(self) -> Float[Array, "pushes states"]:
        """From its states to the wrench on its axes, and to the water's velocity."""
        own = jnp.eye(len(self.axes))
        if self.swells:
            own = jnp.concatenate([own, jnp.kron(own, jnp.array([[1.0, 0.0]]))], axis=1)
        flow = jnp.eye(FLOW) if self.flows else jnp.zeros((FLOW, 0))
        return jax.scipy.linalg.block_diag(own, flow)

    def _of_states(self, of_parts: Float[Array, " parts"]) -> Float[Array, " states"]:
        count = len(self.axes)
        return jnp.concatenate([of_parts[:count], jnp.repeat(of_parts[count:], 2)])

    @property
    def level(self) -> Float[Array, " states"]:
        """Standard deviation of its states, after many memories."""
        return self._of_states(self.size)

    def after(self, dt: Float[Array, ""], states: Float[Array, "states columns"]):
        """What is left of its states [states, columns] after some time [s]."""
        left = jnp.exp(-dt / self._of_states(self.time))[:, None] * states
        if not self.swells:
            return left
        count = len(self.axes)
        angle = (self.frequency[count : 2 * count] * dt)[:, None]
        here, there = left[count : 3 * count : 2], left[count + 1 : 3 * count : 2]
        turned = (
            jnp.cos(angle) * here - jnp.sin(angle) * there,
            jnp.sin(angle) * here + jnp.cos(angle) * there,
        )
        pairs = jnp.stack(turned, axis=1).reshape(2 * count, -1)
        return jnp.concatenate([left[:count], pairs, left[3 * count :]])

    def new(self, dt: Float[Array, ""]) -> Float[Array, " states"]:
        """Variance of what is new in its states after some time [s]."""
        return self.level**2 * -jnp.expm1(-2 * dt / self._of_states(self.time))

    def over(self, dt: Float[Array, ""]) -> "Hold":
        """What its states are on the average over a hold of some length [s], which is not nothing.

        A pair is one complex number here, which goes on as exp(-rate t). What is new in it some time before
        the hold's end adds to the end as exp(-rate t), and to the mean as that does on the average.
        """
        rate = 1.0 / self.time - 1j * self.frequency

        def adds(t):
            """To the mean, of one that is new so long before the end."""
            return -jnp.expm1(-rate * t) / (rate * dt)

        def square(t):
            """Of that, and its product with what it adds to the end."""
            return jnp.abs(adds(t)) ** 2 + 0j, jnp.exp(-rate * t) * jnp.conj(adds(t))

        # Twice the variance over the memory is new in a second; the weights are of an integral from -1 to 1.
        new = dt * self.size**2 / self.time
        within = [WEIGHTS @ one for one in jax.vmap(square)(0.5 * dt * (1.0 + NODES))]
        return Hold(*map(self._matrix, (adds(dt), *(new * one for one in within))))

    def _matrix(self, of_parts: Complex[Array, " parts"]) -> Float[Array, "states states"]:
        """Complex factors of its parts as a matrix on its states."""
        count = len(self.axes)
        single, pairs = of_parts.real, of_parts[count : 2 * count]
        blocks = [jnp.diag(single[:count])]
        if self.swells:
            turns = jnp.array([[pairs.real, -pairs.imag], [pairs.imag, pairs.real]])
            blocks.append(jax.scipy.linalg.block_diag(*jnp.moveaxis(turns, -1, 0)))
        if self.flows:
            blocks.append(single[-1] * jnp.eye(FLOW))
        return jax.scipy.linalg.block_diag(*blocks)


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
    frequency [rad/s]; last of a current its size [m/s] and its memory [s].
    """

    axes: int

    def of(self, force: Disturbance, unit: np.ndarray) -> Float[np.ndarray, " logarithms"]:
        n, size = self.axes, np.asarray(force.size / self._units(force, unit))
        time, frequency = np.asarray(force.time), np.asarray(force.frequency)
        swell = [size[n : 2 * n], time[n : n + 1], frequency[n : n + 1]] if force.swells else []
        flow = [size[-1:], time[-1:]] if force.flows else []
        return np.log(np.concatenate([size[:n] / np.sqrt(time[:n]), time[:n], *swell, *flow]))

    def set(self, force: Disturbance, unit: Array, values: Float[Array, " logarithms"]) -> Disturbance:
        n, values = self.axes, jnp.exp(values)
        size, time, frequency = values[:n] * jnp.sqrt(values[n : 2 * n]), values[n : 2 * n], jnp.zeros(n)
        if force.swells:
            size = jnp.concatenate([size, values[2 * n : 3 * n]])
            time = jnp.concatenate([time, jnp.full(n, values[3 * n])])
            frequency = jnp.concatenate([frequency, jnp.full(n, values[3 * n + 1])])
        if force.flows:
            size, time = jnp.append(size, values[-2]), jnp.append(time, values[-1])
            frequency = jnp.append(frequency, 0.0)
        size = size * self._units(force, unit)
        return dataclasses.replace(force, size=size, time=time, frequency=frequency)

    def _of_kinds(
        self, force: Disturbance, own: list[float], swell: list[float], flow: list[float]
    ) -> Float[np.ndarray, " logarithms"]:
        """A number for each, by its kind: of the wrench on an axis (2), of a swell (3), of a current (2)."""
        n = self.axes
        swells = np.repeat(swell, [n, 1, 1]) if force.swells else []
        return np.concatenate([np.repeat(own, n), swells, flow if force.flows else []])

    def new(self, force: Disturbance) -> Float[np.ndarray, " logarithms"]:
        """Of each size, how many numbers are new at a time that are as large as it; 0 of all others."""
        return self._of_kinds(force, [1.0, 0.0], [2.0, 0.0, 0.0], [2.0, 0.0])

    def _units(self, force: Disturbance, unit: Array | np.ndarray) -> Array:
        """Of each part's size: the full thrust of its axis, of a current 1 m/s."""
        wrenches = jnp.tile(jnp.asarray(unit), 2 if force.swells else 1)
        return jnp.append(wrenches, 1.0) if force.flows else wrenches

    def unusual(self, force: Disturbance, unit: Array) -> Float[Array, ""]:
        """Minus twice the logarithm of the prior's density."""
        n, size = self.axes, force.size / self._units(force, unit)
        wrenches = size[:-1] if force.flows else size
        out = USUAL_SIZE.unusual(wrenches).sum() + USUAL_MEMORY.unusual(force.time[:n]).sum()
        if force.swells:
            out += SWELL_MEMORY.unusual(force.time[n]) + SWELL_FREQUENCY.unusual(force.frequency[n])
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
    return 0.5 * np.diag(meaning._of_kinds(force, [size, memory], [size, memory, period], [flow, flow]))


def unusual(force: Disturbance, unit: Float[np.ndarray, " axes"]) -> float:
    """Minus twice the logarithm of the prior's density of a disturbance, but for a constant; 0 at its most.

    - `unit`: as of `estimated`.
    """
    return float(Logarithms(len(force.axes)).unusual(force, jnp.asarray(unit)))


def flowing(force: Disturbance, size: float = USUAL_FLOW.median) -> Disturbance:
    """The disturbance with a current of some size [m/s] and of a usual memory beside it."""
    return dataclasses.replace(
        force,
        size=jnp.append(force.size, size),
        time=jnp.append(force.time, FLOW_MEMORY.median),
        frequency=jnp.append(force.frequency, 0.0),
        flows=True,
    )
