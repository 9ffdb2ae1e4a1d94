"""From commands to what actuators do: delay, deadband, saturation, curve, gain, lag, limit of the rate.

Of a thruster that is its thrust, of others whatever stands for them: shaft speed, angle, deflection.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Commands, Times

# A rate [1/s] that limits nothing, in units of whatever changes.
UNLIMITED = 1e15


class Curve(eqx.Module):
    r"""A learned share of `max_thrust`, $\sum_k w_k (\tanh(a_k c + b_k) - \tanh b_k)$, for each thruster.

    - `slope` a, `bias` b, `weight` w: one array per unit k, with an entry per thruster as in `Drive`.
    - `low`, `high`: the command is clipped to this range.
    """

    slope: tuple[Float[Array, "*times thrusters"], ...]
    bias: tuple[Float[Array, "*times thrusters"], ...]
    weight: tuple[Float[Array, "*times thrusters"], ...]
    low: Float[Array, "*times thrusters"]
    high: Float[Array, "*times thrusters"]

    def __call__(self, c: Commands) -> Commands:
        c = jnp.clip(c, self.low, self.high)
        out = jnp.zeros_like(c)
        for a, b, w in zip(self.slope, self.bias, self.weight, strict=True):
            out = out + w * (jnp.tanh(a * c + b) - jnp.tanh(b))
        return out


class Drive(eqx.Module):
    """How each thruster turns its command into thrust; one entry per thruster.

    In the order in which they act: `delay` [s], `deadband` [command], `saturation` [command],
    `quadratic` [1] (share of the command that acts as c|c|), `gain` [1], `lag` [s] (first order),
    `inflow` [s/m] (relative loss per speed through the water along the thruster).
    `max_thrust` [N] is the thrust at command 1, `max_thrust_reverse` [N] that at command -1, backwards.
    `curves` are learned ones beside that of the other constants, of the command before the dead zone.
    `rate` [N/s]: the fastest change behind the lag, `UNLIMITED` where there is no limit; None: none has one.
    """

    delay: Float[Array, "*times thrusters"]
    deadband: Float[Array, "*times thrusters"]
    saturation: Float[Array, "*times thrusters"]
    quadratic: Float[Array, "*times thrusters"]
    gain: Float[Array, "*times thrusters"]
    lag: Float[Array, "*times thrusters"]
    inflow: Float[Array, "*times thrusters"]
    max_thrust: Float[Array, "*times thrusters"]
    max_thrust_reverse: Float[Array, "*times thrusters"]
    curves: tuple[Curve, ...] = ()
    rate: Float[Array, "*times thrusters"] | None = None


def step_lengths(t: Times) -> Times:
    """Length of each sample's hold [s]; the last sample is held as long as the one before it."""
    steps = jnp.diff(t)
    return jnp.concatenate([steps, steps[-1:]])


class Late(eqx.Module):
    """What commands were some time before: `mean` and `slope` [1/s] over each hold, `now` at each sample."""

    mean: Commands
    slope: Commands
    now: Commands


def delayed(t: Times, commands: Commands, delay: Commands) -> Late:
    """The commands `delay` seconds earlier.

    Mean and slope (of the straight line with the same first moment) come from running integrals of the
    staircase, which is exact at any sampling and differentiable in the delay. Before the log the first
    command is taken to have held. The mean is written as the last command that acts in the hold plus what
    the earlier ones change, so that a delay of zero gives the commands to the last bit; its derivative
    there is that of a small positive delay. At a sample the command is a stair of the delay.
    """
    dt = step_lengths(t)
    t = t - t[0]  # moments about the clock's zero would cancel where that is far away, as in Unix time
    times = jnp.concatenate([t, t[-1:] + dt[-1:]])
    zero = jnp.zeros((1, commands.shape[1]))
    integral = jnp.concatenate([zero, jnp.cumsum(commands * dt[:, None], axis=0)])
    squares = jnp.diff(times**2)[:, None] / 2
    moment = jnp.concatenate([zero, jnp.cumsum(commands * squares, axis=0)])

    def one(integral, moment, delay, c):
        def cell(time):
            """The sample whose hold has the time in it; at a border the earlier one."""
            return jnp.clip(jnp.searchsorted(times, time, side="left") - 1, 0, len(c) - 1)

        start, end = times[:-1] - delay, times[1:] - delay
        i, j = cell(start), cell(end)
        earlier = c[i] * (times[i + 1] - start) + (integral[j] - integral[i + 1])
        mean = c[j] + (earlier - c[j] * (times[j] - start)) / dt
        first = (
            c[i] * (times[i + 1] ** 2 - start**2) / 2
            + (moment[j] - moment[i + 1])
            + c[j] * (end**2 - times[j] ** 2) / 2
        )
        slope = 12.0 / dt**3 * (first - mean * dt * (start + end) / 2)
        # A border that rounding has moved is still passed.
        now = jnp.searchsorted(times, start + 1e-9, side="right") - 1
        return mean, jnp.where(delay > 0.0, slope, 0.0), c[jnp.clip(now, 0, len(c) - 1)]

    # One thruster after another: for all at once a long log would need four times the memory.
    columns = jax.lax.map(lambda column: one(*column), (integral.T, moment.T, delay.T, commands.T))
    return Late(*(a.T for a in columns))


def _goal(drive: Drive, c: Commands) -> Commands:
    """Thrust that a command asks for [N]: dead zone, saturation, curve, gain.

    The sign of the command itself, not of what a curve makes of it, says which way the propeller turns.
    """
    most = jnp.where(c < 0.0, drive.max_thrust_reverse, drive.max_thrust)
    learned = [curve(c) for curve in drive.curves]
    # Without a dead zone a command of zero is not silent: its slope with respect to the delay is one.
    silent = (jnp.abs(c) <= drive.deadband) & (drive.deadband > 0.0)
    c = jnp.where(silent, 0.0, c - jnp.sign(c) * drive.deadband)
    c = jnp.clip(c, -drive.saturation, drive.saturation)
    c = (1.0 - drive.quadratic) * c + drive.quadratic * c * jnp.abs(c)
    for share in learned:
        c = c + share
    return most * drive.gain * c


class Thrust(eqx.Module):
    """Thrust of each thruster without inflow loss, one row per sample.

    - `mean` [N] and `slope` [N/s] over the hold: the straight line with the same impulse and first moment.
    - `instant` [N]: at the sample itself, just after the command has changed.
    - `before` [N]: where the lag stands at the sample, which is what the hold begins from.
    """

    mean: Commands
    slope: Commands
    instant: Commands
    before: Commands


class Asked(eqx.Module):
    """Thrust that is asked for over each hold, and the first-order lag that answers it.

    - `goal` [N], `rise` [N/s]: mean and slope over the hold; `now` [N]: at its sample.
    - `first`, `last` [N]: at its ends, late by the lag; `decay`: over the hold, of what differs from that.
    - `dt` [s]: length of the hold; `lag` [s]: not negative; `rate` [N/s]: as in `Drive`.
    """

    goal: Float[Array, "*times thrusters"]
    rise: Float[Array, "*times thrusters"]
    now: Float[Array, "*times thrusters"]
    lag: Float[Array, "*times thrusters"]
    dt: Float[Array, "*times 1"]
    first: Float[Array, "*times thrusters"]
    last: Float[Array, "*times thrusters"]
    decay: Float[Array, "*times thrusters"]
    rate: Float[Array, "*times thrusters"] | None = None

    @classmethod
    def of(cls, drive: Drive, late: Late, dt: Float[Array, "times 1"]) -> "Asked":
        """One row per sample: constants of the thrusters, what their commands were, length of the hold."""
        goal, rise = jax.jvp(lambda c: _goal(drive, c), (late.mean,), (late.slope,))
        if drive.rate is not None:
            # A late step within a hold is a steep line, which what is slow does not follow: it has the mean.
            rise = jnp.where(drive.rate < UNLIMITED, 0.0, rise)
        # Keeps the derivative finite; exp(-dt/1e-9) is zero.
        decay = jnp.exp(-dt / jnp.maximum(drive.lag, 1e-9))
        lag = jnp.maximum(drive.lag, 0.0)
        first, last = goal - rise * dt / 2 - rise * lag, goal + rise * dt / 2 - rise * lag
        return cls(goal, rise, _goal(drive, late.now), lag, dt, first, last, decay, drive.rate)

    def _rest(self, before: Float[Array, "*times thrusters"]) -> tuple[Array, Array, Array]:
        """Of what the lag's state differs from the line: at the hold's end, its mean, and its slope.

        It decays, after it has come at the limited rate so near that its lag is slower.
        """
        dt, lag, rest = self.dt, self.lag, before - self.first
        if self.rate is None:
            decay = self.decay
            moment = lag * (lag * (1.0 - decay) - dt * decay - 0.5 * dt * (1.0 - decay))
            return rest * decay, rest * lag / dt * (1.0 - decay), 12.0 * rest * moment / dt**3
        near = self.rate * lag
        moved = jnp.clip(rest - jnp.clip(rest, -near, near), -self.rate * dt, self.rate * dt)
        slow, fast = rest - moved, jnp.abs(moved) / self.rate
        decay = jnp.exp(-(dt - fast) / jnp.maximum(lag, 1e-9))
        mean = (0.5 * (rest + slow) * fast + slow * lag * (1.0 - decay)) / dt
        moment = rest * fast * (fast - dt) / 2 - moved * fast * (fast / 3 - dt / 4)
        late = lag * (1.0 - decay) * (lag + fast - dt / 2) - lag * (dt - fast) * decay
        return slow * decay, mean, 12.0 * (moment + slow * late) / dt**3

    def after(self, before: Float[Array, "*times thrusters"]) -> Float[Array, "*times thrusters"]:
        """Where the lag stands at the end of the hold: its answer to the line, and a decaying rest."""
        return self.last + self._rest(before)[0]

    def thrust(self, before: Commands) -> Thrust:
        """From where the lag stands at the sample."""
        _, mean, slope = self._rest(before)
        slow = self.lag > 0.0
        if self.rate is not None:
            slow = slow | (self.rate < UNLIMITED)
        return Thrust(
            mean=self.goal - self.rise * self.lag + mean,
            slope=self.rise + slope,
            instant=jnp.where(slow, before, self.now),
            before=before,
        )


def lagging(drive: Drive, late: Late, t: Times) -> Thrust:
    """Thrust from the commands that act: `thrust`, once those are known."""
    asked = Asked.of(drive, late, step_lengths(t)[:, None])
    _, before = jax.lax.scan(lambda state, now: (now.after(state), state), asked.goal[0], asked)
    return asked.thrust(before)


def thrust(drive: Drive, t: Times, commands: Commands) -> Thrust:
    """Thrust from held commands.

    - `drive`: with one row per sample (its constants may change at a sample).
    - `commands`: held from each sample to the next.

    What moves the vehicle over a hold is the thrust's impulse and first moment; the lag is integrated in
    closed form, so a lag of zero is no special case for them. At the sample itself a thruster with lag
    still gives what it gave before the sample, one without gives the new thrust: there the two differ,
    and the derivative with respect to a lag of zero does not exist.
    """
    return lagging(drive, delayed(t, commands, drive.delay), t)
