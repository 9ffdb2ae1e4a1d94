"""Damping as a network of the velocity, inside the physics."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._types import DOFS, Wrench
from ..effects import Craft, Motion
from ._seen import Seen, moved
from ._term import LearnedDamping, check_shapes

# Equinox' first weights are below one over the root of the inputs: over inputs of one the units would
# all be straight lines, and their solve long. So steep, each bends somewhere in the data.
_STEEP = 3.0


class MLPDamping(LearnedDamping):
    r"""Damping beside that of the vehicle, $\tau_a = \gamma(\nu_r) s_o (f(\nu_r / s_i) - f(0))$ on some axes.

    - `network`: the arrays of the multilayer perceptron f, from the velocities of the chosen axes
      to forces on them; zero at first in its last layer: the unfitted vehicle is the physics.
    - `input_scale` [m/s, rad/s]: largest speeds in the data; `output_scale` [N, N m]: size of the forces.
    - `seen`: the gate $\gamma$; beyond the velocities seen the term fades out, so that what is left there is
      the vehicle's own damping. That is the best classical law only if it was fitted before, and held.

    There is no force at rest, by construction. Nothing makes the force dissipative. Source: thesis
    sec. 4.1 (a network parallel to the model), as a term of the equations of motion.
    """

    name: ClassVar[str] = "mlp_damping"

    network: eqx.nn.MLP
    input_scale: Float[Array, " axes"]
    output_scale: Float[Array, " axes"]
    seen: Seen
    # Activations are no arrays, and all that a plant holds must be.
    frame: eqx.nn.MLP = eqx.field(static=True)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, layer by layer."""
        out = {"input_scale": self.input_scale, "output_scale": self.output_scale}
        for k, layer in enumerate(self.network.layers):
            out |= {f"weight_{k}": layer.weight, f"bias_{k}": layer.bias}
        out |= self.seen.arrays()
        return {name: np.asarray(value) for name, value in out.items() if value is not None}

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        del craft, target
        depth = sum(name.startswith("weight_") for name in arrays) - 1
        one, width = np.ones(len(inputs)), len(arrays["weight_0"])
        term = mlp_damping(inputs, one, one, jax.random.key(0), width=width, depth=depth)
        check_shapes(arrays, {name: value.shape for name, value in term.arrays().items()})

        def stored(term: Self) -> list[Array | None]:
            layers = term.network.layers
            biases = [layer.bias for layer in layers[:-1]]
            return [term.input_scale, term.output_scale, *[x.weight for x in layers], *biases]

        term = eqx.tree_at(lambda t: t.seen, term, Seen.restored(arrays))
        names = ["input_scale", "output_scale", *(f"weight_{k}" for k in range(depth + 1))]
        names += [f"bias_{k}" for k in range(depth)]
        return eqx.tree_at(stored, term, [jnp.asarray(arrays[name], float) for name in names])

    def __call__(self, motion: Motion) -> Wrench:
        places = np.array([DOFS.index(axis) for axis in self.inputs])
        network = eqx.combine(self.network, self.frame)
        x = motion.nu_r[places] / self.input_scale
        force = self.seen(motion.nu_r[places]) * self.output_scale * (network(x) - network(jnp.zeros_like(x)))
        return jnp.zeros(6).at[places].set(force)


def mlp_damping(
    axes: Sequence[str],
    speed: Float[np.ndarray, " axes"],
    force: Float[np.ndarray, " axes"],
    key: PRNGKeyArray,
    width: int = 8,
    depth: int = 1,
    seen: Float[np.ndarray, "samples axes"] | None = None,
) -> MLPDamping:
    """An untrained term on `axes`: random but for its last layer, which is zero.

    - `speed` [m/s, rad/s], `force` [N, N m]: sizes per axis, which scale inputs and outputs.
    - `seen`: velocities of the data [m/s, rad/s]; None: the ellipsoid about the box of `speed`.
    """
    # No bias in the last layer: the subtracted value at rest would cancel it.
    network = eqx.nn.MLP(
        len(axes),
        len(axes),
        width,
        depth,
        activation=jnp.tanh,
        use_final_bias=False,
        dtype=jnp.result_type(float),
        key=key,
    )
    network = eqx.tree_at(
        lambda net: (net.layers[0].weight, net.layers[0].bias), network, replace_fn=lambda a: _STEEP * a
    )
    network = eqx.tree_at(lambda net: net.layers[-1].weight, network, replace_fn=jnp.zeros_like)
    arrays, frame = eqx.partition(network, eqx.is_array)
    return MLPDamping(
        network=arrays,
        input_scale=jnp.asarray(moved(speed)),
        output_scale=jnp.asarray(np.asarray(force, float)),
        seen=Seen.within(speed) if seen is None else Seen.of(seen),
        frame=frame,
        inputs=tuple(axes),
    )
