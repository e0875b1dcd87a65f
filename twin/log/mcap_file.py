"""An MCAP file as it is written, from records of the mcap library.

The library's own writer spends 5 µs on a message and keeps 1 kB in memory for each chunk; a live
log has 14 400 chunks an hour and runs for weeks. Layout: https://mcap.dev/spec
"""

import struct
import zlib
from collections import defaultdict

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

from twin.log.output import Output

CHUNK_BYTES = 1 << 20  # before compression; a chunk is complete when it is longer

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_HEAD = 22  # bytes of it that count as length
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    built: bytes = builder.end()  # type: ignore[no-untyped-call]
    return built


class McapFile:
    """Appends chunks to ``output``; what is behind a flush is readable whatever happens next."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._compressor = zstandard.ZstdCompressor()
        # Records of the summary, packed: they stay in memory until the end.
        self._summary: dict[Opcode, bytearray] = defaultdict(bytearray)
        self._counts: dict[Opcode, int] = defaultdict(int)
        self._messages: dict[int, int] = defaultdict(int)  # by channel
        self._first_ns, self._last_ns = 2**64 - 1, 0
        self._begin_chunk()
        output.write(MAGIC + _bytes(Header(profile="", library="ejector-twin")))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Append a metadata record."""
        record = _bytes(Metadata(name=name, metadata=data))
        index = MetadataIndex(offset=self._output.position, length=len(record), name=name)
        self._note(Opcode.METADATA_INDEX, index)
        self._output.write(record)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Append an attachment; its times are left open."""
        record = _bytes(Attachment(0, 0, name, media_type, data))
        self._note(
            Opcode.ATTACHMENT_INDEX,
            AttachmentIndex(
                offset=self._output.position,
                length=len(record),
                create_time=0,
                log_time=0,
                data_size=len(data),
                name=name,
                media_type=media_type,
            ),
        )
        self._output.write(record)

    def add_channel(self, number: int, topic: str, schema: str, files: bytes) -> None:
        """Declare a protobuf channel; ``files`` is a FileDescriptorSet that has the schema."""
        for opcode, record in (
            (Opcode.SCHEMA, Schema(id=number, data=files, encoding="protobuf", name=schema)),
            (Opcode.CHANNEL, Channel(number, topic, "protobuf", {}, schema_id=number)),
        ):
            # Ahead of the chunks, so that no broken chunk takes them along.
            self._output.write(self._note(opcode, record))

    def add(self, channel: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to the chunk; times are not negative."""
        chunk = self._chunk
        self._index[channel] += _INDEX_ENTRY.pack(log_ns, len(chunk))
        self._times.append(log_ns)
        length = _MESSAGE_HEAD + len(data)
        chunk += _MESSAGE.pack(Opcode.MESSAGE, length, channel, 0, log_ns, publish_ns)
        chunk += data
        if len(chunk) > CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Complete the chunk, if there is anything in it, and write it."""
        if not self._chunk:
            return
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(self._chunk),
            message_start_time=min(self._times),
            message_end_time=max(self._times),
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        record = _bytes(chunk)
        index = self._message_index(self._output.position + len(record))
        self._note(Opcode.CHUNK_INDEX, self._chunk_index(chunk, len(record), index))
        self._first_ns = min(self._first_ns, chunk.message_start_time)
        self._last_ns = max(self._last_ns, chunk.message_end_time)
        self._begin_chunk()
        self._output.write(record + b"".join(index.values()))

    def finish(self) -> None:
        """Complete the file with its summary."""
        self.flush()
        self._output.write(_bytes(DataEnd(0)))
        start = self._output.position
        self._note(Opcode.STATISTICS, self._statistics())
        summary = b"".join(self._summary.values())
        offsets = self._summary_offsets(start)
        footer = Footer(start, start + len(summary), summary_crc=0)
        footer.summary_crc = zlib.crc32(summary + offsets + _bytes(footer)[:-4])
        self._output.write(summary + offsets + _bytes(footer) + MAGIC)

    def _note(self, opcode: Opcode, record: McapRecord) -> bytes:
        packed = _bytes(record)
        self._summary[opcode] += packed
        self._counts[opcode] += 1
        return packed

    def _begin_chunk(self) -> None:
        self._chunk = bytearray()
        self._index: dict[int, bytearray] = defaultdict(bytearray)
        self._times: list[int] = []

    def _message_index(self, position: int) -> dict[int, bytes]:
        """Message index records by where in the file they will stand."""
        records = {}
        for channel, entries in self._index.items():
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries))
            records[position] = head + entries
            position += len(records[position])
            self._messages[channel] += len(entries) // _INDEX_ENTRY.size
        return records

    def _chunk_index(self, chunk: Chunk, length: int, index: dict[int, bytes]) -> ChunkIndex:
        return ChunkIndex(
            chunk_start_offset=self._output.position,
            chunk_length=length,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            message_index_offsets=dict(zip(self._index, index, strict=True)),
            message_index_length=sum(map(len, index.values())),
        )

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=self._counts[Opcode.ATTACHMENT_INDEX],
            channel_count=self._counts[Opcode.CHANNEL],
            channel_message_counts=dict(self._messages),
            chunk_count=self._counts[Opcode.CHUNK_INDEX],
            message_count=sum(self._messages.values()),
            message_start_time=min(self._first_ns, self._last_ns),  # 0 without messages
            message_end_time=self._last_ns,
            metadata_count=self._counts[Opcode.METADATA_INDEX],
            schema_count=self._counts[Opcode.SCHEMA],
        )

    def _summary_offsets(self, start: int) -> bytes:
        offsets = b""
        for opcode, group in self._summary.items():
            offsets += _bytes(SummaryOffset(opcode, start, len(group)))
            start += len(group)
        return offsets
