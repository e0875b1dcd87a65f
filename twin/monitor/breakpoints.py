"""Where the slope of a noisy course breaks: local polynomials, free on either side of it.

Nothing is known of the system. How far to look follows from the noise, the sampling and how steep
the course is; all lengths are times, however often there is a row.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from twin.signals import MBAR, MS

Floats = npt.NDArray[np.float64]
Rows = tuple[int, int]  # first, and last exclusive

# Noise is what is left beside a parabola over two periods of the mains, so that hum counts. Edges
# are in few of such windows, so a low quantile of them is noise; over the short ones hum does not
# show, and of their few rows that quantile is less than the mean.
MAINS, SHORT, FEWEST, FEWEST_SHORT = 20.0 * MS, 8.0 * MS, 16, 8
QUIET, SHORT_QUIET = 0.3, 0.77
ENOUGH = 10  # windows of a part that shows its noise
HUM = 0.02  # of hum's variance over a period is left by windows that are longer
HUMS = 1.5  # times as much over the long windows as over the short ones
WIDTHS = (1, 3, 5, 9, 15, 21)  # rows over which readings are smoothed, until that is quiet:
CALM = 0.00125  # of the record's range
SHARE_OF_STEP = 12.0**-0.5  # a step of the converter adds as much noise

WANTED = 1.5 * MS  # one sigma of when a break is, where noise lets it be known so well
OF_A_ROW = 0.3  # the same in rows, where they are far apart
OF_NOISE = 18.0  # variance of a break between two free parabolas, 4.2² (W·Δ²/density)⁻¹
LEAST, LEAST_ROWS = 30.0 * MS, 12  # window
OUTER = 1e-9  # keeps the normal equations solvable
AT_ONCE = 16  # bins that a window is thinned to where it is only looked through
POINTS, PLACES = 192, 61  # a window is thinned to so many; a break is looked for at so many
STEP_POINTS = 80
CLEAR, FIRST = 8.0, 0.6  # sigmas of a break; one as clear as this share of it but earlier is it
RINGS, AWAY, COMES_BACK, FOOT = 60.0 * MS, 5.0, 1.5, 0.2  # s; sigmas; times as far away; share
STEP_CLEAR, STEP_GAIN = 10.0, 20.0  # sigmas of one with a step; χ² by which the step must be better


def smoothed(pressure: Floats, width: int) -> Floats:
    """Mean over ``width`` rows about each, fewer at the ends."""
    sums = np.cumsum(np.concatenate([[0.0], pressure - pressure[0]]))
    at = np.arange(len(pressure))
    half = np.minimum(width // 2, np.minimum(at, len(at) - 1 - at))
    mean: Floats = (sums[at + half + 1] - sums[at - half]) / (2 * half + 1) + pressure[0]
    return mean


def beside_parabolas(pressure: Floats, rows: int) -> float:
    """What most windows of so many rows leave beside a parabola (Pa rms); 0 if there is none."""
    windows = pressure[: len(pressure) // rows * rows].reshape(-1, rows)
    if not len(windows):
        return 0.0
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, rows), 3))[0]
    left = windows - (windows @ smooth) @ smooth.T
    return float(np.sqrt(np.quantile(np.sum(left**2, axis=1) / (rows - 3), QUIET)))


def _least(parts: Sequence[Floats], rows: int, width: int) -> float:
    """The least noise (Pa) of any part that has some, smoothed over ``width`` rows."""
    found = [beside_parabolas(smoothed(part, width), rows) for part in parts]
    return min((one for one in found if one > 0.0), default=0.0)


@dataclass(frozen=True)
class Noise:
    """How readings scatter, and over which times."""

    period: float  # s, the usual time between readings
    single: float  # Pa, of single readings, with hum
    width: int  # rows; means over them are quiet enough for turns of the pressure to be seen
    quiet: float  # Pa, noise of such means
    density: float  # Pa²·s: divided by a time it is the variance of a mean over it
    steps: float  # Pa³; divided by the slope it is that density for the converter's steps
    correlated: float  # s, over which noise is alike: shorter windows say nothing
    hum: bool

    @classmethod
    def of(cls, pressure: Floats, idle: Floats, period: float, falls: Floats) -> "Noise":
        """Read it off a record.

        ``idle`` are its readings while nothing is commanded: a small vessel is never quiet else.
        ``falls`` is the change (Pa) from row to row where the pressure is steep.
        """
        rows = max(round(2.0 * MAINS / period), FEWEST)
        both = [one for one in (pressure, idle) if len(one) >= ENOUGH * rows]
        single = _least(both, rows, 1)
        short = _least(both, max(FEWEST_SHORT, round(SHORT / period)), 1) / SHORT_QUIET
        span = CALM * float(np.ptp(pressure))
        mains = int(MAINS / period) | 1
        width, quiet = 1, single
        for width in sorted({*(one for one in WIDTHS if one < mains), mains}):
            quiet = _least(both, rows, width)
            if quiet < span:
                break
        levels = np.unique(np.round(pressure, 1))
        step = float(np.quantile(np.diff(levels), 0.1)) if len(levels) > 2 else 0.0
        held = 1.0 / max(float(np.mean(falls != 0.0)), 0.05) if len(falls) > 9 else 1.0
        hum = single > HUMS * short
        of_a_row = max(short, step * SHARE_OF_STEP)
        return cls(
            period=period,
            single=single,
            width=width,
            quiet=quiet,
            density=of_a_row**2 * period * held + hum * HUM * MAINS * single**2,
            steps=step**3 / 12.0,
            correlated=held * period,
            hum=hum,
        )

    def at(self, slope: float) -> float:
        """Density (Pa²·s) where the pressure moves by ``slope`` (Pa/s); never 0."""
        return self.density + self.steps / slope + (1e-4 * MBAR) ** 2 * MS

    @property
    def side(self) -> float:
        """Shortest time (s) beside a break that shows it."""
        return max(MAINS if self.hum else 0.0, 4.0 * self.correlated)

    @property
    def window(self) -> float:
        """Shortest time (s) beside a break that places it."""
        return max(2.0 * MAINS if self.hum else 0.0, 8.0 * self.correlated)


class Course(NamedTuple):
    """Readings that can be used, in order of time."""

    time: Floats  # s
    pressure: Floats  # Pa
    noise: Noise

    @property
    def period(self) -> float:
        """The usual time (s) between them."""
        return self.noise.period

    def thinned(self, rows: Rows, points: int) -> tuple[Floats, Floats, float]:
        """Time and pressure, averaged to about ``points``, and what each of these lasts (s)."""
        first, last = rows
        many = max(1, (last - first) // points)
        count = (last - first) // many
        part = slice(first, first + count * many)
        time, pressure = (
            one[part].reshape(count, many).mean(axis=1) for one in (self.time, self.pressure)
        )
        return time, pressure, many * self.period

    def row(self, time: float, rows: Rows) -> int:
        """The first row from ``time`` on, well within ``rows``."""
        return int(np.clip(np.searchsorted(self.time, time), rows[0] + 2, rows[1] - 2))


class Break(NamedTuple):
    """A break of the slope."""

    time: float  # s
    level: float  # Pa, where the course before it leads
    jump: float  # Pa/s, by which the slope changes
    clear: float  # sigmas
    stepped: bool  # the pressure jumps as well


@lru_cache(maxsize=512)
def hinge(left: int, right: int) -> Floats:
    """Filter that gives by how much the slope breaks, beside a cubic; over so many bins."""
    at = np.arange(-left, right + 1.0)
    cubic = np.linalg.qr(np.stack([(at / left) ** k for k in range(4)], axis=1))[0]
    bent = np.maximum(at, 0.0)
    bent -= cubic @ (cubic.T @ bent)
    filter_: Floats = bent / (bent @ bent)
    return filter_


def closer(course: Course, rows: Rows, row: int, window: int, jump: float) -> tuple[int, int]:
    """Follow a break to shorter windows while it stays clear: its row, and the last window (rows).

    Where a line rings, each of its swings breaks the slope: the first is the break. ``jump`` is
    negative where the slope becomes less.
    """
    density = course.noise.at(abs(jump))
    while (half := window // 2) >= 6 and half * course.period >= course.noise.window:
        many = max(1, half // AT_ONCE)
        bins = max(half // many, 4)
        first = max(rows[0], row - half - bins * many - many)
        last = min(rows[1], row + half + bins * many + many)
        count = (last - first) // many
        if count < 2 * bins + 3:
            break
        means = course.pressure[first : first + count * many].reshape(count, many).mean(axis=1)
        sigma = np.sqrt(density / (many * course.period)) * np.linalg.norm(hinge(bins, bins))
        clear = np.sign(jump) * np.correlate(means, hinge(bins, bins), "valid") / sigma
        if clear.max() < CLEAR:
            break
        beside = np.concatenate([[-np.inf], clear, [-np.inf]])
        peaks = (clear >= beside[:-2]) & (clear >= beside[2:]) & (clear >= FIRST * clear.max())
        row = first + (int(peaks.argmax()) + bins) * many + many // 2
        window = half
    return row, window


def placed(
    course: Course, rows: Rows, row: int, reach: int, most: int, jump: float
) -> Break | None:
    """The break within ``reach`` of ``row``, in a window of at most ``most`` rows on either side.

    It is as wide as it must be for the time to be known. None where there is no room.
    """
    period = course.period
    wanted = max(WANTED, OF_A_ROW * period)
    density = course.noise.at(abs(jump))
    least = max(LEAST_ROWS * period, LEAST, course.noise.window)
    wide = max(OF_NOISE * density / (jump * wanted) ** 2, least) / period
    half = int(np.clip(round(wide), 8, max(most, 8)))
    found = None
    for _ in range(2):
        window = max(rows[0], row - half), min(rows[1], row + half + 1)
        found = _best(course, window, float(course.time[row]), reach, (POINTS, 0.0), jump)
        if found is None:
            return None
        row = course.row(found.time, rows)
        reach = max(reach // 8, 2)
    return found


def stepped(course: Course, rows: Rows, row: int, window: int, jump: float) -> Break | None:
    """The break about ``row`` if the pressure jumps there as well; found as closely as it shows."""
    found, reach = None, window
    while True:
        part = max(rows[0], row - window - reach // 2), min(rows[1], row + window + reach // 2 + 1)
        near = _best(course, part, float(course.time[row]), reach, (STEP_POINTS, STEP_GAIN), jump)
        if near is None or near.clear < STEP_CLEAR or not near.stepped:
            return found
        found, row = near, course.row(near.time, rows)
        if window <= 8:
            return found
        window = max(window // 2, 8)
        reach = max(window // 2, 2)


def rung(course: Course, rows: Rows, time: float, scale: float) -> Break | None:
    """Where the pressure first left its course, if by ``time`` it has been away and come back.

    A line that rings does so: a later swing may break the slope more than the first. ``scale`` (s)
    of the course before it may be taken for a parabola.
    """
    period, noise = course.period, course.noise
    row = course.row(time, rows)
    back = min(RINGS, 0.5 * scale)
    span = max(scale, LEAST_ROWS * period)
    begin = max(course.row(time - back - span, rows), rows[0])
    ends = course.row(time - back, rows)
    if ends - begin < LEAST_ROWS or row - ends < 3:
        return None
    x = (course.time[begin:row] - course.time[ends]) / span
    fit = np.linalg.lstsq(np.vander(x[: ends - begin], 3), course.pressure[begin:ends], rcond=None)[
        0
    ]
    led = np.vander(x, 3) @ fit
    width = max(round(noise.correlated / period), 1) | 1
    off = smoothed(course.pressure[begin:row] - led, width)[ends - begin :]
    least = AWAY * max(
        noise.single, float(np.std(course.pressure[begin:ends] - led[: ends - begin]))
    )
    highest = float(off.max())
    if highest < least + COMES_BACK * max(float(off[-1]), 0.0):
        return None
    peak = int(off.argmax())
    below = np.flatnonzero(off[:peak] < FOOT * highest)
    at = int(below[-1]) + 1 if len(below) else 0
    return Break(float(course.time[ends + at]), float(led[ends - begin + at]), 0.0, np.inf, True)


def _best(
    course: Course, rows: Rows, at: float, reach: int, how: tuple[int, float], jump: float
) -> Break | None:
    """The best break within ``reach`` rows of the time ``at``.

    ``how``: points that the window is thinned to, χ² by which one with a step must be better; 0: it
    must leave half as much.
    """
    points, gain = how
    if rows[1] - rows[0] < 8:
        return None
    time, pressure, lasts = course.thinned(rows, points)
    time = time - at
    middle, scale = float(pressure.mean()), float(np.abs(time[[0, -1]]).max())
    low = max(-reach * course.period, time[0] + 2.5 * lasts)
    high = min(reach * course.period, time[-1] - 2.5 * lasts)
    if high <= low:
        return None
    places = np.linspace(low, high, PLACES)
    y, sign = pressure - middle, np.sign(jump)
    variance = course.noise.at(abs(jump)) / lasts
    smooth, bent = fits(time / scale, y, places / scale, step=False)
    rss = np.where(sign * bent[:, 3] > 0.0, smooth, np.inf)
    with_step = False
    least = int(rss.argmin())
    other, jumped = fits(time / scale, y, places / scale, step=True)
    left = float(other.min())
    spare = max(len(y) - 7, 1)
    if gain:
        with_step = bool(rss[least] - left > gain * max(variance, left / spare))
    else:
        with_step = bool(left < 0.5 * rss[least] - variance * len(y))
    if with_step:
        rss, bent, least = other, jumped, int(other.argmin())
    if not np.isfinite(rss[least]):
        return None
    cubic = np.linalg.qr(np.vander(time / scale, 4))[0]
    unbent = float(np.sum((y - cubic @ (cubic.T @ y)) ** 2))
    sigma = np.sqrt(max(variance, 0.25 * float(rss[least]) / spare))
    return Break(
        time=at + float(places[least]) + vertex(rss, least) * float(places[1] - places[0]),
        level=float(bent[least, 0]) + middle,
        jump=max(abs(float(bent[least, 3])) / scale, 1e-3),
        clear=float(np.sqrt(max(unbent - float(rss[least]), 0.0)) / sigma),
        stepped=with_step,
    )


def fits(x: Floats, y: Floats, places: Floats, *, step: bool) -> tuple[Floats, Floats]:
    """Sum of squares beside two parabolas that meet at each of ``places``, and coefficients.

    These are level, slope and half the curvature before, and what is added to slope and curvature
    after, (places, 5); with ``step`` also the step between the parabolas.
    """
    z = x - places[:, None]
    after = np.maximum(z, 0.0)
    columns = [np.ones_like(z), z, z * z, after, after * after]
    if step:
        columns.append((z > 0.0).astype(float))
    basis = np.stack(columns, axis=2)
    turned = basis.transpose(0, 2, 1)
    normal, right = turned @ basis, turned @ y
    normal += OUTER * np.eye(len(columns))
    coefficients: Floats = np.linalg.solve(normal, right[..., None])[..., 0]
    rss: Floats = y @ y - np.sum(coefficients * right, axis=1)
    return rss, coefficients


def vertex(values: Floats, least: int) -> float:
    """Where the parabola through the least of equally spaced values and its neighbours is least."""
    if not 0 < least < len(values) - 1:
        return 0.0
    before, here, after = values[least - 1 : least + 2]
    bend = before - 2.0 * here + after
    return float(0.5 * (before - after) / bend) if np.isfinite(bend) and bend > 0.0 else 0.0
