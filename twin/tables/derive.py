"""Commands that nobody recorded, found from the pressure alone.

The record is cut at its falls into vacuum and its returns from it. Between a fall and a return lies
suction. The rest is idle, and blow-off where the pressure goes above the level of idle. What moves
is the pressure: a valve's delay and the timing of a command cannot be found.

Levels are those of the record itself. So an offset, an unknown ambient pressure or its drift change
nothing.
"""

import math
from bisect import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.errors import SourceError
from twin.inference.levels import MAD_TO_SIGMA
from twin.signals import MBAR, MS, NS, UNUSABLE, Command, Quality, Samples

Floats = npt.NDArray[np.float64]

LONGEST_HOLE, MOST_MISSING = 0.25, 5  # s and rows: a longer hole may hide a cycle
FEWEST = 8  # readings, below which there is nothing to see
LEAST_VACUUM = 20.0 * MBAR  # Pa, that a record must show
LEAST_MOVE = 10.0 * MBAR  # Pa; a fall and a return of less are none
CLEAR = 10.0  # sigmas that they must have
RETURNED = 0.6  # of the way up, from which on a vacuum has ended; an air saving swings by less
LEAST_SHARE = 0.1  # of what stands still between a release and a fall, that idle has
NEAR = 3  # tops on each side, that tell how high idle is
BRIEF, SHALLOW = 50.0 * MS, 0.2  # s, and share of the deepest vacuum: a line that rings
ABRUPT = 0.1  # of the record, in which half of some move is over; drift takes longer
ONSET = 0.05  # of a move, at which its beginning is looked for; noise and wander may ask for more
FLAT = 0.25  # of the slope of a return: what is less steep comes before it
LOOKS = 20  # at a fall at most, each from the level that the one before found: idle cools
SETTLED = 20.0 * MS  # s before a fall, that tell the level it begins at
PEAK = 0.8  # of an overshoot; blow-off has ended where the pressure is below it
MOST_AMBIENT = 1100.0 * MBAR  # Pa; the highest air pressure measured at sea level is 1085 mbar
LEAST_AMBIENT = 500.0 * MBAR  # Pa, at 5.5 km; the highest towns lie at 5.1 km
LEAST_ABSOLUTE = 20.0 * MBAR  # Pa; no ejector evacuates to as little
UNTOLD = "valve delays and the timing of commands cannot be told"


@dataclass(frozen=True)
class Derived:
    """Commands found for some samples, row for row, and what is to be said of them."""

    commands: npt.NDArray[np.uint8]
    suctions: int  # whole or in part
    blown: bool  # releases go above the level of idle: they are blow-offs

    def words(self, lacking: Sequence[str]) -> str:
        """What was found of the commands that a file was ``lacking``, and what cannot be."""
        how = (
            "releases go above the level of idle, so they are called blow-off"
            if self.blown
            else "no release goes above the level of idle: whether a blow-off or a vent ends the"
            " vacuum cannot be told, so it is called idle"
        )
        many = f"{self.suctions} suction{'' if self.suctions == 1 else 's'}"
        return f"{' and '.join(lacking)} derived from the pressure: {many}; {how}; {UNTOLD}"


def derive(samples: Samples, ambient: float | None = None) -> Derived:
    """Find the commands of a whole record; SourceError with the reason where it shows none.

    ``ambient`` (Pa) is what the sensor reads there, where that is known: idle is then told from a
    long blow-off.
    """
    traces = list(_traces(samples))
    if not traces:
        raise SourceError("too few usable readings follow on each other", "record at least a cycle")
    move = _least_move(traces)
    found = [(trace, _suctions(trace, move, ambient)) for trace in traces]
    suctions = [one for _, edges in found for one in edges]
    if not suctions:
        raise SourceError(
            "the pressure never falls into a vacuum and returns from it, as with suction and"
            " release: there is no cycle in it, but drift",
            "record at least one suction with its release",
        )
    over = [one.blown is not None for one in suctions if one.end < math.inf]
    blown = 2 * sum(over) >= len(over) > 0
    commands = np.zeros(len(samples), np.uint8)
    times = _seconds(samples)
    for trace, edges in found:
        part = slice(trace.rows[0], trace.rows[-1] + 1)
        for one in edges:
            stretches = [(one.begin, one.end, Command.SUCTION)]
            if blown and one.blown is not None:
                stretches.append((one.end, one.blown, Command.BLOW_OFF))
            for begin, end, command in stretches:
                first, last = np.searchsorted(times[part], (begin, end))
                commands[part][first:last] = int(command)
    return Derived(commands, len(suctions), blown)


def _seconds(samples: Samples) -> Floats:
    times: Floats = (samples["time_ns"] - samples["time_ns"][0]) * NS
    return times


# --- readings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Trace:
    """Usable readings while time runs on, without a long hole; single spikes are taken out."""

    time: Floats  # s
    pressure: Floats  # Pa
    rows: npt.NDArray[np.intp]  # of the samples
    noise: float  # Pa

    def last(self, rows: slice, above: bool, level: float) -> int:
        """Last row in ``rows`` whose pressure is above a level, or below it; −1 if none is."""
        part = self.pressure[rows]
        found = np.flatnonzero(part >= level if above else part <= level)
        return int(rows.start + found[-1]) if len(found) else -1

    def crossing(self, row: int, level: float) -> float:
        """When (s) the line from ``row`` to the next row, if there is one, comes to a level."""
        if row + 1 >= len(self.time):
            return float(self.time[row])
        (t, u), (p, q) = self.time[row : row + 2], self.pressure[row : row + 2]
        return float(t if p == q else t + (u - t) * min(max((level - p) / (q - p), 0.0), 1.0))


def _traces(samples: Samples) -> Iterator[_Trace]:
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    times = _seconds(samples)
    apart = np.diff(times)
    longest = max(LONGEST_HOLE, MOST_MISSING * float(np.median(apart))) if len(apart) else 0.0
    anew = (samples["quality"][1:] & (Quality.RESTART | Quality.CLOCK)) != 0
    breaks = np.flatnonzero(anew | (apart <= 0.0) | (apart > longest)) + 1
    for first, last in pairwise([0, *breaks.tolist(), len(samples)]):
        rows = first + np.flatnonzero(usable[first:last])
        if len(rows) >= FEWEST:
            pressure = samples["pressure"][rows].astype(np.float64)
            noise = _noise(pressure)
            three = np.stack([pressure[:-2], pressure[1:-1], pressure[2:]])
            pressure[1:-1] = np.median(three, axis=0)
            yield _Trace(times[rows], pressure, rows, noise)


def _noise(pressure: Floats) -> float:
    """Noise (Pa) of single readings, from second differences: few rows of a record are curved."""
    return float(np.median(np.abs(np.diff(pressure, 2)))) * MAD_TO_SIGMA / math.sqrt(6.0)


def _least_move(traces: Sequence[_Trace]) -> float:
    """A fall or return (Pa) that is more than noise; SourceError where there is no vacuum."""
    pressure = np.concatenate([trace.pressure for trace in traces])
    noise = max(trace.noise for trace in traces)
    lowest, highest = float(pressure.min()), float(pressure.max())
    if lowest >= 0.0 and highest < 0.002 * MOST_AMBIENT:
        raise SourceError(
            f"the pressure is never above {highest / MBAR:.3g} mbar: it is probably in bar",
            'say so under [import.columns]: pressure_bar = "NAME IN THE FILE", or vacuum_bar',
        )
    if highest - lowest < max(LEAST_VACUUM, CLEAR * noise):
        raise SourceError(
            f"the pressure moves by {(highest - lowest) / MBAR:.1f} mbar only: no vacuum is made",
            "record at least one suction with its release; check which column is the pressure",
        )
    if lowest < LEAST_ABSOLUTE:
        raise SourceError(
            f"the pressure comes down to {lowest / MBAR:.0f} mbar absolute, which no ejector makes:"
            " the column is probably gauge pressure or vacuum",
            'a vacuum, positive when evacuated, is vacuum_mbar = "NAME IN THE FILE" under'
            " [import.columns]; turn the sign of a gauge pressure in the file",
        )
    if float(np.median(pressure)) > MOST_AMBIENT:
        raise SourceError(
            f"the pressure is mostly above {MOST_AMBIENT / MBAR:.0f} mbar absolute, as no ambient"
            " pressure is",
            "check sign and reference of the column; a vacuum is positive when evacuated",
        )
    if highest < LEAST_AMBIENT:
        raise SourceError(
            f"the pressure is never above {highest / MBAR:.0f} mbar absolute: no vacuum ends in it",
            "record at least one suction with its release; check the column's reference",
        )
    return max(LEAST_MOVE, CLEAR * noise)


# --- vacua, and what lies between ---------------------------------------------------------------


@dataclass(frozen=True)
class _Top:
    """Rows from a return to the next fall, or what of them is in the record."""

    rows: slice
    level: float  # Pa, at which it stays the longest: idle
    high: float  # Pa, the highest
    wander: float  # Pa, that idle may differ by: its gas cools


@dataclass(frozen=True)
class _Suction:
    """When suction begins and ends (s), and the overshoot after it if there is one."""

    begin: float  # −inf where the record begins in it
    end: float  # inf where the record ends in it
    blown: float | None


def _suctions(trace: _Trace, move: float, ambient: float | None) -> list[_Suction]:
    lows = _vacua(trace, move)
    if not lows or not _is_abrupt(trace):
        return []
    all_tops = _tops(trace, move, lows, ambient)
    usual = [_usual(number, all_tops) for number in range(len(all_tops))]
    tops = [_as_idle(top, other) for top, other in zip(all_tops, usual, strict=True)]
    if tops[0] is not None:  # no blow-off is seen before it
        tops[0] = all_tops[0]
    bounds = [0, *(number for number in range(1, len(lows)) if tops[number]), len(lows)]
    found = []
    for first, last in pairwise(bounds):
        low = min(lows[first:last], key=lambda row: float(trace.pressure[row]))
        before, after = tops[first], tops[last]
        other = usual[last if after is None else first]
        is_whole = before is not None and after is not None
        if is_whole or other is None or trace.pressure[low] < other.level - other.wander:
            found.append(_suction(trace, low, before, after))
    return found


def _usual(number: int, tops: list[_Top | None]) -> _Top | None:
    """Idle as the neighbours of a top have it after their returns; None where there are none."""
    near = range(max(number - NEAR, 1), min(number + NEAR + 1, len(tops)))
    others = [top for i in near if i != number and (top := tops[i]) is not None]
    if not others:
        return None
    wander = max(top.wander for top in (tops[number], *others) if top is not None)
    levels, highs = zip(*((top.level, top.high) for top in others), strict=True)
    return _Top(slice(0, 0), float(np.median(levels)), float(np.median(highs)), wander)


def _as_idle(top: _Top | None, usual: _Top | None) -> _Top | None:
    """A top with the level of idle; None if it stays below it.

    An open cup under suction does, and one that has lost its part. One that stays above it does so
    in a long blow-off.
    """
    if top is None or usual is None:
        return top
    if top.high < usual.level - usual.wander:
        return None
    return top if top.level <= usual.level + usual.wander else replace(top, level=usual.level)


def _suction(trace: _Trace, low: int, before: _Top | None, after: _Top | None) -> _Suction:
    return _Suction(
        -math.inf if before is None else _fall(trace, before, low),
        math.inf if after is None else _return(trace, low, after),
        None if after is None else _overshoot(trace, after),
    )


def _is_abrupt(trace: _Trace) -> bool:
    """Whether half of all that the pressure moves happens in a small part of the record."""
    pressure, time = np.minimum(trace.pressure, MOST_AMBIENT), trace.time
    marks = np.linspace(time[0], time[-1], round(2.0 / ABRUPT) + 1)
    rows = np.searchsorted(time, marks)
    parts = [pressure[first : last + 1] for first, last in zip(rows, rows[2:], strict=False)]
    most = max(float(np.ptp(part)) for part in parts if len(part))
    return most >= 0.5 * float(np.ptp(pressure))


def _vacua(trace: _Trace, move: float) -> list[int]:
    """Rows at which vacua are deepest, one for each suction."""
    pressure = np.minimum(trace.pressure, MOST_AMBIENT)
    lows, highs = _turns(pressure.tolist(), move)
    middle = 0.5 * (pressure.max() + pressure.min())
    shallow = SHALLOW * float(np.ptp(trace.pressure))
    lows = [row for row in lows if not _rings(trace, row, highs, shallow)]
    if not lows:
        return []
    top = float(np.median([pressure[row] for row in highs if pressure[row] >= middle]))
    kept = lows[:1]
    for low in lows[1:]:
        saddle = float(pressure[kept[-1] : low].max())
        above = max(pressure[kept[-1]], pressure[low])
        if saddle - above >= RETURNED * (top - above):
            kept.append(low)
        elif pressure[low] < pressure[kept[-1]]:
            kept[-1] = low
    return kept


def _rings(trace: _Trace, low: int, highs: list[int], shallow: float) -> bool:
    """Whether a low is but a line that rings: brief, and less deep than ``shallow`` (Pa)."""
    place = bisect(highs, low)
    first = highs[place - 1] if place else 0
    rows = slice(first, (highs[place] if place < len(highs) else len(trace.time) - 1) + 1)
    part = trace.pressure[rows]
    if max(part[0], part[-1]) - trace.pressure[low] > shallow:
        return False
    side = min(part[0], part[-1])
    if place in {0, len(highs)}:  # it may be idle after blow-off: nobody sees how it goes on
        return True
    half = np.flatnonzero(part <= 0.5 * (side + trace.pressure[low]))
    return float(trace.time[rows][half[-1]] - trace.time[rows][half[0]]) < BRIEF


def _turns(pressure: list[float], least: float) -> tuple[list[int], list[int]]:
    """Rows of the lows and the highs between which the pressure moves by at least ``least``."""
    found: tuple[list[int], list[int]] = ([], [])  # lows, highs
    low = high = 0
    up: bool | None = None  # the way since the last turn
    for row, value in enumerate(pressure):
        if value < pressure[low]:
            low = row
        if value > pressure[high]:
            high = row
        if up is not False and pressure[high] - value >= least:
            found[1].append(high)
            up, low = False, row
        elif up is not True and value - pressure[low] >= least:
            found[0].append(low)
            up, high = True, row
    if up is not None:
        found[int(up)].append(high if up else low)
    return found


def _tops(trace: _Trace, move: float, lows: list[int], ambient: float | None) -> list[_Top | None]:
    """What is before the first vacuum, between two, and after the last; None if nothing is."""
    pressure, tops = np.minimum(trace.pressure, MOST_AMBIENT), list[_Top | None]()
    for before, after in pairwise([None, *lows, None]):
        first = 0 if before is None else before
        part = pressure[first : None if after is None else after + 1]
        deep = max(pressure[row] for row in (before, after) if row is not None)
        way = float(part.max()) - deep
        up = np.flatnonzero(part >= deep + RETURNED * way)
        rows = slice(first + int(up[0]), first + int(up[-1]) + 1)
        flat = _flat(trace, rows)
        (level, _), (_, width) = shortest_half(_still(flat, ambient)), shortest_half(flat)
        wander, high = max(move, 2.0 * width), float(trace.pressure[rows].max())
        tops.append(_Top(rows, level, high, wander) if way >= move else None)
    return tops


def _flat(trace: _Trace, rows: slice) -> Floats:
    """Pressures (Pa) of some rows that are less steep than the fall after them, or all of these."""
    time, pressure = trace.time[rows], trace.pressure[rows]
    high = pressure.min() + 0.75 * np.ptp(pressure)
    began = int(np.flatnonzero(pressure >= high)[-1])
    fall, took = pressure[began] - pressure[-1], time[-1] - time[began]
    if fall <= 0.0:
        return pressure
    window = max(0.1 * took, 2.0 * float(np.median(np.diff(time))))
    ahead = np.searchsorted(time, time + window).clip(0, len(time) - 1)
    moved, passed = np.abs(pressure[ahead] - pressure), time[ahead] - time
    flat = pressure[(moved < FLAT * fall / took * passed + trace.noise) & (passed > 0.0)]
    return flat if len(flat) > 1 else pressure


def _still(flat: Floats, ambient: float | None) -> Floats:
    """Those of some pressures (Pa) that are ambient, where it is known and enough of them are."""
    if ambient is None:
        return flat
    near = flat[np.abs(flat - ambient) <= LEAST_MOVE]
    return near if len(near) >= max(NEAR, LEAST_SHARE * len(flat)) else flat


def shortest_half(values: Floats) -> tuple[float, float]:
    """The level that half of some values are closest about, and how far these are apart."""
    ordered = np.sort(values)
    half = (len(ordered) + 1) // 2
    spans = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    first = int(spans.argmin())
    return float(np.median(ordered[first : first + half])), float(spans[first])


# --- edges --------------------------------------------------------------------------------------


def _fall(trace: _Trace, top: _Top, low: int) -> float:
    """When (s) the pressure leaves idle: where a line through its first fall begins."""
    level, begin = top.level, float(trace.time[top.rows.start])
    rows = slice(top.rows.start, low + 1)
    settled = max(SETTLED, 2.5 * float(np.median(np.diff(trace.time[rows]))))
    for _ in range(LOOKS):
        depth = level - trace.pressure[low]
        step = max(min(ONSET * depth, top.wander), CLEAR / 2.0 * trace.noise)
        first, second = (trace.last(rows, True, level - n * step) for n in (1, 2))
        if first < 0:
            return float(trace.time[rows.start])
        at, later = (trace.crossing(row, level - n * step) for row, n in ((first, 1), (second, 2)))
        still = trace.last(rows, True, level - 0.25 * step)
        begin = max(2.0 * at - later, float(trace.time[max(still, rows.start)]))
        since, until = np.searchsorted(trace.time, (begin - settled, begin))
        before = trace.pressure[max(int(since), rows.start) : int(until) + 1]
        was, level = level, float(np.median(before)) if len(before) else level
        if abs(level - was) < 0.1 * step:
            break
    return begin


def _return(trace: _Trace, low: int, top: _Top) -> float:
    """When (s) a vacuum ends: where a line through the foot of the steep way up begins."""
    rows = slice(low, top.rows.start + 1)
    high = max(top.level, float(trace.pressure[top.rows.start]))
    since, foot = _foot(trace, rows, high)
    level = float(np.median(trace.pressure[since : foot + 1]))
    step = max(ONSET * (high - level), CLEAR / 2.0 * trace.noise)
    first, second = (trace.last(rows, False, level + n * step) for n in (1, 2))
    if first < 0:
        return float(trace.time[foot])
    at, later = (trace.crossing(row, level + n * step) for row, n in ((first, 1), (second, 2)))
    return max(2.0 * at - later, float(trace.time[since]))


def _foot(trace: _Trace, rows: slice, high: float) -> tuple[int, int]:
    """The last rows, first and last, over which the way up to ``high`` (Pa) is not yet steep."""
    low, pressure, time = rows.start, trace.pressure, trace.time
    way = high - float(pressure[low])
    early, late = (trace.last(rows, False, pressure[low] + share * way) for share in (0.4, 0.6))
    begins, ends = (
        trace.crossing(row, pressure[low] + share * way)
        for row, share in ((early, 0.4), (late, 0.6))
    )
    steep = 0.2 * way / max(ends - begins, NS)
    changes = np.count_nonzero(np.diff(pressure[early : late + 2]))  # a reading may be held
    held = (time[min(late + 1, len(time) - 1)] - time[early]) / max(changes, 1)
    window = max(CLEAR * trace.noise / steep, 2.0 * held)
    here = np.arange(low, early + 1)
    back = np.searchsorted(time, time[here] - window, side="right") - 1
    back = np.clip(np.minimum(back, here - 1), low, None)
    climbed, passed = pressure[here] - pressure[back], time[here] - time[back]
    last = int(np.flatnonzero(climbed <= FLAT * steep * passed)[-1])
    return int(back[last]), low + last


def _overshoot(trace: _Trace, top: _Top) -> float | None:
    """When (s) the pressure leaves what it was blown up to, above idle; None if it was not."""
    over = float(trace.pressure[top.rows].max()) - top.level
    if over < top.wander:
        return None
    level = top.level + PEAK * over
    return trace.crossing(trace.last(top.rows, True, level), level)
