"""Hardware in the loop over OPC UA: outputs as nodes, all by one request."""

from typing import Self

from pydantic import Field, model_validator

from drivers.opcua.client import OpcuaClient
from drivers.opcua.settings import Node, NodeName, NodePressure, OpcuaSettings
from drivers.outputs.writer import Outputs, Ranged, Writer, counted, refuse_empty, refuse_no_range
from drivers.reconnect import REAL
from twin.errors import ConfigError
from twin.settings import Document, Settings
from twin.signals import MBAR


class Signal(Settings):
    """A signal that is written, as the type of its node: a Boolean, or 0 and 1."""

    node: NodeName  # as of other tags


class Counter(Settings):
    """The watchdog: counts up with each block, and from the high end on from the low one."""

    node: NodeName  # as of other tags
    range: tuple[int, int] = (0, 32_767)  # it counts from the first to the last, again and again

    @model_validator(mode="after")
    def _counts(self) -> Self:
        refuse_empty(self.range)
        return self


class WrittenPressure(NodePressure):
    """The pressure as the PLC expects it, within ``range``."""

    @model_validator(mode="after")
    def _can_be_written(self) -> Self:
        refuse_no_range(self.range)
        return self


class HilTags(Settings):
    """What may be written; what is not listed never is."""

    pressure: WrittenPressure | None = None
    part_present: Signal | None = None  # H2
    air_saving: Signal | None = None  # H1
    watchdog: Counter | None = None


class HilSettings(Settings):
    """The ``[hil]`` table beside an OPC UA ``[driver]``."""

    min_interval_ms: float = Field(default=10.0, ge=1, le=1000)  # between two writes
    tags: HilTags


class NodeOutlet:
    """Writes nodes of one server."""

    def __init__(self, link: OpcuaClient, driver: OpcuaSettings, tags: HilTags) -> None:
        self._link, self._tags = link, tags
        ambient = driver.ambient_mbar * MBAR
        self._pressure = tags.pressure and Ranged(tags.pressure, ambient, driver.where)
        self.open, self.close = link.open, link.close

    def write(self, outputs: Outputs, watchdog: int) -> None:
        """Write every tag that is listed."""
        self._link.write(self.values(outputs, watchdog))

    def values(self, outputs: Outputs, watchdog: int) -> dict[Node, float]:
        """Numbers to write, by node."""
        tags, values = self._tags, dict[Node, float]()
        if tags.pressure and self._pressure:
            values[tags.pressure.node] = self._pressure.raw(outputs.pressure)
        if tags.part_present:
            values[tags.part_present.node] = outputs.part_present
        if tags.air_saving:
            values[tags.air_saving.node] = outputs.air_saving
        if tags.watchdog:
            values[tags.watchdog.node] = counted(watchdog, tags.watchdog.range)
        return values


def writer(driver: OpcuaSettings, document: Document) -> Writer:
    """The writer to this server, in a session of its own: the reader's blocks while it waits."""
    settings = document.section(HilSettings, "hil")
    nodes = [tag.node for _, tag in settings.tags if tag is not None]
    if not driver.namespace and any(not node.uri for node in nodes):
        raise ConfigError(
            f"{document.name}: the nodes of [hil.tags] need a namespace",
            'give its URI as namespace in [driver], or write "nsu=URI;s=Name"',
        )
    outlet = NodeOutlet(OpcuaClient(driver, REAL), driver, settings.tags)
    return Writer(outlet, driver.where, settings.min_interval_ms)
