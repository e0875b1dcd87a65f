"""Publishes to an MQTT 5 broker: a retained topic for each alarm, the twin's status, and more.

The library's network loop runs in the sender's thread, between messages. Every connection has a new
client without earlier state: the outbox holds all that the broker has not taken.
"""

import re
import ssl
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

from paho.mqtt.client import Client, ConnectFlags, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from twin.assets.unit import Unit
from twin.notifications.message import Message, asset_of, of_status
from twin.notifications.sender import ALARM, BATCH, LostError, Sent
from twin.notifications.settings import MqttSettings
from twin.secret import Say

CONNECT_S = 5.0  # limit for connecting, and then for the broker's acceptance
ANSWER_S = 20.0  # limit for the broker to take a batch
LISTEN_S = 0.1  # time on the network loop before the next look for messages to send
REQUEST = "request"  # the topic for requests to the twin of a unit
SESSION_S = 86_400  # lifetime of the session, which shows whether the broker has lost its state


class Mqtt:
    """A channel (``twin.notifications.sender.Channel``) for the messages of one unit.

    Paths are relative to ``folder``. ConfigError if a secret or certificate cannot be used. A
    request is acknowledged to the broker unless ``on_request`` raises.
    """

    def __init__(
        self,
        settings: MqttSettings,
        unit: Unit,
        folder: Path,
        say: Say,
        clock: Callable[[], int] = time.time_ns,
        batch: str = "",
        on_request: Callable[[bytes], None] | None = None,
    ) -> None:
        self._settings, self._unit, self._clock = settings, unit, clock
        self._asset, self._on_request = asset_of(unit, batch), on_request
        secret = settings.password
        self._password = secret.read("[mqtt] password", folder, say) if secret else None
        self._tls: ssl.SSLContext | None = None
        if settings.tls is not None:
            self._tls = settings.tls.context("mqtt", folder)
            self._tls.sslsocket_class = _Closed
        self._port = settings.port or (8883 if self._tls else 1883)
        self._where = f"{settings.host}:{self._port}"
        self._client: Client | None = None
        self._is_first = True
        self._let_in: tuple[ConnectFlags, ReasonCode, Properties] | None = None
        self._awaited: set[int] = set()  # packets; each connection numbers them anew
        self._answers: dict[int, ReasonCode] = {}  # by packet
        self._say, self._is_deaf = say, False
        self._largest = 0  # bytes of a message that the broker takes; 0 is any
        self._at_once = BATCH

    def open(self) -> bool:
        """Connect with the last will, and publish that the twin is online."""
        if self._client is not None:
            return False
        client = self._client = self._new_client()
        session = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        session.SessionExpiryInterval = SESSION_S
        self._let_in = None
        self._awaited.clear()
        self._answers.clear()
        try:
            client.connect(
                self._settings.host,
                self._port,
                self._settings.keepalive_s,
                clean_start=False,
                properties=session,
            )
        except (OSError, ValueError) as error:
            raise self._lost(str(error)) from error
        with suppress(LostError):  # a broker that rejects us answers first, then disconnects
            self._listen_until(lambda: self._let_in is not None, CONNECT_S)
        forgotten = self._settle()
        if self._on_request is not None:
            self._ask_for_requests(client)
        self._say_status("online")
        self._is_first, was_first = False, self._is_first
        return forgotten and not was_first

    def send(self, messages: Sequence[Message], topic: str = ALARM) -> Sent:
        """Publish retained messages, and wait until the broker has taken each."""
        sent = Sent()
        try:
            for begin in range(0, len(messages), self._at_once):
                self._send(messages[begin : begin + self._at_once], topic, sent)
        except LostError as error:
            sent.lost = error
        return sent

    def idle(self, wake: threading.Event) -> None:
        """Listen to the network."""
        if not wake.is_set():
            self._listen(LISTEN_S)

    def hang_up(self) -> None:
        """Drop the connection without notice; the broker publishes the last will."""
        if self._client is not None:
            sock = self._client.socket()
            if sock is not None:
                sock.close()
        self._client = None

    def close(self) -> None:
        """Publish that the twin is offline, and disconnect."""
        if self._client is None:
            return
        self._say_status("offline")
        self._client.disconnect()
        self.hang_up()

    def topic(self, *path: str) -> str:
        """A topic of this unit; wildcards and level separators in names are escaped."""
        levels = (_SPECIAL.sub(_escaped, name) or "-" for name in (*self._unit, *path))
        return "/".join((self._settings.prefix, *levels))

    # --- connecting -----------------------------------------------------------------------------

    def _new_client(self) -> Client:
        name = "-".join(("ejector-twin", *self._unit))
        client = Client(CallbackAPIVersion.VERSION2, client_id=name, protocol=MQTTv5)
        client.connect_timeout = CONNECT_S
        client.max_inflight_messages_set(BATCH)
        if self._settings.user:
            client.username_pw_set(self._settings.user, self._password)
        if self._tls is not None:
            client.tls_set_context(self._tls)
        will = of_status(self._asset, "offline", None, _program())
        client.will_set(self.topic("status"), will, qos=1, retain=True)
        client.on_connect = self._on_connect
        client.on_publish = self._on_publish
        return client

    def _settle(self) -> bool:
        """Take the broker's CONNACK; returns whether it has no session of ours."""
        if self._let_in is None:
            raise self._lost("it does not answer as an MQTT 5 broker", "is it the right port?")
        flags, reason, properties = self._let_in
        if reason.is_failure:
            raise self._lost(f"it does not let us in: {reason}", "check [mqtt] user and password")
        self._largest = int(getattr(properties, "MaximumPacketSize", 0))
        self._at_once = min(BATCH, int(getattr(properties, "ReceiveMaximum", BATCH)))
        return not flags.session_present

    def _on_connect(
        self,
        _client: Client,
        _userdata: Any,
        flags: ConnectFlags,
        reason: ReasonCode,
        properties: Properties | None,
    ) -> None:
        no_properties = Properties(PacketTypes.CONNACK)  # type: ignore[no-untyped-call]
        self._let_in = flags, reason, properties or no_properties

    def _on_publish(
        self, _client: Client, _userdata: Any, packet: int, reason: ReasonCode, _properties: Any
    ) -> None:
        if packet in self._awaited:
            self._awaited.discard(packet)
            self._answers[packet] = reason

    def _ask_for_requests(self, client: Client) -> None:
        """Subscribe to requests; the broker keeps those of up to a day's absence.

        Retained requests are ignored: they would arrive with every connection.
        """
        answers: list[ReasonCode] = []
        client.on_subscribe = lambda _c, _u, _packet, reasons, _p: answers.extend(reasons)
        client.on_message = self._on_message
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_DO_NOT_SEND)
        client.subscribe(self.topic(REQUEST), options=options)
        self._listen_until(lambda: bool(answers), CONNECT_S)
        if answers[0].is_failure and not self._is_deaf:
            self._say(f"MQTT broker {self._where}: requests cannot be heard: {answers[0]}")
        self._is_deaf = answers[0].is_failure

    def _on_message(self, _client: Client, _userdata: Any, message: MQTTMessage) -> None:
        """Handle a request; an error leaves the library's loop before the acknowledgement."""
        if self._on_request is not None and not message.retain:
            self._on_request(bytes(message.payload))

    def _say_status(self, status: str) -> None:
        body = of_status(self._asset, status, self._clock(), _program())
        packet = self._publish(self.topic("status"), body)
        self._listen_until(lambda: packet in self._answers, CONNECT_S)
        reason = self._answers.pop(packet)
        if reason.is_failure:
            raise self._lost(f"it does not take {self.topic('status')}: {reason}")

    # --- sending --------------------------------------------------------------------------------

    def _send(self, messages: Sequence[Message], topic: str, sent: Sent) -> None:
        packets: dict[int, Message] = {}
        try:
            for message in messages:
                address = self.topic(topic, message.alarm) if message.alarm else self.topic(topic)
                if problem := self._too_large(address, message):
                    sent.refused[message.id] = problem
                else:
                    packets[self._publish(address, message.body)] = message
            self._listen_until(lambda: packets.keys() <= self._answers.keys(), ANSWER_S)
        finally:
            for packet, message in packets.items():
                if (reason := self._answers.pop(packet, None)) is None:
                    continue
                if reason.is_failure:
                    sent.refused[message.id] = f"{self._where}: {reason}"
                else:
                    sent.delivered.append(message)

    def _too_large(self, topic: str, message: Message) -> str:
        """Why the broker would drop the connection over this message; empty if it would not."""
        size = len(message.body.encode()) + len(topic.encode()) + 16  # more than the header takes
        if not self._largest or size <= self._largest:
            return ""
        return f"{self._where}: {size} bytes are more than the {self._largest} that it takes"

    def _publish(self, topic: str, body: str) -> int:
        assert self._client is not None
        info = self._client.publish(topic, body, qos=1, retain=True)
        if info.rc != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise self._lost(info.rc.name)
        self._awaited.add(info.mid)
        return int(info.mid)

    def _listen_until(self, is_done: Callable[[], bool], patience_s: float) -> None:
        """Listen until ``is_done``; LostError if that takes longer than ``patience_s``."""
        end = time.monotonic() + patience_s
        while not is_done():
            if time.monotonic() > end:
                raise self._lost(f"no answer in {patience_s:g} s")
            self._listen(LISTEN_S)

    def _listen(self, seconds: float) -> None:
        assert self._client is not None
        result = self._client.loop(seconds)
        if result != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise self._lost(f"the connection is lost ({result.name})")

    def _lost(self, cause: str, hint: str = "") -> LostError:
        return LostError(
            f"MQTT broker {self._where}: {cause}", hint or "is it there, and reachable?"
        )


class _Closed(ssl.SSLSocket):
    """A socket that closes if the handshake fails; the library would leave it open."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


_SPECIAL = re.compile(r"[/+#%\x00-\x1f\x7f]")  # in a level of a topic


def _escaped(match: re.Match[str]) -> str:
    return quote(match[0], safe="")


def _program() -> str:
    return f"ejector-twin {version('ejector-twin')}"
