"""Small files that claim to be large: refused before the memory is taken, and nothing else ends."""

import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pyarrow as pa
import pytest
import rigs
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from pyarrow import parquet

from twin.config import Config, document_in
from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind
from twin.exchange.aas import read_package
from twin.exchange.fmu_file import read_fmu
from twin.files import MEMORY_BUDGET
from twin.fleet.runner import Outcome, ask
from twin.log import recorder
from twin.log.check import check
from twin.log.columns import decode
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.log.schema import COLUMNS, EVENTS, SAMPLES
from twin.signals import SAMPLE, TICK
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

MUCH = 8 * MEMORY_BUDGET


@contextmanager
def little_memory(most: int = 4 << 20) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def written(path: Path, text: str = "") -> Path:
    header = rigs.config("gripper").log_header()
    given = LogHeader("t", "", "g.toml", text or header.config_text, header.metadata)
    with Recorder(path, given) as log:
        log.write(np.zeros(5, SAMPLE), np.zeros(5, TICK))
    return path


def test_rows_that_take_no_place() -> None:
    columns = dict.fromkeys(COLUMNS, bytes(8))
    packed = SAMPLES.message(count=MUCH // 50, **columns).SerializeToString()
    assert len(packed) < 1000
    with little_memory(), pytest.raises(ValueError, match=r"more than 64 MiB are not read"):
        decode(packed)


@pytest.mark.parametrize("claimed", [1000, MUCH])
def test_a_chunk_that_unpacks_to_more_than_it_may(tmp_path: Path, claimed: int) -> None:
    zeros = bytes(MEMORY_BUDGET)
    packed = lz4.frame.compress(zeros)
    record = RecordBuilder()
    Chunk("lz4", packed, 0, 0, zlib.crc32(zeros), claimed).write(record)
    del zeros
    raw = written(tmp_path / "a.mcap").read_bytes()
    at = raw.index(b"zstd") - 45 + 4  # the chunk's opcode
    (tmp_path / "b.mcap").write_bytes(raw[:at] + record.end() + raw[at:])
    with little_memory():
        (damage,) = check(tmp_path / "b.mcap").damage
    assert ("MiB" if claimed == MUCH else "not as long as it says") in damage.what


def test_an_archive_that_unpacks_to_more_than_it_may(tmp_path: Path) -> None:
    path = tmp_path / "a.aasx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(3):
            archive.writestr(f"aasx/{number}.xml", bytes(MEMORY_BUDGET // 2))
    for read in (read_package, read_fmu):
        with little_memory(), pytest.raises(ConfigError, match="claims 96 MiB"):
            read(path)


def test_a_page_of_a_table_that_unpacks_to_more_than_it_may(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    table = {"time_ms": [0.0], "vacuum_mbar": [0.0], "note": [bytes(MEMORY_BUDGET + 1)]}
    parquet.write_table(pa.table(table), path, use_dictionary=False, compression="zstd")
    assert path.stat().st_size < 100_000
    with little_memory(), pytest.raises(SourceError, match=r"a page claims 64 MiB"):
        open_table(path, ImportSettings(), 1e5, derive=True)


@pytest.mark.parametrize(
    "how",
    [
        {"data_page_version": "2.0", "write_statistics": True, "data_page_size": 1000},
        {"use_dictionary": False, "compression": "none", "row_group_size": 700},
        {"write_page_checksum": True, "write_page_index": True},
    ],
    ids=["version 2", "row groups", "checksums"],
)
def test_a_table_as_others_write_it_is_no_bomb(tmp_path: Path, how: dict[str, Any]) -> None:
    path, count = tmp_path / "a.parquet", 5000
    time_ms = np.arange(count) * 1.0
    long = ["x" * 3000] * count  # its statistics are long
    table = {"time_ms": time_ms, "vacuum_mbar": np.sin(time_ms), "note": long}
    parquet.write_table(pa.table(table), path, **how)
    read = open_table(path, ImportSettings(), 1e5, derive=True)
    assert sum(map(len, read.blocks())) == count


def test_an_event_that_is_nested_deeply(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, event = tmp_path / "deep.mcap", Event(0, Kind.GAP, "deep", {})
    deep = EVENTS.message(kind=event.kind.value, data_json="[" * 100_000).SerializeToString()
    monkeypatch.setattr(recorder, "encode_event", lambda _: deep)
    with Recorder(path, rigs.config("gripper").log_header()) as log:
        log.write(np.zeros(5, SAMPLE), np.zeros(5, TICK), [event])
    with pytest.raises(SourceError, match="cannot be decoded"):
        list(open_log(path).events())


def test_one_deep_log_does_not_end_a_fleet(tmp_path: Path) -> None:
    deep = written(tmp_path / "deep.mcap", "a = " + "[" * 100_000)
    good = written(tmp_path / "good.mcap")
    first, second = ask(
        "replay",
        [deep, good],
        lambda log: Config.of_log(document_in(log.header), log.header.metadata, str(log.path)),
    )
    assert isinstance(first, Outcome)
    assert first.state == "failed"
    assert "not valid TOML" in first.error
    assert not isinstance(second, Outcome)
