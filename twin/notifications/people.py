"""People who are told of alarms: their addresses, and when they are on duty."""

import re
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from email.errors import MessageError
from email.headerregistry import Address as HeaderAddress
from typing import Annotated, Literal
from zoneinfo import ZoneInfo

from pydantic import AfterValidator, Field

from twin.alarms.rules import Priority
from twin.notifications.message import EPOCH
from twin.settings import Settings

Weekday = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
WEEKDAYS: tuple[Weekday, ...] = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
ALWAYS = "00:00-24:00"
_ORDER = tuple(Priority)  # the least urgent first
_ADDRESS = re.compile(r"[A-Za-z0-9.!#$%&'*+/=?^_`{|}~-]{1,64}@[A-Za-z0-9]([A-Za-z0-9.-]{0,250})")
_HOURS = re.compile(r"(\d\d):([0-5]\d)-(\d\d):([0-5]\d)")
DAY_MIN = 24 * 60


def _checked_address(text: str) -> str:
    """The address; ValueError if it could be anything else in a header or a command."""
    if _ADDRESS.fullmatch(text):
        with suppress(ValueError, IndexError, MessageError):  # as the header's parser has them
            HeaderAddress(addr_spec=text)
            return text
    raise ValueError("no e-mail address: it has the form NAME@HOST, in plain letters")


def _checked_name(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has a line break, or a character that cannot be seen")
    return text


def _checked_hours(text: str) -> str:
    if _minutes(text) is None:
        raise ValueError(
            'must be two times of the day such as "06:00-14:00", or "22:00-06:00" over midnight'
        )
    return text


def _checked_zone(text: str) -> str:
    try:
        _zone(text)
    except (ValueError, OSError, KeyError) as error:  # as zoneinfo has them for odd names
        raise ValueError(
            f'"{text}" is not known here: write one such as "Europe/Berlin"; if it is right,'
            " install the package tzdata"
        ) from error
    return text


Address = Annotated[str, AfterValidator(_checked_address)]
Name = Annotated[str, AfterValidator(_checked_name)]
Hours = Annotated[str, AfterValidator(_checked_hours)]
Zone = Annotated[str, AfterValidator(_checked_zone)]


class Person(Settings):
    """Somebody who is told of alarms while on duty; people of one ``step`` are a group."""

    name: Name = Field(min_length=1, max_length=100)  # as the mail addresses the person
    address: Address  # e-mail address, NAME@HOST
    weekdays: tuple[Weekday, ...] = Field(default=WEEKDAYS, min_length=1)  # days on duty
    # hours on duty; "22:00-06:00" ends on the day after
    hours: Hours = ALWAYS
    time_zone: Zone = ""  # zone of the hours, such as "Europe/Berlin"; empty: this machine's
    from_priority: Priority = Priority.LOW  # less urgent alarms are not told
    step: int = Field(default=1, ge=1, le=20)  # 1 is told at once, each next one by escalation

    def is_told_of(self, priority: str) -> bool:
        """Whether alarms of this priority concern the person."""
        return _ORDER.index(Priority(priority)) >= _ORDER.index(self.from_priority)

    def is_on_duty(self, now_ns: int) -> bool:
        """Whether the person is on duty at a time; hours over midnight count from their day on."""
        limits = _minutes(self.hours)
        assert limits is not None
        begin, end = limits
        now = local_time(now_ns, self.time_zone)
        minute, today = 60 * now.hour + now.minute, WEEKDAYS[now.weekday()]
        if begin < end:
            return today in self.weekdays and begin <= minute < end
        yesterday = WEEKDAYS[now.weekday() - 1]
        is_evening = today in self.weekdays and minute >= begin
        return is_evening or (yesterday in self.weekdays and minute < end)


def local_time(ns: int, time_zone: str) -> datetime:
    """An instant (UTC, ns) in a time zone; an empty one is this machine's."""
    instant = (EPOCH + timedelta(microseconds=ns // 1000)).replace(tzinfo=UTC)
    return instant.astimezone(_zone(time_zone))


def _zone(name: str) -> ZoneInfo | None:
    return ZoneInfo(name) if name else None


def _minutes(hours: str) -> tuple[int, int] | None:
    """Begin and end of hours in minutes of the day; None if they are no hours."""
    match = _HOURS.fullmatch(hours)
    if match is None:
        return None
    hour, minute, last_hour, last_minute = map(int, match.groups())
    begin, end = 60 * hour + minute, 60 * last_hour + last_minute
    return (begin, end) if begin < DAY_MIN and end <= DAY_MIN and begin != end else None
