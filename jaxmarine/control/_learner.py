"""Learning while the vehicle is under way, in such a way that the model cannot run away."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._types import Velocity
from ..fitting import Select, fit, wrapped
from ..logs import Log, smooth_states
from ..simulation import initial_state, simulate
from ..vehicle import Input, Vehicle


@dataclasses.dataclass(frozen=True)
class Learned:
    """What a learner knows at one time.

    - `vehicle`: the last good model. `recent`: the newest of the log, at most a window long.
    - `taken`: how many updates have been taken.
    - `verdict`: what became of the last update, in words; `errors`: root-mean-square prediction error
      in units of the noise, of the model before it and of the update.
    """

    vehicle: Vehicle
    recent: Log | None = None
    taken: int = 0
    verdict: str = "nothing learned yet"
    errors: tuple[float, float] = (np.nan, np.nan)

    @property
    def accepted(self) -> bool:
        return self.verdict == "accepted"


@dataclasses.dataclass(frozen=True)
class Learner:
    """Refits a model to a sliding window; the update is taken only where it predicts better.

    Four things keep it from running away. The window forgets what is old. The prior of every refit
    stands at the last good model, so that what the window does not excite stays. An update is refused that
    gives energy to the hull at a velocity of the window, or at one that it is to be used at next. The newest
    part of the window is not learned from: there the update has to predict better than the model that it
    is to replace.

    They do not suffice for a network's weights. A stale model may keep the vehicle slow, and what is learned
    there is used at the speed that was meant, where a network may say anything and is not solved for in
    forty steps. So free linear and quadratic damping beside a network that is held: it grows as damping
    does, and the next window puts right what the last one could not tell.

    Damping is refitted without the triangular factor that would keep it dissipative everywhere: in the
    matrices themselves the problem is nearly linear and solved in a few steps, in the factor it is not in
    forty (measured: velocity errors 16 times larger half a minute after a change).

    - `free`, `prior`: what is refitted and its standard deviations, as in `fit`; `tightened`: their share
      that is left once an update has been taken. What the first window told of speeds that later ones do
      not have is then kept. A change that is known of begins anew with `Learned(vehicle)`.
    - `noise`: standard deviation per channel, NaN for those not to use.
    - `learned`, `judged` [s]: lengths of the part that is learned from, and of the newest, which judges.
    - `piece` [s]: windows into which the first is cut, each with an initial state of its own.
    """

    free: Select
    prior: PyTree
    noise: Float[np.ndarray, " channels"]
    learned: float = 15.0
    judged: float = 5.0
    piece: float = 2.5
    max_steps: int = 40
    tightened: float = 0.1

    def __post_init__(self):
        if not (self.learned >= 2 * self.piece > 0 and self.judged > 0):
            raise ValueError("Argument `learned` must be two pieces or more, and `judged` positive.")

    def update(self, before: Learned, log: Log, ahead: Float[np.ndarray, "points 6"]) -> Learned:
        """What is known after `log`, which follows on what was known before.

        - `ahead` [m/s, rad/s]: velocities that the update is to be used at.
        """
        recent = log if before.recent is None else _joined(before.recent, log)
        end = recent.t[-1] + recent.dt
        whole = end - recent.t[0] >= self.learned + self.judged - 1e-6
        if not whole:
            return dataclasses.replace(before, recent=recent, verdict="the window is not full yet")
        # Half a sample of room, as times are rounded.
        half = 0.5 * recent.dt
        recent = recent.between(end - self.learned - self.judged - half, np.inf)
        past, newest = recent.split(end - self.judged - half)
        candidate = self._refitted(before, past)
        if candidate is None:
            return dataclasses.replace(before, recent=recent, verdict="rejected: its fit diverged")
        start = _state_at(before.vehicle, recent, newest.t[0])
        old, new = (
            prediction_error(vehicle, newest, start, self.noise) for vehicle in (before.vehicle, candidate)
        )
        velocities = np.concatenate([smooth_states(recent, before.vehicle.dof).nu, ahead])
        after = dataclasses.replace(before, recent=recent, errors=(old, new))
        if not dissipates(candidate, jnp.asarray(velocities)):
            return dataclasses.replace(after, verdict="rejected: its damping gives energy to the hull")
        # A prediction that diverges is NaN, which is not less.
        if not new < old:
            return dataclasses.replace(after, verdict="rejected: it predicts worse")
        return Learned(candidate, recent, before.taken + 1, "accepted", (old, new))

    def _refitted(self, before: Learned, past: Log) -> Vehicle | None:
        """The last good model fitted to the past; None where that cannot be."""
        share = self.tightened if before.taken else 1.0
        try:
            vehicle = fit(
                before.vehicle,
                past,
                self.free,
                prior=jax.tree.map(lambda std: share * std, self.prior),
                window=self.piece,
                noise=self.noise,
                max_steps=self.max_steps,
                throw=False,
            ).vehicle
        except np.linalg.LinAlgError:
            # Where the roll-outs diverge from the start the information is singular: nothing to go by.
            return None
        finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(vehicle))
        return vehicle if finite else None


def prediction_error(vehicle: Vehicle, log: Log, start, noise: Float[np.ndarray, " channels"]) -> float:
    """Root-mean-square difference of a roll-out to what was measured, in units of the noise."""
    off = wrapped(simulate(vehicle, log, start).channels - log.channels)
    scaled = np.asarray(off) / noise
    used = np.isfinite(log.channels) & np.isfinite(noise)
    return float(np.sqrt((scaled[used] ** 2).mean()))


def dissipates(vehicle: Vehicle, velocities: Float[Array, "points 6"]) -> bool:
    """Whether the hull loses energy to still water at each of these velocities [m/s, rad/s].

    nu . (balance(nu) - balance(0)) on an even keel; the Coriolis term in it does no work. True within
    a millionth of the largest power, so that a hull at rest passes.
    """
    power = np.asarray(_power(vehicle, velocities))
    return bool((power >= -1e-6 * np.abs(power).max()).all())


@eqx.filter_jit
def _power(vehicle: Vehicle, velocities: Float[Array, "points 6"]) -> Float[Array, " points"]:
    plant, count = vehicle.plant(), len(vehicle.drive_names)
    nothing = Input(jnp.zeros(count), jnp.zeros(count), jnp.zeros(6), jnp.zeros(()))

    def needed(nu: Velocity):
        return plant.balance(initial_state(vehicle, velocity=nu), jnp.zeros(6), nothing)

    return jax.vmap(lambda nu: nu @ (needed(nu) - needed(jnp.zeros(6))))(velocities)


def _state_at(vehicle: Vehicle, log: Log, t: float):
    """The smoothed state at a time of the log."""
    track = smooth_states(log, vehicle.dof)
    k = int(np.searchsorted(log.t, t - 1e-9))
    return initial_state(vehicle, track.position[k], track.attitude[k], track.nu[k])


def _joined(first: Log, then: Log) -> Log:
    """One log after the other."""

    def both(a, b):
        return None if a is None or b is None else np.concatenate([a, b])

    return dataclasses.replace(
        then,
        t=np.concatenate([first.t, then.t]),
        channels=np.concatenate([first.channels, then.channels]),
        commands=both(first.commands, then.commands),
        wrench=both(first.wrench, then.wrench),
        battery=both(first.battery, then.battery),
    )
