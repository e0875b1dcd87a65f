"""The calls of a unit (``twin.notifications.escalation``), kept in the alarm database."""

import json
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Column, MetaData, Table, Text, select

from twin.alarms.database import EPISODE
from twin.alarms.database import metadata as alarm_metadata
from twin.assets.unit import Unit, of_unit, unit_columns
from twin.notifications.escalation import Call, Outcome
from twin.notifications.outbox import Outbox

metadata = MetaData()

CALL = Table(
    "alarm_call",
    metadata,
    *unit_columns(in_key=True),
    Column("alarm", Text, primary_key=True),
    Column("call", Text, nullable=False),  # JSON
)


def open_calls(
    where: str | Path | URL,
    unit: Unit,
    *,
    busy_s: float = 5.0,
    clock: Callable[[], int] = time.time_ns,
) -> "CallStore":
    """Open the calls of a unit in the alarm database at a URL or in an SQLite file.

    ConfigError for a URL of an unknown kind, SourceError if the database cannot be used.
    """
    store = CallStore(where, unit, busy_s, clock)
    with store.closed_on_error():
        store.prepare()
    return store


class CallStore(Outbox):
    """Calls beside the outbox, so that a call and its mails are stored in one transaction."""

    def prepare(self) -> None:
        """Create missing tables."""
        super().prepare()
        self._make_missing(metadata)
        self._make_missing(alarm_metadata)

    def calls(self) -> dict[str, Call]:
        """All calls, by alarm."""
        with self._reading() as connection:
            rows = connection.execute(select(CALL).where(*of_unit(CALL, self._unit))).all()
        return {row.alarm: Call.from_json(row.call) for row in rows}

    def evidence(self, episode: str) -> dict[str, Any] | None:
        """What is known of an episode by now, by its ID in messages; None if it is not stored."""
        raised_ns, _, raised_as = episode.partition(".")
        key = EPISODE.c.raised_ns == int(raised_ns), EPISODE.c.raised_as == raised_as
        statement = select(EPISODE.c.evidence).where(*of_unit(EPISODE, self._unit), *key)
        with self._reading() as connection:
            text = connection.execute(statement).scalar()
        return None if text is None else dict(json.loads(text))

    def store(self, outcome: Outcome, box: str, source: str, taken: Collection[str]) -> None:
        """Store calls, put mails into ``box``, and remove what they follow from.

        ``taken`` are IDs of messages to ``source``. All of it is one transaction: after a crash
        nobody is told twice, and nobody is forgotten.
        """
        unit_key = {"asset_type": self._unit.type, "asset_id": self._unit.id}
        with self._writing() as connection:
            for alarm, call in outcome.calls.items():
                key = (*of_unit(CALL, self._unit), CALL.c.alarm == alarm)
                connection.execute(CALL.delete().where(*key))
                if call is not None:
                    row = {**unit_key, "alarm": alarm, "call": call.to_json()}
                    connection.execute(CALL.insert().values(row))
            if outcome.mails:
                self._insert(connection, [(box, mail) for mail in outcome.mails])
            self._delete(connection, source, taken)
