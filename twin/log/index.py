"""Where the chunks of a log file lie and which time each covers, without unpacking them.

A finished file says so in its summary. The file of a run, or one that was damaged, has no summary
that counts. Then only the heads of its records are read, and from the second time on only those
that are new.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

from twin.files import MEMORY_BUDGET
from twin.log.records import next_chunk

PLACE = np.dtype([("position", "<i8"), ("begin_ns", "<i8"), ("end_ns", "<i8")])  # of a chunk

_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_TIMES = struct.Struct("<QQ")  # first and last time of receipt, with which a chunk begins
_INDEX = struct.Struct("<QQQ")  # both times and the position, with which a chunk's index begins
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, begin of summary and of its index, checksum
_CHECKED = 25  # bytes of the footer that its checksum covers
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_LATEST_NS = 2**63 - 1  # also of a position: there is nothing

Places: TypeAlias = npt.NDArray[np.void]  # of PLACE
_Place: TypeAlias = tuple[int, int, int]


@dataclass(frozen=True)
class ChunkIndex:
    """The chunks of a file as far as it was written, in the order of the file."""

    places: Places
    end: int  # bytes that have been looked at
    complete: bool  # by its summary: nothing will be added
    damaged: int  # stretches in which no record was recognised


def read_index(path: Path, before: ChunkIndex | None = None) -> ChunkIndex:
    """The chunks of a file; ``before`` is what an earlier call has returned for the same file.

    OSError if it cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        places = _summary(file, size)
        if places is not None:
            return ChunkIndex(np.array(places, PLACE), size, complete=True, damaged=0)
        if before is None or before.complete or before.end > size:
            before = ChunkIndex(np.empty(0, PLACE), len(MAGIC), complete=False, damaged=0)
        return _walk_on(file, size, before)


def first_time(path: Path) -> int | None:
    """Time of receipt in ns with which the first chunk of a file begins; None without a chunk."""
    with path.open("rb") as file:
        for record in _heads(file, len(MAGIC), file.seek(0, os.SEEK_END)):
            if record.place is not None:
                return record.place[1]
    return None


def _summary(file: BinaryIO, size: int) -> list[_Place] | None:
    """The chunks by the summary; None if there is none, or none that can be trusted."""
    footer_at = size - len(MAGIC) - _FOOTER.size
    if footer_at < len(MAGIC):
        return None
    tail = os.pread(file.fileno(), _FOOTER.size + len(MAGIC), footer_at)
    if not tail.endswith(MAGIC):
        return None
    opcode, length, begin, _, checksum = _FOOTER.unpack_from(tail)
    is_footer = opcode == Opcode.FOOTER and length == _FOOTER.size - _HEAD.size
    if not (is_footer and 0 < begin <= footer_at and footer_at - begin <= MEMORY_BUDGET):
        return None
    summary = os.pread(file.fileno(), footer_at - begin, begin)
    if zlib.crc32(tail[:_CHECKED], zlib.crc32(summary)) != checksum:
        return None
    return list(_summary_places(summary))


def _summary_places(summary: bytes) -> Iterator[_Place]:
    position = 0
    while position + _HEAD.size <= len(summary):
        opcode, length = _HEAD.unpack_from(summary, position)
        if opcode == Opcode.CHUNK_INDEX and length >= _INDEX.size:
            begin_ns, end_ns, at = _INDEX.unpack_from(summary, position + _HEAD.size)
            yield min(at, _LATEST_NS), min(begin_ns, _LATEST_NS), min(end_ns, _LATEST_NS)
        position += _HEAD.size + length


@dataclass(frozen=True)
class _RecordHead:
    end: int  # position after the record
    place: _Place | None = None  # of a chunk
    damaged: bool = False


def _walk_on(file: BinaryIO, size: int, before: ChunkIndex) -> ChunkIndex:
    places, end, damaged = list[_Place](), before.end, before.damaged
    for record in _heads(file, before.end, size):
        if record.place is not None:
            places.append(record.place)
        end, damaged = record.end, damaged + record.damaged
    joined = np.concatenate([before.places, np.array(places, PLACE)])
    return ChunkIndex(joined, end, complete=False, damaged=damaged)


def _heads(file: BinaryIO, position: int, size: int) -> Iterator[_RecordHead]:
    """The head of each whole record from ``position`` on; after a broken one from the next chunk.

    A record that is being written, at the end, is left for later.
    """
    while position + _HEAD.size <= size:
        head = os.pread(file.fileno(), _HEAD.size + _TIMES.size, position)
        opcode, length = _HEAD.unpack_from(head)
        end = position + _HEAD.size + length
        if opcode not in _OPCODES or end > size:
            following = next_chunk(file, position + 1)
            if following is None:
                return
            position = following
            yield _RecordHead(position, damaged=True)
            continue
        place = None
        if opcode == Opcode.CHUNK and length >= _TIMES.size:
            begin_ns, end_ns = _TIMES.unpack_from(head, _HEAD.size)
            place = position, min(begin_ns, _LATEST_NS), min(end_ns, _LATEST_NS)
        position = end
        yield _RecordHead(position, place)
