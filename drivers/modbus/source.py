"""A Modbus TCP PLC as a stream of samples."""

from collections.abc import Generator

from drivers.connection_pool import ConnectionPool
from drivers.modbus.client import ModbusClient
from drivers.modbus.line import line_to
from drivers.modbus.poll import Poller
from drivers.modbus.poll_socket import PollSocket
from drivers.modbus.ring import Trace
from drivers.modbus.settings import ModbusSettings
from drivers.reconnect import REAL, Away, Clock, in_thread, reconnecting
from twin.signals import Samples


def blocks(
    settings: ModbusSettings,
    clock: Clock = REAL,
    pool: ConnectionPool | None = None,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    A PLC that has given rows, or is ``known`` to have, is retried for ever: any error counts as a
    lost connection, and shows as empty blocks and flags. Before that, a PLC that is absent or does
    not serve an address is retried only with ``away``; other SourceErrors are raised. ``away``
    receives why there are no rows. Closing releases all.
    With a ``pool``, block mode shares its connection with others; polling has no millisecond to
    wait for them.
    """
    if settings.mode == "poll":
        link = PollSocket(settings) if settings.tls is None else ModbusClient(settings)
        return in_thread(reconnecting(Poller(settings, clock), link, clock, away, known=known))
    client = ModbusClient(settings, line_to(settings, pool))
    stream = reconnecting(Trace(settings, clock), client, clock, away, known=known)
    return stream if settings.tls is None else in_thread(stream)  # shaking hands takes time
