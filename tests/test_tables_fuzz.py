"""Whatever a table holds: its rows, each of them, or one error that says where."""

import io
import tempfile
import zipfile
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from log_rows import HEADER, course
from openpyxl import Workbook
from table_rows import MARK, REFUSE, taken, written

from twin.errors import SourceError, TwinError
from twin.quality import Quality
from twin.signals import SAMPLE, TICK, Samples
from twin.tables import csv_file
from twin.tables.export import export
from twin.tables.settings import ImportSettings

HEADER_ROW = "time_ms,sequence,suction,blow_off,pressure_mbar,supply_bar,quality"
NAMES = HEADER_ROW.split(",")
IN_MBAR = ImportSettings(pressure_unit="mbar")  # however small: any float is valid here


@settings(max_examples=150, deadline=None)
@given(
    st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)),
    st.sampled_from(["t.csv", "t.txt", "t.xlsx", "t.parquet"]),
    st.sampled_from([REFUSE, MARK]),
)
def test_any_bytes(content: bytes, name: str, how: ImportSettings) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), content, name)
        with pytest.raises(SourceError) as caught:
            taken(path, how)
        assert str(path) in str(caught.value)


_SCRAPS = st.text("0123456789.,;-+eE#\"' \t\r\x00\x1f\x85\u2028nafi_x١", max_size=12)
_NUMBERS = st.one_of(st.integers(-3, 12).map(str), st.integers().map(str), st.floats().map(repr))
_CELLS = st.one_of(_SCRAPS, _NUMBERS, st.sampled_from(["", "0", "1", "nan", "-inf", "1e999"]))
_LINES = st.one_of(
    st.text(max_size=20).filter(lambda text: not set("\n\r") & set(text)),
    st.lists(_CELLS, min_size=6, max_size=8).map(",".join),
    st.lists(_CELLS, min_size=7, max_size=7).map(",".join),
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    st.lists(_LINES, max_size=12),
    st.sampled_from([",", ";"]),
    st.sampled_from([REFUSE, MARK]),
    st.integers(1, 100),
)
@example(['"'], ",", MARK, 1)
@example(["0,0,0,0,0,0,0", '"', "1,1,0,0,0,0,0"], ",", MARK, 100)
@example([',,,,,"\x1f'], ",", REFUSE, 1)
def test_any_rows(lines: list[str], separator: str, how: ImportSettings, piece: int) -> None:
    text = "\n".join([HEADER_ROW, *lines]).replace(",", separator)
    data = text.replace("\r", "\n").split("\n")[1:]
    count = sum(line.strip()[:1] not in {"", "#"} for line in data)
    with tempfile.TemporaryDirectory() as folder, patch.object(csv_file, "_PIECE", piece):
        path = written(Path(folder), text)
        try:
            assert len(taken(path, how)) == count
        except TwinError as error:
            assert str(error).startswith(f"{path}:")  # noqa: PT017
            assert how is REFUSE or "has a time" in str(error) or not count  # noqa: PT017


FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
ROWS = st.lists(
    st.tuples(
        st.integers(1, 2**40),  # ns from row to row
        st.sampled_from([1, 1, 1, 2, 1000]),  # numbers from row to row
        FINITE,
        st.one_of(FINITE, st.just(np.nan)),
        st.integers(0, 3),
        st.sampled_from([0, 0, Quality.OUT_OF_RANGE, Quality.STALE, Quality.BAD]),
        st.integers(-(2**63), 2**63 - 1),
    ),
    min_size=1,
    max_size=20,
)


def _samples(rows: list[tuple[float, ...]], start: int) -> Samples:
    samples = np.zeros(len(rows), SAMPLE)
    steps, numbers, pressure, supply, commands, quality, host = zip(*rows, strict=True)
    samples["time_ns"] = start + np.cumsum(steps)
    samples["sequence"] = np.cumsum(numbers) - 5
    samples["host_ns"] = host
    samples["pressure"], samples["supply"] = pressure, supply
    samples["commands"] = commands
    samples["quality"] = np.array(quality) | np.where(np.array(numbers) > 1, Quality.GAP, 0)
    samples["pressure"][samples["quality"] & Quality.BAD != 0] = np.nan
    return samples


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(ROWS, st.sampled_from([0, -(10**18), 1_767_225_600_000_000_000, 2**63 - 2**50]))
def test_any_valid_rows_come_back_to_the_bit(rows: list[tuple[float, ...]], start: int) -> None:
    samples = _samples(rows, start)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for suffix in ("csv", "parquet"):
            export([(samples, np.zeros(len(samples), TICK))], HEADER, folder / f"t.{suffix}")
            assert taken(folder / f"t.{suffix}", IN_MBAR).tobytes() == samples.tobytes()
        german = (folder / "t.csv").read_text().replace(",", ";").replace(".", ",")
        assert taken(written(folder, german, "g.csv"), IN_MBAR).tobytes() == samples.tobytes()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 39),
    st.sampled_from(NAMES),
    st.text("abc?%-_. ", min_size=1, max_size=5).filter(lambda text: text.strip()),
    st.integers(100, 2000),
    st.data(),
)
def test_any_damaged_cell(row: int, name: str, junk: str, piece: int, data: st.DataObject) -> None:
    rows = [[str(i), str(i + 5), "1", "0", f"{1000 + i}", "5.5", "0"] for i in range(40)]
    rows[row][NAMES.index(name)] = junk
    lines = [HEADER_ROW, *(",".join(cells) for cells in rows)]
    for _ in range(data.draw(st.integers(0, 5))):
        lines.insert(data.draw(st.integers(0, len(lines))), data.draw(st.sampled_from(["", "#,"])))
    line = lines.index(",".join(rows[row])) + 1
    with tempfile.TemporaryDirectory() as folder, patch.object(csv_file, "_PIECE", piece):
        path = written(Path(folder), "\n".join(lines))
        with pytest.raises(SourceError) as caught:
            taken(path)
        assert str(caught.value).startswith(f"{path}:{line}: column {name!r}: {junk.strip()!r}")
        if row == 0 and piece < 200:
            return  # alone in its piece it goes on from nothing
        marked = taken(path, ImportSettings(values="mark"))
        assert marked["quality"].tolist() == [Quality.BAD * (i == row) for i in range(40)]
        assert marked["time_ns"].tolist() == [i * 1_000_000 for i in range(40)]
        assert marked["sequence"].tolist() == [i + 5 for i in range(40)]
        assert marked["commands"].tolist() == [1] * 40


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_excel_file(data: st.DataObject) -> None:
    """Bytes of one part change, with a checksum that is right."""
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(NAMES)
    for row in range(20):
        sheet.append([row, row, 0, 0, 1000.5, 5.5, 0])
    whole = io.BytesIO()
    book.save(whole)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.xlsx"
        with zipfile.ZipFile(whole) as parts, zipfile.ZipFile(path, "w") as damaged:
            chosen = data.draw(st.sampled_from(parts.namelist()))
            for name in parts.namelist():
                content = bytearray(parts.read(name))
                for _ in range(data.draw(st.integers(0, 3)) if name == chosen else 0):
                    place = data.draw(st.integers(0, len(content) - 1))
                    content[place] = data.draw(st.sampled_from(list(b"<>&\"'/=0a ")))
                damaged.writestr(name, bytes(content))
        try:
            assert len(taken(path, MARK)) <= 20
        except TwinError as error:
            assert str(path) in str(error)  # noqa: PT017


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_parquet_file(data: st.DataObject) -> None:
    samples, ticks = course(50)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.parquet"
        export([(samples, ticks)], HEADER, path)
        content = bytearray(path.read_bytes())
        for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=3)):
            content[place] ^= data.draw(st.integers(1, 255))
        path.write_bytes(content)
        try:
            assert len(taken(path, MARK)) == 50
        except TwinError as error:
            assert str(path) in str(error)  # noqa: PT017
