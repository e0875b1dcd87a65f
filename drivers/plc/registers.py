"""The trace as Modbus registers: 16-bit words of the newest scans, whatever transports them.

Addresses are 0-based protocol offsets. A 64-bit or 32-bit value has its high word first unless
``word_order`` is "little".
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.plc.scan import DEPTH, PERIOD_NS, Task
from twin.signals import Command

RECORD = 4  # registers of one scan in the ring
HEADER, RING = 100, 1000
HEADER_SIZE, TEST_SIZE, INPUT_SIZE, COILS = 12, 6, 7, 2
RING_SIZE = RECORD * DEPTH

Words = list[int]


@dataclass(frozen=True)
class Registers:
    """The PLC's memory as a client sees it; ``start_ns`` is the PLC time of sequence 0."""

    task: Task
    start_ns: int
    boot: int  # differs after every restart

    def coils(self) -> int:
        """Bits of the commands: as a client asked, or as the program has them."""
        asked = self.task.settings.program.commands == "coils"
        return int(self.task.coils if asked else self.task.commands)

    def write_coils(self, address: int, values: Sequence[int | bool]) -> bool:
        """Command from a client; False where the program commands itself."""
        if self.task.settings.program.commands != "coils":
            return False
        bits = int(self.task.coils)
        for bit, value in enumerate(values, address):
            bits = bits & ~(1 << bit) | int(value) << bit
        self.task.coils = Command(bits)
        return True

    def inputs(self) -> Words:
        """Input registers 0 to 6: plain values of the newest scan."""
        scan = self.task.ring[self.task.newest % DEPTH]
        tenths = int(np.clip(np.rint(float(scan["pressure"]) * 10), -32768, 32767))
        return [
            tenths & 0xFFFF,
            *self._split(scan["pressure"]),
            int(scan["supply"]) & 0xFFFF,
            int(scan["status"]),
            *self._split(np.uint32(self.task.newest & 0xFFFFFFFF)),
        ]

    def holding(self, address: int, count: int) -> Words:
        """``count`` holding registers, all of one part of the map, from ``address`` on."""
        if address >= RING:
            return self.ring(address - RING, count)
        begin, words = (HEADER, self.header()) if address >= HEADER else (0, self.test())
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
        """Holding registers 100 to 111: where the trace stands."""
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

    def ring(self, first: int, count: int) -> Words:
        """``count`` holding registers of the ring from offset ``first`` within it."""
        begin, end = first // RECORD, (first + count - 1) // RECORD + 1
        scans = self.task.ring[begin:end]
        words = np.empty((len(scans), RECORD), np.uint16)
        words[:, 0] = scans["sequence"] & 0xFFFF
        words[:, 1] = scans["status"]
        high_first = scans["pressure"].astype(">f4").view(">u2").reshape(-1, 2)
        words[:, 2:] = high_first if self._big else high_first[:, ::-1]
        part: Words = words.ravel()[first - begin * RECORD :][:count].tolist()
        return part

    @property
    def _big(self) -> bool:
        return self.task.settings.server.word_order == "big"

    def _split(self, value: np.generic) -> Words:
        """Words of a 32-bit or 64-bit value in the configured order."""
        raw = np.asarray(value)
        words = raw.astype(raw.dtype.newbyteorder(">")).reshape(1).view(">u2")
        return [int(word) for word in (words if self._big else words[::-1])]
