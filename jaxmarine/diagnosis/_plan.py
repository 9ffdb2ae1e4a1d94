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
from .._types import CHANNELS, DOFS, SENSORS
from ..effects import Suspect, place
from ..fitting import start_precision
from ..logs import Log
from ..physics import compose, small_turn, step_lengths, to_euler_matrix
from ..physics import rotation as rotation_of
from ..simulation import hold, initial_state, inputs, substeps
from ..vehicle import Damping, Placed, State, Vehicle
from ..vehicle_io import suspect_named

DT = 0.1  # [s] between samples of the manoeuvre
HOLD = 3.0  # [s] between corners of a command
WINDOW = 4.0  # [s], as in a diagnosis: each window has an initial state of its own
# Relative error of the file's own coefficients, which could hide a difference, as in a diagnosis.
FILE_ERROR = 0.1
# Random manoeuvres of which the best is improved, and steps that improve it.
RANDOM, STEPS = 12, 40
# Share of the box that the plan itself keeps to, and shrinking of commands that leave it nevertheless.
INSIDE, SHRINK = 0.9, 0.9
_WALL = 1e3


@dataclasses.dataclass(frozen=True)
class Box:
    """States that are safe: `depth` range [m], largest roll and pitch [rad], speed [m/s], distance [m].

    The distance is horizontal, from where the manoeuvre begins: at rest, level, in the middle of the depths.
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

    - `log`: the commands, with what a vehicle with the first cause would show, without noise.
    - `evidence` [nats]: by which the log would prefer the true cause to the rival that comes closest, if
      that is refitted with the file's coefficients; `random`: the same for the median random manoeuvre
      of that length in the same box.
    """

    log: Log
    evidence: float
    random: float


class _Rivals(eqx.Module):
    """Everything that the separation of causes is computed from."""

    vehicle: Vehicle
    suspects: tuple[Suspect, ...] = eqx.field(static=True)
    values: tuple[Float[Array, " parameters"], ...]
    sizes: tuple[Float[Array, " parameters"], ...]
    weight: Float[Array, "18"]
    t: Float[Array, " times"]
    start: State
    split: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    box: Box = eqx.field(static=True)

    def with_cause(self, which: int, z: Array, base: Array) -> Vehicle:
        """The vehicle with one cause, z sizes from its given values, and its own coefficients changed."""
        suspect = self.suspects[which]
        values = self.values[which] + self.sizes[which] * z
        effects = [place(suspect, self.vehicle, dict(zip(suspect.slots, values, strict=True)))]
        # All causes are there, so that all vehicles have the same states.
        effects += [s.effect.neutral(self.vehicle) for i, s in enumerate(self.suspects) if i != which]
        mass = jnp.diag(jnp.diag(self.vehicle.mass_matrix)) * FILE_ERROR
        linear, quadratic = (
            jnp.diag(jnp.diag(d)) for d in (self.vehicle.damping.linear, self.vehicle.damping.quadratic)
        )
        added, slow, fast = base.reshape(3, 6)
        return dataclasses.replace(
            self.vehicle,
            added_mass=self.vehicle.added_mass + mass @ jnp.diag(added),
            damping=Damping(
                self.vehicle.damping.linear + FILE_ERROR * linear @ jnp.diag(slow),
                self.vehicle.damping.quadratic + FILE_ERROR * quadratic @ jnp.diag(fast),
            ),
        ).place(*[Placed(effect) for effect in effects])

    def flown(self, which: int, commands: Array) -> tuple[State, Array]:
        """States and channels of the vehicle with a cause, over the whole manoeuvre."""
        plant = self.with_cause(which, jnp.zeros(len(self.values[which])), jnp.zeros(18)).plant()
        over, at = inputs(plant, self.t, commands, jnp.zeros((len(self.t), 6)))

        def step(state, now):
            over, at, dt = now
            shown = plant.readings(state, plant.acceleration(state, at))
            return hold(plant, state, over, dt, self.split), (state, shown)

        return jax.lax.scan(step, self.start, (over, at, step_lengths(self.t)))[1]

    def windows(self, which: int, commands: Array, starts: State, z, base, moved) -> Array:
        """Channels of every window [windows, steps, 18] from its own initial state, moved by 12 numbers."""
        plant = self.with_cause(which, z, base).plant()
        over, at = inputs(plant, self.t, commands, jnp.zeros((len(self.t), 6)))
        cut = lambda a: a[: len(a) // self.window * self.window].reshape(-1, self.window, *a.shape[1:])  # noqa: E731
        tracks = jax.tree.map(cut, (over, at, step_lengths(self.t)))

        def one(start, track):
            state = State(
                start.position + moved[:3],
                compose(start.attitude, small_turn(moved[3:6])),
                start.velocity + moved[6:],
                start.memory,
            )

            def step(state, now):
                over, at, dt = now
                shown = plant.readings(state, plant.acceleration(state, at))
                return hold(plant, state, over, dt, self.split), shown

            return jax.lax.scan(step, state, track)[1]

        return jax.vmap(one)(starts, tracks)

    def separation(self, true: int, rival: int, commands: Array, states: State) -> Array:
        """Chi-square that the rival leaves of the true cause's log when everything else is refitted."""
        starts = jax.tree.map(lambda a: a[: len(self.t) // self.window * self.window : self.window], states)
        count = len(self.values[rival])
        nothing = jnp.zeros(count + 18 + 12)

        def shown(x):
            parts = x[:count], x[count : count + 18], x[count + 18 :]
            return self.weight * self.windows(rival, commands, starts, *parts)

        own = self.windows(
            true, commands, starts, jnp.zeros(len(self.values[true])), jnp.zeros(18), jnp.zeros(12)
        )
        off = (shown(nothing) - self.weight * own).reshape(len(starts.position), -1)
        slopes = jax.jacfwd(shown)(nothing).reshape(*off.shape, -1)
        h = jnp.einsum("wnp,wnq->wpq", slopes, slopes)
        g = jnp.einsum("wnp,wn->wp", slopes, off)
        n = count + 18
        prior = jnp.asarray(start_precision(self.vehicle.free))
        # Each window's initial state is free; then the rival and, within their error, the coefficients.
        h_xx = h[:, n:, n:] + jnp.diag(prior)
        solved = jnp.linalg.solve(h_xx, jnp.concatenate([h[:, n:, :n], g[:, n:, None]], axis=2))
        g_z = (g[:, :n] - jnp.einsum("wzx,wx->wz", h[:, :n, n:], solved[..., -1])).sum(0)
        h_z = (h[:, :n, :n] - jnp.einsum("wzx,wxy->wzy", h[:, :n, n:], solved[..., :-1])).sum(0)
        h_z = h_z + jnp.diag(jnp.concatenate([jnp.full(count, 1e-2), jnp.ones(18)]))
        left = (off**2).sum() - (g[:, n:] * solved[..., -1]).sum()
        return left - g_z @ jnp.linalg.solve(h_z, g_z)

    def outside(self, states: State) -> Array:
        """How far the states lie outside the box, squared, in sizes of the box and summed over time."""
        low, high = self.box.depth
        depth = (states.position[:, 2] - 0.5 * (low + high)) / (0.5 * (high - low))
        depth = depth * self.vehicle.free[2]
        angles = jax.vmap(lambda q: to_euler_matrix(rotation_of(q)))(states.attitude)
        squares = jnp.stack(
            [
                depth**2,
                *(angles[:, :2].T / self.box.tilt) ** 2,
                (states.velocity[:, :3] ** 2).sum(1) / self.box.speed**2,
                ((states.position - self.start.position)[:, :2] ** 2).sum(1) / self.box.radius**2,
            ]
        )
        return (jnp.maximum(squares - INSIDE**2, 0.0) ** 2).mean(1).sum()


def _commands(corners: Float[Array, "corners thrusters"], t: Array) -> Array:
    """Commands along straight lines between corners, within -1 and 1."""
    x = jnp.linspace(0.0, 1.0, len(corners))
    return jax.vmap(lambda c: jnp.interp(t / t[-1], x, jnp.tanh(c)), in_axes=1, out_axes=1)(corners)


@eqx.filter_jit
def _judged(rivals: _Rivals, corners: Array) -> tuple[Array, Array]:
    """Least separation of any two causes, softly, and how far outside the box any of them goes."""
    commands = _commands(corners, rivals.t)
    count = len(rivals.suspects)
    flown = [rivals.flown(i, commands)[0] for i in range(count)]
    apart = [rivals.separation(i, j, commands, flown[i]) for i, j in itertools.permutations(range(count), 2)]
    outside = jnp.stack([rivals.outside(states) for states in flown]).sum()
    return 1.0 / (1.0 / jnp.maximum(jnp.stack(apart), 1e-9)).sum(), outside


@eqx.filter_jit
def _improved(rivals: _Rivals, corners: Array) -> Array:
    def cost(corners, rivals):
        apart, outside = _judged(rivals, corners)
        return _WALL * outside - jnp.log(apart + 1.0)

    return optx.minimise(
        cost, optx.BFGS(rtol=1e-3, atol=1e-3), corners, rivals, max_steps=STEPS, throw=False
    ).value


def _shrunk(rivals: _Rivals, corners: np.ndarray) -> np.ndarray:
    """Corners made smaller until every vehicle stays in the box."""
    for _ in range(60):
        apart, outside = _judged(rivals, jnp.asarray(corners))
        if np.isfinite(apart) and float(outside) <= 0.0:
            return corners
        corners = SHRINK * corners
    raise InputError("No manoeuvre stays in the box: even the weakest commands leave it; widen the box.")


def plan(
    vehicle: Vehicle,
    causes: Sequence[Placed],
    duration: float = 60.0,
    box: Box | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
) -> Manoeuvre:
    """The commands over `duration` [s] that tell the causes apart best, by the sensors that the file states.

    - `causes`: two or more, with the values at which they explain what was seen.
    - `box`: states to keep to, with any of the causes.

    Raises `InputError` where there is nothing to command or to see, or no room. Source: optimal experiment
    design for model discrimination (Atkinson and Fedorov 1975; T-optimality), here with the rival, the
    file's coefficients and the windows' initial states refitted.
    """
    box = Box() if box is None else box
    if len(causes) < 2:
        raise InputError("A plan needs two causes to tell apart.")
    if not vehicle.thruster_names:
        raise InputError(f"{vehicle.name}: has no thrusters to plan commands for.")
    weight = np.zeros(18)
    for kind, std in vehicle.sensors:
        weight[np.isin(CHANNELS, SENSORS[kind])] = 1.0 / std
    weight *= np.tile([dof in vehicle.dof for dof in DOFS], 3)
    if not weight.any():
        raise InputError(
            f"{vehicle.name}: states no noise under [sensors]; say what is measured, and how well."
        )
    t = np.arange(round(duration / DT)) * DT
    if duration < 2 * WINDOW:
        raise InputError(f"A manoeuvre of {duration:g} s is too short; give {2 * WINDOW:g} s or more.")
    suspects, values, sizes = [], [], []
    for cause in causes:
        suspect = suspect_named(vehicle, cause.effect.name, cause.target, (type(cause.effect),))
        flat = np.concatenate([np.ravel(v) for v in cause.effect.parameters().values()])
        value = flat[[slots[0] for slots in suspect.slots.values()]]
        suspects.append(suspect)
        values.append(jnp.asarray(value))
        sizes.append(jnp.asarray(np.maximum(np.abs(value), 1e-3)))
    start = initial_state(
        vehicle.place(*causes), (0.0, 0.0, 0.5 * sum(box.depth) if "heave" in vehicle.dof else 0.0)
    )
    rivals = _Rivals(
        vehicle,
        tuple(suspects),
        tuple(values),
        tuple(sizes),
        jnp.asarray(weight),
        jnp.asarray(t),
        start,
        substeps(vehicle.place(*causes), DT, box.speed),
        round(WINDOW / DT),
        box,
    )
    progress("flying random manoeuvres")
    rng = np.random.default_rng(seed)
    shape = (max(2, round(duration / HOLD) + 1), len(vehicle.thruster_names))
    drawn = [_shrunk(rivals, rng.normal(size=shape)) for _ in range(RANDOM)]
    apart = [float(_judged(rivals, jnp.asarray(corners))[0]) for corners in drawn]
    progress("improving the best of them")
    best = drawn[int(np.argmax(apart))]
    better = _shrunk(rivals, np.asarray(_improved(rivals, jnp.asarray(best))))
    reached = float(_judged(rivals, jnp.asarray(better))[0])
    if reached < max(apart):
        better, reached = best, max(apart)
    commands = _commands(jnp.asarray(better), rivals.t)
    _, channels = rivals.flown(0, commands)
    channels = np.where(weight > 0, np.asarray(channels), np.nan)
    log = Log(t, channels, np.asarray(commands), None, vehicle.thruster_names, "plan")
    return Manoeuvre(log, 0.5 * reached, 0.5 * float(np.median(apart)))
