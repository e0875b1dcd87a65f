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
    named: str,
    document: Document | None,
    *,
    write: bool,
    shipped: bool = True,
    to_store: bool = False,
) -> Assets:
    """Open the database named on the command line, else in the configuration, else the default.

    The default is a file beside the configuration, without one in the current folder. Only who
    writes makes a file, named or default. To read where the default is not there, the shipped
    data sets are enough; and where a named one is not there, if what is read for is ``to_store``
    something in it. SourceError otherwise. ``shipped`` as in ``open_assets``.
    """
    where = chosen(named, document)
    is_named = bool(named or (document and document.section(AssetsSettings, "assets").url))
    if not write and (to_store or not is_named) and is_new(named, document):
        return open_assets(MEMORY, shipped=shipped)
    return open_assets(where, create=write, shipped=shipped)


def is_new(named: str, document: Document | None) -> bool:
    """Whether that database is a file that is not there yet."""
    file = sqlite_file(parse_url(chosen(named, document), ASSETS))
    return file is not None and not file.exists()


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
