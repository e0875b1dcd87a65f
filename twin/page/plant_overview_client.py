"""The MQTT client of the plant overview; it only subscribes."""

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
LONGEST_PAUSE_S = 30  # between attempts to connect
TOPICS = (STATUS, f"{ALARM}/+", CYCLE, VALUES)  # below a unit's


@contextmanager
def listening(
    settings: MqttSettings, folder: Path, plant: PlantOverview, say: Callable[[str], None]
) -> Iterator[None]:
    """Receive what all ejectors of a broker publish, in a thread of the library.

    The library reconnects by itself. Paths are relative to ``folder``; ConfigError if a secret or
    certificate cannot be used.
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
    broker = f"MQTT broker {settings.host}"
    prefix = settings.prefix.split("/")

    def on_connect(_c: Client, _u: Any, _flags: Any, reason: ReasonCode, _p: Any) -> None:
        if reason.is_failure:
            plant.lost(f"{broker} does not let us in: {reason}")
            return
        client.subscribe([(f"{settings.prefix}/+/+/{item}", 1) for item in TOPICS])

    def on_subscribe(_c: Client, _u: Any, _packet: int, reasons: list[ReasonCode], _p: Any) -> None:
        refused = [item for item in reasons if item.is_failure]
        if refused:
            plant.lost(f"{broker} does not let us listen: {refused[0]}")
        else:
            plant.connected()

    def on_message(_c: Client, _u: Any, message: MQTTMessage) -> None:
        levels = message.topic.split("/")[len(prefix) :]
        plant.take(levels, bytes(message.payload), kept=message.retain)

    client.on_connect, client.on_subscribe, client.on_message = on_connect, on_subscribe, on_message
    client.on_connect_fail = lambda *_: plant.lost(f"{broker} cannot be reached")
    client.on_disconnect = lambda *_: plant.lost(f"{broker}: the connection is lost")
    port = settings.port or (8883 if settings.tls is not None else 1883)
    client.connect_async(settings.host, port, settings.keepalive_s)
    client.loop_start()
    try:
        yield
    finally:
        client.disconnect()
        client.loop_stop()
