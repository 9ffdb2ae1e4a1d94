"""Formats of recorded messages: one file per format, one line each in `RECORDINGS`."""

import os
from pathlib import Path

from ..._errors import InputError
from ..._files import existing_file, file_to_hold
from ._bags import Bag
from ._dataflash import DataFlash
from ._matlab import read_matlab as read_matlab
from ._series import Recording as Recording
from ._series import Series as Series
from ._telemetry import Telemetry

RECORDINGS = {".bag": Bag, ".db3": Bag, ".mcap": Bag, ".bin": DataFlash, ".tlog": Telemetry}


def is_recording(path: Path) -> bool:
    """Whether a path leads to messages with their own times, not to a table."""
    return path.suffix.lower() in RECORDINGS or os.path.isfile(path / "metadata.yaml")


def open_recording(path: Path, stamp: str) -> Recording:
    """The recording there; a folder is a ROS 2 bag. `stamp`: "header" or "bag"."""
    if os.path.isfile(path / "metadata.yaml"):
        return Bag(path, stamp)
    if existing_file(path).stat().st_size == 0:
        raise InputError(f"{path}: is empty; check that the recording was not cut off.")
    kind = RECORDINGS[path.suffix.lower()]
    if kind is not Bag:  # bags hold pictures too, of which nothing is read
        file_to_hold(path)
    return kind(path, stamp)
