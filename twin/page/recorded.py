"""Rows of an ejector's logs for any range of time: found by their indexes, kept as bins.

A request takes at most about ``BUDGET_S``. The next request continues the reading. Bins are cached:
the most recently used ones, in at most ``MOST_KEPT`` bytes.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np

from twin.errors import SourceError
from twin.log.columns import joined
from twin.log.index import ChunkIndex, Places, first_time, read_index
from twin.log.part import SUFFIX, place_of
from twin.log.reader import decode_rows, read_header
from twin.log.records import ChunkReader
from twin.log.schema import SAMPLES
from twin.page.bins import Bins, merged, no_bins, of_rows
from twin.signals import Samples, Ticks

BUDGET_S = 0.8
GROUP = 64  # chunks that are read together: 16 s of a run, which completes four in a second
MOST_KEPT = 48 << 20  # bytes of bins
MOST_INDEXES = 40  # files; 1 MiB each for 64 MB of log
MOST_ROWS = 200_000  # in memory at a time
MARGIN_NS = 2_000_000_000  # longest time of rows outside the range that a file or chunk states

_Key: TypeAlias = tuple[Path, int, int, int]
_Found: TypeAlias = tuple[Bins, int]  # and the count of damaged chunks


@dataclass(frozen=True)
class Recorded:
    """Bins of a range of time from logs, and the progress of reading."""

    bins: Bins
    share: float  # share of the logs that has been read; below 1 another request reads more
    damaged: int  # stretches that cannot be read


@dataclass(frozen=True)
class _LogHead:
    """Constant facts of a log file of this ejector."""

    begin_ns: int
    ambient: float  # Pa


@dataclass(frozen=True)
class _Group:
    """Neighbouring chunks of a file."""

    path: Path
    inode: int
    number: int
    places: Places
    ambient: float  # Pa

    @property
    def key(self) -> _Key:
        """Key of its content; the last group of a running log grows."""
        return self.path, self.inode, self.number, len(self.places)

    @property
    def begins_log(self) -> bool:
        """Whether a run began with this group, so that rows before it are another run's."""
        return self.number == 0 and place_of(self.path)[1] == 0


class RecordedRows:
    """The logs that ``twin run`` has recorded of one unit, in some folders."""

    def __init__(
        self,
        folders: Callable[[], list[Path]],
        unit: tuple[str, str],
        seconds: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folders, self._unit, self._seconds = folders, unit, seconds
        self._heads: dict[tuple[Path, int], _LogHead | None] = {}  # None: not of this unit
        self._indexes: OrderedDict[tuple[Path, int], ChunkIndex] = OrderedDict()
        self._kept: OrderedDict[tuple[_Key, int], _Found] = OrderedDict()
        self._kept_bytes = 0

    def read(self, from_ns: int, to_ns: int, width_ns: int) -> Recorded:
        """Bins of ``width_ns`` within a range of time, as far as the time for it lasts."""
        groups = list(self._groups(from_ns, to_ns))
        found = [self._kept_bins(group, width_ns) for group in groups]
        deadline = self._seconds() + BUDGET_S
        for number, group in enumerate(groups):
            if found[number] is None and self._seconds() < deadline:
                found[number] = self._read(group, width_ns)
        done = [group_found for group_found in found if group_found is not None]
        pieces = [_within(bins, from_ns, to_ns) for bins, _ in done]
        return Recorded(
            merged(np.concatenate([no_bins(), *pieces]), width_ns),
            len(done) / len(groups) if groups else 1.0,
            sum(damaged for _, damaged in done),
        )

    # --- files ----------------------------------------------------------------------------------

    def _groups(self, from_ns: int, to_ns: int) -> Iterator[_Group]:
        """The groups with chunks in a range of time, in order of files."""
        for path, inode, head in self._files(from_ns, to_ns):
            try:
                places = self._index(path, inode).places
            except OSError:  # deleted meanwhile
                continue
            in_range = (places["end_ns"] >= from_ns - MARGIN_NS) & (
                places["begin_ns"] <= to_ns + MARGIN_NS
            )
            for number in np.unique(np.flatnonzero(in_range) // GROUP).tolist():
                chunks = places[number * GROUP : (number + 1) * GROUP]
                yield _Group(path, inode, number, chunks, head.ambient)

    def _files(self, from_ns: int, to_ns: int) -> list[tuple[Path, int, _LogHead]]:
        """The unit's files with rows in a range of time, in order of time."""
        files = []
        for folder in self._folders():
            for path in folder.glob(f"*{SUFFIX}"):
                try:
                    status = path.stat()
                    if status.st_mtime_ns < from_ns - MARGIN_NS:
                        continue
                    head = self._head(path, status.st_ino)
                except (OSError, SourceError):  # gone, being begun, or no log at all
                    continue
                if head is not None and head.begin_ns <= to_ns + MARGIN_NS:
                    files.append((path, status.st_ino, head))
        return sorted(files, key=lambda file: (file[2].begin_ns, file[0]))

    def _head(self, path: Path, inode: int) -> _LogHead | None:
        key = path, inode
        if key not in self._heads:
            header = read_header(path)
            unit = header.asset_type, header.asset_id
            begin_ns = first_time(path)
            if not (header.is_recorded and unit == self._unit):
                self._heads[key] = None
            elif begin_ns is None:  # its first rows are still to come
                return None
            else:
                self._heads[key] = _LogHead(begin_ns, header.ambient)
        return self._heads[key]

    def _index(self, path: Path, inode: int) -> ChunkIndex:
        key = path, inode
        index = self._indexes.pop(key, None)
        if index is None or not index.complete:
            index = read_index(path, index)
        self._indexes[key] = index
        while len(self._indexes) > MOST_INDEXES:
            self._indexes.popitem(last=False)
        return index

    # --- rows -----------------------------------------------------------------------------------

    def _kept_bins(self, group: _Group, width_ns: int) -> _Found | None:
        """Cached bins of a group; None if there are none."""
        key = group.key, width_ns
        if key in self._kept:
            self._kept.move_to_end(key)
        return self._kept.get(key)

    def _read(self, group: _Group, width_ns: int) -> _Found:
        """Bins of a group and the count of its damaged chunks."""
        try:
            with group.path.open("rb") as file:
                reader = _GroupReader(file, group)
                found = reader.bins(width_ns), reader.damaged
        except OSError:  # deleted meanwhile
            return no_bins(), 1
        self._keep((group.key, width_ns), found)
        return found

    def _keep(self, key: tuple[_Key, int], found: _Found) -> None:
        self._kept[key] = found
        self._kept_bytes += found[0].nbytes
        while self._kept_bytes > MOST_KEPT and len(self._kept) > 1:
            _, (oldest, _) = self._kept.popitem(last=False)
            self._kept_bytes -= oldest.nbytes


def _within(bins: Bins, from_ns: int, to_ns: int) -> Bins:
    return bins[(bins["last_ns"] >= from_ns) & (bins["first_ns"] <= to_ns)]


class _GroupReader:
    """Reads the chunks of one group; ``damaged`` counts those that cannot be read."""

    def __init__(self, file: BinaryIO, group: _Group) -> None:
        self._chunks, self._group = ChunkReader(file), group
        self.damaged = 0

    def bins(self, width_ns: int) -> Bins:
        """Bins of all its rows."""
        pieces = [merged(of_rows(*rows, self._group.ambient), width_ns) for rows in self._batches()]
        if pieces and self._group.begins_log:
            pieces[0]["broken"][0] = True
        return merged(np.concatenate([no_bins(), *pieces]), width_ns)

    def _batches(self) -> Iterator[tuple[Samples, Ticks]]:
        """Its rows in blocks of little more than ``MOST_ROWS``."""
        blocks = list[tuple[Samples, Ticks]]()
        for position in self._group.places["position"].tolist():
            blocks += self._chunk(position)
            if sum(len(samples) for samples, _ in blocks) > MOST_ROWS:
                yield joined(blocks)
                blocks.clear()
        if blocks:
            yield joined(blocks)

    def _chunk(self, position: int) -> list[tuple[Samples, Ticks]]:
        try:
            packed = self._chunks.messages(position, SAMPLES.topic)
            return [decode_rows(self._group.path, message) for message in packed]
        except (ValueError, SourceError):
            self.damaged += 1
            return []
