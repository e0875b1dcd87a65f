"""The tables of the outlets: where alarms go, and what protects them on the way."""

import ssl
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, model_validator

from twin.errors import ConfigError
from twin.notifications.people import Address, Person
from twin.secret import Say, Secret, refuse_secrets
from twin.settings import Document, Settings
from twin.tls import OwnCertificate, is_loopback


class ServerTls(OwnCertificate):
    """How a connection is protected. ``{}`` trusts whom this machine trusts."""

    trusted: Path | None = None  # PEM: the server's certificate, or the authority's

    def context(self, table: str, folder: Path) -> ssl.SSLContext:
        """The context of a connection; ConfigError if a file cannot be used."""
        try:
            trusted = folder / self.trusted if self.trusted else None
            context = ssl.create_default_context(cafile=trusted)
            # The server's own certificate is enough.
            context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
            if self.certificate and self.key:
                pair = folder / self.certificate, folder / self.key
                context.load_cert_chain(*pair, password=lambda: "")
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"[{table}.tls]: cannot be used: {error}",
                "trusted, certificate and key are PEM files, the key without a password",
            ) from error
        return context


class Outlet(Settings):
    """What every destination has: how much waits for it, and for how long."""

    most_waiting: int = Field(default=10_000, ge=100)  # messages; then the oldest are given up
    longest_days: float = Field(default=30.0, gt=0.0)  # longest time that a message waits


class ValueSettings(Settings):
    """Values at a slower pace than the loop's."""

    period_s: float = Field(default=1.0, ge=0.01, le=600.0)  # PLC time that one row stands for


class MqttSettings(Outlet):
    """An MQTT broker; none while ``host`` is empty."""

    host: str = ""  # name or address of the broker
    port: int = Field(default=0, ge=0, le=65535)  # 0: 8883 with tls, else 1883
    tls: ServerTls | None = None
    user: str = ""  # name at the broker
    password: Secret | None = None
    unprotected: bool = False  # a password without tls beyond this machine all the same
    # First level of all topics.
    prefix: str = Field(default="ejector-twin", pattern=r"^[^+#\x00/]+(/[^+#\x00/]+)*$")
    keepalive_s: int = Field(default=30, ge=5, le=3600)  # gone for 1.5 of it, the twin is offline
    cycles: bool = False  # the key figures of each cycle too
    values: ValueSettings | None = None  # and lowest, mean and highest vacuum of each period
    # Longest time that cycles and values are kept.
    keep_hours: float = Field(default=72.0, gt=0.0, le=8784.0)

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        if self.password is None:
            return self
        if not self.user:
            raise ValueError("a password needs a user")
        if self.tls is None and not self.unprotected and not is_loopback(self.host):
            raise ValueError(
                f'"{self.host}" is beyond this machine, and a password is not sent in the clear:'
                " give [mqtt.tls] (may be empty), or say unprotected = true"
            )
        return self


class HttpSettings(Settings):
    """An address of HTTP, and what protects what goes there."""

    url: str | Secret = ""
    # Headers of each message; each value is a secret.
    headers: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9-]+$")], Secret] = Field(default={})
    tls: ServerTls = ServerTls()
    unprotected: bool = False  # headers without https beyond this machine all the same

    @model_validator(mode="after")
    def _is_protected(self) -> Self:
        if self.url and isinstance(self.url, str):
            self._check(self.url)
            refuse_secrets(self.url)
        return self

    def address(self, table: str, folder: Path, say: Say) -> str:
        """The address, read from its secret if need be; ConfigError if it is no address."""
        if isinstance(self.url, str):
            return self.url
        url = self.url.read(f"[{table}] url", folder, say)
        try:
            self._check(url)
        except ValueError as error:
            raise ConfigError(f"[{table}] {error}", "put an address there") from error
        return url

    def _check(self, url: str) -> None:
        _check_url(url, has_secrets=bool(self.headers) and not self.unprotected)


class WebhookSettings(HttpSettings, Outlet):
    """An address that takes JSON by POST; none while ``url`` is empty."""

    timeout_s: float = Field(default=10.0, gt=0.0, le=60.0)  # longest time for an answer


class UploadSettings(HttpSettings):
    """Where logs go when they are asked for, and the folder that they are taken from.

    ``url`` takes PUT of what lies below it.
    """

    logs: Path  # where twin run writes them; nothing else is ever uploaded
    folder: Path | None = None  # or a folder, which may be a share
    timeout_s: float = Field(default=60.0, gt=0.0, le=600.0)  # longest silence of the server

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.folder is None) == (not self.url):
            raise ValueError("needs one place: url or folder")
        return self


class OutletsSettings(Settings):
    """The table ``[outlets]``."""

    upload: UploadSettings | None = None  # without it nobody can ask for logs


class EmailSettings(Outlet):
    """A mail server, and whom it sends to; none while ``host`` is empty."""

    host: str = ""  # name or address of the mail server
    port: int = Field(default=0, ge=0, le=65535)  # 0: 587 with starttls, 465 with tls, else 25
    # "tls" from the first byte on, "starttls" after the greeting; without it nothing is sent
    encryption: Literal["starttls", "tls", "none"] = "starttls"
    tls: ServerTls = ServerTls()
    user: str = ""  # name at the mail server
    password: Secret | None = None
    unprotected: bool = False  # a password without encryption beyond this machine all the same
    sender: Address | None = None  # address that the mails come from
    recipients: tuple[Address, ...] = ()  # addresses that get every alarm at any time
    # a code such as "de", of a catalogue in twin/locale
    language: str = Field(default="en", pattern=r"^[A-Za-z]{2,3}(-[A-Za-z0-9]{2,8})*$")
    # Shortest time between two mails on one alarm.
    pause_min: float = Field(default=15.0, ge=0.0, le=1440.0)
    # Longest time for each answer of the server.
    timeout_s: float = Field(default=10.0, gt=0.0, le=60.0)
    longest_days: float = Field(default=3.0, gt=0.0)  # longest time that a mail waits

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.host and self.sender is None:
            raise ValueError("needs a sender, the address that the mails come from")
        if (self.password is None) != (not self.user):
            raise ValueError("user and password belong together")
        in_the_clear = self.encryption == "none" and not is_loopback(self.host)
        if self.password is not None and in_the_clear and not self.unprotected:
            raise ValueError(
                f'"{self.host}" is beyond this machine, and a password is not sent in the clear:'
                ' take encryption = "starttls" or "tls", or say unprotected = true'
            )
        return self


class NotificationSettings(Settings):
    """E-mail, and who is told when. Without people every mail goes to ``recipients``."""

    email: EmailSettings = EmailSettings()
    people: tuple[Person, ...] = ()  # who is told when, and by which step of escalation
    # time without acknowledgement until the next step is told
    escalate_after_min: float = Field(default=15.0, gt=0.0, le=1440.0)

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if not self.email.host:
            if self.people:
                raise ValueError("people are told by e-mail: [notifications.email] needs a host")
            return self
        if not (self.people or self.email.recipients):
            raise ValueError(
                "nobody gets the mails: write recipients under [notifications.email],"
                " or [[notifications.people]]"
            )
        addresses = [*self.email.recipients, *(person.address for person in self.people)]
        if several := sorted({address for address in addresses if addresses.count(address) > 1}):
            raise ValueError(f"{', '.join(several)}: an address is to be written once")
        return self

    @property
    def everybody(self) -> tuple[Person, ...]:
        """The people and the recipients, who are told at once and at any time."""
        recipients = (Person(name=address, address=address) for address in self.email.recipients)
        return (*recipients, *self.people)


def chosen(document: Document) -> tuple[MqttSettings, WebhookSettings]:
    """The settings of a configuration; ConfigError names file, line and key."""
    mqtt = document.section(MqttSettings, "mqtt")
    webhook = document.section(WebhookSettings, "webhook")
    for table, target in (("mqtt", mqtt.host), ("webhook", webhook.url)):
        if table in document.tables and not target:
            key = "host" if table == "mqtt" else "url"
            raise ConfigError(
                f"{document.name}: [{table}] has no {key}", "write where, or leave the table out"
            )
    return mqtt, webhook


def chosen_notifications(document: Document) -> NotificationSettings | None:
    """The e-mail settings, None without e-mail; ConfigError names file, line and key."""
    if "notifications" not in document.tables:
        return None
    settings = document.section(NotificationSettings, "notifications")
    if not settings.email.host:
        raise ConfigError(
            f"{document.name}: [notifications.email] has no host",
            "write the mail server there, or leave [notifications] out",
        )
    return settings


def chosen_upload(document: Document) -> UploadSettings | None:
    """The upload settings, None without uploads; ConfigError names file, line and key."""
    upload = document.section(OutletsSettings, "outlets").upload
    if upload is not None and "mqtt" not in document.tables:
        raise ConfigError(
            f"{document.name}: [outlets.upload] is asked over MQTT, and there is no [mqtt]",
            "say where the broker is, or leave the table out",
        )
    return upload


def _check_url(url: str, *, has_secrets: bool) -> None:
    """ValueError if the URL is no address, or would show secrets."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError("url is no address: https://HOST/PATH")
    if has_secrets and parts.scheme == "http" and not is_loopback(parts.hostname):
        raise ValueError(
            f'"{parts.hostname}" is beyond this machine, and headers are secrets: take https,'
            " or say unprotected = true"
        )
