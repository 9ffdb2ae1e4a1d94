"""Each coefficient of the damping matrix as a network of the velocity, inside the physics."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._types import DOFS, Wrench
from ..effects import Craft, Motion, Suspect, WrenchEffect
from ._seen import Seen

_NETWORK = ("weight_1", "bias_1", "weight_2")


class CoefficientDamping(WrenchEffect):
    r"""Damping beside that of the vehicle, $\tau_a = -\gamma(\nu_r) \sum_b d_{ab}(\nu_r) \nu_{r,b}$.

    $d_{ab} = s_{ab} W_2 \tanh(W_1 \nu_r / s_i + b_1)$, one small network for each coefficient that has a
    size; $\gamma$ is the gate of the velocities seen.

    - `weight_1` [entries, hidden, axes], `bias_1`, `weight_2` [entries, hidden]: the networks, row by row of
      the entries of `size` that are not zero; zero at first in the last layer.
    - `input_scale` [m/s, rad/s]: largest speeds in the data; `size` [N s/m, N s, N m s]: of coefficients.
    - `seen`: beyond it the term fades out, so that the classical damping is left.

    There is no force at rest, by construction; nothing makes it dissipative. Without the gate its
    coefficients level off outside the data, where a force from `MLPDamping` itself does. Source: thesis
    sec. 4.2 (networks for single parameters of the model).
    """

    name: ClassVar[str] = "coefficient_damping"
    units: ClassVar[Mapping[str, str]] = {}

    weight_1: Float[Array, "entries hidden axes"]
    bias_1: Float[Array, "entries hidden"]
    weight_2: Float[Array, "entries hidden"]
    input_scale: Float[Array, " axes"]
    size: Float[Array, "axes axes"]
    seen: Seen
    axes: tuple[str, ...] = eqx.field(static=True)
    entries: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @classmethod
    def neutral(cls, craft: Craft) -> Self:
        raise NotImplementedError("A learned term has no neutral value before it is built.")

    @classmethod
    def suspects(cls, craft: Craft) -> tuple[Suspect, ...]:
        del craft
        return ()

    @property
    def network(self) -> tuple[Array, ...]:
        """What is trained."""
        return self.weight_1, self.bias_1, self.weight_2

    @property
    def inputs(self) -> tuple[str, ...]:
        """What a vehicle file names: the axes."""
        return self.axes

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name."""
        own = {name: np.asarray(getattr(self, name)) for name in (*_NETWORK, "input_scale", "size")}
        return own | self.seen.arrays()

    @classmethod
    def restored(cls, arrays: Mapping[str, np.ndarray], axes: tuple[str, ...]) -> Self:
        """The term whose `arrays()` these were; ValueError where they do not fit together."""
        term = coefficient_damping(
            axes,
            arrays["input_scale"],
            arrays["size"],
            jax.random.key(0),
            hidden=np.shape(arrays["weight_1"])[1],
        )
        shapes = {name: value.shape for name, value in term.arrays().items()}
        if shapes != {name: np.shape(value) for name, value in arrays.items()}:
            raise ValueError(f"its arrays are not {shapes}")
        stored = [jnp.asarray(arrays[name], float) for name in _NETWORK]
        return eqx.tree_at(lambda t: (*t.network, t.seen), term, (*stored, Seen.restored(arrays)))

    def coefficients(self, velocity: Float[Array, " axes"]) -> Float[Array, "axes axes"]:
        """d at a velocity, without the gate [N s/m, N s, N m s]."""
        x = velocity / self.input_scale
        hidden = jnp.tanh((self.weight_1 * x[None, None]).sum(-1) + self.bias_1)
        rows, columns = np.array(self.entries).T
        values = self.size[rows, columns] * (self.weight_2 * hidden).sum(-1)
        return jnp.zeros_like(self.size).at[rows, columns].set(values)

    def __call__(self, motion: Motion) -> Wrench:
        places = np.array([DOFS.index(axis) for axis in self.axes])
        velocity = motion.nu_r[places]
        force = -self.seen(velocity) * (self.coefficients(velocity) * velocity[None]).sum(-1)
        return jnp.zeros(6).at[places].set(force)


def coefficient_damping(
    axes: Sequence[str],
    speed: Float[np.ndarray, " axes"],
    size: Float[np.ndarray, "axes axes"],
    key: PRNGKeyArray,
    hidden: int = 4,
    seen: Float[np.ndarray, "samples axes"] | None = None,
) -> CoefficientDamping:
    """Untrained networks on `axes`: random but for their last layers, which are zero.

    - `speed` [m/s, rad/s]: largest per axis; `size` [N s/m, N s, N m s]: of the coefficients, 0: none.
    - `seen`: velocities of the data [m/s, rad/s]; None: the ellipsoid about the box of `speed`.
    """
    size = np.asarray(size, float)
    entries = tuple((int(i), int(j)) for i, j in zip(*np.nonzero(size), strict=True))
    weights = jax.random.normal(key, (len(entries), hidden, len(axes) + 1))
    return CoefficientDamping(
        weight_1=weights[..., :-1],
        bias_1=weights[..., -1],
        weight_2=jnp.zeros((len(entries), hidden)),
        input_scale=jnp.asarray(np.asarray(speed, float)),
        size=jnp.asarray(size),
        seen=Seen.within(speed) if seen is None else Seen.of(seen),
        axes=tuple(axes),
        entries=entries,
    )
