"""One side of a cycle, measured or expected, as key figures look at it: vacuum and nozzle.

Compiled, as a cycle comes once in seconds: by then what NumPy needs for its many small calls has
left the processor's caches, and they take twice as long as one after the other.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.model.compiled import compiled
from twin.model.control import LEAK_SETTLE_S, PROTECTED_S
from twin.signals import BAR, MBAR, NS, UNUSABLE, Phase, Samples, Ticks

LEAK_WINDOW_S = 1.0  # after the settling, in which leakage is judged
LEAST_WINDOW_S = 0.05  # noise of 0.3 mbar then gives 3 mbar/s
LAST_S = 0.5  # at the end of the suction, in which it may stand still
ENDS = (0.01, 0.99)  # quantiles that stand for the lowest and the highest reading
LONGEST_HOLE = 0.01  # s without a reading, beyond which a switching may have been missed
MOST_STEPS = 5.0  # of the cadence, without a reading: beyond, a level may have been missed

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

# As plain numbers: enumerations are slow to compare.
_SUCTION, _HOLD, _BLOW_OFF = int(Phase.SUCTION), int(Phase.HOLD), int(Phase.BLOW_OFF)


@dataclass(frozen=True)
class Rows:
    """Rows of one cycle from its suction edge on, one at least.

    ``vacuum`` (mbar) is NaN where nothing usable was read; ``supply`` (bar gauge, at the nozzle)
    where it is not measured. ``off_lag`` and ``on_lag`` (s) are from the switching of the air
    saving to where ``phase`` has it.
    """

    time: Floats  # s since the suction edge
    vacuum: Floats
    supply: Floats
    phase: Bytes
    ended: bool  # the end of the suction was seen
    blown: bool  # and that of the blow-off
    off_lag: float = 0.0
    on_lag: float = 0.0


class Nozzle(NamedTuple):
    """How the nozzle was switched while suction was commanded."""

    on_s: float  # how long it was on
    switchings: int  # how often it was switched on
    quick_switchings: int  # most of the air saving, on or off, in the time valve protection has
    went_off: bool  # the air saving switched it off
    off_s: float  # when it first did


class Vacuum(NamedTuple):
    """What the vacuum did until suction was not commanded any more, single readings smoothed."""

    seamless: bool  # readings are so close that no switching can have been missed
    even: bool  # none is missing that tells a level, however far apart they are
    h2_s: float  # when it came to H2
    h1_s: float  # and to H1
    highest: float  # mbar
    last: float  # its mean at the end (mbar)
    last_slope: float  # and how it moved there (mbar/s)
    leakage: float  # what was lost per time in the first stretch of hold (mbar/s)


class Supply(NamedTuple):
    """What the supply read while the nozzle was on (bar)."""

    mean: float
    lowest: float  # but for one reading in a hundred
    highest: float


class Course(NamedTuple):
    """What is found in rows; NaN where they do not tell it."""

    ended: bool
    blown: bool
    suction_s: float  # how long suction was commanded
    blow_off_s: float  # how long blow-off was on
    nozzle: Nozzle
    vacuum: Vacuum
    supply: Supply

    @property
    def is_whole(self) -> bool:
        """Whether nothing of the suction was missed, to its end."""
        return self.ended and self.vacuum.seamless

    @property
    def is_even(self) -> bool:
        """Whether the vacuum was seen as often as ever, to the end of the suction."""
        return self.ended and self.vacuum.even


def course(rows: Rows, h2: float, h1: float) -> Course:
    """Find it, with the levels of the unit (mbar)."""
    found: Course = _course(
        rows.time,
        rows.vacuum,
        rows.supply,
        rows.phase,
        (rows.ended, rows.blown),
        (rows.off_lag, rows.on_lag),
        (h2, h1),
    )
    return found


def measured(
    samples: Samples, ticks: Ticks, ambient: float
) -> tuple[Floats, Floats, Floats, Bytes]:
    """Time, vacuum below ``ambient`` (mbar), supply and phase of what was measured, for Rows."""
    found: tuple[Floats, Floats, Floats, Bytes] = _measured(samples, ticks, ambient)
    return found


# --- compiled -----------------------------------------------------------------------------------


@compiled
def _measured(samples, ticks, ambient):  # type: ignore[no-untyped-def]
    """Columns in the units of Rows."""
    count = len(samples)
    time, vacuum, supply = np.empty(count), np.empty(count), np.empty(count)
    phase = np.empty(count, np.uint8)
    for row in range(count):
        one = samples[row]
        usable = (one.quality & UNUSABLE) == 0
        time[row] = (one.time_ns - samples[0].time_ns) * NS
        vacuum[row] = ambient - one.pressure / MBAR if usable else math.nan
        supply[row] = one.supply / BAR
        phase[row] = ticks[row].phase
    return time, vacuum, supply, phase


@compiled
def _course(time, vacuum, supply, phase, seen, lags, levels):  # type: ignore[no-untyped-def]
    """The course that rows took; ``seen``, ``lags`` and ``levels`` are pairs of numbers."""
    rows = _suction_rows(phase)
    suction_s = _at(time, rows)
    suction = phase[:rows]
    return Course(
        seen[0],
        seen[1],
        suction_s,
        _blow_off_s(time, phase),
        _nozzle(_edges(time, suction, suction_s, lags), suction),
        _vacuum(time[:rows], vacuum[:rows], suction, suction_s, levels),
        _supply(supply, phase),
    )


@compiled
def _suction_rows(phase):  # type: ignore[no-untyped-def]
    """Rows until suction is not commanded any more."""
    for row in range(len(phase)):
        if phase[row] != _SUCTION and phase[row] != _HOLD:
            return row
    return len(phase)


@compiled
def _stretch(phase, wanted, row):  # type: ignore[no-untyped-def]
    """Where the next stretch of a phase begins and ends, from ``row`` on: the same if none does."""
    while row < len(phase) and phase[row] != wanted:
        row += 1
    begin = row
    while row < len(phase) and phase[row] == wanted:
        row += 1
    return begin, row


@compiled
def _at(time, row):  # type: ignore[no-untyped-def]
    """Time of a row (s); of the one behind the last as if it came as soon as that did."""
    if row < len(time):
        return time[row]
    return time[-1] + (time[-1] - time[-2] if row > 1 else 0.0)


@compiled
def _edges(time, phase, end, lags):  # type: ignore[no-untyped-def]
    """When the nozzle was switched on and off in turn (s), while suction was commanded."""
    edges = np.empty(len(phase) + 1)
    count, latest = 0, 0.0  # none is before the suction's edge, which knows no lag
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
def _nozzle(edges, phase):  # type: ignore[no-untyped-def]
    """How it was switched, by its edges; ``phase`` is that of the same rows."""
    on_s = 0.0
    for i in range(0, len(edges), 2):
        on_s += edges[i + 1] - edges[i]
    begin, behind = _stretch(phase, _HOLD, 0)
    to_the_end = len(phase) > 0 and phase[-1] == _SUCTION
    quick = _quick_switchings(edges, to_the_end)
    off_s = edges[1] if len(edges) > 0 else math.nan
    return Nozzle(on_s, len(edges) // 2, quick, begin < behind, off_s)


@compiled
def _quick_switchings(edges, to_the_end):  # type: ignore[no-untyped-def]
    """Most edges within the time that valve protection has.

    Those that were commanded do not count: the first one, and where the nozzle was on
    ``to_the_end``, the last one.
    """
    last = len(edges) - 1 if to_the_end else len(edges)
    most, behind = 0, 1
    for i in range(1, last):
        while behind < last and edges[behind] < edges[i] + PROTECTED_S:
            behind += 1
        most = max(most, behind - i)
    return most


@compiled
def _blow_off_s(time, phase):  # type: ignore[no-untyped-def]
    """How long blow-off was on."""
    total = 0.0
    begin, behind = _stretch(phase, _BLOW_OFF, 0)
    while begin < behind:
        total += _at(time, behind) - time[begin]
        begin, behind = _stretch(phase, _BLOW_OFF, behind)
    return total


@compiled
def _vacuum(time, vacuum, phase, end, levels):  # type: ignore[no-untyped-def]
    """What it did in rows of suction, which ended at ``end`` (s)."""
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
def _readings(time, vacuum, end):  # type: ignore[no-untyped-def]
    """Times of what was read, smoothed; and the longest time without, from 0 to ``end`` (s)."""
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
def _smoothed(padded):  # type: ignore[no-untyped-def]
    """The median of five neighbours: it moves no edge, and one reading alone reaches nothing.

    Of four the least and the greatest cannot be it, so it is that of the other two and the fifth.
    """
    smooth = np.empty(len(padded) - 4)
    for i in range(len(smooth)):
        a, b, c, d = padded[i], padded[i + 1], padded[i + 3], padded[i + 4]
        low, high = max(min(a, b), min(c, d)), min(max(a, b), max(c, d))
        low, high = min(low, high), max(low, high)
        smooth[i] = max(low, min(high, padded[i + 2]))
    return smooth


@compiled
def _reached(time, vacuum, level, longest):  # type: ignore[no-untyped-def]
    """Time (s) at which the vacuum comes to ``level`` (mbar); NaN if it does not.

    So it is where there was no reading for ``longest`` (s) before.
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
def _leakage(time, vacuum):  # type: ignore[no-untyped-def]
    """Vacuum lost per time (mbar/s) in a stretch of hold; NaN where it is too short, or none."""
    if len(time) == 0:
        return math.nan
    _, slope, end = _line(time - time[0] - LEAK_SETTLE_S, vacuum, 0.0, LEAK_WINDOW_S)
    return -slope if end >= LEAST_WINDOW_S else math.nan


@compiled
def _line(time, values, first, last):  # type: ignore[no-untyped-def]
    """A straight line through what was read from ``first`` to ``last`` (s).

    Mean, slope per second, and time of the last reading: minus infinity if there is none.
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
def _supply(supply, phase):  # type: ignore[no-untyped-def]
    """What it read while the nozzle was on."""
    there = np.empty(len(supply))
    count, beyond = 0, 0.0  # the first one: then the mean of equal ones is just that
    for row in range(len(supply)):
        if phase[row] == _SUCTION and math.isfinite(supply[row]):
            there[count] = supply[row]
            beyond += there[count] - there[0]
            count += 1
    if count == 0:
        return Supply(math.nan, math.nan, math.nan)
    mean = there[0] + beyond / count
    low, high = round(ENDS[0] * (count - 1)), round(ENDS[1] * (count - 1))
    in_place = np.partition(there[:count], np.array([low, high]))
    return Supply(mean, in_place[low], in_place[high])
