"""A Dask cluster of real processes on this machine: a scheduler, and workers of one thread."""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

_DASK = [sys.executable, "-m", "dask"]
_QUIET = ["--no-dashboard", "--host", "127.0.0.1"]


@dataclass
class Cluster:
    """A scheduler and its workers."""

    address: str
    workers: list["subprocess.Popen[str]"]


@contextmanager
def cluster(workers: int) -> Iterator[Cluster]:
    """Start a scheduler and workers, each a process with one thread."""
    with contextlib.ExitStack() as ending:
        scheduler = _start(ending, "scheduler", "--port", "0", *_QUIET)
        address = _read_until(scheduler, r"Scheduler at:\s+(tcp://\S+)")
        processes = [
            _start(ending, "worker", address, "--nthreads", "1", "--no-nanny", *_QUIET)
            for _ in range(workers)
        ]
        for worker in processes:
            _read_until(worker, r"Registered to:\s+(\S+)")
        yield Cluster(address, processes)


def _start(ending: contextlib.ExitStack, *arguments: str) -> "subprocess.Popen[str]":
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # as Dask's nannies set it
    process = subprocess.Popen(
        [*_DASK, *arguments], stderr=subprocess.PIPE, text=True, env=environment
    )
    ending.callback(_end, process)
    return process


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def _read_until(process: "subprocess.Popen[str]", pattern: str) -> str:
    output = []
    assert process.stderr is not None
    for line in process.stderr:
        output.append(line)
        if match := re.search(pattern, line):
            return match[1]
    raise RuntimeError(f"ended (exit code {process.wait()}):\n{''.join(output)}")
