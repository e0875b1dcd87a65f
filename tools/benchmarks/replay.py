"""Replay from end to end and by parts, and how long the command line takes to start."""

import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks import log
from benchmarks.figures import Measured, Run
from benchmarks.kernel import in_c, over_hour
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import TWIN
from benchmarks.recording import HOUR_S, hour, new_twin
from twin.log.recorder import Recorder
from twin.monitor.detect import Monitor

REPEATS = 3
STARTS = 7


def end_to_end(run: Run) -> Sequence[Measured]:
    """Time (s) of ``twin replay`` over an hour, its speed, and the twin's and monitor's parts."""
    run.tell("replay: simulating the rig")
    path = log.hour_log(run.folder)
    chunks, native = log.packed(path), in_c(run.folder)
    whole, floors, model, expecting, monitoring = [], [], [], [], []
    with on_core(TWIN_CORE):
        _seconds([TWIN, "replay", path])  # compiles what is not compiled yet
        for number in range(REPEATS):
            run.tell(f"replay: {number + 1} of {REPEATS}")
            whole.append(_seconds([TWIN, "replay", path]))
            if native is not None:
                begin = time.perf_counter()
                log.unpack(chunks)
                model.append(over_hour(native))
                floors.append(time.perf_counter() - begin)
            expecting.append(_expect())
            monitoring.append(_monitor())
    speeds = [HOUR_S / seconds for seconds in whole]
    return (
        Measured(whole, floors),
        Measured(speeds),
        Measured(expecting, model),
        Measured(monitoring),
    )


def _expect() -> float:
    """Time (s) of phases and model for the hour."""
    twin = new_twin(hour().config)
    begin = time.perf_counter()
    for samples, _ in hour().blocks():
        twin.advance(samples)
    return time.perf_counter() - begin


def _monitor() -> float:
    """Time (s) of the monitor for the hour."""
    monitor = Monitor(hour().config.monitor, hour().theta)
    begin = time.perf_counter()
    for samples, ticks in hour().blocks():
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
            _by_turns([TWIN, "replay", small], [*python, "import numba, numpy, pydantic, typer"]),
        )


def _by_turns(ours: Sequence[str | Path], floor: Sequence[str | Path]) -> Measured:
    _seconds(ours)
    _seconds(floor)
    pairs = [(_seconds(ours) * 1e3, _seconds(floor) * 1e3) for _ in range(STARTS)]
    values, floors = zip(*pairs, strict=True)
    return Measured(values, floors)


def _small_log(folder: Path) -> Path:
    path = folder / "small.mcap"
    with Recorder(path, hour().header()) as recorder:
        recorder.write(*hour().blocks()[0])
    return path


def _seconds(command: Sequence[str | Path]) -> float:
    begin = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin
