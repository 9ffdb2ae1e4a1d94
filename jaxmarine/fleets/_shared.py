"""Logs that lie on workers, for a fit and a diagnosis that leave them there."""

import contextlib
import itertools
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from .._errors import InputError
from .._start import prepare
from ..fitting import AbstractShares, Share
from ..logs import read_logs
from ..vehicle import Vehicle
from ._engine import client_of
from ._paths import at_hand


class _Remote(AbstractShares):
    """Shares that are actors of dask.distributed."""

    def __init__(self, actors: Sequence[Any]):
        self._actors = actors

    def ask(self, question: str, *given: Any, each: Sequence[tuple] | None = None) -> list[Any]:
        own = each or [()] * len(self._actors)
        # All are asked before the first answer is waited for.
        answers = [getattr(one, question)(*given, *more) for one, more in zip(self._actors, own, strict=True)]
        return [answer.result() for answer in answers]


@contextlib.contextmanager
def shared(
    vehicle: Vehicle, logs: Sequence[str], *, scheduler: str | None = None, workers: int | None = None
) -> Iterator[AbstractShares]:
    """Logs dealt out to workers, each of which reads its own, for `jaxmarine.fit` and `jaxmarine.diagnose`:

        with jm.fleets.shared(vehicle, paths) as logs:
            fit = jm.fit(vehicle, logs, free=...)
            diagnosis = jm.diagnose(vehicle, logs, test)

    Statistics are summed on the workers; gradients and information travel. Fit and diagnosis are those of one
    process within rounding.

    - `logs`: paths or URLs that the workers see, in order of time.
    - `scheduler`, `workers`: as of `fleet`.

    Raises `InputError` for a log that cannot be used; where a worker is lost, all is to be made again.
    """
    if not logs:
        raise InputError("There is no log to deal out to workers; give the path of at least one.")
    # Actors speak by the client that is the current one.
    with client_of(scheduler, workers) as client, client.as_current():
        addresses = list(client.nthreads())[: len(logs)]
        size, more = divmod(len(logs), len(addresses))
        ends = [i * size + min(i, more) for i in range(len(addresses) + 1)]
        futures = [
            client.submit(_share, vehicle, list(logs[begin:end]), actor=True, workers=[address], pure=False)
            for address, (begin, end) in zip(addresses, itertools.pairwise(ends), strict=True)
        ]
        yield _Remote([future.result() for future in futures])


def _share(vehicle: Vehicle, places: Sequence[str]) -> Share:
    """A share, on its worker."""
    prepare()
    with tempfile.TemporaryDirectory() as folder:
        return Share(vehicle, read_logs([at_hand(place, Path(folder)) for place in places], vehicle))
