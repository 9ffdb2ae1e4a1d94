"""The one-step loss: accelerations at each sample, from the measured motion and the commands there.

    r_k = sigma^-1 M^-1 (M nu'_k + C nu_k + D nu_k + g - tau_k)

It needs no integration and is nearly linear in the parameters, but takes the measured velocities
for true: their noise enters the regressors and pulls damping towards zero.
"""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._types import ACCELERATIONS, ALL_CHANNELS, MOTION, STATE
from ..logs import Log, alike, smooth_states
from ..physics import apply, from_euler
from ..vehicle import Input, Plant, State
from ._coverage import acceleration_of
from ._driven import HALF
from ._estimate import Estimate, Units
from ._free import Freed, FreedPlant
from ._rollout import Problem, fluid_memory, late_of, moves_of, of_segment, start_precision, thrust_of
from ._trajectory import segments
from ._windows import GAP, SHORTEST, cut


class Samples(eqx.Module):
    """The motion at every sample of every log, padded as `Records` are.

    - `weight` [s²/m, s²/rad]: zero on locked axes, in gaps and accidents, and in the padding.
    - `instant`: whether the accelerations are those at the sample, as sensors give them, or the
      mean slope about it, as differentiated velocities are.
    """

    position: Float[Array, "logs steps 3"]
    attitude: Float[Array, "logs steps 4"]
    velocity: Float[Array, "logs steps 6"]
    acceleration: Float[Array, "logs steps 6"]
    weight: Float[Array, "logs steps 6"]
    instant: bool = eqx.field(static=True)


class OneStep(eqx.Module):
    """The residuals of the one-step loss as a function of z."""

    problem: Problem
    samples: Samples
    start: Float[Array, " raw"]
    map: Float[Array, "raw z"]
    precision: Float[Array, " z"]
    segments: int = eqx.field(static=True)
    moving: tuple[int, ...] = eqx.field(static=True)

    def _at_samples(
        self,
        z: Float[Array, " z"],
        of: Callable[[Plant, State, Array, Input], Array],
        some: Int[Array, " some"] | None = None,
    ):
        """`of` the vehicle, its measured state, acceleration and input, at every sample.

        - `some`: places of those that are asked for, log after log.
        """
        theta = self.start + self.map @ z
        plants = jax.vmap(self.problem.plant_of, in_axes=(None, 0))(theta, jnp.arange(self.segments))
        records, samples = self.problem.records, self.samples
        push = thrust_of(self.problem, plants.drive, late_of(self.problem, plants.drive))
        before = jnp.concatenate([push.mean[:, :1], push.mean[:, :-1]], axis=1)
        thrust = push.instant if samples.instant else 0.5 * (before + push.mean)
        lagged, _ = fluid_memory(self.problem, plants)
        states = State(samples.position, samples.attitude, samples.velocity, lagged)
        commands = records.commands[..., : thrust.shape[-1]]
        moving = moves_of(self.problem, plants)
        earlier = jnp.concatenate([records.wrench[:, :1], records.wrench[:, :-1]], axis=1)
        wrench = records.wrench if samples.instant else 0.5 * (earlier + records.wrench)
        drive = Input(thrust, commands, wrench, records.t, moving=moving)

        def one(state, acceleration, drive, segment):
            return of(of_segment(plants, segment), state, acceleration, drive)

        rows = states, samples.acceleration, drive, records.segment
        if some is None:
            return jax.vmap(jax.vmap(one))(*rows)
        place = jnp.divmod(some, records.t.shape[1])
        return jax.vmap(one)(*jax.tree.map(lambda a: a[place], rows))

    def missing(self, z: Float[Array, " z"]) -> Float[Array, "logs steps 6"]:
        """The wrench that the vehicle lacks for the measured acceleration [N, N m]."""
        return self._at_samples(z, lambda plant, state, nu_dot, drive: plant.balance(state, nu_dot, drive))

    def errors(
        self, z: Float[Array, " z"], some: Int[Array, " some"] | None = None
    ) -> Float[Array, "*samples 6"]:
        """Measured acceleration minus the vehicle's [m/s², rad/s²], at all samples of all logs or at some."""

        def of(plant: Plant, state: State, acceleration: Array, drive: Input):
            return apply(plant.mobility(drive), plant.balance(state, acceleration, drive))

        return self._at_samples(z, of, some)

    def residuals(
        self, z: Float[Array, " z"], some: Int[Array, " some"] | None = None
    ) -> Float[Array, "*samples 6"]:
        weight = self.samples.weight
        return self.errors(z, some) * (weight if some is None else weight.reshape(-1, 6)[some])

    def weighted(self, weight) -> "OneStep":
        """The same with other weights per axis, zero where it was zero."""
        new = jnp.where(self.samples.weight > 0, jnp.asarray(weight)[None, None], 0.0)
        return eqx.tree_at(lambda s: s.samples.weight, self, new)


def one_step(
    freed: Freed, units: Units, logs: Sequence[Log], noise: Float[np.ndarray, " channels"]
) -> OneStep:
    """The one-step problem of logs; each axis weighs by the spread of its own acceleration.

    Accelerations are differentiated on all axes where one of them was not measured in some log: a measured
    one goes with the force at its sample, the others with the mean about it.
    """
    free = np.array(freed.vehicle.free > 0, dtype=bool)
    logs = alike(logs, len(noise))
    measured = [np.isfinite((log.channels / noise)[:, ACCELERATIONS]).any(axis=0) for log in logs]
    instant = all(bool(np.all(of_log | ~free)) for of_log in measured)
    used = np.isfinite(noise) & (instant | (np.arange(len(noise)) < STATE.stop))
    logs = [dataclasses.replace(log, channels=np.where(used, log.channels, np.nan)) for log in logs]
    vehicle, acting = freed.vehicle, segments(freed.vehicle, logs)
    # Windows play no part here: the shortest ones there are, so that accidents and gaps leave some.
    data = cut(vehicle, logs, noise, SHORTEST * logs[0].dt, segments=acting.of_samples)
    problem = Problem(
        FreedPlant(freed, jnp.asarray(acting.gates)),
        data.records,
        data.windows,
        jnp.asarray(start_precision(vehicle.free)),
        (),
    )
    return OneStep(
        problem,
        _samples(logs, vehicle.dof, free, data.records.t.shape[1], instant),
        freed.start,
        jnp.asarray(units.map),
        jnp.asarray(units.precision),
        len(acting.gates),
        tuple(np.flatnonzero(vehicle.free).tolist()),
    )


def _samples(
    logs: Sequence[Log], dof: Sequence[str], moving: Bool[np.ndarray, "6"], steps: int, instant: bool
) -> Samples:
    rows = []
    for log in logs:
        track = smooth_states(log, dof)
        guess = np.concatenate([track.position, track.attitude, track.nu], axis=1)
        state = log.channels[:, STATE]
        seen = np.isfinite(state) & np.tile(moving, 2)
        motion = np.where(seen, state, guess)
        acceleration = acceleration_of(log, track.nu)
        measured = np.isin(ALL_CHANNELS[ACCELERATIONS], log.measured)
        known = np.isfinite(acceleration) & moving & (measured | _sound(log)[:, None])
        row = np.concatenate([motion, np.where(known, acceleration, 0.0), known], axis=1)
        rows.append(np.pad(row, [(0, steps - len(row)), (0, 0)]))
    table = np.array(rows)
    acceleration, known = table[..., ACCELERATIONS], table[..., ACCELERATIONS.stop :] > 0
    spread = [acceleration[..., i][known[..., i]].std() if known[..., i].any() else 1.0 for i in range(6)]
    weight = known / np.where(np.array(spread) > 0, spread, 1.0)
    return Samples(
        position=jnp.asarray(table[..., :3]),
        attitude=jax.vmap(jax.vmap(from_euler))(jnp.asarray(table[..., 3:6])),
        velocity=jnp.asarray(table[..., MOTION]),
        acceleration=jnp.asarray(acceleration),
        weight=jnp.asarray(weight),
        instant=instant,
    )


def _sound(log: Log) -> Bool[np.ndarray, " times"]:
    """Samples that what smooths them makes of neither an accident (`Log.rejected`) nor of a gap."""
    reach = max(HALF, 3 * log.dt)
    spans = [(one.start, one.end) for one in log.rejected]
    spans += [(log.t[k], log.t[k + 1]) for k in np.flatnonzero(np.diff(log.t) > GAP * log.dt)]
    near = [(begin - reach <= log.t) & (log.t <= end + reach) for begin, end in spans]
    return ~np.any(near, axis=0) if near else np.ones(len(log.t), bool)


def groups_of(logs: Sequence[Log], steps: int, window: float) -> np.ndarray:
    """The stretch of `window` seconds that each (padded) sample of each log lies in."""
    rows, first = [], 0
    for log in logs:
        own = first + ((log.t - log.t[0]) // window).astype(int)
        first = own[-1] + 1
        rows.append(np.pad(own, (0, steps - len(own)), mode="edge"))
    return np.array(rows)


@eqx.filter_jit
def _solve(task: OneStep, z, max_steps: int):
    def residual(z, task):
        # Locked axes have no residual.
        return task.residuals(z)[..., np.array(task.moving)], jnp.sqrt(task.precision) * z

    solution = optx.least_squares(
        residual,
        # In units of typical sizes and of half the chi-square: far below any standard error.
        optx.LevenbergMarquardt(rtol=1e-6, atol=1e-5),
        z,
        task,
        max_steps=max_steps,
        throw=False,
    )
    return solution.value, solution.stats["num_steps"], solution.result


@eqx.filter_jit
def _slopes(task: OneStep, z):
    return task.errors(z), task.residuals(z), jax.jacfwd(task.residuals)(z)


def fit_one_step(
    freed: Freed,
    units: Units,
    logs: Sequence[Log],
    noise: Float[np.ndarray, " channels"],
    window: float,
    max_steps: int,
    z: Float[np.ndarray, " z"],
) -> Estimate:
    """Minimises the one-step loss from z; a second solve weighs axes by what the first left of them."""
    task = one_step(freed, units, logs, noise)
    near, first, _ = _solve(task, jnp.asarray(z), max_steps)
    task = weighed_by_scatter(task, near)
    near, second, result = _solve(task, near, max_steps)
    _, residual, slope = _slopes(task, near)
    group = groups_of(logs, residual.shape[1], window)
    return _estimate(task, np.asarray(near), residual, slope, group, int(first + second), result)


def weighed_by_scatter(task: OneStep, z: Float[Array, " z"]) -> OneStep:
    """The task whose axes weigh by what it leaves of them at z."""
    errors, _, _ = _slopes(task, z)
    scatter = scatter_of(np.asarray(errors), np.asarray(task.samples.weight) > 0)
    return task.weighted(1.0 / np.maximum(scatter, 1e-9))


def scatter_of(errors: Float[np.ndarray, "logs steps 6"], known: np.ndarray) -> Float[np.ndarray, "6"]:
    """Root mean square per axis where known; one where an axis has no sample."""
    count = known.sum(axis=(0, 1))
    return np.where(count > 0, np.sqrt((errors**2 * known).sum(axis=(0, 1)) / np.maximum(count, 1)), 1.0)


def _estimate(task: OneStep, z, residual, slope, group, steps: int, result) -> Estimate:
    residual, slope = np.asarray(residual), np.asarray(slope)
    scores = np.zeros((group.max() + 1, len(z)))
    information = np.zeros((group.max() + 1, len(z), len(z)))
    for g in range(len(scores)):
        own = group == g
        j, r = slope[own].reshape(-1, len(z)), residual[own].ravel()
        scores[g], information[g] = j.T @ r, j.T @ j
    chi2 = float((residual**2).sum())
    nothing = np.full(task.problem.width, np.nan)
    return Estimate(
        z=z,
        raw=np.asarray(task.start) + np.asarray(task.map) @ z,
        scores=scores,
        information=information,
        spurious=np.zeros((len(z), len(z))),
        chi2=chi2,
        freedom=float((np.asarray(task.samples.weight) > 0).sum()) - len(z),
        steps=steps,
        converged=bool(result == optx.RESULTS.successful) and bool(np.isfinite(chi2)),
        result=optx.RESULTS[result] or "converged",  # pyrefly: ignore[bad-argument-type]
        weighed=np.ones_like(nothing),
        left=nothing,
    )
