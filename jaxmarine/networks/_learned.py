"""A wrench that no known effect explains, learned as a network of measured signals."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._types import ATTITUDE, DOFS, POSITION, RATE, VELOCITY, Scalar, Wrench
from ..effects import Craft, Motion, WrenchEffect
from ..physics import to_euler_matrix
from ._seen import faded
from ._term import LearnedTerm, check_shapes

# Every signal that a residual is tested against, besides the thrusters' commands.
SIGNALS = (*POSITION, *ATTITUDE, *VELOCITY, *RATE, "t")


def signals_known(name: str, thrusters: tuple[str, ...]) -> bool:
    """Whether a learned term can depend on that signal."""
    return name in SIGNALS or name in thrusters


def signals(motion: Motion, names: tuple[str, ...], thrusters: tuple[str, ...]) -> Array:
    """Values of named signals; angles as sine and cosine, velocities relative to the water."""
    angles = to_euler_matrix(motion.rotation)
    out = []
    for name in names:
        if name in ATTITUDE:
            angle = angles[ATTITUDE.index(name)]
            out += [jnp.sin(angle), jnp.cos(angle)]
        elif name in POSITION:
            out.append(motion.position[POSITION.index(name)])
        elif name in VELOCITY + RATE:
            out.append(motion.nu_r[(VELOCITY + RATE).index(name)])
        elif name == "t":
            out.append(motion.t)
        elif name in thrusters:
            out.append(motion.command[thrusters.index(name)])
        else:
            raise ValueError(f"`{name}` is neither a signal nor a thruster.")
    return jnp.stack(out)


class LearnedWrench(LearnedTerm, WrenchEffect):
    r"""A force on one axis as a network of named signals, $\tau_i = s\, W_2 \tanh(W_1 x + b_1) + s\, b_2$.

    - `weight_1` [hidden, inputs], `bias_1`, `weight_2` [hidden], `bias_2`: the network, zero at the start
      in its last layer, so that the unfitted vehicle is the physics.
    - `low`, `high`: range of each input in the data it was fitted on; outside it the input is clipped, so
      that the term stays what it was at the edge and does not run away. Beyond the places seen it fades out
      over the width of a unit's step instead: what pulls here says nothing of elsewhere.
    - `scale` [N or N m]: size of the output.

    Source: thesis sec. 4.1 (a network parallel to the model), kept to the signals that the residual
    depends on.
    """

    name: ClassVar[str] = "unknown"

    weight_1: Float[Array, "hidden inputs"]
    bias_1: Float[Array, " hidden"]
    weight_2: Float[Array, " hidden"]
    bias_2: Float[Array, ""]
    low: Float[Array, " inputs"]
    high: Float[Array, " inputs"]
    scale: Float[Array, ""]
    target: str = eqx.field(static=True)
    thrusters: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def check(cls, craft: Craft, target: str | None, inputs: tuple[str, ...]) -> None:
        if target not in craft.dof:
            raise ValueError(f"has the target `{target}`, but must name a free axis: {', '.join(craft.dof)}.")
        for name in inputs:
            if not signals_known(name, craft.drive_names):
                raise ValueError(f"has the input `{name}`, which is neither a signal nor a thruster.")

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        hidden = len(arrays["weight_2"])
        # An angle comes as sine and cosine.
        columns = sum(2 if name in ATTITUDE else 1 for name in inputs)
        shapes = {"weight_1": (hidden, columns), "bias_1": (hidden,), "weight_2": (hidden,), "bias_2": ()}
        check_shapes(arrays, shapes | {"low": (columns,), "high": (columns,), "scale": ()})
        values = {name: jnp.asarray(value) for name, value in arrays.items()}
        return cls(**values, target=str(target), inputs=inputs, thrusters=craft.drive_names)

    @property
    def network(self) -> tuple[Any, ...]:
        """What is trained."""
        return self.weight_1, self.bias_1, self.weight_2, self.bias_2

    def with_network(self, network: tuple[Array, ...]) -> "LearnedWrench":
        """The same term with other weights."""
        return eqx.tree_at(lambda term: term.network, self, network)

    def force(self, inputs: Float[Array, " inputs"], network: tuple[Array, ...]) -> Scalar:
        """The force for given inputs and weights [N or N m]."""
        weight_1, bias_1, weight_2, bias_2 = network
        # Squares the range to [-1, 1]; a signal that never moved stays at zero.
        width = jnp.where(self.high > self.low, self.high - self.low, 1.0)
        x = 2.0 * (jnp.clip(inputs, self.low, self.high) - self.low) / width - 1.0
        hidden = jnp.tanh((weight_1 * x[None]).sum(-1) + bias_1)
        return self._seen(inputs) * self.scale * ((weight_2 * hidden).sum() + bias_2)

    def _seen(self, inputs: Float[Array, " inputs"]) -> Scalar:
        """1 at the places seen, 0 away from them."""
        columns = [(name,) * (2 if name in ATTITUDE else 1) for name in self.inputs]
        places = np.array([name in POSITION for names in columns for name in names])
        width = 2.0 / len(self.bias_1) * (self.high - self.low) + 1e-9
        beyond = jnp.maximum(jnp.maximum(self.low - inputs, inputs - self.high), 0.0) / width
        return jnp.prod(jnp.where(places, faded(beyond), 1.0))

    def __call__(self, motion: Motion) -> Wrench:
        inputs = signals(motion, self.inputs, self.thrusters)
        return jnp.zeros(6).at[DOFS.index(self.target)].set(self.force(inputs, self.network))


def learned_wrench(
    target: str,
    inputs: tuple[str, ...],
    thrusters: tuple[str, ...],
    low: Float[np.ndarray, " inputs"],
    high: Float[np.ndarray, " inputs"],
    scale: float,
    key: PRNGKeyArray,
    hidden: int = 8,
) -> LearnedWrench:
    """An untrained term: random in its first layer, zero in its last."""
    weights = jax.random.normal(key, (hidden, len(low) + 1))
    return LearnedWrench(
        weight_1=weights[:, :-1],
        bias_1=weights[:, -1],
        weight_2=jnp.zeros(hidden),
        bias_2=jnp.zeros(()),
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        scale=jnp.asarray(scale, float),
        target=target,
        inputs=inputs,
        thrusters=thrusters,
    )
