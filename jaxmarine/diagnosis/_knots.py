"""The missing wrench: a free force on the hull, piece by piece in time, and what it depends on.

Any wrench that the model lacks is a combination of the knots' columns, so their statistics answer every
question about it by linear algebra: how large it is over time, on which signals it depends, whether it
swings with a period. No hypothesis needs a simulation of its own.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..fitting import (
    Disturbance,
    estimated,
    free_wrench,
    improbability,
    innovations,
    path_lines,
)
from ._explanation import Beside, Model
from ._result import MissingWrench
from ._score import AbstractStatistics, Reduced, joined, rows, solve, totals
from ._signals import Places
from ._workbench import Workbench

# Waves are looked for over this much of a log [s]: swell is hardly in step with itself for longer.
COHERENT = 1800.0
# Shapes of a wrench fill the programs up to a multiple of this.
SHAPES = 64


def on_axis(
    axis: int, values: Float[np.ndarray, "windows knots features"]
) -> Float[np.ndarray, "windows knots 6 features"]:
    """Wrenches that take the given values on one axis and are zero on all others."""
    out = np.zeros((*values.shape[:2], 6, values.shape[2]))
    out[:, :, axis] = values
    return out


@dataclasses.dataclass(frozen=True)
class Knots:
    """Statistics of the known parameters and the knots, and where the knots lie.

    - `stats`: columns are the model's z, then knots times six axes.
    - `precision`, `offset`: prior of z; `free` [6].
    - `lost`: nats by which the logs are less likely amid these, where nothing is missing, than at best.
    """

    stats: AbstractStatistics
    width: int
    precision: np.ndarray
    offset: np.ndarray
    free: np.ndarray
    places: Places
    lost: float = dataclasses.field(default=0.0, kw_only=True)

    @property
    def chi2(self) -> Float[np.ndarray, " windows"]:
        """Of each window."""
        return rows(self.stats.each(_chi2))

    @property
    def given(self) -> Places:
        """Where wrenches are given that are `summed`."""
        return self.places

    def summed(self, values: Float[np.ndarray, "windows knots 6 features"]) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and information, over all windows, of z and of wrenches with these values."""
        g, h = totals(self.stats.each(_summed, self.width, along=(values,)))
        return g, h

    def where(self, step: Float[np.ndarray, " z"], wrench: Float[np.ndarray, "windows knots 6"]) -> "Knots":
        """Beside the disturbance that suits the logs where a wrench acts, which had stood in for it, if any.

        - `step`: of z that goes with the wrench; z is left as it is.
        """
        return self

    def beside(self, values: Float[np.ndarray, "windows knots 6 features"], share: float) -> "Knots":
        """The statistics once wrenches with these values may act, each as often as a prior `share` allows.

        The known numbers give way to them (one step of the linearised chi-square).
        """
        n = self.width
        g, h = self.summed(values)
        h += np.diag(np.concatenate([self.precision, np.full(values.shape[-1], share**-2)]))
        g[:n] += self.precision * self.offset
        step = -solve(h, g)
        push = (values @ step[n:]).reshape(len(values), -1)
        after = self.stats.keep(_pushed, step[:n], along=(push,))
        return dataclasses.replace(self, stats=after, offset=self.offset + step[:n])


def _chi2(stats: Reduced) -> Float[np.ndarray, " windows"]:
    return stats.chi2


def _summed(
    stats: Reduced, values: Float[np.ndarray, "windows knots 6 features"], n: int
) -> tuple[np.ndarray, np.ndarray]:
    """`Knots.summed` over the windows of one place, of which z is the first `n` columns."""
    flat = values.reshape(len(values), values.shape[1] * 6, values.shape[-1])
    g, h = stats.g, stats.h
    h_zk = np.tensordot(np.swapaxes(h[:, :n, n:], 1, 2), flat, ((0, 1), (0, 1)))
    h_kk = np.tensordot(flat, h[:, n:, n:] @ flat, ((0, 1), (0, 1)))
    g_k = np.tensordot(g[:, n:], flat, 2)
    h = np.block([[h[:, :n, :n].sum(0), h_zk], [h_zk.T, h_kk]])
    return np.concatenate([g[:, :n].sum(0), g_k]), h


def _pushed(
    stats: Reduced, push: Float[np.ndarray, "windows knotted"], step: Float[np.ndarray, " z"]
) -> Reduced:
    """The statistics after a step of z and wrenches at the knots."""
    moved = np.concatenate([np.broadcast_to(step, (len(push), len(step))), push], axis=1)
    bent = (stats.h @ moved[..., None])[..., 0]
    chi2 = stats.chi2 + ((2 * stats.g + bent) * moved).sum(axis=1)
    return Reduced(chi2, stats.g + bent, stats.h)


@dataclasses.dataclass(frozen=True)
class KnotsBeside(Knots):
    """Knots beside a model's disturbance, which remembers for longer than a window what pushed in it.

    So wrenches are summed over all windows at once, each given all before it, and not by `stats`, which are
    those beside the disturbance that was estimated first. They are given at every sample, from which they are
    held to the next: within a knot a command already answers the force that acts in it.
    """

    bench: Workbench
    model: Model

    @property
    def disturbance(self) -> Disturbance:
        assert self.model.beside is not None
        return self.model.beside.force

    @property
    def given(self) -> Places:
        """Every sample, as of `Workbench.expected`."""
        return _through_water(self.bench, self.model, self.bench.expected(self.model))

    def summed(
        self, values: Float[np.ndarray, "windows samples 6 features"]
    ) -> tuple[np.ndarray, np.ndarray]:
        return with_shapes(self.bench, self.model, values)

    def where(
        self, step: Float[np.ndarray, " z"], wrench: Float[np.ndarray, "windows samples 6"]
    ) -> "KnotsBeside":
        model, lost = beside_wrench(self.bench, self.model, step, wrench)
        return dataclasses.replace(self, model=model, lost=self.lost + lost)


def knots(bench: Workbench, model: Model) -> Knots:
    """The knots' statistics at a model, beside its disturbance, where it has one."""
    known, precision, offset = bench.known(model)
    places = _through_water(bench, model, bench.places)
    own = at_knots(bench, model), known.shape[1], precision, offset, bench.vehicle.free, places
    return Knots(*own) if model.beside is None else KnotsBeside(*own, bench, model)


def _through_water(bench: Workbench, model: Model, places: Places) -> Places:
    """As forces on the hull depend on velocities: through the water, where that is known to move."""
    signals = places.through_water(bench.water(model), places.signals)
    return dataclasses.replace(places, signals=signals)


def at_knots(bench: Workbench, model: Model) -> AbstractStatistics:
    """Of each window, for z, then for a free wrench on the hull in each of `knots` parts of a window.

    Beside a disturbance what is left of the latter, and of the chi-square, once it is filtered out.
    """
    if model.beside is None:
        return bench.keeper.of_windows(bench, bench.screening(model)[0])
    problem, affine = bench.along(model)
    parts = bench.fine.parts
    group = jnp.arange(bench.room.windows * parts) // parts
    found = free_wrench(
        problem,
        affine,
        model.beside.force,
        model.beside.path,
        bench.knots // parts,
        parts,
        group,
        bench.room.windows,
    )
    given, width = affine.acts.shape[1], len(model.z)
    kept = np.concatenate([np.arange(width), given + np.arange(6 * bench.knots + 1)])
    h = np.asarray(found)[: bench.count][:, kept[:, None], kept]
    return Reduced(h[:, -1, -1], h[:, :-1, -1], h[:, :-1, :-1])


def with_shapes(
    bench: Workbench, model: Model, shapes: Float[np.ndarray, "windows samples 6 shapes"]
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and information of z, then of the sizes of wrenches of given shapes at the samples.

    Beside the model's disturbance, over all windows, each given all before it.
    """
    assert model.beside is not None
    problem, affine = bench.along(model)
    count = shapes.shape[-1]
    fill = SHAPES * -(-max(count, 1) // SHAPES) - count
    room = _of_parts(bench, np.pad(shapes, [(0, 0)] * 3 + [(0, fill)]))
    group = jnp.asarray(np.arange(len(room)) >= bench.fine.count, int)
    found = innovations(problem, affine, model.beside.force, model.beside.path, group, 1, room)
    kept = np.concatenate([np.arange(len(model.z)), affine.acts.shape[1] + np.arange(count)])
    g = np.asarray(found.g)[: bench.fine.count].sum(axis=0)
    return g[kept], np.asarray(found.h)[0][kept[:, None], kept]


def beside_wrench(
    bench: Workbench,
    model: Model,
    step: Float[np.ndarray, " z"],
    wrench: Float[np.ndarray, "windows samples 6"],
) -> tuple[Model, float]:
    """The model beside the disturbance that suits the logs after a step of z with a wrench at the samples.

    And the nats by which they are less likely beside it as the model is, without either.
    """
    assert model.beside is not None
    beside, unit = model.beside, bench.fine.unit
    without, spread = bench.lines(model), bench.spread
    problem, affine = bench.along(dataclasses.replace(model, z=model.z + step))
    every = path_lines(problem, affine, beside.force, beside.path, _of_parts(bench, wrench))
    force, learned, _ = estimated(spread, every, beside.force, unit, beside.covariance)
    now = dataclasses.replace(model, beside=Beside(force, beside.path, learned), cost=np.inf)
    before, after = improbability(spread, without, [beside.force, force], unit)
    return now, 0.5 * float(after - before)


def _of_parts(bench: Workbench, at_samples: Float[np.ndarray, "windows samples *values"]) -> Array:
    """What is given at the samples of whole windows, for the windows cut up, then zeros."""
    most, steps = bench.fine.problem.windows.step.shape
    cut_up = at_samples.reshape(bench.fine.count, steps, *at_samples.shape[2:])
    return jnp.asarray(np.pad(cut_up, [(0, most - len(cut_up))] + [(0, 0)] * (cut_up.ndim - 1)))


def missing_wrench(k: Knots) -> MissingWrench:
    """The missing wrench over time with its standard deviation, each window by itself.

    A weak pull to zero (by a fiftieth of the information) keeps neighbouring knots that the window
    cannot tell apart from running against each other.
    """
    count = k.places.t.shape[1]
    parts = k.stats.each(_missing, k.width, count, np.flatnonzero(k.free))
    wrench, std = map(rows, zip(*parts, strict=True))
    return MissingWrench(
        log=np.repeat(k.places.log, count),
        t=k.places.t.ravel(),
        wrench=wrench.reshape(-1, 6),
        std=std.reshape(-1, 6),
        velocity=k.places.velocity.reshape(-1, 6),
    )


def _missing(
    stats: Reduced, n: int, count: int, free: Int[np.ndarray, " axes"]
) -> tuple[Float[np.ndarray, "windows knots 6"], Float[np.ndarray, "windows knots 6"]]:
    """`missing_wrench` of the windows of one place and its standard deviation, `count` knots in each."""
    windows = len(stats.g)
    wrench = np.full((windows, count, 6), np.nan)
    std = np.full((windows, count, 6), np.nan)
    index = (np.arange(count)[:, None] * 6 + free).ravel()
    for w in range(windows):
        h = stats.h[w][n:, n:][np.ix_(index, index)]
        g = stats.g[w][n:][index]
        scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
        cov = np.linalg.inv(h / np.outer(scale, scale) + 0.02 * np.eye(len(h))) / np.outer(scale, scale)
        wrench[w][:, free] = (-cov @ g).reshape(count, -1)
        std[w][:, free] = np.sqrt(np.diag(cov)).reshape(count, -1)
    return wrench, std


def _some(stats: Reduced, which: Bool[np.ndarray, " windows"]) -> Reduced:
    """The statistics of some windows."""
    return Reduced(stats.chi2[which], stats.g[which], stats.h[which])


def wave_start(k: Knots) -> tuple[float, dict[str, float]]:
    """What a swinging force of the best period would save, and its parameters to start a fit from.

    Along the longest log, as a phase means nothing in another one. Periods are as dense as the log tells them
    apart; of a very long log its beginning is enough.
    """
    longest = max(np.unique(k.places.log), key=lambda i: np.ptp(k.places.t[k.places.log == i]))
    t = k.places.t
    begin = t[k.places.log == longest].min()
    here = (k.places.log == longest) & (t[:, 0] <= begin + COHERENT)
    t, span = t[here], np.ptp(t[here])
    knot = float(np.median(np.diff(t, axis=1)))
    slowest = min(2.0 / span, 1.0 / (8 * knot))
    frequencies = np.arange(slowest, 1.0 / (4 * knot), 0.3 / span)
    n, count, stats = k.width, t.shape[1], joined(k.stats.each(_some, along=(here,)))
    h_z = stats.h[:, :n, :n].sum(0) + np.diag(k.precision)
    g_z = stats.g[:, :n].sum(0) + k.precision * k.offset
    inverse = solve(h_z, np.eye(n))
    pulled = inverse @ g_z
    # Of forces to the north and to the east at each knot.
    axes = np.swapaxes(k.places.rotation[here], 2, 3)[..., :2]
    by_axis = np.ascontiguousarray(stats.g[:, n:]).reshape(len(t), count, 6)[..., :3]
    g = np.einsum("wkj,wkja->wka", by_axis, axes)
    by_axis = np.ascontiguousarray(stats.h[:, :n, n:]).reshape(len(t), n, count, 6)[..., :3]
    cross = np.einsum("wnkj,wkja->wnka", by_axis, axes)
    by_axis = np.ascontiguousarray(stats.h[:, n:, n:]).reshape(len(t), count, 6, count, 6)[:, :, :3, :, :3]
    own = np.einsum("wkilj,wkia,wljb->wkalb", by_axis, axes, axes, optimize=True)
    best = (-np.inf, {})
    for frequency in frequencies:
        angle = 2 * np.pi * frequency * t
        swing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        across = np.einsum("wnka,wks->nas", cross, swing, optimize=True).reshape(n, 4)
        own_h = np.einsum("wkalb,wks,wlr->asbr", own, swing, swing, optimize=True).reshape(4, 4)
        own_g = np.einsum("wka,wks->as", g, swing).ravel() - across.T @ pulled
        step = -solve(own_h - across.T @ inverse @ across, own_g)
        saved = float(-own_g @ step)
        if saved > best[0]:
            best = saved, in_phase(step.reshape(2, 2), float(1.0 / frequency))
    return best


def in_phase(parts: Float[np.ndarray, "2 2"], period: float) -> dict[str, float]:
    """Parameters of a wave from what a force to the north and to the east has of sine and cosine of time.

    With one phase for both axes: the direction in which those parts are largest.
    """
    _, _, direction = np.linalg.svd(parts)
    phase = float(np.arctan2(direction[0, 1], direction[0, 0]))
    size = parts @ direction[0]
    if not -np.pi / 2 < phase <= np.pi / 2:
        phase, size = phase - np.copysign(np.pi, phase), -size
    return {"north": float(size[0]), "east": float(size[1]), "period": period, "phase": phase}
