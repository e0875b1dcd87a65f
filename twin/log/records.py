"""A walk over the records of an MCAP file from front to back, through what a crash leaves.

The library's readers need a finished file, or raise at a torn end; this walk reads every complete
chunk, says where something is broken and goes on behind it.
"""

import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC

from twin.log.schema import CHANNELS

_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE = struct.Struct("<H")  # channel id, before sequence and times
_MESSAGE_DATA = 22  # bytes before the data of a message
_INDEX = struct.Struct("<HI")  # channel id and bytes of entries of a message index
_CHUNK_MARK = re.compile(rb"\x06.{36}\x04\x00\x00\x00zstd", re.DOTALL)
_CHUNK_MARK_LENGTH = 45
_LARGEST = 64 << 20  # bytes; no record that is read here is ever near it
_PIECE = 1 << 20
_OPCODES = frozenset(Opcode)
_BROKEN = (zstandard.ZstdError, McapError, ValueError, struct.error, OverflowError, MemoryError)

R = TypeVar("R", Metadata, Attachment, Channel, Statistics)


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


Damaged = Callable[[Damage], None]  # told of each damage; may raise


def is_complete(path: Path) -> bool:
    """Whether the writer came to the end: there is a footer."""
    footer = _HEAD.pack(Opcode.FOOTER, 20)
    with path.open("rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - len(footer) - 20 - len(MAGIC)))
        tail = file.read()
    return tail.startswith(footer) and tail.endswith(MAGIC)


def records(
    path: Path, wanted: Collection[int], damaged: Damaged
) -> Iterator[tuple[int, int, bytes]]:
    """Opcode, position and body of each record that is wanted; of a chunk, what is packed in it.

    Behind something broken it goes on at the next chunk: its length may be what is broken.
    """
    complete = is_complete(path)
    with path.open("rb") as file:
        size = file.seek(0, 2)
        position, opcode = len(MAGIC), 0
        while position < size and opcode != Opcode.FOOTER:
            file.seek(position)
            opcode, length = _head(file)
            end = position + _HEAD.size + length
            try:
                if end > size:
                    raise ValueError("not a record")
                body = _body(file, opcode, length, wanted)
            except _BROKEN as error:
                end = _next_chunk(file, position + 1) or size
                torn = end == size and not complete
                what = "the last record is unfinished" if torn else str(error)
                damaged(Damage(path, position, end - position, what, torn))
            else:
                if opcode in wanted:
                    yield opcode, position, body
            position = end


def _head(file: BinaryIO) -> tuple[int, int]:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return 0, 0  # no opcode of MCAP
    opcode, length = _HEAD.unpack(head)
    return opcode, length


def _body(file: BinaryIO, opcode: int, length: int, wanted: Collection[int]) -> bytes:
    """What a record holds, if it is wanted; one of ``_BROKEN`` if it cannot be one."""
    if opcode not in _OPCODES:
        raise ValueError("not a record")
    if opcode == Opcode.MESSAGE_INDEX:
        _, entries = _INDEX.unpack(file.read(_INDEX.size))
        if length != _INDEX.size + entries:
            raise ValueError("a message index's lengths disagree")
    if opcode not in wanted:
        return b""
    if length > _LARGEST:
        raise ValueError("a record is too long")
    body = file.read(length)
    if opcode == Opcode.STATISTICS:
        _parse(Statistics, body)  # a chunk with one bit wrong may pass for it
    try:
        return _contents(body) if opcode == Opcode.CHUNK else body
    except _BROKEN as error:
        raise ValueError(f"a chunk is damaged: {error}") from error


def _contents(body: bytes) -> bytes:
    """Unpack a chunk; one of ``_BROKEN`` if it is damaged."""
    stream = ReadDataStream(BytesIO(body))
    chunk = Chunk.read(stream)
    if stream.count != len(body) or chunk.uncompressed_size > _LARGEST:
        raise ValueError("its lengths disagree")
    data, length = get_chunk_data_stream(chunk, validate_crc=True)
    return data.read(length)


def _next_chunk(file: BinaryIO, start: int) -> int | None:
    """Position of the next chunk's head at or after ``start``."""
    file.seek(start)
    window = b""
    while piece := file.read(_PIECE):
        window += piece
        if match := _CHUNK_MARK.search(window):
            return start + match.start()
        rest = window[1 - _CHUNK_MARK_LENGTH :]
        start += len(window) - len(rest)
        window = rest
    return None


def metadata(body: bytes) -> Metadata:
    """Parse a metadata record; ValueError if it is none."""
    return _parse(Metadata, body)


def attachment(body: bytes) -> Attachment:
    """Parse an attachment; ValueError if it is damaged."""
    if zlib.crc32(body[:-4]) != struct.unpack("<I", body[-4:])[0]:
        raise ValueError("the attachment's checksum is wrong")
    return _parse(Attachment, body)


def _parse(kind: type[R], body: bytes) -> R:
    try:
        record: R = kind.read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, OverflowError) as error:
        raise ValueError(f"not a {kind.__name__} record") from error
    return record


def messages(path: Path, topics: Collection[str], damaged: Damaged) -> Iterator[tuple[str, bytes]]:
    """Topic and data of each message of ``topics``, in written order, one chunk in memory."""
    names = {number: channel.topic for number, channel in CHANNELS.items()}
    chunks = 0
    told: list[Damage] = []

    def tell(damage: Damage) -> None:
        told.append(damage)
        damaged(damage)

    for opcode, position, body in records(path, (Opcode.CHUNK, Opcode.STATISTICS), tell):
        if opcode == Opcode.CHUNK:
            chunks += 1
            yield from _chunk_messages(body, names, topics)
        elif not told and (count := _parse(Statistics, body).chunk_count) != chunks:
            what = f"{count} chunks were written, {chunks} are found"
            damaged(Damage(path, position, len(body), what))


def _chunk_messages(
    contents: bytes, names: dict[int, str], topics: Collection[str]
) -> Iterator[tuple[str, bytes]]:
    position = 0
    while position < len(contents):
        opcode, length = _HEAD.unpack_from(contents, position)
        position += _HEAD.size
        if opcode == Opcode.MESSAGE:
            topic = names.get(_MESSAGE.unpack_from(contents, position)[0], "")
            if topic in topics:
                yield topic, contents[position + _MESSAGE_DATA : position + length]
        elif opcode == Opcode.CHANNEL:  # other tools number them anew
            channel = _parse(Channel, contents[position : position + length])
            names[channel.id] = channel.topic
        position += length
