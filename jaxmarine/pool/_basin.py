"""The craft in the water: one sample after the other, in simulated time."""

import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics import to_euler
from ..simulation import Held, asked, initial_state, steer, substeps
from ..vehicle import State, Vehicle
from ._faults import Fault, push_of, resized, with_faults

# Between samples [s], as in the thesis (sec. 5.3).
DT = 0.1
# Speed on all axes for which steps are short enough [m/s, rad/s].
_FASTEST = 3.0
# The disturbance that can be asked for, a Gauss-Markov wrench as `disturbances.RandomWrench`: its standard
# deviation as a share of what the actuators can give, with the craft's length as arm, and its memory [s].
_SHARE, _MEMORY = 0.02, 5.0


@eqx.filter_jit
def _step(vehicle: Vehicle, gates, state: State, acting, commands, push, t, split) -> Held:
    return steer(vehicle.plant(gates), state, acting, commands, push, t, jnp.asarray(DT), split)


@eqx.filter_jit
def _at_rest(vehicle: Vehicle, gates, commands) -> Array:
    return asked(vehicle.plant(gates), commands, jnp.asarray(DT)).goal[0]


_attitude = jax.jit(to_euler)


@dataclasses.dataclass(frozen=True)
class Sample:
    """What happened at one sample.

    - `t` [s]; `pose`: x y z [m] NED and roll pitch yaw [rad], as they are; `commands`: held until the next.
    - `shown`: what the sensors show, with noise, in the order of `CHANNELS`, NaN where nothing measures.
    - `given`: thrust [N] and states of other actuators.
    """

    t: float
    pose: Float[np.ndarray, "6"]
    commands: Float[np.ndarray, " columns"]
    shown: Float[np.ndarray, "18"]
    given: Float[np.ndarray, " columns"]


class Basin:
    """Water with a craft in it that has `faults`, none of which acts at first.

    - `vehicle`: without them; `length` [m]; `depth` [m] of its origin at the start.
    - `noise`: standard deviation of the sensors' white noise, by `CHANNELS`; NaN: no such sensor.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        faults: Mapping[str, Fault],
        length: float,
        depth: float,
        noise: Float[np.ndarray, "18"],
        seed: int | None = None,
    ):
        if np.any(vehicle.plant().drive.delay) or vehicle.slider is not None:
            raise ValueError("A craft whose commands act late, or that shifts a mass, cannot be flown.")
        self._faults, self._own = faults, len(vehicle.placed)
        self._vehicle = with_faults(vehicle, faults)
        self._gates = np.ones(self._own + len(faults))
        self._gates[self._own :] = 0.0
        self._split = substeps(vehicle, DT, _FASTEST)
        self._noise, self._rng = noise, np.random.default_rng(seed)
        self._size = _SHARE * push_of(vehicle) * np.array([1, 1, 1, length, length, length]) * vehicle.free
        self._push = np.zeros(6)
        self.disturbed = False
        self._count = 0
        self._state = initial_state(vehicle, position=(0.0, 0.0, depth))
        rest = jnp.zeros(len(vehicle.command_names))
        self._acting = _at_rest(self._vehicle, jnp.asarray(self._gates), rest)
        # Compiles before the clock runs.
        jax.block_until_ready(self._held(np.zeros(len(rest))))

    @property
    def t(self) -> float:
        """Time of the next sample [s]."""
        return self._count * DT

    def switch(self, label: str, on: bool, values: Mapping[str, float]) -> None:
        """Switches a fault from the next sample on; `values`: its size, all parameters of it."""
        place = self._own + list(self._faults).index(label)
        if values:
            fault = self._faults[label].placed(self._vehicle, values)
            self._vehicle = resized(self._vehicle, place, fault)
        self._gates[place] = float(on)

    def _held(self, commands: Float[np.ndarray, " columns"]) -> Held:
        return _step(
            self._vehicle,
            jnp.asarray(self._gates),
            self._state,
            self._acting,
            jnp.asarray(commands),
            jnp.asarray(self._push),
            jnp.asarray(self.t),
            jnp.asarray(self._split),
        )

    def step(self, commands: Float[np.ndarray, " columns"]) -> Sample:
        """Takes one sample, and goes on to the next under these commands."""
        kept = np.exp(-DT / _MEMORY) if self.disturbed else 0.0
        new = np.sqrt(1.0 - kept**2) * self._size * self._rng.standard_normal(6)
        self._push = kept * self._push + new if self.disturbed else np.zeros(6)
        held, position = self._held(commands), np.asarray(self._state.position)
        shown = np.asarray(held.shown)
        attitude = np.asarray(_attitude(self._state.attitude))
        sample = Sample(
            t=self.t,
            pose=np.concatenate([position, attitude]),
            commands=commands,
            shown=shown + self._noise * self._rng.standard_normal(len(shown)),
            given=np.asarray(held.given),
        )
        self._state, self._acting = held.after, held.acting
        self._count += 1
        return sample
