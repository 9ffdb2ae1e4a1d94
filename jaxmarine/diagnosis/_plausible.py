"""Whether more is missing than a disturbance can be: a bound on forces, from its own thrust."""

import dataclasses
from collections.abc import Container, Sequence

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats

from .._types import DOFS
from ..logs import Log
from ..networks import LearnedWrench
from ..vehicle import Vehicle, reach
from ._criteria import DEFAULT
from ._result import Excess, Finding, MissingWrench

# What begins or ends within a log is larger over a part of it than over the whole [s]; what is over sooner
# may be a wave or a collision.
STRETCH = 3.0
# Probability that noise alone feigns as much over a stretch: a long log has thousands of them.
CHANCE = 1e-7


def full_thrust(vehicle: Vehicle) -> Float[np.ndarray, "6"]:
    """The largest wrench [N, N m] that commands can give on each axis."""
    plant = vehicle.plant()
    drive = plant.drive
    thrust = np.maximum(drive.max_thrust, drive.max_thrust_reverse)
    most = np.abs(thrust * drive.gain * drive.saturation)[: len(vehicle.thruster_names)]
    return np.abs(np.asarray(plant.allocation)) @ most + reach(plant)


def excesses(
    missing: MissingWrench,
    vehicles: Sequence[Vehicle],
    logs: Sequence[Log],
    phi: float,
    known: Container[str | None] = (),
    quiet: float = 1.0,
    steerable: float = DEFAULT.steerable,
) -> tuple[Finding, ...]:
    """Where more is missing than a disturbance can be: of each axis the time at which it is most.

    Forces are compared with the full thrust of the strongest axis, moments likewise: wind and water push
    from all sides, and no less where the craft has no thrust against them.

    - `vehicles`: the craft by its file and by what was found: the stronger counts, as a thruster that has
      failed calms no sea. Of logs of wrenches the largest in them counts too.
    - `logs`: those that `missing` counts; `phi`: dispersion of the scores (`_search.dispersion`).
    - `known`: axes of which it is told already that something unknown acts there.
    - `quiet`: noise of the sensors alone over that by which `missing` has its standard errors: where the
      latter was raised to what the model misses, it is the question.
    - `steerable`: as of `Criteria`. Peaks of a random force are some three times its root mean square: one of
      a sixth of the full thrust, which is a rough sea, stays below the default.
    """
    given = [np.abs(log.wrench).max(axis=0) for log in logs if log.wrench is not None]
    most = np.max([*map(full_thrust, vehicles), *given], axis=0)
    missing = dataclasses.replace(missing, std=quiet * missing.std)
    found = []
    for axis in vehicles[0].axes:
        kind = slice(0, 3) if axis < 3 else slice(3, 6)
        strongest = kind.start + int(np.argmax(most[kind]))
        # A towed body has no thrust to compare with.
        if DOFS[axis] not in known and most[strongest] > 0:
            strength = float(most[strongest])
            found.append(_largest(missing, axis, strongest, strength, steerable * strength, logs, phi))
    return tuple(one for one in found if one is not None)


def _largest(
    missing: MissingWrench,
    axis: int,
    strongest: int,
    strength: float,
    bound: float,
    logs: Sequence[Log],
    phi: float,
) -> Finding | None:
    """The worst stretch on an axis with those that adjoin it, as far as they are beyond the bound."""
    worst, out = 1.0, None
    for i, log in enumerate(logs):
        t, wrench, std = (a[missing.log == i] for a in (missing.t, missing.wrench, missing.std))
        if len(t) < 2:  # a log that gave no window, or none to speak of
            continue
        wrench, std, knot = wrench[:, axis], std[:, axis], float(np.median(np.diff(t)))
        count = min(max(1, round(STRETCH / knot)), len(t))
        # The estimate of a force has its noise in it, whose size is known.
        squares = wrench**2 - std**2
        most_noise = stats.chi2.isf(CHANCE, count) / count * std**2
        times = sliding_window_view(wrench**2 - most_noise, count).mean(axis=1) / bound**2
        if times.max() <= worst:
            continue
        worst, at = times.max(), int(np.argmax(times))
        fine = np.flatnonzero(times <= 1.0)
        first, last = max(fine[fine < at], default=-1) + 1, min(fine[fine > at], default=len(times)) - 1
        # A stretch that is beyond the bound may begin before the force does, and end after it.
        loud = first + np.flatnonzero(np.abs(wrench[first : last + count]) > bound)
        part = slice(loud[0], loud[-1] + 1)
        rms = float(np.sqrt(squares[part].mean()))
        excess = Excess(
            log=log.name,
            # A knot's time is its middle.
            begin=float(t[part][0] - knot / 2),
            end=float(t[part][-1] + knot / 2),
            log_begin=float(log.t[0]),
            rms=rms,
            peak=float(np.abs(wrench[part]).max()),
            unit="N" if axis < 3 else "N m",
            share=rms / strength,
            strongest=DOFS[strongest],
        )
        saved = 0.5 * float((squares[part] / std[part] ** 2).sum()) / phi
        out = Finding(LearnedWrench.name, DOFS[axis], None, None, {}, saved, excess=excess)
    return out


def told(finding: Finding) -> str:
    """What a finding's excess says, in a sentence."""
    e = finding.excess
    assert e is not None
    what = "moment" if e.unit == "N m" else "force"
    return (
        f"{finding.target}: from {e.begin - e.log_begin:.1f} to {e.end - e.log_begin:.1f} s after the start "
        f"of {e.log} (t = {e.begin:.1f} to {e.end:.1f}) a {what} of {e.rms:.3g} {e.unit} is missing (root "
        f"mean square; at most {e.peak:.3g}), {e.share:.2f} of the full thrust in {e.strongest}: "
        "more than a disturbance in which a craft can be steered, and no known cause or signal explains it."
    )
