"""The head of a TwinCAT Scope text export: channels' names and properties above time and values.

Above the values are some rows on the whole record. Then come rows such as ``Name``, ``Data-Type``
and ``SampleTime[ms]``. A cell with the row's title stands above each column of times, before the
cells of the channels that have these times: each channel has its own, or those of one sample time
share them. Beckhoff's manual of the TE13xx Scope View, "Export to csv", describes the options.
"""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from twin.errors import SourceError
from twin.tables.settings import Column

NAME, END = "Name", "EOF"
_SAMPLE_TIME = "SampleTime[ms]"
_PROPERTIES = {"SymbolComment", "Data-Type", _SAMPLE_TIME, "SymbolBased", "SymbolName", "NetID"}
_NUMBER = re.compile(r"-?\d+([.,]\d+)?")
_FILE_TIME = 10**16  # of 100 ns since 1601: no time in ms since the record's begin is as long

Rows = Sequence[tuple[int, list[str]]]  # lines and their cells


class Values(NamedTuple):
    """Where the values are."""

    line: int  # the first one
    names: list[str]  # of the columns; that of the times is a known one
    time: int  # index of their column; where a row has none, the channels have ended


def has_properties(below: Rows) -> bool:
    """Whether rows below one that begins with ``NAME`` have properties of channels."""
    return any(row[0] in _PROPERTIES for _, row in below)


def values(names: Sequence[str], below: Rows, wanted: Collection[str], location: str) -> Values:
    """The values of the channels ``wanted``; ``below`` are the rows after ``names``.

    SourceError if there are no values, or these channels are not sampled together.
    """
    line, first = next((row for row in below if _NUMBER.fullmatch(row[1][0])), (0, []))
    if not first:
        raise SourceError(f"{location}: no row follows", "export it with its data")
    times = [index for index, name in enumerate(names) if name == NAME]
    channels = [index for index, name in enumerate(names) if name in wanted and index not in times]
    shared = {index: max(time for time in times if time < index) for index in channels}
    begins = {_comparable(_cell(first, time)) for time in shared.values()}
    if len(begins) > 1:
        raise _apart(location, f"begin at {len(begins)} different times")
    rows = (row for _, row in below if row[0] == _SAMPLE_TIME and len(row) == len(names))
    sample_times = next(rows, [""] * len(names))  # 0,2 between commas would be two cells
    periods = {sample_times[index] for index in channels}
    if len(periods) > 1:
        raise _apart(location, f"are sampled every {' and '.join(sorted(periods))} ms")
    time = min(shared.values(), default=times[0])
    begin = _cell(first, time)
    is_file_time = begin.isdecimal() and int(begin) >= _FILE_TIME
    known = Column.TIME if is_file_time else Column.TIME_MS
    columns = ["" if name == NAME else name for name in names]
    columns[time] = known.value
    return Values(line, columns, time)


def _cell(row: Sequence[str], index: int) -> str:
    return row[index] if index < len(row) else ""


def _comparable(time: str) -> float | None:
    """The first time of a column: 0 and 0.0 are the same. None if the column has none there."""
    return float(time.replace(",", ".")) if _NUMBER.fullmatch(time) else None


def _apart(location: str, problem: str) -> SourceError:
    hint = "record them with one sample time, or export with the same time line for all"
    return SourceError(f"{location}: its channels {problem}", hint)
