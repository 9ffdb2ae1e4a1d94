"""What disturbs a craft, as random processes with a memory: a wrench on each axis, a swell, a drift, and
a current.

The wrench on an axis wanders, and so does a swell on it, which also swings (`_processes.py`). A drift is a
force to the north and to the east: two numbers that wander. Wind and waves push so for longer than a craft
keeps its heading; the wrench on each axis turns with the hull, as turbulence about it does. A current is the
water's velocity to the north and to the east. What it does turns with the heading too, and grows with the
craft's speed, as no force does.

Between two samples a craft is moved by what pushed on the average, which at the first of them is known in
part only: of a disturbance that forgets within a sample's time hardly anything is (`Disturbance.over`). The
mean is all that is told of a hold: that an early push moves a craft farther than a late one is left out. It
shows where positions are known better than to a tenth of what a push moves a craft in a sample's time.

Source: after Fossen (2021) on slowly varying forces as a Gauss-Markov bias in earth axes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics import rotation
from ._processes import Hold, Process, Swell, Wander
from ._windows import PLANE


class Kinds(NamedTuple):
    """Which numbers are of each kind of a disturbance: none of one that it has not."""

    own: slice
    swell: slice
    drift: slice
    current: slice

    @classmethod
    def one_by_one(cls, own: int, swell: int, drift: int, current: int) -> "Kinds":
        """So many of each, one behind the other."""
        ends: list[int] = np.cumsum([0, own, swell, drift, current]).tolist()
        return cls(*map(slice, ends[:-1], ends[1:]))


class Disturbance(eqx.Module):
    """A Gauss-Markov wrench on the hull, a swell, a drift, and a current.

    - `size`: standard deviation [N, N m, m/s]; `time`: its memory, as of `Process` [s]; `frequency`
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
    def parts(self) -> Kinds:
        """Which of its sizes, times and frequencies are of each kind."""
        n = len(self.axes)
        return Kinds.one_by_one(n, n * self.swells, self.drifts, self.flows)

    @property
    def swell(self) -> Swell | None:
        """The process of the swell, which is alike on all axes."""
        first = self.parts.swell.start
        return Swell(self.time[first], self.frequency[first]) if self.swells else None

    @property
    def places(self) -> Kinds:
        """Which of its states are of each kind: one for each number that wanders, four for a swell."""
        n = len(self.axes)
        swell = Swell.STATES * n * self.swells
        return Kinds.one_by_one(n, swell, PLANE * self.drifts, PLANE * self.flows)

    @property
    def states(self) -> int:
        return self.places.current.stop

    def shared_with(self, narrower: "Disturbance") -> Int[np.ndarray, " states"]:
        """Indices of those of its states that one has as well which lacks some of its kinds."""
        both = zip(narrower.places, self.places, strict=True)
        kept = [np.arange(own.start, own.stop) for its, own in both if its.stop > its.start]
        return np.concatenate(kept)

    def output(self, plane: Float[Array, "axes plane"]) -> Float[Array, "pushes states"]:
        """From its states to the wrench on its axes, and to the water's velocity.

        - `plane`: as of `by_plane`.
        """
        wrench = [jnp.eye(len(self.axes))]
        if self.swells:
            wrench.append(jnp.kron(wrench[0], Swell.READ))
        if self.drifts:
            wrench.append(plane)
        flow = jnp.eye(PLANE) if self.flows else jnp.zeros((PLANE, 0))
        return jax.scipy.linalg.block_diag(jnp.concatenate(wrench, axis=1), flow)

    @property
    def spread(self) -> Float[Array, "states states"]:
        """Covariance of its states, after many memories."""
        return self._on_states(*self._each(lambda process: process.spread), self.size**2)

    def after(self, dt: Float[Array, ""], states: Float[Array, "states columns"]):
        """What is left of its states [states, columns] after some time [s]."""
        wander, swell = self._each(lambda process: process.left(dt))
        own, swinging, *plane = (states[place] for place in self.places)
        if swell is not None:
            by_axis = swinging.reshape(len(own), len(swell), -1)
            swinging = jnp.einsum("ij,ajc->aic", swell, by_axis).reshape(swinging.shape)
        drift, current = (wander[part, 0] * both for part, both in zip(self.parts[2:], plane, strict=True))
        return jnp.concatenate([wander[self.parts.own, 0] * own, swinging, drift, current])

    def new(self, dt: Float[Array, ""]) -> Float[Array, "states states"]:
        """Covariance of what is new in its states after some time [s]."""
        return self._on_states(*self._each(lambda process: process.new(dt)), self.size**2)

    def over(self, dt: Float[Array, ""]) -> Hold:
        """What its states are on the average over a hold of some length [s], which is not nothing."""
        wander, swell = self._each(lambda process: process.over(dt))
        each = [None] * len(wander) if swell is None else swell
        scales = [jnp.ones_like(self.size), *[self.size**2] * 3]
        return Hold(*map(self._on_states, wander, each, scales))

    def _each(self, of: Callable[[Process], Any]) -> tuple[Any, Any]:
        """Of the processes of all parts, as those that wander, and of that of the swell."""
        swell = None if self.swell is None else of(self.swell)
        return jax.vmap(lambda time: of(Wander(time)))(self.time), swell

    def _on_states(
        self,
        wander: Float[Array, "parts 1 1"],
        swell: Float[Array, "4 4"] | None,
        scale: Float[Array, " parts"],
    ) -> Float[Array, "states states"]:
        """A matrix on its states, of those of processes of size one, each part's times a number."""
        wander = wander[:, 0, 0] * scale
        blocks = [jnp.diag(wander[self.parts.own])]
        if swell is not None:
            blocks.append(jnp.kron(jnp.diag(scale[self.parts.swell]), swell))
        last = wander[self.parts.swell.stop :]
        return jax.scipy.linalg.block_diag(*blocks, *(one * jnp.eye(PLANE) for one in last))


def by_plane(
    axes: tuple[int, ...], attitude: Float[Array, "*samples 4"]
) -> Float[Array, "*samples axes plane"]:
    """What a force to the north and one to the east are on some of the six axes of a craft."""
    turns = jnp.vectorize(rotation, signature="(q)->(i,j)")(attitude)[..., :PLANE, :]
    on_six = jnp.pad(jnp.swapaxes(turns, -1, -2), [(0, 0)] * (attitude.ndim - 1) + [(0, 3), (0, 0)])
    return on_six[..., np.array(axes), :]
