"""The types that come with the program, as TOML files in ``types/``."""

from dataclasses import replace
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from uuid import NAMESPACE_URL, uuid5

from twin.assets.file import read_asset
from twin.assets.record import Record, checked
from twin.settings import Document


@cache
def shipped_types() -> tuple[Record, ...]:
    """All of them, checked, in the order of their file names, with their ids."""
    folder = files("twin.assets") / "types"
    provenance = {"source": f"shipped with ejector-twin {version('ejector-twin')}"}
    documents = [
        Document.parse(file.read_text(encoding="utf-8"), file.name)
        for file in sorted(folder.iterdir(), key=lambda file: file.name)
        if file.name.endswith(".toml")
    ]
    return tuple(_named(checked(read_asset(document, provenance)[0])) for document in documents)


def _named(record: Record) -> Record:
    """With an id that is the same in every database, so that none gets it twice."""
    return replace(record, id=uuid5(NAMESPACE_URL, f"{record.name}/{record.hash}").hex)
