"""An asset's TOML file, which a person writes: one file for a type or a unit."""

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
    """The record in a file, and whether the file has a valid time (without: always valid).

    ConfigError with file, line and key.
    """
    asset = document.section(AssetFile)
    if asset.kind == "instance" and not asset.type:
        raise ConfigError(
            f"{document.name}:1: type: instance {asset.name!r} has no type",
            'say which type of ejector it is: type = "..."',
        )
    record = Record(
        asset.kind,
        asset.name,
        asset.type or asset.name,
        asset.data,
        asset.healthy,
        asset.diagram.arrays() if asset.diagram else {},
        {**provenance, "note": asset.note} if asset.note else provenance,
        valid_from_ns=0 if asset.valid_from is None else to_ns(asset.valid_from),
    )
    return record, asset.valid_from is not None


def write_asset(record: Record) -> str:
    """The file with this record's content; it contains no arrays other than the diagram."""
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
    return tomli_w.dumps(
        {key: _without_null(value) for key, value in tables.items() if value != {}}
    )


def _without_null(value: Any) -> Any:
    """A value without null entries, since TOML cannot express them."""
    if isinstance(value, Mapping):
        return {key: _without_null(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list):
        return [_without_null(inner) for inner in value if inner is not None]
    return value


def to_ns(moment: date) -> int:
    """UTC in ns since 1970; a date means its first moment, a time without a zone is UTC."""
    if not isinstance(moment, datetime):
        moment = datetime(moment.year, moment.month, moment.day)
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - _EPOCH
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def parse_time(text: str) -> int:
    """The time in ns of a command-line argument; ConfigError if it is no time."""
    try:
        return to_ns(datetime.fromisoformat(text))
    except ValueError as error:
        raise ConfigError(
            f"not a time: {text!r}", "write 2026-05-31 or 2026-05-31T14:00:00Z; UTC without a zone"
        ) from error


def show_time(ns: int) -> str:
    """A time in UTC to the second; 0 means always."""
    if ns == 0:
        return "always"
    return (_EPOCH + timedelta(seconds=ns // 10**9)).strftime("%Y-%m-%dT%H:%M:%SZ")
