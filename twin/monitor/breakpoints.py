"""Breakpoints of the slope of a noisy curve: local polynomials, free on either side.

No model of the system is used. Windows follow from the noise, the sampling and the slope of the
curve; all lengths are times, whatever the sampling.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.signals import MBAR, MS

Floats = npt.NDArray[np.float64]
Rows = tuple[int, int]  # first, and last exclusive

# Noise is the residual of a parabola over two periods of the mains, so that hum counts. Few such
# windows contain edges, so a low quantile of their variances is noise. Short windows do not show
# hum; with their few rows that quantile is less than the mean.
MAINS, SHORT, FEWEST, FEWEST_SHORT = 20.0 * MS, 8.0 * MS, 16, 8
QUIET, SHORT_QUIET = 0.3, 0.77
ENOUGH = 10  # least windows in a part for an estimate of its noise
HUM = 0.02  # share of the hum's variance that remains in windows longer than its period
HUMS = 1.5  # noise of long windows over that of short ones, above which there is hum
WIDTHS = (1, 3, 5, 9, 15, 21)  # rows of the moving mean: the first with noise below CALM
CALM = 0.00125  # noise over the record's range
SHARE_OF_STEP = 12.0**-0.5  # sigma of quantisation noise over a step of the converter

WANTED = 1.5 * MS  # wanted sigma of the time of a break
OF_A_ROW = 0.3  # wanted sigma in rows, if they are far apart
OF_NOISE = 18.0  # variance of a break between two free parabolas, 4.2² (W·Δ²/density)⁻¹
LEAST, LEAST_ROWS = 30.0 * MS, 12  # shortest window
OUTER = 1e-9  # keeps the normal equations solvable
AT_ONCE = 16  # bins per window in a search
POINTS, PLACES = 192, 61  # points of a thinned window; times at which a break is tried
STEP_POINTS = 80
CLEAR, FIRST = 8.0, 0.6  # least sigmas of a break; share of them with which an earlier one wins
RINGS, AWAY, COMES_BACK, FOOT = 60.0 * MS, 5.0, 1.5, 0.2  # ``rung``: s, sigmas, ratio, share
# A sensor that is slower than the rows repeats readings while the pressure falls. Rows over which
# the fall is taken, its least size per row in converter steps, rows needed, and share of repeats.
REPEATS_FOR, REPEATS_STEPS, FEWEST_FALLS, LEAST_REPEATED = 20, 2.0, 30, 0.25
STEP_CLEAR, STEP_GAIN = 10.0, 20.0  # least sigmas of a break with a step; least χ² it must gain


def turns(smooth: Floats, least: float) -> list[int]:
    """Rows of alternating lows and highs, a low first, that differ by ``least`` or more.

    ``smooth`` begins by falling. A last turn without a reversal after it does not count.
    """
    rows, falling, best, best_value = list[int](), True, 0, float(smooth[0])
    for row, value in enumerate(smooth.tolist()):
        if (value < best_value) if falling else (value > best_value):
            best, best_value = row, value
        elif abs(value - best_value) >= least:
            rows.append(best)
            falling, best, best_value = not falling, row, value
    return rows


def converter_step(pressure: Floats) -> float:
    """The smallest frequent difference (Pa) between readings: a step of the converter, or 0."""
    levels = np.unique(np.round(pressure, 1))
    return float(np.quantile(np.diff(levels), 0.1)) if len(levels) > 2 else 0.0


def rounding_error(step: float, noise: float) -> float:
    """Rms rounding error of a mean over many readings of one pressure.

    ``noise`` is one sigma of readings, with that of rounding; both are in one unit. Noise below
    the steps reduces the error of means: its first harmonic remains (Widrow).
    """
    beneath = max(noise**2 - (SHARE_OF_STEP * step) ** 2, 0.0)
    return SHARE_OF_STEP * step * math.exp(-2.0 * math.pi**2 * beneath / step**2) if step else 0.0


def renewed_every(pressure: Floats, sucks: npt.NDArray[np.bool_]) -> float:
    """Mean rows from one new reading to the next as the pressure falls; 0 if every row is new."""
    changes = np.diff(pressure)
    if len(changes) < REPEATS_FOR:
        return 0.0
    falls = -smoothed(changes, REPEATS_FOR) > REPEATS_STEPS * converter_step(pressure)
    repeated = (changes == 0.0)[falls & sucks[1:] & sucks[:-1]]
    if len(repeated) < FEWEST_FALLS or not LEAST_REPEATED < repeated.mean() < 1.0:
        return 0.0
    return 1.0 / (1.0 - float(repeated.mean()))


def smoothed(pressure: Floats, width: int) -> Floats:
    """Moving mean over ``width`` rows, fewer at the ends."""
    sums = np.cumsum(np.concatenate([[0.0], pressure - pressure[0]]))
    at = np.arange(len(pressure))
    half = np.minimum(width // 2, np.minimum(at, len(at) - 1 - at))
    mean: Floats = (sums[at + half + 1] - sums[at - half]) / (2 * half + 1) + pressure[0]
    return mean


def beside_parabolas(pressure: Floats, rows: int) -> float:
    """Noise (Pa rms): QUIET quantile of windows' residuals from parabolas; 0 without windows."""
    windows = pressure[: len(pressure) // rows * rows].reshape(-1, rows)
    if not len(windows):
        return 0.0
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, rows), 3))[0]
    residual = windows - (windows @ smooth) @ smooth.T
    return float(np.sqrt(np.quantile(np.sum(residual**2, axis=1) / (rows - 3), QUIET)))


def _least_noise(parts: Sequence[Floats], rows: int, width: int) -> float:
    """The least noise (Pa) above zero of any part, smoothed over ``width`` rows."""
    noises = [beside_parabolas(smoothed(part, width), rows) for part in parts]
    return min((noise for noise in noises if noise > 0.0), default=0.0)


@dataclass(frozen=True)
class Noise:
    """Noise of readings, and its correlation time."""

    period: float  # s, median time between readings
    single: float  # Pa, of single readings, with hum
    width: int  # rows; a mean over them is quiet enough to show turns of the pressure
    quiet: float  # Pa, noise of means over ``width`` rows
    density: float  # Pa²·s; divided by a time it is the variance of a mean over that time
    steps: float  # Pa³; divided by the slope it is the density for the converter's steps
    correlated: float  # s, correlation time of the noise; shorter windows show nothing
    hum: bool

    @classmethod
    def of(cls, pressure: Floats, idle: Floats, period: float, falls: Floats) -> "Noise":
        """Estimate it from a record.

        ``idle`` are the readings while nothing is commanded: a small vessel is quiet only then.
        ``falls`` are changes (Pa) from row to row where the pressure is steep.
        """
        rows = max(round(2.0 * MAINS / period), FEWEST)
        parts = [candidate for candidate in (pressure, idle) if len(candidate) >= ENOUGH * rows]
        single = _least_noise(parts, rows, 1)
        short = _least_noise(parts, max(FEWEST_SHORT, round(SHORT / period)), 1) / SHORT_QUIET
        span = CALM * float(np.ptp(pressure))
        mains = int(MAINS / period) | 1
        width, quiet = 1, single
        for width in sorted({*(candidate for candidate in WIDTHS if candidate < mains), mains}):
            quiet = _least_noise(parts, rows, width)
            if quiet < span:
                break
        step = converter_step(pressure)
        rows_per_reading = 1.0 / max(float(np.mean(falls != 0.0)), 0.05) if len(falls) > 9 else 1.0
        hum = single > HUMS * short
        of_a_row = max(short, step * SHARE_OF_STEP)
        return cls(
            period=period,
            single=single,
            width=width,
            quiet=quiet,
            density=of_a_row**2 * period * rows_per_reading + hum * HUM * MAINS * single**2,
            steps=step**3 / 12.0,
            correlated=rows_per_reading * period,
            hum=hum,
        )

    def at(self, slope: float) -> float:
        """Density (Pa²·s) at a slope (Pa/s) of the pressure; never 0."""
        return self.density + self.steps / slope + (1e-4 * MBAR) ** 2 * MS

    @property
    def side(self) -> float:
        """Shortest time (s) beside a break that shows it."""
        return max(MAINS if self.hum else 0.0, 4.0 * self.correlated)

    @property
    def window(self) -> float:
        """Shortest time (s) beside a break that places it."""
        return max(2.0 * MAINS if self.hum else 0.0, 8.0 * self.correlated)


class PressureCurve(NamedTuple):
    """Usable readings in order of time."""

    time: Floats  # s
    pressure: Floats  # Pa
    noise: Noise

    @property
    def period(self) -> float:
        """Median time (s) between readings."""
        return self.noise.period

    def thinned(self, rows: Rows, points: int) -> tuple[Floats, Floats, float]:
        """Time and pressure, averaged to about ``points``, and the time between these (s)."""
        first, last = rows
        rows_per_point = max(1, (last - first) // points)
        count = (last - first) // rows_per_point
        part = slice(first, first + count * rows_per_point)
        time, pressure = (
            column[part].reshape(count, rows_per_point).mean(axis=1)
            for column in (self.time, self.pressure)
        )
        return time, pressure, rows_per_point * self.period

    def row(self, time: float, rows: Rows) -> int:
        """The first row from ``time`` on, well within ``rows``."""
        return int(np.clip(np.searchsorted(self.time, time), rows[0] + 2, rows[1] - 2))


class Break(NamedTuple):
    """A break of the slope."""

    time: float  # s
    level: float  # Pa, by the curve before it
    jump: float  # Pa/s, change of the slope
    clear: float  # significance in sigmas
    stepped: bool  # the pressure jumps as well


@lru_cache(maxsize=512)
def hinge(left: int, right: int) -> Floats:
    """Filter over bins that gives the change of the slope, insensitive to a cubic."""
    offsets = np.arange(-left, right + 1.0)
    cubic = np.linalg.qr(np.stack([(offsets / left) ** k for k in range(4)], axis=1))[0]
    ramp = np.maximum(offsets, 0.0)
    ramp -= cubic @ (cubic.T @ ramp)
    filter_: Floats = ramp / (ramp @ ramp)
    return filter_


def closer(curve: PressureCurve, rows: Rows, row: int, window: int, jump: float) -> tuple[int, int]:
    """Follow a break to shorter windows while it stays significant: its row and last window (rows).

    If a line rings, each swing breaks the slope: the first one is the break. ``jump`` is negative
    if the slope decreases.
    """
    density = curve.noise.at(abs(jump))
    while (half := window // 2) >= 6 and half * curve.period >= curve.noise.window:
        rows_per_bin = max(1, half // AT_ONCE)
        bins = max(half // rows_per_bin, 4)
        first = max(rows[0], row - half - bins * rows_per_bin - rows_per_bin)
        last = min(rows[1], row + half + bins * rows_per_bin + rows_per_bin)
        count = (last - first) // rows_per_bin
        if count < 2 * bins + 3:
            break
        means = (
            curve.pressure[first : first + count * rows_per_bin]
            .reshape(count, rows_per_bin)
            .mean(axis=1)
        )
        sigma = np.sqrt(density / (rows_per_bin * curve.period)) * np.linalg.norm(hinge(bins, bins))
        significance = np.sign(jump) * np.correlate(means, hinge(bins, bins), "valid") / sigma
        if significance.max() < CLEAR:
            break
        padded = np.concatenate([[-np.inf], significance, [-np.inf]])
        peaks = (
            (significance >= padded[:-2])
            & (significance >= padded[2:])
            & (significance >= FIRST * significance.max())
        )
        row = first + (int(peaks.argmax()) + bins) * rows_per_bin + rows_per_bin // 2
        window = half
    return row, window


def placed(
    curve: PressureCurve, rows: Rows, row: int, reach: int, most: int, jump: float
) -> Break | None:
    """The break within ``reach`` of ``row``, in a window of at most ``most`` rows on either side.

    The window is as wide as the wanted precision of the time requires. None if there is no room.
    """
    period = curve.period
    wanted = max(WANTED, OF_A_ROW * period)
    density = curve.noise.at(abs(jump))
    shortest = max(LEAST_ROWS * period, LEAST, curve.noise.window)
    wanted_rows = max(OF_NOISE * density / (jump * wanted) ** 2, shortest) / period
    half = int(np.clip(round(wanted_rows), 8, max(most, 8)))
    best_break = None
    for _ in range(2):
        window = max(rows[0], row - half), min(rows[1], row + half + 1)
        best_break = _best_break(curve, window, float(curve.time[row]), reach, (POINTS, 0.0), jump)
        if best_break is None:
            return None
        row = curve.row(best_break.time, rows)
        reach = max(reach // 8, 2)
    return best_break


def stepped(curve: PressureCurve, rows: Rows, row: int, window: int, jump: float) -> Break | None:
    """The break about ``row`` if the pressure also jumps there, in the shortest clear window."""
    closest, reach = None, window
    while True:
        part = max(rows[0], row - window - reach // 2), min(rows[1], row + window + reach // 2 + 1)
        candidate = _best_break(
            curve, part, float(curve.time[row]), reach, (STEP_POINTS, STEP_GAIN), jump
        )
        if candidate is None or candidate.clear < STEP_CLEAR or not candidate.stepped:
            return closest
        closest, row = candidate, curve.row(candidate.time, rows)
        if window <= 8:
            return closest
        window = max(window // 2, 8)
        reach = max(window // 2, 2)


def rung(curve: PressureCurve, rows: Rows, time: float, scale: float) -> Break | None:
    """The point where the pressure first left its curve, if it came back to it before ``time``.

    A ringing line does that: a later swing may change the slope more than the first. The curve
    before it is approximately a parabola over ``scale`` (s).
    """
    period, noise = curve.period, curve.noise
    row = curve.row(time, rows)
    ringing_time = min(RINGS, 0.5 * scale)
    span = max(scale, LEAST_ROWS * period)
    begin = max(curve.row(time - ringing_time - span, rows), rows[0])
    ends = curve.row(time - ringing_time, rows)
    if ends - begin < LEAST_ROWS or row - ends < 3:
        return None
    x = (curve.time[begin:row] - curve.time[ends]) / span
    fit = np.linalg.lstsq(np.vander(x[: ends - begin], 3), curve.pressure[begin:ends], rcond=None)[
        0
    ]
    extrapolated = np.vander(x, 3) @ fit
    width = max(round(noise.correlated / period), 1) | 1
    deviation = smoothed(curve.pressure[begin:row] - extrapolated, width)[ends - begin :]
    threshold = AWAY * max(
        noise.single, float(np.std(curve.pressure[begin:ends] - extrapolated[: ends - begin]))
    )
    highest = float(deviation.max())
    if highest < threshold + COMES_BACK * max(float(deviation[-1]), 0.0):
        return None
    peak = int(deviation.argmax())
    below = np.flatnonzero(deviation[:peak] < FOOT * highest)
    foot = int(below[-1]) + 1 if len(below) else 0
    return Break(
        float(curve.time[ends + foot]), float(extrapolated[ends - begin + foot]), 0.0, np.inf, True
    )


def _best_break(
    curve: PressureCurve,
    rows: Rows,
    centre: float,
    reach: int,
    criteria: tuple[int, float],
    jump: float,
) -> Break | None:
    """The best break within ``reach`` rows of the time ``centre``.

    ``criteria``: points of the thinned window, and the χ² that a step must gain; with 0 the step
    must halve the residual.
    """
    points, gain = criteria
    if rows[1] - rows[0] < 8:
        return None
    time, pressure, point_time = curve.thinned(rows, points)
    time = time - centre
    mean, scale = float(pressure.mean()), float(np.abs(time[[0, -1]]).max())
    low = max(-reach * curve.period, time[0] + 2.5 * point_time)
    high = min(reach * curve.period, time[-1] - 2.5 * point_time)
    if high <= low:
        return None
    times = np.linspace(low, high, PLACES)
    y, sign = pressure - mean, np.sign(jump)
    variance = curve.noise.at(abs(jump)) / point_time
    smooth, coefficients = fits(time / scale, y, times / scale, step=False)
    rss = np.where(sign * coefficients[:, 3] > 0.0, smooth, np.inf)
    with_step = False
    best = int(rss.argmin())
    stepped_rss, stepped_coefficients = fits(time / scale, y, times / scale, step=True)
    least_stepped_rss = float(stepped_rss.min())
    freedom = max(len(y) - 7, 1)
    if gain:
        with_step = bool(
            rss[best] - least_stepped_rss > gain * max(variance, least_stepped_rss / freedom)
        )
    else:
        with_step = bool(least_stepped_rss < 0.5 * rss[best] - variance * len(y))
    if with_step:
        rss, coefficients, best = stepped_rss, stepped_coefficients, int(stepped_rss.argmin())
    if not np.isfinite(rss[best]):
        return None
    cubic = np.linalg.qr(np.vander(time / scale, 4))[0]
    cubic_rss = float(np.sum((y - cubic @ (cubic.T @ y)) ** 2))
    sigma = np.sqrt(max(variance, 0.25 * float(rss[best]) / freedom))
    return Break(
        time=centre + float(times[best]) + vertex(rss, best) * float(times[1] - times[0]),
        level=float(coefficients[best, 0]) + mean,
        jump=max(abs(float(coefficients[best, 3])) / scale, 1e-3),
        clear=float(np.sqrt(max(cubic_rss - float(rss[best]), 0.0)) / sigma),
        stepped=with_step,
    )


def fits(x: Floats, y: Floats, places: Floats, *, step: bool) -> tuple[Floats, Floats]:
    """Residual sum of squares of two parabolas that meet at each of ``places``, and coefficients.

    These are level, slope and half the curvature before, and the changes of slope and half the
    curvature after, (places, 5); with ``step`` also the step between the parabolas.
    """
    z = x - places[:, None]
    after = np.maximum(z, 0.0)
    columns = [np.ones_like(z), z, z * z, after, after * after]
    if step:
        columns.append((z > 0.0).astype(float))
    basis = np.stack(columns, axis=2)
    transposed = basis.transpose(0, 2, 1)
    normal, moments = transposed @ basis, transposed @ y
    normal += OUTER * np.eye(len(columns))
    coefficients: Floats = np.linalg.solve(normal, moments[..., None])[..., 0]  # pyright: ignore[reportAssignmentType]
    rss: Floats = y @ y - np.sum(coefficients * moments, axis=1)
    return rss, coefficients


def vertex(values: Floats, least: int) -> float:
    """Offset of the vertex of the parabola through the least value and its neighbours, in steps."""
    if not 0 < least < len(values) - 1:
        return 0.0
    before, middle, after = values[least - 1 : least + 2]
    curvature = before - 2.0 * middle + after
    return (
        float(0.5 * (before - after) / curvature)
        if np.isfinite(curvature) and curvature > 0.0
        else 0.0
    )
