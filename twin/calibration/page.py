"""The page of a commissioning: verdict, what to change, measured against fitted, values."""

import html
from collections.abc import Iterator, Sequence
from pathlib import Path

from twin.calibration.calibrate import Calibration
from twin.calibration.commission import Commissioned
from twin.calibration.doubts import Doubt
from twin.calibration.picture import draw_fit
from twin.calibration.read_off import read_off
from twin.calibration.record_checks import Remark
from twin.calibration.report import (
    calibration_headline,
    calibration_verdict,
    headline,
    parameters,
    sentences,
    to_check,
)
from twin.calibration.verdict import Verdict
from twin.config import Asset
from twin.diagnosis import page
from twin.diagnosis.retelling import retold
from twin.diagnosis.text import capital, listed, spoken
from twin.files import write_text
from twin.languages.texts import ENGLISH, Language, language_code, ntr, numeral, speaking, tr
from twin.signals import MBAR, Samples

MARKS = {"good": ("●", "#2e7d4f"), "usable": ("▲", "#8a5200"), "refused": ("■", "#b3261e")}


def summary(commissioned: Commissioned, asset: Asset) -> str:
    """A commissioning as a part of a page: verdict, what to change, residuals, a small picture."""
    mark, colour = MARKS[commissioned.verdict.word]
    title = f"{mark} {asset.type} {asset.id}: {headline(commissioned.verdict)}"
    parts = [*_remarks(commissioned), _residuals(commissioned.verdict)]
    picture = draw_fit(commissioned.calibration.fitted.data, commissioned.samples)
    return page.summary(title, parts, picture, colour)


def calibration_summary(calibration: Calibration, asset: Asset, samples: Samples) -> str:
    """A calibration as a part of a page: how close it is, its values, and a small picture."""
    title = f"{asset.type} {asset.id}: {calibration_headline(calibration)}"
    picture = draw_fit(calibration.fitted.data, samples)
    verdict = page.paragraph(f"{capital(calibration_verdict(calibration.verdict))}.")
    boxes = (*_doubts(calibration.doubts), *_corrections(calibration.remarks))
    parts = [verdict, *boxes, _residuals(calibration.verdict), _parameters(calibration)]
    return page.summary(title, parts, picture)


def write_page(
    commissioned: Commissioned, asset: Asset, path: Path, language: Language = ENGLISH
) -> None:
    """Write the page, one HTML file; SourceError if it cannot be written."""
    with speaking(language):
        write_text(path, _page(commissioned, asset))


def _page(commissioned: Commissioned, asset: Asset) -> str:
    why = [page.paragraph(f"{capital(text)}.") for text in sentences(commissioned.verdict)]
    parts = [
        page.section(tr("Why"), "\n".join(why)),
        page.section(tr("What to change"), "\n".join(_remarks(commissioned))),
        _picture(commissioned),
        page.section(tr("How close"), _residuals(commissioned.verdict)),
        page.section(tr("Read off the record"), _read_off(commissioned)),
        page.section(
            tr("What was found"),
            page.details(tr("All values of the data set"), _parameters(commissioned.calibration)),
        ),
    ]
    footer = ntr(
        "{count} cycle; pressures in mbar, intervals of 95 %",
        "{count} cycles; pressures in mbar, intervals of 95 %",
        commissioned.calibration.cycles,
    )
    verdict = commissioned.verdict
    return framed(asset, verdict.word, f"{_result(verdict)}.", "\n".join(parts), footer)


def framed(asset: Asset, word: str, headline: str, body: str, footer: str) -> str:
    """The page of a commissioning: the ``word`` of its verdict, and the sections in ``body``."""
    mark, colour = MARKS[word]
    return page.PAGE.substitute(
        language=language_code(),
        title=html.escape(tr("Commissioning of {unit}", unit=asset.id)),
        colour=colour,
        mark=mark,
        verdict=html.escape(f"{capital(tr(word))} – {asset.type} {asset.id}"),
        headline=html.escape(headline),
        body=body,
        footer=footer,
    )


def _remarks(commissioned: Commissioned) -> Iterator[str]:
    yield from _doubts(commissioned.doubts)
    yield from _corrections(commissioned.remarks)
    for contradiction in commissioned.contradictions:
        action = capital(retold(contradiction.action))
        yield page.box(capital(retold(contradiction.what)), f"{action}.")
    if commissioned.verdict.word == "refused":
        yield page.paragraph(f"{to_check()}.")
    elif not (commissioned.doubts or commissioned.remarks or commissioned.contradictions):
        yield page.paragraph(
            tr("Nothing to change: the record does not contradict the configuration.")
        )
    if commissioned.unseen:
        yield page.paragraph(f"{capital(commissioned.unseen)}.")


def _doubts(doubts: Sequence[Doubt]) -> Iterator[str]:
    for doubt in doubts:
        what = tr("Is the unit healthy? {what}", what=capital(retold(doubt.text)))
        yield page.box(what, f"{capital(retold(doubt.action))}.")


def _corrections(remarks: Sequence[Remark]) -> Iterator[str]:
    for remark in remarks:
        advice = tr("The record's value is used. Write: {line}", line=retold(remark.line))
        yield page.box(capital(retold(remark.text)), advice)


def _residuals(verdict: Verdict) -> str:
    head = (tr("phase"), tr("rms left, mbar"), tr("floor, mbar"), tr("times the floor"))
    rows = (
        (
            spoken(phase.name.lower()),
            *(
                numeral(value, ".2f")
                for value in (residual.left / MBAR, residual.floor / MBAR, residual.times)
            ),
        )
        for phase, residual in verdict.residuals.items()
    )
    caption = tr("The floor is what cycles of this record differ by, noise included")
    return page.table(caption, head, rows, numbers=(1, 2, 3))


def _read_off(commissioned: Commissioned) -> str:
    head = ("", tr("value"), tr("unit"), tr("known from"))
    rows = (
        (entry.name, entry.shown, entry.unit, entry.known_from) for entry in read_off(commissioned)
    )
    return page.table("", head, rows, numbers=(1,))


def _parameters(calibration: Calibration) -> str:
    head = (tr("key"), tr("value"), tr("from"), tr("to"), tr("unit"), tr("known from"))
    sources = {True: tr("record"), False: tr("assumed")}
    rows = (
        (
            name,
            *(numeral(parameter[key], ".4g") for key in ("value", "low95", "high95")),
            parameter["unit"],
            sources[parameter["determined"]],
        )
        for name, parameter in parameters(calibration).items()
    )
    caption = tr("Values of the data set, with intervals of 95 %")
    return page.table(caption, head, rows, (1, 2, 3))


def _picture(commissioned: Commissioned) -> str:
    title = tr("Measured against fitted: {result}", result=_result(commissioned.verdict))
    picture = draw_fit(commissioned.calibration.fitted.data, commissioned.samples)
    caption = tr("The cycle whose deviation is the median of all.")
    return page.picture(title, picture, caption)


def _result(verdict: Verdict) -> str:
    """Which phases the twin follows, in a short sentence without a full stop."""
    if not verdict.weak:
        return tr("The twin follows every phase")
    phases = [spoken(phase.name.lower()) for phase in verdict.weak]
    return ntr(
        "The twin is off in {phases}",
        "The twin is off in {phases}",
        len(phases),
        phases=listed(phases),
    )
