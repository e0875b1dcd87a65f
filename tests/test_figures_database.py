"""The figure database on SQLite and on a real PostgreSQL server, by one body of tests."""

import itertools
import math
import sqlite3
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest

from twin.assets.database import open_assets
from twin.assets.unit import Unit
from twin.errors import ConfigError, SourceError
from twin.figures.database import LIVE, VALUES, Counters, Store, open_store
from twin.figures.database_url import FILE, open_chosen
from twin.settings import Document

RIG, GRIPPER = Unit("ejector-35", "rig-01"), Unit("ejector-35", "gripper-01")
SECOND = 1_000_000_000


def execute(url: str, statement: str) -> None:
    """Do to the database what the program never does."""
    if url.startswith("sqlite"):
        connection: Any = sqlite3.connect(url.removeprefix("sqlite:///"), isolation_level=None)
    else:
        connection = psycopg.connect(url, autocommit=True)
    with closing(connection):
        connection.execute(statement)


def cycle(number: int, **values: Any) -> dict[str, Any]:
    """A cycle each three seconds, as events carry it."""
    begin = {"begin_ns": number * 3 * SECOND, "host_ns": 10**18 + number * 3 * SECOND}
    own = {"t0_measured": 700.0 + number, "switchings_measured": 2.0, "warnings": []}
    return {"cycle": number, "alarms": 0, **begin, **own, **values}


def add(store: Store, *cycles: dict[str, Any], unit: Unit = RIG, data_set: str = "a") -> int:
    return store.add(unit, data_set, "run.mcap", cycles)


def test_what_is_added_comes_back(url: str) -> None:
    given = cycle(7, leakage_measured=40.125, leakage_expected=0.1 + 0.2, warnings=["a", "b"])
    with open_store(url) as store:
        assert add(store, given) == 1
    with open_store(url) as store:
        found = store.history(RIG)
    assert (found.host_ns[0], found.begin_ns[0]) == (given["host_ns"], given["begin_ns"])
    assert (found.cycle[0], found.alarms[0], found.warnings[0]) == (7, 0, "a b")
    assert set(found.values) == set(VALUES)
    for name, column in found.values.items():
        assert column[0] == given[name] if name in given else math.isnan(column[0])


def test_a_replay_of_the_same_log_adds_nothing(url: str) -> None:
    cycles = [cycle(number) for number in range(20)]
    with open_store(url) as store:
        assert add(store, *cycles[:12]) == 12
        assert add(store, *cycles) == 8
        assert add(store, *cycles) == 0
        assert add(store, *cycles, *cycles, unit=GRIPPER) == 20
        assert len(store.history(RIG).host_ns) == 20
        assert store.units() == [GRIPPER, RIG]


def test_plc_time_that_begins_anew_is_another_cycle(url: str) -> None:
    again = cycle(0, host_ns=cycle(100)["host_ns"])
    with open_store(url) as store:
        assert add(store, cycle(0), again) == 2
        assert store.history(RIG).begin_ns.tolist() == [0, 0]


def test_of_a_cycle_the_newest_row_holds(url: str) -> None:
    clock = itertools.count(1)
    with open_store(url, clock=lambda: next(clock)) as store:
        add(store, cycle(1, t0_expected=700.0), cycle(2, t0_expected=700.0))
        assert add(store, cycle(1, t0_expected=720.0), data_set="calibrated") == 1
        assert store.history(RIG).values["t0_expected"].tolist() == [720.0, 700.0]
        assert store.counters(RIG).cycles == 2


def test_cycles_come_in_the_order_of_time_and_since_when_they_are_asked_for(url: str) -> None:
    with open_store(url) as store:
        add(store, *(cycle(number) for number in (5, 2, 9)))
        assert store.history(RIG).cycle.tolist() == [2, 5, 9]
        recent = store.history(RIG, cycle(5)["host_ns"], ["t0_measured"])
        assert recent.cycle.tolist() == [5, 9]
        assert set(recent.values) == {"t0_measured"}
        assert len(store.history(GRIPPER).host_ns) == 0


def test_counters_have_twins_that_can_be_erased(url: str) -> None:
    now = [cycle(0)["host_ns"]]
    with open_store(url, clock=lambda: now[0]) as store:
        assert store.counters(RIG) == Counters(0, 0, 0)
        add(store, *(cycle(number, alarms=number == 2) for number in range(4)))
        assert store.counters(RIG) == store.counters(RIG, erasable=True) == Counters(4, 8, 1)
        now[0] = cycle(3)["host_ns"] + 1
        store.erase(RIG)
        add(store, cycle(4, switchings_measured=3.0), cycle(5, switchings_measured=None))
        assert store.counters(RIG) == Counters(6, 11, 1)
        assert store.counters(RIG, erasable=True) == Counters(2, 3, 0)
        assert store.counters(GRIPPER, erasable=True) == Counters(0, 0, 0)


def both_counters(store: Store) -> tuple[Counters, Counters]:
    return store.counters(RIG), store.counters(RIG, erasable=True)


def test_deleting_cycles_changes_no_counter(url: str) -> None:
    """Nine cycles, two of them stored with two data sets; erasable counters begin in the midst."""
    now = [cycle(2)["host_ns"] + 1]
    cycles = [cycle(number, alarms=number % 2) for number in range(9)]
    with open_store(url, clock=lambda: now[0]) as store:
        add(store, *cycles)
        add(store, *cycles[1:3], data_set="b")
        add(store, *cycles, unit=GRIPPER)
        store.erase(RIG)
        before = both_counters(store)
        assert before == (Counters(9, 18, 4), Counters(6, 12, 3))
        rows = []
        while not rows or rows[-1]:  # the rows of a cycle go together, even beyond a portion
            rows.append(store.delete(RIG, cycle(6)["host_ns"], most=2))
            assert both_counters(store) == before
        assert rows == [3, 2, 2, 1, 0]
        assert store.deleted_until(RIG) == cycle(5)["host_ns"]
        assert store.history(RIG).cycle.tolist() == [6, 7, 8]
        assert len(store.history(GRIPPER).cycle) == 9
        assert store.deleted_until(GRIPPER) is None
        now[0] = cycle(8)["host_ns"] + 1
        store.erase(RIG)
        add(store, cycle(9))
        assert both_counters(store) == (Counters(10, 20, 4), Counters(1, 2, 0))
        store.delete(RIG, cycle(20)["host_ns"], most=100)
        assert both_counters(store) == (Counters(10, 20, 4), Counters(1, 2, 0))
        assert store.units() == [GRIPPER, RIG]


KEY = "asset_type, asset_id, host_ns, begin_ns, data_set"
HELD = (  # a cycle that another table refers to cannot be deleted
    "CREATE TABLE held (asset_type TEXT, asset_id TEXT, host_ns BIGINT, begin_ns BIGINT,"
    f" data_set TEXT, FOREIGN KEY ({KEY}) REFERENCES figure_cycle ({KEY}))",
    f"INSERT INTO held SELECT {KEY} FROM figure_cycle WHERE cycle = 2",
)


@pytest.mark.parametrize(
    ("sabotage", "repair"),
    [
        (HELD, "DROP TABLE held"),
        (
            ["ALTER TABLE figure_deleted RENAME TO away"],
            "ALTER TABLE away RENAME TO figure_deleted",
        ),
    ],
    ids=["the rows stay", "the sums cannot be carried"],
)
def test_a_deletion_that_ends_half_way_has_changed_nothing(
    url: str, sabotage: list[str], repair: str
) -> None:
    cycles = [cycle(number, alarms=1) for number in range(4)]
    with open_store(url) as store:
        add(store, *cycles)
        for statement in sabotage:
            execute(url, statement)
        with pytest.raises(SourceError, match="figure database"):
            store.delete(RIG, cycle(3)["host_ns"], most=100)
        execute(url, repair)
        assert store.history(RIG).cycle.tolist() == [0, 1, 2, 3]
        assert store.counters(RIG) == Counters(4, 8, 4)
        assert store.delete(RIG, cycle(3)["host_ns"], most=100) == 3
        assert store.counters(RIG) == Counters(4, 8, 4)


def test_a_log_of_deleted_cycles_is_not_counted_again(url: str) -> None:
    with open_store(url) as store:
        add(store, *(cycle(number) for number in range(6)))
        store.delete(RIG, cycle(4)["host_ns"], most=100)
        assert add(store, *(cycle(number) for number in range(8))) == 2
        assert store.counters(RIG).cycles == 8
        # The clock of a run may have been set back. Its cycles are new all the same.
        assert store.add(RIG, "a", LIVE, [cycle(3, begin_ns=7)]) == 1
        store.delete(RIG, cycle(4)["host_ns"], most=100)
        assert store.deleted_until(RIG) == cycle(3)["host_ns"]
        assert store.counters(RIG).cycles == 9


def test_a_database_of_an_older_program_gets_what_deletion_needs(url: str) -> None:
    with open_store(url) as store:
        add(store, cycle(1), cycle(2))
    execute(url, "DROP TABLE figure_deleted")
    with open_store(url) as store:
        assert store.counters(RIG).cycles == 2
        assert store.delete(RIG, cycle(2)["host_ns"], most=100) == 1
        assert store.counters(RIG).cycles == 2


def test_a_batch_is_added_whole_or_not_at_all(url: str) -> None:
    with open_store(url) as store:
        execute(url, "CREATE UNIQUE INDEX one ON figure_cycle (air_measured)")
        with pytest.raises(SourceError, match=r"figure database: .*(?i:unique)"):
            add(store, cycle(1, air_measured=3.0), cycle(2, air_measured=3.0))
        assert len(store.history(RIG).host_ns) == 0
        assert add(store, cycle(1, air_measured=3.0)) == 1


def test_figures_that_an_older_program_did_not_know_get_their_columns(url: str) -> None:
    with open_store(url) as store:
        add(store, cycle(1, air_measured=3.0))
    execute(url, "ALTER TABLE figure_cycle DROP COLUMN energy_expected")
    with open_store(url) as store:
        add(store, cycle(2, energy_expected=0.25))
        found = store.history(RIG).values
    assert math.isnan(found["energy_expected"][0])
    assert found["energy_expected"][1] == 0.25
    assert found["air_measured"][0] == 3.0


def test_two_who_add_the_same_add_it_once(url: str) -> None:
    cycles = [cycle(number) for number in range(60)]
    added: list[int] = []

    def work() -> None:
        with open_store(url) as store:
            added.extend(add(store, cycle) for cycle in cycles)

    both = [threading.Thread(target=work) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert sum(added) == 60
    with open_store(url) as store:
        assert np.array_equal(store.history(RIG).cycle, np.arange(60))


def test_assets_and_figures_share_a_server(server: Path | None, url: str) -> None:
    with open_store(url) as store:
        add(store, cycle(1))
    if server is None:  # a file has one purpose
        with pytest.raises(ConfigError, match="a database of another program"):
            open_assets(url)
        return
    with open_assets(url) as assets:
        assert assets.records()


# Which database.


def test_the_default_is_a_file_beside_the_configuration(tmp_path: Path) -> None:
    config = tmp_path / "cell.toml"
    config.write_text("")
    document = Document.read(config)
    with pytest.raises(SourceError, match="no such figure database"):
        open_chosen("", document, create=False)
    with open_chosen("", document, create=True) as store:
        assert store.name == str(tmp_path / FILE)
    with open_chosen("", document, create=False) as store:
        assert store.units() == []


def test_a_configuration_names_a_file_from_its_own_folder(tmp_path: Path) -> None:
    config = tmp_path / "cell.toml"
    config.write_text('[figures]\nurl = "kept/figures.sqlite"\n')
    (tmp_path / "kept").mkdir()
    with open_chosen("", Document.read(config), create=True) as store:
        assert store.name == str(tmp_path / "kept" / "figures.sqlite")
    with open_chosen(str(tmp_path / "other.sqlite"), Document.read(config), create=True) as store:
        assert store.name == str(tmp_path / "other.sqlite")


def test_what_is_no_database_is_said_with_the_right_option(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("this is no database, and long enough to be told from an empty one" * 20)
    with pytest.raises(SourceError, match=r"notes\.txt: figure database: ") as caught:
        open_store(path)
    assert "--figures" in caught.value.hint
    with pytest.raises(ConfigError, match="figure databases of kind 'mysql' are not supported"):
        open_store("mysql://host/name")
