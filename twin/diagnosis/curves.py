"""Curves over time: measured and expected vacuum, and the deviation below them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from twin.diagnosis.drawing import AFTER, MEASURED, QUIET, Picture, legend
from twin.diagnosis.text import spoken
from twin.languages.texts import tr
from twin.monitor.bins import Floats, Ints
from twin.signals import Phase

COLUMNS = 500  # of a picture's width, each with its lowest and highest values
MOST_SHADED = 120  # phases; more of them are too narrow to be told apart
LABELLED = 0.06  # of a picture's width: a narrower phase has no room for its name
DEVIATION = "measured − expected\n(mbar absolute)"  # what an axis shows
SHADES = {
    Phase.IDLE: "#ffffff",
    Phase.SUCTION: "#e6f0f8",
    Phase.HOLD: "#f5f5f5",
    Phase.BLOW_OFF: "#fdeee2",
}


@dataclass(frozen=True)
class Expected:
    """An expected curve with how it is drawn."""

    vacuum: Floats  # mbar below ambient
    label: str
    colour: str = AFTER
    style: str = "-"


def draw_curves(
    picture: Picture,
    time: Floats,
    measured: Floats | None,
    expected: Sequence[Expected],
    phase: npt.NDArray[np.uint8],
) -> Axes:
    """Draw vacuum (mbar) over time (n), shaded by phase (n); give the lowest panel.

    ``time`` is in the unit of the axis. Without a measured vacuum there is no deviation either.
    """
    if measured is None:
        above = below = picture.subplots()
    else:
        above, below = picture.subplots(2, sharex=True, height_ratios=(2, 1))
        above.plot(time, measured, color=MEASURED, lw=2.2, label=tr("measured"))
        below.axhline(0.0, color=QUIET, lw=0.8)
        below.set_ylabel(tr(DEVIATION))
    for curve in expected:
        colour, style = curve.colour, curve.style
        above.plot(time, curve.vacuum, style, color=colour, lw=1.4, label=curve.label)
        if measured is not None:
            below.plot(time, curve.vacuum - measured, style, color=colour, lw=1.4)
    above.set_ylabel(tr("vacuum\n(mbar below ambient)"))
    _shade(picture, {above, below}, above, time, phase)
    legend(picture, [above])
    return below


def outline(curves: Sequence[Floats], columns: int = COLUMNS) -> Ints:
    """Rows that suffice to draw curves (n each): those with their ends in each column.

    No peak is lost. All rows, where there are hardly more.
    """
    count = len(curves[0])
    width = -(-count // columns)
    if width <= 1 + 2 * len(curves):
        return np.arange(count)
    index = np.minimum(np.arange(columns * width).reshape(columns, width), count - 1)
    rows = [index[:, 0], index[-1, -1:]]
    for curve in curves:
        for missing, end in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            values = np.where(np.isnan(curve), missing, curve)[index]
            rows.append(index[np.arange(columns), end(values, axis=1)])
    return np.unique(np.concatenate(rows))


def _shade(
    picture: Picture,
    panels: set[Axes],
    labelled: Axes,
    time: Floats,
    phase: npt.NDArray[np.uint8],
) -> None:
    """Shade the phases, and label those that are wide enough."""
    labelled.set_xlim(time[0], time[-1])
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1), len(phase) - 1]
    if len(edges) > MOST_SHADED:
        return
    for first, last in pairwise(edges):
        name, begin, end = Phase(phase[first]), float(time[first]), float(time[last])
        for axes in panels:
            axes.axvspan(begin, end, color=SHADES[name], lw=0, zorder=0)
        if end - begin > LABELLED * (time[-1] - time[0]):
            middle = (begin + end) / 2.0
            picture.name_above(labelled, middle, spoken(name.name.lower()))
