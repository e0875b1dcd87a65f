"""What goes into a log comes out of it, here and in other programs, in time and in parts."""

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given, settings
from hypothesis import strategies as st
from log_rows import EVENTS, HEADER, START_NS, awkward, course, rows_of
from mcap.reader import make_reader

from twin.errors import SourceError
from twin.events import Event, Kind
from twin.log.part import first_parts
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.signals import SAMPLE, TICK, Command, Samples, Ticks


class Clock:
    """Time as the test wants it."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def record(
    path: Path, samples: Samples, ticks: Ticks, block: int = 30, rotate_bytes: int | None = None
) -> None:
    """Write rows as a live run would: a millisecond each, by the clock."""
    clock = Clock()
    with Recorder(path, HEADER, rotate_bytes, clock) as recorder:
        for start in range(0, len(samples), block):
            clock.now = (start + block) / 1000
            recorder.write(samples[start : start + block], ticks[start : start + block])


@pytest.mark.parametrize("block", [1, 30, 700, 25_000])
def test_rows_come_back_in_order_to_the_bit(tmp_path: Path, block: int) -> None:
    samples, ticks = course(25_000 if block > 1 else 400)
    record(tmp_path / "a.mcap", samples, ticks, block)
    log = open_log(tmp_path / "a.mcap")
    assert log.complete
    assert rows_of(log) == (samples.tobytes(), ticks.tobytes())
    assert [len(rows) for rows, _ in log.blocks(7000)][:-1] == [7000] * (len(samples) // 7000)
    for _ in range(2):  # they are read anew
        assert b"".join(rows.tobytes() for rows in log.samples) == samples.tobytes()


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.sampled_from([0.0, 0.01, 0.3, 1.5])),
        max_size=12,
    ),
    st.integers(1, 50),
)
def test_however_the_blocks_and_the_time_fall(cuts: list[tuple[int, float]], size: int) -> None:
    samples, ticks = course(sum(length for length, _ in cuts))
    samples[: len(awkward()[0])] = awkward()[0][: len(samples)]
    clock, start = Clock(), 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with Recorder(path, HEADER, clock=clock) as recorder:
            for length, pause in cuts:
                recorder.write(samples[start : start + length], ticks[start : start + length])
                start += length
                clock.now += pause
        assert rows_of(open_log(path), size) == (samples.tobytes(), ticks.tobytes())


def test_the_header_comes_back(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", *course(0))
    log = open_log(tmp_path / "a.mcap")
    assert log.header == HEADER
    assert log.complete
    assert list(log.blocks()) == []


def test_events_come_back(tmp_path: Path) -> None:
    samples, ticks = course(100)
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples[:0], ticks[:0], EVENTS[2:])  # before there is any row
        recorder.write(samples, ticks, EVENTS[:2])
    assert list(open_log(tmp_path / "a.mcap").events()) == [*EVENTS[2:], *EVENTS[:2]]


def test_numbers_of_numpy_are_fine_in_an_event(tmp_path: Path) -> None:
    data: Any = {"a": np.float32(0.5), "b": np.int64(3)}
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(*course(1), [Event(START_NS, Kind.CYCLE, "", data)])
    (event,) = open_log(tmp_path / "a.mcap").events()
    assert event.data == {"a": 0.5, "b": 3}


def test_an_event_that_json_cannot_hold_is_logged_and_says_so(tmp_path: Path) -> None:
    samples, ticks = course(100)
    odd: dict[Any, Any] = {"raw": b"\xff", "nan": np.nan, ("a", 1): {1}, "cycle": 7}
    happened = [
        Event(START_NS, Kind.CYCLE, "half a \ud800 character", odd),
        Event(START_NS, Kind.CYCLE, "the next"),
    ]
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks, happened)
    log = open_log(tmp_path / "a.mcap")
    assert rows_of(log)[0] == samples.tobytes()
    first, second = log.events()
    assert first.text == "half a \\ud800 character"
    assert first.data["raw"] == r"not JSON (bytes): b'\xff'"
    assert (first.data["nan"], first.data["('a', 1)"], first.data["cycle"]) == (None, [1], 7)
    assert second.text == "the next"


def test_the_recorder_may_not_be_handed_unequal_rows(tmp_path: Path) -> None:
    samples, ticks = course(10)
    with (
        Recorder(tmp_path / "a.mcap", HEADER) as recorder,
        pytest.raises(ValueError, match="10 samples but 9 ticks"),
    ):
        recorder.write(samples, ticks[:9])


def test_a_driver_may_reuse_its_block(tmp_path: Path) -> None:
    samples, ticks = course(20)
    block = samples[:10].copy()
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(block, ticks[:10])
        block[:] = samples[10:]
        recorder.write(block, ticks[10:])
    assert rows_of(open_log(tmp_path / "a.mcap"))[0] == samples.tobytes()


# What other programs see: read with the library's reader and the schemas in the file alone.


def messages(path: Path, topic: str) -> list[tuple[Any, Any]]:
    """MCAP message and decoded protobuf of each message on a topic."""
    found = []
    with path.open("rb") as file:
        for schema, _, message in make_reader(file, validate_crcs=True).iter_messages([topic]):
            assert schema is not None
            pool = descriptor_pool.DescriptorPool()
            for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(each)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found.append((message, kind.FromString(message.data)))
    return found


def seconds(message: Any) -> int:
    return int(message.timestamp.seconds * 10**9 + message.timestamp.nanos)


def test_other_programs_find_the_summary(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", *course(3000))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        topics = {channel.topic: number for number, channel in summary.channels.items()}
        assert set(topics) == {"/samples", "/scalars", "/events", "/log"}
        counts = summary.statistics.channel_message_counts
        assert counts[topics["/samples"]] == summary.statistics.chunk_count == 12
        assert summary.statistics.message_start_time <= START_NS + 40_000_000
        (attachment,) = reader.iter_attachments()
        assert attachment.data.decode() == HEADER.config_text
        names = {record.name: record.metadata for record in reader.iter_metadata()}
        assert names["run"] == HEADER.metadata
        assert names["ejector-twin"]["asset_id"] == "robot 7, left"


def test_scalars_are_drawable(tmp_path: Path) -> None:
    samples, ticks = course(2500, block=50)
    samples["pressure"][100] = np.nan
    samples["host_ns"] = samples["time_ns"] + 5_000_000
    record(tmp_path / "a.mcap", samples, ticks, block=70)
    found = messages(tmp_path / "a.mcap", "/scalars")
    rows = [(seconds(scalars) - START_NS) // 1_000_000 for _, scalars in found]
    assert rows == [*range(0, 2500, 20)]  # commands change on the grid here
    for row, (message, scalars) in zip(rows, found, strict=True):
        assert message.publish_time == samples["time_ns"][row] == seconds(scalars)
        assert message.log_time == samples["host_ns"][row]
        measured = 1000 - float(samples["pressure"][row]) / 100
        expected = 1000 - float(ticks["expected"][row]) / 100
        assert scalars.vacuum_mbar == pytest.approx(measured, nan_ok=True)
        assert scalars.expected_vacuum_mbar == pytest.approx(expected)
        assert scalars.deviation_mbar == pytest.approx(expected - measured, nan_ok=True, abs=1e-6)
        assert scalars.supply_bar == pytest.approx(float(samples["supply"][row]) / 1e5)
        assert scalars.suction == bool(samples["commands"][row] & Command.SUCTION)
        assert scalars.blow_off == bool(samples["commands"][row] & Command.BLOW_OFF)
        assert scalars.phase == ticks["phase"][row]


def test_scalars_show_a_short_pulse(tmp_path: Path) -> None:
    samples, ticks = course(180)
    samples["commands"][103:106] = Command.BLOW_OFF
    record(tmp_path / "a.mcap", samples, ticks, block=1)
    blowing = [
        (seconds(scalars) - START_NS) // 1_000_000
        for _, scalars in messages(tmp_path / "a.mcap", "/scalars")
        if scalars.blow_off
    ]
    assert blowing == [103]


def test_events_are_shown_when_they_happened(tmp_path: Path) -> None:
    samples, ticks = course(1000)
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks, EVENTS[:2])
    (gap, log), _ = zip(
        messages(tmp_path / "a.mcap", "/events"), messages(tmp_path / "a.mcap", "/log"), strict=True
    )
    for message, _ in (gap, log):
        assert message.log_time == samples["host_ns"][40]
        assert message.publish_time == samples["time_ns"][40]
    assert (gap[1].kind, gap[1].severity, gap[1].data_json) == ("gap", "warning", '{"missing": 12}')
    assert (log[1].level, log[1].message, log[1].name) == (3, "12 samples are missing", "gap")


def test_an_event_was_received_with_the_last_row_that_is_not_later(tmp_path: Path) -> None:
    samples, ticks = course(60)
    samples["host_ns"] = START_NS + 10**9 + np.arange(60)
    samples["time_ns"][40:] -= 30_000_000  # the PLC's clock was set back by thirty rows
    # By microseconds; of what was before all of them, the last one.
    rows = {-1000: 59, 0: 0, 5000: 5, 5500: 5, 20_000: 50, 35_000: 59}
    events = [Event(START_NS + us * 1000, Kind.CYCLE, "") for us in rows]
    with Recorder(tmp_path / "a.mcap", HEADER) as recorder:
        recorder.write(samples, ticks, events)
    found = [message for message, _ in messages(tmp_path / "a.mcap", "/events")]
    received = {(message.publish_time - START_NS) // 1000: message.log_time for message in found}
    assert received == {us: samples["host_ns"][row] for us, row in rows.items()}


def test_times_before_1970_are_kept_in_the_columns(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", *awkward())
    assert rows_of(open_log(tmp_path / "a.mcap"))[0] == awkward()[0].tobytes()
    assert [message.log_time for message, _ in messages(tmp_path / "a.mcap", "/samples")] == [0]


@pytest.mark.parametrize(("step", "limit"), [(50.0, 7.5), (10.0, 8.0), (1e5 / 27648, 9.0)])
def test_a_live_log_is_small(tmp_path: Path, step: float, limit: float) -> None:
    samples, ticks = course(40_000, step)
    record(tmp_path / "a.mcap", samples, ticks)
    record(tmp_path / "head.mcap", samples[:0], ticks[:0])
    written = (tmp_path / "a.mcap").stat().st_size - (tmp_path / "head.mcap").stat().st_size
    assert written / len(samples) < limit  # scalars and indexes included


# Time: what is flushed and synced when.


def test_nothing_is_held_back_for_longer_than_a_quarter_second_and_the_first_rows_not_at_all(
    tmp_path: Path,
) -> None:
    samples, ticks = course(400)
    clock = Clock()
    path = tmp_path / "a.mcap"
    with Recorder(path, HEADER, clock=clock) as recorder:
        clock.now = 0.1
        recorder.write(samples[:100], ticks[:100])
        assert rows_of(open_log(path))[0] == samples[:100].tobytes()
        clock.now = 0.2
        recorder.write(samples[100:200], ticks[100:200])
        assert rows_of(open_log(path))[0] == samples[:100].tobytes()
        clock.now = 0.4
        recorder.write(samples[200:300], ticks[200:300], EVENTS[:1])
        log = open_log(path)
        assert not log.complete
        assert rows_of(log)[0] == samples[:300].tobytes()
        assert list(log.events()) == EVENTS[:1]
        clock.now = 0.41
        recorder.write(samples[300:], ticks[300:])
        assert rows_of(open_log(path))[0] == samples[:300].tobytes()
        recorder.write(samples[:0], ticks[:0])  # the PLC has nothing: no reason to wait
        assert rows_of(open_log(path))[0] == samples.tobytes()


def test_the_disk_is_asked_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    clock = Clock()
    monkeypatch.setattr(os, "fdatasync", lambda _: asked.append(clock.now))
    samples, ticks = course(100)
    with Recorder(tmp_path / "a.mcap", HEADER, clock=clock) as recorder:
        for quarter in range(40):
            clock.now = quarter * 0.25
            recorder.write(samples, ticks)
        during = len(asked)
    assert 1 <= during <= 10
    assert len(asked) in (during + 1, during + 2)  # one may have been under way; one at close


# Parts.


def test_a_log_goes_on_in_parts(tmp_path: Path) -> None:
    samples, ticks = course(20_000)
    record(tmp_path / "run.mcap", samples, ticks, rotate_bytes=40_000)
    log = open_log(tmp_path / "run.mcap")
    assert [part.name for part in log.parts][:3] == ["run.mcap", "run.0001.mcap", "run.0002.mcap"]
    assert log.complete
    assert rows_of(log) == (samples.tobytes(), ticks.tobytes())
    second = open_log(log.parts[1])
    assert second.header == HEADER
    assert second.parts == (log.parts[1],)
    assert rows_of(second)[0] in samples.tobytes()


def test_where_the_first_parts_are_gone_the_next_one_begins_the_log(tmp_path: Path) -> None:
    samples, ticks = course(20_000)
    record(tmp_path / "run.mcap", samples, ticks, rotate_bytes=40_000)
    parts = open_log(tmp_path / "run.mcap").parts
    assert len(parts) > 3
    for part in parts[:2]:
        part.unlink()
    assert first_parts(tmp_path) == [parts[2]]
    log = open_log(parts[2])
    assert log.parts == parts[2:]
    assert samples.tobytes().endswith(rows_of(log)[0])
    assert open_log(parts[3]).parts == (parts[3],)


def test_parts_of_another_log_are_not_read(tmp_path: Path) -> None:
    samples, ticks = course(20_000)
    record(tmp_path / "run.mcap", samples, ticks, rotate_bytes=80_000)
    (tmp_path / "run.mcap").unlink()
    record(tmp_path / "other.mcap", samples[:100], ticks[:100])
    (tmp_path / "other.mcap").rename(tmp_path / "run.mcap")
    assert rows_of(open_log(tmp_path / "run.mcap"))[0] == samples[:100].tobytes()


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", *course(9000), rotate_bytes=20_000)
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(SourceError, match=r"run\.mcap: there is already"):
        Recorder(tmp_path / "run.mcap", HEADER)
    assert (tmp_path / "run.mcap").read_bytes() == before
    (tmp_path / "run.mcap").unlink()
    with pytest.raises(SourceError, match="there is already"):  # its parts are still there
        Recorder(tmp_path / "run.mcap", HEADER)


# Trouble.


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"nowhere/a\.mcap: cannot be written: No such file"):
        Recorder(tmp_path / "nowhere" / "a.mcap", HEADER)


def full_after(writes: int) -> Callable[[Any, bytes], None]:
    """Stand in for Output.write on a disk that takes so many pieces and a half."""

    def write(output: Any, data: bytes) -> None:
        nonlocal writes
        writes -= len(data) > 0
        if writes < 0:
            output._raw.write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        output._raw.write(data)

    return write


@pytest.mark.parametrize("writes", [0, 3, 5, 6, 7, 20])
def test_a_full_disk_is_told_once_and_costs_no_flushed_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    monkeypatch.setattr("twin.log.disk_file.Output.write", full_after(writes))
    samples, ticks = course(10_000)
    with pytest.raises(SourceError, match=r"a\.mcap: cannot be written: No space left") as caught:
        record(tmp_path / "a.mcap", samples, ticks, block=250)
    assert caught.value.__context__ is caught.value.__cause__  # no second error on top
    flushed = (writes - 4) // 2  # a chunk and its index, after what is written in 5 pieces:
    if writes >= 5:  # magic, header, two metadata, attachment
        log = open_log(tmp_path / "a.mcap")
        assert not log.complete
        assert rows_of(log)[0] == samples[: 250 * flushed].tobytes()


def test_after_a_failure_writing_says_so_again_and_closing_is_quiet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path / "a.mcap", HEADER)
    monkeypatch.setattr("twin.log.disk_file.Output.write", full_after(0))
    for _ in range(2):
        with pytest.raises(SourceError, match="No space left"):
            recorder.write(*course(0), EVENTS)
    recorder.close()


def test_a_full_disk_at_the_very_end_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder(tmp_path / "a.mcap", HEADER, clock=Clock())
    recorder.write(*course(10))
    monkeypatch.setattr("twin.log.disk_file.Output.write", full_after(0))
    with pytest.raises(SourceError, match="No space left"):
        recorder.close()
    recorder.close()


@pytest.mark.parametrize("rows", [0, 10])
def test_a_failing_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    clock = Clock()
    recorder = Recorder(tmp_path / "a.mcap", HEADER, clock=clock)
    monkeypatch.setattr(os, "fdatasync", fail)
    clock.now = 1.0 if rows else 0.0  # with rows the disk is asked before closing
    recorder.write(*course(rows))
    with pytest.raises(SourceError, match="cannot be written: Input/output error"):
        recorder.close()
    recorder.close()


def test_rows_are_of_the_dtypes_promised(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", *course(10))
    ((samples, ticks),) = open_log(tmp_path / "a.mcap").blocks()
    assert (samples.dtype, ticks.dtype) == (SAMPLE, TICK)
    samples["pressure"] = 0  # they are the caller's own
