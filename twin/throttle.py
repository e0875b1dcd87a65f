"""How often one may try a password, counted once for all processes that take them."""

import os
import sqlite3
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

FILE = "logins.sqlite"  # beside the users; without it counting begins anew
MOST = 1000  # who are remembered of a kind
FREE_TRIES = 5
BUSY_S = 0.2  # longest wait for another process that counts

_TABLE = """CREATE TABLE IF NOT EXISTS wrong (
    kind TEXT, who TEXT, count INTEGER, last REAL, told INTEGER, PRIMARY KEY (kind, who))"""
_FORGET = """DELETE FROM wrong WHERE kind = ? AND rowid NOT IN
    (SELECT rowid FROM wrong WHERE kind = ? ORDER BY rowid DESC LIMIT ?)"""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Wait:
    """How long somebody has to wait (s), and whether that has not been told yet."""

    seconds: float = 0.0
    is_news: bool = False


class LoginThrottle:
    """Slows down who guesses: after some wrong ones each takes twice as long as the one before.

    ``longest_s`` has the longest wait of each kind of ``who``, as address and name are. ``clock``
    is one for all processes of a machine. Where the file cannot be written each counts for itself.
    """

    def __init__(
        self,
        path: Path,
        longest_s: Mapping[str, float],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path, self._longest_s, self._clock = path, longest_s, clock
        self._own: sqlite3.Connection | None = None

    def take(self, who: Mapping[str, str]) -> Wait:
        """Begin a try, by kind who makes it; it counts as wrong until it was ``right``."""
        return self._counted(lambda connection: self._take(connection, who))

    def right(self, who: Mapping[str, str]) -> None:
        """It was right: nothing is held against him."""
        forget = "DELETE FROM wrong WHERE kind = ? AND who = ?"
        self._counted(lambda connection: connection.executemany(forget, who.items()))

    def _take(self, connection: sqlite3.Connection, who: Mapping[str, str]) -> Wait:
        now = self._clock()
        # The clock begins anew with the machine.
        connection.execute("UPDATE wrong SET last = ? WHERE last > ?", (now, now))
        find = "SELECT count, last, told FROM wrong WHERE kind = ? AND who = ?"
        there = {one: connection.execute(find, one).fetchone() for one in who.items()}
        waits = {
            one: self._pause_s(one[0], row[0]) - (now - row[1]) for one, row in there.items() if row
        }
        waiting = [one for one, wait_s in waits.items() if wait_s > 0.0]
        if waiting:
            tell = "UPDATE wrong SET told = 1 WHERE kind = ? AND who = ?"
            connection.executemany(tell, waiting)
            return Wait(max(waits.values()), any(not there[one][2] for one in waiting))
        for kind, name in who.items():
            row = there[kind, name]
            counted = kind, name, (row[0] if row else 0) + 1, now
            connection.execute("REPLACE INTO wrong VALUES (?, ?, ?, ?, 0)", counted)
            connection.execute(_FORGET, (kind, kind, MOST))
        return Wait()

    def _pause_s(self, kind: str, count: int) -> float:
        if count < FREE_TRIES:
            return 0.0
        return min(2.0 ** min(count - FREE_TRIES, 20), self._longest_s[kind])

    # --- where it is counted --------------------------------------------------------------------

    def _counted(self, work: Callable[[sqlite3.Connection], Result]) -> Result:
        """Work that no other process comes between, in the file; where that fails, in memory."""
        with suppress(sqlite3.Error, OSError):
            os.close(os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600))  # for its owner alone
            with closing(self._opened(str(self._path))) as connection:
                return self._done(connection, work)
        self._own = self._own or self._opened(":memory:")
        return self._done(self._own, work)

    def _done(
        self, connection: sqlite3.Connection, work: Callable[[sqlite3.Connection], Result]
    ) -> Result:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute(_TABLE)
        result = work(connection)
        connection.execute("COMMIT")
        return result

    def _opened(self, path: str) -> sqlite3.Connection:
        connection = sqlite3.connect(
            path, timeout=BUSY_S, isolation_level=None, check_same_thread=False
        )
        try:
            connection.execute("PRAGMA synchronous = OFF")  # after a crash it may begin anew
            connection.execute("PRAGMA journal_mode = MEMORY")
        except sqlite3.Error:
            connection.close()
            raise
        return connection
