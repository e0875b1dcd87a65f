"""Writes an MCAP file as the library's Writer does, but many messages at once.

The library encodes the records. Only messages and their indexes are laid out here as arrays: an
hour has 185 000 of them, and the library's Writer takes only one message at a time.
"""

import struct
import zlib
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

from twin.log.disk_file import Output

CHUNK = 1 << 20  # bytes; a chunk that has grown longer is completed

_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),  # of what follows
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_AFTER_LENGTH = _HEAD.itemsize - 9  # bytes of the head that its length counts
_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])  # of a message index
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel and length of the entries
_FOOTER = struct.Struct("<BQQQ")  # opcode, length and the two offsets, all that its checksum covers

Times: TypeAlias = npt.NDArray[np.int64]  # ns since 1970; those before are written as 0


class _OpenChunk:
    """The chunk under way: its bytes, and the index entries of each channel.

    Messages are laid out in place: copying all of them costs a tenth of packing them.
    """

    def __init__(self) -> None:
        self._memory = np.empty(2 * CHUNK, np.uint8)
        self.clear()

    def clear(self) -> None:
        """Begin another chunk in the same memory."""
        self.size = 0
        self.entries: dict[int, list[npt.NDArray[np.void]]] = {}

    @property
    def contents(self) -> memoryview:
        """All bytes of the chunk so far."""
        return self._memory[: self.size].data

    def room(self, length: int) -> npt.NDArray[np.uint8]:
        """The next ``length`` bytes. Fill them before counting: half a record spoils a chunk."""
        end = self.size + length
        if end > len(self._memory):
            self._memory = np.resize(self._memory, 2 * end)
        return self._memory[self.size : end]


class Writer:
    """Writes to ``output`` from its beginning; memory holds one chunk and the index of all."""

    def __init__(self, output: Output, library: str) -> None:
        self._output = output
        self._compressor = zstandard.ZstdCompressor()
        self._open = _OpenChunk()
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunks: list[McapRecord] = []
        self._attachments: list[McapRecord] = []
        self._metadata: list[McapRecord] = []
        self._counts: dict[int, int] = {}  # messages by channel
        self._saved: dict[int, int] = {}  # messages by channel in whole chunks of the file
        self._first = self._last = 0  # log times
        output.write(MAGIC)
        output.write(_bytes(Header("", library)))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Write a named table of strings."""
        offset, raw = self._output.tell(), _bytes(Metadata(name, data))
        self._metadata.append(MetadataIndex(offset, len(raw), name))
        self._output.write(raw)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment without times."""
        offset = self._output.tell()
        raw = _bytes(Attachment(0, 0, name, media_type, data))
        index = AttachmentIndex(offset, len(raw), 0, 0, len(data), name, media_type)
        self._attachments.append(index)
        self._output.write(raw)

    def register_channel(self, topic: str, schema: str, files: bytes) -> int:
        """Register a topic of protobuf messages that ``files`` define; returns its id, from 1."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(number, files, "protobuf", schema))
        self._channels.append(Channel(number, topic, "protobuf", {}, number))
        record_bytes = _bytes(self._schemas[-1]) + _bytes(self._channels[-1])
        self._open.room(len(record_bytes))[:] = np.frombuffer(record_bytes, np.uint8)
        self._open.size += len(record_bytes)
        return number

    def add_message(self, channel: int, log_ns: int, publish_ns: int, message: bytes) -> None:
        """Write one message."""
        length = _AFTER_LENGTH + len(message)
        fields = Opcode.MESSAGE, length, channel, 0, max(log_ns, 0), max(publish_ns, 0)
        head = np.array(fields, _HEAD)
        record = head.tobytes() + message
        self._open.room(len(record))[:] = np.frombuffer(record, np.uint8)
        self._count(channel, head["log_time"][np.newaxis], len(record))

    def add_messages(
        self, channel: int, log_ns: Times, publish_ns: Times, messages: npt.NDArray[np.void]
    ) -> None:
        """Write n messages of one length; each element of ``messages`` is one encoded message."""
        n = len(messages)
        if not n:
            return
        message_type = np.dtype((np.void, messages.itemsize))
        record = np.dtype([("head", _HEAD), ("message", message_type)])
        records = self._open.room(n * record.itemsize).view(record)
        head = records["head"]
        head["opcode"] = Opcode.MESSAGE
        head["length"] = _AFTER_LENGTH + messages.itemsize
        head["channel"] = channel
        head["sequence"] = 0
        head["log_time"] = np.maximum(log_ns, 0)
        head["publish_time"] = np.maximum(publish_ns, 0)
        records["message"] = messages.view(message_type)
        self._count(channel, head["log_time"], record.itemsize)

    def _count(self, channel: int, times: npt.NDArray[np.uint64], length: int) -> None:
        """Count records of one ``length`` (bytes) that have been laid out."""
        entries = np.empty(len(times), _ENTRY)
        entries["log_time"] = times
        entries["offset"] = self._open.size + length * np.arange(len(times))
        self._open.entries.setdefault(channel, []).append(entries)
        self._open.size += length * len(times)
        if self._open.size > CHUNK:
            self.flush()

    def saved(self, channel: int) -> int:
        """How many messages of a channel are safely in the file, even if a later write fails."""
        return self._saved.get(channel, 0)

    def flush(self) -> None:
        """Write the chunk under way to the file, if it has messages."""
        if not self._open.entries:
            return
        contents, indexes = self._open.contents, self._open.entries
        joined = {channel: np.concatenate(entries) for channel, entries in indexes.items()}
        times = np.concatenate([entries["log_time"] for entries in joined.values()])
        first, last = int(times.min()), int(times.max())
        self._first = min(self._first, first) if self._counts else first
        self._last = max(self._last, last)
        for channel, entries in joined.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(entries)
        packed = self._compressor.compress(contents)
        chunk = Chunk("zstd", packed, last, first, zlib.crc32(contents), len(contents))
        self._open.clear()
        self._write_chunk(chunk, {channel: _index(channel, joined[channel]) for channel in joined})

    def _write_chunk(self, chunk: Chunk, indexes: dict[int, bytes]) -> None:
        start, raw, counts = self._output.tell(), _bytes(chunk), dict(self._counts)
        self._output.write(raw)
        self._saved = counts  # also where the index that follows cannot be written
        lengths = [len(index) for index in indexes.values()]
        offsets = self._output.tell() + np.cumsum([0, *lengths])
        self._output.write(b"".join(indexes.values()))
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(raw),
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=sum(lengths),
                message_index_offsets=dict(zip(indexes, offsets.tolist(), strict=False)),
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )

    def finish(self) -> None:
        """Write the chunk under way and the summary; ``output`` stays open."""
        self.flush()
        self._output.write(_bytes(DataEnd(0)))
        start = self._output.tell()
        summary, offsets = RecordBuilder(), []
        for opcode, records in self._groups():
            begin = summary.count
            for record in records:
                record.write(summary)
            offsets.append(SummaryOffset(opcode, start + begin, summary.count - begin))
        offset_start = start + summary.count
        for offset in offsets:
            offset.write(summary)
        raw: bytes = summary.end()  # type: ignore[no-untyped-call]
        checked = _FOOTER.pack(Opcode.FOOTER, 20, start, offset_start)
        self._output.write(raw)
        self._output.write(
            _bytes(Footer(start, offset_start, zlib.crc32(checked, zlib.crc32(raw))))
        )
        self._output.write(MAGIC)

    def _groups(self) -> list[tuple[Opcode, Sequence[McapRecord]]]:
        return [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        ]

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._last,
            message_start_time=self._first,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    raw: bytes = builder.end()  # type: ignore[no-untyped-call]
    return raw


def _index(channel: int, entries: npt.NDArray[np.void]) -> bytes:
    """A message index; the library's own takes one entry at a time."""
    length = entries.nbytes
    head = _INDEX.pack(Opcode.MESSAGE_INDEX, length + 6, channel, length)
    return head + entries.tobytes()
