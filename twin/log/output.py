"""The file on disk below a log."""

import errno
import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path


class Output:
    """A new file without a buffer; OSError where the disk is full or fails.

    What is written survives the process, and what could not be written is not tried again at
    close.
    """

    def __init__(self, path: Path) -> None:
        # The disk may take its time, hundreds of milliseconds on flash; the live loop has none.
        self._thread = ThreadPoolExecutor(1, "log-sync")
        self._syncing: Future[None] | None = None
        self._raw = path.open("xb", buffering=0)  # last: what fails leaves no empty file

    def write(self, data: bytes) -> None:
        """Write all of it."""
        left = memoryview(data)
        while left:
            left = left[self._raw.write(left) :]

    def flush(self) -> None:
        """Nothing is held back."""

    def tell(self) -> int:
        """Bytes written."""
        return self._raw.tell()

    def sync(self) -> None:
        """Start bringing everything to the disk, unless that is still under way.

        OSError where that went wrong before, or somebody has deleted the file.
        """
        if os.fstat(self._raw.fileno()).st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "somebody has deleted it")
        if self._syncing is not None:
            if not self._syncing.done():
                return
            self._syncing.result()  # raises what went wrong
        self._syncing = self._thread.submit(os.fdatasync, self._raw.fileno())

    def finish(self) -> None:
        """Bring everything to the disk, wait for it and close."""
        self._thread.shutdown()
        if self._syncing is not None:
            self._syncing.result()
        os.fdatasync(self._raw.fileno())
        self._raw.close()

    def abandon(self) -> None:
        """Close as it stands, after an error that was told; another one adds nothing."""
        self._thread.shutdown()
        with suppress(OSError):
            self._raw.close()
