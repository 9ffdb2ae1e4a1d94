"""The grossest errors first: what is wrong with signs, columns, axes and times before any number is fitted.

By kinematics, whatever forces act, and by the signs with which the vehicle answers its thrusters, whatever
their sizes are. A coefficient that bends to such an error means nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._types import DOFS
from ..effects import (
    CATALOGUE,
    ExchangedThrusters,
    SensorDelay,
    SensorEffect,
    Suspect,
    ThrusterGain,
    place,
)
from ..logs import Log
from ..vehicle import Placed, Vehicle
from ._feedback import answers
from ._kinematics import Contradiction, contradiction, kinematics, misread
from ._responses import USUAL, Reading, confirmed, opposite, read_otherwise, responses
from ._reversed import reversed_columns


class GrossError(NamedTuple):
    """What is grossly wrong, in a sentence, and the causes of the catalogue that it is; none has no name.

    - `evidence` [nats]: by which it is likelier than that log and file agree.
    - `instead`: of a single cause, others by which axes answer as they do by it.
    """

    told: str
    causes: tuple[Placed, ...]
    evidence: float
    instead: tuple[Placed, ...] = ()


def gross_errors(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[GrossError, ...]:
    """What is grossly wrong with logs and vehicle file together; mostly nothing.

    What is `misconnected`, columns of propellers, surfaces and swivels that act the wrong way, and sensors
    that contradict one another in a way that the catalogue names: earth axes, a compass that deviates, those
    that come late (`contradiction`).
    """
    wrong = misconnected(vehicle, logs)
    if any(not one.causes for one in wrong):
        return wrong
    suspects = _sensing(vehicle)
    found = contradiction(vehicle, logs, suspects)
    wrong = (*wrong, *_of_others(vehicle, logs))
    return wrong if found is None else (*wrong, *_of_sensors(vehicle, logs, suspects, found))


def misconnected(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[GrossError, ...]:
    """Sensors of the wrong sign, axis or unit (`misread`); where there are none, columns of commands that are
    exchanged or of the wrong sign, and axes that answer the wrong way (`read_otherwise`).
    """
    wrong = misread(vehicle, logs)
    if wrong is None:
        return _of_columns(vehicle, logs)
    words, evidence = wrong
    put_right = contradiction(vehicle, logs, _sensing(vehicle))
    if put_right is not None and put_right.evidence > evidence:
        return _of_columns(vehicle, logs)
    told = f"{words[0].upper()}{words[1:]}: positions, attitude and velocities contradict one another."
    return (GrossError(told, (), evidence),)


def _sensing(vehicle: Vehicle) -> list[Suspect]:
    sensing = [cls for cls in CATALOGUE if issubclass(cls, SensorEffect | SensorDelay)]
    return [suspect for cls in sensing for suspect in cls.suspects(vehicle)]


def _of_sensors(
    vehicle: Vehicle, logs: Sequence[Log], suspects: Sequence[Suspect], found: Contradiction
) -> tuple[GrossError, ...]:
    suspect, values = suspects[found.suspect], found.values
    dt = float(np.median([log.dt for log in logs]))
    told = suspect.effect.contradicts(suspect.target, values, dt)
    if not told:
        return ()
    cause = Placed(place(suspect, vehicle, values), suspect.target)
    return (GrossError(told, (cause,), found.evidence),)


def _of_columns(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[GrossError, ...]:
    seen = responses(vehicle, logs)
    readings = () if seen is None else read_otherwise(seen)
    if seen is None or not readings:
        return ()
    spread = USUAL
    if any(map(answers, logs)):
        # Of what an axis answers a controller hides a part, up to all of it.
        spread = np.inf
        readings = read_otherwise(seen, spread)
    # Where one sensor comes late, or water goes on moving, what is said of the others hangs on the time.
    otherwise = responses(vehicle, logs, apart=True)
    readings = () if otherwise is None else confirmed(readings, read_otherwise(otherwise, spread))
    if not readings:
        return ()
    agreed = _agreed(vehicle, logs)
    # Where sensors that measure an axis twice agree, its sign is right.
    kept = [one for one in readings if not {*one.axes} & agreed] or list(readings)
    named = [one for one in kept if not one.axes]
    causes, *others = [_causes(vehicle, one) for one in named] or [()]
    instead = tuple(other[0] for other in others if len(causes) == len(other) == 1)
    axes, thrusters = opposite(seen)
    ways = ", or ".join(dict.fromkeys(_words(one) for one in kept))
    what = (
        f"{_listed(axes).capitalize()} answer{'s' if len(axes) == 1 else ''} opposite to {_listed(thrusters)}"
    )
    head = what if axes else "The vehicle does not answer its thrusters as the file says"
    # A mirrored log is one whose sensors agree.
    mirrored = any({*one.axes} & {"sway", "yaw"} for one in readings if one not in kept)
    other = ", or the log is mirrored (y, psi, v and r all have the wrong sign)" if mirrored else ""
    return (GrossError(f"{head}: {ways}{other}.", causes, readings[0].odds, instead),)


def _of_others(vehicle: Vehicle, logs: Sequence[Log]) -> tuple[GrossError, ...]:
    """Columns of propellers, surfaces and swivels that act the wrong way: a diagnosis has names for these."""
    return tuple(
        GrossError(
            f"{one.axis.capitalize()} answers opposite to {one.column} ({one.factor:.1f} times what the file "
            f"says): the column of {one.column} has the wrong sign, or the file its axis or direction.",
            (),
            0.5 * one.sigmas**2,
        )
        for one in reversed_columns(vehicle, logs)
    )


def _agreed(vehicle: Vehicle, logs: Sequence[Log]) -> set[str]:
    """Axes whose sensors positions and attitude confirm, none of which was found misread."""
    seen = kinematics(vehicle, logs)
    if seen is None:
        return set()
    measured = np.asarray(np.isfinite(seen.logged).any(axis=0))
    # A heading is confirmed by the track and velocities together, its rate by itself.
    found = {dof for dof, known in zip(DOFS, measured, strict=True) if known}
    return found if {"surge", "sway"} <= found else found - {"yaw"}


def _causes(vehicle: Vehicle, reading: Reading) -> tuple[Placed, ...]:
    """The exchanges and the gains of the wrong sign that a reading is."""
    out = []
    for pair in reading.exchanged:
        target = "+".join(sorted(pair, key=vehicle.thruster_names.index))
        out.append(Placed(ExchangedThrusters(), target))
    gains = {suspect.target: suspect for suspect in ThrusterGain.suspects(vehicle)}
    every = len(vehicle.thruster_names) > 1 and {*reading.turned} == {*vehicle.thruster_names}
    for name in ("all",) if every else reading.turned:
        out.append(Placed(place(gains[name], vehicle, {"factor": -1.0}), name))
    return tuple(out)


def _words(reading: Reading) -> str:
    parts = [f"the columns of {_listed(pair)} are exchanged" for pair in reading.exchanged]
    if reading.columns:
        many = "columns of {} have" if len(reading.columns) > 1 else "column of {} has"
        parts.append(f"the {many.format(_listed(reading.columns))} the wrong sign")
    parts += [f"{axis} has the wrong sign in the log or in the file" for axis in reading.axes]
    return " and ".join(parts)


def _listed(names: Sequence[str]) -> str:
    return " and ".join(names) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"
