"""Staleness by one clock: the time that the twin has listened without a fresh row.

The clock is monotonic, whatever happens to the wall clock. It stops while the twin is busy with
something else. The limit is ``[monitor] stale_ms``. Rows carry the decision (``Quality.OURS``), so
that a replay decides the same.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from twin.events import Event, Kind
from twin.quality import Quality, mark
from twin.signals import NS, LastRow, Samples

if TYPE_CHECKING:  # it loads the compiler, and a PLC is waited for without
    from twin.monitor.monitor import Monitor

LONGEST_WAIT_NS = 500_000_000  # drivers give a block at least this often: else the host slept
ONCE_NS = 60_000_000_000  # a twin that is late again within this time does not report it again
MOST_NOTICES = 100  # notices that may wait for the loop
NO_DATA: Mapping[str, Any] = MappingProxyType({})


@dataclass
class Notices:
    """Notices of threads beside the loop, which the loop takes with the PLC's time."""

    _pending: deque[tuple[Kind, str, Mapping[str, Any]]] = field(
        default_factory=lambda: deque(maxlen=MOST_NOTICES)
    )

    def tell(self, kind: Kind, text: str, data: Mapping[str, Any] = NO_DATA) -> None:
        """Add a notice; any thread may call this, and it does not block."""
        self._pending.append((kind, text, data))

    def taken(self, time_ns: int) -> list[Event]:
        """Notices since the last call, as events at ``time_ns``."""
        notices = [self._pending.popleft() for _ in range(len(self._pending))]
        return [Event(time_ns, kind, text, dict(data)) for kind, text, data in notices]


@dataclass
class Listening:
    """Times the blocks of a live source; a replay needs none of it."""

    clock: Callable[[], int] = time.perf_counter_ns  # monotonic
    notices: Notices = field(default_factory=Notices)
    answer: LastRow = field(default_factory=LastRow)  # before the loop; given if none comes to it
    # While the run loads its model the twin may be late: that is no sign of a busy machine.
    is_starting: Callable[[], bool] = lambda: False
    _last: LastRow = field(default_factory=LastRow)  # that is not stale
    _heard_ns: int = 0  # its time of receipt, by ``clock``
    _listened_ns: int = 0  # since then
    _late_ns: int | None = field(default=None)  # last time at which the twin was late, by ``clock``

    def over(
        self, source: Iterable[Samples], monitor: "Monitor"
    ) -> Iterator[tuple[Samples, list[Event]]]:
        """The blocks, each with the events of its delay, at the PLC's time before it."""
        blocks = iter(source)
        asked_ns = self.clock()
        while (block := next(blocks, None)) is not None:
            now_ns = self.clock()
            self._listened_ns += min(now_ns - asked_ns, LONGEST_WAIT_NS)
            last = self._last.row
            notices = self.notices.taken(int(last["time_ns"][0])) if len(last) else []
            rows, events = self._judge(block, monitor, now_ns)
            yield rows, notices + events
            asked_ns = self.clock()

    def _judge(
        self, block: Samples, monitor: "Monitor", now_ns: int
    ) -> tuple[Samples, list[Event]]:
        fresh = np.flatnonzero((block["quality"] & Quality.STALE) == 0)
        last = self._last.row
        if not len(block) and not len(last) and self._listened_ns > monitor.stale_ns:
            last = block = self.answer.row
            self._last.keep(last)
        if not len(fresh):
            return block, monitor.silent(last[0], self._listened_ns) if len(last) else []
        events: list[Event] = []
        if len(last) and len(self.answer.row) and last == self.answer.row:  # from another stream
            block = block.copy()
            is_later = block["time_ns"][0] > last["time_ns"][0]
            mark(block["quality"], [0], Quality.GAP if is_later else Quality.CLOCK)
        if len(last) and not monitor.is_stale(last[0]):
            first = fresh[:1]
            if (block["host_ns"][first] - last["host_ns"] > monitor.stale_ns).any():
                block = block.copy()
                mark(block["quality"], first, Quality.OURS)
            events = self._late(int(last["time_ns"][0]), now_ns, monitor.stale_ns)
        self._last.keep(block[fresh[-1:]])
        self._heard_ns, self._listened_ns = now_ns, 0
        return block, events

    def _late(self, time_ns: int, now_ns: int, stale_ns: int) -> list[Event]:
        """TWIN_LATE if the twin was late, unless reported a short time ago."""
        late_ns = now_ns - self._heard_ns
        if late_ns <= stale_ns or self.is_starting():
            return []
        before, self._late_ns = self._late_ns, now_ns
        if before is not None and now_ns - before < ONCE_NS:
            return []
        seconds = late_ns * NS
        text = (
            f"the twin was late: it took no samples for {seconds:.1f} s; the PLC is not stale. "
            "Is this machine too busy?"
        )
        return [Event(time_ns, Kind.TWIN_LATE, text, {"seconds": seconds})]
