"""The table of drivers: which kinds of source a configuration can name."""

from collections.abc import Callable, Iterator
from pathlib import Path

from drivers import installed
from drivers.connection_pool import ConnectionPool
from drivers.driver import AnyDriver, cannot_write
from drivers.reconnect import Away
from drivers.settings import DriverSettings
from twin.errors import ConfigError, SourceError, known_names
from twin.settings import Document, Settings
from twin.signals import Samples


def _modbus() -> type[AnyDriver]:
    from drivers.modbus.driver import ModbusDriver  # noqa: PLC0415 - of a protocol in use

    return ModbusDriver


def _opcua() -> type[AnyDriver]:
    from drivers.opcua.driver import OpcuaDriver  # noqa: PLC0415 - of a protocol in use

    return OpcuaDriver


DEFAULT = "modbus"  # without a kind
BUILT_IN: dict[str, Callable[[], type[AnyDriver]]] = {DEFAULT: _modbus, "opcua": _opcua}


def open_source(
    document: Document,
    address: str = "",
    pool: ConnectionPool | None = None,
    away: Away | None = None,
    *,
    known: bool = False,
) -> Iterator[Samples]:
    """The blocks of the source that ``[driver]`` names; ``address`` (host:port) overrides its own.

    Sources opened with the same ``pool`` share a connection where the protocol allows it.
    Raises ConfigError for an unknown kind or bad settings, SourceError if the PLC does not answer.
    With ``away``, which receives the reason, it is retried until it answers. A ``known`` source has
    given rows before: it is retried whatever it sends.
    """
    return driver_of(document, address, pool).blocks(away, known=known)


def probe_source(document: Document, address: str = "") -> Iterator[str]:
    """Lines on what the source answers; each hint once, below the line that needs it.

    SourceError after the last line if any inspection failed.
    """
    shown_hints: set[str] = set()
    lines = driver_of(document, address).probe()
    for line in lines:
        yield f"{'ok ' if line.good else '!! '} {line.what:<14} {line.text}"
        if line.hint and line.hint not in shown_hints:
            shown_hints.add(line.hint)
            yield f"{'':19}{line.hint}"
    if failed := [line.what for line in lines if not line.good]:
        raise SourceError(f"{document.name}: not as configured: {', '.join(failed)}")


def driver_of(
    document: Document, address: str = "", pool: ConnectionPool | None = None
) -> AnyDriver:
    """The driver that ``[driver]`` names, with its settings; errors as from ``settings_of``."""
    kind, origin = _find(document)
    settings = _settings(document, kind, origin, address)
    if origin:
        return installed.GuardedDriver(kind, settings, pool, origin)
    return kind(settings, pool)


def settings_of(document: Document, address: str = "") -> DriverSettings:
    """Where the source is and what it holds.

    ConfigError for an unknown kind, a driver that cannot be used, bad settings or a bad address.
    """
    return _settings(document, *_find(document), address)


def hil_settings_of(document: Document) -> Settings:
    """What ``[hil]`` lists; ConfigError as from ``settings_of``, or if the driver only reads."""
    kind, origin = _find(document)
    if kind.hil_settings_class is None:
        raise cannot_write(document, document.tables["driver"]["kind"])
    with installed.naming(origin, ConfigError):
        return document.section(kind.hil_settings_class, "hil")


def _find(document: Document) -> tuple[type[AnyDriver], str]:
    """The class of the driver that ``[driver]`` names, and where it is from; "" if it is built in.

    Without such a table the default one. ConfigError for an unknown kind, or if it cannot be used.
    """
    table = document.tables.get("driver")
    kind = str(table.get("kind", DEFAULT)) if isinstance(table, dict) else DEFAULT
    if kind in BUILT_IN:
        return BUILT_IN[kind](), ""
    try:
        found = installed.load(kind)
    except ConfigError as error:
        raise ConfigError(f"{document.name}: {error}", error.hint) from error
    if found is None:
        raise _unknown(document, kind)
    return found


def _unknown(document: Document, kind: str) -> ConfigError:
    """The error for a kind that is neither built in nor installed."""
    others = installed.installed()
    brought = "".join(f"; {name!r} comes with {package}" for name, package in others.items())
    return ConfigError(
        f"{document.place('driver', 'kind')}: unknown driver {kind!r}",
        f"{known_names(kind, [*BUILT_IN, *others])}{brought}; a driver for another PLC is a package"
        " of its own, docs/write-a-driver.md",
    )


def _settings(
    document: Document, kind: type[AnyDriver], origin: str, address: str
) -> DriverSettings:
    if "driver" not in document.tables:
        raise ConfigError(
            f"{document.name}: there is no [driver] table",
            'say where the PLC is, such as kind = "modbus" and host = "192.168.0.10";'
            " twin init writes a whole configuration",
        )
    folder = Path(document.name).parent  # files lie there, wherever the program was started
    with installed.naming(origin, ConfigError):
        settings = document.section(kind.settings_class, "driver").below(folder)
        if address:
            settings = settings.at(*_host_and_port(address))
    if not isinstance(settings, DriverSettings):
        raise ConfigError(
            f"{origin} gave {type(settings).__name__} instead of settings",
            f"settings_class.below and at return settings; {installed.A_MISTAKE}",
        )
    return settings


def _host_and_port(address: str) -> tuple[str, int]:
    """The parts of HOST:PORT; ConfigError if it is not such a text."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) <= 0xFFFF:
        raise ConfigError(f"{address!r} is no address", "write it as HOST:PORT, e.g. 10.0.0.5:502")
    return host, int(port)
