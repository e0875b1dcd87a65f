"""A PLC behind an OPC UA server as a stream of samples."""

from collections.abc import Generator

from drivers.opcua.client import OpcuaClient
from drivers.opcua.settings import OpcuaSettings
from drivers.opcua.subscribe import Subscription
from drivers.opcua.trace import NodeTrace
from drivers.reconnect import REAL, Away, Clock, in_thread, reconnecting
from twin.signals import Samples

__all__ = ["OpcuaSettings", "blocks"]


def blocks(
    settings: OpcuaSettings,
    clock: Clock = REAL,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    A server that has given rows, or is ``known`` to have, is retried for ever: any error counts as
    a lost connection, and shows as empty blocks and flags. Before that, a server that is absent or
    lacks nodes is retried only with ``away``; other errors are raised. ``away`` receives why there
    are no rows. It runs in a thread, since connecting may take seconds. Closing releases all.
    """
    link = OpcuaClient(settings, clock)
    if settings.mode == "block":
        return in_thread(reconnecting(NodeTrace(settings, clock), link, clock, away, known=known))
    return in_thread(reconnecting(Subscription(settings, clock), link, clock, away, known=known))
