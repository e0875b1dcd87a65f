"""The trace as Modbus registers: 16-bit words of the newest scans.

Addresses are 0-based protocol offsets. A 64-bit or 32-bit value has its high word first unless
``word_order`` is "little".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drivers.plc.partner import PartnerTask, Written
from drivers.plc.scan import DEPTH, PERIOD_NS, Task
from twin.signals import Command

RECORD = 4  # registers of one scan in the ring
HEADER, HIL, RING = 100, 200, 1000
HEADER_SIZE, TEST_SIZE, INPUT_SIZE, VALUES_SIZE, HIL_SIZE, COILS = 12, 6, 7, 6, 5, 2
RING_SIZE = RECORD * DEPTH

Words = list[int]


class Place(NamedTuple):
    """One line of the register map: ``first`` is the 0-based offset in its area."""

    area: str
    first: int
    size: int
    type: str
    meaning: str


MAP = (
    Place("coil", 0, 1, "bit", "suction command"),
    Place("coil", 1, 1, "bit", "blow-off command"),
    Place("input", 0, 1, "int16", "pressure, 0.1 mbar absolute"),
    Place("input", 1, 2, "float32", "pressure, mbar absolute"),
    Place("input", 3, 1, "int16", "supply, mbar gauge"),
    Place(
        "input",
        4,
        1,
        "bits",
        "status: bit 0 suction, bit 1 blow-off, bit 8 input overflow; where the ejector reports "
        "them, bit 2 nozzle on, bit 3 air saving, bit 4 part present",
    ),
    Place("input", 5, 2, "uint32", "sequence number of the newest scan"),
    Place("input", 7, 1, "int16", "barometer, 0.1 mbar absolute; from here on with `values`"),
    Place("input", 8, 1, "int16", "temperature of the surroundings, 0.1 °C"),
    Place("input", 9, 2, "float32", "second pressure, in the vessel, mbar absolute"),
    Place("input", 11, 2, "float32", "suction flow, sl/min"),
    Place("holding", 0, 1, "uint16", "test of the word order: 0x1234"),
    Place("holding", 1, 1, "int16", "test: -12345"),
    Place("holding", 2, 2, "uint32", "test: 0x12345678"),
    Place("holding", 4, 2, "float32", "test: 123.456"),
    Place("holding", HEADER, 2, "uint32", "trace: sequence number of the newest complete record"),
    Place("holding", HEADER + 2, 4, "uint64", "trace: PLC time of that record, ns"),
    Place("holding", HEADER + 6, 1, "uint16", "trace: boot counter, other after every restart"),
    Place("holding", HEADER + 7, 1, "uint16", "trace: scan period, µs"),
    Place("holding", HEADER + 8, 1, "uint16", "trace: depth of the ring, records"),
    Place("holding", HEADER + 9, 1, "uint16", "trace: registers in a record (4)"),
    Place("holding", HEADER + 10, 1, "int16", "trace: supply, mbar gauge"),
    Place("holding", HEADER + 11, 1, "-", "reserved, 0"),
    Place(
        "holding",
        RING,
        RING_SIZE,
        "records",
        "ring: scan s at 1000 + 4·(s mod depth): low word of s, status, pressure float32 mbar",
    ),
)
_REFERENCE = {"coil": 1, "input": 30001, "holding": 40001}  # how manuals count, from 1


def table() -> str:
    """The register map in Markdown, with protocol offsets and references as in manuals."""
    lines = ["| area | offset | reference | type | what |", "| --- | --- | --- | --- | --- |"]
    for entry in MAP:
        ends = (entry.first, entry.first + entry.size - 1)
        offset = "–".join(str(end) for end in dict.fromkeys(ends))
        reference = "–".join(f"{_REFERENCE[entry.area] + end:05d}" for end in dict.fromkeys(ends))
        row = (entry.area, offset, reference, entry.type, entry.meaning)
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


@dataclass
class Registers:
    """The PLC's memory as a client sees it; ``start_ns`` is the PLC time of sequence 0.

    It changes when the PLC's clock is set.
    """

    task: Task
    start_ns: int
    boot: int  # differs after every restart

    def coils(self) -> int:
        """Bits of the commands: a client's, or the program's."""
        from_client = self.task.settings.program.commands == "coils"
        return int(self.task.coils if from_client else self.task.commands)

    def write_coils(self, address: int, values: Sequence[int | bool]) -> bool:
        """Take a client's commands; False if the program gives its own."""
        if self.task.settings.program.commands != "coils":
            return False
        bits = int(self.task.coils)
        for bit, value in enumerate(values, address):
            bits = bits & ~(1 << bit) | int(value) << bit
        self.task.coils = Command(bits)
        return True

    def inputs(self) -> Words:
        """Input registers of the newest scan: 0 to 6 always served, 7 to 12 optional values."""
        scan = self.task.ring[self.task.newest % DEPTH]
        tenths = int(np.clip(np.rint(float(scan["pressure"]) * 10), -32768, 32767))
        return [
            tenths & 0xFFFF,
            *self._split(scan["pressure"]),
            int(scan["supply"]) & 0xFFFF,
            int(scan["status"]),
            *self._split(np.uint32(self.task.newest & 0xFFFFFFFF)),
            int(scan["ambient"]) & 0xFFFF,
            int(scan["temperature"]) & 0xFFFF,
            *self._split(scan["vessel"]),
            *self._split(scan["flow"]),
        ]

    def holding(self, address: int, count: int) -> Words:
        """``count`` holding registers from ``address`` on, all in one section of the map."""
        if address >= RING:
            return self.ring(address - RING, count)
        begin, words = (HEADER, self.header()) if address >= HEADER else (0, self.test())
        if address >= HIL and self.partner is not None:
            begin, words = HIL, self.hil(self.partner.written)
        return words[address - begin : address - begin + count]

    def test(self) -> Words:
        """Holding registers 0 to 5: known values that show a client the word order."""
        return [
            0x1234,
            -12345 & 0xFFFF,
            *self._split(np.uint32(0x12345678)),
            *self._split(np.float32(123.456)),
        ]

    def header(self) -> Words:
        """Holding registers 100 to 111: the trace's header."""
        newest = self.task.newest
        supply = int(self.task.ring["supply"][newest % DEPTH])
        return [
            *self._split(np.uint32(newest & 0xFFFFFFFF)),
            *self._split(np.uint64(self.start_ns + newest * PERIOD_NS)),
            self.boot,
            PERIOD_NS // 1000,
            DEPTH,
            RECORD,
            supply & 0xFFFF,
            0,
        ]

    @property
    def partner(self) -> PartnerTask | None:
        """The task, if a twin answers it."""
        return self.task if isinstance(self.task, PartnerTask) else None

    def hil(self, written: Written) -> Words:
        """Holding registers 200 to 204: what the twin writes."""
        signals = written.part_present, written.air_saving, written.watchdog
        return [*self._split(np.float32(written.pressure)), *signals]

    def write_hil(self, address: int, values: Sequence[int]) -> bool:
        """Take values that the twin writes; False for other registers, or without a partner."""
        first = address - HIL
        if self.partner is None or first < 0 or first + len(values) > HIL_SIZE:
            return False
        written = self.partner.written
        words = np.array(self.hil(written), np.uint16)
        words[first : first + len(values)] = values
        pair = words[:2] if self._big else words[1::-1]
        written.pressure = float(pair.astype(">u2").view(">f4")[0])
        written.part_present, written.air_saving, written.watchdog = words[2:].tolist()
        return True

    def ring(self, first: int, count: int) -> Words:
        """``count`` holding registers of the ring from offset ``first`` within it."""
        begin, end = first // RECORD, (first + count - 1) // RECORD + 1
        scans = self.task.ring[begin:end]
        words = np.empty((len(scans), RECORD), np.uint16)
        words[:, 0] = scans["sequence"] & 0xFFFF
        words[:, 1] = scans["status"]
        high_first = scans["pressure"].astype(">f4").view(">u2").reshape(-1, 2)
        words[:, 2:] = high_first if self._big else high_first[:, ::-1]
        registers: Words = words.ravel()[first - begin * RECORD :][:count].tolist()
        return registers

    @property
    def _big(self) -> bool:
        return self.task.settings.server.word_order == "big"

    def _split(self, value: np.generic) -> Words:
        """Words of a 32-bit or 64-bit value in the configured order."""
        raw = np.asarray(value)
        words = raw.astype(raw.dtype.newbyteorder(">")).reshape(1).view(">u2")
        return [int(word) for word in (words if self._big else words[::-1])]
