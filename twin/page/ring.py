"""Live rows in a small file, from the loop to the page: one writer, many readers, without waiting.

The file is a ring of ``ROW``. A row contains its number twice: the second one is written before its
values, the first one after them. So a reader in between sees two different numbers and skips the
row. A row covers ``ROW_NS`` of PLC time with its lowest and highest values, so no peak is hidden.
"""

import mmap
import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from twin.errors import SourceError, in_words
from twin.events import Event
from twin.quality import UNUSABLE
from twin.signals import SAMPLE, TICK, Samples, Ticks

ROW = np.dtype(
    [
        ("number", "<i8"),
        ("time_ns", "<i8"),  # PLC time of its last sample
        ("host_ns", "<i8"),  # host time of receiving that sample
        ("measured_low", "<f4"),  # Pa, absolute; NaN without a usable sample
        ("measured_high", "<f4"),
        ("expected_low", "<f4"),
        ("expected_high", "<f4"),
        ("phase", "u1"),  # of its last sample
        ("commands", "u1"),  # bits of all its samples
        ("quality", "u1"),  # bits of all its samples
        ("spare", "u1", (5,)),
        ("again", "<i8"),  # its number
    ]
)
HEAD = np.dtype(
    [
        ("magic", "S16"),
        ("ambient", "<f8"),  # Pa
        ("written", "<i8"),  # rows written so far, over all runs
        ("begun_ns", "<i8"),  # when the run began, host time
        ("alive_ns", "<i8"),  # last sign of life of its loop
        ("ended_ns", "<i8"),  # when it ended in good order; 0 before
    ]
)
MAGIC = b"ejector-twin/1"
ROW_NS = 25_000_000
DEPTH = 2400  # rows: a minute
FILE = np.dtype([("head", HEAD), ("rows", ROW, (DEPTH,))])
MOST_WAITING = 400  # blocks: 12 s at 30 ms
MOST_HELD = 1000  # samples after which a row ends in any case: its time at 40 kHz
STALE_S = 5.0  # a driver yields a block at least every half a second

_VALUES = [name for name in ROW.fields or () if name not in ("number", "again", "spare")]
Rows = npt.NDArray[np.void]  # of ROW


# --- the run ------------------------------------------------------------------------------------


class LiveRows:
    """A sink that writes live rows for the page, in a thread of its own.

    If that thread does not keep up, rows are dropped, with one message. SourceError if the file
    cannot be written, or another run writes to it.
    """

    def __init__(
        self,
        path: Path,
        ambient: float,
        say: Callable[[str], None],
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._file = _Writer(path, ambient, clock)
        self._say = say
        self._behind = False
        self._blocks: queue.Queue[tuple[Samples, Ticks] | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="live rows", daemon=True)
        self._thread.start()

    def write(self, samples: Samples, ticks: Ticks, _events: Sequence[Event]) -> None:
        """Take row-aligned blocks; an empty one is a sign of life of the loop."""
        try:
            self._blocks.put_nowait((samples.copy(), ticks.copy()))
        except queue.Full:
            self._fail("cannot be written quickly enough")

    def close(self) -> None:
        """Write the waiting rows and the end of the run."""
        self._blocks.put(None)
        self._thread.join()
        self._file.close()

    def _fail(self, cause: str) -> None:
        """Report once that rows are missing."""
        if not self._behind:
            self._say(f"the page's live rows: some are missing: {cause}")
        self._behind = True

    def _work(self) -> None:
        empty: tuple[Samples, Ticks] = np.empty(0, SAMPLE), np.empty(0, TICK)
        pending = empty
        while (block := self._blocks.get()) is not None:
            try:
                pending = (
                    np.concatenate([pending[0], block[0]]),
                    np.concatenate([pending[1], block[1]]),
                )
                rows, pending = _bin_rows(*pending)
                self._file.add(rows)
            except Exception as error:  # later rows must still be shown, whatever the error
                pending = empty
                self._fail(in_words(error))


def _bin_rows(samples: Samples, ticks: Ticks) -> tuple[Rows, tuple[Samples, Ticks]]:
    """A row for each completed period of ROW_NS, and the samples of the period under way.

    If PLC time stands still, a row ends after MOST_HELD samples.
    """
    period = samples["time_ns"] // ROW_NS
    cuts = np.flatnonzero(np.diff(period)) + 1
    if len(samples) - (cuts[-1] if len(cuts) else 0) >= MOST_HELD:
        cuts = np.append(cuts, len(samples))
    if not len(cuts):
        return np.empty(0, ROW), (samples, ticks)
    end, starts = cuts[-1], np.concatenate([[0], cuts[:-1]])
    complete, last = samples[:end], cuts - 1
    usable = (complete["quality"] & UNUSABLE) == 0
    measured = np.where(usable, complete["pressure"], np.float32(np.nan))
    rows = np.zeros(len(cuts), ROW)
    for name in ("time_ns", "host_ns"):
        rows[name] = samples[name][last]
    for side, values in (("measured", measured), ("expected", ticks["expected"][:end])):
        rows[f"{side}_low"] = np.fmin.reduceat(values, starts)
        rows[f"{side}_high"] = np.fmax.reduceat(values, starts)
    for name in ("commands", "quality"):
        rows[name] = np.bitwise_or.reduceat(complete[name], starts)
    rows["phase"] = ticks["phase"][last]
    return rows, (samples[end:], ticks[end:])


class _Writer:
    """The mapped file; its row numbers continue from run to run."""

    def __init__(self, path: Path, ambient: float, clock: Callable[[], int]) -> None:
        self._clock = clock
        try:
            self._open(path)
        except OSError as error:
            hint = "check the folder that [page] names; one run at a time writes for an ejector"
            raise SourceError(f"{path}: cannot be written: {error.strerror}", hint) from error
        head = self._record["head"]
        if head["magic"] != MAGIC or not 0 <= head["written"] < 2**62:
            self._record[...] = np.zeros((), FILE)
        now = clock()
        head["ambient"], head["begun_ns"], head["alive_ns"] = ambient, now, now
        head["ended_ns"], head["magic"] = 0, MAGIC

    def _open(self, path: Path) -> None:
        try:
            import fcntl  # noqa: PLC0415 - other systems have none, and read without it
        except ImportError as error:
            hint = "leave out keep in [page]; everything else runs without it"
            raise SourceError(f"{path}: live rows are written on Linux only", hint) from error
        path.parent.mkdir(parents=True, exist_ok=True)
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(self._handle).st_size != FILE.itemsize:
                os.posix_fallocate(self._handle, 0, FILE.itemsize)
                os.ftruncate(self._handle, FILE.itemsize)
            memory = mmap.mmap(self._handle, FILE.itemsize)
        except BaseException:
            os.close(self._handle)
            raise
        self._record = np.frombuffer(memory, FILE)[0:1].reshape(())

    def add(self, rows: Rows) -> None:
        """Append rows; without rows it only records a sign of life of the loop."""
        head, ring = self._record["head"], self._record["rows"]
        for row in rows:
            number = int(head["written"])
            slot = ring[number % DEPTH : number % DEPTH + 1]
            slot["again"] = number
            for name in _VALUES:
                slot[name] = row[name]
            slot["number"] = number
            head["written"] = number + 1
        head["alive_ns"] = self._clock()

    def close(self) -> None:
        self._record["head"]["ended_ns"] = self._clock()
        del self._record
        os.close(self._handle)


# --- the page -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Live:
    """The live rows of a run in order, and the state of the run."""

    rows: Rows
    ambient: float  # Pa
    begun_ns: int
    alive_ns: int
    ended_ns: int
    next: int  # number of the row that comes next

    def is_running(self, now_ns: int) -> bool:
        """Whether its loop gave a sign of life recently."""
        return not self.ended_ns and now_ns - self.alive_ns < STALE_S * 1e9

    @property
    def last_ns(self) -> int:
        """When it was last known to run, in ns."""
        return self.ended_ns or self.alive_ns


def read(path: Path, since: int = 0) -> Live | None:
    """The stored rows from number ``since`` on; None if no run has written any.

    Rows that are being overwritten are skipped.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if len(content) != FILE.itemsize:
        return None
    content_record = np.frombuffer(content, FILE)[0]
    head = content_record["head"]
    if head["magic"] != MAGIC:
        return None
    rows, written = content_record["rows"], int(head["written"])
    numbers = np.arange(max(since, written - DEPTH, 0), written)
    selected = rows[numbers % DEPTH]
    is_complete = (selected["number"] == numbers) & (selected["again"] == numbers)
    begun, alive, ended = (int(head[name]) for name in ("begun_ns", "alive_ns", "ended_ns"))
    return Live(selected[is_complete], float(head["ambient"]), begun, alive, ended, written)
