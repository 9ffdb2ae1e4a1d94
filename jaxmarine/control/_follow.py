"""A vehicle under control, sample by sample: a wrench known beforehand, and feedback of what is measured."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Matrix6, Velocity, Wrench
from ..allocation import Allocation
from ..physics import Asked, Late, apply, compose, conjugate, rotation, step_lengths
from ..simulation import Trajectory, hold, substeps
from ..vehicle import Input, Plant, State, Vehicle
from ._path import Reference


class Feedback(eqx.Module):
    """Proportional and derivative feedback in body axes: tau = `stiffness` e + `damping` (nu_ref - nu).

    e is the way to the reference [m] and the turn to its attitude [rad], small angle. After Fossen (2021),
    on PD control of position and attitude.
    """

    stiffness: Matrix6
    damping: Matrix6

    def __call__(self, wanted: State, seen: State) -> Wrench:
        return apply(self.stiffness, _off(wanted, seen)) + apply(
            self.damping, wanted.velocity - seen.velocity
        )


def _off(wanted: State, seen: State) -> Velocity:
    """Way and turn from the state that is seen to the one that is wanted, body axes [m, rad]."""
    turn = compose(conjugate(seen.attitude), wanted.attitude)
    # q and -q are one attitude: take the shorter turn.
    turn = 2.0 * jnp.where(turn[0] < 0, -turn[1:], turn[1:])
    return jnp.concatenate([apply(rotation(seen.attitude).T, wanted.position - seen.position), turn])


def pole_placement(mass: Matrix6, frequency: float, ratio: float = 1.0) -> Feedback:
    """Gains with which mass alone would answer at `frequency` [rad/s] and damping `ratio` [1].

    e'' + 2 ratio frequency e' + frequency² e = 0; after Fossen (2021).
    """
    return Feedback(frequency**2 * mass, 2.0 * ratio * frequency * mass)


class Run(eqx.Module):
    """What a vehicle did under control, and the `wrench` that was asked for over each hold [N, N m].

    - `commands`: those of its actuators, in the columns' units; None where the wrench itself acted.
    """

    trajectory: Trajectory
    wrench: Float[Array, "times 6"]
    commands: Float[Array, "times columns"] | None = None


def follow(
    vehicle: Vehicle,
    reference: Reference,
    wrench: Float[Array, "times 6"],
    start: State,
    feedback: Feedback | None = None,
    errors: Float[Array, "times 12"] | None = None,
    steered: Sequence[str] | None = None,
) -> Run:
    """Lets the vehicle go under `wrench`, held over each sample, plus feedback of the measured state.

    - `reference`: at the samples, where the state is measured. `start`: the state at the first.
    - `feedback`: None leaves the wrench alone.
    - `errors`: by what the sensors move the state at each sample (`State.moved`).
    - `steered`: axes on which the craft's own actuators are to give the wrench, as far as they can: by
      commands from `allocate` at the velocity that is measured, and with limits, lags and rates, in a calm.
      None: the wrench itself acts.
    """
    if wrench.shape != (len(reference.t), 6):
        raise ValueError(f"Argument `wrench` must be ({len(reference.t)}, 6), but is {wrench.shape}.")
    dt = float(step_lengths(reference.t).max())
    errors = jnp.zeros((len(reference.t), 12)) if errors is None else errors
    split = jnp.asarray(substeps(vehicle, dt))
    if steered is None:
        return _run(vehicle, reference, wrench, start, feedback, errors, split)
    if np.any(vehicle.plant().drive.delay):
        raise ValueError("Argument `steered` needs actuators without delay, which no command makes up for.")
    allocation = Allocation.of(vehicle, steered)
    return _steer(vehicle, reference, wrench, start, feedback, errors, split, allocation)


@eqx.filter_jit
def _run(vehicle: Vehicle, reference: Reference, wrench, start, feedback, errors, split) -> Run:
    plant = vehicle.plant()

    def step(state: State, now):
        t, dt, wanted, tau, error = now
        if feedback is not None:
            tau = tau + feedback(wanted, state.moved(error))
        drive = _of_wrench(plant, t, tau)
        shown = plant.readings(state, plant.acceleration(state, drive))
        return hold(plant, state, drive, dt, split), (state, shown, tau)

    over = (reference.t, step_lengths(reference.t), reference.states, wrench, errors)
    _, (states, channels, applied) = jax.lax.scan(step, start, over)
    return Run(Trajectory(reference.t, channels, states), applied)


@eqx.filter_jit
def _steer(
    vehicle: Vehicle, reference: Reference, wrench, start, feedback, errors, split, allocation: Allocation
) -> Run:
    """`_run` through the actuators, whose state goes on from sample to sample; before the first they rest."""
    plant = vehicle.plant()

    def asked(commands: Float[Array, " columns"], dt) -> Asked:
        now, drive = jax.tree.map(lambda a: a[None], (commands, plant.drive))
        return Asked.of(drive, Late(now, jnp.zeros_like(now), now), dt[None, None])

    def step(before, now):
        state, acting = before
        t, dt, wanted, tau, error = now
        seen = state.moved(error)
        if feedback is not None:
            tau = tau + feedback(wanted, seen)
        nu_r = plant.relative(seen.attitude, seen.velocity)
        commands = allocation(plant, tau, nu_r, allocation.begin)
        goal = asked(commands, dt)
        given = jax.tree.map(lambda a: a[0], goal.thrust(acting[None]))
        none = jnp.zeros(6)
        drive = Input(given.mean, commands, none, t, given.slope, t + 0.5 * dt)
        shown = plant.readings(state, plant.acceleration(state, Input(given.instant, commands, none, t)))
        return (hold(plant, state, drive, dt, split), goal.after(acting[None])[0]), (
            state,
            shown,
            tau,
            commands,
        )

    steps = step_lengths(reference.t)
    at_rest = jnp.where(np.array(allocation.commanded), 0.0, allocation.begin)
    begin = start, asked(at_rest, steps[0]).goal[0]
    over = (reference.t, steps, reference.states, wrench, errors)
    _, (states, channels, applied, commands) = jax.lax.scan(step, begin, over)
    return Run(Trajectory(reference.t, channels, states), applied, commands)


def _of_wrench(plant: Plant, t, tau: Wrench) -> Input:
    nothing = jnp.zeros(plant.direction.shape[0])
    return Input(nothing, nothing, tau, t)
