"""Subscribe mode over OPC UA: single nodes, for servers that keep no trace.

The server decides how often it samples and publishes. Each value of the pressure is a row at its
source time; commands and supply are those in force then. Rows are numbered by the sampling interval
that the server grants, so that a missing row is a missing number.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from asyncua import ua

from drivers.opcua.client import OpcuaClient, Subscribed
from drivers.opcua.settings import Node, NodeTag, OpcuaSettings
from drivers.opcua.values import (
    code_of,
    lost_some,
    number,
    quality,
    readable,
    time_ns,
    truth,
)
from drivers.optional_signals import BITS, VALUES, ambient_of, put_bits, put_values
from drivers.reconnect import EMPTY, Clock, LostError
from twin.errors import SourceError
from twin.quality import UNUSABLE, Quality, flags_where, mark
from twin.signals import MBAR, SAMPLE, Command, Samples

QUEUE_MS = 2000.0  # of samples that the server is asked to keep for us
PRESSURE = 0  # its index among the nodes, and so its handle

Integers = npt.NDArray[np.int64]
log = logging.getLogger(__name__)


@dataclass
class Column:
    """Values of one node as they came: times, numbers, StatusCodes."""

    times: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)

    def add(self, at_ns: int, value: float, code: int) -> None:
        """Append a value."""
        self.times.append(at_ns)
        self.values.append(value)
        self.codes.append(code)

    def keep_last(self) -> None:
        """Drop all values but the newest, which is still in force."""
        del self.times[:-1], self.values[:-1], self.codes[:-1]

    def at(self, times: Integers) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
        """Values in force at ``times``, and their quality; the first one also before its time."""
        if not self.times:
            return np.full(len(times), np.nan), np.full(len(times), Quality.BAD, np.uint8)
        order = np.argsort(self.times, kind="stable")
        index = np.searchsorted(np.array(self.times)[order], times, side="right") - 1
        chosen = order[np.maximum(index, 0)]
        flags = np.array([quality(code) for code in self.codes], np.uint8)
        return np.array(self.values)[chosen], flags[chosen]


class Subscription:
    """The subscription to one PLC's values; it outlives connections."""

    def __init__(self, settings: OpcuaSettings, clock: Clock) -> None:
        tags = settings.tags
        assert tags.suction is not None  # the settings check both
        assert tags.blow_off is not None
        self._settings = settings
        self._clock = clock
        self._tags = {name: tag for name, tag in tags if tag is not None}  # the pressure first
        self._all = tuple(self._tags.values())
        self._index = {name: index for index, name in enumerate(self._tags)}
        self.nodes: tuple[Node, ...] = tuple(tag.node for tag in self._tags.values())
        self.queue = max(10, round(QUEUE_MS / settings.sampling_ms))  # values to be kept of each
        self._columns: list[Column] = []
        self._reported = ""
        self._period_ns = 0  # of samples, as granted
        self._published = 0  # number of the last publication with values; 0: none yet
        self._sequence = -1  # of the last row
        self._last_ns = 0  # source time of the last row
        self._break = 0  # Quality bits for the next row

    def samples(self, link: OpcuaClient) -> Iterator[Samples]:
        """Blocks as they are published; ends only by an exception."""
        for index, value in enumerate(link.read(self.nodes)):
            self._number(index, value)  # raises if it has another type
        granted = link.subscribe(self.nodes, self.queue)
        self._report(granted)
        self._period_ns = round(max(granted.sampling_ms, self._settings.sampling_ms) * 1e6)
        self._columns = [Column() for _ in self.nodes]
        self._published = 0
        while True:
            yield self._take(link.published(granted.silence_s))

    def _report(self, granted: Subscribed) -> None:
        """Warn if the server grants less than was asked for, once for each answer."""
        settings = self._settings
        differences = []
        if granted.sampling_ms > settings.sampling_ms:
            differences.append(
                f"samples every {granted.sampling_ms:g} ms, not {settings.sampling_ms:g}"
            )
        if granted.publishing_ms > settings.interval_ms:
            publishing = f"publishes every {granted.publishing_ms:g} ms"
            differences.append(f"{publishing}, not {settings.interval_ms:g}")
        if granted.queue * granted.sampling_ms < 2 * granted.publishing_ms:
            differences.append(
                f"keeps only {granted.queue} values, not {self.queue}: some will be lost"
            )
        report = f"{settings.where}: the server {', '.join(differences)}" if differences else ""
        if report and report != self._reported:
            log.warning(report)
        self._reported = report

    def _take(self, publication: ua.PublishResult) -> Samples:
        """Rows of one publication."""
        message = publication.NotificationMessage
        changes: list[ua.MonitoredItemNotification] = []
        for notification in message.NotificationData or ():
            if isinstance(notification, ua.StatusChangeNotification):
                raise LostError(
                    f"{self._settings.where}: the server ended the subscription",
                    "did it restart, or did nothing come through for too long?",
                )
            if isinstance(notification, ua.DataChangeNotification):
                changes += notification.MonitoredItems
        if not changes:
            return EMPTY
        if self._published and message.SequenceNumber != self._published % 0xFFFF_FFFF + 1:
            self._break |= Quality.GAP  # a publication was lost on the way
        self._published = message.SequenceNumber
        for change in changes:
            if 0 <= change.ClientHandle < len(self.nodes):
                self._append(change.ClientHandle, change.Value)
        return self._rows()

    def _append(self, index: int, value: ua.DataValue) -> None:
        at_ns = time_ns(value)
        if at_ns is None:
            raise SourceError(
                f"{self._settings.where}: {self.nodes[index]} comes without a time that can be",
                "the server must send source or server timestamps, after 1970 and before 2116",
            )
        self._columns[index].add(at_ns, self._number(index, value), code_of(value))

    def _number(self, index: int, value: ua.DataValue) -> float:
        """The value as a number, commands as 0 and 1; NaN where there is none."""
        node = self.nodes[index]
        if not readable(value):
            return float("nan")
        tag = self._all[index]
        if isinstance(tag, NodeTag):
            return float(truth(value, node, tag.bit))
        return number(value, node)

    def _rows(self) -> Samples:
        """All pressures that have come, as rows."""
        pressures = self._columns[PRESSURE]
        if not pressures.times:
            return EMPTY
        tags = self._settings.tags
        block = np.zeros(len(pressures.times), SAMPLE)
        times = block["time_ns"] = np.array(pressures.times)
        block["host_ns"] = self._clock.wall_ns()
        raw = {name: self._usable(name, times) for name in VALUES if name in self._index}
        fixed = self._settings.ambient_mbar * MBAR
        ambient = ambient_of(block, tags, raw, fixed)
        put_values(block, tags, raw, ambient)
        measured = np.array(pressures.values)
        block["pressure"], block["quality"] = tags.pressure.pressure(measured, ambient)
        block["quality"] |= np.array([quality(code) for code in pressures.codes], np.uint8)
        for name, command in (("suction", Command.SUCTION), ("blow_off", Command.BLOW_OFF)):
            on, flags = self._columns[self._index[name]].at(times)
            block["commands"] |= np.where(on == 1, np.uint8(command), np.uint8(0))
            block["quality"] |= flags | flags_where(np.isnan(on), Quality.BAD)
        block["supply"] = np.nan
        if tags.supply is not None:
            block["supply"] = tags.supply.gauge(self._usable("supply", times), fixed)
        bits = {name: self._usable(name, times) for name in BITS if name in self._index}
        put_bits(block, bits)
        self._count(block, np.array([lost_some(code) for code in pressures.codes]))
        self._columns[PRESSURE] = Column()
        for column in self._columns[1:]:
            column.keep_last()
        return block

    def _usable(self, name: str, times: Integers) -> npt.NDArray[np.float64]:
        """Values of a tag at ``times``; NaN where unusable."""
        values, flags = self._columns[self._index[name]].at(times)
        values[(flags & UNUSABLE) != 0] = np.nan
        return values

    def _count(self, block: Samples, lost: npt.NDArray[np.bool_]) -> None:
        """Number the rows, and flag gaps and times that do not run on."""
        times = block["time_ns"]
        before = self._last_ns if self._sequence >= 0 else int(times[0]) - self._period_ns
        steps_ns = np.diff(times, prepend=before)
        steps = np.maximum(np.rint(steps_ns / self._period_ns).astype(np.int64), 1)
        missing = (steps > 1) & (steps_ns - self._period_ns > self._settings.gap_ms * 1e6)
        block["sequence"] = self._sequence + np.cumsum(steps)
        mark(block["quality"], missing | lost, Quality.GAP)
        mark(block["quality"], steps_ns <= 0, Quality.CLOCK)
        block["quality"][0] |= self._break
        self._break = 0
        self._sequence, self._last_ns = int(block["sequence"][-1]), int(times[-1])
