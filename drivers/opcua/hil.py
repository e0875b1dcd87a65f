"""Hardware in the loop over OPC UA: outputs as nodes, all by one request."""

from drivers.opcua.client import OpcuaClient
from drivers.opcua.hil_settings import HilSettings, HilTags
from drivers.opcua.settings import Node, OpcuaSettings
from drivers.outputs.writer import Outputs, Ranged, Writer, counted
from drivers.reconnect import REAL
from twin.errors import ConfigError
from twin.settings import Document
from twin.signals import MBAR


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
