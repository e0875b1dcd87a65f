"""Processes of the benchmarks: simulated PLC and live twin, each on its own core."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from benchmarks.machine import PLC_CORE, TWIN_CORE, on_core

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs" / "test_rig.toml"
LAUNCHER = Path(__file__).with_name("launcher.py")
TWIN = Path(sys.executable).with_name("twin")

INTERRUPTED = 130
START_S = 300.0  # the kernels may have to be compiled, on a busy machine


@contextmanager
def plc() -> Iterator[int]:
    """Run the simulated PLC; yields its port on 127.0.0.1."""
    command = [sys.executable, "-m", "drivers.plc", CONFIG, "--port", "0"]
    with on_core(PLC_CORE):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    with process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line.startswith("listening on "):
                sys.exit("the PLC did not start")
            yield int(line.rsplit(":", 1)[1])
        finally:
            process.terminate()


@contextmanager
def live(
    log: Path,
    configs: Sequence[Path] = (CONFIG,),
    logs: Sequence[Path] = (),
    port: int | None = None,
    stdout: int | IO[bytes] = subprocess.DEVNULL,
) -> Iterator["subprocess.Popen[bytes]"]:
    """Run ``twin run`` with a log; yields the process once samples are logged.

    ``port`` is that of the PLC if it differs from the configuration. ``logs`` are the paths of the
    logs of several ejectors.
    """
    with on_core(TWIN_CORE):
        process = subprocess.Popen(command(log, configs, port), stdout=stdout)
    with process:
        try:
            for path in logs or [log]:
                _wait_for_samples(process, path)
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()  # before Popen's exit closes the pipe that it still writes to
    if process.returncode != INTERRUPTED:
        sys.exit(f"twin run ended with exit code {process.returncode}")


def command(log: Path, configs: Sequence[Path], port: int | None) -> list[str | Path]:
    """The command line of ``twin run``; ``port`` is the PLC's, if not as configured."""
    address = [] if port is None else ["--address", f"127.0.0.1:{port}"]
    return [TWIN, "run", *configs, *address, "--log", log]


def usage(command: Sequence[str | Path]) -> tuple[float, float]:
    """Run a command to its end; returns its time (s) and peak resident memory (MB)."""
    output = subprocess.run(
        [sys.executable, "-S", LAUNCHER, *command], stdout=subprocess.PIPE, text=True, check=True
    )
    seconds, most, code = output.stdout.split()
    if code != "0":
        sys.exit(f"{command[0]} {command[1]} ended with exit code {code}")
    return float(seconds), float(most)


def _wait_for_samples(process: "subprocess.Popen[bytes]", log: Path) -> None:
    """Return when the log grows; its head alone is written at once."""
    end = time.monotonic() + START_S
    sizes: set[int] = set()
    while len(sizes) < 3:
        if process.poll() is not None or time.monotonic() > end:
            sys.exit("twin run did not start")
        time.sleep(0.1)
        if log.exists():
            sizes.add(log.stat().st_size)
