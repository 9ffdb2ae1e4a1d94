"""From a file to a `Log`, and back; every rule of the log format is checked here."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._errors import InputError
from .._extras import of_extra
from .._files import listed
from .._types import ALL_CHANNELS, ATTITUDE, BATTERY, WRENCH, width_of
from ._clean import clean
from ._columns import ColumnMap, read_columns
from ._craft import Craft, free_motions, free_wrench
from ._log import Log
from ._notes import Note

with of_extra("files", "A log in a file"):
    import pandas as pd

    from ._mapped import MappedFile, from_start, open_mapped
    from ._table import write_table
    from ._wind import add_true_wind

# Fewer samples than this hold no window that could be compared with a simulation.
_MIN_ROWS = 10

# A column map's scale is rounded (0.0274 for 1 / 36.5), so that full thrust comes out as 1.0001:
# commands beyond the limit by less than this share are set to the limit, with a note.
_ROUNDING = 1e-3
# A jump by which an angle in degrees is wrapped; in radians it would be more than a turn and a half.
_DEGREES = 3 * np.pi
# What an accelerometer shows of the earth's pull [m/s²]; where on the earth makes no difference here.
_GRAVITY = 9.81


def read_log(
    source: str | os.PathLike[str] | pd.DataFrame,
    vehicle: Craft,
    columns: str | os.PathLike[str] | ColumnMap | None = None,
) -> Log:
    """Read a recording and check that `vehicle` can have driven it.

    - `source`: a CSV (also .csv.gz), Parquet or MATLAB file, a data frame of pandas, a ROS 1 bag, a ROS 2 bag
      (its folder, .db3 or .mcap), a DataFlash log (.BIN) or MAVLink telemetry (.tlog).
    - `columns`: where a foreign file keeps the columns of the contract, in which units and axes: a
      `ColumnMap` or the path of its TOML file. What holds messages needs one.

    Spikes and dropouts count as missing (`clean`). What is ignored or repaired stands in the log's `notes`;
    what cannot be used raises `InputError` with one sentence.
    """
    if columns is not None and not isinstance(columns, ColumnMap):
        columns = read_columns(columns)
    file = open_mapped(source, vehicle, columns)
    t = _time(file)
    channels = np.full((len(t), len(ALL_CHANNELS)), np.nan)
    for index, name in enumerate(ALL_CHANNELS):
        if name in file:
            channels[:, index] = file[name]
    channels = channels[:, : width_of(np.asarray(np.isfinite(channels).any(axis=0)))]
    _check_motion(file, channels, vehicle.dof)
    add_true_wind(file, t, channels, vehicle)
    commands, wrench = _drive(file, vehicle)
    file.note_ignored()
    name = "DataFrame" if isinstance(source, pd.DataFrame) else Path(source).name
    log = Log(
        t=t,
        channels=channels,
        commands=commands,
        wrench=wrench,
        command_names=tuple(vehicle.command_names),
        battery=_battery(file, vehicle),
        name=name,
        notes=tuple(Note.on(name, sentence) for sentence in file.notes),
    )
    return clean(log)


def read_logs(
    paths: Sequence[str | os.PathLike[str]], vehicle: Craft, columns: ColumnMap | None = None
) -> list[Log]:
    """The recordings at some paths; of several one that cannot be used is left out, and a note says so."""
    logs, wrong = [], []
    for path in paths:
        try:
            logs.append(read_log(path, vehicle, columns))
        except InputError as error:
            wrong.append(error)
    if not logs:
        raise wrong[0]
    logs[0] = dataclasses.replace(logs[0], notes=(*(f"Left out: {error}" for error in wrong), *logs[0].notes))
    return logs


def write_log(log: Log, path: str | os.PathLike[str]) -> None:
    """Write a log in the contract's columns, as CSV or Parquet by the name of `path`."""
    data = {"t": log.t}
    data |= {name: log.channels[:, ALL_CHANNELS.index(name)] for name in log.measured}
    if log.commands is not None:
        data |= dict(zip(log.command_names, log.commands.T, strict=True))
    if log.battery is not None:
        data[BATTERY] = log.battery
    if log.wrench is not None:
        data |= dict(zip(WRENCH, log.wrench.T, strict=True))
    write_table(pd.DataFrame(data), path)


def _time(file: MappedFile) -> np.ndarray:
    if "t" not in file:
        raise InputError(
            f"{file.path}: has no column `t` (time in seconds); rename it, or map it by a column "
            f"map; the file has {listed(file.file_names)}."
        )
    t = file["t"]
    if len(t) < _MIN_ROWS:
        raise InputError(
            f"{file.path}: has {len(t)} row{'s' * (len(t) != 1)}, but a log needs at least "
            f"{_MIN_ROWS}; record for longer."
        )
    empty = np.flatnonzero(np.isnan(t))
    if len(empty):
        raise InputError(
            f"{file.path}: column {file.label('t')} is empty in {file.place(int(empty[0]))}; "
            "give every row a time."
        )
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        row = int(back[0]) + 1
        # all digits, as times that look alike may differ in the last one
        raise InputError(
            f"{file.path}: time {file.label('t')} must strictly increase, but is "
            f"{float(t[row])!r} s in {file.place(row)}, after {float(t[row - 1])!r} s; sort the rows "
            "and remove repeated ones."
        )
    t, told = from_start(t)
    file.notes.extend(told)
    return t


def _check_motion(file: MappedFile, channels: np.ndarray, dof: Sequence[str]) -> None:
    """The free axes are seen by position with attitude, or by velocity with rates or attitude."""
    finite = np.isfinite(channels)
    seen = {name for index, name in enumerate(ALL_CHANNELS[: channels.shape[1]]) if finite[:, index].any()}
    hollow = [name for name in ALL_CHANNELS if name in file and name not in seen]
    motions = pose, velocity, _ = free_motions(tuple(dof))
    if not any(map(seen.issuperset, motions)):
        nearer = min(motions, key=lambda names: len(set(names) - seen))
        empty = [name for name in nearer if name in hollow]
        if empty:
            raise InputError(
                f"{file.path}: column {file.label(empty[0])} has no value in any row; fill it, or "
                f"give the other set: {listed(velocity if nearer == pose else pose)}."
            )
        raise InputError(
            f"{file.path}: lacks {listed(file.missing(nearer))}; a log of this vehicle needs "
            f"position with attitude ({listed(pose)}) or velocity ({listed(velocity)}, for whose rates "
            "the attitude may stand): add the columns or map them by a column map."
        )
    for name in hollow:
        file.notes.append(f"Column {file.label(name)} has no value and counts as not measured.")
    for name in ATTITUDE:
        values = channels[finite[:, ALL_CHANNELS.index(name)], ALL_CHANNELS.index(name)]
        turns = np.count_nonzero(np.abs(np.diff(values)) > np.pi)
        if turns:
            file.notes.append(f"Column {file.label(name)} is wrapped {turns} times; it counts modulo a turn.")
        if np.abs(np.diff(values)).max(initial=0.0) > _DEGREES:
            file.notes.append(f"Column {file.label(name)} jumps by more than a turn: is it in degrees?")
    for name in ATTITUDE[:2]:
        if name not in seen:
            continue
        size = np.abs(channels[:, ALL_CHANNELS.index(name)])
        if np.nanmax(size) > 2 * np.pi:
            file.notes.append(f"Column {file.label(name)} exceeds 2 pi: is it in degrees instead of radians?")
        if np.nanmedian(size) > np.pi / 2:
            file.notes.append(
                f"Column {file.label(name)} is about {np.nanmedian(size):.2g} rad most of the time, as of a "
                "vehicle on its back: is its frame right?"
            )
    if "fz" in seen:
        middle = np.nanmedian(channels[:, ALL_CHANNELS.index("fz")])
        # Half more or less is no error of a sensor, nor a roll that a craft keeps for most of a log.
        if not -1.5 * _GRAVITY < middle < -0.5 * _GRAVITY:
            file.notes.append(
                f"Column {file.label('fz')} is about {middle:.2g} m/s² most of the time, but a craft at rest "
                f"and level shows {-_GRAVITY:g}: is it in g, of the other sign, or without gravity?"
            )


def _drive(file: MappedFile, vehicle: Craft) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The commands, or else the wrench, without gaps."""
    thrusters, wrench = vehicle.command_names, free_wrench(vehicle.dof)
    given = [name for name in WRENCH if name in file]
    if thrusters and not file.missing(thrusters):
        if given:
            file.notes.append(f"The commands drive; the wrench {listed(given)} is ignored.")
        return _commands(file, vehicle), None
    if not file.missing(wrench):
        commands = [name for name in thrusters if name in file]
        if commands:
            file.notes.append(
                f"The wrench drives, as {listed(file.missing(thrusters))} is missing; "
                f"{listed(commands)} is ignored."
            )
        held = [_held(file, name) if name in file else np.zeros(len(file["t"])) for name in WRENCH]
        return None, np.stack(held, axis=1)
    if not thrusters:
        raise InputError(
            f"{file.path}: lacks {listed(file.missing(wrench))}; the vehicle has no thruster, so "
            f"its log needs the applied wrench {listed(wrench)}."
        )
    raise InputError(
        f"{file.path}: lacks {listed(file.missing(thrusters))}; a log needs one command column "
        f"per thruster ({listed(thrusters)}) or the applied wrench ({listed(wrench)}): add the "
        "columns or map them by a column map."
    )


def _commands(file: MappedFile, vehicle: Craft) -> np.ndarray:
    columns = []
    for name, limit in zip(vehicle.command_names, vehicle.command_limits, strict=True):
        command = _held(file, name)
        beyond = np.flatnonzero(np.abs(command) > limit * (1 + _ROUNDING))
        if len(beyond):
            row = int(beyond[0])
            raise InputError(
                f"{file.path}: command {file.label(name)} is {command[row]:.6g} in {file.place(row)} "
                f"(t = {file['t'][row]:.6g} s), outside [{-limit:g}, {limit:g}]; scale it by a "
                "column map, or correct the row."
            )
        if np.any(np.abs(command) > limit):
            file.notes.append(
                f"Command {file.label(name)} exceeds {limit:g} by up to "
                f"{np.max(np.abs(command)) - limit:.1g}, taken for rounding, and is set to it."
            )
        columns.append(np.clip(command, -limit, limit))
    return np.stack(columns, axis=1)


def _battery(file: MappedFile, vehicle: Craft) -> np.ndarray | None:
    """Its voltage, if it is no command; empty cells hold the last value, the first one before that."""
    if BATTERY not in file or BATTERY in vehicle.command_names or np.isnan(file[BATTERY]).all():
        return None
    return pd.Series(file[BATTERY]).ffill().bfill().to_numpy()


def _held(file: MappedFile, name: str) -> np.ndarray:
    """A command whose empty cells hold the last value, zero before the first."""
    values = file[name]
    empty = np.isnan(values)
    if empty.all():
        raise InputError(
            f"{file.path}: column {file.label(name)} has no value in any row; fill it, with 0 "
            "where nothing was commanded."
        )
    if empty.any():
        file.notes.append(
            f"Column {file.label(name)} has {np.count_nonzero(empty)} empty cells, which hold the "
            "last value (zero before the first)."
        )
        values = pd.Series(values).ffill().fillna(0.0).to_numpy()
    return values
