"""What a benchmark gives: figures, each with its floor measured in the same run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import linear_regression, median


@dataclass(frozen=True)
class Figure:
    """What is measured: its unit, what its floor is, and the limit on it or on the ratio."""

    name: str
    unit: str
    floor: str = ""  # what stands beside it: the same without what is ours
    limit: float | None = None
    limits_ratio: bool = False


@dataclass(frozen=True)
class Line:
    """What something costs at several sizes, and the straight line through that."""

    what: str  # and its unit
    of: str  # what the sizes are
    sizes: Sequence[float]
    costs: Sequence[float]  # medians
    most: float | None = None  # that there is to spend
    spent: str = ""  # what that is

    @property
    def slope(self) -> float:
        """Cost of one more."""
        return linear_regression(self.sizes, self.costs).slope

    @property
    def rest(self) -> float:
        """Cost of none, by the line."""
        return linear_regression(self.sizes, self.costs).intercept

    @property
    def off(self) -> float:
        """Furthest that a cost is from the line, % of the largest cost."""
        pairs = zip(self.sizes, self.costs, strict=True)
        far = max(abs(cost - self.rest - self.slope * size) for size, cost in pairs)
        return 100.0 * far / max(self.costs)

    @property
    def limit(self) -> float | None:
        """Size at which all is spent, by the line; None where it is never reached."""
        if self.most is None or self.slope <= 0.0:
            return None
        return (self.most - self.rest) / self.slope


def medians(runs: Sequence[Sequence[float]]) -> list[float]:
    """Costs at several sizes from repeated runs over all of them."""
    return [median(column) for column in zip(*runs, strict=True)]


@dataclass(frozen=True)
class Measured:
    """Repetitions of a figure and of its floor, in the figure's unit; none where none was made.

    ``valid`` is False where the machine was too busy for the figure to say anything.
    """

    values: Sequence[float]
    floors: Sequence[float] = ()
    note: str = ""
    valid: bool = True
    line: Line | None = None  # where the figure is its slope, or what it leaves for a size of none

    @property
    def ratio(self) -> float | None:
        """Median over median of the floor; None where there is no floor or it is zero."""
        floor = median(self.floors) if self.floors else 0.0
        return median(self.values) / floor if self.values and floor else None


@dataclass(frozen=True)
class Run:
    """How it is measured: short or long, a folder for files, and where to say what is going on."""

    long: bool
    folder: Path
    tell: Callable[[str], None]
    seconds: float | None = None  # of acquisition over OPC UA, instead of what is usual


@dataclass(frozen=True)
class Benchmark:
    """A function that measures some figures, in their order, and how it does it for readers."""

    name: str
    measure: Callable[[Run], Sequence[Measured]]
    how: str
    figures: Sequence[Figure]
    long: bool = False  # only in a long run, or where it is named


def kept(figure: Figure, measured: Measured) -> bool | None:
    """Whether the limit is kept; None where there is none or nothing to judge."""
    if figure.limit is None or not measured.values or not measured.valid:
        return None
    value = measured.ratio if figure.limits_ratio else median(measured.values)
    return None if value is None else value <= figure.limit
