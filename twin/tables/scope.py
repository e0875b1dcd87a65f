"""The head of a TwinCAT Scope text export: blocks of channel data above pairs of time and value.

Above the values are some rows on the whole record. Then come rows such as ``Name``, ``Data-Type``
and ``SampleTime[ms]``, each with a pair of cells for every channel. Beckhoff's manual of the TE13xx
Scope View, "Export to csv", describes the options.
"""

import re
from collections.abc import Iterable, Sequence

from twin.errors import SourceError
from twin.tables.settings import Column

END = "EOF"
_NAME = "Name"
_NUMBER = re.compile(r"-?\d+([.,]\d+)?")
_FILE_TIME = 10**16  # of 100 ns since 1601: no time in ms since the record's begin is as long


def is_header(cells: Sequence[str]) -> bool:
    """Whether a row names channels, in pairs of ``Name`` and the channel's name."""
    return len(cells) >= 4 and set(cells[::2]) <= {_NAME, ""} and cells[0] == cells[2] == _NAME


def columns(
    names: Sequence[str], below: Iterable[tuple[int, list[str]]], location: str
) -> tuple[int, list[str]]:
    """The line of the first values, and the columns' names: the first time, and the channels.

    ``below`` gives rows after ``names`` with their lines. SourceError if there are no values, or
    channels are not sampled together.
    """
    values = ((line, cells) for line, cells in below if cells and _NUMBER.fullmatch(cells[0]))
    line, first = next(values, (0, []))
    if not first:
        raise SourceError(f"{location}: no row follows", "export it with its data")
    times = {cell for cell in first[: len(names) : 2] if cell}
    if len(times) > 1:
        raise SourceError(
            f"{location}: its channels begin at {len(times)} different times",
            "record them with one sample time, or export with the same time line for all",
        )
    is_file_time = "." not in first[0] and "," not in first[0] and int(first[0]) >= _FILE_TIME
    time = Column.TIME if is_file_time else Column.TIME_MS
    header_names = [
        name for pair in zip([""] * len(names), names[1::2], strict=False) for name in pair
    ]
    return line, [time.value, *header_names[1:]]
