"""The asset database. Records are added and never changed; two times decide which one holds.

Valid time says from when a data set describes its asset; recorded time says when it was stored. So
a replay of last month's log can get the data set of that time, as known at that time (``as_of``).
"""

import json
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import URL, ColumnElement, Connection, Row, func, select

from twin.assets.engine import ASSETS, Database
from twin.assets.exchange import parse_export, to_export
from twin.assets.record import (
    Array,
    Found,
    Kind,
    Record,
    UnknownAssetError,
    checked,
    content_hash,
    holding,
    to_json,
)
from twin.assets.schema import ARRAY, RECORD, is_made, make
from twin.assets.shipped import shipped_records
from twin.errors import ConfigError, SourceError

Conditions = Sequence[ColumnElement[bool]]


def open_assets(
    where: str | Path | URL,
    *,
    create: bool = True,
    shipped: bool = True,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Assets":
    """Open the database at a URL or in an SQLite file; close it, or use it as a context.

    A new database gets its tables. Every database gets the shipped records that it never had;
    ``shipped=False`` leaves them to the next opening, for an import that brings its own.
    ``create=False`` rejects a missing SQLite file. ``busy_s`` is how long to wait for other
    writers; ``clock`` returns UTC in ns.

    ConfigError for a URL of an unknown kind, a newer schema and another program's file; SourceError
    if the database cannot be reached, read or written, or stays locked.
    """
    makers = "twin commission or calibrate, or twin assets add or import, makes one"
    absent_hint = "" if create else f"check --assets, or [assets] url; {makers}"
    assets = Assets(where, ASSETS, busy_s, clock, absent_hint)
    with assets.closed_on_error():
        assets.prepare(shipped=shipped)
    return assets


class Assets(Database):
    """An open asset database. Every write is one transaction."""

    def prepare(self, *, shipped: bool) -> None:
        """Create missing tables and add missing shipped records."""
        required = shipped_records() if shipped else ()
        with self._reading() as connection:
            if is_made(connection, self.name) and not _missing(connection, required):
                return
        with self._writing() as connection:
            if not is_made(connection, self.name):
                make(connection, self.name)
            for record in _missing(connection, required):
                self._append(connection, record)

    def add(self, record: Record) -> Record:
        """Append a record; returns it with its id, recorded time and hash.

        ConfigError for a unit of an unknown type, and for content that cannot be stored.
        """
        record = checked(record)
        with self._writing() as connection:
            if record.kind == "instance":
                _require_type(record, _names(connection, "type"))
            return self._append(connection, replace(record, id=uuid.uuid4().hex))

    def get(
        self,
        type: str,  # noqa: A002
        id: str = "",  # noqa: A002
        *,
        at_ns: int | None = None,
        as_of_ns: int | None = None,
    ) -> Found:
        """The data set that holds for a unit at a time (default: now), else that of its type.

        ``as_of_ns`` ignores records stored later. The record with the newest valid time holds;
        among equals the one recorded last. UnknownAssetError if there is none, ConfigError if the
        unit is of another type.
        """
        if not type:
            raise ConfigError(f"asset {id!r} has no type", "say [asset] type in the configuration")
        time_ns = self._clock() if at_ns is None else at_ns
        type_record = holding(self.records("type", type, as_of_ns=as_of_ns), time_ns)
        if id and (record := holding(self.records("instance", id, as_of_ns=as_of_ns), time_ns)):
            return Found(_of_type(record, type), type_record)
        if type_record:
            return Found(type_record)
        with self._reading() as connection:
            raise _unknown_asset(self.name, type, id, _names(connection, "type"))

    def records(
        self, kind: Kind | None = None, name: str | None = None, *, as_of_ns: int | None = None
    ) -> list[Record]:
        """All records (of a kind, of a name, recorded by a time), in the order of recording."""
        conditions: list[ColumnElement[bool]] = []
        if kind is not None:
            conditions.append(RECORD.c.kind == kind)
        if name is not None:
            conditions.append(RECORD.c.name == name)
        if as_of_ns is not None:
            conditions.append(RECORD.c.recorded_ns <= as_of_ns)
        with self._reading() as connection:
            return _read(connection, conditions)

    def export(self) -> dict[str, Any]:
        """All records as one JSON document that ``import_`` reads without loss."""
        return to_export(self.records())

    def import_(self, document: Mapping[str, Any]) -> int:
        """Append the new records of an export; returns their number.

        They keep their id and their recorded time. ConfigError if a record is damaged, differs from
        the stored record of the same id, or is a unit without a type; then nothing is appended.
        """
        imported = parse_export(document)
        with self._writing() as connection:
            new = _new_records(connection, imported)
            for record in new:
                _insert(connection, record)
        return len(new)

    def refuse(self, document: Mapping[str, Any]) -> None:
        """Raise the ConfigError that ``import_`` would raise; nothing is written."""
        imported = parse_export(document)
        with self._reading() as connection:
            _new_records(connection, imported)

    def _append(self, connection: Connection, record: Record) -> Record:
        """Insert a record with a later recorded time than all others, whatever the clock says."""
        last = connection.scalar(select(func.max(RECORD.c.recorded_ns)))
        now = self._clock() if last is None else max(self._clock(), last + 1)
        record = replace(record, recorded_ns=now)
        _insert(connection, record)
        return record


# --- rows and records ---------------------------------------------------------------------------


def _insert(connection: Connection, record: Record) -> None:
    values = {column.name: getattr(record, column.name) for column in RECORD.c}
    for table in ("data", "healthy", "provenance"):
        values[table] = to_json(values[table])
    connection.execute(RECORD.insert().values(values))
    arrays = [
        {
            "record": record.id,
            "name": name,
            "shape": json.dumps(array.shape),
            "bytes": array.astype("<f8").tobytes(),
        }
        for name, array in record.arrays.items()
    ]
    if arrays:
        connection.execute(ARRAY.insert(), arrays)


def _read(connection: Connection, conditions: Conditions) -> list[Record]:
    """Records with their arrays, in the order of recording."""
    statement = select(RECORD).where(*conditions).order_by(RECORD.c.recorded_ns, RECORD.c.id)
    rows = connection.execute(statement).all()
    arrays: defaultdict[str, dict[str, Array]] = defaultdict(dict)
    for row in connection.execute(select(ARRAY).join(RECORD).where(*conditions)):
        arrays[row.record][row.name] = _array(row)
    return [_record(row, arrays[row.id]) for row in rows]


def _new_records(connection: Connection, imported: Sequence[Record]) -> list[Record]:
    """The records that are not stored yet; ConfigError for one that cannot be added."""
    by_id = {record.id: record for record in _read(connection, ())}
    types = _names(connection, "type") | {
        imported_record.name for imported_record in imported if imported_record.kind == "type"
    }
    new: list[Record] = []
    for record in imported:
        if _is_stored(record, by_id):
            continue
        if record.kind == "instance":
            _require_type(record, types)
        by_id[record.id] = record
        new.append(record)
    return new


def _array(row: Row[Any]) -> Array:
    flat = np.frombuffer(row.bytes, dtype="<f8").astype(np.float64)
    return flat.reshape(json.loads(row.shape))


def _record(row: Row[Any], arrays: Mapping[str, Array]) -> Record:
    """The record of a row; SourceError if its content has changed since it was written."""
    values: dict[str, Any] = dict(row._mapping)
    for table in ("data", "healthy", "provenance"):
        values[table] = json.loads(values[table])
    record = Record(**values, arrays=dict(sorted(arrays.items())))
    if content_hash(record) != record.hash:
        raise SourceError(
            f"asset database: the record {record.id} of {record.name!r} is damaged",
            "import an export into a new database",
        )
    return record


def _names(connection: Connection, kind: Kind) -> set[str]:
    """The names of all types, or of all units."""
    return set(connection.scalars(select(RECORD.c.name).where(RECORD.c.kind == kind)))


def _missing(connection: Connection, records: Sequence[Record]) -> list[Record]:
    """The records never stored here: an older program must not put its own back on top."""
    ids = [record.id for record in records]
    stored = set(connection.scalars(select(RECORD.c.id).where(RECORD.c.id.in_(ids))))
    return [record for record in records if record.id not in stored]


# --- checks -------------------------------------------------------------------------------------


def _require_type(record: Record, types: Iterable[str]) -> None:
    if record.type not in types:
        raise ConfigError(
            f"{record.name!r} is of a type that is not in the database: {record.type!r}",
            f"add the type first; known types: {', '.join(sorted(types)) or 'none'}",
        )


def _of_type(record: Record, type_name: str) -> Record:
    if record.type != type_name:
        raise ConfigError(
            f"{record.name!r} is of type {record.type!r} in the database, not {type_name!r}",
            "change [asset] type, or add a data set of the unit with the right type",
        )
    return record


def _unknown_asset(
    database: str, type_name: str, unit: str, types: Iterable[str]
) -> UnknownAssetError:
    asset = f"{unit!r} or its type {type_name!r}" if unit else f"type {type_name!r}"
    type_list = ", ".join(sorted(types)) or "none"
    return UnknownAssetError(
        f"{database}: no data set of {asset} at that time",
        f"known types: {type_list}; twin assets add",
    )


def _is_stored(record: Record, by_id: Mapping[str, Record]) -> bool:
    """Whether this record is stored; ConfigError if its id belongs to another record.

    A shipped type has the same id everywhere, but its own recorded time in each database.
    """
    stored = by_id.get(record.id)
    if stored is not None and _identity(stored) != _identity(record):
        raise ConfigError(
            f"record {record.id} of {record.name!r} differs from the one in the database",
            "an exported record was changed; add it as a new one instead",
        )
    return stored is not None


def _identity(record: Record) -> tuple[str, str, str, int, str]:
    return record.kind, record.name, record.type, record.valid_from_ns, record.hash
