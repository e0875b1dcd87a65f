"""What a driver is: a class that reads one kind of PLC, built in or of another package."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Generic, TypeVar

from drivers.connection_pool import ConnectionPool
from drivers.outputs.writer import Writer
from drivers.probe import Line
from drivers.reconnect import Away
from drivers.settings import DriverSettings
from twin.errors import ConfigError
from twin.settings import Document, Settings
from twin.signals import Samples

S = TypeVar("S", bound=DriverSettings)


class Driver(ABC, Generic[S]):
    """The driver of one PLC. Drivers of one process may share connections of a ``pool``."""

    settings_class: ClassVar[type[DriverSettings]]
    hil_settings_class: ClassVar[type[Settings] | None] = None  # of [hil]; None: it cannot write

    def __init__(self, settings: S, pool: ConnectionPool | None = None) -> None:
        self.settings = settings
        self.pool = pool

    @abstractmethod
    def blocks(self, away: Away | None = None, *, known: bool = False) -> Iterator[Samples]:
        """Samples as they come: a block at least every 0.5 s, empty while there is nothing.

        A PLC that has given rows, or is ``known`` to have, is retried for ever: any error counts as
        a lost connection, and shows as empty blocks and flags. Before that, a PLC that does not
        answer is retried only with ``away``, which receives why there are no rows; other
        SourceErrors are raised. Closing the iterator releases all.
        """

    @abstractmethod
    def probe(self) -> list[Line]:
        """Connect, read all configured values and report each; never raises SourceError."""

    def writer(self, document: Document) -> Writer:
        """The writer of what ``[hil]`` lists.

        ConfigError if the driver cannot write, SourceError if the PLC does not answer.
        """
        raise cannot_write(document, self.settings.kind)


AnyDriver = Driver[Any]


def cannot_write(document: Document, kind: str) -> ConfigError:
    """The error for ``[hil]`` beside a driver that only reads."""
    return ConfigError(
        f"{document.name}: [hil] lists what is written, and a driver of kind {kind!r} only reads",
        "leave [hil] out",
    )
