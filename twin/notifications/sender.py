"""Delivers what waits in the outbox for one destination, in a thread of its own."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from twin.backoff import Backoff
from twin.errors import SourceError, in_words
from twin.notifications.message import Message, again
from twin.notifications.outbox import Outbox
from twin.notifications.settings import Outlet

BATCH = 20  # messages on their way at once: what MQTT brokers take
FIRST_PAUSE_S = 1.0  # after a failure; the next ones are twice as long each
LONGEST_PAUSE_S = 60.0
BOUND_NS = 10 * 1_000_000_000  # between looks whether more waits than is to
LOOK_S = 30.0  # into the outbox, where nobody has said that there is something
GRACE_S = 3.0  # to deliver what is left when the program ends
ALARM = "alarm"  # the topic of alarms
HOUR_NS = 3600 * 1_000_000_000
DAY_NS = 86_400 * 1_000_000_000


class LostError(SourceError):
    """The destination cannot be reached now, or does not answer; it may come back."""


@dataclass
class Sent:
    """What has become of messages; what is in neither is to be sent again."""

    delivered: list[Message] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)  # by ID, why; for good
    lost: LostError | None = None


@dataclass(frozen=True)
class Lane:
    """What goes to a destination beside alarms: after them, in an order of its own."""

    topic: str
    what: str  # in words
    hours: float  # for which it waits
    most: int = 1_000_000  # messages that wait


class Channel(Protocol):
    """A way to a destination; one thread alone uses it."""

    def open(self) -> bool:
        """Be connected. True if the other side has forgotten what it was told; LostError if not."""

    def send(self, messages: Sequence[Message], topic: str = ALARM) -> Sent:
        """Deliver in this order, waiting until they are taken."""

    def idle(self, wake: threading.Event) -> None:
        """Keep the connection for a moment, or until ``wake``; LostError if it is lost."""

    def hang_up(self) -> None:
        """Let go of a connection that failed."""

    def close(self) -> None:
        """Say good-bye; nothing comes after it."""


def box_of(destination: str, topic: str) -> str:
    """Under what name a lane's messages wait in the outbox."""
    return f"{destination} {topic}"


class Sender:
    """Delivers the messages of a unit to one destination, each at least once and in order.

    ``lanes`` are what goes there beside alarms. What goes wrong is said once, until it goes well
    again.
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
        self._lanes = {box_of(name, one.topic): one for one in lanes}
        self._bounded_ns = 0
        self._gone: Counter[str] = Counter()  # by lane: what was given up and is not yet said
        self._channel, self._open_outbox = channel, open_outbox
        self._limits, self._say, self._clock = limits, say, clock
        self._outbox: Outbox | None = None
        self._told: dict[str, Message] = {}  # by alarm: the newest that was delivered
        self._to_restate = False
        self._complaint = ""
        self._refusal = ""
        self._backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._wake, self._ending = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"to {name}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def wake(self) -> None:
        """There is something in the outbox."""
        self._wake.set()

    def end(self) -> None:
        """Deliver what can be delivered at once, then stop."""
        self._ending.set()
        self._wake.set()

    def join(self, patience_s: float | None = None) -> bool:
        """Wait until it has stopped; whether it has."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    # --- the thread -----------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._ending.is_set():
            self._go_on_or_wait()
        self._finish()
        self._let_go()

    def _go_on_or_wait(self) -> None:
        try:
            if not self._go_on():
                self._rest()
        except Exception as error:  # whatever it is, later ones are to be delivered
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
        """Alarms first, then what is beside them; False if there is nothing."""
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
        self._told |= {one.alarm: one for one in sent.delivered}
        self._settle(outbox, self.name, "alarms", sent)

    def _settle(self, outbox: Outbox, box: str, what: str, sent: Sent) -> None:
        """Note what has become of messages; LostError if the connection is lost."""
        outbox.delivered(box, [one.id for one in sent.delivered])
        for number, why in sent.refused.items():
            outbox.refuse(box, number, why)
            if why != self._refusal:
                self._say(f"{self.name} refuses {what}, which are set aside: {why}")
            self._refusal = why
        if sent.lost is not None:
            raise sent.lost

    def _restate(self) -> None:
        """Tell every alarm as it was told last, so that whoever has lost everything is right."""
        messages = [again(one, self._clock()) for one in self._told.values()]
        for begin in range(0, len(messages), BATCH):
            sent = self._channel.send(messages[begin : begin + BATCH])
            if sent.lost is not None:
                raise sent.lost
        self._to_restate = False

    def _give_up(self, outbox: Outbox) -> None:
        """Let go of what waits beyond the bounds, and say so; the newest state is still told."""
        since_ns = self._clock() - round(self._limits.longest_days * DAY_NS)
        lost = outbox.give_up(self.name, self._limits.most_waiting, since_ns)
        if lost:
            self._told |= {one.alarm: one for one in lost}
            self._to_restate = True
            self._say(
                f"{len(lost)} changes of alarms were never delivered to {self.name} and are given"
                f" up: more than {self._limits.most_waiting} waited, or longer than"
                f" {self._limits.longest_days:g} days"
            )

    def _bound(self, outbox: Outbox) -> None:
        """Hold what waits beside alarms within its bounds, also while nobody takes it."""
        now = self._clock()
        if abs(now - self._bounded_ns) < BOUND_NS:
            return
        self._bounded_ns = now
        for box, lane in self._lanes.items():
            gone = outbox.forget(box, lane.most, now - round(lane.hours * HOUR_NS))
            if gone and not self._gone[box]:
                self._say(
                    f"{lane.what} wait for {self.name} for longer than {lane.hours:g} hours:"
                    " the oldest are given up"
                )
            self._gone[box] += gone

    def _say_gone(self) -> None:
        for box, lane in self._lanes.items():
            if gone := self._gone.pop(box, 0):
                self._say(
                    f"{gone} messages with {lane.what} were never delivered to {self.name}"
                    " and are given up"
                )

    # --- when it goes wrong, and well again -----------------------------------------------------

    def _fail(self, error: Exception) -> None:
        """Say so if that is new, and wait; longer each time."""
        self._let_go()
        if not self._complaint:
            self._say(f"alarms wait in the outbox: {self.name}: {in_words(error)}")
        self._complaint = in_words(error)
        self._ending.wait(self._backoff.next_s())

    def _succeed(self) -> None:
        if self._complaint:
            self._say(f"alarms go to {self.name} again")
        self._say_gone()
        self._complaint = ""
        self._backoff.reset()

    def _let_go(self) -> None:
        self._channel.hang_up()
        if self._outbox is not None:
            self._outbox.close()
        self._outbox = None

    def _finish(self) -> None:
        """Deliver what is left while that goes well and is soon done."""
        end = time.monotonic() + GRACE_S
        try:
            while self._go_on() and time.monotonic() < end:
                continue
            self._channel.close()
        except Exception as error:
            self._complaint = in_words(error)
        with_why = f": {self._complaint}" if self._complaint else ""
        try:
            self._outbox = self._outbox or self._open_outbox()
            self._say_gone()
            if left := sum(self._outbox.count(box) for box in (self.name, *self._lanes)):
                self._say(f"{left} messages to {self.name} wait for the next run{with_why}")
        except Exception as error:
            self._say(f"what waits for {self.name} is not known: {in_words(error)}")
