"""The workbench: the saturated problem with its compiled programs, and what a search asks of the windows."""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._compiled import compiled
from .._errors import InputError, runaway
from .._types import AXES, DOFS, POSES
from ..effects import AbstractEffect, CoupledDamping, InflowLoss
from ..fitting import (
    LEAST_DAMPING,
    Affine,
    Check,
    Cut,
    Likelihood,
    Path,
    Problem,
    Room,
    Segments,
    Task,
    Windowed,
    coefficient_name,
    cut,
    estimated,
    evaluated,
    innovations,
    logarithms_of,
    maximise,
    measured_channels,
    path_lines,
    promise,
    refine_windows,
    scaled,
    screening,
    segments,
    start_precision,
    start_spread,
    unusual,
    worth_a_step,
)
from ..logs import Log
from ..vehicle import Placed, Vehicle
from ._criteria import DEFAULT, Criteria
from ._explanation import Beginning, Beside, Member, Model, Stretches
from ._filed import base_coefficients, matrix_place
from ._fine import Fine, parts_of
from ._keeper import HERE, AbstractKeeper, Outline, Part, seen_of
from ._possible import braked, braking_holds, of_a_craft, water_of
from ._saturated import Layout, SaturatedPlant
from ._score import Reduced, joined
from ._signals import PlacedAt, Places, largest_commands, placed_at, places

# Room for parameters in the compiled refinement: coefficients of the file, members and one suspect. With
# half of it a step would take as long.
SLOTS = 44
# Members with a beginning of their own: parameters that the compiled screening has columns for, and
# stretches between beginnings, those of the vehicle file included.
BEGUN = 6
SEGMENTS = 4
# Groups that windows are screened in at most: each window of logs of up to 40 min, some in a row of longer
# ones, as each group takes up half a megabyte.
GROUPS = 600
# Of many windows suspects are refitted on every second, third or fourth first: on no fewer than a log of
# 300 s has, and no sparser, as a cause may show in few.
SAMPLE, SPARSEST = 75, 4
# Damping with which a refinement begins, at most: as the one before ended, which knows how far a step holds.
MOST_DAMPING = 0.1
# A refinement ends where a step promises less than this share of the chi-square, beside a disturbance of
# minus twice the logarithm of the likelihood or of the samples, if these are more: a twentieth of what one of
# some ten thousand samples has left, so that no parameter is a quarter of its standard error away.
EXACT = 1e-6
# Steps of a refit that tells roughly what a model is worth beside a disturbance, and that share of it.
FEW_STEPS, ROUGH = 3, 1e-4
# Times that sizes and memories of a disturbance are estimated in turn with all else at most, and nats that
# are worth one more.
ESTIMATES, LIKELIER = 4, 0.5
# Minus twice the logarithm of a sample's likelihood beyond which a model misses more than noise and wind.
TOO_FAR = 4.0
# A noise that was raised by this much says that more than it was left.
RAISED = 1.3
# Length of a knot of the missing wrench [s]: shorter than what a craft's wrench changes in, long enough
# for the noise.
KNOT = 0.5

# Arguments of a workbench's constructor that another one takes over from it.
_OWN = ("vehicle", "families", "layout", "data", "noise", "split", "own_noise", "filed", "criteria", "part")

Result = TypeVar("Result")


class Sample(NamedTuple):
    """One of so many windows, and a model refined on these.

    What a model saves in a sample it is taken to save in as many more windows as there are.
    """

    bench: "Workbench"
    model: Model
    every: int

    def saved(self, cost: float) -> float:
        """Chi-square that is saved on all windows, by the cost on these."""
        return 2 * self.every * (self.model.cost - cost)

    def whole(self, model: Model, one: Model) -> Model:
        """A model on all windows, from one that was refined on these; `model`: what was sampled."""
        if self.every == 1:
            return one
        cost, promised = (model.cost - 0.5 * self.saved(x) for x in (one.cost, one.promised))
        same = {"delta": model.delta, "weight": model.weight}
        return dataclasses.replace(one, cost=cost, promised=promised, **same)


class Workbench:
    """The saturated problem with its compiled programs; everything the search asks of the windows.

    It holds no state of the search: a `Model` goes in, a `Model` comes out.

    - `filed`: the vehicle as filed, `vehicle` with its columns in the order that the log has them.
    - `noise`: of each channel, NaN where it is not used; `own_noise`: that of its sensor alone.
    - `samples`: measured numbers in all windows; `freedom`: those that the windows' starts leave.
    - `criteria`: what decides an answer.
    - `room`: that of the programs; one that was given, if the logs fit into it.
    - `part`: which of all logs its own are, where others lie elsewhere; `keeper`: who keeps the windows, of
      which `data` is an outline where that is not this process.
    - `group_windows`, `group_log`, `group_starts`: the first window of each group, its log and its time [s].
    """

    def __init__(
        self,
        vehicle: Vehicle,
        families: tuple[AbstractEffect, ...],
        layout: Layout,
        data: Cut | Outline,
        noise: Float[np.ndarray, " channels"],
        split: int,
        own_noise: Float[np.ndarray, " channels"] | None = None,
        filed: Vehicle | None = None,
        criteria: Criteria = DEFAULT,
        room: Room | None = None,
        part: Part | None = None,
        keeper: AbstractKeeper = HERE,
    ):
        self.vehicle = vehicle
        self.filed = vehicle if filed is None else filed
        self.layout = layout
        self.data = data
        self.noise = noise
        self.own_noise = noise if own_noise is None else own_noise
        self.split = split
        self.families = families
        self.criteria = criteria
        self.base = base_coefficients(vehicle, layout, criteria.file_error)
        outline = data if isinstance(data, Outline) else Outline.of(data)
        log, steps = outline.log, outline.steps
        dt = float(np.median([log.dt for log in data.logs]))
        self.part = Part(0, (), 0, len(log), dt) if part is None else part
        self.keeper = keeper
        self.count = len(log)
        self.samples = int(outline.seen.sum())
        self.freedom = float(max(self.samples - self.count * _starts(outline.seen, vehicle), 1))
        group = _grouped(log, self.part.windows)
        self.group_windows = np.flatnonzero(np.diff(group, prepend=-1))
        self.group_log, self.group_starts = log[self.group_windows], data.starts[self.group_windows]
        # Two samples or more to each: what pushes behind a window's last one shows nowhere.
        parts = parts_of(steps, self.part.dt)
        of_part = round(data.length / parts / KNOT)
        self.knots = parts * min(max(2 if parts == 1 else 1, of_part), max(1, steps // (2 * parts)))
        self._own = segments(vehicle, data.logs, self.part.later)
        self._screened: tuple[Model, Any, Reduced] | None = None
        self._expected: tuple[Path, Places] | None = None
        self._sampled: tuple[Model, Model] | None = None
        # Programs that are compiled, by kinds of models.
        self._known = set[tuple[str, tuple[bool, ...] | None]]()
        if isinstance(data, Outline):
            # No program for windows is compiled here.
            self.room = Room(0, 0, 0)
            return
        own = Room.of(data.records, data.windows)
        self.room = room if room is not None and room.holds(own) else own
        # Windows that only fill the programs' arrays up are in a group of their own, the last.
        self._most_groups = self.room.windows if self.count <= GROUPS else GROUPS + self.room.logs
        self._groups = np.full(self.room.windows, self._most_groups)
        self._groups[: self.count] = group
        records, windows = self.room.filled(data.records, data.windows)
        self._problem = Problem(
            SaturatedPlant(vehicle, families, jnp.ones((SEGMENTS, len(vehicle.placed)))),
            records,
            windows,
            jnp.asarray(start_precision(vehicle.free)),
            measured_channels(windows),
            jnp.asarray(split),
            apart=False,
            axes=vehicle.axes,
        )

    @property
    def cut(self) -> Cut:
        """The windows, where they lie here."""
        assert isinstance(self.data, Cut)
        return self.data

    @functools.cached_property
    def _sample(self) -> tuple["Workbench", int]:
        """The same with some windows out of many, and one of how many these are."""
        step = max(1, min(SPARSEST, self.count // SAMPLE))
        return (self if step == 1 else self.every(step)), step

    def which(self, step: int) -> slice:
        """The own windows whose number, counted over all, is a multiple of `step`."""
        return slice(-self.part.before % step, None, step)

    def every(self, step: int) -> "Workbench":
        """The same with those windows alone whose number, counted over all, is a multiple of `step`."""
        data, which = self.data, self.which(step)
        starts = data.starts[which]
        if isinstance(data, Outline):
            seen = np.sum(self.keeper.each(self, seen_in, step), axis=0)
            few = dataclasses.replace(data, starts=starts, log=data.log[which], seen=seen)
        else:
            windows = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[which]), data.windows)
            few = dataclasses.replace(data, windows=windows, starts=starts)
        own = self._arguments | {"data": few, "part": self.part.every(step)}
        return Workbench(**own, keeper=self.keeper.remade(Workbench.every, step))

    @property
    def _arguments(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _OWN}

    def _like(self, **other: Any) -> "Workbench":
        """The same but for some arguments of the constructor."""
        return Workbench(**(self._arguments | other), keeper=self.keeper.remade(remade, other))

    def finer(self, split: int) -> "Workbench":
        """The same with each hold integrated in so many steps."""
        return self._like(split=split)

    @functools.cached_property
    def fine(self) -> Fine:
        """The windows cut up for the filter."""
        parts = self._problem, self.vehicle, self.cut, self.room, self._groups, self._most_groups
        return Fine.of(*parts)

    @functools.cached_property
    def places(self) -> Places:
        """Of the knots; logs are smoothed for them, which a workbench that only refines can do without."""
        return self._places(self.knots)

    @functools.cached_property
    def _every_sample(self) -> Places:
        """Of every sample of the windows, as measured."""
        return self._places(self.cut.windows.step.shape[1])

    def expected(self, model: Model) -> Places:
        """Every sample, with the craft where the path of a model beside a disturbance lets one expect it.

        It knows of no later sample, but for where a log begins, and for what commands give (`driven`). The
        last one is kept: it is commonly asked of models along the same path.
        """
        assert model.beside is not None
        if self._expected is None or self._expected[0] is not model.beside.path:
            states = np.asarray(self.lines(model).states)[: self.fine.count]
            along = self._every_sample.in_states(states.reshape(*self._every_sample.t.shape, -1))
            self._expected = model.beside.path, along
        return self._expected[1]

    def _places(self, count: int) -> Places:
        """Of so many knots in each window."""
        names, logs = self.vehicle.drive_names, self.data.logs
        largest = np.max(self.keeper.each(self, largest_in), axis=0)
        return places(names, logs, self.keeper.each(self, placed_in, count, largest))

    # --- the affine map of z -------------------------------------------------------------------

    def width(self, members: Sequence[Member]) -> int:
        return len(self.base) + sum(self.layout.columns[m.suspect].shape[1] for m in members)

    def coefficient_of(self, suspect: int) -> int | None:
        """Which coefficient of the file a suspect alters, if it does nothing else."""
        return next((j for j, c in enumerate(self.base) if c.suspect == suspect), None)

    def _padded(self, z: np.ndarray, fill: float = 0.0) -> np.ndarray:
        return np.append(z, np.full(SLOTS - len(z), fill))

    def slices(self, members: Sequence[Member]) -> list[slice]:
        """Where each member's parameters lie in z."""
        out, at = [], len(self.base)
        for member in members:
            n = self.layout.columns[member.suspect].shape[1]
            out.append(slice(at, at + n))
            at += n
        return out

    def beginnings(self, members: Sequence[Member]) -> list[Beginning]:
        found = {m.since for m in members if m.since is not None}
        return sorted(found, key=lambda b: (b.log, b.time))

    def stretches(self, members: Sequence[Member], test: Log | None = None) -> Stretches:
        """Those of the training logs, or of a test log that comes after them unless it is one of them."""
        logs = self.data.logs
        if test is None:
            return self._stretches(members, logs, self._positions, self._own)
        twin = self.twin(test)
        if twin is not None:
            whole = self.stretches(members)
            return dataclasses.replace(whole, of_samples=(whole.of_samples[twin],))
        own = segments(self.vehicle, (*logs, test))
        last = dataclasses.replace(own, of_samples=own.of_samples[-1:])
        return self._stretches(members, (test,), (len(logs),), last)

    @property
    def _positions(self) -> range:
        """The own logs' places in the order of recording."""
        return range(self.part.first, self.part.first + len(self.data.logs))

    def twin(self, test: Log) -> int | None:
        """Which training log a test log is, if it is one."""
        return next((i for i, log in enumerate(self.data.logs) if same_log(log, test)), None)

    def have_room(self, members: Sequence[Member]) -> bool:
        """Whether the programs have a stretch for each of those between the members' beginnings."""
        logs = self.data.logs
        codes = self._codes(members, logs, self._positions, self._own)
        return len(np.unique(np.concatenate(codes))) <= SEGMENTS

    def _codes(
        self, members: Sequence[Member], logs: Sequence[Log], positions: Sequence[int], own: Segments
    ) -> list[np.ndarray]:
        """Per log and sample a number for what acts there; `positions`: as of `_stretches`."""
        codes = []
        for log, position, acting in zip(logs, positions, own.of_samples, strict=True):
            passed = np.zeros(len(log.t), int)
            for b in self.beginnings(members):
                passed += (position > b.log) | ((position == b.log) & (log.t >= b.time - 1e-9))
            codes.append(passed * len(own.gates) + acting)
        return codes

    def _stretches(
        self, members: Sequence[Member], logs: Sequence[Log], positions: Sequence[int], own: Segments
    ) -> Stretches:
        """`positions`: the logs' places in the order of recording."""
        codes = self._codes(members, logs, positions, own)
        met, index = np.unique(np.concatenate(codes), return_inverse=True)
        if len(met) > SEGMENTS:
            raise InputError(
                f"Effects of {self.vehicle.name} begin at {len(met) - 1} times within these logs; "
                f"a diagnosis has room for {SEGMENTS - 1}: leave some of the logs out."
            )
        ends = np.cumsum([len(code) for code in codes])[:-1]
        return Stretches(tuple(np.split(index, ends)), met // len(own.gates), own.gates[met % len(own.gates)])

    def open(self, model: Model) -> list[int]:
        """Suspects that are not in the model yet and that the programs have room for."""
        room = SLOTS - len(model.z)
        taken = {m.suspect for m in model.members}
        return [i for i, c in enumerate(self.layout.columns) if i not in taken and c.shape[1] <= room]

    def may_begin(self, model: Model, suspect: int) -> bool:
        """Whether the programs have room for one more suspect with a beginning of its own."""
        begun = [m for m in model.members if m.since is not None]
        columns = sum(self.layout.columns[m.suspect].shape[1] for m in begun)
        # One more beginning cuts one stretch in two, or one in each log where the file's own recur.
        more = 1 if len(self._own.gates) == 1 else 2
        room = len(self.stretches(model.members).passed) + more <= SEGMENTS
        return room and columns + self.layout.columns[suspect].shape[1] <= BEGUN

    def affine(self, members: Sequence[Member], stretches: Stretches | None = None) -> Affine:
        """From z to the saturated model's parameters in each segment, of the training logs by default."""
        begun = self.beginnings(members)
        passed = filled((stretches or self.stretches(members)).passed)
        columns, acts = np.zeros((self.layout.size, SLOTS)), np.ones((SEGMENTS, SLOTS))
        for j, coefficient in enumerate(self.base):
            columns[coefficient.index, j] = 1.0
        for member, where in zip(members, self.slices(members), strict=True):
            columns[:, where] = self.layout.columns[member.suspect]
            if member.since is not None:
                acts[passed <= begun.index(member.since), where] = 0.0
        neutral = np.tile(self.layout.neutral, (SEGMENTS, 1))
        return Affine(jnp.asarray(neutral), jnp.asarray(columns), jnp.asarray(acts))

    def phases(self, members: Sequence[Member]) -> tuple[int, ...]:
        """Where the members' phases lie in the saturated model's parameters."""
        out = []
        for m in members:
            suspect, columns = self.layout.suspects[m.suspect], self.layout.columns[m.suspect]
            own = [i for i, name in enumerate(suspect.slots) if name in suspect.effect.phases]
            out += np.flatnonzero(columns[:, own].any(axis=1)).tolist()
        return tuple(out)

    def problem(self, members: Sequence[Member], whole: Problem | None = None) -> Problem:
        """The windows' residuals, with the segments that the beginnings make; `whole`: of other windows."""
        whole = self._problem if whole is None else whole
        logs, steps = whole.records.t.shape
        stretches = self.stretches(members)
        rows = [np.pad(row, (0, steps - len(row)), mode="edge") for row in stretches.of_samples]
        # Of logs that there is room for and that are not there nothing is asked.
        segment = np.pad(np.array(rows), ((0, logs - len(rows)), (0, 0)), mode="edge")
        return eqx.tree_at(
            lambda p: (p.records.segment, p.plant_of.gates),
            whole,
            (jnp.asarray(segment), jnp.asarray(filled(stretches.gates))),
        )

    def _plant_of(self, members: Sequence[Member]) -> SaturatedPlant:
        """The plants of the segments that the beginnings make."""
        gates = filled(self.stretches(members).gates)
        return SaturatedPlant(self.vehicle, self.families, jnp.asarray(gates))

    def stood_for(self, model: Model) -> Bool[np.ndarray, " base"]:
        """Which coefficients of the file a member stands for: one that changes them and always acts."""
        taken = {m.suspect for m in model.members if m.since is None}
        return np.array([c.suspect in taken for c in self.base], bool)

    def held(self, model: Model) -> Bool[np.ndarray, " base"]:
        """Which coefficients of the file may not bend."""
        out = self.stood_for(model) | model.frozen
        out[list(model.held)] = True
        return out

    def _precision(self, model: Model) -> np.ndarray:
        """Inverse variance of the prior on z."""
        out = np.full(self.width(model.members), 1e-8)  # a trace, for what the data do not determine
        for j, (c, held) in enumerate(zip(self.base, self.held(model), strict=True)):
            out[j] = (1e12 if held else model.weight) / c.prior**2
        return out

    def task_prior(self, model: Model) -> Array:
        """The prior's precision of a task, of a z that fills up too."""
        return jnp.asarray(self._padded(self._precision(model), 1.0))

    def task(self, model: Model) -> Task:
        return Task(self.problem(model.members), self.affine(model.members), self.task_prior(model))

    # --- what the search asks ------------------------------------------------------------------

    def start(self) -> Model:
        return Model((), np.zeros(len(self.base)), self.keeper.keep(self, as_measured), np.inf)

    def refine(self, model: Model, max_steps: int = 25, rtol: float = EXACT) -> Model:
        """Gauss-Newton on all numbers, until a step promises less than `rtol` of the chi-square.

        Where the vehicle runs away from the start, it begins at the file's values.
        """
        z = self._padded(model.z)
        damping = float(np.clip(model.damping, LEAST_DAMPING, MOST_DAMPING))
        if model.beside is not None:
            likely = self._likelihood(model)
            path = model.beside.path
            out = maximise(likely, jnp.asarray(z), path, max_steps, rtol, self.samples, damping)
            moved = dict[str, Any](beside=dataclasses.replace(model.beside, path=out.path))
            own = 0.5 * unusual(model.beside.force, self.fine.unit)
        else:
            out = self.keeper.refined(self, model, jnp.asarray(z), max_steps, rtol, damping)
            moved, own = dict[str, Any](delta=out.delta), 0.0
        cost = float(out.cost) + own
        if not np.isfinite(cost) and model.z[: len(self.base)].any():
            return self.refine(self.as_filed(model), max_steps, rtol)
        promised = cost - float(out.promised) if np.isfinite(cost) else np.inf
        z = np.asarray(out.z)[: len(model.z)]
        damping = float(out.damping)
        return dataclasses.replace(model, z=z, cost=cost, promised=promised, damping=damping, **moved)

    def _likelihood(self, model: Model) -> Likelihood:
        assert model.beside is not None
        problem = self.problem(model.members, self.fine.problem)
        return Likelihood(problem, self.affine(model.members), self.task_prior(model), model.beside.force)

    def along(self, model: Model) -> tuple[Problem, Affine]:
        """The windows cut up for the filter, and the map of changes of z."""
        problem = self.problem(model.members, self.fine.problem)
        return problem, self.affine(model.members).at(jnp.asarray(self._padded(model.z)))

    def lines(self, model: Model) -> Windowed:
        """The windows cut up for the filter, as linear systems along the model's path."""
        assert model.beside is not None
        return path_lines(*self.along(model), model.beside.force, model.beside.path)

    @property
    def spread(self) -> Float[Array, "12"]:
        """Standard deviation of a window's first state beside a disturbance."""
        return start_spread(self._problem.start_precision)

    def promised(self, models: Sequence[Model]) -> list[float]:
        """The cost that a step of each promises: beside a disturbance the next, else the one after it."""
        if any(model.beside is None for model in models):
            return [one.promised for one in self.refine_each(models, 1)]

        def of(model: Model) -> float:
            assert model.beside is not None
            likely = self._likelihood(model)
            z = jnp.asarray(self._padded(model.z))
            cost = float(promise(likely, z, model.beside.path, LEAST_DAMPING))
            cost += 0.5 * unusual(model.beside.force, self.fine.unit)
            return cost if np.isfinite(cost) else np.inf

        return self._side_by_side(of, models, "promise")

    def likeliest(
        self, model: Model, max_steps: int = 25, rtol: float = EXACT, times: int = ESTIMATES
    ) -> Model:
        """The model refined, with the disturbance that makes the logs most likely beside it.

        - `times`: that the two are done in turn at most.
        """
        model = self.refine(model, max_steps, rtol)
        for _ in range(times):
            if model.beside is None or not np.isfinite(model.cost):
                break
            beside = model.beside
            step = float(worth_a_step(rtol, self.samples, 2 * model.cost))
            unit, known = self.fine.unit, (beside.force, self.fine.unit, beside.covariance)
            force, learned, _ = estimated(self.spread, self.lines(model), *known, enough=step, far=True)
            moved = not np.allclose(logarithms_of(force, unit), logarithms_of(beside.force, unit))
            if not moved and 2 * (model.cost - model.promised) < step:
                break
            # What a model misses makes the likelihood curve as it will not once that has a name.
            missed = 2 * model.cost > TOO_FAR * self.samples
            now = Beside(force, beside.path, beside.covariance if missed else learned)
            before, model = model, self.refine(dataclasses.replace(model, beside=now), max_steps, rtol)
            if not before.cost - model.cost > max(LIKELIER, 0.5 * step):
                return model if model.cost < before.cost else before
        return model

    def undisturbed(self, model: Model) -> Model:
        """The model as it is for white noise alone, with windows that begin as suits it best."""
        if model.beside is None:
            return model
        white = dataclasses.replace(model, beside=None, damping=LEAST_DAMPING)
        task = self.task(white)
        # Nothing but the starts is free.
        fixed = eqx.tree_at(lambda t: (t.affine, t.precision), task, self._fixed(white, task))
        out = refine_windows(fixed, jnp.zeros(SLOTS), white.delta, 10, rtol=1e-5)
        prior = float(self._precision(white) @ white.z**2)
        return dataclasses.replace(white, delta=out.delta, cost=float(out.cost) + 0.5 * prior)

    @contextlib.contextmanager
    def preparing(self, model: Model) -> Iterator[None]:
        """Has what is asked in the end beside white noise compiled meanwhile, where there are two processors.

        A search beside a disturbance needs none of it, and compiles little: at a first start these take a
        fifth of a diagnosis.
        """
        alone = isinstance(self.data, Outline) or (os.cpu_count() or 1) < 2
        if model.beside is None or alone:
            yield
            return
        white = dataclasses.replace(model, beside=None)

        def asked() -> None:
            with jax.enable_x64(True):
                refine_windows(self.task(white), jnp.asarray(self._padded(white.z)), white.delta, 1)
                self.screened(white)

        with ThreadPoolExecutor(1) as pool:
            prepared = pool.submit(asked)
            yield
            prepared.result()

    def _fixed(self, model: Model, task: Task) -> tuple[Affine, Array]:
        here = task.affine.at(jnp.asarray(self._padded(model.z)))
        none = dataclasses.replace(here, columns=jnp.zeros_like(here.columns))
        return none, jnp.ones_like(task.precision)

    def refine_each(
        self, models: Sequence[Model], max_steps: int = 25, rtol: float = EXACT, times: int = 0
    ) -> list[Model]:
        """`likeliest` of each, as many at once as there are processors: a compiled program keeps one busy."""

        return self._side_by_side(
            lambda model: self.likeliest(model, max_steps, rtol, times), models, "refine"
        )

    def _side_by_side(
        self, of: Callable[[Model], Result], models: Sequence[Model], program: str
    ) -> list[Result]:
        """`of` each model, in threads."""

        def one(model: Model) -> Result:
            # Precision that was asked for by `with` is the calling thread's alone.
            with jax.enable_x64(True):
                return of(model)

        # The first compiles the program that the others share, if none of its kind was compiled before. Other
        # processors work on windows that lie elsewhere.
        kinds = {(program, None if model.beside is None else model.beside.force.kind) for model in models}
        alone = len(models) if isinstance(self.data, Outline) else 0 if kinds <= self._known else 1
        first = [one(model) for model in models[:alone]]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            out = [*first, *pool.map(one, models[alone:])]
        self._known |= kinds
        return out

    def sampled(self, model: Model) -> "Sample":
        """Some windows out of many, and the model refined on these; all where there are not many."""
        few, step = self._sample
        if few is self or model.beside is not None:
            return Sample(self, model, 1)
        if self._sampled is None or self._sampled[0] is not model:
            delta = self.keeper.keep(few, as_some, self, step, model)
            here = dataclasses.replace(model, delta=delta, weight=model.weight / step, cost=np.inf)
            self._sampled = model, few.refine(here)
        return Sample(few, self._sampled[1], step)

    def frozen(self, model: Model) -> Model:
        """The model with the file's coefficients held at their values."""
        return dataclasses.replace(model, frozen=True)

    def as_filed(self, model: Model) -> Model:
        """The model with the file's coefficients at their values, and windows that begin as measured.

        Beside a disturbance its path stays.
        """
        z = np.concatenate([np.zeros(len(self.base)), model.z[len(self.base) :]])
        delta = self.keeper.keep(self, as_measured)
        return dataclasses.replace(model, z=z, delta=delta, cost=np.inf, damping=LEAST_DAMPING)

    def theta(self, model: Model, stretches: Stretches | None = None) -> np.ndarray:
        """The saturated model's parameters in each segment, of the training logs by default."""
        return np.asarray(self.affine(model.members, stretches)(jnp.asarray(self._padded(model.z))))

    def water(self, model: Model) -> Float[np.ndarray, "3"]:
        """Velocity of the water [m/s], where all that begins has begun."""
        last = len(self.stretches(model.members).passed) - 1
        theta, plant_of = self.theta(model)[last], self._plant_of(model.members)
        return np.asarray(water_of(plant_of, jnp.asarray(theta), jnp.asarray(last)))

    @property
    def own_weight(self) -> Float[np.ndarray, "windows steps channels"]:
        """One over the noise of the sensors alone, 0 where nothing was measured."""
        return np.where(np.asarray(self.cut.windows.weight) > 0, np.nan_to_num(1.0 / self.own_noise), 0.0)

    def as_connected(self, *otherwise: Placed) -> "Workbench":
        """The same with the columns as the vehicle file has them, or as causes of ours exchange these."""
        return self._like(vehicle=self.filed.place(*otherwise))

    def against(self, filed: Vehicle) -> "Workbench":
        """The same with another vehicle as filed, whose placed effects its own has first."""
        return self._like(filed=filed, room=self.room)

    def on(self, logs: Sequence[Log]) -> "Workbench":
        """The same with other logs, whose programs are those of its own where there is room."""
        assert isinstance(self.data, Cut)
        data = cut(self.vehicle, logs, self.noise, self.data.length)
        return self._like(data=data, part=None, room=self.room)

    def reweighed(self, noise: Float[np.ndarray, " channels"]) -> "Workbench":
        """The same with another noise of its channels, but where windows begin (`fitting._weights`)."""
        factor = np.nan_to_num(noise / self.own_noise, nan=1.0)
        weight = scaled(self.own_weight, factor, self.data.logs[0].dt)
        windows = dataclasses.replace(self.cut.windows, weight=jnp.asarray(weight))
        return self._like(data=dataclasses.replace(self.cut, windows=windows), noise=noise)

    @property
    def raised(self) -> bool:
        """Whether a channel counts for less than its sensor's own noise asks for: more than that is left."""
        return bool(np.nanmax(self.noise / self.own_noise) > RAISED)

    @property
    def quiet(self) -> float:
        """The sensors' own noise over the one that is used, of the channel that was raised least."""
        return float(np.nanmax(self.own_noise / self.noise))

    def sound(self, model: Model) -> bool:
        """Whether all numbers mean something: in their effects' ranges, and such as a craft can have."""
        for member, where in zip(model.members, self.slices(model.members), strict=True):
            if not self.layout.plausible(member.suspect, model.z[where]):
                return False
        met = len(self.stretches(model.members).passed)
        theta = jnp.asarray(self.theta(model))
        return of_a_craft(self.vehicle, self._plant_of(model.members), theta, self._flow(model), met)

    def _flow(self, model: Model) -> Float[np.ndarray, " thrusters"]:
        """Root mean square velocity along each thruster [m/s], where the model loses thrust by it.

        Zero where water moves: of the velocity through it the logs do not tell without the model.
        """
        direction = np.asarray(self.vehicle.thrusters.direction)
        loses = any(self.layout.suspects[m.suspect].effect is InflowLoss for m in model.members)
        if not loses or self.water(model).any():
            return np.zeros(len(direction))
        return np.sqrt(sum(self.keeper.each(self, squares_along, direction)) / self.count)

    def brakes(self, model: Model) -> Bool[np.ndarray, "6 6"]:
        """On the diagonal whether each axis is braked at the logs' speeds, gear at rest and memory included.

        Off it whether any motion of two axes is: of a linear coupling both terms come to at most twice the
        geometric mean of what brakes the two, as D + D' is positive (after Fossen 2021, on damping).

        A push within the width of the prior is none: where the file says zero, the logs may say a bit less.
        A prior that the file states itself, which may be wide, allows no more than that of a usual file.
        """
        met, theta = len(self.stretches(model.members).passed), self.theta(model)
        speed = self.data.speeds
        braking = np.array(
            braked(self._plant_of(model.members), jnp.asarray(theta), jnp.asarray(speed))[:met]
        )
        for c in self.base:
            if c.diagonal and c.kind != "added_mass":
                usual = self.criteria.file_error * abs(c.value)
                slack = min(c.prior, usual or c.prior)
                braking[:, c.place[0]] += slack * (
                    speed[c.place[0]] if c.kind == "damping.quadratic" else 1.0
                )
        coupled = np.tile(np.asarray(self.vehicle.damping.linear), (met, 1, 1))
        for placed in self.vehicle.placed:
            if isinstance(placed.effect, CoupledDamping):
                coupled += np.asarray(placed.effect.value)
        for suspect, columns in zip(self.layout.suspects, self.layout.columns, strict=True):
            if suspect.effect.filed == "damping.linear":
                coupled[:, *matrix_place(suspect)] += theta[:met] @ columns[:, 0]
        return braking_holds(self.vehicle.free > 0, braking, coupled)

    def stands(self, model: Model, beside: Model) -> bool:
        """Whether a refit may stand: it ended, its numbers mean something, and its damping brakes.

        The latter on those axes where that of the model it was refitted from does: a cause that turns the
        file's damping into a push only undoes what the log contradicts in another way.
        """
        if not np.isfinite(model.cost) or not self.sound(model):
            return False
        return bool((self.brakes(model) | ~self.brakes(beside)).all())

    def with_member(self, model: Model, member: Member, value: np.ndarray) -> Model:
        """The model with one member more, its parameters at `value` minus neutral."""
        return dataclasses.replace(
            model,
            members=(*model.members, member),
            z=np.concatenate([model.z, value]),
            cost=np.inf,
        )

    def with_other(self, model: Model, which: int, member: Member, value: np.ndarray) -> Model:
        """The model with one member in the place of another."""
        where = self.slices(model.members)[which]
        members = tuple(member if i == which else m for i, m in enumerate(model.members))
        z = np.concatenate([model.z[: where.start], value, model.z[where.stop :]])
        return dataclasses.replace(model, members=members, z=z, cost=np.inf)

    def without_member(self, model: Model, which: int) -> Model:
        where = self.slices(model.members)[which]
        members = tuple(m for i, m in enumerate(model.members) if i != which)
        return dataclasses.replace(model, members=members, z=np.delete(model.z, where), cost=np.inf)

    def screen(self, model: Model) -> Reduced:
        """Reduced statistics of every parameter of the catalogue at the model, then of members that begin.

        Of each group of windows; of each window, where there are not many. Beside a disturbance the
        chi-square is minus twice the logarithm of the likelihood of each given all before it. Raises
        `InputError` where the vehicle runs away along the logs.
        """
        found = self.screening(model)[1] if model.beside is None else self._innovated(model)
        if not np.isfinite(found.h).all():
            raise runaway(self.data.logs[0].name, self.vehicle.name)
        return found

    def _innovated(self, model: Model) -> Reduced:
        """The statistics of `screen` beside a disturbance."""
        assert model.beside is not None
        problem = self.problem(model.members, self.fine.problem)
        groups = jnp.asarray(self.fine.group)
        found = innovations(
            problem,
            self._every_column(model),
            model.beside.force,
            model.beside.path,
            groups,
            self._most_groups,
            width=SLOTS,
        )
        count = len(self.group_windows)
        of = self.fine.group[: self.fine.count]
        first = np.flatnonzero(np.diff(of, prepend=-1))
        return Reduced(
            np.add.reduceat(np.asarray(found.minus_twice)[: self.fine.count], first),
            np.add.reduceat(np.asarray(found.g)[: self.fine.count], first, axis=0),
            np.asarray(found.h)[:count],
        )

    def _own_columns(self, model: Model) -> np.ndarray:
        """The model's z and the knots among the columns of a screening."""
        known, _, _ = self.known(model)
        more = 6 * self.knots
        out = np.zeros((len(known) + more, known.shape[1] + more))
        out[: len(known), : known.shape[1]] = known
        out[len(known) :, known.shape[1] :] = np.eye(more)
        return out

    def _every_column(self, model: Model) -> Affine:
        """From every parameter of the catalogue, then of members that begin, to those of each segment."""
        size, own = self.layout.size, self.affine(model.members)
        columns = np.zeros((size, size + BEGUN))
        columns[:, :size] = np.eye(size)
        acts = np.ones((SEGMENTS, size + BEGUN))
        at = size
        for member, where in zip(model.members, self.slices(model.members), strict=True):
            if member.since is not None:
                width = where.stop - where.start
                columns[:, at : at + width] = own.columns[:, where]
                acts[:, at : at + width] = own.acts[:, where]
                at += width
        return Affine(jnp.asarray(self.theta(model)), jnp.asarray(columns), jnp.asarray(acts))

    def screening(self, model: Model) -> tuple[Any, Reduced]:
        """The statistics of groups, and those of `screened` where the windows lie.

        The last one is kept: screening and missing wrench are commonly asked of the same model.
        """
        if self._screened is None or self._screened[0] is not model:
            self._screened = None
            found = self.keeper.keep(self, screened, model)
            self._screened = (model, found, joined(self.keeper.each(self, of_groups, found)))
        return self._screened[1:]

    def screened(self, model: Model) -> tuple[Reduced, Reduced]:
        """Statistics of `screen` of groups of windows, and of each at the knots, beside white noise."""
        size, affine = self.layout.size, self._every_column(model)
        asked = self._own_columns(model)
        room = np.zeros((len(asked), SLOTS + 6 * self.knots))
        room[:, : asked.shape[1]] = asked
        found = _screening(
            self.problem(model.members),
            affine,
            model.delta,
            self.knots,
            jnp.asarray(room),
            jnp.asarray(self._groups),
            self._most_groups,
        )
        chi2, g = np.asarray(found.chi2)[: self.count], np.asarray(found.g)[: self.count]
        first, n, width = self.group_windows, size + BEGUN, asked.shape[1]
        groups = Reduced(
            np.add.reduceat(chi2, first),
            np.add.reduceat(g[:, :n], first, axis=0),
            np.asarray(found.h)[: len(first)],
        )
        # Without the room that was not taken, whose rows are the last.
        row, column = np.tril_indices(width)
        pairs = np.asarray(found.h_own)[: self.count, : len(row)]
        h = np.empty((self.count, width, width))
        h[:, row, column] = h[:, column, row] = pairs
        return groups, Reduced(chi2, g @ asked, h)

    def check(self, model: Model) -> Check | None:
        """What the logs tell of the file's coefficients, at the model; None of logs that lie elsewhere."""
        if isinstance(self.data, Outline):
            return None
        model = self.undisturbed(model)
        z, task = self._padded(model.z), self.task(model)
        # One step leaves the statistics where it began.
        refined = refine_windows(task, jnp.asarray(z), model.delta, 1)
        names = [coefficient_name(c.kind, DOFS[c.place[0]]) for c in self.base if c.diagonal]
        return evaluated(self.vehicle, self.data.logs, task, refined, names, self.data.length)

    def known(self, model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Columns (in the screening's order) that the model already has; prior precision; z."""
        size = self.layout.size
        columns = np.zeros((size + BEGUN, len(model.z)))
        for j, coefficient in enumerate(self.base):
            columns[coefficient.index, j] = 1.0
        at = size
        for member, where in zip(model.members, self.slices(model.members), strict=True):
            if member.since is None:
                columns[:size, where] = self.layout.columns[member.suspect]
            else:
                width = where.stop - where.start
                columns[at : at + width, where] = np.eye(width)
                at += width
        return columns, self._precision(model), model.z

    def own(self, suspect: int) -> np.ndarray:
        """A suspect's columns in the screening's order."""
        columns = self.layout.columns[suspect]
        return np.concatenate([columns, np.zeros((BEGUN, columns.shape[1]))])


# --- what a keeper does where the windows lie ----------------------------------------------------


def remade(bench: Workbench, other: dict[str, Any]) -> Workbench:
    """The workbench but for some arguments of its constructor; programs there have room of their own."""
    return bench._like(**{name: value for name, value in other.items() if name != "room"})


def as_measured(bench: Workbench) -> Float[Array, "windows 12"]:
    """Changes of the windows' initial states: none."""
    return jnp.zeros((bench.room.windows, 12))


def as_some(few: Workbench, bench: Workbench, step: int, model: Model) -> Float[Array, "windows 12"]:
    """Those of a model for the windows that are in `few` (`Workbench.every`)."""
    delta = np.zeros((few.room.windows, 12))
    delta[: few.count] = np.asarray(model.delta)[: bench.count][bench.which(step)]
    return jnp.asarray(delta)


def seen_in(bench: Workbench, step: int) -> Int[np.ndarray, " channels"]:
    """How many numbers of each channel were measured in some of the windows (`Workbench.every`)."""
    return seen_of(np.asarray(bench.cut.windows.weight)[bench.which(step)])


def squares_along(
    bench: Workbench, direction: Float[np.ndarray, "directions 3"]
) -> Float[np.ndarray, " directions"]:
    """Sum of the squares of the velocities along some directions with which windows begin [m²/s²]."""
    velocity = np.asarray(bench.cut.windows.velocity)[:, :3]
    return ((velocity @ direction.T) ** 2).sum(axis=0)


def largest_in(bench: Workbench) -> Float[np.ndarray, " columns"]:
    """The largest command of each column, 0 where it has none."""
    return largest_commands(bench.vehicle, bench.data.logs)


def placed_in(bench: Workbench, count: int, largest: Float[np.ndarray, " columns"]) -> PlacedAt:
    """Where so many knots in each window lie and what was measured there."""
    return placed_at(bench.vehicle, bench.cut, bench.part.first, count, largest)


def screened(bench: Workbench, model: Model) -> tuple[Reduced, Reduced]:
    return bench.screened(model)


def of_groups(bench: Workbench, found: tuple[Reduced, Reduced]) -> Reduced:
    del bench
    return found[0]


def _starts(seen: Int[np.ndarray, " channels"], vehicle: Vehicle) -> int:
    """Numbers of a window's start that its samples determine: they take as many degrees of freedom.

    Of each axis its velocity, where anything of it is measured, and its position where that is; `seen`: how
    many numbers of each channel were measured.
    """
    measured = np.flatnonzero(seen)
    seen = np.array(AXES)[measured]
    placed = seen[measured < POSES.stop]
    return sum((axis in placed) + (axis in seen) for axis in vehicle.axes)


def _grouped(log: Int[np.ndarray, " windows"], windows: int) -> Int[np.ndarray, " windows"]:
    """The group of each window: as many in a row of a log as make no more than `GROUPS` in all, or a few.

    - `windows`: how many there are with those that lie elsewhere.
    """
    size = -(-windows // GROUPS)
    number = np.arange(len(log)) - np.searchsorted(log, log)
    return np.cumsum(np.diff(log, prepend=log[0]).astype(bool) | (number % size == 0)) - 1


def filled(rows: np.ndarray) -> np.ndarray:
    """One row per segment that the programs have, the last one repeated."""
    return np.concatenate([rows, np.repeat(rows[-1:], SEGMENTS - len(rows), axis=0)])


def same_log(a: Log, b: Log) -> bool:
    """Whether two logs are of the same channels and values."""
    return a.channels.shape == b.channels.shape and bool(
        np.array_equal(a.channels, b.channels, equal_nan=True)
    )


@compiled
def _screening(problem, affine, delta, knots: int, own, group, groups: int):
    return screening(problem, affine, delta, knots, own, group, groups)
