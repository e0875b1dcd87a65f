"""Limits that people change: what is in force, in the running loop and after a restart."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import rigs
from rigs import Collect

from twin.alarms.database import Store, open_store
from twin.alarms.limit_changes import LimitChanges
from twin.alarms.limits import ADJUSTABLE, UnitLimits, limits_in_force, with_unit
from twin.alarms.loop import News
from twin.alarms.requests import LimitChange
from twin.alarms.writer import AlarmWriter
from twin.assets.unit import Unit
from twin.config import Config
from twin.errors import ConfigError
from twin.events import Kind
from twin.figures.cycle import KeyFigures
from twin.languages.choice import language_of
from twin.languages.texts import speaking
from twin.live import run
from twin.monitor.isolation import Isolation
from twin.monitor.monitor import Monitor
from twin.settings import Document
from twin.signals import Samples

UNIT = Unit("compact-ejector-35", "gripper-01")
NOW = 1_700_000_000_000_000_000
SECONDS = 14.0  # of the simulated rig: a cycle takes about 2 s


@pytest.fixture(scope="module")
def configured() -> UnitLimits:
    return UnitLimits.of(rigs.config("gripper"))


def wish(limit: str, value: float | None, number: int = 1) -> LimitChange:
    return LimitChange(number, limit, value, "ann", "shorter cycle", NOW)


def applied(limit: str, value: float | None, number: int = 1) -> LimitChange:
    return replace(wish(limit, value, number), answered_ns=NOW)


# --- what is in force -----------------------------------------------------------------------------


def test_a_changed_limit_is_in_force_and_says_that_a_person_changed_it(
    configured: UnitLimits,
) -> None:
    after = configured.changed_to("permitted_t1_ms", 700.0)
    assert (after.limits.t1, after.value("permitted_t1_ms")) == (700.0, 700.0)
    assert after.limits.source("t1") == "changed by a person"
    assert after.limits.leakage == configured.limits.leakage
    assert after.limits.source("leakage") == configured.limits.source("leakage")
    assert after.configured().value("permitted_t1_ms") == configured.limits.t1


def test_a_changed_side_of_the_supply_leaves_the_source_of_the_other(
    configured: UnitLimits,
) -> None:
    after = configured.changed_to("supply_high_bar", 9.0).limits
    assert after.source("highest_supply") == "changed by a person"
    assert after.source("lowest_supply") == configured.limits.source("lowest_supply")


def test_every_limit_can_be_changed_within_its_range(configured: UnitLimits) -> None:
    wanted = {"supply_low_bar": 1.0, "supply_high_bar": 9.0}
    for key, limit in ADJUSTABLE.items():
        value = wanted.get(key, (limit.lowest + limit.highest) / 2.0)
        assert configured.changed_to(key, value).value(key) == value
        for wrong in (limit.highest * 1.01, limit.lowest - 1.0, float("nan"), float("inf")):
            with pytest.raises(ConfigError, match=limit.title):
                configured.changed_to(key, wrong)


def test_the_budget_of_false_alarms_moves_the_monitor_not_what_is_healthy(
    configured: UnitLimits,
) -> None:
    after = configured.changed_to("false_alarm_days", 365.0)
    assert after.watch.false_alarm_days == 365.0
    assert after.watch.healthy == configured.watch.healthy
    assert after.limits.t1 >= configured.limits.t1  # the rarer the alarms, the wider the range


def test_a_supply_range_is_never_empty(configured: UnitLimits) -> None:
    high = configured.limits.supply[1]
    with pytest.raises(ConfigError, match="lowest supply pressure must be below"):
        configured.changed_to("supply_low_bar", high)
    with pytest.raises(ConfigError, match="no limit is called 't1'"):
        configured.changed_to("t1", 700.0)


def test_the_last_change_of_each_limit_holds_and_a_reset_ends_it(configured: UnitLimits) -> None:
    changes = [
        applied("permitted_t1_ms", 700.0),
        replace(applied("permitted_t1_ms", 1.0), refusal="too low"),
        wish("permitted_t1_ms", 800.0),  # nobody has applied it yet
        applied("permitted_leakage_mbar_s", 30.0),
        applied("permitted_leakage_mbar_s", None),
        applied("gone", 3.0),  # of another version of the program
    ]
    assert configured.after(changes).changed == {"permitted_t1_ms": 700.0}


def test_the_ends_of_a_range_that_moved_one_after_the_other_stay(configured: UnitLimits) -> None:
    steps = [("supply_high_bar", 14.0), ("supply_low_bar", 12.0), ("supply_high_bar", 15.0)]
    assert configured.after([applied(*step) for step in steps]).limits.supply == (12.0, 15.0)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "no limit"),
        (700.4, "700 ms"),
        (60_000.0, "60000 ms"),
        (7.25, "7.25 ms"),
        (0.0, "0 ms"),
    ],
)
def test_values_have_a_unit_and_no_exponent(value: float | None, words: str) -> None:
    assert with_unit(value, "ms") == words


def test_in_german_values_have_a_decimal_comma() -> None:
    with speaking(language_of("de", "language")):
        assert with_unit(7.25, "bar") == "7,25 bar"
        assert with_unit(None, "bar") == "kein Grenzwert"


# --- the running loop -----------------------------------------------------------------------------


def watched(
    limits: LimitChanges, meanwhile: Callable[[int], None] = lambda _: None
) -> tuple[Collect, Monitor]:
    """The loop over the simulated rig; ``meanwhile`` is called before each block."""
    seen, config = Collect(), rigs.config("gripper")
    isolation = Isolation.of(config.data, config.monitor.healthy, config.monitor.false_alarm_days)
    figures = KeyFigures(config.data)
    monitor = Monitor(config.monitor, rigs.theta("gripper"), figures, isolation=isolation)
    limits.attach(monitor)

    def source() -> Iterator[Samples]:
        for number, block in enumerate(rigs.cut(rigs.recorded("gripper", SECONDS)[0], 100)):
            meanwhile(number)
            yield block

    run(source(), rigs.twin("gripper"), monitor, [seen], advisers=[limits])
    return seen, monitor


def over_limit(seen: Collect) -> list[bool]:
    """Whether t1 was over its limit, for each complete cycle."""
    return ["t1_over_limit" in event.data["warnings"] for event in seen.of(Kind.CYCLE)]


class Desk:
    """A storage in memory."""

    def __init__(self, *changes: LimitChange) -> None:
        self.wishes, self.news = list(changes), News()

    def take(self, news: News) -> None:
        self.news.add(news)

    def limit_changes(self) -> list[LimitChange]:
        wishes, self.wishes = self.wishes, []
        return wishes


def test_a_change_holds_from_the_next_cycle_on_without_a_restart(configured: UnitLimits) -> None:
    desk = Desk()
    limits = LimitChanges(configured, desk, lambda: NOW + 5)

    def meanwhile(block: int) -> None:
        if block == 60:
            desk.wishes += [wish("permitted_t1_ms", 10.0), wish("false_alarm_days", 365.0, 2)]

    seen, monitor = watched(limits, meanwhile)
    told, days = seen.of(Kind.LIMIT_CHANGED)
    judged = over_limit(seen)
    assert set(judged[:2]) == {False}
    assert set(judged[-2:]) == {True}
    old = with_unit(configured.limits.t1, "ms")
    assert told.text == f'limit "Longest t1" changed from {old} to 10 ms by ann: shorter cycle'
    assert (told.data["old"], told.data["new"]) == (configured.limits.t1, 10.0)
    assert 5e9 < told.time_ns - seen.samples[0]["time_ns"][0] < 8e9
    assert desk.news.limits[1].answered_ns == told.data["host_ns"] == NOW + 5
    assert days.data["new"] == monitor.settings.false_alarm_days == 365.0
    assert monitor.isolation is not None
    assert monitor.isolation.days == 365.0


def test_what_cannot_be_is_refused_and_changes_nothing(configured: UnitLimits) -> None:
    desk = Desk(wish("supply_low_bar", 16.0))
    limits = LimitChanges(configured, desk, lambda: NOW)
    monitor = rigs.monitor("gripper")
    limits.attach(monitor)
    answered = desk.news.limits[1]
    assert (answered.is_applied, answered.is_waiting) == (False, False)
    assert "must be below the highest" in answered.refusal
    assert limits.follow(rigs.recorded("gripper", SECONDS)[0][:1], []) == []


# --- the database, and a restart ------------------------------------------------------------------


@pytest.mark.slow
def test_a_change_outlives_the_run_until_it_is_reset(
    url: str, monkeypatch: pytest.MonkeyPatch, configured: UnitLimits
) -> None:
    monkeypatch.setattr("twin.alarms.writer.POLL_S", 0.01)

    def one_run() -> Collect:
        alarm_writer = AlarmWriter(lambda: open_store(url), UNIT, pytest.fail)
        alarm_writer.begin()
        try:
            return watched(LimitChanges(configured, alarm_writer, time.time_ns))[0]
        finally:
            alarm_writer.close()

    with open_store(url) as store:
        store.change_limit(UNIT, "permitted_t1_ms", 10.0, "ann", "shorter cycle")
        store.change_limit(Unit("other", ""), "permitted_t1_ms", 20.0, "bob", "another unit")
        first = one_run()
        (change,) = store.limit_changes(UNIT)
        assert (change.is_applied, change.old, change.new) == (True, configured.limits.t1, 10.0)
        assert set(over_limit(first)) == {True}
        second = one_run()
        assert set(over_limit(second)) == {True}
        (told,) = second.of(Kind.LIMIT_CHANGED)
        assert told.text.startswith('limit "Longest t1" is 10 ms since 20')
        assert told.text.endswith("changed by ann: shorter cycle")
        store.change_limit(UNIT, "permitted_t1_ms", None, "bob", "as it was")
        third = one_run()
        assert set(over_limit(third)) == {False}
        *_, back = third.of(Kind.LIMIT_CHANGED)
        assert (back.data["new"], back.data["configured"]) == (configured.limits.t1, True)
        assert one_run().of(Kind.LIMIT_CHANGED) == []  # nothing differs from the configuration


def test_trends_know_the_limit_in_force(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(rigs.path_of("gripper").read_text() + "\n[alarms]\nkeep = true\n")
    config = Config.of(Document.read(path))
    assert limits_in_force(config).changed == {}  # before the first run there is no database
    with open_store(tmp_path / "alarms.sqlite") as store:
        _applied_in(store, "permitted_leakage_mbar_s", 30.0)
    assert limits_in_force(config).limits.leakage == 30.0


def _applied_in(store: Store, limit: str, value: float) -> None:
    number = store.change_limit(UNIT, limit, value, "ann", "why")
    (change,) = store.limit_changes(UNIT)
    store.save(UNIT, News(limits={number: replace(change, answered_ns=NOW)}))
