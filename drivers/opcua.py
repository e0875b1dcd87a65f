"""A PLC behind an OPC UA server as a stream of samples."""

from collections.abc import Generator

from drivers.lasting import REAL, Away, Clock, in_thread, lasting
from drivers.opcua_link import OpcuaLink
from drivers.opcua_settings import OpcuaSettings
from drivers.opcua_subscribe import Subscription
from drivers.opcua_trace import NodeTrace
from twin.signals import Samples

__all__ = ["OpcuaSettings", "blocks"]


def blocks(
    settings: OpcuaSettings, clock: Clock = REAL, away: Away | None = None
) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    Once there was a block, a lost connection is retried for ever and shows as empty blocks and
    flags. Before that it is retried too where there is ``away``, which is told why: nobody answers,
    or the server lacks its nodes. Other SourceErrors come out, and whenever the server cannot
    be trusted or serves something else. It runs in a thread, since connecting may take seconds.
    Closing releases all.
    """
    link = OpcuaLink(settings, clock)
    if settings.mode == "block":
        return in_thread(lasting(NodeTrace(settings, clock), link, clock, away))
    return in_thread(lasting(Subscription(settings, clock), link, clock, away))
