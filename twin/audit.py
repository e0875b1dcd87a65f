"""The audit trail: who did what, from where and when, one JSON object a line beside the users.

What was refused has a file of its own: whoever guesses passwords must not push out what users did.
Each file is moved aside when it is large, and the oldest goes.
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
    """What is told beside the deeds of alarms."""

    LOGGED_IN = "logged_in"
    LOGGED_OUT = "logged_out"
    USER_ADDED = "user_added"
    USER_REMOVED = "user_removed"
    ROLE_CHANGED = "role_changed"
    PASSWORD_CHANGED = "password_changed"  # noqa: S105  # what happened
    WRONG_PASSWORD = "wrong_password"  # noqa: S105
    THROTTLED = "throttled"  # tried again before the time was over; the first such try is told
    COMMENTED = "commented"  # an alarm
    DENIED = "denied"  # the role does not allow it


_REFUSALS = {Act.WRONG_PASSWORD, Act.THROTTLED, Act.DENIED}


class Audit:
    """Appends records in ``folder``; a disk that fails is complained of once and holds up nobody.

    ``through`` is which way people come: page, opcua or command. ``clock`` gives ns since 1970.
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
        self._fails = False

    def record(self, what: str, who: str, address: str = "", **details: str) -> None:
        """Keep that ``who`` did ``what``; it is on the disk when this returns."""
        seconds, rest_ns = divmod(self._clock(), SECOND_NS)
        moment = f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 1000:06d}Z"
        told = {"time": moment, "what": str(what), "who": who[:LONGEST]}
        told |= {"through": self._through, "from": address}
        told |= {name: text[:LONGEST] for name, text in details.items() if text}
        line = json.dumps(told, ensure_ascii=False).encode(errors="replace") + b"\n"
        path = self._folder / (REFUSED if what in _REFUSALS else DONE)
        try:
            with _locked(self._folder) as is_alone:
                if is_alone and _size(path) + len(line) > LARGEST:
                    _move_aside(path)
                _append(path, line)
            self._fails = False
        except OSError as error:
            if not self._fails:
                self._complain(
                    f"{path}: the audit trail cannot be written: {error.strerror or error};"
                    " logins go on without it"
                )
            self._fails = True


def records(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """All records, the oldest first, and how many lines cannot be read; OSError as open."""
    found, broken = [], 0
    for name in (DONE, REFUSED):
        for path in _files(folder / name):
            for line in path.read_bytes().splitlines():
                try:
                    told = json.loads(line)
                    moment = str(told["time"])
                except (ValueError, KeyError, TypeError):
                    broken += bool(line)
                else:
                    found.append((moment, told))
    return [told for _, told in sorted(found, key=lambda one: one[0])], broken


def in_words(told: dict[str, Any]) -> str:
    """A record on one line. Names are a stranger's: what a terminal would act on is left out."""
    what = str(told.get("what", "")).replace("_", " ")
    place = f"{told.get('through', '')} {told.get('from', '')}".strip()
    known = ("time", "what", "who", "through", "from")
    details = [f"{name}={text}" for name, text in told.items() if name not in known]
    line = "  ".join([str(told["time"]), f"{what:<16}", str(told.get("who", "")), place, *details])
    return "".join(letter if letter.isprintable() else "�" for letter in line)


# --- files ----------------------------------------------------------------------------------------


def _files(path: Path) -> list[Path]:
    """Those of a kind that are there, the oldest first."""
    aside = [_aside(path, number) for number in range(KEPT - 1, 0, -1)]
    return [one for one in (*aside, path) if one.exists()]


def _aside(path: Path, number: int) -> Path:
    return path.with_name(f"{path.stem}.{number}{path.suffix}")


def _move_aside(path: Path) -> None:
    for number in range(KEPT - 1, 1, -1):
        if (younger := _aside(path, number - 1)).exists():
            younger.replace(_aside(path, number))
    path.replace(_aside(path, 1))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _append(path: Path, line: bytes) -> None:
    """Whole and on the disk; after what a crash has left of a line, on a new one."""
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
    """Whether no other process writes in a folder; where one hangs it is not waited for long."""
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
