"""A Modbus TCP PLC as a stream of samples."""

from collections.abc import Generator, Iterator

from drivers.link import Clock, Link, LostError, ModbusSettings
from drivers.poll import Poller, in_thread
from drivers.ring import EMPTY, Trace
from twin.signals import Samples

__all__ = ["ModbusSettings", "blocks"]

RETRY_S = 0.4  # between two attempts to connect
REAL = Clock()


def blocks(settings: ModbusSettings, clock: Clock = REAL) -> Generator[Samples, None, None]:
    """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

    Once there was a sample, a lost connection is retried for ever and shows as empty blocks and
    flags. SourceError before that, and whenever the PLC refuses an address. Closing releases all.
    """
    if settings.mode == "block":
        return _lasting(Trace(settings, clock), settings, clock)
    return in_thread(_lasting(Poller(settings, clock), settings, clock))


def _lasting(
    source: Trace | Poller, settings: ModbusSettings, clock: Clock
) -> Generator[Samples, None, None]:
    """Samples of ``source`` over one connection after the other."""
    link = Link(settings)
    begun = False
    try:
        link.open()
        while True:
            try:
                for block in source.samples(link):
                    begun = True
                    yield block
            except LostError:
                if not begun:
                    raise
                yield from _reconnect(link, clock)
    finally:
        link.close()


def _reconnect(link: Link, clock: Clock) -> Iterator[Samples]:
    """Empty blocks until there is a connection again."""
    while True:
        yield EMPTY  # and around whatever may take its time
        for _ in range(2):
            clock.sleep(RETRY_S / 2)
            yield EMPTY
        try:
            link.open()
        except LostError:
            continue
        yield EMPTY  # connected is not yet answered
        return
