"""Rows of a table as samples, with masks of the unusable cells."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from twin.quality import UNUSABLE, Quality
from twin.signals import SAMPLE, Command, Reported, Samples
from twin.tables.date_time import Calendar
from twin.tables.layout import BESIDE, COMMANDS, REPORTED, Layout
from twin.tables.numbers import Mask, flags, floats, integers
from twin.tables.settings import DIGITS, Column
from twin.tables.units import SUPPLIES

_ALL_FLAGS = sum(Quality)

Spoilt = dict[Column, Mask]  # by column: where its cells are unusable


@dataclass(frozen=True)
class Batch:
    """Some rows of a file, not yet converted."""

    columns: Mapping[Column, pa.Array]  # of ``count`` cells each, null where a row is broken
    count: int
    broken: Mapping[int, str]  # rows that cannot be split into cells, and why
    location: Callable[[int], str]  # file and line of a row, for messages
    cell: Callable[[int, Column], str]  # as it is written in the file


def decode(
    batch: Batch, layout: Layout, ambient: float, calendar: Calendar
) -> tuple[Samples, Spoilt]:
    """Give rows of SAMPLE and, by column, a mask of bad cells; ``ambient`` in Pa.

    Bad cells become NaN or 0, as do columns that the file lacks.
    """
    rows, bad = np.zeros(batch.count, SAMPLE), Spoilt()
    if Column.QUALITY in batch.columns:  # other columns depend on it
        _flags(batch, rows, bad)
    if layout.time is Column.TIME:
        _date_time(batch, calendar, rows["time_ns"], bad)
    else:
        _whole(batch, layout.time, rows["time_ns"], bad)
    for name in _present(batch, (Column.SEQUENCE, Column.HOST_NS)):
        _whole(batch, name, rows[name.value], bad)
    for name in _present(batch, COMMANDS):
        _command(batch, name, rows, bad)
    rows["supply"] = np.nan
    with np.errstate(over="ignore"):  # an overflow gives infinity, which is bad
        _pressure(batch, layout, ambient, rows, bad)
        _supply(batch, layout, ambient, rows, bad)
        for name in _present(batch, BESIDE):
            _beside(batch, name, layout.lines[name], rows, bad)
    for name in _present(batch, REPORTED):
        _reported(batch, name, rows, bad)
    return rows, bad


def _present(batch: Batch, names: Iterable[Column]) -> list[Column]:
    return [name for name in names if name in batch.columns]


def _flags(batch: Batch, rows: Samples, bad: Spoilt) -> None:
    quality, empty, unreadable = integers(batch.columns[Column.QUALITY])
    bad[Column.QUALITY] = empty | unreadable | (quality < 0) | (quality > _ALL_FLAGS)
    rows["quality"] = np.where(bad[Column.QUALITY], 0, quality)


def _whole(batch: Batch, name: Column, out: npt.NDArray[np.int64], bad: Spoilt) -> None:
    out[:], empty, unreadable = integers(batch.columns[name], DIGITS.get(name, 0))
    bad[name] = empty | unreadable


def _date_time(batch: Batch, calendar: Calendar, out: npt.NDArray[np.int64], bad: Spoilt) -> None:
    read = calendar.read(batch.columns[Column.TIME], batch.columns.get(Column.DATE))
    out[:], empty, unreadable = read
    bad[Column.TIME] = empty | unreadable


def _command(batch: Batch, name: Column, rows: Samples, bad: Spoilt) -> None:
    state, empty, unreadable = flags(batch.columns[name])
    bad[name] = empty | unreadable | ((state != 0) & (state != 1))
    rows["commands"][state == 1] |= COMMANDS[name].value


def _pressure(batch: Batch, layout: Layout, ambient: float, rows: Samples, bad: Spoilt) -> None:
    """An empty cell is valid where the quality says that there is no pressure."""
    name = layout.pressure
    value, empty, unreadable = floats(batch.columns[name])
    rows["pressure"] = _single(layout.meanings[name].pascal(value, ambient, "absolute"))
    explained = empty & ((rows["quality"] & UNUSABLE) != 0)
    bad[name] = unreadable | (np.isnan(rows["pressure"]) & ~explained)


def _supply(batch: Batch, layout: Layout, ambient: float, rows: Samples, bad: Spoilt) -> None:
    """An empty cell means that it is not measured."""
    for name in _present(batch, SUPPLIES):  # one at most
        value, empty, unreadable = floats(batch.columns[name])
        rows["supply"] = _single(layout.meanings[name].pascal(value, ambient, "gauge"))
        bad[name] = unreadable | (np.isnan(rows["supply"]) & ~empty)


def _beside(
    batch: Batch, name: Column, line: tuple[float, float], rows: Samples, bad: Spoilt
) -> None:
    """An empty cell means that it is not measured."""
    column, unit, zero = BESIDE[name]
    value, empty, unreadable = floats(batch.columns[name])
    if line != (1.0, 0.0):
        value = value * line[0] + line[1]
    single = _single(value * unit + zero if zero else value * unit)  # -0 + 0 is another zero
    measured = np.isfinite(single)
    bad[name] = unreadable | (~measured & ~empty)
    rows[column] = np.where(measured, single, 0.0)
    if column == "flow":
        rows["reported"] |= np.where(measured, np.uint8(Reported.FLOW_KNOWN), np.uint8(0))


def _reported(batch: Batch, name: Column, rows: Samples, bad: Spoilt) -> None:
    """An empty cell means that nothing was reported.

    Under suction the nozzle is off while the ejector saves air, and on while it does not.
    """
    state, empty, unreadable = flags(batch.columns[name])
    is_state = (state == 0) | (state == 1)
    bad[name] = unreadable | (~is_state & ~empty)
    on = state == 1
    if name is Column.REPORTED_AIR_SAVING:
        on = (state == 0) & (rows["commands"] == Command.SUCTION)
    bit, known_bit = REPORTED[name]
    rows["reported"] |= np.where(is_state, np.uint8(known_bit), np.uint8(0))
    rows["reported"] |= np.where(is_state & on, np.uint8(bit), np.uint8(0))


def _single(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """The values as float32; NaN where they are not finite."""
    single = values.astype(np.float32)
    single[~np.isfinite(single)] = np.nan
    return single
