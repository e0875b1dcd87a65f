"""A bare socket for polling, which has one millisecond for everything.

A read of four registers costs 1.4 times the processor time of a socket that checks nothing, and 3.5
times through pymodbus (docs/decisions/0075). All other reading is through ``ModbusClient``.
"""

import socket
import struct

from drivers.modbus.client import EXCEPTION, READING, connected
from drivers.modbus.errors import lost, refused
from drivers.modbus.plan import Request
from drivers.modbus.settings import ModbusSettings
from drivers.reconnect import LostError

QUESTION = struct.Struct(">HHHBBHH")  # transaction, protocol 0, length, unit, function, from, count
# Transaction, protocol 0, length, unit, function, number of data bytes that follow. An exception
# has its code in place of that number, and nothing follows. The length counts from the unit on.
HEAD = struct.Struct(">HHHBBB")


class PollSocket:
    """A connection that reads, and closes on the first broken answer."""

    def __init__(self, settings: ModbusSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._transaction = 0

    def open(self) -> None:
        """Connect, unless it is connected; LostError if that fails."""
        if self._socket is None:
            settings = self._settings
            self._socket = connected(settings.host, settings.port, settings.timeout_ms)
            _wait_in_the_kernel(self._socket, settings.timeout_ms)

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def ask(self, request: Request) -> bytes:
        """Data of the answer as they came, ``request.size`` bytes.

        LostError if no complete answer comes; AbsentError if the PLC does not serve the address;
        SourceError if it refuses the request otherwise.
        """
        if self._socket is None:
            raise self._lost(request, "the connection is closed")
        self._transaction = (self._transaction + 1) & 0xFFFF
        stamp = self._transaction, self._settings.unit, READING[request.address.area].function_code
        try:
            self._socket.sendall(question(request, *stamp))
            received = self._received(HEAD.size)
            if received == head(request.size, *stamp):
                return self._received(request.size)
        except OSError as error:
            raise self._lost(request, "no answer") from error
        if received[:-1] != exception_head(*stamp):
            raise self._lost(request, "no answer")
        refusal = refused(self._settings.where, request.address, request.count, received[-1])
        if isinstance(refusal, LostError):
            self.close()
        raise refusal

    def _received(self, size: int) -> bytes:
        """Exactly ``size`` bytes, in however many pieces they come; OSError if they do not."""
        assert self._socket is not None
        data = self._socket.recv(size, socket.MSG_WAITALL)
        if len(data) < size:
            raise ConnectionError(f"{len(data)} of {size} bytes came")
        return data

    def _lost(self, request: Request, cause: str) -> LostError:
        """The error for a lost answer; closes, so that no late answer is taken for the next one."""
        self.close()
        return lost(self._settings.where, request.address, request.count, cause)


def _wait_in_the_kernel(connection: socket.socket, timeout_ms: float) -> None:
    """Python's own timeout would poll before each read, and could not wait for whole answers."""
    timeout = struct.pack("@ll", 0, round(timeout_ms * 1e3))  # struct timeval: s, µs
    connection.settimeout(None)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, timeout)


def question(request: Request, transaction: int, unit: int, function: int) -> bytes:
    """Encode the whole request."""
    return QUESTION.pack(transaction, 0, 6, unit, function, request.address.offset, request.count)


def head(size: int, transaction: int, unit: int, function: int) -> bytes:
    """The head of an answer that brings ``size`` bytes of data; only the data follow."""
    return HEAD.pack(transaction, 0, 3 + size, unit, function, size)


def exception_head(transaction: int, unit: int, function: int) -> bytes:
    """The head of an answer that brings an exception, without its code."""
    return HEAD.pack(transaction, 0, 3, unit, function | EXCEPTION, 0)[:-1]
