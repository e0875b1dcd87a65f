"""Missing rows: their events, and how short gaps pass through twin and monitor unmarked."""

from dataclasses import dataclass, field

import numpy as np

from twin.events import Event, Kind
from twin.quality import Quality, mark
from twin.signals import MOST_BRIDGED, NS, Bridge, LastRow, Samples, unseen_ns

APART_NS = 1_000_000_000  # between events of short gaps: a stream may have dozens a second


def gap_event(before: np.void, row: np.void) -> Event:
    """The event of missing rows between two."""
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
    """Removes the marks of short gaps before twin and monitor, and restores them afterwards.

    Rows must come back in the order in which they went in; blocks may be cut anew. A short gap is
    reported at once; those within a second after it are reported with the next.
    """

    _bridge: Bridge = field(default_factory=Bridge)
    _marks: list[int] = field(default_factory=list)  # marked rows that have not come back
    _in: int = 0  # rows so far
    _out: int = 0
    _last: LastRow = field(default_factory=LastRow)  # that came back
    _events: list[Event] = field(default_factory=list)
    _reported_ns: int | None = None
    _gaps: int = 0  # not yet reported, and rows missing in them
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
        """The next of these rows, with their marks."""
        begin, self._out = self._out, self._out + len(samples)
        marked_rows = [row - begin for row in self._marks if row < self._out]
        if marked_rows:
            self._marks = self._marks[len(marked_rows) :]
            samples = samples.copy()
            mark(samples["quality"], marked_rows, Quality.GAP)
            for row in marked_rows:
                self._report(samples[row - 1] if row else self._last.row[0], samples[row])
        self._last.keep(samples)
        return samples

    def told(self) -> list[Event]:
        """Events of the rows that came back since the last call."""
        events, self._events = self._events, []
        return events

    def _report(self, before: np.void, row: np.void) -> None:
        """Report a gap, or count it for the next report."""
        self._gaps += 1
        self._missing += int(row["sequence"]) - int(before["sequence"]) - 1
        now_ns = int(row["time_ns"])
        if self._reported_ns is not None and 0 <= now_ns - self._reported_ns < APART_NS:
            return
        event = gap_event(before, row)
        if self._gaps > 1:
            since = (now_ns - self._reported_ns) * NS if self._reported_ns is not None else 0.0
            text = (
                f"{self._missing} samples are missing in {self._gaps} gaps of at most"
                f" {MOST_BRIDGED} within {since:.1f} s: the model steps over them"
            )
            data = {"missing": self._missing, "seconds": since, "gaps": self._gaps}
            event = Event(now_ns, Kind.GAP, text, data)
        self._events.append(event)
        self._reported_ns, self._gaps, self._missing = now_ns, 0, 0
