"""Vehicles in files: TOML read into a `Vehicle` and written back, learned terms beside it."""

import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ._errors import InputError
from ._files import did_you_mean, file_to_hold, validated, written_whole
from .actuators import KINDS, AbstractKind, Supply, Swivels
from .effects import CATALOGUE, AbstractEffect, Suspect, place
from .networks import LEARNED, LearnedTerm
from .vehicle import Body, Damping, Placed, Thrusters, Vehicle
from .vehicle_file import (
    AnyVehicleFile,
    EffectEntry,
    file_model,
    read_vehicle_file,
    rigid_body,
    write_vehicle_file,
)

# Numbers of a thruster beside its place.
_OF_THRUSTER = (
    "max_thrust",
    "max_thrust_reverse",
    "quadratic",
    "advance_loss",
    "deadband",
    "lag",
    "delay",
    "saturation",
)
_LEARNED = {cls.name: cls for cls in LEARNED}
# The networks of a learned term hold some thousand numbers.
_MOST_ARRAY_BYTES = 100_000_000
# What reading a file raises that holds no such arrays.
_DAMAGED = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    EOFError,
    MemoryError,
    RecursionError,
    NotImplementedError,  # a way of packing that Python does not know
    zipfile.BadZipFile,
    zlib.error,
)


def suspect_named(craft, effect: str, target: str | None, catalogue=CATALOGUE) -> Suspect:
    """The catalogue's suspect of that effect and target; ValueError says what there is instead."""
    by_name = {cls.name: cls for cls in catalogue}
    if effect not in by_name:
        raise ValueError(f"names `{effect}`, which is no known effect; {did_you_mean(effect, by_name)}")
    suspects = by_name[effect].suspects(craft)
    for suspect in suspects:
        if suspect.target == target:
            return suspect
    targets = ", ".join(str(suspect.target) for suspect in suspects)
    if not suspects:
        raise ValueError(
            f"is `{effect}`, which this vehicle's free axes and thrusters do not allow; leave it out."
        )
    raise ValueError(f"has the target `{target}`, but `{effect}` takes one of: {targets}.")


def cause_named(vehicle: Vehicle, text: str) -> Placed:
    """A cause as words, `EFFECT[:TARGET] parameter=value ...`, acting throughout; raises `InputError`."""
    label, *assignments = text.split() or [""]
    effect, _, target = label.partition(":")
    values = {}
    try:
        suspect = suspect_named(vehicle, effect, target or None)
        for assignment in assignments:
            name, _, value = assignment.partition("=")
            if name not in suspect.slots:
                raise ValueError(f"has no parameter `{name}`; give {', '.join(suspect.slots)}.")
            try:
                values[name] = float(value)
            except ValueError as error:
                raise ValueError(f"needs a number after `{name}=`, not `{value}`.") from error
        missing = [name for name in suspect.slots if name not in values]
        if missing:
            raise ValueError(f"needs a value of {missing[0]}, such as `{label} {missing[0]}=1.0`.")
    except ValueError as error:
        raise InputError(f"Cause `{label}` {error}") from error
    return Placed(place(suspect, vehicle, values), suspect.target)


def with_effect(vehicle: Vehicle, label: str) -> tuple[Vehicle, int]:
    """The vehicle with an effect `EFFECT[:TARGET]` in it, and its place among those; raises `InputError`.

    One that it has stays as it is. Another begins where it changes nothing, or where that has no slope at the
    first value that a fit is to begin from.
    """
    effect, _, target = label.partition(":")
    try:
        suspect = suspect_named(vehicle, effect, target or None)
        if not suspect.slots:
            raise ValueError("has no number that could be fitted.")
    except ValueError as error:
        raise InputError(f"Effect `{label}` {error}") from error
    for i, placed in enumerate(vehicle.placed):
        if isinstance(placed.effect, suspect.effect) and placed.target == suspect.target:
            return vehicle, i
    start = suspect.starts[0] if suspect.starts else {}
    return vehicle.place(Placed(place(suspect, vehicle, start), suspect.target)), len(vehicle.placed)


def _check_effect(entry: EffectEntry, file: AnyVehicleFile) -> None:
    if entry.effect in _LEARNED:
        if entry.arrays is None or not entry.inputs:
            raise ValueError("is a learned term and needs `arrays` and `inputs`.")
        for key, given in (("since", entry.since is not None), *((name, True) for name in entry.parameters)):
            if given:
                raise ValueError(f"is a learned term, which has no `{key}`; remove it.")
        _LEARNED[entry.effect].check(file, entry.target, entry.inputs)
    elif entry.arrays is not None or entry.inputs:
        raise ValueError(
            f"has `arrays` or `inputs`, which only a learned term (`{'`, `'.join(_LEARNED)}`) has."
        )


def _vehicle(file: AnyVehicleFile) -> Vehicle:
    def column(name: str, width: tuple[int, ...] = ()):
        # Only the thrust astern may be left out, which zero stands for.
        values = [getattr(thruster, name) or 0.0 for thruster in file.thruster]
        return jnp.asarray(np.array(values, float).reshape(len(values), *width))

    def number(value):
        return jnp.asarray(np.array(value, float))

    return Vehicle(
        body=Body(
            matrix=number(file.rigid_body_matrix),
            mass=number(file.body.mass),
            cog=number(file.body.cog),
            cob=number(file.body.cob),
            weight=number(file.weight),
            buoyancy=number(file.buoyancy),
        ),
        added_mass=number(file.added_mass_matrix),
        damping=Damping(number(file.linear), number(file.quadratic)),
        thrusters=Thrusters(
            position=column("position", (3,)),
            direction=column("direction", (3,)),
            **{name: column(name) for name in _OF_THRUSTER},
        ),
        density=number(file.environment.density),
        gravity=number(file.environment.gravity),
        placed=(),
        name=file.name,
        dof=file.dof,
        thruster_names=file.thruster_names,
        sensors=tuple(file.sensors.stated().items()),
        prior=tuple(file.prior.stated().items()),
        actuators=file.actuators,
        masses=file.masses,
    )


def load_vehicle(
    path: str | os.PathLike[str],
    catalogue: tuple[type[AbstractEffect], ...] = CATALOGUE,
    kinds: tuple[type[AbstractKind], ...] = KINDS,
) -> Vehicle:
    """Reads a vehicle file with its effects; raises `InputError` with one sentence.

    - `catalogue`: the effects that entries may name; pass `(*CATALOGUE, YourEffect)` for one of your own.
    - `kinds`: of actuators that may have tables; pass `(*KINDS, YourActuators)` likewise.
    """
    file = read_vehicle_file(path, _check_effect, kinds)
    vehicle = _vehicle(file)
    placed = []
    for number, entry in enumerate(file.effect, start=1):
        if entry.effect in _LEARNED:
            effect = _load_learned(Path(path), entry, file)
        else:
            try:
                suspect = suspect_named(vehicle, entry.effect, entry.target, catalogue)
                unknown = [name for name in entry.parameters if name not in entry_names(suspect)]
                if unknown:
                    raise ValueError(
                        f"has the parameter `{unknown[0]}`; `{entry.effect}` has "
                        f"{', '.join(entry_names(suspect)) or 'none'}."
                    )
                if suspect.slots and not entry.parameters:
                    raise ValueError(
                        f"is `{entry.effect}` without any parameter; give {', '.join(suspect.slots)}."
                    )
            except ValueError as error:
                raise InputError(f"{path}: `effect[{number}]` {error}") from error
            used = {name: value for name, value in entry.parameters.items() if name in suspect.slots}
            effect = place(suspect, vehicle, used)
        placed.append(Placed(effect, entry.target, entry.since, entry.since_log))
    return vehicle.place(*placed)


def entry_names(suspect: Suspect) -> tuple[str, ...]:
    """The parameters that a file may give; those that a locked axis makes idle are allowed."""
    return tuple(suspect.effect.units)


def _load_learned(path: Path, entry: EffectEntry, file: AnyVehicleFile) -> LearnedTerm:
    beside = file_to_hold(path.parent / str(entry.arrays), _MOST_ARRAY_BYTES)
    try:
        with zipfile.ZipFile(beside) as packed:
            size = sum(part.file_size for part in packed.infolist())
        if size > _MOST_ARRAY_BYTES:
            raise ValueError(f"it claims {size / 1e6:.0f} MB when unpacked")
        with np.load(beside, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name], float) for name in stored.files}
        return _LEARNED[entry.effect].restored(arrays, file, entry.target, entry.inputs)
    except _DAMAGED as error:
        raise InputError(
            f"{beside}: is no file of arrays of a learned term ({error}); copy it once more from where the "
            "vehicle file was written."
        ) from error


def _parameters(placed: Placed, vehicle: Vehicle) -> Mapping[str, float]:
    suspect = suspect_named(vehicle, placed.effect.name, placed.target, (type(placed.effect),))
    return dict(zip(suspect.slots, suspect.values(placed.effect).tolist(), strict=True))


def save_vehicle(vehicle: Vehicle, path: str | os.PathLike[str]) -> None:
    """Writes the vehicle with its effects as TOML; arrays of learned terms as `.npz` beside it."""
    path = Path(path)
    entries = []
    for number, placed in enumerate(vehicle.placed):
        entry: dict = {"effect": placed.effect.name, "target": placed.target}
        entry |= {"since": placed.since, "since_log": placed.since_log}
        if isinstance(placed.effect, LearnedTerm):
            kind = placed.target or placed.effect.name
            beside = path.with_name(f"{path.stem}_{kind}_{number}.npz")
            with written_whole(beside) as whole, open(whole, "wb") as stream:
                np.savez(stream, allow_pickle=False, **placed.effect.arrays())
            entry |= {"arrays": beside.name, "inputs": placed.effect.inputs}
        else:
            entry |= {"parameters": dict(_parameters(placed, vehicle))}
        entries.append({key: value for key, value in entry.items() if value is not None})
    thrusters = vehicle.thrusters
    body = vehicle.body
    matrix, cog = np.asarray(body.matrix), np.asarray(body.cog)
    mass, inertia = float(body.mass), matrix[3:, 3:]
    # Where mass, inertia and cog say it all, a reader who edits them is to change the vehicle.
    told = np.array_equal(matrix, rigid_body(mass, inertia, cog))
    others = [one for one in (*vehicle.actuators, *vehicle.masses) if not isinstance(one, Swivels | Supply)]
    supply = next((one for one in vehicle.actuators if isinstance(one, Supply)), None)
    kinds = tuple(dict.fromkeys((*KINDS, *map(type, others))))
    axes = {
        one.names[i]: np.asarray(axis)
        for one in vehicle.actuators
        if isinstance(one, Swivels)
        for i, axis in enumerate(one.axis)
    }
    file = validated(
        file_model(kinds),
        {
            "schema": 1,
            "name": vehicle.name,
            "dof": vehicle.dof,
            "environment": {"density": float(vehicle.density), "gravity": float(vehicle.gravity)},
            "body": {
                "mass": mass,
                "inertia": inertia,
                "cog": cog,
                "cob": np.asarray(body.cob),
                "weight": float(body.weight),
                "buoyancy": float(body.buoyancy),
                "mass_matrix": None if told else matrix,
            },
            "added_mass": {"matrix": np.asarray(vehicle.added_mass)},
            "damping": {
                "linear": np.asarray(vehicle.damping.linear),
                "quadratic": np.asarray(vehicle.damping.quadratic),
            },
            "thruster": [
                {
                    "name": name,
                    "position": np.asarray(thrusters.position[i]),
                    "direction": np.asarray(thrusters.direction[i]),
                    **_thruster_numbers(thrusters, i),
                    "swivel": axes.get(name),
                    **({} if supply is None else supply.of_thruster(name)),
                }
                for i, name in enumerate(vehicle.thruster_names)
            ],
            "sensors": dict(vehicle.sensors),
            "prior": dict(vehicle.prior),
            "effect": entries,
            **{one.key: one.tables()[0] if one.single else one.tables() for one in others},
        },
        str(path),
    )
    write_vehicle_file(file, path)


def _thruster_numbers(thrusters: Thrusters, i: int) -> dict[str, float]:
    numbers = {key: float(getattr(thrusters, key)[i]) for key in _OF_THRUSTER}
    # Left out, it is as `max_thrust`.
    if numbers["max_thrust_reverse"] in (0.0, numbers["max_thrust"]):
        del numbers["max_thrust_reverse"]
    return numbers


def packaged_vehicle(name: str) -> Path:
    """The file of a vehicle that comes with the package, such as `tethra`."""
    return Path(__file__).parent / "vehicles" / f"{name}.toml"
