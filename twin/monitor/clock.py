"""The PLC's clock against the host's: offset, drift, and steps when one of them was set.

A sample is received later than it was taken, sometimes much later, and never earlier. So the
fastest of many receipts gives the offset, apart from the shortest transport. A line through the
fastest receipt of each window gives the drift. If the PLC counts its scans, a step of its clock
shows against the count, whatever the transport does.
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
from twin.quality import NEW_TIME
from twin.signals import SAMPLE, LastRow, Samples

WINDOW_NS = 5_000_000_000  # of PLC time; the fastest receipt of each counts
KEPT = 120  # windows: ten minutes, over which the drift of a quartz is steady
EVERY = 12  # windows from one report to the next
FEWEST = 3  # windows for a report
FULL = 20  # receipts that a window needs if it was cut off: one has the shortest transport
LEAD = 64  # rows from which the scans' period is taken
SET_NS = 3_000_000  # a smaller step of a clock cannot be told from the PLC's jitter
CONFIRMED = 3  # receipts that must agree on a step
OLDEST = 0.1  # the line is fitted anew after this share of its windows, before it judges outliers
FARTHEST = 1000  # scans between two receipts; beyond, the period is not precise enough
UNSTEADY = 2.0  # limit of an offset over the median delay behind the fastest: that may be late too
SHORTER, LONGER = 2, 12  # windows after which a shorter, or longer, transport counts as a step

Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Number = TypeVar("Number", float, Floats)


@dataclass(frozen=True)
class Estimate:
    """The PLC's clock less the host's, transport included; ± half of a 95 % interval.

    A sample is received after it was taken. So the shortest transport reduces the offset of the
    clocks: only an offset above zero is certainly one of the clocks.
    """

    offset_ms: float
    offset_pm_ms: float
    drift_ppm: float  # above zero: the PLC's clock is faster
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
    """Slope, and value at the last ``x``, of a robust line: a third of the points may be outliers.

    The line of Theil and Sen as in SciPy, whose import would take longer than a block may.
    """
    slopes = _slopes(x, y)
    middles = [(len(slopes) - 1) // 2, len(slopes) // 2]
    slopes.partition(middles)  # only these of thousands need to be in order
    slope = float(slopes[middles].sum()) / 2
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
def _slopes(x: Floats, y: Floats) -> Floats:
    """Slopes of the lines through all pairs of points."""
    slopes, first = np.empty(len(x) * (len(x) - 1) // 2), 0
    for i in range(len(x) - 1):
        to = slopes[first : first + len(x) - 1 - i]
        for j in range(len(to)):
            to[j] = (y[i + 1 + j] - y[i]) / (x[i + 1 + j] - x[i])
        first += len(to)
    return slopes


@compiled
def _receipts(before: Samples, samples: Samples) -> Integers:
    """The newest row of each receipt that another follows: PLC time, host time and sequence.

    ``before`` is the row before these, or empty. Rows whose host time is their PLC time are left
    out: there is only one clock.
    """
    receipts, count = np.empty((len(samples), 3), np.int64), 0
    for row in range(1 - len(before), len(samples)):
        newest = samples[row - 1] if row else before[0]
        if newest.host_ns != samples[row].host_ns and newest.host_ns != newest.time_ns:
            receipts[count] = newest.time_ns, newest.host_ns, newest.sequence
            count += 1
    return receipts[:count].copy()


@compiled
def _first_plain(
    receipts: Integers, last: tuple[int, int], zero_ns: int, window: int, period: float, far: float
) -> int:
    """Number of the first receipts that lie in a window and have no step of ``far`` (ns) or more.

    ``last`` is the receipt before: PLC time and sequence.
    """
    time_ns, sequence = last
    for i in range(len(receipts)):
        scans = receipts[i, 2] - sequence
        clock_step = receipts[i, 0] - time_ns - scans * period
        was_set = period > 0.0 and 0 < scans <= FARTHEST and abs(clock_step) >= far
        time_ns, sequence = receipts[i, 0], receipts[i, 2]
        if was_set or (time_ns - zero_ns) // WINDOW_NS != window:
            return i
    return len(receipts)


@dataclass
class _Estimate:
    """What is known of the clocks since PLC time began or was set."""

    zero: tuple[int, int] | None = None  # origin of PLC time, and of host less PLC time
    last: tuple[int, int] = (0, 0)  # PLC time and sequence of the receipt before
    clock_step: float = 0.0  # ns, PLC time less that by the count of the scans
    suspected_steps: list[float] = field(default_factory=list)  # large steps of the last receipts
    window: int = 0
    fastest: tuple[int, int] | None = None  # receipt of the window: time and transport, ns
    transports: list[int] = field(default_factory=list)  # transports of the window's receipts, ns
    # Windows before: time and transport of the fastest, and the median delay behind it, ns.
    points: Floats = field(default_factory=lambda: np.empty((3, 0)))
    since: int = 0  # windows since the last report
    off_windows: int = 0  # windows in a row off the line; below zero if they are early
    line: tuple[float, float, float] = (0.0, 0.0, 0.0)  # slope, value and time (ns) at its end
    windows_since_fit: int = 0  # windows since the line was fitted


@dataclass
class ClockWatch:
    """Turns rows into events of the clocks; all in PLC time."""

    _last: LastRow = field(default_factory=LastRow)
    _lead: Samples = field(default_factory=lambda: np.empty(0, SAMPLE))
    _period: float = 0.0  # ns a scan; 0 until it is known
    _now: _Estimate = field(default_factory=_Estimate)

    def __post_init__(self) -> None:
        """Compile now, so that no block has to wait for it."""
        _slopes(np.zeros(2), np.zeros(2))
        row = np.zeros(1, SAMPLE)
        _first_plain(_receipts(row, row), self._now.last, 0, 0, 0.0, 0.0)

    def push(self, samples: Samples) -> list[Event]:
        """Take rows; only the first may have a break before it."""
        if not len(samples):
            return []
        events = []
        if samples["quality"][0] & NEW_TIME:
            events += self.close()
            self._last, self._period = LastRow(), 0.0
            self._begin()
        receipts = _receipts(self._last.keep(samples), samples)
        self._learn_period(samples)
        while len(receipts):
            if plain := self._plain_count(receipts):
                self._take_plain(receipts[:plain])
            else:
                events += self._take(*receipts[0].tolist())
            receipts = receipts[max(plain, 1) :]
        return events

    def close(self) -> list[Event]:
        """Report the rows since the last report, if they suffice."""
        if not len(self._last.row):
            return []
        if len(self._now.transports) >= FULL:
            self._close_window()
        return list(self._report(int(self._last.row["time_ns"][0])))

    def _begin(self) -> None:
        """Begin the estimate anew."""
        self._lead, self._now = np.empty(0, SAMPLE), _Estimate()

    def _learn_period(self, samples: Samples) -> None:
        """Learn the period of the scans from the first LEAD rows."""
        if self._period:
            return
        self._lead = np.concatenate([self._lead, samples[: LEAD - len(self._lead)]])
        if len(self._lead) == LEAD:
            scans = np.maximum(np.diff(self._lead["sequence"]), 1)
            us = np.median(np.diff(self._lead["time_ns"]) / scans) / 1e3
            self._period = max(float(np.rint(us)), 1.0) * 1e3

    def _plain_count(self, receipts: Integers) -> int:
        """Number of the first receipts that only add a transport: nearly always all.

        They lie in the current window, and ``_was_set`` would find no step in any of them.
        """
        if self._now.zero is None or self._now.clock_step or self._now.suspected_steps:
            return 0
        zero_ns, period = self._now.zero[0], self._period
        plain = _first_plain(
            receipts, self._now.last, zero_ns, self._now.window, period, self._least_step
        )
        return int(plain)

    def _take_plain(self, receipts: Integers) -> None:
        """Take receipts that only add a transport; equivalent to ``_take`` of each."""
        assert self._now.zero is not None
        time_ns, host_ns, sequence = receipts.T
        since = time_ns - self._now.zero[0]
        transports = host_ns - sum(self._now.zero) - since
        first = int(np.argmin(transports))
        if self._now.fastest is None or transports[first] < self._now.fastest[1]:
            self._now.fastest = int(since[first]), int(transports[first])
        self._now.transports += transports.tolist()
        self._now.last = int(time_ns[-1]), int(sequence[-1])

    def _take(self, time_ns: int, host_ns: int, sequence: int) -> Iterator[Event]:
        transport = host_ns - time_ns
        if self._now.zero is None:
            self._now.zero = time_ns, transport
        elif (moved := self._was_set(time_ns, sequence)) is not None:
            yield from self._report_step(time_ns, moved, "PLC time was set by {:+.1f} ms")
            self._now.zero = time_ns, transport
        self._now.last = time_ns, sequence
        point = time_ns - self._now.zero[0], transport - self._now.zero[1]
        if point[0] // WINDOW_NS != self._now.window:
            yield from self._next_window(time_ns)
            if self._now.zero is None:  # it begins anew
                self._now.zero, point = (time_ns, transport), (0, 0)
            self._now.window = point[0] // WINDOW_NS
        self._now.transports.append(point[1])
        if self._now.fastest is None or point[1] < self._now.fastest[1]:
            self._now.fastest = point

    # --- a clock that was set -------------------------------------------------------------------

    @property
    def _least_step(self) -> float:
        """Least step (ns) of PLC time that counts."""
        return max(float(SET_NS), 2.0 * self._period)

    def _was_set(self, time_ns: int, sequence: int) -> float | None:
        """Step (ns) of PLC time against the count some receipts ago, if it lasted."""
        scans = sequence - self._now.last[1]
        if not self._period or not 0 < scans <= FARTHEST:
            self._now.clock_step = 0.0
            self._now.suspected_steps.clear()
            return None
        self._now.clock_step += time_ns - self._now.last[0] - scans * self._period
        if abs(self._now.clock_step) < self._least_step:
            self._now.clock_step = 0.0  # the count's own clock may run a little differently
            self._now.suspected_steps.clear()
            return None
        self._now.suspected_steps.append(self._now.clock_step)
        if len(self._now.suspected_steps) <= CONFIRMED:
            return None
        least, most = min(self._now.suspected_steps), max(self._now.suspected_steps)
        return median(self._now.suspected_steps) if least * most > 0 else None

    def _report_step(self, time_ns: int, by_ns: float, text: str) -> Iterator[Event]:
        """Report the estimate so far and the step, and begin the estimate anew."""
        self._now.fastest, self._now.transports = (
            None,
            [],
        )  # these may be from before the step or after it
        yield from self._report(time_ns)
        data = {"jump_s": by_ns * 1e-9}
        yield Event(time_ns, Kind.CLOCK_JUMPED, text.format(by_ns * 1e-6), data)
        self._begin()

    # --- the fastest of each window -------------------------------------------------------------

    def _next_window(self, time_ns: int) -> Iterator[Event]:
        off = self._close_window()
        if -self._now.off_windows >= SHORTER or self._now.off_windows >= LONGER:
            text = "the clocks were moved by {:+.1f} ms against each other"
            text += ", or the samples' way is longer now" if self._now.off_windows > 0 else ""
            yield from self._report_step(time_ns, -off, text)
        elif self._now.since >= EVERY:
            yield from self._report(time_ns)

    def _close_window(self) -> float:
        """Close the window; its offset (ns) from the line if it is an outlier, else 0."""
        if self._now.fastest is None:
            return 0.0
        off = self._outlier_offset(self._now.fastest)
        self._now.off_windows = (
            0
            if not off
            else int(np.sign(off))
            + (self._now.off_windows if off * self._now.off_windows > 0 else 0)
        )
        late = median(self._now.transports) - self._now.fastest[1]
        self._now.points = np.column_stack(
            [self._now.points[:, -KEPT + 1 :], [*self._now.fastest, late]]
        )
        self._now.since, self._now.windows_since_fit = (
            self._now.since + 1,
            self._now.windows_since_fit + 1,
        )
        self._now.fastest, self._now.transports = None, []
        return off

    def _outlier_offset(self, point: tuple[int, int]) -> float:
        """Offset (ns) of a window's fastest from the line of those before if large, else 0."""
        x, y, late = self._settled_points
        if len(x) < FEWEST:
            return 0.0
        if self._now.windows_since_fit > OLDEST * len(x):
            self._fit_line()
        if abs(self._off_line(*point)) <= SET_NS:  # nearly always
            return 0.0
        self._fit_line()
        off = self._off_line(*point)
        scatter = MAD_TO_SIGMA * median(np.abs(self._off_line(x, y)).tolist())
        unsteady = UNSTEADY * median(late.tolist())
        return off if abs(off) > max(float(SET_NS), 8.0 * scatter, unsteady) else 0.0

    def _fit_line(self) -> None:
        x, y, _ = self._settled_points
        self._now.line, self._now.windows_since_fit = (*line(x, y), float(x[-1])), 0

    def _off_line(self, x: Number, y: Number) -> Number:
        slope, at_end, end = self._now.line
        return y - at_end - slope * (x - end)

    def _report(self, time_ns: int) -> Iterator[Event]:
        if self._settled_points.shape[1] < FEWEST or not self._now.since or self._now.zero is None:
            return
        self._now.since = 0
        estimate = self._estimate(time_ns - self._now.zero[0], self._now.zero[1])
        data = {name: float(f"{value:.6g}") for name, value in vars(estimate).items()}
        data["offset_ms"] = round(float(estimate.offset_ms), 3)
        yield Event(time_ns, Kind.CLOCK, str(estimate), data)

    def _estimate(self, now: int, zero: int) -> Estimate:
        """The estimate, with the line extrapolated to ``now``."""
        x, y, _ = self._settled_points
        self._fit_line()
        slope, at_end, _ = self._now.line
        drift_pm = slope_pm(x, y)
        scatter = MAD_TO_SIGMA * median(np.abs(self._off_line(x, y)).tolist())
        offset_pm = SIGMAS_95 * scatter + drift_pm * float(x[-1] - x[0]) / 2
        offset_ns = at_end + slope * (now - x[-1])
        return Estimate(-(zero + offset_ns) * 1e-6, offset_pm * 1e-6, -slope * 1e6, drift_pm * 1e6)

    @property
    def _settled_points(self) -> Floats:
        """Windows without the last ones that are off the line: a new line may begin there."""
        return self._now.points[:, : self._now.points.shape[1] - abs(self._now.off_windows)]
