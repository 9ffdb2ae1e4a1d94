"""What motion a fit has seen: outside it the fitted vehicle extrapolates."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from .._types import CHANNELS, DOFS
from ..logs import Log, smooth_states


@dataclasses.dataclass(frozen=True)
class AxisCoverage:
    """Standard deviation and range of an axis' velocity and acceleration [m, rad, s]."""

    dof: str
    velocity_std: float
    velocity_range: tuple[float, float]
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
            ranges = [(float(x.min()), float(x.max())) for x in (v, a)]
            out.append(AxisCoverage(name, float(v.std()), ranges[0], float(a.std()), ranges[1]))
    return tuple(out)


def acceleration_of(log: Log, nu: np.ndarray) -> np.ndarray:
    """nu' [times, 6]: samples of a measured channel (NaN in gaps), else the slope of `nu`."""
    slope = np.gradient(nu, log.t, axis=0)
    measured = log.channels[:, 12:]
    seen = np.isin(CHANNELS[12:], log.measured)
    return np.where(seen, measured, slope)
