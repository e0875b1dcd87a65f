"""The statements of docs/operation.md do in a database what the page says of them."""

import re
import sqlite3
import time
from contextlib import closing
from typing import Any

import psycopg
import rigs

from twin.assets.unit import Unit
from twin.figures.database import open_store

UNIT = Unit("ejector-35", "rig-01")
DAY_NS = 86_400 * 10**9


def test_cycles_older_than_two_years_are_deleted(url: str) -> None:
    now_ns = time.time_ns()
    received = [now_ns - days * DAY_NS for days in (1000, 732, 728, 0)]
    cycles: list[dict[str, Any]] = [
        {"cycle": number, "begin_ns": number, "host_ns": host_ns, "warnings": []}
        for number, host_ns in enumerate(received)
    ]
    with open_store(url) as store:
        store.add(UNIT, "hash", "live", cycles)
    of_sqlite = url.startswith("sqlite")
    program = "sqlite3 figures.sqlite" if of_sqlite else "psql NAME -c"
    page = (rigs.ROOT / "docs" / "operation.md").read_text(encoding="utf-8")
    statements = re.findall(rf'^{program} "(.*)"$', page, re.MULTILINE)
    assert len(statements) == (2 if of_sqlite else 1)
    connection: Any = (
        sqlite3.connect(url.removeprefix("sqlite:///"), isolation_level=None)
        if of_sqlite
        else psycopg.connect(url, autocommit=True)
    )
    with closing(connection):
        for statement in statements:
            connection.execute(statement)
    with open_store(url) as store:
        assert store.history(UNIT).host_ns.tolist() == received[2:]
