"""What a PLC shows of itself, line by line, whatever it speaks."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.reconnect import Clock, LostError
from drivers.trace import Header
from twin.errors import SourceError

TIMES = 20  # requests to measure the round trip with
WATCHED_S = 0.5  # to measure the scan rate
# Of the time watched: a clock in a PLC is off by less than a thousandth, a task that misses its
# period or a sequence with its words swapped by much more.
RATE_TOLERANCE = 0.1


@dataclass(frozen=True)
class Line:
    """One thing that was looked at."""

    what: str
    text: str
    good: bool = True
    hint: str = ""  # what to do where it is not good
    lost: bool = False  # nothing came at all


def looked_at(what: str, look: Callable[[], str]) -> Line:
    """What ``look`` says, or why it could not."""
    try:
        return Line(what, look())
    except SourceError as error:
        return Line(what, str(error), False, error.hint, isinstance(error, LostError))


@dataclass(frozen=True)
class _Seen:
    """A header, and between when and when (ns) the PLC sent it."""

    header: Header
    asked: int
    answered: int


def watched(ask: Callable[[], Header], clock: Clock) -> str:
    """Scans per second by the clock here; SourceError if they are not those of the period."""
    first = _seen(ask, clock)
    clock.sleep(WATCHED_S)
    return scan_rate(first, _seen(ask, clock))


def _seen(ask: Callable[[], Header], clock: Clock) -> _Seen:
    asked = clock.now_ns()
    header = ask()
    return _Seen(header, asked, clock.now_ns())


def scan_rate(first: _Seen, last: _Seen) -> str:
    """Scans per second between two headers; SourceError if they are not those of the period."""
    scans = last.header.advance(first.header)
    if not scans:
        raise SourceError(
            f"the sequence went from {first.header.sequence} to {last.header.sequence} in "
            f"{WATCHED_S} s",
            "does the PLC's program run, or did it restart just now?",
        )
    nominal = 1e9 / first.header.period_ns
    text = f"{scans / (last.answered - first.answered) * 1e9:.1f} scans/s, nominal {nominal:.1f}"
    # The requests took their time: at least and at most so many nanoseconds lie between the two.
    shortest, longest = last.asked - first.answered, last.answered - first.asked
    due = scans * first.header.period_ns
    if due > longest * (1.0 + RATE_TOLERANCE):
        raise SourceError(text, "does word_order fit, and is the scan period that of the task?")
    if due < shortest * (1.0 - RATE_TOLERANCE):
        raise SourceError(text, "does the task keep its period, and does each scan make a record?")
    return text
