"""The table of drivers: which kinds of source a configuration can name."""

from collections.abc import Iterator

from drivers import modbus
from drivers.link import ModbusSettings
from drivers.probe import probe
from twin.errors import ConfigError
from twin.settings import Document
from twin.signals import Samples

KINDS = ("modbus",)


def open_source(document: Document, address: str = "") -> Iterator[Samples]:
    """The blocks of the source that ``[driver]`` names; ``address`` (host:port) goes before it.

    Raises ConfigError for an unknown kind or bad settings, SourceError if it does not answer.
    """
    return modbus.blocks(_settings(document, address))


def probe_source(document: Document, address: str = "") -> Iterator[str]:
    """Say, line by line, what the source answers."""
    for line in probe(_settings(document, address)):
        yield f"{'ok ' if line.good else '!! '} {line.what:<14} {line.text}"


def _settings(document: Document, address: str) -> ModbusSettings:
    table = document.tables.get("driver")
    if table is None:
        raise ConfigError(f"{document.name}: there is no [driver] table", "say where the PLC is")
    kind = table.get("kind", "modbus")
    if kind not in KINDS:
        raise ConfigError(f"{document.name}: unknown driver {kind!r}", f"known: {', '.join(KINDS)}")
    settings = document.section(ModbusSettings, "driver")
    if not address:
        return settings
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(f"{address!r} is no address", "write it as HOST:PORT, e.g. 10.0.0.5:502")
    return settings.model_copy(update={"host": host, "port": int(port)})
