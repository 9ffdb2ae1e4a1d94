"""What motion a fit has seen: outside it the fitted vehicle extrapolates."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .._types import ACCELERATIONS, ALL_CHANNELS, DOFS
from ..logs import Log, smooth_states

# Of the range of a velocity, for the time spent in each.
_PARTS = 9


@dataclasses.dataclass(frozen=True)
class AxisCoverage:
    """Standard deviation and range of an axis' velocity and acceleration [m, rad, s].

    - `velocity_rms`: root mean square; `velocity_middle`: what it stays within for 90 % of the time.
    - `velocity_shares`: of the time, in equal parts of `velocity_range`.
    """

    dof: str
    velocity_std: float
    velocity_rms: float
    velocity_range: tuple[float, float]
    velocity_middle: tuple[float, float]
    velocity_shares: tuple[float, ...]
    acceleration_std: float
    acceleration_range: tuple[float, float]


def coverage(logs: Sequence[Log], dof: Sequence[str]) -> tuple[AxisCoverage, ...]:
    """Coverage of each free axis, from smoothed velocities and, where measured, accelerations."""
    velocities, accelerations = [], []
    for log in logs:
        nu = smooth_states(log, dof).nu
        velocities.append(nu)
        accelerations.append(acceleration_of(log, nu))
    nu, nu_dot = np.concatenate(velocities), np.concatenate(accelerations)
    out = []
    for i, name in enumerate(DOFS):
        if name in dof:
            v, a = nu[:, i], nu_dot[:, i][np.isfinite(nu_dot[:, i])]
            low, high = np.quantile(v, (0.05, 0.95)).tolist()
            out.append(
                AxisCoverage(
                    dof=name,
                    velocity_std=float(v.std()),
                    velocity_rms=float(np.sqrt((v**2).mean())),
                    velocity_range=(float(v.min()), float(v.max())),
                    velocity_middle=(low, high),
                    # Without the mean: numbers that differ in the last digit only have no bins between them.
                    velocity_shares=tuple((np.histogram(v - v.mean(), _PARTS)[0] / len(v)).tolist()),
                    acceleration_std=float(a.std()),
                    acceleration_range=(float(a.min()), float(a.max())),
                )
            )
    return tuple(out)


def acceleration_of(log: Log, nu: np.ndarray) -> np.ndarray:
    """nu' [times, 6]: samples of a measured channel (NaN in gaps), else the slope of `nu`."""
    slope = np.gradient(nu, log.t, axis=0)
    measured = log.channels[:, ACCELERATIONS]
    seen = np.isin(ALL_CHANNELS[ACCELERATIONS], log.measured)
    return np.where(seen, measured, slope)
