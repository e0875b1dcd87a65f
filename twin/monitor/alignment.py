"""Align the breakpoints of one kind: move each to where it fits their mean curve best.

The valve's stroke, the line and the sensor round all breakpoints of a record in the same way. All
of them together give that common shape; then noise only affects the time of each.

A nozzle that closes slowly rounds its breakpoint so much that the slope hardly breaks. But the
control switches at a pressure. So the curves are also aligned by when they pass a common pressure.
That alignment counts if it makes the curves much more similar.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.monitor.breakpoints import OF_A_ROW, WANTED, Floats, PressureCurve, fits, turns, vertex
from twin.signals import MS

FEWEST = 3  # least number of breakpoints for a mean curve
AROUND = 40.0 * MS  # compared time on either side of a break
CLEAR = 5.0  # least difference in sigmas of a reading
# Largest share of the squares that alignment by pressure leaves. On 35 rigs of another simulated
# world and 7 shared ones it is 0.007 and 0.13 where the pressure places breaks better, and 0.46 or
# more where the slope does.
MUCH_MORE_ALIKE = 0.25
FINE_ROWS = 30  # least rows of such a curve: a hose rings in some 20 ms
ELSEWHERE = 3.0  # rms over noise, from which the curve about a breakpoint is unlike the usual one
ROUNDS, NARROWS = 4, 0.7
OF_NOISE = 40.0  # variance factor of the time, as in ``breakpoints``, with the common shape known
LEAST, LEAST_ROWS = 80.0 * MS, 12  # shortest window on either side
ROOM = 0.8  # share of the time that three quarters of the breakpoints have on either side
POINTS, PLACES = 60, 61
FARTHEST, ROWS, SHARE = 30.0 * MS, 2.0, 0.4  # largest shift in a round: s, rows, of the window
ROUNDED = (-0.2, -0.1, -0.05, 0.05, 0.1, 0.2)  # of the window: where the mean curve may bend
OWN, ALIKE = (
    [0, 1, 4],
    [2, 3, *range(5, 7 + len(ROUNDED))],
)  # columns: each breakpoint has its own level and slopes


@dataclass
class Breakpoint:
    """A breakpoint: the nozzle's switching as it shows in the pressure."""

    on: bool
    time: float  # s
    level: float  # Pa
    rows: tuple[int, int]  # from the breakpoint or command before it to the one after it
    jump: float  # Pa/s, change of the slope
    scale: float  # s, over which the curve is approximately a parabola
    stepped: bool = False
    later: bool = False  # not the first of its suction: the nozzle went on again before
    held: float = np.nan  # Pa at the end of suction, if the nozzle is off until then


def align_by_level(curve: PressureCurve, breakpoints: Sequence[Breakpoint]) -> None:
    """Move the ``breakpoints`` of falls to where they pass a common pressure, if that fits better.

    It fits better if their curves are then much more similar. First and later falls of suctions
    are treated apart: each kind has its own curve and its own time from pressure to breakpoint.
    """
    if len(breakpoints) < FEWEST:
        return
    times = np.array([point.time for point in breakpoints])
    passes = np.array(
        [_passes(curve, point, _passed_by_all(curve, breakpoints)) for point in breakpoints]
    )
    if not (np.abs(times - passes) < AROUND).all():  # the fall is too slow to time a pressure
        return
    by_level = np.empty(len(breakpoints))
    before = after = 0.0
    for later in {point.later for point in breakpoints}:
        alike = [number for number, point in enumerate(breakpoints) if point.later == later]
        by_level[alike] = passes[alike] + np.median((times - passes)[alike])
        similar = [breakpoints[number] for number in alike]
        before += _difference(curve, similar, times[alike])
        after += _difference(curve, similar, by_level[alike])
    if after < MUCH_MORE_ALIKE * before:
        for point, time in zip(breakpoints, by_level.tolist(), strict=True):
            point.time = time


def align_by_curve(curve: PressureCurve, breakpoints: Sequence[Breakpoint]) -> None:
    """Move each breakpoint to where its curve is most like the usual one, if much more so.

    A line that rings after the nozzle has closed breaks the slope repeatedly, so some breakpoints
    may be at another of these breaks than most. Levels and slopes of the curves do not count. If
    most are at a later break, all move to the first end of the fall. Breakpoints closer to one
    another than the compared time stay where they are. All stay if the rows are too far apart to
    show a ringing line.
    """
    times = np.array([point.time for point in breakpoints])
    rows = np.array([point.rows for point in breakpoints], np.int64).reshape(-1, 2)
    limits = curve.time[rows - [0, 1]]
    has_room = (times - AROUND > limits[:, 0]) & (times + AROUND < limits[:, 1])
    is_fine = FINE_ROWS * curve.period < 2.0 * AROUND
    if not is_fine or np.count_nonzero(has_room) < max(FEWEST, 0.5 * len(breakpoints)):
        return
    usual = np.median(_bent(curve, times[has_room]), axis=0)
    shifts = np.arange(-FARTHEST, FARTHEST + 0.5 * curve.period, curve.period)
    for number in np.flatnonzero(has_room):
        first, last = limits[number]
        at = times[number] + shifts
        at = np.append(times[number], at[(at - AROUND > first) & (at + AROUND < last)])
        squares = np.mean((_bent(curve, at) - usual) ** 2, axis=1)
        best = int(squares.argmin())
        is_off = squares[0] > (ELSEWHERE * curve.noise.single) ** 2
        if is_off and squares[best] < MUCH_MORE_ALIKE * squares[0]:
            times[number] = at[best]
    times += _first_end_of_fall(curve, times[has_room])
    for point, time in zip(breakpoints, times.tolist(), strict=True):
        point.time = time


def _bent(curve: PressureCurve, times: Floats) -> Floats:
    """The curve (Pa) about times, each less its own straight line, (times, rows)."""
    offsets = np.arange(-AROUND, AROUND, curve.period)
    straight = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, len(offsets)), 2))[0]
    values = np.interp(times[:, None] + offsets, curve.time, curve.pressure)
    without_line: Floats = values - (values @ straight) @ straight.T
    return without_line


def _first_end_of_fall(curve: PressureCurve, times: Floats) -> float:
    """Offset (s, not positive) from the breaks to the first end of the usual fall before them.

    0 if the pressure falls up to the break.
    """
    offsets = np.arange(-AROUND, 0.5 * curve.period, curve.period)
    falls = np.interp(times[:, None] + offsets, curve.time, curve.pressure)
    rows = turns(np.median(falls, axis=0), CLEAR * curve.noise.single)
    return float(offsets[rows[0]]) if len(rows) > 1 else 0.0  # a low, and a high after it


def _passed_by_all(curve: PressureCurve, breakpoints: Sequence[Breakpoint]) -> float:
    """The usual pressure (Pa) of ``breakpoints``, or a higher one that all curves fall below."""
    lowest = [curve.pressure[slice(*point.rows)].min() for point in breakpoints]
    surely = float(max(lowest)) + CLEAR * curve.noise.single
    return max(float(np.median([point.level for point in breakpoints])), surely)


def _passes(curve: PressureCurve, point: Breakpoint, level: float) -> float:
    """Time (s) at which the curve about a breakpoint falls to ``level``; NaN if it does not."""
    begin, end = point.rows
    below = curve.pressure[begin:end] <= level
    row = int(below.argmax())
    if row == 0:
        return np.nan
    rows = [begin + row, begin + row - 1]
    return float(np.interp(level, curve.pressure[rows], curve.time[rows]))


def _difference(curve: PressureCurve, breakpoints: Sequence[Breakpoint], times: Floats) -> float:
    """Sum of squares (Pa²) of the curves about ``times`` less the usual one."""
    offsets = np.arange(-AROUND, AROUND, curve.period)
    ends = np.array([curve.time[point.rows[1] - 1] for point in breakpoints])
    at = times[:, None] + offsets
    values = np.where(at <= ends[:, None], np.interp(at, curve.time, curve.pressure), np.nan)
    values = values[:, np.isfinite(values).any(axis=0)]
    return float(np.nansum((values - np.nanmedian(values, axis=0)) ** 2))


def align(curve: PressureCurve, breakpoints: Sequence[Breakpoint]) -> None:
    """Align ``breakpoints`` of one kind in place. One with a pressure step stays at its step."""
    if len(breakpoints) < FEWEST or np.mean([point.stepped for point in breakpoints]) > 0.5:
        return
    half = _window(curve, breakpoints)
    rows_per_point = max(1, round(half / curve.period / POINTS))
    grid = rows_per_point * curve.period
    count = round(half / grid)
    reach = min(FARTHEST + ROWS * curve.period, SHARE * half)
    reach_count = count + int(np.ceil(reach / grid))
    offsets = np.arange(-float(reach_count), reach_count + 1.0) * grid
    curves_at = _CurveAtBreakpoints(curve, rows_per_point, half, offsets, count)
    times = np.array([point.time for point in breakpoints])
    ends = curve.time[np.array([[point.rows[0], point.rows[1] - 1] for point in breakpoints])]
    for _ in range(ROUNDS):
        mean_curve = curves_at.mean_curve(times, ends)
        shifts = np.array(
            [
                curves_at.shift_of(*time_and_ends, mean_curve, reach)
                for time_and_ends in zip(times, ends, strict=True)
            ]
        )
        times = times + shifts - np.median(shifts)
        reach = max(NARROWS * reach, 2.0 * curve.period)
    times = times + curves_at.break_offset(times, ends, -1.0 if breakpoints[0].on else 1.0)
    for point, time, (low, high) in zip(breakpoints, times.tolist(), ends.tolist(), strict=True):
        point.time = min(max(time, low + curve.period), high - curve.period)


def _window(curve: PressureCurve, breakpoints: Sequence[Breakpoint]) -> float:
    """Window (s) on either side: precise times, and room for it at most breakpoints."""
    period, noise = curve.period, curve.noise
    jump, scale = (
        float(np.median(values))
        for values in zip(*((k.jump, k.scale) for k in breakpoints), strict=True)
    )
    wanted_sigma = max(WANTED, OF_A_ROW * period)
    wanted_window = max(
        OF_NOISE * noise.at(jump) / (jump * wanted_sigma) ** 2, LEAST_ROWS * period, LEAST
    )
    room = [
        min(point.time - curve.time[point.rows[0]], curve.time[point.rows[1] - 1] - point.time)
        for point in breakpoints
    ]
    shortest = 6.0 * period
    limits = max(ROOM * float(np.quantile(room, 0.25)), shortest), max(scale, shortest)
    return min(max(wanted_window, noise.window), *limits)


@dataclass(frozen=True)
class _CurveAtBreakpoints:
    """The curve about breakpoints, at the same times before and after each."""

    curve: PressureCurve
    rows_per_point: int  # rows averaged in each value
    half: float  # s, compared on either side
    wide: Floats  # s, times about a breakpoint, with a margin for its shift
    count: int  # values compared on either side

    @property
    def narrow(self) -> Floats:
        """Times (s) about a breakpoint that are compared."""
        beyond = len(self.wide) // 2 - self.count
        return self.wide[beyond : len(self.wide) - beyond]

    def at(self, times: Floats) -> Floats:
        """Pressure (Pa) about ``times``."""
        row_offsets = (
            np.arange(self.rows_per_point) - 0.5 * (self.rows_per_point - 1)
        ) * self.curve.period
        readings = np.interp(
            (times[:, None] + row_offsets).ravel(), self.curve.time, self.curve.pressure
        )
        means: Floats = readings.reshape(-1, self.rows_per_point).mean(axis=1)
        return means

    def mean_curve(self, times: Floats, ends: Floats) -> Floats:
        """Common curve (Pa) about all breakpoints, less their own levels and slopes."""
        columns = _break_columns(self.wide / self.half)
        shape_columns, residuals = list[Floats](), list[Floats]()
        for time, (low, high) in zip(times, ends, strict=True):
            inside = (time + self.wide >= low) & (time + self.wide <= high)
            if np.count_nonzero(inside) < self.count:
                continue
            own_basis = np.linalg.qr(columns[inside][:, OWN])[0]
            for values, parts in (
                (columns[inside][:, ALIKE], shape_columns),
                (self.at(time + self.wide[inside]), residuals),
            ):
                parts.append(values - own_basis @ (own_basis.T @ values))
        if not shape_columns:
            return np.zeros(len(self.wide))
        common = np.linalg.lstsq(
            np.concatenate(shape_columns), np.concatenate(residuals), rcond=1e-6
        )[0]
        mean: Floats = columns[:, ALIKE] @ common
        return mean

    def shift_of(self, time: float, ends: Floats, mean: Floats, reach: float) -> float:
        """Shift (s) of a breakpoint for which ``mean`` fits best."""
        narrow = self.narrow
        inside = (time + narrow >= ends[0]) & (time + narrow <= ends[1])
        if np.count_nonzero(inside) < max(8, self.count):
            return 0.0
        shifts = np.linspace(-reach, reach, PLACES)
        z = narrow[inside] - shifts[:, None]
        residual = self.at(time + narrow[inside]) - np.interp(z, self.wide, mean)
        own_columns = np.stack(
            [np.ones_like(z), z / self.half, np.maximum(z, 0.0) / self.half], axis=2
        )
        basis = np.linalg.qr(own_columns)[0]
        projections = np.einsum("mnk,mn->mk", basis, residual)
        rss = np.sum(residual**2, axis=1) - np.sum(projections**2, axis=1)
        best = int(rss.argmin())
        return float(shifts[best]) + vertex(rss, best) * float(shifts[1] - shifts[0])

    def break_offset(self, times: Floats, ends: Floats, sign: float) -> float:
        """Offset (s) at which the mean curve breaks."""
        narrow = self.narrow
        curves = [
            self.at(time + narrow)
            for time, (low, high) in zip(times, ends, strict=True)
            if time + narrow[0] >= low and time + narrow[-1] <= high
        ]
        if not curves:
            return 0.0
        mean = np.mean([curve - curve.mean() for curve in curves], axis=0)
        offsets = np.linspace(-0.5, 0.5, PLACES)
        rss, coefficients = fits(narrow / self.half, mean, offsets, step=False)
        rss = np.where(sign * coefficients[:, 3] > 0.0, rss, np.inf)
        best = int(rss.argmin())
        return self.half * float(offsets[best]) if np.isfinite(rss[best]) else 0.0


def _break_columns(u: Floats) -> npt.NDArray[np.float64]:
    """Columns of a curve with a rounded break at 0: cubics on either side, and bends about it."""
    after = np.maximum(u, 0.0)
    columns = [u**0, u, u * u, u**3, after, after**2, after**3]
    return np.stack(columns + [np.maximum(u - offset, 0.0) for offset in ROUNDED], axis=1)
