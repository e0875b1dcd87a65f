"""A soak run: a day in compressed time and an hour in real time, and nothing may grow.

Compressed, ``twin run`` takes the rows of the simulated rig as fast as it goes, with log, console,
databases and live rows. In real time it runs beside the simulated PLC, with its results served as
well. Memory, threads and handles of its process, and the sizes of log and databases, are taken down
while it runs. A straight line is fitted to each once it has settled; the run fails where a slope is
more than is allowed, its 95 % interval included.

    python -m tools.soak [--hours 24] [--real-hours 1]
"""

import argparse
import json
import signal
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tomli_w
from scipy import stats

from drivers.plc import simulate
from drivers.plc.settings import PlcSettings
from tools.fault_run import CONFIGS, ROOT, Cell, until_logged
from twin.events import Kind
from twin.log.reader import open_log
from twin.settings import Document
from twin.signals import Command, Samples

STRETCH_S = 600.0  # of the rig, over and over
BLOCK = 1000  # rows
SETTLED = 0.25  # share of the run, and this long, before the line begins: caches fill first
SETTLED_H = 0.75
JUDGED_H = 0.9  # a shorter run does not judge memory
POINTS = 20  # the line is fitted to means of so many stretches: neighbours are correlated
LEAST_S = 0.2  # between two measurements
ROTATE_MB = 1.0  # of a part of the log: some minutes in real time
ENDS_S = 120.0  # to end in order
# Largest growth in an hour of the PLC's time, by measurement.
ALLOWED = {
    "memory_mb": 0.1,  # a gigabyte in a year
    "threads": 0.0,
    "handles": 0.0,
    "log_mb": 30.0,  # 8 bytes a row at 1 kHz
    "database_mb": 1.0,  # 800 bytes a cycle
}


@dataclass(frozen=True)
class Line:
    """A straight line through a measurement."""

    slope: float  # in an hour
    low95: float
    high95: float
    allowed: float

    @property
    def is_good(self) -> bool:
        """Whether growth beyond the allowed one is not certain."""
        return self.low95 <= self.allowed


def fitted(hours: Sequence[float], values: Sequence[float], allowed: float) -> Line:
    """The line through the means of stretches, without the first part of the run.

    With fewer than three measurements its interval is infinite.
    """
    x, y = np.array(hours), np.array(values)
    span = x[-1] - x[0]
    settled = x - x[0] >= max(SETTLED * span, min(SETTLED_H, (1 - SETTLED) * span))
    points = min(POINTS, int(settled.sum()))
    if points < 3:
        return Line(0.0, -np.inf, np.inf, allowed)
    parts = np.array_split(np.flatnonzero(settled), points)
    x, y = (np.array([column[part].mean() for part in parts]) for column in (x, y))
    line = stats.linregress(x, y)
    reach = 0.0 if y.min() == y.max() else float(stats.t.ppf(0.975, points - 2) * line.stderr)
    slope = float(line.slope)
    return Line(slope, slope - reach, slope + reach, allowed)


# --- compressed -----------------------------------------------------------------------------------


def stretch(settings: PlcSettings) -> Samples:
    """Whole cycles of the simulated rig, so that they can be repeated."""
    samples = np.concatenate([*simulate.blocks(settings, STRETCH_S, seed=1)])
    on = (samples["commands"] & Command.SUCTION) != 0
    begins = np.flatnonzero(on[1:] & ~on[:-1]) + 1
    return samples[begins[1] : begins[-1]]  # each begins as the one before


def endless(
    cycles: Samples, report_hours: Callable[[float], None], is_live: Callable[[], bool]
) -> Iterator[Samples]:
    """Endless blocks of ``cycles``; ``report_hours`` gets the hours taken so far.

    After the first block it waits until the loop reads it: a run reads ahead while it loads its
    model.
    """
    period_ns = int(cycles["time_ns"][1] - cycles["time_ns"][0])
    rounds = 0
    while True:
        for start in range(0, len(cycles), BLOCK):
            block = cycles[start : start + BLOCK].copy()
            block["sequence"] += rounds * len(cycles)
            for name in ("time_ns", "host_ns"):
                block[name] += rounds * len(cycles) * period_ns
            yield block
            while not is_live():
                time.sleep(LEAST_S)
                yield block[:0]
            report_hours((rounds * len(cycles) + start + len(block)) * period_ns / 3.6e12)
        rounds += 1


def run_compressed(config: Path, log: Path, progress: Path) -> None:
    """``twin run`` with these rows in place of a PLC, in this process, until interrupted."""
    from drivers import sources  # noqa: PLC0415 - of the child alone
    from twin.cli.main import main as run_command  # noqa: PLC0415

    cycles = stretch(Document.read(config).section(PlcSettings, "plc"))
    with progress.open("w") as file:

        def told(hours: float) -> None:
            file.seek(0)
            file.write(f"{hours:.6f}\n")
            file.flush()

        def is_live() -> bool:
            return threading.current_thread() is threading.main_thread()

        sources.open_source = lambda *_given, **_named: endless(cycles, told, is_live)
        sys.argv = ["twin", "run", str(config), "--log", str(log)]
        run_command()


@contextmanager
def compressed(folder: Path) -> Iterator[tuple[psutil.Popen, Callable[[], float]]]:
    """The process, and a function that gives its hours so far."""
    progress, config = folder / "progress", folder / "soak.toml"
    config.write_text(tomli_w.dumps(configured()), encoding="utf-8")
    (folder / "logs").mkdir()
    command = [sys.executable, "-m", "tools.soak", "--child", str(folder)]
    with (folder / "said.txt").open("w") as output:
        process = psutil.Popen(command, cwd=ROOT, stdout=output, stderr=output)
        try:
            yield process, lambda: float(progress.read_text() or 0) if progress.exists() else 0.0
        finally:
            with suppress(psutil.NoSuchProcess):
                process.kill()
                process.wait()


def configured() -> dict[str, Any]:
    """The test rig's configuration, with all stores on."""
    path = ROOT / "configs" / f"{CONFIGS['modbus']}.toml"
    tables: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    return tables | {name: {"keep": True} for name in ("figures", "alarms", "page")}


# --- in real time ---------------------------------------------------------------------------------


@contextmanager
def real(folder: Path) -> Iterator[tuple[psutil.Popen, Callable[[], float]]]:
    """The process with a simulated PLC, and a function that gives its hours so far."""
    # The writer keeps an index entry for each half second until its part of the log ends.
    with Cell("modbus", folder, np.random.default_rng(1), rotate_mb=ROTATE_MB) as cell:
        until_logged(cell)
        begun = time.monotonic()
        yield cell.twin, lambda: (time.monotonic() - begun) / 3600


# --- both -----------------------------------------------------------------------------------------


def looked_at(process: psutil.Popen, folder: Path) -> dict[str, float]:
    """All measurements now."""
    with process.oneshot():
        sizes = {
            "memory_mb": process.memory_info().rss / 1e6,
            "threads": float(process.num_threads()),
            "handles": float(process.num_fds()),
        }
    for name, pattern in (("log_mb", "logs/*.mcap"), ("database_mb", "*.sqlite*")):
        sizes[name] = sum(path.stat().st_size for path in folder.glob(pattern)) / 1e6
    return sizes


def soak(
    process: psutil.Popen, so_far: Callable[[], float], hours: float, folder: Path
) -> dict[str, list[float]]:
    """Measure for so many hours; then end the process in order, or raise SystemExit."""
    measurements: dict[str, list[float]] = {name: [] for name in ("hours", *ALLOWED)}
    while (now := so_far()) < hours:
        if process.poll() is not None:
            output = "\n".join(path.read_text() for path in folder.glob("*.txt"))
            raise SystemExit(f"it ended before its time:\n{output}")
        time.sleep(LEAST_S)
        if now and now != (measurements["hours"] or [0.0])[-1]:
            for name, value in ({"hours": now} | looked_at(process, folder)).items():
                measurements[name].append(value)
        if sys.stderr.isatty():
            print(f"\r{now:.2f} of {hours:g} h", end="", file=sys.stderr, flush=True)
    process.send_signal(signal.SIGINT)
    if (code := process.wait(ENDS_S)) != 130:
        raise SystemExit(f"it ended with {code}, and not with 130")
    return measurements


def judged(measurements: dict[str, list[float]], folder: Path) -> dict[str, Any]:
    """The lines, the content of the log, and the problems."""
    lines = {
        name: fitted(measurements["hours"], measurements[name], ALLOWED[name]) for name in ALLOWED
    }
    problems = [
        f"{name} grows by {line.slope:.3g} an hour ({line.low95:.3g} to {line.high95:.3g}), and"
        f" {line.allowed:g} is allowed"
        for name, line in lines.items()
        if not (line.is_good or (name == "memory_mb" and measurements["hours"][-1] < JUDGED_H))
    ]
    log = open_log(folder / "logs" / "run.mcap")
    rows, missing, last = 0, 0, None
    for samples, _ in log.blocks():
        sequence = samples["sequence"] if last is None else np.append(last, samples["sequence"])
        rows, missing = rows + len(samples), missing + int((np.diff(sequence) - 1).sum())
        last = samples["sequence"][-1]
    wrong = Kind.DEVIATION, Kind.OUTPUT_DOWN
    problems += [event.text for event in log.events() if event.kind in wrong]
    problems += ["the log is not complete"] * (not log.complete)
    problems += [f"{missing} rows are missing in the log"] * bool(missing)
    return {
        "hours": round(measurements["hours"][-1], 3),
        "looks": len(measurements["hours"]),
        "rows": rows,
        "last": {name: measurements[name][-1] for name in ALLOWED},
        "an_hour": {name: asdict(line) for name, line in lines.items()},
        "problems": problems,
    }


def main() -> int:
    """Run from the command line; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=24.0, help="compressed; 0: none")
    parser.add_argument("--real-hours", type=float, default=1.0, help="0: none")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child is not None:
        folder = arguments.child
        run_compressed(folder / "soak.toml", folder / "logs" / "run.mcap", folder / "progress")
        return 0
    answer = {}
    for name, hours, begin in (
        ("compressed", arguments.hours, compressed),
        ("real", arguments.real_hours, real),
    ):
        if not hours:
            continue
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            process, so_far = stack.enter_context(begin(folder))
            begun = time.monotonic()
            answer[name] = judged(soak(process, so_far, hours, folder), folder)
            answer[name]["seconds"] = round(time.monotonic() - begun)
    print(json.dumps(answer, indent=1))
    return 1 if any(result["problems"] for result in answer.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
