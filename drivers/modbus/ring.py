"""Block mode over Modbus: the ring of scans as registers.

The header is read first, then the new records. A record carries the low 16 bits of its sequence.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.modbus.client import ModbusClient
from drivers.modbus.errors import span
from drivers.modbus.plan import Answers, plan
from drivers.modbus.settings import ModbusSettings
from drivers.optional_signals import BITS, VALUES, ambient_of, once, put_bits, put_values
from drivers.reconnect import Clock
from drivers.tags import WordOrder, Words, numbers
from drivers.trace import COMMANDS, OVERFLOW_BIT, RESERVE, WRAP, Follower, refusal
from drivers.trace import Header as AnyHeader
from twin.errors import SourceError
from twin.quality import Quality, flags_where
from twin.signals import MBAR, SAMPLE, Samples

HEADER_WORDS = 12
RECORD_WORDS = 4
RECORDS_AT_ONCE = 31  # 124 of the 125 words that a request may carry
TRIES = 3  # for a header that is neither torn nor ahead of its records
LONGEST_FETCH_NS = 100_000_000  # then yield what came; no interval is longer


@dataclass(frozen=True)
class Header(AnyHeader):
    """The PLC's header of its ring, and the layout of its records."""

    record_words: int
    supply: Words  # (1, 1), as its tag declares

    @classmethod
    def parse(cls, words: Words, order: WordOrder) -> "Header":
        """Take the header's 12 words."""
        return cls(
            sequence=int(numbers(words[0:2], ">u4", order)),
            time_ns=int(numbers(words[2:6], ">i8", order)),
            boot=int(words[6]),
            period_ns=int(words[7]) * 1000,
            depth=int(words[8]),
            record_words=int(words[9]),
            supply=words[10:11].reshape(1, 1),
        )

    @property
    def ready(self) -> bool:
        """Whether it describes a ring with records of the known size."""
        return self.record_words == RECORD_WORDS and super().ready


class Trace(Follower[Header, ModbusClient]):
    """The reading position in the ring of one PLC; it outlives connections."""

    def __init__(self, settings: ModbusSettings, clock: Clock) -> None:
        super().__init__(settings, clock)
        self._settings = settings
        tags = settings.tags
        self._status_bits = {
            name: bit for name, bit in BITS.items() if getattr(tags, name) is not None
        }
        self._values = {
            name: getattr(tags, name) for name in VALUES if getattr(tags, name) is not None
        }
        self._requests = plan(self._values.values())

    def start(self, link: ModbusClient) -> Header:
        """Begin at the newest record; SourceError if there is no ring as configured."""
        header = self._verified_header(link)
        self._begin(header)
        return header

    def _verified_header(self, link: ModbusClient) -> Header:
        """A header that follows the last one, or fits the ring's records; else SourceError.

        A read may be torn: an unexpected header is read again. Some PLCs announce a record a
        little before it can be read.
        """
        last = self._header
        for attempt in range(TRIES):
            header = self.header(link)
            if last is not None and header.follows(last):
                return header
            read_again = attempt > 0 or last is None
            if read_again and self._fits(header) and self._has_announced_records(link, header):
                return header
        self.refuse_other(header)
        ring = self._settings.ring
        raise SourceError(
            f"{self._settings.where}: the records at {ring.records} do not carry the sequence "
            f"numbers that the header at {ring.header} announces ({header.sequence})",
            f'check [driver.ring] and word_order (is "{self._settings.word_order}"); '
            "twin probe shows both orders",
        )

    def _fits(self, header: Header) -> bool:
        """Whether ``header`` describes a ring that lies within the registers."""
        end = self._settings.ring.records.offset + header.depth * RECORD_WORDS
        return header.ready and end <= 0x10000

    def refuse_other(self, header: Header) -> None:
        """SourceError if ``header`` does not describe a ring that can be followed."""
        ring = self._settings.ring
        if not self._fits(header):
            raise refusal(header)(
                f"{self._settings.where}: no trace header at {span(ring.header, HEADER_WORDS)}: "
                f"it says {header.depth} records of {header.record_words} words, one every "
                f"{header.period_ns // 1000} µs, the newest at {header.time_ns} ns; expected are "
                f"words of {RECORD_WORDS}, more than {2 * RESERVE} records, and a time before 2116",
                "check [driver.ring] header against the PLC's trace block, and word_order; is its "
                "program running?",
            )

    def header(self, link: ModbusClient) -> Header:
        """Read the header."""
        words = link.read(self._settings.ring.header, HEADER_WORDS)
        return Header.parse(words, self._settings.word_order)

    def _has_announced_records(self, link: ModbusClient, header: Header) -> bool:
        """Whether the two newest records are those that the header announces."""
        for sequence in range(max(0, header.sequence - 1), header.sequence + 1):
            if not self._fetch(link, header, sequence, sequence + 1)[1].all():
                return False
        return True

    def _read(self, link: ModbusClient) -> Samples:
        """New samples, as many as fit into the time for one block."""
        started = self._clock.now_ns()
        values = self._read_values(link)
        header = self._next_header(link)
        self._advance_to(header)
        first = self._next
        records, valid = self._fetch(link, header, first, self._newest + 1)
        end = first + len(valid)
        took_ns = self._clock.now_ns() - started
        if took_ns > header.period_ns * (first - self._newest + header.depth) // 2:
            overwritten = self._overwritten(link, header)
            valid &= np.arange(first, end) > overwritten
        sequence = self._consume(first, valid)
        return self._stamp(self._decode(header, records[valid], values), header, sequence)

    def _read_values(self, link: ModbusClient) -> dict[str, float]:
        """Present values that are not in the ring; they are read once a block."""
        if not self._values:
            return {}
        words = [link.read(request.address, request.count) for request in self._requests]
        answers = Answers(self._requests, [row[np.newaxis] for row in words])
        order = self._settings.word_order
        return {name: float(answers.floats(tag, order)[0]) for name, tag in self._values.items()}

    def _next_header(self, link: ModbusClient) -> Header:
        """Read the header, and smooth its time.

        A read torn between sequence and time stays unnoticed: the time is another scan's.
        """
        return self._smoothed(self._verified_header(link), 1)

    def _fetch(
        self, link: ModbusClient, header: Header, first: int, end: int
    ) -> tuple[Words, npt.NDArray[np.bool_]]:
        """Records (rows, 4) from sequence ``first`` on, at most to ``end``, and which are valid."""
        deadline = self._clock.now_ns() + LONGEST_FETCH_NS
        chunks = [np.empty((0, RECORD_WORDS), np.uint16)]
        sequence = first
        while sequence < end and self._clock.now_ns() < deadline:
            slot = sequence % WRAP % header.depth
            to_wrap = min(header.depth - slot, WRAP - sequence % WRAP)
            count = min(RECORDS_AT_ONCE, end - sequence, to_wrap)
            address = self._settings.ring.records + RECORD_WORDS * slot
            words = link.read(address, RECORD_WORDS * count)
            chunks.append(words.reshape(count, RECORD_WORDS))
            sequence += count
        records = np.concatenate(chunks)
        expected = np.arange(first, sequence).astype(np.uint16)  # the low 16 bits
        return records, records[:, 0] == expected

    def _overwritten(self, link: ModbusClient, header: Header) -> int:
        """Sequence up to which the PLC may have overwritten records since ``header``."""
        scans = self.header(link).advance(header)
        if scans is None:  # it restarted, so the read records are invalid
            return self._newest
        return self._newest + scans - header.depth + 1  # one is being written

    def _decode(self, header: Header, records: Words, values: dict[str, float]) -> Samples:
        tags, order = self._settings.tags, self._settings.word_order
        block = np.zeros(len(records), SAMPLE)
        status = records[:, 1]
        block["commands"] = status & COMMANDS
        put_bits(
            block,
            {name: (status >> bit & 1).astype(float) for name, bit in self._status_bits.items()},
        )
        raw = {name: once(value, name, len(block)) for name, value in values.items()}
        fixed = self._settings.ambient_mbar * MBAR
        ambient = ambient_of(block, tags, raw, fixed)
        put_values(block, tags, raw, ambient)
        block["pressure"], quality = tags.pressure.decode(records[:, 2:4], order, ambient)
        overflow = flags_where((status >> OVERFLOW_BIT & 1) != 0, Quality.OVERFLOW)
        block["quality"] = quality | overflow
        block["supply"] = np.nan
        if tags.supply is not None:
            block["supply"] = tags.supply.supply(header.supply, order, fixed)
        return block
