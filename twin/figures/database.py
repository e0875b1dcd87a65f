"""The database of key figures: one row for each cycle; rows are only added.

A cycle's key is its asset, the PLC time of its suction edge and the time that the edge was
received: PLC time alone may begin anew after a restart. So a replay of a log adds no cycle twice.
With another data set it adds a row with that one's expectations; the newest row of a cycle counts.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import (
    URL,
    BigInteger,
    Column,
    Connection,
    Double,
    Integer,
    MetaData,
    Row,
    Table,
    Text,
    and_,
    func,
    inspect,
    select,
    text,
)

from twin.assets.engine import Database, Purpose
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.figures.key_figures import FIGURES

FIGURE_DATABASE = Purpose("figure database", "--figures", "figures")
SIDES = ("measured", "expected")
_CYCLE_COLUMNS = ("host_ns", "begin_ns", "cycle", "alarms", "warnings")
VALUES = tuple(f"{name}_{side}" for name in FIGURES for side in SIDES)

metadata = MetaData()

CYCLE = Table(
    "figure_cycle",
    metadata,
    *unit_columns(in_key=True),
    Column("host_ns", BigInteger, primary_key=True, autoincrement=False),
    Column("begin_ns", BigInteger, primary_key=True, autoincrement=False),
    Column("data_set", Text, primary_key=True),  # content hash of the twin's data
    Column("cycle", BigInteger, nullable=False),  # its number in that stream
    Column("source", Text, nullable=False),  # a log, or "live"
    Column("stored_ns", BigInteger, nullable=False),
    Column("alarms", Integer, nullable=False),
    Column("warnings", Text, nullable=False),  # names with spaces between
    *(Column(value, Double) for value in VALUES),
    sqlite_with_rowid=False,
)

# The erasable twins of the counters count from the newest of these on.
ERASED = Table(
    "figure_erased",
    metadata,
    *unit_columns(in_key=True),
    Column("host_ns", BigInteger, primary_key=True, autoincrement=False),
)

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class History:
    """Cycles of one unit in order of time, as columns."""

    host_ns: npt.NDArray[np.int64]
    begin_ns: npt.NDArray[np.int64]
    cycle: npt.NDArray[np.int64]
    alarms: npt.NDArray[np.int64]
    warnings: tuple[str, ...]  # of each cycle, with spaces between
    values: Mapping[str, Floats]  # by VALUES; NaN if a cycle could not tell


@dataclass(frozen=True)
class Counters:
    """The field's counters, since the first cycle or since they were erased."""

    cycles: int
    switchings: int
    alarms: int


def open_store(
    location: str | Path | URL,
    *,
    create: bool = True,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Store":
    """Open the figure database at a URL or in an SQLite file; close it, or use it as a context.

    ``create=False`` refuses a missing SQLite file. ConfigError for a URL of an unknown kind,
    SourceError if it cannot be reached, read or written.
    """
    absent = "" if create else "check --figures; twin run makes one where [figures] keep = true"
    store = Store(location, FIGURE_DATABASE, busy_s, clock, absent)
    with store.closed_on_error():
        store.prepare()
    return store


class Store(Database):
    """An open figure database. Cycles are added all together or not at all."""

    def prepare(self) -> None:
        """Create missing tables, and columns of figures that an older program did not know."""
        with self._reading() as connection:
            if not _missing(connection):
                return
        with self._writing() as connection:
            metadata.create_all(connection)
            for column in _missing(connection):
                kind = column.type.compile(connection.dialect)
                connection.execute(
                    text(f"ALTER TABLE {CYCLE.name} ADD COLUMN {column.name} {kind}")
                )

    def add(
        self, unit: Unit, data_set: str, source: str, cycles: Sequence[Mapping[str, Any]]
    ) -> int:
        """Append cycles in the form of ``CycleFigures.plain``; returns how many were new."""
        if not cycles:
            return 0
        key_columns = {"asset_type": unit.type, "asset_id": unit.id, "data_set": data_set}
        key_columns |= {"source": source}
        with self._writing() as connection:
            stored = _stored_cycles(
                connection, key_columns, [int(cycle["host_ns"]) for cycle in cycles]
            )
            rows = {
                key: {**key_columns, **_row(cycle), "stored_ns": self._clock()}
                for cycle in cycles
                if (key := (int(cycle["host_ns"]), int(cycle["begin_ns"]))) not in stored
            }
            if rows:
                connection.execute(CYCLE.insert(), list(rows.values()))
        return len(rows)

    def units(self) -> list[Unit]:
        """All units that have cycles."""
        names = select(CYCLE.c.asset_type, CYCLE.c.asset_id).distinct()
        with self._reading() as connection:
            return sorted(Unit(*row) for row in connection.execute(names))

    def history(
        self, unit: Unit, since_ns: int | None = None, values: Sequence[str] = VALUES
    ) -> History:
        """The cycles of a unit, received from ``since_ns`` on; of each the row stored last."""
        conditions = [*of_unit(CYCLE, unit)]
        if since_ns is not None:
            conditions.append(CYCLE.c.host_ns >= since_ns)
        query = select(*(CYCLE.c[name] for name in (*_CYCLE_COLUMNS, *values))).where(*conditions)
        in_order = query.order_by(CYCLE.c.host_ns, CYCLE.c.begin_ns, CYCLE.c.stored_ns)
        with self._reading() as connection:
            return _history(connection.execute(in_order).all(), values)

    def counters(self, unit: Unit, *, erasable: bool = False) -> Counters:
        """Suction cycles, valve switchings and alarms; erasable counters count since erasure."""
        conditions = [*of_unit(CYCLE, unit)]
        newest = select(func.max(ERASED.c.host_ns)).where(*of_unit(ERASED, unit))
        with self._reading() as connection:
            since = connection.scalar(newest) if erasable else None
            if since is not None:
                conditions.append(CYCLE.c.host_ns > since)
            per_cycle = (  # a cycle stored with several data sets counts once
                select(
                    func.max(CYCLE.c.switchings_measured).label("switchings"),
                    func.max(CYCLE.c.alarms).label("alarms"),
                )
                .where(*conditions)
                .group_by(CYCLE.c.host_ns, CYCLE.c.begin_ns)
                .subquery()
            )
            sums = select(
                func.count(), func.sum(per_cycle.c.switchings), func.sum(per_cycle.c.alarms)
            ).select_from(per_cycle)
            return Counters(*(int(value or 0) for value in connection.execute(sums).one()))

    def erase(self, unit: Unit) -> None:
        """Restart the erasable counters; the others and the cycles stay."""
        row = {"asset_type": unit.type, "asset_id": unit.id, "host_ns": self._clock()}
        with self._writing() as connection:
            connection.execute(ERASED.insert().values(row))


def _missing(connection: Connection) -> list[Column[Any]]:
    """The columns that the database lacks; all if it has no tables."""
    inspector = inspect(connection)
    if not (inspector.has_table(CYCLE.name) and inspector.has_table(ERASED.name)):
        return list(CYCLE.columns)
    existing = {column["name"] for column in inspector.get_columns(CYCLE.name)}
    return [column for column in CYCLE.columns if column.name not in existing]


def _stored_cycles(
    connection: Connection, key_columns: Mapping[str, str], received: Sequence[int]
) -> set[tuple[int, int]]:
    """Keys of the cycles that are stored already, within the time of ``received``."""
    between = and_(CYCLE.c.host_ns >= min(received), CYCLE.c.host_ns <= max(received))
    same_unit = (
        CYCLE.c[name] == key_columns[name] for name in ("asset_type", "asset_id", "data_set")
    )
    query = select(CYCLE.c.host_ns, CYCLE.c.begin_ns).where(*same_unit, between)
    return {(row.host_ns, row.begin_ns) for row in connection.execute(query)}


def _row(cycle: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a cycle, without its unit and data set."""
    names = ("cycle", "begin_ns", "host_ns")
    values = {value: cycle.get(value) for value in VALUES}
    warned = " ".join(cycle["warnings"])
    columns = {name: int(cycle[name]) for name in names}
    return {**columns, **values, "alarms": int(cycle.get("alarms", 0)), "warnings": warned}


def _history(rows: Sequence[Row[Any]], values: Sequence[str]) -> History:
    """Columns from ordered rows; of several rows of a cycle the last."""
    columns = list(zip(*rows, strict=True)) or [()] * (len(_CYCLE_COLUMNS) + len(values))
    host_ns, begin_ns, cycle, alarms = (np.array(column, dtype=np.int64) for column in columns[:4])
    changes = (np.diff(host_ns) != 0) | (np.diff(begin_ns) != 0)
    last = np.append(changes, True)[: len(rows)]
    floats = columns[len(_CYCLE_COLUMNS) :]  # None becomes NaN
    return History(
        host_ns=host_ns[last],
        begin_ns=begin_ns[last],
        cycle=cycle[last],
        alarms=alarms[last],
        warnings=tuple(compress(columns[4], last)),
        values={
            name: np.array(column, dtype=np.float64)[last]
            for name, column in zip(values, floats, strict=True)
        },
    )
