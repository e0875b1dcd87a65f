"""Instants as people read them: clock time and age, worded once for terminal, page, report and log.

Clock times are those of this computer's zone: what hangs on the wall beside it.
"""

import time

from twin.language import tr

SECOND_NS = 1_000_000_000
CALENDAR_NS = 946_684_800 * SECOND_NS  # year 2000: a clock that reads less was never set


def instant(ns: int, now_ns: int) -> str:
    """An instant (UTC, ns) with its age: "14:02:31, 8 min ago"."""
    return f"{clock(ns, now_ns)}, {age(ns, now_ns)}"


def clock(ns: int, now_ns: int) -> str:
    """Its clock time to the second; with the date where that is another day than today's."""
    there, here = time.localtime(ns // SECOND_NS), time.localtime(now_ns // SECOND_NS)
    return time.strftime("%H:%M:%S" if there[:3] == here[:3] else "%Y-%m-%d %H:%M:%S", there)


def dated(ns: int) -> str:
    """Its clock time with the date, for what is kept."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(ns // SECOND_NS))


def age(ns: int, now_ns: int) -> str:
    """How long ago it was, or how soon it comes."""
    seconds = (now_ns - ns) / SECOND_NS
    if seconds >= 0.0:
        return tr("{time} ago", time=lasting(seconds))
    return tr("in {time}", time=lasting(-seconds))


def lasting(seconds: float) -> str:
    """A time in the largest unit that tells it well enough."""
    if seconds < 119.5:
        return f"{seconds:.0f} s"
    if seconds < 7170.0:
        return f"{seconds / 60:.0f} min"
    if seconds < 171_000.0:
        return f"{seconds / 3600:.0f} h"
    return tr("{count} days", count=f"{seconds / 86_400:.0f}")


def zone(ns: int) -> int:
    """Seconds that this computer's zone is ahead of UTC then."""
    return time.localtime(ns // SECOND_NS).tm_gmtoff


def stamp(ns: int) -> str:
    """The time of day to the millisecond, before a line that says what happened then."""
    there = time.strftime("%H:%M:%S", time.localtime(ns // SECOND_NS))
    return f"{there}.{ns // 1_000_000 % 1000:03d}"
