"""The craft in the water: one sample after the other, in simulated time."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics import to_euler
from ..simulation import Held, steer
from ..vehicle import Plant, State, Vehicle
from ._crafts import Craft
from ._faults import Fault, with_faults

# Between samples [s], as in the thesis (sec. 5.3).
DT = 0.1
# The disturbance that can be asked for, a Gauss-Markov wrench as `disturbances.RandomWrench`: its standard
# deviation as a share of what the actuators can give, with the craft's length as arm, and its memory [s].
_SHARE, _MEMORY = 0.02, 5.0
# Into how many steps a sample is cut: no fewer than `simulation.substeps` asks of any craft at 3 m/s and
# 3 rad/s, with the largest drag that can be switched on.
STEPS = 10


@jax.jit
def _step(plant: Plant, state: State, acting, commands, push, t) -> tuple[Held, Float[Array, "6"]]:
    pose = jnp.concatenate([state.position, to_euler(state.attitude)])
    return steer(plant, state, acting, commands, push, t, jnp.asarray(DT), STEPS), pose


@dataclasses.dataclass(frozen=True)
class Sample:
    """What happened at one sample.

    - `t` [s]; `pose`: x y z [m] NED and roll pitch yaw [rad], as they are; `commands`: held until the next.
    - `shown`: what the sensors show, with noise, in the order of `ALL_CHANNELS`, NaN where nothing measures.
    - `given`: thrust [N] and states of other actuators.
    """

    t: float
    pose: Float[np.ndarray, "6"]
    commands: Float[np.ndarray, " columns"]
    shown: Float[np.ndarray, " channels"]
    given: Float[np.ndarray, " columns"]


class Basin:
    """Water with a craft in it that has `faults`, none of which acts at first.

    - `vehicle`: the craft's, without them.
    - `noise`: standard deviation of the sensors' white noise, by `ALL_CHANNELS`; NaN: no such sensor.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        faults: Mapping[str, Fault],
        craft: Craft,
        noise: Float[np.ndarray, " channels"],
        seed: int | None = None,
    ):
        late = [vehicle.thrusters.delay, *(one.delay for one in vehicle.actuators)]
        if any(np.any(delay) for delay in late) or vehicle.masses:
            raise ValueError("A craft whose commands act late, or that shifts a mass, cannot be flown.")

        def plant(sizes: dict[str, dict[str, Array]], gates: Float[Array, " placed"]) -> Plant:
            return with_faults(vehicle, faults, sizes).plant(gates)

        # All faults are in it always, with gates that open and shut them: one program, whatever is on.
        self._plant_of = jax.jit(plant)
        self._sizes = {label: {n: s.value for n, s in one.sizes.items()} for label, one in faults.items()}
        self._own = len(vehicle.placed)
        self._gates = np.concatenate([np.ones(self._own), np.zeros(len(faults))])
        self._plant = self._plant_of(self._sizes, self._gates)
        self._noise, self._rng = noise, np.random.default_rng(seed)
        self._force = _SHARE * craft.push * np.repeat([1.0, craft.size[0]], 3) * vehicle.free
        self._push = np.zeros(6)
        self.disturbed = False
        self._count = 0
        self._state = State(
            jnp.array([0.0, 0.0, craft.depth]), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(6), jnp.zeros(0)
        )
        # Nothing is asked of actuators that rest.
        self._acting = jnp.zeros(len(vehicle.command_names))
        # Compiles before the clock runs.
        jax.block_until_ready(self._held(self._acting))

    @property
    def t(self) -> float:
        """Time of the next sample [s]."""
        return self._count * DT

    def switch(self, label: str, on: bool, size: Mapping[str, float]) -> None:
        """Switches a fault from the next sample on; `size`: all its parameters."""
        self._sizes[label] = dict(size)
        self._gates[self._own + list(self._sizes).index(label)] = float(on)
        self._plant = self._plant_of(self._sizes, self._gates)

    def _held(self, commands: Float[Array | np.ndarray, " columns"]) -> tuple[Held, Array]:
        return _step(self._plant, self._state, self._acting, commands, self._push, self.t)

    def step(self, commands: Float[np.ndarray, " columns"]) -> Sample:
        """Takes one sample, and goes on to the next under these commands."""
        kept = np.exp(-DT / _MEMORY) if self.disturbed else 0.0
        new = np.sqrt(1.0 - kept**2) * self._force * self._rng.standard_normal(6)
        self._push = kept * self._push + new if self.disturbed else np.zeros(6)
        held, pose = self._held(commands)
        shown = np.asarray(held.shown)
        sample = Sample(
            t=self.t,
            pose=np.asarray(pose),
            commands=commands,
            shown=shown + self._noise * self._rng.standard_normal(len(shown)),
            given=np.asarray(held.given),
        )
        self._state, self._acting = held.after, held.acting
        self._count += 1
        return sample
