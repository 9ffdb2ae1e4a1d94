"""Where rows come from: one file per kind of source."""

from pathlib import Path

from ..._errors import InputError
from ...logs import ColumnMap
from ...vehicle import Vehicle
from ._lines import Growing, Piped
from ._mavlink import Mavlink
from ._replayed import Replayed
from ._source import Source as Source

# Tables that grow line by line; all else that has a name is replayed as a whole.
_LINES = (".csv", ".txt", ".tsv")


def open_source(text: str, vehicle: Vehicle, columns: ColumnMap | None) -> Source:
    """The source that a text names: `-` (standard input), `udp://127.0.0.1:14550`, or a path.

    A CSV is followed while it grows, a `.tlog` is replayed message by message as it came over the link, any
    other recording (a ROS 2 bag, Parquet, ...) row by row. Raises `InputError` where there is no such thing.
    """
    if text == "-":
        return Piped(columns, vehicle.command_names)
    if "://" in text:
        scheme, _, address = text.partition("://")
        host, _, port = address.rpartition(":")
        if scheme != "udp" or not host or not port.isdigit():
            raise InputError(f"{text}: is no source; give - , udp://HOST:PORT, or the path of a recording.")
        return Mavlink(f"udpin:{host}:{port}", text, vehicle, columns)
    path = Path(text)
    if path.suffix.lower() in _LINES:
        return Growing(path, columns, vehicle.command_names)
    if path.suffix.lower() == ".tlog":
        return Mavlink(str(path), text, vehicle, columns)
    return Replayed(path, vehicle, columns)
