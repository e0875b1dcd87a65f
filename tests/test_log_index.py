"""Where the chunks of a log lie: by its summary, and by the heads of its records without one."""

from pathlib import Path

import pytest
from log_rows import HEADER, START_NS, course

from twin.log.index import first_time, read_index
from twin.log.reader import decode_rows
from twin.log.recorder import Recorder
from twin.log.records import ChunkReader
from twin.log.schema import SAMPLES

CHUNKS = 100


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A log of 100 chunks with 250 rows each."""
    samples, ticks = course(250 * CHUNKS)
    with Recorder(tmp_path / "run.mcap", HEADER, clock=lambda: 0.0) as recorder:
        for at in range(0, len(samples), 250):
            recorder.write(samples[at : at + 250], ticks[at : at + 250])
            recorder.write(samples[:0], ticks[:0])  # a pause completes a chunk
    return tmp_path / "run.mcap"


def test_each_chunk_is_read_by_itself(path: Path) -> None:
    index = read_index(path)
    assert (len(index.places), index.complete, index.damaged) == (CHUNKS, True, 0)
    with path.open("rb") as file:
        reader = ChunkReader(file)
        for number in (70, 3):
            (packed,) = reader.messages(int(index.places["position"][number]), SAMPLES.topic)
            samples, _ = decode_rows(path, packed)
            assert samples["time_ns"][0] == START_NS + number * 250_000_000
            assert index.places["begin_ns"][number] <= samples["host_ns"][0]
        with pytest.raises(ValueError, match="not a"):
            list(reader.messages(8, SAMPLES.topic))


def test_an_unfinished_file_has_the_same_index(path: Path) -> None:
    whole, content = read_index(path), path.read_bytes()
    path.write_bytes(content[: int(whole.places["position"][70]) + 100])
    first = read_index(path)
    assert not first.complete
    assert first.places.tolist() == whole.places[:70].tolist()
    path.write_bytes(content[:-9])  # it has grown, and lacks its end
    assert read_index(path, first).places.tolist() == whole.places.tolist()
    assert first_time(path) == whole.places["begin_ns"][0]


def test_a_damaged_file_has_what_can_be_found(path: Path) -> None:
    whole, content = read_index(path), bytearray(path.read_bytes())
    content[-40] ^= 1  # its summary cannot be trusted
    at = int(whole.places["position"][50])
    content[at : at + 9] = b"\xff" * 9
    path.write_bytes(content)
    index = read_index(path)
    assert (len(index.places), index.complete, index.damaged) == (CHUNKS - 1, False, 1)


@pytest.mark.parametrize("content", [b"", b"x", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + b"\xff" * 300])
def test_what_has_no_chunk_has_no_index(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "none.mcap"
    path.write_bytes(content)
    assert len(read_index(path).places) == 0
    assert first_time(path) is None
