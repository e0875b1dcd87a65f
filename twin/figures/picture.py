"""A plot of a trend: cycles, their medians, the line with its band, expected value and limit."""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Picture

from twin.errors import SourceError
from twin.figures.database import History
from twin.figures.key_figures import Figure
from twin.figures.trend import Trend
from twin.instants import DAY_NS

MOST_POINTS = 5000  # of cycles
TITLE = 110  # characters in a line of the title
AHEAD = 0.5  # share of the record that is drawn after its end, if no limit is reached


def draw(history: History, figure: Figure, trend: Trend, title: str, path: Path) -> None:
    """Draw one figure of a unit over time; SourceError if it cannot be written."""
    days = (history.host_ns - history.host_ns[-1]) / DAY_NS
    unit, scale = _axis(float(-days[0]))
    values = history.values[f"{figure.name}_measured"]
    every = max(len(days) // MOST_POINTS, 1)
    picture = Picture(figsize=(10.0, 4.5), layout="constrained")
    FigureCanvasAgg(picture)
    axes = picture.subplots()
    axes.plot(
        days[::every] * scale, values[::every], ".", color="0.75", markersize=3, label="cycles"
    )
    expected = history.values[f"{figure.name}_expected"]
    if np.isfinite(expected).any():
        middle = float(np.nanmedian(expected))
        axes.axhline(middle, color="tab:green", linestyle=":", label=f"expected {middle:.3g}")
    if trend.line is not None or trend.step is not None:
        _draw_course(axes, trend, scale)
    if trend.limit is not None:
        _draw_limit(axes, trend.limit)
    axes.set_xlabel(f"{unit} from the last cycle")
    axes.set_ylabel(f"{figure.name} ({figure.unit})")
    picture.suptitle(fill(title, TITLE), x=0.01, ha="left", fontsize=10)
    picture.legend(loc="outside right upper", fontsize="small")
    axes.margins(x=0.01)
    try:
        picture.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be written: {error}", "as .png or .svg") from error


def _axis(days: float) -> tuple[str, float]:
    """The unit of a time axis over so many days, and the number of units in a day."""
    if days >= 2.0:
        return "days", 1.0
    return ("hours", 24.0) if days * 24.0 >= 2.0 else ("minutes", 1440.0)


def _draw_limit(axes: Axes, limit: float) -> None:
    """Draw the limit, unless it would shrink the cycles too much."""
    low, high = axes.get_ylim()
    if low - (high - low) < limit < high + (high - low):
        axes.axhline(limit, color="tab:red", linestyle="--", label=f"limit {limit:.4g}")
    else:
        away = f"limit {limit:.4g},\nnot in the picture"
        axes.plot([], [], color="tab:red", linestyle="--", label=away)


def _draw_course(axes: Axes, trend: Trend, scale: float) -> None:
    """Draw the levels of a step, the line with its band, and the time of the limit."""
    days, middle, half = trend.shape(trend.ahead(AHEAD))
    line, comes = trend.line, trend.comes
    if line is not None:
        at = line.days * scale
        axes.plot(at, line.medians, "o", color="tab:blue", markersize=4, label="medians")
    rises = line is not None and line.is_trend
    label = "trend" if rises else "step" if trend.step is not None else "no trend"
    if trend.lacking:
        label = f"not measured in the last {trend.lacking} cycles"
    axes.plot(days * scale, middle, color="tab:blue", label=label)
    band = middle - half, middle + half
    axes.fill_between(days * scale, *band, color="tab:blue", alpha=0.2, lw=0)
    if comes is not None and comes.earliest < days[-1]:
        reached = comes.earliest * scale, min(comes.latest, float(days[-1])) * scale
        axes.axvspan(*reached, color="tab:red", alpha=0.15, lw=0, label="limit reached")
