"""Writes alarms to the database and reads people's requests. The loop never waits for it."""

import queue
import threading
from collections.abc import Callable

from twin.alarms.database import Store
from twin.alarms.loop import Before, News
from twin.alarms.requests import LimitChange, Request
from twin.assets.unit import Unit
from twin.errors import TwinError, in_words

POLL_S = 1.0  # interval at which changes are written and requests are read
RETRY_S = 5.0  # after the database could not be reached


class AlarmWriter:
    """Stores the alarms of a unit, in a thread of its own (``twin.alarms.loop.AlarmStorage``).

    A failure is reported once, and the changes are held until they can be written. The loop always
    goes on.
    """

    def __init__(
        self, open_store: Callable[[], Store], unit: Unit, say: Callable[[str], None]
    ) -> None:
        self._open_store, self._unit, self._say = open_store, unit, say
        self._store: Store | None = None
        self._waiting = News()
        self._failed = False
        self._news: queue.SimpleQueue[News] = queue.SimpleQueue()
        self._requests: queue.SimpleQueue[Request] = queue.SimpleQueue()
        self._limits: queue.SimpleQueue[LimitChange] = queue.SimpleQueue()
        self._passed_on = 0  # ID of the newest request handed to the loop
        self._passed_limit = 0  # the same of changes of limits
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="alarms", daemon=True)

    def begin(self) -> Before:
        """Start; returns the state of an earlier run, or an empty one without a database."""
        before = Before()
        try:
            self._store = self._open_store()
            before = self._store.before(self._unit)
            self._pass_on_limits(self._store)
        except TwinError as error:
            self._let_go()
            self._failed = True
            self._say(f"alarms begin anew, and wait in memory: {error}")
        self._thread.start()
        return before

    def take(self, news: News) -> None:
        """Take changes to store."""
        self._news.put(news)

    def asked(self) -> list[Request]:
        """People's requests since the last call."""
        return [self._requests.get() for _ in range(self._requests.qsize())]

    def limit_changes(self) -> list[LimitChange]:
        """Changes of limits since the last call, first those of all earlier runs."""
        return [self._limits.get() for _ in range(self._limits.qsize())]

    def close(self) -> None:
        """Write what is left; if the database cannot be reached, only one more attempt is made."""
        self._ending.set()
        self._thread.join()

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        pause = POLL_S
        while not self._ending.wait(pause):
            pause = POLL_S if self._exchange() else RETRY_S
        if not self._exchange() and self._waiting:
            self._say(f"{len(self._waiting.episodes)} episodes of alarms could not be stored")
        self._let_go()

    def _exchange(self) -> bool:
        """Write changes and read requests; reports when this begins to fail."""
        while not self._news.empty():
            self._waiting.add(self._news.get())
        try:
            self._store = self._store or self._open_store()
            if self._waiting:
                self._store.save(self._unit, self._waiting)
            self._waiting = News()
            self._pass_on(self._store.requests(self._unit))
            self._pass_on_limits(self._store)
        except Exception as error:  # later changes must still be stored, whatever the error
            self._let_go()
            if not self._failed:
                self._say(f"alarms wait in memory: {in_words(error)}")
            self._failed = True
            return False
        if self._failed:
            self._say("alarms are stored again")
        self._failed = False
        return True

    def _pass_on(self, requests: list[Request]) -> None:
        """Hand over each request once; it stays in the database until it has its answer."""
        for request in requests:
            if request.id > self._passed_on:
                self._passed_on = request.id
                self._requests.put(request)

    def _pass_on_limits(self, store: Store) -> None:
        """Hand over each change of a limit once, in their order."""
        for change in store.limit_changes(self._unit, self._passed_limit):
            self._passed_limit = change.id
            self._limits.put(change)

    def _let_go(self) -> None:
        if self._store is not None:
            self._store.close()
        self._store = None
