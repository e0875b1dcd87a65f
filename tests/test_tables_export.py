"""A log as CSV and Parquet: lossless, complete or not there, and read back to the bit."""

import csv
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from log_rows import HEADER, course
from pyarrow import parquet
from table_rows import AMBIENT, REFUSE, SMALL, taken, written

from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.errors import ConfigError, SourceError
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.quality import Quality
from twin.signals import TICK, Reported, Samples, Signal, Ticks
from twin.tables import parquet_file
from twin.tables.export import export
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

SUFFIXES = ["csv", "parquet"]
SAID = ("expected_mbar", "phase", "level_mbar", "part_present", "air_saving")  # by the twin


def recorded(count: int = 25_000) -> tuple[Samples, Ticks]:
    """Rows as a driver gives them, with everything that can be wrong with them."""
    samples, ticks = course(count)
    samples["sequence"][100:] += 7
    samples["time_ns"][200:] -= 10**12
    samples["sequence"][300:] -= 1000
    samples["pressure"][400:410] = np.nan
    samples["supply"][500:600] = np.nan
    ticks["expected"][:50] = np.nan
    ticks["signals"][600:] = Signal.PART_PRESENT
    ticks["signals"][700:] = Signal.PART_PRESENT | Signal.AIR_SAVING
    ticks["signals"][800:] = Signal.AIR_SAVING
    for row, flag in ((100, Quality.GAP), (200, Quality.CLOCK), (300, Quality.RESTART)):
        samples["quality"][row] = flag
    samples["quality"][400:410] = Quality.BAD | Quality.OUT_OF_RANGE
    return samples, ticks


def exported(folder: Path, suffix: str, samples: Samples, ticks: Ticks) -> Path:
    """Rows by way of a log."""
    with Recorder(folder / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks)
    log = open_log(folder / "a.mcap")
    path = folder / f"a.{suffix}"
    export(log.blocks(7000), log.header, path)
    return path


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_log_comes_back_to_the_bit(tmp_path: Path, suffix: str) -> None:
    samples, ticks = recorded()
    path = exported(tmp_path, suffix, samples, ticks)
    assert taken(path).tobytes() == samples.tobytes()
    assert open_table(path, REFUSE, 1.0).ignored == SAID
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["a.mcap", path.name])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_reported_comes_back_to_the_bit(tmp_path: Path, suffix: str) -> None:
    told = PlcSettings.model_validate({"reports": {"bits": True, "values": True}})
    samples = np.concatenate(list(blocks(told, 4.0)))
    for column in ("ambient", "temperature", "pressure_2", "flow"):
        samples[column][100:200] = 0.0
    samples["reported"][300:400] &= np.uint8(Reported.FLOW_KNOWN)  # the rest is not known
    samples["reported"][100:200] &= np.uint8(Reported.NOZZLE_KNOWN | Reported.NOZZLE)
    ticks = np.zeros(len(samples), TICK)
    path = exported(tmp_path, suffix, samples, ticks)
    assert taken(path).tobytes() == samples.tobytes()


def test_other_programs_read_the_ticks_too(tmp_path: Path) -> None:
    samples, ticks = recorded(1000)
    for suffix in SUFFIXES:
        export([(samples, ticks)], HEADER, tmp_path / f"a.{suffix}")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if line[0] != "#"))
    table = parquet.read_table(tmp_path / "a.parquet").to_pydict()
    assert rows[0].keys() == table.keys()
    for name, unit in (("expected", 100.0), ("level", 100.0), ("phase", 1)):
        column = name if name == "phase" else f"{name}_mbar"
        here = np.array([float(row[column] or "nan") for row in rows]) * unit
        there = np.array([np.nan if cell is None else cell for cell in table[column]]) * unit
        np.testing.assert_array_equal(here.astype(ticks.dtype[name]), ticks[name])
        np.testing.assert_array_equal(there.astype(ticks.dtype[name]), ticks[name])
    for signal in Signal:
        column = str(signal.name).lower()
        given = (ticks["signals"] & signal) != 0
        assert 0 < given.sum() < len(given)
        assert [row[column] for row in rows] == ["1" if bit else "0" for bit in given]
        assert table[column] == given.astype(int).tolist()


def test_whose_it_is_and_the_units_stand_in_it(tmp_path: Path) -> None:
    for suffix in SUFFIXES:
        export([course(3)], HEADER, tmp_path / f"a.{suffix}")
    text = (tmp_path / "a.csv").read_text()
    assert "# asset_type: SCPSi 15\n" in text
    assert "# program: 0.1.0\n" in text
    assert "# expected_mbar: mbar absolute\n" in text
    schema = parquet.read_schema(tmp_path / "a.parquet")
    assert schema.metadata[b"asset_id"] == b"robot 7, left"
    assert schema.metadata[b"ambient_pa"] == b"100000.0"
    assert schema.field("supply_bar").metadata[b"unit"] == b"bar gauge"
    assert all(field.metadata[b"unit"] for field in schema)


def test_an_asset_of_several_lines_stays_a_comment(tmp_path: Path) -> None:
    header = LogHeader("a\nb\r,c", "1", "c.toml", "")
    export([course(3)], header, tmp_path / "a.csv")
    assert len(taken(tmp_path / "a.csv")) == 3


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_of_that_name_is_left_as_it_is(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path, "mine", f"a.{suffix}")
    with pytest.raises(SourceError, match="already a file of that name"):
        export([course(3)], HEADER, path)
    assert path.read_text() == "mine"


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("error", [SourceError("damaged"), KeyboardInterrupt()])
def test_what_is_not_complete_is_not_there(
    tmp_path: Path, suffix: str, error: BaseException
) -> None:
    def rows() -> Iterator[tuple[Samples, Ticks]]:
        yield course(1000)
        raise error

    with pytest.raises(type(error)):
        export(rows(), HEADER, tmp_path / f"a.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_is_said_and_leaves_nothing(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a.{suffix}.part").symlink_to("/dev/full")
    with pytest.raises(SourceError, match=rf"a\.{suffix}: cannot be written: .*[Nn]o space"):
        export([course(20_000)] * 3, HEADER, tmp_path / f"a.{suffix}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("folder", ["none", "file"])
def test_where_nothing_can_be_written_that_is_said(tmp_path: Path, folder: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SourceError, match="cannot be written"):
        export([course(3)], HEADER, tmp_path / folder / "a.csv")


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"a\.xlsx: .* \.csv or \.parquet") as caught:
        export([course(3)], HEADER, tmp_path / "a.xlsx")
    assert "a.csv" in caught.value.hint
    assert list(tmp_path.iterdir()) == []


# --- Parquet of others --------------------------------------------------------------------------


def _parquet(folder: Path, **columns: pa.Array) -> Path:
    path = folder / "t.parquet"
    parquet.write_table(pa.table(columns), path)
    return path


PLAIN = {
    "time_ms": pa.array([0, 1, 2, 3], pa.int32()),
    "suction": pa.array([0, 1, 1, 0], pa.int8()),
    "blow_off": pa.array([0, 0, 0, 1], pa.uint64()),
    "pressure_mbar": pa.array([1013.25, 1000.5, 900.25, 1013.0]),
}


@pytest.mark.parametrize(
    "other",
    [
        {},
        {"suction": pa.array([False, True, True, False])},
        {"suction": pa.array(["0", "1", "1", "0"]).dictionary_encode()},
        {"pressure_mbar": pa.array(["1013.25", " 1000.5", "9.0025e2", "1013"])},
        {"pressure_mbar": PLAIN["pressure_mbar"].cast(pa.float32())},
        {"pressure_mbar": PLAIN["pressure_mbar"].cast(pa.decimal128(10, 2))},
        {"time_ms": pa.array([0.0, 1.0, 2.0, 3.0])},
        {"time_ms": pa.array([0, 1, 2, 3], pa.decimal128(20, 3))},
        {"time_ms": pa.array(["0", "1", "2", "3"], pa.large_string())},
    ],
    ids=range(9),
)
def test_numbers_of_any_type_are_taken(tmp_path: Path, other: dict[str, pa.Array]) -> None:
    rows = taken(_parquet(tmp_path, **PLAIN | other))
    assert rows.tobytes() == taken(written(tmp_path, SMALL)).tobytes()


@pytest.mark.parametrize("kind", [pa.timestamp("ns"), pa.list_(pa.int64()), pa.binary()])
def test_what_is_no_number_is_refused_by_its_type(tmp_path: Path, kind: pa.DataType) -> None:
    path = _parquet(tmp_path, **PLAIN | {"time_ms": pa.array([None] * 4, kind)})
    with pytest.raises(SourceError, match=r"t\.parquet: column 'time_ms' holds "):
        taken(path)


@pytest.mark.parametrize(
    ("name", "cells", "what"),
    [
        ("pressure_mbar", pa.array([1.0, 1.0, None, 1.0]), "the cell is empty"),
        ("pressure_mbar", pa.array([1.0, 1.0, np.nan, 1.0]), "'nan' is not a finite number"),
        ("suction", pa.array([0, 0, 2, 0]), "'2' is not 0 or 1"),
        ("time_ms", pa.array([0.0, 1.0, np.inf, 3.0]), "'inf' is not a time"),
        ("time_ms", pa.array(["0", "1", "x", "3"]), "'x' is not a time"),
        ("time_ms", pa.array([0, 1, 2**63, 3], pa.uint64()), "is not a time"),
        ("time_ms", pa.array([0, 1, 1, 2]), "'1' does not go forward"),
    ],
)
def test_bad_input_is_named_by_row_or_marked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, cells: pa.Array, what: str
) -> None:
    path = _parquet(tmp_path, **PLAIN | {name: cells})
    for size in (10_000, 2):
        monkeypatch.setattr(parquet_file, "_ROWS", size)
        with pytest.raises(SourceError) as caught:
            taken(path)
        assert str(caught.value).startswith(f"{path}: row 3: column {name!r}: ")
        assert what in str(caught.value)
        rows = taken(path, ImportSettings(values="mark", jumps="mark"))
        assert (rows["quality"] != 0).tolist() == [False, False, True, False]


def test_a_column_name_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    parquet.write_table(pa.table(PLAIN), path, store_schema=False)
    path.write_bytes(path.read_bytes().replace(b"suction", b"s\xffction"))
    with pytest.raises(SourceError, match="cannot be read as Parquet"):
        open_table(path, REFUSE, AMBIENT)


def test_text_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    raw = pa.array([b"0", b"1", b"\xff", b"3"]).view(pa.string())
    with pytest.raises(SourceError, match="cannot be read as Parquet"):
        taken(_parquet(tmp_path, **PLAIN | {"time_ms": raw}), ImportSettings(values="mark"))


def test_damage_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    export([course(3000)], HEADER, path)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"cannot be read as Parquet: .*CRC"):
        taken(path)
    os.truncate(path, 1000)
    with pytest.raises(SourceError, match="cannot be read as Parquet"):
        taken(path)
