"""The line from a broker to the hall: who is let in, what is heard, and what is said of a loss."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from twin.notifications.settings import MqttSettings
from twin.page import plant_overview_client as hall_line


class Broker:
    """In place of the library's client: what it was told, and what it would call."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.told: list[tuple[str, Any]] = []
        self.connect_timeout = 0.0
        self.on_connect = self.on_subscribe = self.on_message = None
        self.on_connect_fail = self.on_disconnect = None

    def __getattr__(self, name: str) -> Any:
        return lambda *given, **_: self.told.append((name, given))

    def of(self, name: str) -> list[Any]:
        return [given for one, given in self.told if one == name]


class Hall:
    """In place of the hall: what it heard."""

    def __init__(self) -> None:
        self.heard: list[Any] = []

    def connected(self) -> None:
        self.heard.append("connected")

    def lost(self, why: str) -> None:
        self.heard.append(why)

    def take(self, levels: list[str], payload: bytes, *, kept: bool) -> None:
        self.heard.append((levels, payload, kept))


@pytest.fixture
def line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[tuple[Any, Hall, pytest.MonkeyPatch]]:
    broker, hall = Broker(), Hall()
    monkeypatch.setattr(hall_line, "Client", lambda *_, **__: broker)
    monkeypatch.setenv("BROKER_WORD", "secret")
    settings = MqttSettings.model_validate(
        {
            "host": "127.0.0.1",
            "user": "hall",
            "password": {"env": "BROKER_WORD"},
            "prefix": "works/hall 3",
        }
    )
    with hall_line.listening(settings, tmp_path, hall, lambda _: None):  # type: ignore[arg-type]
        yield broker, hall, monkeypatch
    assert [name for name, _ in broker.told[-2:]] == ["disconnect", "loop_stop"]


def reason(packet: int, name: str) -> ReasonCode:
    return ReasonCode(packet, name)


def test_a_password_goes_to_the_broker_and_the_topics_are_below_the_prefix(line: Any) -> None:
    broker, hall, _ = line
    assert broker.of("username_pw_set") == [("hall", "secret")]
    assert broker.of("connect_async") == [("127.0.0.1", 1883, 30)]
    broker.on_connect(None, None, None, reason(PacketTypes.CONNACK, "Success"), None)
    (((topics,),),) = [broker.of("subscribe")]
    assert all(topic.startswith("works/hall 3/+/+/") for topic, _ in topics)
    broker.on_subscribe(None, None, 1, [reason(PacketTypes.SUBACK, "Granted QoS 1")], None)
    assert hall.heard == ["connected"]


def test_who_is_not_let_in_or_may_not_listen_is_told(line: Any) -> None:
    broker, hall, _ = line
    broker.on_connect(None, None, None, reason(PacketTypes.CONNACK, "Not authorized"), None)
    broker.on_subscribe(None, None, 1, [reason(PacketTypes.SUBACK, "Not authorized")], None)
    broker.on_connect_fail(None, None)
    broker.on_disconnect(None)
    where = "MQTT broker 127.0.0.1"
    assert hall.heard == [
        f"{where} does not let us in: Not authorized",
        f"{where} does not let us listen: Not authorized",
        f"{where} cannot be reached",
        f"{where}: the connection is lost",
    ]


def test_what_is_heard_comes_without_the_prefix_and_says_whether_it_was_kept(line: Any) -> None:
    broker, hall, _ = line
    message = SimpleNamespace(topic="works/hall 3/t/u/status", payload=b"online", retain=True)
    broker.on_message(None, None, message)
    assert hall.heard == [(["t", "u", "status"], b"online", True)]
