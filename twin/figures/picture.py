"""A picture of a trend: cycles, their medians, the line with its band, expected and limit."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Picture

from twin.errors import SourceError
from twin.figures.store import History
from twin.figures.table import Figure
from twin.figures.trend import DAY_NS, FARTHEST, Line, Reach
from twin.figures.words import in_words

MOST_POINTS = 5000  # of cycles
AHEAD = 0.5  # of the record, drawn after its end where nothing is reached


def draw(
    history: History,
    figure: Figure,
    line: Line | None,
    limit: float | None,
    comes: Reach | None,
    path: Path,
) -> None:
    """Draw one figure of a unit over days; SourceError if it cannot be written."""
    days = (history.host_ns - history.host_ns[-1]) / DAY_NS
    values = history.values[f"{figure.name}_measured"]
    every = max(len(days) // MOST_POINTS, 1)
    picture = Picture(figsize=(10.0, 4.5), layout="constrained")
    FigureCanvasAgg(picture)
    axes = picture.subplots()
    axes.plot(days[::every], values[::every], ".", color="0.75", markersize=3, label="cycles")
    expected = history.values[f"{figure.name}_expected"]
    if np.isfinite(expected).any():
        middle = float(np.nanmedian(expected))
        axes.axhline(middle, color="tab:green", linestyle=":", label=f"expected {middle:.3g}")
    if line is not None:
        _draw_line(axes, line, comes)
    if limit is not None:
        _draw_limit(axes, limit)
    axes.set_xlabel("days from the last cycle")
    axes.set_ylabel(f"{figure.name} ({figure.unit})")
    picture.suptitle(in_words(figure, line, limit, comes), x=0.01, ha="left", fontsize=10)
    picture.legend(loc="outside right upper", fontsize="small")
    axes.margins(x=0.01)
    try:
        picture.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be written: {error}", "as .png or .svg") from error


def _draw_limit(axes: Axes, limit: float) -> None:
    """The limit, if it leaves the cycles room to be seen."""
    low, high = axes.get_ylim()
    if low - (high - low) < limit < high + (high - low):
        axes.axhline(limit, color="tab:red", linestyle="--", label=f"limit {limit:.4g}")
    else:
        away = f"limit {limit:.4g},\nnot in the picture"
        axes.plot([], [], color="tab:red", linestyle="--", label=away)


def _draw_line(axes: Axes, line: Line, comes: Reach | None) -> None:
    ahead = AHEAD * line.span
    if comes is not None:
        ahead = max(ahead, min(1.2 * comes.expected, FARTHEST * line.span))
    days = np.linspace(line.days[0], ahead, 300)
    middle, half = line.at(days), line.half(days)
    axes.plot(line.days, line.medians, "o", color="tab:blue", markersize=4, label="medians")
    trend = "line" if line.is_trend else "no trend"
    axes.plot(days, middle, color="tab:blue", label=f"{trend}, {line.slope:+.3g} per day")
    axes.fill_between(days, middle - half, middle + half, color="tab:blue", alpha=0.2, lw=0)
    if comes is not None and comes.earliest < days[-1]:
        end = min(comes.latest, float(days[-1]))
        axes.axvspan(comes.earliest, end, color="tab:red", alpha=0.15, lw=0, label="limit reached")
