"""Instants for people: clock time and age, in the same words on terminal, page, report and log.

Clock times are in this computer's time zone.
"""

import time

from twin.languages.texts import ntr, tr

SECOND_NS = 1_000_000_000
DAY_NS = 86_400 * SECOND_NS
DATE, TIME = "%Y-%m-%d", "%H:%M:%S"  # a catalogue has the date of its language
CALENDAR_NS = 946_684_800 * SECOND_NS  # year 2000: an earlier clock was never set


def instant(ns: int, now_ns: int) -> str:
    """An instant (UTC, ns) with its age: "14:02:31, 8 min ago"."""
    return f"{clock(ns, now_ns)}, {age(ns, now_ns)}"


def clock(ns: int, now_ns: int) -> str:
    """Clock time to the second; with the date unless it is today."""
    instant_time, now_time = time.localtime(ns // SECOND_NS), time.localtime(now_ns // SECOND_NS)
    is_today = instant_time[:3] == now_time[:3]
    return time.strftime(TIME if is_today else f"{tr(DATE)} {TIME}", instant_time)


def dated(ns: int) -> str:
    """Clock time with the date, for stored texts."""
    return time.strftime(f"{tr(DATE)} {TIME}", time.localtime(ns // SECOND_NS))


def age(ns: int, now_ns: int) -> str:
    """How long ago an instant was, or how soon it comes."""
    seconds = (now_ns - ns) / SECOND_NS
    if seconds >= 0.0:
        return tr("{time} ago", time=lasting(seconds))
    return tr("in {time}", time=lasting(-seconds))


def lasting(seconds: float) -> str:
    """A duration in a unit that is precise enough."""
    if seconds < 119.5:
        return f"{seconds:.0f} s"
    if seconds < 7170.0:
        return f"{seconds / 60:.0f} min"
    if seconds < 171_000.0:
        return f"{seconds / 3600:.0f} h"
    return ntr("{count} day", "{count} days", round(seconds / 86_400))


def zone(ns: int) -> int:
    """The offset (s) of this computer's zone from UTC at an instant."""
    return time.localtime(ns // SECOND_NS).tm_gmtoff


def stamp(ns: int) -> str:
    """The time of day to the millisecond, as the beginning of a line about an event."""
    clock_time = time.strftime("%H:%M:%S", time.localtime(ns // SECOND_NS))
    return f"{clock_time}.{ns // 1_000_000 % 1000:03d}"
