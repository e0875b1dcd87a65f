"""Deletes old cycles from the figure database while a run adds new ones, a few at a time."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from twin.assets.unit import Unit
from twin.errors import in_words
from twin.figures.database import Store
from twin.instants import DAY_NS

PORTION = 1000  # rows of one transaction, for which others wait
LOOK_S = 60.0  # interval at which the database is checked, once no old cycles are left


def forget(store: Store, unit: Unit, before_ns: int, progress: Callable[[int], None]) -> int:
    """Delete all cycles of a unit received before ``before_ns`` (UTC); returns how many.

    ``progress`` gets how many are deleted so far. Who stops it has deleted whole portions.
    """
    deleted = 0
    while rows := store.delete(unit, before_ns, PORTION):
        deleted += rows
        progress(deleted)
    return deleted


@dataclass
class Retention:
    """Deletes cycles that are older than ``days``; ``say`` reports the first time and failures.

    A failure is reported once, and tried again. ``clock`` gives UTC in ns, ``uptime`` seconds.
    """

    days: float
    say: Callable[[str], None]
    clock: Callable[[], int] = time.time_ns
    uptime: Callable[[], float] = time.monotonic
    _due_s: float = 0.0
    _announced: bool = False
    _failed: bool = False

    def apply(self, store: Store, unit: Unit) -> None:
        """Delete a portion of a unit's old cycles if it is time to check."""
        if self.uptime() < self._due_s:
            return
        if self._delete(store, unit) < PORTION:
            self._due_s = self.uptime() + LOOK_S

    def _delete(self, store: Store, unit: Unit) -> int:
        """The number of rows deleted; 0 after a failure."""
        try:
            rows = store.delete(unit, self.clock() - round(self.days * DAY_NS), PORTION)
        except Exception as error:  # whatever it is, the run goes on
            if not self._failed:
                self.say(f"old key figures cannot be deleted: {in_words(error)}")
            self._failed = True
            return 0
        self._failed = False
        if rows and not self._announced:
            self.say(
                f"key figures of cycles older than {self.days:g} days are deleted"
                " ([figures] keep_days); the counters keep them"
            )
            self._announced = True
        return rows
