"""What is to be done with one log of a fleet, and what came of it.

A worker knows it without the rest of the package, and so begins at once.
"""

import dataclasses
import hashlib
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from .._files import read_toml
from ._paths import at_hand, content, joined

if TYPE_CHECKING:
    from ._rows import Row
    from ._table import Entry


@dataclasses.dataclass(frozen=True)
class Job:
    """A diagnosis that is to be made.

    - `key`: of the content of all files, their names and the program: the same answer has the same key.
    - `vehicle`, `arrays`, `train`, `test`: paths or URLs; `arrays`: of learned terms, beside the vehicle
      file.
    - `program`: the one that is to answer.
    """

    key: str
    name: str
    vehicle: str
    arrays: tuple[str, ...]
    train: tuple[str, ...]
    test: tuple[str, ...]
    program: str


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What came of a job: rows of the table and the files of the report, or a sentence that says why not.

    - `final`: whether the same job would come to the same again; one whose worker was lost may not.
    """

    rows: tuple["Row", ...] = ()
    files: dict[str, bytes] = dataclasses.field(default_factory=dict)
    error: str | None = None
    final: bool = True


def job_of(entry: "Entry", program: str) -> Job:
    """The job of a row of the table; raises `InputError` where its files are not there.

    - `program`: the one that is to answer (`_program`).
    """
    vehicle, train, test = entry.files()
    arrays = _arrays(vehicle)
    # Names count, as they stand in the answer; where the files lie does not.
    what = [
        [[Path(place).name, content(place)] for place in places]
        for places in ((vehicle, *arrays), train, test)
    ]
    key = hashlib.sha256(json.dumps([program, what]).encode()).hexdigest()
    return Job(key, entry.name, vehicle, arrays, train, test, program)


def _arrays(vehicle: str) -> tuple[str, ...]:
    """The files beside a vehicle file that it names."""
    with tempfile.TemporaryDirectory() as folder:
        tables = read_toml(at_hand(vehicle, Path(folder)))
    effects = tables.get("effect", [])
    names = (
        [one.get("arrays") for one in effects if isinstance(one, dict)] if isinstance(effects, list) else []
    )
    folder = vehicle.rpartition("/")[0] or "."
    return tuple(joined(folder, name) for name in names if isinstance(name, str))
