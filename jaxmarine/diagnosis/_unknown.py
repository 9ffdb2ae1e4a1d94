"""On which signals a residual depends that no known effect explains.

The missing wrench at the knots is regressed on shapes of the signals, one axis at a time. What a
dependence is worth is the chi-square that it saves on windows that were left out of its regression.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from .._types import ATTITUDE, DOFS, POSITION, RATE, VELOCITY
from ._criteria import DEFAULT, Criteria
from ._knots import Knots, missing_wrench, on_axis
from ._score import Reduced, blocks, rows, solve, step_with, t_value
from ._signals import Places, Signals

# Standard errors over windows within which two sets of signals are not told apart.
TOLD_APART = 2.0
# Harmonics of a heading (or of another angle that turns through more than 2 rad), and bumps over a range:
# of a place as many as it resolves, two knots to a bump.
HARMONICS = 6
BUMPS = 16
MOST_BUMPS = 48
# Half periods of a drift in the logs.
SWINGS = 12
# Pulls to zero of the regressors' coefficients, relative to what the data say of one: the one that predicts
# left-out windows best is taken. Pulled too little, many shapes follow the noise, and hide what they explain.
RIDGES = (1e-3, 1e-2, 1e-1, 1.0)
# How many times as much is missing where the craft is driven as where it is not, if only the size of what is
# missing is to speak.
AMID_MOTION = 10.0
# By how much rank correlations of two signals with what is missing may differ if they are not to be told
# apart, and the probability that chance alone is taken for such a correlation.
ALIKE, CHANCE = 0.1, 1e-3
# Width of a prior on a force [N, N m] that does not hold it.
UNPULLED = 1e6


# Of the signals at some places.
Regressors = Callable[[Places], Float[np.ndarray, "windows places features"]]


@dataclasses.dataclass(frozen=True)
class Dependence:
    """A missing wrench on one axis as a function of signals.

    - `saved`: chi-square saved on left-out windows; beside a disturbance twice the nats by which it makes the
      logs likelier (`likely`). `tied`: signals that would do as well as one of those
      named, within two standard errors: the log cannot tell them apart.
    - `features`: the regressors' values at the knots, or where `at` says, none where only the size of the
      wrench goes with the signals; `made`: them at any places, None where only those at the knots are known.
    - `remembers`: it hangs on the past of a command, since without the plays it saves less than half.
    """

    axis: int
    signals: tuple[str, ...]
    tied: tuple[str, ...]
    saved: float
    features: Float[np.ndarray, "windows knots features"]
    remembers: bool
    made: Regressors | None = None

    def at(self, places: Places) -> "Dependence":
        """With its regressors at other places than the knots."""
        return self if self.made is None else dataclasses.replace(self, features=self.made(places))

    @property
    def size_only(self) -> bool:
        return not self.features.shape[-1]

    @property
    def dof(self) -> str:
        return DOFS[self.axis]


def resolved(name: str, values: np.ndarray) -> int:
    """Bumps over the range of a signal: of a place as many as the knots resolve."""
    if name not in POSITION:
        return BUMPS
    step = 2.0 * float(np.median(np.abs(np.diff(values, axis=1)))) / max(float(np.ptp(values)), 1e-12)
    return int(np.clip(1.0 / max(step, 1.0 / MOST_BUMPS), BUMPS, MOST_BUMPS))


def _single(name: str, values: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Shapes of one signal, of the kind and the range that its values at the knots have.

    Harmonics of an angle that turns; bumps over the range of a place, of the time and of a small angle;
    x, x², x³, |x| x and a step at zero, as of dry friction, of all that has a zero of its own.
    """
    if name in ATTITUDE and np.ptp(knots) > 2.0:
        turns = np.arange(1, HARMONICS + 1) * values[..., None]
        return np.concatenate([np.sin(turns), np.cos(turns)], axis=-1)
    if name in (*POSITION, "t", *ATTITUDE):
        low, high = np.quantile(knots, [0.005, 0.995])
        x = (np.clip(values, low, high) - low) / max(high - low, 1e-12)
        count = resolved(name, knots)
        bumps = np.exp(-0.5 * ((count - 1) * x[..., None] - np.arange(count)) ** 2)
        return np.concatenate([x[..., None] - 0.5, (x[..., None] - 0.5) ** 2, bumps], axis=-1)
    x = np.clip(values / max(float(np.quantile(np.abs(knots), 0.99)), 1e-12), -1.5, 1.5)
    return np.stack([x, x**2, x**3, np.abs(x) * x, np.tanh(10.0 * x)], axis=-1)


@dataclasses.dataclass(frozen=True)
class _Shapes:
    """Regressors made of the signals at some places, each of the kind and range that it has at the knots."""

    places: Places
    knots: Places

    @functools.cached_property
    def _made(self) -> dict[str, np.ndarray]:
        return {}

    def single(self, name: str) -> Float[np.ndarray, "windows places features"]:
        """Of one signal."""
        if name not in self._made:
            self._made[name] = _single(name, self.places.signals[name], self.knots.signals[name])
        return self._made[name]

    @functools.cached_property
    def swings(self) -> Float[np.ndarray, "windows places swings"]:
        """Of the time, from half a period in the logs to as many as left-out stretches leave visible."""
        t, knots = self.places.signals["t"], self.knots.signals["t"]
        turns = np.pi * (t - knots.min()) / max(float(np.ptp(knots)), 1e-12)
        angles = np.arange(1, SWINGS + 1) * turns[..., None]
        return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)

    def of(self, names: tuple[str, ...], heads: int = 2) -> Float[np.ndarray, "windows places features"]:
        """Shapes of each signal, and for every pair products of all harmonics or of the first `heads` shapes.

        Commands also have their plays: a thrust may depend on where its command comes from. With the time
        the others have products of slow swings, since what drifts need not drift one way; beside the
        swings of several signals no other products.
        """
        singles = [self.single(name) for name in names]
        firsts = [shapes if shapes.shape[-1] == 2 * HARMONICS else shapes[..., :heads] for shapes in singles]
        products = [
            (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:2], -1)
            for a, b in itertools.combinations(firsts, 2)
        ]
        played = [self.places.played[name] for name in names if name in self.places.played]
        if "t" not in names:
            return np.concatenate([*singles, *products, *played], axis=-1)
        moving = [shapes for name, shapes in zip(names, singles, strict=True) if name != "t"]
        slow = [shapes[..., :1] * self.swings for shapes in moving]
        # Swings of several signals are many regressors: the rest would be more than a log can tell.
        rest = [*products, *played] if len(names) < 3 else []
        return np.concatenate([*singles, *slow, *rest], axis=-1)

    def drifting(self, axis: int) -> Float[np.ndarray, "windows places features"]:
        """What commands together give on an axis, with its slow swings: drives that drift alike."""
        given = self.places.driven[..., axis, None]
        return np.concatenate([given, given * self.swings], axis=-1)


def _left_out(
    y: Float[np.ndarray, "windows knots"],
    weight: Float[np.ndarray, "windows knots"],
    values: Float[np.ndarray, "windows knots features"],
) -> Float[np.ndarray, "ridges windows knots"]:
    """The response in each window by ridge regressions on the others, neighbours left out as well."""
    total, count = weight.sum(), values.shape[-1]
    flat = values.reshape(y.size, count)
    centre = weight.ravel() @ flat / total
    spread = np.sqrt(weight.ravel() @ (flat - centre) ** 2 / total)
    x = np.ones((*y.shape, count + 1))
    x[..., :-1] = (values - centre) / np.maximum(spread, 1e-9)
    pull = total * np.diag([*np.ones(count), 0.0])
    names, fold = np.unique(blocks(len(y)), return_inverse=True)
    rest = np.array([np.convolve(fold == b, [1, 1, 1], "same") == 0 for b in range(len(names))], float)
    # Windows that the same folds leave out are summed at once: there are few such kinds, and many windows.
    kinds, kind = np.unique(rest, axis=1, return_inverse=True)
    own_h, own_g = [], []
    for i in range(kinds.shape[1]):
        part = x[kind == i].reshape(-1, count + 1)
        weighted = part * weight[kind == i].reshape(-1, 1)
        own_h.append(weighted.T @ part)
        own_g.append(weighted.T @ y[kind == i].ravel())
    h, g = np.tensordot(kinds, own_h, 1), kinds @ np.array(own_g)
    # All folds and ridges at once: there are thousands of sets of regressors to try.
    pulled = h[:, None] + np.array(RIDGES)[:, None, None] * pull
    fitted = np.linalg.solve(pulled, g[:, None, :, None])[..., 0]
    return np.moveaxis(x @ np.swapaxes(fitted[fold], 1, 2), 2, 0)


class _Ledger:
    """What dependences save on left-out windows beside those found already and a constant."""

    def __init__(self, k: Knots, criteria: Criteria = DEFAULT):
        self.k, self.criteria = k, criteria
        self.shapes = _Shapes(k.places, k.places)
        shape = (*k.places.t.shape, 6)
        missing = missing_wrench(k)
        self.y = np.nan_to_num(missing.wrench.reshape(shape))
        variance = np.nan_to_num(missing.std.reshape(shape), nan=1.0) ** 2
        # A knot that its window hardly determines counts little, one that it knows well not without limit.
        self.weight = 1.0 / (variance + np.median(variance, axis=(0, 1)))
        self.known = np.zeros(shape)
        self._constants: dict[int, np.ndarray] = {}
        self._laid = k.stats.lay(self.known)

    def chi2(
        self, axis: int, wrenches: Float[np.ndarray, "some windows knots"]
    ) -> Float[np.ndarray, "some windows"]:
        """Change of each window's chi-square by some wrenches on an axis, each beside those found already."""
        along = (self._laid, np.moveaxis(wrenches, 0, 1))
        return rows(self.k.stats.each(_change, self.k.width, axis, along=along)).T

    def _predicted(self, axis: int, values: np.ndarray):
        """What regressors predict of the missing wrench on left-out windows, pulled to zero as suits them.

        And by how much it changes each window's chi-square.
        """
        pulled = _left_out(self.y[..., axis], self.weight[..., axis], values)
        costs = self.chi2(axis, pulled)
        best = int(np.argmin(costs.sum(axis=1)))
        return pulled[best], costs[best]

    def wrench(self, axis: int, values: np.ndarray) -> Float[np.ndarray, "windows knots"]:
        """What regressors predict of the missing wrench on left-out windows."""
        return self._predicted(axis, values)[0]

    def saved(self, axis: int, values: np.ndarray) -> Float[np.ndarray, " windows"]:
        """Chi-square saved on each window, beyond a constant, by regressors fitted on the others."""
        return self._constant(axis) - self._predicted(axis, values)[1]

    def _constant(self, axis: int) -> Float[np.ndarray, " windows"]:
        if axis not in self._constants:
            self._constants[axis] = self._predicted(axis, np.zeros((*self.y.shape[:2], 0)))[1]
        return self._constants[axis]

    def left(self, axis: int) -> float:
        """Chi-square that a free force on an axis saves beyond a constant."""
        return float(self._constant(axis).sum() - self.chi2(axis, self.y[None, ..., axis]).sum())

    def constant(self, axis: int) -> float:
        """Chi-square that a constant force on an axis saves."""
        without = self.chi2(axis, np.zeros((1, *self.y.shape[:2])))
        return float(without.sum() - self._constant(axis).sum())

    def better(self, new: np.ndarray, old: np.ndarray) -> bool:
        """Whether one more signal helps, by what is saved with it and without it."""
        enough = (1 + self.criteria.more) * max(old.sum(), 0.0)
        return bool(new.sum() > enough and t_value(new - old) > TOLD_APART)

    def add(self, axis: int, wrench: np.ndarray) -> None:
        self.known[..., axis] += wrench
        self._laid = self.k.stats.lay(self.known)
        self._constants.clear()


def _change(
    stats: Reduced,
    known: Float[np.ndarray, "windows knots 6"],
    wrenches: Float[np.ndarray, "windows some knots"],
    n: int,
    axis: int,
) -> Float[np.ndarray, "windows some"]:
    """`_Ledger.chi2` of the windows of one place, where `known` acts; z is the first `n` columns."""
    wrenches = np.moveaxis(wrenches, 0, 1)
    push = np.tile(known, (len(wrenches), 1, 1, 1))
    push[..., axis] += wrenches
    push = np.moveaxis(push.reshape(*push.shape[:2], -1), 0, 2)
    return ((2 * stats.g[:, n:, None] + stats.h[:, n:, n:] @ push) * push).sum(axis=1)


class _Best(NamedTuple):
    """On which signals the missing wrench on an axis depends best; `tied`: as of `Dependence`.

    - `gain`: what they save on each window; `alike`: drives drift, and all of them alike.
    """

    signals: tuple[str, ...]
    gain: Float[np.ndarray, " windows"]
    tied: tuple[str, ...]
    alike: bool


def _best_signals(ledger: _Ledger, axis: int) -> _Best:
    places = ledger.k.places

    def saved(names: tuple[str, ...]) -> np.ndarray:
        return ledger.saved(axis, ledger.shapes.of(names))

    singles = {name: saved((name,)) for name in places.signals}
    order = sorted(singles, key=lambda name: -singles[name].sum())
    chosen: tuple[str, ...] = (order[0],)
    gain = singles[order[0]]
    best_pair, best = chosen, gain
    for pair in itertools.combinations(order, 2):
        now = saved(pair)
        if now.sum() > best.sum():
            best_pair, best = pair, now
    if ledger.better(best, gain):
        chosen, gain = best_pair, best
        results: dict[tuple[str, ...], np.ndarray] = {
            (*chosen, name): saved((*chosen, name)) for name in order if name not in chosen
        }
        names = max(results, key=lambda n: results[n].sum(), default=chosen)
        if names != chosen and ledger.better(results[names], gain):
            chosen, gain = names, results[names]
    if len(places.commanded) > 1:
        drift, now = _drift(places.commanded, saved, ledger.better)
        if ledger.better(now, gain):
            chosen, gain = drift, now
        together = ledger.shapes.drifting(axis)
        now = ledger.saved(axis, together)
        # One cause in the place of many signals: it is enough that it saves more. But it must drift: what
        # commands give goes with what the file has wrong, as a craft that goes on brakes as much.
        if now.sum() > gain.sum() and ledger.better(now, ledger.saved(axis, together[..., :1])):
            return _Best(("t", *places.commanded), now, (), alike=True)
    tied = []
    for name in order:
        if name in chosen:
            continue
        for i in range(len(chosen)):
            other = tuple(name if j == i else kept for j, kept in enumerate(chosen))
            now = singles[name] if len(chosen) == 1 else saved(other)
            if t_value(gain - now) < TOLD_APART and now.sum() > 0.8 * gain.sum():
                tied.append(name)
                break
    return _Best(chosen, gain, tuple(tied), alike=False)


def _shapes_of(ledger: _Ledger, axis: int, best: _Best) -> tuple[Regressors, np.ndarray, bool]:
    """Shapes of signals, of which few leave what would look like a force on a coupled axis.

    Their values at the knots, and whether the wrench hangs on the past of a command.
    """
    here, names = ledger.k.places, best.signals
    if best.alike:
        return functools.partial(_drifting, axis, here), ledger.shapes.drifting(axis), False
    some = {heads: ledger.shapes.of(names, heads) for heads in (2, 4)}
    heads = max(some, key=lambda heads: ledger.saved(axis, some[heads]).sum())
    forgetful = _mixed(names, 2, here, dataclasses.replace(here, played={}))
    remembers = bool(ledger.saved(axis, forgetful).sum() < 0.5 * best.gain.sum())
    return functools.partial(_mixed, names, heads, here), some[heads], remembers


def _mixed(
    names: tuple[str, ...], heads: int, knots: Places, places: Places
) -> Float[np.ndarray, "windows places features"]:
    return _Shapes(places, knots).of(names, heads)


def _drifting(axis: int, knots: Places, places: Places) -> Float[np.ndarray, "windows places features"]:
    return _Shapes(places, knots).drifting(axis)


def _drift(
    commands: tuple[str, ...],
    saved: Callable[[tuple[str, ...]], np.ndarray],
    better: Callable[[np.ndarray, np.ndarray], bool],
) -> tuple[tuple[str, ...], np.ndarray]:
    """The time with the commands whose thrust drifts, without those that need not, and what it saves.

    A drift of all thrusters shows on none alone: what each misses hides what the others would save.
    """
    names = ("t", *commands)
    gain = saved(names)
    while len(names) > 2 and gain.sum() > 0:
        fewer = [tuple(other for other in names if other != name) for name in names[1:]]
        results = {less: saved(less) for less in fewer}
        best = max(fewer, key=lambda less: results[less].sum())
        if better(gain, results[best]):
            break
        names, gain = best, results[best]
    return names, gain


def tried_nats(k: Knots) -> float:
    """What a dependence must gain for having been chosen: by pairs of signals, and axes."""
    return float(np.log(len(k.places.signals) ** 2 * k.free.sum()))


def dependences(
    k: Knots,
    phi: float,
    undisturbed: Signals | None = None,
    freedom: float = np.inf,
    criteria: Criteria = DEFAULT,
) -> tuple[Dependence, ...]:
    """Axes with a missing wrench that depends on signals, the strongest first.

    - `phi`: dispersion of the scores (`_search.dispersion`).
    - `undisturbed`: velocities as the commands alone give them. A disturbance moves the craft, so the
      measured velocity goes with it without being its cause; these do not. They are the instruments of
      an instrumental-variable regression (Young 2011): where they save nothing, nothing depends. Unless
      the measured ones save most of what noise with so much `freedom` does not account for: no disturbance
      is a function of the motion.
    """
    ledger = _Ledger(k, criteria)
    trials: dict[int, _Best] = {}
    left = [int(axis) for axis in np.flatnonzero(k.free)]
    found: list[Dependence] = []
    enough = 2 * phi * tried_nats(k) + 2 * criteria.nats
    while left:
        trials |= {axis: _best_signals(ledger, axis) for axis in left if axis not in trials}
        axis = max(left, key=lambda a: trials[a].gain.sum())
        names, gain, tied, _ = trials[axis]
        if gain.sum() < enough:
            break
        if found and gain.sum() < criteria.smallest * found[0].saved:
            break
        left.remove(axis)
        others = sum(one.saved for one in found) + ledger.constant(axis)
        excess = k.chi2.sum() - freedom - others
        plain = 0.0 < criteria.most * excess < gain.sum()
        most = bool(gain.sum() > criteria.most * ledger.left(axis))
        if _sigmas(gain, most) < (criteria.sigmas_of_most if plain else criteria.sigmas):
            continue
        if not (plain or _causal(ledger, axis, names, gain, undisturbed, most)):
            continue
        made, values, remembers = _shapes_of(ledger, axis, trials[axis])
        found.append(Dependence(axis, names, tied, float(gain.sum()), values, remembers, made))
        ledger.add(axis, ledger.wrench(axis, values))
        # What is found acts on all axes, by what couples them.
        trials.clear()
    return tuple(found)


def size_only(
    k: Knots, phi: float, undisturbed: Signals | None, freedom: float, criteria: Criteria = DEFAULT
) -> tuple[Dependence, ...]:
    """The command or velocity with which the size of what is missing goes, where its value goes with nothing.

    No disturbance asks whether the craft is driven: what is `AMID_MOTION` times as large in the third of the
    windows in which a signal is large as in the third in which it is small is not one. Velocities are those
    that the commands alone give.
    """
    moved = k.places.signals | (undisturbed or {})
    names = [n for n in moved if n in k.places.commanded or (undisturbed and n in undisturbed)]
    activity = {n: np.sqrt((moved[n] ** 2).mean(axis=1)) for n in names}
    chi2, third = k.chi2, len(k.chi2) // 3
    ranks: Any = {n: stats.spearmanr(a, chi2) for n, a in activity.items() if np.ptp(a) > 0}
    alike = {n: float(rank.statistic) for n, rank in ranks.items()}
    order = sorted(alike, key=lambda n: -alike[n])
    if not order or not third:
        return ()
    best = order[0]
    order_of = np.argsort(activity[best])
    gross = chi2[order_of[-third:]].mean() > AMID_MOTION * chi2[order_of[:third]].mean()
    if not gross or alike[best] < 0 or ranks[best].pvalue * len(alike) > CHANCE:
        return ()
    ledger = _Ledger(k, criteria)
    axis = int(np.argmax((ledger.weight * ledger.y**2).sum(axis=(0, 1)) * (np.asarray(k.free) > 0)))
    tied = tuple(n for n in order[1:] if alike[n] > alike[best] - ALIKE)
    saved = float(chi2.sum() - freedom)
    empty = np.zeros((*k.places.t.shape, 0))
    enough = saved > 2 * phi * np.log(len(alike)) + 2 * criteria.nats
    return (Dependence(axis, (best,), tied, saved, empty, remembers=False),) if enough else ()


def _sigmas(gain: Float[np.ndarray, " windows"], most: bool) -> float:
    """Standard errors by which a dependence helps on left-out windows.

    What explains nearly all of a force that is large in few windows saves most there, and the more it saves
    the more its savings scatter. Where it is `most`, their roots count as well, which go with the force.
    """
    roots = np.sign(gain) * np.sqrt(np.abs(gain))
    return max(t_value(gain), t_value(roots)) if most else t_value(gain)


def _causal(
    ledger: _Ledger,
    axis: int,
    names: tuple[str, ...],
    gain: np.ndarray,
    undisturbed: Signals | None,
    most: bool,
) -> bool:
    """Whether a dependence also shows on velocities that no disturbance has moved; `most`: see `_sigmas`."""
    if undisturbed is None or not set(names) & {*VELOCITY, *RATE}:
        return True
    places = ledger.k.places
    moved = dataclasses.replace(places, signals=places.signals | undisturbed)
    saved = ledger.saved(axis, _Shapes(moved, moved).of(names))
    return bool(_sigmas(saved, most) > TOLD_APART and saved.sum() > 0.1 * gain.sum())


def _beside(k: Knots, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and information of the known numbers, with their prior, and of wrenches."""
    g, h = k.summed(wrench)
    n = k.width
    h[:n, :n] += np.diag(k.precision)
    g[:n] += k.precision * k.offset
    h[range(n, len(h)), range(n, len(h))] *= 1 + 1e-6
    return g, h


def _wrenches(places: Places, found: tuple[Dependence, ...]) -> np.ndarray:
    """The dependences' regressors as wrenches at some places."""
    empty = np.zeros((*places.t.shape, 6, 0))
    return np.concatenate([empty, *(on_axis(one.axis, one.features) for one in found)], axis=-1)


def cost_of_removal(k: Knots, members: list[slice], found: tuple[Dependence, ...]) -> list[float]:
    """Chi-square lost by putting each member back to neutral beside the dependences.

    One that only stood in for an unknown dependence costs little once that may act for itself.
    """
    g, h = _beside(k, _wrenches(k.places, found))
    out = []
    for where in members:
        held = np.arange(where.start, where.stop)
        least, without = (step_with(g, h, fixed, -k.offset[fixed]) for fixed in (held[:0], held))
        out.append(float(2 * g @ (without - least) + without @ h @ without - least @ h @ least))
    return out


def acting(k: Knots, found: tuple[Dependence, ...]) -> Knots:
    """The statistics once dependences act as the logs say, known numbers refitted with them."""
    return k.beside(_normalised(k, found), UNPULLED)


def likely(
    k: Knots, found: tuple[Dependence, ...], criteria: Criteria = DEFAULT
) -> tuple[tuple[Dependence, ...], Knots]:
    """Those of some dependences without which the logs are clearly less likely, each beside the ones before.

    And the knots amid the disturbance that suits the logs beside them.

    The evidence of a dependence whose shapes have coefficients of one unknown size, z integrated out, against
    odds for how many sets of signals there are to try. A disturbance that goes with a signal for a while, as
    with a command that answers it, has its own place in the likelihood and needs no dependence. But one that
    was estimated without the dependence had to stand in for it, and is estimated again beside it.
    """
    if not found:
        return found, k
    accepted: tuple[Dependence, ...] = ()
    before = nats_beside(k, accepted, 1.0)
    for one in found:
        if one.axis in {other.axis for other in accepted}:
            continue
        shapes = as_given(k, (*accepted, one))
        first = _integrated(k, shapes, 1.0)
        ways = [(k, first)]
        if (other := k.where(first.step, _normalised(k, shapes) @ first.sizes)) is not k:
            again = _integrated(other, shapes, 1.0)
            # A smaller disturbance narrows z by more, over which all is integrated.
            narrower = 0.5 * (again.narrowed - first.narrowed)
            ways.append((dataclasses.replace(other, lost=other.lost + narrower), again))
        nats = np.nan_to_num([found.nats - way.lost for way, found in ways], nan=-np.inf)
        gained = float(nats.max()) - before
        if gained > criteria.nats:
            accepted = (*accepted, dataclasses.replace(one, saved=2 * gained))
            k, before = ways[int(nats.argmax())][0], before + gained
    return accepted, k


def nats_beside(k: Knots, found: tuple[Dependence, ...], phi: float) -> float:
    """Nats by which some dependences make the logs likelier, known numbers refitted with them (linearised).

    Coefficients of shapes are integrated out, each dependence's at the size at which they gain most, and it
    is charged for how many there were to choose from.

    - `phi`: dispersion of the scores, by which all that is gained counts less.
    """
    found = tuple(one for one in found if not one.size_only)
    nats = _integrated(k, found, phi).nats
    # Beside nothing it is that of the disturbance which suits the logs without any.
    return nats - k.lost / phi if found else nats


class _Integrated(NamedTuple):
    """What some dependences are worth, their coefficients integrated out.

    - `nats` that they gain; `step` of z and `sizes` of their shapes at which the logs are likeliest.
    - `narrowed`: logarithm of the determinant of the information of z with its prior.
    """

    nats: float
    step: Float[np.ndarray, " z"]
    sizes: Float[np.ndarray, " shapes"]
    narrowed: float


def _integrated(k: Knots, found: tuple[Dependence, ...], phi: float) -> _Integrated:
    g, h = _beside_shapes(k, found)
    rest = np.arange(k.width)
    nats = 0.5 * g[rest] @ solve(h[np.ix_(rest, rest)], g[rest]) / phi
    first = k.width
    for one in found:
        own = np.arange(first, first + one.features.shape[-1])
        left, slope = _eliminated(g, h, own, rest)
        gained, pull = _evidence(left / phi, slope / phi)
        nats += gained - tried_nats(k)
        h[own, own] += phi * pull
        rest, first = np.append(rest, own), own[-1] + 1
    best = -solve(h, g)
    narrowed = float(np.linalg.slogdet(h[: k.width, : k.width])[1]) if k.width else 0.0
    return _Integrated(float(nats), best[: k.width], best[k.width :], narrowed)


def _beside_shapes(k: Knots, found: tuple[Dependence, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and information of the known numbers and of the shapes, each of mean square one."""
    return _beside(k, _normalised(k, found))


def _normalised(k: Knots, found: tuple[Dependence, ...]) -> np.ndarray:
    """The dependences' regressors as wrenches where they are given, each of mean square one on its axis."""
    wrenches = _wrenches(k.given, found)
    size = np.sqrt(6 * (wrenches**2).mean(axis=(0, 1, 2)))
    return wrenches / np.maximum(size, 1e-300)


def as_given(k: Knots, found: tuple[Dependence, ...]) -> tuple[Dependence, ...]:
    """Dependences with regressors where wrenches are given."""
    return tuple(one.at(k.given) for one in found)


def _eliminated(
    g: np.ndarray, h: np.ndarray, own: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient of some numbers once the rest is refitted with them."""
    across = h[np.ix_(own, rest)]
    x = solve(h[np.ix_(rest, rest)], np.column_stack([across.T, g[rest]]))
    return h[np.ix_(own, own)] - across @ x[:, :-1], g[own] - across @ x[:, -1]


def _evidence(h: np.ndarray, g: np.ndarray) -> tuple[float, float]:
    """Nats that coefficients of one size gain, at that at which they gain most; and its inverse square."""
    eigenvalues, vectors = np.linalg.eigh(h)
    eigenvalues, along = np.maximum(eigenvalues, 0.0), (vectors.T @ g) ** 2
    sizes = np.geomspace(1e-4, 1e4, 81) / np.sqrt(max(eigenvalues.mean(), 1e-300))
    by = sizes[:, None] ** 2
    gained = 0.5 * (along * by / (1 + by * eigenvalues) - np.log1p(by * eigenvalues)).sum(axis=1)
    best = int(np.argmax(gained))
    return float(gained[best]), float(sizes[best] ** -2)
