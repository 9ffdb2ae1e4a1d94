"""The wind over the ground, from the one that was measured on the craft."""

import numpy as np
import pandas as pd

from .._errors import InputError
from .._files import listed
from .._types import ALL_CHANNELS, APPARENT_WIND, WIND
from ._clean import clean
from ._craft import Craft
from ._euler import matrices_of
from ._log import Log
from ._mapped import MappedFile
from ._states import smooth_states


def add_true_wind(file: MappedFile, t: np.ndarray, channels: np.ndarray, vehicle: Craft) -> None:
    """Adds the columns of the true wind to a file that has those of the apparent one in their place.

    The air that passes the craft goes with the wind less the craft's own velocity over ground; heading and
    velocity are the measured ones, smoothed. Along the measured motion the wind on the craft is then the
    logged one. Raises `InputError` where both pairs are given, or one column of the apparent one alone.
    """
    given = [name for name in APPARENT_WIND if name in file]
    if not given:
        return
    true = [name for name in WIND if name in file]
    if true:
        raise InputError(
            f"{file.path}: has both {listed(true)} and {listed(given)}, which say the same wind; leave out "
            "one of the pairs."
        )
    missing = file.missing(APPARENT_WIND)
    if missing:
        raise InputError(
            f"{file.path}: has {listed(given)} without {listed(missing)}; add it, or give {listed(WIND)}."
        )
    psi = ALL_CHANNELS.index("psi")
    if "yaw" in vehicle.dof and not np.isfinite(channels[:, psi]).any():
        raise InputError(
            f"{file.path}: lacks `psi`, without which {listed(APPARENT_WIND)} cannot be turned to north; add "
            f"it, or give {listed(WIND)}."
        )
    speed, angle = (_filled(file, name, vehicle) for name in APPARENT_WIND)
    log = clean(Log(t, channels, None, np.zeros((len(t), 6)), (), str(file.path)))
    track = smooth_states(log, vehicle.dof)
    # The wind is level: its two parts in earth axes are those that show so in the plane of the craft.
    ahead = -speed * np.cos(angle) + track.nu[:, 0]
    starboard = -speed * np.sin(angle) + track.nu[:, 1]
    level = np.swapaxes(matrices_of(track.attitude), -1, -2)[:, :2, :2]
    north, east = np.linalg.solve(level, np.stack([ahead, starboard], axis=1)[:, :, None])[:, :, 0].T
    file.add(WIND[0], np.hypot(north, east))
    file.add(WIND[1], np.arctan2(-east, -north))
    file.notes.append(
        f"{listed(WIND)} are those of {listed(APPARENT_WIND)} and of the measured heading and velocity."
    )


def _filled(file: MappedFile, name: str, vehicle: Craft) -> np.ndarray:
    """A column of the apparent wind; empty cells hold the last value, the first one before that."""
    values, true = pd.Series(file[name]), WIND[APPARENT_WIND.index(name)]
    if values.isna().all():
        raise InputError(f"{file.path}: column {file.label(name)} has no value in any row; fill it.")
    limit = float(vehicle.command_limits[list(vehicle.command_names).index(true)])
    beyond = np.flatnonzero(values.abs() > limit)
    if len(beyond):
        row = int(beyond[0])
        raise InputError(
            f"{file.path}: column {file.label(name)} is {values[row]:.6g} in {file.place(row)}, outside "
            f"[{-limit:g}, {limit:g}]; give m/s and radians, or correct the row."
        )
    return values.ffill().bfill().to_numpy()
