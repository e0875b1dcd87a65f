"""A small fleet's logs, and a Dask cluster of real processes."""

import contextlib
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rigs

from tools.calibration_coverage import shipped
from tools.fleet_trial import write_log
from twin.config import Config

CYCLES = 5
_DASK = [sys.executable, "-m", "dask"]
_QUIET = ["--no-dashboard", "--host", "127.0.0.1"]


def write(folder: Path, unit: str, seed: int, faults: tuple[str, ...] = ()) -> Path:
    """A log of a unit on the tank rig."""
    config = Config.of(shipped("test_rig"), unit=unit)
    samples, _ = rigs.recorded("test_rig", 3.1 * (CYCLES + 1.2), faults, seed)
    path = folder / f"{unit}-{seed}.mcap"
    write_log(path, config, samples)
    return path


@dataclass
class Cluster:
    """A scheduler and its workers."""

    address: str
    workers: list["subprocess.Popen[str]"]


@contextmanager
def cluster(workers: int) -> Iterator[Cluster]:
    """Start them, each a process with one thread."""
    with contextlib.ExitStack() as ending:
        scheduler = _start(ending, "scheduler", "--port", "0", *_QUIET)
        address = _read_until(scheduler, r"Scheduler at:\s+(tcp://\S+)")
        some = [
            _start(ending, "worker", address, "--nthreads", "1", "--no-nanny", *_QUIET)
            for _ in range(workers)
        ]
        for one in some:
            _read_until(one, r"Registered to:\s+(\S+)")
        yield Cluster(address, some)


def _start(ending: contextlib.ExitStack, *arguments: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen([*_DASK, *arguments], stderr=subprocess.PIPE, text=True)
    ending.callback(_end, process)
    return process


def _end(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def _read_until(process: "subprocess.Popen[str]", pattern: str) -> str:
    said = []
    assert process.stderr is not None
    for line in process.stderr:
        said.append(line)
        if found := re.search(pattern, line):
            return found[1]
    raise RuntimeError(f"ended (exit code {process.wait()}):\n{''.join(said)}")
