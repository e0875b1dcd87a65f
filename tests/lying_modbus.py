"""A PLC with a trace whose Modbus server lies: what it says wrongly is drawn by seed."""

import socket
import struct

import numpy as np
from modbus_server import ModbusServer, TracePlc

HEADER = 100  # its first register
TIMES = [2**63 - 1, 2**63 - 10**9, -(2**63), -1, 0, 2**62, 10**18]


class LyingServer(ModbusServer):
    """Answers as ``ModbusServer``, and lies in ``share`` of its answers."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.plc: TracePlc | None = None
        self.share = 0.0
        self.lies: list[str] = []
        self._header: tuple[int, list[int]] = (0, [])  # so often still, and what it says
        super().__init__()

    def _answer(self, connection: socket.socket, request: bytes) -> bool:
        transaction, _, _, unit, function, address, count = struct.unpack(">HHHBBHH", request)
        pdu = self._pdu(function, address, count, None)
        if (function, address) == (3, HEADER):
            pdu = self._of_header(pdu)
        elif self._random.random() < self.share:
            pdu = self._of_records(pdu) if address >= 1000 else pdu
        frame = struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu
        if self._random.random() >= self.share:
            connection.sendall(frame)
            return True
        return self._lie(connection, frame)

    def _lie(self, connection: socket.socket, frame: bytes) -> bool:
        """Send something else in place of ``frame``; whether the connection stays."""
        random = self._random
        how = str(random.choice(["exception", "length", "transaction", "truncated", "garbage"]))
        self.lies.append(how)
        match how:
            case "exception":
                function = bytes([frame[7] | 0x80, int(random.integers(1, 12))])
                connection.sendall(frame[:4] + b"\0\3" + frame[6:7] + function)
            case "length":
                changed = bytearray(frame)
                changed[int(random.choice([5, 8]))] ^= int(random.integers(1, 256))
                connection.sendall(changed)
            case "transaction":
                connection.sendall(random.bytes(2) + frame[2:])
            case "truncated":
                connection.sendall(frame[: int(random.integers(len(frame)))])
                return False
            case "garbage":
                connection.sendall(random.bytes(int(random.integers(1, 400))))
        return True

    def _of_header(self, pdu: bytes) -> bytes:
        """The same, or a header that is wrong for some readings in a row."""
        left, words = self._header
        if not left and self._random.random() < self.share:
            left, words = int(self._random.integers(1, 6)), self._wrong()
        if not left:
            return pdu
        self._header = left - 1, words
        return pdu[:2] + np.array(words, ">u2").tobytes()

    def _wrong(self) -> list[int]:
        random, plc = self._random, self.plc
        assert plc is not None
        sequence, time_ns, boot, period, depth, words = plc.sequence, plc.time_ns, 7, 1000, 4096, 4
        how = str(random.choice(["depth", "words", "period", "sequence", "near", "time", "boot"]))
        self.lies.append(how)
        match how:
            case "depth":
                depth = int(random.integers(0x10000))
            case "words":
                words = int(random.integers(0x10000))
            case "period":
                period = int(random.choice([0, 1, 65535]))
            case "sequence":
                sequence = int(random.integers(1 << 32))
            case "near":
                sequence = (sequence + int(random.integers(-300, 300))) % (1 << 32)
            case "time":
                time_ns = int(random.choice(TIMES))
            case "boot":
                boot, time_ns = int(random.integers(0x10000)), int(random.choice(TIMES))
        said = [*plc.words(">I", sequence), *plc.words(">q", time_ns)]
        return [*said, boot, period, depth, words, 5000, 0]

    def _of_records(self, pdu: bytes) -> bytes:
        """Records of other scans."""
        self.lies.append("records")
        data = np.frombuffer(pdu[2:], ">u2").copy()
        data[::4] ^= np.uint16(self._random.integers(1, 0x10000))
        return pdu[:2] + data.tobytes()
