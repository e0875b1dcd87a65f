"""One run at a time for a unit: a lock on a file beside what it writes, until the process ends."""

import errno
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.errors import SourceError
from twin.instants import dated

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
    """
    path = lock_file(folder, unit)
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        complain(_unguarded(path, error))
        yield
        return
    try:
        _take(path, handle, unit, complain)
        with suppress(OSError):  # a full disk is no reason not to run
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"process {os.getpid()} since {dated(now_ns)}\n".encode(), 0)
        yield
    finally:
        os.close(handle)


def _take(path: Path, handle: int, unit: str, complain: Callable[[str], None]) -> None:
    try:
        import fcntl  # noqa: PLC0415 - other systems have none, and run without

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError as error:
        complain(_unguarded(path, error))
    except OSError as error:
        if error.errno not in _TAKEN:  # some network folders have no locks
            complain(_unguarded(path, error))
            return
        holder = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process"
        raise SourceError(
            f"{unit} is watched already: {holder} writes into {path.parent.resolve()}",
            "two runs would write each cycle twice: end that one first",
        ) from error


def _unguarded(path: Path, error: Exception) -> str:
    return f"{path} cannot be locked ({error}): a second run of this unit would not be noticed"
