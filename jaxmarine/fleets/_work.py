"""The work of one worker: a log diagnosed, from its files to what is kept of it."""

import ctypes
import dataclasses
import gc
import os
import tempfile
from pathlib import Path

from .._compiled import let_go
from .._errors import InputError
from .._program import program
from .._start import prepare
from ..diagnosis import diagnose
from ..logs import read_logs
from ..reports import write_report
from ..vehicle_io import load_vehicle, save_vehicle
from ._job import Job, Outcome
from ._paths import at_hand
from ._rows import rows_of

# Memory maps of a process from which on its compiled programs are let go: Linux gives a process 65530, and
# one diagnosis adds a few thousand at most. And memory [bytes] that has come since they were let go the last
# time: what stays then is not theirs, and to let go for its sake, after each log, would win nothing.
# Programs are kept on disk as well, and loaded again in a second or two.
_MAPS, _MEMORY = 20_000, 1.5e9


def diagnosed(job: Job) -> Outcome:
    """Diagnoses a log as `jaxmarine diagnose` does, in a process that may have diagnosed others before."""

    prepare()
    try:
        if program() != job.program:
            raise InputError(
                f"{job.name}: the worker runs jaxmarine {program()}, not {job.program}; install the same one "
                "on all machines."
            )
        with tempfile.TemporaryDirectory() as folder:
            return _diagnosed(job, Path(folder))
    except InputError as error:
        return Outcome(error=str(error))
    finally:
        _let_go()


def _diagnosed(job: Job, folder: Path) -> Outcome:
    for place in job.arrays:
        at_hand(place, folder / "vehicle")
    craft = load_vehicle(at_hand(job.vehicle, folder / "vehicle"))
    train, test = (
        read_logs([at_hand(place, folder / part) for place in places], craft)
        for part, places in (("train", job.train), ("test", job.test))
    )
    result = diagnose(craft, train, test)
    out = folder / "report"
    write_report(result, out)
    save_vehicle(result.extended, out / "extended.toml")
    files = {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}
    return Outcome(tuple(rows_of(result)), files)


@dataclasses.dataclass
class _Stayed:
    """Memory that stays in a process without compiled programs [bytes]: at first that of its libraries."""

    memory: float = 0.5e9


_STAYED = _Stayed()


def _let_go() -> None:
    """Gives free memory back, and lets compiled programs go where the process holds much all the same."""
    if not Path("/proc/self/maps").exists():
        return
    _trim()
    if _maps() > _MAPS or _memory() > _STAYED.memory + _MEMORY:
        let_go()
        gc.collect()
        _trim()
        _STAYED.memory = _memory()


def _maps() -> int:
    """Memory maps of this process."""
    return len(Path("/proc/self/maps").read_bytes().splitlines())


def _memory() -> int:
    """Memory that this process takes up [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _trim() -> None:
    """Gives memory that is free back to the system: glibc would hold it for as long as the process lives."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
