"""How a figure runs over days: a straight line, how sure it is, and when it comes to its limit.

Cycles are first gathered in bins of time, their medians: cycle-to-cycle scatter, and single cycles
that went wrong, then matter little. The line is Theil and Sen's, the median of all slopes between
two bins. How sure it is follows from what the bins scatter about it, enlarged where neighbours
scatter alike, as with the temperature of a day: such a record tells less than its length suggests.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student
from scipy.stats import theilslopes, trim_mean

CONFIDENCE = 0.95  # of bands and intervals
SURE = 0.99  # that the slope has a sign, before a trend is said to be one
BINS = 60  # of a record
FEWEST_BINS = 12
FARTHEST = 3.0  # record's lengths ahead: no line is trusted beyond
DAY_NS = 86_400 * 10**9
TRIMMED = 0.1  # of the bins on either side, before their mean is the line's level
MOST_ALIKE = 0.95  # correlation of neighbours
ROBUST = 1.4826  # standard deviations in the median of absolute deviations, for normal scatter

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
class Reach:
    """When a line comes to a limit, in days from the last cycle; ``latest`` is inf if it may not.

    ``expected`` beyond FARTHEST records ahead is nothing to rely on: it is then inf as well.
    """

    expected: float
    earliest: float
    latest: float


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
    sigma = max(ROBUST * float(np.median(np.abs(off - np.median(off)))), float(off.std()) / 2.0)
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
