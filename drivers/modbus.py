"""A Modbus TCP PLC as a stream of samples."""

from collections.abc import Generator

from drivers.lasting import REAL, Clock, in_thread, lasting
from drivers.link import Link, ModbusSettings
from drivers.poll import Poller
from drivers.ring import Trace
from twin.signals import Samples

__all__ = ["ModbusSettings", "blocks"]


def blocks(settings: ModbusSettings, clock: Clock = REAL) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    Once there was a sample, a lost connection is retried for ever and shows as empty blocks and
    flags. SourceError before that, and whenever the PLC refuses an address. Closing releases all.
    """
    link = Link(settings)
    if settings.mode == "block":
        return lasting(Trace(settings, clock), link, clock)
    return in_thread(lasting(Poller(settings, clock), link, clock))
