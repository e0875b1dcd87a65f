"""The line from a broker to what is known of all ejectors: it only listens."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.reasoncodes import ReasonCode

from twin.notifications.data import CYCLE, VALUES
from twin.notifications.sender import ALARM
from twin.notifications.settings import MqttSettings
from twin.page.plant_overview import STATUS, PlantOverview

CONNECT_S = 5.0
LONGEST_PAUSE_S = 30  # between tries to connect
TOPICS = (STATUS, f"{ALARM}/+", CYCLE, VALUES)  # below a unit's


@contextmanager
def listening(
    settings: MqttSettings, folder: Path, hall: PlantOverview, say: Callable[[str], None]
) -> Iterator[None]:
    """Hear what all ejectors of a broker publish, in a thread of the library's; it comes back by
    itself. ``folder`` is where relative paths are from; ConfigError where a secret or certificate
    cannot be used.
    """
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
    client.connect_timeout = CONNECT_S
    client.reconnect_delay_set(1, LONGEST_PAUSE_S)
    if settings.user:
        secret = settings.password
        password = secret.read("[mqtt] password", folder, say) if secret else None
        client.username_pw_set(settings.user, password)
    if settings.tls is not None:
        client.tls_set_context(settings.tls.context("mqtt", folder))
    where = f"MQTT broker {settings.host}"
    prefix = settings.prefix.split("/")

    def come(_c: Client, _u: Any, _flags: Any, reason: ReasonCode, _p: Any) -> None:
        if reason.is_failure:
            hall.lost(f"{where} does not let us in: {reason}")
            return
        client.subscribe([(f"{settings.prefix}/+/+/{one}", 1) for one in TOPICS])

    def heard(_c: Client, _u: Any, _packet: int, reasons: list[ReasonCode], _p: Any) -> None:
        refused = [one for one in reasons if one.is_failure]
        if refused:
            hall.lost(f"{where} does not let us listen: {refused[0]}")
        else:
            hall.connected()

    def take(_c: Client, _u: Any, message: MQTTMessage) -> None:
        levels = message.topic.split("/")[len(prefix) :]
        hall.take(levels, bytes(message.payload), kept=message.retain)

    client.on_connect, client.on_subscribe, client.on_message = come, heard, take
    client.on_connect_fail = lambda *_: hall.lost(f"{where} cannot be reached")
    client.on_disconnect = lambda *_: hall.lost(f"{where}: the connection is lost")
    port = settings.port or (8883 if settings.tls is not None else 1883)
    client.connect_async(settings.host, port, settings.keepalive_s)
    client.loop_start()
    try:
        yield
    finally:
        client.disconnect()
        client.loop_stop()
