"""The windows of a diagnosis cut up for the filter, and the disturbance that it begins with."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..effects import SensorDelay
from ..fitting import USUAL_MEMORY, USUAL_SIZE, Cut, Disturbance, Path, Problem, Room, split
from ..vehicle import Vehicle
from ._plausible import full_thrust

# Along a path that begins anew so often [s] what a disturbance does to a craft meanwhile is small beside the
# noise. Measured on a craft that holds its station with nothing hidden: after 4 s a false cause was worth
# thousands of nats, after 1 s its quadratic drag was worth 79, after 0.5 s the best one 6.
STRAIGHT = 0.5
# Samples that a path is followed for at least: what pushes behind a part's last one shows nowhere in it. With
# four, gusts of a memory of 4 s in a log at 1 Hz made a fluid memory of 53 nats that is none in an hour.
FEWEST = 2
# From one log to the next: many times any memory [s].
_LONG = 1e6
# Acceleration [m/s², rad/s²] that stands for the full thrust of a craft that has none.
PUSH = 0.3


def parts_of(steps: int, dt: float) -> int:
    """Into how many parts a window of so many samples, `dt` [s] apart, is cut."""
    fits = [n for n in range(1, steps // FEWEST + 1) if steps % n == 0]
    return min(fits, key=lambda n: abs(np.log(steps * dt / n / STRAIGHT)), default=1)


def strength(vehicle: Vehicle) -> Float[np.ndarray, "6"]:
    """The full thrust [N, N m] of each axis, or of the strongest of its kind where an axis has none."""
    own = full_thrust(vehicle)
    most = np.repeat([own[:3].max(), own[3:].max()], 3)
    inertia = PUSH * np.diag(np.asarray(vehicle.mass_matrix))
    return np.where(own > 0, own, np.where(most > 0, most, inertia))


@dataclasses.dataclass(frozen=True)
class Fine:
    """Windows cut up, and what joins them.

    - `problem`: has them in the place of the whole ones; `parts`: of each of those; `group`: of each, that of
      its whole window.
    - `begin`: the disturbance that is assumed first; `unit`: the full thrust of its axes.
    """

    problem: Problem
    parts: int
    group: Int[np.ndarray, " windows"]
    count: int
    begin: Disturbance
    unit: Float[np.ndarray, " axes"]

    @classmethod
    def of(
        cls, problem: Problem, vehicle: Vehicle, data: Cut, room: Room, group: np.ndarray, others: int
    ) -> "Fine":
        """Of the whole windows' problem; `group`: of each whole window, `others` what is in none."""
        dt = float(np.median([log.dt for log in data.logs]))
        parts = parts_of(data.windows.step.shape[1], dt)
        windows = split(data, parts)
        log, step = np.asarray(windows.log), np.asarray(windows.step)
        count, most = windows.count, room.windows * parts
        hold = np.asarray(data.records.hold)
        gap, joined = np.full(most, _LONG), np.zeros(most, bool)
        for w in range(1, count):
            if log[w] == log[w - 1]:
                t, last = data.logs[log[w]].t, step[w - 1, -1]
                gap[w] = t[step[w, 0]] - (t[last] + hold[log[w], last])
                joined[w] = w % parts > 0
        records, windows = dataclasses.replace(room, windows=most).filled(data.records, windows)
        axes = np.flatnonzero(vehicle.free)
        unit = strength(vehicle)[axes]
        groups = np.full(most, others)
        groups[:count] = np.repeat(group[: data.windows.count], parts)
        begin = Disturbance(
            size=jnp.asarray(USUAL_SIZE.median * unit),
            time=jnp.full(len(axes), USUAL_MEMORY.median),
            frequency=jnp.zeros(len(axes)),
            gap=jnp.asarray(gap),
            joined=jnp.asarray(joined),
            axes=tuple(axes.tolist()),
        )
        whole = dataclasses.replace(problem, records=records, windows=windows, trail=SensorDelay.longest(dt))
        return cls(whole, parts, groups, count, begin, unit)

    @property
    def path(self) -> Path:
        """As measured, where nothing disturbs."""
        count = len(self.group)
        return Path.measured(count, self.begin.axes)
