"""Growth of cost with the length of a log, the number of hypotheses and of ejectors."""

import subprocess
import sys
import time
import tracemalloc
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil

from benchmarks import kernel, plant, replay
from benchmarks.acquisition import bare_share, lost
from benchmarks.figures import Line, Measured, Run, medians
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import TWIN, plc, usage
from benchmarks.recording import hour
from twin.log.recorder import Recorder
from twin.model import kernel as model

REPEATS = 3
MINUTES = (5, 20, 60)
DAY_H = 24
MOST_MB = 500.0  # limit on the memory of a replay
HYPOTHESES = (8, 16, 32, 64)
A_ROW_NS = 1e6  # time for a row if the bank is to keep up
EJECTORS = (1, 4, 8)
SLICE_S, SLICES = 4.0, 3
IMPORTS = (sys.executable, "-c", "import numba, numpy, pydantic, typer")


def _grown(
    sizes: Sequence[float], runs: Sequence[Sequence[float]], line: Line, floors: Sequence[float]
) -> Measured:
    """Slopes of repeated runs over all sizes, and the line through their medians."""
    slopes = [Line("", "", sizes, run).slope for run in runs]
    return Measured(slopes, floors, note=f"{line.off:.1f} % from a line at most", line=line)


# --- the length of a log --------------------------------------------------------------------------


def length(run: Run) -> Sequence[Measured]:
    """Time and peak memory of replays of logs of several lengths, and of one of a day."""
    hours = [minutes / 60.0 for minutes in MINUTES]
    results = [replay.replays(run, minutes) for minutes in MINUTES]
    times, floors, memories = (
        list(zip(*columns, strict=True))
        for columns in zip(
            *((result.times, result.floors, result.memories) for result in results), strict=True
        )
    )
    time_line = Line("replay, s", "hours of log", hours, medians(times))
    # Memory has not settled at the first size.
    sizes, costs = hours[1:], [list(run_memories[1:]) for run_memories in memories]
    most, note = None, "by the line, which an hour and less make too steep"
    with on_core(TWIN_CORE):
        imports = [usage(IMPORTS)[1] for _ in range(REPEATS)]
        if run.long:
            run.tell("length: a day")
            day, note = _replay_of_a_day(run.folder)
            sizes, costs, most = [*sizes, DAY_H], [[*before, day] for before in costs], MOST_MB
    line = Line("replay, MB", "hours of log", sizes, medians(costs), most, f"{MOST_MB:g} MB")
    if not run.long:
        day = line.rest + DAY_H * line.slope
    return (
        _grown(
            hours,
            times,
            time_line,
            [Line("", "", hours, run_floors).slope for run_floors in floors],
        ),
        _grown(sizes, costs, line, ()),
        Measured([day], imports, note=note, valid=run.long),
    )


def _replay_of_a_day(folder: Path) -> tuple[float, str]:
    """Peak memory (MB) of the replay of a day, and how long it took in words."""
    path, again = _day(folder / "day.mcap"), folder / "day again.mcap"
    seconds, most = usage([TWIN, "replay", path, "-o", again])
    path.unlink()
    again.unlink()
    return most, f"measured, in {seconds:.0f} s"


def _day(path: Path) -> Path:
    """A log of the hour repeated DAY_H times, with clock and sequence numbers running on."""
    rows = len(hour().samples)
    with Recorder(path, hour().config.log_header()) as recorder:
        for number in range(DAY_H):
            for samples, ticks in hour().blocks():
                later = samples.copy()
                later["sequence"] += number * rows
                for clock in ("time_ns", "host_ns"):
                    later[clock] += number * rows * 1_000_000
                recorder.write(later, ticks)
    return path


# --- the number of hypotheses ---------------------------------------------------------------------


def hypotheses(run: Run) -> Sequence[Measured]:
    """Time of a row and memory of a call, for several numbers of hypotheses."""
    run.tell("hypotheses")
    rows, banks = kernel.first_rows(hour(), kernel.BANK_ROWS), []
    banks = [kernel.hypotheses(hour().theta, count) for count in HYPOTHESES]
    together = [np.ascontiguousarray(np.transpose(bank)) for bank in banks]
    vectors = kernel.in_c(run.folder, kernel.VECTORS)
    times, floors = [], []
    with on_core(TWIN_CORE):
        kernel.timed(model.advance, together[0], rows)
        for _ in range(REPEATS):
            row_times = [kernel.timed(model.advance, theta, rows)[0] for theta in together]
            times.append([n * ns for n, ns in zip(HYPOTHESES, row_times, strict=True)])
            if vectors is not None:
                floors.append(_slope_in_c(vectors, banks, rows))
    memories = [[_memory(theta, rows) for theta in together]]
    spent = "a row each ms, on one core"
    line = Line("a row, ns", "hypotheses", HYPOTHESES, medians(times), A_ROW_NS, spent)
    memory = Line("10 000 rows, MB", "hypotheses", HYPOTHESES, memories[0])
    return _grown(HYPOTHESES, times, line, floors), _grown(HYPOTHESES, memories, memory, ())


def _slope_in_c(
    vectors: kernel.Advance, banks: Sequence[list[kernel.Theta]], rows: kernel.Driven
) -> float:
    times = []
    for bank in banks:
        row_times = [kernel.timed(vectors, lanes, rows)[0] for lanes in kernel.in_lanes(bank)]
        times.append(sum(row_times) * model.LANES)
    return Line("", "", HYPOTHESES, times).slope


def _memory(theta: kernel.Theta, rows: kernel.Driven) -> float:
    """Peak memory (MB) of a call's inputs and outputs."""
    tracemalloc.start()
    kernel.timed(model.advance, theta, rows)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most * 1e-6


# --- the number of ejectors -----------------------------------------------------------------------


def ejectors(run: Run) -> Sequence[Measured]:
    """Lost samples and CPU share of max(EJECTORS); CPU and memory of one more ejector."""
    shares, memories = [], []
    with ExitStack() as stack:
        ports = [stack.enter_context(plc()) for _ in range(max(EJECTORS))]
        for count in EJECTORS:
            with plant.together(run, ports[:count]) as (process, logs):
                run.tell(f"together: {count}")
                shares.append([_share(process) for _ in range(SLICES)])
                memories.append(psutil.Process(process.pid).memory_info().rss * 1e-6)
        with on_core(TWIN_CORE):
            floors = [bare_share(ports[0]) for _ in range(SLICES)]
    losses = [lost(log) for log in logs]
    runs = list(zip(*shares, strict=True))
    line = Line("CPU, %", "ejectors", EJECTORS, medians(runs), 100.0, "a core")
    memory = Line("memory, MB", "ejectors", EJECTORS, memories)
    return (
        Measured(
            [sum(missing for missing, _ in losses)],
            note=f"of {sum(rows for _, rows in losses):,} samples",
        ),
        Measured(shares[-1]),
        _grown(EJECTORS, runs, line, floors),
        _grown(EJECTORS, [memories], memory, ()),
    )


def _share(process: "subprocess.Popen[bytes]") -> float:
    """CPU time (% of a core) over a slice."""
    measured = psutil.Process(process.pid)
    measured.cpu_percent()
    time.sleep(SLICE_S)
    share: float = measured.cpu_percent()
    return share
