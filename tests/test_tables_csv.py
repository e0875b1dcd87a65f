"""CSV as PLC tools write it: what is taken, and where what is bad is named or marked."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from table_rows import AMBIENT, MARK, REFUSE, SMALL, taken, written

from twin.errors import ConfigError, SourceError, TwinError
from twin.quality import Quality
from twin.settings import Document
from twin.signals import Command, Reported
from twin.tables import csv_file
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

FULL = """# exported by hand
time_s;sequence;suction;blow_off;pressure_mbar;supply_bar;quality
0,000;7;0;0;1013,25;5,5;0
0,001;8;1;0;1000,5;;0
0,002;9;1;1;900,25;5,4;8
"""


def test_columns_come_in_si(tmp_path: Path) -> None:
    rows = taken(written(tmp_path, FULL))
    assert rows["time_ns"].tolist() == [0, 1_000_000, 2_000_000]
    assert rows["host_ns"].tolist() == rows["time_ns"].tolist()
    assert rows["sequence"].tolist() == [7, 8, 9]
    assert rows["commands"].tolist() == [0, Command.SUCTION, Command.SUCTION | Command.BLOW_OFF]
    assert rows["pressure"].tolist() == [101_325.0, 100_050.0, 90_025.0]
    assert rows["quality"].tolist() == [0, 0, Quality.OUT_OF_RANGE]
    np.testing.assert_array_equal(rows["supply"], np.float32([5.5e5, np.nan, 5.4e5]))


@pytest.mark.parametrize(
    "text",
    [
        SMALL.replace(",", ";"),
        SMALL.replace(",", ";").replace(".", ","),
        SMALL.replace("\n", "\r\n"),
        SMALL.replace("\n", "\r"),
        SMALL.rstrip("\n"),
        "\ufeff" + SMALL,
        "# a\n\n  # b; c\n" + SMALL.replace("\n", "\n# d\n \n"),
        SMALL.replace(",", " ,\t "),
        '"' + SMALL.strip().replace(",", '","').replace("\n", '"\n"') + '"\n',
        SMALL.replace("\n", ",\n"),
        SMALL.replace("\n", ',"a, b ""c"""\n'),
        SMALL.replace("1000.5", "+1.0005E3").replace("1013\n", "1013.\n"),
    ],
    ids=range(12),
)
def test_dialects_say_the_same(tmp_path: Path, text: str) -> None:
    rows = taken(written(tmp_path, text))
    assert rows.tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()


@pytest.mark.parametrize(
    ("column", "of"),
    [
        ("pressure_pa", lambda mbar: mbar * 100),
        ("vacuum_mbar", lambda mbar: AMBIENT / 100 - mbar),
        ("vacuum_pa", lambda mbar: AMBIENT - mbar * 100),
    ],
)
def test_pressure_however_it_is_counted(
    tmp_path: Path, column: str, of: Callable[[float], float]
) -> None:
    text = SMALL.replace("pressure_mbar", column)
    for mbar in ("1013.25", "1000.5", "900.25", "1013\n"):
        text = text.replace(mbar, f"{of(float(mbar))}" + "\n" * mbar.count("\n"))
    expected = taken(written(tmp_path, SMALL, "u.csv"))
    assert taken(written(tmp_path, text)).tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("column", "text", "ns"),
    [
        ("time_s", "1767225600.123456789", 1_767_225_600_123_456_789),
        ("time_s", "-0.000000001", -1),
        ("time_s", "0.30000000000000004", 300_000_000),
        ("time_s", "1.5e-3", 1_500_000),
        ("time_s", "0.12345678850000000000001", 123_456_789),
        ("time_ms", "1767225600123.456789", 1_767_225_600_123_456_789),
        ("time_us", "1767225600123456.7894", 1_767_225_600_123_456_789),
        ("time_ns", "9223372036854775807", 2**63 - 1),
        ("time_ns", "-9223372036854775808", -(2**63)),
        ("time_ns", "12.0", 12),
    ],
)
def test_time_is_exact_to_the_nanosecond(tmp_path: Path, column: str, text: str, ns: int) -> None:
    row = taken(written(tmp_path, f"{column},suction,blow_off,pressure_pa\n{text},0,0,1\n"))
    assert row["time_ns"].tolist() == [ns]


def test_other_names_are_mapped(tmp_path: Path) -> None:
    _, end, rows = SMALL.partition("\n")
    path = written(tmp_path, '"Zeit [ms]",Saugen,blow_off,"Druck, abs"' + end + rows)
    document = Document.parse(
        """[import.columns]
time_ms = "Zeit [ms]"
suction = "Saugen"
pressure_mbar = "Druck, abs"
""",
        "c.toml",
    )
    rows = taken(path, document.section(ImportSettings, "import"))
    assert rows.tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()


def test_a_mapping_of_an_unknown_column_is_refused_at_its_line() -> None:
    document = Document.parse('[import]\n[import.columns]\npresure_mbar = "p"\n', "c.toml")
    with pytest.raises(ConfigError, match=r"c\.toml:3: import\.columns\.presure_mbar"):
        document.section(ImportSettings, "import")


def test_columns_not_taken_are_named(tmp_path: Path) -> None:
    text = SMALL.replace("\n", ",a,,b\n").replace("mbar,a,,b", "mbar,torque,,time_MS")
    table = open_table(written(tmp_path, text), REFUSE, AMBIENT)
    assert table.ignored == ("torque", "time_MS")
    assert len(taken(table.path)) == 4


# --- no table at all ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "what"),
    [
        ("suction,blow_off,pressure_pa", "no column time_s or time_ms or time_us or time_ns"),
        ("time_s,blow_off,pressure_pa", "no column suction;"),
        ("time_s,suction,pressure_pa", "no column blow_off;"),
        (
            "time_s,suction,blow_off",
            "no column pressure_mbar or pressure_pa or pressure_bar or pressure or vacuum_mbar or",
        ),
        ("time_s,time_ms,suction,blow_off,pressure_pa", "only one of .*'time_s', 'time_ms'"),
        ("time_s,suction,blow_off,pressure_pa,vacuum_pa", "only one of .*'pressure_pa', 'vac"),
        ("time_s,suction,suction,blow_off,pressure_pa", "column 'suction' stands there 2 times"),
        ("time_s|suction|blow_off|pressure_pa", r"the columns are 'time_s\|suction"),
    ],
)
def test_the_header_must_name_each_column_once(tmp_path: Path, header: str, what: str) -> None:
    path = written(tmp_path, f"# a\n\n{header}\n0,0,0,0,0\n")
    with pytest.raises(SourceError, match=rf"t\.csv:3: .*{what}") as caught:
        open_table(path, MARK, AMBIENT)
    assert caught.value.hint


def test_a_mapped_name_must_be_there(tmp_path: Path) -> None:
    settings = ImportSettings(columns={"supply_bar": "p0"})
    with pytest.raises(SourceError, match=r"t\.csv:1: no column 'p0', which \[import\.columns\]"):
        open_table(written(tmp_path, SMALL), settings, AMBIENT)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "no header row"),
        (b"# only\n\n", "no header row"),
        (SMALL.encode("utf-16-le"), ":1: this is no text"),
        (b"x" * 3_000_000, "a line of more than 1 MiB"),
        (SMALL.partition("\n")[0].encode(), "t.csv:1: no row follows"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes, what: str) -> None:
    with pytest.raises(SourceError, match=what):
        taken(written(tmp_path, content), MARK)


@pytest.mark.parametrize("name", ["no.csv", "no.parquet", "."])
def test_what_cannot_be_opened_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.csv").mkdir()
    path = tmp_path / ("folder.csv" if name == "." else name)
    with pytest.raises(SourceError, match="cannot be read"):
        open_table(path, REFUSE, AMBIENT)


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"t\.ods") as caught:
        open_table(written(tmp_path, SMALL, "t.ods"), REFUSE, AMBIENT)
    assert ".csv, .txt, .tsv, .xlsx, .parquet" in caught.value.hint


# --- bad input ----------------------------------------------------------------------------------

TABLE = """# a comment
time_ms,sequence,suction,blow_off,pressure_mbar,supply_bar,quality,host_ns

0,10,0,0,1013,5.5,0,100
1,11,1,0,1000,5.5,0,200
# another
2,12,1,0,900,5.5,0,300
3,13,1,0,800,5.5,0,400
"""
BAD_ROW = "2,12,1,0,900,5.5,0,300"


def _damaged(column: str, cell: str) -> str:
    names = TABLE.splitlines()[1].split(",")
    cells = BAD_ROW.split(",")
    cells[names.index(column)] = cell
    return TABLE.replace(BAD_ROW, ",".join(cells))


BAD_CELLS = [
    ("time_ms", "abc", "'abc' is not a time"),
    ("time_ms", "", "the cell is empty"),
    ("time_ms", "nan", "'nan' is not a time"),
    ("time_ms", "1e999999999", "is not a time"),
    ("time_ms", "1_0", "is not a time"),
    ("time_ms", "١", "is not a time"),
    ("sequence", "1.5", "'1.5' is not a whole number"),
    ("sequence", "", "the cell is empty"),
    ("suction", "2", "'2' is not 0 or 1"),
    ("suction", "on", "'on' is not 0 or 1"),
    ("blow_off", "nan", "'nan' is not 0 or 1"),
    ("blow_off", "", "the cell is empty"),
    ("pressure_mbar", "", "the cell is empty"),
    ("pressure_mbar", "NaN", "'NaN' is not a finite number"),
    ("pressure_mbar", "-inf", "'-inf' is not a finite number"),
    ("pressure_mbar", "1e39", "'1e39' is not a finite number"),
    ("pressure_mbar", "1.79e308", "'1.79e308' is not a finite number"),
    ("supply_bar", "-1.79e308", "'-1.79e308' is not a finite number"),
    ("pressure_mbar", "12 3", "'12 3' is not a finite number"),
    ("pressure_mbar", "0x10", "is not a finite number"),
    ("supply_bar", "nan", "is not a finite number"),
    ("supply_bar", "-", "'-' is not a finite number"),
    ("quality", "300", "'300' is not a sum of quality flags"),
    ("quality", "-1", "is not a sum of quality flags"),
    ("host_ns", "x", "'x' is not a whole number"),
]


@pytest.mark.parametrize(("column", "cell", "what"), BAD_CELLS)
def test_a_bad_cell_is_refused_at_its_line_and_column(
    tmp_path: Path, column: str, cell: str, what: str
) -> None:
    path = written(tmp_path, _damaged(column, cell))
    with pytest.raises(SourceError) as caught:
        taken(path, ImportSettings(jumps="mark", gaps="mark"))
    assert str(caught.value).startswith(f"{path}:7: column {column!r}: ")
    assert what in str(caught.value)
    assert 'values = "mark"' in caught.value.hint


@pytest.mark.parametrize(("column", "cell"), [(column, cell) for column, cell, _ in BAD_CELLS])
def test_a_bad_cell_is_kept_and_marked(tmp_path: Path, column: str, cell: str) -> None:
    settings = ImportSettings(values="mark")
    rows, whole = (
        taken(written(tmp_path, _damaged(column, cell)), settings),
        taken(written(tmp_path, TABLE, "u.csv")),
    )
    assert rows["quality"].tolist() == [0, 0, Quality.BAD, 0]
    expected = whole.copy()
    expected["quality"][2] = Quality.BAD
    if column == "pressure_mbar":
        expected["pressure"][2] = np.nan
    if column == "supply_bar":
        expected["supply"][2] = np.nan
    if column == "host_ns":
        expected["host_ns"][2] = expected["time_ns"][2]
    assert rows.tobytes() == expected.tobytes()  # time, sequence and commands go on as before


def test_commands_of_bad_cells_stay_as_they_were(tmp_path: Path) -> None:
    text = "time_ms,suction,blow_off,pressure_pa\n0,?,1,1\n1,1,0,1\n2,?,?,1\n3,0,1,1\n4,?,?,1\n"
    rows = taken(written(tmp_path, text), ImportSettings(values="mark"))
    assert rows["commands"].tolist() == [3, 1, 1, 2, 2]


def test_times_before_the_first_known_one_are_counted_back(tmp_path: Path) -> None:
    text = "time_ms,suction,blow_off,pressure_pa\n?,0,0,1\n?,0,0,1\n20,0,0,1\n30,0,0,1\n"
    rows = taken(written(tmp_path, text), ImportSettings(values="mark"))
    assert rows["time_ns"].tolist() == [0, 10_000_000, 20_000_000, 30_000_000]


def test_times_between_known_ones_lie_between_them(tmp_path: Path) -> None:
    text = _ticks(0, "?", 0.2, 1, 2, 3, "?", "?", 3.3, 5, "?")
    rows = taken(written(tmp_path, text), ImportSettings(values="mark", gaps="mark"))
    expected = [0, 0.1, 0.2, 1, 2, 3, 3.1, 3.2, 3.3, 5, 6]
    assert rows["time_ns"].tolist() == [round(ms * 1e6) for ms in expected]


def test_rows_without_any_time_are_refused(tmp_path: Path) -> None:
    text = "time_ms,suction,blow_off,pressure_pa\n?,0,0,1\n?,0,0,1\n"
    with pytest.raises(SourceError, match=r"t\.csv:2: none of 2 rows .* has a time"):
        taken(written(tmp_path, text), MARK)
    with pytest.raises(SourceError, match=r"t\.csv:2: column 'time_ms': '\?' is not a time"):
        taken(written(tmp_path, text), REFUSE)


@pytest.mark.parametrize("row", ["2,12,1,0,90", "2,12,1,0,900,5.5,0,300,1", "2;12", "x"])
def test_a_row_with_another_number_of_cells(tmp_path: Path, row: str) -> None:
    path = written(tmp_path, TABLE.replace(BAD_ROW, row))
    with pytest.raises(SourceError, match=rf":7: {row.count(',') + 1} cells under 8 columns"):
        taken(path)
    rows = taken(path, ImportSettings(values="mark"))
    assert rows["quality"].tolist() == [0, 0, Quality.BAD, 0]
    assert rows["time_ns"].tolist() == [0, 1_000_000, 2_000_000, 3_000_000]
    assert np.isnan(rows["pressure"]).tolist() == [False, False, True, False]


@pytest.mark.parametrize("stray", ['2,12,1,0,"900,5.5,0,300', '"2,12,1,0,900,5.5,0,300'])
def test_a_stray_quotation_mark_takes_no_other_row_along(tmp_path: Path, stray: str) -> None:
    path = written(tmp_path, TABLE.replace(BAD_ROW, stray))
    rows = taken(path, ImportSettings(values="mark"))
    assert rows["quality"].tolist() == [0, 0, Quality.BAD, 0]


@pytest.mark.parametrize("cell", ["1", "0.5", "-3"])
def test_time_that_does_not_go_forward(tmp_path: Path, cell: str) -> None:
    path = written(tmp_path, _damaged("time_ms", cell))
    with pytest.raises(SourceError) as caught:
        taken(path, ImportSettings(values="mark", gaps="mark"))
    assert f":7: column 'time_ms': '{cell}' does not go forward" in str(caught.value)
    assert 'jumps = "mark"' in caught.value.hint
    rows = taken(path, ImportSettings(jumps="mark"))
    assert rows["quality"].tolist() == [0, 0, Quality.CLOCK, 0]
    assert rows["time_ns"][2] == float(cell) * 1_000_000


def test_a_sequence_that_goes_back_is_a_restart(tmp_path: Path) -> None:
    path = written(tmp_path, TABLE.replace("2,12,", "2,1,").replace("3,13,", "3,2,"))
    with pytest.raises(SourceError, match=":7: column 'sequence': '1' does not go forward"):
        taken(path)
    rows = taken(path, ImportSettings(jumps="mark"))
    assert rows["quality"].tolist() == [0, 0, Quality.RESTART, 0]
    assert rows["sequence"].tolist() == [10, 11, 1, 2]


def test_a_gap_in_the_sequence(tmp_path: Path) -> None:
    path = written(tmp_path, TABLE.replace("3,13,", "3,20,"))
    with pytest.raises(SourceError) as caught:
        taken(path, ImportSettings(values="mark", jumps="mark"))
    assert ":8: column 'sequence': 7 samples are missing before this row" in str(caught.value)
    assert 'gaps = "mark"' in caught.value.hint
    rows = taken(path, ImportSettings(gaps="mark"))
    assert rows["quality"].tolist() == [0, 0, 0, Quality.GAP]
    assert rows["sequence"].tolist() == [10, 11, 12, 20]


def _ticks(*times: float | str) -> str:
    rows = "".join(f"{time},0,0,1000\n" for time in times)
    return f"time_ms,suction,blow_off,pressure_mbar\n{rows}"


def test_a_gap_in_time_where_nothing_is_counted(tmp_path: Path) -> None:
    path = written(tmp_path, _ticks(0, 1, 2.4, 3, 4, 7, 8))
    with pytest.raises(SourceError) as caught:
        taken(path)
    assert ":7: column 'time_ms': 2 samples are missing before this row" in str(caught.value)
    assert "at a period of 1 ms" in str(caught.value)
    rows = taken(path, ImportSettings(gaps="mark"))
    assert rows["quality"].tolist() == [0, 0, 0, 0, 0, Quality.GAP, 0]
    assert rows["sequence"].tolist() == [0, 1, 2, 3, 4, 7, 8]


def test_the_period_can_be_said(tmp_path: Path) -> None:
    path = written(tmp_path, _ticks(0, 1, 2, 3, 7, 8))
    assert taken(path, ImportSettings(period_ms=4.0))["quality"].tolist() == [0] * 6
    rows = taken(path, ImportSettings(period_ms=0.5, gaps="mark"))
    assert rows["quality"].tolist() == [0, *[Quality.GAP] * 5]


def test_where_the_quality_says_it_nothing_is_refused(tmp_path: Path) -> None:
    text = """time_ms,sequence,suction,blow_off,pressure_mbar,quality
0,1,0,0,,64
1,2,0,0,,16
2,9,0,0,1000,1
1,10,0,0,1000,4
2,1,0,0,1000,2
"""
    rows = taken(written(tmp_path, text))
    assert rows["quality"].tolist() == [64, 16, 1, 4, 2]
    assert np.isnan(rows["pressure"]).tolist() == [True, True, False, False, False]


def test_the_first_bad_row_is_the_one_named(tmp_path: Path) -> None:
    text = _ticks(0, 1, 2, 3, 9, 10).replace("3,0,0,1000", "2,0,0,1000")  # stands still, then gap
    with pytest.raises(SourceError, match=":5: column 'time_ms'"):
        taken(written(tmp_path, text.replace("10,0", "10,?")))


@pytest.mark.parametrize("piece", [40, 61, 200, 5000])
def test_pieces_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int) -> None:
    rows = [f"{i},{i % 2},0,{1000 + i}" for i in range(300)]
    for row, text in ((100, "100,?,0,x"), (150, "150,1"), (200, "20,0,0,1"), (201, "230,0,0,1")):
        rows[row] = text
    header, _, _ = SMALL.partition("\n")
    text = "\n".join(["# a", header, *rows[:120], "# b", "", *rows[120:]])
    path = written(tmp_path, text)
    whole = taken(path, MARK)
    monkeypatch.setattr(csv_file, "_PIECE", piece)
    assert taken(path, MARK).tobytes() == whole.tobytes()
    for values, jumps, line in (("refuse", "mark", 103), ("mark", "refuse", 205)):
        settings = ImportSettings(values=values, jumps=jumps, gaps="mark")
        with pytest.raises(TwinError, match=rf"t\.csv:{line}: "):
            taken(path, settings)


def test_a_file_is_never_in_memory_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csv_file, "_PIECE", 1 << 16)
    rows = "".join(f"{i},0,0,1000\n" for i in range(50_000)) + "x\n"
    blocks = open_table(
        written(tmp_path, SMALL.partition("\n")[0] + "\n" + rows), REFUSE, AMBIENT
    ).blocks()
    assert 1000 < len(next(blocks)) < 10_000  # given long before the bad end is read
    with pytest.raises(SourceError, match=":50002: 1 cells"):
        list(blocks)


@pytest.mark.parametrize("kind", ["vacuum", "pressure"])
def test_a_column_in_bar_is_not_taken_as_mbar(tmp_path: Path, kind: str) -> None:
    bars = {"vacuum": (0.0, 0.71), "pressure": (1.013, 0.29)}[kind]
    rows = [f"{n / 1000},{int(n > 500)},0,{bars[n > 600]}" for n in range(2000)]
    path = tmp_path / "bar.csv"
    path.write_text("\n".join([f"time_s,suction,blow_off,{kind}_mbar", *rows]))
    ambient = 101_300.0
    with pytest.raises(SourceError, match="In which unit is it") as caught:
        list(open_table(path, ImportSettings(), ambient).blocks())
    assert f'{kind}_bar = "{kind}_mbar"' in caught.value.hint
    said = ImportSettings.model_validate({"columns": {f"{kind}_bar": f"{kind}_mbar"}})
    *_, block = open_table(path, said, ambient).blocks()
    assert block["pressure"][-1] == pytest.approx(30_300.0 if kind == "vacuum" else 29_000.0)


def _dead(folder: Path, column: str = "vacuum_mbar") -> Path:
    """A record of an ejector that draws nothing: 1 mbar of vacuum in 1.5 s of suction."""
    rows = [f"{n / 1000},{int(n > 500)},0,{float(n > 600)}" for n in range(2000)]
    path = folder / "dead.csv"
    path.write_text("\n".join([f"time_s,suction,blow_off,{column}", *rows]))
    return path


def test_a_record_of_a_dead_ejector_is_taken_once_its_unit_is_said(tmp_path: Path) -> None:
    path, ambient = _dead(tmp_path), 101_300.0
    with pytest.raises(SourceError, match="In which unit is it") as caught:
        list(open_table(path, ImportSettings(), ambient).blocks())
    assert 'under [import]: pressure_unit = "mbar"' in caught.value.hint
    said = ImportSettings.model_validate({"pressure_unit": "mbar"})
    *_, block = open_table(path, said, ambient).blocks()
    assert block["pressure"][-1] == pytest.approx(101_200.0)


def test_a_unit_other_than_the_columns_is_refused(tmp_path: Path) -> None:
    path = _dead(tmp_path, "vacuum_bar")
    said = ImportSettings.model_validate({"pressure_unit": "mbar"})
    with pytest.raises(ConfigError, match="is taken as vacuum_bar") as caught:
        open_table(path, said, 101_300.0)
    assert 'vacuum_mbar = "vacuum_bar"' in caught.value.hint


def test_what_an_ejector_reports_is_taken(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """time_ms,suction,blow_off,pressure_mbar,reported_air_saving,reported_part_present
        0,1,0,900,0,0
        1,1,0,400,1,1
        2,1,0,400,,
        3,0,0,400,0,1
        """.replace("        ", ""),
    )
    known = Reported.NOZZLE_KNOWN | Reported.PART_KNOWN
    on, part = Reported.NOZZLE, Reported.PART
    assert taken(path)["reported"].tolist() == [known | on, known | part, 0, known | part]


@pytest.mark.parametrize(
    ("header", "cell", "message"),
    [
        ("reported_nozzle", "2", "'2' is not 0 or 1"),
        ("flow_sl_min", "much", "'much' is not a finite number"),
    ],
)
def test_what_is_reported_is_checked(tmp_path: Path, header: str, cell: str, message: str) -> None:
    text = f"time_ms,suction,blow_off,pressure_mbar,{header}\n0,1,0,900,{cell}\n"
    with pytest.raises(SourceError, match=message):
        taken(written(tmp_path, text))


def test_two_columns_that_say_the_same_are_refused(tmp_path: Path) -> None:
    text = "time_ms,suction,blow_off,pressure_mbar,reported_nozzle,reported_air_saving\n"
    with pytest.raises(SourceError, match="say the same"):
        taken(written(tmp_path, text + "0,1,0,900,1,0\n"))
