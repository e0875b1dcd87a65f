"""What the first cells of a file's columns are: dates and times, by their form."""

import re
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import Literal

import pyarrow as pa

from twin.errors import SourceError
from twin.tables.date_time import NO_ZONE, Calendar
from twin.tables.settings import Column, ImportSettings, Unsaid

MOST_ROWS = 10  # that are looked at
MOST_COLUMNS = 200
_DATE = re.compile(
    r"(\d{4}[-/]\d\d[-/]\d\d|\d{1,2}[./]\d{1,2}[./]\d{4})([T ]+0?0:00(:00([.,]0+)?)?)?", re.ASCII
)
_TIME_OF_DAY = re.compile(r"\d{1,2}:\d\d", re.ASCII)

FirstCells = Mapping[str, Sequence[str]]  # by name of the column
DateOrder = Literal["day", "month"]


class Form(Enum):
    """What the cells of a column are."""

    INSTANT = auto()  # a date and time
    DATE = auto()
    TIME_OF_DAY = auto()


def form_of(cells: Sequence[str], order: DateOrder | None) -> Form | None:
    """The form of a column's cells; None if they are no dates and times, or all empty."""
    filled = [cell for cell in cells if cell]
    if not filled:
        return None
    if all(map(_DATE.fullmatch, filled)):
        return Form.DATE
    if not all(":" in cell for cell in filled) or not _orders(filled, None, order):
        return None
    return Form.TIME_OF_DAY if all(map(_TIME_OF_DAY.match, filled)) else Form.INSTANT


def unsaid_of_times(
    cells: FirstCells, names: Mapping[Column, str], settings: ImportSettings
) -> list[Unsaid]:
    """What is lacking to read the first times: their zone, and the order of day and month.

    Lines are of ``[import]``.
    """
    if Column.TIME not in names:
        return []
    dates = cells.get(names[Column.DATE], []) if Column.DATE in names else None
    times = cells.get(names[Column.TIME], [])
    orders = _orders(times, dates, settings.date_order)
    unsaid = []
    if orders and settings.time_zone is None and _lacks_zone(times, dates, orders[0]):
        line = 'time_zone = "..."   # such as Europe/Berlin, or UTC; --time-zone says it as well'
        unsaid.append(Unsaid(NO_ZONE, line))
    if orders and None not in orders and settings.date_order is None:
        first = next(filter(None, dates or times))
        choice = f'"{orders[0]}"' if len(orders) == 1 else '"..."'
        line = f"date_order = {choice}   # day or month: which comes first in {first}"
        unsaid.append(Unsaid(f"nothing says whether {first} begins with day or month", line))
    return unsaid


def _orders(
    times: Sequence[str], dates: Sequence[str] | None, order: DateOrder | None
) -> list[DateOrder | None]:
    """Orders of day and month by which all cells can be read: ``order``, or else those possible."""
    if order is not None or _are_readable(times, dates, None):
        tried: tuple[DateOrder | None, ...] = (order,)
    else:
        tried = ("day", "month")
    return [choice for choice in tried if _are_readable(times, dates, choice)]


def _are_readable(
    times: Sequence[str], dates: Sequence[str] | None, order: DateOrder | None
) -> bool:
    days = None if dates is None else pa.array(dates, pa.string())
    numbers = Calendar("UTC", order, "").read(pa.array(times, pa.string()), days)
    return not numbers.unreadable.any()


def _lacks_zone(times: Sequence[str], dates: Sequence[str] | None, order: DateOrder | None) -> bool:
    days = None if dates is None else pa.array(dates, pa.string())
    try:
        Calendar(None, order, "").read(pa.array(times, pa.string()), days)
    except SourceError:
        return True
    return False
