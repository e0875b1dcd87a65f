"""Logs that a crash, a full disk or a bad disk left, and files that are no logs."""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_rows import EVENTS, HEADER, course, rows_of
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from twin.errors import SourceError
from twin.log.check import Report, check, recover
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.quality import Quality

SAMPLES, TICKS = course(2000)
BLOCK = 250


class Written:
    """A log, and how many rows were flushed at which size of the file."""

    def __init__(self, path: Path) -> None:
        now = 0.0
        with Recorder(path, HEADER, clock=lambda: now) as recorder:
            self.flushed = [(path.stat().st_size, 0)]
            for start in range(0, len(SAMPLES), BLOCK):
                now += 0.25
                rows = slice(start, start + BLOCK)
                recorder.write(SAMPLES[rows], TICKS[rows], EVENTS if start == 750 else ())
                self.flushed.append((path.stat().st_size, start + BLOCK))
        self.raw = path.read_bytes()
        self.head = self.flushed[0][0]


@pytest.fixture(scope="module")
def written() -> Iterator[Written]:
    with tempfile.TemporaryDirectory() as folder:
        yield Written(Path(folder) / "a.mcap")


@pytest.fixture
def file(tmp_path: Path, written: Written) -> Path:
    """A sound log that the test may spoil."""
    (tmp_path / "a.mcap").write_bytes(written.raw)
    return tmp_path / "a.mcap"


def spoil(file: Path, position: int, data: bytes = b"") -> None:
    """Overwrite bytes, by default turn one around."""
    raw = bytearray(file.read_bytes())
    data = data or bytes([raw[position] ^ 0xFF])
    raw[position : position + len(data)] = data
    file.write_bytes(raw)


# Cut off anywhere.


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_cut_anywhere_it_keeps_all_that_was_flushed(written: Written, data: st.DataObject) -> None:
    edges = [size + near for size, _ in written.flushed for near in (-1, 0, 1)]
    near_end = st.integers(len(written.raw) - 60, len(written.raw) - 1)
    anywhere = st.integers(written.head, len(written.raw) - 1)
    size = data.draw(st.sampled_from(edges[1:]) | anywhere | near_end)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cut.mcap"
        path.write_bytes(written.raw[:size])
        log = open_log(path)
        rows = max(rows for flushed, rows in written.flushed if flushed <= size)
        got, _ = rows_of(log)
        assert len(got) >= rows * SAMPLES.itemsize
        assert SAMPLES.tobytes().startswith(got)
        assert not log.complete
        if rows > 750:
            assert list(log.events()) == EVENTS
        report = check(path)
        assert not report.complete
        assert all(damage.torn for damage in report.damage)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_cut_in_the_head_it_says_so(written: Written, data: st.DataObject) -> None:
    size = data.draw(st.integers(0, written.head - 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cut.mcap"
        path.write_bytes(written.raw[:size])
        with pytest.raises(SourceError, match=r"cut\.mcap"):  # or all of the head was there
            raise_if_empty(path)


def raise_if_empty(path: Path) -> None:
    if list(open_log(path).blocks()) == []:
        raise SourceError(f"{path}: nothing in it")


def test_a_log_can_be_read_while_it_is_written(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap", HEADER, clock=iter(range(100)).__next__) as recorder:
        recorder.write(SAMPLES[:100], TICKS[:100])
        blocks = open_log(tmp_path / "a.mcap").blocks(10)
        next(blocks)
        recorder.write(SAMPLES[100:200], TICKS[100:200])
        assert sum(len(rows) for rows, _ in blocks) >= 90


# A process that ends without closing its log.

CHILD = """
import resource, sys
from pathlib import Path
from log_rows import HEADER, course
from twin.errors import SourceError
from twin.log.recorder import Recorder

path, limit = Path(sys.argv[1]), int(sys.argv[2])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
now = 0.0
samples, ticks = course(300_000)
with Recorder(path, HEADER, clock=lambda: now) as recorder:
    for start in range(0, len(samples), 30):
        now = (start + 30) / 1000
        try:
            recorder.write(samples[start : start + 30], ticks[start : start + 30])
        except SourceError as error:
            print(error, "|", error.hint, flush=True)
            break
        print(start + 30, flush=True)
"""


def child(path: Path, limit: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "error", "-c", CHILD, str(path), str(limit)],
        cwd=Path(__file__).parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_killed_process_loses_less_than_half_a_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with child(path, limit=0) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= 3_000:
                break
        process.kill()
        rest, _ = process.communicate()
    said = int(rest.split()[-1]) if rest.split() else int(line)
    log = open_log(path)
    assert not log.complete
    samples, _ = course(300_000)
    got, _ = rows_of(log)
    assert len(got) > (said - 500) * samples.itemsize  # rows are milliseconds
    assert samples.tobytes().startswith(got)
    report = recover(path, tmp_path / "saved.mcap")
    assert report.samples * samples.itemsize == len(got)
    assert rows_of(open_log(tmp_path / "saved.mcap"))[0] == got
    assert check(tmp_path / "saved.mcap").sound


def test_a_full_disk_leaves_a_readable_log(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    with child(path, limit=100_000) as process:
        out, err = process.communicate(timeout=60)
    assert err == ""  # closing said nothing more
    assert process.returncode == 0
    *progress, last = out.splitlines()
    assert last.startswith(f"{path}: cannot be written: File too large | make space")
    assert path.stat().st_size == 100_000
    got, _ = rows_of(open_log(path))
    assert len(got) > (int(progress[-1]) - 500) * SAMPLES.itemsize
    assert course(300_000)[0].tobytes().startswith(got)


# Bytes that changed.


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_changed_byte_is_never_taken_for_rows(written: Written, data: st.DataObject) -> None:
    position = data.draw(st.integers(written.head, len(written.raw) - 1))
    flip = data.draw(st.integers(1, 255))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        raw = bytearray(written.raw)
        raw[position] ^= flip
        path.write_bytes(raw)
        with suppress(SourceError):  # refused, or harmless
            assert rows_of(open_log(path)) == (SAMPLES.tobytes(), TICKS.tobytes())
        report = check(path)
        assert report.samples >= len(SAMPLES) - BLOCK
        saved = recover(path, Path(folder) / "saved.mcap")
        assert check(Path(folder) / "saved.mcap").samples == saved.samples == report.samples


def test_a_damaged_chunk_is_named_and_the_rest_is_saved(file: Path, written: Written) -> None:
    third = written.flushed[2][0]
    spoil(file, third + 300)
    with pytest.raises(SourceError, match=rf"a\.mcap: byte {third}: a chunk is damaged") as caught:
        rows_of(open_log(file))
    assert caught.value.hint.startswith(f"'twin log recover {file} -o")
    out = file.with_name("saved.mcap")
    report = recover(file, out)
    assert [(damage.position, damage.torn) for damage in report.damage] == [(third, False)]
    assert (report.samples, report.gaps, report.missing) == (1750, 1, 250)
    saved = open_log(out)
    kept = SAMPLES[:500].tobytes() + SAMPLES[750:].tobytes()
    assert rows_of(saved)[0] == kept
    assert list(saved.events()) == EVENTS
    assert saved.header.config_text == HEADER.config_text
    assert saved.header.metadata == HEADER.metadata | {"recovered_from": "a.mcap"}
    assert check(out).sound


def test_a_wrong_length_takes_no_other_chunk_along(file: Path, written: Written) -> None:
    chunk = written.flushed[1][0]
    index = chunk + 9 + int.from_bytes(written.raw[chunk + 1 : chunk + 9], "little")
    for position in (*range(chunk, chunk + 53), *range(index, index + 15)):
        for flip in (2, 255):
            file.write_bytes(written.raw)
            spoil(file, position, bytes([written.raw[position] ^ flip]))
            assert check(file).samples >= len(SAMPLES) - BLOCK, (position - chunk, flip)


def test_a_lost_place_is_found_again(file: Path, written: Written) -> None:
    second = written.flushed[1][0]
    spoil(file, second, bytes(40))  # the head of a chunk
    with pytest.raises(SourceError, match=f"byte {second}: not a record"):
        rows_of(open_log(file))
    report = check(file)
    assert (report.samples, report.missing) == (1750, 250)
    assert report.complete
    assert not report.sound


def test_an_unfinished_log_with_a_hole_is_damaged_not_torn(file: Path, written: Written) -> None:
    file.write_bytes(written.raw[: written.flushed[5][0]])
    spoil(file, written.flushed[1][0] + 1, b"\xff\xff\xff\xff")  # a chunk longer than the file
    with pytest.raises(SourceError, match="not a record"):
        rows_of(open_log(file))
    assert check(file).samples == 1000


def test_zeros_at_the_end_are_what_a_power_cut_leaves(file: Path, written: Written) -> None:
    file.write_bytes(written.raw[: written.flushed[3][0]] + bytes(5000))
    log = open_log(file)
    assert not log.complete
    assert rows_of(log)[0] == SAMPLES[:750].tobytes()


def test_a_damaged_configuration_is_not_used(file: Path, written: Written) -> None:
    spoil(file, written.raw.index(b"[asset]"))
    with pytest.raises(SourceError, match=r"the head of the log is damaged: .*checksum"):
        open_log(file)


# No logs.


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="No such file"):
        open_log(tmp_path / "a.mcap")


def test_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(SourceError, match="is empty"):
        open_log(tmp_path / "a.mcap")


def test_a_file_of_another_kind(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("time_s,suction\n0,1\n")
    with pytest.raises(SourceError, match="not an MCAP file"):
        open_log(tmp_path / "a.mcap")


def foreign(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.add_attachment(0, 0, "a.png", "image/png", b"\xff")
        writer.finish()


def rewrite(source: Path, target: Path) -> None:
    """As tools that filter or merge do: other numbers, other compression, the head at the end."""
    with source.open("rb") as old, target.open("wb") as new:
        reader = make_reader(old)
        writer = Writer(new, chunk_size=5000, compression=CompressionType.LZ4)
        writer.start()
        writer.register_channel("/other", "json", 0)
        numbers: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in numbers:
                of = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(channel.topic, "protobuf", of)
            times = message.log_time, message.data, message.publish_time
            writer.add_message(numbers[channel.id], *times)
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, "application/toml", attachment.data)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()


def test_a_log_that_went_through_another_tool(file: Path) -> None:
    rewrite(file, file.with_name("b.mcap"))
    log = open_log(file.with_name("b.mcap"))
    assert log.header == HEADER
    assert rows_of(log) == (SAMPLES.tobytes(), TICKS.tobytes())
    assert sorted(event.text for event in log.events()) == sorted(event.text for event in EVENTS)
    assert check(log.path).sound


def test_damage_in_a_log_that_went_through_another_tool(file: Path) -> None:
    other = file.with_name("b.mcap")
    rewrite(file, other)
    second = other.read_bytes().index(b"lz4", other.read_bytes().index(b"lz4") + 3)
    spoil(other, second + 200)
    report = check(other)
    assert 0 < report.samples < len(SAMPLES)
    assert len(report.damage) == 1
    assert not report.sound


def test_a_log_of_another_program(tmp_path: Path) -> None:
    foreign(tmp_path / "a.mcap")
    with pytest.raises(SourceError, match=r"another program: it has no /samples") as caught:
        open_log(tmp_path / "a.mcap")
    assert caught.value.hint


def test_a_folder(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="Is a directory"):
        open_log(tmp_path)


# Check and recover.


def test_a_sound_log(file: Path) -> None:
    report = check(file)
    assert report == Report(
        path=file,
        parts=1,
        complete=True,
        damage=(),
        samples=2000,
        events=3,
        duration_s=pytest.approx(1.999),
        gaps=0,
        missing=0,
        unseen_s=0.0,
        restarts=0,
        time_back=0,
        bytes_per_sample=file.stat().st_size / 2000,
    )
    assert report.sound


def test_a_report_is_for_people(file: Path, written: Written) -> None:
    assert str(check(file)).splitlines() == [
        f"{file}: 2000 rows, 2.0 s, 3 events",
        "gaps: 0, 0 rows missing",
        f"size: {len(written.raw) / 2000:.1f} bytes a row, parts: 1",
        "state: complete",
    ]
    end = written.flushed[-1][0]
    file.write_bytes(written.raw[: end - 1])
    assert "state: unfinished" in str(check(file))
    spoil(file, written.flushed[2][0] + 300)
    said = str(check(file))
    assert "gaps: 1, 250 rows missing, 0.3 s not seen" in said
    assert "state: damaged" in said
    assert f"unreadable: {file}: byte {written.flushed[2][0]}: a chunk is damaged" in said


def test_what_is_in_the_stream_is_counted(tmp_path: Path) -> None:
    samples, ticks = course(300)
    samples["sequence"][100:] += 7
    samples["sequence"][200:] += 5
    samples["time_ns"][250:] -= 3_600_000_000_000
    samples["quality"][250] = Quality.CLOCK
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks)
    report = check(tmp_path / "a.mcap")
    assert (report.gaps, report.missing, report.time_back) == (2, 12, 1)
    assert report.duration_s == pytest.approx(0.298)


def test_a_restart_is_a_gap_as_long_as_nothing_came(tmp_path: Path) -> None:
    """What ran meanwhile was never seen, though the sequence begins anew without a hole."""
    samples, ticks = course(300)
    samples["sequence"][100:] -= samples["sequence"][100]
    for name in ("time_ns", "host_ns"):
        samples[name][100:] += 5_600_000_000
    samples["quality"][100] = Quality.RESTART
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks)
    report = check(tmp_path / "a.mcap")
    assert (report.gaps, report.missing, report.restarts) == (1, 0, 1)
    assert report.unseen_s == pytest.approx(5.601, abs=2e-3)
    assert (
        "gaps: 1, how many rows are missing is not known, 5.6 s not seen, 1 of them a restart"
        in str(report)
    )


def test_a_log_in_parts_is_recovered_as_one(tmp_path: Path) -> None:
    samples, ticks = course(20_000)
    now = iter(range(10_000))
    with Recorder(tmp_path / "a.mcap", HEADER, 40_000, clock=now.__next__) as recorder:
        for start in range(0, len(samples), 500):
            rows = slice(start, start + 500)
            recorder.write(samples[rows], ticks[rows], EVENTS[:1] if start == 9500 else ())
    parts = open_log(tmp_path / "a.mcap").parts
    assert len(parts) > 3
    parts[2].write_bytes(parts[2].read_bytes()[:-30])
    assert not open_log(tmp_path / "a.mcap").complete
    report = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert (report.parts, report.samples, report.missing) == (len(parts), 20_000, 0)
    saved = open_log(tmp_path / "b.mcap")
    assert rows_of(saved) == (samples.tobytes(), ticks.tobytes())
    assert list(saved.events()) == EVENTS[:1]
    assert len(saved.parts) == 1


def test_a_part_whose_writer_died_at_once_is_not_complete(tmp_path: Path) -> None:
    samples, ticks = course(9000)
    with Recorder(tmp_path / "a.mcap", HEADER, 20_000, clock=iter(range(99)).__next__) as recorder:
        for start in range(0, len(samples), 500):
            recorder.write(samples[start : start + 500], ticks[start : start + 500])
    log = open_log(tmp_path / "a.mcap")
    log.parts[-1].write_bytes(b"")
    shorter = open_log(tmp_path / "a.mcap")
    assert shorter.parts == log.parts[:-1]
    assert not shorter.complete


def test_recover_does_not_overwrite(file: Path) -> None:
    before = file.read_bytes()
    with pytest.raises(SourceError, match="there is already a log"):
        recover(file, file)
    assert file.read_bytes() == before


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Reading holds a few chunks, whatever the length."""
    import tracemalloc

    path = tmp_path / "a.mcap"
    samples, ticks = course(100_000)
    with Recorder(path, HEADER) as recorder:
        for lap in range(5):
            samples["sequence"] += 100_000 * (lap > 0)
            recorder.write(samples, ticks)
    tracemalloc.start()
    try:
        assert sum(len(rows) for rows, _ in open_log(path).blocks()) == 500_000
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 12e6  # the rows are 21 MB, a chunk 1 MB
