"""The table ``[page]``: what a run stores for the page, and where."""

import re
from pathlib import Path

from twin.config import Asset
from twin.settings import Document, Settings

RING = "live.ring"
REPORTS = "reports"


class PageSettings(Settings):
    """The page of one ejector."""

    keep: bool = False  # twin run stores live rows and reports of diagnoses for twin serve
    folder: str = "page"  # folder relative to the configuration's; each ejector has its own in it


def folder_of(document: Document, asset: Asset) -> Path:
    """The folder in which the run of an ejector stores the data for its page."""
    folder = document.section(PageSettings, "page").folder
    name = ".".join(re.sub(r"[^\w-]+", "_", part) for part in (asset.type, asset.id) if part)
    return Path(document.name).parent / folder / name
