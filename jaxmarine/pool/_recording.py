"""The files of a flight: a log that grows by whole rows, and when which fault was on."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

from .._errors import InputError

# In the folder of the flights, by their numbers.
FLIGHT, FAULTS, VEHICLE = "flight-{}.csv", "faults-{}.csv", "vehicle.toml"


class Rows:
    """A CSV file that grows: each row is written by one call, so that nobody ever finds half of one."""

    def __init__(self, path: Path, names: Iterable[str]):
        self.path, self.count, self._size = path, 0, 0
        try:
            self._file: int | None = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except OSError as error:
            raise self._refused(error) from error
        self._write(names)

    def append(self, cells: Iterable[str]) -> None:
        if self._file is None:
            raise InputError(f"{self.path}: has ended; start the pool again.")
        self._write(cells)
        self.count += 1

    def _write(self, cells: Iterable[str]) -> None:
        assert self._file is not None
        line = (",".join(cells) + "\n").encode()
        try:
            if os.write(self._file, line) < len(line):
                raise OSError("the disk is full")
        except OSError as error:
            # What a full disk has taken of the row goes.
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._size)
            raise self._refused(error) from error
        self._size += len(line)

    def _refused(self, error: OSError) -> InputError:
        reason = (error.strerror or str(error)).lower()
        return InputError(f"{self.path}: cannot be written, because {reason}; choose another --out.")

    def close(self) -> None:
        """Ends the file; one without a row is removed."""
        if self._file is None:
            return
        os.close(self._file)
        self._file = None
        if not self.count:
            self.path.unlink(missing_ok=True)


def next_flight(folder: Path) -> int:
    """The number of the first flight that a folder has no files of."""
    number = 1
    while any((folder / name.format(number)).exists() for name in (FLIGHT, FAULTS)):
        number += 1
    return number
