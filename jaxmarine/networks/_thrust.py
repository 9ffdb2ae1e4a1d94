"""The thrust of each propeller as a network of its command, and how it lags."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import Craft, DriveEffect
from ..physics import Curve, Drive
from ._term import LearnedTerm, check_shapes


class LearnedThrust(LearnedTerm, DriveEffect):
    r"""Thrust beside the curve of the file, per thruster, and more lag than the file's.

    $T / T_{max} = \mathrm{file}(c) + \sum_k w_k (\tanh(a_k c + b_k) - \tanh b_k)$, with c the command after
    the delay and before the dead zone, and the lag $\tau = \tau_{file} + \Delta\tau$. Where c is negative,
    $T_{max}$ is the thrust at command -1.

    - `slope` a, `bias` b, `weight` w [hidden, thrusters]: the networks; w is zero at first: the file's curve.
    - `low`, `high` [thrusters]: commands in the data, in which the command is clipped: beyond them the
      network's share stays what it was at the edge.
    - `lag` [s]: beside that of the file, per thruster; the sum is not below zero.

    A command of zero gives no thrust but the file's, by construction. The curve is neither odd nor monotone:
    a fouled propeller is weaker one way, and where the data are poor a prior on w holds the file's curve.
    Source: thesis sec. 8.4 (networks for actuators); steady and first-order thrust, after Fossen (2021).
    """

    name: ClassVar[str] = "learned_thrust"

    slope: Float[Array, "hidden thrusters"]
    bias: Float[Array, "hidden thrusters"]
    weight: Float[Array, "hidden thrusters"]
    low: Float[Array, " thrusters"]
    high: Float[Array, " thrusters"]
    lag: Float[Array, " thrusters"]

    @property
    def network(self) -> tuple[Any, ...]:
        """What is trained, besides `lag`."""
        return self.slope, self.bias, self.weight

    @classmethod
    def check(cls, craft: Craft, target: str | None, inputs: tuple[str, ...]) -> None:
        del target
        if inputs != craft.thruster_names:
            raise ValueError("is a learned thrust and needs all thrusters as `inputs`.")

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], craft: Craft, target: str | None, inputs: tuple[str, ...]
    ) -> Self:
        del craft, target
        hidden, count = len(arrays["weight"]), len(inputs)
        shapes = dict.fromkeys(("low", "high", "lag"), (count,))
        check_shapes(arrays, {**shapes, **dict.fromkeys(("slope", "bias", "weight"), (hidden, count))})
        return cls(**{name: jnp.asarray(value) for name, value in arrays.items()}, inputs=inputs)

    def __call__(self, drive: Drive) -> Drive:
        curve = Curve(tuple(self.slope), tuple(self.bias), tuple(self.weight), self.low, self.high)
        return dataclasses.replace(
            drive, curves=(*drive.curves, curve), lag=jnp.maximum(drive.lag + self.lag, 0.0)
        )


def learned_thrust(
    thrusters: tuple[str, ...],
    low: Float[np.ndarray, " thrusters"],
    high: Float[np.ndarray, " thrusters"],
    hidden: int = 8,
) -> LearnedThrust:
    """Untrained networks for all thrusters: steps spread evenly over the commands, without weight.

    - `low`, `high`: commands in the data; the range is widened to zero.
    """
    # At a command of zero each network is zero; one that never moved still needs a range.
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    high = np.where(high > low, high, 1.0)
    count = len(thrusters)
    middle = (np.arange(hidden)[:, None] + 0.5) / hidden * (high - low) + low
    # A step as wide as the distance between two neighbours.
    slope = np.broadcast_to(hidden / (high - low), (hidden, count))
    return LearnedThrust(
        slope=jnp.asarray(slope),
        bias=jnp.asarray(-slope * middle),
        weight=jnp.zeros((hidden, count)),
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        lag=jnp.zeros(count),
        inputs=tuple(thrusters),
    )
