"""Delivers the outbox's messages to one destination, in a thread of its own."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from twin.backoff import Backoff
from twin.errors import SourceError, in_words
from twin.instants import DAY_NS
from twin.notifications.message import Message, again
from twin.notifications.outbox import Outbox
from twin.notifications.settings import Outlet

BATCH = 20  # messages in flight at once: what MQTT brokers accept
FIRST_PAUSE_S = 1.0  # after a failure; each further pause is twice as long
LONGEST_PAUSE_S = 60.0
BOUND_NS = 10 * 1_000_000_000  # interval at which the bounds on waiting messages are checked
LOOK_S = 30.0  # interval at which the outbox is read without a wake-up
GRACE_S = 3.0  # for deliveries when the program ends
ALARM = "alarm"  # the topic of alarms
HOUR_NS = 3600 * 1_000_000_000


class LostError(SourceError):
    """The destination cannot be reached or does not answer; it may come back."""


@dataclass
class Sent:
    """The outcome of sending; a message in neither collection must be sent again."""

    delivered: list[Message] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)  # reason by ID; final
    lost: LostError | None = None


@dataclass(frozen=True)
class Lane:
    """Other data for a destination; it is sent after alarms, in an order of its own."""

    topic: str
    what: str  # in words
    hours: float  # longest wait
    most: int = 1_000_000  # waiting messages


class Channel(Protocol):
    """A connection to a destination; only one thread uses it."""

    def open(self) -> bool:
        """Connect if needed; True if the other side has lost its state. LostError if that fails."""

    def send(self, messages: Sequence[Message], topic: str = ALARM) -> Sent:
        """Deliver messages in this order, and wait until they are taken."""

    def idle(self, wake: threading.Event) -> None:
        """Keep the connection for a moment, or until ``wake``; LostError if it is lost."""

    def hang_up(self) -> None:
        """Drop a connection that failed."""

    def close(self) -> None:
        """Close the connection in order; it is the last call."""


def box_of(destination: str, topic: str) -> str:
    """The name under which a lane's messages wait in the outbox."""
    return f"{destination} {topic}"


class Sender:
    """Delivers the messages of a unit to one destination, each at least once and in order.

    ``lanes`` describe the other data for this destination. A failure is reported once, and its end
    too.
    """

    def __init__(
        self,
        name: str,
        channel: Channel,
        open_outbox: Callable[[], Outbox],
        limits: Outlet,
        say: Callable[[str], None],
        clock: Callable[[], int] = time.time_ns,
        lanes: Sequence[Lane] = (),
    ) -> None:
        self.name = name
        self._lanes = {box_of(name, lane.topic): lane for lane in lanes}
        self._bounded_ns = 0
        self._unreported: Counter[str] = Counter()  # by lane: messages given up, not yet reported
        self._channel, self._open_outbox = channel, open_outbox
        self._limits, self._say, self._clock = limits, say, clock
        self._outbox: Outbox | None = None
        self._newest: dict[str, Message] = {}  # by alarm: the newest that was delivered
        self._to_restate = False
        self._complaint = ""
        self._refusal = ""
        self._backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._wake, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"to {name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def wake(self) -> None:
        """Signal that the outbox has new messages."""
        self._wake.set()

    def end(self) -> None:
        """Deliver what is possible at once, then stop."""
        self._ending.set()
        self._wake.set()

    def join(self, patience_s: float | None = None) -> bool:
        """Wait until the thread has stopped; returns whether it has."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ending.is_set():
            self._go_on_or_wait()
        self._finish()
        self._disconnect()

    def _go_on_or_wait(self) -> None:
        try:
            if not self._go_on():
                self._rest()
        except Exception as error:  # later messages must still be delivered, whatever the error
            self._fail(error)

    def _go_on(self) -> bool:
        """Deliver the next messages; False if there are none."""
        self._wake.clear()
        self._outbox = self._outbox or self._open_outbox()
        self._bound(self._outbox)
        self._to_restate |= self._channel.open()
        self._give_up(self._outbox)
        is_more = self._deliver_next(self._outbox)
        self._succeed()
        return is_more

    def _deliver_next(self, outbox: Outbox) -> bool:
        """Deliver alarms first, then other data; False if there is nothing."""
        if messages := outbox.next(self.name, BATCH):
            self._deliver(outbox, messages)
            return True
        if self._to_restate:
            self._restate()
        for box, lane in self._lanes.items():
            if messages := outbox.next(box, BATCH):
                self._settle(outbox, box, lane.what, self._channel.send(messages, lane.topic))
                return True
        return False

    def _rest(self) -> None:
        """Keep the connection until there is something to do."""
        end = time.monotonic() + LOOK_S
        while not (self._wake.is_set() or self._ending.is_set()) and time.monotonic() < end:
            self._channel.idle(self._wake)

    def _deliver(self, outbox: Outbox, messages: Sequence[Message]) -> None:
        sent = self._channel.send(messages)
        self._newest |= {message.alarm: message for message in sent.delivered}
        self._settle(outbox, self.name, "alarms", sent)

    def _settle(self, outbox: Outbox, box: str, content: str, sent: Sent) -> None:
        """Record the outcome of sending; LostError if the connection is lost."""
        outbox.delivered(box, [message.id for message in sent.delivered])
        for number, reason in sent.refused.items():
            outbox.refuse(box, number, reason)
            if reason != self._refusal:
                self._say(f"{self.name} refuses {content}, which are set aside: {reason}")
            self._refusal = reason
        if sent.lost is not None:
            raise sent.lost

    def _restate(self) -> None:
        """Send every alarm's last state again, for a destination that has lost its own."""
        messages = [again(message, self._clock()) for message in self._newest.values()]
        for begin in range(0, len(messages), BATCH):
            sent = self._channel.send(messages[begin : begin + BATCH])
            if sent.lost is not None:
                raise sent.lost
        self._to_restate = False

    def _give_up(self, outbox: Outbox) -> None:
        """Delete alarms that wait beyond the bounds, and report it; their newest state is sent."""
        since_ns = self._clock() - round(self._limits.longest_days * DAY_NS)
        lost = outbox.give_up(self.name, self._limits.most_waiting, since_ns)
        if lost:
            self._newest |= {message.alarm: message for message in lost}
            self._to_restate = True
            self._say(
                f"{len(lost)} changes of alarms were never delivered to {self.name} and are given"
                f" up: more than {self._limits.most_waiting} waited, or longer than"
                f" {self._limits.longest_days:g} days"
            )

    def _bound(self, outbox: Outbox) -> None:
        """Keep waiting other data within its bounds, also while the destination is away."""
        now = self._clock()
        if abs(now - self._bounded_ns) < BOUND_NS:
            return
        self._bounded_ns = now
        for box, lane in self._lanes.items():
            count = outbox.forget(box, lane.most, now - round(lane.hours * HOUR_NS))
            if count and not self._unreported[box]:
                self._say(
                    f"{lane.what} wait for {self.name} for longer than {lane.hours:g} hours:"
                    " the oldest are given up"
                )
            self._unreported[box] += count

    def _report_given_up(self) -> None:
        for box, lane in self._lanes.items():
            if count := self._unreported.pop(box, 0):
                self._say(
                    f"{count} messages with {lane.what} were never delivered to {self.name}"
                    " and are given up"
                )

    # --- failure and recovery -------------------------------------------------------------------

    def _fail(self, error: Exception) -> None:
        """Report a new failure, and wait; each pause is longer than the last."""
        self._disconnect()
        if not self._complaint:
            self._say(f"alarms wait in the outbox: {self.name}: {in_words(error)}")
        self._complaint = in_words(error)
        self._ending.wait(self._backoff.next_s())

    def _succeed(self) -> None:
        if self._complaint:
            self._say(f"alarms go to {self.name} again")
        self._report_given_up()
        self._complaint = ""
        self._backoff.reset()

    def _disconnect(self) -> None:
        self._channel.hang_up()
        if self._outbox is not None:
            self._outbox.close()
        self._outbox = None

    def _finish(self) -> None:
        """Deliver what is left, until a failure or the end of the grace time."""
        end = time.monotonic() + GRACE_S
        try:
            while self._go_on() and time.monotonic() < end:
                continue
            self._channel.close()
        except Exception as error:
            self._complaint = in_words(error)
        cause = f": {self._complaint}" if self._complaint else ""
        try:
            self._outbox = self._outbox or self._open_outbox()
            self._report_given_up()
            if waiting := sum(self._outbox.count(box) for box in (self.name, *self._lanes)):
                self._say(f"{waiting} messages to {self.name} wait for the next run{cause}")
        except Exception as error:
            self._say(f"what waits for {self.name} is not known: {in_words(error)}")
