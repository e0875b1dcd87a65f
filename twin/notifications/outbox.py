"""The outbox: a table in the alarm database with messages to deliver, in order, under fixed IDs.

A row is a message to one destination. It is stored before it is sent, and deleted when the
destination has taken it. So each message is delivered at least once, through restarts and lost
networks.
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
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.notifications.message import Message

metadata = MetaData()

OUTBOX = Table(
    "alarm_outbox",
    metadata,
    Column("number", Integer, primary_key=True),  # the order
    Column("destination", Text, nullable=False),
    *unit_columns(in_key=False),
    Column("id", Text, nullable=False),
    Column("alarm", Text, nullable=False),
    Column("body", Text, nullable=False),  # JSON
    Column("made_ns", BigInteger, nullable=False),
    Column("refused", Text),  # why the destination refused it; then it is not sent again
    sqlite_autoincrement=True,
)
ORDER = Index(
    "alarm_outbox_order",
    *(OUTBOX.c[name] for name in ("destination", "asset_type", "asset_id", "number")),
)


def open_outbox(
    where: str | Path | URL,
    unit: Unit,
    *,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Outbox":
    """Open the outbox of a unit in the alarm database at a URL or in an SQLite file.

    ConfigError for a URL of an unknown kind, SourceError if the database cannot be used.
    """
    outbox = Outbox(where, unit, busy_s, clock)
    with outbox.closed_on_error():
        outbox.prepare()
    return outbox


class Outbox(Database):
    """An open outbox. Each thread uses its own; every write is one transaction."""

    def __init__(
        self, where: str | Path | URL, unit: Unit, busy_s: float, clock: Callable[[], int]
    ) -> None:
        super().__init__(where, ALARM_DATABASE, busy_s, clock)
        self._unit = unit

    def prepare(self) -> None:
        """Create the table and its index if they are missing."""
        with self._reading() as connection:
            inspector = inspect(connection)
            is_complete = inspector.has_table(OUTBOX.name) and inspector.has_index(
                OUTBOX.name, str(ORDER.name)
            )
        if not is_complete:
            with self._writing() as connection:
                metadata.create_all(connection)
                ORDER.create(connection, checkfirst=True)

    def put(self, messages: Iterable[tuple[str, Message]]) -> None:
        """Store messages, each with its destination."""
        with self._writing() as connection:
            self._insert(connection, messages)

    def next(self, destination: str, most: int) -> list[Message]:
        """The oldest waiting messages, in order, at most ``most`` of them."""
        with self._reading() as connection:
            return _messages(connection, self._waiting(destination), most)

    def count(self, destination: str) -> int:
        """The number of waiting messages."""
        statement = select(func.count()).select_from(OUTBOX).where(*self._waiting(destination))
        with self._reading() as connection:
            return int(connection.execute(statement).scalar_one())

    def delivered(self, destination: str, numbers: Collection[str]) -> None:
        """Delete messages that the destination has taken, by their IDs."""
        with self._writing() as connection:
            self._delete(connection, destination, numbers)

    def refuse(self, destination: str, number: str, why: str) -> None:
        """Set a message aside that the destination refused."""
        with self._writing() as connection:
            named = OUTBOX.update().where(*self._named(destination, [number]))
            connection.execute(named.values(refused=why))

    def refused(self, destination: str) -> list[tuple[Message, str]]:
        """The refused messages, each with the reason."""
        condition = (*self._of_destination(destination), OUTBOX.c.refused.is_not(None))
        with self._reading() as connection:
            rows = connection.execute(select(OUTBOX).where(*condition).order_by(OUTBOX.c.number))
            return [(_message(row), str(row.refused)) for row in rows]

    def again(self) -> int:
        """Let all refused messages wait again, in their old order; returns how many."""
        condition = *self._of_unit(), OUTBOX.c.refused.is_not(None)
        with self._writing() as connection:
            return connection.execute(
                OUTBOX.update().where(*condition).values(refused=None)
            ).rowcount

    def destinations(self) -> list[str]:
        """The destinations of all stored messages."""
        statement = select(OUTBOX.c.destination).where(*self._of_unit()).distinct()
        with self._reading() as connection:
            return sorted(connection.execute(statement).scalars())

    def give_up(self, destination: str, most: int, since_ns: int) -> list[Message]:
        """Delete waiting messages beyond the newest ``most`` or from before a time; returns them.

        Refused messages from before that time are deleted too; they were reported already.
        """
        waiting, number = self._waiting(destination), OUTBOX.c.number
        with self._reading() as connection:
            newest = select(number).where(*waiting).order_by(number.desc()).offset(most).limit(1)
            limit = connection.execute(newest).scalar()
            outdated = OUTBOX.c.made_ns < since_ns
            if limit is not None:
                outdated |= number <= limit
            lost = _messages(connection, (*waiting, outdated))
            old = (*self._of_destination(destination), OUTBOX.c.made_ns < since_ns)
            is_old = connection.execute(select(number).where(*old).limit(1)).first()
        if lost or is_old:
            with self._writing() as connection:
                for condition in ((*waiting, outdated), old):
                    connection.execute(OUTBOX.delete().where(*condition))
        return lost

    def forget(self, destination: str, most: int, since_ns: int) -> int:
        """Delete all messages beyond the newest ``most`` or from before a time.

        Returns how many of them were waiting.
        """
        condition, number = self._of_destination(destination), OUTBOX.c.number
        newest = select(number).where(*condition).order_by(number.desc()).offset(most).limit(1)
        oldest = select(OUTBOX.c.made_ns).where(*condition).order_by(number).limit(1)
        with self._reading() as connection:
            limit = connection.execute(newest).scalar()
            first_ns = connection.execute(oldest).scalar()
        if limit is None and (first_ns is None or first_ns >= since_ns):
            return 0
        outdated = or_(OUTBOX.c.made_ns < since_ns, number <= (-1 if limit is None else limit))
        statement = select(func.count()).select_from(OUTBOX)
        statement = statement.where(*self._waiting(destination), outdated)
        with self._writing() as connection:
            count = int(connection.execute(statement).scalar_one())
            connection.execute(OUTBOX.delete().where(*condition, outdated))
        return count

    def _insert(self, connection: Connection, messages: Iterable[tuple[str, Message]]) -> None:
        common: dict[str, Any] = {"asset_type": self._unit.type, "asset_id": self._unit.id}
        common["made_ns"] = self._clock()
        rows = [
            {
                **common,
                "destination": destination,
                "id": message.id,
                "alarm": message.alarm,
                "body": message.body,
            }
            for destination, message in messages
        ]
        connection.execute(OUTBOX.insert(), rows)

    def _delete(self, connection: Connection, destination: str, numbers: Collection[str]) -> None:
        connection.execute(OUTBOX.delete().where(*self._named(destination, numbers)))

    def _of_destination(self, destination: str) -> tuple[ColumnElement[bool], ...]:
        return OUTBOX.c.destination == destination, *self._of_unit()

    def _of_unit(self) -> tuple[ColumnElement[bool], ...]:
        return of_unit(OUTBOX, self._unit)

    def _waiting(self, destination: str) -> tuple[ColumnElement[bool], ...]:
        return *self._of_destination(destination), OUTBOX.c.refused.is_(None)

    def _named(self, destination: str, numbers: Collection[str]) -> tuple[ColumnElement[bool], ...]:
        return *self._of_destination(destination), OUTBOX.c.id.in_(numbers)


def _messages(
    connection: Connection, condition: Sequence[ColumnElement[bool]], most: int | None = None
) -> list[Message]:
    statement = select(OUTBOX).where(*condition).order_by(OUTBOX.c.number).limit(most)
    return [_message(row) for row in connection.execute(statement)]


def _message(row: Row[Any]) -> Message:
    return Message(row.id, row.alarm, row.body)
