"""Random processes of size one: what wanders, and a swell.

    x' = rate x + kick w,    w white noise,    of which one number comes out with a standard deviation of 1.

What wanders is the process of Gauss and Markov, x' = -x / time + sqrt(2 / time) w.

Waves push to and fro, and with frequencies far from their peak's hardly at all. Of white noise the filter

    h(s) = s / (s^2 + 2 s / time + 1 / time^2 + frequency^2)

leaves amplitudes that fall as the frequency below its peak and as its inverse above. Those of a sea fall
faster, most of all below their peak, where a force moves a craft farthest: there a cause would be looked for
in what the filter lets through and the sea does not. A swell is what two of them leave, one after the other.
Each is a pair of numbers, of which the first comes out,

    p' = [[-1 / time, -frequency], [frequency, -1 / time]] p + b u,    b ~ (1, 1 / (frequency time)),

with such a b that there is no numerator but s; u is white noise for the first pair, and for the second what
comes out of the first.

Source: after Van Loan (1978) on what is new in a process and in its integral over a step, Fossen (2021) on
filters for waves, and Hasselmann et al. (1973) on the spectrum of a sea.
"""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

# Places in [-1, 1] and their weights, for integrals over a hold (Gauss, Legendre): exact to a thousandth of a
# process' variance where its memory is a thirtieth of a hold and it turns less than two turns in one.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)


class Hold(NamedTuple):
    """The mean of a process over a hold: by its first states, and what is new in it.

    - `variance` of what is new in the mean; `covariance` of what is new in the states at the end with that;
      `new`: that of these states. They are sums of products of the same numbers: no rounding and no step
      that is too long for them makes a variance of any of it less than nothing.
    """

    mean: Float[Array, "*parts states states"]
    variance: Float[Array, "*parts states states"]
    covariance: Float[Array, "*parts states states"]
    new: Float[Array, "*parts states states"]


class Process(eqx.Module):
    """White noise through a filter. `time`: its memory [s], in which the filter forgets all but 1/e.

    After it 1/e is left of what wanders, and 2/e of a swell, as much of which is left as there is after two
    filters in a row.
    """

    time: eqx.AbstractVar[Float[Array, ""]]

    @property
    @abstractmethod
    def kick(self) -> Float[Array, " states"]:
        """What a number that is new, of size one in a second, adds to its states."""

    @property
    @abstractmethod
    def spread(self) -> Float[Array, "states states"]:
        """Covariance of its states, after many memories."""

    @abstractmethod
    def left(self, t: Float[Array, ""]) -> Float[Array, "states states"]:
        """What is left of its states after some time [s]: exp(rate t)."""

    @abstractmethod
    def summed(self, t: Float[Array, ""]) -> Float[Array, "states states"]:
        """The integral of what is left from 0 to some time [s]."""

    def new(self, t: Float[Array, ""]) -> Float[Array, "states states"]:
        """Covariance of what is new in its states after some time [s]."""
        left, spread = self.left(t), self.spread
        return spread - left @ spread @ left.T

    def over(self, dt: Float[Array, ""]) -> Hold:
        """What its states are on the average over a hold of some length [s], which is not nothing.

        What is new some time before the hold's end adds to the end what is left of it, and to the mean what
        is left on the average.
        """

        def products(t):
            """Of what is new so long before the end in the mean and at the end."""
            mean, end = self.summed(t) @ self.kick / dt, self.left(t) @ self.kick
            return jnp.outer(mean, mean), jnp.outer(end, mean), jnp.outer(end, end)

        within = jax.vmap(products)(0.5 * dt * (1.0 + NODES))
        # The weights are of an integral from -1 to 1.
        return Hold(self.summed(dt) / dt, *(0.5 * dt * jnp.tensordot(WEIGHTS, one, 1) for one in within))


class Wander(Process):
    """The process of Gauss and Markov: one number."""

    time: Float[Array, ""]

    @property
    def kick(self) -> Float[Array, "1"]:
        return jnp.sqrt(2.0 / self.time)[None]

    @property
    def spread(self) -> Float[Array, "1 1"]:
        return jnp.ones_like(self.time)[None, None]

    def left(self, t: Float[Array, ""]) -> Float[Array, "1 1"]:
        return jnp.exp(-t / self.time)[None, None]

    def summed(self, t: Float[Array, ""]) -> Float[Array, "1 1"]:
        return (-jnp.expm1(-t / self.time) * self.time)[None, None]

    def new(self, t: Float[Array, ""]) -> Float[Array, "1 1"]:
        # As `Process.new`, with all digits of a short time.
        return -jnp.expm1(-2.0 * t / self.time)[None, None]


class Swell(Process):
    """Two pairs of numbers, the second driven by the first. `frequency` [rad/s].

    Both are scaled so that the first number of either has a standard deviation of 1.
    """

    time: Float[Array, ""]
    frequency: Float[Array, ""]
    # How many states it has, and how it is read from them.
    STATES: ClassVar[int] = 4
    READ: ClassVar[np.ndarray] = np.array([0.0, 0.0, 1.0, 0.0])

    @property
    def _slow(self) -> Float[Array, ""]:
        return 1.0 / (self.frequency * self.time)

    @property
    def kick(self) -> Float[Array, "4"]:
        one = 2.0 / jnp.sqrt(self.time)
        return jnp.stack([one, one * self._slow, jnp.zeros_like(one), jnp.zeros_like(one)])

    @property
    def _drive(self) -> Float[Array, "2 2"]:
        """What the first pair adds to the second in a second."""
        one = 2.0 * np.sqrt(2.0) / self.time
        zero = jnp.zeros_like(one)
        return jnp.stack([one, zero, one * self._slow, zero]).reshape(2, 2)

    @property
    def spread(self) -> Float[Array, "4 4"]:
        slow, one = self._slow, jnp.ones_like(self._slow)
        pair = jnp.stack([one, slow, slow, 1.0 + 2.0 * slow**2]).reshape(2, 2)
        # The solution of Lyapunov's equation.
        return jnp.kron(jnp.array([[1.0, np.sqrt(0.5)], [np.sqrt(0.5), 1.0]]), pair)

    def left(self, t: Float[Array, ""]) -> Float[Array, "4 4"]:
        return jnp.eye(self.STATES) + self._change(t)

    def _change(self, t: Float[Array, ""]) -> Float[Array, "4 4"]:
        """Of its states until some time later [s], with all digits of its pairs where that is short."""
        rate, drive = -1.0 / self.time + 1j * self.frequency, self._drive
        # The part of the drive that turns as the pairs do adds up; the rest comes and goes.
        quarter = _as_matrix(jnp.array(1j))
        alike = 0.5 * (drive - quarter @ drive @ quarter)
        turned = jnp.exp(rate * t)
        driven = t * alike @ _as_matrix(turned) + turned.imag / self.frequency * (drive - alike)
        return _in_a_row(_as_matrix(jnp.expm1(rate * t)), driven)

    def summed(self, t: Float[Array, ""]) -> Float[Array, "4 4"]:
        inverse = _as_matrix(1.0 / (-1.0 / self.time + 1j * self.frequency))
        return _in_a_row(inverse, -inverse @ self._drive @ inverse) @ self._change(t)

    def out(self, states: Float[Array, "*axes 4"]) -> Float[Array, "*axes 2"]:
        """What comes out, and that a quarter of a turn before: how fast it falls, by the frequency.

        Of a wave that goes on as cos(frequency t) of the one and sin(frequency t) of the other less.
        """
        rate = _in_a_row(_as_matrix(-1.0 / self.time + 1j * self.frequency), self._drive)
        return states @ jnp.stack([jnp.asarray(self.READ), -self.READ @ rate / self.frequency], axis=1)


def _as_matrix(factor: Complex[Array, ""]) -> Float[Array, "2 2"]:
    """What a complex factor does to a pair."""
    return jnp.stack([factor.real, -factor.imag, factor.imag, factor.real]).reshape(2, 2)


def _in_a_row(each: Float[Array, "2 2"], driven: Float[Array, "2 2"]) -> Float[Array, "4 4"]:
    """What is done to either of two pairs, and by the first to the second."""
    return jnp.block([[each, jnp.zeros((2, 2))], [driven, each]])
