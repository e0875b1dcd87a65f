"""Destinations for the alarms of ``twin run``, from its configurations."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.errors import ConfigError

if TYPE_CHECKING:
    from twin.config import Config
    from twin.notifications.data import MessageSource
    from twin.notifications.dispatch import Outlets
    from twin.notifications.sender import Channel, Lane
    from twin.notifications.settings import MqttSettings, NotificationSettings, Outlet
    from twin.notifications.uploader import Uploader

Say = Callable[[str], None]
Standing = Sequence[Mapping[str, Any]]  # standing alarms as plain data
Begin = Callable[[Standing], "Outlets"]


def outlets_of(settings: "Config", say: Say) -> Begin | None:
    """A function that starts a configuration's outlets with its standing alarms.

    None without outlets. ConfigError names a wrong key, or an unusable secret or certificate.
    """
    from twin.alarms.database_url import place_of
    from twin.alarms.settings import AlarmSettings
    from twin.assets.unit import Unit
    from twin.notifications.settings import chosen, chosen_notifications, chosen_upload

    document = settings.document
    mqtt, webhook = chosen(document)
    chosen_upload(document)
    notifications = chosen_notifications(document)
    if not (mqtt.host or webhook.url or notifications):
        return None
    if not document.section(AlarmSettings, "alarms").keep:
        raise ConfigError(
            f"{document.name}: [mqtt], [webhook] and [notifications] keep what waits in the alarm"
            " database, and [alarms] does not",
            "set keep = true under [alarms]",
        )
    from twin.notifications.dispatch import Outlets
    from twin.notifications.mqtt import Mqtt
    from twin.notifications.outbox import open_outbox
    from twin.notifications.sender import Sender
    from twin.notifications.webhook import Webhook

    folder, unit = Path(document.name).parent, Unit(settings.asset.type, settings.asset.id)
    outbox = partial(open_outbox, place_of(document), unit)
    channels: dict[str, tuple[Channel, Outlet]] = {}
    uploader = _uploader_of(settings, say)
    if mqtt.host:
        batch, receive = settings.asset.batch, uploader.receive if uploader else None
        channels["mqtt"] = Mqtt(mqtt, unit, folder, say, batch=batch, on_request=receive), mqtt
    if webhook.url:
        channels["webhook"] = Webhook(webhook, folder, say), webhook
    if notifications:
        channels["email"] = _email_of(settings, notifications, say), notifications.email

    def begin(standing: Standing) -> "Outlets":
        message_sources = {"mqtt": _message_sources_of(settings, mqtt)} if mqtt.host else {}
        lanes = {"mqtt": _lanes_of(mqtt)}
        if notifications:
            lanes["email"] = _mail_lanes_of(notifications)
        senders = [
            Sender(name, channel, outbox, limits, say, lanes=lanes.get(name, ()))
            for name, (channel, limits) in channels.items()
        ]
        restating = [name for name in channels if name != "webhook"]
        outlets = Outlets(
            unit,
            outbox,
            senders,
            say,
            restating=restating,
            message_sources=message_sources,
            uploader=uploader,
        )
        outlets.begin(standing)
        return outlets

    return begin


def _email_of(settings: "Config", notifications: "NotificationSettings", say: Say) -> "Channel":
    """E-mail to people, in the language of the configuration."""
    from twin.alarms.database_url import place_of
    from twin.alarms.settings import board_rules
    from twin.assets.unit import Unit
    from twin.notifications.call_store import open_calls
    from twin.notifications.email import Email
    from twin.notifications.mail_server import MailServer
    from twin.page.alarm_mail import mail_language, writer

    document, unit = settings.document, Unit(settings.asset.type, settings.asset.id)
    return Email(
        notifications,
        MailServer(notifications.email, Path(document.name).parent, say),
        partial(open_calls, place_of(document), unit),
        writer(board_rules(document), mail_language(document)),
    )


def _uploader_of(settings: "Config", say: Say) -> "Uploader | None":
    """The uploader of logs on request; None without ``[outlets.upload]``."""
    import threading

    from twin.alarms.database_url import place_of as database_of
    from twin.assets.unit import Unit
    from twin.notifications.logs import find
    from twin.notifications.message import asset_of
    from twin.notifications.settings import chosen_upload
    from twin.notifications.upload_destinations import place_of
    from twin.notifications.upload_requests import open_uploads
    from twin.notifications.uploader import Uploader

    upload = chosen_upload(settings.document)
    if upload is None:
        return None
    folder, ending = Path(settings.document.name).parent, threading.Event()
    unit = Unit(settings.asset.type, settings.asset.id)
    return Uploader(
        asset_of(unit, settings.asset.batch),
        partial(open_uploads, database_of(settings.document), unit),
        partial(find, folder / upload.logs, unit),
        place_of(upload, unit, folder, ending, say),
        ending,
        say,
    )


def _message_sources_of(settings: "Config", mqtt: "MqttSettings") -> "list[MessageSource]":
    """Sources of other data for the broker: key figures and values."""
    from twin.assets.unit import Unit
    from twin.notifications.data import Cycles, Values
    from twin.notifications.message import asset_of
    from twin.signals import MBAR

    asset = asset_of(Unit(settings.asset.type, settings.asset.id), settings.asset.batch)
    message_sources: list[MessageSource] = [Cycles(asset)] if mqtt.cycles else []
    if mqtt.values is not None:
        ambient = settings.data.ambient.pressure_mbar * MBAR
        message_sources.append(Values(asset, mqtt.values.period_s, ambient))
    return message_sources


def _lanes_of(mqtt: "MqttSettings") -> "list[Lane]":
    """Lanes in which that data waits; also for data of an earlier run that is no longer sent."""
    from twin.notifications.data import CYCLE, VALUES
    from twin.notifications.sender import Lane
    from twin.notifications.uploader import UPLOAD

    answers = Lane(UPLOAD, "answers about uploads", mqtt.keep_hours, most=1000)
    labels = {CYCLE: "key figures", VALUES: "values"}
    return [answers, *(Lane(topic, label, mqtt.keep_hours) for topic, label in labels.items())]


def _mail_lanes_of(notifications: "NotificationSettings") -> "list[Lane]":
    """The lane in which mails wait."""
    from twin.notifications.email import MAIL
    from twin.notifications.sender import Lane

    email = notifications.email
    return [Lane(MAIL, "mails", 24.0 * email.longest_days, email.most_waiting)]
