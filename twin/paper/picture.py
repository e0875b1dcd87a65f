"""The picture of ``twin paper``: curves like the paper's Fig. 7, and pairs that separate later."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from twin.diagnosis.drawing import MEASURED, empty, write_picture
from twin.paper.evacuation import (
    END_MBAR,
    INSTANCE_SL_MIN,
    OBJECT_SL_MIN,
    RIG,
    SAFETY,
    Floats,
    Unit,
    pressures,
    time_constant,
)
from twin.paper.separation import Separation
from twin.paper.tables import Row, percent_more
from twin.signals import MBAR

LONGEST_MS, HOLD_MS = 2000, 4000
SHOWN = (0.0, 2.0, 10.0, 40.0)  # film coefficients
TEXTBOOK = (("eq. (1)", "#7d3c98", (1, 1.2)), (f"eq. (2) × {SAFETY:g}", "#2e8b57", (1, 1.2)))
COLOURS = ("#8a8a8a", "#3f9b8f", "#0a62a8", "#c8500a")
TITLE = "Evacuation of the paper's test rig, and pairs of film coefficient and bulge"


def draw(rows: Sequence[Row], separation: Separation, path: Path) -> None:
    """Write the picture; errors as ``write_picture`` has them."""
    with empty("paper", 4.9, TITLE, width=11.0) as figure:
        left, right = figure.subplots(1, 2)
        _draw_tables(left, rows, separation)
        _draw_pairs(right, separation)
    write_picture(figure, path)


def _draw_tables(axes: Axes, rows: Sequence[Row], separation: Separation) -> None:
    """Draw vacuum over time on the rig, like Fig. 7."""
    seconds = np.linspace(0.0, LONGEST_MS * 1e-3, LONGEST_MS + 1)
    textbook = zip(TEXTBOOK, _textbook(seconds), strict=True)
    for (label, colour, dashes), curve in textbook:
        axes.plot(seconds, curve, color=colour, lw=1.8, ls=(0, dashes), label=label)
    (extended,) = (pair.unit for pair in separation.pairs if pair.unit.film == separation.film)
    for label, colour, style, unit in (
        ("the paper's model, object-specific", "#c8500a", "--", Unit(OBJECT_SL_MIN)),
        ("the paper's model, instance-specific", "#e0a100", "--", Unit(INSTANCE_SL_MIN)),
        ("this twin, with wall heat and a bulge", "#0a62a8", "-", extended),
    ):
        curve = _vacuum(pressures(RIG, unit, LONGEST_MS))
        axes.plot(seconds, curve, style, color=colour, lw=1.8, label=label)
    _mark(axes)
    over = [percent_more(row.twin_ms, RIG.measured_ms) for row in rows if row.setup is RIG]
    axes.set_title(
        f"Test rig to 600 mbar,rel: the equations take {min(over[:2]):.0f} to {max(over[:2]):.0f} %"
        f" too long,\nthe paper's model {over[3]:.0f} to {over[2]:.0f} %",
        fontsize=10.5,
    )
    axes.set(xlim=(0.0, LONGEST_MS * 1e-3), ylim=(0.0, 880.0))
    _label(axes)


def _draw_pairs(axes: Axes, separation: Separation) -> None:
    """Draw pairs of film coefficient and bulge that meet the measured time, and their hold."""
    switch_off_ms = round(RIG.measured_ms)
    seconds = np.linspace(0.0, (switch_off_ms + HOLD_MS) * 1e-3, switch_off_ms + HOLD_MS + 1)
    shown = [pair.unit for pair in separation.pairs if pair.unit.film in SHOWN]
    for unit, colour in zip(shown, COLOURS, strict=True):
        label = f"film {unit.film:g} W/(m² K), bulge {unit.bulge:.2f}"
        width = 2.4 if unit.film == separation.film else 1.6
        curve = _vacuum(pressures(RIG, unit, switch_off_ms, HOLD_MS))
        axes.plot(seconds, curve, color=colour, lw=width, label=label)
    _mark(axes)
    axes.set_title(
        "Wall heat and bulge: many pairs meet the one measured time,\n"
        "and part when the nozzle goes off and the gas warms up",
        fontsize=10.5,
    )
    axes.set(xlim=(0.0, seconds[-1]), ylim=(0.0, 660.0))
    _label(axes)


def _textbook(seconds: Floats) -> tuple[Floats, Floats]:
    """Vacuum (mbar) over time by equations (1) and (2); the latter ends at end pressure."""
    shares = seconds / (time_constant(RIG) * 1e-3)
    ambient = RIG.ambient_mbar
    first = (ambient - END_MBAR) * -np.expm1(-shares)
    second = -ambient * np.expm1(-shares / SAFETY)
    return first, np.minimum(second, ambient - END_MBAR)


def _vacuum(pressures: Floats) -> Floats:
    return RIG.ambient_mbar - pressures / MBAR


def _mark(axes: Axes) -> None:
    vacuum = RIG.ambient_mbar - RIG.target_mbar
    seconds = RIG.measured_ms * 1e-3
    label = f"measured: {RIG.measured_ms:.0f} ms to {vacuum:.0f} mbar,rel"
    axes.plot(seconds, vacuum, "o", color=MEASURED, ms=8, zorder=5, label=label)


def _label(axes: Axes) -> None:
    axes.set_xlabel("time (s)")
    axes.set_ylabel("vacuum (mbar below ambient)")
    axes.legend(loc="lower right", fontsize=9)
