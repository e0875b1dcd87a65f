"""The database of key figures: one row for each cycle; rows never change.

A cycle's key is its asset, the PLC time of its suction edge and the time that the edge was
received: PLC time alone may begin anew after a restart. So a replay of a log adds no cycle twice.
With another data set it adds a row with that one's expectations; the newest row of a cycle counts.

Old cycles may be deleted. What the counters hold of them is carried, so no counter changes.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import (
    URL,
    BigInteger,
    Boolean,
    Column,
    ColumnElement,
    Connection,
    Double,
    Integer,
    MetaData,
    Row,
    Select,
    Table,
    Text,
    and_,
    func,
    inspect,
    select,
    text,
    union,
    union_all,
)

from twin.assets.engine import Database, Purpose
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.figures.key_figures import FIGURES

FIGURE_DATABASE = Purpose("figure database", "--figures", "figures")
LIVE = "live"  # source of cycles that come from a run, and not from its log
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

# What the counters hold of deleted cycles: of all, and of those since the counters were erased.
DELETED = Table(
    "figure_deleted",
    metadata,
    *unit_columns(in_key=True),
    Column("erasable", Boolean, primary_key=True),
    Column("until_ns", BigInteger, nullable=False),  # host_ns of the newest deleted cycle
    Column("cycles", BigInteger, nullable=False),
    Column("switchings", BigInteger, nullable=False),
    Column("alarms", BigInteger, nullable=False),
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
        self._make_missing(metadata)
        with self._reading() as connection:
            if not _missing(connection):
                return
        with self._writing() as connection:
            for column in _missing(connection):
                kind = column.type.compile(connection.dialect)
                connection.execute(
                    text(f"ALTER TABLE {CYCLE.name} ADD COLUMN {column.name} {kind}")
                )

    def add(
        self, unit: Unit, data_set: str, source: str, cycles: Sequence[Mapping[str, Any]]
    ) -> int:
        """Append cycles in the form of ``CycleFigures.plain``; returns how many were new.

        Cycles of a log that are as old as deleted ones are left out: they may be counted already.
        """
        if not cycles:
            return 0
        key_columns = {"asset_type": unit.type, "asset_id": unit.id, "data_set": data_set}
        key_columns |= {"source": source}
        with self._writing() as connection:
            stored = _stored_cycles(
                connection, key_columns, [int(cycle["host_ns"]) for cycle in cycles]
            )
            deleted = None if source == LIVE else _deleted_until(connection, unit)
            rows = {
                key: {**key_columns, **_row(cycle), "stored_ns": self._clock()}
                for cycle in cycles
                if (key := (int(cycle["host_ns"]), int(cycle["begin_ns"]))) not in stored
                and (deleted is None or key[0] > deleted)
            }
            if rows:
                connection.execute(CYCLE.insert(), list(rows.values()))
        return len(rows)

    def units(self) -> list[Unit]:
        """All units that have cycles, or had some that are deleted."""
        names = (select(table.c.asset_type, table.c.asset_id) for table in (CYCLE, DELETED))
        with self._reading() as connection:
            return sorted(Unit(*row) for row in connection.execute(union(*names)))

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
        with self._reading() as connection:
            return _counters(connection, unit, erasable=erasable)

    def delete(self, unit: Unit, before_ns: int, most: int) -> int:
        """Delete cycles of a unit received before ``before_ns`` (UTC); returns how many rows.

        The oldest go, about ``most`` rows: cycles received at one instant go together. The counters
        stay as they are.
        """
        old = (*of_unit(CYCLE, unit), CYCLE.c.host_ns < before_ns)
        oldest = select(CYCLE.c.host_ns).where(*old).order_by(CYCLE.c.host_ns).limit(most)
        newest = select(func.max(oldest.subquery().c.host_ns))
        with self._reading() as connection:
            until = connection.scalar(newest)
        if until is None:
            return 0
        outdated = CYCLE.c.host_ns <= until
        with self._writing() as connection:
            _carry(connection, unit, until, outdated)
            return connection.execute(
                CYCLE.delete().where(*of_unit(CYCLE, unit), outdated)
            ).rowcount

    def deleted_until(self, unit: Unit) -> int | None:
        """When the newest deleted cycle was received (UTC, ns); None if none was deleted."""
        with self._reading() as connection:
            return _deleted_until(connection, unit)

    def erase(self, unit: Unit) -> None:
        """Restart the erasable counters; the others and the cycles stay."""
        row = {"asset_type": unit.type, "asset_id": unit.id, "host_ns": self._clock()}
        with self._writing() as connection:
            connection.execute(ERASED.insert().values(row))
            connection.execute(DELETED.delete().where(*of_unit(DELETED, unit), DELETED.c.erasable))


def _missing(connection: Connection) -> list[Column[Any]]:
    """The columns that the table of cycles lacks."""
    existing = {column["name"] for column in inspect(connection).get_columns(CYCLE.name)}
    return [column for column in CYCLE.columns if column.name not in existing]


def _counters(
    connection: Connection, unit: Unit, *conditions: ColumnElement[bool], erasable: bool
) -> Counters:
    """Counters of the cycles that meet the conditions, and of all that are deleted.

    One statement reads both: between two, PostgreSQL would let a deletion in.
    """
    carried = select(DELETED.c.cycles, DELETED.c.switchings, DELETED.c.alarms).where(
        *of_unit(DELETED, unit), DELETED.c.erasable == erasable
    )
    both = union_all(_sums(unit, *conditions, erasable=erasable), carried)
    rows = connection.execute(both).all()
    return Counters(
        *(sum(int(value or 0) for value in column) for column in zip(*rows, strict=True))
    )


def _sums(unit: Unit, *conditions: ColumnElement[bool], erasable: bool) -> Select[int, Any, Any]:
    """Query for the counts of cycles; a cycle stored with several data sets counts once."""
    if erasable:
        newest = select(func.max(ERASED.c.host_ns)).where(*of_unit(ERASED, unit))
        conditions = *conditions, CYCLE.c.host_ns > func.coalesce(newest.scalar_subquery(), -1)
    per_cycle = (
        select(
            func.max(CYCLE.c.switchings_measured).label("switchings"),
            func.max(CYCLE.c.alarms).label("alarms"),
        )
        .where(*of_unit(CYCLE, unit), *conditions)
        .group_by(CYCLE.c.host_ns, CYCLE.c.begin_ns)
        .subquery()
    )
    sums = (func.count(), func.sum(per_cycle.c.switchings), func.sum(per_cycle.c.alarms))
    return select(*sums).select_from(per_cycle)


def _carry(connection: Connection, unit: Unit, until: int, outdated: ColumnElement[bool]) -> None:
    """Add what the counters hold of outdated cycles to what they hold of deleted ones."""
    key = {"asset_type": unit.type, "asset_id": unit.id}
    until = max(until, _deleted_until(connection, unit) or until)
    for erasable in (False, True):
        counters = _counters(connection, unit, outdated, erasable=erasable)
        row = {**key, "erasable": erasable, "until_ns": until, **asdict(counters)}
        previous = (*of_unit(DELETED, unit), DELETED.c.erasable == erasable)
        connection.execute(DELETED.delete().where(*previous))
        connection.execute(DELETED.insert().values(row))


def _deleted_until(connection: Connection, unit: Unit) -> int | None:
    """When the newest deleted cycle of a unit was received."""
    newest = select(func.max(DELETED.c.until_ns)).where(*of_unit(DELETED, unit))
    until = connection.scalar(newest)
    return None if until is None else int(until)


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
