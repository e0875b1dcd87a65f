"""The log as one more sink of the loop."""

import errno
import os
import shutil
import time
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from twin.errors import SourceError
from twin.events import Event, Kind
from twin.log.columns import Tray, encode
from twin.log.header import Identity, LogHeader
from twin.log.messages import Scalars, encode_event, encode_log
from twin.log.output import Output
from twin.log.part import CLOCK_METADATA, part_path, write_head
from twin.log.schema import CHANNELS
from twin.signals import SAMPLE, TICK, Samples, Ticks

FLUSH_S = 0.25  # after this much a chunk is completed; a killed process loses no more than it
SYNC_S = 1.0  # after this much the disk is asked to keep it
BATCH = 10_000  # rows in a message where they come fast
ROOM = 16 << 20  # bytes that a disk must have free for another part: some minutes of rows

_SAMPLES, _SCALARS, _EVENTS, _LOG = CHANNELS


class Recorder:
    """Writes a new log, in parts where ``rotate_bytes`` is given.

    A part is closed once it is that long, so it may be longer by a chunk (1 MiB). Every method
    raises SourceError where the file cannot be written; what was written until then can be read,
    and ``close`` is then quiet. ``again`` goes on in another part.
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
        self._flushed = self._synced = clock()
        self._tray = Tray(BATCH)
        self._scalars = Scalars(header.ambient)
        self._events: list[tuple[int, Event]] = []  # with ns of receipt
        # Of the chunk under way, so that another part can begin with it:
        self._in_chunk: list[tuple[Samples, Ticks]] = []
        self._events_in_chunk: list[tuple[int, Event]] = []
        self._host_ns: int | None = None  # of the last row
        self._clocks: dict[str, str] = {}  # as last told of
        self._failure: SourceError | None = None
        self._closed = False
        self._series = uuid.uuid4().hex
        self._number = 0
        encode(np.zeros(1, SAMPLE), np.zeros(1, TICK))  # compiled, not to fall into a block
        self._begin(0)

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event] = ()) -> None:
        """Take row-aligned SAMPLE and TICK rows, maybe none, and what happened with them."""
        if len(samples) != len(ticks):
            raise ValueError(f"{len(samples)} samples but {len(ticks)} ticks")
        if self._failure:
            raise self._failure
        try:
            self._take(samples, ticks, events)
        except OSError as error:
            raise self._fail(error) from error

    def close(self) -> None:
        """Write what is held back and the summary; further calls do nothing."""
        if self._closed or self._failure:
            return
        self._closed = True
        try:
            self._add_rows(*self._tray.take())
            self._add_events()
            self._finish()
        except OSError as error:
            raise self._fail(error) from error

    @property
    def under_way(self) -> Path:
        """The file of the part that is being written."""
        return part_path(self._path, self._number)

    def again(self) -> Self:
        """After a failure go on in the next part, with what had not reached the file.

        SourceError where that cannot be written either; then it can be asked again.
        """
        if self._failure is None:
            return self
        self._in_chunk.append(self._tray.take())
        self._events_in_chunk += self._events
        self._events = []
        self._begin_next()
        rows, events = self._in_chunk, self._events_in_chunk
        self._forget_chunk()
        try:
            for block in rows:
                self._add_rows(*block)
            self._events += events
            self._flush(self._clock())
        except OSError as error:
            self._in_chunk, self._events_in_chunk, self._events = rows, events, []
            raise self._fail(error) from error
        return self

    def _begin_next(self) -> None:
        """Begin another part where there is room for it."""
        folder = self._path.parent
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if shutil.disk_usage(folder).free < ROOM:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise self._fail(error) from error
        self._begin(self._number + 1)
        self._failure = None

    def _forget_chunk(self) -> None:
        self._in_chunk, self._events_in_chunk = [], []

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
        if len(samples):
            self._host_ns = int(samples["host_ns"][-1])
        if events:
            self._events += zip(self._received(events, samples), events, strict=True)
        for event in events:
            if event.kind is Kind.CLOCK:
                at = {"time_ns": str(event.time_ns)}
                self._clocks = at | {name: str(value) for name, value in event.data.items()}
        for block in self._tray.add(samples, ticks):
            self._add_rows(*block)
        now = self._clock()
        # An empty block says that nothing comes just now: nothing to wait for.
        if now - self._flushed >= FLUSH_S or not len(samples):
            self._flush(now)

    def _flush(self, now: float) -> None:
        self._add_rows(*self._tray.take())
        self._add_events()
        self._writer.flush()
        self._forget_chunk()
        self._flushed = now
        if now - self._synced >= SYNC_S:
            self._output.sync()
            self._synced = now

    def _add_rows(self, samples: Samples, ticks: Ticks) -> None:
        if not len(samples):
            return
        self._in_chunk.append((samples.copy(), ticks.copy()))
        host, plc = int(samples["host_ns"][0]), int(samples["time_ns"][0])
        self._writer.add_message(_SAMPLES, host, plc, encode(samples, ticks))
        self._writer.add_messages(_SCALARS, *self._scalars.messages(samples, ticks))
        if self._rotate_bytes is not None and self._output.tell() >= self._rotate_bytes:
            self._finish()
            self._forget_chunk()
            self._begin(self._number + 1)

    def _add_events(self) -> None:
        self._events_in_chunk += self._events
        for host_ns, event in self._events:
            self._writer.add_message(_EVENTS, host_ns, event.time_ns, encode_event(event))
            self._writer.add_message(_LOG, host_ns, event.time_ns, encode_log(event))
        self._events.clear()

    def _received(self, events: Sequence[Event], samples: Samples) -> list[int]:
        """When the rows were received with which they happened: in a long block not the last."""
        times = np.array([event.time_ns for event in events], np.int64)
        host = times if self._host_ns is None else np.full(len(times), self._host_ns)
        if len(samples):
            # The PLC's clock may jump back: of the rows that are not later, the last one.
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
            self._output = Output(path)
        except OSError as error:
            self._failure = _refused(path, error)
            raise self._failure from error
        try:
            self._writer = write_head(self._output, self._header, Identity(self._series, number))
        except OSError as error:
            self._fail(error)
            path.unlink(missing_ok=True)  # without a whole head it would end the log
            self._failure = _refused(path, error)
            raise self._failure from error
        self._number = number

    def _finish(self) -> None:
        if self._clocks:
            self._writer.add_metadata(CLOCK_METADATA, self._clocks)
        self._writer.finish()
        self._output.finish()

    def _fail(self, error: OSError) -> SourceError:
        self._output.abandon()
        path = part_path(self._path, self._number)
        self._failure = SourceError(
            f"{path}: cannot be written: {error.strerror}",
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
