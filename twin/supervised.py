"""Outputs of a run that may fail: one that does is set aside and tried again; the loop goes on.

A full disk, a reader that has gone or a mistake of ours in one output is no reason to end
monitoring. What happens to an output is told among the events of the run, once.
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
from twin.signals import TICK, Quality, Samples, Ticks

KEPT_ROWS = 60_000  # that wait for an output: a minute of them each millisecond, some 5 MB
KEPT_EVENTS = 10_000  # of rows that were lost
KEPT_BLOCKS = 10_000  # of an output that takes no rows, or while none come
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # before an output is tried again
SOUND_S = 60.0  # an adviser that worked so long begins with the first pause again

Block = tuple[Samples, Ticks, Sequence[Event]]


@dataclass
class Outages:
    """Which outputs of one run are down."""

    notices: Notices
    _down: dict[str, float] = field(default_factory=dict)  # since when

    def begin(self, name: str, why: Exception, now_s: float) -> None:
        """Tell that an output has failed, unless that has been told."""
        if name in self._down:
            return
        self._down[name] = now_s
        text = f"{name}: {in_words(why)}; monitoring goes on, and it is tried again"
        self.notices.tell(Kind.OUTPUT_DOWN, text, {"output": name})

    def end(self, name: str, now_s: float, rows: int = 0, events: int = 0) -> None:
        """Tell that an output works again; so many rows and events did not wait for it."""
        seconds = now_s - self._down.pop(name)
        missing = f"; {lost(rows, events)}" if rows or events else ""
        text = f"{name}: works again after {seconds:.0f} s{missing}"
        data = {"output": name, "seconds": seconds, "rows_lost": rows, "events_lost": events}
        self.notices.tell(Kind.OUTPUT_BACK, text, data | {"standing": sorted(self._down)})


def lost(rows: int, events: int) -> str:
    """What is missing in an output, in words."""
    counts = [f"{rows} rows"] * bool(rows or not events) + [f"{events} events"] * bool(events)
    return f"{' and '.join(counts)} are missing in it"


class Backlog:
    """Blocks that wait for an output: bounded, and what found no room is counted.

    The first rows after some that were lost are marked as after a gap.
    """

    def __init__(self) -> None:
        self.blocks: deque[Block] = deque()
        self.rows = 0  # that wait
        self.rows_lost = self.events_lost = 0
        self._gap = False  # rows were lost, and none are there to mark yet

    @property
    def events(self) -> int:
        """How many wait."""
        return sum(len(events) for *_, events in self.blocks)

    def keep(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Have a block wait, unless it is empty; the oldest rows make room."""
        if len(samples) or events:
            self.blocks.append((samples.copy(), ticks.copy(), list(events)))
            self.rows += len(samples)
            self._mark()
        while len(self.blocks) > 1 and (self.rows > KEPT_ROWS or len(self.blocks) > KEPT_BLOCKS):
            self._lose_oldest()

    def forget_oldest(self) -> None:
        """It has arrived."""
        self.rows -= len(self.blocks.popleft()[0])

    def clear(self) -> None:
        """All of it has arrived, and what did not was told."""
        self.blocks.clear()
        self.rows = self.rows_lost = self.events_lost = 0
        self._gap = False

    def _lose_oldest(self) -> None:
        """Let its rows go; its events wait on."""
        oldest, _, before = self.blocks.popleft()
        samples, ticks, events = self.blocks.popleft()
        together = [*before, *events]
        self.blocks.appendleft((samples, ticks, together[-KEPT_EVENTS:]))
        self.rows -= len(oldest)
        self.rows_lost += len(oldest)
        self.events_lost += max(0, len(together) - KEPT_EVENTS)
        self._gap |= len(oldest) > 0
        self._mark()

    def _mark(self) -> None:
        later = next((rows for rows, *_ in self.blocks if len(rows)), None)
        if self._gap and later is not None:
            later["quality"][0] |= np.uint8(Quality.GAP)
            self._gap = False


class SupervisedSink:
    """A sink (``twin.live.Sink``) that raises nothing while it is written to.

    After a failure rows and events wait, up to KEPT_ROWS, and ``again`` is asked for a sink that
    works, with a pause that doubles. A sink that says how many rows it has ``held`` is not given
    those again with which it raised SourceError, and is tried once more where it fails at its end.
    One without ``rows`` is of events alone. ``close`` raises what a sink says at its end.
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
        """Take rows, their ticks, and what happened."""
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
        """Finish; SourceError where something is missing in it."""
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
        """Whether a sink that failed has the rows, to write them when it is tried again."""
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
    """An adviser (``twin.live.EventEnricher``) that raises nothing while rows come.

    After a failure rows and events wait for it, up to KEPT_ROWS. With a pause that doubles it is
    given all of them again, in order. Once it takes any of them, those that it still fails at are
    left out and counted; as long as it takes none, they wait on. The pause begins anew after it
    has worked for SOUND_S. ``close`` raises SourceError where it has failed to the end.
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
        self._back_s = 0.0  # when it worked again
        self._waiting = Backlog()

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and what happened; give what has been found out by now."""
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
        """Give what is still to be said when the rows have ended."""
        said = self._try_again() if self._failure is not None else []
        if self._failure is None:
            try:
                said += self._adviser.finish()
            except Exception as error:
                self._set_aside(error)
        return said

    def close(self) -> None:
        """Let go of everything; SourceError where it has not heard all that happened."""
        self._adviser.close()
        if self._failure is not None:
            waiting = self._waiting
            rows, events = waiting.rows + waiting.rows_lost, waiting.events + waiting.events_lost
            raise SourceError(
                f"{self._name}: {in_words(self._failure)}; {lost(rows, events)}",
                getattr(self._failure, "hint", ""),
            ) from self._failure

    def _try_again(self, *newest: Block) -> list[Event]:
        """Give it all that waits; what it says."""
        waiting = self._waiting
        for block in newest:
            waiting.keep(*block)
        said: list[Event] = []
        blocks = [*waiting.blocks] or [*newest]
        failures = list[tuple[Exception, Block]]()
        for block in blocks:
            try:
                said += self._adviser.follow(block[0], block[2])
            except Exception as error:
                failures.append((error, block))
        if blocks and len(failures) == len(blocks):
            self._set_aside(failures[0][0])
            return []
        rows = waiting.rows_lost + sum(len(block[0]) for _, block in failures)
        events = waiting.events_lost + sum(len(block[2]) for _, block in failures)
        self._outages.end(self._name, self._clock(), rows, events)
        self._failure, self._back_s = None, self._clock()
        waiting.clear()
        return said

    def _set_aside(self, error: Exception) -> None:
        now_s = self._clock()
        if self._failure is None and now_s - self._back_s >= SOUND_S:
            self._backoff.reset()
        self._outages.begin(self._name, error, now_s)
        self._failure, self._next_s = error, now_s + self._backoff.next_s()
