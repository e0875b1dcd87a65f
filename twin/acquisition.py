"""The rows of a live source; they may be read ahead, while the model is still compiled."""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from twin.signals import Samples

MOST_ROWS = 600_000  # that wait: ten minutes of one each millisecond, 31 MB


class Acquisition:
    """Reads a source ``ahead``, in a thread, until the loop has caught up with it.

    Then the loop reads the source itself, as it does from the beginning without ``ahead``.
    ``clock`` is what the loop has to time blocks by (``twin.monitor.staleness.Listening``), in ns:
    for blocks that waited it gives when they came.
    """

    def __init__(
        self,
        source: Iterator[Samples],
        now_ns: Callable[[], int] = time.perf_counter_ns,
        *,
        ahead: bool,
    ) -> None:
        self._source, self._now_ns = source, now_ns
        self._waiting: deque[tuple[int, Samples]] = deque()  # with when they came
        self._rows = 0  # that wait; an empty block counts as one
        self._came_ns = now_ns() if ahead else None  # the block that the loop has, if it waited
        self._error: Exception | None = None
        self._lock = threading.Lock()  # for what waits
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="acquisition") if ahead else None
        if self._thread is not None:
            self._thread.start()

    def clock(self) -> int:
        """When the block came that the loop has (ns); now, once it reads the source itself."""
        return self._now_ns() if self._came_ns is None else self._came_ns

    def is_waiting(self) -> bool:
        """Whether the block that the loop has waited for the loop."""
        return self._came_ns is not None

    def blocks(self) -> Iterator[Samples]:
        """All blocks in their order; raises what the source raised, after what came before.

        A source that gives rows faster than the loop takes them is read ahead no longer.
        """
        behind = self._rows
        while behind:
            yield from self.waiting(len(self._waiting))
            behind, before = self._rows, behind
            if behind >= before:
                break
        self.close()
        yield from self.waiting()  # what came until the thread had ended
        if self._error is not None:
            raise self._error
        self._came_ns = None
        yield from self._source

    def waiting(self, most: int = sys.maxsize) -> Iterator[Samples]:
        """The blocks that wait, the oldest first, until none does or ``most`` came."""
        for _ in range(most):
            oldest = self._take_oldest(0)
            if oldest is None:
                return
            self._came_ns, block = oldest
            yield block

    def surplus(self) -> Iterator[Samples]:
        """The oldest blocks beyond MOST_ROWS; they no longer wait."""
        while (oldest := self._take_oldest(MOST_ROWS)) is not None:
            yield oldest[1]

    def close(self) -> None:
        """End the thread; what waits stays. This takes as long as a block of the source."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _read(self) -> None:
        try:
            while not self._stop.is_set() and (block := next(self._source, None)) is not None:
                with self._lock:
                    self._waiting.append((self._now_ns(), block))
                    self._rows += len(block) or 1
        except Exception as error:  # the loop gets it, after the blocks before it
            self._error = error

    def _take_oldest(self, most_rows: int) -> tuple[int, Samples] | None:
        """The oldest block and when it came (ns), if more than ``most_rows`` wait."""
        with self._lock:
            if self._rows <= most_rows:
                return None
            came_ns, block = self._waiting.popleft()
            self._rows -= len(block) or 1
            return came_ns, block
