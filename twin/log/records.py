"""The records of an MCAP file from front to back, also of a file that a crash has damaged.

The library parses and unpacks them. Its StreamReader cannot walk over them: it skips whatever a
wrong length covers, does not tell its position, and ends at the first broken record.
"""

import os
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Header,
    McapRecord,
    Metadata,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from twin.files import MEMORY_BUDGET, require_within_budget
from twin.log.schema import CHANNELS, LIBRARY
from twin.model.compiled import compiled, per_row

_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_HEAD_SIZE = _HEAD.size
_INDEX = struct.Struct("<HI")  # channel id and length of the entries of a message index
_MESSAGE_DATA = 22  # bytes before the data of a message: channel id, sequence and times
_MESSAGE, _CHANNEL = int(Opcode.MESSAGE), int(Opcode.CHANNEL)
_CHUNK_MARK = re.compile(rb"\x06.{36}(\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4)", re.DOTALL)
_CHUNK_MARK_LENGTH = 45  # at most
_PIECE = 1 << 20
_OPCODES = frozenset(Opcode)
_Bytes = npt.NDArray[np.uint8]
_Bools = npt.NDArray[np.bool_]
_RECORD_TYPES: dict[int, type[Any]] = {
    Opcode.ATTACHMENT: Attachment,
    Opcode.CHUNK: Chunk,
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
}
_DECODE_ERRORS = (
    zstandard.ZstdError,
    McapError,
    ValueError,
    struct.error,
    OverflowError,
    MemoryError,
    RuntimeError,  # lz4 has no error of its own
)


@dataclass(frozen=True)
class Damage:
    """Bytes that cannot be read."""

    path: Path
    position: int
    length: int
    what: str
    torn: bool = False  # the unfinished end of a file whose writer was stopped: nothing unusual

    def __str__(self) -> str:
        return f"{self.path}: byte {self.position}: {self.what} ({self.length} bytes)"


class _DecompressionBuffer:
    """Memory reused for each unpacked chunk: allocating it anew costs as much as unpacking."""

    def __init__(self) -> None:
        self._memory = memoryview(b"")
        self._zstd = zstandard.ZstdDecompressor()

    def unpack(self, chunk: Chunk) -> memoryview:
        """Contents of a chunk, valid until the next call; ``_DECODE_ERRORS`` if it is damaged."""
        require_within_budget(chunk.uncompressed_size, "unpacked it")
        if chunk.compression == "zstd":
            contents = self._unpack_zstd(chunk)
        elif chunk.compression == "lz4":
            contents = _unpack_lz4(chunk)
        elif chunk.compression:
            raise ValueError(f"it is compressed by {chunk.compression!r}, which nobody knows here")
        else:
            contents = memoryview(chunk.data)
        if chunk.uncompressed_crc not in (0, zlib.crc32(contents)):
            raise ValueError("its checksum is wrong")
        return contents

    def _unpack_zstd(self, chunk: Chunk) -> memoryview:
        size = chunk.uncompressed_size
        if size > len(self._memory):
            self._memory = memoryview(bytearray(size))
        contents = self._memory[:size]
        if self._zstd.stream_reader(chunk.data).readinto(contents) < size:
            raise ValueError("it is too short")
        return contents.toreadonly()


def _unpack_lz4(chunk: Chunk) -> memoryview:
    size = chunk.uncompressed_size
    unpacker = lz4.frame.LZ4FrameDecompressor()
    contents = memoryview(unpacker.decompress(chunk.data, max_length=size + 1))
    if len(contents) != size:
        raise ValueError("it is not as long as it says")
    return contents


Damaged = Callable[[Damage], None]  # is called with each damage; may raise


def is_complete(path: Path) -> bool:
    """Whether the file ends with a footer, so that its writer has finished it."""
    footer = _HEAD.pack(Opcode.FOOTER, 20)
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - len(footer) - 20 - len(MAGIC)))
        tail = file.read()
    return tail.startswith(footer) and tail.endswith(MAGIC)


def records(path: Path, damaged: Damaged) -> Iterator[McapRecord | memoryview]:
    """Each record of ``_RECORD_TYPES`` in written order, one in memory at a time.

    A chunk is yielded as its contents; the next chunk overwrites them. After a broken record,
    reading goes on at the next chunk, because the record's length may be wrong.
    """
    complete = is_complete(path)
    chunks = 0  # so far, with broken ones
    buffer = _DecompressionBuffer()
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        position = file.seek(len(MAGIC))
        while position < size - len(MAGIC) * complete:
            try:
                record = _record(file, buffer)
                chunks += isinstance(record, memoryview)
                if isinstance(record, Statistics) and record.chunk_count > chunks:
                    raise ValueError(f"{record.chunk_count - chunks} chunks are missing")
            except _DECODE_ERRORS as error:
                chunks += 1
                end = file.seek(next_chunk(file, position + 1) or size)
                torn = end >= size and not complete
                damaged(Damage(path, position, end - position, _reason(error, torn), torn))
            else:
                if record is not None:
                    yield record
            position = file.tell()


def _reason(error: Exception, torn: bool) -> str:
    if torn:
        return "the last record is unfinished"
    # Other errors are the library's, whose messages are technical.
    return str(error) if type(error) is ValueError else "not a record"


def _record(file: BinaryIO, buffer: _DecompressionBuffer) -> McapRecord | memoryview | None:
    """The record at the file's position, None if unused; ``_DECODE_ERRORS`` if it is damaged."""
    opcode, length = _HEAD.unpack(file.read(_HEAD.size))
    body = file.read(min(length, MEMORY_BUDGET))
    if opcode not in _OPCODES or len(body) < length:
        raise ValueError("not a record")
    if opcode == Opcode.MESSAGE_INDEX and length != _INDEX.size + _INDEX.unpack_from(body)[1]:
        raise ValueError("not a record")  # not needed, but its length may skip chunks
    if opcode not in _RECORD_TYPES:
        return None
    stream = ReadDataStream(BytesIO(body))
    record = _RECORD_TYPES[opcode].read(stream)
    if stream.count < length:
        raise ValueError("a record's lengths disagree")
    if isinstance(record, Attachment) and zlib.crc32(body[:-4]).to_bytes(4, "little") != body[-4:]:
        raise ValueError("the attachment's checksum is wrong")
    return _contents(record, buffer) if isinstance(record, Chunk) else record


def _contents(chunk: Chunk, buffer: _DecompressionBuffer) -> memoryview:
    try:
        contents = buffer.unpack(chunk)
    except _DECODE_ERRORS as error:
        raise ValueError(f"a chunk is damaged: {error}") from error
    if not _is_whole(np.frombuffer(contents, np.uint8)):
        raise ValueError("a chunk is damaged: its records do not fill it")
    return contents


def next_chunk(file: BinaryIO, start: int) -> int | None:
    """Position of the next chunk's head at or after ``start``."""
    file.seek(start)
    window = b""
    while piece := file.read(_PIECE):
        window = window[1 - _CHUNK_MARK_LENGTH :] + piece
        if match := _CHUNK_MARK.search(window):
            return file.tell() - len(window) + match.start()
    return None


class ChunkReader:
    """Messages of single chunks of an open file that ``twin run`` wrote, in any order."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._buffer = _DecompressionBuffer()

    def messages(self, position: int, topic: str) -> Iterator[memoryview]:
        """Data of each message of ``topic`` in the chunk at ``position``, valid until the next one.

        ValueError if there is no whole chunk.
        """
        self._file.seek(position)
        try:
            contents = _record(self._file, self._buffer)
        except _DECODE_ERRORS as error:
            raise ValueError(_reason(error, torn=False)) from error
        if not isinstance(contents, memoryview):
            raise ValueError("not a chunk")
        names = {number: channel.topic for number, channel in CHANNELS.items()}
        for _, packed in _chunk_messages(contents, names, (topic,)):
            yield packed


def messages(
    path: Path, topics: Collection[str], damaged: Damaged
) -> Iterator[tuple[str, memoryview]]:
    """Topic and data of each message of ``topics``, in written order, with one chunk in memory.

    The data is valid until the next message is requested.
    """
    names: dict[int, str] = {}
    for record in records(path, damaged):
        if isinstance(record, Header) and record.library == LIBRARY:
            names = {number: channel.topic for number, channel in CHANNELS.items()}
        elif isinstance(record, memoryview):
            yield from _chunk_messages(record, names, topics)


def _chunk_messages(
    contents: memoryview, names: dict[int, str], topics: Collection[str]
) -> Iterator[tuple[str, memoryview]]:
    """Topic and data of each wanted message; compiled code skips others: an hour has 200 000."""
    records = np.frombuffer(contents, np.uint8)
    wanted = _wanted(names, topics)
    end = 0
    while end < len(records):
        opcode, number, start, end = _next_record(records, end, wanted)
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(contents[start:end])))
            names[channel.id] = channel.topic
            wanted = _wanted(names, topics)
        elif opcode == Opcode.MESSAGE:
            yield names[number], contents[start + _MESSAGE_DATA : end]


def _wanted(names: dict[int, str], topics: Collection[str]) -> npt.NDArray[np.bool_]:
    """True at the id of each channel of ``topics``."""
    wanted = np.zeros(1 << 16, np.bool_)
    wanted[[number for number, name in names.items() if name in topics]] = True
    return wanted


@per_row
def _span(records: _Bytes, position: int) -> tuple[int, int]:
    """Where the data of the record at ``position`` begins and ends."""
    length: Any = np.int64(0)
    for j in range(8):
        length |= np.int64(records[position + 1 + j]) << (8 * j)
    return position + _HEAD_SIZE, position + _HEAD_SIZE + length


@compiled
def _is_whole(records: _Bytes) -> bool:
    """Whether the records follow one another up to the end."""
    end = 0
    while end + _HEAD_SIZE <= len(records):
        opcode = records[end]
        start, end = _span(records, end)
        least = _MESSAGE_DATA if opcode == _MESSAGE else 0
        if not start + least <= end <= len(records):
            return False
    return end == len(records)


@compiled
def _next_record(records: _Bytes, position: int, wanted: _Bools) -> tuple[int, int, int, int]:
    """Opcode, channel id, begin and end of the next channel record or ``wanted`` message.

    If there is none, those of the last record.
    """
    opcode, number, start, end = 0, 0, position, position
    while end < len(records):
        opcode = int(records[end])
        start, end = _span(records, end)
        if opcode == _CHANNEL:
            break
        if opcode == _MESSAGE:
            number = int(records[start]) | int(records[start + 1]) << 8
            if wanted[number]:
                break
            opcode = 0
    return opcode, number, start, end
