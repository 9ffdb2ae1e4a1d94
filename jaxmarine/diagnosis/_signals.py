"""When and where the knots of the missing wrench lie, and what was measured there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._types import ATTITUDE, POSITION, RATE, VELOCITY
from ..fitting import Cut
from ..logs import smooth_states
from ..networks import SIGNALS
from ..physics import from_euler, rotation
from ..vehicle import Vehicle

Signals = dict[str, Float[np.ndarray, "windows knots"]]


@dataclasses.dataclass(frozen=True)
class Places:
    """The middles of the knots.

    - `t` in its log's own time [s], `log` [windows]; `rotation` from body to world axes.
    - `velocity`: linear [m/s] and angular [rad/s] in body axes.
    - `signals`: what a missing wrench may depend on, by name; those that never change are left out.
    """

    t: Float[np.ndarray, "windows knots"]
    log: np.ndarray
    rotation: Float[np.ndarray, "windows knots 3 3"]
    velocity: Float[np.ndarray, "windows knots 6"]
    signals: Signals


def places(vehicle: Vehicle, data: Cut, count: int) -> Places:
    """The places of `count` knots in each window of a cut."""
    step = np.asarray(data.windows.step)
    part = np.arange(step.shape[1]) * count // step.shape[1]
    middle = np.array([step[:, part == k].mean(axis=1) for k in range(count)]).T
    log = np.asarray(data.windows.log)
    t = np.zeros((len(log), count))
    state = np.zeros((len(log), count, 12))
    command = np.zeros((len(log), count, len(vehicle.thruster_names)))
    for i, source in enumerate(data.logs):
        here = log == i
        track = smooth_states(source, vehicle.dof)
        sample = np.clip(np.round(middle[here]).astype(int), 0, len(source.t) - 1)
        t[here] = source.t[sample]
        state[here] = np.concatenate([track.position, track.attitude, track.nu], axis=1)[sample]
        if source.commands is not None:
            command[here] = np.asarray(source.commands)[sample][..., : command.shape[-1]]
    names = (*POSITION, *ATTITUDE, *VELOCITY, *RATE)
    signals = {name: state[:, :, i] for i, name in enumerate(names) if name in SIGNALS}
    signals |= {name: command[:, :, i] for i, name in enumerate(vehicle.thruster_names)}
    # Time over all logs in order, so that a drift from log to log is a dependence too.
    spans = np.cumsum([0.0, *[source.duration for source in data.logs]])[:-1]
    signals["t"] = t + spans[log][:, None]
    turns = jax.vmap(jax.vmap(lambda a: rotation(from_euler(a))))(jnp.asarray(state[:, :, 3:6]))
    return Places(
        t=t,
        log=log,
        rotation=np.asarray(turns),
        velocity=state[:, :, 6:],
        signals={name: values for name, values in signals.items() if np.ptp(values) > 1e-6},
    )
