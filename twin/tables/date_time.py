"""Columns of dates and times as PLC tools and spreadsheets write them, to the nanosecond.

Supported are ISO 8601, 31.12.2026 23:59:59,999, dates with slashes if the settings give their
order, a time of day alone (counted from midnight), and Windows file times (100 ns since 1601).
"""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from twin.errors import SourceError
from twin.tables.numbers import Numbers, as_numbers, plain

_FILE_TIME = r"^[0-9]{17,18}$"
_SINCE_1601 = 11_644_473_600 * 10_000_000  # of 100 ns, to 1970
_MIDNIGHT = r"[T ]+0?0:00(:00([.,]0+)?)?$"  # which spreadsheets and databases add to a date
_DAY_OF_NONE = "1970-01-01 "
_OFFSET = r"[0-9]:[0-9]{2}.*(Z|[+-][0-9]{2}(:?[0-9]{2})?)$"
NO_ZONE = "the times say no time zone, and nothing else does"
_ISO = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.]\d{1,9})?)?(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII
)
_SLASHES = {
    "day": (r"^(\d{2})/(\d{2})/(\d{4})", r"\3-\2-\1"),
    "month": (r"^(\d{2})/(\d{2})/(\d{4})", r"\3-\1-\2"),
}
_TO_ISO = (  # in order; RE2 has nine groups, so "\10" is the first one and a zero
    (r"^(\d)([./])", r"0\1\2"),
    (r"^(\d{2})([./])(\d)([./])", r"\1\20\3\4"),
    (r"^(\d{2})\.(\d{2})\.(\d{4})", r"\3-\2-\1"),
    (r"^(\d{4})/(\d{2})/(\d{2})", r"\1-\2-\3"),
    (r"^(\d{1,2}:\d\d)", _DAY_OF_NONE + r"\1"),
    (r"([T ])(\d):", r"\10\2:"),
    (r"[T ]+", " "),
    (r"(:\d\d:\d\d)[,:](\d)", r"\1.\2"),
    (r" (Z|[+-]\d\d)", r"\1"),
)


@dataclass(frozen=True)
class Calendar:
    """How to read dates and times of one file; ``zone`` applies to times without one."""

    zone: str | None
    date_order: Literal["day", "month"] | None
    location: str  # for messages

    def read(self, times: pa.Array, dates: pa.Array | None = None) -> Numbers[np.int64]:
        """Nanoseconds since 1970 UTC; with ``dates`` the times are times of day.

        SourceError if times have no zone and the settings give none.
        """
        if pa.types.is_timestamp(times.type):
            return self._of_stamps(times)
        cells = plain(times.cast(pa.string()))
        if dates is not None:
            days = plain(dates.cast(pa.string()))
            days = pc.replace_substring_regex(days, _MIDNIGHT, "")
            cells = pc.binary_join_element_wise(days, cells, " ")
        file_times = pc.match_substring_regex(cells, _FILE_TIME)
        if pc.any(file_times).as_py():
            return self._of_file_times(cells, file_times)
        return self._of_text(cells)

    @property
    def should_be(self) -> str:
        """What an unreadable cell should be, for messages."""
        if self.date_order is None:
            return (
                "a date and time that can only mean one (see date_order and time_zone of [import])"
            )
        return "a date and time"

    def _of_stamps(self, times: pa.Array) -> Numbers[np.int64]:
        stamps = times.cast(pa.timestamp("ns", times.type.tz))
        if times.type.tz is not None:
            return as_numbers(times, stamps.cast(pa.int64()), 0)
        return as_numbers(times, self._local(stamps), 0)

    def _of_file_times(self, cells: pa.Array, is_file_time: pa.Array) -> Numbers[np.int64]:
        ticks = pc.if_else(is_file_time, cells, None).cast(pa.int64())
        return as_numbers(cells, pc.multiply(pc.subtract(ticks, _SINCE_1601), 100), 0)

    def _of_text(self, cells: pa.Array) -> Numbers[np.int64]:
        text = self._iso(cells)
        says_zone = pc.match_substring_regex(text, _OFFSET)
        no_day = pc.starts_with(text, _DAY_OF_NONE)
        aware = _stamps(pc.if_else(says_zone, text, None), "UTC").cast(pa.int64())
        naive = _stamps(pc.if_else(says_zone, None, text), None)
        local = pc.if_else(no_day, naive.cast(pa.int64()), None)
        if pc.any(pc.and_(naive.is_valid(), pc.invert(no_day))).as_py():
            local = pc.coalesce(local, self._local(naive))
        return as_numbers(cells, pc.coalesce(aware, local), 0)

    def _iso(self, cells: pa.Array) -> pa.Array:
        text = cells
        for pattern, form in _TO_ISO:
            text = pc.replace_substring_regex(text, pattern, form)
            if self.date_order is not None and pattern.startswith(r"^(\d{2})([./])"):
                text = pc.replace_substring_regex(text, *_SLASHES[self.date_order])
        return text

    def _local(self, naive: pa.Array) -> pa.Array:
        """Local times of the zone in UTC; null where its clock skips or repeats them."""
        if self.zone is None:
            raise SourceError(
                f"{self.location}: {NO_ZONE}",
                'write under [import]: time_zone = "Europe/Berlin" (or UTC), or give --time-zone',
            )
        first, last = (
            pc.assume_timezone(naive, self.zone, ambiguous=choice, nonexistent=choice).cast(
                pa.int64()
            )
            for choice in ("earliest", "latest")
        )
        return pc.if_else(pc.equal(first, last), first, None)


def _stamps(text: pa.Array, zone: str | None) -> pa.Array:
    """Instants from text in ISO form; null where it is invalid."""
    kind = pa.timestamp("ns", zone)
    try:
        return text.cast(kind)
    except pa.ArrowInvalid:
        return pa.array([_stamp(cell, kind) for cell in text.to_pylist()], pa.int64()).cast(kind)


def _stamp(cell: str | None, kind: pa.DataType) -> int | None:
    if cell is None or not _ISO.fullmatch(cell):
        return None
    try:
        value: int = pa.scalar(cell).cast(kind).value
    except pa.ArrowInvalid:  # a thirteenth month
        return None
    return value
