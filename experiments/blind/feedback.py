"""Controllers as people's craft have them: they see the samples of the log, noise and all, and nothing else.

- "pilot": heading, speed and depth held at set-points that change in steps.
- "station": a place and a heading are held; the place is moved in steps.
- "tracking": speeds, heading and depth follow smooth references, whose accelerations are fed forward.

All are PID controllers of the axes that thrusters command, gains by pole placement after Fossen (2011),
sec. 12.2, from the vehicle's own inertia and full thrust; the pseudo-inverse of the thrust matrix allocates.
"""

from collections.abc import Callable

import numpy as np

from .excitation import axes
from .vehicle import DOFS, Array, Vehicle

DT = 0.1  # s
STEERINGS = ("pilot", "station", "tracking")
DAMPING = 0.8  # relative, of the closed loop
SLOWEST = 0.3  # rad/s
# Attitudes that right themselves are held more stiffly: a hull that moves up and ahead pitches by itself.
FASTEST = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 1.0])  # rad/s
# Error for which a controller of the bandwidth in between asks for full thrust [m, rad].
LARGE = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
FARTHEST = np.array([2.0, 2.0, 2.0, 0.12, 0.12, 2.0])  # largest step of a set-point [m, rad]
LIMIT = 0.6  # share of full thrust that one axis may ask for: the others need the thrusters too
CRUISE = 0.5  # share of full thrust of the largest speed
ASTERN = -0.3  # share of the largest speed ahead
HOLD = (4.0, 15.0)  # s, shortest and longest hold of a set-point
STRAY = 1.0  # m, from where a craft that cannot move sideways turns to the place that it keeps
TURN_ROUND = 2.0  # rad, bearing of that place from which it takes its other end
PIVOT = 0.5  # rad, by which its end may be off while it goes there
LOST = 1.0  # rad, error of heading from where it is not steered


def wrapped(angle: Array | float) -> Array | float:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def steps(samples: int, rng: np.random.Generator, goal: Callable[[float], float]) -> Array:
    """Set-points held at random; each is what `goal` makes of the one before, the first of 0."""
    out, now, k = np.empty(samples), 0.0, 0
    while k < samples:
        last = k + int(rng.uniform(*HOLD) / DT)
        now = goal(now)
        out[k:last], k = now, last
    return out


def smooth(goals: Array, bandwidth: float) -> Array:
    """Goals (K,) behind a critically damped filter of second order: value and its two rates, (K, 3)."""
    out, x, rate = np.empty((len(goals), 3)), 0.0, 0.0
    for k, goal in enumerate(goals):
        bend = bandwidth**2 * (goal - x) - 2.0 * bandwidth * rate
        out[k] = x, rate, bend
        rate += DT * bend
        x += DT * rate
    return out


def steady_speed(linear: float, quadratic: float, force: float) -> float:
    """Speed at which the drag linear u + quadratic u^2 is a force."""
    return 2.0 * force / (linear + np.sqrt(linear**2 + 4.0 * quadratic * force))


class Controller:
    """One way of steering on one vehicle, with its set-points.

    - `level`: factor on all set-points.
    - `strayed`: samples so far at which the heading was off by more than `LOST`.

    It keeps what it has integrated: one controller steers one log.
    """

    def __init__(
        self, vehicle: Vehicle, steering: str, samples: int, rng: np.random.Generator, level: float = 1.0
    ) -> None:
        allocation, self.full = vehicle.allocation, np.zeros(6)
        for dof, pattern in axes(vehicle):
            i = DOFS.index(dof)
            self.full[i] = (allocation @ pattern)[i]
        self.steered = self.full > 0.0
        self.allocate = np.linalg.pinv(allocation[self.steered])
        self.inertia = np.diag(vehicle.rigid + vehicle.added)
        most = self.full / self.inertia
        self.bandwidth = np.clip(np.sqrt(most / LARGE), SLOWEST, FASTEST)
        # Speeds are steered by their integral: there is no place that they are off.
        self.by_speed = np.isin(np.arange(6), [0, 1] if steering != "station" else []) & self.steered
        self.keeps_place = steering == "station"
        self.goals = np.zeros((samples, 6))  # of speed, or of place and attitude, by axis
        self.rates = np.zeros((samples, 6))
        self.bends = np.zeros((samples, 6))
        self.integral, self.off, self.strayed = np.zeros(6), np.zeros(6), 0
        self.heading: float | None = None
        self.homing, self.astern = 0.0, False
        for i in np.flatnonzero(self.steered | (self.keeps_place & (np.arange(6) < 2))):
            largest = level * self.reach(vehicle, int(i), most)
            low = ASTERN if self.by_speed[i] and i == 0 else -1.0
            turning = i == 5

            def goal(now: float, largest: float = largest, low: float = low, go_on: bool = turning) -> float:
                return now * go_on + float(rng.uniform(low, 1.0)) * largest

            self.goals[:, i] = steps(samples, rng, goal)
            if steering == "tracking":
                value, rate, bend = smooth(self.goals[:, i], self.bandwidth[i]).T
                self.goals[:, i] = value
                self.rates[:, i], self.bends[:, i] = (value, rate) if self.by_speed[i] else (rate, bend)
            elif self.by_speed[i]:
                self.rates[:, i] = self.goals[:, i]

    def reach(self, vehicle: Vehicle, i: int, most: Array) -> float:
        """Largest set-point of an axis: a speed, or a step that asks for no more than twice full thrust."""
        if self.by_speed[i]:
            return steady_speed(vehicle.linear[i, i], vehicle.quadratic[i, i], CRUISE * self.full[i])
        if i in (3, 4):  # a craft that rights itself is tilted by a moment as long as the step lasts
            righting = vehicle.weight * vehicle.cog[2] - vehicle.buoyancy * vehicle.cob[2]
            return float(min(FARTHEST[i], 0.5 * LIMIT * self.full[i] / max(righting, 1e-9)))
        if i < 2:  # a place is moved in earth axes: as far as the weaker of the two axes follows
            i = min(np.flatnonzero(self.steered[:2]), key=lambda j: most[j])
        return float(min(FARTHEST[i], 2.0 * most[i] / self.bandwidth[i] ** 2))

    def __call__(self, k: int, seen: Array) -> Array:
        """Commands (thrusters,) from the logged sample `k`: pose and velocity, 12 numbers."""
        pose, velocity = seen[:6], seen[6:12]
        if self.heading is None:
            self.heading = self.homing = pose[5]  # headings count from that of the start
        error = self.goals[k] - pose
        error[5] += self.heading
        if self.keeps_place:
            self.home(self.goals[k, :2] - pose[:2], pose[5], error)
        error[3:] = wrapped(error[3:])
        self.strayed += bool(self.steered[5] and abs(error[5]) > LOST)
        slow = self.rates[k] - velocity
        stiffness = self.inertia * self.bandwidth**2
        room = np.divide(0.5 * self.full, stiffness)  # an integral asks for half of full thrust at most
        self.off = np.clip(self.off + DT * slow, -room, room)
        error = np.where(self.by_speed, self.off, error)
        wrench = self.inertia * (self.bends[k] + 2.0 * DAMPING * self.bandwidth * slow)
        wrench += stiffness * error + self.integral
        grown = self.integral + DT * 0.1 * self.bandwidth * stiffness * error
        self.integral = np.where(self.by_speed, 0.0, np.clip(grown, -0.5 * self.full, 0.5 * self.full))
        wrench = np.clip(wrench, -LIMIT * self.full, LIMIT * self.full)
        return np.clip(self.allocate @ wrench[self.steered], -1.0, 1.0).round(6)

    def home(self, away: Array, heading: float, error: Array) -> None:
        """Errors of place and heading towards a place `away` in earth axes, from a heading.

        A craft that cannot move sideways turns its bow to a place that it has strayed from, or its stern where
        that is much nearer, before it goes there, and stays so when it is there.
        """
        cos, sin = np.cos(heading), np.sin(heading)
        error[:2] = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0]
        if self.steered[1]:
            return
        if np.hypot(*away) > STRAY:
            bearing = heading + np.arctan2(error[1], error[0])
            off = wrapped(bearing + np.pi * self.astern - heading)
            self.astern ^= bool(abs(off) > TURN_ROUND)
            self.homing = bearing + np.pi * self.astern
        error[5] = wrapped(self.homing - heading)
        if abs(error[5]) > PIVOT:
            error[0] = 0.0
