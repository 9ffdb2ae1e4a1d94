"""Commands that give a wanted wrench: of thrusters in closed form, of other actuators by Newton steps."""

from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._types import DOFS, Velocity, Wrench
from .actuators import AbstractActuators, Supply, Swivels
from .physics import apply
from .vehicle import Plant, Vehicle

# Thrust goes with the square of the shaft speed: from the middle of the range a tenth of full thrust, or all
# of it, is met to a part in 1e8 after four steps. Azimuths that have to go astern take up to twelve; of
# wrenches within half of a ferry's thrust they then meet 93 in 100, the rest as far as the nearest way leads.
_STEPS = 12


def allocate(
    vehicle: Vehicle,
    wrench: Float[Array, "*times 6"],
    dof: Sequence[str] | None = None,
    velocity: Float[Array, "*moving 6"] | None = None,
    begin: Float[Array, "*times columns"] | None = None,
) -> Float[Array, "*times columns"]:
    """Commands with which the actuators of the file's sections together give a wrench, where they can.

    - `wrench`: wanted at `o`, body axes [N, N m], beside what they give where all commands are zero, as
      `inverse_dynamics` asks for it.
    - `dof`: the axes on which it is asked for, default all free ones; on the others it comes out as it does.
    - `velocity`: of the craft through the water, body axes [m/s, rad/s], default at rest.
    - `begin`: commands from which those of propellers, surfaces and swivels are sought, in the columns'
      units; default the middle of their usual ranges. What nobody commands stays there: by default it is
      calm, and the battery has its nominal voltage.

    Of thrusters alone the least thrusts in the sense of least squares, as shares of `max_thrust`, by the
    pseudo-inverse, and the commands that give them with `max_thrust_reverse` and `quadratic`, clipped to the
    vehicle's limits, whatever the flow. After Fossen (2021).

    With other actuators the forces are linearised at the velocity and the commands, and the least changes of
    commands are taken, as shares of their usual range, a few times. That is singular where a column moves
    nothing: a surface without flow, a swivel without thrust, a propeller at rest in still water. Such a
    command stays where it is, and close by it goes to its limit.

    Neither delay, lag, dead band, rate limits nor effects are made up for.
    """
    allocation, plant = Allocation.of(vehicle, vehicle.dof if dof is None else dof), vehicle.plant()
    if not allocation.in_flow:
        return allocation.by_thrusters(plant, wrench)
    times = wrench.shape[:-1]
    nu_r = jnp.zeros(6) if velocity is None else jnp.asarray(velocity)
    start = allocation.begin if begin is None else jnp.asarray(begin)
    each = (jnp.broadcast_to(one, (*times, one.shape[-1])) for one in (wrench, nu_r, start))
    flat = jax.vmap(lambda *now: allocation(plant, *now))(*(one.reshape(-1, one.shape[-1]) for one in each))
    return flat.reshape(*times, -1)


class Allocation(eqx.Module):
    """What `allocate` needs to know of a vehicle; see there.

    - `rows`: of the wrench, that are asked for; `count`: of thrusters, whose columns are the first.
    - `limits`: of commands; `width`: of each column, half its usual range, what counts as one in the least
      change.
    - `begin`: the middle of each column's usual range. Thrusters that swivel are at half of their thrust, or
      turning them would change nothing; others at rest. No wind, and the battery's nominal voltage.
    - `commanded`: whether somebody sets a column; else it is what was measured.
    """

    limits: Float[Array, " columns"]
    width: Float[Array, " columns"]
    begin: Float[Array, " columns"]
    rows: tuple[int, ...] = eqx.field(static=True)
    commanded: tuple[bool, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @classmethod
    def of(cls, vehicle: Vehicle, dof: Sequence[str]) -> Self:
        others, count = vehicle.actuators, len(vehicle.thruster_names)
        swivels = [i for one in others if isinstance(one, Swivels) for i in one.places]
        at = 0.5 * np.isin(np.arange(count), swivels)
        return cls(
            limits=jnp.asarray(vehicle.command_limits[: len(vehicle.drive_names)]),
            width=jnp.asarray(np.concatenate([np.ones(count), *(0.5 * np.ptp(o.usual, 1) for o in others)])),
            begin=jnp.asarray(np.concatenate([at, *map(_begin, others)])),
            rows=tuple(DOFS.index(name) for name in dof),
            commanded=(True,) * count + tuple(o.commanded for o in others for _ in o.columns),
            count=count,
        )

    @property
    def in_flow(self) -> bool:
        """Whether something else than thrusters is commanded."""
        return any(self.commanded[self.count :])

    def by_thrusters(
        self, plant: Plant, wrench: Float[Array, "*times 6"]
    ) -> Float[Array, "*times thrusters"]:
        """By the pseudo-inverse."""
        rows = np.array(self.rows)
        effect = plant.allocation[rows] * plant.drive.max_thrust[None, : self.count]
        return self._of_shares(plant, wrench[..., rows] @ jnp.linalg.pinv(effect).T)

    def _of_shares(
        self, plant: Plant, shares: Float[Array, "*times thrusters"]
    ) -> Float[Array, "*times thrusters"]:
        """Commands that give thrusts, which are shares of `max_thrust`."""
        drive = plant.drive
        limits, backwards, quadratic = (
            jnp.broadcast_to(one[: self.count], shares.shape)
            for one in (self.limits, drive.max_thrust / drive.max_thrust_reverse, drive.quadratic)
        )
        commands = _uncurved(shares * jnp.where(shares < 0.0, backwards, 1.0), quadratic)
        return jnp.clip(commands, -limits, limits)

    def __call__(
        self, plant: Plant, wrench: Wrench, nu_r: Velocity, start: Float[Array, " columns"]
    ) -> Float[Array, " columns"]:
        """Commands at one time, in the flow, sought from `start`."""
        drive, rows, moves = plant.drive, np.array(self.rows), np.array(self.commanded)
        size = drive.max_thrust * self.width * moves
        high, low = drive.saturation * drive.max_thrust, -drive.saturation * drive.max_thrust_reverse
        idle = plant.pushed(jnp.where(moves, 0.0, start), nu_r)

        def given(acting):
            return (plant.pushed(acting, nu_r) - idle)[rows]

        def step(_, acting):
            slope = jax.jacfwd(given)(acting) * size[None]
            change = size * apply(jnp.linalg.pinv(slope), wrench[rows] - given(acting))
            return jnp.where(moves, jnp.clip(acting + change, low, high), acting)

        acting = jax.lax.fori_loop(0, _STEPS, step, start * drive.max_thrust)
        shares = acting[: self.count] / drive.max_thrust[: self.count]
        return jnp.concatenate([self._of_shares(plant, shares), acting[self.count :]])


def _begin(one: AbstractActuators) -> Float[np.ndarray, " columns"]:
    if isinstance(one, Supply):
        return np.asarray(one.nominal[:1])
    return one.usual.mean(axis=1) if one.commanded else np.zeros(len(one.columns))


def _uncurved(
    share: Float[Array, "*times thrusters"], quadratic: Float[Array, "*times thrusters"]
) -> Float[Array, "*times thrusters"]:
    """The command c with (1 - quadratic) c + quadratic c |c| = share, the largest where there are several.

    Where no command gives so much, as beyond the top of a curve that bends down, that at the top or beyond.
    """
    linear = 1.0 - quadratic
    # Not below a trace, which keeps the derivative finite.
    root = jnp.sqrt(jnp.maximum(linear**2 + 4.0 * quadratic * jnp.abs(share), 1e-18))
    # Each way of writing the quadratic formula is regular where the other divides zero by zero.
    bent = quadratic > 0.5
    by_root = (root - linear) / jnp.where(bent, 2.0 * quadratic, 1.0)
    by_share = 2.0 * jnp.abs(share) / jnp.where(bent, 1.0, root + linear)
    return jnp.sign(share) * jnp.where(bent, by_root, by_share)
