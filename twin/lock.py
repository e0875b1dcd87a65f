"""One run at a time for a unit: a lock on a file beside what it writes, until the process ends."""

import errno
import os
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.errors import SourceError
from twin.instants import dated

LOOK_S = 1.0  # between looks whether the file is still there; a log finds as fast that it is not
_TAKEN = (errno.EAGAIN, errno.EACCES)  # what flock says of one that another process holds


def lock_file(folder: Path, unit: str) -> Path:
    """Where the lock of a unit in a folder is; it stays there when a run has ended."""
    name = re.sub(r"[^\w.-]+", "_", unit)
    return folder / f".{name}.lock"


@contextmanager
def only_run(
    folder: Path, unit: str, now_ns: int, complain: Callable[[str], None]
) -> Iterator[None]:
    """Be the only run of ``unit`` that writes into ``folder``; SourceError says who else is.

    ``now_ns`` (UTC) is kept for others to read. Where nothing can be locked it is complained of.
    Somebody may delete the file, with its folder maybe: once the folder is there again, so is it.
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
    """Hold the lock wherever its file is deleted; what hinders that is said once."""
    said = ""
    while not ended.wait(LOOK_S):
        try:
            lock.hold()
            said = ""
        except FileNotFoundError:  # its folder is gone: nobody can write into it now
            continue
        except (SourceError, OSError) as error:
            text = str(error) if isinstance(error, SourceError) else lock.refused(error)
            if said != text:
                complain(f"{text}; this run goes on")
            said = text


class _Lock:
    """A lock on a file, which others may delete."""

    def __init__(self, path: Path, unit: str, now_ns: int) -> None:
        self._path, self._unit = path, unit
        self._told = f"process {os.getpid()} since {dated(now_ns)}\n".encode()
        self._handle: int | None = None

    def hold(self) -> None:
        """Take it, or take it again if the file there is not the one that is locked.

        SourceError if somebody else has it, OSError or ImportError if it cannot be locked.
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
            os.pwrite(handle, self._told, 0)

    def let_go(self) -> None:
        """Others may have it."""
        if self._handle is not None:
            os.close(self._handle)
        self._handle = None

    def refused(self, error: Exception) -> str:
        """What is wrong, in words."""
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
    """Whether that is the open file of ``handle``."""
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except OSError:
        return False
