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
import optimistix as optx
from jaxtyping import Array, Float

from .._errors import InputError
from .._types import CHANNELS, SENSORS
from ..effects import AddedMass, LinearDamping, QuadraticDamping
from ..fitting import start_precision, wrapped
from ..logs import Log
from ..physics import compose, small_turn, step_lengths, to_euler
from ..simulation import hold, initial_state, inputs, substeps
from ..vehicle import Placed, Plant, State, Vehicle
from ._model import base_coefficients
from ._saturated import SaturatedPlant, saturate

DT = 0.1  # [s] between samples of the manoeuvre
HOLD = 2.0  # [s] between corners of a command
WINDOW = 4.0  # [s], as in a diagnosis: each window has an initial state of its own
# Random manoeuvres that are moved into the box and improved, and steps for either.
RANDOM, STEPS = 4, 60
# Share of the box that a manoeuvre is to keep to, and the price of leaving it.
INSIDE, WALL = 0.8, 1e3
# Precision of a rival's parameters: a trace, for what the manoeuvre does not determine.
TRACE = 1e-8

Progress = Callable[[str], None]


def _silent(text: str) -> None:
    del text


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
      numbers that are refitted to them, for each cause; `precision` of those numbers.
    - `weight`: 1 / standard deviation of each channel, 0 where it is not measured.
    """

    plant_of: SaturatedPlant
    theta: tuple[Float[Array, " parameters"], ...]
    columns: tuple[Float[Array, "parameters z"], ...]
    precision: tuple[Float[Array, " z"], ...]
    weight: Float[Array, "18"]
    t: Float[Array, " times"]
    start: State
    split: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    box: Box = eqx.field(static=True)

    def plant(self, which: int, z: Array) -> Plant:
        """The vehicle with a cause, its parameters and the file's coefficients moved by z."""
        return self.plant_of(self.theta[which] + self.columns[which] @ z, 0)

    def _roll(self, plant: Plant, start: State, tracks) -> tuple[State, Array]:
        """States and channels at each step of a stretch."""

        def step(state, now):
            over, at, dt = now
            shown = plant.readings(state, plant.acceleration(state, at))
            return hold(plant, state, over, dt, self.split, backward=True), (state, shown)

        return jax.lax.scan(step, start, tracks)[1]

    def _tracks(self, plant: Plant, commands: Array):
        wrench = jnp.zeros((len(self.t), 6))
        return *inputs(plant, self.t, commands, wrench), step_lengths(self.t)

    def flown(self, which: int, commands: Array) -> tuple[State, Array]:
        """States and channels of the vehicle with a cause, over the whole manoeuvre."""
        plant = self.plant(which, jnp.zeros(self.columns[which].shape[1]))
        return self._roll(plant, self.start, self._tracks(plant, commands))

    def seen(self, which: int, commands: Array, starts: State, z, moved) -> Array:
        """Channels of every window, each from its own state, all moved by 12 numbers."""
        plant = self.plant(which, z)
        count = len(self.t) // self.window

        def cut(a):
            return a[: count * self.window].reshape(count, self.window, *a.shape[1:])

        def one(start, tracks):
            state = State(
                start.position + moved[:3],
                compose(start.attitude, small_turn(moved[3:6])),
                start.velocity + moved[6:],
                start.memory,
            )
            return self._roll(plant, state, tracks)[1]

        return jax.vmap(one)(starts, jax.tree.map(cut, self._tracks(plant, commands)))

    def separation(self, true: int, rival: int, commands: Array, states: State) -> Array:
        """Chi-square that the rival leaves of the true cause's log when all else is refitted (one step)."""
        starts = jax.tree.map(lambda a: a[: len(self.t) - self.window + 1 : self.window], states)
        own = self.seen(true, commands, starts, jnp.zeros(self.columns[true].shape[1]), jnp.zeros(12))
        n = self.columns[rival].shape[1]

        def missed(x):
            off = wrapped(self.seen(rival, commands, starts, x[:n], x[n:]) - own)
            return (self.weight * off).reshape(len(own), -1)

        nothing = jnp.zeros(n + 12)
        off, slopes = missed(nothing), jax.jacfwd(missed)(nothing)
        h = jnp.einsum("wnp,wnq->wpq", slopes, slopes)
        g = jnp.einsum("wnp,wn->wp", slopes, off)
        # Each window's initial state is free; then the rival and, within their error, the coefficients.
        h_xx = h[:, n:, n:] + jnp.diag(jnp.asarray(start_precision(self.plant_of.vehicle.free)))
        solved = jnp.linalg.solve(h_xx, jnp.concatenate([h[:, n:, :n], g[:, n:, None]], axis=2))
        g_z = (g[:, :n] - jnp.einsum("wzx,wx->wz", h[:, :n, n:], solved[..., -1])).sum(0)
        h_z = (h[:, :n, :n] - jnp.einsum("wzx,wxy->wzy", h[:, :n, n:], solved[..., :-1])).sum(0)
        left = (off**2).sum() - (g[:, n:] * solved[..., -1]).sum()
        return left - g_z @ jnp.linalg.solve(h_z + jnp.diag(self.precision[rival]), g_z)

    def sizes(self, states: State) -> Float[Array, "limits times"]:
        """Squared distances from the middle of the box, in halves of its size: depth, tilts, speed, radius."""
        low, high = self.box.depth
        depth = (states.position[:, 2] - 0.5 * (low + high)) / (0.5 * (high - low))
        angles = jax.vmap(to_euler)(states.attitude)
        away = (states.position - self.start.position)[:, :2]
        return jnp.stack(
            [
                depth**2 * self.plant_of.vehicle.free[2],
                *(angles[:, :2].T / self.box.tilt) ** 2,
                (states.velocity[:, :3] ** 2).sum(1) / self.box.speed**2,
                (away**2).sum(1) / self.box.radius**2,
            ]
        )

    def outside(self, states: State) -> Array:
        """How far the states lie outside the inner box, squared and averaged over time."""
        return (jnp.maximum(self.sizes(states) - INSIDE**2, 0.0) ** 2).mean(1).sum()


def _commands(corners: Float[Array, "corners columns"], t: Array) -> Array:
    """Commands along straight lines between corners, within -1 and 1."""
    x = jnp.linspace(0.0, 1.0, len(corners))
    return jax.vmap(lambda c: jnp.interp(t / t[-1], x, jnp.tanh(c)), in_axes=1, out_axes=1)(corners)


def _least(causes: _Causes, commands: Array, flown: Sequence[State]) -> Array:
    """Softly the least separation of any two causes, either of which may be the true one."""
    pairs = itertools.permutations(range(len(flown)), 2)
    apart = jnp.stack([causes.separation(i, j, commands, flown[i]) for i, j in pairs])
    return 1.0 / (1.0 / jnp.maximum(apart, 1e-9)).sum()


def _cost(corners: Array, causes: _Causes, aimed: bool) -> Array:
    """The price of leaving the box, and if `aimed` the gain of telling the causes apart."""
    commands = _commands(corners, causes.t)
    flown = [causes.flown(i, commands)[0] for i in range(len(causes.theta))]
    cost = WALL * jnp.stack([causes.outside(states) for states in flown]).sum()
    return cost - jnp.log(_least(causes, commands, flown) + 1.0) if aimed else cost


@eqx.filter_jit
def _improved(causes: _Causes, corners: Array, aimed: bool) -> Array:
    """Corners that cost less."""
    return optx.minimise(
        lambda corners, causes: _cost(corners, causes, aimed),
        optx.BFGS(rtol=1e-4, atol=1e-4),
        corners,
        causes,
        max_steps=STEPS,
        throw=False,
    ).value


@eqx.filter_jit
def _judged(causes: _Causes, corners: Array) -> tuple[Array, Array]:
    """The separation, and the largest squared size of any state in that of the box."""
    commands = _commands(corners, causes.t)
    flown = [causes.flown(i, commands)[0] for i in range(len(causes.theta))]
    return _least(causes, commands, flown), jnp.max(jnp.stack([causes.sizes(s) for s in flown]))


def plan(
    vehicle: Vehicle,
    causes: Sequence[Placed],
    duration: float = 60.0,
    box: Box | None = None,
    seed: int = 0,
    progress: Progress = _silent,
) -> Manoeuvre:
    """The commands over `duration` [s] that tell causes apart best, by the sensors that the file states.

    - `causes`: two or more, with the values at which they explain what was seen.
    - `box`: states to keep to, whichever cause is true; default `Box()`.
    - `seed`: of the random manoeuvres that it begins from.

    Raises `InputError` where there is nothing to command or to see, or no room. Source: optimal experiment
    design for telling models apart (Atkinson and Fedorov 1975, T-optimality), here with the rival, the
    file's coefficients and the windows' initial states refitted.
    """
    problem = _causes(vehicle, causes, duration, Box() if box is None else box)
    shape = (max(2, round(duration / HOLD) + 1), len(vehicle.command_names))
    rng = np.random.default_rng(seed)
    inside, better = [], []
    for number in range(RANDOM):
        progress(f"manoeuvre {number + 1} of {RANDOM}: into the box")
        drawn = _improved(problem, jnp.asarray(rng.normal(size=shape)), aimed=False)
        inside.append((drawn, *map(float, _judged(problem, drawn))))
        progress(f"manoeuvre {number + 1} of {RANDOM}: telling the causes apart")
        best = _improved(problem, drawn, aimed=True)
        better.append((best, *map(float, _judged(problem, best))))
    kept = [found for found in (*better, *inside) if np.isfinite(found[1]) and found[2] <= 1.0]
    if not kept:
        raise InputError(
            f"{vehicle.name}: no manoeuvre of {duration:g} s was found that stays in the box with each of the "
            "causes; widen the box or plan for a shorter time."
        )
    corners, apart, _ = max(kept, key=lambda found: found[1])
    random = [found for found in inside if np.isfinite(found[1]) and found[2] <= 1.0]
    return Manoeuvre(
        _log(problem, corners, "plan"),
        0.5 * apart,
        tuple(_log(problem, found[0], "random") for found in random),
        tuple(0.5 * found[1] for found in random),
    )


def _log(causes: _Causes, corners: Array, name: str) -> Log:
    """The commands, and what the vehicle with the first cause shows."""
    commands = _commands(corners, causes.t)
    channels = np.asarray(causes.flown(0, commands)[1])
    vehicle = causes.plant_of.vehicle
    shown = np.where(np.asarray(causes.weight) > 0, channels, np.nan)
    return Log(np.asarray(causes.t), shown, np.asarray(commands), None, vehicle.command_names, name)


def _causes(vehicle: Vehicle, causes: Sequence[Placed], duration: float, box: Box) -> _Causes:
    if len(causes) < 2:
        raise InputError("A plan needs two causes to tell apart; name another one.")
    if not vehicle.command_names:
        raise InputError(f"{vehicle.name}: has no thrusters to plan commands for.")
    if duration < 2 * WINDOW:
        raise InputError(
            f"A manoeuvre of {duration:g} s is too short for a diagnosis; give {2 * WINDOW:g} s or more."
        )
    weight = np.zeros(len(CHANNELS))
    for kind, std in vehicle.sensors:
        weight[np.isin(CHANNELS, SENSORS[kind])] = 1.0 / std
    weight *= np.tile(vehicle.free, 3)
    if not weight.any():
        raise InputError(
            f"{vehicle.name}: states no noise under [sensors]; say what is measured, and how well."
        )
    own = (AddedMass, LinearDamping, QuadraticDamping)
    families, layout = saturate(vehicle, tuple(dict.fromkeys((*own, *(type(c.effect) for c in causes)))))
    base = base_coefficients(vehicle, layout)
    labels = [(suspect.effect, suspect.target) for suspect in layout.suspects]
    theta, columns, precision = [], [], []
    for cause in causes:
        i = labels.index((type(cause.effect), cause.target))
        flat = np.concatenate([np.ravel(value) for value in cause.effect.parameters().values()])
        value = flat[[slots[0] for slots in layout.suspects[i].slots.values()]]
        theta.append(layout.neutral + layout.columns[i] @ (value - layout.neutral_of(i)))
        others = [c for c in base if c.label != layout.suspects[i].label]
        bent = np.zeros((layout.size, len(others)))
        bent[[c.index for c in others], range(len(others))] = 1.0
        columns.append(np.concatenate([layout.columns[i], bent], axis=1))
        precision.append([TRACE] * len(value) + [c.prior**-2 for c in others])
    middle = 0.5 * sum(box.depth) if "heave" in vehicle.dof else 0.0
    crafts = [vehicle.place(cause) for cause in causes]
    return _Causes(
        SaturatedPlant(vehicle, families, jnp.ones((1, len(vehicle.placed)))),
        tuple(map(jnp.asarray, theta)),
        tuple(map(jnp.asarray, columns)),
        tuple(map(jnp.asarray, precision)),
        jnp.asarray(weight),
        jnp.asarray(np.arange(round(duration / DT)) * DT),
        initial_state(vehicle.place(*causes), (0.0, 0.0, middle)),
        max(substeps(craft, DT, box.speed) for craft in crafts),
        round(WINDOW / DT),
        box,
    )
