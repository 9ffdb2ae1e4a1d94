"""Fault isolation by Kalman filters: a bank with one for each cause, and one that estimates all of them.

Both are extended filters, linearised about their own prediction, of the vehicle under the commands of a log.
Its state is that of the craft, and the parameters of suspects beside it, which stay or walk at random. What
is not modelled pushes the craft as white noise of an unknown level.

Source: multiple-model adaptive estimation after Magill (1965) and Maybeck (1982); the augmented state after
Jazwinski (1970). The evidence of a cause whose size is unknown is that of Schwarz (1978).

Limits: a log is sampled evenly; sensors that are late are taken to be in time; causes act throughout;
coefficients of the file stay as filed.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special, stats

from jaxmarine._angles import ANGLES, wrap_to_pi
from jaxmarine._types import ALWAYS
from jaxmarine.diagnosis._plausible import full_thrust
from jaxmarine.diagnosis._saturated import SaturatedPlant
from jaxmarine.diagnosis._workbench import Workbench
from jaxmarine.physics import Asked, Late, compose
from jaxmarine.simulation import hold, initial_state
from jaxmarine.vehicle import Input, Plant, State

# Standard deviation of the force that is not modelled, held over a sample, as a share of the acceleration of
# full thrust. One that lasts for seconds does as much as a white one that is several times larger.
LEVELS = (1e-3, 0.03, 0.1, 0.3)
# Standard deviation of the first position [m], attitude [rad], velocity [m/s] and rate [rad/s] about what was
# logged: far more than the noise.
ANY = np.repeat([1.0, 0.3, 0.5, 0.3], 3)
# Standard deviation of a parameter beforehand, as a share of the size at which it alone changes accelerations
# or readings as much as they vary, or of where a search would start.
SHARE = 0.5
WALK = 0.1  # of a parameter over the log, in units of that, where it walks at random
WIDTH = 6  # numbers of the causes of one hypothesis
LANES = 8  # filters that run side by side
SHORTLIST = 3  # hypotheses that are asked at all levels
EVERY = 10  # samples between those at which sizes are looked at

X = TypeVar("X")


# --- the filter -----------------------------------------------------------------------------------


class System(eqx.Module, Generic[X]):
    """What a filter has to know of a state `x`; `now` is what is given of a sample."""

    @abc.abstractmethod
    def moved(self, x: X, by: Float[Array, " n"]) -> X:
        """The state moved by small numbers, in which its error counts."""

    @abc.abstractmethod
    def shown(self, x: X, now: Any) -> tuple[Float[Array, " rows"], Float[Array, "rows n"]]:
        """What sensors without noise would show, and its slopes by what moves the state."""

    @abc.abstractmethod
    def after(self, x: X, now: Any) -> tuple[X, Float[Array, "n n"]]:
        """The state at the next sample without noise, and how it is moved by what moves this one."""

    @abc.abstractmethod
    def missed(self, y: Float[Array, " rows"], shown: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """What was measured minus what is shown; angles come round."""


class Filtered(NamedTuple, Generic[X]):
    """Where a filter ends, and what it thought of the log.

    - `covariance`: of the numbers that move the last state; `path`: the state at each sample, behind its
      measurement; `log_likelihood` [nats]: of all innovations; -inf where the filter has diverged.
    """

    state: X
    covariance: Float[Array, "n n"]
    path: X
    log_likelihood: Float[Array, ""]


def run_filter(
    system: System[X],
    start: X,
    covariance: Float[Array, "n n"],
    walk: Float[Array, " n"],
    noise: Float[Array, " rows"],
    y: Float[Array, "times rows"],
    now: Any,
) -> Filtered[X]:
    """An extended Kalman filter over a log.

    - `covariance`: before the first measurement; `walk`: variance that each step adds.
    - `noise`: standard deviation of each row; `y`: NaN where nothing was measured.
    """

    def step(carry, sample):
        x, p, total, _ = carry
        y, now = sample
        seen = jnp.isfinite(y)
        shown, slopes = system.shown(x, now)
        # A row that was not measured is one of no slope that shows what it should.
        slopes = jnp.where(seen[:, None], slopes, 0.0) / noise[:, None]
        off = jnp.where(seen, system.missed(jnp.where(seen, y, shown), shown), 0.0) / noise
        s = slopes @ p @ slopes.T + jnp.eye(len(y))
        root = jnp.linalg.cholesky(s)
        white = jax.scipy.linalg.solve_triangular(root, off, lower=True)
        gain = jax.scipy.linalg.cho_solve((root, True), slopes @ p).T
        # Of a density in the units of what was measured.
        unit = jnp.where(seen, jnp.log(noise) + 0.5 * np.log(2 * np.pi), 0.0).sum()
        total = total - 0.5 * (white**2).sum() - jnp.log(jnp.diag(root)).sum() - unit
        x = system.moved(x, gain @ off)
        # Joseph's form stays positive where rounding would not.
        kept = jnp.eye(len(p)) - gain @ slopes
        p = kept @ p @ kept.T + gain @ gain.T
        then, f = system.after(x, now)
        return (then, f @ p @ f.T + jnp.diag(walk), total, p), x

    begun = start, covariance, jnp.zeros(()), covariance
    (_, _, total, p), path = jax.lax.scan(step, begun, (y, now))
    last = jax.tree.map(lambda a: a[-1], path)
    sound = jnp.isfinite(total) & jnp.isfinite(p).all()
    return Filtered(last, p, path, jnp.where(sound, total, -jnp.inf))


# --- the craft ------------------------------------------------------------------------------------


class Commands(eqx.Module):
    """The commands of a log with even samples, held from each to the next.

    - `t`: of the first sample, `dt` [s]; `held` [times, columns]; `sums`: their integral up to each sample.
    """

    t: Float[Array, ""]
    dt: Float[Array, ""]
    held: Float[Array, "times columns"]
    sums: Float[Array, "times columns"]

    def _cell(self, time: Float[Array, " columns"], off: float) -> Array:
        return jnp.clip(jnp.floor((time - self.t) / self.dt + off).astype(int), 0, len(self.held) - 1)

    def _sum(self, time: Float[Array, " columns"]) -> Float[Array, " columns"]:
        """The integral up to a time of each column; before the log the first command has held."""
        # At a sample the hold before it, as of a small positive delay.
        k, columns = self._cell(time, -1e-6), np.arange(self.held.shape[1])
        return self.sums[k, columns] + self.held[k, columns] * (time - self.t - k * self.dt)

    def late(self, t: Float[Array, ""], delay: Float[Array, " columns"]) -> Late:
        """What they were `delay` [s] before the hold from `t` on, as one row: its mean, and at its sample."""
        mean = (self._sum(t + self.dt - delay) - self._sum(t - delay)) / self.dt
        now = self.held[self._cell(t - delay, 1e-6), np.arange(self.held.shape[1])]
        return Late(mean[None], jnp.zeros_like(mean)[None], now[None])


class Augmented(NamedTuple):
    """A craft's state, where its thrusters' lags stand, and parameters of suspects minus neutral values."""

    craft: State
    acting: Float[Array, " columns"]
    z: Float[Array, " z"]


class Craft(System[Augmented]):
    """A vehicle whose suspects have their numbers in the state; what is given of a sample is its time [s].

    Errors count in free axes: position [m] NED, a small turn [rad], velocity [m/s, rad/s], the memory of the
    fluid; then in the thrusters' lags, and parameters in their own units.

    - `neutral`, `columns`: from the numbers z to the saturated model's parameters.
    - `rows`: the channels that are measured; `axes`: places of free positions and velocities among twelve;
      `memory`: those of free axes in the fluid's memory.
    """

    plant_of: SaturatedPlant
    neutral: Float[Array, " parameters"]
    columns: Float[Array, "parameters z"]
    commands: Commands
    rows: tuple[int, ...] = eqx.field(static=True)
    axes: tuple[int, ...] = eqx.field(static=True)
    memory: tuple[int, ...] = eqx.field(static=True)
    split: int = eqx.field(static=True)

    def moved(self, x: Augmented, by: Float[Array, " n"]) -> Augmented:
        ends = np.cumsum([len(self.axes), len(self.memory), len(x.acting)])
        free, memory, acting, z = jnp.split(by, ends)
        craft = x.craft.moved(jnp.zeros(12).at[np.array(self.axes)].set(free))
        remembered = craft.memory.at[np.array(self.memory, int)].add(memory)
        return Augmented(dataclasses.replace(craft, memory=remembered), x.acting + acting, x.z + z)

    def apart(self, x: Augmented, other: Augmented) -> Float[Array, " n"]:
        """By what a state is moved to become another one close to it."""
        a, b = x.craft, other.craft
        back = a.attitude * jnp.array([1.0, -1.0, -1.0, -1.0])
        turn = 2.0 * compose(back, b.attitude)[1:]
        twelve = jnp.concatenate([b.position - a.position, turn, b.velocity - a.velocity])
        memory = (b.memory - a.memory)[np.array(self.memory, int)]
        return jnp.concatenate([twelve[np.array(self.axes)], memory, other.acting - x.acting, other.z - x.z])

    def asked(self, x: Augmented, t: Float[Array, ""]) -> tuple[Plant, Asked]:
        """The plant with these parameters, and what commands ask of its thrusters from `t` on."""
        plant = self.plant_of(self.neutral + self.columns @ x.z, 0)
        late = self.commands.late(t, plant.drive.delay)
        drive = jax.tree.map(lambda a: a[None], plant.drive)
        return plant, Asked.of(drive, late, self.commands.dt[None, None])

    def slopes(
        self, outputs: Callable[[Augmented, Plant, Asked], Array], x: Augmented, t: Float[Array, ""]
    ) -> tuple[Array, Array]:
        """Outputs, and their slopes by what moves the state; only parameters change the plant."""
        plant, goal = self.asked(x, t)
        none = jnp.zeros(len(x.z))

        def by_state(by):
            return outputs(self.moved(x, jnp.concatenate([by, none])), plant, goal)

        def by_z(by):
            other = x._replace(z=x.z + by)
            return outputs(other, *self.asked(other, t))

        states = len(self.axes) + len(self.memory) + len(x.acting)
        both = jax.jacfwd(by_state)(jnp.zeros(states)), jax.jacfwd(by_z)(none)
        return outputs(x, plant, goal), jnp.concatenate(both, axis=1)

    def read(self, x: Augmented, plant: Plant, goal: Asked, t: Float[Array, ""]) -> Float[Array, " rows"]:
        """What is measured."""
        at = Input(goal.thrust(x.acting[None]).instant[0], goal.now[0], jnp.zeros(6), t)
        readings = plant.readings(x.craft, plant.acceleration(x.craft, at), max(ALWAYS, 1 + max(self.rows)))
        return readings[np.array(self.rows)]

    def held(self, x: Augmented, plant: Plant, goal: Asked, t: Float[Array, ""]) -> Augmented:
        """The state after the hold from `t` on."""
        given, dt = goal.thrust(x.acting[None]), self.commands.dt
        over = Input(given.mean[0], goal.now[0], jnp.zeros(6), t, given.slope[0], t + 0.5 * dt)
        return Augmented(hold(plant, x.craft, over, dt, self.split), goal.after(x.acting[None])[0], x.z)

    def shown(self, x: Augmented, now: Float[Array, ""]) -> tuple[Array, Array]:
        return self.slopes(lambda x, plant, goal: self.read(x, plant, goal, now), x, now)

    def after(self, x: Augmented, now: Float[Array, ""]) -> tuple[Augmented, Array]:
        then = self.held(x, *self.asked(x, now), now)
        moved = self.slopes(lambda x, plant, goal: self.apart(then, self.held(x, plant, goal, now)), x, now)
        return then, moved[1]

    def missed(self, y: Float[Array, " rows"], shown: Float[Array, " rows"]) -> Float[Array, " rows"]:
        off = y - shown
        return jnp.where(ANGLES[np.array(self.rows)], wrap_to_pi(off), off)


# --- hypotheses about a log -----------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """Suspects that act throughout, with their numbers z before the log.

    - `columns` [parameters, z], `start` and `spread` [z]: minus neutral values, and standard deviation.
    """

    suspects: tuple[int, ...]
    columns: np.ndarray
    start: np.ndarray
    spread: np.ndarray


class Answer(NamedTuple):
    """What filters side by side have found, one row each.

    - `log_likelihood` [nats]; `z` and `covariance`: of the parameters at the end; `path`: states.
    """

    log_likelihood: Float[Array | np.ndarray, " filters"]
    z: Float[Array | np.ndarray, "filters z"]
    covariance: Float[Array | np.ndarray, "filters z z"]
    path: State


class Watched:
    """A log, with what the filters of its vehicle share."""

    def __init__(self, bench: Workbench):
        (self.log,), self.bench = bench.data.logs, bench
        vehicle, log = bench.vehicle, self.log
        free = vehicle.free > 0
        measured = np.isfinite(bench.own_noise) & np.isfinite(log.channels).any(axis=0)
        plant_of = SaturatedPlant(vehicle, bench.families, jnp.ones((1, len(vehicle.placed))))
        given, dt = log.commanded(vehicle.command_names), float(np.median(np.diff(log.t)))
        assert given is not None
        sums = np.concatenate([np.zeros((1, given.shape[1])), np.cumsum(given[:-1] * dt, axis=0)])
        fluid = len(plant_of(jnp.asarray(bench.layout.neutral), 0).memories)
        self.craft = Craft(
            plant_of,
            jnp.asarray(bench.layout.neutral),
            jnp.zeros((bench.layout.size, WIDTH)),
            Commands(jnp.asarray(log.t[0]), jnp.asarray(dt), jnp.asarray(given), jnp.asarray(sums)),
            rows=tuple(np.flatnonzero(measured & np.tile(free, 4)[: len(measured)]).tolist()),
            axes=tuple(np.flatnonzero(np.tile(free, 2)).tolist()),
            memory=tuple(np.flatnonzero(np.tile(free, fluid)).tolist()),
            split=bench.split,
        )
        # What full thrust gives [m/s², rad/s²].
        self.pushed = np.abs(np.asarray(vehicle.plant().inverse_mass)) @ full_thrust(vehicle)
        self.y = log.channels[:, list(self.craft.rows)]

    def begun(self) -> Augmented:
        """The state as it was logged first, channel by channel, with neutral parameters."""
        channels, neutral = self.log.channels[:, :12], jnp.zeros(WIDTH)
        known = np.isfinite(channels)
        first = np.where(known.any(axis=0), channels[known.argmax(axis=0), np.arange(12)], 0.0)
        craft = initial_state(self.bench.vehicle, first[:3], first[3:6], first[6:])
        fluid = self.craft.plant_of(self.craft.neutral, 0).memories
        begun = dataclasses.replace(craft, memory=jnp.zeros(6 * len(fluid)))
        x = Augmented(begun, jnp.zeros(self.craft.commands.held.shape[1]), neutral)
        return x._replace(acting=self.craft.asked(x, self.craft.commands.t)[1].goal[0])

    def run(self, lanes: Sequence[tuple[Hypothesis, float]], walk: float = 0.0) -> Answer:
        """A filter for each hypothesis with its level of what is not modelled; all of one width.

        - `walk`: of parameters over the log, in units of their spread.
        """
        out = []
        size = min(LANES, len(lanes)) if walk else LANES
        for begin in range(0, len(lanes), size):
            some = lanes[begin : begin + size]
            full = [*some, *[some[-1]] * (size - len(some))]
            out.append(self._run(full, walk))
        joined = jax.tree.map(lambda *parts: np.concatenate(parts), *out)
        return jax.tree.map(lambda a: a[: len(lanes)], joined)

    def _run(self, lanes: Sequence[tuple[Hypothesis, float]], walk: float) -> Answer:
        columns, start, spread = (
            jnp.asarray(np.array([getattr(one, name) for one, _ in lanes]))
            for name in ("columns", "start", "spread")
        )
        levels = np.array([level for _, level in lanes])
        craft, dt = self.craft, float(self.craft.commands.dt)
        # Errors of the state and of readings that come of what is not modelled.
        on_state = np.append(np.zeros(6), self.pushed)[list(craft.axes)] * dt
        felt = np.concatenate([np.zeros(12), self.pushed, np.zeros(3), self.pushed[:3]])
        on_rows = felt[list(craft.rows)]
        own = self.bench.own_noise[list(craft.rows)]
        return _side_by_side(
            craft,
            self.begun(),
            jnp.asarray(ANY[list(craft.axes)]),
            columns,
            start,
            spread,
            jnp.asarray(np.outer(levels, on_state)),
            walk / np.sqrt(len(self.y)) * spread,
            jnp.asarray(np.hypot(own, np.outer(levels, on_rows))),
            jnp.asarray(self.y),
            jnp.asarray(self.log.t),
        )

    @functools.cached_property
    def sizes(self) -> Float[np.ndarray, " parameters"]:
        """At what size each parameter of the saturated model changes what varies by as much as it varies.

        Of accelerations and readings, root mean squares along the path of the filter of the file itself, the
        one that changes most; NaN where nothing changes.
        """
        layout = self.bench.layout
        nothing = Hypothesis((), np.zeros((layout.size, WIDTH)), np.zeros(WIDTH), np.zeros(WIDTH))
        found = self.run([(nothing, level) for level in LEVELS])
        best = int(np.argmax(found.log_likelihood))
        path = jax.tree.map(lambda a: jnp.asarray(a[best, ::EVERY]), found.path)
        craft = eqx.tree_at(lambda c: c.columns, self.craft, jnp.eye(layout.size))
        slopes, values = _sensitivities(craft, self.begun().acting, path, jnp.asarray(self.log.t[::EVERY]))
        vary = np.maximum(np.asarray(values).std(axis=0), 1e-9)
        ratio = np.sqrt((np.asarray(slopes) ** 2).mean(axis=0)) / vary[:, None]
        most = np.nan_to_num(ratio).max(axis=0)
        return 1.0 / np.where(most > 0.0, most, np.nan)

    def hypothesis(self, members: Sequence[tuple[int, np.ndarray]], width: int = WIDTH) -> Hypothesis | None:
        """Suspects with the values that each begins from; None where they are wider."""
        layout = self.bench.layout
        parts = [layout.columns[i] for i, _ in members]
        columns = np.concatenate([np.zeros((layout.size, 0)), *parts], axis=1)
        start = np.concatenate([np.zeros(0), *(value for _, value in members)])
        more = width - columns.shape[1]
        if more < 0:
            return None
        usual = np.array([np.nanmin(np.append(self.sizes[column != 0.0], np.inf)) for column in columns.T])
        usual = np.where(np.isfinite(usual), usual, 0.0)
        spread = SHARE * np.where(start != 0.0, np.abs(start), usual)
        pad = (0, more)
        columns, start, spread = np.pad(columns, [(0, 0), pad]), np.pad(start, pad), np.pad(spread, pad)
        return Hypothesis(tuple(i for i, _ in members), columns, start, spread)


@eqx.filter_jit
def _side_by_side(craft, begun, known, columns, start, spread, pushes, walks, noise, y, t) -> Answer:
    def one(columns, start, spread, push, walk, noise):
        system = eqx.tree_at(lambda c: c.columns, craft, columns)
        # Memory and lags begin at rest.
        rest = jnp.zeros(len(craft.memory) + len(begun.acting))
        covariance = jnp.diag(jnp.concatenate([known, rest, spread]) ** 2)
        steps = jnp.concatenate([push, rest, walk]) ** 2
        found = run_filter(system, begun._replace(z=start), covariance, steps, noise, y, t)
        width = len(start)
        p = found.covariance[-width:, -width:]
        return Answer(found.log_likelihood, found.state.z, p, found.path.craft)

    return jax.vmap(one)(columns, start, spread, pushes, walks, noise)


@eqx.filter_jit
def _sensitivities(craft: Craft, acting: Array, states: State, t: Float[Array, " times"]):
    """Slopes [times outputs parameters] of the acceleration over a hold and of readings, and both themselves.

    Thrusters are taken to have settled.
    """

    free = np.array([a - 6 for a in craft.axes if a >= 6])

    def outputs(z, state, t):
        x = Augmented(state, acting, z)
        plant, goal = craft.asked(x, t)
        x = x._replace(acting=goal.goal[0])
        change = (craft.held(x, plant, goal, t).craft.velocity - state.velocity) / craft.commands.dt
        out = jnp.concatenate([change[free], craft.read(x, plant, goal, t)])
        return out, out

    none = jnp.zeros(craft.columns.shape[1])
    return jax.vmap(lambda state, now: jax.jacfwd(outputs, has_aux=True)(none, state, now))(states, t)


# --- what they say --------------------------------------------------------------------------------


def evidences(watched: Watched, hypotheses: Sequence[Hypothesis]) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of each hypothesis' evidence [nats], and where its filter has left z.

    The first is asked at all levels of what is not modelled, the others at the one under which the first is
    most likely; then the first and the best of the others at all levels, which are as likely as one another.
    What is not on that shortlist has the evidence of its one level, less the logarithm of their number.
    """
    at_each = _schwarz(watched, [(hypotheses[0], level) for level in LEVELS])[0]
    level = LEVELS[int(np.argmax(at_each))]
    worth, z = _schwarz(watched, [(one, level) for one in hypotheses])
    worth = worth - np.log(len(LEVELS))
    best = [0, *(1 + np.argsort(-worth[1:])[:SHORTLIST])]
    more, there = _schwarz(watched, [(hypotheses[i], level) for i in best for level in LEVELS])
    more, there = more.reshape(len(best), -1), there.reshape(len(best), len(LEVELS), -1)
    worth[best] = special.logsumexp(more, axis=1) - np.log(len(LEVELS))
    z[best] = there[np.arange(len(best)), np.argmax(more, axis=1)]
    return worth, z


def _schwarz(watched: Watched, lanes: Sequence[tuple[Hypothesis, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Evidence of each filter [nats], and its z.

    The innovations' likelihood has z integrated out. Without what its prior says of where z ended, and by
    what the filter has learned of it, that is the likelihood at that z, which pays log(n) / 2 for each number
    (Schwarz 1978): no answer hangs on how wide a prior was.
    """
    found = watched.run(lanes)
    used = np.array([one.spread > 0.0 for one, _ in lanes])
    spread = np.where(used, [one.spread for one, _ in lanes], 1.0)
    scaled = found.covariance / (spread[:, :, None] * spread[:, None, :])
    both = used[:, :, None] & used[:, None, :]
    scaled = np.where(both, np.nan_to_num(scaled), np.eye(used.shape[1]))
    learned = -0.5 * np.linalg.slogdet(scaled)[1]
    off = (np.asarray(found.z) - np.array([one.start for one, _ in lanes])) / spread
    learned = learned + 0.5 * np.where(used, np.nan_to_num(off) ** 2, 0.0).sum(axis=1)
    paid = 0.5 * used.sum(axis=1) * np.log(np.isfinite(watched.y).sum())
    likely = np.asarray(found.log_likelihood)
    # A filter that ran away explains nothing.
    fits = np.isfinite(likely) & np.isfinite(learned)
    worth = np.where(fits, likely, -1e300) + np.where(fits, learned, 0.0) - paid
    return worth, np.asarray(found.z)


def significances(watched: Watched) -> tuple[np.ndarray, np.ndarray]:
    """How far each suspect's parameters are off neutral, -log p [nats], and their estimates in one vector.

    One filter has the parameters of all suspects as states that walk at random, at the level of what is not
    modelled under which the log is most likely. By their chi-square in units of the covariance, the others
    integrated out.
    """
    layout = watched.bench.layout
    members = [(i, np.zeros(columns.shape[1])) for i, columns in enumerate(layout.columns)]
    every = watched.hypothesis(members, sum(columns.shape[1] for columns in layout.columns))
    assert every is not None
    found = watched.run([(every, level) for level in LEVELS], WALK)
    best = int(np.argmax(found.log_likelihood))
    z, p = found.z[best], found.covariance[best]
    out, at = [], 0
    for _, value in members:
        own = slice(at, at := at + len(value))
        used = np.flatnonzero(every.spread[own] > 0.0) + own.start
        chi2 = z[used] @ np.linalg.solve(p[np.ix_(used, used)], z[used]) if len(used) else 0.0
        out.append(-stats.chi2.logsf(chi2, max(len(used), 1)))
    return np.array(out), np.asarray(z)
