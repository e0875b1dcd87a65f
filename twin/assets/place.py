"""Which database: the one that is named, else a file beside the configuration."""

from pathlib import Path

from twin.assets.database import Assets, open_assets
from twin.assets.engine import ASSETS, parse_url, sqlite_file
from twin.settings import Document, Settings

FILE = "assets.sqlite"
MEMORY = "sqlite://"


class AssetsSettings(Settings):
    """The table [assets] of a configuration."""

    url: str = ""  # or the path of an SQLite file, from the configuration's folder


def open_chosen(
    named: str, document: Document | None, *, write: bool, shipped: bool = True
) -> Assets:
    """Open the database named on the command line, else in the configuration, else the default.

    The default is a file beside the configuration, without one in the current folder. Only who
    writes makes a file: to read where the default is not there, the shipped ones are enough.
    ``shipped`` as in ``open_assets``.
    """
    where = chosen(named, document)
    if named or (document and document.section(AssetsSettings, "assets").url):
        return open_assets(where, create=write, shipped=shipped)
    return open_assets(where if write or Path(where).exists() else MEMORY, shipped=shipped)


def chosen(named: str, document: Document | None) -> str | Path:
    """The URL or file of that database."""
    if named:
        return named
    folder = Path(document.name).parent if document else Path()
    url = document.section(AssetsSettings, "assets").url if document else ""
    return _beside(folder, url) if url else folder / FILE


def _beside(folder: Path, url: str) -> str | Path:
    """What a configuration names, with a file taken from its own folder."""
    file = sqlite_file(parse_url(url, ASSETS))
    return url if file is None else folder / file
