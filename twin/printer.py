"""Prints lines to a stream from a thread of its own, so that the loop never waits for a reader.

A pager may be paused, a terminal stopped, a disk full. Then a write to a pipe blocks. The stream
cannot be made non-blocking, since that would affect all who have it open.
"""

import errno
import os
import threading
from collections import deque
from io import UnsupportedOperation
from typing import TextIO

from twin.errors import SourceError

MOST_WAITING = 1000  # waiting texts
RETRY_S = 1.0  # after a full disk
PATIENCE_S = 3.0  # at the end, for a reader that takes nothing
NOBODY = {errno.EPIPE, errno.EIO, errno.EBADF}  # the reader has gone, or the terminal is closed


class Printer:
    """Prints to a stream in order. Once the reader has gone, it prints nothing more."""

    def __init__(self, stream: TextIO) -> None:
        stream.flush()
        self._stream = stream
        try:
            self._handle: int | None = stream.fileno()
        except UnsupportedOperation:  # a stream in memory
            self._handle = None
        self._texts: deque[str] = deque()
        self._rest = b""  # unwritten bytes of the first text
        self._missing = 0  # lines that were dropped
        self._why = "nobody takes what it says"
        self._taken = 0
        self._is_read, self._ending = True, False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="printer", daemon=True)
        self._thread.start()

    def print(self, text: str) -> None:
        """Queue lines for printing; SourceError if too many wait, and then none are queued."""
        with self._changed:
            if not self._is_read:
                return
            if len(self._texts) >= MOST_WAITING:
                hint = "go on with the pager or the terminal, or send the output into a file"
                raise SourceError(self._why, hint)
            self._texts.append(text)
            self._changed.notify_all()

    def say(self, text: str) -> None:
        """Print a line that may be dropped; the next line says how many were."""
        try:
            missing = f"twin: {self._missing} lines are missing here\n" if self._missing else ""
            self.print(missing + text)
            self._missing = 0
        except SourceError:
            self._missing += 1

    def close(self) -> int:
        """Print waiting texts while the reader takes them; returns the number of the others."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
            taken = -1
            while self._texts and self._is_read and taken != self._taken:
                taken = self._taken
                self._changed.wait(PATIENCE_S)
            unprinted = len(self._texts) if self._is_read else 0
            self._is_read = False
            self._changed.notify_all()
        if not unprinted:
            self._thread.join()
        return unprinted

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        while self._wait_for_text():
            try:
                self._write()
            except OSError as error:
                self._fail(error)

    def _wait_for_text(self) -> bool:
        """Wait for the next text; False if there will be none."""
        with self._changed:
            while self._is_read and not self._texts and not self._ending:
                self._changed.wait()
            if not (self._is_read and self._texts):
                return False
            if not self._rest:
                encoding = self._stream.encoding or "utf-8"
                self._rest = self._texts[0].encode(encoding, "backslashreplace")
            return True

    def _write(self) -> None:
        if self._handle is None:
            self._stream.write(self._rest.decode(self._stream.encoding or "utf-8"))
            self._rest = b""
        while self._rest and self._handle is not None:
            self._rest = self._rest[os.write(self._handle, self._rest) :]
        with self._changed:
            self._texts.popleft()
            self._taken += 1
            self._why = "nobody takes what it says"
            self._changed.notify_all()

    def _fail(self, error: OSError) -> None:
        """Stop printing if the reader has gone, else wait before the next attempt."""
        with self._changed:
            self._is_read &= error.errno not in NOBODY
            self._why = f"it cannot be written: {error.strerror}"
            self._changed.notify_all()
            if self._is_read and not self._ending:
                self._changed.wait(RETRY_S)
