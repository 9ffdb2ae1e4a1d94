"""The plant: Fossen's equations of motion with the catalogue's effects, batched.

    M_RB nu' + C_RB(nu) nu + M_A nu_r' + C_A(nu_r) nu_r
        + D_l nu_r + D_q (|nu_r| nu_r) + g(eta) = tau

with nu_r = nu - nu_c, the current constant in earth axes, so nu_c' = -omega x nu_c in body axes; where it
wanders, its own slow change adds nothing to nu_c'.
Locked degrees of freedom keep zero velocity and acceleration. Attitude is roll, pitch, yaw (ZYX):
keep pitch below 90 degrees.

Arrays hold the batch on the last axis. A state has 13 rows: pose (6), velocity (6), fluid memory [N
or N m].
"""

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import pairwise

import numpy as np

from .vehicle import DOFS, Array, Vehicle, rigid_mass

LEFT, RIGHT = np.triu_indices(6)
DRIFT = [1, 2, 5]  # rows of v, w and r
SENSOR = (
    "velocity_lever_arm",
    "velocity_misalignment",
    "velocity_scale",
    "velocity_in_earth_axes",
    "gyro_bias",
    "compass_deviation",
    "sensor_delay",
)
KINDS = {"position": slice(0, 3), "attitude": slice(3, 6), "velocity": slice(6, 9), "rate": slice(9, 12)}


@dataclass(frozen=True)
class Effect:
    """A named effect of the catalogue, acting from the time `since` [s], or always."""

    effect: str
    target: str | None
    parameters: dict[str, float]
    since: float | None = None

    def vector(self, *keys: str) -> Array:
        """The parameters of these names, zero where absent."""
        return np.array([self.parameters.get(k, 0.0) for k in keys])


@dataclass(frozen=True)
class Outside:
    """An effect outside the catalogue.

    - `dofs`: the degrees of freedom on which it acts; `depends_on`: the log columns it depends on.
    - `wrench`: (t, state, nu_r) to six rows in body axes at o [N, N m], or None.
    - `commands`: (t, commands) to the commands that the thrusters see, or None; time on the first
      axis.
    """

    name: str
    dofs: tuple[str, ...]
    depends_on: tuple[str, ...]
    wrench: Callable[[Array | float, Array, Array], Array] | None = None
    commands: Callable[[Array, Array], Array] | None = None


@dataclass(frozen=True)
class Disturbance:
    """What the surroundings do to the craft, along lines from sample to sample; rows of samples first.

    - `wrench` (rows, 6, B): at o in body axes [N, N m].
    - `force` (rows, 3, B): at o in earth axes [N].
    - `water` (rows, 3, B): velocity of the water beside the steady current, in earth axes [m/s].
    """

    wrench: Array
    force: Array | None = None
    water: Array | None = None

    def at(self, row: float, attitude: Array) -> tuple[Array, Array | None]:
        """Wrench in body axes at an attitude (3, B), and velocity of the water, at a row or behind it.

        Wind and waves do not wait for a sample as commands do.
        """
        k, share = int(row), row % 1.0

        def along(signal: Array) -> Array:
            now, then = (signal[min(one, len(signal) - 1)] for one in (k, k + 1))
            return now + share * (then - now)

        wrench = along(self.wrench)
        if self.force is not None:
            wrench[:3] += (rotation(attitude) * along(self.force)[:, None]).sum(0)
        return wrench, None if self.water is None else along(self.water)


def coriolis(m: Array, nu: Array) -> Array:
    """C(nu) nu of a symmetric mass matrix, after Fossen (2011).

    With (p, h) = M nu it is (omega x p, v x p + omega x h).
    """
    p, h = np.split(m @ nu, 2)
    v, w = np.split(nu, 2)
    return np.concatenate([np.cross(w, p), np.cross(v, p) + np.cross(w, h)])


def coriolis_form(m: Array) -> Array:
    """The 6 x 21 matrix Q with C(nu) nu = Q (nu_i nu_j), i <= j."""
    m, e = 0.5 * (m + m.T), np.eye(6)
    columns = []
    for i, j in zip(LEFT, RIGHT, strict=True):
        square = coriolis(m, e[i])
        mixed = coriolis(m, e[i] + e[j]) - square - coriolis(m, e[j])
        columns.append(square if i == j else mixed)
    return np.array(columns).T


def lift_form(hull: Array, turning: Array) -> Array:
    """Lift on the left-hand side, of (nu_i nu_j), i <= j, and of |u| (v, w, r); 6 x 24.

    - `hull`: Y_uv |u| v, N_uv u v, Z_uw |u| w, M_uw u w; `turning`: Y_ur u r, N_ur |u| r.
    """
    q = np.zeros((6, len(LEFT) + len(DRIFT)))
    uv, uw, ur = (int(np.flatnonzero((LEFT == 0) & (j == RIGHT))[0]) for j in (1, 2, 5))
    by_v, by_w, by_r = (int(k) for k in len(LEFT) + np.arange(len(DRIFT)))
    q[(1, 5, 2, 4), (by_v, uv, by_w, uw)] = hull
    q[(1, 5), (ur, by_r)] = turning
    return q


def rotation(attitude: Array) -> Array:
    """Body to earth axes, ZYX Euler angles, after Fossen (2011); shape (3, 3, ...)."""
    (sf, st, sp), (cf, ct, cp) = np.sin(attitude), np.cos(attitude)
    return np.array(
        [
            [cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf],
            [sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf],
            [-st, ct * sf, ct * cf],
        ]
    )


@dataclass
class Model:
    """A vehicle with a fixed set of effects, in the form that is cheap to evaluate.

    `afloat`: the water may move although no current is among the effects.
    """

    vehicle: Vehicle
    effects: Sequence[Effect] = ()
    outside: Sequence[Outside] = ()
    afloat: bool = False
    lag: Array = field(init=False)
    delay: Array = field(init=False)

    def __post_init__(self) -> None:
        v = self.vehicle
        n = len(v.names)
        rigid, added = v.rigid.copy(), v.added.copy()
        linear, quadratic = v.linear.copy(), v.quadratic.copy()
        hull, turning = np.zeros(4), np.zeros(2)
        weight_moment, buoyancy, cob = v.weight * v.cog, v.buoyancy, v.cob.copy()
        weight, point_buoyancy, point_moment = v.weight, 0.0, np.zeros(3)
        self.gear = deepcopy(v.gear)
        # Columns behind those of fixed thrusters.
        self.lag = np.concatenate([v.lag, v.gear.servos("lag")])
        self.delay = np.concatenate([v.delay, v.gear.servos("delay")])
        self.deadband, self.saturation = v.deadband.copy(), v.saturation.copy()
        self.column = np.arange(n)  # of each thruster, the column that holds its command
        self.gain, self.reverse, self.curve, self.inflow = np.ones(n), np.ones(n), v.curve.copy(), 0.0
        self.current, self.constant = np.zeros(3), np.zeros((6, 1))
        self.waves: Effect | None = None
        self.tether, self.blown = 0.0, np.zeros(3)
        self.memory_row, self.memory_gain, self.memory_rate = 0, 0.0, 0.0

        filed = [
            Effect(
                e["effect"], e.get("target"), {k: x for k, x in e.items() if k not in ("effect", "target")}
            )
            for e in v.raw.get("effect", [])
        ]
        for e in (*filed, *self.effects):
            value = e.parameters.get("value", 0.0)
            row = DOFS.index(e.target) if e.target in DOFS else 0
            match e.effect:
                case "steady_current":
                    self.current = self.current + e.vector("north", "east", "down")
                case "waves":
                    self.waves = e
                case "tether_drag":
                    self.tether += e.parameters["coefficient"]
                case "wind_push":
                    self.blown = self.blown + e.vector("north", "east", "down")
                case "added_mass":
                    added[row, row] += value
                case "coupled_added_mass":
                    one, other = (DOFS.index(dof) for dof in str(e.target).split("+"))
                    added[one, other] += value
                    added[other, one] += value
                case "payload":
                    mass, r = e.parameters["mass"], e.vector("x", "y", "z")
                    lifted = v.density * v.gravity * e.parameters.get("volume", 0.0)
                    rigid += rigid_mass(mass, r, mass * (r @ r * np.eye(3) - np.outer(r, r)))
                    weight += mass * v.gravity
                    weight_moment = weight_moment + mass * v.gravity * r
                    point_buoyancy += lifted
                    point_moment += lifted * r
                case "buoyancy":
                    buoyancy += e.parameters["force"]
                case "trim":
                    cob += e.vector("x", "y", "z")
                case "linear_damping":
                    linear[row, row] += value
                case "quadratic_damping":
                    quadratic[row, row] += value
                case "coupled_damping":
                    to, by = str(e.target).split("<-")
                    linear[DOFS.index(to), DOFS.index(by)] += value
                case "hull_lift":
                    hull += e.vector("Y_uv", "N_uv", "Z_uw", "M_uw")
                case "turning_lift":
                    turning += e.vector("Y_ur", "N_ur")
                case "fluid_memory":
                    self.memory_row = row
                    self.memory_gain = e.parameters["gain"]
                    self.memory_rate = 1.0 / e.parameters["time_constant"]
                case "constant_wrench":
                    self.constant[row] += value
                case "thruster_gain":
                    for p in self.gear.propellers:
                        p.gain *= e.parameters["factor"] if e.target in (p.name, "all") else 1.0
                    self.gain[[e.target in (name, "all") for name in v.names]] *= e.parameters["factor"]
                case "surface_gain" | "surface_offset" | "surface_stuck":
                    for one in self.gear.surfaces:
                        if e.target not in (one.name, "all"):
                            continue
                        one.gain *= e.parameters.get("factor", 1.0)
                        if e.effect == "surface_offset":
                            one.offset += e.parameters["angle"]
                        elif e.effect == "surface_stuck":
                            one.stuck = e.parameters["angle"]
                case "wake":
                    for p in self.gear.propellers:
                        p.wake += e.parameters["fraction"] if p.name == e.target else 0.0
                case "cross_flow_drag":
                    self.gear.add_strip_drag(e.parameters["coefficient"])
                case "wind":
                    self.gear.add_wind(e.parameters)
                case "voltage":
                    self.gear.exponent += e.parameters["exponent"]
                case "reverse_thrust":
                    self.reverse[[e.target in (name, "all") for name in v.names]] *= e.parameters["factor"]
                case "exchanged_thrusters":
                    i, j = (v.names.index(name) for name in str(e.target).split("+"))
                    self.column[[i, j]] = self.column[[j, i]]
                case "thrust_curve":
                    self.curve += e.parameters["quadratic"]
                case "thruster_lag":
                    self.lag[: n + len(self.gear.propellers)] += e.parameters["time_constant"]
                case "input_delay":
                    self.delay += e.parameters["delay"]
                case "deadband":
                    self.deadband += e.parameters["width"]
                case "saturation":
                    self.saturation = np.minimum(self.saturation, e.parameters["limit"])
                case "inflow_loss":
                    self.inflow += e.parameters["per_speed"]
                case name if name in SENSOR:
                    pass
                case name:
                    raise ValueError(f"Effect `{name}` is not in the catalogue.")

        free = np.ix_(v.free, v.free)
        self.inverse = np.zeros((6, 6))
        self.inverse[free] = np.linalg.inv((rigid + added)[free])
        self.added = added
        self.flows = self.afloat or bool(self.current.any())
        self.rigid_form = -coriolis_form(rigid) if self.flows else None
        carried = added if self.flows else rigid + added
        products = lift_form(hull, turning)
        products[:, : len(LEFT)] += coriolis_form(carried)
        self.water_form = -np.hstack([linear, quadratic, products])
        self.hydrostatic = np.zeros((6, 3))
        self.hydrostatic[:3] = (weight - buoyancy - point_buoyancy) * np.eye(3)
        arm = weight_moment - buoyancy * cob - point_moment
        self.hydrostatic[3:] = np.cross(arm, np.eye(3)).T
        self.allocation = v.pushes / v.max_thrust
        self.rate = np.concatenate([np.full(n, np.inf), self.gear.servos("rate", np.inf)])

    def drive(self, commands: Array) -> Array:
        """Steady thrust [N] of commands (..., columns, B): deadband, saturation, curve, gain.

        Behind that of fixed thrusters the state that each column of the gear asks for.
        """
        most = self.gear.limits()[:, None]
        gear = np.clip(commands[..., len(self.column) :, :], -most, most)
        commands = commands[..., self.column, :]
        dead, limit, curve = self.deadband[:, None], self.saturation[:, None], self.curve[:, None]
        c = np.sign(commands) * np.maximum(np.abs(commands) - dead, 0.0)
        c = np.clip(c, -limit, limit)
        c = (1.0 - curve) * c + curve * c * np.abs(c)
        ahead, astern = self.vehicle.max_thrust, self.vehicle.max_thrust_reverse * self.reverse
        thrust = np.where(commands < 0.0, astern[:, None], ahead[:, None]) * self.gain[:, None] * c
        return np.concatenate([thrust, gear], axis=-2)

    def intervals(self, dt: float, step: float) -> list[tuple[float, float, Array]]:
        """Steps within a sample, none across a command change.

        Each: offset [s], length [s] and, per thruster, the row of the command relative to the
        sample's.
        """
        ends = sorted({0.0, dt, *(round(float(d) % dt, 9) % dt for d in self.delay)})
        out = []
        for a, b in pairwise(ends):
            pieces = math.ceil((b - a) / step - 1e-6)
            h = (b - a) / pieces
            shift = np.floor((0.5 * (a + b) - self.delay) / dt).astype(int)
            out += [(a + k * h, h, shift) for k in range(pieces)]
        return out

    def steps(self, dt: float, step: float) -> list[tuple[float, float, Array, Array, Array]]:
        """`intervals`, each with the `decay` over its half and over the whole."""
        return [(o, h, i, self.decay(0.5 * h), self.decay(h)) for o, h, i in self.intervals(dt, step)]

    def fastest(self, velocity: Array) -> float:
        """Rate at which damping brakes the fastest mode at velocities (6, B) [1/s]."""
        linear, quadratic = -self.water_form[:, :6], -self.water_form[:, 6:12]
        speed = np.abs(velocity).max(axis=1)
        if not np.isfinite(speed).all():
            return 0.0
        return float(np.abs(np.linalg.eigvals(self.inverse @ (linear + 2.0 * quadratic * speed))).max())

    def decay(self, h: float) -> Array:
        """Share of a thrust deviation left after h [s], (columns, 1); none without lag."""
        lag = np.where(self.lag > 0.0, self.lag, 1.0)
        return np.where(self.lag > 0.0, np.exp(-h / lag), 0.0)[:, None]

    def derivative(
        self,
        t: Array | float,
        s: Array,
        thrust: Array,
        extra: Array | float,
        water: Array | None = None,
    ) -> Array:
        """d/dt of the 13 state rows at t [s] under the thrusts [N], the gear's states and a further wrench.

        `water`: its velocity beside the steady current (3, B), of an `afloat` model [m/s].
        """
        r = rotation(s[3:6])
        nu, (p, q, yaw) = s[6:12], s[9:12]
        through = nu
        force = self.hydrostatic @ r[2] + self.constant + extra
        if self.rigid_form is not None:
            current = np.tensordot(self.current, r, axes=1)
            if water is not None:
                current = current + (r * water[:, None]).sum(0)
            through = nu.copy()
            through[:3] -= current
            turning = np.array(
                [
                    yaw * current[1] - q * current[2],
                    p * current[2] - yaw * current[0],
                    q * current[0] - p * current[1],
                ]
            )
            force = force + self.rigid_form @ (nu[LEFT] * nu[RIGHT]) + self.added[:, :3] @ turning
        size = np.abs(through)
        products = through[LEFT] * through[RIGHT]
        water = np.concatenate([through, size * through, products, size[0] * through[DRIFT]])
        state, thrust = thrust[len(self.column) :], thrust[: len(self.column)]
        if len(state):
            thrust = self.gear.supplied(thrust, state)
            force = force + self.gear.wrench(state, thrust, nu, through, r)
        if self.inflow:
            thrust = thrust * (1.0 - self.inflow * np.abs(self.vehicle.direction @ through[:3]))
        force = force + self.allocation @ thrust + self.water_form @ water
        if self.tether:
            v = through[:3]
            force[:3] -= self.tether * np.sqrt((v * v).sum(0)) * v
        if self.blown.any():
            force[:3] += np.tensordot(self.blown, r, axes=1)
        if self.waves is not None:
            w = self.waves.parameters
            swell = np.sin(2.0 * np.pi * t / w["period"] + w["phase"])
            force[:3] += (w["north"] * r[0] + w["east"] * r[1]) * swell
        for o in self.outside:
            if o.wrench is not None:
                force = force + o.wrench(t, s, through)

        ds = np.zeros_like(s)
        if self.memory_rate:
            force[self.memory_row] -= s[12]
            ds[12] = self.memory_rate * (self.memory_gain * through[self.memory_row] - s[12])
        ds[:3] = (r * nu[:3]).sum(1)
        sf, cf, ct, tt = np.sin(s[3]), np.cos(s[3]), np.cos(s[4]), np.tan(s[4])
        side = q * sf + yaw * cf
        ds[3] = p + side * tt
        ds[4] = q * cf - yaw * sf
        ds[5] = side / ct
        ds[6:12] = self.inverse @ force
        return ds


@dataclass(frozen=True)
class Run:
    """A simulated batch at its samples: `states` (K, 13, B), `accelerations` (K, 6, B)."""

    states: Array
    accelerations: Array

    def signals(self) -> Array:
        """Pose, velocity and acceleration of the samples, (K, 18, B)."""
        return np.concatenate([self.states[:, :12], self.accelerations], axis=1)


def simulate(
    schedule: Sequence[tuple[int, Model]],
    commands: Array,
    start: Array,
    samples: int,
    *,
    t0: Array | float = 0.0,
    lead: int = 0,
    thrust: Array | float = 0.0,
    disturbance: Disturbance | None = None,
    steer: Callable[[int, Array], Array] | None = None,
    dt: float = 0.1,
    step: float = 0.025,
) -> Run:
    """Classical Runge-Kutta from `start` (13, B) over `samples` rows of held commands.

    In steps of at most `step` [s], halved until one is no longer than the fastest damping takes.

    - `schedule`: models and the sample from which each acts, the first from 0.
    - `commands` (rows, thrusters, B): row `lead` is the command of the first sample; the rows
      before it serve the delay, and the first row held for ever before.
    - `thrust`: thrust of lagging thrusters at the start [N].
    - `disturbance`: of as many rows as `commands`.
    - `steer`: gives the commands (thrusters, B) of a sample from its number and state (13, B), in place of
      that row of `commands`, for a controller in the loop.

    The acceleration of a sample is that of its instant with the command of that sample already
    acting.
    """
    n = commands.shape[1]
    each = np.arange(n)
    commands = commands if steer is None else commands.copy()
    s = start.copy()
    states = np.empty((samples, *s.shape))
    accelerations = np.empty((samples, 6, s.shape[1]))
    thrust = np.broadcast_to(np.asarray(thrust, float), commands.shape[1:]) + 0.0
    ends = [k for k, _ in schedule[1:]] + [samples]

    def slope(model: Model, k: int, within: float, s: Array, force: Array) -> Array:
        """d/dt of the state at a time within the hold of a sample."""
        pushed = (0.0, None) if disturbance is None else disturbance.at(lead + k + within / dt, s[3:6])
        return model.derivative(t0 + k * dt + within, s, force, *pushed)

    for (first, model), last in zip(schedule, ends, strict=True):
        drive = model.drive(commands)
        steps_of = cache(partial(model.steps, dt))
        alive = model.decay(0.0)
        lagging = bool(alive.any())
        limited = np.isfinite(model.rate)[:, None]
        for k in range(first, last):
            if steer is not None:
                commands[lead + k] = steer(k, s)
                drive[lead + k] = model.drive(commands[lead + k])
            # A step of 2.8 times what the fastest damping takes settles on motions that no damping allows.
            halvings = max(0, math.ceil(np.log2(max(model.fastest(s[6:12]) * step, 1e-9))))
            for number, (offset, h, shift, half, whole) in enumerate(steps_of(step / 2**halvings)):
                target = drive[np.maximum(lead + k + shift, 0), each]
                f0 = fm = f1 = target
                if lagging:
                    away = thrust - target
                    f0, fm, f1 = target + alive * away, target + half * away, target + whole * away
                if limited.any():
                    # By the limited rate first, by the lag where that is slower.
                    most = model.rate[:, None]
                    steer_by = np.clip(target - thrust, -most * h, most * h)
                    f0 = np.where(limited, thrust, f0)
                    fm = np.where(
                        limited, thrust + np.clip(target - thrust, -0.5 * most * h, 0.5 * most * h), fm
                    )
                    f1 = np.where(limited, thrust + steer_by, f1)
                a = slope(model, k, offset, s, f0)
                if number == 0:
                    states[k] = s
                    accelerations[k] = a[6:12]
                b = slope(model, k, offset + 0.5 * h, s + 0.5 * h * a, fm)
                c = slope(model, k, offset + 0.5 * h, s + 0.5 * h * b, fm)
                d = slope(model, k, offset + h, s + h * c, f1)
                s = s + h / 6.0 * (a + 2.0 * (b + c) + d)
                thrust = f1
    return Run(states, accelerations)


def thrust_states(model: Model, commands: Array) -> Array:
    """Thrust [N] at every sample (10 Hz) just before its command acts, (K, thrusters, B); from none."""
    drive = model.drive(commands)
    each = np.arange(commands.shape[1])
    now = np.zeros(commands.shape[1:])
    out = np.empty_like(drive)
    steps = [(h, shift, model.decay(h)) for _, h, shift in model.intervals(0.1, 0.1)]
    for k in range(len(commands)):
        out[k] = now
        for length, shift, left in steps:
            target = drive[np.maximum(k + shift, 0), each]
            most = model.rate[:, None] * length
            now = np.clip(target + left * (now - target), now - most, now + most)
    return out


def earlier(t: Array, signals: Array, delay: float) -> Array:
    """Signals (K, n, B) so long before, along lines; before the first sample the first line goes on."""
    k = np.clip(np.searchsorted(t, t - delay + 1e-9) - 1, 0, len(t) - 2)
    share = ((t - delay - t[k]) / (t[k + 1] - t[k]))[:, None, None]
    return (1.0 - share) * signals[k] + share * signals[k + 1]


def observed(effects: Sequence[Effect], t: Array, signals: Array) -> Array:
    """What sensors without noise log of the true signals (K, 18, B) at the times t (K,)."""
    out = signals.copy()
    pose, v, w = out[:, :6], out[:, 6:9], out[:, 9:12]
    for name in SENSOR:
        for e in (x for x in effects if x.effect == name):
            on = t >= (-np.inf if e.since is None else e.since)
            if name == "velocity_lever_arm":
                v[on] += np.cross(w[on], e.vector("x", "y", "z")[None, :, None], axis=1)
            elif name == "velocity_misalignment":
                turn = rotation(np.array([0.0, 0.0, e.parameters["yaw"]]))
                v[on] = np.einsum("ij,kjb->kib", turn, v[on])
            elif name == "velocity_scale":
                v[on] *= e.parameters["factor"]
            elif name == "velocity_in_earth_axes":
                f = e.parameters["fraction"]
                earth = np.einsum("ijkb,kjb->kib", rotation(pose[on, 3:6].swapaxes(0, 1)), v[on])
                v[on] = (1.0 - f) * v[on] + f * earth
            elif name == "compass_deviation":
                constant, cos, sin = e.vector("constant", "cos", "sin")
                psi = pose[on, 5]
                pose[on, 5] = psi + constant + cos * np.cos(psi) + sin * np.sin(psi)
            elif name == "sensor_delay":
                kind = KINDS[str(e.target)]
                out[on, kind] = earlier(t, out[:, kind], e.parameters["delay"])[on]
            else:
                w[on] += e.vector("p", "q", "r")[:, None]
    return out
