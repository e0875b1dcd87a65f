"""Hardware in the loop over Modbus: outputs as holding registers and coils."""

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.connection_pool import ConnectionPool
from drivers.modbus.client import ModbusClient
from drivers.modbus.line import line_to
from drivers.modbus.settings import ModbusSettings
from drivers.outputs.writer import Outputs, Ranged, Writer, counted, refuse_empty, refuse_no_range
from drivers.tags import CODE, Address, Pressure, Tag, words_of
from twin.settings import Document, Settings
from twin.signals import MBAR

MOST_WRITTEN = 123  # words in one request that writes, by the protocol
WRITABLE = ("coil", "holding")
Group = tuple[Address, tuple[int, ...]]  # words, or bits, from there on


class Written(Tag):
    """A written value; it takes the whole register or coil."""

    @model_validator(mode="after")
    def _can_be_written(self) -> Self:
        if self.address.area not in WRITABLE:
            raise ValueError(f"{self.address} cannot be written: holding registers and coils can")
        if self.bit is not None or self.type == "float32":
            raise ValueError("a signal that is written takes a coil, or a register of integer type")
        return self


class Counter(Written):
    """The watchdog: counts up with each block, and from the high end on from the low one."""

    type: Literal["int16", "uint16", "int32", "uint32"] = "uint16"
    range: tuple[int, int] = (0, 32_767)  # it counts from the first to the last, again and again

    @model_validator(mode="after")
    def _counts(self) -> Self:
        refuse_empty(self.range)
        return self


class WrittenPressure(Pressure):
    """The pressure as the PLC expects it, within ``range``."""

    @model_validator(mode="after")
    def _can_be_written(self) -> Self:
        refuse_no_range(self.range)
        if self.address.area != "holding":
            raise ValueError(f"{self.address} cannot be written: a holding register can")
        return self


class HilTags(Settings):
    """Tags that are written; no other tag ever is."""

    pressure: WrittenPressure | None = None
    part_present: Written | None = None  # H2
    air_saving: Written | None = None  # H1
    watchdog: Counter | None = None


class HilSettings(Settings):
    """The ``[hil]`` table beside a Modbus ``[driver]``."""

    min_interval_ms: float = Field(default=5.0, ge=1, le=1000)  # shortest time between two writes
    tags: HilTags


class RegisterOutlet:
    """Writes registers and coils; adjacent ones in one request, the watchdog last."""

    def __init__(self, link: ModbusClient, driver: ModbusSettings, tags: HilTags) -> None:
        self._link, self._tags, self._order = link, tags, driver.word_order
        ambient = driver.ambient_mbar * MBAR
        self._pressure = tags.pressure and Ranged(tags.pressure, ambient, driver.where)
        self.open, self.close = link.open, link.close

    def write(self, outputs: Outputs, watchdog: int) -> None:
        """Write every tag that is listed."""
        for address, values in self.groups(outputs, watchdog):
            self._link.write(address, values)

    def groups(self, outputs: Outputs, watchdog: int) -> list[Group]:
        """The writes in order; those to adjacent addresses are joined."""
        tags, groups = self._tags, list[Group]()
        if tags.pressure and self._pressure:
            groups.append(self._words(tags.pressure, self._pressure.raw(outputs.pressure)))
        if tags.part_present:
            groups.append(self._words(tags.part_present, outputs.part_present))
        if tags.air_saving:
            groups.append(self._words(tags.air_saving, outputs.air_saving))
        if tags.watchdog:
            groups.append(self._words(tags.watchdog, counted(watchdog, tags.watchdog.range)))
        joined: list[Group] = []
        for address, values in groups:
            start, words = joined[-1] if joined else (None, ())
            fits = start is not None and len(words) + len(values) <= MOST_WRITTEN
            if start is not None and fits and start + len(words) == address:
                joined[-1] = start, (*words, *values)
            else:
                joined.append((address, values))
        return joined

    def _words(self, tag: Tag, number: float) -> Group:
        value = number if tag.type == "float32" else round(number)
        return tag.address, words_of(value, CODE[tag.type], self._order)


def writer(
    driver: ModbusSettings, document: Document, pool: ConnectionPool | None = None
) -> Writer:
    """The writer to this PLC, over a shared connection of a ``pool``."""
    settings = document.section(HilSettings, "hil")
    link = ModbusClient(driver, line_to(driver, pool))
    outlet = RegisterOutlet(link, driver, settings.tags)
    return Writer(outlet, driver.where, settings.min_interval_ms)
