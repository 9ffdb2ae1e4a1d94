"""Controllers as people's craft have them: they see the samples of the log, noise and all, and nothing else.

- "pilot": speeds, heading, depth and tilt are held at set-points that change in steps.
- "station": a place, heading, depth and tilt are held, and moved in steps.
- "tracking": what the pilot holds follows smooth references, whose rates and accelerations are fed forward.

All are PID controllers of the axes that thrusters command, gains by pole placement after Fossen (2011),
from the vehicle's own inertia and full thrust; the pseudo-inverse of the thrust matrix allocates.
"""

from collections.abc import Callable

import numpy as np

from .excitation import axes
from .vehicle import DOFS, Array, Vehicle

DT = 0.1  # s
STEERINGS = ("pilot", "station", "tracking")
DAMPING = 0.8  # relative, of the closed loop
SLOWEST = 0.3  # rad/s
SLOWEST_OF_SHIPS = 0.1  # rad/s, of what surfaces steer
# Attitudes that right themselves are held more stiffly: a hull that moves up and ahead pitches by itself.
FASTEST = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 1.0])  # rad/s
# Error for which a controller of the bandwidth in between asks for full thrust [m, rad].
LARGE = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
FARTHEST = np.array([2.0, 2.0, 2.0, 0.12, 0.12, 2.0])  # largest step of a set-point [m, rad]
LIMIT = 0.6  # share of full thrust that one axis may ask for: the others need the thrusters too
INTEGRAL = 0.5  # share of full thrust that the integral of an error may ask for
SLOW_SHARE = 0.1  # of the bandwidth, of that integral
CRUISE = 0.5  # share of full thrust of the largest speed
ASTERN = -0.3  # share of the largest speed ahead
FAST, UNDER_WAY = (
    1.3,
    0.5,
)  # of craft with surfaces: largest speed over the trimmed one, least over the largest
HOLD = (4.0, 15.0)  # s, shortest and longest hold of a set-point
STRAY = 1.0  # m, from where a craft that cannot move sideways turns to the place that it keeps
TURN_ROUND = 2.0  # rad, bearing of that place from which it takes its other end
PIVOT = 0.5  # rad, by which its end may be off while it goes there
DIVE, STEEPEST = 5.0, 0.25  # s, in which an error of depth is made up for by pitch; the most of that [rad]
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


def authority(vehicle: Vehicle) -> Array:
    """Wrench of full thrust on each axis that thrusters can command alone, six rows [N, N m]; else zero."""
    full = np.zeros(6)
    for dof, pattern in axes(vehicle):
        i = DOFS.index(dof)
        full[i] = (vehicle.allocation @ pattern)[i]
    return full


class Controller:
    """One way of steering on one vehicle, with its set-points.

    - `level`: factor on all set-points; `dt` [s]: from one command to the next.
    - `strayed`: samples so far at which the heading was off by more than `LOST`.

    It keeps what it has integrated: one controller steers one log.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        steering: str,
        samples: int,
        rng: np.random.Generator,
        level: float = 1.0,
        dt: float = DT,
    ) -> None:
        self.vehicle, self.full, self.dt = vehicle, authority(vehicle), dt
        self.steered = self.full > 0.0
        self.allocate = np.linalg.pinv(vehicle.allocation[self.steered])
        self.inertia = np.diag(vehicle.rigid + vehicle.added)
        self.most = self.full / self.inertia  # accelerations of full thrust
        slowest = SLOWEST_OF_SHIPS if vehicle.gear.surfaces else SLOWEST
        self.bandwidth = np.clip(np.sqrt(self.most / LARGE), slowest, FASTEST)
        self.keeps_place = steering == "station"
        horizontal = np.arange(6) < 2
        self.by_speed = self.steered & horizontal & (not self.keeps_place)
        # Of place and attitude, or of speed; their rates; the rates of those.
        self.goals, self.rates, self.bends = np.zeros((3, samples, 6))
        self.integral, self.strayed = np.zeros(6), 0
        self.heading, self.homing, self.astern = 0.0, 0.0, False
        for i in np.flatnonzero(self.steered | (horizontal & self.keeps_place)).tolist():
            goals = self.set_points(i, level, samples, rng)
            if steering == "tracking":
                x, rate, bend = smooth(goals, self.bandwidth[i]).T
            else:
                x, rate, bend = goals, np.zeros(samples), np.zeros(samples)
            if self.by_speed[i]:
                self.rates[:, i], self.bends[:, i] = x, rate
            else:
                self.goals[:, i], self.rates[:, i], self.bends[:, i] = x, rate, bend
        # A craft whose planes cannot lift it, but turn its bow.
        self.by_pitch = bool(self.steered[4] and not self.steered[2] and vehicle.gear.surfaces)
        if self.by_pitch:
            self.goals[:, 4] = self.rates[:, 4] = self.bends[:, 4] = 0.0
            self.depths = steps(samples, rng, lambda _: level * float(rng.uniform(-1.0, 1.0)))

    def set_points(self, i: int, level: float, samples: int, rng: np.random.Generator) -> Array:
        """Set-points of an axis: speeds, headings that go on from one another, places, depths or tilts."""
        largest, lowest = level * self.reach(i), ASTERN if i == 0 and self.by_speed[i] else -1.0
        if self.by_speed[i] and self.vehicle.gear.surfaces:
            lowest = UNDER_WAY
        goes_on = 1.0 if i == 5 else 0.0
        return steps(samples, rng, lambda now: goes_on * now + largest * float(rng.uniform(lowest, 1.0)))

    def reach(self, i: int) -> float:
        """Largest set-point of an axis: a speed, or a step that asks for no more than twice full thrust."""
        v = self.vehicle
        if self.by_speed[i] and v.gear.surfaces:
            return FAST * v.cruise
        if self.by_speed[i]:
            return steady_speed(v.linear[i, i], v.quadratic[i, i], CRUISE * self.full[i])
        if i in (3, 4):  # a craft that rights itself is tilted by a moment as long as the step lasts
            righting = v.weight * v.cog[2] - v.buoyancy * v.cob[2]
            return float(min(FARTHEST[i], 0.5 * LIMIT * self.full[i] / max(righting, 1e-9)))
        if i < 2:  # a place is moved in earth axes: as far as the weaker of the two axes follows
            i = min((j for j in (0, 1) if self.steered[j]), key=lambda j: self.most[j])
        return float(min(FARTHEST[i], 2.0 * self.most[i] / self.bandwidth[i] ** 2))

    def __call__(self, k: int, seen: Array) -> Array:
        """Commands (thrusters,) from the logged sample `k`: pose and velocity, 12 numbers."""
        pose, velocity = seen[:6], seen[6:12]
        if k == 0:  # headings count from that of the start
            self.heading = self.homing = pose[5]
        error = self.goals[k] - pose
        error[5] += self.heading
        if self.keeps_place:
            self.home(self.goals[k, :2] - pose[:2], pose[5], error)
        if self.by_pitch:  # depth is held by the bow's way up or down
            deeper = self.depths[k] - pose[2]
            error[4] += float(np.clip(-deeper / self.vehicle.cruise / DIVE, -STEEPEST, STEEPEST))
        error[3:] = wrapped(error[3:])
        self.strayed += bool(self.steered[5] and abs(error[5]) > LOST)
        slow = self.rates[k] - velocity
        stiffness = self.inertia * self.bandwidth**2
        # The error of a speed is that of a place when integrated; a place has an integral of its own beside.
        lasting = np.where(self.by_speed, slow, SLOW_SHARE * self.bandwidth * error)
        most = INTEGRAL * self.full
        self.integral = np.clip(self.integral + self.dt * stiffness * lasting, -most, most)
        wrench = self.inertia * (self.bends[k] + 2.0 * DAMPING * self.bandwidth * slow) + self.integral
        wrench += np.where(self.by_speed, 0.0, stiffness * error)
        wrench = np.clip(wrench, -LIMIT * self.full, LIMIT * self.full)
        return np.clip(self.allocate @ wrench[self.steered], -1.0, 1.0).round(6)

    def home(self, away: Array, heading: float, error: Array) -> None:
        """Errors of place and heading towards a place `away` in earth axes, from a heading.

        A craft that cannot move sideways turns its bow to a place that it has strayed from, or its stern
        where that is much nearer, before it goes there, and stays so when it is there.
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
