"""Limits attempts to log in, counted together for all processes."""

import os
import sqlite3
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

FILE = "logins.sqlite"  # beside the users; without it counting starts anew
MOST = 1000  # remembered names and addresses, each
FREE_TRIES = 5
BUSY_S = 0.2  # longest wait for another process that counts

_TABLE = """CREATE TABLE IF NOT EXISTS wrong (
    kind TEXT, who TEXT, count INTEGER, last REAL, told INTEGER, PRIMARY KEY (kind, who))"""
_FORGET = """DELETE FROM wrong WHERE kind = ? AND rowid NOT IN
    (SELECT rowid FROM wrong WHERE kind = ? ORDER BY rowid DESC LIMIT ?)"""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Wait:
    """How long somebody has to wait (s), and whether that was not recorded yet."""

    seconds: float = 0.0
    is_news: bool = False


class LoginThrottle:
    """Slows down guessing: after some wrong attempts each wait is twice as long as the last.

    ``longest_s`` is the longest wait for each kind of ``who``, such as address and name. ``clock``
    must be common to all processes of a machine. If the file cannot be written, each process counts
    for itself.
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
        """Begin an attempt of ``who``, by kind; it counts as wrong until ``right`` is called."""
        return self._transact(lambda connection: self._take(connection, who))

    def right(self, who: Mapping[str, str]) -> None:
        """Forget wrong attempts after a right one."""
        forget = "DELETE FROM wrong WHERE kind = ? AND who = ?"
        self._transact(lambda connection: connection.executemany(forget, who.items()))

    def _take(self, connection: sqlite3.Connection, who: Mapping[str, str]) -> Wait:
        now = self._clock()
        # The clock starts anew with the machine.
        connection.execute("UPDATE wrong SET last = ? WHERE last > ?", (now, now))
        query = "SELECT count, last, told FROM wrong WHERE kind = ? AND who = ?"
        rows = {key: connection.execute(query, key).fetchone() for key in who.items()}
        waits = {
            key: self._pause_s(key[0], row[0]) - (now - row[1]) for key, row in rows.items() if row
        }
        waiting = [key for key, wait_s in waits.items() if wait_s > 0.0]
        if waiting:
            update = "UPDATE wrong SET told = 1 WHERE kind = ? AND who = ?"
            connection.executemany(update, waiting)
            return Wait(max(waits.values()), any(not rows[key][2] for key in waiting))
        for kind, name in who.items():
            row = rows[kind, name]
            new_row = kind, name, (row[0] if row else 0) + 1, now
            connection.execute("REPLACE INTO wrong VALUES (?, ?, ?, ?, 0)", new_row)
            connection.execute(_FORGET, (kind, kind, MOST))
        return Wait()

    def _pause_s(self, kind: str, count: int) -> float:
        if count < FREE_TRIES:
            return 0.0
        return min(2.0 ** min(count - FREE_TRIES, 20), self._longest_s[kind])

    # --- storage --------------------------------------------------------------------------------

    def _transact(self, work: Callable[[sqlite3.Connection], Result]) -> Result:
        """Run ``work`` in an exclusive transaction, in the file; in memory if that fails."""
        with suppress(sqlite3.Error, OSError):
            os.close(os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600))  # for its owner alone
            with closing(self._open_database(str(self._path))) as connection:
                return self._run(connection, work)
        self._own = self._own or self._open_database(":memory:")
        return self._run(self._own, work)

    def _run(
        self, connection: sqlite3.Connection, work: Callable[[sqlite3.Connection], Result]
    ) -> Result:
        connection.execute("BEGIN IMMEDIATE")
        connection.execute(_TABLE)
        result = work(connection)
        connection.execute("COMMIT")
        return result

    def _open_database(self, path: str) -> sqlite3.Connection:
        connection = sqlite3.connect(
            path, timeout=BUSY_S, isolation_level=None, check_same_thread=False
        )
        try:
            connection.execute("PRAGMA synchronous = OFF")  # counting may start anew after a crash
            connection.execute("PRAGMA journal_mode = MEMORY")
        except sqlite3.Error:
            connection.close()
            raise
        return connection
