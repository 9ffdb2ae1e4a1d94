"""When and where the knots of the missing wrench lie, and what was measured there."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._types import ATTITUDE, POSITION, RATE, VELOCITY
from ..fitting import Cut, driven
from ..logs import Log, smooth_states
from ..physics import from_euler, rotation, to_euler
from ..vehicle import Vehicle

Signals = dict[str, Float[np.ndarray, "windows knots"]]

# Widths of the play operators, as shares of the largest command in the logs.
PLAYS = (0.1, 0.2, 0.4, 0.8)
# The numbers of a craft's state.
STATE_NAMES = (*POSITION, *ATTITUDE, *VELOCITY, *RATE)


@dataclasses.dataclass(frozen=True)
class Places:
    """The middles of the knots, or of samples, each of which is a knot then.

    - `t` in its log's own time [s], `log` [windows]; `rotation` from body to world axes.
    - `velocity`: linear [m/s] and angular [rad/s] in body axes.
    - `driven`: the wrench that commands give, `o`, body axes [N, N m], 0 on locked axes.
    - `signals`: what a missing wrench may depend on, by name; those that never change are left out.
    - `played`: per thruster what play operators of several widths make of its command, without the
      command and in shares of their width. Every hysteresis without creep is a sum of such operators
      (Prandtl-Ishlinskii; after Visintin 1994).
    """

    t: Float[np.ndarray, "windows knots"]
    log: np.ndarray
    rotation: Float[np.ndarray, "windows knots 3 3"]
    velocity: Float[np.ndarray, "windows knots 6"]
    driven: Float[np.ndarray, "windows knots 6"]
    signals: Signals
    played: dict[str, Float[np.ndarray, "windows knots plays"]]

    @property
    def commanded(self) -> tuple[str, ...]:
        """Thrusters whose command changes."""
        return tuple(name for name in self.played if name in self.signals)

    def in_states(self, states: Float[np.ndarray, "windows knots 13"]) -> "Places":
        """With the craft in other states (position, attitude as a quaternion, velocity), turned as often."""
        position, attitude, velocity = np.split(states, [3, 7], axis=-1)
        turns, angles = jax.vmap(jax.vmap(lambda q: (rotation(q), to_euler(q))))(jnp.asarray(attitude))
        state = np.concatenate([position, angles, velocity], axis=-1)
        now = {name: state[..., i] for i, name in enumerate(STATE_NAMES) if name in self.signals}
        for name in {*ATTITUDE} & {*now}:
            now[name] += 2 * np.pi * np.round((self.signals[name] - now[name]) / (2 * np.pi))
        return dataclasses.replace(
            self, rotation=np.asarray(turns), velocity=velocity, signals=self.signals | now
        )

    def through_water(self, water: Float[np.ndarray, "3"], signals: Signals) -> Signals:
        """Signals with velocities over ground made relative to water that moves (north, east, down) [m/s]."""
        flow = np.einsum("wkij,i->wkj", self.rotation, water)
        moving = {name: signals[name] - flow[..., i] for i, name in enumerate(VELOCITY) if name in signals}
        return signals | moving


class PlacedAt(NamedTuple):
    """The middles of the knots of some logs, and what was measured there.

    - `t` [s], `log`, `rotation`: as of `Places`.
    - `state`: position [m], attitude [rad], velocity and rate [m/s, rad/s]; `command`; `behind`: `played`.
    - `driven`: as of `Places`.
    """

    t: Float[np.ndarray, "windows knots"]
    log: Int[np.ndarray, " windows"]
    rotation: Float[np.ndarray, "windows knots 3 3"]
    state: Float[np.ndarray, "windows knots 12"]
    command: Float[np.ndarray, "windows knots columns"]
    behind: Float[np.ndarray, "windows knots columns plays"]
    driven: Float[np.ndarray, "windows knots 6"]


def samples_at(data: Cut, count: int) -> Int[np.ndarray, "windows knots"]:
    """The samples in the middles of `count` knots in each window of a cut."""
    step = np.asarray(data.windows.step)
    part = np.arange(step.shape[1]) * count // step.shape[1]
    middle = np.array([step[:, part == k].mean(axis=1) for k in range(count)]).T
    return np.round(middle).astype(int)


def placed_at(
    vehicle: Vehicle, data: Cut, first: int, count: int, largest: Float[np.ndarray, " columns"]
) -> PlacedAt:
    """Of `count` knots in each window of a cut.

    - `first`: how many logs come before its own; `largest`: command of each column in all of them.
    """
    sample, log = samples_at(data, count), np.asarray(data.windows.log)
    t = np.zeros((len(log), count))
    state = np.zeros((len(log), count, 12))
    command = np.zeros((len(log), count, len(vehicle.drive_names)))
    behind, given = np.zeros((*command.shape, len(PLAYS))), np.zeros((*t.shape, 6))
    widths = np.outer(np.where(largest > 0, largest, 1.0), PLAYS)
    for i, source in enumerate(data.logs):
        here = log == i
        track = smooth_states(source, vehicle.dof)
        t[here] = source.t[sample[here]]
        state[here] = np.concatenate([track.position, track.attitude, track.nu], axis=1)[sample[here]]
        commands = source.commanded(vehicle.command_names)
        given[here] = driven(vehicle, source, track).commanded[sample[here]]
        if commands is not None:
            columns = np.asarray(commands)[:, : command.shape[-1]]
            command[here] = columns[sample[here]]
            behind[here] = _played(columns, widths)[sample[here]]
    turns = jax.vmap(jax.vmap(lambda a: rotation(from_euler(a))))(jnp.asarray(state[:, :, 3:6]))
    return PlacedAt(t, first + log, np.asarray(turns), state, command, behind, given)


def places(drives: Sequence[str], logs: Sequence[Log], parts: Sequence[PlacedAt]) -> Places:
    """The places of knots; `drives`: names of the columns, `parts`: of the logs, in their order."""
    t, log, turns, state, command, behind, given = map(np.concatenate, zip(*parts, strict=True))
    signals = {name: state[:, :, i] for i, name in enumerate(STATE_NAMES)}
    signals |= {name: command[:, :, i] for i, name in enumerate(drives)}
    # Time over all logs in order, so that a drift from log to log is a dependence too.
    spans = np.cumsum([0.0, *[source.duration for source in logs]])[:-1]
    began = np.array([source.t[0] for source in logs])
    signals["t"] = t + (began[0] + spans - began)[log][:, None]
    return Places(
        t=t,
        log=log,
        rotation=turns,
        velocity=state[:, :, 6:],
        driven=given,
        signals={name: values for name, values in signals.items() if np.ptp(values) > 1e-6},
        played={name: behind[:, :, i] for i, name in enumerate(drives)},
    )


def largest_commands(vehicle: Vehicle, logs: Sequence[Log]) -> Float[np.ndarray, " columns"]:
    """The largest command of each column, 0 where it has none."""
    columns = len(vehicle.drive_names)
    given = [log.commanded(vehicle.command_names) for log in logs]
    sizes = [np.abs(one[:, :columns]) for one in given if one is not None]
    return np.concatenate([np.zeros((1, columns)), *sizes]).max(axis=0)


def _played(
    commands: Float[np.ndarray, "samples thrusters"], widths: Float[np.ndarray, "thrusters plays"]
) -> Float[np.ndarray, "samples thrusters plays"]:
    """How far a play of each width is behind its command, in shares of the width, from -1/2 to 1/2."""
    out = np.empty((*commands.shape, widths.shape[1]))
    now = np.repeat(commands[0][:, None], widths.shape[1], axis=1)
    for k, command in enumerate(commands):
        now = np.clip(now, command[:, None] - 0.5 * widths, command[:, None] + 0.5 * widths)
        out[k] = (now - command[:, None]) / widths
    return out
