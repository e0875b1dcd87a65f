"""Replay from end to end and by parts, and start times of the command line."""

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from benchmarks import log
from benchmarks.figures import Measured, Run
from benchmarks.kernel import Advance, first_rows, in_c, timed
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import TWIN, usage
from benchmarks.recording import HOUR_S, MINUTE, hour, new_twin
from twin.cli.setup import pair_of
from twin.live import REPLAYED
from twin.log.recorder import Recorder
from twin.signals import Samples, Ticks

REPEATS = 3
STARTS = 5
IMPORTS = "import numba, numpy, pydantic, typer"
HOUR_MIN = 60
PART_MIN = 10  # length over which parts of a replay and the model in C are measured


@dataclass(frozen=True)
class Replays:
    """Repeated replays of one log: time (s), its floor (s), and peak memory (MB)."""

    times: Sequence[float]
    floors: Sequence[float]
    memories: Sequence[float]


def end_to_end(run: Run) -> Sequence[Measured]:
    """Time (s) of ``twin replay`` over an hour, its speed, and the twin's and monitor's parts."""
    whole, native = replays(run, HOUR_MIN), in_c(run.folder)
    model, expecting, monitoring = [], [], []
    part = hour().blocks(REPLAYED)[: PART_MIN * MINUTE // REPLAYED]
    with on_core(TWIN_CORE):
        for number in range(REPEATS):
            run.tell(f"replay: its parts, {number + 1} of {REPEATS}")
            if native is not None:
                model.append(_in_c(native, HOUR_MIN))
            expecting.append(_expect(part) * HOUR_MIN / PART_MIN)
            monitoring.append(_monitor(part) * HOUR_MIN / PART_MIN)
    speeds = [HOUR_S / seconds for seconds in whole.times]
    return (
        Measured(whole.times, whole.floors),
        Measured(speeds),
        Measured(expecting, model),
        Measured(monitoring),
    )


@cache
def replays(run: Run, minutes: int) -> Replays:
    """``twin replay`` of the hour's first minutes into a new log, by turns with its floor.

    The result is cached.
    """
    run.tell("replay: simulating the rig")
    path, native = log.part_log(run.folder, minutes), in_c(run.folder)
    rows, packed, again = minutes * MINUTE, log.packed(path), run.folder / "again.mcap"
    times, floors, memories = [], [], []
    with on_core(TWIN_CORE):
        usage([TWIN, "replay", log.part_log(run.folder, 1)])  # compiles first
        for number in range(REPEATS):
            run.tell(f"replay: {minutes} minutes, {number + 1} of {REPEATS}")
            seconds, most = usage([TWIN, "replay", path, "-o", again])
            times.append(seconds)
            memories.append(most)
            if native is not None:
                begin = time.perf_counter()
                log.unpack(packed)
                log.write_bare(again, rows)
                bare = time.perf_counter() - begin
                floors.append(bare + _in_c(native, minutes))
            again.unlink()  # a log is never overwritten
    return Replays(times, floors, memories)


def _in_c(native: Advance, minutes: int) -> float:
    """Processor time (s) of the model in C for ``minutes``, scaled from at most PART_MIN."""
    rows = first_rows(hour(), min(minutes, PART_MIN) * MINUTE)
    return timed(native, hour().theta, rows)[0] * 1e-9 * minutes * MINUTE


def _expect(blocks: Sequence[tuple[Samples, Ticks]]) -> float:
    """Time (s) of phases and model."""
    twin = new_twin(hour().config)
    begin = time.perf_counter()
    for samples, _ in blocks:
        twin.advance(samples)
    return time.perf_counter() - begin


def _monitor(blocks: Sequence[tuple[Samples, Ticks]]) -> float:
    """Time (s) of the monitor, configured as in a replay."""
    monitor = pair_of(hour().config)[1]
    begin = time.perf_counter()
    for samples, ticks in blocks:
        monitor.update(samples, ticks)
    return time.perf_counter() - begin


def starts(run: Run) -> Sequence[Measured]:
    """Time (ms) of ``twin --help``, and of ``twin replay`` over a log of ten seconds."""
    small = _small_log(run.folder)
    run.tell("starts")
    python = [sys.executable, "-c"]
    with on_core(TWIN_CORE):
        return (
            _by_turns([TWIN, "--help"], [*python, "pass"]),
            _by_turns([TWIN, "replay", small], [*python, IMPORTS]),
        )


def _by_turns(ours: Sequence[str | Path], floor: Sequence[str | Path]) -> Measured:
    seconds_of(ours)
    seconds_of(floor)
    pairs = [(seconds_of(ours) * 1e3, seconds_of(floor) * 1e3) for _ in range(STARTS)]
    values, floors = zip(*pairs, strict=True)
    return Measured(values, floors)


def _small_log(folder: Path) -> Path:
    path = folder / "small.mcap"
    with Recorder(path, hour().config.log_header()) as recorder:
        recorder.write(*hour().blocks()[0])
    return path


def seconds_of(command: Sequence[str | Path]) -> float:
    """Time (s) of a whole process."""
    begin = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin
