"""The manoeuvre that would tell causes apart which a log could not.

Were one cause true, another could still be fitted to its log. What chi-square is then left, beyond the
noise, is their separation; half of it is the evidence by which the log would decide. It is a differentiable
function of the commands, and is maximised over them within a box of safe states.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from .._errors import InputError
from .._precision import need_double
from .._progress import Progress, silent
from .._types import AXES
from ..effects import AbstractEffect
from ..fitting import start_precision, wrapped
from ..logs import Log
from ..physics import late, step_lengths, to_euler
from ..simulation import hold, initial_state, inputs, substeps
from ..vehicle import Placed, Plant, State, Vehicle
from ._filed import FILED, base_coefficients
from ._prepare import WINDOW, window_length
from ._saturated import SaturatedPlant, saturate

DT = 0.1  # [s] between samples of the manoeuvre
HOLD = 2.0  # [s] between corners of a command
# Random manoeuvres that are moved into the box, of which the best is improved, and steps for either.
RANDOM, STAY, IMPROVE = 4, 200, 60
# Standard deviation of the corners of a random manoeuvre's commands.
FIRST = 0.3
# Share of the box that a manoeuvre is to keep to, and the price of leaving it.
INSIDE, WALL = 0.8, 1e3
RUNAWAY = 1e6  # cost of commands along which the vehicle cannot be simulated
# Precision of a rival's parameters: a trace, for what the manoeuvre does not determine.
TRACE = 1e-8


@dataclasses.dataclass(frozen=True)
class Box:
    """States that are safe: depths [m], largest roll and pitch [rad], speed [m/s], distance [m].

    The distance is horizontal, from where the manoeuvre begins: at rest, level, in the middle of the depths.
    Raises `InputError` for an empty box.
    """

    depth: tuple[float, float] = (0.5, 5.0)
    tilt: float = 0.6
    speed: float = 1.5
    radius: float = 15.0

    def __post_init__(self):
        if not (self.depth[0] < self.depth[1] and min(self.tilt, self.speed, self.radius) > 0):
            raise InputError("The box of safe states is empty: give a depth range and positive limits.")


@dataclasses.dataclass(frozen=True)
class Manoeuvre:
    """What to command, and how surely it would tell the causes apart.

    - `log`: the commands, with what the vehicle with the first cause would show, without noise.
    - `evidence` [nats]: by which the log of it would prefer the true cause to the rival that comes closest,
      if that is refitted together with the file's coefficients.
    - `random`: manoeuvres of the same length in the same box that were drawn without this aim, and
      `random_evidence` [nats] of each.
    """

    log: Log
    evidence: float
    random: tuple[Log, ...]
    random_evidence: tuple[float, ...]


class _Causes(eqx.Module):
    """Everything that the separation of causes is computed from.

    - `theta`: parameters of the saturated plant with each cause at its given values; `columns`: from the
      numbers that are refitted to them, `precision` of those numbers; filled up with numbers that do nothing.
    - `weight`: 1 / standard deviation of each channel, 0 where it is not measured.
    - `middle`, `half`: of the range of each command column, in its own unit.
    """

    plant_of: SaturatedPlant
    theta: Float[Array, "causes parameters"]
    columns: Float[Array, "causes parameters z"]
    precision: Float[Array, "causes z"]
    weight: Float[Array, " channels"]
    middle: Float[Array, " columns"]
    half: Float[Array, " columns"]
    t: Float[Array, " times"]
    start: State
    split: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    box: Box = eqx.field(static=True)

    def commands(self, corners: Float[Array, "corners columns"]) -> Float[Array, "times columns"]:
        """Commands along straight lines between corners, of any size, each within its column's range.

        What can be commanded begins at zero: what it did before the log began would be another unknown.
        """
        x = jnp.linspace(0.0, 1.0, len(corners) + 1)
        heights = self.middle[None] + self.half[None] * jnp.tanh(corners)
        begin = jnp.where(self.half > 0.0, 0.0, self.middle)
        heights = jnp.concatenate([begin[None], heights])
        share = self.t / self.t[-1]
        return jax.vmap(lambda y: jnp.interp(share, x, y), in_axes=1, out_axes=1)(heights)

    def _roll(self, plant: Plant, start: State, tracks) -> tuple[State, Array]:
        """States and channels at each step of a stretch."""

        def step(state, now):
            over, at, dt = now
            shown = plant.readings(state, plant.acceleration(state, at), len(self.weight))
            return hold(plant, state, over, dt, self.split), (state, shown)

        states, shown = jax.lax.scan(step, start, tracks)[1]
        if plant.delay is not None:
            t = tracks[1].t
            shown = late(t, shown, jnp.broadcast_to(plant.delay, (len(t), len(plant.delay))))
        return states, shown

    def _tracks(self, plant: Plant, commands: Array):
        wrench = jnp.zeros((len(self.t), 6))
        return *inputs(plant, self.t, commands, wrench), step_lengths(self.t)

    def flown(self, commands: Array) -> tuple[State, Array]:
        """States and channels of the vehicle with each cause, over the whole manoeuvre."""

        def one(theta):
            plant = self.plant_of(theta, 0)
            return self._roll(plant, self.start, self._tracks(plant, commands))

        return jax.vmap(one)(self.theta)

    def _cut(self, a: Array) -> Array:
        """Windows of what is there for each sample."""
        count = len(self.t) // self.window
        return a[: count * self.window].reshape(count, self.window, *a.shape[1:])

    def _windows(
        self, theta: Array, commands: Array, starts: State, moved: Float[Array, "windows 12"]
    ) -> Array:
        """Channels of every window, each from its own state moved by 12 numbers."""
        plant = self.plant_of(theta, 0)

        def one(start, tracks, moved):
            return self._roll(plant, start.moved(moved), tracks)[1]

        return jax.vmap(one)(starts, jax.tree.map(self._cut, self._tracks(plant, commands)), moved)

    def separations(self, commands: Array, states: State, channels: Array) -> Float[Array, " pairs"]:
        """Chi-square that each rival leaves of each cause's log when all else is refitted (one step).

        Where the refit is best, what is left does not depend on it to first order. So the refit is not
        differentiated, and of all its slopes only the one along it is.
        """
        pairs = np.array(list(itertools.permutations(range(len(self.theta)), 2)))
        n = self.columns.shape[-1]
        prior = jnp.diag(jnp.asarray(start_precision(self.plant_of.vehicle.free)))

        def one(flown, theta, columns, precision):
            states, channels = flown
            now = commands, jax.tree.map(lambda a: self._cut(a)[:, 0], states), self._cut(channels)

            def missed(z, x, commands, starts, own):
                seen = self._windows(theta + columns @ z, commands, starts, x)
                return (self.weight[None, None] * wrapped(seen - own)).reshape(len(own), -1)

            def alike(both):
                moved = jnp.broadcast_to(both[n:], (len(now[2]), 12))
                off = missed(both[:n], moved, *jax.lax.stop_gradient(now))
                return off, off

            slopes, off = jax.jacfwd(alike, has_aux=True)(jnp.zeros(n + 12))
            h = jnp.einsum("wnp,wnq->wpq", slopes, slopes)
            g = jnp.einsum("wnp,wn->wp", slopes, off)
            # Each window's initial state is free; then the rival and, within their error, the coefficients.
            right = jnp.concatenate([h[:, n:, :n], g[:, n:, None]], axis=2)
            solved = jnp.linalg.solve(h[:, n:, n:] + prior[None], right)
            g_z = (g[:, :n] - jnp.einsum("wzx,wx->wz", h[:, :n, n:], solved[..., -1])).sum(0)
            h_z = (h[:, :n, :n] - jnp.einsum("wzx,wxy->wzy", h[:, :n, n:], solved[..., :-1])).sum(0)
            z = -jnp.linalg.solve(h_z + jnp.diag(precision), g_z)
            x = -solved[..., -1] - solved[..., :-1] @ z
            refit = z, x = jax.lax.stop_gradient((z, x))
            off, change = jax.jvp(lambda z, x: missed(z, x, *now), jax.tree.map(jnp.zeros_like, refit), refit)
            return ((off + change) ** 2).sum() + precision @ z**2 + jnp.einsum("wp,pq,wq->", x, prior, x)

        true, rival = pairs[:, 0], pairs[:, 1]
        return jax.vmap(one)(
            jax.tree.map(lambda a: a[true], (states, channels)),
            self.theta[rival],
            self.columns[rival],
            self.precision[rival],
        )

    def sizes(self, states: State) -> Float[Array, "causes times limits"]:
        """Squared distances from the middle of the box, in halves of its size.

        Of depth, roll, pitch, speed and radius.
        """
        low, high = self.box.depth
        depth = (states.position[..., 2] - 0.5 * (low + high)) / (0.5 * (high - low))
        angles = jax.vmap(jax.vmap(to_euler))(states.attitude)
        away = states.position[..., :2] - self.start.position[None, None, :2]
        return jnp.stack(
            [
                depth**2 * self.plant_of.vehicle.free[2],
                (angles[..., 0] / self.box.tilt) ** 2,
                (angles[..., 1] / self.box.tilt) ** 2,
                (states.velocity[..., :3] ** 2).sum(-1) / self.box.speed**2,
                (away**2).sum(-1) / self.box.radius**2,
            ],
            axis=-1,
        )


def _leaving(sizes: Array) -> Array:
    """The price of leaving the inner box: squared, averaged over time."""
    return WALL * (jnp.maximum(sizes - INSIDE**2, 0.0) ** 2).mean(axis=1).sum()


def _staying(corners: Array, causes: _Causes) -> tuple[Array, None]:
    return _leaving(causes.sizes(causes.flown(causes.commands(corners))[0])), None


def _telling(corners: Array, causes: _Causes) -> tuple[Array, tuple[Array, Array]]:
    """Less for a larger separation, of the pair that is hardest to tell, and for staying in the box.

    Beside it the least separation, and the largest of all sizes in that of the box, squared.
    """
    commands = causes.commands(corners)
    states, channels = causes.flown(commands)
    apart, sizes = causes.separations(commands, states, channels), causes.sizes(states)
    softly_least = 1.0 / (1.0 / jnp.maximum(apart, 1e-9)).sum()
    return _leaving(sizes) - jnp.log(softly_least + 1.0), (apart.min(), sizes.max())


@eqx.filter_jit
def _with_slope(cost: Callable, corners: Array, causes: _Causes):
    return jax.value_and_grad(cost, has_aux=True)(corners, causes)


def _improved(cost: Callable, steps: int, causes: _Causes, corners: Array) -> Array:
    """Corners that cost less.

    The minimiser calls one compiled program; one that is compiled itself would contain it several times.
    """

    def at(flat):
        (value, _), slope = _with_slope(cost, jnp.asarray(flat).reshape(corners.shape), causes)
        usable = np.isfinite(value) and np.isfinite(slope).all()
        return (float(value), np.ravel(slope)) if usable else (RUNAWAY, np.zeros(corners.size))

    found = minimize(at, np.ravel(corners), jac=True, method="L-BFGS-B", options={"maxiter": steps})
    return jnp.asarray(found.x).reshape(corners.shape)


@dataclasses.dataclass(frozen=True)
class _Flown:
    """A manoeuvre, by how much it tells the causes apart, and whether all of them stay in the box."""

    corners: Array
    apart: float
    safe: bool

    @classmethod
    def of(cls, causes: _Causes, corners: Array) -> "_Flown":
        apart, size = map(float, _with_slope(_telling, corners, causes)[0][1])
        return cls(corners, apart, np.isfinite(apart) and size <= 1.0)


def plan(
    vehicle: Vehicle,
    causes: Sequence[Placed],
    duration: float = 60.0,
    box: Box | None = None,
    seed: int = 0,
    progress: Progress = silent,
    families: Sequence[type[AbstractEffect]] = (),
) -> Manoeuvre:
    """The commands over `duration` [s] that tell causes apart best, by the sensors that the file states.

    - `causes`: two or more, with the values at which they explain what was seen.
    - `box`: states to keep to, whichever cause is true; default `Box()`.
    - `seed`: of the random manoeuvres that it begins from.
    - `families`: kinds of effects that its programs are to hold beside those of the causes. Plans for other
      causes among the same kinds need not compile anew then, but each step takes longer.

    Raises `InputError` where there is nothing to command or to see, or no room. Source: optimal experiment
    design for telling models apart (Atkinson and Fedorov 1975, T-optimality), here with the rival, the
    file's coefficients and the windows' initial states refitted.
    """
    need_double("A plan")
    problem = _causes(vehicle, causes, duration, Box() if box is None else box, families)
    shape = (round(duration / HOLD), len(vehicle.command_names))
    rng = np.random.default_rng(seed)
    random = []
    for number in range(RANDOM):
        progress(f"moving random manoeuvre {number + 1} of {RANDOM} into the box")
        drawn = _improved(_staying, STAY, problem, jnp.asarray(FIRST * rng.normal(size=shape)))
        random.append(_Flown.of(problem, drawn))
    progress("improving the best of them")
    best = max(random, key=lambda one: (one.safe, one.apart))
    better = _Flown.of(problem, _improved(_telling, IMPROVE, problem, best.corners))
    random = [one for one in random if one.safe]
    kept = [better, *random] if better.safe else random
    if not kept:
        raise InputError(
            f"{vehicle.name}: no manoeuvre of {duration:g} s was found that stays in the box with each "
            "cause; widen the box or plan for a shorter time."
        )
    chosen = max(kept, key=lambda one: one.apart)
    return Manoeuvre(
        _log(problem, chosen.corners, "plan"),
        0.5 * chosen.apart,
        tuple(_log(problem, one.corners, "random") for one in random),
        tuple(0.5 * one.apart for one in random),
    )


def _log(causes: _Causes, corners: Array, name: str) -> Log:
    """The commands, and what the vehicle with the first cause shows."""
    commands = causes.commands(corners)
    channels = np.asarray(causes.flown(commands)[1])[0]
    vehicle = causes.plant_of.vehicle
    shown = np.where(np.asarray(causes.weight) > 0, channels, np.nan)
    return Log(np.asarray(causes.t), shown, np.asarray(commands), None, vehicle.command_names, name)


def _causes(
    vehicle: Vehicle,
    causes: Sequence[Placed],
    duration: float,
    box: Box,
    families: Sequence[type[AbstractEffect]] = (),
) -> _Causes:
    if len(causes) < 2:
        raise InputError("A plan needs two causes to tell apart; name another one.")
    if not vehicle.command_names:
        raise InputError(f"{vehicle.name}: has no thrusters or other actuators to plan commands for.")
    if duration < 2 * WINDOW:
        raise InputError(
            f"A manoeuvre of {duration:g} s is too short for a diagnosis; give {2 * WINDOW:g} s or more."
        )
    noise = vehicle.stated_noise
    weight = np.nan_to_num(1.0 / noise) * vehicle.free[np.array(AXES[: len(noise)])]
    if not weight.any():
        raise InputError(
            f"{vehicle.name}: states no noise under [sensors]; say what is measured, and how well."
        )
    kinds = dict.fromkeys((*FILED, *families, *(type(c.effect) for c in causes)))
    held, layout = saturate(vehicle, tuple(kinds))
    base = base_coefficients(vehicle, layout)
    theta, columns, precision = [], [], []
    for cause in causes:
        i = layout.place_of(cause)
        value = layout.suspects[i].values(cause.effect)
        theta.append(layout.neutral + layout.columns[i] @ (value - layout.neutral_of(i)))
        others = [c for c in base if c.label != layout.suspects[i].label]
        bent = np.zeros((layout.size, len(others)))
        bent[[c.index for c in others], range(len(others))] = 1.0
        columns.append(np.concatenate([layout.columns[i], bent], axis=1))
        precision.append(np.array([TRACE] * len(value) + [c.prior**-2 for c in others]))
    # As wide for any cause of these kinds.
    width = len(base) + max(column.shape[1] for column in layout.columns)
    columns = [np.pad(c, ((0, 0), (0, int(width - c.shape[1])))) for c in columns]
    precision = [np.pad(p, (0, width - len(p)), constant_values=1.0) for p in precision]
    depth = 0.5 * sum(box.depth) if "heave" in vehicle.dof else 0.0
    middle, half = _ranges(vehicle)
    crafts = [vehicle.place(cause) for cause in causes]
    plant_of = SaturatedPlant(vehicle, held, jnp.ones((1, len(vehicle.placed))))
    start = initial_state(vehicle, (0.0, 0.0, depth))
    memory = jnp.zeros(6 * len(plant_of(jnp.asarray(layout.neutral), 0).memories))
    return _Causes(
        plant_of,
        jnp.asarray(np.array(theta)),
        jnp.asarray(np.array(columns)),
        jnp.asarray(np.array(precision)),
        jnp.asarray(weight),
        jnp.asarray(middle),
        jnp.asarray(half),
        jnp.asarray(np.arange(round(duration / DT)) * DT),
        dataclasses.replace(start, memory=memory),
        max(substeps(craft, DT, box.speed) for craft in crafts),
        # As a diagnosis of such a log: each window has an initial state of its own.
        round(window_length(duration, DT) / DT),
        box,
    )


def _ranges(vehicle: Vehicle) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each command column, and how far a plan goes from it, in the column's unit.

    Thrusters over all their commands, other actuators and masses inside as their `usual` ones. What is
    logged but nobody commands, wind and battery, stays in its middle.
    """
    count = len(vehicle.thruster_names)
    low, high = -np.ones(count), np.ones(count)
    for one in (*vehicle.actuators, *vehicle.masses):
        ends = one.usual if one.commanded else np.repeat(one.usual.mean(axis=1, keepdims=True), 2, axis=1)
        low, high = np.append(low, ends[:, 0]), np.append(high, ends[:, 1])
    return 0.5 * (low + high), 0.5 * (high - low)
