"""The table of drivers: which kinds of source a configuration can name."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.modbus import source as modbus
from drivers.modbus.connection_pool import ConnectionPool
from drivers.modbus.probe import probe
from drivers.modbus.settings import ModbusSettings
from drivers.probe import Line
from drivers.reconnect import Away
from twin.errors import ConfigError, SourceError
from twin.extras import require
from twin.settings import Document
from twin.signals import Samples

if TYPE_CHECKING:
    from drivers.opcua.source import OpcuaSettings

KINDS = ("modbus", "opcua")


def open_source(
    document: Document,
    address: str = "",
    lines: ConnectionPool | None = None,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Iterator[Samples]:
    """The blocks of the source that ``[driver]`` names; ``address`` (host:port) overrides its own.

    Sources opened with the same ``lines`` share a connection where the protocol allows it.
    Raises ConfigError for an unknown kind or bad settings, SourceError if the PLC does not answer.
    With ``away``, which receives the reason, it is retried until it answers. A ``known`` source has
    given rows before: it is retried whatever it sends.
    """
    settings = settings_of(document, address)
    if isinstance(settings, ModbusSettings):
        return modbus.blocks(settings, lines=lines, away=away, known=known)
    require("opcua", "a PLC over OPC UA")
    from drivers.opcua import source as opcua  # noqa: PLC0415 - the library takes its time

    return opcua.blocks(settings, away=away, known=known)


def probe_source(document: Document, address: str = "") -> Iterator[str]:
    """Lines on what the source answers; each hint once, below the line that needs it.

    SourceError after the last line if any inspection failed.
    """
    shown_hints: set[str] = set()
    lines = _probed(settings_of(document, address))
    for line in lines:
        yield f"{'ok ' if line.good else '!! '} {line.what:<14} {line.text}"
        if line.hint and line.hint not in shown_hints:
            shown_hints.add(line.hint)
            yield f"{'':19}{line.hint}"
    if failed := [line.what for line in lines if not line.good]:
        raise SourceError(f"{document.name}: not as configured: {', '.join(failed)}")


def _probed(settings: "ModbusSettings | OpcuaSettings") -> list[Line]:
    if isinstance(settings, ModbusSettings):
        return probe(settings)
    require("opcua", "a PLC over OPC UA")
    from drivers.opcua import probe as opcua_probe  # noqa: PLC0415 - the library takes its time

    return opcua_probe.probe(settings)


def settings_of(document: Document, address: str = "") -> "ModbusSettings | OpcuaSettings":
    """Where the source is and what it holds; raises as ``open_source``."""
    settings = _configured(document)
    if not address:
        return settings
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= 0xFFFF:
        raise ConfigError(f"{address!r} is no address", "write it as HOST:PORT, e.g. 10.0.0.5:502")
    return settings.at(host, int(port))


def _configured(document: Document) -> "ModbusSettings | OpcuaSettings":
    table = document.tables.get("driver")
    if table is None:
        raise ConfigError(f"{document.name}: there is no [driver] table", "say where the PLC is")
    kind = table.get("kind", "modbus")
    if kind not in KINDS:
        raise ConfigError(f"{document.name}: unknown driver {kind!r}", f"known: {', '.join(KINDS)}")
    folder = Path(document.name).parent  # files lie there, wherever the program was started
    if kind == "modbus":
        return document.section(ModbusSettings, "driver").below(folder)
    from drivers.opcua.settings import OpcuaSettings  # noqa: PLC0415 - of a protocol in use

    return document.section(OpcuaSettings, "driver").below(folder)
