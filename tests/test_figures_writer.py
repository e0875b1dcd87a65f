"""Key figures on their way from the loop into the database."""

import queue
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rigs

from twin.assets.unit import Unit
from twin.cli.figures import figure_writer_of, key_figures_of
from twin.config import Config
from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind
from twin.figures import writer as module
from twin.figures.cycle import KeyFigures
from twin.figures.database import Store, open_store
from twin.figures.read import of_log
from twin.figures.retention import LOOK_S, PORTION, Retention
from twin.figures.writer import Alarms, FigureWriter
from twin.live import run
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.monitor.monitor import Monitor
from twin.settings import Document
from twin.signals import SAMPLE, TICK

UNIT = Unit("compact-ejector-35", "gripper-01")
NONE = np.empty(0, SAMPLE), np.empty(0, TICK)


def cycle(number: int) -> Event:
    begin = 3_000_000_000 * number
    data = {"cycle": number, "begin_ns": begin, "end_ns": begin + 10, "host_ns": begin}
    return Event(begin + 10, Kind.CYCLE, "", {**data, "warnings": [], "t0_measured": 1.0})


def alarm(time_ns: int) -> Event:
    return Event(time_ns, Kind.DEVIATION, "")


def keep(open_it: Callable[[], Store], *batches: list[Event]) -> list[str]:
    """Hand events to a keeper and close it; gives what it said."""
    said: list[str] = []
    figure_writer = FigureWriter(open_it, UNIT, "a", said.append)
    for events in batches:
        figure_writer.write(*NONE, events)
    figure_writer.close()
    return said


def test_cycles_and_their_alarms_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "f.sqlite"
    first, second = cycle(1), cycle(2)
    batches = [[first, alarm(first.time_ns)], [], [alarm(first.time_ns + 5)], [second], [alarm(1)]]
    assert keep(lambda: open_store(path), *batches) == []
    with open_store(path) as store:
        found = store.history(UNIT)
    assert found.cycle.tolist() == [1, 2]
    assert found.alarms.tolist() == [1, 1]


def test_a_cycle_that_carries_no_key_figures_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "f.sqlite"
    keep(lambda: open_store(path), [Event(5, Kind.CYCLE, "", {"cycle": 1})])
    assert not path.exists()


def test_alarms_belong_to_the_cycle_they_were_raised_in() -> None:
    alarms = Alarms()
    alarms.see([alarm(5), alarm(12), cycle(0), alarm(10)])
    assert (alarms.until(10), alarms.until(11), alarms.until(12)) == (2, 0, 1)


def test_a_database_that_is_away_is_said_once_and_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BATCH_S", 0.01)
    monkeypatch.setattr(module, "RETRY_S", 0.01)
    tries, there = threading.Semaphore(0), threading.Event()
    said: list[str] = []

    def flaky() -> Store:
        tries.release()
        if not there.is_set():
            raise SourceError("server: figure database: connection refused")
        return open_store(tmp_path / "f.sqlite")

    figure_writer = FigureWriter(flaky, UNIT, "a", said.append)
    figure_writer.write(*NONE, [cycle(1)])
    for _ in range(3):
        assert tries.acquire(timeout=10)
    figure_writer.write(*NONE, [cycle(2)])
    there.set()
    end = time.monotonic() + 10
    while len(said) < 2 and time.monotonic() < end:
        time.sleep(0.005)
    figure_writer.close()
    assert said[0] == "key figures wait in memory: server: figure database: connection refused"
    assert said[1].startswith("key figures are stored again: ")
    assert len(said) == 2
    with open_store(tmp_path / "f.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [1, 2]


def test_a_defect_does_not_end_what_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "BATCH_S", 0.001)
    monkeypatch.setattr(module, "RETRY_S", 0.001)
    failures, again = iter([MemoryError(), ValueError("a defect")]), threading.Event()

    def flaky() -> Store:
        for error in failures:
            raise error
        again.set()
        return open_store(tmp_path / "f.sqlite")

    said: list[str] = []
    figure_writer = FigureWriter(flaky, UNIT, "a", said.append)
    figure_writer.write(*NONE, [cycle(1)])
    assert again.wait(20.0)
    figure_writer.close()
    assert said == [
        "key figures wait in memory: MemoryError: ",
        "key figures are stored again: 1 cycles had waited",
    ]
    with open_store(tmp_path / "f.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [1]


def test_what_is_stored_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BATCH_S", 0.01)
    batches: queue.Queue[list[int]] = queue.Queue()

    class Counting:
        def add(self, _unit: Unit, _data: str, _source: str, cycles: list[dict[str, int]]) -> None:
            batches.put([row["cycle"] for row in cycles])

        def close(self) -> None: ...

    figure_writer = FigureWriter(Counting, UNIT, "a", print)  # type: ignore[arg-type]
    for number in (1, 2):
        figure_writer.write(*NONE, [cycle(number)])
        assert batches.get(timeout=10) == [number]
    figure_writer.close()
    assert batches.empty()


def test_what_cannot_be_stored_to_the_end_is_said() -> None:
    def away() -> Store:
        raise SourceError("gone")

    said = keep(away, [cycle(1), cycle(2)])
    assert said[0] == "key figures wait in memory: gone"
    assert said[1].startswith("key figures of 2 cycles could not be stored; from a log: twin fig")


def test_the_memory_for_what_waits_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_WAITING", 3)

    def away() -> Store:
        raise SourceError("gone")

    said = keep(away, [cycle(number) for number in range(9)])
    assert said[1].startswith("key figures of 3 cycles")


def configured(folder: Path, table: str) -> Config:
    """The gripper with a table [figures]."""
    path = folder / "cell.toml"
    path.write_text(table)
    return replace(rigs.config("gripper"), document=Document.read(path))


def test_a_configuration_says_whether_and_where_figures_are_kept(tmp_path: Path) -> None:
    said: list[str] = []
    assert figure_writer_of(configured(tmp_path, ""), said.append) is None
    opened = figure_writer_of(configured(tmp_path, "[figures]\nkeep = true\n"), said.append)
    assert opened is not None
    figure_writer = opened()
    figure_writer.write(*NONE, [cycle(1)])
    figure_writer.close()
    assert said == []
    with open_store(tmp_path / "figures.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [1]


DAY = 86_400 * 10**9


def old_and_new(path: Path) -> None:
    """A database with a cycle of 40 days ago and one of 20 days ago."""
    with open_store(path) as store:
        ages = [{**cycle(n).data, "host_ns": time.time_ns() - n * DAY} for n in (40, 20)]
        store.add(UNIT, "a", "live", ages)


def run_once(folder: Path, table: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Store cycles as configured, until the keeper has looked for old ones; what it said."""
    said: list[str] = []
    opened = figure_writer_of(configured(folder, table), said.append)
    assert opened is not None
    monkeypatch.setattr(module, "BATCH_S", 0.01)
    figure_writer = opened()
    with open_store(folder / "figures.sqlite") as store:
        for number in range(2):  # the second is stored after the first deletion
            data = {**cycle(number).data, "host_ns": time.time_ns()}
            figure_writer.write(*NONE, [Event(0, Kind.CYCLE, "", data)])
            end = time.monotonic() + 20
            while store.counters(UNIT).cycles < 3 + number and time.monotonic() < end:
                time.sleep(0.005)
    figure_writer.close()
    return said


def test_old_cycles_are_deleted_if_the_configuration_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old_and_new(tmp_path / "figures.sqlite")
    said = run_once(tmp_path, "[figures]\nkeep = true\nkeep_days = 30\n", monkeypatch)
    assert said == [
        "key figures of cycles older than 30 days are deleted ([figures] keep_days);"
        " the counters keep them"
    ]
    with open_store(tmp_path / "figures.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [20, 0, 1]
        assert store.counters(UNIT).cycles == 4


def test_all_cycles_are_kept_if_nothing_is_configured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old_and_new(tmp_path / "figures.sqlite")
    assert run_once(tmp_path, "[figures]\nkeep = true\n", monkeypatch) == []
    with open_store(tmp_path / "figures.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [40, 20, 0, 1]


def test_old_cycles_go_in_portions_and_then_once_a_minute() -> None:
    said: list[str] = []
    uptime, portions = [0.0], iter([PORTION, PORTION + 1, 3, 0])
    asked: list[int] = []

    class Old:
        def delete(self, _unit: Unit, before_ns: int, most: int) -> int:
            assert most == PORTION
            asked.append(before_ns)
            return next(portions)

    retention = Retention(30.0, said.append, lambda: 100 * DAY, lambda: uptime[0])

    def portions_by(second: float) -> int:
        uptime[0] = second
        retention.apply(Old(), UNIT)  # type: ignore[arg-type]
        return len(asked)

    assert [portions_by(second) for second in (0, 2, 4, 6, 63, 64)] == [1, 2, 3, 3, 3, 4]
    assert asked == [70 * DAY] * 4
    assert len(said) == 1


def test_a_locked_database_is_reported_once_and_tried_again(tmp_path: Path) -> None:
    path, said, uptime = tmp_path / "f.sqlite", list[str](), [0.0]
    old_and_new(path)
    retention = Retention(30.0, said.append, uptime=lambda: uptime[0])
    with open_store(path, busy_s=0.01) as store, closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for _ in range(2):
            retention.apply(store, UNIT)
            uptime[0] += LOOK_S
        assert len(said) == 1
        assert said[0].startswith("old key figures cannot be deleted: ")
        assert "database is locked" in said[0]
        other.rollback()
        retention.apply(store, UNIT)
        assert store.history(UNIT).cycle.tolist() == [20]
        assert store.counters(UNIT).cycles == 2


def test_cycles_are_stored_although_old_ones_cannot_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> int:
        raise MemoryError

    monkeypatch.setattr(Store, "delete", fail)
    old_and_new(tmp_path / "figures.sqlite")
    said = run_once(tmp_path, "[figures]\nkeep = true\nkeep_days = 30\n", monkeypatch)
    assert said == ["old key figures cannot be deleted: MemoryError: "]
    with open_store(tmp_path / "figures.sqlite") as store:
        assert store.history(UNIT).cycle.tolist() == [40, 20, 0, 1]


def test_what_is_wrong_in_the_configuration_is_said_before_the_run(tmp_path: Path) -> None:
    wrong = configured(tmp_path, '[figures]\nkeep = true\nurl = "mysql://host/name"\n')
    with pytest.raises(ConfigError, match="figure databases of kind 'mysql'"):
        figure_writer_of(wrong, print)
    wrong = configured(tmp_path, "[figures]\npermitted_t1 = 5\n")
    with pytest.raises(ConfigError, match=r"cell\.toml:2: figures\.permitted_t1: unknown key"):
        key_figures_of(wrong)


def test_the_loop_and_its_log_give_the_same_rows(tmp_path: Path) -> None:
    """Stored live, then read from the log of that run: not one new row, alarms included."""
    config = rigs.config("gripper")
    header = LogHeader(*UNIT, "gripper.toml", config.document.text)
    said: list[str] = []
    figure_writer = FigureWriter(lambda: open_store(tmp_path / "f.sqlite"), UNIT, "a", said.append)
    sinks = [Recorder(tmp_path / "run.mcap", header), figure_writer]
    monitor = Monitor(config.monitor, rigs.theta("gripper"), KeyFigures(config.data))
    recorded = rigs.cut(rigs.recorded("gripper", 20.0, ("leakage=2.0@8",))[0], 30)
    run(recorded, rigs.twin("gripper"), monitor, sinks)
    log = open_log(tmp_path / "run.mcap")
    cycles = [kept for _, kept in of_log(log, KeyFigures(config.data))]
    with open_store(tmp_path / "f.sqlite") as store, open_store(tmp_path / "g.sqlite") as other:
        live = store.history(UNIT)
        assert store.add(UNIT, "a", "run.mcap", cycles) == 0
        assert other.add(UNIT, "a", "run.mcap", cycles) == len(cycles) == len(live.cycle)
        from_log = other.history(UNIT)
    assert said == []
    assert live.alarms.sum() >= 1
    assert live.alarms.tolist() == from_log.alarms.tolist()
    assert live.warnings == from_log.warnings
    for name, column in live.values.items():
        assert np.array_equal(column, from_log.values[name], equal_nan=True), name
