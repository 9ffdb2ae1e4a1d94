"""Fitting a vehicle to logs: the call, and what it hands back."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray, PyTree

from .._errors import InputError
from .._precision import need_double
from .._types import ALWAYS, DOFS
from ..logs import Log, merged
from ..vehicle import Vehicle
from ._coverage import AxisCoverage, coverage
from ._estimate import Estimate, Units, units
from ._free import Freed, Select, Selection, set_free
from ._hidden import MANY, by_samples, by_windows, hidden_layers, train
from ._noise import median_noise, noises_of, tell_missed, widened
from ._one_step import fit_one_step
from ._review import reviewed
from ._shares import AbstractShares, fit_shares
from ._trajectory import fit_trajectory
from ._uncertainty import Combination, Parameter, Posterior, Uncertainty, posterior, uncertainty

# Half a chi-square that is not worth another step: a third of a standard error.
_WITHIN_NOISE = 0.05
# With an inertia so many times that of the start, or its inverse, it is another craft, or other units.
_OTHER_CRAFT = 10.0
# Standard errors by which it must be so for sure: one of 400 draws of noise is farther off.
_SURE = 3.0
# Lines of undetermined combinations that a printed fit shows.
_SHOWN = 6


class FitError(RuntimeError):
    """A fit that did not succeed; the message says what to change."""


@dataclasses.dataclass(frozen=True, repr=False)
class Fit:
    """A fitted vehicle, and how far to trust it. `print(fit)` shows the table.

    - `vehicle`, and the `start` it was fitted from.
    - `uncertainty`: each freed entry with its standard errors, covariances, and what the data do
      not determine; without hidden layers that gradients trained (`solver`).
    - `posterior`: the vehicles that the data leave, to `draw` from.
    - `reduced_chi2`: chi-square per degree of freedom in units of `noise`; 1 where noise alone is left. For
      the one-step loss it is 1 by construction, because the scatter is estimated from the residuals. Weights
      of hidden layers that gradients trained (`solver`) are not counted.
    - `left` [channels]: root mean square error that the model leaves in each channel over a window, NaN where
      it was not measured; `weighed` [channels]: standard deviations that they counted by at last, which are
      `noise` where that is all that is left, and larger where it is not (trajectory loss).
    - `steps`, `converged`, `result`: how the solve ended, in words.
    - `coverage`: the motion that the fit has seen, per free axis.
    - `loss`, `window` [s], `noise` [channels]: settings that it was made with.
    - `rejected`: times at which windows begin that were left out [s, of their log].
    - `notes`: what was found in the logs, accidents that were left out and clocks that differ.
    """

    vehicle: Vehicle
    start: Vehicle
    uncertainty: Uncertainty
    posterior: Posterior
    reduced_chi2: float
    steps: int
    converged: bool
    result: str
    coverage: tuple[AxisCoverage, ...]
    loss: str
    window: float
    noise: Float[np.ndarray, " channels"]
    left: Float[np.ndarray, " channels"]
    weighed: Float[np.ndarray, " channels"]
    rejected: Float[np.ndarray, " rejected"]
    notes: tuple[str, ...]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Name, start, value and standard errors of each freed entry."""
        return self.uncertainty.parameters

    @property
    def information(self) -> Float[np.ndarray, " entries"]:
        """Eigenvalues of the information in units of typical sizes, rising: (size / std)²."""
        return self.uncertainty.information

    @property
    def undetermined(self) -> tuple[Combination, ...]:
        """Combinations of parameters that the data do not determine."""
        return self.uncertainty.undetermined

    def draw(self, count: int, key: PRNGKeyArray) -> tuple[Vehicle, ...]:
        """So many vehicles as likely as the data and the prior leave them: simulated, they make a band.

        They scatter as `std_model` says, with all correlations, and keep the constraints of the fit. Where
        gradients trained hidden layers, these stand, and the last layer scatters with mass and damping
        (Laplace's approximation in the last layer). A band of them shows what the data leave open, without
        noise and without what the model lacks.
        """
        return self.posterior.draw(count, key)

    def __getitem__(self, name: str) -> Parameter:
        """The parameter of that name, such as `damping.linear[surge]`."""
        return {p.name: p for p in self.parameters}[name]

    def __repr__(self) -> str:
        lines = [*_table(self.parameters), *_undetermined(self), *_coverage(self), _ending(self)]
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines)


def fit(
    vehicle: Vehicle,
    logs: Log | Sequence[Log] | AbstractShares,
    free: Select,
    *,
    loss: Literal["trajectory", "one_step"] = "trajectory",
    solver: Literal["auto", "gauss_newton", "gradients"] = "auto",
    starts: Literal["estimated", "measured"] = "estimated",
    prior: float | PyTree | None = None,
    entries: Selection = "all",
    dissipative: bool = False,
    reject: bool = False,
    window: float = 4.0,
    max_steps: int = 100,
    throw: bool = True,
    noise: Float[np.ndarray, " channels"] | None = None,
) -> Fit:
    r"""Fits what `free` names to logs, by Gauss-Newton or Levenberg-Marquardt, hidden layers by gradients.

    Minimises, over the freed entries p and (trajectory) the initial state $x_w$ of every window,
    $\sum_w \sum_k |(\hat y_k(p, x_w) - y_k) / \sigma|^2 + \sum_i ((p_i - p_{i,0}) / s_i)^2$.

    - `logs`: one or several, in the order in which they were recorded; or shares of them that lie elsewhere
      (`jaxmarine.fleets.shared`), for the trajectory loss without `reject`: the motion that such a fit has
      seen is not told.
    - `free`: picks leaves of the vehicle, `lambda v: (v.added_mass, v.damping.linear)`. Entries of
      6x6 matrices on locked axes stay; so does what an effect has besides its target's parameters.
    - `loss`: "trajectory" compares all measured channels over windows and is consistent under
      sensor noise; "one_step" compares accelerations at each sample and is biased by noise in the
      velocities.
    - `solver`: "gauss_newton" fits all numbers alike, in time and memory of the square of how many there are,
      and more. "gradients" is for learned terms of many: Gauss-Newton fits all but hidden layers (before the
      last, in a network's `layers` or numbered in the names of its arrays), then reverse gradients and Adam
      train these with all else over minibatches, and Gauss-Newton ends it. `converged` tells of that end;
      hidden layers stop by schedule, and `result` tells what they gained. "auto" takes gradients for more
      than 450 weights in hidden layers, from where on they take less time and memory.
    - `starts`: of the windows, trajectory only. "estimated" from each window's own data: consistent under
      sensor noise, but short windows of a poor model are saved by their start. "measured": held at the
      smoothed log, which is what a prediction from there has.
    - `prior`: width relative to the start values (of an inertia: to the total mass; of a thrust, and of
      damping on a diagonal, where they are positive: of their logarithm, so that they stay so; of a start of
      zero: to a typical size, which is 1 of what is no matrix, such as `thrusters.quadratic`, and none of an
      effect of the catalogue, which may be of any size), or standard deviations in the structure of
      `free(vehicle)`, where 0 holds an entry and inf means none (numbers of actuators that are positive by
      what they are stay so within these too). What the logs do not determine stays at the
      start by it, with that standard error. A learned network needs one, as its weights are never all
      determined. What the table `[prior]` of the vehicle's file says goes before a number, and before none.
    - `entries`: of 6x6 matrices "all", those "nonzero" in the start, the "diagonal", or "coupled": with the
      diagonal what joins surge, heave and pitch, and what joins sway, roll and yaw, as in a hull that is
      alike on port and starboard. Between axes a prior is relative to the geometric mean of their diagonals.
    - `dissipative`: keeps the symmetric part of damping matrices positive semidefinite.
    - `reject`: leaves out windows whose chi-square lies far above the median one (trajectory only), because
      something acted in them that is not in the model: a collision, a fault. Less than half may be such.
    - `window` [s]: length of the windows, which for one-step are the groups of the sandwich.
    - `max_steps`: of each solve, those included that found no decrease. There are up to two: a stiffer
      vehicle is fitted again with finer integration, and one-step weighs axes anew.
    - `throw`: raises where the fit did not succeed; False: `converged` and `result` tell.
    - `noise`: standard deviation that each channel counts by, NaN for those not to use; default: that of the
      sensors (what the vehicle states, else estimated from the logs), raised to what the model leaves in the
      channel and for how many of its samples are worth one (`_weights`), but at the beginning of each window.

    The total mass matrix stays symmetric and positive definite, whatever is free of it, an added mass
    positive where the start's is, and thrusts keep their sign. Accidents that a log shows are left out
    (`Log.rejected`); `reject` makes the loss robust against what else the model lacks in a few windows.

    Raises `InputError` for logs that cannot be fitted (none, too short, too slowly sampled, nothing that ever
    changes), `ValueError` for arguments that no fit can have and without double precision, and, with `throw`,
    `FitError` for a simulation that diverged and a solve that did not reach its minimum.
    """
    shares = logs if isinstance(logs, AbstractShares) else None
    logs = () if isinstance(logs, AbstractShares) else (logs,) if isinstance(logs, Log) else tuple(logs)
    if not logs and shares is None:
        raise InputError("A fit needs at least one log.")
    need_double("A fit")
    _allowed(loss, starts, solver, reject, shares is not None)
    looks = shares.ask("look") if shares is not None else []
    logs, notes = reviewed(vehicle, logs)
    notes = (*notes, *(note for look in looks for note in look["notes"]))
    names = [log.name for log in logs] + [name for look in looks for name in look["names"]]
    weigh = noise is None
    noise = _noise(vehicle, logs, looks, names) if noise is None else noise
    # Channels that a given one does not tell are not to be used.
    noise = widened(noise, max((log.channels.shape[1] for log in logs), default=ALWAYS))
    hidden = hidden_layers(vehicle, free, prior)
    by_gradients = _takes_gradients(solver, hidden.count, shares is not None)
    freed, scales = set_free(
        vehicle,
        free,
        prior,
        entries,
        dissipative,
        spreads=dict(vehicle.prior),
        without=hidden.places if by_gradients else (),
    )
    z_units = units(freed, scales)
    held = starts == "measured"

    def solved(freed: Freed, z: Float[np.ndarray, " z"]) -> Estimate:
        if shares is not None:
            return fit_shares(freed, z_units, shares, looks, noise, window, max_steps, held, weigh)
        if loss == "trajectory":
            return fit_trajectory(freed, z_units, logs, noise, window, max_steps, held, reject, weigh, z)
        return fit_one_step(freed, z_units, logs, noise, window, max_steps, z)

    estimate, told = solved(freed, np.zeros(len(z_units.precision))), ""
    if by_gradients and estimate.finite:
        if loss == "trajectory":
            training = by_windows(hidden, freed, z_units, logs, noise, window, held, estimate)
        else:
            training = by_samples(hidden, freed, z_units, logs, noise, estimate)
        trained = train(training, estimate.z)
        ended = solved(trained.freed, trained.z)
        if ended.finite:
            freed, told = trained.freed, f"; {trained.told}"
            estimate = dataclasses.replace(ended, steps=estimate.steps + ended.steps)
    found = uncertainty(freed, scales, z_units, estimate)
    estimate = _judged(estimate, freed, z_units, found)
    estimate = dataclasses.replace(estimate, result=estimate.result + told)
    if throw and not estimate.converged:
        raise FitError(f"The fit did not succeed: {estimate.result}")
    missed = tell_missed(vehicle, names, estimate.left, noise, window) if weigh and estimate.finite else None
    return Fit(
        vehicle=freed(jnp.asarray(estimate.raw)),
        start=vehicle,
        uncertainty=found,
        posterior=posterior(freed, z_units, estimate),
        reduced_chi2=estimate.chi2 / max(estimate.freedom, 1.0),
        steps=estimate.steps,
        converged=estimate.converged,
        result=estimate.result,
        coverage=coverage(logs, vehicle.dof) if logs else (),
        loss=loss,
        window=window,
        noise=noise,
        left=estimate.left * noise,
        weighed=estimate.weighed * noise,
        rejected=estimate.rejected,
        notes=merged((*notes, missed) if missed else notes),
    )


def _allowed(loss: str, starts: str, solver: str, reject: bool, shared: bool) -> None:
    """Raises `ValueError` for arguments that no fit can have; `shared`: logs lie in several places."""
    if loss not in ("trajectory", "one_step"):
        raise ValueError(f"Argument `loss` must be trajectory or one_step, but is {loss!r}.")
    if starts not in ("estimated", "measured") or (starts == "measured" and loss == "one_step"):
        raise ValueError(
            f"Argument `starts` must be estimated, or measured with the trajectory loss, but is {starts!r}."
        )
    if reject and loss == "one_step":
        raise ValueError("Argument `reject` leaves out windows, which the one-step loss does not have.")
    if shared and (reject or loss == "one_step"):
        raise ValueError("Logs that lie in several places are fitted by trajectories, without `reject`.")
    if solver not in ("auto", "gauss_newton", "gradients"):
        raise ValueError(f"Argument `solver` must be auto, gauss_newton or gradients, but is {solver!r}.")


def _takes_gradients(solver: str, weights: int, shared: bool) -> bool:
    """Whether so many weights of hidden layers are trained by gradients; `shared`: as of `_allowed`."""
    if solver == "gradients" and (shared or not weights):
        raise ValueError(
            "Argument `solver`: gradients train hidden layers beside the last one, on logs in one place."
        )
    return solver == "gradients" or (solver == "auto" and weights > MANY and not shared)


def _noise(
    vehicle: Vehicle, logs: Sequence[Log], looks: Sequence[dict[str, Any]], names: Sequence[str]
) -> Float[np.ndarray, " channels"]:
    """Standard deviation of each channel over all logs, here or (`looks`) elsewhere; `names`: of all."""
    each = [look["noise"] for look in looks] or [noises_of(vehicle, logs)]
    width = max(one.shape[1] for one in each)
    return median_noise(np.concatenate([widened(one, width) for one in each]), names)


def _judged(estimate: Estimate, freed: Freed, units: Units, found: Uncertainty) -> Estimate:
    """The estimate with its result in words: converged, or why not and what to do."""

    def failed(what: str) -> Estimate:
        return dataclasses.replace(estimate, converged=False, result=what)

    advice = "start nearer, give a prior, or take a shorter `window`."
    where = f"; it goes wrong most in {estimate.worst}" if estimate.worst else ""
    if not estimate.finite:
        return failed(f"the simulation diverged{where}; {advice}")
    parts = estimate.promise(units)
    promise = float(parts.sum())
    minimised = estimate.chi2 if np.isnan(estimate.weighed_chi2) else estimate.weighed_chi2
    if (not estimate.converged and promise >= _WITHIN_NOISE) or promise > max(1.0, 1e-3 * minimised):
        name = freed.names[int(np.argmax(parts))]
        return failed(
            f"after {estimate.steps} steps {promise:.2g} nats could still be gained, most by {name}{where}; "
            f"raise `max_steps`, {advice}"
        )
    senseless = _senseless(freed, found)
    if senseless:
        return failed(f"it ended where {senseless}{where}; check units and signs, or give a prior.")
    if not estimate.converged:
        # It creeps along what the data do not determine.
        return dataclasses.replace(estimate, converged=True, result="converged within the noise")
    return estimate


def _senseless(freed: Freed, found: Uncertainty) -> str:
    """Which inertia no craft of the start's kind has, in words, or nothing; unsure ones may be right."""
    before = np.diag(np.asarray(freed.vehicle.mass_matrix))
    for p in found.parameters:
        kind, _, dof = p.name.removesuffix("]").partition("[")
        if kind not in ("added_mass", "body.matrix") or dof not in DOFS:
            continue
        whole = before[DOFS.index(dof)]
        off, ratio = _SURE * p.std_model / whole, 1.0 + (p.value - p.start) / whole
        if ratio + off < 1 / _OTHER_CRAFT or ratio - off > _OTHER_CRAFT:
            return f"the inertia in {dof} is {ratio:.2g} times that of the start"
    return ""


def _table(parameters: tuple[Parameter, ...]) -> list[str]:
    wide = max(len("parameter"), *(len(p.name) for p in parameters))
    titles = ("start", "value", "std model", "std windows")
    head = f"{'parameter':<{wide}}" + "".join(f" {title:>11}" for title in titles)
    rows = [
        f"{p.name:<{wide}} {p.start:>11.5g} {p.value:>11.5g} {p.std_model:>11.2g} {p.std_sandwich:>11.2g}"
        for p in parameters
    ]
    return [head, "-" * len(head), *rows]


def _undetermined(fit: Fit) -> list[str]:
    lines = [f"not determined by the data: {c}" for c in fit.undetermined[:_SHOWN]]
    more = len(fit.undetermined) - _SHOWN
    return [*lines, *([f"... and {more} more such combinations"] if more > 0 else [])]


def _coverage(fit: Fit) -> list[str]:
    def axis(c: AxisCoverage) -> str:
        low, high = c.velocity_range
        return f"{c.dof} {low:.2g} to {high:.2g}"

    if not fit.coverage:
        return []
    return ["velocities seen (m/s, rad/s): " + ", ".join(axis(c) for c in fit.coverage)]


def _ending(fit: Fit) -> str:
    return (
        f"{fit.loss} loss, chi-square per degree of freedom {fit.reduced_chi2:.3g}, "
        f"{fit.steps} steps: {fit.result}"
        + (f"; {len(fit.rejected)} windows rejected" if len(fit.rejected) else "")
    )
