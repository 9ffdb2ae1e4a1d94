"""ROS 1 bags, ROS 2 bags and MCAP files, by the library rosbags."""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ..._errors import InputError
from ..._files import MOST_BYTES, file_to_hold
from ._paths import FieldPath, Fields
from ._series import Series, reading

# How files begin; the library would look for the end of the first line in all of another one.
_BEGINS = {".bag": b"#ROSBAG V", ".db3": b"SQLite format 3\0", ".mcap": b"\x89MCAP0\r\n"}
# Of the list of topics in a folder.
_MOST_METADATA = 10_000_000
_ADVICE = "copy it again, or repair its index by `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"


class Bag:
    """The topics of a bag.

    - `path`: a `.bag`, `.db3` or `.mcap` file, or the folder of a ROS 2 bag.
    - `stamp`: "header" takes the time in a message's header where it has one, "bag" that of recording.
    """

    def __init__(self, path: Path, stamp: str):
        self.path = path
        self.notes: list[str] = []
        self._by_header = stamp == "header"
        self._is_first = path.suffix.lower() == ".bag" and path.is_file()
        with self._reading():
            _check_begins(path)
        with self._reading(), self._reader() as reader:
            self._types = {name: (topic.msgtype, topic.msgcount) for name, topic in reader.topics.items()}
        self.names = tuple(self._types)

    def read(self, wanted: Collection[str]) -> dict[str, Series]:
        paths = [FieldPath.parse(text, self.names, "topic", self.path) for text in wanted]
        heads = {path.head for path in paths}
        for head in heads:
            self._check(head)
        samples: dict[str, list[tuple[float, float]]] = {path.text: [] for path in paths}
        unstamped = set()
        with self._reading(), self._reader() as reader:
            _refuse_absurd_chunks(reader, self.path)
            connections = [one for one in reader.connections if one.topic in heads]
            store = self._types_of(connections)
            fields = {kind: [name for name, _ in rows] for kind, (_, rows) in store.fielddefs.items()}
            decode = store.deserialize_ros1 if self._is_first else store.deserialize_cdr

            def fields_of(value: object) -> Collection[str]:
                # what a message's definition names can be reached, and no other attribute of the object
                return fields.get(getattr(value, "__msgtype__", ""), ())

            for connection, recorded, data in reader.messages(connections=connections):
                message = decode(data, connection.msgtype)
                measured = _header_time(message, fields_of) if self._by_header else None
                if measured is None:
                    unstamped.add(connection.topic)
                for path in paths:
                    if path.head == connection.topic:
                        value = path.number(message, fields_of, self.path)
                        samples[path.text].append((1e-9 * (measured or recorded), value))
        self._note(unstamped)
        return {text: Series(*np.array(found).reshape(-1, 2).T) for text, found in samples.items()}

    def _reading(self):
        return reading(self.path, "a ROS bag or MCAP file", _ADVICE)

    def _reader(self):
        # a bag is read in two goes, as its topics are wanted before anything is mapped
        import rosbags.rosbag1
        import rosbags.rosbag2

        return (rosbags.rosbag1 if self._is_first else rosbags.rosbag2).Reader(self.path)

    def _check(self, topic: str) -> None:
        kind, count = self._types[topic]
        if kind is None:
            raise InputError(
                f"{self.path}: topic `{topic}` holds messages of several types; record them apart."
            )
        if count == 0:
            raise InputError(f"{self.path}: topic `{topic}` has no message; check that its node was running.")

    def _types_of(self, connections: list):
        """The types of the messages that are read, and no others."""
        from rosbags.interfaces import MessageDefinitionFormat as Format
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        # Before ROS 2 Iron a bag names its types without defining them; the common ones are known.
        common = get_typestore(Stores.ROS2_HUMBLE)
        store, types = get_typestore(Stores.EMPTY), {}
        for connection in connections:
            definition = connection.msgdef
            if definition.format == Format.MSG:
                types |= get_types_from_msg(definition.data, connection.msgtype)
            elif definition.format == Format.IDL:
                for part in re.split(r"^=+\nIDL: .*\n", definition.data, flags=re.MULTILINE):
                    types |= get_types_from_idl(part) if part.strip() else {}
            elif connection.msgtype in common.fielddefs:
                types = common.fielddefs | types
            else:
                raise InputError(
                    f"{self.path}: topic `{connection.topic}` holds {connection.msgtype}, a type that the "
                    "bag does not define; convert it to MCAP where the type is installed, or record it anew."
                )
        store.register(types)
        return store

    def _note(self, unstamped: set[str]) -> None:
        if self._by_header and unstamped:
            topics = ", ".join(f"`{topic}`" for topic in sorted(unstamped))
            self.notes.append(
                f"The messages of {topics} have no time of their own and stand at that of recording."
            )


def _check_begins(path: Path) -> None:
    if path.is_dir():
        file_to_hold(path / "metadata.yaml", _MOST_METADATA)
    for file in path.iterdir() if path.is_dir() else [path]:
        begins = _BEGINS.get(file.suffix.lower())
        if begins is None:
            continue
        with file.open("rb") as stream:
            if stream.read(len(begins)) != begins:
                raise ValueError(f"{file.name} does not begin as such")


def _header_time(message: object, fields: Fields) -> int | None:
    """The time in a message's header [ns], None without one or where it was left at zero."""
    stamp = message
    for name in ("header", "stamp"):
        stamp = getattr(stamp, name) if name in fields(stamp) else None
    if not {"sec", "nanosec"} <= {*fields(stamp)}:
        return None
    return (10**9 * int(stamp.sec) + int(stamp.nanosec)) or None  # type: ignore[union-attr]


def _refuse_absurd_chunks(reader, path: Path) -> None:
    """MCAP states how long each chunk is when unpacked; a recorder's hold some megabytes."""
    whole = getattr(reader, "storage", None)  # a file, or a folder of several
    for storage in (whole, *getattr(whole, "storages", ())):
        for chunk in getattr(storage, "chunks", ()):
            if chunk.uncompressed_size > MOST_BYTES:
                raise InputError(
                    f"{path}: claims a chunk of {chunk.uncompressed_size / 1e9:.0f} GB, which no recorder "
                    "writes; record it anew."
                )
