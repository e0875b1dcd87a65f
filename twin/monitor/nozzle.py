"""When the air saving switched the nozzle, from commands and pressure of a whole record.

A suction begins with the nozzle on: the pressure falls. Where the fall ends for good, or until the
pressure turns again, the nozzle went off; where a fall as slow as the first begins, it went on.
Nothing is known of the system, not even whether it saves air. The levels at which it switches are
alike in all suctions: learned in a first pass, they decide where one alone is in doubt.

Where the ejector reports its nozzle, that says how often it switched; the pressure says when.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.inference.levels import MAD_TO_SIGMA
from twin.monitor.alignment import Knee, align
from twin.monitor.breakpoints import (
    Course,
    Floats,
    Noise,
    Rows,
    closer,
    hinge,
    placed,
    rung,
    smoothed,
    stepped,
)
from twin.signals import MBAR, MS, NS, UNUSABLE, Phase, Reported, Samples

LONGEST_GAP, GAP_ROWS = 20.0 * MS, 5.0  # without a reading; beyond it a suction is in two parts
LEAST_VACUUM, LEAST_NOISE, LEAST_ROWS = 20.0 * MBAR, 10.0, 12  # less shows nothing
# A turn is one by so many sigmas of the smoothed pressure, and this share of the vacuum.
TURN, TURN_SHARE = 12.0, 0.015
HALFWAY = 0.5  # of the vacuum; before it the nozzle does not go off
RETURN = 0.25  # of its rise: so near the level where the nozzle went off a fall must come again
SPEED = 0.4  # as slow as the first fall over the same levels; a line that rings is faster
LIKE_OTHERS, MOST = 0.5, 0.8  # of the hysteresis; quantile of all rises that is taken for it
# Where a fall is looked at, in shares of it from its end, for the first of a suction and for later
# ones. The time from one to the other is its scale.
FIRST_FALL, LATER_FALL = (0.16, 0.06), (0.5, 0.2)
NEAR_THE_END = 0.06, 0.15  # of a fall: the nozzle goes off there
BINS = 32  # in a fall's scale
BEFORE, AFTER = (0.25, 0.5, 1.0, 2.0), (1.0, 0.5, 0.25)  # windows: of the scale, and of that before
FALLING, RISING = 0.05, 0.1  # of the fall's slope: before the break, or after it
ENDED = 0.35  # of the slope before it
# The slope breaks by this share of the fall's own; by less where it is as clear as that, or where
# the pressure then rises by that share of the vacuum (a supply that wanders moves it less), or at
# the level of the others.
BREAKS, BREAKS_CLEARLY, BREAKS_AS_KNOWN, CLEARLY, RISES = 0.32, 0.2, 0.1, 100.0, 0.012
# Sigmas: in the first pass, then at the level of others, and where no others say so.
CLEAR, CLEAR_AT_LEVEL, CLEAR_ALONE = 8.0, 5.0, 16.0
OTHERS = 1.0 / 3.0  # of the suctions must show it go off for its levels to be known
SIGMAS_OF_LEVEL, SHARE_OF_LEVEL = 5.0, 0.02  # as near to it
# A reported switching shows within so long of its report (a valve, and a slow IO-Link cycle); share
# of the readings in suction that must have a report.
TOLD_WITHIN, MOST_TOLD = 50.0 * MS, 0.98
ON_WITHIN, ON_WINDOW = 20.0 * MS, 40  # about the turn; rows on either side that show the slopes


class Switching(NamedTuple):
    """The air saving has switched the nozzle."""

    row: int  # from which on it shows
    on: bool
    time: float  # s, since the record began


@dataclass(frozen=True)
class Levels:
    """At which pressures (Pa) the nozzle switches in a record."""

    off: float = np.nan  # where few suctions show it
    sigma: float = np.nan
    hysteresis: float = 0.0  # where few suctions show it go on again
    held: float = -np.inf  # up to which it stays off

    @classmethod
    def of(cls, knees: Sequence[Knee], suctions: int) -> "Levels":
        """Those of the knees that were found so far, in so many suctions."""
        offs = np.array([knee.level for knee in knees if not knee.on])
        if len(offs) <= OTHERS * suctions:
            return cls()
        off = float(np.median(offs))
        rises = [knee.level - off for knee in knees if knee.on]
        held = [knee.held for knee in knees if np.isfinite(knee.held)]
        return cls(
            off,
            MAD_TO_SIGMA * float(np.median(np.abs(offs - off))),
            float(np.quantile(rises, MOST)) if len(rises) > OTHERS * suctions else 0.0,
            float(np.quantile(held, MOST)) if held else -np.inf,
        )


def noise_of(samples: Samples, phase: npt.NDArray[np.uint8]) -> Noise:
    """How the readings of a record scatter; ``phase`` as in ``switchings``."""
    time, pressure, sucks, rows = _readings(samples, phase)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 1.0 * MS
    falls = _falls(pressure, _suctions(time, sucks, period))
    return Noise.of(pressure, pressure[phase[rows] == Phase.IDLE], period, falls)


def switchings(samples: Samples, phase: npt.NDArray[np.uint8], noise: Noise) -> list[Switching]:
    """Find all in ``samples``; ``phase`` is what commands alone make of each row."""
    time, pressure, sucks, rows = _readings(samples, phase)
    if np.count_nonzero(sucks) < LEAST_ROWS:
        return []
    course = Course(time, pressure, noise)
    suctions = list(_suctions(time, sucks, noise.period))
    said = samples["reported"][rows]
    knees = _found(course, suctions)
    found = [(knee.time, knee.on) for knee in knees]
    if reports_nozzle(said[sucks]):
        found = sorted(_told(time, suctions, knees, (said & np.uint8(Reported.NOZZLE)) != 0))
    return [Switching(int(rows[np.searchsorted(time, when)]), on, when) for when, on in found]


def reports_nozzle(said: npt.NDArray[np.uint8]) -> bool:
    """Whether the ejector reports its nozzle in rows whose ``reported`` these are."""
    return bool(np.mean((said & np.uint8(Reported.NOZZLE_KNOWN)) != 0) > MOST_TOLD)


def told_edges(on: npt.NDArray[np.bool_]) -> list[int]:
    """Rows of a suction at which the nozzle is reported to switch; it begins on.

    What is reported may be late, so a nozzle that is off as suction begins goes on with it.
    """
    edges = (np.flatnonzero(np.diff(on)) + 1).tolist()
    return edges if not len(on) or on[0] else edges[1:]


def _told(
    time: Floats, suctions: Sequence[Rows], shown: Sequence[Knee], on: npt.NDArray[np.bool_]
) -> Iterator[tuple[float, bool]]:
    """When (s) the nozzle switched for each report of it, and whether it went on.

    That is when the pressure shows it; where it does not, as long after the report as elsewhere.
    """
    rows = np.array([a + row for a, b in suctions for row in told_edges(on[a:b])], np.int64)
    for opens in (False, True):
        reported = time[rows[on[rows] == opens]]
        late = np.array([[knee.time for knee in shown if knee.on == opens]]) - reported[:, None]
        late = np.column_stack([late, np.full(len(reported), np.inf)])  # there may be none
        late = late[np.arange(len(reported)), np.abs(late).argmin(axis=1)]
        shows = np.abs(late) < TOLD_WITHIN
        usual = float(np.median(late[shows])) if shows.any() else 0.0
        for when in (reported + np.where(shows, late, usual)).tolist():
            yield min(when, float(time[-1])), opens


def _readings(
    samples: Samples, phase: npt.NDArray[np.uint8]
) -> tuple[Floats, Floats, npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Time (s) and pressure (Pa) of readings that can be used, if suction is on, and their rows."""
    rows = np.flatnonzero(((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"]))
    time = (samples["time_ns"][rows] - samples["time_ns"][:1]) * NS
    return time, samples["pressure"][rows].astype(np.float64), phase[rows] == Phase.SUCTION, rows


def _suctions(time: Floats, sucks: npt.NDArray[np.bool_], period: float) -> Iterator[Rows]:
    """Stretches of suction without a gap."""
    apart = np.diff(time)
    gap = (apart > max(LONGEST_GAP, GAP_ROWS * period)) | (apart <= 0.0)
    edges = np.flatnonzero(gap | np.diff(sucks)) + 1
    for first, last in pairwise([0, *edges.tolist(), len(time)]):
        if sucks[first]:
            yield first, last


def _falls(pressure: Floats, suctions: Iterable[Rows]) -> Floats:
    """Change from row to row where the pressure falls steeply."""
    parts = [np.empty(0)]
    for first, last in suctions:
        part = pressure[first:last]
        share = (part - part.min()) / max(float(part[0] - part.min()), 1.0)
        parts.append(np.diff(part)[((share > 0.3) & (share < 0.9))[1:]])
    return np.concatenate(parts)


def _found(course: Course, suctions: Sequence[Rows]) -> list[Knee]:
    """All knees that the pressure of a record shows, in order of time."""
    levels: Levels | None = None
    knees = list[Knee]()
    for _ in range(2):
        knees = [knee for suction in suctions for knee in _Suction(course, suction, levels).knees()]
        levels = Levels.of(knees, len(suctions))
    for on in (False, True):
        align(course, [knee for knee in knees if knee.on == on])
    return sorted(knees, key=lambda knee: knee.time)


@dataclass(frozen=True)
class _Suction:
    """One suction, and the levels of others, if they are known."""

    course: Course
    rows: Rows
    levels: Levels | None

    def knees(self) -> Iterator[Knee]:
        """Its knees in order: off, on, off, and so on."""
        first, last = self.rows
        if last - first < LEAST_ROWS:
            return
        smooth = smoothed(self.course.pressure[first:last], self.course.noise.width)
        depth = float(smooth[0] - smooth.min())
        if depth < max(LEAST_VACUUM, LEAST_NOISE * self.course.noise.single):
            return
        edges = [0, *self._goes_on(smooth, depth), len(smooth)]
        room = first
        for begin, end in pairwise(edges):
            again = end < len(smooth)
            off = self._off(smooth[begin:end], first + begin, first + end, again)
            if off is None:
                continue
            off.rows = (room, off.rows[1])
            if not again:
                off.held = float(smooth[-1])
                yield off
                return
            on = self._on(off, first + end)
            off.rows = (room, self.course.row(on.time, on.rows))
            yield off
            yield on
            room = self.course.row(on.time, on.rows)

    def _goes_on(self, smooth: Floats, depth: float) -> list[int]:
        """Rows at which a fall begins again that is the nozzle's."""
        least = max(TURN * self.course.noise.quiet, TURN_SHARE * depth)
        known = LIKE_OTHERS * self.levels.hysteresis if self.levels else 0.0
        off_until = self.levels.held - least if self.levels else -np.inf
        begin = int((smooth < smooth[0] - HALFWAY * depth).argmax())
        rows = [begin + row for row in turns(smooth[begin:], least)]
        lows, highs = rows[0::2], rows[1::2]
        lowest = np.minimum.accumulate(smooth)
        found = [0]
        for number, high in enumerate(highs):
            ends = number + 1 == len(lows)  # suction does, before the nozzle goes off
            low = high + int(smooth[high:].argmin()) if ends else lows[number + 1]
            rise = float(smooth[high] - smooth[found[-1] : high].min())
            fall = float(smooth[high] - smooth[low])
            comes_back = ends or smooth[low] <= smooth[high] - (1.0 - RETURN) * rise
            too_low = rise < known or smooth[high] < off_until
            if min(fall, rise) < least or too_low or not comes_back:
                continue
            between = smooth[high] - 0.25 * fall, smooth[high] - 0.75 * fall
            slow = _lasts(smooth[high:], *between) + 1 >= SPEED * _lasts(lowest, *between)
            if known or slow:
                found.append(high)
        return found[1:]

    def _off(self, smooth: Floats, first: int, last: int, again: bool) -> Knee | None:
        """Where the nozzle goes off in one fall and what follows it.

        If it goes on ``again`` it did. None if it did not.
        """
        course = self.course
        later = first > self.rows[0]
        lowest = float(smooth.min())
        depth = float(smooth[0]) - lowest
        high, low = LATER_FALL if later else FIRST_FALL
        begin = _passes(smooth, lowest + high * depth, 0)
        rows = max(_passes(smooth, lowest + low * depth, len(smooth)) - begin, 4)
        scale = rows * course.period
        slope = (high - low) * depth / scale
        best = self._clearest(_Fall(first, last, begin, rows, slope, lowest, depth, later))
        if not again:
            if best is None:
                return None
            rise = float(smooth[best.row - first :].max()) - best.level
            if not self._is_off(best, rise, depth):
                return None
        row = best.row if best else first + int(smooth.argmin())
        jump = max(best.share if best else 1.0, 0.2) * slope
        window = max(best.window if best else rows // 4, 6)
        beside = first + max(begin - rows, 0), last
        row, window = closer(course, beside, row, window, jump)
        near = placed(course, beside, row, max(window // 2, 3), max(rows, 8), jump)
        row = course.row(near.time, beside) if near else row
        at_step = stepped(course, beside, row, max(window, rows // 4, 12), jump)
        found = at_step or near
        time, level = (found.time, found.level) if found else (float(course.time[row]), lowest)
        if first_swing := rung(course, beside, time, scale):
            time, level = first_swing.time, first_swing.level
            at_step = first_swing
        jump = near.jump if near and not at_step else jump
        return Knee(False, time, level, (first, last), jump, scale, at_step is not None)

    def _is_off(self, best: "_Clear", rise: float, depth: float) -> bool:
        """Whether the slope breaks clearly enough, here or at the level where it does elsewhere."""
        least, at_level = CLEAR, False
        if self.levels:
            near = max(SIGMAS_OF_LEVEL * self.levels.sigma, SHARE_OF_LEVEL * depth)
            at_level = abs(best.level - self.levels.off) < near
            least = CLEAR_AT_LEVEL if at_level else CLEAR_ALONE
        share = BREAKS_CLEARLY if best.clear >= CLEARLY else BREAKS
        share = BREAKS_AS_KNOWN if at_level or rise >= RISES * depth else share
        return best.clear >= least and best.share >= share

    def _clearest(self, fall: "_Fall") -> "_Clear | None":
        """Where the slope breaks most clearly as it does when the nozzle goes off."""
        course = self.course
        many = max(1, fall.scale // BINS)
        lasts = many * course.period
        count = (fall.last - fall.first) // many
        means = course.pressure[fall.first : fall.first + count * many]
        means = means.reshape(count, many).mean(axis=1)
        level = np.convolve(means, np.ones(3) / 3.0, "same")
        sigma = np.sqrt(course.noise.at(fall.slope) / lasts)
        side = int(np.ceil(course.noise.side / lasts))
        windows = {max(int(fall.scale / many * one), side, 4) for one in BEFORE}
        best = None
        for before, after in sorted(
            {(one, max(int(one * share), side, 4)) for one in windows for share in AFTER}
        ):
            if count < before + after + 1:
                continue
            places = np.arange(before, count - after)
            filter_ = hinge(before, after)
            breaks = np.correlate(means, filter_, "valid") / lasts  # Pa/s
            line = np.arange(after + 1.0) - 0.5 * after
            slopes = np.correlate(means, line / (line @ line), "valid") / lasts
            left, right = slopes[places - after], slopes[places]
            may_be = (places >= fall.begin // many) & (breaks > 0.0)
            may_be &= (places - before) * many >= fall.begin - max(fall.scale, side * many)
            may_be &= level[places] <= fall.lowest + NEAR_THE_END[fall.later] * fall.depth
            may_be &= (left < -FALLING * fall.slope) | (right > RISING * fall.slope)
            may_be &= right > ENDED * left
            clear = np.where(may_be, breaks * lasts / (sigma * np.linalg.norm(filter_)), 0.0)
            at = int(clear.argmax())
            if clear[at] > (best.clear if best else 0.0):
                best = _Clear(
                    fall.first + int(places[at]) * many + many // 2,
                    float(clear[at]),
                    float(breaks[at]) / fall.slope,
                    float(means[places[at]]),
                    min(before, after) * many,
                )
        return best

    def _on(self, off: Knee, row: int) -> Knee:
        """Where the nozzle goes on about the turn at ``row``."""
        course = self.course
        first = course.row(off.time, (off.rows[0], row))
        last = self.rows[1]
        since = max(row - first, 6)
        half = max(min(since // 2, ON_WINDOW), 2)
        before, after = max(row - half, 0), min(row + half, last - 1)
        here = float(course.pressure[row])
        jump = max(here - float(course.pressure[before]), 0.0) / (half * course.period)
        jump += max(here - float(course.pressure[after]), 0.0) / (half * course.period)
        jump = max(jump, 1e-3)
        reach = max(3, min(since // 4, int(ON_WITHIN / course.period)))
        near = placed(course, (first + 1, last), row, reach, max(since, 8), -jump)
        scale = since * course.period
        if near is None:
            return Knee(True, float(course.time[row]), here, (first, last), jump, scale)
        return Knee(True, near.time, near.level, (first, last), near.jump, scale)


class _Fall(NamedTuple):
    """A fall of the pressure, and what follows it."""

    first: int  # row
    last: int  # exclusive
    begin: int  # rows after the first, from which on the nozzle may go off
    scale: int  # rows
    slope: float  # Pa/s, that it falls by over its scale
    lowest: float  # Pa
    depth: float  # Pa
    later: bool  # not the first of its suction


class _Clear(NamedTuple):
    """The clearest break of the slope in a fall."""

    row: int
    clear: float  # sigmas
    share: float  # of the fall's slope
    level: float  # Pa
    window: int  # rows


def turns(smooth: Floats, least: float) -> list[int]:
    """Rows of lows and highs in turn, a low first, between which it moves by ``least`` or more.

    It begins by falling. A last one that nothing follows is none.
    """
    found, falling, best, value_there = list[int](), True, 0, float(smooth[0])
    for row, value in enumerate(smooth.tolist()):
        if (value < value_there) if falling else (value > value_there):
            best, value_there = row, value
        elif abs(value - value_there) >= least:
            found.append(best)
            falling, best, value_there = not falling, row, value
    return found


def _passes(falling: Floats, level: float, otherwise: int) -> int:
    """The first row at or below ``level``."""
    below = falling <= level
    row = int(below.argmax())
    return row if below[row] else otherwise


def _lasts(falling: Floats, begin: float, end: float) -> int:
    """Rows from one level down to the other."""
    return _passes(falling, end, len(falling)) - _passes(falling, begin, 0)
