"""The driver of PLCs behind an OPC UA server; it loads the library when it connects."""

from collections.abc import Iterator

from drivers.driver import Driver
from drivers.opcua.hil_settings import HilSettings
from drivers.opcua.settings import OpcuaSettings
from drivers.outputs.writer import Writer
from drivers.probe import Line
from drivers.reconnect import Away
from twin.extras import require
from twin.settings import Document
from twin.signals import Samples


class OpcuaDriver(Driver[OpcuaSettings]):
    """Reads a PLC over OPC UA, and writes to it for hardware in the loop."""

    settings_class = OpcuaSettings
    hil_settings_class = HilSettings

    def blocks(self, away: Away | None = None, *, known: bool = False) -> Iterator[Samples]:
        """Samples as they come, as ``opcua.source.blocks`` has them."""
        _require_library()
        from drivers.opcua import source  # noqa: PLC0415 - the library takes its time

        return source.blocks(self.settings, away=away, known=known)

    def probe(self) -> list[Line]:
        """What the server answers, line by line."""
        _require_library()
        from drivers.opcua.probe import probe  # noqa: PLC0415 - the library takes its time

        return probe(self.settings)

    def writer(self, document: Document) -> Writer:
        """The writer to nodes."""
        _require_library()
        from drivers.opcua import hil  # noqa: PLC0415 - the library takes its time

        return hil.writer(self.settings, document)


def _require_library() -> None:
    """ConfigError unless the extra for OPC UA is installed."""
    require("opcua", "a PLC over OPC UA")
