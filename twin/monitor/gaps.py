"""Missing rows: what is said of them, and how short gaps go through twin and monitor unmarked."""

from dataclasses import dataclass, field

import numpy as np

from twin.events import Event, Kind
from twin.signals import MOST_BRIDGED, NS, SAMPLE, Bridge, Quality, Samples, unseen_ns

APART_NS = 1_000_000_000  # between events of short gaps: a stream may have dozens a second


def gap_event(before: np.void, row: np.void) -> Event:
    """That rows are missing between two."""
    missing = int(row["sequence"]) - int(before["sequence"]) - 1
    seconds = float(unseen_ns(before, row)) * NS
    text = f"{missing} samples are missing ({seconds:.3f} s)"
    if missing < 0 or row["quality"] & Quality.RESTART:
        missing = 0
        text = f"samples are missing over {seconds:.3f} s; how many is not known"
    data: dict[str, float | int | str] = {"missing": missing, "seconds": seconds}
    return Event(int(row["time_ns"]), Kind.GAP, text, data)


@dataclass
class ShortGaps:
    """Keeps the marks of short gaps aside while rows go through what steps over them.

    Rows come back in the order in which they went in, however they are cut. A short gap is told of
    at once; those within a second after it are told with the next.
    """

    _bridge: Bridge = field(default_factory=Bridge)
    _marks: list[int] = field(default_factory=list)  # rows with one that have not come back
    _in: int = 0  # rows so far
    _out: int = 0
    _last: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # row that came back
    _events: list[Event] = field(default_factory=list)
    _told_ns: int | None = None
    _gaps: int = 0  # not told of yet, and rows missing in them
    _missing: int = 0

    def off(self, block: Samples) -> Samples:
        """The rows of ``block`` without these marks."""
        rows = self._bridge.over(block)
        if rows is not block:
            marked = np.flatnonzero(rows["quality"] != block["quality"])
            self._marks += (self._in + marked).tolist()
        self._in += len(block)
        return rows

    def on(self, samples: Samples) -> Samples:
        """The next of these rows, as they were."""
        begin, self._out = self._out, self._out + len(samples)
        here = [row - begin for row in self._marks if row < self._out]
        if here:
            self._marks = self._marks[len(here) :]
            samples = samples.copy()
            samples["quality"][here] |= np.uint8(Quality.GAP)
            for row in here:
                self._tell(samples[row - 1] if row else self._last[0], samples[row])
        self._last = samples[-1:].copy() if len(samples) else self._last
        return samples

    def told(self) -> list[Event]:
        """What there is to say of the rows that came back since the last call."""
        events, self._events = self._events, []
        return events

    def _tell(self, before: np.void, row: np.void) -> None:
        """Say it, or keep it for the next that is said."""
        self._gaps += 1
        self._missing += int(row["sequence"]) - int(before["sequence"]) - 1
        now_ns = int(row["time_ns"])
        if self._told_ns is not None and 0 <= now_ns - self._told_ns < APART_NS:
            return
        event = gap_event(before, row)
        if self._gaps > 1:
            since = (now_ns - self._told_ns) * NS if self._told_ns is not None else 0.0
            text = (
                f"{self._missing} samples are missing in {self._gaps} gaps of at most"
                f" {MOST_BRIDGED} within {since:.1f} s: the model steps over them"
            )
            data = {"missing": self._missing, "seconds": since, "gaps": self._gaps}
            event = Event(now_ns, Kind.GAP, text, data)
        self._events.append(event)
        self._told_ns, self._gaps, self._missing = now_ns, 0, 0
