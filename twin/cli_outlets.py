"""Where the alarms of ``twin run`` go, as its configurations have it."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import ConfigError

if TYPE_CHECKING:
    from twin.config import Config
    from twin.outlets.dispatch import Outlets
    from twin.outlets.sender import Channel
    from twin.outlets.settings import Outlet

Say = Callable[[str], None]
Standing = Sequence[Mapping[str, Any]]  # alarms as they are
Begin = Callable[[Standing], "Outlets"]


def outlets_of(settings: "Config", say: Say) -> Begin | None:
    """What begins the outlets of a configuration, with its alarms as they are; None without any.

    ConfigError names a wrong key, or a secret or certificate that cannot be used.
    """
    from twin.alarms.place import place_of
    from twin.alarms.settings import AlarmSettings
    from twin.assets.unit import Unit
    from twin.outlets.settings import chosen

    document = settings.document
    mqtt, webhook = chosen(document)
    if not (mqtt.host or webhook.url):
        return None
    if not document.section(AlarmSettings, "alarms").keep:
        raise ConfigError(
            f"{document.name}: [mqtt] and [webhook] keep what waits in the alarm database,"
            " and [alarms] does not",
            "set keep = true under [alarms]",
        )
    from twin.outlets.dispatch import Outlets
    from twin.outlets.mqtt import Mqtt
    from twin.outlets.outbox import open_outbox
    from twin.outlets.sender import Sender
    from twin.outlets.webhook import Webhook

    folder, unit = Path(document.name).parent, Unit(settings.asset.type, settings.asset.id)
    outbox = partial(open_outbox, place_of(document), unit)
    channels: dict[str, tuple[Channel, Outlet]] = {}
    show_cycle = None
    if mqtt.host:
        broker = Mqtt(mqtt, unit, folder, say)
        channels["mqtt"] = broker, mqtt
        show_cycle = broker.show_cycle if mqtt.cycles else None
    if webhook.url:
        channels["webhook"] = Webhook(webhook, folder, say), webhook

    def begin(standing: Standing) -> "Outlets":
        senders = [
            Sender(name, channel, outbox, limits, say)
            for name, (channel, limits) in channels.items()
        ]
        restating = [name for name in channels if name == "mqtt"]
        outlets = Outlets(unit, outbox, senders, say, restating=restating, show_cycle=show_cycle)
        outlets.begin(standing)
        return outlets

    return begin
