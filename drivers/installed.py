"""Drivers of other packages, found by their entry points; their mistakes become errors for people.

The project file of a package has ``kind = "module:Class"`` in the table
``[project.entry-points."ejector_twin.drivers"]``. Only kinds that are not built in are looked up:
a look-up reads the metadata of all installed packages.
"""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import numpy as np

from drivers.connection_pool import ConnectionPool
from drivers.driver import AnyDriver, Driver
from drivers.outputs.writer import Writer
from drivers.probe import Line
from drivers.reconnect import Away
from drivers.settings import DriverSettings
from twin.errors import ConfigError, SourceError, TwinError, in_words
from twin.settings import Document, Settings
from twin.signals import SAMPLE, Samples

GROUP = "ejector_twin.drivers"  # of entry points; packages of others name it
A_MISTAKE = "this is a mistake of the driver: its author can correct it"


def installed() -> dict[str, str]:
    """The kinds of all installed drivers, each with its packages."""
    packages: dict[str, list[str]] = {}
    for entry_point in entry_points(group=GROUP):
        packages.setdefault(entry_point.name, []).append(_package(entry_point))
    return {kind: " and ".join(sorted(names)) for kind, names in sorted(packages.items())}


def load(kind: str) -> tuple[type[AnyDriver], str] | None:
    """The driver of this kind, and where it is from; None if no package has it.

    ConfigError if several have it, or if it cannot be imported or is no driver.
    """
    found = list(entry_points(group=GROUP, name=kind))
    if not found:
        return None
    if len(found) > 1:
        packages = " and ".join(sorted(map(_package, found)))
        raise ConfigError(f"several packages have a driver {kind!r}: {packages}", "uninstall one")
    origin = f"the driver {kind!r} of {_package(found[0])}"
    try:
        loaded = found[0].load()
    except (Exception, SystemExit) as error:  # whatever its modules do when they are imported
        raise ConfigError(
            f"{origin} cannot be imported from {found[0].value}: {in_words(error)}",
            "install what it needs beside ejector-twin, or ask its author",
        ) from error
    if misfit := _misfit(loaded):
        raise ConfigError(
            f"{origin} does not fit this program: {found[0].value} {misfit}",
            "install a version of it that fits; docs/write-a-driver.md says what a driver has",
        )
    return loaded, origin


def _package(entry_point: EntryPoint) -> str:
    distribution = entry_point.dist
    return f"{distribution.name} {distribution.version}" if distribution else "an unknown package"


def _misfit(loaded: object) -> str:
    """Why this is no driver; "" if it is one."""
    if not (isinstance(loaded, type) and issubclass(loaded, Driver)):
        return "is no class derived from drivers.driver.Driver"
    settings = getattr(loaded, "settings_class", None)
    if not (isinstance(settings, type) and issubclass(settings, DriverSettings)):
        return "has no settings_class derived from drivers.settings.DriverSettings"
    written = loaded.hil_settings_class
    if written is not None and not (isinstance(written, type) and issubclass(written, Settings)):
        return "has a hil_settings_class that is not derived from twin.settings.Settings"
    missing = sorted(loaded.__abstractmethods__)
    return f"lacks {' and '.join(missing)}" if missing else ""


class GuardedDriver(Driver[DriverSettings]):
    """An installed driver whose mistakes become SourceErrors that name it."""

    def __init__(
        self,
        kind: type[AnyDriver],
        settings: DriverSettings,
        pool: ConnectionPool | None,
        origin: str,
    ) -> None:
        super().__init__(settings, pool)
        with naming(origin):
            self._driver = kind(settings, pool)
        self._origin = origin

    def blocks(self, away: Away | None = None, *, known: bool = False) -> Iterator[Samples]:
        """The driver's blocks; SourceError at a block that is none."""
        with naming(self._origin):
            blocks = iter(self._driver.blocks(away, known=known))
            try:
                for block in blocks:
                    if misfit := _no_block(block):
                        raise SourceError(
                            f"{self._origin} gave {misfit}",
                            f"a block is a NumPy array of twin.signals.SAMPLE; {A_MISTAKE}",
                        )
                    yield block
            finally:
                if hasattr(blocks, "close"):
                    blocks.close()

    def probe(self) -> list[Line]:
        """What the driver's PLC answers; SourceError at a line that is none."""
        with naming(self._origin):
            lines = list(self._driver.probe())
        for line in lines:
            if not isinstance(line, Line):
                raise SourceError(
                    f"{self._origin} gave {type(line).__name__} instead of a line",
                    f"probe gives a list of drivers.probe.Line; {A_MISTAKE}",
                )
        return lines

    def writer(self, document: Document) -> Writer:
        """The driver's writer."""
        with naming(self._origin):
            return self._driver.writer(document)


def _no_block(block: object) -> str:
    """What this is instead of a block of samples; "" if it is one."""
    if not isinstance(block, np.ndarray):
        return f"{type(block).__name__} instead of a block"
    if block.dtype != SAMPLE or block.ndim != 1:
        return f"an array of {block.dtype} in {block.ndim} dimensions instead of a block"
    return ""


@contextmanager
def naming(origin: str, kind: type[TwinError] = SourceError) -> Iterator[None]:
    """An error that names the driver, for any error that is not for people.

    The mistake of a built-in driver, which has no ``origin``, stays as it is.
    """
    try:
        yield
    except TwinError:
        raise
    except (Exception, SystemExit) as error:  # whatever a driver of others raises
        if not origin:
            raise
        frame = traceback.extract_tb(error.__traceback__)[-1]
        raise kind(
            f"{origin} failed: {in_words(error)} ({Path(frame.filename).name}, line"
            f" {frame.lineno})",
            A_MISTAKE,
        ) from error
