"""What docs/operation.md has people write does in a database what the page says of it."""

import re
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import rigs

from twin.assets.unit import Unit
from twin.figures.database import open_store
from twin.figures.retention import Retention
from twin.figures.settings import FigureSettings
from twin.instants import DAY_NS
from twin.settings import Document

UNIT = Unit("ejector-35", "rig-01")


def page() -> str:
    return (rigs.ROOT / "docs" / "operation.md").read_text(encoding="utf-8")


def test_the_configuration_of_the_page_keeps_two_years(url: str) -> None:
    (toml,) = re.findall(r"```toml\n(\[figures\].*?)```", page(), re.DOTALL)
    settings = Document.parse(toml, "cell.toml").section(FigureSettings, "figures")
    assert settings.keep
    assert settings.keep_days is not None
    now_ns = time.time_ns()
    received = [now_ns - days * DAY_NS for days in (1000, 732, 728, 0)]
    cycles: list[dict[str, Any]] = [
        {"cycle": number, "begin_ns": number, "host_ns": host_ns, "warnings": []}
        for number, host_ns in enumerate(received)
    ]
    with open_store(url) as store:
        store.add(UNIT, "hash", "live", cycles)
        Retention(settings.keep_days, lambda _: None).apply(store, UNIT)
        assert store.history(UNIT).host_ns.tolist() == received[2:]
        assert store.counters(UNIT).cycles == 4


def test_a_vacuum_leaves_all_cycles(tmp_path: Path) -> None:
    file = tmp_path / "figures.sqlite"
    cycle = {"cycle": 1, "begin_ns": 1, "host_ns": 1, "warnings": []}
    with open_store(file) as store:
        store.add(UNIT, "hash", "live", [cycle])
    (statement,) = re.findall(r'^sqlite3 figures.sqlite "(.*)"$', page(), re.MULTILINE)
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        connection.execute(statement)
    with open_store(file) as store:
        assert store.history(UNIT).host_ns.tolist() == [1]
