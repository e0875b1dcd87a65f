"""Derive commands that nobody recorded from the pressure alone.

The record is cut at its falls into vacuum and its returns from it. Suction lies between a fall and
a return. The rest is idle, or blow-off where the pressure goes above the idle level. Only the
pressure's moves are seen: valve delays and the timing of commands cannot be found.

All levels come from the record itself. So an offset, an unknown ambient pressure or its drift
change nothing.
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
from twin.quality import UNUSABLE, Quality
from twin.signals import MBAR, MS, NS, Command, Samples

Floats = npt.NDArray[np.float64]

LONGEST_HOLE, MOST_MISSING = 0.25, 5  # s and rows: a longer hole may hide a cycle
FEWEST = 8  # readings; fewer show nothing
LEAST_VACUUM = 20.0 * MBAR  # Pa, that a record must show
LEAST_MOVE = 10.0 * MBAR  # Pa; less is no fall or return
CLEAR = 10.0  # sigmas that they must have
RETURNED = 0.6  # share of the rise at which a vacuum has ended; air saving swings by less
LEAST_SHARE = 0.1  # of the flat readings between a release and a fall, that idle has
NEAR = 3  # plateaus on each side that give the idle level
BRIEF, SHALLOW = 50.0 * MS, 0.2  # s, and share of the deepest vacuum: a line that rings
ABRUPT = 0.1  # share of the record in which half of a move must happen; drift takes longer
ONSET = 0.05  # share of a move that marks its beginning; more with noise and wander
FLAT = 0.25  # of the slope of a return: readings less steep come before it
LOOKS = 20  # iterations at a fall at most, each from the last one's level: idle cools
SETTLED = 20.0 * MS  # s before a fall that give the level it begins at
PEAK = 0.8  # of an overshoot; below it blow-off has ended
MOST_AMBIENT = 1100.0 * MBAR  # Pa; the highest air pressure measured at sea level is 1085 mbar
LEAST_AMBIENT = 500.0 * MBAR  # Pa, at 5.5 km; the highest towns lie at 5.1 km
LEAST_ABSOLUTE = 20.0 * MBAR  # Pa; no ejector evacuates to as little
UNTOLD = "valve delays and the timing of commands cannot be told"


@dataclass(frozen=True)
class Derived:
    """Commands derived for some samples, row by row, with a summary."""

    commands: npt.NDArray[np.uint8]
    suctions: int  # whole or in part
    blown: bool  # releases go above the level of idle: they are blow-offs

    def words(self, lacking: Sequence[str]) -> str:
        """Text on the commands that a file was ``lacking``: what was found, and what cannot be."""
        release_text = (
            "releases go above the level of idle, so they are called blow-off"
            if self.blown
            else "no release goes above the level of idle: whether a blow-off or a vent ends the"
            " vacuum cannot be told, so it is called idle"
        )
        count = f"{self.suctions} suction{'' if self.suctions == 1 else 's'}"
        return (
            f"{' and '.join(lacking)} derived from the pressure: {count}; {release_text}; {UNTOLD}"
        )


def derive(samples: Samples, ambient: float | None = None) -> Derived:
    """Find the commands of a whole record; SourceError with the reason if it shows no cycle.

    ``ambient`` (Pa) is the sensor's reading at ambient pressure, if known. It tells idle from a
    long blow-off.
    """
    traces = list(_traces(samples))
    if not traces:
        raise SourceError("too few usable readings follow on each other", "record at least a cycle")
    move = _least_move(traces)
    edges_by_trace = [(trace, _suctions(trace, move, ambient)) for trace in traces]
    suctions = [suction for _, edges in edges_by_trace for suction in edges]
    if not suctions:
        raise SourceError(
            "the pressure never falls into a vacuum and returns from it, as with suction and"
            " release: there is no cycle in it, but drift",
            "record at least one suction with its release",
        )
    above_idle = [suction.blown is not None for suction in suctions if suction.end < math.inf]
    blown = 2 * sum(above_idle) >= len(above_idle) > 0
    commands = np.zeros(len(samples), np.uint8)
    times = _seconds(samples)
    for trace, edges in edges_by_trace:
        rows = slice(trace.rows[0], trace.rows[-1] + 1)
        for suction in edges:
            stretches = [(suction.begin, suction.end, Command.SUCTION)]
            if blown and suction.blown is not None:
                stretches.append((suction.end, suction.blown, Command.BLOW_OFF))
            for begin, end, command in stretches:
                first, last = np.searchsorted(times[rows], (begin, end))
                commands[rows][first:last] = int(command)
    return Derived(commands, len(suctions), blown)


def _seconds(samples: Samples) -> Floats:
    times: Floats = (samples["time_ns"] - samples["time_ns"][0]) * NS
    return times


# --- readings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Trace:
    """Usable readings of a stretch without a long hole; single spikes are removed."""

    time: Floats  # s
    pressure: Floats  # Pa
    rows: npt.NDArray[np.intp]  # of the samples
    noise: float  # Pa

    def last(self, rows: slice, above: bool, level: float) -> int:
        """Last row in ``rows`` with a pressure above (or below) a level; −1 if there is none."""
        pressure = self.pressure[rows]
        matches = np.flatnonzero(pressure >= level if above else pressure <= level)
        return int(rows.start + matches[-1]) if len(matches) else -1

    def crossing(self, row: int, level: float) -> float:
        """Time (s) at which the line from ``row`` to the next row reaches a level."""
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
    """Noise (Pa) of single readings, from second differences: few rows lie on a bend."""
    return float(np.median(np.abs(np.diff(pressure, 2)))) * MAD_TO_SIGMA / math.sqrt(6.0)


def _least_move(traces: Sequence[_Trace]) -> float:
    """The least fall or return (Pa) beyond noise; SourceError if there is no vacuum."""
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


# --- vacua, and plateaus between them -----------------------------------------------------------


@dataclass(frozen=True)
class _Plateau:
    """Rows from a return to the next fall, as far as the record has them."""

    rows: slice
    level: float  # Pa, where the pressure stays longest: idle
    high: float  # Pa, the highest
    wander: float  # Pa, by which idle may vary: its gas cools


@dataclass(frozen=True)
class _Suction:
    """When suction begins and ends (s), and when an overshoot after it ends, if any (s)."""

    begin: float  # −inf where the record begins in it
    end: float  # inf where the record ends in it
    blown: float | None


def _suctions(trace: _Trace, move: float, ambient: float | None) -> list[_Suction]:
    lows = _vacua(trace, move)
    if not lows or not _is_abrupt(trace):
        return []
    all_plateaus = _plateaus(trace, move, lows, ambient)
    references = [_neighbour_idle(number, all_plateaus) for number in range(len(all_plateaus))]
    plateaus = [
        _as_idle(plateau, reference)
        for plateau, reference in zip(all_plateaus, references, strict=True)
    ]
    if plateaus[0] is not None:  # no blow-off comes before it
        plateaus[0] = all_plateaus[0]
    bounds = [0, *(number for number in range(1, len(lows)) if plateaus[number]), len(lows)]
    suctions = []
    for first, last in pairwise(bounds):
        low = min(lows[first:last], key=lambda row: float(trace.pressure[row]))
        before, after = plateaus[first], plateaus[last]
        reference = references[last if after is None else first]
        is_whole = before is not None and after is not None
        if (
            is_whole
            or reference is None
            or trace.pressure[low] < reference.level - reference.wander
        ):
            suctions.append(_suction(trace, low, before, after))
    return suctions


def _neighbour_idle(number: int, plateaus: list[_Plateau | None]) -> _Plateau | None:
    """Idle according to a plateau's neighbours; None if it has none."""
    numbers = range(max(number - NEAR, 1), min(number + NEAR + 1, len(plateaus)))
    neighbours = [plateau for i in numbers if i != number and (plateau := plateaus[i]) is not None]
    if not neighbours:
        return None
    wander = max(
        plateau.wander for plateau in (plateaus[number], *neighbours) if plateau is not None
    )
    levels, highs = zip(*((plateau.level, plateau.high) for plateau in neighbours), strict=True)
    return _Plateau(slice(0, 0), float(np.median(levels)), float(np.median(highs)), wander)


def _as_idle(plateau: _Plateau | None, reference: _Plateau | None) -> _Plateau | None:
    """A plateau with the level of idle; None if it stays below idle.

    It stays below with an open cup under suction, or one that has lost its part. It stays above in
    a long blow-off.
    """
    if plateau is None or reference is None:
        return plateau
    if plateau.high < reference.level - reference.wander:
        return None
    return (
        plateau
        if plateau.level <= reference.level + reference.wander
        else replace(plateau, level=reference.level)
    )


def _suction(trace: _Trace, low: int, before: _Plateau | None, after: _Plateau | None) -> _Suction:
    return _Suction(
        -math.inf if before is None else _fall(trace, before, low),
        math.inf if after is None else _return(trace, low, after),
        None if after is None else _overshoot(trace, after),
    )


def _is_abrupt(trace: _Trace) -> bool:
    """Whether half of the pressure's range is passed in a small part of the record."""
    pressure, time = np.minimum(trace.pressure, MOST_AMBIENT), trace.time
    marks = np.linspace(time[0], time[-1], round(2.0 / ABRUPT) + 1)
    rows = np.searchsorted(time, marks)
    windows = [pressure[first : last + 1] for first, last in zip(rows, rows[2:], strict=False)]
    most = max(float(np.ptp(window)) for window in windows if len(window))
    return most >= 0.5 * float(np.ptp(pressure))


def _vacua(trace: _Trace, move: float) -> list[int]:
    """Rows at which vacua are deepest, one for each suction."""
    pressure = np.minimum(trace.pressure, MOST_AMBIENT)
    lows, highs = _turns(pressure.tolist(), move)
    middle = 0.5 * (pressure.max() + pressure.min())
    shallow = SHALLOW * float(np.ptp(trace.pressure))
    lows = [row for row in lows if not _is_ringing(trace, row, highs, shallow)]
    if not lows:
        return []
    top = float(np.median([pressure[row] for row in highs if pressure[row] >= middle]))
    deepest = lows[:1]
    for low in lows[1:]:
        saddle = float(pressure[deepest[-1] : low].max())
        above = max(pressure[deepest[-1]], pressure[low])
        if saddle - above >= RETURNED * (top - above):
            deepest.append(low)
        elif pressure[low] < pressure[deepest[-1]]:
            deepest[-1] = low
    return deepest


def _is_ringing(trace: _Trace, low: int, highs: list[int], shallow: float) -> bool:
    """Whether a low is only a ringing line: brief, and less deep than ``shallow`` (Pa)."""
    index = bisect(highs, low)
    first = highs[index - 1] if index else 0
    rows = slice(first, (highs[index] if index < len(highs) else len(trace.time) - 1) + 1)
    pressure = trace.pressure[rows]
    if max(pressure[0], pressure[-1]) - trace.pressure[low] > shallow:
        return False
    side = min(pressure[0], pressure[-1])
    if index in {0, len(highs)}:  # at the record's ends it may be idle after blow-off
        return True
    half = np.flatnonzero(pressure <= 0.5 * (side + trace.pressure[low]))
    return float(trace.time[rows][half[-1]] - trace.time[rows][half[0]]) < BRIEF


def _turns(pressure: list[float], least: float) -> tuple[list[int], list[int]]:
    """Rows of the lows and of the highs, at least ``least`` (Pa) apart."""
    turns: tuple[list[int], list[int]] = ([], [])  # lows, highs
    low = high = 0
    rising: bool | None = None  # direction since the last turn
    for row, value in enumerate(pressure):
        if value < pressure[low]:
            low = row
        if value > pressure[high]:
            high = row
        if rising is not False and pressure[high] - value >= least:
            turns[1].append(high)
            rising, low = False, row
        elif rising is not True and value - pressure[low] >= least:
            turns[0].append(low)
            rising, high = True, row
    if rising is not None:
        turns[int(rising)].append(high if rising else low)
    return turns


def _plateaus(
    trace: _Trace, move: float, lows: list[int], ambient: float | None
) -> list[_Plateau | None]:
    """Plateaus before the first vacuum, between two, and after the last; None where none is."""
    pressure, plateaus = np.minimum(trace.pressure, MOST_AMBIENT), list[_Plateau | None]()
    for before, after in pairwise([None, *lows, None]):
        first = 0 if before is None else before
        stretch = pressure[first : None if after is None else after + 1]
        deep = max(pressure[row] for row in (before, after) if row is not None)
        rise = float(stretch.max()) - deep
        above = np.flatnonzero(stretch >= deep + RETURNED * rise)
        rows = slice(first + int(above[0]), first + int(above[-1]) + 1)
        flat = _flat(trace, rows)
        (level, _), (_, width) = shortest_half(_at_ambient(flat, ambient)), shortest_half(flat)
        wander, high = max(move, 2.0 * width), float(trace.pressure[rows].max())
        plateaus.append(_Plateau(rows, level, high, wander) if rise >= move else None)
    return plateaus


def _flat(trace: _Trace, rows: slice) -> Floats:
    """Pressures (Pa) of the rows less steep than the fall after them; of all rows if none are."""
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


def _at_ambient(flat: Floats, ambient: float | None) -> Floats:
    """The pressures (Pa) near ambient, if it is known and enough are near it; else all."""
    if ambient is None:
        return flat
    near = flat[np.abs(flat - ambient) <= LEAST_MOVE]
    return near if len(near) >= max(NEAR, LEAST_SHARE * len(flat)) else flat


def shortest_half(values: Floats) -> tuple[float, float]:
    """Median and width of the narrowest interval that holds half of the values."""
    ordered = np.sort(values)
    half = (len(ordered) + 1) // 2
    spans = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    first = int(spans.argmin())
    return float(np.median(ordered[first : first + half])), float(spans[first])


# --- edges --------------------------------------------------------------------------------------


def _fall(trace: _Trace, plateau: _Plateau, low: int) -> float:
    """Time (s) at which the pressure leaves idle: the start of a line through its first fall."""
    level, begin = plateau.level, float(trace.time[plateau.rows.start])
    rows = slice(plateau.rows.start, low + 1)
    settled = max(SETTLED, 2.5 * float(np.median(np.diff(trace.time[rows]))))
    for _ in range(LOOKS):
        depth = level - trace.pressure[low]
        step = max(min(ONSET * depth, plateau.wander), CLEAR / 2.0 * trace.noise)
        first, second = (trace.last(rows, True, level - n * step) for n in (1, 2))
        if first < 0:
            return float(trace.time[rows.start])
        crossing_1, crossing_2 = (
            trace.crossing(row, level - n * step) for row, n in ((first, 1), (second, 2))
        )
        still = trace.last(rows, True, level - 0.25 * step)
        begin = max(2.0 * crossing_1 - crossing_2, float(trace.time[max(still, rows.start)]))
        since, until = np.searchsorted(trace.time, (begin - settled, begin))
        before = trace.pressure[max(int(since), rows.start) : int(until) + 1]
        previous, level = level, float(np.median(before)) if len(before) else level
        if abs(level - previous) < 0.1 * step:
            break
    return begin


def _return(trace: _Trace, low: int, plateau: _Plateau) -> float:
    """Time (s) at which a vacuum ends: the start of a line through the foot of the steep rise."""
    rows = slice(low, plateau.rows.start + 1)
    high = max(plateau.level, float(trace.pressure[plateau.rows.start]))
    since, foot = _foot(trace, rows, high)
    level = float(np.median(trace.pressure[since : foot + 1]))
    step = max(ONSET * (high - level), CLEAR / 2.0 * trace.noise)
    first, second = (trace.last(rows, False, level + n * step) for n in (1, 2))
    if first < 0:
        return float(trace.time[foot])
    crossing_1, crossing_2 = (
        trace.crossing(row, level + n * step) for row, n in ((first, 1), (second, 2))
    )
    return max(2.0 * crossing_1 - crossing_2, float(trace.time[since]))


def _foot(trace: _Trace, rows: slice, high: float) -> tuple[int, int]:
    """First and last row of the window just before the rise to ``high`` (Pa) gets steep."""
    low, pressure, time = rows.start, trace.pressure, trace.time
    rise = high - float(pressure[low])
    early, late = (trace.last(rows, False, pressure[low] + share * rise) for share in (0.4, 0.6))
    begins, ends = (
        trace.crossing(row, pressure[low] + share * rise)
        for row, share in ((early, 0.4), (late, 0.6))
    )
    steep = 0.2 * rise / max(ends - begins, NS)
    changes = np.count_nonzero(np.diff(pressure[early : late + 2]))  # a sensor may repeat a reading
    held_s = (time[min(late + 1, len(time) - 1)] - time[early]) / max(changes, 1)
    window = max(CLEAR * trace.noise / steep, 2.0 * held_s)
    rows_up = np.arange(low, early + 1)
    earlier = np.searchsorted(time, time[rows_up] - window, side="right") - 1
    earlier = np.clip(np.minimum(earlier, rows_up - 1), low, None)
    climbed, passed = pressure[rows_up] - pressure[earlier], time[rows_up] - time[earlier]
    last = int(np.flatnonzero(climbed <= FLAT * steep * passed)[-1])
    return int(earlier[last]), low + last


def _overshoot(trace: _Trace, plateau: _Plateau) -> float | None:
    """Time (s) at which the pressure leaves its overshoot above idle; None without one."""
    over = float(trace.pressure[plateau.rows].max()) - plateau.level
    if over < plateau.wander:
        return None
    level = plateau.level + PEAK * over
    return trace.crossing(trace.last(plateau.rows, True, level), level)
