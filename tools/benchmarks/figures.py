"""What a benchmark gives: figures, each with its floor measured in the same run."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median


@dataclass(frozen=True)
class Figure:
    """What is measured: its unit, what its floor is, and the limit on it or on the ratio."""

    name: str
    unit: str
    floor: str = ""  # what stands beside it: the same without what is ours
    limit: float | None = None
    limits_ratio: bool = False


@dataclass(frozen=True)
class Measured:
    """Repetitions of a figure and of its floor, in the figure's unit.

    ``valid`` is False where the machine was too busy for the figure to say anything.
    """

    values: Sequence[float]
    floors: Sequence[float] = ()
    note: str = ""
    valid: bool = True

    @property
    def ratio(self) -> float | None:
        """Median over median of the floor; None where there is no floor or it is zero."""
        floor = median(self.floors) if self.floors else 0.0
        return median(self.values) / floor if floor else None


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
    value = measured.ratio if figure.limits_ratio else median(measured.values)
    if figure.limit is None or value is None or not measured.valid:
        return None
    return value <= figure.limit
