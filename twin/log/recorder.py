"""The log as a sink of the live loop."""

import errno
import math
import os
import shutil
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self, TypeAlias

import numpy as np

from twin.errors import SourceError, in_words
from twin.events import Event, Kind
from twin.log.columns import encode, joined
from twin.log.disk_file import Output
from twin.log.header import Identity, LogHeader
from twin.log.messages import Scalars, encode_event, encode_log
from twin.log.part import CLOCK_METADATA, part_path, write_head
from twin.log.schema import CHANNELS
from twin.signals import SAMPLE, TICK, Samples, Ticks

FLUSH_S = 0.25  # interval at which chunks are completed: a killed process loses at most this
SYNC_S = 1.0  # interval of syncs to the disk
BATCH = 10_000  # rows in a message where they arrive fast
ROOM = 16 << 20  # free bytes that another part needs: a few minutes of rows

_SAMPLES, _SCALARS, _EVENTS, _LOG = CHANNELS

Block: TypeAlias = tuple[Samples, Ticks]


class Recorder:
    """Writes a new log, in parts if ``rotate_bytes`` is given.

    A part is closed once it is that long, so it may be longer by a chunk (1 MiB). Every method
    raises SourceError if the file cannot be written; what was written before can be read. Rows
    given to ``write`` are then held, and ``again`` writes them to another part. After any other
    error ``write`` has not taken its rows.
    """

    def __init__(
        self,
        path: Path,
        header: LogHeader,
        rotate_bytes: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._path = path
        self._header = header
        self._rotate_bytes = rotate_bytes
        self._clock = clock
        self._synced = clock()
        self._flushed = -math.inf  # the first rows are in the file at once: it is seen to record
        self._scalars = Scalars(header.ambient)
        # Rows and events (with ns of receipt) arrive here and are laid out as messages. They are
        # dropped once a whole chunk with them is in the file.
        self._blocks: list[Block] = []
        self._events: list[tuple[int, Event]] = []
        self._laid_blocks: list[Block] = []
        self._laid_events: list[tuple[int, Event]] = []
        self._saved = 0, 0  # messages of rows and of events in this part, already dropped
        self._host_ns: int | None = None  # of the last row
        self._clocks: dict[str, str] = {}  # of the latest CLOCK event
        self._failure: SourceError | None = None
        self._closed = False
        self._series = uuid.uuid4().hex
        self._number = 0
        encode(np.zeros(1, SAMPLE), np.zeros(1, TICK))  # compile now, not during a block
        self._begin(0)

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event] = ()) -> None:
        """Take row-aligned SAMPLE and TICK rows, maybe none, and the events that go with them."""
        if len(samples) != len(ticks):
            raise ValueError(f"{len(samples)} samples but {len(ticks)} ticks")
        if self._failure:
            raise self._failure
        self._take(samples, ticks, events)
        try:
            self._write_on(not len(samples))
        except Exception as error:
            raise self._fail(error) from error

    def close(self) -> None:
        """Write the held rows and events and the summary; further calls do nothing."""
        if self._closed or self._failure:
            return
        try:
            self._lay_out()
            self._finish()
            self._closed = True
        except Exception as error:
            raise self._fail(error) from error

    @property
    def under_way(self) -> Path:
        """The file of the part that is being written."""
        return part_path(self._path, self._number)

    @property
    def held(self) -> int:
        """Rows that are not in a file yet."""
        return sum(len(rows) for rows, _ in [*self._laid_blocks, *self._blocks])

    def again(self) -> Self:
        """After a failure, go on in the next part with all that had not reached the file.

        SourceError if that part cannot be written either; the call can then be repeated.
        """
        if self._failure is None:
            return self
        try:
            self._require_room()
            self._begin(self._number + 1)
            self._failure = None
            self._flush(self._clock())
        except Exception as error:
            raise self._fail(error) from error
        return self

    def _require_room(self) -> None:
        folder = self._path.parent
        folder.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(folder).free < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _take(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Hold rows and events: all of them, or none."""
        last = int(samples["host_ns"][-1]) if len(samples) else self._host_ns
        received = [*zip(self._received(events, samples, last), events, strict=True)]
        clocks = self._clocks
        for event in events:
            if event.kind is Kind.CLOCK:
                entry = {"time_ns": str(event.time_ns)}
                clocks = entry | {name: str(value) for name, value in event.data.items()}
        blocks = [(samples.copy(), ticks.copy())] if len(samples) else []
        self._blocks, self._events, self._host_ns, self._clocks = (
            self._blocks + blocks,
            self._events + received,
            last,
            clocks,
        )

    def _write_on(self, idle: bool) -> None:
        """Lay out full messages, and complete the chunk when it is due."""
        while sum(len(rows) for rows, _ in self._blocks) >= BATCH:
            self._lay_out_rows()
        now = self._clock()
        # An empty block means that no rows are arriving: there is nothing to wait for.
        if now - self._flushed >= FLUSH_S or idle:
            self._flush(now)

    def _flush(self, now: float) -> None:
        has_rows = bool(self._blocks)
        self._lay_out()
        self._writer.flush()
        self._forget_saved()
        if has_rows:
            self._flushed = now
        if now - self._synced >= SYNC_S:
            self._output.sync()
            self._synced = now

    def _lay_out(self) -> None:
        """Lay out all rows and events."""
        while self._blocks:
            self._lay_out_rows()
        events = self._events
        self._laid_events, self._events = self._laid_events + events, []
        for host_ns, event in events:
            self._writer.add_message(_EVENTS, host_ns, event.time_ns, encode_event(event))
            self._writer.add_message(_LOG, host_ns, event.time_ns, encode_log(event))

    def _lay_out_rows(self) -> None:
        """Lay out one message of rows, and begin another part if this one is long enough."""
        samples, ticks = joined(self._blocks)
        rest = [(samples[BATCH:], ticks[BATCH:])] if len(samples) > BATCH else []
        samples, ticks = samples[:BATCH], ticks[:BATCH]
        self._laid_blocks, self._blocks = [*self._laid_blocks, (samples, ticks)], rest
        host, plc = int(samples["host_ns"][0]), int(samples["time_ns"][0])
        self._writer.add_message(_SAMPLES, host, plc, encode(samples, ticks))
        self._writer.add_messages(_SCALARS, *self._scalars.messages(samples, ticks))
        self._forget_saved()
        if self._rotate_bytes is not None and self._output.tell() >= self._rotate_bytes:
            self._finish()
            self._begin(self._number + 1)

    def _forget_saved(self) -> None:
        """Drop what whole chunks in the file contain."""
        rows, events = self._writer.saved(_SAMPLES), self._writer.saved(_EVENTS)
        rows_before, events_before = self._saved
        self._laid_blocks, self._laid_events, self._saved = (
            self._laid_blocks[rows - rows_before :],
            self._laid_events[events - events_before :],
            (rows, events),
        )

    def _received(self, events: Sequence[Event], samples: Samples, last: int | None) -> list[int]:
        """Receipt time of each event's row, in ns; in a long block this is not the last row."""
        times = np.array([event.time_ns for event in events], np.int64)
        host = times if last is None else np.full(len(times), last)
        if len(samples):
            # The PLC's clock may jump back: take the last row that is not later than the event.
            earliest = np.minimum.accumulate(samples["time_ns"][::-1])[::-1]
            rows = np.searchsorted(earliest, times, "right") - 1
            host = np.where(rows >= 0, samples["host_ns"][rows], host)
        received: list[int] = host.tolist()
        return received

    def _begin(self, number: int) -> None:
        path = part_path(self._path, number)
        try:
            if number == 0 and part_path(path, 1).exists():
                raise FileExistsError
            output = Output(path)
        except OSError as error:
            raise _refused(path, error) from error
        try:
            writer = write_head(output, self._header, Identity(self._series, number))
        except Exception as error:
            output.abandon()
            path.unlink(missing_ok=True)  # without a whole head it would end the log
            if isinstance(error, OSError):
                raise _refused(path, error) from error
            raise
        self._output, self._writer, self._number, self._saved = output, writer, number, (0, 0)

    def _finish(self) -> None:
        """Complete the part with all that was laid out."""
        if self._clocks:
            self._writer.add_metadata(CLOCK_METADATA, self._clocks)
        self._writer.finish()
        self._output.finish()
        self._forget_saved()

    def _fail(self, error: Exception) -> SourceError:
        """Close the file, and hold what its whole chunks do not contain."""
        self._output.abandon()
        self._forget_saved()
        self._blocks, self._laid_blocks = self._laid_blocks + self._blocks, []
        self._events, self._laid_events = self._laid_events + self._events, []
        if isinstance(error, SourceError):
            self._failure = error
        else:
            why = getattr(error, "strerror", None) or in_words(error)
            self._failure = SourceError(
                f"{self.under_way}: cannot be written: {why}",
                "make space or choose another disk; what was logged until then can be read",
            )
        return self._failure


def _refused(path: Path, error: OSError) -> SourceError:
    if isinstance(error, FileExistsError):
        return SourceError(
            f"{path}: there is already a log of that name",
            "a log is never overwritten: choose another name, or remove the old one with its parts",
        )
    hint = "check that the folder exists, may be written to and has space"
    return SourceError(f"{path}: cannot be written: {error.strerror}", hint)
