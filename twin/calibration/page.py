"""The page of a commissioning: verdict, what to change, measured against fitted, values."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.calibration.commission import Commissioned
from twin.calibration.report import headline, parameters
from twin.config import Asset
from twin.diagnosis import page
from twin.diagnosis.drawing import AFTER, MEASURED, as_svg, empty, legend
from twin.files import write_text
from twin.live import Twin
from twin.model.dataset import DataSet
from twin.monitor.cycles import Cycle, whole
from twin.signals import MBAR, NS, Phase, Samples

MARKS = {"good": ("●", "#2e7d4f"), "usable": ("▲", "#b36b00"), "refused": ("■", "#b3261e")}
HEIGHT = 5.0  # inches


def write_page(commissioned: Commissioned, asset: Asset, path: Path) -> None:
    """Write the page, one HTML file that needs no network."""
    mark, colour = MARKS[commissioned.verdict.word]
    parts = [
        page.section("What to change", "\n".join(_remarks(commissioned))),
        _picture(commissioned),
        page.section("How close", _residuals(commissioned)),
        page.section("What was found", _parameters(commissioned)),
    ]
    text = page.PAGE.substitute(
        title=f"Commissioning of {asset.id}",
        colour=colour,
        mark=mark,
        verdict=commissioned.verdict.word,
        headline=f"{asset.type} {asset.id}: {headline(commissioned.verdict)}",
        body="\n".join(parts),
        footer=f"{commissioned.calibration.cycles} cycles; pressures in mbar, intervals of 95 %",
    )
    write_text(path, text)


def _remarks(commissioned: Commissioned) -> Iterator[str]:
    for remark in commissioned.remarks:
        yield page.box(remark.text, f"The record's value is used. Write: {remark.line}")
    for contradiction in commissioned.contradictions:
        yield page.box(
            contradiction.what, f"{contradiction.action[0].upper()}{contradiction.action[1:]}."
        )
    if not commissioned.remarks and not commissioned.contradictions:
        yield page.paragraph("Nothing: the record does not contradict the configuration.")
    if commissioned.unseen:
        yield page.paragraph(commissioned.unseen)


def _residuals(commissioned: Commissioned) -> str:
    head = ("phase", "rms left, mbar", "floor, mbar", "times the floor")
    rows = (
        (
            phase.name.lower().replace("_", "-"),
            *(
                f"{value:.2f}"
                for value in (residual.left / MBAR, residual.floor / MBAR, residual.times)
            ),
        )
        for phase, residual in commissioned.verdict.residuals.items()
    )
    caption = "The floor is what cycles of this record differ by, noise included"
    return page.table(caption, head, rows, numbers=(1, 2, 3))


def _parameters(commissioned: Commissioned) -> str:
    head = ("value", "found", "from", "to", "unit", "known from")
    rows = (
        (
            name,
            *(f"{parameter[key]:.4g}" for key in ("value", "low95", "high95")),
            parameter["unit"],
            "record" if parameter["determined"] else "assumed",
        )
        for name, parameter in parameters(commissioned.calibration).items()
    )
    return page.table("Values of the data set, with intervals of 95 %", head, rows, (1, 2, 3))


def _picture(commissioned: Commissioned) -> str:
    title = f"Measured against fitted: {_worst(commissioned)}"
    alt = "Vacuum of one cycle, measured and fitted, and the deviation below it"
    with empty("commissioning", HEIGHT) as figure:
        _draw(figure, _typical(commissioned.calibration.fitted.data, commissioned.samples))
        svg = as_svg(figure, alt)
    return page.picture(title, svg, "The cycle whose deviation is the median of all.")


def _worst(commissioned: Commissioned) -> str:
    if not commissioned.verdict.weak:
        return "the twin follows every phase"
    names = [phase.name.lower().replace("_", "-") for phase in commissioned.verdict.weak]
    return f"the twin is off in {' and '.join(names)}"


def _typical(data: DataSet, samples: Samples) -> Cycle:
    """The cycle with the median deviation."""
    cycles = [cycle for cycle in whole(Twin.of(data).over([samples])) if cycle.settled]
    cycles.sort(key=lambda cycle: float(np.nanmean(cycle.off**2)))
    return cycles[len(cycles) // 2]


def _draw(figure: Figure, cycle: Cycle) -> None:
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.0, 1.0))
    seconds = (cycle.samples["time_ns"] - cycle.samples["time_ns"][0]) * NS
    measured = cycle.samples["pressure"].astype(float) / MBAR
    fitted = cycle.ticks["expected"].astype(float) / MBAR
    above.plot(seconds, measured, color=MEASURED, linewidth=1.6, label="measured")
    above.plot(seconds, fitted, color=AFTER, linewidth=1.0, label="fitted")
    above.set_ylabel("pressure, mbar absolute")
    below.plot(seconds, cycle.off, color=AFTER, linewidth=0.8)
    below.set_ylabel("measured less\nfitted, mbar")
    below.set_xlabel("time since suction was commanded, s")
    blown = cycle.ticks["phase"] == Phase.BLOW_OFF
    for axes in (above, below):
        axes.fill_between(
            seconds, 0, 1, where=blown, transform=axes.get_xaxis_transform(), color="#eeeeee"
        )
    legend(figure, (above,))
