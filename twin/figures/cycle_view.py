"""One side of a cycle, measured or expected, as input of key figures: vacuum and nozzle.

It is compiled. Cycles come seconds apart, and by then NumPy's code has left the processor's caches:
its many small calls would take twice as long as in a row.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model.compiled import compiled
from twin.model.safeguards import LEAK_SETTLE_S, PROTECTED_S
from twin.quality import UNUSABLE
from twin.signals import BAR, MBAR, NS, Phase, Samples, Ticks

LEAK_WINDOW_S = 1.0  # after the settling, over which leakage is read
LEAST_WINDOW_S = 0.05  # noise of 0.3 mbar then gives 3 mbar/s
LAST_S = 0.5  # at the end of the suction, in which the vacuum may stand still
ENDS = (0.01, 0.99)  # quantiles used as the lowest and the highest reading
LONGEST_HOLE = 0.01  # s without a reading; a longer hole may hide a switching
MOST_STEPS = 5.0  # usual steps without a reading; a longer hole may hide a level

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

# Plain numbers, since enumerations are slow to compare.
_SUCTION, _HOLD, _BLOW_OFF = int(Phase.SUCTION), int(Phase.HOLD), int(Phase.BLOW_OFF)


@dataclass(frozen=True)
class Rows:
    """Rows of one cycle from its suction edge on, at least one.

    ``vacuum`` (mbar) is NaN where no reading is usable, ``supply`` (bar gauge, at the nozzle) where
    it is not measured. ``off_lag`` and ``on_lag`` (s) are the times from a switching of the air
    saving until ``phase`` shows it.
    """

    time: Floats  # s since the suction edge
    vacuum: Floats
    supply: Floats
    phase: Bytes
    ended: bool  # the end of the suction was seen
    blown: bool  # the end of the blow-off was seen too
    off_lag: float = 0.0
    on_lag: float = 0.0


class Nozzle(NamedTuple):
    """Switching of the nozzle while suction was commanded."""

    on_s: float  # time that it was on
    switchings: int  # number of times it was switched on
    quick_switchings: int  # most by the air saving, on or off, within valve protection's time
    went_off: bool  # the air saving switched it off
    off_s: float  # first time that it did


class Vacuum(NamedTuple):
    """The vacuum until the end of the command of suction, with readings smoothed."""

    seamless: bool  # readings are so dense that no switching can have been missed
    even: bool  # no reading is missing, whatever their spacing: levels can be read
    h2_s: float  # time at which it reached H2
    h1_s: float  # and H1
    highest: float  # mbar
    last: float  # its mean at the end (mbar)
    last_slope: float  # its slope at the end (mbar/s)
    leakage: float  # loss per time in the first stretch of hold (mbar/s)


class Supply(NamedTuple):
    """Readings of the supply while the nozzle was on (bar)."""

    mean: float
    lowest: float  # except for one reading in a hundred
    highest: float


class CycleFindings(NamedTuple):
    """Findings in the rows of a cycle; NaN where they do not tell."""

    ended: bool
    blown: bool
    suction_s: float  # time with suction commanded
    blow_off_s: float  # time of blow-off
    nozzle: Nozzle
    vacuum: Vacuum
    supply: Supply

    @property
    def is_whole(self) -> bool:
        """Whether readings are dense to the end of the suction."""
        return self.ended and self.vacuum.seamless

    @property
    def is_even(self) -> bool:
        """Whether readings of the vacuum come without a gap to the end of the suction."""
        return self.ended and self.vacuum.even


def find_in_cycle(rows: Rows, h2: float, h1: float) -> CycleFindings:
    """The findings in the rows of a cycle, with the unit's levels (mbar)."""
    result: CycleFindings = _find_in_cycle(
        rows.time,
        rows.vacuum,
        rows.supply,
        rows.phase,
        (rows.ended, rows.blown),
        (rows.off_lag, rows.on_lag),
        (h2, h1),
    )
    return result


def measured(
    samples: Samples, ticks: Ticks, ambient: float
) -> tuple[Floats, Floats, Floats, Bytes]:
    """Time, vacuum below ``ambient`` (mbar), supply and phase as measured, for Rows."""
    columns: tuple[Floats, Floats, Floats, Bytes] = _measured(samples, ticks, ambient)
    return columns


# --- compiled -----------------------------------------------------------------------------------


@compiled
def _measured(
    samples: Samples, ticks: Ticks, ambient: float
) -> tuple[Floats, Floats, Floats, Bytes]:
    """Columns in the units of Rows."""
    count = len(samples)
    time, vacuum, supply = np.empty(count), np.empty(count), np.empty(count)
    phase = np.empty(count, np.uint8)
    for row in range(count):
        sample = samples[row]
        usable = (sample.quality & UNUSABLE) == 0
        time[row] = (sample.time_ns - samples[0].time_ns) * NS
        vacuum[row] = ambient - sample.pressure / MBAR if usable else math.nan
        supply[row] = sample.supply / BAR
        phase[row] = ticks[row].phase
    return time, vacuum, supply, phase


@compiled
def _find_in_cycle(
    time: Floats,
    vacuum: Floats,
    supply: Floats,
    phase: Bytes,
    ends_seen: tuple[bool, bool],
    lags: tuple[float, float],
    levels: tuple[float, float],
) -> CycleFindings:
    """The findings in rows; ``ends_seen``, ``lags`` and ``levels`` are pairs."""
    rows = _suction_rows(phase)
    suction_s = _at(time, rows)
    suction = phase[:rows]
    return CycleFindings(
        ends_seen[0],
        ends_seen[1],
        suction_s,
        _blow_off_s(time, phase),
        _nozzle(_edges(time, suction, suction_s, lags), suction),
        _vacuum(time[:rows], vacuum[:rows], suction, suction_s, levels),
        _supply(supply, phase),
    )


@compiled
def _suction_rows(phase: Bytes) -> int:
    """Number of rows with suction commanded, from the first on."""
    for row in range(len(phase)):
        if phase[row] != _SUCTION and phase[row] != _HOLD:
            return row
    return len(phase)


@compiled
def _stretch(phase: Bytes, value: int, row: int) -> tuple[int, int]:
    """Begin and end of the next stretch of a phase from ``row`` on; equal if there is none."""
    while row < len(phase) and phase[row] != value:
        row += 1
    begin = row
    while row < len(phase) and phase[row] == value:
        row += 1
    return begin, row


@compiled
def _at(time: Floats, row: int) -> float:
    """Time of a row (s); the row after the last is extrapolated by the last step."""
    if row < len(time):
        return time[row]
    return time[-1] + (time[-1] - time[-2] if row > 1 else 0.0)


@compiled
def _edges(time: Floats, phase: Bytes, end: float, lags: tuple[float, float]) -> Floats:
    """Times at which the nozzle was switched on and off in turn (s) under suction."""
    edges = np.empty(len(phase) + 1)
    count, latest = 0, 0.0  # no edge comes before suction's, which has no lag
    begin, behind = _stretch(phase, _SUCTION, 0)
    while begin < behind:
        on = time[begin] - lags[1]
        off = time[behind] - lags[0] if behind < len(phase) else end
        edges[count] = max(on, latest)
        edges[count + 1] = latest = max(off, edges[count])
        count += 2
        begin, behind = _stretch(phase, _SUCTION, behind)
    return edges[:count]


@compiled
def _nozzle(edges: Floats, phase: Bytes) -> Nozzle:
    """Switching of the nozzle by its edges; ``phase`` is that of the same rows."""
    on_s = 0.0
    for i in range(0, len(edges), 2):
        on_s += edges[i + 1] - edges[i]
    begin, behind = _stretch(phase, _HOLD, 0)
    to_the_end = len(phase) > 0 and phase[-1] == _SUCTION
    quick = _quick_switchings(edges, to_the_end)
    off_s = edges[1] if len(edges) > 0 else math.nan
    return Nozzle(on_s, len(edges) // 2, quick, begin < behind, off_s)


@compiled
def _quick_switchings(edges: Floats, to_the_end: bool) -> int:
    """Most edges within the time of valve protection.

    Commanded edges do not count: the first one, and the last one if the nozzle was on
    ``to_the_end``.
    """
    last = len(edges) - 1 if to_the_end else len(edges)
    most, behind = 0, 1
    for i in range(1, last):
        while behind < last and edges[behind] < edges[i] + PROTECTED_S:
            behind += 1
        most = max(most, behind - i)
    return most


@compiled
def _blow_off_s(time: Floats, phase: Bytes) -> float:
    """Total time of blow-off (s)."""
    total = 0.0
    begin, behind = _stretch(phase, _BLOW_OFF, 0)
    while begin < behind:
        total += _at(time, behind) - time[begin]
        begin, behind = _stretch(phase, _BLOW_OFF, behind)
    return total


@compiled
def _vacuum(
    time: Floats, vacuum: Floats, phase: Bytes, end: float, levels: tuple[float, float]
) -> Vacuum:
    """The vacuum in the rows of suction, which ended at ``end`` (s)."""
    times, smooth, hole = _readings(time, vacuum, end)
    seamless = len(times) > 0 and hole <= LONGEST_HOLE
    longest = LONGEST_HOLE
    if len(times) > 1:
        longest = max(longest, MOST_STEPS * (times[-1] - times[0]) / (len(times) - 1))
    last, last_slope, _ = _line(times, smooth, end - LAST_S, end)
    begin, behind = _stretch(phase, _HOLD, 0)
    leakage = _leakage(time[begin:behind], vacuum[begin:behind]) if seamless else math.nan
    return Vacuum(
        seamless,
        len(times) > 0 and hole <= longest,
        _reached(times, smooth, levels[0], longest),
        _reached(times, smooth, levels[1], longest),
        smooth.max() if len(smooth) > 0 else math.nan,
        last,
        last_slope,
        leakage,
    )


@compiled
def _readings(time: Floats, vacuum: Floats, end: float) -> tuple[Floats, Floats, float]:
    """Times and smoothed readings, and the longest time without a reading to ``end`` (s)."""
    times, padded = np.empty(len(time)), np.empty(len(time) + 4)
    count, latest, hole = 0, 0.0, 0.0
    for row in range(len(time)):
        if math.isfinite(vacuum[row]):
            times[count], padded[count + 2] = time[row], vacuum[row]
            hole, latest = max(hole, time[row] - latest), time[row]
            count += 1
    if count > 0:
        padded[:2], padded[count + 2 : count + 4] = padded[2], padded[count + 1]
    return times[:count], _smoothed(padded[: count + 4]), max(hole, end - latest)


@compiled
def _smoothed(padded: Floats) -> Floats:
    """The median of five neighbours: it moves no edge, and a single spike has no effect.

    Of four values the least and the greatest cannot be the median. So it is the median of the other
    two and the fifth.
    """
    smooth = np.empty(len(padded) - 4)
    for i in range(len(smooth)):
        a, b, c, d = padded[i], padded[i + 1], padded[i + 3], padded[i + 4]
        low, high = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
        low, high = min(low, high), max(low, high)
        smooth[i] = max(low, min(high, padded[i + 2]))
    return smooth


@compiled
def _reached(time: Floats, vacuum: Floats, level: float, longest: float) -> float:
    """Time (s) at which the vacuum reaches ``level`` (mbar); NaN if it does not.

    It is also NaN after more than ``longest`` (s) without a reading.
    """
    for row in range(len(time)):
        if vacuum[row] >= level:
            before = time[row - 1] if row > 0 else 0.0
            if time[row] - before > longest:
                return math.nan
            if row == 0:
                return time[row]
            share = (level - vacuum[row - 1]) / (vacuum[row] - vacuum[row - 1])
            return before + share * (time[row] - before)
    return math.nan


@compiled
def _leakage(time: Floats, vacuum: Floats) -> float:
    """Vacuum lost per time (mbar/s) in a stretch of hold; NaN if that is too short or empty."""
    if len(time) == 0:
        return math.nan
    _, slope, end = _line(time - time[0] - LEAK_SETTLE_S, vacuum, 0.0, LEAK_WINDOW_S)
    return -slope if end >= LEAST_WINDOW_S else math.nan


@compiled
def _line(time: Floats, values: Floats, first: float, last: float) -> tuple[float, float, float]:
    """A straight line through the readings from ``first`` to ``last`` (s).

    Mean, slope per second, and time of the last reading (minus infinity if there is none).
    """
    count, middle, mean, end = 0, 0.0, 0.0, -math.inf
    for row in range(len(time)):
        if first <= time[row] <= last and math.isfinite(values[row]):
            count += 1
            middle += time[row]
            mean += values[row]
            end = time[row]
    middle, mean = middle / count, mean / count
    moment, squares = 0.0, 0.0
    for row in range(len(time)):
        if first <= time[row] <= last and math.isfinite(values[row]):
            moment += (time[row] - middle) * values[row]
            squares += (time[row] - middle) ** 2
    return mean, moment / squares, end


@compiled
def _supply(supply: Floats, phase: Bytes) -> Supply:
    """Mean, low and high end of the supply while the nozzle was on."""
    readings = np.empty(len(supply))
    count, beyond = 0, 0.0  # sum over the first reading: the mean of equal readings is exact
    for row in range(len(supply)):
        if phase[row] == _SUCTION and math.isfinite(supply[row]):
            readings[count] = supply[row]
            beyond += readings[count] - readings[0]
            count += 1
    if count == 0:
        return Supply(math.nan, math.nan, math.nan)
    mean = readings[0] + beyond / count
    low, high = round(ENDS[0] * (count - 1)), round(ENDS[1] * (count - 1))
    partitioned = np.partition(readings[:count], np.array([low, high]))
    return Supply(mean, partitioned[low], partitioned[high])
