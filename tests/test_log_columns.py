"""The coding of rows: lossless whatever they hold and however they are cut."""

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from log_rows import awkward, course

from twin.log.columns import RowBuffer, decode, encode
from twin.log.schema import SAMPLES
from twin.signals import SAMPLE, TICK, Samples, Ticks

WIDTH = SAMPLE.itemsize + TICK.itemsize


def rows_from(raw: bytes) -> tuple[Samples, Ticks]:
    n = len(raw) // WIDTH
    cut = n * SAMPLE.itemsize
    return np.frombuffer(raw[:cut], SAMPLE), np.frombuffer(raw[cut : n * WIDTH], TICK)


@given(st.binary(min_size=WIDTH, max_size=40 * WIDTH))
@example(awkward()[0].tobytes() + awkward()[1].tobytes())
def test_any_bits_come_back(raw: bytes) -> None:
    samples, ticks = rows_from(raw)
    back = decode(encode(samples, ticks))
    assert back[0].tobytes() == samples.tobytes()
    assert back[1].tobytes() == ticks.tobytes()


def test_columns_that_run_regularly_cost_nothing() -> None:
    samples, ticks = course(10_000)
    message = SAMPLES.message.FromString(encode(samples, ticks))
    assert len(message.sequence) == 8 + 10_000  # one byte plane, all ones
    assert len(message.quality) == 8  # constant: the first value stands for all
    assert message.count == 10_000


def test_the_coding_is_the_one_written_in_the_schema() -> None:
    """Decode a column by the words of the schema's comment, not with our own decoder."""
    samples, ticks = course(300)
    message = SAMPLES.message.FromString(encode(samples, ticks))
    data = message.expected
    k = (len(data) - 8) // message.count
    bits = int.from_bytes(data[:8], "little", signed=True)
    for i in range(message.count):
        z = sum(data[8 + j * message.count + i] << (8 * j) for j in range(k))
        bits += (z >> 1) ^ -(z & 1)
        value = np.array([bits], "<i4").view("<f4")[0]
        assert value == ticks["expected"][i]


def test_a_missing_column_is_refused() -> None:
    message = SAMPLES.message.FromString(encode(*course(5)))
    message.ClearField("supply")
    with pytest.raises(ValueError, match="supply is not packed for 5 rows"):
        decode(message.SerializeToString())


@given(st.data())
def test_what_is_broken_off_or_changed_is_refused_or_rows(data: st.DataObject) -> None:
    """Never more than the bytes that are there is read: compiled code would not notice."""
    packed = bytearray(encode(*course(20)))
    del packed[data.draw(st.integers(1, len(packed))) :]
    for _ in range(data.draw(st.integers(0, 3))):
        packed[data.draw(st.integers(0, len(packed) - 1))] = data.draw(st.integers(0, 255))
    try:
        samples, ticks = decode(bytes(packed))
    except (ValueError, MemoryError):
        return
    assert len(samples) == len(ticks) > 0


def test_fields_of_later_programs_are_passed_over() -> None:
    samples, ticks = course(5)
    later = b"\xf8\x07\x2a" + b"\xfa\x07\x03abc" + b"\x80\x08\x01"  # numbers 127 and 128
    packed = encode(samples, ticks)
    for either in (later + packed, packed + later):
        assert decode(either)[0].tobytes() == samples.tobytes()


def test_a_log_from_before_a_column_was_added_is_read() -> None:
    samples, ticks = course(5)
    ticks["signals"] = [0, 1, 1, 3, 2]
    message = SAMPLES.message.FromString(encode(samples, ticks))
    assert decode(message.SerializeToString())[1]["signals"].tolist() == [0, 1, 1, 3, 2]
    message.ClearField("signals")
    before, beside = decode(message.SerializeToString())
    ticks["signals"] = 0
    assert (before.tobytes(), beside.tobytes()) == (samples.tobytes(), ticks.tobytes())


@given(st.lists(st.integers(0, 70)), st.integers(1, 50))
def test_a_tray_changes_the_cuts_and_nothing_else(lengths: list[int], size: int) -> None:
    samples, ticks = course(sum(lengths))
    out = list(through_tray(samples, ticks, lengths, size))
    assert all(len(block) == size for block, _ in out[:-1])
    assert b"".join(block.tobytes() for block, _ in out) == samples.tobytes()
    assert b"".join(block.tobytes() for _, block in out) == ticks.tobytes()


def through_tray(
    samples: Samples, ticks: Ticks, lengths: list[int], size: int
) -> Iterator[tuple[Samples, Ticks]]:
    tray = RowBuffer(size)
    start = 0
    for length in lengths:
        yield from tray.add(samples[start : start + length], ticks[start : start + length])
        start += length
    yield tray.take()


def test_what_a_tray_gave_away_is_not_overwritten() -> None:
    samples, ticks = course(20)
    tray = RowBuffer(10)
    first, second = tray.add(samples, ticks)
    assert first[0].tobytes() == samples[:10].tobytes()
    assert second[0].tobytes() == samples[10:].tobytes()
