"""Switchings of the nozzle by the air saving, from commands and pressure of a whole record.

A suction begins with the nozzle on: the pressure falls. The nozzle went off where the fall ends,
for good or until the pressure turns again. It went on where a fall as slow as the first begins. No
model of the system is used; the system may lack air saving. The switching levels are similar in all
suctions: a first pass learns them, and they decide doubtful cases in the second.

If the ejector reports its nozzle, the report says how often it switched; the pressure says when.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.inference.levels import MAD_TO_SIGMA
from twin.monitor.alignment import Breakpoint, align, align_by_curve, align_by_level
from twin.monitor.breakpoints import (
    Floats,
    Noise,
    PressureCurve,
    Rows,
    closer,
    hinge,
    placed,
    rung,
    smoothed,
    stepped,
    turns,
)
from twin.quality import UNUSABLE
from twin.signals import MBAR, MS, NS, Phase, Reported, Samples

LONGEST_GAP, GAP_ROWS = 20.0 * MS, 5.0  # without a reading; a longer gap splits a suction
LEAST_VACUUM, LEAST_NOISE, LEAST_ROWS = 20.0 * MBAR, 10.0, 12  # depth of a suction: Pa, noise, rows
# Least height of a turn: sigmas of the smoothed pressure, and share of the vacuum.
TURN, TURN_SHARE = 12.0, 0.015
HALFWAY = 0.5  # least share of the vacuum at which the nozzle goes off
RETURN = 0.25  # of the rise: how near a new fall must come to the level where the nozzle went off
SPEED = 0.4  # least duration of a new fall over that of the first; a ringing line is faster
# Least rise over the hysteresis, if a slow fall follows or not; quantile of rises taken for it.
LIKE_OTHERS, AS_OTHERS, MOST = 0.5, 0.8, 0.8
# Levels between which a fall's scale is timed, as shares from its end: for the first fall of a
# suction, and for later ones.
FIRST_FALL, LATER_FALL = (0.16, 0.06), (0.5, 0.2)
NEAR_THE_END = 0.06, 0.15  # share of a fall, from its end, in which the nozzle goes off
BINS = 32  # in a fall's scale
BEFORE, AFTER = (0.25, 0.5, 1.0, 2.0), (1.0, 0.5, 0.25)  # windows: over the scale; over that before
FALLING, RISING = 0.05, 0.1  # least slopes over the fall's: before the break, or after it
ENDED = 0.35  # largest slope after the break, over that before it
# Least break of the slope, over the fall's slope. It is lower if the break is clearer than CLEARLY
# (sigmas), if the pressure then rises by RISES of the vacuum (a wandering supply moves it less), or
# at the level of the other suctions.
BREAKS, BREAKS_CLEARLY, BREAKS_AS_KNOWN, CLEARLY, RISES = 0.32, 0.2, 0.1, 100.0, 0.012
# Least significance (sigmas): in the first pass, then at the known level, and away from it.
CLEAR, CLEAR_AT_LEVEL, CLEAR_ALONE = 8.0, 5.0, 16.0
OTHERS = 1.0 / 3.0  # share of the suctions that must show a switching for its level to be known
SIGMAS_OF_LEVEL, SHARE_OF_LEVEL = 5.0, 0.02  # largest distance from it: sigmas, or of the vacuum
SHARE_OF_USUAL = 0.08  # largest distance (of the vacuum) from a known unit's level: it may change
# Longest time from a report to its switching in the pressure (a valve, and a slow IO-Link cycle);
# least share of readings in suction with a report.
TOLD_WITHIN, MOST_TOLD = 50.0 * MS, 0.98
ON_WITHIN, ON_WINDOW = 20.0 * MS, 40  # search about the turn; rows on either side for the slopes


class Switching(NamedTuple):
    """A switching of the nozzle by the air saving."""

    row: int  # first row after it
    on: bool
    time: float  # s, since the record began


@dataclass(frozen=True)
class Levels:
    """Pressures (Pa) at which the nozzle switches in a record."""

    off: float = np.nan  # NaN if few suctions show it
    sigma: float = np.nan
    hysteresis: float = 0.0  # 0 if few suctions show the nozzle go on again
    held: float = -np.inf  # pressure up to which the nozzle stays off

    @classmethod
    def of(cls, breakpoints: Sequence[Breakpoint], suctions: int) -> "Levels":
        """Levels of the breakpoints found so far, in so many suctions."""
        offs = np.array([point.level for point in breakpoints if not point.on])
        if len(offs) <= OTHERS * suctions:
            return cls()
        off = float(np.median(offs))
        rises = [point.level - off for point in breakpoints if point.on]
        held = [point.held for point in breakpoints if np.isfinite(point.held)]
        return cls(
            off,
            MAD_TO_SIGMA * float(np.median(np.abs(offs - off))),
            float(np.quantile(rises, MOST)) if len(rises) > OTHERS * suctions else 0.0,
            float(np.quantile(held, MOST)) if held else -np.inf,
        )


def shows_suction(samples: Samples, phase: npt.NDArray[np.uint8]) -> bool:
    """Whether there are readings in suction to search; ``phase`` as in ``switchings``."""
    _, _, sucks, _ = _readings(samples, phase)
    return bool(np.count_nonzero(sucks) >= LEAST_ROWS)


def noise_of(samples: Samples, phase: npt.NDArray[np.uint8]) -> Noise:
    """Noise of a record's readings; ``phase`` as in ``switchings``."""
    time, pressure, sucks, rows = _readings(samples, phase)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 1.0 * MS
    falls = _falls(pressure, _suctions(time, sucks, period))
    return Noise.of(pressure, pressure[phase[rows] == Phase.IDLE], period, falls)


def switchings(
    samples: Samples, phase: npt.NDArray[np.uint8], noise: Noise, usual: float = np.nan
) -> list[Switching]:
    """Find all switchings in ``samples``; ``phase`` follows from commands alone.

    ``usual`` is the pressure (Pa) at which the nozzle of a known unit goes off.
    """
    time, pressure, sucks, rows = _readings(samples, phase)
    if np.count_nonzero(sucks) < LEAST_ROWS:
        return []
    curve = PressureCurve(time, pressure, noise)
    suctions = list(_suctions(time, sucks, noise.period))
    reported = samples["reported"][rows]
    breakpoints = _all_breakpoints(curve, suctions, usual)
    switch_times = [(point.time, point.on) for point in breakpoints]
    if reports_nozzle(reported[sucks]):
        switch_times = sorted(
            _reported_switchings(
                time, suctions, breakpoints, (reported & np.uint8(Reported.NOZZLE)) != 0
            )
        )
    return [Switching(int(rows[np.searchsorted(time, at)]), on, at) for at, on in switch_times]


def reports_nozzle(reported: npt.NDArray[np.uint8]) -> bool:
    """Whether the ejector reports its nozzle in rows whose ``reported`` these are."""
    return bool(np.mean((reported & np.uint8(Reported.NOZZLE_KNOWN)) != 0) > MOST_TOLD)


def told_edges(on: npt.NDArray[np.bool_]) -> list[int]:
    """Rows of a suction at which the nozzle is reported to switch; it begins on.

    A report may be late, so a nozzle that is reported off as suction begins goes on with it.
    """
    edges = (np.flatnonzero(np.diff(on)) + 1).tolist()
    return edges if not len(on) or on[0] else edges[1:]


def _reported_switchings(
    time: Floats, suctions: Sequence[Rows], shown: Sequence[Breakpoint], on: npt.NDArray[np.bool_]
) -> Iterator[tuple[float, bool]]:
    """Time (s) of each reported switching, and whether the nozzle went on.

    The time is that of the breakpoint in the pressure. If there is none, it is the time of the
    report with the median delay of the others.
    """
    rows = np.array([a + row for a, b in suctions for row in told_edges(on[a:b])], np.int64)
    for opens in (False, True):
        reported = time[rows[on[rows] == opens]]
        delays = (
            np.array([[point.time for point in shown if point.on == opens]]) - reported[:, None]
        )
        delays = np.column_stack([delays, np.full(len(reported), np.inf)])  # there may be none
        delays = delays[np.arange(len(reported)), np.abs(delays).argmin(axis=1)]
        is_shown = np.abs(delays) < TOLD_WITHIN
        median_delay = float(np.median(delays[is_shown])) if is_shown.any() else 0.0
        for at in (reported + np.where(is_shown, delays, median_delay)).tolist():
            yield min(at, float(time[-1])), opens


def _readings(
    samples: Samples, phase: npt.NDArray[np.uint8]
) -> tuple[Floats, Floats, npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Time (s) and pressure (Pa) of usable readings, whether suction is on, and their rows."""
    rows = np.flatnonzero(((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"]))
    time = (samples["time_ns"][rows] - samples["time_ns"][:1]) * NS
    return time, samples["pressure"][rows].astype(np.float64), phase[rows] == Phase.SUCTION, rows


def _suctions(time: Floats, sucks: npt.NDArray[np.bool_], period: float) -> Iterator[Rows]:
    """Stretches of suction without a gap."""
    intervals = np.diff(time)
    gap = (intervals > max(LONGEST_GAP, GAP_ROWS * period)) | (intervals <= 0.0)
    edges = np.flatnonzero(gap | np.diff(sucks)) + 1
    for first, last in pairwise([0, *edges.tolist(), len(time)]):
        if first < last and sucks[first]:
            yield first, last


def _falls(pressure: Floats, suctions: Iterable[Rows]) -> Floats:
    """Change from row to row where the pressure falls steeply."""
    parts = [np.empty(0)]
    for first, last in suctions:
        part = pressure[first:last]
        share = (part - part.min()) / max(float(part[0] - part.min()), 1.0)
        parts.append(np.diff(part)[((share > 0.3) & (share < 0.9))[1:]])
    return np.concatenate(parts)


def _all_breakpoints(
    curve: PressureCurve, suctions: Sequence[Rows], usual: float
) -> list[Breakpoint]:
    """All breakpoints that the pressure of a record shows, in order of time."""
    levels: Levels | None = None
    breakpoints = list[Breakpoint]()
    for _ in range(2):
        breakpoints = [
            point
            for suction in suctions
            for point in _Suction(curve, suction, levels, usual).breakpoints()
        ]
        levels = Levels.of(breakpoints, len(suctions))
    for on in (False, True):
        align(curve, [point for point in breakpoints if point.on == on])
    align_by_level(curve, [point for point in breakpoints if not point.on])
    for later in (False, True):
        align_by_curve(
            curve, [point for point in breakpoints if not point.on and point.later == later]
        )
    return sorted(breakpoints, key=lambda point: point.time)


@dataclass(frozen=True)
class _Suction:
    """One suction, and the levels of all suctions if they are known."""

    curve: PressureCurve
    rows: Rows
    levels: Levels | None
    usual: float  # Pa, or NaN

    def breakpoints(self) -> Iterator[Breakpoint]:
        """Breakpoints of the suction in order: off, on, off, and so on."""
        first, last = self.rows
        if last - first < LEAST_ROWS:
            return
        smooth = smoothed(self.curve.pressure[first:last], self.curve.noise.width)
        depth = float(smooth[0] - smooth.min())
        if depth < max(LEAST_VACUUM, LEAST_NOISE * self.curve.noise.single):
            return
        edges = [0, *self._restarts(smooth, depth), len(smooth)]
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
            off.rows = (room, self.curve.row(on.time, on.rows))
            yield off
            yield on
            room = self.curve.row(on.time, on.rows)

    def _restarts(self, smooth: Floats, depth: float) -> list[int]:
        """Rows at which the pressure falls again because the nozzle went on."""
        least = max(TURN * self.curve.noise.quiet, TURN_SHARE * depth)
        least_rise = LIKE_OTHERS * self.levels.hysteresis if self.levels else 0.0
        off_until = self.levels.held - least if self.levels else -np.inf
        begin = int((smooth < smooth[0] - HALFWAY * depth).argmax())
        rows = [begin + row for row in turns(smooth[begin:], least)]
        lows, highs = rows[0::2], rows[1::2]
        lowest = np.minimum.accumulate(smooth)
        restarts = [0]
        for number, high in enumerate(highs):
            ends = number + 1 == len(lows)  # suction ends before the nozzle goes off again
            low = high + int(smooth[high:].argmin()) if ends else lows[number + 1]
            rise = float(smooth[high] - smooth[restarts[-1] : high].min())
            fall = float(smooth[high] - smooth[low])
            returns = ends or smooth[low] <= smooth[high] - (1.0 - RETURN) * rise
            too_low = rise < least_rise or smooth[high] < off_until
            if min(fall, rise) < least or too_low or not returns:
                continue
            between = smooth[high] - 0.25 * fall, smooth[high] - 0.75 * fall
            slow = _rows_between(smooth[high:], *between) + 1 >= SPEED * _rows_between(
                lowest, *between
            )
            if slow or (self.levels and rise >= AS_OTHERS * self.levels.hysteresis > 0.0):
                restarts.append(high)
        return restarts[1:]

    def _off(self, smooth: Floats, first: int, last: int, again: bool) -> Breakpoint | None:
        """The breakpoint at which the nozzle goes off in one fall; None if it does not.

        If it goes on ``again``, it must have gone off.
        """
        curve = self.curve
        later = first > self.rows[0]
        lowest = float(smooth.min())
        depth = float(smooth[0]) - lowest
        high, low = LATER_FALL if later else FIRST_FALL
        begin = _first_below(smooth, lowest + high * depth, 0)
        rows = max(_first_below(smooth, lowest + low * depth, len(smooth)) - begin, 4)
        scale = rows * curve.period
        slope = (high - low) * depth / scale
        best = self._clearest_break(_Fall(first, last, begin, rows, slope, depth, later))
        if not again:
            if best is None:
                return None
            rise = float(smooth[best.row - first :].max()) - best.level
            if not self._is_off(best, rise, depth):
                return None
        row = best.row if best else first + int(smooth.argmin())
        jump = max(best.share if best else 1.0, 0.2) * slope
        window = max(best.window if best else rows // 4, 6)
        rows_around = first + max(begin - rows, 0), last
        row, window = closer(curve, rows_around, row, window, jump)
        placed_break = placed(curve, rows_around, row, max(window // 2, 3), max(rows, 8), jump)
        row = curve.row(placed_break.time, rows_around) if placed_break else row
        stepped_break = stepped(curve, rows_around, row, max(window, rows // 4, 12), jump)
        best_break = stepped_break or placed_break
        time, level = (
            (best_break.time, best_break.level) if best_break else (float(curve.time[row]), lowest)
        )
        if first_swing := rung(curve, rows_around, time, scale):
            time, level = first_swing.time, first_swing.level
            stepped_break = first_swing
        jump = placed_break.jump if placed_break and not stepped_break else jump
        return Breakpoint(
            False, time, level, (first, last), jump, scale, stepped_break is not None, later
        )

    def _is_off(self, best: "_SlopeBreak", rise: float, depth: float) -> bool:
        """Whether a break is clear enough; limits are lower at the level of the other suctions."""
        levels = self.levels
        if levels and np.isfinite(levels.off):
            tolerance = max(SIGMAS_OF_LEVEL * levels.sigma, SHARE_OF_LEVEL * depth)
            at_level = abs(best.level - levels.off) < tolerance
        else:  # no levels yet
            at_level = abs(best.level - self.usual) < SHARE_OF_USUAL * depth
        least = CLEAR_AT_LEVEL if at_level else CLEAR_ALONE if levels else CLEAR
        share = BREAKS_CLEARLY if best.clear >= CLEARLY else BREAKS
        share = BREAKS_AS_KNOWN if at_level or rise >= RISES * depth else share
        return best.clear >= least and best.share >= share

    def _clearest_break(self, fall: "_Fall") -> "_SlopeBreak | None":
        """The most significant break of the slope that is like that of the nozzle going off."""
        curve = self.curve
        rows_per_bin = max(1, fall.scale // BINS)
        bin_time = rows_per_bin * curve.period
        count = (fall.last - fall.first) // rows_per_bin
        means = curve.pressure[fall.first : fall.first + count * rows_per_bin]
        means = means.reshape(count, rows_per_bin).mean(axis=1)
        padded = np.pad(means, 1, "edge")  # a line without flow raises the pressure at once
        level = np.minimum(np.minimum(padded[:-2], padded[2:]), means)
        sigma = np.sqrt(curve.noise.at(fall.slope) / bin_time)
        side = int(np.ceil(curve.noise.side / bin_time))
        windows = {max(int(fall.scale / rows_per_bin * width), side, 4) for width in BEFORE}
        best = None
        for before, after in sorted(
            {(width, max(int(width * share), side, 4)) for width in windows for share in AFTER}
        ):
            if count < before + after + 1:
                continue
            bins = np.arange(before, count - after)
            filter_ = hinge(before, after)
            breaks = np.correlate(means, filter_, "valid") / bin_time  # Pa/s
            line = np.arange(after + 1.0) - 0.5 * after
            slopes = np.correlate(means, line / (line @ line), "valid") / bin_time
            left, right = slopes[bins - after], slopes[bins]
            is_candidate = (bins >= fall.begin // rows_per_bin) & (breaks > 0.0)
            is_candidate &= (bins - before) * rows_per_bin >= fall.begin - max(
                fall.scale, side * rows_per_bin
            )
            is_candidate &= level[bins] <= means.min() + NEAR_THE_END[fall.later] * fall.depth
            is_candidate &= (left < -FALLING * fall.slope) | (right > RISING * fall.slope)
            is_candidate &= right > ENDED * left
            clear = np.where(
                is_candidate, breaks * bin_time / (sigma * np.linalg.norm(filter_)), 0.0
            )
            clearest = int(clear.argmax())
            if clear[clearest] > (best.clear if best else 0.0):
                best = _SlopeBreak(
                    fall.first + int(bins[clearest]) * rows_per_bin + rows_per_bin // 2,
                    float(clear[clearest]),
                    float(breaks[clearest]) / fall.slope,
                    float(means[bins[clearest]]),
                    min(before, after) * rows_per_bin,
                )
        return best

    def _on(self, off: Breakpoint, row: int) -> Breakpoint:
        """The breakpoint at which the nozzle goes on, about the turn at ``row``."""
        curve = self.curve
        first = curve.row(off.time, (off.rows[0], row))
        last = self.rows[1]
        since = max(row - first, 6)
        half = max(min(since // 2, ON_WINDOW), 2)
        before, after = max(row - half, 0), min(row + half, last - 1)
        turn_pressure = float(curve.pressure[row])
        jump = max(turn_pressure - float(curve.pressure[before]), 0.0) / (half * curve.period)
        jump += max(turn_pressure - float(curve.pressure[after]), 0.0) / (half * curve.period)
        jump = max(jump, 1e-3)
        reach = max(3, min(since // 4, int(ON_WITHIN / curve.period)))
        rows_around, scale = (first + 1, last), since * curve.period
        point = Breakpoint(True, float(curve.time[row]), turn_pressure, (first, last), jump, scale)
        placed_break = placed(curve, rows_around, row, reach, max(since, 8), -jump)
        if stepped_break := stepped(curve, rows_around, row, max(half, 12), -jump):
            point.time, point.level, point.stepped = stepped_break.time, stepped_break.level, True
        elif placed_break:
            point.time, point.level = placed_break.time, placed_break.level
            point.jump = placed_break.jump
        return point


class _Fall(NamedTuple):
    """A fall of the pressure, and what follows it."""

    first: int  # row
    last: int  # exclusive
    begin: int  # rows after ``first`` from which the nozzle may go off
    scale: int  # rows
    slope: float  # Pa/s, mean of the fall over its scale
    depth: float  # Pa
    later: bool  # not the first of its suction


class _SlopeBreak(NamedTuple):
    """The most significant break of the slope in a fall."""

    row: int
    clear: float  # sigmas
    share: float  # of the fall's slope
    level: float  # Pa
    window: int  # rows


def _first_below(falling: Floats, level: float, default: int) -> int:
    """The first row at or below ``level``, or the default."""
    below = falling <= level
    row = int(below.argmax())
    return row if below[row] else default


def _rows_between(falling: Floats, begin: float, end: float) -> int:
    """Rows from one level down to another."""
    return _first_below(falling, end, len(falling)) - _first_below(falling, begin, 0)
