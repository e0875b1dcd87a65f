"""Reads a log from disk: its header, its rows in blocks, and its events."""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError
from mcap.records import Attachment, Metadata
from mcap.writer import MCAP0_MAGIC as MAGIC

from twin.errors import SourceError
from twin.events import Event
from twin.log.columns import RowBuffer, decode
from twin.log.header import Identity, LogHeader, from_metadata
from twin.log.messages import decode_event
from twin.log.part import FREE_METADATA, OWN_METADATA, follows, part_path, place_of
from twin.log.records import Damage, is_complete, messages, records
from twin.log.schema import EVENTS, SAMPLES
from twin.signals import Samples, Ticks

_UNDECODABLE = (ValueError, struct.error, DecodeError, RecursionError)  # the last: deep JSON


@dataclass(frozen=True)
class Log:
    """A log with all its parts; each iteration reads the files anew, a chunk at a time.

    Iterating raises SourceError where a file is damaged. An unfinished end that a killed writer
    left is no damage: iteration ends there, and ``complete`` is False.
    """

    path: Path
    header: LogHeader
    parts: tuple[Path, ...]
    complete: bool  # every part was finished by its writer
    checked: bool = True  # every head by its checksum; logs of older programs have none

    def blocks(self, size: int = 10_000) -> Iterator[tuple[Samples, Ticks]]:
        """Rows of SAMPLE and TICK in written order, in blocks of ``size``; the last is shorter."""
        buffer = RowBuffer(size)
        for part in self.parts:
            for _, packed in messages(part, (SAMPLES.topic,), _refuse):
                yield from buffer.add(*decode_rows(part, packed))
        samples, ticks = buffer.take()
        if len(samples):
            yield samples, ticks

    @property
    def samples(self) -> Iterable[Samples]:
        """The same rows without ticks, read anew by each iteration."""
        return _RowsOf(self)

    def events(self) -> Iterator[Event]:
        """Events in written order."""
        for part in self.parts:
            for _, packed in messages(part, (EVENTS.topic,), _refuse):
                yield decode_event_message(part, packed)


@dataclass(frozen=True)
class _RowsOf:
    log: Log

    def __iter__(self) -> Iterator[Samples]:
        return (samples for samples, _ in self.log.blocks())


def _refuse(damage: Damage) -> None:
    if not damage.torn:
        hint = f"'twin log recover {damage.path} -o OUT.mcap' writes a new log of what is readable"
        raise SourceError(str(damage), hint)


def decode_rows(part: Path, packed: memoryview) -> tuple[Samples, Ticks]:
    """Rows of a message of /samples; SourceError if it is not of this format."""
    try:
        return decode(packed)
    except _UNDECODABLE as error:
        raise _other_version(part, error) from error


def decode_event_message(part: Path, packed: memoryview) -> Event:
    """Event of a message of /events; SourceError if it is not of this format."""
    try:
        return decode_event(packed)
    except _UNDECODABLE as error:
        raise _other_version(part, error) from error


def _other_version(part: Path, error: Exception) -> SourceError:
    hint = "it was damaged, or written by another version of the program: read it with that one"
    return SourceError(f"{part}: cannot be decoded: {error}", hint)


def open_log(path: Path) -> Log:
    """Open a log at its first part, or one part of it; SourceError if the file is no log.

    If earlier parts were deleted, the first existing part begins the log.
    """
    header, identity, checked = _head(path)
    parts = [path]
    complete = is_complete(path)
    first, number = place_of(path) if identity.part else (path, 0)
    alone = number != identity.part or (number > 0 and follows(path))
    while not alone and (following := part_path(first, number + len(parts))).exists():
        try:
            _, next_identity, next_checked = _head(following)
        except SourceError:  # its writer was stopped before the head was complete
            complete = False
            break
        if next_identity != Identity(identity.series, number + len(parts)):
            break  # left from another log of that name
        parts.append(following)
        complete &= is_complete(following)
        checked &= next_checked
    return Log(path, header, tuple(parts), complete, checked)


def read_header(path: Path) -> LogHeader:
    """The header of one file; SourceError if it is no log."""
    header, _, _ = _head(path)
    return header


def _head(path: Path) -> tuple[LogHeader, Identity, bool]:
    try:
        _check_magic(path)
        return _read_head(path)
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise SourceError(message, "check the path") from error


def _check_magic(path: Path) -> None:
    with path.open("rb") as file:
        magic = file.read(len(MAGIC))
    if not magic:
        raise SourceError(f"{path}: the file is empty", "nothing was recorded; take another log")
    if magic != MAGIC:
        raise SourceError(
            f"{path}: not an MCAP file", "a log of 'twin run', 'twin replay' or 'twin import' is"
        )


def _read_head(path: Path) -> tuple[LogHeader, Identity, bool]:
    """Read the head's records; this program writes them before the first chunk."""
    stored: dict[str, dict[str, str]] = {}
    config: bytes | None = None
    damage: list[Damage] = []
    for record in records(path, damage.append):
        if isinstance(record, Metadata):
            stored[record.name] = record.metadata
        elif isinstance(record, Attachment):
            config = record.data
        if config is not None and {OWN_METADATA, FREE_METADATA} <= stored.keys():
            try:
                return from_metadata(stored[OWN_METADATA], config.decode(), stored[FREE_METADATA])
            except (ValueError, KeyError) as error:
                raise _head_error(path, f"damaged: {error}") from error
    if damage:
        raise _head_error(path, f"damaged: {damage[0].what}")
    if OWN_METADATA in stored or not is_complete(path):
        raise _head_error(path, "missing")
    raise SourceError(
        f"{path}: an MCAP file of another program: it has no {SAMPLES.topic} of an ejector",
        "take a log of 'twin run', 'twin replay' or 'twin import'",
    )


def _head_error(path: Path, how: str) -> SourceError:
    hint = "there is no way to read it without; take another log or a copy"
    return SourceError(f"{path}: the head of the log is {how}", hint)
