"""Compares two logs: mean, spread and difference of each figure, and how certain that is.

The 95 % intervals come from resampling whole cycles. For few cycles they are widened like a t
distribution (Hesterberg's expanded percentile interval). Welch's test with Holm's correction
decides which figures differ, for all of them together. So two logs of the same kind are called
different once in twenty comparisons, and not in nearly every one.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from twin.compare.side import Side
from twin.figures.curve import CURVE
from twin.figures.key_figures import FIGURES
from twin.inference.levels import UPPER_95
from twin.signals import Phase

Floats = npt.NDArray[np.float64]

FEWEST = 5  # cycles on each side, for an interval
RESAMPLED = 10_000
AT_ONCE = 1_000_000  # numbers drawn at a time
WRONGLY = 0.05  # family-wise error rate: how often a comparison of equals may mark any figure
UNKNOWN = math.nan
_PHASES = {Phase.SUCTION: "suction", Phase.HOLD: "hold", Phase.BLOW_OFF: "blow-off"}


@dataclass(frozen=True)
class Values:
    """A figure over those cycles of one side that have it."""

    count: int
    mean: float  # NaN if no cycle has it
    spread: float  # standard deviation; NaN for fewer than two cycles
    expected: float  # mean of the twin's expectation; NaN without one


@dataclass(frozen=True)
class Quantity:
    """One figure of both logs."""

    name: str
    unit: str
    what: str
    a: Values
    b: Values
    difference: float  # of the means, B less A
    low: float  # 95 %; NaN for too few cycles
    high: float
    chance: float  # p value of the difference; NaN for too few cycles
    differs: bool = False  # significant, with all figures considered


@dataclass(frozen=True)
class Comparison:
    """Two logs beside each other."""

    a: Side
    b: Side
    figures: Sequence[Quantity]
    deviations: Sequence[Quantity]  # of measured from expected pressure, per phase

    @property
    def different(self) -> list[Quantity]:
        """The quantities that differ, the clearest first."""
        differing = [quantity for quantity in (*self.figures, *self.deviations) if quantity.differs]
        return sorted(differing, key=lambda quantity: -clearness(quantity))


def clearness(quantity: Quantity) -> float:
    """Size of a difference in spreads of a cycle; for counts that never vary, in tenths."""
    spread = math.hypot(quantity.a.spread, quantity.b.spread) / math.sqrt(2.0)
    return abs(quantity.difference) / (spread or 0.1 * abs(quantity.a.mean + quantity.b.mean))


def compare(a: Side, b: Side, seed: int = 1) -> Comparison:
    """Compare all figures of two logs' cycles; ``seed`` is for the resampling."""
    rng = np.random.default_rng(seed)
    if a.derived or b.derived:  # derived commands make figures of commands and twin meaningless
        return Comparison(a, b, _mark_differences(list(_curve_figures(a, b, rng))), [])
    quantities = [*_figures(a, b, rng), *_deviations(a, b, rng)]
    judged = _mark_differences(quantities)
    split = sum(quantity.name in FIGURES for quantity in judged)
    return Comparison(a, b, judged[:split], judged[split:])


def _figures(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for figure in FIGURES.values():
        sides = [
            (_column(side.measured, figure.name), _column(side.expected, figure.name))
            for side in (a, b)
        ]
        if any(len(measured) for measured, _ in sides):
            yield _quantity(figure.name, figure.unit, figure.what, sides, rng)


def _curve_figures(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for figure in CURVE.values():
        sides = [(_column(side.curve, figure.name), np.empty(0)) for side in (a, b)]
        if any(len(measured) for measured, _ in sides):
            yield _quantity(figure.name, figure.unit, figure.what, sides, rng)


def _deviations(a: Side, b: Side, rng: np.random.Generator) -> Iterator[Quantity]:
    for phase, phase_name in _PHASES.items():
        for kind in ("mean", "rms"):
            name = f"{phase.name.lower()}_{kind}"
            sides = [(_column(side.deviation, name), np.empty(0)) for side in (a, b)]
            if any(len(measured) for measured, _ in sides):
                what = f"{kind} of measured less expected pressure in {phase_name}"
                yield _quantity(name, "mbar", what, sides, rng)


def _column(cycles: Iterable[dict[str, float]], name: str) -> Floats:
    """One figure of all cycles that have it."""
    values = np.array([cycle.get(name, UNKNOWN) for cycle in cycles], np.float64)
    finite: Floats = values[np.isfinite(values)]
    return finite


def _quantity(
    name: str,
    unit: str,
    what: str,
    sides: Sequence[tuple[Floats, Floats]],
    rng: np.random.Generator,
) -> Quantity:
    (a, _), (b, _) = sides
    values_a, values_b = (_values(*side) for side in sides)
    low, high = interval(a, b, rng)
    return Quantity(
        name, unit, what, values_a, values_b, values_b.mean - values_a.mean, low, high, chance(a, b)
    )


def _values(measured: Floats, expected: Floats) -> Values:
    return Values(
        len(measured),
        float(measured.mean()) if len(measured) else UNKNOWN,
        float(measured.std(ddof=1)) if len(measured) > 1 else UNKNOWN,
        float(expected.mean()) if len(expected) else UNKNOWN,
    )


def interval(a: Floats, b: Floats, rng: np.random.Generator) -> tuple[float, float]:
    """The 95 % interval of mean(b) − mean(a), by resampling; NaN for too few values."""
    smaller = min(len(a), len(b))
    if smaller < FEWEST:
        return UNKNOWN, UNKNOWN
    quantile = math.sqrt(smaller / (smaller - 1)) * stats.t.ppf(UPPER_95, smaller - 1)
    tail = float(stats.norm.sf(quantile))
    differences = _means(b, rng) - _means(a, rng)
    low, high = np.quantile(differences, [tail, 1.0 - tail])
    return float(low), float(high)


def _means(values: Floats, rng: np.random.Generator) -> Floats:
    """Means of resampled values."""
    batch = max(AT_ONCE // len(values), 1)
    sizes = [min(batch, RESAMPLED - start) for start in range(0, RESAMPLED, batch)]
    samples = (values[rng.integers(len(values), size=(size, len(values)))] for size in sizes)
    return np.concatenate([sample.mean(axis=1) for sample in samples])


def chance(a: Floats, b: Floats) -> float:
    """The p value of the difference of two means; NaN for too few values.

    Welch's test; without any spread, from the number of ways to deal the cycles to two sides.
    """
    if min(len(a), len(b)) < FEWEST:
        return UNKNOWN
    if np.ptp(a) == 0.0 and np.ptp(b) == 0.0:  # no spread to compare with: counts, for example
        return 1.0 if a[0] == b[0] else 2.0 / math.comb(len(a) + len(b), len(a))
    test = stats.ttest_ind_from_stats(
        a.mean(), a.std(ddof=1), len(a), b.mean(), b.std(ddof=1), len(b), equal_var=False
    )
    return float(test.pvalue)


def _mark_differences(quantities: Sequence[Quantity]) -> list[Quantity]:
    """Mark quantities that differ: from the smallest p value on, by Holm's correction."""
    testable = sorted(
        (quantity for quantity in quantities if math.isfinite(quantity.chance)),
        key=lambda quantity: quantity.chance,
    )
    marked: set[str] = set()
    for remaining, quantity in zip(range(len(testable), 0, -1), testable, strict=True):
        if quantity.chance > WRONGLY / remaining:
            break
        marked.add(quantity.name)
    return [replace(quantity, differs=quantity.name in marked) for quantity in quantities]
