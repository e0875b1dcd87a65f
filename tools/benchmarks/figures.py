"""Results of benchmarks: figures, each with its floor measured in the same run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import linear_regression, median


@dataclass(frozen=True)
class Figure:
    """A measured quantity: its unit, its floor in words, and the limit on it or on the ratio."""

    name: str
    unit: str
    floor: str = ""  # the same work without this project's code
    limit: float | None = None
    limits_ratio: bool = False


@dataclass(frozen=True)
class Line:
    """A cost at several sizes, and the straight line through it."""

    what: str  # the cost, and its unit
    of: str  # the meaning of the sizes
    sizes: Sequence[float]
    costs: Sequence[float]  # medians
    most: float | None = None  # budget, in the unit of the cost
    spent: str = ""  # the budget in words

    @property
    def slope(self) -> float:
        """Cost per unit of size."""
        return linear_regression(self.sizes, self.costs).slope

    @property
    def rest(self) -> float:
        """Cost at size zero, by the line."""
        return linear_regression(self.sizes, self.costs).intercept

    @property
    def off(self) -> float:
        """Largest distance of a cost from the line, in % of the largest cost."""
        pairs = zip(self.sizes, self.costs, strict=True)
        furthest = max(abs(cost - self.rest - self.slope * size) for size, cost in pairs)
        return 100.0 * furthest / max(self.costs)

    @property
    def limit(self) -> float | None:
        """Size at which the line reaches the budget; None if it never does."""
        if self.most is None or self.slope <= 0.0:
            return None
        return (self.most - self.rest) / self.slope


def medians(runs: Sequence[Sequence[float]]) -> list[float]:
    """Median cost at each size; each of ``runs`` has a cost for every size."""
    return [median(column) for column in zip(*runs, strict=True)]


@dataclass(frozen=True)
class Measured:
    """Repetitions of a figure and of its floor, in the figure's unit; empty if not measured.

    ``valid`` is False if the machine was too busy for a meaningful figure.
    """

    values: Sequence[float]
    floors: Sequence[float] = ()
    note: str = ""
    valid: bool = True
    line: Line | None = None  # if the figure is its slope or its value at size zero

    @property
    def ratio(self) -> float | None:
        """Median over median of the floor; None without a floor or with a floor of zero."""
        floor = median(self.floors) if self.floors else 0.0
        return median(self.values) / floor if self.values and floor else None


@dataclass(frozen=True)
class Run:
    """How to measure: short or long, a folder for files, and a function for progress."""

    long: bool
    folder: Path
    tell: Callable[[str], None]
    seconds: float | None = None  # of acquisition over OPC UA, instead of the default


@dataclass(frozen=True)
class Benchmark:
    """A function that measures figures, in their order, and a description of how it does."""

    name: str
    measure: Callable[[Run], Sequence[Measured]]
    how: str
    figures: Sequence[Figure]
    long: bool = False  # only in a long run, or if it is named


def kept(figure: Figure, measured: Measured) -> bool | None:
    """Whether the limit is kept; None without a limit or without a valid figure."""
    if figure.limit is None or not measured.values or not measured.valid:
        return None
    value = measured.ratio if figure.limits_ratio else median(measured.values)
    return None if value is None else value <= figure.limit
