"""Stores answers about logs in the asset database, each once.

The key of an answer is the work, the content of the log, the program's sources and the
configuration. So a repeated run does only the missing work.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    BigInteger,
    Boolean,
    Column,
    ColumnElement,
    MetaData,
    Row,
    Table,
    Text,
    select,
)

from twin.assets.engine import ASSETS, Database
from twin.assets.unit import unit_columns
from twin.config import Config
from twin.fleet.tasks import code
from twin.log.reader import Log

PIECE = 1 << 20

metadata = MetaData()

RESULT = Table(
    "fleet_result",
    metadata,
    Column("work", Text, primary_key=True),
    Column("log_sha256", Text, primary_key=True),
    Column("code", Text, primary_key=True),
    Column("basis", Text, primary_key=True),
    *unit_columns(in_key=False),
    Column("batch", Text, nullable=False),
    Column("log", Text, nullable=False),  # its path then
    Column("begin_ns", BigInteger, nullable=False),  # when it was recorded, UTC
    Column("stored_ns", BigInteger, nullable=False),
    Column("answer", Text, nullable=False),  # JSON
    sqlite_with_rowid=False,
)

LOG = Table(
    "fleet_log",
    metadata,
    Column("log_sha256", Text, primary_key=True),
    Column("complete", Boolean, nullable=False),  # its writer came to the end
    sqlite_with_rowid=False,
)


@dataclass(frozen=True)
class Key:
    """The key of an answer."""

    work: str
    log_sha256: str
    code: str
    basis: str


@dataclass(frozen=True)
class Result:
    """One answer about one log."""

    key: Key
    type: str
    id: str
    batch: str
    log: str
    begin_ns: int
    stored_ns: int
    answer: Mapping[str, Any]
    complete: bool = True  # the log; otherwise it was cut off, and the answer is about the rest


def key_of(work: str, log: Log, config: Config) -> Key:
    """The key for a log with all its parts and a configuration."""
    content = hashlib.sha256()
    for part in log.parts:
        with part.open("rb") as file:
            while piece := file.read(PIECE):
                content.update(piece)
    inputs = [config.document.text, config.data.hash, config.monitor.model_dump_json()]
    inputs += [config.asset.type, config.asset.id, config.asset.batch]
    basis = hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:16]
    return Key(work, content.hexdigest(), code(), basis)


def open_store(
    where: str | Path | URL, busy_s: float = 30.0, clock: Callable[[], int] = time.time_ns
) -> "Store":
    """Open the answers in an existing asset database."""
    store = Store(where, ASSETS, busy_s, clock)
    with store.closed_on_error():
        store.prepare()
    return store


class Store(Database):
    """An open database of answers. Every write is one transaction."""

    def prepare(self) -> None:
        """Create missing tables."""
        self._make_missing(metadata)

    def known(self, keys: Iterable[Key]) -> set[Key]:
        """Those of the keys that have an answer."""
        with self._reading() as connection:
            rows = connection.execute(select(*RESULT.primary_key.columns)).all()
        return {Key(*row) for row in rows} & set(keys)

    def answer(self, key: Key) -> Any:
        """The answer of a stored key."""
        with self._reading() as connection:
            return json.loads(
                connection.scalars(select(RESULT.c.answer).where(*_matches(key))).one()
            )

    def add(self, key: Key, config: Config, log: Path, begin_ns: int, answer: object) -> None:
        """Store an answer; one that another run has added meanwhile stays."""
        asset = config.asset
        values = {
            **vars(key),
            "asset_type": asset.type,
            "asset_id": asset.id or log.stem,
            "batch": asset.batch,
            "log": str(log),
            "begin_ns": begin_ns,
            "stored_ns": self._clock(),
            "answer": json.dumps(answer),
        }
        with self._writing() as connection:
            if connection.execute(select(RESULT.c.work).where(*_matches(key))).first() is None:
                connection.execute(RESULT.insert().values(values))

    def note(self, complete: Mapping[str, bool]) -> None:
        """Store which logs, by their SHA-256, are complete."""
        with self._writing() as connection:
            stored = set(connection.scalars(select(LOG.c.log_sha256)))
            for digest, is_complete in complete.items():
                if digest not in stored:
                    connection.execute(LOG.insert().values(log_sha256=digest, complete=is_complete))

    def newest(self) -> list[Result]:
        """The last added answer for every work and log, in the order of recording."""
        with self._reading() as connection:
            rows = connection.execute(select(RESULT).order_by(RESULT.c.stored_ns)).all()
            incomplete = set(connection.scalars(select(LOG.c.log_sha256).where(~LOG.c.complete)))
        newest_rows = {
            (row.work, row.log_sha256, row.asset_type, row.asset_id): row for row in rows
        }
        results = (_result(row, row.log_sha256 not in incomplete) for row in newest_rows.values())
        return sorted(results, key=lambda result: result.begin_ns)


def _matches(key: Key) -> list[ColumnElement[bool]]:
    return [column == getattr(key, column.name) for column in RESULT.primary_key.columns]


def _result(row: Row[Any], complete: bool) -> Result:
    return Result(
        Key(row.work, row.log_sha256, row.code, row.basis),
        row.asset_type,
        row.asset_id,
        row.batch,
        row.log,
        row.begin_ns,
        row.stored_ns,
        json.loads(row.answer),
        complete,
    )
