"""Inspection of a PLC, line by line; shared by all protocols."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.reconnect import Clock, LostError
from drivers.trace import Header
from twin.errors import SourceError

TIMES = 20  # requests by which the round trip is measured
WATCHED_S = 0.5  # s, for measuring the scan rate
# Fraction of the time watched. A PLC's clock is off by less than a thousandth. A task that misses
# its period, or a sequence with swapped words, is off by much more.
RATE_TOLERANCE = 0.1


@dataclass(frozen=True)
class Line:
    """The result of one inspection."""

    what: str
    text: str
    good: bool = True
    hint: str = ""  # what to do where it is not good
    lost: bool = False  # nothing came at all


def looked_at(subject: str, inspect: Callable[[], str]) -> Line:
    """The result of ``inspect``, or the error that prevented it."""
    try:
        return Line(subject, inspect())
    except SourceError as error:
        return Line(subject, str(error), False, error.hint, isinstance(error, LostError))


@dataclass(frozen=True)
class _TimedHeader:
    """A header, with the times (ns) of its request and of its arrival."""

    header: Header
    asked_ns: int
    answered_ns: int


def watched(ask: Callable[[], Header], clock: Clock) -> str:
    """Scans per second by this machine's clock; SourceError if they do not fit the period."""
    first = _timed_header(ask, clock)
    clock.sleep(WATCHED_S)
    return scan_rate(first, _timed_header(ask, clock))


def _timed_header(ask: Callable[[], Header], clock: Clock) -> _TimedHeader:
    asked_ns = clock.now_ns()
    header = ask()
    return _TimedHeader(header, asked_ns, clock.now_ns())


def scan_rate(first: _TimedHeader, last: _TimedHeader) -> str:
    """Scans per second between two headers; SourceError if they do not fit the period."""
    scans = last.header.advance(first.header)
    if not scans:
        raise SourceError(
            f"the sequence went from {first.header.sequence} to {last.header.sequence} in "
            f"{WATCHED_S} s",
            "does the PLC's program run, or did it restart just now?",
        )
    nominal = 1e9 / first.header.period_ns
    text = (
        f"{scans / (last.answered_ns - first.answered_ns) * 1e9:.1f} scans/s, nominal {nominal:.1f}"
    )
    # Requests take time: the headers lie at least and at most so many nanoseconds apart.
    shortest_ns, longest_ns = last.asked_ns - first.answered_ns, last.answered_ns - first.asked_ns
    expected_ns = scans * first.header.period_ns
    if expected_ns > longest_ns * (1.0 + RATE_TOLERANCE):
        raise SourceError(text, "does word_order fit, and is the scan period that of the task?")
    if expected_ns < shortest_ns * (1.0 - RATE_TOLERANCE):
        raise SourceError(text, "does the task keep its period, and does each scan make a record?")
    return text
