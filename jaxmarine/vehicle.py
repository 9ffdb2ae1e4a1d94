"""The vehicle: the stages in order, forward and inverse dynamics.

    command -> actuator -> water -> inertia -> wrench -> sensor

`Vehicle` is what the file says plus the effects placed in it. `Plant` is the vehicle at one time,
when each effect either acts or does not yet, with its masses summed and inverted. All equations of
motion stand on `Plant.balance`, the inverse dynamics.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._types import (
    ALL_SENSORS,
    ALWAYS,
    DOFS,
    TABLE,
    Matrix3,
    Matrix6,
    Moving,
    Quaternion,
    Times,
    Vector3,
    Velocity,
    Wrench,
    width_of,
)
from .actuators import AbstractActuators, AbstractMasses, Flow, Supply, joined
from .effects import (
    CATALOGUE,
    AbstractEffect,
    ActuatorEffect,
    DriveEffect,
    ExchangedThrusters,
    FluidMemory,
    LoadEffect,
    Motion,
    Readings,
    SensorDelay,
    SensorEffect,
    WaterEffect,
    WrenchEffect,
    blend,
)
from .physics import (
    Drive,
    Load,
    apply,
    attitude_rate,
    compose,
    coriolis,
    damping,
    rotation,
    small_turn,
    to_euler,
)

# Beyond the speed of any vessel that is driven by propellers [m/s].
_FASTEST = 40.0
# Share of full thrust below which the loss to the flow fades.
_FAINT = 1e-4
_ORDER = {effect: place for place, effect in enumerate(CATALOGUE)}


class State(eqx.Module):
    """Position of `o` [m] NED, attitude quaternion, velocity over ground in body axes, fluid memory.

    `memory` is the relative velocity passed through the lag of each axis, six numbers for every fluid memory
    in the order of `Plant.memories`; it is empty (shape 0) in a vehicle without one. Those of many times or
    logs are stacked.
    """

    position: Float[Array, "*times 3"]
    attitude: Float[Array, "*times 4"]
    velocity: Float[Array, "*times 6"]
    memory: Float[Array, "*times memory"]

    def moved(self, delta: Float[Array, "12"]) -> "State":
        """The state moved by position [m] NED, a small turn in body axes [rad] and velocity [m/s, rad/s]."""
        return State(
            position=self.position + delta[:3],
            attitude=compose(self.attitude, small_turn(delta[3:6])),
            velocity=self.velocity + delta[6:],
            memory=self.memory,
        )


class Input(eqx.Module):
    """What drives the vehicle: what acts, commands, a wrench, the time [s].

    `thrust` is that of thrusters [N] before inflow loss and, behind them, the state of other actuators:
    shaft speed, angle, deflection.

    Over a hold `thrust` is its mean, and changes by `slope` [N/s] about the time `middle`. `moving` is
    the motion of masses inside, one of each kind; None: they rest where the file has them. `water` is a
    velocity of the water [m/s] NED beside the plant's own, `drift` a force at o [N] NED beside the wrench in
    body axes, None where there is none. Those of many times or logs are stacked, for `vmap` and `scan` to
    take apart.
    """

    thrust: Float[Array, "*times columns"]
    command: Float[Array, "*times columns"]
    wrench: Float[Array, "*times 6"]
    t: Float[Array, "*times"]
    slope: Float[Array, "*times columns"] | None = None
    middle: Float[Array, "*times"] | None = None
    moving: tuple[Any, ...] | None = None
    water: Float[Array, "*times 3"] | None = None
    drift: Float[Array, "*times 3"] | None = None


class Body(eqx.Module):
    """Rigid body about `o`: `matrix` M_RB, `mass` [kg], `cog` and `cob` [m], `weight` and `buoyancy` [N]."""

    matrix: Matrix6
    mass: Float[Array, ""]
    cog: Vector3
    cob: Vector3
    weight: Float[Array, ""]
    buoyancy: Float[Array, ""]


class Damping(eqx.Module):
    """`linear` D_l on nu_r, `quadratic` D_q on |nu_r| nu_r (elementwise); full 6x6, positive sign."""

    linear: Matrix6
    quadratic: Matrix6


class Thrusters(eqx.Module):
    """Fixed thrusters: `position` [m], unit `direction`, `max_thrust` [N], and the constants of `Drive`.

    `advance_loss` [N s/m] is the thrust that each m/s of flow along a thruster takes at command 1.
    `max_thrust_reverse` [N] is 0 where the file states none: the thruster then gives `max_thrust` backwards
    too, whatever a fit makes of that.
    """

    position: Float[Array, "thrusters 3"]
    direction: Float[Array, "thrusters 3"]
    max_thrust: Float[Array, " thrusters"]
    deadband: Float[Array, " thrusters"]
    lag: Float[Array, " thrusters"]
    delay: Float[Array, " thrusters"]
    saturation: Float[Array, " thrusters"]
    max_thrust_reverse: Float[Array, " thrusters"]
    quadratic: Float[Array, " thrusters"]
    advance_loss: Float[Array, " thrusters"]

    @property
    def reverse(self) -> Float[Array, " thrusters"]:
        """Thrust at command -1, backwards [N], stated or not."""
        return jnp.where(self.max_thrust_reverse == 0.0, self.max_thrust, self.max_thrust_reverse)

    def drive(self) -> Drive:
        one = jnp.ones_like(self.max_thrust)
        return Drive(
            delay=self.delay,
            deadband=self.deadband,
            saturation=self.saturation,
            quadratic=self.quadratic,
            gain=one,
            lag=self.lag,
            inflow=0.0 * one,
            max_thrust=self.max_thrust,
            max_thrust_reverse=self.reverse,
        )


class Placed(eqx.Module):
    """An effect in a vehicle, acting from `since` [s] of the log `since_log` on; None: always."""

    effect: AbstractEffect
    target: str | None = eqx.field(static=True, default=None)
    since: float | None = eqx.field(static=True, default=None)
    since_log: str | None = eqx.field(static=True, default=None)


class Vehicle(eqx.Module):
    """A marine vehicle: what its file says, and the effects placed in it.

    - `actuators`: those beside thrusters, kind by kind; `masses`: those that move inside, likewise.
    """

    body: Body
    added_mass: Matrix6
    damping: Damping
    thrusters: Thrusters
    density: Float[Array, ""]
    gravity: Float[Array, ""]
    placed: tuple[Placed, ...]
    name: str = eqx.field(static=True)
    dof: tuple[str, ...] = eqx.field(static=True)
    thruster_names: tuple[str, ...] = eqx.field(static=True)
    # Stated standard deviations of the sensors by kind (keys of `_types.ALL_SENSORS`), as pairs.
    sensors: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    # How far sections of the file may be off, as shares of their values (keys of its table `[prior]`).
    prior: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    actuators: tuple[AbstractActuators, ...] = ()
    masses: tuple[AbstractMasses, ...] = ()

    def __check_init__(self):
        for what, matrix in (
            ("body.matrix", self.body.matrix),
            ("added_mass", self.added_mass),
            ("damping.linear", self.damping.linear),
            ("damping.quadratic", self.damping.quadratic),
        ):
            # Under transformations leaves may be anything; only arrays have a shape to check.
            if hasattr(matrix, "shape") and matrix.shape[-2:] != (6, 6):
                raise ValueError(f"`{what}` must be 6x6, but is {matrix.shape}.")

    @property
    def free(self) -> Float[np.ndarray, "6"]:
        """1 for each degree of freedom that can move, 0 for a locked one."""
        return np.array([float(dof in self.dof) for dof in DOFS])

    @property
    def axes(self) -> tuple[int, ...]:
        """The degrees of freedom that can move, as indices."""
        return tuple(np.flatnonzero(self.free).tolist())

    @property
    def command_names(self) -> tuple[str, ...]:
        """The command columns of a log: the thrusters, other actuators and, last, masses inside."""
        return *self.drive_names, *(name for one in self.masses for name in one.columns)

    @property
    def drive_names(self) -> tuple[str, ...]:
        """The command columns but those of masses inside, in the order of `Plant.drive`."""
        return *self.thruster_names, *(name for one in self.actuators for name in one.columns)

    @property
    def command_units(self) -> tuple[str, ...]:
        """The unit of each command column, "1" of shares such as a thruster's."""
        shares = ("1",) * len(self.thruster_names)
        return *shares, *(unit for one in (*self.actuators, *self.masses) for unit in one.units)

    @property
    def command_limits(self) -> np.ndarray:
        """The largest command allowed per command column."""
        limits = np.maximum(1.0, np.asarray(self.thrusters.saturation))
        return np.concatenate([limits, *(one.limits for one in (*self.actuators, *self.masses))])

    @property
    def stated_noise(self) -> Float[np.ndarray, " channels"]:
        """Standard deviation that the file states for each channel that a log of it has, NaN for none."""
        stated = dict(self.sensors)
        noise = np.array(
            [stated.get(kind, np.nan) for kind, channels in ALL_SENSORS.items() for _ in channels]
        )
        return noise[: width_of(np.isfinite(noise))]

    def states_noise(self, width: int) -> Bool[np.ndarray, " channels"]:
        """Whether the file states the noise of each of the first so many channels."""
        stated = dict(self.sensors)
        return np.array([kind in stated for kind, channels in ALL_SENSORS.items() for _ in channels])[:width]

    @property
    def mass_matrix(self) -> Matrix6:
        """M_RB + M_A of the file's sections, without effects."""
        return self.body.matrix + self.added_mass

    def place(self, *placed: Placed) -> "Vehicle":
        """The vehicle with more effects in it."""
        return dataclasses.replace(self, placed=(*self.placed, *placed))

    def plant(
        self, gates: Float[Array, " placed"] | None = None, extra: Sequence[AbstractEffect] = ()
    ) -> "Plant":
        """The vehicle while each placed effect acts (gate 1) or does not (0); None: all act.

        `extra` are effects that act besides those placed; the diagnosis puts its suspicions there.
        """
        effects = [p.effect for p in self.placed]
        if gates is not None:
            effects = [
                blend(type(e).neutral(self), e, gate) if p.since is not None else e
                for e, p, gate in zip(effects, self.placed, gates, strict=True)
            ]
        # In the catalogue's order, whatever the order in which they were found; others come last.
        effects = sorted([*effects, *extra], key=lambda e: _ORDER.get(type(e), len(_ORDER)))

        load = Load(
            rigid=self.body.matrix,
            added=self.added_mass,
            weight=self.body.weight,
            weight_moment=self.body.weight * self.body.cog,
            buoyancy=self.body.buoyancy,
            buoyancy_moment=self.body.buoyancy * self.body.cob,
            density=self.density,
            gravity=self.gravity,
        )
        drive, actuators = self.thrusters.drive(), self.actuators
        current, delay = None, None
        for effect in effects:
            if isinstance(effect, ActuatorEffect):
                actuators = tuple(effect.changed(one) for one in actuators)
            if isinstance(effect, DriveEffect):
                drive = effect(drive)
            elif isinstance(effect, LoadEffect):
                load = effect(load)
            elif isinstance(effect, WaterEffect):
                current = effect() if current is None else current + effect()
            elif isinstance(effect, SensorDelay):
                delay = effect.delay if delay is None else delay + effect.delay
        free = jnp.asarray(self.free)
        arms = jnp.cross(self.thrusters.position, self.thrusters.direction)
        allocation = jnp.concatenate([self.thrusters.direction, arms], axis=1).T
        advance = self.thrusters.advance_loss
        exchanged = self._exchanged(gates)
        if exchanged is not None:
            # A column takes all that is its thruster's; after the other effects, which are the thrusters'.
            drive, allocation, advance = jax.tree.map(lambda a: a @ exchanged, (drive, allocation, advance))
        return Plant(
            load=load,
            inverse_mass=_inverse_mass(load, free),
            damping=self.damping,
            drive=joined([drive, *(one.servo() for one in actuators)]),
            actuators=actuators,
            direction=allocation[:3].T,
            allocation=allocation,
            advance=advance,
            current=current,
            wrenches=tuple(e for e in effects if isinstance(e, WrenchEffect)),
            sensors=tuple(e for e in effects if isinstance(e, SensorEffect)),
            free=free,
            masses=self.masses,
            delay=delay,
        )

    def _exchanged(self, gates: Float[Array, " placed"] | None) -> Float[Array, "thrusters thrusters"] | None:
        """From what is the thrusters' to what is the columns', None where no columns are exchanged."""
        out, eye = None, np.eye(len(self.thruster_names))
        for i, p in enumerate(self.placed):
            if isinstance(p.effect, ExchangedThrusters) and p.target is not None:
                other = eye[:, ExchangedThrusters.columns_of(p.target, self.thruster_names)]
                acts = 1.0 if gates is None or p.since is None else gates[i]
                one = jnp.asarray(eye + acts * (other - eye))
                out = one if out is None else out @ one
        return out


def _inverse_mass(load: Load, free: Float[Array, "6"]) -> Matrix6:
    """The inverse of the mass matrix on the free axes (1), zero on locked ones (0)."""
    both = free[:, None] * free[None, :]
    return both * jnp.linalg.inv(both * (load.rigid + load.added) + jnp.diag(1.0 - free))


class Plant(eqx.Module):
    """A vehicle at one time: constants ready for the equations of motion.

    - `drive`: of all command columns but those of masses inside, the thrusters' first; `direction` and
      `allocation` are the thrusters' alone.
    - `current`: velocity of the water [m/s] NED; None where nothing moves it, which spares a fifth of a step.
    - `delay` [s]: of each kind of sensor (`physics.LATE`), for `physics.late`; None where none is suspected.
    """

    load: Load
    inverse_mass: Matrix6
    damping: Damping
    drive: Drive
    actuators: tuple[AbstractActuators, ...]
    direction: Float[Array, "thrusters 3"]
    allocation: Float[Array, "6 thrusters"]
    advance: Float[Array, " thrusters"]
    current: Vector3 | None
    wrenches: tuple[WrenchEffect, ...]
    sensors: tuple[SensorEffect, ...]
    free: Float[Array, "6"]
    masses: tuple[AbstractMasses, ...] = ()
    delay: Float[Array, " kinds"] | None = None

    @property
    def water(self) -> Vector3:
        """Velocity of the water [m/s] NED."""
        return jnp.zeros(3) if self.current is None else self.current

    @property
    def memories(self) -> tuple[FluidMemory, ...]:
        """The fluid memories, each with a lag of its own on every axis, so that two may act on one."""
        return tuple(e for e in self.wrenches if isinstance(e, FluidMemory))

    @property
    def has_memory(self) -> bool:
        return bool(self.memories)

    def memory_gain(self) -> Float[Array, "*segments memories 6"]:
        """Damping that comes late, of each fluid memory and axis [N s/m, N m s]."""
        return jnp.stack([e.gain for e in self.memories])

    def memory_lag(self) -> Float[Array, " memory"]:
        """Time constants of the fluid memories [s], in the order of `State.memory`."""
        return jnp.maximum(jnp.concatenate([e.time_constant for e in self.memories]), 1e-2)

    def for_each_memory(self, relative: Float[Array, "*times 6"]) -> Float[Array, "*times memory"]:
        """The velocity through the water [m/s, rad/s], for each fluid memory: what drives it."""
        return jnp.concatenate([relative] * len(self.memories), axis=-1)

    def relative(self, attitude: Quaternion, velocity: Velocity) -> Velocity:
        """Velocity through the water, body axes, zero on locked axes [m/s, rad/s]."""
        if self.current is None:
            return velocity * self.free
        flow = apply(rotation(attitude).T, self.current)
        return (velocity - jnp.concatenate([flow, jnp.zeros(3)])) * self.free

    def amid(self, water: Vector3 | None) -> "Plant":
        """The plant in water that moves by so much more [m/s] NED."""
        return self if water is None else dataclasses.replace(self, current=self.water + water)

    def moves(self, t: Times, commands: Float[Array, "times columns"]) -> tuple[Any, ...] | None:
        """The motion of masses inside over each hold, if there are any; their columns are the last."""
        if not self.masses:
            return None
        return tuple(one.moves(t, part) for one, part in self.told(commands))

    def told(self, commands: Float[Array, "*times columns"]) -> list[tuple[AbstractMasses, Array]]:
        """Masses inside, each with its own columns."""
        first = self.drive.max_thrust.shape[-1]
        ends = np.cumsum([first, *(len(one.columns) for one in self.masses)]).tolist()
        parts = [commands[..., begin:end] for begin, end in itertools.pairwise(ends)]
        return list(zip(self.masses, parts, strict=True))

    def _moving(self, drive: Input) -> tuple[tuple[AbstractMasses, Any], ...]:
        """Masses inside with their motion; none where the input has them at rest."""
        return () if drive.moving is None else tuple(zip(self.masses, drive.moving, strict=True))

    def carried(self, drive: Input) -> Load:
        """What the vehicle carries, with the masses inside where the input has them."""
        load = self.load
        for one, inside in self._moving(drive):
            load = one.moved(load, inside, drive.t)
        return load

    def mobility(self, drive: Input) -> Matrix6:
        """The inverse of the mass matrix under the given input, zero on locked axes."""
        if not self._moving(drive):
            return self.inverse_mass
        return _inverse_mass(self.carried(drive), self.free)

    def _motion(self, state: State, drive: Input) -> Motion:
        return Motion(
            position=state.position,
            rotation=rotation(state.attitude),
            nu=state.velocity,
            nu_r=self.relative(state.attitude, state.velocity),
            lagged=state.memory,
            t=drive.t,
            command=drive.command,
        )

    def balance(self, state: State, nu_dot: Velocity, drive: Input) -> Wrench:
        """Inverse dynamics: the wrench that is missing for the acceleration `nu_dot` under the given input.

        `M_RB nu' + C_RB nu + M_A nu_r' + C_A nu_r + D nu_r + g - tau - (wrenches of effects)`, zero on
        the free axes where `nu_dot` is the acceleration of this vehicle. After Fossen (2021), with
        `nu_r' = nu' + (w x R' v_c, 0)` for a current that is steady in earth axes. The Coriolis term
        of the added mass uses the symmetric part of its matrix, which alone has kinetic energy. Masses that
        move inside add their `reaction`, and M_RB and g have them where they are.
        """
        if drive.water is not None:
            return self.amid(drive.water).balance(state, nu_dot, dataclasses.replace(drive, water=None))
        load = self.carried(drive)
        motion = self._motion(state, drive)
        relative_dot = nu_dot
        if self.current is not None:
            turned = jnp.cross(state.velocity[3:], apply(motion.rotation.T, self.current))
            relative_dot = relative_dot + jnp.concatenate([turned, jnp.zeros(3)]) * self.free
        out = (
            apply(load.rigid, nu_dot)
            + coriolis(load.rigid, state.velocity)
            + apply(load.added, relative_dot)
            + coriolis(0.5 * (load.added + load.added.T), motion.nu_r)
            + damping(self.damping.linear, self.damping.quadratic, motion.nu_r)
            + load.restoring(motion.rotation[2])
            - self.pushed(drive.thrust, motion.nu_r, state.velocity, motion.rotation)
            - drive.wrench
        )
        if drive.drift is not None:
            out = out - jnp.concatenate([apply(motion.rotation.T, drive.drift), jnp.zeros(3)])
        for one, inside in self._moving(drive):
            out = out + one.reaction(inside, drive.t, state.velocity)
        begin = 0
        for effect in self.wrenches:
            if isinstance(effect, FluidMemory):
                motion = dataclasses.replace(motion, lagged=state.memory[begin : begin + 6])
                begin += 6
            out = out - effect(motion)
        return out

    def _in_flow(self, thrust: Float[Array, " thrusters"], nu_r: Velocity) -> Float[Array, " thrusters"]:
        """What the flow leaves of the thrusters' thrust [N].

        After Fossen (2021), T = T_nn n|n| - T_nu |n| u_a, with the command that gives as much thrust in place
        of n: what lag, dead zone and faults do to the thrust they do to it.
        """
        drive, count = self.drive, len(thrust)
        most = jnp.where(thrust < 0.0, drive.max_thrust_reverse[:count], drive.max_thrust[:count])
        share, curve = jnp.abs(thrust) / most, jnp.clip(drive.quadratic[:count], 0.0, 1.0)
        # The root of (1 - curve) c + curve c² = share, with a finite slope at no thrust.
        root = jnp.sqrt((1.0 - curve) ** 2 + 4.0 * curve * (share + _FAINT))
        command = 2.0 * share / (1.0 - curve + root)
        along = jnp.abs(apply(self.direction, nu_r[:3]))
        # What makes a wrench of thrusts makes, transposed, speeds along them of a motion: power is the same.
        lost = self.advance * command * apply(self.allocation.T, nu_r)
        return thrust * (1.0 - drive.inflow[:count] * along) - lost

    def pushed(
        self,
        acting: Float[Array, " columns"],
        nu_r: Velocity,
        nu: Velocity | None = None,
        turn: Matrix3 | None = None,
    ) -> Wrench:
        """What thrusters and other actuators give in the flow: wrench at `o`, body axes [N, N m].

        - `acting`: thrust [N] before inflow loss, or the state of another actuator, per column of `drive`.
        - `nu`: velocity over ground, default `nu_r`; `turn`: body to world, default upright and to the north.
        """
        count = self.allocation.shape[-1]
        thrust = self._in_flow(acting[:count], nu_r)
        if not self.actuators:
            return apply(self.allocation, thrust)
        ends = np.cumsum([count, *(len(one.columns) for one in self.actuators)])
        states = [acting[begin:end] for begin, end in itertools.pairwise(ends.tolist())]
        for one, state in zip(self.actuators, states, strict=True):
            if isinstance(one, Supply):
                thrust = one.supplied(thrust, state)
        out = apply(self.allocation, thrust)
        alone = Flow(
            nu_r=nu_r,
            density=self.load.density,
            nu=nu_r if nu is None else nu,
            rotation=jnp.eye(3) if turn is None else turn,
            thrust=thrust,
            streams={},
        )
        streams = {}
        for one, state in zip(self.actuators, states, strict=True):
            streams |= one.streams(state, alone)
        flow = dataclasses.replace(alone, streams=streams)
        for one, state in zip(self.actuators, states, strict=True):
            out = out + one.wrench(state, flow)
        return out

    def acceleration(self, state: State, drive: Input) -> Velocity:
        """Forward dynamics: nu' [m/s², rad/s²]; locked axes stay at rest."""
        return -apply(self.mobility(drive), self.balance(state, jnp.zeros(6), drive))

    def rates(self, state: State, drive: Input) -> State:
        """Time derivative of the state."""
        if self.has_memory:
            relative = self.amid(drive.water).relative(state.attitude, state.velocity)
            memory = (self.for_each_memory(relative) - state.memory) / self.memory_lag()
        else:
            memory = jnp.zeros_like(state.memory)
        return State(
            position=apply(rotation(state.attitude), state.velocity[:3]),
            attitude=attitude_rate(state.attitude, state.velocity[3:]),
            velocity=self.acceleration(state, drive),
            memory=memory,
        )

    def readings(self, state: State, nu_dot: Velocity, width: int = ALWAYS) -> Float[Array, " channels"]:
        """What sensors in time show, in the order of `ALL_CHANNELS`, of which these are the first `width`.

        Effects of sensors touch the channels that they name; kinds with an equation in `TABLE` show what is.
        """
        shown = Readings(state.position, to_euler(state.attitude), state.velocity, nu_dot)
        turn = rotation(state.attitude)
        for effect in self.sensors:
            shown = effect(shown, turn)
        channels = [shown.position, shown.attitude, shown.nu, shown.nu_dot]
        if width > ALWAYS:
            nu_r = self.relative(state.attitude, state.velocity)
            seen = Moving(turn, state.velocity, nu_r, nu_dot, self.load.gravity)
            channels += [one.shows(seen) for one in TABLE[: width // 3] if one.shows]
        return jnp.concatenate(channels)


def reach(plant: Plant) -> Float[np.ndarray, "6"]:
    """The largest wrench that actuators beside the thrusters can give on each axis [N, N m].

    Of each column what its two ends change, the others at rest or full ahead: with the vehicle at rest and at
    the speed at which full thrust is balanced by drag.
    """
    count, columns = plant.allocation.shape[-1], plant.drive.max_thrust.shape[-1]
    if columns == count and not plant.actuators:
        return np.zeros(6)
    ends = np.asarray(plant.drive.saturation * plant.drive.max_thrust)
    pushed = jax.jit(jax.vmap(lambda acting, u: plant.pushed(acting, jnp.zeros(6).at[0].set(u))))

    def each(base: np.ndarray, speed: float) -> Float[np.ndarray, "2 columns 6"]:
        """What the lower and the upper end of each column change."""
        flat = np.tile(base, (3, columns, 1))
        for side, share in enumerate((-1.0, 1.0, 0.0)):
            flat[side, np.arange(columns), np.arange(columns)] = share * ends
        speeds = jnp.full(3 * columns, speed)
        given = np.asarray(pushed(jnp.asarray(flat.reshape(-1, columns)), speeds)).reshape(3, columns, 6)
        return given[:2] - given[2]

    rest = each(np.zeros(columns), 0.0)
    ahead = np.where(rest[1, :, 0] > 1e-9, ends, np.where(rest[0, :, 0] > 1e-9, -ends, 0.0))
    low, high = 0.0, _FASTEST
    for _ in range(20):
        middle = 0.5 * (low + high)
        nu = jnp.zeros(6).at[0].set(middle)
        state = State(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), nu, jnp.zeros(6 * len(plant.memories)))
        driven = Input(jnp.asarray(ahead), jnp.zeros(columns), jnp.zeros(6), jnp.zeros(()))
        missing = float(plant.balance(state, jnp.zeros(6), driven)[0])
        low, high = (middle, high) if missing < 0.0 else (low, middle)
    most = np.maximum(np.abs(rest), np.abs(each(ahead, low))).max(axis=0)
    return most[count:].sum(axis=0) * np.asarray(plant.free)


def forward_dynamics(vehicle: Vehicle, state: State, drive: Input) -> Velocity:
    """Acceleration nu' [m/s², rad/s²] of the vehicle with all its effects acting."""
    return vehicle.plant().acceleration(state, drive)


def inverse_dynamics(
    vehicle: Vehicle, state: State, nu_dot: Velocity, t=0.0, moving: tuple[Any, ...] | None = None
) -> Wrench:
    """The control wrench at `o` [N, N m] that gives the acceleration `nu_dot`, for feedforward control.

    - `moving`: motion of masses inside, as in `Input`; None: they rest where the file has them.
    """
    count = len(vehicle.drive_names)
    nothing = Input(jnp.zeros(count), jnp.zeros(count), jnp.zeros(6), jnp.asarray(t, float), moving=moving)
    return vehicle.plant().balance(state, nu_dot, nothing)
