"""Opens SQLite and PostgreSQL databases from a URL, and turns their errors into messages.

SQLite keeps its rollback journal. The faster write-ahead log needs shared memory, which network
folders do not provide, and two more files that are easily forgotten when copying.
"""

import math
import random
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    MetaData,
    create_engine,
    event,
    inspect,
    make_url,
)
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import ArgumentError, DBAPIError, OperationalError
from sqlalchemy.pool import ConnectionPoolEntry, NullPool, StaticPool

from twin.assets.configured import DatabaseSettings
from twin.errors import ConfigError, SourceError
from twin.extras import require
from twin.secret import refuse_password


@dataclass(frozen=True)
class Purpose:
    """The name of a database in messages, and the option that chooses another one."""

    name: str
    option: str
    table: str  # of a configuration


ASSETS = Purpose("asset database", "--assets", "assets")
POSTGRES = {"postgresql", "postgres", "postgresql+psycopg"}
_WRITERS_LOCK = 0x656A6563  # any number that no other program uses as a lock in the same database

_TRY_AGAIN = "another program holds it; try again, or end the program that keeps it open"
_HINTS = {  # by SQLite's error name, or PostgreSQL's SQLSTATE
    "SQLITE_BUSY": _TRY_AGAIN,
    "SQLITE_CANTOPEN": "check that the folder exists and may be written to",
    "SQLITE_CORRUPT": "the file is damaged; import an export into a new one",
    "SQLITE_FULL": "make room on the disk",
    "SQLITE_NOTADB": "choose another file with {option}; this one is something else",
    "SQLITE_READONLY": "have the file and its folder made writable for you",
    "42501": "have this user granted the rights, or name another one in the URL",
    "55P03": _TRY_AGAIN,
}
_ELSE = {
    "sqlite": "choose another database with {option}",
    "postgresql": "check that the server runs and that host, user, password and name are right",
}


def parse_url(where: str | Path | URL, purpose: Purpose) -> URL:
    """The URL of a database: a URL, or the path of an SQLite file.

    ConfigError for other kinds, and for a text that contains a password.
    """
    if isinstance(where, URL):
        return where
    if isinstance(where, Path) or "://" not in where:
        return URL.create("sqlite", database=str(where))
    try:
        refuse_password(where, "take it out, and put it into PGPASSWORD or ~/.pgpass")
    except ValueError as error:
        raise ConfigError(f"the URL of the {purpose.name}: {error}") from error
    try:
        url = make_url(where)
    except (ArgumentError, ValueError) as error:  # ValueError: a port that is no number
        raise _unknown_kind(f"the URL of the {purpose.name} cannot be read") from error
    if url.drivername == "sqlite":
        return url
    if url.drivername in POSTGRES:
        return url.set(drivername="postgresql+psycopg")
    raise _unknown_kind(f"{purpose.name}s of kind {url.drivername!r} are not supported")


def configured(settings: DatabaseSettings, folder: Path, default: str, purpose: Purpose) -> URL:
    """The database that the configuration in ``folder`` names, else the file ``default`` there.

    ConfigError for a URL of an unknown kind, or a password that cannot be read.
    """
    url = parse_url(settings.url or default, purpose)
    if (file := sqlite_file(url)) is not None:
        return parse_url(folder / file, purpose)
    if settings.password is None:
        return url
    return url.set(password=settings.password.read(f"[{purpose.table}] password", folder))


class Database:
    """An open database. Every write is one transaction; close the database, or use ``with``.

    ``busy_s`` is how long to wait for other writers; ``clock`` returns UTC in ns. ConfigError for a
    URL of an unknown kind. With ``absent``, a hint, a missing SQLite file raises SourceError.
    """

    def __init__(
        self,
        where: str | Path | URL,
        purpose: Purpose,
        busy_s: float,
        clock: Callable[[], int],
        absent: str = "",
    ) -> None:
        self._url = parse_url(where, purpose)
        file = sqlite_file(self._url)
        if absent and file is not None and not file.exists():
            raise SourceError(f"{file}: no such {purpose.name}", absent)
        self._engine = make_engine(self._url, busy_s)
        self._purpose, self._clock = purpose, clock

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    @property
    def name(self) -> str:
        """The file or the URL, for messages; without a password."""
        return shown(self._url)

    @property
    def in_memory(self) -> bool:
        """Whether the database exists only while it is open."""
        return is_in_memory(self._url)

    @contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """Close the database if the block fails, for creating tables."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _make_missing(self, tables: MetaData) -> None:
        """Create missing tables; nothing is written if all exist."""
        with self._reading() as connection:
            existing = set(inspect(connection).get_table_names())
        if not existing >= set(tables.tables):
            with self._writing() as connection:
                tables.create_all(connection)

    @contextmanager
    def _reading(self) -> Iterator[Connection]:
        with plain_errors(self._url, self._purpose), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        writer = self._engine.execution_options(writing=True)
        with plain_errors(self._url, self._purpose), writer.begin() as connection:
            yield connection


def _unknown_kind(message: str) -> ConfigError:
    return ConfigError(message, "use sqlite:///FILE, or postgresql://USER@HOST/NAME")


def is_in_memory(url: URL) -> bool:
    """Whether the URL is an SQLite database without a file."""
    return url.get_backend_name() == "sqlite" and sqlite_file(url) is None


def sqlite_file(url: URL) -> Path | None:
    """The file of an SQLite database; None for one in memory or on a server."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    return Path(str(url.database))


def make_engine(url: URL, busy_s: float) -> Engine:
    """An engine whose writing transactions are serial; each waits ``busy_s`` for its turn."""
    options = {"busy_ms": max(1, round(busy_s * 1e3))}  # for PostgreSQL 0 means no limit
    if url.get_backend_name() == "sqlite":
        pool = NullPool if sqlite_file(url) else StaticPool  # in memory: one shared connection
        engine = create_engine(
            url, poolclass=pool, connect_args={"timeout": busy_s}, execution_options=options
        )
        event.listen(engine, "connect", _prepare_sqlite)
    else:
        require("postgres", shown(url))
        query = {"connect_timeout": str(max(2, math.ceil(busy_s)))}  # libpq's minimum is 2 s
        url = url.update_query_dict({**query, **url.query})
        engine = create_engine(url, pool_pre_ping=True, execution_options=options)
    event.listen(engine, "begin", _begin)
    return engine


def _prepare_sqlite(connection: DBAPIConnection, _entry: ConnectionPoolEntry) -> None:
    """Turn off automatic transactions, and make writes durable through a loss of power."""
    assert isinstance(connection, sqlite3.Connection)
    connection.isolation_level = None
    connection.execute("PRAGMA foreign_keys = ON")
    connection.execute("PRAGMA synchronous = EXTRA")


def _begin(connection: Connection) -> None:
    """Writers take the lock at the start, so that none waits for it after reading."""
    options = connection.get_execution_options()
    writing = options.get("writing", False)
    if connection.dialect.name == "sqlite":
        if writing:
            _take_turn(connection, options["busy_ms"])
        else:
            connection.exec_driver_sql("BEGIN")
        return
    connection.exec_driver_sql(f"SET LOCAL lock_timeout = {options['busy_ms']}")
    if writing:
        connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_WRITERS_LOCK})")


def _take_turn(connection: Connection, busy_ms: int) -> None:
    """Begin a write, polling often: SQLite polls every 100 ms, so a busy writer starves others."""
    end = time.monotonic() + busy_ms * 1e-3
    connection.exec_driver_sql("PRAGMA busy_timeout = 0")
    while True:
        try:
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        except OperationalError as error:
            if _code(error.orig) != "SQLITE_BUSY" or time.monotonic() > end:
                raise
            time.sleep(random.uniform(0.5e-3, 3e-3))
        else:
            break
    connection.exec_driver_sql(f"PRAGMA busy_timeout = {busy_ms}")


@contextmanager
def plain_errors(url: URL, purpose: Purpose) -> Iterator[None]:
    """Turn the database's errors into a SourceError with the place and a hint."""
    try:
        yield
    except DBAPIError as error:
        first = str(error.orig).strip().partition("\n")[0]
        code = _code(error.orig)
        hint = _HINTS.get(code, _ELSE[url.get_backend_name()])
        hint = hint.format(option=purpose.option)
        raise SourceError(f"{shown(url)}: {purpose.name}: {first}", hint) from error


def _code(error: BaseException | None) -> str:
    """SQLite's error name without its refinement, or PostgreSQL's SQLSTATE, or nothing."""
    if isinstance(error, sqlite3.Error):
        name = getattr(error, "sqlite_errorname", "")  # some errors are Python's own
        return "_".join(name.split("_")[:2])
    return getattr(error, "sqlstate", None) or ""


def shown(url: URL) -> str:
    """The database's name in messages: the file, or the URL without its password."""
    if url.get_backend_name() == "sqlite":
        return str(sqlite_file(url) or "the shipped data sets")
    return url.set(drivername=url.get_backend_name(), query={}).render_as_string()
