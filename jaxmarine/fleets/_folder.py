"""What a fleet has come to so far, in its folder: one run writes, and the next goes on where it ended."""

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from .._errors import InputError
from .._files import write_together
from ._job import Outcome

_OUTCOME = "outcome.json"


class Folder:
    """Outcomes by the names of their logs, each with its report in `logs/NAME`, beside the key of its job."""

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keeps other runs out; raises `InputError` where one is in. The system lets go with the process."""
        try:
            (self.path / "logs").mkdir(parents=True, exist_ok=True)
            lock = (self.path / ".running").open("w")
        except OSError as error:
            raise InputError(
                f"{self.path}: is no folder that can be written; choose another --out."
            ) from error
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(
                    f"{self.path}: another run writes into this folder; wait for it, or choose another --out."
                ) from error
            yield

    def report(self, name: str) -> Path:
        """The folder of a log's report."""
        return self.path / "logs" / name

    def known(self, name: str, key: str) -> Outcome | None:
        """The outcome of a job, without the files of its report, if it is here and final."""
        try:
            kept = json.loads((self.report(name) / _OUTCOME).read_text("utf-8"))
            if kept["key"] == key and kept["final"]:
                return Outcome(tuple(kept["rows"]), {}, kept["error"])
        except (OSError, ValueError, KeyError, TypeError):
            pass  # not there, or not ours: the job is done again
        return None

    def keep(self, name: str, key: str, outcome: Outcome) -> None:
        """Writes an outcome with its report, in place of the one before."""
        folder = self.report(name)
        # The outcome goes first and comes last: a run that is killed between leaves none.
        (folder / _OUTCOME).unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        whole = {"key": key, "final": outcome.final, "error": outcome.error, "rows": outcome.rows}
        files = {_OUTCOME: json.dumps(whole, indent=1).encode(), **outcome.files}
        for file in files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
        write_together(folder, files)
