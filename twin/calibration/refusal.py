"""The page of a record that cannot be commissioned: the reason, and what to do."""

from pathlib import Path

from twin.calibration.page import framed
from twin.config import Asset
from twin.diagnosis import page
from twin.diagnosis.retelling import retold
from twin.diagnosis.text import capital
from twin.errors import TwinError
from twin.files import write_text
from twin.languages.texts import ENGLISH, Language, speaking, tr


def write_refusal(error: TwinError, asset: Asset, path: Path, language: Language = ENGLISH) -> None:
    """Write the page, one HTML file; SourceError if it cannot be written."""
    with speaking(language):
        write_text(path, _page(error, asset))


def _page(error: TwinError, asset: Asset) -> str:
    sentences = [capital(retold(text)) for text in (str(error), error.hint) if text]
    return framed(
        asset,
        "refused",
        tr("No twin was fitted to this record."),
        page.section(tr("Why"), page.paragraph(f"{'. '.join(sentences)}.")),
        tr("Nothing is stored."),
    )
