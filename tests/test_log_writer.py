"""The writer of many messages at once: to the byte what the library's own writes one by one."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_rows import START_NS, awkward, course
from mcap.reader import make_reader
from mcap.writer import Writer as LibraryWriter

from twin.log.disk_file import Output
from twin.log.messages import Scalars
from twin.log.schema import CHANNELS, SCALARS
from twin.log.writer import CHUNK, Writer
from twin.signals import SAMPLE, TICK

PIECE = np.dtype((np.void, 7))
Chunks = list[list[tuple[int, int, int, bytes]]]  # channel, log and publish time, message


def filled(output: Output, writer: Any, add: Callable[..., None], chunks: Chunks) -> None:
    """Write chunks, one message at a time, and what ends a file."""
    for chunk in chunks:
        for message in chunk:
            add(*message)
        writer.flush()
    writer.add_metadata("end", {})
    writer.finish()
    output.finish()


def by_library(path: Path, chunks: Chunks) -> bytes:
    output = Output(path)
    writer: Any = LibraryWriter(cast(IO[bytes], output))
    writer.start(library="x")
    writer.add_metadata("a", {"ä": "b"})
    writer.add_attachment(0, 0, "c.toml", "application/toml", b"d")
    for channel in CHANNELS.values():
        schema = writer.register_schema(channel.schema, "protobuf", channel.files)
        writer.register_channel(channel.topic, "protobuf", schema)
    filled(
        output,
        writer,
        lambda channel, log, plc, m: writer.add_message(channel, log, m, plc),
        chunks,
    )
    return path.read_bytes()


def begun(path: Path) -> tuple[Output, Writer]:
    output = Output(path)
    writer = Writer(output, "x")
    writer.add_metadata("a", {"ä": "b"})
    writer.add_attachment("c.toml", "application/toml", b"d")
    for channel in CHANNELS.values():
        writer.register_channel(channel.topic, channel.schema, channel.files)
    return output, writer


MESSAGE = st.tuples(
    st.integers(1, 4), st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=1)
)


@given(chunks=st.lists(st.lists(MESSAGE, max_size=5), max_size=3))
def test_one_by_one_it_is_the_librarys_file(
    tmp_path_factory: pytest.TempPathFactory, chunks: Chunks
) -> None:
    folder = tmp_path_factory.mktemp("files")
    output, writer = begun(folder / "ours.mcap")
    filled(output, writer, writer.add_message, chunks)
    assert (folder / "ours.mcap").read_bytes() == by_library(folder / "library.mcap", chunks)


def test_many_at_once_are_the_same_as_one_by_one(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    log_ns, publish_ns = rng.integers(0, 2**62, (2, 50))  # out of order
    messages = rng.integers(0, 256, (50, 7), np.uint8).view(PIECE)[:, 0]
    output, writer = begun(tmp_path / "ours.mcap")
    writer.add_message(3, 5, 6, b"event")
    writer.add_messages(2, log_ns, publish_ns, messages)
    writer.add_messages(2, log_ns[:0], publish_ns[:0], messages[:0])
    filled(output, writer, writer.add_message, [[(1, 2, 3, b"rows")]])
    many = zip(log_ns.tolist(), publish_ns.tolist(), messages.tolist(), strict=True)
    chunk = [(3, 5, 6, b"event"), *((2, *message) for message in many), (1, 2, 3, b"rows")]
    assert (tmp_path / "ours.mcap").read_bytes() == by_library(tmp_path / "library.mcap", [chunk])


def test_the_library_reads_it_by_its_index(tmp_path: Path) -> None:
    """In the order of time, over chunks that fill up by themselves."""
    output, writer = begun(tmp_path / "a.mcap")
    log_ns = np.random.default_rng(1).permutation(3 * CHUNK // 31)
    pieces = np.frombuffer(log_ns.astype("<i8").tobytes(), (np.void, 8))
    for at in range(0, len(log_ns), 10_000):
        part = slice(at, at + 10_000)
        writer.add_messages(2, log_ns[part], log_ns[part], pieces[part])
    writer.finish()
    output.finish()
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [message for _, _, message in reader.iter_messages(["/scalars"])]
        summary = reader.get_summary()
    assert [message.log_time for message in found] == list(range(len(log_ns)))
    assert all(struct.unpack("<q", message.data) == (message.log_time,) for message in found)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(log_ns)
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 3
    assert all(chunk.uncompressed_size < 2 * CHUNK for chunk in summary.chunk_indexes)


@pytest.mark.parametrize("time_ns", [0, -1, 1, -(2**63), 2**63 - 1, START_NS, -(10**9), 10**9 - 1])
def test_varints_of_fixed_length_are_protobuf(time_ns: int) -> None:
    samples, ticks = np.zeros(1, SAMPLE), np.zeros(1, TICK)
    samples["time_ns"] = time_ns
    for phase in (0, 1, 127, 128, 255):
        ticks["phase"] = phase
        samples["commands"] = phase & 3
        (message,) = Scalars(101_325.0).messages(samples, ticks)[2]
        read = SCALARS.message.FromString(message.tobytes())
        assert read.timestamp.seconds * 10**9 + read.timestamp.nanos == time_ns
        assert 0 <= read.timestamp.nanos < 10**9
        assert (read.phase, read.suction, read.blow_off) == (phase, phase & 1, phase >> 1 & 1)
        again = SCALARS.message.FromString(read.SerializeToString())  # in its shortest form
        assert again == read


@pytest.mark.parametrize("rows", [awkward(), course(500)])
def test_each_field_of_scalars_holds_what_it_says(rows: Any) -> None:
    samples, ticks = rows
    scalars = Scalars(100_000.0)
    picked = Scalars(100_000.0).pick(samples, ticks)
    host_ns, time_ns, messages = scalars.messages(samples, ticks)
    assert host_ns.tolist() == samples["host_ns"][picked].tolist()
    for i, message in enumerate(messages):
        read = SCALARS.message.FromString(message.tobytes())
        row, tick = samples[picked][i], ticks[picked][i]
        with np.errstate(invalid="ignore"):
            vacuum = (100_000.0 - float(row["pressure"])) / 100
            expected = (100_000.0 - float(tick["expected"])) / 100
            supply = float(row["supply"]) / 1e5
        assert read.timestamp.seconds == time_ns[i] // 10**9
        found = np.array([read.vacuum_mbar, read.expected_vacuum_mbar, read.supply_bar])
        np.testing.assert_array_equal(found, [vacuum, expected, supply])
        assert read.phase == tick["phase"]
