"""Follow a PLC's ring of scans without loss, over any protocol.

The PLC writes a record per scan into a ring and counts them in a header. The sequence number of a
record shows whether it is the expected one. A lost record leaves a missing number, and a flag on
the next sample.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from drivers.reconnect import EMPTY, Clock, LostError
from twin.errors import SourceError
from twin.quality import Quality, mark
from twin.settings import KeyedError
from twin.signals import Samples

COMMANDS = 0b11  # in the status of a record, as in Command
COMMAND_BITS = {"suction": 0, "blow_off": 1}  # the same by the tags' names
OVERFLOW_BIT = 8  # in the status of a record
RESERVE = 64  # records at the old end of the ring that the PLC may overwrite while they are read
CLOCK_TOLERANCE_NS = 50_000_000  # permitted difference of PLC time and sequence
LONGEST_PERIOD_NS = 1_000_000_000  # longest period of a PLC's scans
LATEST_NS = 1 << 62  # the year 2116; a later time is invalid
WRAP = 1 << 32  # the PLC counts with 32 bits


@dataclass(frozen=True)
class Header:
    """The PLC's header of its ring."""

    sequence: int  # sequence number of the newest complete record, 32 bits
    time_ns: int  # time of that record
    boot: int  # differs after every restart
    period_ns: int
    depth: int  # records
    unsure_ns: int = field(default=0, kw_only=True)  # largest error of its time

    @property
    def ready(self) -> bool:
        """Whether it describes a ring; a PLC that just starts may show zeros."""
        runs = 0 < self.period_ns <= LONGEST_PERIOD_NS and abs(self.time_ns) < LATEST_NS
        return runs and self.depth > 2 * RESERVE

    @property
    def blank(self) -> bool:
        """Whether nothing was written yet, as in a PLC that just starts."""
        return not (self.sequence or self.time_ns or self.period_ns)

    def advance(self, earlier: "Header") -> int | None:
        """Scans since ``earlier``; None if the PLC restarted in between."""
        scans = (self.sequence - earlier.sequence) % WRAP
        return None if self.boot != earlier.boot or scans >= WRAP // 2 else scans

    def clock_jumped(self, earlier: "Header", scans: int) -> bool:
        """Whether PLC time and sequence disagree beyond the tolerance."""
        drift_ns = self.time_ns - earlier.time_ns - scans * self.period_ns
        return abs(drift_ns) > CLOCK_TOLERANCE_NS

    def follows(self, earlier: "Header") -> bool:
        """Whether the PLC has only continued to scan since ``earlier``."""
        scans = self.advance(earlier)
        return (
            self.ready
            and scans is not None
            and scans < self.depth
            and not self.clock_jumped(earlier, scans)
        )


def no_effect(tag: str, bit: int, address: object, single_mode: str) -> KeyedError:
    """The error for a bit's tag in block mode whose address differs from the trace's.

    ``single_mode`` is the mode that reads single values.
    """
    return KeyedError(
        f"{address} has no effect in block mode: each record has {tag} in bit {bit} of "
        f"its status. Have the PLC write it there and leave out [driver.tags.{tag}], or read "
        f'single values with mode = "{single_mode}" in [driver]',
        "tags",
        tag,
    )


def refuse_unused(present: Collection[str], names: Collection[str], single_mode: str) -> None:
    """KeyedError if a ``present`` setting among ``names`` is for ``single_mode`` alone."""
    for name in names:
        if name in present:
            raise KeyedError(
                "has no effect in block mode: a missing record shows in the sequence. Leave it "
                f'out, or set mode = "{single_mode}" in [driver]',
                name,
            )


def refusal(header: Header) -> type[SourceError]:
    """Type of error for a ring that cannot be followed; LostError if the PLC may be starting."""
    return LostError if header.blank else SourceError


class Paced(Protocol):
    """Settings of the reading interval."""

    @property
    def interval_ms(self) -> float:
        """Time between blocks (ms)."""
        ...


H = TypeVar("H", bound=Header)
L = TypeVar("L")


class Follower(ABC, Generic[H, L]):
    """The reading position in the ring of one PLC; it outlives connections."""

    def __init__(self, settings: Paced, clock: Clock) -> None:
        self._interval_ns = round(settings.interval_ms * 1e6)
        self._clock = clock
        self._header: H | None = None
        self._newest = -1  # sequence of the header, beyond 32 bits
        self._next = 0  # sequence to fetch next
        self._last = -1  # sequence of the last sample given
        self._last_ns = 0  # PLC time of the last sample given
        self._break = 0  # Quality bits for the next sample

    @abstractmethod
    def start(self, link: L) -> H:
        """Begin at the newest record; SourceError if there is no ring as configured."""

    @abstractmethod
    def refuse_other(self, header: H) -> None:
        """SourceError if ``header`` does not describe a ring that can be followed.

        LostError if there may be one once the PLC has started.
        """

    @abstractmethod
    def _read(self, link: L) -> Samples:
        """New samples, as many as fit into the time for one block."""

    def samples(self, link: L) -> Iterator[Samples]:
        """Blocks of new samples, one every interval; ends only by an exception."""
        if self._header is None:
            self._header = self.start(link)
        while True:
            started = self._clock.now_ns()
            yield self._read(link)
            remaining_ns = started + self._interval_ns - self._clock.now_ns()
            if remaining_ns > 0:
                self._clock.sleep(remaining_ns * 1e-9)

    def _begin(self, header: H) -> None:
        """Start at the newest record."""
        self._newest = header.sequence
        self._next, self._last = header.sequence, header.sequence - 1
        self._last_ns = header.time_ns - header.period_ns

    def _advance_to(self, header: H) -> None:
        """Move to ``header``, and set flags for breaks since the last one."""
        assert self._header is not None
        self.refuse_other(header)
        scans = header.advance(self._header)
        if scans is None:
            self._break |= Quality.RESTART | Quality.GAP  # scans in between were never read
            self._newest, self._next, self._last = header.sequence, 0, -1
        else:
            self._newest += scans
            if header.clock_jumped(self._header, scans):
                self._break |= Quality.CLOCK
        self._header = header
        self._next = max(self._next, self._newest - header.depth + RESERVE)

    def _smoothed(self, header: H, scans_apart: int) -> H:
        """The header with its time smoothed by the count of scans.

        Time and sequence may be read up to ``scans_apart`` scans apart, so the time of a scan is
        known only to that tolerance. Within it, time runs on evenly. The first time may be off by
        as much. Once that shows, it is corrected little by little, so that time never jumps.
        """
        tolerance_ns = scans_apart * header.period_ns
        scans = header.advance(self._header) if self._header else None
        if self._header is None or scans is None:
            return replace(header, unsure_ns=tolerance_ns)
        expected = self._header.time_ns + scans * header.period_ns
        deviation_ns = header.time_ns - expected
        if abs(deviation_ns) > max(CLOCK_TOLERANCE_NS, tolerance_ns + self._header.unsure_ns):
            return replace(header, unsure_ns=tolerance_ns)  # the clock was set
        shift_ns = min(max(0, deviation_ns - tolerance_ns), deviation_ns + tolerance_ns)
        if abs(shift_ns) <= self._header.unsure_ns:
            earliest, latest = self._half_period_window(header, scans)
            shift_ns = max(shift_ns, min(earliest - expected, 0))
            shift_ns = min(shift_ns, max(latest - expected, 0))
        unsure_ns = min(self._header.unsure_ns, abs(deviation_ns - shift_ns) + tolerance_ns)
        return replace(header, time_ns=expected + shift_ns, unsure_ns=unsure_ns)

    def _half_period_window(self, header: H, scans: int) -> tuple[int, int]:
        """Times of ``header`` at which the next sample is half a period early, or late (ns)."""
        to_next = self._newest + scans - self._last - 1
        due = self._last_ns + (to_next + 1) * header.period_ns
        return due - header.period_ns // 2, due + header.period_ns // 2

    def _consume(self, first: int, valid: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
        """Sequences of the valid records from ``first`` on; the position moves behind them."""
        sequence = first + np.flatnonzero(valid)
        # Records after the last valid one may only be late. If none is valid, waiting is useless.
        self._next = int(sequence[-1]) + 1 if len(sequence) else first + len(valid)
        return sequence

    def _stamp(self, block: Samples, header: H, sequence: npt.NDArray[np.int64]) -> Samples:
        """Set numbers and times of decoded records, and flag breaks."""
        if not len(block):
            return EMPTY
        block["sequence"] = sequence
        block["time_ns"] = header.time_ns - (self._newest - sequence) * header.period_ns
        block["host_ns"] = self._clock.wall_ns()
        self._mark_breaks(block)
        return block

    def _mark_breaks(self, block: Samples) -> None:
        gaps = np.diff(block["sequence"], prepend=self._last) != 1
        mark(block["quality"], gaps, Quality.GAP)
        if block["time_ns"][0] <= self._last_ns:
            self._break |= Quality.CLOCK
        block["quality"][0] |= self._break
        self._break = 0
        self._last = int(block["sequence"][-1])
        self._last_ns = int(block["time_ns"][-1])
