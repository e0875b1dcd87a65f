"""The audit trail: who did what, from where and when, one JSON object a line beside the users.

Refused actions have a file of their own, so that guessing passwords cannot push out what users did.
Each file is rotated when it is large, and the oldest one is deleted.
"""

import errno
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

DONE, REFUSED = "audit.jsonl", "audit-refused.jsonl"
LARGEST = 2 << 20  # bytes of a file: some ten thousand records
KEPT = 5  # files of each kind, with the one that is written to
LOCK_S = 0.2  # longest wait for another process that writes
LONGEST = 200  # letters of a name or comment
SECOND_NS = 1_000_000_000


class Act(StrEnum):
    """Recorded actions, in addition to those on alarms."""

    LOGGED_IN = "logged_in"
    LOGGED_OUT = "logged_out"
    USER_ADDED = "user_added"
    USER_REMOVED = "user_removed"
    ROLE_CHANGED = "role_changed"
    PASSWORD_CHANGED = "password_changed"  # noqa: S105  # what happened
    WRONG_PASSWORD = "wrong_password"  # noqa: S105
    THROTTLED = "throttled"  # tried again during the wait; only the first such try is recorded
    COMMENTED = "commented"  # an alarm
    LIMIT_CHANGED = "limit_changed"  # asked for; the run applies it
    DENIED = "denied"  # the role does not allow it


_REFUSALS = {Act.WRONG_PASSWORD, Act.THROTTLED, Act.DENIED}


class Audit:
    """Appends records in ``folder``; a failing disk is reported once and blocks nobody.

    ``through`` is the interface that people use: page, opcua or command. ``clock`` returns ns since
    1970.
    """

    def __init__(
        self,
        folder: Path,
        through: str,
        complain: Callable[[str], None],
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._folder, self._through = folder, through
        self._complain, self._clock = complain, clock
        self._is_failing = False

    def record(self, act: str, who: str, address: str = "", **details: str) -> None:
        """Record that ``who`` did ``act``; the record is on the disk when this returns."""
        seconds, rest_ns = divmod(self._clock(), SECOND_NS)
        moment = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 1000:06d}Z"
        entry = {"time": moment, "what": str(act), "who": who[:LONGEST]}
        entry |= {"through": self._through, "from": address}
        entry |= {name: text[:LONGEST] for name, text in details.items() if text}
        line = json.dumps(entry, ensure_ascii=False).encode(errors="replace") + b"\n"
        path = self._folder / (REFUSED if act in _REFUSALS else DONE)
        try:
            with _locked(self._folder) as is_alone:
                if is_alone and _size(path) + len(line) > LARGEST:
                    _rotate(path)
                _append(path, line)
            self._is_failing = False
        except OSError as error:
            if not self._is_failing:
                self._complain(
                    f"{path}: the audit trail cannot be written: {error.strerror or error};"
                    " logins go on without it"
                )
            self._is_failing = True


def records(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """All records, the oldest first, and the number of unreadable lines; OSError as in open."""
    entries, broken = [], 0
    for name in (DONE, REFUSED):
        for path in _files(folder / name):
            for line in path.read_bytes().splitlines():
                try:
                    entry = json.loads(line)
                    moment = str(entry["time"])
                except (ValueError, KeyError, TypeError):
                    broken += bool(line)
                else:
                    entries.append((moment, entry))
    return [entry for _, entry in sorted(entries, key=lambda pair: pair[0])], broken


def in_words(entry: dict[str, Any]) -> str:
    """A record on one line; control characters are replaced, since names come from strangers."""
    act = str(entry.get("what", "")).replace("_", " ")
    origin = f"{entry.get('through', '')} {entry.get('from', '')}".strip()
    fixed_keys = ("time", "what", "who", "through", "from")
    details = [f"{name}={text}" for name, text in entry.items() if name not in fixed_keys]
    line = "  ".join(
        [str(entry["time"]), f"{act:<16}", str(entry.get("who", "")), origin, *details]
    )
    return "".join(letter if letter.isprintable() else "�" for letter in line)


# --- files ----------------------------------------------------------------------------------------


def _files(path: Path) -> list[Path]:
    """The existing files of a kind, the oldest first."""
    rotated = [_rotated_path(path, number) for number in range(KEPT - 1, 0, -1)]
    return [file for file in (*rotated, path) if file.exists()]


def _rotated_path(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


def _rotate(path: Path) -> None:
    for number in range(KEPT - 1, 1, -1):
        if (younger := _rotated_path(path, number - 1)).exists():
            younger.replace(_rotated_path(path, number))
    path.replace(_rotated_path(path, 1))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _append(path: Path, line: bytes) -> None:
    """Append a line and sync it; after an unfinished line of a crash, begin a new one."""
    handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o600)
    try:
        size = os.fstat(handle).st_size
        if size and os.pread(handle, 1, size - 1) != b"\n":
            line = b"\n" + line
        if os.write(handle, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder against other writers; yields whether that worked within LOCK_S."""
    try:
        import fcntl  # noqa: PLC0415 - other systems have none
    except ImportError:
        yield True
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        end = time.monotonic() + LOCK_S
        while not (is_alone := _try_lock(fcntl, handle)) and time.monotonic() < end:
            time.sleep(0.01)
        yield is_alone
    finally:
        os.close(handle)


def _try_lock(fcntl: Any, handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
