"""A Modbus PLC through pymodbus: words and bits are read and written, with errors for people."""

import logging
import socket

import numpy as np
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException, ModbusIOException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu import bit_message as bits
from pymodbus.pdu import register_message as registers

from drivers.modbus.errors import lost, refused
from drivers.modbus.line import Line
from drivers.modbus.plan import Request
from drivers.modbus.settings import ModbusSettings
from drivers.modbus.tls import rejection, secured
from drivers.reconnect import LostError, unreachable
from drivers.tags import Address, Area, Words
from twin.errors import SourceError

# It logs each broken answer, with frames; our errors tell what matters of it.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

READING: dict[Area, type[ModbusPDU]] = {
    "coil": bits.ReadCoilsRequest,
    "discrete": bits.ReadDiscreteInputsRequest,
    "holding": registers.ReadHoldingRegistersRequest,
    "input": registers.ReadInputRegistersRequest,
}
EXCEPTION = 0x80  # set in the function code of an answer that brings an exception


class ModbusClient:
    """Reads words and bits over a connection, which the first broken answer closes.

    Several clients may share a ``line``; their requests take turns.
    """

    def __init__(self, settings: ModbusSettings, line: Line | None = None) -> None:
        self._settings = settings
        self._line = Line(fresh_s=0.0) if line is None else line
        self._connection: ModbusTcpClient | None = None

    def open(self) -> None:
        """Connect, unless it is connected; LostError if that fails, and as ``tls.secured``."""
        with self._line.lock:
            if self._connection is None:
                self._connection = self._line.join(self._connected)

    def close(self) -> None:
        """Close the connection, unless other clients share it."""
        with self._line.lock:
            connection, self._connection = self._connection, None
            self._line.leave(connection)

    def read(self, address: Address, count: int) -> Words:
        """Read ``count`` words (bits as 0 or 1) from ``address`` on, in one request.

        LostError if no complete answer comes; AbsentError if the PLC does not serve the address;
        SourceError if it refuses the request otherwise.
        """
        answer = self._read(Request(address, count))
        values = answer.registers if address.of_words else answer.bits[:count]
        return np.array(values, np.uint16)

    def ask(self, request: Request) -> bytes:
        """Data of the answer as they came, ``request.size`` bytes; errors as from ``read``."""
        return self._read(request).encode()[1:]  # behind their number

    def write(self, address: Address, values: tuple[int, ...]) -> None:
        """Write words (to coils 0 or 1) from ``address`` on; errors as from ``read``.

        Only hardware in the loop writes (drivers/outputs/writer.py).
        """
        offset, unit = address.offset, self._settings.unit
        question: ModbusPDU
        if address.of_words:
            question = registers.WriteMultipleRegistersRequest(unit, 0, offset, registers=values)
        else:
            states = [value != 0 for value in values]
            question = bits.WriteMultipleCoilsRequest(offset, states, unit)
        answer = self._ask(question, address, len(values))
        if (answer.address, answer.count) != (offset, len(values)):
            raise self._lost(address, len(values), "the answer is to another request")

    def _read(self, request: Request) -> ModbusPDU:
        address, count = request.address, request.count
        question = READING[address.area](self._settings.unit, 0, address.offset, count)
        answer = self._ask(question, address, count)
        size = 2 * len(answer.registers) if address.of_words else len(answer.bits) // 8
        if size != request.size:
            raise self._lost(address, count, "the answer has the wrong length")
        return answer

    def _ask(self, question: ModbusPDU, address: Address, count: int) -> ModbusPDU:
        """The answer, in turn with the others on the line; errors as from ``read``."""
        with self._line.lock:
            if self._connection is None or not self._connection.connected:
                raise self._lost(address, count, "the connection is closed")
            try:
                answer = self._connection.execute(False, question)
            except (OSError, ModbusException) as error:
                raise self._unanswered(error, address, count) from error
            self._line.has_answered = True
            if answer.function_code & ~EXCEPTION != question.function_code:
                raise self._lost(address, count, "no answer")
            if answer.isError():
                raise self._refused(address, count, answer.exception_code)
            return answer

    def _unanswered(self, error: Exception, address: Address, count: int) -> SourceError:
        """The error for a request without an answer; inside TLS the PLC may have rejected us."""
        lost_error = self._lost(address, count, "no answer")
        if self._settings.tls is None or isinstance(error, ModbusIOException):
            return lost_error  # the latter: nothing, or nothing that can be decoded, came in time
        target = f"{self._settings.host}:{self._settings.port}"
        return rejection(error, target, has_answered=self._line.has_answered) or lost_error

    def _lost(self, address: Address, count: int, cause: str) -> LostError:
        """Close for all, and give the error: a late answer must not be taken for the next one."""
        with self._line.lock:
            self._line.hang_up(self._connection)
            self.close()
        return lost(self._settings.where, address, count, cause)

    def _refused(self, address: Address, count: int, code: int) -> SourceError:
        error = refused(self._settings.where, address, count, code)
        if isinstance(error, LostError):
            self.close()
        return error

    def _connected(self) -> ModbusTcpClient:
        """A new connection; pymodbus' own attempts would not say why they failed."""
        host, port, tls = self._settings.host, self._settings.port, self._settings.tls
        timeout_ms = self._settings.timeout_ms
        connection = ModbusTcpClient(host, port=port, timeout=timeout_ms * 1e-3, retries=0)
        plain = connected(host, port, timeout_ms)
        # Its framing inside TLS would take the first piece of an answer for the whole.
        connection.socket = plain if tls is None else secured(plain, tls, f"{host}:{port}")
        return connection


def connected(host: str, port: int, timeout_ms: float) -> socket.socket:
    """A TCP connection; LostError if it cannot be made within ``timeout_ms``."""
    try:
        return socket.create_connection((host, port), timeout_ms * 1e-3)
    except (OSError, UnicodeError) as error:  # the latter where it cannot be a host's name
        raise unreachable(f"{host}:{port}", error, "Modbus TCP server") from error
