"""Finds the files of an upload request: finished parts of the unit's logs in the logs folder.

No text of a request becomes part of a path: a name is looked up among the existing files.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from twin.assets.unit import Unit
from twin.errors import SourceError
from twin.log.part import first_parts
from twin.log.reader import Log, open_log
from twin.log.records import is_complete
from twin.notifications.upload_requests import RefusedError, UploadRequest

MOST_PARTS = 1000  # of one request


@dataclass(frozen=True)
class Found:
    """Finished files, and names of unfinished ones: still being written, or their writer died."""

    parts: tuple[Path, ...]
    unfinished: tuple[str, ...]


def find(folder: Path, unit: Unit, request: UploadRequest) -> Found:
    """The files that a request asks for in a folder of logs; RefusedError if there are none."""
    parts, unfinished = list[Path](), list[str]()
    for log in _named(folder, unit, request.log) if request.log else _all(folder, unit):
        for part in log.parts:
            if not _is_own(part):
                continue
            if not is_complete(part):
                unfinished.append(part.name)
            elif _is_within(part, request):
                parts.append(part)
    if not parts:
        reason = "no finished file of a log is like that"
        note = f"; not finished: {', '.join(unfinished[:5])}" if unfinished else ""
        raise RefusedError(f"{reason}{note}")
    if len(parts) > MOST_PARTS:
        raise RefusedError(f"that is {len(parts)} files, more than {MOST_PARTS}: ask for less")
    return Found(tuple(parts), tuple(unfinished))


def _named(folder: Path, unit: Unit, name: str) -> list[Log]:
    path_by_name = {path.name: path for path in first_parts(folder) if _is_own(path)}
    if name not in path_by_name:
        raise RefusedError("there is no log of that name")
    log = _opened(path_by_name[name])
    if log is None:
        raise RefusedError("the file of that name cannot be read as a log")
    if _unit_of(log) != unit:
        raise RefusedError("that is the log of another asset")
    return [log]


def _all(folder: Path, unit: Unit) -> Iterator[Log]:
    for path in first_parts(folder):
        if _is_own(path) and (log := _opened(path)) and _unit_of(log) == unit:
            yield log


def _opened(path: Path) -> Log | None:
    try:
        return open_log(path)
    except SourceError:
        return None


def _unit_of(log: Log) -> Unit:
    return Unit(log.header.asset_type, log.header.asset_id)


def _is_own(path: Path) -> bool:
    """Whether it is a regular file: a link may lead anywhere."""
    return path.is_file() and not path.is_symlink()


def _is_within(part: Path, request: UploadRequest) -> bool:
    """Whether any message of the part was received in the requested range of time."""
    if request.begin is None or request.end is None:
        return True
    try:
        with part.open("rb") as file:
            summary = SeekingReader(file).get_summary()
    except (McapError, OSError, ValueError):
        return False
    if summary is None or summary.statistics is None or not summary.statistics.message_count:
        return False
    statistics = summary.statistics
    begin, end = (round(time.timestamp() * 1e9) for time in (request.begin, request.end))
    return statistics.message_start_time < end and statistics.message_end_time >= begin
