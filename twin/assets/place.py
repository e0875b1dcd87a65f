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
    if named:
        return open_assets(named, create=write, shipped=shipped)
    folder = Path(document.name).parent if document else Path()
    url = document.section(AssetsSettings, "assets").url if document else ""
    if url:
        return open_assets(_beside(folder, url), create=write, shipped=shipped)
    default = folder / FILE
    return open_assets(default if write or default.exists() else MEMORY, shipped=shipped)


def _beside(folder: Path, url: str) -> str | Path:
    """What a configuration names, with a file taken from its own folder."""
    file = sqlite_file(parse_url(url, ASSETS))
    return url if file is None else folder / file
