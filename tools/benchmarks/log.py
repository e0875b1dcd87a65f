"""The log: its size, and the time to write and read an hour, beside bare rows through zstd."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from pyarrow import parquet

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.recording import BLOCK, MINUTE, Recording, hour
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.log.schema import CHANNELS, SAMPLES

REPEATS = 5


class _Way(NamedTuple):
    """One way to store the hour: functions that write it to a path and read it."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]


class _Taken(NamedTuple):
    """Repetitions of one way: bytes per sample, time (s) to write, time (s) to read."""

    sizes: list[float]
    written: list[float]
    read: list[float]


def files(run: Run) -> Sequence[Measured]:
    """Bytes per sample, time (s) to write an hour and to read it; the same for other ways."""
    run.tell("log: simulating the rig")
    log = part_log(run.folder)
    read(log)  # loads compiled code first
    chunks = packed(log)
    ours, bare = _by_turns(run, _Way(write, read), _Way(write_bare, lambda _: unpack(chunks)))
    messages, table = _messages(log), _table()  # 200 MB, made only after our own log is measured
    others = _by_turns(
        run,
        _Way(lambda path: _write_by_library(path, messages), _read_by_library),
        _Way(lambda path: _write_parquet(path, table), _read_parquet),
    )
    pairs = [(ours, bare), *((theirs, ours) for theirs in others)]
    return [Measured(*repetitions) for pair in pairs for repetitions in zip(*pair, strict=True)]


def _by_turns(run: Run, *ways: _Way) -> list[_Taken]:
    taken = [_Taken([], [], []) for _ in ways]
    path = run.folder / "again"
    run.tell("log: writing and reading")
    with on_core(TWIN_CORE):
        for _ in range(REPEATS):
            for way, times in zip(ways, taken, strict=True):
                times.written.append(_timed(way.write, path))
                times.read.append(_timed(way.read, path))
                times.sizes[:] = [path.stat().st_size / len(hour().samples)]
                path.unlink()
    return taken


def part_log(folder: Path, minutes: int = 60) -> Path:
    """A log of the hour, or of its first minutes; written on the first call."""
    path = folder / f"{minutes} min.mcap"
    return path if path.exists() else keep(path, hour(), minutes * MINUTE)


def write(path: Path) -> None:
    """Write the hour as a replay would."""
    keep(path, hour())


def keep(path: Path, recording: Recording, rows: int | None = None) -> Path:
    """Write a recording, or about its first ``rows``, as a replay would."""
    with Recorder(path, recording.config.log_header()) as recorder:
        for samples, ticks in recording.blocks()[: rows and rows // BLOCK]:
            recorder.write(samples, ticks)
    return path


def read(path: Path) -> None:
    """Read all rows."""
    assert sum(len(samples) for samples, _ in open_log(path).blocks()) == len(hour().samples)


def packed(path: Path) -> list[tuple[bytes, int]]:
    """The compressed chunks of a log, each with its uncompressed size."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        return [(r.data, r.uncompressed_size) for r in records if isinstance(r, Chunk)]


def unpack(chunks: list[tuple[bytes, int]]) -> None:
    """Decompress the chunks only."""
    decompressor = zstandard.ZstdDecompressor()
    for data, size in chunks:
        decompressor.decompress(data, max_output_size=size)


def write_bare(path: Path, rows: int | None = None) -> None:
    """Write the rows, or about the first ``rows``, through zstd with their layout in memory."""
    compressor = zstandard.ZstdCompressor()
    with path.open("wb") as file:
        for samples, ticks in hour().blocks()[: rows and rows // BLOCK]:
            file.write(compressor.compress(samples.tobytes() + ticks.tobytes()))


def _messages(path: Path) -> list[tuple[int, int, bytes, int]]:
    """Channel, log time, data and publish time of each message of a log, in written order."""
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages(log_time_order=False)
        return [(m.channel_id, m.log_time, m.data, m.publish_time) for _, _, m in messages]


def _write_by_library(path: Path, messages: list[tuple[int, int, bytes, int]]) -> None:
    """The log's own messages, made beforehand, through the MCAP library's writer."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for channel in CHANNELS.values():
            schema = writer.register_schema(channel.schema, "protobuf", channel.files)
            writer.register_channel(channel.topic, "protobuf", schema)
        for message in messages:
            writer.add_message(*message)
        writer.finish()


def _read_by_library(path: Path) -> None:
    """Rows of a log, found by the MCAP library's reader and decoded by protobuf's classes."""
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages([SAMPLES.topic]):
            SAMPLES.message.FromString(message.data)


def _table() -> pa.Table:
    """The hour as columns with the same values."""
    samples, ticks = hour().samples, hour().ticks
    names = [(rows, name) for rows in (samples, ticks) for name in rows.dtype.names]
    return pa.table({name: np.ascontiguousarray(rows[name]) for rows, name in names})


def _write_parquet(path: Path, table: pa.Table) -> None:
    parquet.write_table(table, path, compression="zstd", row_group_size=1 << 20)


def _read_parquet(path: Path) -> None:
    parquet.read_table(path, use_threads=False)


def _timed(work: Callable[[Path], object], path: Path) -> float:
    begin = time.perf_counter()
    work(path)
    return time.perf_counter() - begin
