"""From commands to thrust: delay, deadband, saturation, curve, gain, lag."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Commands, Times


class Drive(eqx.Module):
    """How each thruster turns its command into thrust; one entry per thruster.

    In the order in which they act: `delay` [s], `deadband` [command], `saturation` [command],
    `quadratic` [1] (share of the command that acts as c|c|), `gain` [1], `lag` [s] (first order),
    `inflow` [s/m] (relative loss per speed through the water along the thruster).
    `max_thrust` [N] is the thrust at command 1.
    """

    delay: Float[Array, "*times thrusters"]
    deadband: Float[Array, "*times thrusters"]
    saturation: Float[Array, "*times thrusters"]
    quadratic: Float[Array, "*times thrusters"]
    gain: Float[Array, "*times thrusters"]
    lag: Float[Array, "*times thrusters"]
    inflow: Float[Array, "*times thrusters"]
    max_thrust: Float[Array, "*times thrusters"]


def step_lengths(t: Times) -> Times:
    """Length of each sample's hold [s]; the last sample is held as long as the one before it."""
    steps = jnp.diff(t)
    return jnp.concatenate([steps, steps[-1:]])


def _delayed(t: Times, commands: Commands, delay: Commands) -> Commands:
    """Mean over each hold of the command `delay` seconds earlier.

    The mean of a delayed staircase follows from its running integral, which is exact at any sampling
    and differentiable in the delay. Before the log the first command is taken to have held. Written
    as the last command that acts in the hold plus what the earlier ones change, so that a delay of
    zero gives the commands to the last bit; its derivative there is that of a small positive delay.
    """
    dt = step_lengths(t)
    integral = jnp.concatenate(
        [jnp.zeros((1, commands.shape[1])), jnp.cumsum(commands * dt[:, None], axis=0)]
    )
    times = jnp.concatenate([t, t[-1:] + dt[-1:]])

    def one(integral, delay, c):
        def cell(time):
            """The sample whose hold has the time in it; at a border the earlier one."""
            return jnp.clip(jnp.searchsorted(times, time, side="left") - 1, 0, len(c) - 1)

        start = times[:-1] - delay
        i, j = cell(start), cell(times[1:] - delay)
        earlier = c[i] * (times[i + 1] - start) + (integral[j] - integral[i + 1])
        return c[j] + (earlier - c[j] * (times[j] - start)) / dt

    return jax.vmap(one, in_axes=1, out_axes=1)(integral, delay, commands)


def thrust(drive: Drive, t: Times, commands: Commands) -> tuple[Commands, Commands]:
    """Thrust of each thruster without inflow loss [N]: mean over each hold, and at each sample.

    - `drive`: with one row per sample (its constants may change at a sample).
    - `commands`: held from each sample to the next.

    The mean is what moves the vehicle over the hold: the lag is integrated in closed form, so a lag
    of zero is no special case for it. At the sample itself a thruster with lag still gives what it
    gave before the sample, one without gives the new thrust: there the two differ, and the
    derivative with respect to a lag of zero does not exist.
    """
    c = _delayed(t, commands, drive.delay)
    # Without a dead zone a command of zero is not silent: its slope with respect to the delay is one.
    silent = (jnp.abs(c) <= drive.deadband) & (drive.deadband > 0.0)
    c = jnp.where(silent, 0.0, c - jnp.sign(c) * drive.deadband)
    c = jnp.clip(c, -drive.saturation, drive.saturation)
    c = (1.0 - drive.quadratic) * c + drive.quadratic * c * jnp.abs(c)
    goal = drive.max_thrust * drive.gain * c

    dt = step_lengths(t)[:, None]
    lag = jnp.maximum(drive.lag, 1e-9)  # keeps the derivative finite; exp(-dt/1e-9) is zero
    decay = jnp.exp(-dt / lag)

    def hold(state, now):
        goal, decay = now
        return goal + (state - goal) * decay, state

    _, start = jax.lax.scan(hold, goal[0], (goal, decay))
    mean = goal + (start - goal) * jnp.maximum(drive.lag, 0.0) / dt * (1.0 - decay)
    return mean, jnp.where(drive.lag > 0.0, start, goal)
