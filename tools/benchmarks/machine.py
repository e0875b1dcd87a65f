"""The machine of a run: description, noise, and the cores that may be used."""

import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

SPINS = 300
SPIN = 100_000  # additions, some milliseconds


def cores() -> list[int]:
    """Cores this process may run on; empty if the system cannot tell."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


PLC_CORE, TWIN_CORE = 0, -1  # indices into ``cores()``


def can_pin() -> bool:
    """Whether processes can be bound to cores, and at least two are available."""
    try:
        os.sched_setaffinity(0, cores())
    except (AttributeError, OSError):
        return False
    return len(cores()) > 1


@contextmanager
def on_core(index: int) -> Iterator[None]:
    """Run the block, with its new processes and threads, on one core if that is possible."""
    allowed = cores()
    pinned = can_pin()
    if pinned:
        os.sched_setaffinity(0, {allowed[index]})
    try:
        yield
    finally:
        if pinned:
            os.sched_setaffinity(0, allowed)


def spins() -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Times (ms) of SPINS repetitions of the same additions; on a quiet machine all are equal."""
    times = []
    with on_core(TWIN_CORE):
        for _ in range(SPINS):
            begin = time.perf_counter()
            sum(range(SPIN))
            times.append((time.perf_counter() - begin) * 1e3)
    return np.array(times)


def noise() -> str:
    """How much a fixed spin loop varies, in a sentence."""
    times = spins()
    middle, late, worst = np.quantile(times, (0.5, 0.95, 1.0))
    return (
        f"a fixed spin loop of {middle:.1f} ms takes {late / middle:.2f} × that at the 95th "
        f"percentile and {worst / middle:.2f} × at worst"
    )


@dataclass(frozen=True)
class Load:
    """Core seconds so far: in total, used by other processes, and stolen by the host."""

    total: float
    others: float
    stolen: float

    @classmethod
    def now(cls) -> "Load":
        """The load so far; our child processes count as ours only after they have ended."""
        machine = psutil.cpu_times()
        ours = psutil.Process().cpu_times()
        used = ours.user + ours.system + ours.children_user + ours.children_system
        busy = machine.user + machine.nice + machine.system
        total = time.monotonic() * psutil.cpu_count()
        return cls(total, busy - used, getattr(machine, "steal", 0.0))

    def since(self, before: "Load") -> str:
        """Share of other processes and of the host since ``before``, in a sentence."""
        total = (self.total - before.total) / 100.0
        # Times count in ticks: on a quiet machine ours may exceed the total of all processes.
        others = max(self.others - before.others, 0.0)
        stolen = self.stolen - before.stolen
        return (
            f"others took {others / total:.0f} % of the cores' time during the run, "
            f"the host of this virtual machine {stolen / total:.0f} %"
        )


def description() -> str:
    """Processor, cores, system and Python in one line."""
    return (
        f"{_processor()}, {psutil.cpu_count()} cores, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}"
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
