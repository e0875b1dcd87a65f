"""Rows of a table as samples, and which of their cells hold nothing usable."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from twin.signals import SAMPLE, UNUSABLE, Command, Quality, Reported, Samples
from twin.tables.date_time import Calendar
from twin.tables.layout import BESIDE, COMMANDS, DIGITS, REPORTED, Layout
from twin.tables.meaning import SUPPLIES
from twin.tables.numbers import Mask, flags, floats, integers
from twin.tables.settings import Column

_ALL_FLAGS = sum(Quality)

Spoilt = dict[Column, Mask]  # where the cells of each column hold nothing usable


@dataclass(frozen=True)
class Batch:
    """Some rows of a file as they stand there."""

    columns: Mapping[Column, pa.Array]  # of ``count`` cells each, null where a row is broken
    count: int
    broken: Mapping[int, str]  # rows whose cells cannot be told apart, and why
    place: Callable[[int], str]  # file and line of a row, for messages
    cell: Callable[[int, Column], str]  # as it is written in the file


def decode(
    batch: Batch, layout: Layout, ambient: float, calendar: Calendar
) -> tuple[Samples, Spoilt]:
    """Give rows of SAMPLE and, by column, where a cell is bad; ``ambient`` in Pa.

    Bad cells are NaN or 0. A column that the file does not have is NaN or 0 too.
    """
    rows, bad = np.zeros(batch.count, SAMPLE), Spoilt()
    if Column.QUALITY in batch.columns:  # the others ask what it says
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
    with np.errstate(over="ignore"):  # too large is infinite, and infinite is bad
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
    told, empty, unreadable = integers(batch.columns[Column.QUALITY])
    bad[Column.QUALITY] = empty | unreadable | (told < 0) | (told > _ALL_FLAGS)
    rows["quality"] = np.where(bad[Column.QUALITY], 0, told)


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
    """An empty cell is as it should be where the quality says that there is no pressure."""
    name = layout.pressure
    value, empty, unreadable = floats(batch.columns[name])
    rows["pressure"] = _single(layout.meanings[name].pascal(value, ambient, "absolute"))
    told = empty & ((rows["quality"] & UNUSABLE) != 0)
    bad[name] = unreadable | (np.isnan(rows["pressure"]) & ~told)


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
    """An empty cell means that nothing was reported; an ejector that saves air has its nozzle off.

    That is so while it is to suck, and the nozzle is on while it does not save.
    """
    state, empty, unreadable = flags(batch.columns[name])
    known = (state == 0) | (state == 1)
    bad[name] = unreadable | (~known & ~empty)
    on = state == 1
    if name is Column.REPORTED_AIR_SAVING:
        on = (state == 0) & (rows["commands"] == Command.SUCTION)
    bit, whether = REPORTED[name]
    rows["reported"] |= np.where(known, np.uint8(whether), np.uint8(0))
    rows["reported"] |= np.where(known & on, np.uint8(bit), np.uint8(0))


def _single(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """NaN for whatever is not finite in float32."""
    single = values.astype(np.float32)
    single[~np.isfinite(single)] = np.nan
    return single
