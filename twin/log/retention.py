"""Deletes the oldest finished log files of a unit to make room, and reports each deletion.

Only files that ``twin run`` recorded of this unit in the one folder are deleted. Read-only files
stay, and so do imported, replayed and recovered logs.
"""

import shutil
import stat
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Self

from twin.errors import SourceError
from twin.instants import dated
from twin.log.part import SUFFIX
from twin.log.reader import read_header
from twin.log.records import is_complete

LOOK_S = 60.0  # interval at which the folder is checked
MOST_AT_ONCE = 50  # files deleted in one check, each with an event
ABANDONED_S = 86_400.0  # an unfinished file counts as finished after so long without a write
LEAST_SHARE = 0.1  # of the disk, which logs may keep however much others use
GB = 1e9  # bytes
DAY_S = 86_400.0

Say = Callable[[str], None]


@dataclass(frozen=True)
class Bounds:
    """How much is kept; None means no bound."""

    days: float | None = None
    bytes: float | None = None  # of all logs of the unit in the folder
    disk_share: float = 1.0  # of the disk that may be used, by whomever; 1 is no bound


@dataclass(frozen=True)
class Disk:
    """Bytes of a disk that a user without privileges can have."""

    total: int
    free: int

    @classmethod
    def of(cls, folder: Path) -> "Disk":
        """The disk that a folder is on; OSError if the folder does not exist."""
        usage = shutil.disk_usage(folder)
        return cls(usage.used + usage.free, usage.free)


@dataclass(frozen=True)
class File:
    """A finished file of a log."""

    path: Path
    size: int  # bytes
    ended_s: float  # when it was written last, s since 1970


def outdated(
    files: Sequence[File], bounds: Bounds, disk: Disk, now_s: float
) -> list[tuple[File, str]]:
    """Those of ``files`` (the oldest first) to delete, each with the reason."""
    total = sum(file.size for file in files)
    least = LEAST_SHARE * disk.total
    most_used = bounds.disk_share * disk.total
    deletions: list[tuple[File, str]] = []
    for file, cumulative in zip(files, accumulate(file.size for file in files), strict=True):
        remaining = total - (cumulative - file.size)  # with this one, without those before
        used = disk.total - disk.free - (cumulative - file.size)
        if bounds.days is not None and now_s - file.ended_s > bounds.days * DAY_S:
            reason = f"logs are kept for {bounds.days:g} days"
        elif bounds.bytes is not None and remaining > bounds.bytes:
            reason = f"logs of this unit may take {bounds.bytes / GB:g} GB"
        elif used > most_used and remaining > least:
            reason = f"the disk is more than {bounds.disk_share:.0%} full"
        else:
            break
        deletions.append((file, reason))
    return deletions


@dataclass
class Retention:
    """Keeps the logs of a unit in a folder within bounds; a ``with`` block runs it in a thread.

    The file that ``written`` names always stays. ``tell`` reports each deleted file; ``complain``
    reports a failure once.
    """

    folder: Path
    unit: tuple[str, str]  # type and ID
    bounds: Bounds
    written: Callable[[], Path]
    tell: Say
    complain: Say
    clock: Callable[[], float] = time.time
    disk: Callable[[Path], Disk] = Disk.of
    _ours: dict[Path, bool] = field(default_factory=dict)  # a head is read once
    _complained: bool = False
    _ending: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._work, name="retention", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()

    def look(self) -> None:
        """Delete files that are outdated now; OSError if that is not allowed."""
        files = self._finished()
        deletions = outdated(files, self.bounds, self.disk(self.folder), self.clock())
        for file, reason in deletions[:MOST_AT_ONCE]:
            file.path.unlink(missing_ok=True)
            until = dated(round(file.ended_s * 1e9))
            self.tell(
                f"{file.path.name} is deleted ({file.size / 1e6:.0f} MB, until {until}): {reason}"
            )

    def _work(self) -> None:
        while True:
            try:
                self.look()
                self._complained = False
            except Exception as error:  # whatever it is, the run goes on
                if not self._complained:
                    self.complain(f"old logs cannot be deleted: {error}")
                self._complained = True
            if self._ending.wait(LOOK_S):
                return

    def _finished(self) -> list[File]:
        """The files that may be deleted, the oldest first."""
        written = self.written().name  # before the listing: a file finished meanwhile stays
        files = []
        for path in self.folder.glob(f"*{SUFFIX}"):
            with suppress(OSError):  # somebody else has moved or deleted it
                status = path.lstat()
                may_go = stat.S_ISREG(status.st_mode) and status.st_mode & stat.S_IWUSR
                if may_go and path.name != written and self._is_over(path, status.st_mtime):
                    files.append(File(path, status.st_size, status.st_mtime))
        ours = [file for file in files if self._is_ours(file.path)]
        return sorted(ours, key=lambda file: (file.ended_s, file.path))

    def _is_over(self, path: Path, written_s: float) -> bool:
        return is_complete(path) or self.clock() - written_s > ABANDONED_S

    def _is_ours(self, path: Path) -> bool:
        if path not in self._ours:
            try:
                header = read_header(path)
            except SourceError:
                return False
            unit = header.asset_type, header.asset_id
            self._ours[path] = header.is_recorded and unit == self.unit
        return self._ours[path]
