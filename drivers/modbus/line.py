"""One Modbus connection for all ejectors behind one PLC: their requests take turns.

PLCs grant few connections, and some of them only one for each that was programmed.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from drivers.connection_pool import ConnectionPool
from drivers.modbus.settings import ModbusSettings
from drivers.reconnect import RETRY_S, LostError

if TYPE_CHECKING:
    from pymodbus.client import ModbusTcpClient

FRESH_S = RETRY_S / 2  # s for which a failed attempt of one user counts for all


@dataclass
class Line:
    """A connection that several clients share; once broken it is closed for all of them."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    fresh_s: float = FRESH_S
    connection: "ModbusTcpClient | None" = None
    has_answered: bool = False  # whether the PLC has answered over this connection
    users: int = 0
    failure: LostError | None = None  # error of the last attempt to connect
    failed_s: float = 0.0

    def join(self, connect: "Callable[[], ModbusTcpClient]") -> "ModbusTcpClient":
        """The connection, made with ``connect`` unless there is one; LostError if that fails."""
        if self.connection is None:
            if self.failure is not None and time.monotonic() - self.failed_s < self.fresh_s:
                # Otherwise each user would wait for the failed attempts of all others.
                raise LostError(str(self.failure), self.failure.hint)
            try:
                self.connection, self.users, self.has_answered = connect(), 0, False
            except LostError as error:
                self.failure, self.failed_s = error, time.monotonic()
                raise
        self.users += 1
        return self.connection

    def leave(self, connection: "ModbusTcpClient | None") -> None:
        """Count one user less; the last one closes the connection."""
        if connection is not None and connection is self.connection:
            self.users -= 1
            if not self.users:
                self.hang_up(connection)

    def hang_up(self, connection: "ModbusTcpClient | None") -> None:
        """Close it for everybody: a late answer must not be taken for another's."""
        if connection is not None and connection is self.connection:
            connection.close()  # type: ignore[no-untyped-call]
            self.connection = None


def line_to(settings: ModbusSettings, pool: ConnectionPool | None) -> Line | None:
    """The one connection of a pool to this PLC, for all of its units; None without a pool."""
    if pool is None:
        return None
    address = settings.model_dump_json(include={"host", "port", "timeout_ms", "tls"})
    return pool.shared((settings.kind, address), Line)
