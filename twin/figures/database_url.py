"""The choice of the figure database: the named one, else a file beside the configuration."""

from pathlib import Path

from sqlalchemy import URL

from twin.assets.engine import configured
from twin.figures.database import FIGURE_DATABASE, Store, open_store
from twin.figures.settings import FigureSettings
from twin.settings import Document

FILE = "figures.sqlite"


def open_chosen(named: str, document: Document | None, *, create: bool) -> Store:
    """Open the database named on the command line, else in the configuration, else the default.

    The default is a file beside the configuration, or in the current folder without one. A missing
    file is created only with ``create``; otherwise it is a SourceError.
    """
    if named:
        return open_store(named, create=create)
    return open_store(place_of(document), create=create)


def place_of(document: Document | None) -> URL:
    """URL of the database that a configuration names, else of the default."""
    folder = Path(document.name).parent if document else Path()
    settings = document.section(FigureSettings, "figures") if document else FigureSettings()
    return configured(settings, folder, FILE, FIGURE_DATABASE)
