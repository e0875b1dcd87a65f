"""Write key figures to the database, from the loop or a log; the loop never waits for it."""

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from twin.assets.unit import Unit
from twin.errors import in_words
from twin.events import Event, Kind, Severity
from twin.figures.database import LIVE, Store
from twin.figures.retention import Retention
from twin.signals import Samples, Ticks

BATCH_S = 2.0  # cycles of this time are written together
RETRY_S = 5.0  # after the database could not be written
MOST_WAITING = 20_000  # cycles that wait for an unreachable database: most of a day


class Alarms:
    """Counts alarms for the cycles they were raised in."""

    def __init__(self) -> None:
        self._open: list[int] = []  # PLC times of those that no cycle has counted

    def see(self, events: Iterable[Event]) -> None:
        """Take events; alarms among them count."""
        self._open += [event.time_ns for event in events if event.severity is Severity.ALARM]

    def until(self, end_ns: int) -> int:
        """Number of alarms up to the end of a cycle, since the cycle before."""
        later = [time_ns for time_ns in self._open if time_ns > end_ns]
        count, self._open = len(self._open) - len(later), later
        return count


class FigureWriter:
    """A sink that stores the key figures of CYCLE events, in a thread of its own.

    A failure to write is reported once, and cycles wait until writing works again; the loop goes on
    in every case. Old cycles are deleted if a ``retention`` is given.
    """

    def __init__(  # everything that makes a row whole
        self,
        open_store: Callable[[], Store],
        unit: Unit,
        data_set: str,
        say: Callable[[str], None],
        retention: Retention | None = None,
    ) -> None:
        self._open_store = open_store
        self._origin = unit, data_set, LIVE
        self._retention = retention
        self._say = say
        self._alarms = Alarms()
        self._store: Store | None = None
        self._waiting: list[Mapping[str, Any]] = []
        self._failed = False
        self._cycles: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="key figures", daemon=True)
        self._thread.start()

    def write(self, _samples: Samples, _ticks: Ticks, events: Sequence[Event]) -> None:
        """Take the events; rows are ignored."""
        if not events:
            return
        self._alarms.see(events)
        for event in events:
            if event.kind is Kind.CYCLE and "begin_ns" in event.data:
                alarms = self._alarms.until(int(event.data["end_ns"]))
                self._cycles.put({**event.data, "alarms": alarms})

    def close(self) -> None:
        """Write the remaining cycles; it does not wait long for an unreachable database."""
        self._ending.set()
        self._thread.join()

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        pause = BATCH_S
        while not self._ending.wait(pause):
            pause = BATCH_S if self._write_waiting() else RETRY_S
            if self._retention is not None and self._store is not None:
                self._retention.apply(self._store, self._origin[0])
        if not self._write_waiting():
            text = f"key figures of {len(self._waiting)} cycles could not be stored"
            self._say(f"{text}; from a log: twin figures show LOG --keep")
        self._close_store()

    def _write_waiting(self) -> bool:
        """Write all waiting cycles; reports the first failure, and success after failures."""
        while not self._cycles.empty():
            self._waiting.append(self._cycles.get())
        del self._waiting[:-MOST_WAITING]
        if not self._waiting:
            return True
        try:
            self._store = self._store or self._open_store()
            self._store.add(*self._origin, self._waiting)
        except Exception as error:  # whatever it is, later cycles must be stored
            self._close_store()
            if not self._failed:
                self._say(f"key figures wait in memory: {in_words(error)}")
            self._failed = True
            return False
        if self._failed:
            self._say(f"key figures are stored again: {len(self._waiting)} cycles had waited")
        self._failed, self._waiting = False, []
        return True

    def _close_store(self) -> None:
        if self._store is not None:
            self._store.close()
        self._store = None
