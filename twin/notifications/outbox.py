"""What is to be told, until it is: a table beside the alarms, in order, under IDs that stay.

A row is a message to one destination. It is there before it is sent, and goes when the destination
has taken it; so each is delivered at least once, through restarts and lost networks.
"""

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    BigInteger,
    Column,
    ColumnElement,
    Connection,
    Index,
    Integer,
    MetaData,
    Row,
    Table,
    Text,
    func,
    inspect,
    or_,
    select,
)

from twin.alarms.database import ALARM_DATABASE
from twin.assets.engine import Database
from twin.assets.unit import Unit, of_unit
from twin.notifications.message import Message

metadata = MetaData()

OUTBOX = Table(
    "alarm_outbox",
    metadata,
    Column("number", Integer, primary_key=True),  # the order
    Column("destination", Text, nullable=False),
    Column("asset_type", Text, nullable=False),
    Column("asset_id", Text, nullable=False),
    Column("id", Text, nullable=False),
    Column("alarm", Text, nullable=False),
    Column("body", Text, nullable=False),  # JSON
    Column("made_ns", BigInteger, nullable=False),
    Column("refused", Text),  # why the destination will not have it; then it is not sent again
    sqlite_autoincrement=True,
)
ORDER = Index(
    "alarm_outbox_order",
    *(OUTBOX.c[one] for one in ("destination", "asset_type", "asset_id", "number")),
)


def open_outbox(
    where: str | Path | URL,
    unit: Unit,
    *,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Outbox":
    """Open the outbox of a unit in the alarm database at a URL or in an SQLite file.

    ConfigError for a URL of an unknown kind, SourceError if it cannot be reached or written.
    """
    outbox = Outbox(where, unit, busy_s, clock)
    with outbox.closed_on_error():
        outbox.prepare()
    return outbox


class Outbox(Database):
    """An open outbox. Several threads may use one each; what is written is written whole."""

    def __init__(
        self, where: str | Path | URL, unit: Unit, busy_s: float, clock: Callable[[], int]
    ) -> None:
        super().__init__(where, ALARM_DATABASE, busy_s, clock)
        self._unit = unit

    def prepare(self) -> None:
        """Make the table if it is not there, and its index."""
        with self._reading() as connection:
            there = inspect(connection)
            whole = there.has_table(OUTBOX.name) and there.has_index(OUTBOX.name, str(ORDER.name))
        if not whole:
            with self._writing() as connection:
                metadata.create_all(connection)
                ORDER.create(connection, checkfirst=True)

    def put(self, letters: Iterable[tuple[str, Message]]) -> None:
        """Take messages, each for the destination it is with."""
        own: dict[str, Any] = {"asset_type": self._unit.type, "asset_id": self._unit.id}
        own["made_ns"] = self._clock()
        rows = [
            {**own, "destination": to, "id": one.id, "alarm": one.alarm, "body": one.body}
            for to, one in letters
        ]
        with self._writing() as connection:
            connection.execute(OUTBOX.insert(), rows)

    def next(self, destination: str, most: int) -> list[Message]:
        """The oldest messages that wait, in their order."""
        with self._reading() as connection:
            return _messages(connection, self._waiting(destination), most)

    def count(self, destination: str) -> int:
        """How many wait."""
        wanted = select(func.count()).select_from(OUTBOX).where(*self._waiting(destination))
        with self._reading() as connection:
            return int(connection.execute(wanted).scalar_one())

    def delivered(self, destination: str, numbers: Collection[str]) -> None:
        """The destination has these, by their IDs."""
        with self._writing() as connection:
            connection.execute(OUTBOX.delete().where(*self._named(destination, numbers)))

    def refuse(self, destination: str, number: str, why: str) -> None:
        """Set one aside that the destination will not have."""
        with self._writing() as connection:
            named = OUTBOX.update().where(*self._named(destination, [number]))
            connection.execute(named.values(refused=why))

    def refused(self, destination: str) -> list[tuple[Message, str]]:
        """What was set aside, with why."""
        whose = (*self._own(destination), OUTBOX.c.refused.is_not(None))
        with self._reading() as connection:
            rows = connection.execute(select(OUTBOX).where(*whose).order_by(OUTBOX.c.number))
            return [(_message(row), str(row.refused)) for row in rows]

    def again(self) -> int:
        """Let everything that was refused wait once more, in its old order; gives how many."""
        mine = *self._whose(), OUTBOX.c.refused.is_not(None)
        with self._writing() as connection:
            return connection.execute(OUTBOX.update().where(*mine).values(refused=None)).rowcount

    def destinations(self) -> list[str]:
        """For whom there is anything."""
        wanted = select(OUTBOX.c.destination).where(*self._whose()).distinct()
        with self._reading() as connection:
            return sorted(connection.execute(wanted).scalars())

    def give_up(self, destination: str, most: int, since_ns: int) -> list[Message]:
        """Let go of what waits beyond the newest ``most`` or from before a time; gives it.

        What was refused goes after that time as well; it has been told.
        """
        waiting, number = self._waiting(destination), OUTBOX.c.number
        with self._reading() as connection:
            newest = select(number).where(*waiting).order_by(number.desc()).offset(most).limit(1)
            limit = connection.execute(newest).scalar()
            gone = OUTBOX.c.made_ns < since_ns
            if limit is not None:
                gone |= number <= limit
            lost = _messages(connection, (*waiting, gone))
            old = (*self._own(destination), OUTBOX.c.made_ns < since_ns)
            is_old = connection.execute(select(number).where(*old).limit(1)).first()
        if lost or is_old:
            with self._writing() as connection:
                for which in ((*waiting, gone), old):
                    connection.execute(OUTBOX.delete().where(*which))
        return lost

    def forget(self, destination: str, most: int, since_ns: int) -> int:
        """Let go of all beyond the newest ``most`` or from before a time.

        Gives how many of them waited.
        """
        own, number = self._own(destination), OUTBOX.c.number
        newest = select(number).where(*own).order_by(number.desc()).offset(most).limit(1)
        oldest = select(OUTBOX.c.made_ns).where(*own).order_by(number).limit(1)
        with self._reading() as connection:
            limit = connection.execute(newest).scalar()
            first_ns = connection.execute(oldest).scalar()
        if limit is None and (first_ns is None or first_ns >= since_ns):
            return 0
        gone = or_(OUTBOX.c.made_ns < since_ns, number <= (-1 if limit is None else limit))
        waited = select(func.count()).select_from(OUTBOX)
        waited = waited.where(*self._waiting(destination), gone)
        with self._writing() as connection:
            count = int(connection.execute(waited).scalar_one())
            connection.execute(OUTBOX.delete().where(*own, gone))
        return count

    def _own(self, destination: str) -> tuple[ColumnElement[bool], ...]:
        return OUTBOX.c.destination == destination, *self._whose()

    def _whose(self) -> tuple[ColumnElement[bool], ...]:
        return of_unit(OUTBOX, self._unit)

    def _waiting(self, destination: str) -> tuple[ColumnElement[bool], ...]:
        return *self._own(destination), OUTBOX.c.refused.is_(None)

    def _named(self, destination: str, numbers: Collection[str]) -> tuple[ColumnElement[bool], ...]:
        return *self._own(destination), OUTBOX.c.id.in_(numbers)


def _messages(
    connection: Connection, which: Sequence[ColumnElement[bool]], most: int | None = None
) -> list[Message]:
    wanted = select(OUTBOX).where(*which).order_by(OUTBOX.c.number).limit(most)
    return [_message(row) for row in connection.execute(wanted)]


def _message(row: Row[Any]) -> Message:
    return Message(row.id, row.alarm, row.body)
