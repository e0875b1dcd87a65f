"""Tables as files that people open: what is text stays text, what is a time is one."""

import csv
from datetime import datetime
from pathlib import Path
from typing import Any

import openpyxl
import pyarrow as pa
import pytest
from pyarrow import parquet
from test_alarms_cli import begun, run  # noqa: F401 - a fixture
from test_alarms_loop import LEAK, UNIT

from twin.alarms.board import Episode
from twin.alarms.export import history_table
from twin.errors import ConfigError, SourceError
from twin.tables import sheet
from twin.tables.sheet import export

NS = 1_000_000_000
AT = 1_700_000_000 * NS + 123_456_789
BAD = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "plain", None]


def table() -> pa.Table:
    fields = [
        pa.field("words", pa.string()),
        pa.field("time", pa.timestamp("ns", "UTC")),
        pa.field("leakage", pa.float64(), metadata={"unit": "mbar/s"}),
        pa.field("plc_time_ns", pa.int64()),
    ]
    columns = [
        BAD,
        [AT] * 6 + [None],
        [-1.5, float("nan"), None, 1, 2, 3, 4],
        [AT, 7, -1, 0, 1, 2, 3],
    ]
    return pa.table(
        [pa.array(column, field.type) for column, field in zip(columns, fields, strict=True)],
        pa.schema(fields),
    )


def cells(path: Path) -> Any:
    book = openpyxl.load_workbook(path)
    return book.active


def test_a_sheet_holds_times_as_times_and_numbers_as_numbers(tmp_path: Path) -> None:
    export(table(), tmp_path / "a.xlsx")
    page = cells(tmp_path / "a.xlsx")
    heads = [cell.value for cell in page[1]]
    assert heads == ["words", "time (UTC)", "leakage (mbar/s)", "plc_time_ns"]
    assert page.freeze_panes == "A2"
    first = page[2]
    assert first[1].is_date
    assert first[1].value == datetime(2023, 11, 14, 22, 13, 20, 123_000)
    assert first[1].number_format == "yyyy-mm-dd hh:mm:ss.000"
    assert (first[2].value, first[2].data_type) == (-1.5, "n")
    assert (first[3].value, first[3].data_type) == (str(AT), "s")  # a number would lose digits
    assert (page[3][3].value, page[3][3].data_type) == (7, "n")
    assert [page[3][2].value, page[4][2].value, page[8][1].value] == [None] * 3


def test_text_never_becomes_a_formula_in_a_sheet(tmp_path: Path) -> None:
    export(table(), tmp_path / "a.xlsx")
    words = [row[0] for row in cells(tmp_path / "a.xlsx").iter_rows(min_row=2)]
    assert [cell.value for cell in words] == BAD
    assert {cell.data_type for cell in words[:-1]} == {"s"}


def test_text_never_becomes_a_formula_in_csv(tmp_path: Path) -> None:
    export(table(), tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    words = [row["words"] for row in rows]
    assert words == ["'=1+1", "'+1", "'-1", "'@SUM(A1)", "'\t=1", "plain", ""]
    assert rows[0]["leakage"] == "-1.5"  # a number is none


def test_parquet_keeps_everything_as_it_is(tmp_path: Path) -> None:
    export(table(), tmp_path / "a.parquet")
    assert parquet.read_table(tmp_path / "a.parquet").column("words").to_pylist() == BAD


def test_what_cannot_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="does not end in") as caught:
        export(table(), tmp_path / "a.ods")
    assert caught.value.hint == f"the ending decides the format, as in {tmp_path / 'a.csv'}"
    monkeypatch.setattr(sheet, "MOST_ROWS", 6)
    with pytest.raises(ConfigError, match="7 rows are more than a sheet holds"):
        export(table(), tmp_path / "a.xlsx")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.csv").touch()
    with pytest.raises(SourceError, match="already a file"):
        export(table(), tmp_path / "a.csv")


def test_the_history_of_alarms(tmp_path: Path) -> None:
    told = {"words": "leaks", "first_cycle": 3, "last_cycle": 9}
    episodes = [
        Episode("gone", AT),
        Episode(LEAK, AT, AT + 2 * NS, AT + 3 * NS, "ann", told, LEAK),
    ]
    made = history_table(episodes, {}, UNIT)
    assert [cell.value for cell in made.column("raised")] == [AT, AT]
    assert [cell.value for cell in made.column("cleared")] == [None, AT + 2 * NS]
    gone, one = made.drop_columns(["raised", "cleared", "acknowledged"]).to_pylist()
    assert (gone["alarm"], gone["active"], gone["priority"]) == ("gone", None, None)
    assert (one["active"], one["acknowledged_by"], one["evidence"]) == (2.0, "ann", "leaks")
    assert (one["first_cycle"], one["last_cycle"], one["asset_id"]) == (3, 9, UNIT.id)


def test_alarms_are_exported_from_their_database(run: Any, tmp_path: Path) -> None:  # noqa: F811
    begun(tmp_path / "alarms.sqlite").close()
    assert run("export", "-o", "h.xlsx") == "1 alarms in h.xlsx\n"
    page = cells(tmp_path / "h.xlsx")
    values = dict(
        zip([cell.value for cell in page[1]], [cell.value for cell in page[2]], strict=True)
    )
    assert (values["alarm"], values["priority"]) == (LEAK, "medium")
    assert values["raised (UTC)"] == datetime(2001, 9, 9, 1, 46, 45)
    assert values["cleared (UTC)"] is None
    assert values["action"].startswith("Look at hoses")
    assert run("export", "-o", "s.csv", "--standing") == "1 alarms in s.csv\n"
    with (tmp_path / "s.csv").open(encoding="utf-8", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["alarm"], row["state"], row["asset_id"]) == (LEAK, "unacknowledged", UNIT.id)
    assert run("export", "-o", "none.csv", "--days", "1") == "0 alarms in none.csv\n"
