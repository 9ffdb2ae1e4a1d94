"""What is free in a fit: the leaves that the caller names, as one flat vector of raw numbers.

Raw numbers are unconstrained. Each freed leaf has a part that makes the leaf from its own raw
numbers: `Entries` takes them as they are, `Inertia` and `Dissipative` keep a matrix positive.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from .._errors import InputError
from .._types import DOFS, Matrix6
from ..effects import JOINED, HullLift, TurningLift
from ..vehicle import Plant, Vehicle

Selection = Literal["all", "nonzero", "diagonal", "coupled"]
Select = Callable[[Vehicle], Any]

# Damping that brakes by this share in a second (at 1 m/s or rad/s): the size of an entry whose axis
# has none in the file.
_BRAKING = 0.2
# Share of an axis' total inertia below which a fitted one fades out instead of becoming negative, and the
# share at which an added mass of zero begins.
_SOFT, _NOTHING = 0.02, 0.01
# Leaves of numbers that are positive by what they are; of actuators, which say theirs, see `_is_positive`.
_THRUSTS = ("thrusters.max_thrust", "thrusters.max_thrust_reverse")
# Which key of a file's table `[prior]` speaks of a leaf; of actuators and lift see `_section`.
PRIOR_KEYS = {
    "added_mass": "added_mass",
    "damping.linear": "linear",
    "damping.quadratic": "quadratic",
    **dict.fromkeys(_THRUSTS, "thrust"),
}
# Of a hull's lift, the power of its length that makes a mass the parameter.
_LIFTS = {"Y_uv": -1, "Z_uw": -1, "N_uv": 0, "M_uw": 0, "Y_ur": 0, "N_ur": 1}
# Share of its typical size at which damping on a diagonal begins that is zero in the file: no log shows it.
_NEAR_NOTHING = 1e-3
# A dissipative matrix starts with at least this share of its size in every direction, because its
# factor has no slope at zero.
_FLOOR = 1e-2


class AbstractPart(eqx.Module):
    """Makes one leaf of the vehicle from its own raw numbers; as many entries as raw numbers."""

    start: eqx.AbstractVar[Float[Array, " own"]]
    names: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def __call__(self, raw: Float[Array, " own"]) -> Array:
        """The leaf."""

    @abc.abstractmethod
    def entries(self, raw: Float[Array, " own"]) -> Float[Array, " own"]:
        """The freed entries of the leaf, in its own units, in the order of `names`."""


class Entries(AbstractPart):
    """A leaf whose entries are the raw numbers themselves: leaf = base + spread @ raw, flat.

    `spread` has one column per number: one 1 for an entry, several where one number acts on
    several thrusters.
    """

    start: Float[Array, " own"]
    base: Array
    spread: Float[Array, "size own"]
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, raw: Float[Array, " own"]) -> Array:
        return self.base + (self.spread @ raw).reshape(self.base.shape)

    def entries(self, raw: Float[Array, " own"]) -> Float[Array, " own"]:
        return raw


class Magnitudes(AbstractPart):
    """A leaf of numbers that keep their sign where they start positive, by their logarithms; others as they
    are.

    A thrust does not turn round, and damping on a diagonal brakes. `base` holds what is not free; `places`:
    of the free entries in the flat leaf; `positive`: which of them go by their logarithm. `soft`: where it is
    not zero, an entry begins there and fades out to zero instead of becoming negative.
    """

    start: Float[Array, " own"]
    base: Array
    soft: Float[Array, " own"]
    names: tuple[str, ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    positive: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, raw: Float[Array, " own"]) -> Array:
        flat = self.base.ravel().at[np.array(self.places, int)].set(self.entries(raw))
        return flat.reshape(self.base.shape)

    def entries(self, raw: Float[Array, " own"]) -> Float[Array, " own"]:
        positive, fades = np.array(self.positive, bool), self.soft > 0.0
        own = jnp.where(fades, _faded(raw, jnp.where(fades, self.soft, 1.0)), raw)
        return jnp.where(positive, jnp.exp(jnp.where(positive, raw, 0.0)), own)


def _faded(raw: Array, soft: Array) -> Array:
    """The raw number where it is far above `soft`, a positive one that fades out where it is below."""
    root = jnp.sqrt(raw**2 + 4.0 * soft**2)
    # The same twice: a difference of large numbers would leave their rounding.
    return jnp.where(raw > 0.0, (raw + root) / 2.0, 2.0 * soft**2 / (root - raw))


class Inertia(AbstractPart):
    r"""Added mass or rigid-body matrix that stays positive, and with it the total mass.

    The leaf is a positive definite matrix $L L^T$ on the free entries beside what is held. `L` is lower
    triangular; its diagonal is the root of a hyperbola over the raw numbers x,
    $L_{ii}^2 = (x_i + \sqrt{x_i^2 + 4 s_i^2}) / 2$: far above s_i (`soft`) the raw number is the inertia
    itself, so that a normal prior on it is one on the inertia; below, it fades out and never becomes
    negative. `rest` is R in $M_{RB} + M_A = R + L L^T$: all that is held, `other` the summand that is not
    free.

    After Pinheiro and Bates (1996), Statistics and Computing 6, 289-296, a hyperbola for their logarithm.
    """

    start: Float[Array, " own"]
    leaf: Matrix6
    other: Float[Array, "axes axes"]
    rest: Float[Array, "axes axes"]
    soft: Float[Array, " axes"]
    names: tuple[str, ...] = eqx.field(static=True)
    axes: tuple[int, ...] = eqx.field(static=True)
    lower: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """The entries among the free axes."""
        return self.lower

    def __call__(self, raw: Float[Array, " own"]) -> Matrix6:
        rows, columns = np.array(self.lower).T
        soft = self.soft[rows]
        diagonal = jnp.sqrt(_faded(raw, soft))
        factor = jnp.zeros_like(self.rest)
        factor = factor.at[rows, columns].set(jnp.where(rows == columns, diagonal, raw))
        total = self.rest + factor @ factor.T
        return self.leaf.at[np.ix_(self.axes, self.axes)].set(total - self.other)

    def entries(self, raw: Float[Array, " own"]) -> Float[Array, " own"]:
        rows, columns = np.array(self.axes)[np.array(self.pairs)].T
        return self(raw)[rows, columns]


class Dissipative(AbstractPart):
    r"""A damping matrix whose symmetric part stays positive semidefinite.

    $D = R + L L^T + K$ on the free axes, `L` lower triangular, `K` skew. Linear damping then takes
    energy at every velocity; for quadratic damping, on the elementwise |nu| nu, that follows only
    where the matrix is diagonal.
    """

    start: Float[Array, " own"]
    leaf: Matrix6
    rest: Float[Array, "axes axes"]
    names: tuple[str, ...] = eqx.field(static=True)
    axes: tuple[int, ...] = eqx.field(static=True)
    lower: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @property
    def _skew(self) -> tuple[tuple[int, int], ...]:
        return tuple((i, j) for i, j in self.lower if i != j)

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """The entries among the free axes."""
        return *self.lower, *((j, i) for i, j in self._skew)

    def __call__(self, raw: Float[Array, " own"]) -> Matrix6:
        rows, columns = np.array(self.lower).T
        factor = jnp.zeros_like(self.rest).at[rows, columns].set(raw[: len(self.lower)])
        skew = jnp.zeros_like(self.rest)
        if self._skew:
            rows, columns = np.array(self._skew).T
            skew = skew.at[rows, columns].set(raw[len(self.lower) :])
        matrix = self.rest + factor @ factor.T + skew - skew.T
        return self.leaf.at[np.ix_(self.axes, self.axes)].set(matrix)

    def entries(self, raw: Float[Array, " own"]) -> Float[Array, " own"]:
        rows, columns = np.array(self.axes)[np.array(self.pairs)].T
        return self(raw)[rows, columns]


class Freed(eqx.Module):
    """The vehicle as a function of the raw numbers of everything that is free."""

    vehicle: Vehicle
    parts: tuple[AbstractPart, ...]
    places: tuple[int, ...] = eqx.field(static=True)

    @property
    def start(self) -> Float[Array, " raw"]:
        return jnp.concatenate([part.start for part in self.parts])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.names)

    def _split(self, raw: Float[Array, " raw"]) -> list[Array]:
        ends = np.cumsum([part.start.size for part in self.parts])
        return jnp.split(raw, ends[:-1])

    def __call__(self, raw: Float[Array, " raw"]) -> Vehicle:
        leaves, structure = jax.tree.flatten(self.vehicle)
        for place, part, own in zip(self.places, self.parts, self._split(raw), strict=True):
            leaves[place] = part(own)
        return jax.tree.unflatten(structure, leaves)

    def entries(self, raw: Float[Array, " raw"]) -> Float[Array, " raw"]:
        """The freed entries in their own units, in the order of `names`."""
        own = self._split(raw)
        return jnp.concatenate([p.entries(o) for p, o in zip(self.parts, own, strict=True)])


class FreedPlant(eqx.Module):
    """`plant_of` for `Problem`: raw numbers to the plant of a segment.

    - `gates` [segments, placed]: which of the vehicle's own effects act in a segment.
    """

    freed: Freed
    gates: Float[Array, "segments placed"]

    def __call__(self, theta: Float[Array, " raw"], segment) -> Plant:
        return self.freed(theta).plant(self.gates[segment])


@dataclasses.dataclass(frozen=True)
class Scales:
    """Per freed entry: a typical `size`, and the standard deviation of its `prior` (inf: none).

    `known` says whether the size means something, or stands for an effect that may be of any size.
    """

    size: Float[np.ndarray, " raw"]
    prior: Float[np.ndarray, " raw"]
    known: Bool[np.ndarray, " raw"]


def set_free(
    vehicle: Vehicle,
    free: Select,
    prior: float | PyTree | None = None,
    entries: Selection = "all",
    dissipative: bool = False,
    linear: bool = False,
    spreads: Mapping[str, float] = MappingProxyType({}),
    without: Sequence[int] = (),
) -> tuple[Freed, Scales]:
    """What `free` names, as a function of raw numbers, and the scales of its entries.

    - `prior`: width relative to the start (of an inertia: to the total; of an entry that is zero:
      to its typical size, which is 1 of what is no matrix, such as `thrusters.quadratic`, and none of an
      effect of the catalogue), or standard deviations in the structure of `free(vehicle)`: 0 holds an
      entry, inf leaves it without prior. Between two axes the typical size is the geometric mean of their
      diagonals, of an inertia in total: a matrix that is positive has less there, and a hull whose centre
      lies a tenth of its length off a third of it, as its moment of inertia is about mass times length² / 12.
    - `entries`: of 6x6 matrices all, those that are not zero, the diagonal, or with it what couples axes
      in a hull that is alike on port and starboard; never those of locked axes.
    - `linear`: inertia is symmetric, but not held positive, so that all entries enter linearly.
    - `spreads`: widths by keys of a file's table `[prior]`, which go before a number for `prior`; of an added
      mass relative to itself, of one that is zero to the total.
    - `without`: places of leaves that are left as they are, whatever `free` says.
    """
    places, paths = named_leaves(vehicle, free)
    leaves = jax.tree.leaves(vehicle)
    names = [jax.tree_util.keystr(path).lstrip(".") for path in paths]
    if {"added_mass", "body.matrix"} <= set(names):
        raise ValueError("Free `added_mass` or `body.matrix`: a log shows only their sum.")
    stds = stated_widths(prior, [leaves[place] for place in places], free, vehicle)
    number = float(prior) if isinstance(prior, float | int) else None
    fitted = [i for i, place in enumerate(places) if place not in without and np.size(leaves[place])]
    found = []
    for place, path, name, std in ((places[i], paths[i], names[i], stds[i]) for i in fitted):
        stated = spreads.get(_section(vehicle, path, name)) if prior is None or number is not None else None
        asked = _Asked(path, name, leaves[place], std, number if stated is None else stated)
        if name in ("added_mass", "body.matrix"):
            part, size, scale = _free_inertia(vehicle, asked, entries, linear)
            scale = size if stated is None else scale
        elif name in ("damping.linear", "damping.quadratic"):
            part, size = _free_damping(vehicle, asked, entries, dissipative, linear)
            scale = size
        else:
            positive = _is_positive(vehicle, path, name) and (asked.relative or _narrowed(path, std))
            part, size = (_free_magnitudes if positive else _free_others)(vehicle, asked)
            scale = size
        found.append((part, *_widths(vehicle, asked, part, size, scale)))
    if not sum(part.start.size for part, *_ in found):
        raise ValueError(
            "Argument `free` leaves nothing free: what it names is empty, held, or on axes that cannot move."
        )
    parts, *scales = zip(*found, strict=True)
    return Freed(vehicle, parts, tuple(places[i] for i in fitted)), Scales(*map(np.concatenate, scales))


class _Asked(NamedTuple):
    """A leaf that is to be free.

    - `std`: standard deviations of its entries, as of `stated_widths`; 0 holds one. `wide`: their width
      relative to a size, which goes before them; None where no number says it.
    """

    path: Any
    name: str
    leaf: Any
    std: Any
    wide: float | None

    @property
    def relative(self) -> bool:
        """Whether its width is relative to a number, and so one of its logarithm."""
        return self.wide is not None

    @property
    def held(self) -> np.ndarray:
        return np.asarray(self.std == 0.0)


def _free_inertia(vehicle: Vehicle, asked: _Asked, entries: Selection, linear: bool):
    """An inertia's part, the size of each entry, and what a width that the file states is relative to."""
    mask = _mask(vehicle, asked.leaf, entries, True) & ~asked.held
    make = functools.partial(_symmetric if linear else _inertia, vehicle)
    part = make(asked.name, np.asarray(asked.leaf), mask)
    flat, total = _places_of(part), np.diag(vehicle.mass_matrix)
    own = np.diag(np.asarray(asked.leaf))
    own = np.where(own > 0, own, total)
    size, scale = (np.sqrt(np.outer(one, one)).ravel()[flat] for one in (total, own))
    return part, size, scale


def _free_damping(vehicle: Vehicle, asked: _Asked, entries: Selection, dissipative: bool, linear: bool):
    """The part of a damping matrix, and the size of each entry."""
    leaf = np.asarray(asked.leaf)
    mask = _mask(vehicle, asked.leaf, entries, dissipative) & ~asked.held
    make = _dissipative if dissipative else _braking if asked.relative and not linear else _plain
    part = make(vehicle, asked.name, leaf, mask)
    return part, _damping_size(vehicle, leaf).ravel()[_places_of(part)]


def _free_magnitudes(vehicle: Vehicle, asked: _Asked):
    """The part of a leaf whose entries keep their sign, and the size of each."""
    name, leaf = asked.name, asked.leaf
    if name == "thrusters.max_thrust_reverse":
        # Where the file states none it is fitted by itself from there on.
        leaf = vehicle.thrusters.reverse
    flat, labels = np.flatnonzero(~asked.held), _labels(vehicle, name, np.asarray(leaf))
    labels = [labels[i] for i in flat]
    # Of thrust over the advance the first number alone has a sign of its own.
    may = flat % leaf.shape[-1] == 0 if leaf.ndim > 1 else np.ones(len(flat), bool)
    part = _magnitudes(np.asarray(leaf), flat, labels, may, np.zeros(len(flat)))
    size = np.abs(np.asarray(leaf).reshape(leaf.shape[0], -1))
    # One that is zero may be as large as the others of its curve.
    size = np.where(size > 0, size, size.max(axis=1, keepdims=True)).ravel()[flat]
    return part, np.where(size > 0, size, 1.0)


def _free_others(vehicle: Vehicle, asked: _Asked):
    """The part of any other leaf, and the size of each entry."""
    leaf = asked.leaf
    if asked.name == "thrusters.max_thrust_reverse":
        leaf = np.where(asked.held, leaf, vehicle.thrusters.reverse)
    part = _any_leaf(vehicle, asked.path, asked.name, np.asarray(leaf), asked.held)
    flat = _places_of(part)
    value = np.abs(np.asarray(leaf).ravel()[flat])
    usual = _usual(vehicle, asked.path, asked.name)
    if usual is not None:
        value = np.maximum(value, usual.ravel()[flat])
    return part, np.where(value > 0, value, 1.0)


def _widths(vehicle: Vehicle, asked: _Asked, part, size: np.ndarray, scale: np.ndarray):
    """Of each entry of a part its size, its width, and whether that size is known.

    - `scale`: what a relative width is relative to.
    """
    name, wide = asked.name, asked.wide
    width = asked.std.ravel()[_places_of(part)] if wide is None else wide * scale
    sure = np.full(len(size), not name.startswith("placed"))
    if wide is not None and isinstance(part, Magnitudes):
        # What fades begins where its slope is a half.
        width = np.where(np.asarray(part.soft) > 0.0, 0.5 * width, width)
    if wide is not None and name.startswith("placed") and _of_target(vehicle, asked.path)[0] is not None:
        nothing, typical = np.asarray(part.start) == 0.0, _typical(vehicle, asked.path)
        if typical is not None:
            size = np.where(nothing, typical, size)
            width, sure = wide * size, np.full(len(size), True)
        else:
            # An effect that changes nothing yet may be of any size; weights of a network may not.
            width = np.where(nothing, np.inf, width)
    if (width == 0).any():
        raise ValueError(
            f"`{name}`: an entry that the prior holds is coupled to free ones; give it a width too, or "
            "hold those as well."
        )
    return size, width, sure


def _section(vehicle: Vehicle, path, name: str) -> str:
    """The key of a file's table `[prior]` that speaks of a leaf; empty where none does."""
    if name.startswith("actuators["):
        return vehicle.actuators[path[1].idx].key
    if name.startswith("placed["):
        lifts = isinstance(vehicle.placed[path[1].idx].effect, HullLift | TurningLift)
        return "lift" if lifts else ""
    return PRIOR_KEYS.get(name, "")


def _is_positive(vehicle: Vehicle, path, name: str) -> bool:
    """Whether a leaf holds what is positive by what it is."""
    if name.startswith("actuators["):
        return name.split("].", 1)[1] in vehicle.actuators[path[1].idx].positive
    return name in _THRUSTS


def _narrowed(path, std: np.ndarray) -> bool:
    """Whether a leaf of actuators has a stated prior that is neither none nor all there is."""
    return path[0].name == "actuators" and bool((np.isfinite(std) & (std > 0.0)).any())


def _typical(vehicle: Vehicle, path) -> float | None:
    """How large a parameter of an effect commonly is on a craft of this mass and length, if that is known.

    Of a hull's lift the mass times the power of the length that its unit asks for, the length being four
    radii of gyration, as of ships: those of KVLCC2 are 0.1 to 0.4 of that, those of small boats about 1.
    """
    power = _LIFTS.get(path[-1].name)
    if power is None or not isinstance(vehicle.placed[path[1].idx].effect, HullLift | TurningLift):
        return None
    mass, inertia = float(vehicle.body.mass), np.diag(np.asarray(vehicle.body.matrix))[3:]
    return mass * (4.0 * np.sqrt(inertia.max() / mass)) ** power


def _usual(vehicle: Vehicle, path, name: str) -> np.ndarray | None:
    """How large the numbers of an actuator's leaf commonly are, if its kind knows that.

    Of thrust that is lost to the flow as much as leaves none at 1 m/s.
    """
    if name == "thrusters.advance_loss":
        return np.asarray(vehicle.thrusters.max_thrust)
    if path[0].name != "actuators":
        return None
    braking = np.diag(_damping_size(vehicle, np.asarray(vehicle.damping.quadratic)))
    return vehicle.actuators[path[1].idx].typical(braking).get(path[2].name)


class _Mark:
    """Stands for a leaf of the vehicle, to see which ones a selection takes."""

    def __init__(self, place: int):
        self.place = place


def named_leaves(vehicle: Vehicle, free: Select) -> tuple[list[int], list]:
    """Places of what `free` names among the leaves of the vehicle, and their paths."""
    paths, structure = jax.tree_util.tree_flatten_with_path(vehicle)
    try:
        chosen = jax.tree.leaves(free(structure.unflatten([_Mark(i) for i in range(len(paths))])))
    except (AttributeError, TypeError) as error:
        raise ValueError(
            f"Argument `free` must pick leaves as they are, such as `lambda v: v.damping.linear` ({error})."
        ) from error
    if not chosen or not all(isinstance(mark, _Mark) for mark in chosen):
        raise ValueError(
            "Argument `free` must return leaves of the vehicle, such as `lambda v: v.damping.linear`."
        )
    places = [mark.place for mark in chosen]
    if len(set(places)) < len(places):
        raise ValueError("Argument `free` names a leaf twice.")
    return places, [paths[place][0] for place in places]


def stated_widths(prior, leaves: list, free: Select, vehicle: Vehicle) -> list[np.ndarray]:
    """Standard deviations in the shape of each freed leaf; inf where no array states any."""
    shapes = [np.shape(leaf) for leaf in leaves]
    if prior is None or isinstance(prior, float | int):
        if prior is not None and not prior > 0:
            raise ValueError(f"Argument `prior` must be positive, but is {prior}.")
        return [np.full(shape, np.inf) for shape in shapes]
    structure = jax.tree.structure(free(vehicle))
    if jax.tree.structure(prior) != structure:
        raise ValueError(f"Argument `prior` must be as `free(vehicle)`, {structure}.")
    stds = [np.asarray(std, float) for std in jax.tree.leaves(prior)]
    if not all((std >= 0).all() for std in stds):
        raise ValueError("Argument `prior` holds a standard deviation that is negative or NaN.")
    return [np.broadcast_to(std, shape) for std, shape in zip(stds, shapes, strict=True)]


def _mask(vehicle: Vehicle, leaf, entries: Selection, symmetric: bool) -> np.ndarray:
    """Which entries of a 6x6 matrix are free."""
    free = vehicle.free.astype(bool)
    wanted = {
        "all": np.ones((6, 6), bool),
        "nonzero": np.asarray(leaf) != 0,
        "diagonal": np.eye(6, dtype=bool),
        "coupled": JOINED,
    }
    if entries not in wanted:
        raise ValueError(f"Argument `entries` must be one of {', '.join(wanted)}, not {entries!r}.")
    mask = wanted[entries]
    if symmetric:
        mask = mask | mask.T
    return mask & np.outer(free, free)


def _blocks(mask: np.ndarray) -> np.ndarray:
    """A symmetric pattern completed to full blocks, which a triangular factor keeps."""
    reach = mask & mask.T
    reach = reach & np.outer(reach.diagonal(), reach.diagonal())
    for _ in range(len(mask)):
        reach = reach | (reach.astype(int) @ reach.astype(int) > 0)
    return reach


def _remainder(matrix: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`matrix` = R + P with R positive semidefinite holding all outside the blocks, P within them.

    With O the outside and B the blocks, O + (1 - m) B is semidefinite for the least eigenvalue m of
    B^-1/2 (O + B) B^-1/2; the rest, m B, is what a factor may change.
    """
    # Axes that are held altogether count as blocks of their own, of any size where they are empty.
    inside = np.where(np.eye(len(matrix), dtype=bool) | blocks, matrix, 0.0)
    inverse = np.linalg.inv(np.linalg.cholesky(inside + np.diag(np.diag(matrix) == 0)))
    least = 1.0 + np.linalg.eigvalsh(inverse @ (matrix - inside) @ inverse.T).min()
    if least <= 0:
        raise InputError(
            "The entries that are held do not leave the start's matrix positive; free those off the diagonal "
            "as well, or start with smaller ones."
        )
    own = np.where(blocks, min(1.0, least) * inside, 0.0)
    return matrix - own, own


def _inertia_remainder(total: np.ndarray, fixed: np.ndarray, blocks: np.ndarray):
    """R and P of the total; R is all that is not free, where that is positive and leaves P so."""
    own = np.where(blocks, total - fixed, 0.0)
    # An entry of zero has no slope: what it starts from instead shows in no log.
    empty = blocks.diagonal() & (own.diagonal() == 0)
    own = own + np.diag(_NOTHING * empty * total.diagonal())
    if _positive(fixed) and _positive(own + np.diag(~blocks.diagonal() * 1.0)):
        return fixed, own
    return _remainder(total, blocks)


def _positive(matrix: np.ndarray) -> bool:
    return bool(np.linalg.eigvalsh(matrix).min() > 1e-9 * np.abs(matrix).max())


def _matrix_places(axes, pairs) -> np.ndarray:
    """Flat places in a 6x6 matrix of pairs of free axes."""
    rows, columns = np.array(axes)[np.array(pairs, int).reshape(-1, 2)].T
    return rows * 6 + columns


def _places_of(part: Entries | Magnitudes | Inertia | Dissipative) -> np.ndarray:
    """Flat places in the leaf of a part's entries."""
    if isinstance(part, Magnitudes):
        return np.array(part.places, int)
    if isinstance(part, Entries):
        return np.argmax(np.asarray(part.spread), axis=0)
    return _matrix_places(part.axes, part.pairs)


def _damping_size(vehicle: Vehicle, leaf: np.ndarray) -> np.ndarray:
    own = np.abs(np.diag(leaf))
    own = np.where(own > 0, own, _BRAKING * np.diag(np.asarray(vehicle.mass_matrix)))
    return np.maximum(np.abs(leaf), np.sqrt(np.outer(own, own)))


def _inertia(vehicle: Vehicle, name: str, leaf: np.ndarray, mask: np.ndarray) -> Inertia:
    axes = vehicle.axes
    block = np.ix_(axes, axes)
    total = np.asarray(vehicle.mass_matrix)[block]
    total = (total + total.T) / 2
    other = np.asarray(vehicle.mass_matrix)[block] - leaf[block]
    blocks = _blocks(mask[block])
    if not _positive(total):
        raise ValueError(
            "The start's mass matrix is not positive definite on the free axes; start with larger entries on "
            "the diagonal, or smaller ones off it, of `body.matrix` or `added_mass`."
        )
    held = (leaf + leaf.T)[block] / 2 * blocks
    rest, own = _inertia_remainder(total, total - held, blocks)
    lower = tuple((int(i), int(j)) for i, j in zip(*np.nonzero(np.tril(blocks)), strict=True))
    factor = np.linalg.cholesky(own + np.diag(~blocks.diagonal() * 1.0))
    soft = _SOFT * total.diagonal()
    raw = [factor[i, i] ** 2 - (soft[i] / factor[i, i]) ** 2 if i == j else factor[i, j] for i, j in lower]
    return Inertia(
        start=jnp.asarray(np.array(raw, float)),
        leaf=jnp.asarray(leaf),
        other=jnp.asarray(other),
        rest=jnp.asarray(rest),
        soft=jnp.asarray(soft),
        names=tuple(_entry(name, axes[i], axes[j], ",") for i, j in lower),
        axes=axes,
        lower=lower,
    )


def _dissipative(vehicle: Vehicle, name: str, leaf: np.ndarray, mask: np.ndarray) -> Dissipative:
    axes = vehicle.axes
    block = np.ix_(axes, axes)
    matrix, blocks = leaf[block], _blocks(mask[block])
    scale = np.sqrt(np.diag(_damping_size(vehicle, leaf)[block]))
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2 / np.outer(scale, scale))
    symmetric = (vectors * np.maximum(values, _FLOOR)) @ vectors.T * np.outer(scale, scale)
    # Flooring may fill what was zero; outside the blocks the matrix stays as it is.
    symmetric = np.where(blocks, symmetric, (matrix + matrix.T) / 2)
    rest, own = _remainder(symmetric, blocks)
    skew = (matrix - matrix.T) / 2
    lower = [(int(i), int(j)) for i, j in zip(*np.nonzero(np.tril(blocks)), strict=True)]
    factor = np.linalg.cholesky(own + np.diag(~blocks.diagonal() * 1.0))
    upper = [(j, i) for i, j in lower if i != j]
    raw = [factor[i, j] for i, j in lower] + [skew[i, j] for i, j in lower if i != j]
    return Dissipative(
        start=jnp.asarray(np.array(raw, float)),
        leaf=jnp.asarray(leaf),
        rest=jnp.asarray(rest + np.where(blocks, 0.0, skew)),
        names=tuple(_entry(name, axes[i], axes[j], "<-") for i, j in lower + upper),
        axes=axes,
        lower=tuple(lower),
    )


def _symmetric(vehicle: Vehicle, name: str, leaf: np.ndarray, mask: np.ndarray) -> Entries:
    del vehicle
    pairs = [(int(i), int(j)) for i, j in zip(*np.nonzero(np.tril(mask)), strict=True)]
    names = [_entry(name, i, j, ",") for i, j in pairs]
    return _entries(leaf, [tuple({6 * i + j, 6 * j + i}) for i, j in pairs], names)


def _plain(vehicle: Vehicle, name: str, leaf: np.ndarray, mask: np.ndarray) -> Entries:
    del vehicle
    pairs = [(int(i), int(j)) for i, j in zip(*np.nonzero(mask), strict=True)]
    names = [_entry(name, i, j, "<-") for i, j in pairs]
    return _entries(leaf, [(6 * i + j,) for i, j in pairs], names)


def _braking(vehicle: Vehicle, name: str, leaf: np.ndarray, mask: np.ndarray) -> Magnitudes:
    rows, columns = np.nonzero(mask)
    names = [_entry(name, int(i), int(j), "<-") for i, j in zip(rows, columns, strict=True)]
    places = 6 * rows + columns
    soft = _NEAR_NOTHING * _damping_size(vehicle, leaf).ravel()[places]
    return _magnitudes(leaf, places, names, rows == columns, soft)


def _any_leaf(vehicle: Vehicle, path, name: str, leaf: np.ndarray, held: np.ndarray) -> Entries:
    """A leaf without constraints; of an effect on a target only what belongs to the target."""
    groups, names = _of_target(vehicle, path) if path[0].name == "placed" else (None, None)
    if groups is None or names is None:
        groups = [(i,) for i in range(leaf.size)]
        names = _labels(vehicle, name, leaf)
    kept = [k for k, group in enumerate(groups) if not held.ravel()[list(group)].all()]
    return _entries(leaf, [groups[k] for k in kept], [names[k] for k in kept])


def _magnitudes(
    leaf: np.ndarray, places: np.ndarray, names: Sequence[str], may: np.ndarray, soft: np.ndarray
) -> Magnitudes:
    """Of the flat `places` of a leaf; `may`: whether an entry keeps its sign where it is positive.

    - `soft`: where such an entry begins that is zero; 0: it is left as it is.
    """
    value = leaf.ravel()[places].astype(float)
    positive = may & (value > 0)
    return Magnitudes(
        start=jnp.asarray(np.where(positive, np.log(np.where(positive, value, 1.0)), value)),
        base=jnp.asarray(leaf),
        soft=jnp.asarray(np.where(may & (value == 0), soft, 0.0)),
        names=tuple(names),
        places=tuple(places.tolist()),
        positive=tuple(positive.tolist()),
    )


def _of_target(vehicle: Vehicle, path) -> tuple[list[tuple[int, ...]] | None, list[str] | None]:
    """Places in the leaf that each parameter of a placed effect fills, and their names."""
    placed = vehicle.placed[path[1].idx]
    suspects = type(placed.effect).suspects(vehicle)
    suspect = next((s for s in suspects if s.target == placed.target), None)
    if suspect is None:
        return None, None
    inside = jax.tree_util.tree_flatten_with_path(placed.effect)[0]
    sizes = [np.size(leaf) for _, leaf in inside]
    which = [tuple(p) for p, _ in inside].index(tuple(path[3:]))
    first = sum(sizes[:which])
    groups, names = [], []
    for parameter, slots in suspect.slots.items():
        own = tuple(s - first for s in slots if 0 <= s - first < sizes[which])
        if own:
            groups.append(own)
            names.append(f"{suspect.label}.{parameter}")
    return groups, names


def _labels(vehicle: Vehicle, name: str, leaf: np.ndarray) -> list[str]:
    if name.startswith("masses["):
        number, name = name.removeprefix("masses[").split("].", 1)
        name = f"{vehicle.masses[int(number)].key}.{name}"
    if leaf.ndim == 0:
        return [name]
    places = list(np.ndindex(*leaf.shape))
    if name.startswith("thrusters."):
        places = [(vehicle.thruster_names[i], *rest) for i, *rest in places]
    if name.startswith("actuators["):
        number, name = name.removeprefix("actuators[").split("].", 1)
        those = vehicle.actuators[int(number)]
        name = f"{those.key}.{name}"
        if leaf.shape[0] == len(those.names):
            places = [(those.names[i], *rest) for i, *rest in places]
    return [f"{name}[{','.join(map(str, place))}]" for place in places]


def _entries(leaf: np.ndarray, groups: list[tuple[int, ...]], names: list[str]) -> Entries:
    spread = np.zeros((leaf.size, len(groups)))
    for k, group in enumerate(groups):
        spread[list(group), k] = 1.0
    flat = leaf.ravel().astype(float)
    start = np.array([flat[group[0]] for group in groups], float)
    base = np.where(spread.any(axis=1), 0.0, flat).reshape(leaf.shape)
    return Entries(
        start=jnp.asarray(start),
        base=jnp.asarray(base),
        spread=jnp.asarray(spread),
        names=tuple(names),
    )


def _entry(name: str, row: int, column: int, between: str) -> str:
    """`damping.linear[sway<-yaw]`, and `damping.linear[sway]` on the diagonal."""
    inside = DOFS[row] if row == column else f"{DOFS[row]}{between}{DOFS[column]}"
    return f"{name}[{inside}]"
