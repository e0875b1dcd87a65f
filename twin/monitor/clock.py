"""The PLC's clock against the one here: how far apart, how fast they part, and when one was set.

A sample is received later than it was taken, sometimes much later, and never earlier: the fastest
of many receipts tells the clocks' distance, but for the shortest way a sample can take. A line
through the fastest of each window tells how fast they part. Where the PLC counts its scans, a clock
that was set shows against the count, whatever the way does meanwhile.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from twin.events import Event, Kind
from twin.inference.levels import MAD_TO_SIGMA, SIGMAS_95
from twin.model.compiled import compiled
from twin.signals import NEW_TIME, SAMPLE, Samples

WINDOW_NS = 5_000_000_000  # of PLC time; the fastest receipt of each counts
KEPT = 120  # windows: ten minutes, over which the drift of a quartz is steady
EVERY = 12  # windows from one report to the next
FEWEST = 3  # windows for a report
FULL = 20  # receipts, of which one came by the shortest way: for a window that was cut off
LEAD = 64  # rows from which the scans' period is taken
SET_NS = 3_000_000  # a clock that was set by less cannot be told from the PLC's jitter
CONFIRMED = 3  # receipts that must agree that it was set
OLDEST = 0.1  # of the windows may have come since the line was drawn that says what is far off it
FARTHEST = 1000  # scans between two receipts; beyond, the period is not known that well
UNSTEADY = 2.0  # times what the middle receipt came after the fastest: the fastest may be late too
SHORTER, LONGER = 2, 12  # windows after which a way that is shorter, or longer, is a clock's doing

Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Number = TypeVar("Number", float, Floats)


@dataclass(frozen=True)
class Estimate:
    """The PLC's clock less the one here, transport included; ± half of a 95 % interval.

    A sample is received after it was taken. The shortest transport therefore makes the offset that
    much smaller than the clocks' own: only an offset above zero is surely one of the clocks.
    """

    offset_ms: float
    offset_pm_ms: float
    drift_ppm: float  # above zero the PLC's clock is the faster one
    drift_pm_ppm: float

    def __str__(self) -> str:
        return (
            f"PLC clock offset {_signed(self.offset_ms)} ± {_long(self.offset_pm_ms)}, transport"
            f" included; drift {self.drift_ppm:+.2g} ± {self.drift_pm_ppm:.2g} ppm".replace(
                "-", "−"
            )
        )


def _signed(ms: float) -> str:
    return f"{'-' if ms < 0 else '+'}{_long(abs(ms))}"


def _long(ms: float) -> str:
    return f"{ms:.2f} ms" if ms < 1e4 else f"{ms / 1e3:.1f} s"


def line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope, and value at the last ``x``, of a line of which a third of the points may be off.

    Theil and Sen's line, as SciPy has it, whose import alone would take longer than a block may.
    """
    slopes = _slopes(x, y)
    middle = [(len(slopes) - 1) // 2, len(slopes) // 2]
    slopes.partition(middle)  # of thousands only these need be in their places
    slope = float(slopes[middle].sum()) / 2
    return slope, median((y - slope * (x - x[-1])).tolist())


def slope_pm(x: Floats, y: Floats) -> float:
    """Half of the 95 % interval of the line's slope (Sen's, without ties)."""
    n, slopes = len(x), _slopes(x, y)
    reach = SIGMAS_95 * np.sqrt(n * (n - 1) * (2 * n + 5) / 18)
    low = max(round((len(slopes) - reach) / 2) - 1, 0)
    high = min(round((len(slopes) + reach) / 2), len(slopes) - 1)
    slopes.partition([low, high])
    return float(slopes[high] - slopes[low]) / 2


@compiled
def _slopes(x, y):  # type: ignore[no-untyped-def]
    """Slopes of the lines through any two points."""
    slopes, first = np.empty(len(x) * (len(x) - 1) // 2), 0
    for i in range(len(x) - 1):
        to = slopes[first : first + len(x) - 1 - i]
        for j in range(len(to)):
            to[j] = (y[i + 1 + j] - y[i]) / (x[i + 1 + j] - x[i])
        first += len(to)
    return slopes


@compiled
def _receipts(before, samples):  # type: ignore[no-untyped-def]
    """The newest row of each receipt that another one follows: PLC time, receipt and sequence.

    ``before`` is the row before these, or none. Where it was received at PLC time itself, there is
    one clock only, and nothing to tell.
    """
    found, count = np.empty((len(samples), 3), np.int64), 0
    for row in range(1 - len(before), len(samples)):
        newest = samples[row - 1] if row else before[0]
        if newest.host_ns != samples[row].host_ns and newest.host_ns != newest.time_ns:
            found[count] = newest.time_ns, newest.host_ns, newest.sequence
            count += 1
    return found[:count].copy()


@compiled
def _first_plain(receipts, last, zero_ns, window, period, far):  # type: ignore[no-untyped-def]
    """How many of the first receipts lie in a window, with no clock set by ``far`` (ns) or more.

    ``last`` is the receipt before, PLC time and sequence.
    """
    time_ns, sequence = last
    for i in range(len(receipts)):
        scans = receipts[i, 2] - sequence
        apart = receipts[i, 0] - time_ns - scans * period
        was_set = period > 0.0 and 0 < scans <= FARTHEST and abs(apart) >= far
        time_ns, sequence = receipts[i, 0], receipts[i, 2]
        if was_set or (time_ns - zero_ns) // WINDOW_NS != window:
            return i
    return len(receipts)


@dataclass
class ClockWatch:
    """Takes rows in, gives what they tell of the clocks; all of it in PLC time."""

    _receipt: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))  # its newest row
    _lead: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))
    _period: float = 0.0  # ns a scan; 0 until it is known
    _zero: tuple[int, int] | None = None  # PLC time, and host less PLC time, counted from here
    _last: tuple[int, int] = (0, 0)  # PLC time and sequence of the receipt before
    _apart: float = 0.0  # ns, PLC time from where the count of the scans says it is
    _aside: list[float] = field(default_factory=list)  # the same of receipts where that is far
    _window: int = 0
    _fastest: tuple[int, int] | None = None  # of the window: time and way, ns
    _ways: list[int] = field(default_factory=list)  # of the window's receipts, ns
    # Of the windows before: their fastest, and how long after it their middle receipt came, ns.
    _points: Floats = field(default_factory=lambda: np.empty((3, 0)))
    _since: int = 0  # windows since the last report
    _off: int = 0  # windows in a row that are off the line, below zero where they are too early
    _line: tuple[float, float, float] = (0.0, 0.0, 0.0)  # its slope, value and time (ns) at its end
    _undrawn: int = 0  # windows since it was drawn

    def __post_init__(self) -> None:
        """Have what is compiled at hand, not to fall into a block."""
        _slopes(np.zeros(2), np.zeros(2))
        row = np.zeros(1, SAMPLE)
        _first_plain(_receipts(row, row), self._last, 0, 0, 0.0, 0.0)

    def push(self, samples: Samples) -> list[Event]:
        """Take rows without a break, but maybe before the first one."""
        if not len(samples):
            return []
        events = []
        if samples["quality"][0] & NEW_TIME:
            events += self.close()
            self._begin()
        receipts = _receipts(self._receipt, samples)
        self._receipt = samples[-1:].copy()
        self._learn(samples)
        while len(receipts):
            if plain := self._plain(receipts):
                self._take_plain(receipts[:plain])
            else:
                events += self._take(*receipts[0].tolist())
            receipts = receipts[max(plain, 1) :]
        return events

    def close(self) -> list[Event]:
        """Give what the rows since the last report tell, if it is enough."""
        if not len(self._receipt):
            return []
        if len(self._ways) >= FULL:
            self._finish_window()
        return list(self._report(int(self._receipt["time_ns"][0])))

    def _begin(self) -> None:
        fresh = ClockWatch()
        self.__dict__.update(fresh.__dict__)

    def _learn(self, samples: Samples) -> None:
        """The period of the scans, from the first rows, however they are cut into blocks."""
        if self._period:
            return
        self._lead = np.concatenate([self._lead, samples[: LEAD - len(self._lead)]])
        if len(self._lead) == LEAD:
            scans = np.maximum(np.diff(self._lead["sequence"]), 1)
            us = np.median(np.diff(self._lead["time_ns"]) / scans) / 1e3
            self._period = max(float(np.rint(us)), 1.0) * 1e3

    def _plain(self, receipts: Integers) -> int:
        """How many of the first receipts only say how fast they were: nearly always all.

        In the window under way, and no clock was set, as ``_was_set`` would find one by one.
        """
        if self._zero is None or self._apart or self._aside:
            return 0
        zero_ns, period = self._zero[0], self._period
        plain = _first_plain(receipts, self._last, zero_ns, self._window, period, self._far)
        return int(plain)

    def _take_plain(self, receipts: Integers) -> None:
        """The same as ``_take`` of each, where it is only how fast they were."""
        assert self._zero is not None
        time_ns, host_ns, sequence = receipts.T
        since = time_ns - self._zero[0]
        ways = host_ns - sum(self._zero) - since
        first = int(np.argmin(ways))
        if self._fastest is None or ways[first] < self._fastest[1]:
            self._fastest = int(since[first]), int(ways[first])
        self._ways += ways.tolist()
        self._last = int(time_ns[-1]), int(sequence[-1])

    def _take(self, time_ns: int, host_ns: int, sequence: int) -> Iterator[Event]:
        way = host_ns - time_ns
        if self._zero is None:
            self._zero = time_ns, way
        elif (moved := self._was_set(time_ns, sequence)) is not None:
            yield from self._moved(time_ns, moved, "PLC time was set by {:+.1f} ms")
            self._zero = time_ns, way
        self._last = time_ns, sequence
        at = time_ns - self._zero[0], way - self._zero[1]
        if at[0] // WINDOW_NS != self._window:
            yield from self._next_window(time_ns)
            if self._zero is None:  # it begins anew
                self._zero, at = (time_ns, way), (0, 0)
            self._window = at[0] // WINDOW_NS
        self._ways.append(at[1])
        if self._fastest is None or at[1] < self._fastest[1]:
            self._fastest = at

    # --- a clock that was set -------------------------------------------------------------------

    @property
    def _far(self) -> float:
        """From how much (ns) on PLC time may have been set."""
        return max(float(SET_NS), 2.0 * self._period)

    def _was_set(self, time_ns: int, sequence: int) -> float | None:
        """By how much (ns) PLC time moved against the count some receipts ago, if it stayed so."""
        scans = sequence - self._last[1]
        if not self._period or not 0 < scans <= FARTHEST:
            self._apart = 0.0
            self._aside.clear()
            return None
        self._apart += time_ns - self._last[0] - scans * self._period
        if abs(self._apart) < self._far:
            self._apart = 0.0  # the count's own clock may run a little differently
            self._aside.clear()
            return None
        self._aside.append(self._apart)
        if len(self._aside) <= CONFIRMED:
            return None
        least, most = min(self._aside), max(self._aside)
        return median(self._aside) if least * most > 0 else None

    def _moved(self, time_ns: int, by_ns: float, text: str) -> Iterator[Event]:
        """A clock was set: what was known is told, and the estimate begins anew."""
        self._fastest, self._ways = None, []  # before it was set, or after: who knows
        yield from self._report(time_ns)
        data = {"jump_s": by_ns * 1e-9}
        yield Event(time_ns, Kind.CLOCK_JUMPED, text.format(by_ns * 1e-6), data)
        receipt, period = self._receipt, self._period
        self._begin()
        self._receipt, self._period = receipt, period

    # --- the fastest of each window -------------------------------------------------------------

    def _next_window(self, time_ns: int) -> Iterator[Event]:
        off = self._finish_window()
        if -self._off >= SHORTER or self._off >= LONGER:
            text = "the clocks were moved by {:+.1f} ms against each other"
            text += ", or the samples' way is longer now" if self._off > 0 else ""
            yield from self._moved(time_ns, -off, text)
        elif self._since >= EVERY:
            yield from self._report(time_ns)

    def _finish_window(self) -> float:
        """Take the window's fastest; how far it is off the line (ns), where that is far."""
        if self._fastest is None:
            return 0.0
        off = self._beyond(self._fastest)
        self._off = 0 if not off else int(np.sign(off)) + (self._off if off * self._off > 0 else 0)
        late = median(self._ways) - self._fastest[1]
        self._points = np.column_stack([self._points[:, -KEPT + 1 :], [*self._fastest, late]])
        self._since, self._undrawn = self._since + 1, self._undrawn + 1
        self._fastest, self._ways = None, []
        return off

    def _beyond(self, point: tuple[int, int]) -> float:
        """How far (ns) a window's fastest is off the line of those before, where that is far."""
        x, y, late = self._sure
        if len(x) < FEWEST:
            return 0.0
        if self._undrawn > OLDEST * len(x):
            self._draw()
        if abs(self._off_line(*point)) <= SET_NS:  # nearly always
            return 0.0
        self._draw()
        off = self._off_line(*point)
        scatter = MAD_TO_SIGMA * median(np.abs(self._off_line(x, y)).tolist())
        unsteady = UNSTEADY * median(late.tolist())
        return off if abs(off) > max(float(SET_NS), 8.0 * scatter, unsteady) else 0.0

    def _draw(self) -> None:
        x, y, _ = self._sure
        self._line, self._undrawn = (*line(x, y), float(x[-1])), 0

    def _off_line(self, x: Number, y: Number) -> Number:
        slope, at_end, end = self._line
        return y - at_end - slope * (x - end)

    def _report(self, time_ns: int) -> Iterator[Event]:
        if self._sure.shape[1] < FEWEST or not self._since or self._zero is None:
            return
        self._since = 0
        estimate = self._estimate(time_ns - self._zero[0], self._zero[1])
        data = {name: float(f"{value:.6g}") for name, value in vars(estimate).items()}
        data["offset_ms"] = round(float(estimate.offset_ms), 3)
        yield Event(time_ns, Kind.CLOCK, str(estimate), data)

    def _estimate(self, now: int, zero: int) -> Estimate:
        """At ``now``, which the line is drawn out to."""
        x, y, _ = self._sure
        self._draw()
        slope, at_end, _ = self._line
        drift_pm = slope_pm(x, y)
        scatter = MAD_TO_SIGMA * median(np.abs(self._off_line(x, y)).tolist())
        offset_pm = SIGMAS_95 * scatter + drift_pm * float(x[-1] - x[0]) / 2
        here = at_end + slope * (now - x[-1])
        return Estimate(-(zero + here) * 1e-6, offset_pm * 1e-6, -slope * 1e6, drift_pm * 1e6)

    @property
    def _sure(self) -> Floats:
        """Windows without the last ones, if these are off the line: it may be another one."""
        return self._points[:, : self._points.shape[1] - abs(self._off)]
