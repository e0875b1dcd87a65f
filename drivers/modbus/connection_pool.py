"""One Modbus connection for all ejectors behind one PLC: their requests take turns.

PLCs grant few connections, and some of them only one for each that was programmed.
"""

import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.modbus.client import ModbusClient, ModbusSettings
from drivers.modbus.pdu import Request, Store
from drivers.reconnect import RETRY_S, LostError

FRESH_S = RETRY_S / 2  # so long a failed attempt of one user counts for all


@dataclass
class Line:
    """A connection that several clients share; once broken it is closed for all of them."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    connection: socket.socket | None = None
    users: int = 0
    failure: LostError | None = None  # of the last try to connect
    failed_s: float = 0.0

    def join(self, connect: Callable[[], socket.socket | None]) -> socket.socket | None:
        """The connection, made with ``connect`` unless there is one; LostError if that fails."""
        if self.connection is None:
            if self.failure is not None and time.monotonic() - self.failed_s < FRESH_S:
                # Otherwise each user would wait for the failed attempts of all others.
                raise LostError(str(self.failure), self.failure.hint)
            try:
                self.connection, self.users = connect(), 0
            except LostError as error:
                self.failure, self.failed_s = error, time.monotonic()
                raise
        self.users += 1
        return self.connection

    def leave(self, connection: socket.socket | None) -> None:
        """Count one user less; the last one closes the connection."""
        if connection is not None and connection is self.connection:
            self.users -= 1
            if not self.users:
                self.hang_up(connection)

    def hang_up(self, connection: socket.socket | None) -> None:
        """Close it for everybody: a late answer must not be taken for another's."""
        if connection is not None and connection is self.connection:
            connection.close()
            self.connection = None


class ConnectionPool:
    """The shared connections to all PLCs of a process."""

    def __init__(self) -> None:
        self._lines: dict[str, Line] = {}  # by the settings of the connection

    def to(self, settings: ModbusSettings) -> Line:
        """Give the one connection to this PLC, for all of its units."""
        key = settings.model_dump_json(include={"host", "port", "timeout_ms", "tls"})
        return self._lines.setdefault(key, Line())


class PooledClient(ModbusClient):
    """A client over a shared connection, with the same calls and errors."""

    def __init__(self, settings: ModbusSettings, line: Line) -> None:
        super().__init__(settings)
        self._line = line

    def open(self) -> None:
        """Connect, unless somebody has; LostError if that fails."""
        with self._line.lock:
            if self._socket is None:
                self._socket = self._line.join(self._connected)

    def close(self) -> None:
        """Leave the connection to the others."""
        with self._line.lock:
            connection, self._socket = self._socket, None
            self._line.leave(connection)

    def ask(self, request: Request | Store) -> bytes:
        """As ``ModbusClient.ask``, when it is our turn."""
        with self._line.lock:
            return super().ask(request)

    def _connected(self) -> socket.socket | None:
        super().open()
        return self._socket

    def _lost(self, request: Request | Store, cause: str) -> LostError:
        with self._line.lock:
            self._line.hang_up(self._socket)
            return super()._lost(request, cause)
