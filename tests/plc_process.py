"""The simulated PLC as a second process, as it is in the field."""

import contextlib
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

ROOT = Path(__file__).parents[1]
PATIENCE_S = 30.0  # on a busy machine an end takes longer than elsewhere


class PlcProcess:
    """A running PLC; ``port`` is where it listens on 127.0.0.1."""

    def __init__(self, process: "subprocess.Popen[str]", port: int) -> None:
        self.process = process
        self.port = port

    def stop(self) -> int:
        """Ask it to end, as a person would; gives its exit code."""
        if self.process.poll() is None:
            self.process.terminate()
        return self._ended()

    def kill(self) -> None:
        """End it without warning, as a power cut would."""
        self.process.kill()
        self._ended()

    def _ended(self) -> int:
        try:
            return self.process.wait(PATIENCE_S)
        finally:
            assert self.process.stdout is not None
            self.process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.stop()
        except subprocess.TimeoutExpired:
            self.kill()
            raise


def start_plc(config: Path, *args: str, port: int = 0) -> PlcProcess:
    """Start it and wait until it listens; ``args`` go to its command line.

    A restart takes the port of the PLC before: ``start_plc(config, port=plc.port)``.
    """
    command = [sys.executable, "-m", "drivers.plc", str(config), "--port", str(port), *args]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line.startswith("listening on "):
        with contextlib.closing(process.stdout):
            raise RuntimeError(
                f"the PLC did not start (exit code {process.wait(PATIENCE_S)}): {line!r}"
            )
    return PlcProcess(process, int(line.rsplit(":", 1)[1]))
