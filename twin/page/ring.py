"""Live rows in a small file, from the loop to the page: one writes, many read, nobody waits.

The file is a ring of ``ROW``. A row carries its number twice: the second one is written before its
values and the first one after them, so that who reads it in between sees two numbers and leaves it
out. A row stands for ``ROW_NS`` of PLC time and has the lowest and the highest of it, so that no
peak is hidden.
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
from twin.signals import SAMPLE, TICK, UNUSABLE, Samples, Ticks

ROW = np.dtype(
    [
        ("number", "<i8"),
        ("time_ns", "<i8"),  # PLC time of its last sample
        ("host_ns", "<i8"),  # when that was received
        ("measured_low", "<f4"),  # Pa, absolute; NaN where nothing usable came
        ("measured_high", "<f4"),
        ("expected_low", "<f4"),
        ("expected_high", "<f4"),
        ("phase", "u1"),  # of its last sample
        ("commands", "u1"),  # all that were given in it
        ("quality", "u1"),  # all that is wrong with its samples
        ("spare", "u1", (5,)),
        ("again", "<i8"),  # its number
    ]
)
HEAD = np.dtype(
    [
        ("magic", "S16"),
        ("ambient", "<f8"),  # Pa
        ("written", "<i8"),  # rows ever
        ("begun_ns", "<i8"),  # when the run began, by the clock here
        ("alive_ns", "<i8"),  # when its loop was last heard of
        ("ended_ns", "<i8"),  # when it ended in good order; 0: it did not yet
    ]
)
MAGIC = b"ejector-twin/1"
ROW_NS = 25_000_000
DEPTH = 2400  # rows: a minute
FILE = np.dtype([("head", HEAD), ("rows", ROW, (DEPTH,))])
MOST_WAITING = 400  # blocks: 12 s at 30 ms
MOST_HELD = 1000  # samples of a row that is not over: its time at 40 kHz
STALE_S = 5.0  # a driver yields a block at least every half a second

_VALUES = [name for name in ROW.fields or () if name not in ("number", "again", "spare")]
Rows = npt.NDArray[np.void]  # of ROW


# --- the run ------------------------------------------------------------------------------------


class LiveRows:
    """A sink that leaves live rows for the page, written in a thread of its own.

    Where that thread does not keep up, rows are left out; said once. SourceError where there is
    nothing to write to, or another run writes there.
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
        """Take row-aligned blocks; an empty one says that the loop is there."""
        try:
            self._blocks.put_nowait((samples.copy(), ticks.copy()))
        except queue.Full:
            self._fail("cannot be written quickly enough")

    def close(self) -> None:
        """Write what waits, and that the run has ended."""
        self._blocks.put(None)
        self._thread.join()
        self._file.close()

    def _fail(self, why: str) -> None:
        """Say once that rows are left out."""
        if not self._behind:
            self._say(f"the page's live rows: some are missing: {why}")
        self._behind = True

    def _work(self) -> None:
        none: tuple[Samples, Ticks] = np.empty(0, SAMPLE), np.empty(0, TICK)
        held = none
        while (block := self._blocks.get()) is not None:
            try:
                held = np.concatenate([held[0], block[0]]), np.concatenate([held[1], block[1]])
                rows, held = _binned(*held)
                self._file.add(rows)
            except Exception as error:  # whatever it is, later ones are to be shown
                held = none
                self._fail(in_words(error))


def _binned(samples: Samples, ticks: Ticks) -> tuple[Rows, tuple[Samples, Ticks]]:
    """A row for each stretch of ROW_NS that is over, and what is left of one that is not.

    Of a PLC whose time stands still there is a row all the same, whenever MOST_HELD are left.
    """
    stretch = samples["time_ns"] // ROW_NS
    cuts = np.flatnonzero(np.diff(stretch)) + 1
    if len(samples) - (cuts[-1] if len(cuts) else 0) >= MOST_HELD:
        cuts = np.append(cuts, len(samples))
    if not len(cuts):
        return np.empty(0, ROW), (samples, ticks)
    end, starts = cuts[-1], np.concatenate([[0], cuts[:-1]])
    whole, last = samples[:end], cuts - 1
    usable = (whole["quality"] & UNUSABLE) == 0
    measured = np.where(usable, whole["pressure"], np.float32(np.nan))
    rows = np.zeros(len(cuts), ROW)
    for name in ("time_ns", "host_ns"):
        rows[name] = samples[name][last]
    for side, values in (("measured", measured), ("expected", ticks["expected"][:end])):
        rows[f"{side}_low"] = np.fmin.reduceat(values, starts)
        rows[f"{side}_high"] = np.fmax.reduceat(values, starts)
    for name in ("commands", "quality"):
        rows[name] = np.bitwise_or.reduceat(whole[name], starts)
    rows["phase"] = ticks["phase"][last]
    return rows, (samples[end:], ticks[end:])


class _Writer:
    """The file, mapped; its numbers go on from run to run."""

    def __init__(self, path: Path, ambient: float, clock: Callable[[], int]) -> None:
        self._clock = clock
        try:
            self._open(path)
        except OSError as error:
            hint = "check the folder that [page] names; one run at a time writes for an ejector"
            raise SourceError(f"{path}: cannot be written: {error.strerror}", hint) from error
        head = self._all["head"]
        if head["magic"] != MAGIC or not 0 <= head["written"] < 2**62:
            self._all[...] = np.zeros((), FILE)
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
            mapped = mmap.mmap(self._handle, FILE.itemsize)
        except BaseException:
            os.close(self._handle)
            raise
        self._all = np.frombuffer(mapped, FILE)[0:1].reshape(())

    def add(self, rows: Rows) -> None:
        """Put rows behind those that are there; none says that the loop is there."""
        head, ring = self._all["head"], self._all["rows"]
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
        self._all["head"]["ended_ns"] = self._clock()
        del self._all
        os.close(self._handle)


# --- the page -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Live:
    """What a run has left: rows in order, and how it is with it."""

    rows: Rows
    ambient: float  # Pa
    begun_ns: int
    alive_ns: int
    ended_ns: int
    next: int  # number of the row that comes next

    def is_running(self, now_ns: int) -> bool:
        """Whether its loop was heard of lately."""
        return not self.ended_ns and now_ns - self.alive_ns < STALE_S * 1e9

    @property
    def last_ns(self) -> int:
        """When it was last known to run."""
        return self.ended_ns or self.alive_ns


def read(path: Path, since: int = 0) -> Live | None:
    """The rows that are there from number ``since`` on; None where no run has left any.

    Rows that are being overwritten are left out.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if len(content) != FILE.itemsize:
        return None
    whole = np.frombuffer(content, FILE)[0]
    head = whole["head"]
    if head["magic"] != MAGIC:
        return None
    rows, written = whole["rows"], int(head["written"])
    numbers = np.arange(max(since, written - DEPTH, 0), written)
    found = rows[numbers % DEPTH]
    whole_ones = (found["number"] == numbers) & (found["again"] == numbers)
    begun, alive, ended = (int(head[name]) for name in ("begun_ns", "alive_ns", "ended_ns"))
    return Live(found[whole_ones], float(head["ambient"]), begun, alive, ended, written)
