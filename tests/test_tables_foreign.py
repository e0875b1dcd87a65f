"""Tables as people have them: dates, units, signs, encodings, sheets, and what PLC tools export."""

import tomllib
import zipfile
from collections.abc import Callable
from datetime import UTC, date, datetime, time, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pyarrow as pa
import pytest
import rigs
from command_line import twin
from openpyxl import Workbook
from pyarrow import parquet
from table_rows import AMBIENT, SMALL, taken, written

from twin import api, files
from twin.errors import ConfigError, SourceError
from twin.log.reader import open_log
from twin.signals import PASCAL, Command, Samples, joined
from twin.tables import reader
from twin.tables.excel_file import ExcelFile
from twin.tables.first_cells import Form, form_of
from twin.tables.likely import likely_columns
from twin.tables.preview import FIRST, HEIGHT, WIDTH, Preview
from twin.tables.reader import open_table
from twin.tables.settings import Column, ImportSettings, toml_string

DATA = Path(__file__).parent / "data"
BEGIN = datetime(2026, 3, 1, 12, tzinfo=ZoneInfo("Europe/Berlin"))
BEGIN_NS = int(BEGIN.timestamp()) * 1_000_000_000


def settings(columns: dict[str, Any] | None = None, **said: Any) -> ImportSettings:
    return ImportSettings.model_validate({"columns": columns or {}, **said})


def times(folder: Path, *cells: str, **said: Any) -> list[int]:
    rows = "".join(f"{cell};0;0;1000\n" for cell in cells)
    path = written(folder, "time;suction;blow_off;pressure_mbar\n" + rows)
    return taken(path, settings(**said))["time_ns"].tolist()  # type: ignore[no-any-return]


# --- dates and times ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "ms"),
    [
        ("2026-03-01T12:00:00.250+01:00", 250),
        ("2026-03-01T11:00:00.250Z", 250),
        ("2026-03-01 11:00:00.250 +0000", 250),
        ("2026-03-01 12:00:00.250", 250),
        ("2026-03-01 12:00", 0),
        ("2026/03/01 12:00:01", 1000),
        ("01.03.2026 12:00:00,250", 250),
        ("1.3.2026 12:00:00,25", 250),
        ("01.03.2026 12:00:00:250", 250),
        ("134168364002500000", 250),
    ],
)
def test_a_date_and_time_however_it_is_written(tmp_path: Path, cell: str, ms: int) -> None:
    read = times(tmp_path, cell, time_zone="Europe/Berlin")
    assert read == [BEGIN_NS + ms * 1_000_000]


def test_a_time_is_exact_to_the_nanosecond(tmp_path: Path) -> None:
    read = times(tmp_path, "2026-03-01T11:00:00.123456789Z")
    assert read == [BEGIN_NS + 123_456_789]


def test_a_time_without_a_zone_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="say no time zone") as caught:
        times(tmp_path, "2026-03-01 12:00:00")
    assert 'time_zone = "Europe/Berlin"' in caught.value.hint
    assert times(tmp_path, "12:00:00.5", "12:00:00.6")[1] == 43_200_600_000_000  # of no day


def test_which_comes_first_is_not_guessed(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="can only mean one"):
        times(tmp_path, "03/04/2026 12:00:00", time_zone="UTC")
    april, march = (
        times(tmp_path, "3/4/2026 12:00:00", time_zone="UTC", date_order=order)[0]
        for order in ("day", "month")
    )
    assert april == int(datetime(2026, 4, 3, 12, tzinfo=UTC).timestamp()) * 10**9
    assert march == int(datetime(2026, 3, 4, 12, tzinfo=UTC).timestamp()) * 10**9


@pytest.mark.parametrize("cell", ["29.03.2026 02:30:00", "25.10.2026 02:30:00"])
def test_an_hour_that_is_there_never_or_twice_is_refused(tmp_path: Path, cell: str) -> None:
    with pytest.raises(SourceError, match=rf"t\.csv:2: column 'time': '{cell}' is not"):
        times(tmp_path, cell, time_zone="Europe/Berlin")
    assert times(tmp_path, cell, time_zone="UTC")


def test_a_date_in_a_column_of_its_own(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "Datum;Uhrzeit;suction;blow_off;pressure_mbar\n"
        "01.03.2026;12:00:00,000;0;0;1000\n01.03.2026;12:00:00,010;0;0;1000\n",
    )
    how = settings({"date": "Datum", "time": "Uhrzeit"}, time_zone="Europe/Berlin")
    assert taken(path, how)["time_ns"].tolist() == [BEGIN_NS, BEGIN_NS + 10_000_000]


def test_a_zone_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="'Mars/Base' is no time zone"):
        settings(time_zone="Mars/Base")


def test_instants_of_parquet(tmp_path: Path) -> None:
    columns = {"suction": [0, 1], "blow_off": [0, 0], "pressure_mbar": [1000.0, 900.0]}
    path = tmp_path / "t.parquet"
    for stamps in (
        pa.array([BEGIN.astimezone(UTC), BEGIN.astimezone(UTC) + timedelta(milliseconds=5)]),
        pa.array([BEGIN.replace(tzinfo=None), BEGIN.replace(tzinfo=None, microsecond=5000)]),
    ):
        parquet.write_table(pa.table({"time": stamps, **columns}), path)
        read = taken(path, settings(time_zone="Europe/Berlin"))["time_ns"]
        assert read.tolist() == [BEGIN_NS, BEGIN_NS + 5_000_000]


# --- units --------------------------------------------------------------------------------------


def pressures(folder: Path, number: float | str, name: str = "p", **source: Any) -> float:
    path = written(folder, f"time_ms;suction;blow_off;{name}\n0;0;0;{number}\n")
    column = source.pop("column", "pressure")
    return float(taken(path, settings({column: {"name": name, **source}}))["pressure"][0])


@pytest.mark.parametrize("unit", PASCAL)
def test_a_pressure_in_each_unit(tmp_path: Path, unit: Any) -> None:
    number = 40_000.0 / PASCAL[unit]
    assert pressures(tmp_path, number, unit=unit) == pytest.approx(40_000.0, rel=1e-6)
    assert pressures(tmp_path, number, f"p [{unit}]") == pytest.approx(40_000.0, rel=1e-6)
    vacuum = pressures(tmp_path, number, unit=unit, column="vacuum")
    assert vacuum == pytest.approx(AMBIENT - 40_000.0, rel=1e-6)


@pytest.mark.parametrize(
    ("source", "number"),
    [
        ({"unit": "mbar", "reference": "gauge"}, -600),
        ({"unit": "mbar", "reference": "vacuum", "scale": -1}, -600),
        ({"column": "vacuum_mbar", "scale": -1}, -600),
        ({"column": "vacuum_bar", "scale": 0.001}, 600),
        ({"unit": "kPa", "reference": "gauge", "offset": -1}, -59),
        ({"unit": "mbar", "reference": "gauge", "signal": [4, 20], "range": [0, -1000]}, 13.6),
        ({"unit": "mbar", "reference": "gauge", "signal": [0, 10], "range": [0, -1000]}, 6),
        ({"unit": "bar", "reference": "gauge", "signal": [0, 27648], "range": [0, -1]}, 16588.8),
    ],
)
def test_signs_scales_and_transmitters(
    tmp_path: Path, source: dict[str, Any], number: float
) -> None:
    assert pressures(tmp_path, number, **source) == pytest.approx(AMBIENT - 60_000.0, rel=1e-6)


def test_a_supply_in_another_unit(tmp_path: Path) -> None:
    path = written(tmp_path, SMALL.replace("\n", ",80\n").replace("mbar,80", "mbar,p0 [psi]"))
    supply = taken(path, settings({"supply": "p0 [psi]"}))["supply"]
    np.testing.assert_allclose(supply, 80 * PASCAL["psi"], rtol=1e-6)
    how = settings({"supply": {"name": "p0 [psi]", "unit": "psi", "reference": "absolute"}})
    np.testing.assert_allclose(taken(path, how)["supply"], 80 * PASCAL["psi"] - AMBIENT, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "columns", "asked", "line"),
    [
        ("p", {"pressure": "p"}, "in which unit column 'p' is", '"p", unit = "..."'),
        ("p [kPa]", {"vacuum_mbar": "p [kPa]"}, "its name says kPa", 'unit = "kPa"'),
        ("p [mA]", {"pressure": "p [mA]"}, "is in mA, and nothing says", "signal = [4, 20]"),
        ("p (V)", {"vacuum": "p (V)"}, "is in V, and nothing says", "signal = [0, 10]"),
    ],
)
def test_a_unit_that_is_not_clear_is_asked_for(
    tmp_path: Path, name: str, columns: dict[str, Any], asked: str, line: str
) -> None:
    path = written(tmp_path, f"time_ms;suction;blow_off;{name}\n0;0;0;1\n")
    with pytest.raises(SourceError, match=asked) as caught:
        open_table(path, settings(columns), AMBIENT)
    assert line in caught.value.hint


@pytest.mark.parametrize(
    ("columns", "what"),
    [
        ({"vacuum_mbar": {"name": "p", "unit": "bar"}}, "is taken as vacuum_mbar"),
        ({"vacuum_mbar": {"name": "p", "reference": "gauge"}}, "counts from ambient"),
        ({"pressure_mbar": "p", "time_ms": {"name": "time_ms", "scale": 2}}, "time_ms cannot"),
    ],
)
def test_what_contradicts_itself_is_refused(
    tmp_path: Path, columns: dict[str, Any], what: str
) -> None:
    path = written(tmp_path, "time_ms;suction;blow_off;p\n0;0;0;1\n")
    with pytest.raises(ConfigError, match=what):
        open_table(path, settings(columns), AMBIENT)


@pytest.mark.parametrize(
    "source",
    [
        {"scale": 0},
        {"signal": [4, 20]},
        {"signal": [4, 4], "range": [0, 1]},
        {"signal": [4, 20], "range": [0, 1], "scale": 2},
    ],
)
def test_a_scale_that_says_nothing_is_refused(source: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"scale|signal"):
        settings({"pressure": {"name": "p", **source}})


def cycle(folder: Path, number: Callable[[float], float], column: str = "p") -> Path:
    """Two seconds of a suction, with ``number`` of the vacuum (mbar) in a column."""
    vacuum = [0.0] * 60 + [700.0] * 100 + [-40.0] * 10 + [0.0] * 30
    rows = [f"{10 * i};{int(30 < i < 160)};0;{number(v)}" for i, v in enumerate(vacuum)]
    return written(folder, "\n".join([f"time_ms;suction;blow_off;{column}", *rows]))


@pytest.mark.parametrize(
    ("column", "number", "what", "line"),
    [
        ("vacuum_mbar", lambda v: -v, "700 mbar above ambient", 'reference = "gauge"'),
        ("vacuum_mbar", lambda v: v / 1000, "never more than 0.7 mbar", 'vacuum_bar = "vacuum'),
        ("vacuum_mbar", lambda v: 100 * v, "mbar absolute, which nothing", 'vacuum_pa = "vacuum'),
        ("pressure_mbar", lambda v: -v, "comes down to -700 mbar", 'reference = "gauge"'),
        ("pressure_mbar", lambda v: (1013 - v) * 100, "mostly above 1100", 'pressure_pa = "press'),
        ("pressure_bar", lambda v: (1013 - v) / 10, "mostly above 1100", 'unit = "kPa"'),
    ],
)
def test_a_pressure_that_cannot_be_is_asked_about(
    tmp_path: Path, column: str, number: Callable[[float], float], what: str, line: str
) -> None:
    path = cycle(tmp_path, number, column)
    with pytest.raises(SourceError, match="In which unit is it") as caught:
        taken(path)
    assert what in str(caught.value)
    assert line in caught.value.hint
    unit = column.rpartition("_")[2].replace("pa", "Pa")
    assert len(taken(path, settings(pressure_unit=unit))) == 200  # a person insists


def test_a_pressure_that_can_be_is_taken(tmp_path: Path) -> None:
    assert taken(cycle(tmp_path, lambda v: v, "vacuum_mbar"))["pressure"].min() < 40_000.0
    assert taken(cycle(tmp_path, lambda v: 1013 - v, "pressure_mbar"))["pressure"].min() < 40_000.0


def test_an_ejector_without_blow_off(tmp_path: Path) -> None:
    path = written(tmp_path, SMALL.replace("blow_off", "x"))
    with pytest.raises(SourceError, match="no column blow_off") as caught:
        open_table(path, settings(), AMBIENT)
    assert "no_blow_off = true" in caught.value.hint
    rows = taken(path, settings(no_blow_off=True))
    assert rows["commands"].tolist() == [0, Command.SUCTION, Command.SUCTION, 0]
    with pytest.raises(ConfigError, match="no_blow_off says there is none"):
        open_table(written(tmp_path, SMALL), settings(no_blow_off=True), AMBIENT)


def test_a_misspelt_name_in_the_file_is_guessed_at(tmp_path: Path) -> None:
    path = written(tmp_path, SMALL.replace("pressure_mbar", "Unterdruck"))
    with pytest.raises(SourceError, match="no column 'Unterdrck'") as caught:
        open_table(path, settings({"vacuum_mbar": "Unterdrck"}), AMBIENT)
    assert caught.value.hint.startswith("did you mean 'Unterdruck'?")


# --- encodings and layouts ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("encoding", "note"),
    [("utf-8", ""), ("utf-8-sig", ""), ("cp1252", "read as cp1252"), ("utf-16", "read as UTF-16")],
)
def test_an_encoding_is_said(tmp_path: Path, encoding: str, note: str) -> None:
    content = SMALL.replace("pressure_mbar", "Gehäusedruck").encode(encoding)
    how = settings({"pressure_mbar": "Gehäusedruck"})
    path = written(tmp_path, content)
    assert taken(path, how).tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()
    notes = " ".join(open_table(path, how, AMBIENT).notes)
    assert note in notes
    assert bool(note) == bool(notes)


def test_an_encoding_that_no_byte_tells_can_be_said(tmp_path: Path) -> None:
    path = written(tmp_path, SMALL.encode("utf-16-le"))
    with pytest.raises(SourceError, match="this is no text") as caught:
        taken(path)
    assert 'encoding = "utf-16-le"' in caught.value.hint
    assert len(taken(path, settings(encoding="utf-16-le"))) == 4


def test_what_stands_before_the_header_is_not_read(tmp_path: Path) -> None:
    path = written(tmp_path, "Rig;4\nBegin;12:00;;\n\n" + SMALL.replace(",", ";"))
    assert taken(path).tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()
    assert any("header is line 4" in note for note in open_table(path, settings(), AMBIENT).notes)


@pytest.mark.parametrize(("no", "yes"), [("FALSE", "true"), ("FALSCH", "WAHR")])
def test_tabs_and_words_for_bits(tmp_path: Path, no: str, yes: str) -> None:
    text = SMALL.replace(",0,", f",{no},").replace(",1,", f",{yes},")
    for sign in ("\t", " ", ";"):
        path = written(tmp_path, text.replace(",", sign).replace(".", ","))
        assert taken(path).tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()


TRACES: dict[str, ImportSettings] = {
    "trace_twincat_scope.txt": settings(
        {"vacuum_mbar": "rVacuum", "suction": "bSuction", "blow_off": "bBlowOff"}
    ),
    "trace_twincat_scope_shared.csv": settings(
        {"vacuum_mbar": "rVacuum", "suction": "bSuction", "blow_off": "bBlowOff"}
    ),
    "trace_codesys.txt": settings(
        {
            "time_ms": "Cycle",
            "vacuum_mbar": "PLC_PRG.rVacuum",
            "suction": "PLC_PRG.xSuction",
            "blow_off": "PLC_PRG.xBlowOff",
        }
    ),
    "trace_s7.csv": settings(
        {
            "time_ms": "Zeit (relativ) [ms]",
            "pressure": {"name": '"Ejektor_DB".Unterdruck [mbar]', "reference": "gauge"},
            "suction": '"Ejektor_DB".Saugen',
            "blow_off": '"Ejektor_DB".Abblasen',
        }
    ),
}


def trace(name: str) -> Samples:
    return taken(DATA / name, TRACES[name])


@pytest.mark.parametrize("name", TRACES)
def test_exports_of_plc_tools_are_read(name: str) -> None:
    rows = trace(name)
    assert len(rows) == 300
    assert np.diff(rows["time_ns"]).tolist() == [10_000_000] * 299
    suction = np.flatnonzero(rows["commands"] == Command.SUCTION)
    blow_off = np.flatnonzero(rows["commands"] == Command.BLOW_OFF)
    assert (suction[0], suction[-1], blow_off[0], blow_off[-1]) == (30, 149, 150, 179)
    assert rows["pressure"].tobytes() == trace("trace_twincat_scope.txt")["pressure"].tobytes()
    assert rows["pressure"].min() == pytest.approx(AMBIENT - 70_000.0, abs=1.0)


@pytest.mark.parametrize("program", ["CODESYS Trace", "S7-1500, S7-1200"])
def test_the_page_says_which_exports_were_never_tried_with_a_real_file(program: str) -> None:
    """Take this away for a program once ``tests/data`` has a file that it wrote."""
    assert "None was written by the program itself" in (DATA / "README.md").read_text("utf-8")
    page = (DATA.parents[1] / "docs" / "csv.md").read_text(encoding="utf-8")
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {program} |"))
    assert "Tested with a file that this project wrote itself" in row
    assert "not yet with an export of the program" in row


def test_a_scope_file_with_whole_time_stamps(tmp_path: Path) -> None:
    lines = (DATA / "trace_twincat_scope.txt").read_text(encoding="utf-8-sig").splitlines()
    whole = [
        "\t".join(
            str(134_168_364_000_000_000 + int(cell) * 10_000) if at % 2 == 0 else cell
            for at, cell in enumerate(line.split("\t"))
        )
        if line[:1].isdigit()
        else line
        for line in lines
    ]
    name = "trace_twincat_scope.txt"
    rows = taken(written(tmp_path, "\n".join(whole), name), TRACES[name])
    assert rows["time_ns"][0] == BEGIN_NS
    assert rows["pressure"].tobytes() == trace(name)["pressure"].tobytes()


def test_scope_channels_that_are_not_sampled_together_are_refused(tmp_path: Path) -> None:
    text = (DATA / "trace_twincat_scope.txt").read_text(encoding="utf-8-sig")
    path = written(tmp_path, text.replace("\n0\t0,00\t0\t", "\n0\t0,00\t5\t"), "t.txt")
    with pytest.raises(SourceError, match="begin at 2 different times"):
        open_table(path, TRACES["trace_twincat_scope.txt"], AMBIENT)


def test_scope_writes_the_same_begin_in_more_than_one_way(tmp_path: Path) -> None:
    name = "trace_twincat_scope.txt"
    text = (DATA / name).read_text(encoding="utf-8-sig")
    path = written(tmp_path, text.replace("\n0\t0,00\t0\t", "\n0.0\t0,00\t0\t"), name)
    assert taken(path, TRACES[name]).tobytes() == trace(name).tobytes()


def test_scope_channels_of_other_sample_times_are_refused() -> None:
    how = settings({"vacuum_mbar": "rValve", "suction": "bSuction", "blow_off": "bBlowOff"})
    with pytest.raises(SourceError, match="are sampled every 10 and 5 ms"):
        open_table(DATA / "trace_twincat_scope_shared.csv", how, AMBIENT)


def test_a_table_whose_first_column_is_called_name_is_none_of_scope(tmp_path: Path) -> None:
    path = written(tmp_path, "Name" + "\nrig 4".join(f",{line}" for line in SMALL.splitlines()))
    assert taken(path).tobytes() == taken(written(tmp_path, SMALL, "u.csv")).tobytes()


@pytest.mark.parametrize(
    ("ending", "advice"),
    [
        (".svdx", "export one in TwinCAT Scope"),
        (".ttrecx", "export one in TIA Portal"),
        (".trace", "export one in CODESYS"),
        (".xls", "save it as"),
        (".mcap", "a log needs no import"),
    ],
)
def test_of_a_file_that_is_no_table_it_is_said_what_to_do(
    tmp_path: Path, ending: str, advice: str
) -> None:
    with pytest.raises(ConfigError, match="cannot tell what it is") as caught:
        open_table(written(tmp_path, b"PK", f"t{ending}"), settings(), AMBIENT)
    assert advice in caught.value.hint


@pytest.mark.parametrize("name", ["trace_s7.csv", "trace_codesys.txt"])
def test_what_a_header_may_mean_is_proposed_and_can_be_pasted(name: str) -> None:
    with pytest.raises(SourceError, match="no column time_s") as caught:
        open_table(DATA / name, settings(), AMBIENT)
    proposed = tomllib.loads(caught.value.hint.partition("[import.columns]\n  ")[2])
    time = {"time_ms"} if name == "trace_s7.csv" else set()  # a count of cycles has no unit
    assert proposed.keys() == {"vacuum", "suction", "blow_off"} | time
    written_by_hand = {source.name for source in TRACES[name].columns.values()}
    names = {one["name"] if isinstance(one, dict) else one for one in proposed.values()}
    assert names <= written_by_hand


def test_a_line_that_is_proposed_is_toml_whatever_the_name(tmp_path: Path) -> None:
    for name in ('"DB".p', "it's", "\"a\" and 'b'", "a\\b"):
        assert tomllib.loads(f"x = {toml_string(name)}") == {"x": name}
    how = TRACES["trace_s7.csv"]
    vacuum = settings({**{key: source.name for key, source in how.columns.items()}})
    columns = {**vacuum.columns, Column.VACUUM: vacuum.columns[Column.PRESSURE]}
    del columns[Column.PRESSURE]
    with pytest.raises(SourceError, match="In which unit is it") as caught:
        taken(DATA / "trace_s7.csv", vacuum.model_copy(update={"columns": columns}))
    line = caught.value.hint.splitlines()[1].partition("#")[0]
    read = tomllib.loads(line)["pressure"]
    assert read == {"name": how.columns[Column.PRESSURE].name, "unit": "mbar", "reference": "gauge"}


def test_what_is_mapped_already_is_not_proposed_again(tmp_path: Path) -> None:
    path = written(tmp_path, "Zeit [ms];Saugventil;Abblasventil;Druck [bar]\n0;0;0;1\n")
    how = settings({"time_ms": "Zeit [ms]", "suction": "Saugventil"})
    with pytest.raises(SourceError, match="no column pressure_mbar") as caught:
        open_table(path, how, AMBIENT)
    assert '  blow_off = "Abblasventil"\n  pressure = "Druck [bar]"' in caught.value.hint
    assert "Saugventil" not in caught.value.hint


def test_of_several_times_one_is_proposed() -> None:
    header = ["Datum", "Zeit [ms]", "Zeit [s]", "Zeit", "p"]
    assert likely_columns(header) == {Column.TIME_S: "Zeit [s]"}
    assert likely_columns(["Zeit", "x"]) == {}


def test_a_date_and_a_time_of_day_are_proposed_as_such() -> None:
    assert likely_columns(["Uhrzeit", "Datum"]) == {Column.DATE: "Datum", Column.TIME: "Uhrzeit"}
    assert likely_columns(["Date", "Time"]) == {Column.DATE: "Date", Column.TIME: "Time"}
    assert likely_columns(["Datum", "x"]) == {Column.TIME: "Datum"}
    assert likely_columns(["Zeitstempel"]) == {Column.TIME: "Zeitstempel"}


def test_a_date_and_time_is_known_by_its_form() -> None:
    cells = {
        "Zeit": ["01.03.2026 12:00:00,000", "01.03.2026 12:00:00,010"],
        "Tag": ["1.3.2026", ""],
        "Stunde": ["12:00:00.5"],
        "Zeiten": ["10", "20"],
        "leer": ["", ""],
        "Text": ["a: b"],
        "Datum": ["2026-03-01 00:00:00"],
        "wann": ["3/13/2026 12:00"],
        "Zeit und mehr": ["01.03.2026 12:00", "x"],
    }
    forms = {name: form_of(column, None) for name, column in cells.items()}
    assert forms == {
        "Zeit": Form.INSTANT,
        "Tag": Form.DATE,
        "Stunde": Form.TIME_OF_DAY,
        "Zeiten": None,
        "leer": None,
        "Text": None,
        "Datum": Form.DATE,
        "wann": Form.INSTANT,
        "Zeit und mehr": None,
    }
    assert likely_columns(["wann", "Zeit"], (), forms) == {Column.TIME: "Zeit"}
    assert likely_columns(["wann", "Zeiten"], (), forms) == {Column.TIME: "wann"}
    of_two = {Column.DATE: "Tag", Column.TIME: "Stunde"}
    assert likely_columns(["Stunde", "Tag"], (), forms) == of_two


GERMAN = "Zeit;Druck;Saugen;Abblasen\n" + "".join(
    f"01.03.2026 12:00:00,{10 * n:03};101,{n};0;0\n" for n in range(10)
)


def test_all_that_a_german_export_lacks_is_named_at_once(tmp_path: Path) -> None:
    path = written(tmp_path, GERMAN)
    with pytest.raises(SourceError, match="no column time_s") as caught:
        open_table(path, settings(), AMBIENT)
    message, lines = str(caught.value), caught.value.hint.partition(":\n")[2]
    shown = f"twin: trace.csv:1:{message.rpartition(f'{path}:1:')[2]}\n  {caught.value.hint}\n"
    assert shown in (DATA.parents[1] / "docs" / "csv.md").read_text(encoding="utf-8")
    assert "and none for pressure, suction and blow_off" in message
    assert "in which unit column 'Druck' is; the times say no time zone" in message
    assert tomllib.loads(lines)["import"] == {
        "time_zone": "...",
        "columns": {
            "time": "Zeit",
            "suction": "Saugen",
            "blow_off": "Abblasen",
            "pressure": {"name": "Druck", "unit": "...", "reference": "absolute"},
        },
    }
    with pytest.raises(ValueError, match=r"columns.pressure.unit") as unchanged:
        ImportSettings.model_validate(tomllib.loads(lines)["import"])
    assert "time_zone" in str(unchanged.value)
    answered = lines.replace('unit = "..."', 'unit = "kPa"').replace('"..."', '"Europe/Berlin"')
    rows = taken(path, ImportSettings.model_validate(tomllib.loads(answered)["import"]))
    assert rows["time_ns"][1] == BEGIN_NS + 10_000_000
    assert rows["pressure"][1] == pytest.approx(101_100.0)


def test_a_missing_zone_is_named_with_a_missing_unit(tmp_path: Path) -> None:
    columns = {"time": "Zeit", "suction": "Saugen", "blow_off": "Abblasen"}
    pressure = {"name": "Druck", "reference": "gauge", "signal": [4, 20], "range": [0, -1]}
    with pytest.raises(SourceError, match="in which unit column 'Druck' is; the times") as caught:
        open_table(written(tmp_path, GERMAN), settings({**columns, "pressure": pressure}), AMBIENT)
    lines = tomllib.loads(caught.value.hint.partition(":\n")[2])["import"]
    assert lines == {"time_zone": "...", "columns": {"pressure": {**pressure, "unit": "..."}}}
    how = settings({**columns, "pressure": "Druck"}, time_zone="UTC")
    with pytest.raises(SourceError, match=r"in which unit column 'Druck' is$") as of_unit:
        open_table(written(tmp_path, GERMAN), how, AMBIENT)
    assert "[import]\n" not in of_unit.value.hint


@pytest.mark.parametrize(
    ("date", "line"),
    [
        ("03/04/2026", 'date_order = "..."'),
        ("03/13/2026", 'date_order = "month"'),
        ("3.4.2026", ""),
    ],
)
def test_the_order_of_day_and_month_is_asked_for_with_the_rest(
    tmp_path: Path, date: str, line: str
) -> None:
    path = written(tmp_path, f"Tag;Zeit;Druck [bar]\n{date};12:00:00,000;1\n")
    with pytest.raises(SourceError, match="the times say no time zone") as caught:
        open_table(path, settings(no_blow_off=True), AMBIENT, derive=True)
    assert ("whether" in str(caught.value)) == bool(line)
    lines = tomllib.loads(caught.value.hint.partition(":\n")[2])["import"]
    assert line in caught.value.hint
    assert lines["columns"] == {"date": "Tag", "time": "Zeit", "pressure": "Druck [bar]"}


def test_first_cells_of_parquet_and_excel_are_looked_at(tmp_path: Path) -> None:
    noon = BEGIN.replace(tzinfo=None)
    columns = {"Saugen": [0], "Abblasen": [0], "Druck": [1.0], "t": pa.array([noon])}
    parquet.write_table(pa.table(columns), tmp_path / "t.parquet")
    workbook(tmp_path / "t.xlsx", [*columns], [0, 0, 1.0, noon], [1, 0])
    for name in ("t.parquet", "t.xlsx"):
        with pytest.raises(SourceError, match="the times say no time zone") as caught:
            open_table(tmp_path / name, settings(), AMBIENT)
        assert 'time = "t"' in caught.value.hint


def test_how_to_read_a_transmitter_is_shown_by_example(tmp_path: Path) -> None:
    path = written(tmp_path, "time_ms;suction;blow_off;AI1 [V]\n0;0;0;1\n")
    with pytest.raises(SourceError) as caught:
        open_table(path, settings({}), AMBIENT)
    lines = caught.value.hint.rpartition("[import.columns]")[2]
    read = tomllib.loads(lines)["pressure"]
    assert read["name"] == "AI1 [V]"
    assert read["signal"] == [0, 10]
    open_table(path, settings({"pressure": read}), AMBIENT)


# --- Excel --------------------------------------------------------------------------------------


def workbook(path: Path, *rows: list[Any]) -> Path:
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    for row in rows:
        sheet.append(row)
    book.create_sheet("Notes").append(["nothing"])
    book.save(path)
    return path


def test_a_column_that_another_sheet_may_have(tmp_path: Path) -> None:
    path = workbook(tmp_path / "t.xlsx", ["Machine 7"])
    with pytest.raises(SourceError, match="no column time_s") as caught:
        open_table(path, settings({}), AMBIENT)
    assert "sheet 'Sheet' is read; sheet of [import] chooses 'Notes'" in caught.value.hint


def test_numbers_that_were_pasted_as_text_have_decimal_commas(tmp_path: Path) -> None:
    path = workbook(
        tmp_path / "t.xlsx",
        ["time_ms", "suction", "blow_off", "pressure_mbar"],
        ["0", "FALSCH", "0", "1013,2"],
        ["0,5", "WAHR", "0", "999"],
    )
    rows = taken(path, settings({}))
    assert rows["time_ns"].tolist() == [0, 500_000]
    assert rows["pressure"].tolist() == pytest.approx([101_320.0, 99_900.0])


def test_date_and_time_in_cells_of_their_own(tmp_path: Path) -> None:
    path = workbook(
        tmp_path / "t.xlsx",
        ["Datum", "Uhrzeit", "suction", "blow_off", "pressure_mbar"],
        [date(2026, 3, 1), time(12, 0), 0, 0, 1000],
        [date(2026, 3, 1), time(12, 0, 0, 10_000), 1, 0, 999],
    )
    how = settings({"date": "Datum", "time": "Uhrzeit"}, time_zone="UTC")
    rows = taken(path, how)
    noon = datetime(2026, 3, 1, 12, tzinfo=UTC)
    assert rows["time_ns"].tolist() == [
        int(noon.timestamp()) * 10**9 + ms * 10**6 for ms in (0, 10)
    ]


def test_a_sheet_is_read(tmp_path: Path) -> None:
    begin = BEGIN.replace(tzinfo=None)
    path = workbook(
        tmp_path / "t.xlsx",
        ["Rig 4"],
        [],
        ["Zeit", "Vakuum [kPa]", "suction", "blow_off"],
        [begin, 0, False, 0],
        [begin + timedelta(milliseconds=10), 10.5, True, 0],
        [],
        [begin + timedelta(milliseconds=20), 20, 1],
    )
    columns = {"time": "Zeit", "vacuum": "Vakuum [kPa]"}
    how = settings(columns, time_zone="Europe/Berlin", values="mark")
    rows = taken(path, how)
    assert rows["time_ns"].tolist() == [BEGIN_NS + ms * 1_000_000 for ms in (0, 10, 20)]
    np.testing.assert_allclose(rows["pressure"], AMBIENT - np.array([0.0, 10_500.0, 20_000.0]))
    assert rows["commands"].tolist() == [0, 1, 1]
    assert "sheet 'Sheet' is read" in " ".join(open_table(path, how, AMBIENT).notes)
    with pytest.raises(SourceError, match=r"t\.xlsx: row 7: column 'blow_off': the cell is empty"):
        taken(path, settings(columns, time_zone="Europe/Berlin"))


def test_a_header_below_a_title_is_found_without_a_known_name(tmp_path: Path) -> None:
    header = ["Zeit", "Vakuum [kPa]", "Saugen", "Abblasen"]
    row = [BEGIN.replace(tzinfo=None), 0, False, 0]
    path = workbook(tmp_path / "t.xlsx", ["Rig 4, left"], header, row)
    with pytest.raises(SourceError, match=r"row 2: no column .* the columns are 'Zeit'") as caught:
        open_table(path, settings(), AMBIENT)
    assert 'vacuum = "Vakuum [kPa]"' in caught.value.hint


def test_a_sheet_by_its_name(tmp_path: Path) -> None:
    path = workbook(tmp_path / "t.xlsx", ["x"])
    with pytest.raises(SourceError, match="no sheet is called 'Notse'") as caught:
        open_table(path, settings(sheet="Notse"), AMBIENT)
    assert "did you mean 'Notes'" in caught.value.hint
    with pytest.raises(SourceError, match="no column time_s"):
        open_table(path, settings(sheet="Notes"), AMBIENT)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no zip", b"time_s,suction\n"])
def test_what_is_no_excel_file_is_refused(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(SourceError, match=r"t\.xlsx: cannot be read as an Excel file"):
        open_table(written(tmp_path, content, "t.xlsx"), settings(), AMBIENT)


def test_a_sheet_that_unpacks_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = workbook(tmp_path / "t.xlsx", ["x"])
    monkeypatch.setattr(files, "MEMORY_BUDGET", 1000)
    with pytest.raises(SourceError, match="unpacked it claims") as caught:
        open_table(path, settings(), AMBIENT)
    assert "CSV" in caught.value.hint


def test_a_sheet_whose_entities_grow_is_refused(tmp_path: Path) -> None:
    whole = workbook(tmp_path / "whole.xlsx", ["time_ms", "suction"], [0, 0])
    each = "".join(f'<!ENTITY {new} "{f"&{old};" * 10}">' for old, new in pairwise("abcdefghi"))
    entities = f'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">{each}]><worksheet'
    with zipfile.ZipFile(whole) as parts, zipfile.ZipFile(tmp_path / "t.xlsx", "w") as bomb:
        for name in parts.namelist():
            text = parts.read(name).decode()
            if name.endswith("sheet1.xml"):
                text = text.replace("<worksheet", entities, 1).replace("<v>0<", "<v>&i;<", 1)
            bomb.writestr(name, text)
    with pytest.raises(SourceError, match=r"t\.xlsx: cannot be read as an Excel file"):
        list(ExcelFile(tmp_path / "t.xlsx", settings()).batches({}))


# --- what it is understood as -------------------------------------------------------------------


def test_a_preview_shows_columns_first_rows_and_a_plot(tmp_path: Path) -> None:
    path = cycle(tmp_path, lambda v: v, "vacuum_mbar")
    table = open_table(path, settings(), AMBIENT)
    preview = Preview(table)
    for block in table.blocks():
        preview.see(block)
    lines = str(preview).splitlines()
    assert "'vacuum_mbar'  vacuum in mbar below ambient, positive" in lines
    at = lines.index("200 rows, 1.990 s, every 10 ms")
    assert lines[at - 2 - FIRST].split()[-2:] == ["vacuum", "mbar"]
    assert lines[at - 1 - FIRST].split() == ["0.000", "0", "0", "1013.2", "0.0"]
    assert lines[at + 1] == "pressure from 313.2 to 1053.2 mbar absolute"
    plot = lines[at + 2 : at + 2 + HEIGHT]
    assert "█" * 30 in plot[-1]  # vacuum is at the bottom
    assert "█" * 20 in plot[1] + plot[0]  # ambient near the top
    assert len(lines[at + 2 + HEIGHT].split()[1]) <= WIDTH


def test_a_preview_does_not_grow_with_the_record(tmp_path: Path) -> None:
    path = cycle(tmp_path, lambda v: v, "vacuum_mbar")
    table = open_table(path, settings(), AMBIENT)
    block = joined(*table.blocks())
    preview = Preview(table)
    for _ in range(500):
        preview.see(block)
    assert len(preview._bins) <= 4 * WIDTH
    assert "100000 rows" in str(preview)


def test_what_commands_are_derived_from_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, cycle(tmp_path, lambda v: v, "vacuum_mbar").read_text(), "u.csv")
    path.write_text(path.read_text().replace("suction", "x"))
    table = open_table(path, settings(), AMBIENT, derive=True)
    assert table.with_commands().derived is not None
    monkeypatch.setattr(files, "MEMORY_BUDGET", 1000)
    monkeypatch.setattr(reader, "MEMORY_BUDGET", 1000)
    with pytest.raises(
        SourceError, match=r"u\.csv:1: what commands are derived from claims"
    ) as out:
        table.with_commands()
    assert "import it in parts of at most 76 rows" in out.value.hint


# --- where people meet it -----------------------------------------------------------------------

CONFIG = rigs.path_of("test_rig")


def test_a_dry_run_writes_nothing_and_shows_what_is_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = cycle(tmp_path, lambda v: v, "vacuum_mbar")
    before = set(tmp_path.iterdir())
    assert twin(monkeypatch, "import", path, "--config", CONFIG, "--dry-run") == 0
    out, _ = capsys.readouterr()
    assert "200 rows, 1.990 s, every 10 ms" in out
    assert set(tmp_path.iterdir()) == before


def test_a_dry_run_shows_also_what_is_then_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = cycle(tmp_path, lambda v: v / 1000, "vacuum_mbar")
    assert twin(monkeypatch, "import", path, "--config", CONFIG, "--dry-run") == 3
    out, err = capsys.readouterr()
    assert "200 rows" in out
    assert 'vacuum_bar = "vacuum_mbar"' in err


def test_an_import_says_nothing_of_rows_that_it_then_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    vacuum = ([0.0] * 60 + [0.7] * 100 + [0.0] * 60) * 3
    rows = [f"{10 * i};{int(30 < i % 220 < 160)};0;{v}" for i, v in enumerate(vacuum)]
    path = written(tmp_path, "\n".join(["time_ms;suction;blow_off;vacuum_mbar", *rows]))
    log = tmp_path / "a.mcap"
    assert twin(monkeypatch, "import", path, "--config", CONFIG, "-o", log) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert "In which unit is it" in err
    assert not log.exists()


def test_a_zone_can_be_given_as_an_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = "".join(f"01.03.2026 12:00:00,{n:03};0;0;1000\n" for n in range(0, 100, 10))
    path = written(tmp_path, "time;suction;blow_off;pressure_mbar\n" + rows)
    log = tmp_path / "a.mcap"
    for zone, code in (("", 3), ("Mars/Base", 2), ("Europe/Berlin", 0)):
        flag = ("--time-zone", zone) if zone else ()
        assert twin(monkeypatch, "import", path, "--config", CONFIG, "-o", log, *flag) == code
    capsys.readouterr()
    assert next(open_log(log).blocks())[0]["time_ns"][0] == BEGIN_NS
    assert twin(monkeypatch, "import", path, "--config", CONFIG) == 2
    assert "--dry-run" in capsys.readouterr().err


def test_a_notebook_is_warned_of_an_encoding(tmp_path: Path) -> None:
    path = written(tmp_path, f"# Größe\n{SMALL}".encode("cp1252"))
    with pytest.warns(UserWarning, match="read as cp1252"):
        api.open(path, CONFIG)
