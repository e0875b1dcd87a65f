"""The alarm database: present states, episodes, and people's requests, comments and limits."""

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sqlalchemy import (
    URL,
    BigInteger,
    Boolean,
    Column,
    Connection,
    Double,
    Integer,
    MetaData,
    Row,
    Table,
    Text,
    or_,
    select,
)

from twin.alarms.board import Comment, Episode
from twin.alarms.loop import Before, News
from twin.alarms.requests import LimitChange, Request
from twin.alarms.state import AlarmAction, Kept
from twin.assets.engine import Database, Purpose
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.errors import ConfigError
from twin.files import json_text

ALARM_DATABASE = Purpose("alarm database", "--alarms", "alarms")

metadata = MetaData()

STATE = Table(
    "alarm_state",
    metadata,
    *unit_columns(in_key=True),
    Column("alarm", Text, primary_key=True),
    Column("active", Boolean, nullable=False),
    Column("acknowledged", Boolean, nullable=False),
    Column("shelved_until_ns", BigInteger),
    Column("out_of_service", Boolean, nullable=False),
    Column("stored_ns", BigInteger, nullable=False),
)

EPISODE = Table(
    "alarm_episode",
    metadata,
    *unit_columns(in_key=True),
    Column("raised_ns", BigInteger, primary_key=True, autoincrement=False),
    Column("raised_as", Text, primary_key=True),  # its name then
    Column("alarm", Text, nullable=False),
    Column("cleared_ns", BigInteger),
    Column("acknowledged_ns", BigInteger),
    Column("acknowledged_by", Text, nullable=False),
    Column("evidence", Text, nullable=False),  # JSON
)

REQUEST = Table(
    "alarm_request",
    metadata,
    Column("id", Integer, primary_key=True),
    *unit_columns(in_key=False),
    Column("alarm", Text, nullable=False),
    Column("deed", Text, nullable=False),
    Column("who", Text, nullable=False),
    Column("seconds", Double, nullable=False),
    Column("asked_ns", BigInteger, nullable=False),
    Column("answered_ns", BigInteger),
    Column("answer", Text),  # empty: done; else why not
    sqlite_autoincrement=True,
)

COMMENT = Table(
    "alarm_comment",
    metadata,
    Column("id", Integer, primary_key=True),
    *unit_columns(in_key=False),
    Column("raised_ns", BigInteger, nullable=False),  # identifies the episode, with raised_as
    Column("raised_as", Text, nullable=False),
    Column("written_ns", BigInteger, nullable=False),
    Column("who", Text, nullable=False),
    Column("text", Text, nullable=False),
)

LIMIT = Table(  # changes of limits, by people
    "alarm_limit",
    metadata,
    Column("id", Integer, primary_key=True),
    *unit_columns(in_key=False),
    Column("limit_key", Text, nullable=False),
    Column("value", Double),  # none: back to the configured value
    Column("who", Text, nullable=False),
    Column("reason", Text, nullable=False),
    Column("asked_ns", BigInteger, nullable=False),
    Column("answered_ns", BigInteger),
    Column("refusal", Text, nullable=False),  # empty: applied, once answered
    Column("old", Double),  # values in force; none: no limit
    Column("new", Double),
    sqlite_autoincrement=True,
)

# All units of which a run has kept alarms. They can be queried even if no alarm was ever raised.
UNIT = Table("alarm_unit", metadata, *unit_columns(in_key=True))


def open_store(
    where: str | Path | URL,
    *,
    create: bool = True,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "Store":
    """Open the alarm database at a URL or in an SQLite file; close it, or use it as a context.

    ``create=False`` rejects a missing SQLite file. ConfigError for a URL of an unknown kind,
    SourceError if the database cannot be reached, read or written.
    """
    absent_hint = "" if create else "check --alarms; twin run makes one where [alarms] keep = true"
    store = Store(where, ALARM_DATABASE, busy_s, clock, absent_hint)
    with store.closed_on_error():
        store.prepare()
    return store


class Store(Database):
    """An open alarm database. Every write is one transaction."""

    def prepare(self) -> None:
        """Create missing tables."""
        self._make_missing(metadata)

    # --- a run ----------------------------------------------------------------------------------

    def before(self, unit: Unit) -> Before:
        """The alarms at the end of a unit's last run; it also registers the unit."""
        unit_key = {"asset_type": unit.type, "asset_id": unit.id}
        with self._writing() as connection:
            _replace(connection, UNIT, unit_key)
        return Before(self.states(unit), self.episodes(unit, only_going_on=True))

    def save(self, unit: Unit, news: News) -> None:
        """Write all changes."""
        unit_key = {"asset_type": unit.type, "asset_id": unit.id}
        with self._writing() as connection:
            _replace(connection, UNIT, unit_key)
            for name, state in news.states.items():
                stored = {"alarm": name, "stored_ns": self._clock()}
                _replace(connection, STATE, {**unit_key, **stored, **_plain_state(state)})
            for episode in news.episodes.values():
                _replace(connection, EPISODE, {**unit_key, **_plain_episode(episode)})
            for number, answer in news.answers.items():
                answered = {"answered_ns": self._clock(), "answer": answer}
                connection.execute(REQUEST.update().where(REQUEST.c.id == number).values(answered))

            for number, change in news.limits.items():
                names = ("answered_ns", "refusal", "old", "new")
                answered = {name: getattr(change, name) for name in names}
                connection.execute(LIMIT.update().where(LIMIT.c.id == number).values(answered))

    def requests(self, unit: Unit) -> list[Request]:
        """The unanswered requests to a unit's alarms, in order."""
        statement = select(REQUEST).where(*of_unit(REQUEST, unit), REQUEST.c.answered_ns.is_(None))
        with self._reading() as connection:
            return [_request(row) for row in connection.execute(statement.order_by(REQUEST.c.id))]

    # --- people ---------------------------------------------------------------------------------

    def ask(
        self, unit: Unit, alarm: str, action: AlarmAction, who: str, seconds: float = 0.0
    ) -> int:
        """Store a request to a unit's alarm; returns its number, by which to get the answer."""
        values: dict[str, Any] = {"asset_type": unit.type, "asset_id": unit.id, "alarm": alarm}
        values |= {"deed": action.value, "who": who, "asked_ns": self._clock(), "seconds": seconds}
        with self._writing() as connection:
            result = connection.execute(REQUEST.insert().values(values).returning(REQUEST.c.id))
            return int(result.scalar_one())

    def answer(self, number: int) -> str | None:
        """Why a request was refused, empty if it was done; None while it is unanswered."""
        statement = select(REQUEST.c.answered_ns, REQUEST.c.answer).where(REQUEST.c.id == number)
        with self._reading() as connection:
            answered_ns, answer = connection.execute(statement).one()
        return None if answered_ns is None else str(answer)

    def change_limit(
        self, unit: Unit, limit: str, value: float | None, who: str, reason: str
    ) -> int:
        """Store a person's change of a limit for a run to apply; returns its number."""
        values: dict[str, Any] = {"asset_type": unit.type, "asset_id": unit.id, "limit_key": limit}
        values |= {"value": value, "who": who, "reason": reason, "refusal": ""}
        values |= {"asked_ns": self._clock()}
        with self._writing() as connection:
            result = connection.execute(LIMIT.insert().values(values).returning(LIMIT.c.id))
            return int(result.scalar_one())

    def limit_changes(self, unit: Unit, after: int = 0) -> list[LimitChange]:
        """The changes of a unit's limits with a number above ``after``, in their order."""
        names = ("id", "limit_key", "value", "who", "reason", "asked_ns", "answered_ns", "refusal")
        columns = [LIMIT.c[name] for name in (*names, "old", "new")]
        statement = select(*columns).where(*of_unit(LIMIT, unit), LIMIT.c.id > after)
        with self._reading() as connection:
            rows = connection.execute(statement.order_by(LIMIT.c.id)).all()
        return [LimitChange(*row) for row in rows]

    def episodes_around(self, unit: Unit, since_ns: int) -> list[Episode]:
        """Episodes of a unit raised since ``since_ns``, after earlier ones that are not over."""
        earlier = [
            episode
            for episode in self.episodes(unit, only_going_on=True)
            if episode.raised_ns < since_ns
        ]
        return [*earlier, *self.episodes(unit, since_ns)]

    def episodes_within(self, unit: Unit, from_ns: int, to_ns: int) -> list[Episode]:
        """Episodes of a unit that were raised, cleared or acknowledged within a range of time."""
        times = (EPISODE.c.raised_ns, EPISODE.c.cleared_ns, EPISODE.c.acknowledged_ns)
        statement = select(EPISODE).where(
            *of_unit(EPISODE, unit), or_(*(column.between(from_ns, to_ns) for column in times))
        )
        with self._reading() as connection:
            return [_episode(row) for row in connection.execute(statement.order_by("raised_ns"))]

    def comment(self, unit: Unit, comment: Comment) -> None:
        """Store a comment; ConfigError if the unit has no such episode."""
        unit_key = {"asset_type": unit.type, "asset_id": unit.id}
        episode_key = {"raised_ns": comment.raised_ns, "raised_as": comment.raised_as}
        condition = [EPISODE.c[name] == value for name, value in (unit_key | episode_key).items()]
        values = unit_key | episode_key | {"written_ns": comment.written_ns}
        values |= {"who": comment.who, "text": comment.text}
        with self._writing() as connection:
            if connection.execute(select(EPISODE.c.alarm).where(*condition)).first() is None:
                raise ConfigError(f"no alarm {comment.raised_as} was raised then")
            connection.execute(COMMENT.insert().values(values))

    def comments(self, unit: Unit, since_ns: int = 0) -> list[Comment]:
        """Comments on a unit's episodes raised since ``since_ns``, in the order of writing."""
        statement = select(COMMENT).where(*of_unit(COMMENT, unit), COMMENT.c.raised_ns >= since_ns)
        with self._reading() as connection:
            rows = connection.execute(statement.order_by(COMMENT.c.id)).all()
        return [
            Comment(row.raised_ns, row.raised_as, row.written_ns, row.who, row.text) for row in rows
        ]

    def units(self) -> list[Unit]:
        """All units of which a run has stored alarms."""
        with self._reading() as connection:
            return sorted(Unit(*row) for row in connection.execute(select(UNIT)))

    def states(self, unit: Unit) -> dict[str, Kept]:
        """The states of a unit's alarms that have ever left the normal state."""
        with self._reading() as connection:
            rows = connection.execute(select(STATE).where(*of_unit(STATE, unit))).all()
        return {
            row.alarm: Kept(row.active, row.acknowledged, row.shelved_until_ns, row.out_of_service)
            for row in rows
        }

    def episodes(
        self, unit: Unit, since_ns: int | None = None, *, only_going_on: bool = False
    ) -> list[Episode]:
        """The episodes of a unit (raised since ``since_ns``), in the order they were raised."""
        statement = select(EPISODE).where(*of_unit(EPISODE, unit))
        if since_ns is not None:
            statement = statement.where(EPISODE.c.raised_ns >= since_ns)
        if only_going_on:
            cleared, seen = EPISODE.c.cleared_ns, EPISODE.c.acknowledged_ns
            statement = statement.where(cleared.is_(None) | seen.is_(None))
        with self._reading() as connection:
            return [_episode(row) for row in connection.execute(statement.order_by("raised_ns"))]


def _replace(connection: Connection, table: Table, row: Mapping[str, Any]) -> None:
    """Replace the row with the same key."""
    key = [column == row[column.name] for column in table.primary_key]
    connection.execute(table.delete().where(*key))
    connection.execute(table.insert().values(row))


def _plain_state(state: Kept) -> dict[str, Any]:
    return {
        "active": state.active,
        "acknowledged": state.acknowledged,
        "shelved_until_ns": state.shelved_until,
        "out_of_service": state.out_of_service,
    }


def _plain_episode(episode: Episode) -> dict[str, Any]:
    names = ("raised_ns", "raised_as", "alarm", "cleared_ns", "acknowledged_ns", "acknowledged_by")
    plain = {name: getattr(episode, name) for name in names}
    return {**plain, "evidence": json_text(episode.evidence)}


def _episode(row: Row[Any]) -> Episode:
    return Episode(
        row.alarm,
        row.raised_ns,
        row.cleared_ns,
        row.acknowledged_ns,
        row.acknowledged_by,
        json.loads(row.evidence),
        row.raised_as,
    )


def _request(row: Row[Any]) -> Request:
    return Request(row.id, row.alarm, AlarmAction(row.deed), row.who, row.asked_ns, row.seconds)
