"""The tables and their version. The database itself enforces that they are append-only."""

from importlib.metadata import version

from sqlalchemy import (
    DDL,
    BigInteger,
    Column,
    Connection,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    Table,
    Text,
    event,
    inspect,
    select,
)
from sqlalchemy.schema import ExecutableDDLElement

from twin.errors import ConfigError

VERSION = 1

metadata = MetaData()

# This table never changes: an older program recognises a newer schema by it.
SCHEMA = Table(
    "asset_schema",
    metadata,
    Column("version", Integer, nullable=False),
    Column("program", Text, nullable=False),  # the program version that made it
)

# Without a rowid, INSERT OR REPLACE has no second key by which it could remove a row.
RECORD = Table(
    "asset_record",
    metadata,
    Column("id", Text, primary_key=True),
    Column("kind", Text, nullable=False),
    Column("name", Text, nullable=False),
    Column("type", Text, nullable=False),
    Column("valid_from_ns", BigInteger, nullable=False),
    Column("recorded_ns", BigInteger, nullable=False, index=True),
    Column("hash", Text, nullable=False),
    Column("data", Text, nullable=False),  # JSON, as are the two below
    Column("healthy", Text, nullable=False),
    Column("provenance", Text, nullable=False),
    Index("asset_record_newest", "kind", "name", "valid_from_ns", "recorded_ns"),
    sqlite_with_rowid=False,
)

ARRAY = Table(
    "asset_array",
    metadata,
    Column("record", Text, ForeignKey("asset_record.id"), primary_key=True),
    Column("name", Text, primary_key=True),
    Column("shape", Text, nullable=False),  # JSON
    Column("bytes", LargeBinary, nullable=False),  # float64, little-endian, last axis fastest
    sqlite_with_rowid=False,
)

_POSTGRES_FUNCTION = """
CREATE OR REPLACE FUNCTION asset_append_only() RETURNS trigger LANGUAGE plpgsql AS
$$ BEGIN RAISE EXCEPTION 'the asset database is append-only'; END $$
"""
_POSTGRES_TRIGGERS = """
CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON {table}
FOR EACH STATEMENT EXECUTE FUNCTION asset_append_only()
"""
_SQLITE_TRIGGER = """
CREATE TRIGGER {table}_no_{deed} BEFORE {deed} ON {table} {when}
BEGIN SELECT RAISE(ABORT, 'the asset database is append-only'); END
"""
# INSERT OR REPLACE deletes rows without firing the trigger on DELETE.
_KEY_EXISTS = {
    RECORD: "WHEN EXISTS (SELECT 1 FROM asset_record WHERE id = NEW.id)",
    ARRAY: "WHEN EXISTS (SELECT 1 FROM asset_array WHERE record = NEW.record AND name = NEW.name)",
}


def _for_dialect(dialect: str, statement: str) -> ExecutableDDLElement:
    ddl: ExecutableDDLElement = DDL(statement).execute_if(dialect=dialect)  # type: ignore[no-untyped-call]
    return ddl


def _guard(table: Table) -> None:
    """Make the database reject every change of ``table`` except new rows."""
    for operation, condition in (("update", ""), ("delete", ""), ("insert", _KEY_EXISTS[table])):
        trigger = _SQLITE_TRIGGER.format(table=table.name, deed=operation, when=condition)
        event.listen(table, "after_create", _for_dialect("sqlite", trigger))
    for statement in (_POSTGRES_FUNCTION, _POSTGRES_TRIGGERS.format(table=table.name)):
        event.listen(table, "after_create", _for_dialect("postgresql", statement))


_guard(RECORD)
_guard(ARRAY)


def is_made(connection: Connection, where: str) -> bool:
    """Whether the tables exist; ConfigError if a newer program made them."""
    if not inspect(connection).has_table(SCHEMA.name):
        return False
    newest = select(SCHEMA).order_by(SCHEMA.c.version.desc()).limit(1)
    schema_version, program = connection.execute(newest).one()
    if schema_version > VERSION:
        raise ConfigError(
            f"{where}: an asset database of ejector-twin {program} (schema {schema_version}); "
            f"this is ejector-twin {version('ejector-twin')} (schema {VERSION})",
            f"update ejector-twin to {program} or newer, or choose another database with --assets",
        )
    return True


def make(connection: Connection, where: str) -> None:
    """Create the tables in an empty database; ConfigError if the file is another program's."""
    if connection.dialect.name == "sqlite" and inspect(connection).get_table_names():
        raise ConfigError(
            f"{where}: a database of another program", "choose another file with --assets"
        )
    metadata.create_all(connection)
    values = {"version": VERSION, "program": version("ejector-twin")}
    connection.execute(SCHEMA.insert().values(values))
