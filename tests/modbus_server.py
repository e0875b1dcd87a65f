"""A Modbus TCP server that does what a test tells it, and a PLC with a trace inside it.

Plain sockets and threads, nothing shared with the driver: a client must not check itself.
"""

import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType

import numpy as np

CUT, HALF, SILENT = "cut", "half", "silent"
Hook = Callable[[int, int, int], str | int | None]  # function, address, count -> what to do


class ModbusServer:
    """Answers function codes 1 to 4 from arrays; ``hook`` may cut, halve, delay or refuse."""

    def __init__(self, unit: int = 1, port: int = 0) -> None:
        self.unit = unit
        self.areas = {code: np.zeros(65536, np.uint16) for code in (1, 2, 3, 4)}
        self.hook: Hook = lambda function, address, count: None
        self.refused: list[range] = []  # of every area
        self.accepted = 0
        self.requests: list[tuple[int, int, int]] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._open: set[socket.socket] = set()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def __enter__(self) -> "ModbusServer":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """Hang up on everybody and be gone."""
        if self._listener.fileno() < 0:
            return
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.hang_up()
        for thread in self._threads:
            thread.join()

    def hang_up(self) -> None:
        for connection in list(self._open):
            with suppress(OSError):  # the client was first
                connection.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.accepted += 1
            self._open.add(connection)
            thread = threading.Thread(target=self._serve, args=(connection,))
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, suppress(OSError):
            while len(request := connection.recv(12, socket.MSG_WAITALL)) == 12:
                if not self._answer(connection, request):
                    break
        self._open.discard(connection)

    def _answer(self, connection: socket.socket, request: bytes) -> bool:
        transaction, _, _, unit, function, address, count = struct.unpack(">HHHBBHH", request)
        self.requests.append((function, address, count))
        told = self.hook(function, address, count)
        if told == CUT:
            return False
        if told == SILENT or unit != self.unit:
            return True
        pdu = self._pdu(function, address, count, told)
        frame = struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu
        connection.sendall(frame[: len(frame) // 2] if told == HALF else frame)
        return told != HALF

    def _pdu(self, function: int, address: int, count: int, told: str | int | None) -> bytes:
        asked = range(address, address + count)
        if any(max(asked.start, r.start) < min(asked.stop, r.stop) for r in self.refused):
            told = 2
        if isinstance(told, int):
            return bytes([function | 0x80, told])
        values = self.areas[function][address : address + count]
        if function <= 2:
            data = np.packbits(values.astype(bool), bitorder="little").tobytes()
        else:
            data = values.astype(">u2").tobytes()
        return bytes([function, len(data)]) + data


class TracePlc:
    """Fills the areas of a server like a PLC with the trace block, scan by scan, when told."""

    def __init__(self, server: ModbusServer, depth: int = 4096, little: bool = False) -> None:
        self.server = server
        self.depth = depth
        self.little = little
        self.boot = 7
        self.sequence = 0  # as the PLC counts, not limited to 32 bits here
        self.time_ns = 1_000_000_000_000
        self.status = 0
        self.pressure: Callable[[int], float] = lambda sequence: 200.0 + sequence % 512
        self.scan(10)

    def words(self, code: str, value: float) -> list[int]:
        words = np.frombuffer(struct.pack(code, value), ">u2")
        return [int(word) for word in (words[::-1] if self.little else words)]

    def put(self, area: int, address: int, words: list[int]) -> None:
        self.server.areas[area][address : address + len(words)] = words

    def scan(self, scans: int) -> None:
        """Run; only the records that can still be seen are written."""
        self.sequence += scans
        self.time_ns += scans * 1_000_000
        for sequence in range(
            max(0, self.sequence - min(scans, self.depth) + 1), self.sequence + 1
        ):
            self.record(sequence)
        self.publish()

    def record(self, sequence: int) -> None:
        words = [sequence & 0xFFFF, self.status, *self.words(">f", self.pressure(sequence))]
        self.put(3, 1000 + 4 * ((sequence & 0xFFFFFFFF) % self.depth), words)

    def publish(self) -> None:
        header = [
            *self.words(">I", self.sequence & 0xFFFFFFFF),
            *self.words(">q", self.time_ns),
            *[self.boot, 1000, self.depth, 4, 5000, 0],
        ]
        self.put(3, 100, header)

    def restart(self, sequence: int = 0, boot: int | None = None) -> None:
        """Be off for a second and start again."""
        self.boot = self.boot + 1 if boot is None else boot
        self.time_ns += 1_000_000_000
        self.sequence = sequence
        self.record(sequence)
        self.publish()

    def test_registers(self) -> None:
        words = [0x1234, -12345 & 0xFFFF, *self.words(">I", 0x12345678), *self.words(">f", 123.456)]
        self.put(3, 0, words)


class PlcTime:
    """A clock for the driver under test: waiting makes the PLC scan, and takes no time."""

    def __init__(self, scan: Callable[[int], None]) -> None:
        self.scan = scan
        self.ns = 5_000_000_000
        self._scanned_ns = self.ns

    def now_ns(self) -> int:
        self.ns += 1_000  # asking takes time as well, so that waiting awake ends
        return self.ns

    def wall_ns(self) -> int:
        return 1_700_000_000_000_000_000 + self.ns

    def sleep(self, seconds: float) -> None:
        self.ns += round(seconds * 1e9)
        scans = (self.ns - self._scanned_ns) // 1_000_000
        self._scanned_ns += scans * 1_000_000
        self.scan(scans)
