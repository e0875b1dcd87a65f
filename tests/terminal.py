"""A terminal in a fresh folder, in which a person runs ``twin`` and reads the screen."""

import fcntl
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

ROOT = Path(__file__).parents[1]
ROWS, COLUMNS = 40, 200
PATIENCE_S = 120.0  # the machine may be busy, and something may have to be compiled
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")


class Program:
    """A command of ``twin`` in a terminal of its own; what it writes is on the screen."""

    def __init__(self, folder: Path, *arguments: str | Path) -> None:
        self._screen, terminal = pty.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
        path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "twin.cli", *map(str, arguments)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path},
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            start_new_session=True,
        )
        os.close(terminal)
        self._read = bytearray()
        self._news = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._take, name="terminal")
        self._reader.start()

    @property
    def screen(self) -> str:
        """All that was written, without colours."""
        return _ESCAPES.sub("", self._read.decode(errors="replace"))

    def until(self, pattern: str) -> str:
        """Wait until a pattern is on the screen; gives its first group, else all of it."""
        with self._news:
            self._news.wait_for(lambda: self._ended or re.search(pattern, self.screen), PATIENCE_S)
        found = re.search(pattern, self.screen)
        assert found, f"{pattern!r} was never on the screen:\n{self.screen}"
        return found[found.lastindex or 0]

    def answer(self, text: str) -> None:
        """Type a line."""
        os.write(self._screen, f"{text}\n".encode())

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def end(self) -> int:
        """Wait for its end; gives its exit code."""
        code = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return code

    def _take(self) -> None:
        while True:
            try:
                read = os.read(self._screen, 65_536)
            except OSError:  # nobody has the terminal any more
                read = b""
            with self._news:
                self._read += read
                self._ended = not read
                self._news.notify_all()
            if not read:
                return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(20.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self._reader.join()
        os.close(self._screen)


def typed(
    folder: Path, *arguments: str | Path, lines: tuple[str, ...] = (), code: int | None = 0
) -> str:
    """Run a command to its end, answer what it asks; gives the screen. None is any exit code."""
    with Program(folder, *arguments) as program:
        for number, line in enumerate(lines):
            program.until(rf"(?s)(?:.*?: ){{{number + 1}}}")
            program.answer(line)
        ended = program.end()
        assert code in (ended, None), program.screen
        return program.screen
