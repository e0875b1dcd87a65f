"""Columns that a file's header may mean, by words of the field and the form of their cells.

Words are English and German.
"""

import re
from collections.abc import Collection, Mapping, Sequence

from twin.tables.first_cells import Form
from twin.tables.settings import Column

_TIME_UNITS = {
    "s": Column.TIME_S,
    "ms": Column.TIME_MS,
    "us": Column.TIME_US,
    "µs": Column.TIME_US,
    "ns": Column.TIME_NS,
}
_TIME_UNIT = re.compile(r"[\[(]\s*(s|ms|us|µs|ns)\s*[\])]\s*$")
_TIME = re.compile(r"time|zeit", re.IGNORECASE)
_INSTANT = re.compile(r"timestamp|zeitstempel|date|datum|uhrzeit", re.IGNORECASE)
_DATE = re.compile(r"\s*(date|datum)\s*", re.IGNORECASE)
_TIME_OF_DAY = re.compile(r"\s*(time|zeit|uhrzeit|time of day)\s*", re.IGNORECASE)
_WORDS = {  # in order: a word of suction may stand in the name of a vacuum's block
    Column.BLOW_OFF: re.compile(r"blow|abblas|ausblas|abwurf|abwerf", re.IGNORECASE),
    Column.VACUUM: re.compile(r"vacuum|vakuum|unterdruck", re.IGNORECASE),
    Column.SUCTION: re.compile(r"suction|suck|saug", re.IGNORECASE),
    Column.PRESSURE: re.compile(r"press|druck", re.IGNORECASE),
}
_NONE: Mapping[str, Form | None] = {}


def likely_columns(
    header: Sequence[str], taken: Collection[str] = (), forms: Mapping[str, Form | None] = _NONE
) -> Mapping[Column, str]:
    """For each known column the first name of the header that may mean it; ``taken`` are none.

    Only one of vacuum and pressure is given, and no time whose unit the name does not have, unless
    the ``forms`` of the cells show that it is a date and time.
    """
    free = [name for name in header if name and name not in taken]
    likely: dict[Column, str] = dict(_by_form(free, forms) or _date_and_time(free))
    for name in free:
        column = None if name in likely.values() else _likely(name)
        if column is not None:
            likely.setdefault(column, name)
    if Column.VACUUM in likely:
        likely.pop(Column.PRESSURE, None)
    times = [column for column in (*_TIME_UNITS.values(), Column.TIME) if column in likely]
    for column in dict.fromkeys(times[1:]):
        if column != times[0]:
            likely.pop(column, None)
    if Column.TIME not in likely:
        likely.pop(Column.DATE, None)
    return likely


def _by_form(names: Sequence[str], forms: Mapping[str, Form | None]) -> Mapping[Column, str]:
    """The column of date and time, or of the time of day, with that of the date beside it."""
    in_order = sorted(names, key=lambda name: not (_TIME.search(name) or _INSTANT.search(name)))
    first = {form: name for name in reversed(in_order) if (form := forms.get(name)) is not None}
    if Form.INSTANT in first:
        return {Column.TIME: first[Form.INSTANT]}
    if Form.TIME_OF_DAY not in first:
        return {}
    date = {Column.DATE: first[Form.DATE]} if Form.DATE in first else {}
    return {**date, Column.TIME: first[Form.TIME_OF_DAY]}


def _date_and_time(names: Sequence[str]) -> Mapping[Column, str]:
    """The two columns of a date and a time of day; nothing if one is lacking."""
    date = next((name for name in names if _DATE.fullmatch(name)), None)
    time = next((name for name in names if _TIME_OF_DAY.fullmatch(name)), None)
    if date is None or time is None:
        return {}
    return {Column.DATE: date, Column.TIME: time}


def _likely(name: str) -> Column | None:
    unit = _TIME_UNIT.search(name)
    if _TIME.search(name) and unit is not None:
        return _TIME_UNITS[unit[1]]
    if _INSTANT.search(name):
        return Column.TIME
    return next((column for column, words in _WORDS.items() if words.search(name)), None)
