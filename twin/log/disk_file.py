"""The file on disk below a log."""

import errno
import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path


class Output:
    """A new unbuffered file; OSError if the disk is full or fails.

    Written bytes survive the process. A failed write is not tried again at close.
    """

    def __init__(self, path: Path) -> None:
        # A sync may take hundreds of milliseconds on flash; the live loop must not wait for it.
        self._thread = ThreadPoolExecutor(1, "log-sync")
        self._syncing: Future[None] | None = None
        self._raw = path.open("xb", buffering=0)  # last: an earlier failure leaves no empty file

    def write(self, data: bytes) -> None:
        """Write all of ``data``."""
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[self._raw.write(remaining) :]

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def tell(self) -> int:
        """Bytes written."""
        return self._raw.tell()

    def sync(self) -> None:
        """Start a sync to the disk, unless one is still under way.

        OSError if the last sync failed or somebody has deleted the file.
        """
        if os.fstat(self._raw.fileno()).st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "somebody has deleted it")
        if self._syncing is not None:
            if not self._syncing.done():
                return
            self._syncing.result()  # raises what went wrong
        self._syncing = self._thread.submit(os.fdatasync, self._raw.fileno())

    def finish(self) -> None:
        """Sync everything to the disk, wait for it and close the file."""
        self._thread.shutdown()
        if self._syncing is not None:
            self._syncing.result()
        os.fdatasync(self._raw.fileno())
        self._raw.close()

    def abandon(self) -> None:
        """Close the file after a reported error; further errors are ignored."""
        self._thread.shutdown()
        with suppress(OSError):
            self._raw.close()
