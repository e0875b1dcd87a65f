"""Rows to packed columns and back, lossless to the bit.

Neighbouring rows are alike: as differences of the bits (floats too: those of like numbers are
near), laid out byte plane by byte plane, most bytes are zero or repeat, and the chunk's
compression takes them away. The coding is written down in twin.log.schema.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from twin.files import require_within_budget
from twin.log.schema import ADDED, COLUMNS, SAMPLES
from twin.model.compiled import compiled, per_row
from twin.signals import EXTRA, SAMPLE, TICK, Samples, Ticks

_Places = npt.NDArray[np.int64]

_FIRST = 8  # bytes of the first row's bits
_MOST = 8  # byte planes
_TILE = 512  # rows that are unpacked at a time: with all their columns they stay in the cache
_ONE = np.uint64(1)
_FIELDS = SAMPLES.message.DESCRIPTOR.fields_by_name
_NUMBERS = np.array([_FIELDS[name].number for name in COLUMNS])
_HIGHEST = int(_NUMBERS.max())
_ADDED = np.array([name in ADDED for name in COLUMNS])
_VARINT, _BYTES = 0, 2  # how protobuf says what comes


def _places(rows: np.dtype[np.void]) -> _Places:
    """Offset and width of each field; in bytes."""
    fields = (rows.fields or {}).values()
    return np.array([(offset, field.itemsize) for field, offset, *_ in fields])


_SAMPLE_PLACES, _TICK_PLACES = _places(SAMPLE), _places(TICK)
_EXTRA_FROM = int(_SAMPLE_PLACES[-len(EXTRA), 0])  # they stand last in a row


def encode(samples: Samples, ticks: Ticks) -> bytes:
    """Pack n > 0 row-aligned rows into a serialised ``ejector_twin.Samples``."""
    message = SAMPLES.message(count=len(samples))
    space = np.empty(_FIRST + _MOST * len(samples), np.uint8)
    columns = iter(COLUMNS)
    for rows, places in ((samples, _SAMPLE_PLACES), (ticks, _TICK_PLACES)):
        raw = np.ascontiguousarray(rows).view(np.uint8)
        raw.flags.writeable = False  # as rows of a file are: one type to compile for
        blank = rows is samples and _ends_in_zeros(raw, rows.itemsize, _EXTRA_FROM)
        for offset, width in places.tolist():
            name = next(columns)
            if name in EXTRA and (blank or _is_zero(raw, rows.itemsize, offset, width)):
                continue
            used = _pack(raw, rows.itemsize, offset, width, space)
            setattr(message, name, space[:used].tobytes())
    packed: bytes = message.SerializeToString()
    return packed


def decode(packed: bytes | memoryview) -> tuple[Samples, Ticks]:
    """Reverse ``encode``; ValueError if it is something else.

    Protobuf's own classes would copy each column twice.
    """
    raw = np.frombuffer(packed, np.uint8)
    spans = np.zeros((_HIGHEST + 1, 2), np.int64)
    count = _find(raw, spans)
    if count < 1:
        raise ValueError("it is no message of rows")
    require_within_budget(count * (SAMPLE.itemsize + TICK.itemsize), f"a message of {count} rows")
    spans = spans[_NUMBERS]
    if (wrong := _misfit(spans, count, _ADDED)) >= 0:
        raise ValueError(f"{COLUMNS[wrong]} is not packed for {count} rows")
    samples, ticks = np.zeros(count, SAMPLE), np.zeros(count, TICK)
    of_samples, of_ticks = spans[: len(_SAMPLE_PLACES)], spans[len(_SAMPLE_PLACES) :]
    _unpack(raw, of_samples, _SAMPLE_PLACES, count, samples.view(np.uint8))
    _unpack(raw, of_ticks, _TICK_PLACES, count, ticks.view(np.uint8))
    return samples, ticks


# Compiled. Places in a row are counted in unsigned integers: then what is done byte by byte below
# becomes one instruction for the whole field.


@per_row
def _read(raw, at, width):  # type: ignore[no-untyped-def]
    """Little-endian bytes, not extended."""
    bits = np.uint64(0)
    for j in range(width):
        bits |= np.uint64(raw[at + np.uint64(j)]) << np.uint64(8 * j)
    return bits


@compiled
def _ends_in_zeros(rows, size, offset):  # type: ignore[no-untyped-def]
    """Whether all fields from ``offset`` on are zero in all rows, to the bit: quick to see."""
    any_bits = np.uint64(0)
    words = (size - offset) // 8
    for begin in range(0, len(rows), size):
        for word in range(words):
            any_bits |= _read(rows, np.uint64(begin + offset + 8 * word), 8)
        for at in range(begin + offset + 8 * words, begin + size):
            any_bits |= np.uint64(rows[at])
    return any_bits == 0


@compiled
def _is_zero(rows, size, offset, width):  # type: ignore[no-untyped-def]
    """Whether a field is zero in all rows, to the bit."""
    any_bits = np.uint64(0)
    for at in range(offset, len(rows), size):
        any_bits |= _read(rows, np.uint64(at), width)
    return any_bits == 0


@compiled
def _pack(rows, size, offset, width, packed):  # type: ignore[no-untyped-def]
    """Pack one field of all rows into the first bytes of ``packed``; gives how many."""
    n = len(rows) // size
    zigzag = np.empty(n, np.uint64)
    at = np.uint64(offset)
    before = any_bits = np.uint64(0)
    for i in range(n):
        if width == 8:
            bits = _read(rows, at, 8)
        elif width == 4:
            bits = np.uint64(np.int32(_read(rows, at, 4)))
        else:
            bits = np.uint64(np.int8(rows[at]))
        at += np.uint64(size)
        if i == 0:
            before = bits
            for j in range(_FIRST):
                packed[j] = bits >> np.uint64(8 * j)
        step = bits - before  # wraps, and wraps back
        zigzag[i] = (step << _ONE) ^ (np.uint64(0) - (step >> np.uint64(63)))
        any_bits |= zigzag[i]
        before = bits
    kept = 0
    while kept < _MOST and any_bits >> np.uint64(8 * kept):
        plane = packed[_FIRST + kept * n :]
        for i in range(n):
            plane[i] = zigzag[i] >> np.uint64(8 * kept)
        kept += 1
    return _FIRST + kept * n


@per_row
def _varint(packed, at):  # type: ignore[no-untyped-def]
    """A number of protobuf and where it ends: past the end where it is broken off."""
    number = np.int64(0)
    for j in range(10):
        if at >= len(packed):
            break
        byte = np.int64(packed[at])
        at += 1
        number |= (byte & 0x7F) << (7 * j)
        if byte < 0x80:
            return number, at
    return number, len(packed) + 1


@compiled
def _find(packed, spans):  # type: ignore[no-untyped-def]
    """Begin and end of each field by its number; gives the count, or -1 if it is no ``Samples``."""
    count = at = 0
    while at < len(packed):
        tag, at = _varint(packed, at)
        number, at = _varint(packed, at)
        if tag & 7 == _VARINT:
            count = number if tag >> 3 == 1 else count
        elif tag & 7 == _BYTES and 0 <= number <= len(packed) - at:
            if 0 <= tag >> 3 < len(spans):
                spans[tag >> 3] = at, at + number
            at += number
        else:
            return -1
    return count if at == len(packed) else -1


@compiled
def _misfit(spans, count, added):  # type: ignore[no-untyped-def]
    """The first column whose length is not that of whole planes, -1 if there is none."""
    for column in range(len(spans)):
        length = spans[column, 1] - spans[column, 0]
        planes = length - _FIRST
        fits = 0 <= planes <= _MOST * count and planes % count == 0
        if not fits and not (added[column] and length == 0):
            return column
    return -1


@compiled
def _steps(packed, at, n, kept, steps):  # type: ignore[no-untyped-def]
    """Differences of some rows; ``at`` is where the first one stands in planes of ``n`` bytes.

    For one to four planes, that is nearly always: several rows in one instruction.
    """
    m = len(steps)
    a = packed[at : at + m]
    if kept == 1:
        for i in range(m):
            z = np.uint32(a[i])
            steps[i] = np.int32((z >> np.uint32(1)) ^ (np.uint32(0) - (z & np.uint32(1))))
        return
    none = np.zeros(m, np.uint8)
    b = packed[at + n : at + n + m] if kept > 1 else none
    c = packed[at + 2 * n : at + 2 * n + m] if kept > 2 else none
    d = packed[at + 3 * n : at + 3 * n + m] if kept > 3 else none
    for i in range(m):
        low = np.uint32(a[i]) | np.uint32(b[i]) << np.uint32(8)
        high = np.uint32(c[i]) | np.uint32(d[i]) << np.uint32(8)
        z = low | high << np.uint32(16)
        steps[i] = np.int32((z >> np.uint32(1)) ^ (np.uint32(0) - (z & np.uint32(1))))


@compiled
def _long_steps(packed, at, n, kept, steps):  # type: ignore[no-untyped-def]
    """As ``_steps``, for any number of planes."""
    for i in range(len(steps)):
        z = np.uint64(0)
        for j in range(kept):
            z |= np.uint64(packed[at + j * n + i]) << np.uint64(8 * j)
        steps[i] = np.int64((z >> _ONE) ^ (np.uint64(0) - (z & _ONE)))


@per_row
def _write(bits, rows, at, width):  # type: ignore[no-untyped-def]
    for j in range(width):
        rows[at + np.uint64(j)] = np.uint8(bits >> np.uint64(8 * j))


@compiled
def _sum(bits, steps, rows, size, at, width):  # type: ignore[no-untyped-def]
    """Write a field of some rows from its bits before them, the first at ``at``; gives the last."""
    at = np.uint64(at)
    if width == 8:
        for step in steps:
            bits += np.uint64(step)
            _write(bits, rows, at, 8)
            at += np.uint64(size)
    elif width == 4:
        for step in steps:
            bits += np.uint64(step)
            _write(bits, rows, at, 4)
            at += np.uint64(size)
    else:
        for step in steps:
            bits += np.uint64(step)
            rows[at] = np.uint8(bits)
            at += np.uint64(size)
    return bits


@compiled
def _unpack(packed, spans, places, n, rows):  # type: ignore[no-untyped-def]
    """Fill ``n`` rows, each field from its packed column; one that is not there stays zero."""
    size = len(rows) // n
    bits = np.zeros(len(places), np.uint64)
    for column in range(len(places)):
        if spans[column, 1] > spans[column, 0]:
            bits[column] = _read(packed, np.uint64(spans[column, 0]), 8)
    short, long = np.empty(_TILE, np.int32), np.empty(_TILE, np.int64)
    for row in range(0, n, _TILE):
        m = min(_TILE, n - row)
        for column in range(len(places)):
            start, end = spans[column]
            if end == start:
                continue
            offset, width = places[column]
            kept = max(end - start - _FIRST, 0) // n
            first, at = start + _FIRST + row, row * size + offset
            if kept > 4:
                _long_steps(packed, first, n, kept, long[:m])
                bits[column] = _sum(bits[column], long[:m], rows, size, at, width)
                continue
            if kept > 0:
                _steps(packed, first, n, kept, short[:m])
            else:
                for i in range(m):  # numba compiles seconds' worth of what a slice may not fit
                    short[i] = 0
            bits[column] = _sum(bits[column], short[:m], rows, size, at, width)


def joined(blocks: Sequence[tuple[Samples, Ticks]]) -> tuple[Samples, Ticks]:
    """The rows of n > 0 blocks in one."""
    if len(blocks) == 1:
        return blocks[0]
    # As raw bytes: NumPy copies structured rows field by field, 20 times slower.
    rows, beside = (
        np.concatenate([one.view((np.void, one.itemsize)) for one in column])
        for column in zip(*blocks, strict=True)
    )
    return rows.view(SAMPLE), beside.view(TICK)


class RowBuffer:
    """Collects rows from blocks of any size into full blocks of ``size`` rows."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._begin()

    def _begin(self) -> None:
        # As raw bytes: NumPy copies structured rows field by field, 20 times slower.
        self._samples = np.empty(self._size, (np.void, SAMPLE.itemsize))
        self._ticks = np.empty(self._size, (np.void, TICK.itemsize))
        self._filled = 0

    def add(self, samples: Samples, ticks: Ticks) -> Iterator[tuple[Samples, Ticks]]:
        """Take rows in; hand out each block as it fills up, what is one already as it is."""
        rows, beside = samples.view(self._samples.dtype), ticks.view(self._ticks.dtype)
        start = 0
        while start < len(rows):
            stop = min(start + self._size - self._filled, len(rows))
            if stop - start == self._size:
                yield samples[start:stop], ticks[start:stop]
            else:
                end = self._filled + stop - start
                self._samples[self._filled : end] = rows[start:stop]
                self._ticks[self._filled : end] = beside[start:stop]
                self._filled = end
            start = stop
            if self._filled == self._size:
                yield self.take()

    def take(self) -> tuple[Samples, Ticks]:
        """Hand out what is in it, maybe nothing; it is empty afterwards."""
        samples, ticks = self._samples[: self._filled], self._ticks[: self._filled]
        self._begin()
        return samples.view(SAMPLE), ticks.view(TICK)
