"""Jobs on the workers of dask.distributed: a cluster of this machine's cores, or a scheduler by its address.

An engine that exists: its scheduler gives the job of a worker that dies to another one, and its nannies start
workers anew. What is added here: a job whose workers die again and again becomes an outcome with a sentence,
and one that takes too long ends its worker.
"""

import asyncio
import contextlib
import importlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from .._errors import InputError
from .._extras import of_extra
from ._job import Job, Outcome

Work = Callable[[Job], Outcome]

# How often a job may lose its worker before that is told; other schedulers have numbers of their own. Once
# more than it takes, as a job that waits behind one that ends its worker is counted too.
_LOSSES = 3
# Of a worker's time that has passed, and of its words on it the way to the scheduler [s].
_TOLD = 1.0
# How long a scheduler is waited for [s], and workers of it.
_PATIENCE = 20.0
# One thread for the programs of each process: as many processes as cores then wait for nothing they share.
_ONE_THREAD = {"NPROC": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# How often the cluster is asked for its size [s].
_ASKED = 5.0
_LATE = "jaxmarine-late"


def worked(
    jobs: Mapping[str, Job],
    work: Work,
    scheduler: str | None = None,
    workers: int | None = None,
    limit: float = 3600.0,
) -> Iterator[tuple[str, Outcome]]:
    """The outcomes of jobs by their names, as they come.

    - `scheduler`: its address; None: a cluster of `workers` processes on this machine, default one per core.
    - `limit` [s]: of one job, after which its worker ends.

    As many jobs are under way as there are threads, so that hardly any waits behind one that ends its worker.
    """
    distributed = _distributed()
    with client_of(scheduler, workers) as client:
        waiting = iter(jobs.items())
        names: dict[Any, str] = {}
        running = distributed.as_completed(loop=client.loop)

        def begin() -> bool:
            name, job = next(waiting, (None, None))
            if name is None or job is None:
                return False
            future = client.submit(_within, work, job, limit, key=f"diagnosis-{job.key}-{name}", pure=False)
            names[future] = name
            running.add(future)
            return True

        while len(names) < _threads(client) and begin():
            pass
        for future in running:
            name = names.pop(future)
            yield name, _outcome(distributed, client, future, jobs[name].name, limit)
            future.release()
            while len(names) < _threads(client) and begin():
                pass


def _distributed() -> Any:
    with of_extra("fleet", "A fleet"):
        return importlib.import_module("distributed")


@contextlib.contextmanager
def client_of(scheduler: str | None, workers: int | None) -> Iterator[Any]:
    """A client of a scheduler, or of a cluster that is this machine's as long as it is held."""
    distributed = _distributed()
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            config = {
                "distributed.scheduler.allowed-failures": _LOSSES - 1,
                # Nothing is spilt, and what a program takes does not come back by waiting: a worker is ended
                # before the machine runs out, and its job is tried again.
                "distributed.worker.memory.target": False,
                "distributed.worker.memory.spill": False,
                "distributed.worker.memory.pause": False,
                "distributed.worker.memory.terminate": 0.95,
            }
            stack.enter_context(importlib.import_module("dask.config").set(config))
            count = workers or _cores()
            # What nannies say of workers that end is told by the rows.
            scheduler = stack.enter_context(
                distributed.LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    # Other clusters of this machine keep their ports.
                    scheduler_kwargs={"dashboard_address": ":0"},
                    silence_logs=logging.CRITICAL,
                    env=_ONE_THREAD,
                )
            )
            stack.enter_context(_kept_up(scheduler, count))
        else:
            asyncio.run(_answers(scheduler))
        client = stack.enter_context(distributed.Client(scheduler, timeout=_PATIENCE, set_as_default=False))
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise InputError(f"--scheduler {scheduler}: has no workers; start some.") from error
        yield client


@contextlib.contextmanager
def _kept_up(cluster: Any, count: int) -> Iterator[None]:
    """A cluster that always comes back to so many workers.

    A nanny starts its worker anew, but not one that ends before it has quite begun; the cluster replaces
    those when it is asked for its size.
    """
    over = threading.Event()

    def ask() -> None:
        while not over.wait(_ASKED):
            cluster.scale(count)

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    try:
        yield
    finally:
        over.set()
        asking.join()


async def _answers(scheduler: str) -> None:
    """Raises `InputError` where nothing answers at an address; a client would try on while it ends."""
    connect = importlib.import_module("distributed.comm").connect
    try:
        comm = await connect(scheduler, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {scheduler}: does not answer; check the address, such as tcp://10.0.0.1:8786."
        ) from error
    await comm.close()


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0))


def _threads(client: Any) -> int:
    """At least one: where all workers are gone, jobs wait for new ones."""
    return max(sum(client.nthreads().values()), 1)


def _within(work: Work, job: Job, limit: float) -> Outcome:
    """The work, on a worker; the process ends where it takes longer than it may."""
    worker = _distributed().get_worker()

    def end() -> None:
        try:
            worker.log_event(_LATE, job.name)
            time.sleep(_TOLD)
        finally:
            # Whether or not the scheduler still hears of it. Compiled programs listen to nothing else.
            os._exit(1)

    watch = threading.Timer(limit, end)
    watch.daemon = True
    watch.start()
    try:
        return work(job)
    finally:
        watch.cancel()


def _outcome(distributed: Any, client: Any, future: Any, name: str, limit: float) -> Outcome:
    """What a job came to, whatever happened to it."""
    try:
        return future.result()
    except distributed.KilledWorker:
        late = any(told == name for _, told in client.get_events(_LATE))
        why = (
            f"it took longer than {limit:g} s; give a shorter part of it, or a larger --limit."
            if late
            else "its worker process ended each time, killed or out of memory; diagnose it alone, or with "
            "fewer --workers."
        )
        return Outcome(error=f"{name}: {why}", final=False)
    except Exception as error:
        words = " ".join(str(error).split())[:300]
        return Outcome(
            error=f"{name}: the diagnosis failed ({type(error).__name__}: {words}); please report it.",
            final=False,
        )
