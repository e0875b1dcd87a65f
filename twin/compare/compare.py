"""What differs between two logs: each figure's mean, spread and difference, and how sure that is.

The 95 % intervals come from resampling whole cycles, widened as a t distribution is where cycles
are few (Hesterberg's expanded percentile interval). Which figures are said to differ is decided
for all of them together (Welch's test with Holm's correction), so that two logs of the same kind
are called different once in twenty comparisons and not in nearly every one.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from twin.compare.side import Side
from twin.figures.curve import CURVE
from twin.figures.table import FIGURES
from twin.inference.levels import UPPER_95
from twin.signals import Phase

Floats = npt.NDArray[np.float64]

FEWEST = 5  # cycles on each side, for an interval
RESAMPLED = 10_000
AT_ONCE = 1_000_000  # numbers that are drawn at a time
WRONGLY = 0.05  # how often, of comparisons of the same with the same, any figure may be marked
UNKNOWN = math.nan
_PHASES = {Phase.SUCTION: "suction", Phase.HOLD: "hold", Phase.BLOW_OFF: "blow-off"}


@dataclass(frozen=True)
class Values:
    """A figure over the cycles of one side that tell it."""

    count: int
    mean: float  # NaN where no cycle tells it
    spread: float  # standard deviation; NaN of fewer than two
    expected: float  # mean of what the twin expected; NaN where it has no say


@dataclass(frozen=True)
class Quantity:
    """One figure of both logs."""

    name: str
    unit: str
    what: str
    a: Values
    b: Values
    difference: float  # of the means, B less A
    low: float  # 95 %; NaN where cycles are too few
    high: float
    chance: float  # of a difference as big in two logs of the same; NaN where nobody can tell
    differs: bool = False  # beyond chance, all figures considered


@dataclass(frozen=True)
class Comparison:
    """Two logs beside each other."""

    a: Side
    b: Side
    figures: Sequence[Quantity]
    deviations: Sequence[Quantity]  # of measured from expected pressure, per phase

    @property
    def different(self) -> list[Quantity]:
        """What differs, the clearest first."""
        found = [one for one in (*self.figures, *self.deviations) if one.differs]
        return sorted(found, key=lambda one: -clearness(one))


def clearness(quantity: Quantity) -> float:
    """How big a difference is, in spreads of a cycle; of counts that never vary, in tenths."""
    spread = math.hypot(quantity.a.spread, quantity.b.spread) / math.sqrt(2.0)
    return abs(quantity.difference) / (spread or 0.1 * abs(quantity.a.mean + quantity.b.mean))


def compare(a: Side, b: Side, seed: int = 1) -> Comparison:
    """Compare all that the cycles of two logs say; ``seed`` is of the resampling."""
    rng = np.random.default_rng(seed)
    if a.derived or b.derived:  # what hangs on commands and the twin beside them tells nothing
        return Comparison(a, b, _judged(list(_off_the_curve(a, b, rng))), [])
    every = [*_figures(a, b, rng), *_deviations(a, b, rng)]
    judged = _judged(every)
    split = sum(one.name in FIGURES for one in judged)
    return Comparison(a, b, judged[:split], judged[split:])


def _figures(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for figure in FIGURES.values():
        sides = [
            (_column(side.measured, figure.name), _column(side.expected, figure.name))
            for side in (a, b)
        ]
        if any(len(measured) for measured, _ in sides):
            yield _quantity(figure.name, figure.unit, figure.what, sides, rng)


def _off_the_curve(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for figure in CURVE.values():
        sides = [(_column(side.curve, figure.name), np.empty(0)) for side in (a, b)]
        if any(len(measured) for measured, _ in sides):
            yield _quantity(figure.name, figure.unit, figure.what, sides, rng)


def _deviations(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for phase, words in _PHASES.items():
        for kind in ("mean", "rms"):
            name = f"{phase.name.lower()}_{kind}"
            sides = [(_column(side.deviation, name), np.empty(0)) for side in (a, b)]
            if any(len(measured) for measured, _ in sides):
                what = f"{kind} of measured less expected pressure in {words}"
                yield _quantity(name, "mbar", what, sides, rng)


def _column(cycles: Iterable[dict[str, float]], name: str) -> Floats:
    """One number of the cycles that tell it."""
    values = np.array([cycle.get(name, UNKNOWN) for cycle in cycles], np.float64)
    told: Floats = values[np.isfinite(values)]
    return told


def _quantity(
    name: str,
    unit: str,
    what: str,
    sides: Sequence[tuple[Floats, Floats]],
    rng: np.random.Generator,
) -> Quantity:
    (a, _), (b, _) = sides
    of_a, of_b = (_values(*side) for side in sides)
    low, high = interval(a, b, rng)
    return Quantity(name, unit, what, of_a, of_b, of_b.mean - of_a.mean, low, high, chance(a, b))


def _values(measured: Floats, expected: Floats) -> Values:
    return Values(
        len(measured),
        float(measured.mean()) if len(measured) else UNKNOWN,
        float(measured.std(ddof=1)) if len(measured) > 1 else UNKNOWN,
        float(expected.mean()) if len(expected) else UNKNOWN,
    )


def interval(a: Floats, b: Floats, rng: np.random.Generator) -> tuple[float, float]:
    """The 95 % interval of mean(b) − mean(a), by resampling; NaN where values are too few."""
    few = min(len(a), len(b))
    if few < FEWEST:
        return UNKNOWN, UNKNOWN
    wide = math.sqrt(few / (few - 1)) * stats.t.ppf(UPPER_95, few - 1)
    tail = float(stats.norm.sf(wide))
    differences = _means(b, rng) - _means(a, rng)
    low, high = np.quantile(differences, [tail, 1.0 - tail])
    return float(low), float(high)


def _means(values: Floats, rng: np.random.Generator) -> Floats:
    """Means of resampled values."""
    at_once = max(AT_ONCE // len(values), 1)
    sizes = [min(at_once, RESAMPLED - first) for first in range(0, RESAMPLED, at_once)]
    drawn = (values[rng.integers(len(values), size=(size, len(values)))] for size in sizes)
    return np.concatenate([some.mean(axis=1) for some in drawn])


def chance(a: Floats, b: Floats) -> float:
    """How probable means as far apart are where nothing differs; NaN where values are too few.

    Welch's test; without any spread, how many ways there are to deal the cycles to two sides.
    """
    if min(len(a), len(b)) < FEWEST:
        return UNKNOWN
    if np.ptp(a) == 0.0 and np.ptp(b) == 0.0:  # no spread to compare with: counts, for example
        return 1.0 if a[0] == b[0] else 2.0 / math.comb(len(a) + len(b), len(a))
    told = stats.ttest_ind_from_stats(
        a.mean(), a.std(ddof=1), len(a), b.mean(), b.std(ddof=1), len(b), equal_var=False
    )
    return float(told.pvalue)


def _judged(every: Sequence[Quantity]) -> list[Quantity]:
    """Mark what differs: from the least probable on, each against those that are left (Holm)."""
    testable = sorted((one for one in every if math.isfinite(one.chance)), key=lambda q: q.chance)
    marked: set[str] = set()
    for left, one in zip(range(len(testable), 0, -1), testable, strict=True):
        if one.chance > WRONGLY / left:
            break
        marked.add(one.name)
    return [replace(one, differs=one.name in marked) for one in every]
