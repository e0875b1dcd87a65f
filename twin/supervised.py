"""Supervises the outputs of a run: a failed one is set aside and retried; the loop goes on.

A full disk, a reader that has gone or a programming error in one output must not end monitoring.
Loss and recovery of an output are each reported once, as events of the run.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from twin.backoff import Backoff
from twin.errors import SourceError, in_words
from twin.events import Event, Kind
from twin.live import EventEnricher, Sink
from twin.monitor.staleness import Notices
from twin.quality import Quality, mark
from twin.signals import TICK, Samples, Ticks

KEPT_ROWS = 60_000  # rows that wait for an output: one minute at 1 kHz, about 5 MB
KEPT_EVENTS = 10_000  # events of lost rows
KEPT_BLOCKS = 10_000  # blocks of an output that takes no rows, or while none arrive
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # before an output is tried again
SOUND_S = 60.0  # after working so long, an adviser starts with the first pause again

Block = tuple[Samples, Ticks, Sequence[Event]]


@dataclass
class Outages:
    """The failed outputs of one run."""

    notices: Notices
    _down: dict[str, float] = field(default_factory=dict)  # since when

    def begin(self, name: str, cause: Exception, now_s: float) -> None:
        """Report that an output has failed, unless that was reported."""
        if name in self._down:
            return
        self._down[name] = now_s
        text = f"{name}: {in_words(cause)}; monitoring goes on, and it is tried again"
        self.notices.tell(Kind.OUTPUT_DOWN, text, {"output": name})

    def end(self, name: str, now_s: float, rows: int = 0, events: int = 0) -> None:
        """Report that an output works again, with the numbers of lost rows and events."""
        seconds = now_s - self._down.pop(name)
        missing = f"; {lost(rows, events)}" if rows or events else ""
        text = f"{name}: works again after {seconds:.0f} s{missing}"
        data = {"output": name, "seconds": seconds, "rows_lost": rows, "events_lost": events}
        self.notices.tell(Kind.OUTPUT_BACK, text, data | {"standing": sorted(self._down)})


def lost(rows: int, events: int) -> str:
    """A text about rows and events that are missing in an output."""
    counts = [f"{rows} rows"] * bool(rows or not events) + [f"{events} events"] * bool(events)
    return f"{' and '.join(counts)} are missing in it"


class Backlog:
    """Blocks that wait for an output, in bounded memory; lost rows and events are counted.

    The first row after lost ones gets the mark of a gap.
    """

    def __init__(self) -> None:
        self.blocks: deque[Block] = deque()
        self.rows = 0  # waiting
        self.rows_lost = self.events_lost = 0
        self._gap = False  # rows were lost, and no later row is there to mark yet

    @property
    def events(self) -> int:
        """The number of waiting events."""
        return sum(len(events) for *_, events in self.blocks)

    def keep(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Add a block, unless it is empty; the oldest rows are dropped to make room."""
        if len(samples) or events:
            self.blocks.append((samples.copy(), ticks.copy(), list(events)))
            self.rows += len(samples)
            self._mark()
        while len(self.blocks) > 1 and (self.rows > KEPT_ROWS or len(self.blocks) > KEPT_BLOCKS):
            self._lose_oldest()

    def forget_oldest(self) -> None:
        """Remove the oldest block after its delivery."""
        self.rows -= len(self.blocks.popleft()[0])

    def clear(self) -> None:
        """Remove all blocks and counts after delivery and report."""
        self.blocks.clear()
        self.rows = self.rows_lost = self.events_lost = 0
        self._gap = False

    def _lose_oldest(self) -> None:
        """Drop the oldest block's rows; its events go on waiting."""
        oldest, _, older_events = self.blocks.popleft()
        samples, ticks, events = self.blocks.popleft()
        all_events = [*older_events, *events]
        self.blocks.appendleft((samples, ticks, all_events[-KEPT_EVENTS:]))
        self.rows -= len(oldest)
        self.rows_lost += len(oldest)
        self.events_lost += max(0, len(all_events) - KEPT_EVENTS)
        self._gap |= len(oldest) > 0
        self._mark()

    def _mark(self) -> None:
        first_rows = next((rows for rows, *_ in self.blocks if len(rows)), None)
        if self._gap and first_rows is not None:
            mark(first_rows["quality"], [0], Quality.GAP)
            self._gap = False


class SupervisedSink:
    """A sink (``twin.live.Sink``) whose ``write`` raises nothing.

    After a failure rows and events wait, up to KEPT_ROWS. ``again`` is called for a working sink,
    with pauses that double. A sink with ``held`` keeps the rows with which it raised SourceError,
    so it does not get them again; it is retried once if it fails at its end. Without ``rows`` the
    sink gets only events. ``close`` raises the sink's error at its end.
    """

    def __init__(
        self,
        name: str,
        sink: Sink,
        again: Callable[[], Sink],
        outages: Outages,
        clock: Callable[[], float] = time.monotonic,
        *,
        held: Callable[[], int] | None = None,
        rows: bool = True,
    ) -> None:
        self._name, self._sink, self._again = name, sink, again
        self._outages, self._clock, self._held = outages, clock, held
        self._takes_rows = rows
        self._failure: Exception | None = None
        self._next_s, self._backoff = 0.0, Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._waiting = Backlog()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take rows, their ticks, and events."""
        if self._failure is None:
            try:
                self._sink.write(samples, ticks, events)
            except Exception as error:
                self._set_aside(error)
                if not self._is_held(error):
                    self._keep(samples, ticks, events)
            return
        self._keep(samples, ticks, events)
        if self._clock() >= self._next_s:
            self._try_again()

    def close(self) -> None:
        """Finish; SourceError if rows or events are missing in the output."""
        if self._failure is None and self._held is not None:
            try:
                self._sink.close()
            except Exception as error:
                self._set_aside(error)
        if self._failure is not None:
            self._try_again()
        if self._failure is not None:
            waiting = self._waiting
            rows = waiting.rows + waiting.rows_lost + (self._held() if self._held else 0)
            events = waiting.events + waiting.events_lost
            raise SourceError(
                f"{self._name}: {in_words(self._failure)}; {lost(rows, events)}",
                getattr(self._failure, "hint", ""),
            ) from self._failure
        self._sink.close()

    def _is_held(self, error: Exception) -> bool:
        """Whether the failed sink holds the rows itself, and writes them when retried."""
        return self._held is not None and isinstance(error, SourceError)

    def _keep(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        if not self._takes_rows:
            samples, ticks = samples[:0], ticks[:0]
        self._waiting.keep(samples, ticks, events)

    def _try_again(self) -> None:
        waiting = self._waiting
        try:
            self._sink = self._again()
            while waiting.blocks:
                self._hand_over(waiting.blocks[0])
        except Exception as error:
            self._set_aside(error)
            return
        self._outages.end(self._name, self._clock(), waiting.rows_lost, waiting.events_lost)
        self._failure = None
        waiting.clear()
        self._backoff.reset()

    def _hand_over(self, block: Block) -> None:
        try:
            self._sink.write(*block)
        except Exception as error:
            if self._is_held(error):
                self._waiting.forget_oldest()
            raise
        self._waiting.forget_oldest()

    def _set_aside(self, error: Exception) -> None:
        now_s = self._clock()
        self._outages.begin(self._name, error, now_s)
        self._failure, self._next_s = error, now_s + self._backoff.next_s()


class SupervisedEnricher:
    """An adviser (``twin.live.EventEnricher``) whose ``follow`` raises nothing.

    After a failure rows and events wait for it, up to KEPT_ROWS. It gets all of them again in
    order, with pauses that double. Once it takes any of them, those that still fail are dropped and
    counted; as long as it takes none, they go on waiting. After SOUND_S of work the pauses start
    anew. ``close`` raises SourceError if it has failed to the end.
    """

    def __init__(
        self,
        name: str,
        adviser: EventEnricher,
        outages: Outages,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._adviser, self._outages = name, adviser, outages
        self._clock = clock
        self._failure: Exception | None = None
        self._next_s, self._backoff = 0.0, Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        self._back_s = 0.0  # when it recovered
        self._waiting = Backlog()

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and events; returns the new events by now."""
        if self._failure is None:
            try:
                return self._adviser.follow(samples, events)
            except Exception as error:
                self._set_aside(error)
        elif self._clock() >= self._next_s:
            return self._try_again((samples, np.empty(0, TICK), events))
        self._waiting.keep(samples, np.empty(0, TICK), events)
        return []

    def finish(self) -> list[Event]:
        """Return the remaining events after the last row."""
        events = self._try_again() if self._failure is not None else []
        if self._failure is None:
            try:
                events += self._adviser.finish()
            except Exception as error:
                self._set_aside(error)
        return events

    def close(self) -> None:
        """Release all resources; SourceError if the adviser has missed rows or events."""
        self._adviser.close()
        if self._failure is not None:
            waiting = self._waiting
            rows, events = waiting.rows + waiting.rows_lost, waiting.events + waiting.events_lost
            raise SourceError(
                f"{self._name}: {in_words(self._failure)}; {lost(rows, events)}",
                getattr(self._failure, "hint", ""),
            ) from self._failure

    def _try_again(self, *newest: Block) -> list[Event]:
        """Pass all waiting blocks to the adviser; returns its events."""
        waiting = self._waiting
        for block in newest:
            waiting.keep(*block)
        events: list[Event] = []
        blocks = [*waiting.blocks] or [*newest]
        failures = list[tuple[Exception, Block]]()
        for block in blocks:
            try:
                events += self._adviser.follow(block[0], block[2])
            except Exception as error:
                failures.append((error, block))
        if blocks and len(failures) == len(blocks):
            self._set_aside(failures[0][0])
            return []
        lost_rows = waiting.rows_lost + sum(len(block[0]) for _, block in failures)
        lost_events = waiting.events_lost + sum(len(block[2]) for _, block in failures)
        self._outages.end(self._name, self._clock(), lost_rows, lost_events)
        self._failure, self._back_s = None, self._clock()
        waiting.clear()
        return events

    def _set_aside(self, error: Exception) -> None:
        now_s = self._clock()
        if self._failure is None and now_s - self._back_s >= SOUND_S:
            self._backoff.reset()
        self._outages.begin(self._name, error, now_s)
        self._failure, self._next_s = error, now_s + self._backoff.next_s()
