"""Trend of a figure: its newest step, the straight line since then, and when it meets a limit.

A step is a change of level between two cycles, as when a hose tears; a trend is a slope. The one
with smaller residuals is chosen, and either is reported only if it is significant.

Cycles are first reduced to medians of time bins, so that scatter and single bad cycles matter
little. The line is that of Theil and Sen: the median of all slopes between two bins. Its interval
follows from the scatter of the bins about it. It is widened where neighbours correlate, as with the
temperature of a day: such a record tells less than its length suggests.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student
from scipy.stats import theilslopes, trim_mean

from twin.inference.levels import MAD_TO_SIGMA
from twin.instants import DAY_NS

CONFIDENCE = 0.95  # of bands and intervals
SURE = 0.99  # confidence that the slope has a sign, for a trend
BINS = 60  # of a record
FEWEST_BINS = 12
FARTHEST = 3.0  # lengths of the record ahead: no line is trusted beyond
LEAST_SPAN = 1.0  # days of a record; a shorter one gives no rate per day
LEAST_BINS = 3  # on either side of a step
AT_ONCE = 0.5  # share of a step within LEAST_BINS before and after it; a slow rise is no step
# Shares of the last cycles in which a step is searched, and the sigmas of the bins that it must
# have there: a record that only wanders shows a step of some sigmas in one part or another.
PARTS = ((1.0, 0.0), (0.5, 10.0), (0.25, 10.0))
LIKELY = 1.92  # difference of log-likelihood that bounds a step's position: 95 %
ENDED = 3  # fewest cycles in a row without a value for a figure that is no longer measured
TRIMMED = 0.1  # share of the bins cut off on either side before their mean is taken
MOST_ALIKE = 0.95  # correlation of neighbours

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A line through a record; times in days before (negative) and after its last cycle."""

    days: Floats  # of the bins
    medians: Floats
    level: float  # at day 0
    slope: float  # per day
    sigma: float  # of a bin about the line
    alike: float  # factor by which correlated neighbours widen all intervals

    @property
    def is_rate(self) -> bool:
        """Whether the record is long enough for a rate per day and the time of a limit."""
        return self.span >= LEAST_SPAN

    @property
    def is_trend(self) -> bool:
        """Whether the slope is surely not zero."""
        return abs(self.slope) > self.slope_half(SURE)

    def slope_half(self, confidence: float = CONFIDENCE) -> float:
        """Half the width of the slope's interval (per day)."""
        return self._times(confidence) * self.sigma / math.sqrt(self._spread)

    def at(self, days: Floats) -> Floats:
        """Values of the line at these times."""
        return self.level + self.slope * days

    def half(self, days: Floats, confidence: float = CONFIDENCE) -> Floats:
        """Half the width of the line's confidence band."""
        away = (days - self.days.mean()) ** 2 / self._spread
        width: Floats = np.sqrt(1.0 / len(self.days) + away)
        return self._times(confidence) * self.sigma * width

    @property
    def span(self) -> float:
        """Length of the record (days)."""
        return float(-self.days[0])

    @property
    def _spread(self) -> float:
        return float(((self.days - self.days.mean()) ** 2).sum())

    def _times(self, confidence: float) -> float:
        """Number of standard errors in half of an interval."""
        return float(student.ppf(0.5 + confidence / 2.0, len(self.days) - 2)) * self.alike


@dataclass(frozen=True)
class Step:
    """A change from one level to another; halves are those of 95 % intervals.

    It happened after the cycle received at ``earliest_ns`` (UTC) and by that at ``latest_ns``, most
    likely between those at ``last_ns`` and ``host_ns``.
    """

    before: float
    before_half: float
    after: float
    after_half: float
    last_ns: int  # of the old level
    host_ns: int  # first of the new one
    earliest_ns: int
    latest_ns: int
    first: int  # cycle of the record that has the new level


@dataclass(frozen=True)
class Reach:
    """When a line reaches a limit, in days from the last cycle; ``latest`` is inf if it may not.

    ``expected`` is inf too beyond FARTHEST records ahead, where it is not reliable.
    """

    expected: float
    earliest: float
    latest: float


@dataclass(frozen=True)
class Trend:
    """Trend of a record: its newest step, and the line since then or through all of it.

    ``step`` is None without one, ``line`` with too few cycles. ``comes`` is when the line reaches
    the ``limit``; it is None for a figure that is no longer measured.
    """

    begin_ns: int  # of the record: first and last cycle that has a value
    end_ns: int
    lacking: int  # cycles after its end, without a value; 0 if that is usual
    step: Step | None
    line: Line | None
    limit: float | None
    comes: Reach | None

    def ahead(self, share: float) -> float:
        """Days of interest after the record's end: a share of it, or until the limit."""
        if self.line is None or self.lacking:
            return 0.0
        ahead = share * self.line.span
        if self.comes is not None:
            ahead = max(ahead, min(1.2 * self.comes.expected, FARTHEST * self.line.span))
        return ahead

    def shape(self, ahead: float) -> tuple[Floats, Floats, Floats]:
        """The trend as a curve, to ``ahead`` days after the record's end.

        Days from the last cycle, value at each, and half of its 95 % interval.
        """
        pieces: list[tuple[Floats, Floats | float, Floats | float]] = []
        if (step := self.step) is not None:
            ends = np.array([self.begin_ns, step.last_ns])
            pieces.append(((ends - self.end_ns) / DAY_NS, step.before, step.before_half))
            if self.line is None:
                ends = np.array([step.host_ns, self.end_ns])
                pieces.append(((ends - self.end_ns) / DAY_NS, step.after, step.after_half))
        if self.line is not None:
            begin = self.begin_ns if self.step is None else self.step.host_ns
            days = np.linspace((begin - self.end_ns) / DAY_NS, ahead, 200)
            pieces.append((days, self.line.at(days), self.line.half(days)))
        broadcast = [[np.broadcast_to(array, len(piece[0])) for array in piece] for piece in pieces]
        days, middle, half = (np.concatenate(array) for array in zip(*broadcast, strict=True))
        return days, middle, half


def trend_of(host_ns: npt.NDArray[np.int64], values: Floats, limit: float | None = None) -> Trend:
    """Trend of a record of cycles in order of their receipt (UTC, ns); values may be NaN."""
    has_value = np.isfinite(values)
    lacking = _lacking(has_value)
    host_ns, values = host_ns[has_value], values[has_value]
    newest, first = None, 0
    while (step := _newest_step(host_ns[first:], values[first:])) is not None:
        newest, first = step, first + step.first
    line = line_through(host_ns[first:], values[first:])
    comes = None
    if line is not None and limit is not None and line.is_rate and not lacking:
        comes = reach(line, limit)
    begin, end = (int(host_ns[0]), int(host_ns[-1])) if len(host_ns) else (0, 0)
    return Trend(begin, end, lacking, newest, line, limit, comes)


def _lacking(has_value: npt.NDArray[np.bool_]) -> int:
    """Number of the last cycles without a value; 0 if stretches as long are usual.

    A stretch is usual if one in a hundred between two values was as long.
    """
    rows = np.flatnonzero(has_value)
    if not len(rows):
        return 0
    lacking = len(has_value) - 1 - int(rows[-1])
    between = np.diff(rows) - 1
    longest_typical = int(np.quantile(between, SURE, method="lower")) if len(between) else 0
    return lacking if lacking >= ENDED and lacking > longest_typical else 0


def line_through(host_ns: npt.NDArray[np.int64], values: Floats) -> Line | None:
    """The line through a record of cycles in order; None if the record is too short."""
    has_value = np.isfinite(values)
    if has_value.sum() < FEWEST_BINS:
        return None
    host_ns, values = host_ns[has_value], values[has_value]
    days = (host_ns - host_ns[-1]) / DAY_NS
    if days[0] >= 0.0:
        return None
    bins = _binned(days, values)
    if bins is None:
        return None
    times, medians = bins
    slope = float(theilslopes(medians, times).slope)
    level = float(trim_mean(medians - slope * times, TRIMMED))
    residuals = medians - level - slope * times
    sigma = max(
        MAD_TO_SIGMA * float(np.median(np.abs(residuals - np.median(residuals)))),
        float(residuals.std()) / 2.0,
    )
    return Line(times, medians, level, slope, sigma, _correlation_factor(residuals))


def reach(line: Line, limit: float) -> Reach | None:
    """When ``line`` reaches ``limit``; None if it does not surely rise, or is beyond already."""
    if not line.is_trend or line.slope <= 0.0 or line.level >= limit:
        return None
    expected = (limit - line.level) / line.slope
    farthest = FARTHEST * line.span
    ahead = np.linspace(0.0, 2.0 * farthest, 4001)
    earliest = _first(ahead, line.at(ahead) + line.half(ahead) >= limit)
    latest = _first(ahead, line.at(ahead) - line.half(ahead) >= limit)
    return Reach(expected if expected <= farthest else math.inf, earliest, latest)


def _first(days: Floats, reached: npt.NDArray[np.bool_]) -> float:
    rows = np.flatnonzero(reached)
    return float(days[rows[0]]) if len(rows) else math.inf


def _newest_step(host_ns: npt.NDArray[np.int64], values: Floats) -> Step | None:
    """A step of the whole record, else of its last parts: a step undone later shows only there."""
    for share, least_sigmas in PARTS:
        begin = round((1.0 - share) * len(values))
        if (step := _step(host_ns[begin:], values[begin:], least_sigmas)) is not None:
            return replace(step, first=begin + step.first)
    return None


def _step(host_ns: npt.NDArray[np.int64], values: Floats, least_sigmas: float) -> Step | None:
    """The step of a record, if it is sure, has ``least_sigmas``, and fits better than a line."""
    if len(values) < FEWEST_BINS or host_ns[0] == host_ns[-1]:
        return None
    days = (host_ns - host_ns[-1]) / DAY_NS
    bins = _binned(days, values)
    if bins is None:
        return None
    times, medians = bins
    count = len(medians)
    positions = range(LEAST_BINS, count - LEAST_BINS + 1)
    k = min(positions, key=lambda at: float(np.abs(_level_residuals(medians, at)).sum()))
    residuals = _level_residuals(medians, k)
    slope = float(theilslopes(medians, times).slope)
    line_residuals = medians - slope * times
    line_residuals = line_residuals - np.median(line_residuals)
    least = 1e-9 * float(np.abs(medians).max()) + 1e-300
    misfit, line_misfit = (
        float(np.abs(values).sum()) + least for values in (residuals, line_residuals)
    )
    # Schwarz's criterion for both: a step has one more parameter, its time.
    better = count * math.log(line_misfit / misfit) - 0.5 * math.log(count)
    if better < math.log(SURE / (1.0 - SURE)):
        return None
    sigma = max(
        MAD_TO_SIGMA * float(np.median(np.abs(residuals))), float(residuals.std()) / 2.0, least
    )
    error = sigma * _correlation_factor(residuals) / np.sqrt([k, count - k])
    before, after = (float(trim_mean(part, TRIMMED)) for part in (medians[:k], medians[k:]))
    chance = (1.0 - SURE) / len(positions)  # any position may look like a step by chance
    at_once = np.median(medians[k : k + LEAST_BINS]) - np.median(medians[k - LEAST_BINS : k])
    if abs(at_once) < max(AT_ONCE * abs(after - before), least_sigmas * sigma):
        return None
    if abs(after - before) < student.ppf(1.0 - chance / 2.0, count - 2) * math.hypot(*error):
        return None
    first, low, high = _locate_step(
        values, np.searchsorted(days, times[[k - 1, k]]), (before, after)
    )
    half = float(student.ppf(0.5 + CONFIDENCE / 2.0, count - 2)) * error
    # From cycles: among few bins the one with the step in it would weigh too much.
    before, after = (float(trim_mean(part, TRIMMED)) for part in (values[:first], values[first:]))
    last_ns, new_ns, earliest_ns, latest_ns = (
        int(host_ns[cycle]) for cycle in (first - 1, first, low - 1, high)
    )
    levels = before, float(half[0]), after, float(half[1])
    return Step(*levels, last_ns, new_ns, earliest_ns, latest_ns, first)


def _level_residuals(medians: Floats, k: int) -> Floats:
    """Residuals of two levels, the second one from bin ``k`` on."""
    levels = np.repeat([np.median(medians[:k]), np.median(medians[k:])], [k, len(medians) - k])
    residuals: Floats = medians - levels
    return residuals


def _locate_step(
    values: Floats, near: npt.NDArray[np.int64], levels: tuple[float, float]
) -> tuple[int, int, int]:
    """The first cycle of the new level, and the bounds of its 95 % interval.

    ``near`` are cycles in the bins on either side of the step.
    """
    width = int(near[1] - near[0])
    begin, end = max(int(near[0]) - width, 0), min(int(near[1]) + width, len(values))
    off_before, off_after = (np.abs(values[begin:end] - level) for level in levels)
    cost = np.concatenate([[0.0], np.cumsum(off_before)]) + np.concatenate(
        [np.cumsum(off_after[::-1])[::-1], [0.0]]
    )
    cost = cost[1:-1]  # each side has at least one cycle
    best = int(np.argmin(cost))
    scale = max(float(np.minimum(off_before, off_after).mean()), 1e-300)
    likely = np.flatnonzero(cost - cost[best] <= LIKELY * scale)
    return begin + 1 + best, begin + 1 + int(likely[0]), begin + 1 + int(likely[-1])


def _binned(days: Floats, values: Floats) -> tuple[Floats, Floats] | None:
    """Mean time and median of each bin that holds cycles; None if there are too few bins."""
    edges = np.searchsorted(days, np.linspace(days[0], 0.0, BINS + 1)[1:-1])
    cuts = [0, *dict.fromkeys(int(edge) for edge in edges if 0 < edge < len(days)), len(days)]
    if len(cuts) <= FEWEST_BINS:
        return None
    bins = [slice(first, last) for first, last in pairwise(cuts)]
    times = np.array([days[rows].mean() for rows in bins])
    return times, np.array([np.median(values[rows]) for rows in bins])


def _correlation_factor(residuals: Floats) -> float:
    """Factor by which correlation of neighbours widens the standard error of a mean.

    √((1 + r)/(1 − r)) for a correlation r. Fitting the line lowers r; here that is corrected.
    """
    power = float(residuals @ residuals)
    if power == 0.0:
        return 1.0
    correlation = float(residuals[1:] @ residuals[:-1]) / power
    r = min(
        max((correlation + 2.0 / len(residuals)) / (1.0 - 4.0 / len(residuals)), 0.0), MOST_ALIKE
    )
    return math.sqrt((1.0 + r) / (1.0 - r))
