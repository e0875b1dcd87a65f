"""Block mode over OPC UA: read the header, and then the whole ring of scans as arrays.

The server may sample the nodes of one request at different times, in any order. So the arrays are
requested after the header has arrived: whatever it announces was complete by then. Fresher records
come with the next block. The oldest records are skipped, as far as the PLC may have overwritten
them before the arrays arrived.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.opcua.client import OpcuaClient
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.opcua.values import (
    SEVERITY,
    code_of,
    moment,
    number,
    numbers,
    quality,
    readable,
    status_name,
    whole,
    wholes,
)
from drivers.optional_signals import BITS, VALUES, ambient_of, once, put_bits, put_values
from drivers.reconnect import Clock, LostError
from drivers.trace import (
    COMMANDS,
    OVERFLOW_BIT,
    RESERVE,
    WRAP,
    Follower,
    Header,
    refusal,
)
from twin.errors import SourceError
from twin.quality import UNUSABLE, Quality, flags_where
from twin.signals import MBAR, SAMPLE, Samples

TRIES = 3  # for a ring that is not torn
Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Ring:
    """The header of the ring, and the whole ring read after it."""

    header: Header
    sequences: Integers
    statuses: Integers
    pressures: Floats  # NaN where there is none
    single: dict[str, float]  # supply and other values outside the ring; NaN if none
    quality: int  # Quality bits that the server gives to all of it
    apart: int  # scans that may have gone by while the header was read
    overwritten: int  # records up to this offset from the header's may be overwritten


class NodeTrace(Follower[Header, OpcuaClient]):
    """The reading position in the ring of one PLC; it outlives connections."""

    def __init__(self, settings: OpcuaSettings, clock: Clock) -> None:
        super().__init__(settings, clock)
        self._settings = settings
        trace, tags = settings.trace, settings.tags
        self._header_nodes = (trace.sequence, trace.time, trace.boot, trace.period)
        self._arrays = (trace.sequences, trace.statuses, trace.pressures)
        self._single = {
            name: getattr(tags, name).node
            for name in ("supply", *VALUES)
            if getattr(tags, name) is not None
        }
        self._status_bits = {
            name: bit for name, bit in BITS.items() if getattr(tags, name) is not None
        }

    @property
    def requests(self) -> tuple[tuple[Node, ...], tuple[Node, ...]]:
        """Nodes of the two requests, in order: the header's, and all others."""
        return self._header_nodes, (*self._arrays, *self._single.values())

    def start(self, link: OpcuaClient) -> Header:
        """Begin at the newest record; SourceError if there is no ring as configured."""
        header = self._verified_ring(link).header
        self._begin(header)
        return header

    def _verified_ring(self, link: OpcuaClient) -> Ring:
        """A ring that follows the last one, or holds the announced records; else SourceError.

        A read may be torn: an unexpected ring is read again.
        """
        last = self._header
        for attempt in range(TRIES):
            ring = self._smoothed_ring(self.ask(link))
            if last is not None and ring.header.follows(last):
                return ring
            read_again = attempt > 0 or last is None
            if read_again and ring.header.ready and _holds_announced_records(ring):
                return ring
        self.refuse_other(ring.header)
        raise SourceError(
            f"{self._settings.where}: {self._settings.trace.sequences} does not hold the sequence "
            f"numbers that {self._settings.trace.sequence} announces ({ring.header.sequence})",
            "check [driver.trace]; scan s must stand at s modulo the arrays' length",
        )

    def refuse_other(self, header: Header) -> None:
        """SourceError if ``header`` does not describe a ring that can be followed."""
        if not header.ready:
            raise refusal(header)(
                f"{self._settings.where}: no trace at {self._settings.trace.sequence}: it says "
                f"{header.depth} records, one every {header.period_ns // 1000} µs, the newest at "
                f"{header.time_ns} ns; needed are more than {2 * RESERVE}, and a time before 2116",
                "check [driver.trace] against the PLC's trace block; is its program running?",
            )

    def ask(self, link: OpcuaClient) -> Ring:
        """Read everything; LostError if the server has no values, SourceError if they are wrong."""
        header_nodes, other_nodes = self.requests
        asked_ns = self._clock.now_ns()
        values = link.read(header_nodes)
        header_ns = self._clock.now_ns() - asked_ns
        values += link.read(other_nodes)
        took_ns = self._clock.now_ns() - asked_ns
        return self._ring(
            dict(zip(header_nodes + other_nodes, values, strict=True)), header_ns, took_ns
        )

    def _ring(self, values: dict[Node, Any], header_ns: int, took_ns: int) -> Ring:
        self._refuse_bad(values)
        arrays = self._columns(values)
        header = self._parse(values, len(arrays[0]))
        period_ns = max(header.period_ns, 1)
        return Ring(
            header,
            *arrays,
            single={name: _number_of(values, node) for name, node in self._single.items()},
            quality=self._quality(values),
            apart=-(-header_ns // period_ns),
            overwritten=-(-took_ns // period_ns) + 1 - header.depth,  # one is being written
        )

    def _refuse_bad(self, values: dict[Node, Any]) -> None:
        """LostError if the server marks a value that must be right as anything but good."""
        trace = self._settings.trace
        for node in (*self._header_nodes, trace.sequences, trace.statuses):
            code = code_of(values[node])
            if code & SEVERITY:
                raise LostError(
                    f"{self._settings.where}: {node} is {status_name(code)}",
                    "does the PLC's program run?",
                )

    def _parse(self, values: dict[Node, Any], depth: int) -> Header:
        trace = self._settings.trace
        return Header(
            sequence=whole(values[trace.sequence], trace.sequence) % WRAP,
            time_ns=moment(values[trace.time], trace.time),
            boot=whole(values[trace.boot], trace.boot),
            period_ns=whole(values[trace.period], trace.period) * 1000,
            depth=depth,
        )

    def _columns(self, values: dict[Node, Any]) -> tuple[Integers, Integers, Floats]:
        """Sequences, statuses and pressures, of one length."""
        trace = self._settings.trace
        sequences = wholes(values[trace.sequences], trace.sequences)
        statuses = wholes(values[trace.statuses], trace.statuses)
        if readable(values[trace.pressures]):
            pressures = numbers(values[trace.pressures], trace.pressures)
        else:  # the server has none, and the quality says why
            pressures = np.full(len(sequences), np.nan)
        if not len(sequences) == len(statuses) == len(pressures):
            lengths = f"{len(sequences)}, {len(statuses)} and {len(pressures)}"
            raise SourceError(
                f"{self._settings.where}: the trace's arrays have {lengths} elements",
                "sequences, statuses and pressures in [driver.trace] must be of one length",
            )
        return sequences, statuses, pressures

    def _quality(self, values: dict[Node, Any]) -> int:
        return quality(code_of(values[self._settings.trace.pressures]))

    def _read(self, link: OpcuaClient) -> Samples:
        """Announced records that are new."""
        ring = self._verified_ring(link)
        self._advance_to(ring.header)
        first, newest = self._next, self._newest
        expected = np.arange(first, max(first, newest + 1))
        slots = expected % WRAP % ring.header.depth
        valid = ring.sequences[slots] == expected % WRAP
        valid &= expected > newest + ring.overwritten
        sequence = self._consume(first, valid)
        return self._stamp(self._decode(ring, slots[valid]), ring.header, sequence)

    def _smoothed_ring(self, ring: Ring) -> Ring:
        return replace(ring, header=self._smoothed(ring.header, ring.apart))

    def _decode(self, ring: Ring, slots: Integers) -> Samples:
        tags = self._settings.tags
        block = np.zeros(len(slots), SAMPLE)
        status = ring.statuses[slots]
        block["commands"] = status & COMMANDS
        put_bits(
            block,
            {name: (status >> bit & 1).astype(float) for name, bit in self._status_bits.items()},
        )
        raw = {name: once(value, name, len(block)) for name, value in ring.single.items()}
        fixed = self._settings.ambient_mbar * MBAR
        ambient = ambient_of(block, tags, raw, fixed)
        put_values(block, tags, raw, ambient)
        block["pressure"], flags = tags.pressure.pressure(ring.pressures[slots], ambient)
        overflow = flags_where((status >> OVERFLOW_BIT & 1) != 0, Quality.OVERFLOW)
        block["quality"] = flags | overflow | np.uint8(ring.quality)
        block["supply"] = np.nan
        if tags.supply is not None:
            block["supply"] = tags.supply.gauge(np.array([ring.single["supply"]]), fixed)
        return block


def _holds_announced_records(ring: Ring) -> bool:
    """Whether one of the newest records at least carries its sequence: some may be torn."""
    newest = ring.header.sequence
    announced = np.arange(max(0, newest - 2 * RESERVE), newest + 1)
    return bool((ring.sequences[announced % ring.header.depth] == announced).any())


def _number_of(values: dict[Node, Any], node: Node) -> float:
    """A single value; NaN where unusable."""
    unusable = quality(code_of(values[node])) & UNUSABLE
    return float("nan") if unusable else number(values[node], node)
