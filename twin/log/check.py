"""Checks a log: its contents and its damage; and recovers the readable part."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin.events import Event
from twin.log.columns import RowBuffer
from twin.log.header import RECOVERED
from twin.log.reader import Log, decode_event_message, decode_rows, open_log
from twin.log.recorder import Recorder
from twin.log.records import Damage, messages
from twin.log.schema import EVENTS, SAMPLES
from twin.quality import Quality
from twin.signals import NS, LastRow, Samples, Ticks, unseen_ns

Piece = tuple[Samples, Ticks, list[Event]]
Watch = Callable[[Iterator[Piece]], Iterator[Piece]]  # passes pieces on, and shows how many


@dataclass(frozen=True)
class Report:
    """The contents of a log; counts are of its readable part."""

    path: Path
    parts: int
    complete: bool  # its writer finished it
    damage: tuple[Damage, ...]  # all unreadable places
    samples: int
    events: int
    duration_s: float  # PLC time, without jumps of the clock and restarts
    gaps: int  # places where samples are missing: sequence numbers, or all of a restart
    missing: int  # samples missing there, without those over restarts: their number is unknown
    unseen_s: float  # total length of the gaps
    restarts: int  # gaps after which the sequence starts again
    time_back: int  # places where PLC time does not go forward
    bytes_per_sample: float  # of the files
    checked: bool = True  # its head has a checksum
    derived: str = ""  # how commands were derived, if nobody recorded them

    @property
    def sound(self) -> bool:
        """Complete and without damage."""
        return self.complete and not self.damage

    def __str__(self) -> str:
        """Several lines for people."""
        lines = [
            f"{self.path}: {self.samples} rows, {self.duration_s:.1f} s, {self.events} events",
            f"gaps: {self.gaps}, {self._missing()}{self._unseen()}",
            f"{self._size()}parts: {self.parts}",
            f"state: {self._state()}",
        ]
        if self.time_back:
            lines.insert(2, f"PLC time does not go forward at {self.time_back} places")
        if self.derived:
            lines.append(f"commands: {self.derived}")
        return "\n".join([*lines, *(f"unreadable: {damage}" for damage in self.damage)])

    def _missing(self) -> str:
        """How many rows are missing; unknown over a restart, since the PLC counts anew."""
        if not self.restarts:
            return f"{self.missing} rows missing"
        if self.restarts == self.gaps:
            return "how many rows are missing is not known"
        return f"{self.missing} rows missing, and those over a restart, which nobody knows"

    def _size(self) -> str:
        return f"size: {self.bytes_per_sample:.1f} bytes a row, " if self.samples else ""

    def _unseen(self) -> str:
        """How long the gaps are, and how many of them are restarts."""
        seconds = f", {self.unseen_s:.1f} s not seen" if self.gaps else ""
        noun = "a restart" if self.restarts == 1 else "restarts"
        return seconds + (f", {self.restarts} of them {noun} of the PLC" if self.restarts else "")

    def _state(self) -> str:
        if any(not damage.torn for damage in self.damage):
            return "damaged"
        end = "complete" if self.complete else "unfinished, its writer was stopped"
        return end if self.checked else f"{end}; its head is unchecked: it has no checksum"


class _StreamStatistics:
    """Counts the rows of a stream. How the stream is cut into blocks does not matter."""

    def __init__(self) -> None:
        self.samples = self.events = self.gaps = self.missing = 0
        self.restarts = self.time_back = 0
        self.duration_s = self.unseen_s = 0.0
        self._last = LastRow()

    def add(self, samples: Samples) -> None:
        self.samples += len(samples)
        rows = np.concatenate((self._last.keep(samples), samples))
        skipped = np.diff(rows["sequence"]) - 1
        restarts = ((rows["quality"][1:] & Quality.RESTART) != 0) | (skipped < 0)
        gaps = (skipped > 0) | restarts
        self.gaps += int(gaps.sum())
        self.restarts += int(restarts.sum())
        self.missing += int(skipped[gaps & ~restarts].sum())
        self.unseen_s += float(unseen_ns(rows[:-1][gaps], rows[1:][gaps]).sum() * NS)
        steps = np.diff(rows["time_ns"])
        self.time_back += int((steps <= 0).sum())
        jumps = (rows["quality"][1:] & (Quality.CLOCK | Quality.RESTART)) != 0
        self.duration_s += float(steps[(steps > 0) & ~jumps].sum() * NS)


def check(path: Path, watch: Watch = iter) -> Report:
    """Read a whole log and report what it holds; SourceError if the file is no log."""
    return _scan(open_log(path), lambda *_: None, watch)


def recover(path: Path, out: Path, watch: Watch = iter) -> Report:
    """Copy the readable part of a log to a complete new log; the report is about the old one.

    SourceError if the file is no log, or if ``out`` exists or cannot be written.
    """
    log = open_log(path)
    origin = log.header.metadata | {RECOVERED: path.name}
    with Recorder(out, replace(log.header, metadata=origin)) as recorder:
        return _scan(log, recorder.write, watch)


def _scan(
    log: Log, write: Callable[[Samples, Ticks, Sequence[Event]], None], watch: Watch
) -> Report:
    damage: list[Damage] = []
    statistics = _StreamStatistics()
    for samples, ticks, events in watch(_pieces(log, damage)):
        statistics.add(samples)
        statistics.events += len(events)
        write(samples, ticks, events)
    size = sum(part.stat().st_size for part in log.parts)
    return Report(
        path=log.path,
        parts=len(log.parts),
        complete=log.complete,
        damage=tuple(damage),
        samples=statistics.samples,
        events=statistics.events,
        duration_s=statistics.duration_s,
        gaps=statistics.gaps,
        missing=statistics.missing,
        unseen_s=statistics.unseen_s,
        restarts=statistics.restarts,
        time_back=statistics.time_back,
        bytes_per_sample=size / max(statistics.samples, 1),
        checked=log.checked,
        derived=log.header.derived,
    )


def _pieces(log: Log, damage: list[Damage]) -> Iterator[Piece]:
    """Each message of rows with the events written after it, which happened during these rows."""
    samples, ticks = RowBuffer(0).take()
    events: list[Event] = []
    for part in log.parts:
        for topic, packed in messages(part, (SAMPLES.topic, EVENTS.topic), damage.append):
            if topic == EVENTS.topic:
                events.append(decode_event_message(part, packed))
                continue
            yield samples, ticks, events
            (samples, ticks), events = decode_rows(part, packed), []
    yield samples, ticks, events
