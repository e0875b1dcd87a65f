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
from twin.live import Adviser, Sink
from twin.monitor.listening import Notices
from twin.signals import Quality, Samples, Ticks

KEPT_ROWS = 60_000  # that wait for an output: a minute of them each millisecond, some 5 MB
KEPT_EVENTS = 10_000  # of rows that were lost
KEPT_BLOCKS = 10_000  # of an output that takes no rows, or while none come
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # before an output is tried again


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
        self._waiting: deque[tuple[Samples, Ticks, Sequence[Event]]] = deque()
        self._rows = self._lost = 0  # that wait, and that did not
        self._events_lost = 0

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
            rows = self._rows + self._lost + (self._held() if self._held else 0)
            events = self._events_lost + sum(len(events) for *_, events in self._waiting)
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
        if len(samples) or events:
            self._waiting.append((samples.copy(), ticks.copy(), list(events)))
            self._rows += len(samples)
        while len(self._waiting) > 1 and (
            self._rows > KEPT_ROWS or len(self._waiting) > KEPT_BLOCKS
        ):
            self._lose_oldest()

    def _lose_oldest(self) -> None:
        """Let its rows go, with a gap marked in the next ones; its events wait on."""
        oldest, _, before = self._waiting.popleft()
        samples, ticks, events = self._waiting.popleft()
        together = [*before, *events]
        self._waiting.appendleft((samples, ticks, together[-KEPT_EVENTS:]))
        self._rows -= len(oldest)
        self._lost += len(oldest)
        self._events_lost += max(0, len(together) - KEPT_EVENTS)
        later = next((rows for rows, *_ in self._waiting if len(rows)), None)
        if len(oldest) and later is not None:
            later["quality"][0] |= np.uint8(Quality.GAP)

    def _try_again(self) -> None:
        try:
            self._sink = self._again()
            while self._waiting:
                self._hand_over(self._waiting[0])
        except Exception as error:
            self._set_aside(error)
            return
        self._outages.end(self._name, self._clock(), self._lost, self._events_lost)
        self._failure, self._lost, self._events_lost = None, 0, 0
        self._backoff.reset()

    def _hand_over(self, block: tuple[Samples, Ticks, Sequence[Event]]) -> None:
        try:
            self._sink.write(*block)
        except Exception as error:
            if self._is_held(error):
                self._forget_oldest()
            raise
        self._forget_oldest()

    def _forget_oldest(self) -> None:
        self._rows -= len(self._waiting.popleft()[0])

    def _set_aside(self, error: Exception) -> None:
        now_s = self._clock()
        self._outages.begin(self._name, error, now_s)
        self._failure, self._next_s = error, now_s + self._backoff.next_s()


class SupervisedAdviser:
    """An adviser (``twin.live.Adviser``) that says nothing to what it fails at."""

    def __init__(
        self,
        name: str,
        adviser: Adviser,
        outages: Outages,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._adviser, self._outages = name, adviser, outages
        self._clock = clock
        self._failed = False

    def follow(self, samples: Samples, events: Sequence[Event]) -> list[Event]:
        """Take rows and what happened; give what has been found out by now."""
        try:
            said = self._adviser.follow(samples, events)
        except Exception as error:
            self._outages.begin(self._name, error, self._clock())
            self._failed = True
            return []
        if self._failed and len(samples):
            self._failed = False
            self._outages.end(self._name, self._clock())
        return said

    def finish(self) -> list[Event]:
        """Give what is still to be said when the rows have ended."""
        return self._adviser.finish()

    def close(self) -> None:
        """Let go of everything."""
        self._adviser.close()
