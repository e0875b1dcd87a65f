"""The asset database on SQLite and on a real PostgreSQL server, by one body of tests."""

import itertools
import json
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from postgres import make_schema

from twin.assets import database
from twin.assets.database import Assets, open_assets
from twin.assets.engine import ASSETS, parse_url
from twin.assets.exchange import to_export, to_plain
from twin.assets.record import Record, checked
from twin.assets.shipped import shipped_records
from twin.errors import ConfigError, SourceError
from twin.model.dataset import DataSet

TYPE, PAPER_UNIT = "compact-ejector-35", "paper-unit"  # shipped
SHIPPED = [TYPE, "gripper-01", PAPER_UNIT, "rig-01"]
WRITER = Path(__file__).with_name("assets_writer.py")
WRITES = 100
NUMBERS = itertools.count()  # names that no other example uses

UNIT = Record(
    "instance",
    "unit-1",
    TYPE,
    {"supply": {"pressure_bar": 4.5}, "ejector": {"suction_capacity_sl_min": 35.0}},
    healthy={"suction_rms": {"mean": 2.0, "sigma": 0.1}},
    arrays={
        "covariance": np.array([[0.1 + 0.2, -0.0], [5e-324, 1e308]]),
        "diagram_vacuum_mbar": np.array([0.0, 400.0, 850.0]),
        "diagram_supply_bar": np.array([3.0, 4.5]),
        "diagram_flow_sl_min": np.array([[30.0, 16.0, 0.0], [35.0, 20.0, 1.0]]),
    },
    provenance={"log": "day.mcap", "cycles": [0, 2, 4], "code": "1.2.3", "names": ["a", "b"]},
)


@pytest.fixture(scope="module")
def shared(server: Path | None, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A database for tests that take names of their own."""
    if server is None:
        return f"sqlite:///{tmp_path_factory.mktemp('shared') / 'assets.sqlite'}"
    return make_schema(server, "shared")


def raw(url: str) -> Any:
    """A connection of the database's own driver, past the program."""
    if url.startswith("sqlite"):
        return sqlite3.connect(url.removeprefix("sqlite:///"), isolation_level=None)
    return psycopg.connect(url, autocommit=True)


def sabotage(url: str, on_sqlite: str, on_postgresql: str) -> None:
    """Do to the database what the program never does."""
    with closing(raw(url)) as connection:
        connection.execute(on_sqlite if url.startswith("sqlite") else on_postgresql)


def units(assets: Assets, **when: int) -> list[Record]:
    """Those that did not come with the program."""
    return [r for r in assets.records("instance", **when) if r.name not in SHIPPED]


def same(left: Record, right: Record) -> bool:
    """Equal to the last bit; JSON tells -0.0 from 0.0."""
    texts = {json.dumps(to_plain(record), sort_keys=True) for record in (left, right)}
    return len(texts) == 1


# --- adding and getting -------------------------------------------------------------------------


def test_what_is_added_comes_back_to_the_last_bit(url: str) -> None:
    with open_assets(url) as assets:
        added = assets.add(UNIT)
    with open_assets(url) as assets:
        found = assets.get(TYPE, "unit-1")
    assert found.used == "instance"
    assert same(found.record, added)
    assert same(replace(added, id="", recorded_ns=0, hash=""), UNIT)
    for name, array in UNIT.arrays.items():
        back = found.record.arrays[name]
        assert (back.shape, back.dtype) == (array.shape, np.float64)
        assert back.tobytes() == array.tobytes()
    assert list(found.record.data) == ["supply", "ejector"]  # in the order it was written


@settings(max_examples=20, deadline=None)
@given(
    array=hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=0, min_side=0),
        elements=st.floats(allow_nan=False, allow_infinity=False),
    ),
    text=st.text(),
)
def test_any_array_and_any_text_survive_database_and_export(
    shared: str, array: "np.ndarray[Any, Any]", text: str
) -> None:
    name = f"any-{next(NUMBERS)}"
    with open_assets(shared) as assets:
        added = assets.add(Record("type", name, name, {text: text}, arrays={"a": array}))
        back = assets.get(name).record
        document = json.loads(json.dumps(to_export([back])))
    with open_assets("sqlite://", shipped=False) as other:
        other.import_(document)
        (carried,) = other.records()
    for record in (back, carried):
        assert record.arrays["a"].tobytes() == array.tobytes()
        assert record.arrays["a"].shape == array.shape
        assert record.data == {text: text}
        assert same(record, added)


def test_a_unit_without_data_of_its_own_falls_back_to_its_type(url: str) -> None:
    with open_assets(url) as assets:
        found = assets.get(TYPE, "unit-1")
        assert (found.used, found.record.name, found.base) == ("type", TYPE, None)
        assets.add(replace(UNIT, valid_from_ns=100))
        assert assets.get(TYPE, "unit-1", at_ns=99).used == "type"
        own = assets.get(TYPE, "unit-1", at_ns=100)
        assert own.used == "instance"
        assert own.base is not None
        assert same(own.base, found.record)  # for what the unit's leaves out
        assert assets.get(TYPE).used == "type"
        assert assets.get(TYPE, "unit-2").used == "type"


def test_the_papers_type_and_the_one_unit_it_measured_are_shipped(url: str) -> None:
    """Table 1: the mean of ten units, and one of them."""
    with open_assets(url) as assets:
        found = assets.get(TYPE, PAPER_UNIT)
        assert [record.name for record in assets.records()] == SHIPPED
    assert found.base is not None
    kind, unit = found.base.data["ejector"], found.record.data["ejector"]
    assert (kind["suction_capacity_sl_min"], kind["end_pressure_mbar"]) == (33.4, 150.0)
    assert unit == {"suction_capacity_sl_min": 35.0}
    for record in (found.base, found.record):
        assert record.provenance["source"].startswith("shipped with ejector-twin ")
        assert "table 1" in record.provenance["note"]
        DataSet.model_validate(record.data)


def test_neither_unit_nor_type_names_the_known_types(url: str) -> None:
    with open_assets(url) as assets:
        with pytest.raises(ConfigError, match="no data set of 'u' or its type 'other'") as caught:
            assets.get("other", "u")
        assert TYPE in caught.value.hint
        with pytest.raises(ConfigError, match="asset 'u' has no type"):
            assets.get("", "u")


def test_a_unit_of_another_type_is_refused_and_can_be_put_right(url: str) -> None:
    with open_assets(url) as assets:
        assets.add(Record("type", "other", "other", {}))
        assets.add(UNIT)
        with pytest.raises(ConfigError, match=f"is of type '{TYPE}' in the database, not 'other'"):
            assets.get("other", "unit-1")
        assets.add(replace(UNIT, type="other"))
        assert assets.get("other", "unit-1").used == "instance"


def test_a_unit_whose_type_is_not_there_is_refused(url: str) -> None:
    with open_assets(url) as assets:
        before = assets.export()
        with pytest.raises(ConfigError, match="'unknown-type'") as caught:
            assets.add(replace(UNIT, type="unknown-type"))
        assert TYPE in caught.value.hint
        assert assets.export() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"type": ""}, "instance 'unit-1' has no type"),
        ({"name": ""}, "cannot be a name"),
        ({"name": " unit-1"}, "cannot be a name"),
        ({"name": "unit\0"}, "cannot be a name"),
        ({"kind": "type"}, "says it is of type"),
        ({"data": {"volume_ml": float("nan")}}, "its data cannot be kept"),
        ({"healthy": {"day": object()}}, "its healthy cannot be kept"),
        ({"valid_from_ns": 2**63}, "valid_from_ns is not a time"),
        ({"arrays": {"covariance": np.array([np.inf])}}, "not finite"),
        ({"arrays": {"diagram_vacuum_mbar": np.array([0.0, 1.0])}}, "characteristic diagram"),
        ({"arrays": {**UNIT.arrays, "diagram_supply_bar": np.array([4.5, 3.0])}}, "rise strictly"),
    ],
)
def test_what_cannot_be_kept_is_refused(changes: dict[str, Any], message: str) -> None:
    with open_assets("sqlite://") as assets:
        before = len(assets.records())
        with pytest.raises(ConfigError, match=message):
            assets.add(replace(UNIT, **changes))
        assert len(assets.records()) == before


def test_the_hash_is_of_the_content_alone() -> None:
    base = checked(UNIT).hash
    reordered = {"ejector": UNIT.data["ejector"], "supply": UNIT.data["supply"]}
    for neutral in ({"name": "unit-2"}, {"provenance": {}}, {"valid_from_ns": 1}):
        assert checked(replace(UNIT, **neutral)).hash == base
    assert checked(replace(UNIT, data=reordered)).hash == base
    other = {
        "data": {"data": {**UNIT.data, "sensor": {}}},
        "healthy": {"healthy": {}},
        "value": {
            "arrays": {**UNIT.arrays, "covariance": np.array([[0.3, -0.0], [5e-324, 1e308]])}
        },
        "shape": {"arrays": {**UNIT.arrays, "covariance": UNIT.arrays["covariance"].ravel()}},
        "name": {"arrays": {**UNIT.arrays, "other": UNIT.arrays["covariance"]}},
    }
    hashes = {checked(replace(UNIT, **changes)).hash for changes in other.values()}
    assert len(hashes | {base}) == len(other) + 1
    assert len(base) == 16


# --- two times ----------------------------------------------------------------------------------

ENTRIES = st.lists(
    st.tuples(st.sampled_from(["type", "instance"]), st.integers(-2, 6), st.integers(-2, 6)),
    min_size=1,
    max_size=8,
)
QUESTIONS = st.lists(
    st.tuples(st.integers(-3, 7), st.none() | st.integers(-3, 7)), min_size=1, max_size=6
)


def told(entries: list[Record], at: int, as_of: int | None) -> Record | None:
    """What ``get`` should find, said by walking through time."""
    for kind in ("instance", "type"):
        last = None
        for record in sorted(entries, key=lambda r: (r.valid_from_ns, r.recorded_ns, r.id)):
            known = as_of is None or record.recorded_ns <= as_of
            if record.kind == kind and known and record.valid_from_ns <= at:
                last = record
        if last is not None:
            return last
    return None


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(ENTRIES, QUESTIONS)
def test_get_is_right_in_both_times(
    shared: str, entries: list[tuple[Any, int, int]], questions: list[tuple[int, int | None]]
) -> None:
    number = next(NUMBERS)
    type_name, unit = f"type-{number}", f"unit-{number}"
    records = [
        checked(
            Record(
                kind,
                type_name if kind == "type" else unit,
                type_name,
                {"which": index},
                valid_from_ns=valid,
                recorded_ns=recorded,
                id=f"{number:016x}{index:016x}",
            )
        )
        for index, (kind, valid, recorded) in enumerate([("type", 5, 5), *entries])
    ]
    with open_assets(shared) as assets:
        assert assets.import_(to_export(records)) == len(records)
        for at, as_of in questions:
            expected = told(records, at, as_of)
            if expected is None:
                with pytest.raises(ConfigError, match="no data set of"):
                    assets.get(type_name, unit, at_ns=at, as_of_ns=as_of)
                continue
            found = assets.get(type_name, unit, at_ns=at, as_of_ns=as_of)
            assert (found.record.id, found.used) == (expected.id, expected.kind)


def test_the_clock_says_now_and_recorded_times_rise_even_if_it_does_not(url: str) -> None:
    shipped = [700, 800, 900, 1000]
    times = iter([*shipped, 2000, 1500, 2000, 1999, 2500])
    with open_assets(url, clock=lambda: next(times)) as assets:
        first, second, third = (assets.add(replace(UNIT, valid_from_ns=2000)) for _ in range(3))
        assert [r.recorded_ns for r in (first, second, third)] == [2000, 2001, 2002]
        assert assets.get(TYPE, "unit-1").used == "type"  # at 1999
        assert assets.get(TYPE, "unit-1").record.id == third.id  # at 2500
        assert [r.recorded_ns for r in assets.records()] == [*shipped, 2000, 2001, 2002]
        assert [r.id for r in units(assets, as_of_ns=2001)] == [first.id, second.id]
        assert assets.records("instance", "nobody") == []


# --- append-only, whole or not at all -----------------------------------------------------------

CHANGES = {
    "update": "UPDATE asset_record SET data = '{}'",
    "update of arrays": "UPDATE asset_array SET shape = '[0]'",
    "delete": "DELETE FROM asset_record",
    "delete of arrays": "DELETE FROM asset_array",
    "upsert": "INSERT INTO asset_record SELECT * FROM asset_record WHERE true"
    " ON CONFLICT (id) DO UPDATE SET data = '{}'",
    "replace or truncate": "",
    "replace or truncate of arrays": "",
}
OWN = {
    "sqlite": "REPLACE INTO {0} SELECT * FROM {0}",
    "postgresql": "TRUNCATE {0} CASCADE",
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_database_itself_refuses_changes(shared: str, change: str) -> None:
    with open_assets(shared) as assets:
        assets.add(replace(UNIT, name=f"kept-{next(NUMBERS)}"))
        before = assets.export()
        table = "asset_array" if "arrays" in change else "asset_record"
        statement = CHANGES[change] or OWN[shared.partition(":")[0]].format(table)
        with (
            closing(raw(shared)) as connection,
            pytest.raises((sqlite3.IntegrityError, psycopg.Error), match="append-only"),
        ):
            connection.execute(statement)
        assert assets.export() == before


def test_sqlite_has_no_second_key_by_which_to_replace(tmp_path: Path) -> None:
    path = tmp_path / "assets.sqlite"
    open_assets(path).close()
    for table in ("asset_record", "asset_array"):
        with (
            closing(sqlite3.connect(path)) as connection,
            pytest.raises(sqlite3.OperationalError, match="rowid"),
        ):
            connection.execute(f"SELECT rowid FROM {table}")


def test_an_add_that_fails_half_way_leaves_nothing(url: str) -> None:
    with open_assets(url) as assets:
        before = assets.export()
        sabotage(
            url,
            "CREATE TRIGGER full BEFORE INSERT ON asset_array WHEN NEW.name = 'covariance'"
            " BEGIN SELECT RAISE(ABORT, 'disk full'); END",
            "ALTER TABLE asset_array ADD CONSTRAINT \"disk full\" CHECK (name <> 'covariance')",
        )
        with pytest.raises(SourceError, match="disk full"):
            assets.add(UNIT)
        good = checked(Record("type", "good", "good", {}, id="0" * 31 + "1"))
        bad = checked(replace(UNIT, id="0" * 31 + "2"))
        with pytest.raises(SourceError, match="disk full"):
            assets.import_(to_export([good, bad]))
        assert assets.export() == before


def test_a_damaged_record_is_not_given_out(url: str) -> None:
    with open_assets(url) as assets:
        assets.add(UNIT)
        sabotage(
            url,
            "DROP TRIGGER asset_record_no_update",
            "ALTER TABLE asset_record DISABLE TRIGGER ALL",
        )
        change = "UPDATE asset_record SET data = '{}' WHERE name = 'unit-1'"
        sabotage(url, change, change)
        with pytest.raises(SourceError, match="of 'unit-1' is damaged"):
            assets.get(TYPE, "unit-1")
        assert assets.get(TYPE, "unit-2").used == "type"


# --- opening ------------------------------------------------------------------------------------


def test_a_database_of_a_newer_schema_is_refused_and_left_alone(url: str) -> None:
    with open_assets(url) as assets:
        before = assets.export()
        newer = "INSERT INTO asset_schema VALUES (2, '9.8.7')"
        sabotage(url, newer, newer)
        with pytest.raises(ConfigError, match=r"ejector-twin 9\.8\.7 \(schema 2\)") as caught:
            open_assets(url)
        assert "update ejector-twin to 9.8.7" in caught.value.hint
        assert assets.export() == before


def test_opening_again_adds_nothing_and_a_new_shipped_version_is_added_once(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_assets(url) as assets:
        old = assets.export()
    with open_assets(url) as assets:
        assert assets.export() == old
    shipped = shipped_records()[0]
    newer = checked(replace(shipped, data={"new": True}, id="f" * 32))
    for records in ((newer,), (newer,), (shipped,)):  # the last is an older program again
        monkeypatch.setattr(database, "shipped_records", lambda given=records: given)
        with open_assets(url) as assets:
            assert [record.name for record in assets.records()] == [*SHIPPED, TYPE]
            assert assets.get(TYPE).record.data == {"new": True}


@contextmanager
def held(url: str) -> Iterator[None]:
    """Somebody else keeps the whole database to himself."""
    with closing(raw(url)) as connection:
        if url.startswith("sqlite"):
            connection.execute("BEGIN EXCLUSIVE")
        else:
            connection.execute("BEGIN")
            connection.execute("LOCK TABLE asset_record, asset_array IN ACCESS EXCLUSIVE MODE")
        yield
        connection.execute("ROLLBACK")


@pytest.mark.parametrize(
    "deed",
    [
        lambda assets: assets.add(UNIT),
        lambda assets: assets.get(TYPE, "unit-1"),
        lambda assets: assets.import_(to_export([checked(replace(UNIT, id="1" * 32))])),
    ],
    ids=["add", "get", "import"],
)
def test_a_locked_database_is_said_and_nothing_is_written(
    url: str, deed: Callable[[Assets], object]
) -> None:
    with open_assets(url, busy_s=0.05) as assets:
        before = assets.export()
        start = time.monotonic()
        with held(url), pytest.raises(SourceError, match="lock") as caught:
            deed(assets)
        assert time.monotonic() - start < 3.0  # of busy_s, not of the default
        assert "another program holds it" in caught.value.hint
        assert assets.export() == before
        deed(assets)


def test_a_database_locked_from_the_start_is_said(url: str) -> None:
    open_assets(url).close()
    with held(url), pytest.raises(SourceError, match="lock"):
        open_assets(url, busy_s=0.05)


def test_a_server_that_cannot_be_reached_is_said_without_the_password(tmp_path: Path) -> None:
    url = parse_url(f"postgresql://me@/assets?host={tmp_path}", ASSETS).set(password="secret")
    with pytest.raises(SourceError, match=r"postgresql://me:\*\*\*@/assets") as caught:
        open_assets(url, busy_s=0.1)
    assert "secret" not in str(caught.value)
    assert "server" in caught.value.hint


def test_files_that_are_no_asset_database_are_refused_and_left_alone(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("not a database, but long enough to be looked at" * 20)
    other = tmp_path / "other.sqlite"
    with closing(sqlite3.connect(other)) as connection:
        connection.execute("CREATE TABLE bookmarks (url TEXT)")
    before = text.read_bytes(), other.read_bytes()
    with pytest.raises(SourceError, match=r"notes\.txt: asset database: file is not a database"):
        open_assets(text)
    with pytest.raises(ConfigError, match=r"other\.sqlite: a database of another program"):
        open_assets(other)
    assert (text.read_bytes(), other.read_bytes()) == before


def test_a_torn_file_is_an_error_for_people(tmp_path: Path) -> None:
    path = tmp_path / "assets.sqlite"
    with open_assets(path) as assets:
        assets.add(UNIT)
    whole = path.read_bytes()
    for size in range(4096, len(whole), 4096):
        path.write_bytes(whole[:size])
        with pytest.raises(SourceError, match=r"assets\.sqlite"), open_assets(path) as assets:
            assets.records()


@pytest.mark.parametrize("url", ["mysql://me@host/db", "postgresql://host:port/db", "://"])
def test_urls_of_other_kinds_are_refused(url: str) -> None:
    with pytest.raises(ConfigError) as caught:
        open_assets(url)
    assert "postgresql://" in caught.value.hint


def test_an_empty_file_becomes_a_database_and_a_missing_one_only_if_asked(tmp_path: Path) -> None:
    empty, missing = tmp_path / "empty.sqlite", tmp_path / "missing.sqlite"
    empty.touch()
    with open_assets(empty, create=False) as assets:
        assert assets.get(TYPE).used == "type"
    with pytest.raises(SourceError, match="no such asset database") as caught:
        open_assets(missing, create=False)
    assert "twin commission" in caught.value.hint
    with pytest.raises(SourceError, match="unable to open") as caught:
        open_assets(tmp_path / "nowhere" / "assets.sqlite")
    assert "folder" in caught.value.hint
    assert list(tmp_path.iterdir()) == [empty]


# --- carrying it elsewhere ----------------------------------------------------------------------


def test_an_export_makes_the_same_database_and_importing_twice_changes_nothing(url: str) -> None:
    with open_assets("sqlite://", clock=lambda: 1000) as assets:
        assets.add(UNIT)
        assets.add(replace(UNIT, data={}, valid_from_ns=500))
        document = json.loads(json.dumps(assets.export()))
    with open_assets(url, shipped=False) as assets:
        assert assets.import_(document) == len(SHIPPED) + 2
        assert assets.import_(document) == 0
    with open_assets(url) as assets:
        assert json.dumps(assets.export()) == json.dumps(document)


def test_two_databases_flow_together(url: str) -> None:
    with open_assets("sqlite://") as other:
        theirs = other.add(UNIT)
        document = other.export()
    with open_assets(url) as assets:
        ours = assets.add(replace(UNIT, name="unit-2"))
        assert assets.import_(document) == 1  # what is shipped is here already
        assert {r.id for r in units(assets)} == {theirs.id, ours.id}


def edited(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    record = checked(replace(UNIT, id="a" * 32))
    document = json.loads(json.dumps(to_export([record])))
    change(document)
    return dict(document)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="ejector-twin-assets/2"), "format"),
        (lambda d: d.pop("records"), "records: Field required"),
        (lambda d: d["records"][0].update(colour="red"), "records.0.colour"),
        (lambda d: d["records"][0].update(kind="group"), "records.0.kind"),
        (lambda d: d["records"][0].update(id="1"), "records.0.id"),
        (lambda d: d["records"][0]["data"].update(new=1), "its hash differs"),
        (lambda d: d["records"][0]["arrays"]["covariance"].update(shape=[3, 3]), "arrays"),
        (lambda d: d["records"][0].update(type="unknown-type"), "unknown-type"),
        (lambda d: d["records"].append({**d["records"][0], "name": "u"}), "differs from the one"),
    ],
)
def test_an_export_that_was_edited_is_refused_whole(
    change: Callable[[dict[str, Any]], object], message: str
) -> None:
    with open_assets("sqlite://") as assets:
        before = assets.export()
        with pytest.raises(ConfigError, match=message):
            assets.import_(edited(change))
        assert assets.export() == before


# --- several at once ----------------------------------------------------------------------------


@contextmanager
def writer(url: str, unit: str) -> Iterator["subprocess.Popen[str]"]:
    """A writing process that has made or found the tables; it is killed at the end."""
    command = [sys.executable, str(WRITER), url, unit]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            assert next_line(process) == "ready"
            yield process
        finally:
            process.kill()


def write(process: "subprocess.Popen[str]", count: int) -> None:
    assert process.stdin is not None
    process.stdin.write(f"{count}\n")
    process.stdin.flush()


def next_line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    assert line, process.stderr and process.stderr.read()
    return line


@pytest.mark.slow
def test_two_writers_at_once_lose_nothing(url: str) -> None:
    with writer(url, "left") as left, writer(url, "right") as right:
        told_ids = [list[str](), list[str]()]
        for _ in range(WRITES):
            for process in (left, right):
                write(process, 1)
            for process, ids in zip((left, right), told_ids, strict=True):
                ids.append(next_line(process))
    with open_assets(url) as assets:
        records = units(assets)
        assert len(assets.records()) == len(records) + len(SHIPPED)
    for unit, ids in zip(("left", "right"), told_ids, strict=True):
        own = [record for record in records if record.name == unit]
        assert [record.id for record in own] == ids
        assert [record.data["number"] for record in own] == list(range(WRITES))
    assert len({record.recorded_ns for record in records}) == 2 * WRITES


def test_who_writes_is_alone(url: str) -> None:
    """Else two could record at one time, or one before what another has already read."""

    def meanwhile() -> int:
        with pytest.raises(SourceError, match="lock"):
            other.add(UNIT)
        return 10**18

    with open_assets(url, busy_s=0.05) as other, open_assets(url, clock=meanwhile) as assets:
        assets.add(UNIT)
        assert len(units(assets)) == 1


def test_a_writer_that_is_killed_leaves_whole_records(url: str) -> None:
    with writer(url, "unit-1") as process:
        write(process, 1_000_000)
        told_ids = [next_line(process) for _ in range(20)]
        process.kill()
        assert process.stdout is not None
        told_ids += process.stdout.read().split()
    with open_assets(url) as assets:  # reading checks every hash
        ids = [record.id for record in units(assets)]
    whole = [told_id for told_id in told_ids if len(told_id) == 32]
    assert ids[: len(whole)] == whole
    assert len(ids) <= len(whole) + 1
