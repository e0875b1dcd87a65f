"""The types and units that come with the program, as TOML files in ``types/`` and ``units/``."""

from dataclasses import replace
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from uuid import NAMESPACE_URL, uuid5

from twin.assets.file import read_asset
from twin.assets.record import Record, checked
from twin.settings import Document

FOLDERS = ("types", "units")  # in this order: a unit is of a type


@cache
def shipped_records() -> tuple[Record, ...]:
    """All shipped records with ids, checked; types first, then by file name."""
    provenance = {"source": f"shipped with ejector-twin {version('ejector-twin')}"}
    records = (read_asset(document, provenance)[0] for document in _documents())
    return tuple(_named(checked(record)) for record in records)


def _documents() -> list[Document]:
    return [
        Document.parse(file.read_text(encoding="utf-8"), file.name)
        for folder in FOLDERS
        for file in sorted((files("twin.assets") / folder).iterdir(), key=lambda file: file.name)
        if file.name.endswith(".toml")
    ]


def _named(record: Record) -> Record:
    """The record with an id that is the same in every database, so that none gets it twice."""
    return replace(record, id=uuid5(NAMESPACE_URL, f"{record.name}/{record.hash}").hex)
