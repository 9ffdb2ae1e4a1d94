"""From the axes of a foreign file to north-east-down and forward-right-down, by rotations."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .._angles import wrap_to_pi
from .._errors import InputError
from .._types import ATTITUDE, POSITION, TABLE, VELOCITY, WRENCH
from ._columns import GEODETIC, QUATERNION, Frame
from ._euler import angles_of, turns_of
from ._sources import Series

# What turns vectors of the foreign axes into ours; each is its own inverse.
_WORLD = {"ned": np.eye(3), "enu": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])}
_BODY = {"frd": np.eye(3), "flu": np.diag([1.0, -1.0, -1.0])}
_IN_BODY = (*(one.channels for one in TABLE if one.in_body), WRENCH[:3], WRENCH[3:])

# The ellipsoid of GPS (WGS 84): half its equator's diameter [m], and its eccentricity squared.
_RADIUS, _ECCENTRICITY = 6378137.0, 6.69437999014e-3
# No pitch is beyond 90 degrees, with room for noise [rad].
_STEEPEST = 1.8
# An attitude is interpolated between samples up to this many of its usual spacings apart.
_CLOSE = 3.0


def in_our_axes(series: Mapping[str, Series], frame: Frame, path: object) -> dict[str, Series]:
    """The contract's channels of what a map found, in north-east-down and forward-right-down.

    Quaternions become phi theta psi, latitude and longitude become x and y about the first fix, and
    velocities along world axes are turned into the body by the attitude of their time.
    """
    ours = dict(series)
    world, body = _WORLD[frame.world], _BODY[frame.body]
    if frame != Frame() and "theta" in ours and np.max(np.abs(ours["theta"].values)) > _STEEPEST:
        raise InputError(
            f"{path}: `theta` is up to {np.max(np.abs(ours['theta'].values)):.3g} rad, which no pitch is; if "
            'the attitude is in degrees, give its angles unit = "deg".'
        )
    if any(name in ours for name in QUATERNION):
        _attitude_of_quaternions(ours, path)
    attitude = _turned(ours, world, body)
    _exchange(ours, POSITION, world)
    for names in _IN_BODY:
        along_world = frame.velocity == "world" and names == VELOCITY
        _exchange(ours, names, world if along_world else body)
    ours |= attitude
    if frame.velocity == "world" and any(name in ours for name in VELOCITY):
        _into_the_body(ours, path)
    if any(name in ours for name in GEODETIC):
        _about_the_first_fix(ours, path)
    lost = [name for name, one in ours.items() if not len(one.t)]
    if lost:
        raise InputError(
            f"{path}: `{lost[0]}` is never measured near the attitude that turns it; map both from one run."
        )
    return ours


def _exchange(series: dict[str, Series], names: Sequence[str], axes: Float[np.ndarray, "3 3"]) -> None:
    """Turns a vector by a matrix of which each row holds one 1 or -1, so that no component needs another."""
    old = {name: series.pop(name) for name in names if name in series}
    for name, row in zip(names, axes, strict=True):
        source = int(np.argmax(np.abs(row)))
        if names[source] in old:
            t, values = old[names[source]]
            series[name] = Series(t, row[source] * values)


def _attitude_of_quaternions(series: dict[str, Series], path: object) -> None:
    """phi theta psi in place of w x y z, in the file's axes; a quaternion of zeros is a missing sample."""
    t, parts = _together(series, QUATERNION, path)
    for name in QUATERNION:
        del series[name]
    length = np.linalg.norm(parts, axis=1)
    whole = length > 0
    if np.any(np.abs(length[whole] - 1) > 0.1):
        raise InputError(
            f"{path}: its quaternions have lengths up to {np.max(length):.3g} instead of 1; check what the "
            "map names for `qw`, `qx`, `qy` and `qz`, or for `attitude`."
        )
    angles = angles_of(Rotation.from_quat(parts[whole], scalar_first=True))
    series |= {name: Series(t[whole], values) for name, values in zip(ATTITUDE, angles.T, strict=True)}


def _turned(
    series: Mapping[str, Series], world: Float[np.ndarray, "3 3"], body: Float[np.ndarray, "3 3"]
) -> dict[str, Series]:
    """phi theta psi between our axes, of those between the file's."""
    ours = {}
    if np.array_equal(world, np.eye(3)) and np.array_equal(body, np.eye(3)):
        return ours
    for index, name in enumerate(ATTITUDE):
        if name in series:
            t, turns = _rotation(series, series[name].t)
            turned = Rotation.from_matrix(world @ turns.as_matrix() @ body)
            ours[name] = Series(t, angles_of(turned)[:, index])
    return ours


def _into_the_body(series: dict[str, Series], path: object) -> None:
    """u v w of the velocity along north, east and down."""
    given = [name for name in VELOCITY if name in series]
    if "psi" not in series:
        raise InputError(
            f"{path}: velocities along world axes need the attitude, but no `psi` is mapped; map it, or "
            'leave out velocity = "world".'
        )
    measured, parts = _together(series, given, path)
    t, turns = _rotation(series, measured)
    along = np.zeros((len(t), 3))
    along[:, [VELOCITY.index(name) for name in given]] = parts[np.isin(measured, t)]
    within = turns.inv().apply(along)
    for name in given:
        series[name] = Series(t, within[:, VELOCITY.index(name)])


def _rotation(
    series: Mapping[str, Series], t: Float[np.ndarray, " times"]
) -> tuple[Float[np.ndarray, " seen"], Rotation]:
    """The attitude at those of some times that lie between close samples of its angles, and these times.

    An angle that is not measured is zero.
    """
    angles = np.zeros((len(t), 3))
    known = np.ones(len(t), bool)
    for index, name in enumerate(ATTITUDE):
        if name in series:
            times, values = series[name]
            angles[:, index] = np.interp(t, times, np.unwrap(values))
            before = np.searchsorted(times, t, side="right") - 1
            after = np.searchsorted(times, t)
            inside = (before >= 0) & (after < len(times))
            apart = times[np.where(inside, after, 0)] - times[np.where(inside, before, 0)]
            known &= inside & (apart <= _CLOSE * np.median(np.diff(times, append=np.inf)))
    return t[known], turns_of(angles[known])


def _about_the_first_fix(series: dict[str, Series], path: object) -> None:
    """x y z of latitude, longitude [deg] and altitude [m]: arcs on the ellipsoid about the first fix.

    z stays what a depth sensor shows, as it does not on a plane that touches the earth at the first fix.
    """
    if "altitude" in series:
        t, height = series.pop("altitude")
        series["z"] = Series(t, height[0] - height)
    if not {"latitude", "longitude"} & {*series}:
        return
    t, degrees = _together(series, GEODETIC[:2], path)
    del series["latitude"], series["longitude"]
    fixed = degrees.any(axis=1)  # a receiver without a fix tells zero, zero
    t, degrees = t[fixed], degrees[fixed]
    if np.any(np.abs(degrees) > [90.0, 360.0]):
        raise InputError(
            f"{path}: `latitude` or `longitude` exceeds what degrees can be; scale them, as by 1e-7 where "
            "they are integers."
        )
    if not len(t):
        raise InputError(f"{path}: `latitude` and `longitude` never have a fix; leave them out of the map.")
    away = np.radians(degrees - degrees[0])
    sine = np.sin(np.radians(degrees[0, 0]))
    bend = 1 - _ECCENTRICITY * sine**2
    north = _RADIUS * (1 - _ECCENTRICITY) / bend**1.5 * away[:, 0]
    east = _RADIUS / np.sqrt(bend) * np.sqrt(1 - sine**2) * wrap_to_pi(away[:, 1])
    series |= {"x": Series(t, north), "y": Series(t, east)}


def _together(
    series: Mapping[str, Series], names: Sequence[str], path: object
) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times parts"]]:
    """The samples of parts of one quantity at the times that they share."""
    missing = [name for name in names if name not in series]
    if missing:
        raise InputError(
            f"{path}: the column map lacks `{missing[0]}`, without which "
            f"`{next(name for name in names if name in series)}` cannot be used; map it too."
        )
    t = series[names[0]].t
    for name in names[1:]:
        t = np.intersect1d(t, series[name].t)
    if not len(t):
        raise InputError(
            f"{path}: {', '.join(f'`{name}`' for name in names)} share no time; take them from one message."
        )
    return t, np.stack([s.values[np.searchsorted(s.t, t)] for s in (series[name] for name in names)], axis=1)
