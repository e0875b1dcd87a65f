"""Measure what the twin costs, each figure beside its floor in the same run.

    python tools/bench.py [--long] [--only NAME ... [--keep]] [--seconds S]

Prints a table and writes docs/bench.json and docs/bench.md; with --only it prints only, unless
--keep puts these figures in the place of older ones there. The short run takes some ten minutes.
--long takes much longer: it acquires for ten minutes, and over OPC UA too (twice; node-opcua has
to be there: npm ci --prefix tests/peers), where --seconds says for how long; it replays a day, and
counts causes that are told.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import (
    acquisition,
    calibration,
    clients,
    detection,
    diagnosis,
    first_view,
    fmu,
    growth,
    isolation,
    kernel,
    log,
    machine,
    opcua,
    page,
    plant,
    polling,
    replay,
    solver,
)
from benchmarks.figures import Benchmark, Figure, Run

from tools.version import commit

INTERRUPTED, TERMINATED = 130, 143
BARE_FETCH = "bare socket that fetches the same registers"
BARE_REPLAY = "decompression, the model in C, and the rows through zstd"
STARTED = "Python that imports numba, numpy, pydantic, typer"

BARE_OPCUA = "asyncua alone that reads the same arrays"


def _over_opcua(plc: str) -> tuple[Figure, ...]:
    name = f"OPC UA, {plc}, stopped for 300 ms every 10 s"
    return (
        Figure(f"{name}: lost samples", "", limit=0),
        Figure(f"{name}: CPU of the live process", "% of a core", BARE_OPCUA, 10.0),
        Figure(f"{name}: from sample to receipt, 99th percentile", "ms"),
        Figure(f"{name}: from sample to event, 99th percentile", "ms", limit=70.0),
    )


BENCHMARKS = (
    Benchmark(
        "acquisition",
        acquisition.steady,
        "`twin run` with its log beside the simulated PLC in another process; slices of 5 s, of "
        "10 s with --long; lost samples are numbers missing in the log.",
        (
            Figure("block mode: lost samples", "", limit=0),
            Figure("block mode: CPU of the live process", "% of a core", BARE_FETCH, 8.0),
            Figure("block mode: log of the live process", "bytes/sample"),
        ),
    ),
    Benchmark(
        "stops",
        acquisition.stopped,
        "The same while the live process gets SIGSTOP for 300 ms in every slice, of 10 s; ten "
        "minutes with --long.",
        (
            Figure("stopped for 300 ms every 10 s: lost samples", "", limit=0),
            Figure("stopped for 300 ms every 10 s: CPU", "% of a core", BARE_FETCH, 8.0),
        ),
    ),
    Benchmark(
        "clients",
        clients.modbus,
        "The driver alone, which decodes, checks and stamps what it fetches, and clients that only "
        "fetch the same registers as often, by turns of 1.5 s at the same PLC; processor time. "
        "What else one would take has ours as its floor.",
        (
            Figure("driver alone: CPU", "% of a core", "bare socket in C"),
            *(
                Figure(f"{name} fetches the same: CPU", "% of a core", "our driver")
                for name in ("bare socket in Python", "pymodbus alone", "libmodbus alone")
            ),
        ),
    ),
    Benchmark(
        "clients-opcua",
        clients.over_opcua,
        "The same over OPC UA, every 50 ms.",
        (Figure("OPC UA driver alone: CPU", "% of a core", BARE_OPCUA),),
    ),
    Benchmark(
        "opcua",
        opcua.ours,
        "`twin run` with its log reads the trace's arrays every 50 ms, and gets SIGSTOP for 300 ms "
        "in every slice of 10 s; an event is published when its line comes out of the console. "
        "Left out of both latencies is what was under way during a stop.",
        _over_opcua("our PLC"),
        long=True,
    ),
    Benchmark(
        "opcua-other",
        opcua.other,
        "The same beside node-opcua's server, which serves cycles of the simulated rig.",
        _over_opcua("node-opcua"),
        long=True,
    ),
    Benchmark(
        "page",
        plant.watched,
        "The same run with key figures, alarms and live rows kept as well, and `twin serve` on the "
        "PLC's core with one browser connected, which takes all it is told.",
        (
            Figure("all on, a page open: CPU of the live process", "% of a core", limit=15.0),
            Figure("all on, a page open: CPU of the page's process", "% of a core"),
        ),
    ),
    Benchmark(
        "first-view",
        first_view.page,
        "That page, opened seven times in Chromium with an empty cache, from the request on.",
        (
            Figure("page: its document parsed", "ms"),
            Figure("page: the first ejector shown", "ms", limit=1000.0),
        ),
    ),
    Benchmark(
        "together",
        growth.ejectors,
        "`twin run` with one, four and eight configurations, each with a simulated PLC and a "
        "log of its own.",
        (
            Figure("eight ejectors in one process: lost samples", "", limit=0),
            Figure("eight ejectors in one process: CPU", "% of a core"),
            Figure("one more ejector: CPU", "% of a core", BARE_FETCH),
            Figure("one more ejector: memory", "MB"),
        ),
    ),
    Benchmark(
        "polling",
        polling.missed,
        "The driver alone and two bare sockets take short turns at the same PLC, one request a "
        "millisecond, the same sleep and spin before it.",
        (
            Figure("poll mode: missed slots", "%", "bare poller in Python", 1.5, limits_ratio=True),
            Figure("poll mode: missed slots", "%", "bare poller in C", 1.5, limits_ratio=True),
        ),
    ),
    Benchmark(
        "kernel",
        kernel.speed,
        "The first rows of the rig's cycles through `kernel.advance` and through "
        "tools/benchmarks/kernel.c by turns, in processor time: 100 000 rows for one hypothesis, "
        "10 000 for 64, which are the data set with each effect at several sizes. They go through "
        "`kernel.advance` together, through the C one after another, then (gcc -O3 -march=native) "
        "eight at once in vectors, and count per hypothesis. What a call costs is the line's rest "
        "through calls of 1 to 50 rows, 10 000 in all, of one hypothesis.",
        (
            Figure("model: one row of 1 ms", "ns", "the same in C, -O2", 1.25, limits_ratio=True),
            Figure(
                "model: one row with dense output, as in the twin", "ns", "row by row in C, -O2"
            ),
            Figure(
                "model: one row for each of 64 hypotheses",
                "ns",
                "each alone in C, -O2",
                0.35,
                limits_ratio=True,
            ),
            Figure("model: one row for each of 64 hypotheses", "ns", "in C, eight to a vector"),
            Figure("model: a call, beyond its rows", "µs", limit=5.0),
        ),
    ),
    Benchmark(
        "solver",
        solver.evacuation,
        "0.3 s of suction from rest by `scipy.integrate.solve_ivp` (Radau, tolerance 1e-6) "
        "with the same equations in Python, and by `kernel.advance`; processor time.",
        (Figure("SciPy's solver: one row of 1 ms", "ns", "our model"),),
    ),
    Benchmark(
        "fmu",
        fmu.in_fmpy,
        "Six cycles by `fmpy.simulate_fmu`, from the unpacked FMU to its last row, driven by its "
        "commands alone, and by `kernel.simulate`; processor time.",
        (Figure("exported FMU in FMPy: one row of 1 ms", "ns", "our model"),),
    ),
    Benchmark(
        "calibration",
        calibration.from_cycles,
        "`twin.calibration.calibrate` over samples of the simulated rig, in this process and on "
        "all cores.",
        (Figure("calibration: 12 healthy cycles", "s", limit=15.0),),
    ),
    Benchmark(
        "detection",
        detection.sums,
        "Healthy cycles of the simulated gripper through twin, bank and isolation (104 000 with "
        "--long, 10 400 where it is named), at the limit for one false alarm in 30 days of 3 s "
        "cycles, which tools/false_alarms.py counts. A change in five effects one by one is put "
        "into these cycles: the median delays of the five. The floor is the mean delay of a "
        "simulated CUSUM that looks for nothing but that effect and size. Both begin in a device "
        "that runs, after healthy cycles, or from rest.",
        (
            *(
                Figure(
                    f"detection: delay for {shift:g} sigma a cycle, {state}",
                    "cycles",
                    "CUSUM for that alone",
                    1.3,
                    limits_ratio=True,
                )
                for state in ("running", "from rest")
                for shift in detection.SHIFTS
            ),
        ),
        long=True,
    ),
    Benchmark(
        "isolation",
        isolation.causes,
        "The simulated rigs with one effect each, drawn by seed, that begins at cycle 30, at twice "
        "the size that a CUSUM for it alone finds within three cycles and that is apart from all "
        "other effects: how many are not told, alone or as one of at most three, by the third "
        "cycle.",
        (Figure("isolation: 60 causes, not told within three cycles", "%", limit=10.0),),
        long=True,
    ),
    Benchmark(
        "log",
        log.files,
        "An hour of the simulated rig (3.6 million samples with model values), received in "
        "blocks of 30 as from a PLC; disk included, in ours fdatasync too. Then what else one "
        "would take, with ours as the floor: the MCAP library, given the log's own messages "
        "ready made, and read as far as bytes; and Parquet with zstd, from columns "
        "and into columns, which pyarrow does on one thread.",
        (
            Figure("log: size with model values", "bytes/sample", "the rows through zstd", 8.0),
            Figure(
                "log: an hour written",
                "s",
                "the rows through zstd into a file",
                1.5,
                limits_ratio=True,
            ),
            Figure("log: an hour read", "s", "decompression alone", 2.5, limits_ratio=True),
            *(
                Figure(f"{format_name}: {quantity}", unit, "our log")
                for format_name in ("MCAP library", "Parquet")
                for quantity, unit in (
                    ("size with model values", "bytes/sample"),
                    ("an hour written", "s"),
                    ("an hour read", "s"),
                )
            ),
        ),
    ),
    Benchmark(
        "replay",
        replay.end_to_end,
        "`twin replay` over that log into another in a process of its own, start included; the "
        "floor decompresses, runs the model in C and writes the rows through zstd. Then its parts "
        "in this process, over ten minutes, told for an hour; the monitor with bank and key "
        "figures, as in a replay.",
        (
            Figure("replay: an hour, start to end", "s", BARE_REPLAY, 4.0),
            Figure("replay: speed", "× real time"),
            Figure("replay: phases and model", "s", "the model in C"),
            Figure("replay: monitor", "s"),
        ),
    ),
    Benchmark(
        "length",
        growth.length,
        "The same over the first 5 and 20 minutes of that log and all of it; with --long over 24 "
        "hours, which are that hour again and again, else by the line. Peak memory is what was "
        "resident; its line leaves out the shortest log, in which it still rises.",
        (
            Figure("replay of one more hour: time", "s", BARE_REPLAY),
            Figure("replay of one more hour: memory", "MB"),
            Figure("replay of 24 hours: peak memory", "MB", STARTED, 500.0),
        ),
    ),
    Benchmark(
        "hypotheses",
        growth.hypotheses,
        "10 000 rows through `kernel.advance` for 8 to 64 hypotheses, in processor time; memory is "
        "that of the arrays of the call.",
        (
            Figure("one more hypothesis: a row of 1 ms", "ns", "in C, eight to a vector"),
            Figure("one more hypothesis: memory for 10 000 rows", "MB"),
        ),
    ),
    Benchmark(
        "diagnosis",
        diagnosis.end_to_end,
        "`twin diagnose` in a process of its own, start included, on all cores: 12 cycles with a "
        "leak, and an hour in which one begins half-way; each has to name it. Beside the hour "
        "stands the replay of the one without a leak.",
        (
            Figure("diagnosis: 12 cycles", "s", "SciPy's least squares for that cause alone", 6.0),
            Figure("diagnosis: 12 cycles, peak memory", "MB", "twin replay"),
            Figure("diagnosis: an hour", "s", "twin replay", 40.0),
            Figure("diagnosis: an hour, peak memory", "MB", "twin replay"),
        ),
    ),
    Benchmark(
        "starts",
        replay.starts,
        "Whole processes, by turns with their floors, everything in the page cache.",
        (
            Figure("start: twin --help", "ms", "Python that does nothing", 300.0),
            Figure("start: twin replay, a log of 10 s", "ms", STARTED, 2000.0),
        ),
    ),
    Benchmark(
        "first-row",
        first_view.row,
        "`twin run` beside the simulated PLC, everything compiled and in the page cache, from its "
        "start: until the first row came that its log has, and until its log holds rows. The model "
        "is loaded between the two.",
        (
            Figure("start: twin run, first row", "ms", STARTED, 1000.0),
            Figure("start: twin run, first row in the log", "ms", STARTED),
        ),
    ),
)


def main() -> int:
    """Measure, print, write; gives the exit code."""
    arguments = _arguments()
    # As after a first start, whatever this shell sets: modules must not be parsed anew.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    before, load = machine.noise(), machine.Load.now()
    results, seconds = [], {}
    with tempfile.TemporaryDirectory(prefix="ejector-twin-bench-") as folder:
        run = Run(arguments.long, Path(folder), _tell, arguments.seconds)
        for benchmark in BENCHMARKS:
            if _wanted(benchmark, arguments):
                begin = time.monotonic()
                results += zip(benchmark.figures, benchmark.measure(run), strict=True)
                seconds[benchmark.name] = time.monotonic() - begin
    _tell("")
    notes = [
        _kind(arguments.long),
        f"Machine: {machine.description()}; {machine.Load.now().since(load)}.",
        f"Noise: {before}; after the run {machine.noise()}.",
        f"Seconds: {', '.join(f'{name} {taken:.0f}' for name, taken in seconds.items())}.",
    ]
    print("\n".join(f"- {note}" for note in notes))
    print(f"\n{page.table(results)}")
    if arguments.keep or not arguments.only:
        newer = page.Session(notes, results)
        page.write(page.with_newer(page.read(BENCHMARKS), newer), BENCHMARKS)
    return 0


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--long", action="store_true", help="also what takes long")
    names = [benchmark.name for benchmark in BENCHMARKS]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--keep", action="store_true", help="with --only: write figures, too")
    parser.add_argument("--seconds", type=float, help="acquire over OPC UA for so long")
    return parser.parse_args()


def _wanted(benchmark: Benchmark, arguments: argparse.Namespace) -> bool:
    return (
        benchmark.name in arguments.only if arguments.only else arguments.long or not benchmark.long
    )


def _tell(text: str) -> None:
    """Print progress on a terminal; a drawing thread would disturb the measurement."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


def _kind(long: bool) -> str:
    pinned = "PLC and twin each on its own core" if machine.can_pin() else "not pinned to cores"
    kind, day = "Long" if long else "Short", time.strftime("%Y-%m-%d")
    return f"{kind} run of {day} at commit {commit()}; {pinned}."


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))  # ends what was started
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
