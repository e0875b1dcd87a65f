"""How a figure runs: its newest step, the straight line since then, and when that meets a limit.

A step is a change from one level to another between two cycles, as when a hose tears; a trend is a
slope. Both are told apart by which of the two leaves less, and each only if it is sure.

Cycles are first gathered in bins of time, their medians: cycle-to-cycle scatter, and single cycles
that went wrong, then matter little. The line is Theil and Sen's, the median of all slopes between
two bins. How sure it is follows from what the bins scatter about it, enlarged where neighbours
scatter alike, as with the temperature of a day: such a record tells less than its length suggests.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student
from scipy.stats import theilslopes, trim_mean

from twin.inference.levels import MAD_TO_SIGMA

CONFIDENCE = 0.95  # of bands and intervals
SURE = 0.99  # that the slope has a sign, before a trend is said to be one
BINS = 60  # of a record
FEWEST_BINS = 12
FARTHEST = 3.0  # record's lengths ahead: no line is trusted beyond
LEAST_SPAN = 1.0  # days of a record, from which on its slope is a rate per day
LEAST_BINS = 3  # on either side of a step
AT_ONCE = 0.5  # of a step, within LEAST_BINS before and after it: what grows slowly is none
# Of the cycles, the last ones in which a step is looked for; and how many sigmas of the bins it
# must have there: what only wanders looks like a step of some sigmas in one part or another.
PARTS = ((1.0, 0.0), (0.5, 10.0), (0.25, 10.0))
LIKELY = 1.92  # of log-likelihood, that where a step is best may be better: 95 %
DAY_NS = 86_400 * 10**9
ENDED = 3  # cycles in a row without a value, at least, where a figure can be measured no more
TRIMMED = 0.1  # of the bins on either side, before their mean is the line's level
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
    alike: float  # how many times wider all intervals are for neighbours that scatter alike

    @property
    def is_rate(self) -> bool:
        """Whether the record is long enough to give a rate per day, and when a limit comes."""
        return self.span >= LEAST_SPAN

    @property
    def is_trend(self) -> bool:
        """Whether the slope is surely not zero."""
        return abs(self.slope) > self.slope_half(SURE)

    def slope_half(self, confidence: float = CONFIDENCE) -> float:
        """Half the width of the slope's interval (per day)."""
        return self._times(confidence) * self.sigma / math.sqrt(self._spread)

    def at(self, days: Floats) -> Floats:
        """The line at these times."""
        return self.level + self.slope * days

    def half(self, days: Floats, confidence: float = CONFIDENCE) -> Floats:
        """Half the width of the band within which the line runs."""
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
        """Standard errors on either side."""
        return float(student.ppf(0.5 + confidence / 2.0, len(self.days) - 2)) * self.alike


@dataclass(frozen=True)
class Step:
    """A change from one level to another; halves are those of 95 % intervals.

    It was after the cycle received at ``earliest_ns`` (UTC) and by that at ``latest_ns``, most
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
    """When a line comes to a limit, in days from the last cycle; ``latest`` is inf if it may not.

    ``expected`` beyond FARTHEST records ahead is nothing to rely on: it is then inf as well.
    """

    expected: float
    earliest: float
    latest: float


@dataclass(frozen=True)
class Trend:
    """How a record runs: its newest step, and the line since then or through all of it.

    Without a step None; without a line where there are too few cycles. ``comes`` is when the line
    comes up to the ``limit``. A figure that can be measured no more has no future.
    """

    begin_ns: int  # of the record: first and last cycle that has a value
    end_ns: int
    lacking: int  # cycles after its end, without a value; 0 where that is as usual
    step: Step | None
    line: Line | None
    limit: float | None
    comes: Reach | None

    def ahead(self, share: float) -> float:
        """How many days after the record's end are of interest: a share of it, or to the limit."""
        if self.line is None or self.lacking:
            return 0.0
        ahead = share * self.line.span
        if self.comes is not None:
            ahead = max(ahead, min(1.2 * self.comes.expected, FARTHEST * self.line.span))
        return ahead

    def shape(self, ahead: float) -> tuple[Floats, Floats, Floats]:
        """The course as one draws it, to ``ahead`` days after the record's end.

        Days from the last cycle, the middle there, and half of its 95 % interval.
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
        parts = [[np.broadcast_to(one, len(piece[0])) for one in piece] for piece in pieces]
        days, middle, half = (np.concatenate(one) for one in zip(*parts, strict=True))
        return days, middle, half


def trend_of(host_ns: npt.NDArray[np.int64], values: Floats, limit: float | None = None) -> Trend:
    """How a record of cycles in order (received UTC, ns) runs; values may be NaN."""
    known = np.isfinite(values)
    lacking = _lacking(known)
    host_ns, values = host_ns[known], values[known]
    newest, first = None, 0
    while (step := _newest_step(host_ns[first:], values[first:])) is not None:
        newest, first = step, first + step.first
    line = line_through(host_ns[first:], values[first:])
    comes = None
    if line is not None and limit is not None and line.is_rate and not lacking:
        comes = reach(line, limit)
    begin, end = (int(host_ns[0]), int(host_ns[-1])) if len(host_ns) else (0, 0)
    return Trend(begin, end, lacking, newest, line, limit, comes)


def _lacking(known: npt.NDArray[np.bool_]) -> int:
    """How many of the last cycles have no value; 0 where stretches as long were seen before.

    A stretch counts as usual if one in a hundred between two values was as long.
    """
    rows = np.flatnonzero(known)
    if not len(rows):
        return 0
    lacking = len(known) - 1 - int(rows[-1])
    between = np.diff(rows) - 1
    usual = int(np.quantile(between, SURE, method="lower")) if len(between) else 0
    return lacking if lacking >= ENDED and lacking > usual else 0


def line_through(host_ns: npt.NDArray[np.int64], values: Floats) -> Line | None:
    """The line through a record of cycles in order; None where it is too short to say anything."""
    known = np.isfinite(values)
    if known.sum() < FEWEST_BINS:
        return None
    host_ns, values = host_ns[known], values[known]
    days = (host_ns - host_ns[-1]) / DAY_NS
    if days[0] >= 0.0:
        return None
    bins = _binned(days, values)
    if bins is None:
        return None
    times, medians = bins
    slope = float(theilslopes(medians, times).slope)
    level = float(trim_mean(medians - slope * times, TRIMMED))
    off = medians - level - slope * times
    sigma = max(
        MAD_TO_SIGMA * float(np.median(np.abs(off - np.median(off)))), float(off.std()) / 2.0
    )
    return Line(times, medians, level, slope, sigma, _alike(off))


def reach(line: Line, limit: float) -> Reach | None:
    """When ``line`` comes up to ``limit``; None where it does not rise for sure, or is beyond."""
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
    """A step of the whole, else of its last parts: one that was undone stands out only there."""
    for part, clear in PARTS:
        begin = round((1.0 - part) * len(values))
        if (step := _step(host_ns[begin:], values[begin:], clear)) is not None:
            return replace(step, first=begin + step.first)
    return None


def _step(host_ns: npt.NDArray[np.int64], values: Floats, clear: float) -> Step | None:
    """The step that a record has, if it is sure, so ``clear`` (sigmas), and more than a line."""
    if len(values) < FEWEST_BINS or host_ns[0] == host_ns[-1]:
        return None
    days = (host_ns - host_ns[-1]) / DAY_NS
    bins = _binned(days, values)
    if bins is None:
        return None
    times, medians = bins
    count = len(medians)
    places = range(LEAST_BINS, count - LEAST_BINS + 1)
    k = min(places, key=lambda at: float(np.abs(_off_levels(medians, at)).sum()))
    off = _off_levels(medians, k)
    slope = float(theilslopes(medians, times).slope)
    off_line = medians - slope * times
    off_line = off_line - np.median(off_line)
    least = 1e-9 * float(np.abs(medians).max()) + 1e-300
    left, left_by_line = (float(np.abs(one).sum()) + least for one in (off, off_line))
    # Schwarz's criterion of the two: a step has a number more, its time.
    better = count * math.log(left_by_line / left) - 0.5 * math.log(count)
    if better < math.log(SURE / (1.0 - SURE)):
        return None
    sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(off))), float(off.std()) / 2.0, least)
    error = sigma * _alike(off) / np.sqrt([k, count - k])
    before, after = (float(trim_mean(one, TRIMMED)) for one in (medians[:k], medians[k:]))
    chance = (1.0 - SURE) / len(places)  # as each place may look like a step by chance
    at_once = np.median(medians[k : k + LEAST_BINS]) - np.median(medians[k - LEAST_BINS : k])
    if abs(at_once) < max(AT_ONCE * abs(after - before), clear * sigma):
        return None
    if abs(after - before) < student.ppf(1.0 - chance / 2.0, count - 2) * math.hypot(*error):
        return None
    first, low, high = _where(values, np.searchsorted(days, times[[k - 1, k]]), (before, after))
    half = float(student.ppf(0.5 + CONFIDENCE / 2.0, count - 2)) * error
    # By their cycles: of few bins the one with the step in it would count too much.
    before, after = (float(trim_mean(one, TRIMMED)) for one in (values[:first], values[first:]))
    last, new, earliest, latest = (int(host_ns[one]) for one in (first - 1, first, low - 1, high))
    levels = before, float(half[0]), after, float(half[1])
    return Step(*levels, last, new, earliest, latest, first)


def _off_levels(medians: Floats, k: int) -> Floats:
    """What two levels leave, the second one from bin ``k`` on."""
    levels = np.repeat([np.median(medians[:k]), np.median(medians[k:])], [k, len(medians) - k])
    off: Floats = medians - levels
    return off


def _where(
    values: Floats, near: npt.NDArray[np.int64], levels: tuple[float, float]
) -> tuple[int, int, int]:
    """The first cycle of the new level, and the first and last one that it may be as well (95 %).

    ``near`` are cycles in the bins on either side of the step.
    """
    width = int(near[1] - near[0])
    begin, end = max(int(near[0]) - width, 0), min(int(near[1]) + width, len(values))
    off_before, off_after = (np.abs(values[begin:end] - level) for level in levels)
    cost = np.concatenate([[0.0], np.cumsum(off_before)]) + np.concatenate(
        [np.cumsum(off_after[::-1])[::-1], [0.0]]
    )
    cost = cost[1:-1]  # one cycle at least is on either side
    best = int(np.argmin(cost))
    scale = max(float(np.minimum(off_before, off_after).mean()), 1e-300)
    likely = np.flatnonzero(cost - cost[best] <= LIKELY * scale)
    return begin + 1 + best, begin + 1 + int(likely[0]), begin + 1 + int(likely[-1])


def _binned(days: Floats, values: Floats) -> tuple[Floats, Floats] | None:
    """Mean time and median of each bin that holds cycles; None where there are too few."""
    edges = np.searchsorted(days, np.linspace(days[0], 0.0, BINS + 1)[1:-1])
    cuts = [0, *dict.fromkeys(int(edge) for edge in edges if 0 < edge < len(days)), len(days)]
    if len(cuts) <= FEWEST_BINS:
        return None
    parts = [slice(first, last) for first, last in pairwise(cuts)]
    times = np.array([days[part].mean() for part in parts])
    return times, np.array([np.median(values[part]) for part in parts])


def _alike(off: Floats) -> float:
    """How many times less sure a mean is than its bins' scatter says, for they are alike.

    For scatter whose neighbours correlate by r: √((1 + r)/(1 − r)). The line has taken from r what
    is added to it here.
    """
    power = float(off @ off)
    if power == 0.0:
        return 1.0
    found = float(off[1:] @ off[:-1]) / power
    r = min(max((found + 2.0 / len(off)) / (1.0 - 4.0 / len(off)), 0.0), MOST_ALIKE)
    return math.sqrt((1.0 + r) / (1.0 - r))
