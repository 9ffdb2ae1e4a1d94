"""What sensors showed some time before, read along a track of samples."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._angles import ANGLES, wrap_to_pi
from .._types import ALL_SENSORS, Times

# Kinds of sensors that can be late, and which of them each channel is: others, such as accelerations, stay in
# time, and are said to be of the first.
LATE = ("position", "attitude", "velocity", "rate")
_CAN = np.array([kind in LATE for kind, channels in ALL_SENSORS.items() for _ in channels])
KIND = np.array(
    [LATE.index(kind) if kind in LATE else 0 for kind, names in ALL_SENSORS.items() for _ in names]
)


class Earlier:
    """Between which samples of a track the times `delay` seconds before each of them lie.

    - `delay` [s]: per sample and kind of sensor, in the order of `LATE`; `width`: how many channels.

    Lines between samples: at 10 Hz a craft that changes its speed by 1 m/s² leaves them by some millimetres.
    Before the sample `first` the line from there goes on backwards.
    """

    def __init__(
        self, t: Times, delay: Float[Array, "times kinds"], width: int, first: int | Int[Array, ""] = 0
    ):
        def one(delay):
            at = t - delay
            # At a sample the line that leads to it, so that a delay of zero has the slope of the past.
            cell = jnp.clip(jnp.searchsorted(t, at, side="left") - 1, first, len(t) - 2)
            length = jnp.maximum(t[cell + 1] - t[cell], 1e-9)
            return cell, (at - t[cell]) / length, length

        cell, share, length = jax.vmap(one, in_axes=1, out_axes=1)(delay)
        kind, self._can = KIND[:width], _CAN[:width]
        self._cell: Int[Array, "times channels"] = jnp.where(
            self._can, cell[:, kind], jnp.arange(len(t))[:, None]
        )
        self._share: Float[Array, "times channels"] = jnp.where(self._can, share[:, kind], 0.0)
        self._length = length[:, kind]
        self._next = jnp.minimum(self._cell + 1, len(t) - 1)

    def shown(
        self, values: Float[Array, "times channels"]
    ) -> tuple[Float[Array, "times channels"], Float[Array, "times channels"]]:
        """Channels so long before, and their slopes there [1/s]; of others as they are, and 0."""
        here = jnp.take_along_axis(values, self._cell, axis=0)
        step = jnp.take_along_axis(values, self._next, axis=0) - here
        step = jnp.where(ANGLES[: len(self._can)], wrap_to_pi(step), step)
        return here + self._share * step, jnp.where(self._can, step / self._length, 0.0)

    def rows(
        self, slopes: Float[Array, "times rows z"], channels: Int[np.ndarray, " rows"]
    ) -> Float[Array, "times rows z"]:
        """Derivatives of some channels, read likewise."""
        here = jnp.take_along_axis(slopes, self._cell[:, channels, None], axis=0)
        after = jnp.take_along_axis(slopes, self._next[:, channels, None], axis=0)
        return here + self._share[:, channels, None] * (after - here)


def late(
    t: Times, values: Float[Array, "times channels"], delay: Float[Array, "times kinds"]
) -> Float[Array, "times channels"]:
    """What sensors show that are `delay` seconds late, per sample and kind; zero changes nothing."""
    return Earlier(t, delay, values.shape[1]).shown(values)[0]
