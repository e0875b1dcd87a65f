"""The log: its size, and an hour written and read, beside bare rows through zstd."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zstandard
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from benchmarks.figures import Measured, Run
from benchmarks.machine import TWIN_CORE, on_core
from benchmarks.recording import hour
from twin.log.reader import open_log
from twin.log.recorder import Recorder

REPEATS = 3


def files(run: Run) -> Sequence[Measured]:
    """Bytes per sample, time (s) to write an hour, time (s) to read it."""
    run.tell("log: simulating the rig")
    rows = len(hour().samples)
    log, bare = hour_log(run.folder), run.folder / "bare.zst"
    chunks = packed(log)
    run.tell("log: writing and reading")
    with on_core(TWIN_CORE):
        bare_written = [_timed(lambda: _write_bare(bare)) for _ in range(REPEATS)]
        written = [
            _timed(lambda path=run.folder / f"again-{number}.mcap": write(path))
            for number in range(REPEATS)
        ]
        unpacked = [_timed(lambda: unpack(chunks)) for _ in range(REPEATS)]
        was_read = [_timed(lambda: read(log)) for _ in range(REPEATS)]
    sizes = [log.stat().st_size / rows], [bare.stat().st_size / rows]
    return Measured(*sizes), Measured(written, bare_written), Measured(was_read, unpacked)


def hour_log(folder: Path) -> Path:
    """A log of the hour; written when it is first asked for."""
    path = folder / "hour.mcap"
    if not path.exists():
        write(path)
    return path


def write(path: Path) -> None:
    """Write the hour as a replay would."""
    with Recorder(path, hour().header()) as recorder:
        for samples, ticks in hour().blocks():
            recorder.write(samples, ticks)


def read(path: Path) -> None:
    """Read all rows."""
    assert sum(len(samples) for samples, _ in open_log(path).blocks()) == len(hour().samples)


def packed(path: Path) -> list[tuple[bytes, int]]:
    """The chunks of a log as they lie in it, with the size they unpack to."""
    with path.open("rb") as file:
        records = StreamReader(file, emit_chunks=True).records
        return [(r.data, r.uncompressed_size) for r in records if isinstance(r, Chunk)]


def unpack(chunks: list[tuple[bytes, int]]) -> None:
    """Decompress, and nothing else."""
    decompressor = zstandard.ZstdDecompressor()
    for data, size in chunks:
        decompressor.decompress(data, max_output_size=size)


def _write_bare(path: Path) -> None:
    """The rows as they lie in memory, through zstd to the file."""
    compressor = zstandard.ZstdCompressor()
    with path.open("wb") as file:
        for samples, ticks in hour().blocks():
            file.write(compressor.compress(samples.tobytes() + ticks.tobytes()))


def _timed(work: Callable[[], None]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
