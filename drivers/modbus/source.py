"""A Modbus TCP PLC as a stream of samples."""

from collections.abc import Generator

from drivers.modbus.client import ModbusClient, ModbusSettings
from drivers.modbus.connection_pool import ConnectionPool, PooledClient
from drivers.modbus.poll import Poller
from drivers.modbus.ring import Trace
from drivers.reconnect import REAL, Away, Clock, in_thread, reconnecting
from twin.signals import Samples

__all__ = ["ModbusSettings", "blocks"]


def blocks(
    settings: ModbusSettings,
    clock: Clock = REAL,
    lines: ConnectionPool | None = None,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    A PLC that has given rows, or is ``known`` to have, is retried for ever: any error counts as a
    lost connection, and shows as empty blocks and flags. Before that, a PLC that is absent or does
    not serve an address is retried only with ``away``; other SourceErrors are raised. ``away``
    receives why there are no rows. Closing releases all.
    With ``lines``, block mode shares its connection with others; polling has no millisecond to wait
    for them.
    """
    if settings.mode == "poll":
        return in_thread(
            reconnecting(Poller(settings, clock), ModbusClient(settings), clock, away, known=known)
        )
    link = ModbusClient(settings) if lines is None else PooledClient(settings, lines.to(settings))
    stream = reconnecting(Trace(settings, clock), link, clock, away, known=known)
    return stream if settings.tls is None else in_thread(stream)  # shaking hands takes time
