"""Engines that run the jobs: processes on this machine, or the workers of a Dask cluster.

An engine takes a function with its argument and returns a future. If a process dies, its job fails:
Pebble reports that job alone; Dask first tries it on another worker.
"""

import os
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from multiprocessing import get_context
from urllib.parse import urlsplit

from pebble import ProcessExpired, ProcessPool

from twin.errors import SourceError
from twin.extras import require
from twin.fleet.tasks import Done, Job

Submit = Callable[[Callable[[Job], Done], Job], Future[Done]]
CONNECT_S = 10.0
PORT = 8786  # Dask's


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local(workers: int) -> Iterator[Submit]:
    """Processes of this machine; an error in the block stops the running ones."""
    pool = ProcessPool(max_workers=workers, context=get_context("spawn"))
    try:
        yield lambda function, job: pool.schedule(function, args=(job,))
        pool.close()  # type: ignore[no-untyped-call]
    except BaseException:
        pool.stop()  # type: ignore[no-untyped-call]
        raise
    finally:
        pool.join()


@contextmanager
def dask(scheduler: str) -> Iterator[Submit]:
    """The workers of the scheduler at an address; ConfigError if Dask is not installed."""
    require("dask", "a Dask cluster")
    from distributed import Client  # noqa: PLC0415  # an extra

    address = urlsplit(scheduler)
    try:  # test the address first: a client that fails to connect leaves a thread behind
        socket.create_connection((address.hostname or "", address.port or PORT), CONNECT_S).close()
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        hint = "check the address (tcp://HOST:8786), and that 'dask scheduler' runs there"
        raise SourceError(f"{scheduler}: no Dask scheduler answers", hint) from error
    with client, client.get_executor(pure=False) as executor:  # type: ignore[no-untyped-call]
        yield executor.submit


def died(error: BaseException) -> bool:
    """Whether an engine's error means that the process of a job has died."""
    return isinstance(error, ProcessExpired) or type(error).__name__ == "KilledWorker"
