"""Rows to packed columns and back, lossless to the bit.

Neighbouring rows differ little, so the coding stores the differences of their bits. Floats of
similar size have similar bits too. The differences are laid out byte plane by byte plane. Most of
these bytes are zero or repeat, and the chunk's compression removes them. twin.log.schema specifies
the coding.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.files import require_within_budget
from twin.log.schema import ADDED, COLUMNS, SAMPLES
from twin.model.compiled import compiled, per_row
from twin.signals import EXTRA, SAMPLE, TICK, Samples, Ticks

_Layout = npt.NDArray[np.int64]
_Bytes = npt.NDArray[np.uint8]
_Bools = npt.NDArray[np.bool_]
_Steps = npt.NDArray[np.int32] | npt.NDArray[np.int64]

_FIRST_ROW_BYTES = 8  # bytes of the first row's bits
_MAX_PLANES = 8  # byte planes
_TILE = 512  # rows unpacked at a time: with all their columns they fit into the cache
_ONE = np.uint64(1)
_FIELDS = SAMPLES.message.DESCRIPTOR.fields_by_name
_NUMBERS = np.array([_FIELDS[name].number for name in COLUMNS])
_MAX_NUMBER = int(_NUMBERS.max())
_IS_OPTIONAL = np.array([name in ADDED for name in COLUMNS])
_VARINT, _BYTES = 0, 2  # protobuf's wire types


def _layout(rows: np.dtype[np.void]) -> _Layout:
    """Offset and width of each field, in bytes."""
    fields = (rows.fields or {}).values()
    return np.array([(offset, field.itemsize) for field, offset, *_ in fields])


_SAMPLE_LAYOUT, _TICK_LAYOUT = _layout(SAMPLE), _layout(TICK)
_EXTRA_FROM = int(_SAMPLE_LAYOUT[-len(EXTRA), 0])  # these fields come last in a row


def encode(samples: Samples, ticks: Ticks) -> bytes:
    """Pack n > 0 row-aligned rows into a serialised ``ejector_twin.Samples``."""
    message = SAMPLES.message(count=len(samples))
    buffer = np.empty(_FIRST_ROW_BYTES + _MAX_PLANES * len(samples), np.uint8)
    columns = iter(COLUMNS)
    for rows, layout in ((samples, _SAMPLE_LAYOUT), (ticks, _TICK_LAYOUT)):
        raw = np.ascontiguousarray(rows).view(np.uint8)
        raw.flags.writeable = False  # like rows of a file, so that numba compiles for one type
        extra_is_zero = rows is samples and _ends_in_zeros(raw, rows.itemsize, _EXTRA_FROM)
        for offset, width in layout.tolist():
            name = next(columns)
            if name in EXTRA and (extra_is_zero or _is_zero(raw, rows.itemsize, offset, width)):
                continue
            length = _pack(raw, rows.itemsize, offset, width, buffer)
            setattr(message, name, buffer[:length].tobytes())
    packed: bytes = message.SerializeToString()
    return packed


def decode(packed: bytes | memoryview) -> tuple[Samples, Ticks]:
    """Reverse ``encode``; ValueError if the bytes are no such message.

    Protobuf's own classes would copy each column twice, so they are not used.
    """
    raw = np.frombuffer(packed, np.uint8)
    spans = np.zeros((_MAX_NUMBER + 1, 2), np.int64)
    count = _parse_fields(raw, spans)
    if count < 1:
        raise ValueError("it is no message of rows")
    require_within_budget(count * (SAMPLE.itemsize + TICK.itemsize), f"a message of {count} rows")
    spans = spans[_NUMBERS]
    if (invalid := _first_invalid_column(spans, count, _IS_OPTIONAL)) >= 0:
        raise ValueError(f"{COLUMNS[invalid]} is not packed for {count} rows")
    samples, ticks = np.zeros(count, SAMPLE), np.zeros(count, TICK)
    sample_spans, tick_spans = spans[: len(_SAMPLE_LAYOUT)], spans[len(_SAMPLE_LAYOUT) :]
    _unpack(raw, sample_spans, _SAMPLE_LAYOUT, count, samples.view(np.uint8))
    _unpack(raw, tick_spans, _TICK_LAYOUT, count, ticks.view(np.uint8))
    return samples, ticks


# Compiled. Positions are unsigned integers: then the compiler turns the loops over bytes into one
# instruction for the whole field.


@per_row
def _read(raw: _Bytes, position: np.uint64, width: int) -> np.uint64:
    """Bits of ``width`` little-endian bytes, without sign extension."""
    bits = np.uint64(0)
    for j in range(width):
        bits |= np.uint64(raw[position + np.uint64(j)]) << np.uint64(8 * j)
    return bits


@compiled
def _ends_in_zeros(rows: _Bytes, size: int, offset: int) -> bool:
    """Whether all fields from ``offset`` on are zero in all rows, to the bit. It is a fast test."""
    any_bits = np.uint64(0)
    words = (size - offset) // 8
    for begin in range(0, len(rows), size):
        for word in range(words):
            any_bits |= _read(rows, np.uint64(begin + offset + 8 * word), 8)
        for position in range(begin + offset + 8 * words, begin + size):
            any_bits |= np.uint64(rows[position])
    return any_bits == 0


@compiled
def _is_zero(rows: _Bytes, size: int, offset: int, width: int) -> bool:
    """Whether a field is zero in all rows, to the bit."""
    any_bits = np.uint64(0)
    for position in range(offset, len(rows), size):
        any_bits |= _read(rows, np.uint64(position), width)
    return any_bits == 0


@compiled
def _pack(rows: _Bytes, size: int, offset: int, width: int, packed: _Bytes) -> int:
    """Pack one field of all rows into the first bytes of ``packed``; returns their number."""
    n = len(rows) // size
    zigzag = np.empty(n, np.uint64)
    position = np.uint64(offset)
    previous = any_bits = np.uint64(0)
    for i in range(n):
        if width == 8:
            bits = _read(rows, position, 8)
        elif width == 4:
            bits = np.uint64(np.int32(_read(rows, position, 4)))
        else:
            bits = np.uint64(np.int8(rows[position]))
        position += np.uint64(size)
        if i == 0:
            previous = bits
            for j in range(_FIRST_ROW_BYTES):
                packed[j] = bits >> np.uint64(8 * j)
        step = bits - previous  # wraps, and wraps back
        zigzag[i] = (step << _ONE) ^ (np.uint64(0) - (step >> np.uint64(63)))
        any_bits |= zigzag[i]
        previous = bits
    planes = 0
    while planes < _MAX_PLANES and any_bits >> np.uint64(8 * planes):
        plane = packed[_FIRST_ROW_BYTES + planes * n :]
        for i in range(n):
            plane[i] = zigzag[i] >> np.uint64(8 * planes)
        planes += 1
    return _FIRST_ROW_BYTES + planes * n


@per_row
def _varint(packed: _Bytes, position: int) -> tuple[int, int]:
    """A varint of protobuf and the position after it; past the end if the varint is cut off."""
    number: Any = np.int64(0)
    for j in range(10):
        if position >= len(packed):
            break
        byte = np.int64(packed[position])
        position += 1
        number |= (byte & 0x7F) << (7 * j)
        if byte < 0x80:
            return number, position
    return number, len(packed) + 1


@compiled
def _parse_fields(packed: _Bytes, spans: _Layout) -> int:
    """Fill ``spans`` with begin and end of each field by its number.

    Returns the count of rows, or -1 if the message is no ``Samples``.
    """
    count = position = 0
    while position < len(packed):
        tag, position = _varint(packed, position)
        number, position = _varint(packed, position)
        if tag & 7 == _VARINT:
            count = number if tag >> 3 == 1 else count
        elif tag & 7 == _BYTES and 0 <= number <= len(packed) - position:
            if 0 <= tag >> 3 < len(spans):
                spans[tag >> 3] = position, position + number
            position += number
        else:
            return -1
    return count if position == len(packed) else -1


@compiled
def _first_invalid_column(spans: _Layout, count: int, is_optional: _Bools) -> int:
    """The first column whose length does not fit whole planes; -1 if all columns fit."""
    for column in range(len(spans)):
        length = spans[column, 1] - spans[column, 0]
        planes = length - _FIRST_ROW_BYTES
        fits = 0 <= planes <= _MAX_PLANES * count and planes % count == 0
        if not fits and not (is_optional[column] and length == 0):
            return column
    return -1


@compiled
def _decode_steps(packed: _Bytes, position: int, n: int, planes: int, steps: _Steps) -> None:
    """Differences of some rows, the first at ``position`` in planes of ``n`` bytes.

    Works for one to four planes, which is nearly always. One instruction decodes several rows.
    """
    m = len(steps)
    a = packed[position : position + m]
    if planes == 1:
        for i in range(m):
            z = np.uint32(a[i])
            steps[i] = np.int32((z >> np.uint32(1)) ^ (np.uint32(0) - (z & np.uint32(1))))
        return
    zeros = np.zeros(m, np.uint8)
    b = packed[position + n : position + n + m] if planes > 1 else zeros
    c = packed[position + 2 * n : position + 2 * n + m] if planes > 2 else zeros
    d = packed[position + 3 * n : position + 3 * n + m] if planes > 3 else zeros
    for i in range(m):
        low = np.uint32(a[i]) | np.uint32(b[i]) << np.uint32(8)
        high = np.uint32(c[i]) | np.uint32(d[i]) << np.uint32(8)
        z = low | high << np.uint32(16)
        steps[i] = np.int32((z >> np.uint32(1)) ^ (np.uint32(0) - (z & np.uint32(1))))


@compiled
def _decode_wide_steps(packed: _Bytes, position: int, n: int, planes: int, steps: _Steps) -> None:
    """As ``_decode_steps``, for any number of planes."""
    for i in range(len(steps)):
        z = np.uint64(0)
        for j in range(planes):
            z |= np.uint64(packed[position + j * n + i]) << np.uint64(8 * j)
        steps[i] = np.int64((z >> _ONE) ^ (np.uint64(0) - (z & _ONE)))


@per_row
def _write(bits: np.uint64, rows: _Bytes, position: np.uint64, width: int) -> None:
    for j in range(width):
        rows[position + np.uint64(j)] = np.uint8(bits >> np.uint64(8 * j))


@compiled
def _write_column(
    bits: np.uint64, steps: _Steps, rows: _Bytes, size: int, position: int | np.uint64, width: int
) -> np.uint64:
    """Write one field of some rows, the first at ``position``, by adding up its differences.

    ``bits`` are those of the row before; returns those of the last row.
    """
    position = np.uint64(position)
    if width == 8:
        for step in steps:
            bits += np.uint64(step)
            _write(bits, rows, position, 8)
            position += np.uint64(size)
    elif width == 4:
        for step in steps:
            bits += np.uint64(step)
            _write(bits, rows, position, 4)
            position += np.uint64(size)
    else:
        for step in steps:
            bits += np.uint64(step)
            rows[position] = np.uint8(bits)
            position += np.uint64(size)
    return bits


@compiled
def _unpack(packed: _Bytes, spans: _Layout, layout: _Layout, n: int, rows: _Bytes) -> None:
    """Fill ``n`` rows, each field from its packed column; a missing field stays zero."""
    size = len(rows) // n
    bits = np.zeros(len(layout), np.uint64)
    for column in range(len(layout)):
        if spans[column, 1] > spans[column, 0]:
            bits[column] = _read(packed, np.uint64(spans[column, 0]), 8)
    narrow_steps, wide_steps = np.empty(_TILE, np.int32), np.empty(_TILE, np.int64)
    for row in range(0, n, _TILE):
        count = min(_TILE, n - row)
        for column in range(len(layout)):
            start, end = spans[column]
            if end == start:
                continue
            offset, width = layout[column]
            planes = max(end - start - _FIRST_ROW_BYTES, 0) // n
            source, position = start + _FIRST_ROW_BYTES + row, row * size + offset
            if planes > 4:
                _decode_wide_steps(packed, source, n, planes, wide_steps[:count])
                bits[column] = _write_column(
                    bits[column], wide_steps[:count], rows, size, position, width
                )
                continue
            if planes > 0:
                _decode_steps(packed, source, n, planes, narrow_steps[:count])
            else:
                for i in range(
                    count
                ):  # a slice would cost seconds: numba compiles its length check
                    narrow_steps[i] = 0
            bits[column] = _write_column(
                bits[column], narrow_steps[:count], rows, size, position, width
            )


def joined(blocks: Sequence[tuple[Samples, Ticks]]) -> tuple[Samples, Ticks]:
    """The rows of n > 0 blocks in one block."""
    if len(blocks) == 1:
        return blocks[0]
    # As raw bytes: NumPy copies structured rows field by field, 20 times slower.
    rows, tick_rows = (
        np.concatenate([block.view((np.void, block.itemsize)) for block in column])
        for column in zip(*blocks, strict=True)
    )
    return rows.view(SAMPLE), tick_rows.view(TICK)


class RowBuffer:
    """Collects rows of blocks of any size into full blocks of ``size`` rows."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._begin()

    def _begin(self) -> None:
        # As raw bytes: NumPy copies structured rows field by field, 20 times slower.
        self._samples = np.empty(self._size, (np.void, SAMPLE.itemsize))
        self._ticks = np.empty(self._size, (np.void, TICK.itemsize))
        self._filled = 0

    def add(self, samples: Samples, ticks: Ticks) -> Iterator[tuple[Samples, Ticks]]:
        """Add rows and yield each full block; rows that are a full block already pass uncopied."""
        rows, tick_rows = samples.view(self._samples.dtype), ticks.view(self._ticks.dtype)
        start = 0
        while start < len(rows):
            stop = min(start + self._size - self._filled, len(rows))
            if stop - start == self._size:
                yield samples[start:stop], ticks[start:stop]
            else:
                end = self._filled + stop - start
                self._samples[self._filled : end] = rows[start:stop]
                self._ticks[self._filled : end] = tick_rows[start:stop]
                self._filled = end
            start = stop
            if self._filled == self._size:
                yield self.take()

    def take(self) -> tuple[Samples, Ticks]:
        """Return the collected rows, maybe none; the buffer is empty afterwards."""
        samples, ticks = self._samples[: self._filled], self._ticks[: self._filled]
        self._begin()
        return samples.view(SAMPLE), ticks.view(TICK)
