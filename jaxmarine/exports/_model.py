"""The equations of a vehicle as functions of plain vectors, from which targets that take code are made.

    state = (x y z, quaternion w x y z, u v w p q r, memory, slow actuators, masses inside)

Positions are north-east-down [m], the rest body axes at `o`, SI units and radians. `memory` is the velocity
through the water as fluid memory lags it (6 numbers for each, or none); slow actuators are those with a lag
or a limited rate, in thrust [N], shaft speed [rev/s] or angle [rad]; masses inside have what their kind says,
such as an offset [m] and its rate [m/s]. All effects act, from the beginning; sensors show what is.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import ATTITUDE, POSITION, RATE, VELOCITY, Scalar, Vector3, Velocity, Wrench
from ..physics import UNLIMITED, Asked, Late, from_euler, to_euler
from ..simulation import hold, substeps
from ..vehicle import Input, Plant, State, Vehicle

Flat = Float[Array, " numbers"]
Command = Float[Array, " columns"]

# What `shown` gives.
SHOWN = POSITION + ATTITUDE + VELOCITY + RATE


class Model(eqx.Module):
    """A vehicle with all its constants summed, so that no target has to invert its mass matrix.

    - `moves`: whether masses inside move; else they rest where the file has them.
    """

    plant: Plant
    command_names: tuple[str, ...] = eqx.field(static=True)
    columns: tuple[str, ...] = eqx.field(static=True)
    slow: tuple[int, ...] = eqx.field(static=True)
    longest_step: float = eqx.field(static=True)

    @classmethod
    def of(cls, vehicle: Vehicle, moves: bool = True) -> "Model":
        plant = vehicle.plant()
        if not moves:
            plant = dataclasses.replace(plant, masses=())
        drive = plant.drive
        slow = np.asarray(drive.lag) > 0.0
        if drive.rate is not None:
            slow = slow | (np.asarray(drive.rate) < UNLIMITED)
        return cls(
            plant=plant,
            command_names=vehicle.command_names if moves else vehicle.drive_names,
            columns=vehicle.drive_names,
            slow=tuple(np.flatnonzero(slow).tolist()),
            # The step below which `simulate` cuts no hold in two.
            longest_step=1.0 / substeps(vehicle, 1.0),
        )

    @property
    def state_names(self) -> tuple[str, ...]:
        """What each number of the state is."""
        memory = tuple(
            f"memory{number if number > 1 else ''}_{name}"
            for number, _ in enumerate(self.plant.memories, start=1)
            for name in VELOCITY + RATE
        )
        slow = tuple(f"actual_{self.columns[i]}" for i in self.slow)
        masses = tuple(name for one in self.plant.masses for name in one.state_names)
        return (*POSITION, "q_w", "q_x", "q_y", "q_z", *VELOCITY, *RATE, *memory, *slow, *masses)

    def start(self, position: Vector3, attitude: Vector3, velocity: Velocity, command: Command) -> Flat:
        """The state at a position [m], roll, pitch, yaw [rad] and velocity; the command has acted long."""
        memory = jnp.zeros(6 * len(self.plant.memories))
        slow = self.asked(command, jnp.ones(())).goal[0][np.array(self.slow, int)]
        parts = [position, from_euler(attitude), velocity, memory, slow]
        parts += [one.rest(own) for one, own in self.plant.told(command)]
        return jnp.concatenate(parts)

    def step(self, state: Flat, command: Command, wrench: Wrench, t: Scalar, dt: Scalar) -> Flat:
        """The state `dt` seconds after `t`, command and wrench held, by one step of `simulate`.

        `dt` is at most `longest_step`; a longer hold is cut in parts.
        """
        now, slow, masses = self._parts(state)
        asked = self.asked(command, dt)
        before = self._filled(asked.goal[0], slow)[None]
        push = asked.thrust(before)
        moving = self._moving(masses, command, t)
        drive = Input(
            push.mean[0], command[: len(self.columns)], wrench, t, push.slope[0], t + 0.5 * dt, moving
        )
        after = hold(self.plant, now, drive, dt)
        parts = [after.position, after.attitude, after.velocity, after.memory]
        parts.append(asked.after(before)[0][np.array(self.slow, int)])
        parts += [one.state(motion, t + dt) for one, motion in zip(self.plant.masses, moving, strict=True)]
        return jnp.concatenate(parts)

    def rates(self, state: Flat, command: Command, wrench: Wrench, t: Scalar) -> Flat:
        """The time derivative of the state."""
        now, slow, masses = self._parts(state)
        goal = self.asked(command, jnp.ones(())).goal[0]
        moving = self._moving(masses, command, t)
        acting = self._filled(goal, slow)
        drive = Input(acting, command[: len(self.columns)], wrench, t, moving=moving)
        rates = self.plant.rates(now, drive)
        parts = [rates.position, rates.attitude, rates.velocity, rates.memory]
        which, limit = np.array(self.slow, int), self.plant.drive.rate
        # What is limited in its rate alone follows within this [s].
        change = (goal[which] - slow) / np.maximum(np.asarray(self.plant.drive.lag)[which], 1e-3)
        if limit is not None:
            change = jnp.clip(change, -limit[which], limit[which])
        parts.append(change)
        parts += [one.rates(motion, t) for one, motion in zip(self.plant.masses, moving, strict=True)]
        return jnp.concatenate(parts)

    def shown(self, state: Flat) -> Float[Array, "12"]:
        """Position [m], roll, pitch, yaw [rad] and velocity, as `SHOWN` names them."""
        now = self._parts(state)[0]
        return jnp.concatenate([now.position, to_euler(now.attitude), now.velocity])

    def _parts(self, state: Flat) -> tuple[State, Array, Array]:
        """The vehicle's state, that of slow actuators, and that of masses inside."""
        ends = 13 + 6 * len(self.plant.memories)
        now = State(state[:3], state[3:7], state[7:13], state[13:ends])
        return now, state[ends : ends + len(self.slow)], state[ends + len(self.slow) :]

    def asked(self, command: Command, dt: Scalar) -> Asked:
        """What a command that is held for `dt` seconds asks of the actuators, a row per sample: of one."""
        drive = jax.tree.map(lambda constants: constants[None], self.plant.drive)
        row = command[None, : len(self.columns)]
        return Asked.of(drive, Late(mean=row, slope=jnp.zeros_like(row), now=row), jnp.reshape(dt, (1, 1)))

    def _filled(self, goal: Command, slow: Array) -> Command:
        """What acts per column: of slow actuators their state, of others what is asked."""
        place = {column: k for k, column in enumerate(self.slow)}
        return (
            jnp.stack([slow[place[i]] if i in place else goal[i] for i in range(len(self.columns))])
            if place
            else goal
        )

    def _moving(self, state: Float[Array, " masses"], command: Command, t: Scalar) -> tuple[Any, ...]:
        """How masses inside move from their state on."""
        out, begin = [], 0
        for one, own in self.plant.told(command):
            end = begin + len(one.state_names)
            out.append(one.held(state[begin:end], own, t))
            begin = end
        return tuple(out)
