"""Key figures for people: a table of cycles, and trends in a sentence."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from twin.figures.settings import Limits
from twin.figures.store import History
from twin.figures.table import FIGURES, Figure
from twin.figures.trend import FARTHEST, FEWEST_BINS, SURE, Line, Reach, line_through, reach

SHOWN = ("t0", "t1", "leakage", "free_flow", "max_vacuum", "nozzle_share", "air", "supply")
NO_DASH = {"-": "", "0 or 1": "", "0 to 3": ""}


def cycles_table(cycles: Sequence[Mapping[str, Any]]) -> str:
    """One line for each cycle: measured, with what was expected in brackets."""
    head = ["cycle", *(f"{name} ({FIGURES[name].unit})" for name in SHOWN), "warnings"]
    rows = [head, *([*_cells(one)] for one in cycles)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _cells(cycle: Mapping[str, Any]) -> list[str]:
    both = [
        f"{_number(cycle.get(f'{name}_measured'))} ({_number(cycle.get(f'{name}_expected'))})"
        for name in SHOWN
    ]
    return [str(cycle["cycle"]), *both, ", ".join(cycle["warnings"])]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def trend_of(
    history: History, figure: Figure, limits: Limits
) -> tuple[Line | None, float | None, Reach | None]:
    """The line through a figure's record, its limit, and when it comes to it; None where not."""
    line = line_through(history.host_ns, history.values[f"{figure.name}_measured"])
    limit = limit_of(figure.name, limits)
    return line, limit, reach(line, limit) if line and limit is not None else None


def limit_of(name: str, limits: Limits) -> float | None:
    """The limit of a figure, where the field has one that it may come up to."""
    return {"t1": limits.t1, "leakage": limits.leakage, "free_flow": limits.free_flow}.get(name)


def in_words(figure: Figure, line: Line | None, limit: float | None, comes: Reach | None) -> str:
    """A trend in a sentence; that there is none is said as well."""
    unit = NO_DASH.get(figure.unit, f" {figure.unit}")
    if line is None:
        return f"{figure.name}: not enough to say: fewer than {FEWEST_BINS} stretches with cycles"
    now = f"{figure.name}: {line.level:.4g}{unit}"
    slope = f"{line.slope:+.3g} ± {line.slope_half():.2g}{unit} per day"
    if not line.is_trend:
        return f"{now}, no trend ({slope} in {line.span:.1f} days)"
    told = f"{now}, {slope}, in {line.span:.1f} days"
    if limit is None:
        return told
    if line.level >= limit:
        return f"{told}; over its limit of {limit:.4g}{unit}"
    return f"{told}; {_comes(comes, line, f'its limit of {limit:.4g}{unit}')}"


def _comes(comes: Reach | None, line: Line, limit: str) -> str:
    if comes is None:
        return f"away from {limit}"
    if not math.isfinite(comes.expected):
        return f"{limit} is more than {FARTHEST * line.span:.1f} days away"
    latest = f"{comes.latest:.1f}" if math.isfinite(comes.latest) else "never"
    return f"{limit} in {comes.expected:.1f} days ({comes.earliest:.1f} to {latest})"


def trend_plain(
    figure: Figure, line: Line | None, limit: float | None, comes: Reach | None
) -> dict[str, Any]:
    """The same as JSON has it; null where there is nothing to say."""
    plain: dict[str, Any] = {"figure": figure.name, "unit": figure.unit, "limit": limit}
    plain |= {"line": None, "days_to_limit": None}
    if line is not None:
        plain["line"] = {
            "level": line.level,
            "per_day": line.slope,
            "per_day_95": [line.slope - line.slope_half(), line.slope + line.slope_half()],
            "days": line.span,
            "is_trend": line.is_trend,
            "sure": SURE,
        }
    if comes is not None:
        days = (comes.expected, comes.earliest, comes.latest)
        names = ("expected", "low95", "high95")
        plain["days_to_limit"] = {
            name: value if math.isfinite(value) else None
            for name, value in zip(names, days, strict=True)
        }
    return plain
