"""Chooses the alarm database: the named one, else a file beside the configuration."""

from pathlib import Path

from sqlalchemy import URL

from twin.alarms.database import ALARM_DATABASE, Store, open_store
from twin.alarms.settings import AlarmSettings
from twin.assets.engine import configured
from twin.settings import Document

FILE = "alarms.sqlite"


def open_chosen(named: str, document: Document | None, *, create: bool) -> Store:
    """Open the database named on the command line, else in the configuration, else the default.

    The default is a file beside the configuration; without a configuration, in the current folder.
    Only a run creates the file; SourceError if there is none to read.
    """
    return open_store(named or place_of(document), create=create)


def place_of(document: Document | None) -> URL:
    """The database that a configuration names, else the default."""
    folder = Path(document.name).parent if document else Path()
    settings = document.section(AlarmSettings, "alarms") if document else AlarmSettings()
    return configured(settings, folder, FILE, ALARM_DATABASE)
