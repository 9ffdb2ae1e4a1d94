"""The networks of the thesis' damping, and the term that puts them into a vehicle (thesis, sec. 4.3.4)."""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._types import DOFS, Velocity, Wrench
from ..effects import Craft, Motion
from ..physics import apply
from ._term import LearnedDamping, check_shapes

Form = Literal["free", "zero_at_rest", "dissipative"]

LOWER = np.tril_indices(6)
SKEW = np.tril_indices(6, -1)


class Perceptron(eqx.Module):
    """One hidden layer of hyperbolic tangents and a linear node for each output; or several, stacked."""

    weight_1: Float[Array, "*nets hidden inputs"]
    bias_1: Float[Array, "*nets hidden"]
    weight_2: Float[Array, "*nets outputs hidden"]
    bias_2: Float[Array, "*nets outputs"]

    def __call__(self, x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return apply(self.weight_2, jnp.tanh(apply(self.weight_1, x) + self.bias_1)) + self.bias_2


def perceptron(inputs: int, hidden: int, outputs: int, key: PRNGKeyArray) -> Perceptron:
    """Random weights for inputs and outputs of size one."""
    first, second, third = jax.random.split(key, 3)
    return Perceptron(
        weight_1=jax.random.normal(first, (hidden, inputs)) / np.sqrt(inputs),
        bias_1=jax.random.uniform(second, (hidden,), minval=-1.0, maxval=1.0),
        weight_2=jax.random.normal(third, (outputs, hidden)) / np.sqrt(hidden),
        bias_2=jnp.zeros(outputs),
    )


class DampingNetworks(eqx.Module):
    """D(nu) nu [N, N m] as networks of (nu, |nu|).

    - `form`: "free" and "zero_at_rest" are six networks of one output each, the second less its value at
      rest; "dissipative" is one network for the entries of D(nu) = L L' + K with L lower triangular and K
      skew, so that nu' D(nu) nu is never negative.
    """

    networks: Perceptron
    input_scale: Float[Array, "6"]
    output_mean: Float[Array, "6"]
    output_scale: Float[Array, "6"]
    form: Form = eqx.field(static=True)

    def __call__(self, nu: Velocity) -> Wrench:
        x = with_magnitudes(nu / self.input_scale)
        if self.form == "dissipative":
            shown = _dissipative(self.networks, x)
        else:
            shown = jax.vmap(lambda net: FORMS[self.form](net, x)[0])(self.networks)
        return self.output_mean + self.output_scale * shown


def with_magnitudes(x: Velocity) -> Float[Array, "12"]:
    return jnp.concatenate([x, jnp.abs(x)])


def _zero_at_rest(network: Perceptron, x: Float[Array, "12"]) -> Float[Array, " outputs"]:
    return network(x) - network(jnp.zeros_like(x))


def _dissipative(network: Perceptron, x: Float[Array, "12"]) -> Float[Array, "6"]:
    """(L L' + K) x with the network's entries; in scaled units, which leave the sign of the power only
    where forces and velocities are scaled alike (`train_damping` sees to that)."""
    entries = network(x)
    factor = jnp.zeros((6, 6)).at[LOWER].set(entries[: len(LOWER[0])])
    skew = jnp.zeros((6, 6)).at[SKEW].set(entries[len(LOWER[0]) :])
    return (factor @ factor.T + skew - skew.T) @ x[:6]


# What a network of the damping shows for scaled velocities and their magnitudes.
FORMS = {"free": Perceptron.__call__, "zero_at_rest": _zero_at_rest, "dissipative": _dissipative}


class NetworkDamping(LearnedDamping):
    """The whole damping of a vehicle as the networks show it, tau = -D(nu_r) nu_r [N, N m].

    What "free" networks show at rest or beyond the data is used as it is: nothing bounds it there, and it may
    push. Those that are "dissipative" brake at every velocity. Source: thesis sec. 4.3.4.
    """

    name: ClassVar[str] = "network_damping"

    networks: DampingNetworks

    @classmethod
    def check(cls, craft: Craft, target: str | None, inputs: tuple[str, ...]) -> None:
        del craft, target
        if inputs != DOFS:
            raise ValueError("is the damping of all six axes and needs them as `inputs`.")

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name; which form they have shows in their shapes."""
        nets, own = self.networks.networks, self.networks
        if own.form == "zero_at_rest":
            # Its value at rest goes into the last bias.
            nets = eqx.tree_at(lambda n: n.bias_2, nets, -_linear(nets, jnp.tanh(nets.bias_1)))
        scales = (own.input_scale, own.output_mean, own.output_scale)
        values = (nets.weight_1, nets.bias_1, nets.weight_2, nets.bias_2, *scales)
        return {name: np.asarray(value) for name, value in zip(_ARRAYS, values, strict=True)}

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        del craft, target
        hidden = np.shape(arrays["weight_1"])[-2]
        form: Form = "dissipative" if np.ndim(arrays["weight_1"]) == 2 else "free"
        outputs = len(LOWER[0]) + len(SKEW[0]) if form == "dissipative" else 1
        of_one = ((hidden, 12), (hidden,), (outputs, hidden), (outputs,))
        shapes = of_one if form == "dissipative" else tuple((6, *shape) for shape in of_one)
        check_shapes(arrays, dict(zip(_ARRAYS, (*shapes, (6,), (6,), (6,)), strict=True)))
        values = [jnp.asarray(arrays[name], float) for name in _ARRAYS]
        return cls(networks=DampingNetworks(Perceptron(*values[:4]), *values[4:], form=form), inputs=inputs)

    def __call__(self, motion: Motion) -> Wrench:
        return -self.networks(motion.nu_r)


_ARRAYS = ("weight_1", "bias_1", "weight_2", "bias_2", "input_scale", "output_mean", "output_scale")


def _linear(nets: Perceptron, hidden: Float[Array, "6 hidden"]) -> Float[Array, "6 1"]:
    return jax.vmap(apply)(nets.weight_2, hidden)
