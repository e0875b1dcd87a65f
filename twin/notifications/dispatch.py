"""A sink that puts messages for all destinations into the outbox. The loop never waits for it."""

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from twin.assets.unit import Unit
from twin.errors import in_words
from twin.events import Event
from twin.notifications.data import MessageSource
from twin.notifications.message import Message, of_event, restated
from twin.notifications.outbox import Outbox
from twin.notifications.sender import Sender, box_of
from twin.notifications.uploader import UPLOAD, Uploader
from twin.signals import Samples, Ticks

MOST_IN_MEMORY = 10_000  # messages, while the database is away
MOST_AT_ONCE = 1000
RETRY_S = 5.0
CLOSE_S = 15.0  # for all threads to end; they die with the program
AddressedMessage = tuple[str, Message]  # destination and message


class Outlets:
    """Sends the alarms of a unit and further data to destinations (``twin.live.Sink``).

    One thread writes into the outbox, and one for each destination delivers. ``restating`` names
    the destinations that get every alarm's state at the start. ``message_sources`` make the further
    data of each destination.
    """

    def __init__(
        self,
        unit: Unit,
        open_outbox: Callable[[], Outbox],
        senders: Sequence[Sender],
        say: Callable[[str], None],
        *,
        restating: Sequence[str] = (),
        message_sources: Mapping[str, Sequence[MessageSource]] | None = None,
        uploader: Uploader | None = None,
    ) -> None:
        self._unit, self._open_outbox, self._senders = unit, open_outbox, senders
        self._say, self._restating, self._uploader = say, restating, uploader
        self._message_sources = [
            (box_of(name, source.topic), source)
            for name, group in (message_sources or {}).items()
            for source in group
        ]
        self._outbox: Outbox | None = None
        self._failed = False
        self._lost = 0  # messages for which there was no room
        self._waiting: list[AddressedMessage] = []
        self._queue: queue.Queue[AddressedMessage] = queue.Queue(MOST_IN_MEMORY)
        self._ending, self._news = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="outbox", daemon=True)

    def begin(self, standing: Sequence[Mapping[str, Any]]) -> None:
        """Start; ``standing`` are the alarms' present states (``twin.alarms.text.plain``)."""
        now_ns = time.time_ns()
        for alarm in standing:
            message = restated(self._unit, alarm, now_ns)
            for name in self._restating:
                self._put(name, message)
        self._thread.start()
        if self._uploader is not None:
            self._uploader.start(partial(self.tell, box_of("mqtt", UPLOAD)))
        for sender in self._senders:
            sender.start()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take rows and events."""
        for event in events:
            for message in of_event(self._unit, event):
                for sender in self._senders:
                    self._put(sender.name, message)
        for box, source in self._message_sources:
            for message in source.tell(samples, ticks, events):
                self.tell(box, message)

    def tell(self, box: str, message: Message) -> None:
        """Put a message that is no alarm into the outbox; from any thread.

        It leaves room for alarms while the database cannot be reached.
        """
        if self._queue.qsize() < MOST_IN_MEMORY // 2:
            self._put(box, message)
        else:
            self._lost += 1

    def close(self) -> None:
        """Write and deliver what is possible at once; the rest waits for the next run.

        A thread that still waits for an answer then is abandoned, with a message.
        """
        end = time.monotonic() + CLOSE_S
        if self._uploader is not None:
            self._uploader.end()
            if not self._uploader.join(CLOSE_S / 2):
                self._say("an upload does not end: it begins anew with the next run")
        for box, source in self._message_sources:
            for message in source.rest():
                self.tell(box, message)
        self._ending.set()
        self._news.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self._say("the last changes of alarms may not be in the outbox: it does not answer")
        for sender in self._senders:
            sender.end()
        for sender in self._senders:
            if not sender.join(max(0.0, end - time.monotonic())):
                self._say(f"{sender.name} does not answer: the rest waits for the next run")

    def _put(self, name: str, message: Message) -> None:
        try:
            self._queue.put_nowait((name, message))
        except queue.Full:
            self._lost += 1
        self._news.set()

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ending.is_set():
            self._news.wait()
            self._news.clear()
            if not self._write_all():
                self._ending.wait(RETRY_S)
                self._news.set()
        self._write_all()
        unsaved = len(self._waiting) + self._queue.qsize() + self._lost
        if unsaved:
            self._say(f"{unsaved} messages could not be put into the outbox")
        self._let_go()

    def _write_all(self) -> bool:
        while self._waiting or not self._queue.empty():
            if not self._write():
                return False
        return True

    def _write(self) -> bool:
        """Put the waiting messages into the outbox; reports when this begins to fail."""
        while len(self._waiting) < MOST_AT_ONCE and not self._queue.empty():
            self._waiting.append(self._queue.get())
        try:
            self._outbox = self._outbox or self._open_outbox()
            self._outbox.put(self._waiting)
        except Exception as error:  # later messages must still go out, whatever the error
            self._let_go()
            if not self._failed:
                cause = in_words(error)
                self._say(f"changes of alarms wait in memory, not in the outbox: {cause}")
            self._failed = True
            return False
        if self._failed:
            self._say("changes of alarms are in the outbox again")
        self._failed, self._waiting = False, []
        for sender in self._senders:
            sender.wake()
        return True

    def _let_go(self) -> None:
        if self._outbox is not None:
            self._outbox.close()
        self._outbox = None
