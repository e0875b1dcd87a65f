"""Allows one run at a time for a unit, by a lock on a file in its output folder."""

import errno
import os
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.errors import SourceError
from twin.instants import dated

LOOK_S = 1.0  # interval of checks that the file still exists; a log notices that as fast
_TAKEN = (errno.EAGAIN, errno.EACCES)  # flock's errors for a lock of another process


def lock_file(folder: Path, unit: str) -> Path:
    """The lock file of a unit in a folder; it remains after a run."""
    name = re.sub(r"[^\w.-]+", "_", unit)
    return folder / f".{name}.lock"


@contextmanager
def only_run(
    folder: Path, unit: str, now_ns: int, complain: Callable[[str], None]
) -> Iterator[None]:
    """Be the only run of ``unit`` that writes into ``folder``; SourceError names another one.

    The file contains ``now_ns`` (UTC) for others to read. ``complain`` reports that locking is
    impossible. If somebody deletes the file or its folder, the lock is taken again once the folder
    exists.
    """
    lock = _Lock(lock_file(folder, unit), unit, now_ns)
    try:
        lock.hold()
    except (ImportError, OSError) as error:
        complain(f"{lock.refused(error)}: a second run of this unit would not be noticed")
        yield
        return
    ended = threading.Event()
    watch = threading.Thread(target=_watch, args=(lock, ended, complain), name="lock", daemon=True)
    watch.start()
    try:
        yield
    finally:
        ended.set()
        watch.join()
        lock.let_go()


def _watch(lock: "_Lock", ended: threading.Event, complain: Callable[[str], None]) -> None:
    """Take the lock again after its file was deleted; each failure is reported once."""
    last_text = ""
    while not ended.wait(LOOK_S):
        try:
            lock.hold()
            last_text = ""
        except FileNotFoundError:  # its folder is gone: nobody can write into it now
            continue
        except (SourceError, OSError) as error:
            text = str(error) if isinstance(error, SourceError) else lock.refused(error)
            if last_text != text:
                complain(f"{text}; this run goes on")
            last_text = text


class _Lock:
    """A lock on a file that others may delete."""

    def __init__(self, path: Path, unit: str, now_ns: int) -> None:
        self._path, self._unit = path, unit
        self._content = f"process {os.getpid()} since {dated(now_ns)}\n".encode()
        self._handle: int | None = None

    def hold(self) -> None:
        """Take the lock, or take it again if the locked file is no longer at its path.

        SourceError if another process holds it, OSError or ImportError if it cannot be locked.
        """
        if self._handle is not None and _is_at(self._path, self._handle):
            return
        handle = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._lock(handle)
        except BaseException:
            os.close(handle)
            raise
        self.let_go()
        self._handle = handle
        with suppress(OSError):  # a full disk is no reason not to run
            os.ftruncate(handle, 0)
            os.pwrite(handle, self._content, 0)

    def let_go(self) -> None:
        """Release the lock."""
        if self._handle is not None:
            os.close(self._handle)
        self._handle = None

    def refused(self, error: Exception) -> str:
        """The text of a failure to lock."""
        return f"{self._path} cannot be locked ({error})"

    def _lock(self, handle: int) -> None:
        import fcntl  # noqa: PLC0415 - other systems have none, and run without

        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _TAKEN:  # some network folders have no locks
                raise
            holder = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process"
            raise SourceError(
                f"{self._unit} is watched already: {holder} writes into"
                f" {self._path.parent.resolve()}",
                "two runs would write each cycle twice: end that one first",
            ) from error


def _is_at(path: Path, handle: int) -> bool:
    """Whether ``path`` is the open file of ``handle``."""
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except OSError:
        return False
