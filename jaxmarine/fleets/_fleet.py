"""A whole fleet: every log of a table diagnosed, each with its report, one table and one page of all."""

import dataclasses
import os
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._extras import of_extra
from .._files import written_whole
from .._program import program
from .._progress import Progress, silent
from ._engine import Work, worked
from ._folder import Folder
from ._job import Job, Outcome, job_of

with of_extra("fleet", "A fleet"):
    import pandas as pd

    from ._page import page
    from ._rows import Row, frame_of
    from ._table import Entry, read_entries
    from ._work import diagnosed


@dataclasses.dataclass(frozen=True)
class Fleet:
    """What a fleet has come to.

    - `table`: what `fleet.parquet` holds, a row per log and finding, in the order of the table of logs.
    - `page`: of all logs. `again`: how many outcomes were there from a run before.
    """

    table: pd.DataFrame
    page: Path
    again: int

    @property
    def verdicts(self) -> Counter[str]:
        """Logs by their verdicts; those that could not be used count as `error`."""
        logs = self.table.drop_duplicates("name")
        return Counter("error" if pd.isna(one) else str(one) for one in logs["verdict"])


def fleet(
    table: str | os.PathLike[str] | pd.DataFrame,
    out: str | os.PathLike[str],
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    limit: float = 3600.0,
    progress: Progress = silent,
) -> Fleet:
    """Diagnoses every log of a table, on all cores of this machine or the workers of a scheduler.

    Writes `fleet.parquet`, `index.html` and `logs/NAME/` with a report per log into the folder `out`. A log
    that cannot be used, takes too long or takes its worker down again and again is a row with a sentence.
    Stopped and started again, it goes on: what the same program made of the same files is not made again.

    - `table`: CSV or Parquet, a path or URL, or a data frame, with the columns `vehicle`, `train`, `test`
      and, if you like, `name`, `craft`, `date`. `train` and `test` are paths or globs, separated by `;`, in
      order of time; relative ones are so to the table's folder. URLs are read by fsspec.
    - `scheduler`: address of one of dask.distributed, whose workers have this program and see the paths;
      default: a cluster of `workers` processes here, one per core. A script that calls it does so below `if
      __name__ == "__main__":`, as these processes import it.
    - `limit` [s]: of one log, after which it is tried again, and given up in the end.

    Answers are those of `diagnose`, whatever the number of workers. Raises `InputError` for a table that
    cannot be used, a folder into which another run writes, and a scheduler that does not answer.
    """
    return run(table, out, diagnosed, scheduler, workers, limit, progress)


def run(
    table: str | os.PathLike[str] | pd.DataFrame,
    out: str | os.PathLike[str],
    work: Work,
    scheduler: str | None,
    workers: int | None,
    limit: float,
    progress: Progress = silent,
) -> Fleet:
    """`fleet`, with whatever work is done on a log."""
    with tempfile.TemporaryDirectory() as scratch:
        entries = read_entries(table, Path(scratch))
    folder = Folder(out)
    with folder.held():
        outcomes, jobs = _begun(entries, folder)
        again = sum(one.final for one in outcomes.values())
        wrong = sum(one.error is not None for one in outcomes.values())
        progress(_said(len(outcomes), len(entries), wrong))
        for name, outcome in worked(jobs, work, scheduler, workers, limit) if jobs else ():
            folder.keep(name, jobs[name].key, outcome)
            outcomes[name] = outcome
            wrong += outcome.error is not None
            progress(_said(len(outcomes), len(entries), wrong))
        rows = [row for entry in entries for row in _rows(entry, outcomes[entry.slug])]
        frame = frame_of(rows)
        with written_whole(folder.path / "fleet.parquet") as beside:
            frame.to_parquet(beside, index=False)
        with written_whole(folder.path / "index.html") as beside:
            beside.write_text(page(rows), "utf-8", errors="replace")
    return Fleet(frame, folder.path / "index.html", again)


def _begun(entries: tuple[Entry, ...], folder: Folder) -> tuple[dict[str, Outcome], dict[str, Job]]:
    """What is known already, by the names of the logs, and what is to be done."""
    outcomes: dict[str, Outcome] = {}
    jobs: dict[str, Job] = {}
    # The sources are read for it: once for all logs.
    by = program()
    for entry in entries:
        try:
            job = job_of(entry, by)
        except InputError as error:
            outcomes[entry.slug] = Outcome(error=str(error), final=False)
            continue
        known = folder.known(entry.slug, job.key)
        if known is None:
            jobs[entry.slug] = job
        else:
            outcomes[entry.slug] = known
    return outcomes, jobs


def _said(done: int, of: int, wrong: int) -> str:
    return f"{done} of {of} logs" + (f", {wrong} of them could not be used" if wrong else "")


def _rows(entry: Entry, outcome: Outcome) -> list[Row]:
    """The rows of a log: what the table of logs says of it, and what it came to."""
    what: dict[str, Any] = {
        "name": entry.name,
        "craft": entry.craft,
        "date": entry.date,
        "vehicle": entry.vehicle,
        "train": entry.train,
        "test": entry.test,
        "error": outcome.error,
        "report": None if outcome.error else f"logs/{entry.slug}/index.html",
    }
    return [what | row for row in outcome.rows or ({},)]
