"""An asset as a person writes it: one TOML file for a type or a unit."""

from collections.abc import Mapping
from datetime import UTC, date, datetime, timedelta
from typing import Annotated, Any

import tomli_w
from pydantic import Field, Strict

from twin.assets.diagram import Diagram, diagram_of
from twin.assets.record import Kind, Record
from twin.errors import ConfigError
from twin.settings import Document, Settings

Moment = Annotated[datetime, Strict()] | Annotated[date, Strict()]

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class AssetFile(Settings):
    """What may stand in it; [data] is checked by whoever uses it."""

    kind: Kind
    name: str
    type: str = ""  # a type is its own
    valid_from: Moment | None = None  # without a zone: UTC
    note: str = ""
    data: dict[str, Any] = Field(default_factory=dict)
    healthy: dict[str, Any] = Field(default_factory=dict)
    diagram: Diagram | None = None


def read_asset(document: Document, provenance: Mapping[str, Any]) -> tuple[Record, bool]:
    """The record in a file, and whether it says from when it is valid (if not: always).

    ConfigError with file, line and key.
    """
    given = document.section(AssetFile)
    if given.kind == "instance" and not given.type:
        raise ConfigError(
            f"{document.name}:1: type: instance {given.name!r} has no type",
            'say which type of ejector it is: type = "..."',
        )
    record = Record(
        given.kind,
        given.name,
        given.type or given.name,
        given.data,
        given.healthy,
        given.diagram.arrays() if given.diagram else {},
        {**provenance, "note": given.note} if given.note else provenance,
        valid_from_ns=0 if given.valid_from is None else to_ns(given.valid_from),
    )
    return record, given.valid_from is not None


def write_asset(record: Record) -> str:
    """The file that would give this content again; arrays other than the diagram are not in it."""
    diagram = diagram_of(record.arrays)
    tables = {
        "kind": record.kind,
        "name": record.name,
        "type": record.type,
        "valid_from": _EPOCH + timedelta(microseconds=record.valid_from_ns // 1000),
        "data": record.data,
        "healthy": record.healthy,
        "diagram": diagram.model_dump() if diagram else {},
    }
    if not record.valid_from_ns:
        del tables["valid_from"]
    return tomli_w.dumps({key: _set(value) for key, value in tables.items() if value != {}})


def _set(value: Any) -> Any:
    """Without what is null: TOML has no word for it, and leaves it out."""
    if isinstance(value, Mapping):
        return {key: _set(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list):
        return [_set(inner) for inner in value if inner is not None]
    return value


def to_ns(when: date) -> int:
    """UTC in ns since 1970; a day is its first moment, a time without a zone is UTC."""
    if not isinstance(when, datetime):
        when = datetime(when.year, when.month, when.day)
    since = (when if when.tzinfo else when.replace(tzinfo=UTC)) - _EPOCH
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def parse_time(text: str) -> int:
    """A time as people give it on the command line, in ns; ConfigError if it is none."""
    try:
        return to_ns(datetime.fromisoformat(text))
    except ValueError as error:
        raise ConfigError(
            f"not a time: {text!r}", "write 2026-05-31 or 2026-05-31T14:00:00Z; UTC without a zone"
        ) from error


def show_time(ns: int) -> str:
    """To the second, UTC; 0 is how records say always."""
    if ns == 0:
        return "always"
    return (_EPOCH + timedelta(seconds=ns // 10**9)).strftime("%Y-%m-%dT%H:%M:%SZ")
