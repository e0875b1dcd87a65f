"""The page of a commissioning: verdict, what to change, measured against fitted, values."""

import html
from collections.abc import Iterator
from pathlib import Path

from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.picture import draw_fit
from twin.calibration.report import calibration_headline, headline, parameters
from twin.config import Asset
from twin.diagnosis import page
from twin.diagnosis.drawing import as_svg
from twin.files import write_text
from twin.language import ENGLISH
from twin.signals import MBAR, Samples

MARKS = {"good": ("●", "#2e7d4f"), "usable": ("▲", "#b36b00"), "refused": ("■", "#b3261e")}


def summary(commissioned: Commissioned, asset: Asset) -> str:
    """A commissioning as a part of a page: verdict, what to change, residuals, a small picture."""
    mark, colour = MARKS[commissioned.verdict.word]
    title = f"{mark} {asset.type} {asset.id}: {headline(commissioned.verdict)}"
    parts = [*_remarks(commissioned), _residuals(commissioned)]
    picture = draw_fit(commissioned.calibration.fitted.data, commissioned.samples)
    return page.summary(title, parts, picture, colour)


def calibration_summary(calibration: Calibration, asset: Asset, samples: Samples) -> str:
    """A calibration as a part of a page: how close it is, its values, and a small picture."""
    title = f"{asset.type} {asset.id}: {calibration_headline(calibration)}"
    picture = draw_fit(calibration.fitted.data, samples)
    return page.summary(title, [_parameters(calibration)], picture)


def write_page(commissioned: Commissioned, asset: Asset, path: Path) -> None:
    """Write the page, one HTML file that needs no network."""
    mark, colour = MARKS[commissioned.verdict.word]
    parts = [
        page.section("What to change", "\n".join(_remarks(commissioned))),
        _picture(commissioned),
        page.section("How close", _residuals(commissioned)),
        page.section("What was found", _parameters(commissioned.calibration)),
    ]
    text = page.PAGE.substitute(
        language=ENGLISH.code,
        title=html.escape(f"Commissioning of {asset.id}"),
        colour=colour,
        mark=mark,
        verdict=commissioned.verdict.word,
        headline=html.escape(f"{asset.type} {asset.id}: {headline(commissioned.verdict)}"),
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
        yield page.paragraph("Nothing to change: the record does not contradict the configuration.")
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


def _parameters(calibration: Calibration) -> str:
    head = ("value", "found", "from", "to", "unit", "known from")
    rows = (
        (
            name,
            *(f"{parameter[key]:.4g}" for key in ("value", "low95", "high95")),
            parameter["unit"],
            "record" if parameter["determined"] else "assumed",
        )
        for name, parameter in parameters(calibration).items()
    )
    return page.table("Values of the data set, with intervals of 95 %", head, rows, (1, 2, 3))


def _picture(commissioned: Commissioned) -> str:
    title = f"Measured against fitted: {_worst(commissioned)}"
    picture = draw_fit(commissioned.calibration.fitted.data, commissioned.samples)
    return page.picture(title, as_svg(picture), "The cycle whose deviation is the median of all.")


def _worst(commissioned: Commissioned) -> str:
    if not commissioned.verdict.weak:
        return "the twin follows every phase"
    names = [phase.name.lower().replace("_", "-") for phase in commissioned.verdict.weak]
    return f"the twin is off in {' and '.join(names)}"
