"""The picture of a comparison: both mean cycles, their twins, and what differs."""

from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes

from twin.compare.compare import Comparison
from twin.compare.side import Curve, Floats, Side, bins, difference
from twin.compare.text import conclusion
from twin.diagnosis.drawing import Picture, empty, write_picture

COLOURS = {"A": "#0a62a8", "B": "#c8500a"}
TITLE = 130  # characters in a line


def draw(comparison: Comparison) -> Picture:
    """Draw both mean cycles, their difference, and the deviation of each from its twin."""
    title = conclusion(comparison)
    with empty("compare", 8.0, title, width=10.0) as figure:
        vacuum, difference, deviation = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.2, 1.2]}
        )
        for label, side in (("A", comparison.a), ("B", comparison.b)):
            _draw_vacuum(vacuum, label, side)
            _band(deviation, side.deviation_curve, COLOURS[label], f"{label}: measured − expected")
        _draw_difference(difference, comparison)
        _name(vacuum, "vacuum (mbar)")
        _name(difference, "difference (mbar)")
        _name(deviation, "deviation (mbar)")
        deviation.set_xlabel("time since the suction edge (s)")
        deviation.set_xlim(0.0, _end(comparison))
        figure.suptitle(fill(title, TITLE), x=0.01, ha="left", fontsize=10.5)
    return figure


def write(comparison: Comparison, path: Path) -> None:
    """Write the picture; errors as ``write_picture`` has them."""
    write_picture(draw(comparison), path)


def _draw_vacuum(axes: Axes, label: str, side: Side) -> None:
    name = f"{label}: {side.name}, {len(side.cycles)} cycles"
    _band(axes, side.measured_vacuum, COLOURS[label], name)
    time, expected, _ = _shown(side.expected_vacuum)
    axes.plot(time, expected, "--", color=COLOURS[label], lw=1.2, label=f"{label}: expected")


def _draw_difference(axes: Axes, comparison: Comparison) -> None:
    """Draw B less A: measured with the 95 % band of the means, and expected."""
    measured = [side.measured_vacuum for side in (comparison.a, comparison.b)]
    time, mean, half = difference(*measured)
    counts = [len(side.cycles) for side in (comparison.a, comparison.b)]
    if min(counts) > 1:
        axes.fill_between(time, mean - half, mean + half, color="0.6", alpha=0.5, lw=0)
    axes.plot(time, mean, color="0.1", lw=1.3, label="B − A, measured vacuum (band: 95 %)")
    time, expected, _ = difference(comparison.a.expected_vacuum, comparison.b.expected_vacuum)
    axes.plot(time, expected, "--", color="0.45", lw=1.2, label="B − A, expected vacuum")


def _band(axes: Axes, curve: Curve, colour: str, label: str) -> None:
    """Draw the mean with a band of one spread on both sides."""
    time, mean, spread = _shown(curve)
    axes.fill_between(time, mean - spread, mean + spread, color=colour, alpha=0.25, lw=0)
    axes.plot(time, mean, color=colour, lw=1.5, label=label)


def _shown(curve: Curve) -> tuple[Floats, Floats, Floats]:
    is_finite = np.isfinite(curve.mean)
    return bins()[is_finite], curve.mean[is_finite], curve.spread[is_finite]


def _end(comparison: Comparison) -> float:
    """When the longer of the mean cycles ends (s)."""
    ends = [
        float(bins()[np.isfinite(side.measured_vacuum.mean)][-1])
        for side in (comparison.a, comparison.b)
    ]
    return max(ends)


def _name(axes: Axes, label: str) -> None:
    axes.set_ylabel(label)
    axes.legend(fontsize=9, loc="upper right")
