"""Chooses the asset database: the named one, else a file beside the configuration."""

from pathlib import Path

from sqlalchemy import URL

from twin.assets.configured import DatabaseSettings
from twin.assets.database import Assets, open_assets
from twin.assets.engine import ASSETS, configured, parse_url, shown, sqlite_file
from twin.settings import Document

FILE = "assets.sqlite"
MEMORY = "sqlite://"


class AssetsSettings(DatabaseSettings):
    """The table [assets] of a configuration."""


def open_chosen(
    named: str | URL,
    document: Document | None,
    *,
    write: bool,
    shipped: bool = True,
    to_store: bool = False,
) -> Assets:
    """Open the database named on the command line, else in the configuration, else the default.

    The default is a file beside the configuration; without a configuration, in the current folder.
    Only ``write`` creates a file. A reader gets the shipped data sets in memory if the default file
    is missing, or if a named file is missing and the reader will store results there later
    (``to_store``). SourceError otherwise. ``shipped`` as in ``open_assets``.
    """
    where = chosen(named, document)
    is_named = bool(named or (document and document.section(AssetsSettings, "assets").url))
    if not write and (to_store or not is_named) and is_new(named, document):
        return open_assets(MEMORY, shipped=shipped)
    return open_assets(where, create=write, shipped=shipped)


def is_new(named: str | URL, document: Document | None) -> bool:
    """Whether that database is a file that does not exist yet."""
    file = sqlite_file(chosen(named, document))
    return file is not None and not file.exists()


def name_of(named: str | URL, document: Document | None) -> str:
    """The file or URL of that database, for messages; without a password."""
    return shown(chosen(named, document))


def chosen(named: str | URL, document: Document | None) -> URL:
    """The URL or file of that database."""
    if named:
        return parse_url(named, ASSETS)
    folder = Path(document.name).parent if document else Path()
    settings = document.section(AssetsSettings, "assets") if document else AssetsSettings()
    return configured(settings, folder, FILE, ASSETS)
