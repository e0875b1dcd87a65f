"""The driver of PLCs that speak Modbus TCP."""

from collections.abc import Iterator

from drivers.driver import Driver
from drivers.modbus import hil, source
from drivers.modbus.probe import probe
from drivers.modbus.settings import ModbusSettings
from drivers.outputs.writer import Writer
from drivers.probe import Line
from drivers.reconnect import Away
from twin.settings import Document
from twin.signals import Samples


class ModbusDriver(Driver[ModbusSettings]):
    """Reads a PLC over Modbus TCP, and writes to it for hardware in the loop."""

    settings_class = ModbusSettings
    hil_settings_class = hil.HilSettings

    def blocks(self, away: Away | None = None, *, known: bool = False) -> Iterator[Samples]:
        """Samples as they come, as ``modbus.source.blocks`` has them."""
        return source.blocks(self.settings, pool=self.pool, away=away, known=known)

    def probe(self) -> list[Line]:
        """What the PLC answers, line by line."""
        return probe(self.settings)

    def writer(self, document: Document) -> Writer:
        """The writer to registers and coils."""
        return hil.writer(self.settings, document, self.pool)
