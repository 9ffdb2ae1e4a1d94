"""A vehicle and its commands become a trajectory. The one place that knows diffrax.

Commands are held over each sample, so the integration steps from sample to sample with the held
input as its argument: an input looked up by time inside the vector field would give the last stage
of a step the next sample.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._types import ALL_CHANNELS, ALL_SENSORS, ALWAYS, Times, width_of
from ._vmap_last import vmap_last
from .logs import Log
from .physics import Asked, Late, from_euler, late, step_lengths, thrust
from .vehicle import Input, Plant, State, Vehicle

# A product of step and fastest decay rate that the explicit method takes with an error below 1e-3.
_STABLE = 0.8


class RungeKutta4(diffrax.AbstractSolver):
    """The classical fourth-order method, without step control (Kutta 1901).

    diffrax' own Runge-Kutta methods keep the slopes of all stages and sum them by products with the tableau.
    In this one a stage needs the slope before it alone, and nothing else is kept: fewer operations for
    a state of thirteen numbers. It can be differentiated in reverse mode as well.
    """

    term_structure: ClassVar = diffrax.ODETerm
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation

    def order(self, terms):
        del terms
        return 4

    def init(self, terms, t0, t1, y0, args) -> None:
        del terms, t0, t1, y0, args

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del solver_state, made_jump
        dt = terms.contr(t0, t1)

        def stage(sums, now):
            slope, total = sums
            share, weight = now
            at = jax.tree.map(lambda y, k: y + share * dt * k, y0, slope)
            slope = terms.vf(t0 + share * dt, at, args)
            return (slope, jax.tree.map(lambda s, k: s + weight * k, total, slope)), None

        nothing = jax.tree.map(jnp.zeros_like, y0)
        stages = jnp.asarray(_STAGES, jnp.result_type(*jax.tree.leaves(y0)))
        # Traced once, but written out: a loop copies the state from stage to stage, for two thirds more time.
        (_, total), _ = jax.lax.scan(stage, (nothing, nothing), stages, unroll=len(stages))
        y1 = jax.tree.map(lambda y, k: y + dt * k, y0, total)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


# Of each stage: how far along the slope before it lies, and its weight in the sum.
_STAGES = np.array([[0.0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1.0, 1 / 6]])


def _flat(state: State) -> Float[Array, " numbers *vehicles"]:
    return jnp.concatenate([state.position, state.attitude, state.velocity, state.memory])


def _parted(y: Float[Array, " numbers *vehicles"]) -> tuple[Array, ...]:
    return y[:3], y[3:7], y[7:13], y[13:]


def _unflat(y: Float[Array, " numbers"]) -> State:
    return State(*_parted(y))


def _rates(t, y: Float[Array, " numbers"], args: tuple[Plant, Input]):
    plant, drive = args
    # Commands are held; the thrust of a slow thruster changes within the hold, and waves go on.
    thrust = drive.thrust if drive.slope is None else drive.thrust + drive.slope * (t - drive.middle)
    drive = dataclasses.replace(drive, thrust=thrust, t=t, slope=None, middle=None)
    return _flat(plant.rates(_unflat(y), drive))


def _rates_of_many(t: Float[Array, "1 vehicles"], y: Float[Array, "numbers vehicles"], args):
    plant, drives, alike = args
    rates = vmap_last(lambda t, y, *one: _rates(t, y, one), (True, True, not alike, True))
    return rates(t[0], y, plant, drives)


def _stepped(method: RungeKutta4, rates, t, dt, y, args, split: int | Int[Array, ""]):
    """The flat state after a hold from `t` on, by so many steps."""
    term, dt = diffrax.ODETerm(rates), dt / split

    def step(k, y):
        start = t + k * dt
        # The method has no state of its own: no step is the first.
        return method.step(term, start, start + dt, y, args, None, False)[0]

    return jax.lax.fori_loop(0, split, step, y)


def hold(plant: Plant, state: State, drive: Input, dt, split: int | Int[Array, ""] = 1) -> State:
    """The state after one hold of length `dt` [s], by `split` steps of the classical Runge-Kutta method.

    It can be differentiated in reverse mode where `split` is a number.
    """
    after = _stepped(RungeKutta4(), _rates, drive.t, dt, _flat(state), (plant, drive), split)
    return _unflat(after)


def hold_many(
    plant: Plant, states: State, drives: Input, dt, split: int | Int[Array, ""] = 1, alike: bool = True
) -> State:
    """`hold` for many vehicles, which lie along the last axis of all arrays: far faster than under `vmap`.

    - `alike`: they have one plant; else the plant's arrays have that axis as well.
    """
    args = plant, drives, alike
    after = _stepped(RungeKutta4(), _rates_of_many, drives.t[None], dt[None], _flat(states), args, split)
    # Not made anew, as the vehicles come first in a state of many otherwise.
    return jax.tree.unflatten(jax.tree.structure(states), _parted(after))


def asked(plant: Plant, commands: Float[Array, " columns"], dt) -> Asked:
    """What commands without delay ask of the actuators over one hold of `dt` [s], as one row."""
    now, drive = jax.tree.map(lambda a: a[None], (commands, plant.drive))
    return Asked.of(drive, Late(now, jnp.zeros_like(now), now), jnp.reshape(dt, (1, 1)))


class Held(NamedTuple):
    """One sample of a vehicle whose commands are known only then.

    - `after`: the state at the next sample; `acting`: where the actuators' lags stand there, in the units of
      `Input.thrust`.
    - `shown`: what the sensors show at this sample; `given`: thrust and states of actuators that act at it.
    """

    after: State
    acting: Float[Array, " columns"]
    shown: Float[Array, " channels"]
    given: Float[Array, " columns"]


def steer(
    plant: Plant,
    state: State,
    acting: Float[Array, " columns"],
    commands,
    push,
    t,
    dt,
    split,
    width: int = ALWAYS,
) -> Held:
    """From one sample to the next under commands, for what is simulated while it is steered.

    - `acting`: where the actuators' lags stand at the sample; before the first, `asked(...).goal[0]`.
    - `push`: a wrench on the hull beside the actuators' [N, N m, body axes].
    - `width`: how many channels are shown.

    Without delays of commands and of sensors, which ask for what was before.
    """
    goal = asked(plant, commands, dt)
    given = jax.tree.map(lambda a: a[0], goal.thrust(acting[None]))
    over = Input(given.mean, commands, push, t, given.slope, t + 0.5 * dt)
    now = Input(given.instant, commands, push, t)
    shown = plant.readings(state, plant.acceleration(state, now), width)
    return Held(hold(plant, state, over, dt, split), goal.after(acting[None])[0], shown, given.instant)


class Trajectory(eqx.Module):
    """What a simulation gives at each sample of its log.

    - `t` [s]; `channels`: what the sensors show, in the order of `ALL_CHANNELS`, as many as were asked;
      `states`: the states, batched along the samples.
    """

    t: Times
    channels: Float[Array, "times channels"]
    states: State

    def __getitem__(self, channel: str) -> Times:
        place = ALL_CHANNELS.index(channel)
        if place >= self.channels.shape[1]:
            raise ValueError(f"Channel `{channel}` was not simulated; name its kind in `sensors`.")
        return self.channels[:, place]


def gates(vehicle: Vehicle, log: Log, earlier: tuple[str, ...] = ()) -> Float[np.ndarray, "times placed"]:
    """1 where a placed effect acts at a sample of the log, else 0.

    An effect with `since` acts from that time on in the log that it names (in any log, where it
    names none), not at all in the logs named in `earlier`, and always in all others.
    """
    out = np.ones((len(log.t), len(vehicle.placed)))
    for i, placed in enumerate(vehicle.placed):
        if placed.since is None:
            continue
        if placed.since_log in (None, log.name):
            out[:, i] = log.t >= placed.since - 1e-9  # times such as 3 * 0.1 are rounded
        elif log.name in earlier:
            out[:, i] = 0.0
    return out


def initial_state(vehicle: Vehicle, position=(0, 0, 0), attitude=(0, 0, 0), velocity=(0,) * 6) -> State:
    """A state from position [m], roll, pitch, yaw [rad] and body velocities [m/s, rad/s]."""
    return State(
        position=jnp.asarray(position, float),
        attitude=from_euler(jnp.asarray(attitude, float)),
        velocity=jnp.asarray(velocity, float),
        memory=jnp.zeros(6 * len(vehicle.plant().memories)),
    )


def substeps(vehicle: Vehicle, dt: float, speed: float | Float[np.ndarray, "6"] = 1.0) -> int:
    """Into how many steps a hold of `dt` [s] must be cut for the explicit method.

    From the largest eigenvalue of M^-1 (D_l + 2 D_q speed), `speed` in m/s and rad/s (one for all axes,
    or one each), and the oscillation of the restoring moments, and from the lag of fluid memory.
    """
    plant = vehicle.plant()
    by_turn, by_nu = _slopes(plant, initial_state(vehicle, velocity=speed * vehicle.free))
    system = np.zeros((9, 9))
    system[:3, 6:] = np.diag(vehicle.free[3:])
    system[3:, :3] = np.asarray(by_turn) * vehicle.free[3:]
    system[3:, 3:] = by_nu
    fastest = np.abs(np.linalg.eigvals(system)).max()
    if plant.has_memory:
        fastest = max(fastest, float(jnp.max(1.0 / plant.memory_lag())))
    return max(1, int(np.ceil(fastest * dt / _STABLE)))


@eqx.filter_jit
def _slopes(plant: Plant, state: State) -> tuple[Array, Array]:
    """Of the acceleration without commands, by small turns of a level vehicle and by velocity."""
    none = jnp.zeros_like(plant.drive.max_thrust)

    def flow(turn, nu):
        tilted = eqx.tree_at(lambda s: (s.attitude, s.velocity), state, (from_euler(turn), nu))
        return plant.acceleration(tilted, Input(none, none, jnp.zeros(6), jnp.zeros(())))

    return jax.jacfwd(flow, argnums=(0, 1))(jnp.zeros(3), state.velocity)


def inputs(plant: Plant, t: Times, commands, wrench) -> tuple[Input, Input]:
    """The inputs over each hold and at each sample.

    - `plant`: constants of the drive with one row per sample, or without (then they hold throughout).
    - `commands`: columns as `Vehicle.command_names`.
    """
    moving = plant.moves(t, commands)
    commands = commands[:, : plant.drive.max_thrust.shape[-1]]
    drive = jax.tree.map(lambda a: jnp.broadcast_to(a, commands.shape), plant.drive)
    push = thrust(drive, t, commands)
    middle = t + 0.5 * step_lengths(t)
    over = Input(push.mean, commands, wrench, t, push.slope, middle, moving)
    return over, Input(push.instant, commands, wrench, t, moving=moving)


class Disturbing(NamedTuple):
    """What disturbs a craft at the samples of a log, as of `simulate`; None: it does not."""

    push: Float[Array, "times 6"] | None
    water: Float[Array, "times 3"] | None
    drift: Float[Array, "times 3"] | None

    def over(self) -> "Disturbing":
        """Its mean over each hold: it does not wait for a sample as commands do, and the last one stays."""
        return jax.tree.map(lambda a: jnp.concatenate([0.5 * (a[:-1] + a[1:]), a[-1:]]), self)

    def beside(self, drive: Input) -> Input:
        wrench = drive.wrench if self.push is None else drive.wrench + self.push
        return dataclasses.replace(drive, wrench=wrench, water=self.water, drift=self.drift)


@eqx.filter_jit
def _roll_out(
    vehicle: Vehicle,
    acting,
    segment,
    start: State,
    t,
    commands,
    wrench,
    disturbing: Disturbing,
    solver,
    split,
    width,
):
    plants = jax.vmap(vehicle.plant)(acting)
    # Masses inside are no effects: they are the same in all segments.
    sampled = eqx.tree_at(lambda p: p.masses, jax.tree.map(lambda a: a[segment], plants), vehicle.masses)
    over, at = inputs(sampled, t, commands, wrench)
    over, at = disturbing.over().beside(over), disturbing.beside(at)

    def step(state, now):
        index, over, at, dt, split = now
        plant = jax.tree.map(lambda a: a[index], plants)
        shown = plant.amid(at.water).readings(state, plant.acceleration(state, at), width)
        if solver is None:
            after = hold(plant, state, over, dt, split)
        else:
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(_rates),
                solver,
                over.t,
                over.t + dt,
                dt / split,
                _flat(state),
                (plant, over),
                stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-10),
                saveat=diffrax.SaveAt(t1=True),
            )
            assert solution.ys is not None
            after = _unflat(solution.ys[0])
        return after, (state, shown)

    _, (states, channels) = jax.lax.scan(step, start, (segment, over, at, step_lengths(t), split))
    if sampled.delay is not None:
        channels = late(t, channels, sampled.delay)
    return Trajectory(t, channels, states)


def simulate(
    vehicle: Vehicle,
    log: Log,
    start: State,
    solver: diffrax.AbstractSolver | None = None,
    earlier: tuple[str, ...] = (),
    push: Float[np.ndarray, "times 6"] | None = None,
    sensors: Sequence[str] = (),
    water: Float[np.ndarray, "times 3"] | None = None,
    drift: Float[np.ndarray, "times 3"] | None = None,
) -> Trajectory:
    """Simulates the vehicle from `start` under the commands (or control wrench) of a log.

    - `solver`: None steps each sample by the classical Runge-Kutta method, cut as finely as the
      vehicle's fastest mode needs. Any diffrax solver runs with adaptive steps inside each sample
      (rtol 1e-8): `diffrax.Tsit5()`, or `diffrax.Kvaerno5()` for stiff vehicles.
    - `earlier`: names of logs recorded before the effects with `since` began.
    - `push`: a wrench on the hull [N, N m, body axes] beside what the log commands: what disturbs it, such as
      a draw of a `RandomWrench`. From sample to sample it goes along a line, of which the mean acts.
    - `water`: velocity of the water [m/s, north, east, down] beside the vehicle's own, likewise.
    - `drift`: a force at the vehicle's origin [N, north, east, down], likewise.
    - `sensors`: kinds to show beside those of every log and of this one: "water_velocity", "specific_force".
    """
    unknown = [kind for kind in sensors if kind not in ALL_SENSORS]
    if unknown:
        raise ValueError(f"Argument `sensors` has {unknown[0]!r}, which is none of {', '.join(ALL_SENSORS)}.")
    asked_for = width_of(kind in sensors for kind, channels in ALL_SENSORS.items() for _ in channels)
    acting, segment = np.unique(gates(vehicle, log, earlier), axis=0, return_inverse=True)
    count = len(vehicle.command_names)
    given = log.commanded(vehicle.command_names)
    commands = jnp.zeros((len(log.t), count)) if given is None else jnp.asarray(given)
    wrench = jnp.zeros((len(log.t), 6)) if log.wrench is None else jnp.asarray(log.wrench)
    # A gap in the log is one long hold.
    lengths = np.asarray(step_lengths(jnp.asarray(log.t)))
    split = np.ceil(substeps(vehicle, log.dt) * np.maximum(lengths / log.dt - 0.01, 1.0)).astype(int)
    return _roll_out(
        vehicle,
        jnp.asarray(acting),
        jnp.asarray(segment.ravel()),
        start,
        jnp.asarray(log.t),
        commands,
        wrench,
        Disturbing(*(None if one is None else jnp.asarray(one) for one in (push, water, drift))),
        solver,
        jnp.asarray(split),
        max(log.channels.shape[1], asked_for),
    )
