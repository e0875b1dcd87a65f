"""How cost grows: with the length of a log, the number of hypotheses, the number of ejectors."""

import subprocess
import sys
import time
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
import psutil

from benchmarks import kernel, log, plant
from benchmarks.acquisition import bare_share, lost
from benchmarks.figures import Line, Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.processes import TWIN, plc, usage
from benchmarks.recording import HOUR_S, hour
from twin.log.recorder import Recorder
from twin.model import kernel as model

REPEATS = 3
MINUTES = (5, 10, 20, 30)
DAY_H = 24
MOST_MB = 500.0  # that a replay may have
HYPOTHESES = (8, 16, 32, 64)
A_ROW_NS = 1e6  # there are, if the bank is to keep up
EJECTORS = (1, 2, 4, 8)
SLICE_S, SLICES = 5.0, 3
IMPORTS = (sys.executable, "-c", "import numba, numpy, pydantic, typer")


def _grown(
    sizes: Sequence[float], runs: Sequence[Sequence[float]], line: Line, floors: Sequence[float]
) -> Measured:
    """Slopes of repeated runs over all sizes, and the line through their medians."""
    slopes = [Line("", "", sizes, run).slope for run in runs]
    return Measured(slopes, floors, note=f"{line.off:.1f} % from a line at most", line=line)


def _medians(runs: Sequence[Sequence[float]]) -> list[float]:
    return [median(column) for column in zip(*runs, strict=True)]


# --- the length of a log --------------------------------------------------------------------------


def length(run: Run) -> Sequence[Measured]:
    """Time and peak memory of replays of logs of several lengths, and of one of a day."""
    run.tell("length: writing logs")
    hours = [minutes / 60.0 for minutes in MINUTES]
    paths = [
        log.keep(run.folder / f"{minutes} min.mcap", hour(), minutes * 60_000)
        for minutes in MINUTES
    ]
    native = kernel.in_c(run.folder)
    times, memories, floors, imports = [], [], [], []
    with on_core(TWIN_CORE):
        usage([TWIN, "replay", paths[0]])  # compiles what is not compiled yet
        for number in range(REPEATS):
            run.tell(f"length: {number + 1} of {REPEATS}")
            used = [usage([TWIN, "replay", path]) for path in paths]
            times.append([seconds for seconds, _ in used])
            memories.append([most for _, most in used])
            imports.append(usage(IMPORTS)[1])
            if native is not None:
                bare = [_bare(path, native, part) for path, part in zip(paths, hours, strict=True)]
                floors.append(Line("", "", hours, bare).slope)
        time_line = Line("replay, s", "hours of log", hours, _medians(times))
        spent = f"{MOST_MB:g} MB"
        costs = _medians(memories)
        line = Line("replay, MB", "hours of log", hours, costs, MOST_MB, spent)
        day, note = line.rest + DAY_H * line.slope, "by the line, which short logs make too steep"
        if run.long:
            run.tell("length: a day")
            day, note = usage([TWIN, "replay", _day(run.folder / "day.mcap")])[1], "measured"
    return (
        _grown(hours, times, time_line, floors),
        _grown(hours, memories, line, ()),
        Measured([day], imports, note=note, valid=run.long),
    )


def _bare(path: Path, native: kernel.Advance, hours: float) -> float:
    """Time (s) to decompress a log, and of the model in C for its rows."""
    begin = time.perf_counter()
    log.unpack(log.packed(path))
    seconds = time.perf_counter() - begin
    rows = round(hours * HOUR_S * 1000)
    one = kernel.timed(native, hour().theta, kernel.first_rows(hour(), rows))[0]
    return seconds + one * 1e-9 * rows


def _day(path: Path) -> Path:
    """The hour again and again, its clock and numbers running on."""
    rows = len(hour().samples)
    with Recorder(path, hour().header()) as recorder:
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
            each = [kernel.timed(model.advance, theta, rows)[0] for theta in together]
            times.append([n * ns for n, ns in zip(HYPOTHESES, each, strict=True)])
            if vectors is not None:
                floors.append(_slope_in_c(vectors, banks, rows))
    memories = [[_memory(theta, rows) for theta in together]]
    spent = "a row each ms, on one core"
    line = Line("a row, ns", "hypotheses", HYPOTHESES, _medians(times), A_ROW_NS, spent)
    memory = Line("10 000 rows, MB", "hypotheses", HYPOTHESES, memories[0])
    return _grown(HYPOTHESES, times, line, floors), _grown(HYPOTHESES, memories, memory, ())


def _slope_in_c(
    vectors: kernel.Advance, banks: Sequence[list[kernel.Theta]], rows: kernel.Driven
) -> float:
    times = []
    for bank in banks:
        each = [kernel.timed(vectors, lanes, rows)[0] for lanes in kernel.in_lanes(bank)]
        times.append(sum(each) * model.LANES)
    return Line("", "", HYPOTHESES, times).slope


def _memory(theta: kernel.Theta, rows: kernel.Driven) -> float:
    """Peak memory (MB) of what a call is given and gives."""
    tracemalloc.start()
    kernel.timed(model.advance, theta, rows)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most * 1e-6


# --- the number of ejectors -----------------------------------------------------------------------


def ejectors(run: Run) -> Sequence[Measured]:
    """Lost samples and CPU share of the most ejectors; CPU and memory of one more."""
    shares, memories = [], []
    for count in EJECTORS:
        with plant.together(run, count) as (process, logs):
            run.tell(f"together: {count}")
            shares.append([_share(process) for _ in range(SLICES)])
            memories.append(psutil.Process(process.pid).memory_info().rss * 1e-6)
    found = [lost(one) for one in logs]
    with plc() as port, on_core(TWIN_CORE):
        floors = [bare_share(port) for _ in range(SLICES)]
    runs = list(zip(*shares, strict=True))
    line = Line("CPU, %", "ejectors", EJECTORS, _medians(runs), 100.0, "a core")
    memory = Line("memory, MB", "ejectors", EJECTORS, memories)
    return (
        Measured(
            [sum(missing for missing, _ in found)],
            note=f"of {sum(rows for _, rows in found):,} samples",
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
