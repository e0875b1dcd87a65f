"""Rows to packed columns and back, lossless to the bit.

Neighbouring rows are alike: as differences of the bits (floats too: those of like numbers are
near), laid out byte plane by byte plane, most bytes are zero or repeat, and the chunk's
compression takes them away. The coding is written down in twin.log.schema.
"""

import struct
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from twin.log.schema import ADDED, COLUMNS, SAMPLES
from twin.signals import SAMPLE, TICK, Samples, Ticks

_INT64 = struct.Struct("<q")  # the first row's bits
_ONE = np.uint64(1)


def _as_integers(rows: np.dtype[np.void]) -> np.dtype[np.void]:
    return np.dtype([(name, f"<i{rows[name].itemsize}") for name in rows.names or ()])


_SAMPLE_BITS, _TICK_BITS = _as_integers(SAMPLE), _as_integers(TICK)


def _columns(samples: Samples, ticks: Ticks) -> list[npt.NDArray[np.signedinteger]]:
    """Views of the fields' bits."""
    sample_bits, tick_bits = samples.view(_SAMPLE_BITS), ticks.view(_TICK_BITS)
    return [
        *(sample_bits[name] for name in _SAMPLE_BITS.names or ()),
        *(tick_bits[name] for name in _TICK_BITS.names or ()),
    ]


def encode(samples: Samples, ticks: Ticks) -> bytes:
    """Pack n > 0 row-aligned rows into a serialised ``ejector_twin.Samples``."""
    bits = np.empty((len(COLUMNS), len(samples)), np.int64)
    for row, column in zip(bits, _columns(samples, ticks), strict=True):
        row[:] = column
    steps = np.zeros_like(bits)
    np.subtract(bits[:, 1:], bits[:, :-1], out=steps[:, 1:])  # wraps, and wraps back
    zigzag = ((steps << 1) ^ (steps >> 63)).view(np.uint64)
    planes = zigzag.view(np.uint8).reshape(*bits.shape, 8)
    message = SAMPLES.message(count=len(samples))
    for index, (name, largest) in enumerate(zip(COLUMNS, zigzag.max(axis=1), strict=True)):
        kept = (int(largest).bit_length() + 7) // 8
        first = bits[index, :1].tobytes()
        setattr(message, name, first + planes[index, :, :kept].T.tobytes())
    packed: bytes = message.SerializeToString()
    return packed


def decode(packed: bytes) -> tuple[Samples, Ticks]:
    """Reverse ``encode``; ValueError, struct.error or DecodeError if it is something else."""
    message = SAMPLES.message.FromString(packed)
    planes = np.zeros((len(COLUMNS), message.count, 8), np.uint8)
    first = np.zeros((len(COLUMNS), 1), np.int64)
    for index, name in enumerate(COLUMNS):
        column = getattr(message, name)
        if not column and name in ADDED:
            continue
        first[index] = _INT64.unpack_from(column)
        if len(column) > _INT64.size:
            kept = np.frombuffer(column, np.uint8, offset=_INT64.size).reshape(-1, message.count)
            planes[index, :, : len(kept)] = kept.T
    zigzag = planes.view(np.uint64)[..., 0]
    steps = (zigzag >> _ONE).view(np.int64)
    steps ^= -(zigzag & _ONE).view(np.int64)
    bits = steps.cumsum(axis=1, out=steps)
    bits += first
    return _rows(bits)


def _rows(bits: npt.NDArray[np.int64]) -> tuple[Samples, Ticks]:
    samples, ticks = np.empty(bits.shape[1], SAMPLE), np.empty(bits.shape[1], TICK)
    for column, row in zip(_columns(samples, ticks), bits, strict=True):
        column[:] = row
    return samples, ticks


class Tray:
    """Collects rows from blocks of any size into full blocks of ``size`` rows."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._filled = 0
        # As raw bytes: NumPy copies structured rows field by field, 20 times slower.
        self._samples = np.empty(size, (np.void, SAMPLE.itemsize))
        self._ticks = np.empty(size, (np.void, TICK.itemsize))

    def add(self, samples: Samples, ticks: Ticks) -> Iterator[tuple[Samples, Ticks]]:
        """Take rows in; hand out each block as it fills up."""
        rows, beside = samples.view(self._samples.dtype), ticks.view(self._ticks.dtype)
        start = 0
        while start < len(rows):
            stop = start + min(self._size - self._filled, len(rows) - start)
            end = self._filled + stop - start
            self._samples[self._filled : end] = rows[start:stop]
            self._ticks[self._filled : end] = beside[start:stop]
            start, self._filled = stop, end
            if self._filled == self._size:
                yield self.take()

    def take(self) -> tuple[Samples, Ticks]:
        """Hand out what is in it, maybe nothing; it is empty afterwards."""
        samples, ticks = self._samples[: self._filled].copy(), self._ticks[: self._filled].copy()
        self._filled = 0
        return samples.view(SAMPLE), ticks.view(TICK)
