"""A comparison for Rerun: both mean cycles and their difference over the time since the edge."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from twin.compare.compare import Comparison
from twin.compare.side import Curve, Floats, bins, difference
from twin.compare.text import conclusion, remarks
from twin.errors import SourceError
from twin.signals import NS
from twin.view import import_rerun

TIMELINE = "time since the suction edge"
_COLOURS = {"a": 0x4FB3FFFF, "b": 0xE08A1EFF, "difference": 0xFF6B6BFF}


def record(comparison: Comparison, path: Path) -> None:
    """Write a ``.rrd`` file; ConfigError without Rerun, SourceError if it cannot be written."""
    rr = import_rerun()
    stream = rr.RecordingStream("ejector-twin-compare")
    try:
        stream.save(path, default_blueprint=_blueprint(rr))
    except RuntimeError as error:
        hint = "check the folder and its rights"
        raise SourceError(f"{path}: cannot be written: {error}", hint) from error
    a, b = comparison.a, comparison.b
    stream.send_recording_name(f"A {a.name}, B {b.name}")
    for label, side in (("a", a), ("b", b)):
        name = f"{label.upper()}: {side.name}"
        _send_curve(rr, stream, f"vacuum/{label}/measured", name, side.measured_vacuum)
        expected = f"{label.upper()}: expected"
        _send_curve(rr, stream, f"vacuum/{label}/expected", expected, side.expected_vacuum)
        _send_curve(rr, stream, f"deviation/{label}", name, side.deviation_curve)
    for kind in ("measured", "expected"):
        time, mean, _ = difference(*(getattr(side, f"{kind}_vacuum") for side in (a, b)))
        _send(rr, stream, f"difference/{kind}", f"B − A, {kind} vacuum", (time, mean))
    text = "\n\n".join([conclusion(comparison), *remarks(comparison)])
    stream.log("conclusion", rr.TextDocument(text), static=True, strict=True)
    stream.disconnect()


def _send_curve(rr: Any, stream: Any, path: str, name: str, curve: Curve) -> None:
    is_finite = np.isfinite(curve.mean)
    _send(rr, stream, path, name, (bins()[is_finite], curve.mean[is_finite]))


def _send(rr: Any, stream: Any, path: str, name: str, line: Sequence[Floats]) -> None:
    time, values = line
    colour = next(colour for part, colour in _COLOURS.items() if part in path.split("/"))
    width = 1.0 if path.endswith("expected") else 2.0
    style = rr.SeriesLines(names=name, colors=colour, widths=width)
    stream.log(path, style, static=True, strict=True)
    durations = np.round(time / NS).astype("timedelta64[ns]")
    columns = [rr.TimeColumn(TIMELINE, duration=durations)]
    stream.send_columns(path, columns, rr.Scalars.columns(scalars=values), strict=True)


def _blueprint(rr: Any) -> Any:
    plan = rr.blueprint
    axis = plan.archetypes.TimeAxis(link="LinkToGlobal")
    legend = plan.PlotLegend(plan.Corner2D.RightTop)
    views = [
        plan.TimeSeriesView(origin=origin, name=name, axis_x=axis, plot_legend=legend)
        for origin, name in (
            ("vacuum", "Mean vacuum, mbar below ambient"),
            ("difference", "Difference B − A, mbar"),
            ("deviation", "Measured less expected pressure, mbar"),
        )
    ]
    text = plan.TextDocumentView(origin="conclusion", name="Conclusion")
    return plan.Blueprint(
        plan.Vertical(text, *views, row_shares=[1.0, 3.0, 2.0, 2.0]),
        plan.TimePanel(state="collapsed", timeline=TIMELINE),
        plan.BlueprintPanel(state="hidden"),
        plan.SelectionPanel(state="hidden"),
    )
