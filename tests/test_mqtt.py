"""Alarms at a real broker (mosquitto): kept there, through its restarts, cuts and ours."""

import json
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import rigs
import tomli_w
from mosquitto import Broker, Listener, Relay, broker
from plc_process import start_plc
from test_alarms_loop import LEAK, NONE, UNIT, Stream, deviation
from test_notifications import NO_TICKS, Bench, message, wait_until

from twin.alarms.database import open_store
from twin.assets.unit import Unit
from twin.cli.notifications import outlets_of
from twin.config import Config
from twin.errors import ConfigError
from twin.events import Event, Kind
from twin.notifications import mqtt, sender
from twin.notifications.dispatch import Outlets
from twin.notifications.message import Message
from twin.notifications.mqtt import Mqtt
from twin.notifications.outbox import open_outbox
from twin.notifications.sender import LostError
from twin.notifications.settings import MqttSettings, Secret, ServerTls
from twin.settings import Document

BASE = f"ejector-twin/{UNIT.type}/{UNIT.id}"
HERE = Path()


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(mqtt, "LISTEN_S", 0.01)


@pytest.fixture(params=[pytest.param("mosquitto", marks=pytest.mark.needs("mosquitto"))])
def running(tmp_path: Path) -> Iterator[Broker]:
    with broker(tmp_path) as one:
        yield one


def channel(port: int, unit: Unit = UNIT, **settings: Any) -> Mqtt:
    wanted = MqttSettings(host="127.0.0.1", port=port, **settings)
    return Mqtt(wanted, unit, HERE, pytest.fail)


class At(Bench):
    """A sender to a broker at a port."""

    def __init__(self, path: Path, port: int) -> None:
        super().__init__(path)
        self.mqtt = channel(port)
        self.sender._channel = self.mqtt
        self.sender.start()

    def drained(self) -> None:
        wait_until(lambda: self.outbox.count("mqtt") == 0)


def numbers(documents: Sequence[dict[str, Any]]) -> list[int]:
    return [document["number"] for document in documents if "deed" not in document]


def test_the_twin_is_there_until_it_leaves(tmp_path: Path, running: Broker) -> None:
    with Listener(running.port) as listener:
        bench = At(tmp_path / "a.sqlite", running.port)
        online = listener.until("status", status="online")
        bench.end()
        offline = listener.until("status", status="offline")
    assert online["asset"] == {"type": UNIT.type, "id": UNIT.id}
    assert online["program"].startswith("ejector-twin ")
    assert online["since"] < offline["since"]
    with Listener(running.port) as late:
        assert late.until("status")["status"] == "offline"
        assert late.all[0][0] == f"{BASE}/status"
        assert late.all[0][2], "it is kept by the broker"
    assert bench.said == []


def test_who_dies_is_reported_by_the_broker(running: Broker) -> None:
    ours = channel(running.port)
    ours.open()
    with Listener(running.port) as listener:
        listener.until("status", status="online")
        ours.hang_up()  # without a goodbye
        assert listener.until("status", status="offline")["since"] is None


def test_each_alarm_is_kept_with_its_newest_state(tmp_path: Path, running: Broker) -> None:
    bench = At(tmp_path / "a.sqlite", running.port)
    bench.put(message(1), message(2, "plc_stale"), message(3))
    bench.drained()
    with Listener(running.port) as late:
        late.until(f"alarm/{LEAK}")
        late.until("alarm/plc_stale")
    kept = {topic: document for topic, document, retained in late.all if retained}
    assert kept[f"{BASE}/alarm/{LEAK}"] == {"number": 3}
    assert kept[f"{BASE}/alarm/plc_stale"] == {"number": 2}
    bench.end()


def test_a_broker_that_lost_everything_is_right_again(tmp_path: Path, running: Broker) -> None:
    bench = At(tmp_path / "a.sqlite", running.port)
    bench.put(message(1), message(2, "plc_stale"), message(3))
    bench.drained()
    running.kill()
    wait_until(lambda: len(bench.said) == 1)
    running.start()
    wait_until(lambda: len(bench.said) == 2)
    bench.end()
    with Listener(running.port) as late:
        restated = [late.until(LEAK), late.until("plc_stale")]
    assert {document["number"]: document["deed"] for document in restated} == {
        2: "restated",
        3: "restated",
    }
    assert "the connection is lost" in bench.said[0]
    assert bench.said[1] == "alarms go to mqtt again"


def test_a_broker_that_lost_nothing_is_told_nothing_twice(tmp_path: Path, running: Broker) -> None:
    with Relay(running.port) as relay, Listener(running.port) as listener:
        bench = At(tmp_path / "a.sqlite", relay.port)
        bench.put(message(1))
        bench.drained()
        relay.cut()
        wait_until(lambda: len(bench.said) == 2)
        bench.put(message(2))
        bench.drained()
        bench.end()
        listener.until("status", status="offline", since=None)
        listener.until("status", status="online")
        assert [document.get("number") for document in listener.on(LEAK)] == [1, 2]


@pytest.mark.slow
def test_a_thousand_changes_wait_through_an_outage(tmp_path: Path, running: Broker) -> None:
    with Relay(running.port) as relay:
        bench = At(tmp_path / "a.sqlite", relay.port)
        bench.put(message(-1))
        bench.drained()
        relay.refuses.set()  # until somebody listens
        running.kill()
        alarms = [f"deviation_{n}" for n in range(7)]
        bench.put(*(message(n, alarms[n % 7]) for n in range(1000)))
        running.start()
        with Listener(running.port) as listener:
            relay.refuses.clear()
            bench.drained()
            listener.until(f"alarm/{alarms[999 % 7]}", number=999)
            for n, alarm in enumerate(alarms):
                assert numbers(listener.on(f"alarm/{alarm}")) == list(range(n, 1000, 7))
        bench.end()


def test_what_was_not_answered_comes_again_in_order(
    tmp_path: Path, running: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network goes when messages have arrived and their answers have not."""
    monkeypatch.setattr(mqtt, "ANSWER_S", 0.2)
    with Relay(running.port) as relay, Listener(running.port) as listener:
        bench = At(tmp_path / "a.sqlite", relay.port)
        bench.put(message(-1))
        bench.drained()  # else the answer to the status might be swallowed
        relay.swallows.set()
        relay.refuses.set()
        bench.put(*(message(n) for n in range(30)))
        wait_until(lambda: bool(bench.said))
        relay.cut()
        relay.swallows.clear()
        relay.refuses.clear()
        bench.drained()
        bench.end()
        listener.until("status", status="offline")
        heard = numbers(listener.on(LEAK))
    assert heard == [-1, *range(20), *range(30)]
    assert "no answer in 0.2 s" in bench.said[0]


def test_only_what_the_broker_has_taken_is_delivered(
    running: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A connection before had the same packet numbers."""
    monkeypatch.setattr(mqtt, "ANSWER_S", 0.2)
    with Relay(running.port) as relay:
        ours = channel(relay.port)
        for _ in range(2):
            ours.open()
            assert ours._answers == {}, "answers that nobody waits for"
            ours.hang_up()
        ours.open()
        assert ours._awaited == set()
        relay.swallows.set()
        sent = ours.send([message(1)])
        ours.hang_up()
        assert (sent.delivered, type(sent.lost)) == ([], LostError)
        relay.swallows.clear()
        ours.open()
        assert ours._awaited == set(), "of a connection that is no more"
        ours.close()


@pytest.mark.needs("mosquitto")
def test_what_is_left_goes_out_with_the_next_program(tmp_path: Path) -> None:
    away = Broker(tmp_path)
    bench = At(tmp_path / "a.sqlite", away.port)
    bench.put(message(1), message(2))
    wait_until(lambda: bool(bench.said))
    bench.end()
    with away, Listener(away.port) as listener:
        later = At(tmp_path / "a.sqlite", away.port)
        later.drained()
        later.end()
        listener.until("status", status="offline")
        assert numbers(listener.on(LEAK)) == [1, 2]


@pytest.mark.needs("mosquitto")
def test_what_the_broker_will_not_have_is_set_aside(tmp_path: Path) -> None:
    """Too large a message would make it hang up, over and over."""
    with broker(tmp_path, "allow_anonymous true", "max_packet_size 2000") as small:
        bench = At(tmp_path / "a.sqlite", small.port)
        large = Message("1", LEAK, json.dumps({"number": 1, "text": "x" * 3000}))
        bench.put(large, message(2))
        bench.drained()
        bench.end()
    ((refused, why),) = bench.outbox.refused("mqtt")
    assert refused.id == "1"
    assert "bytes are more than the 2000 that it takes" in why


@pytest.mark.needs("mosquitto")
def test_what_is_forbidden_is_set_aside(tmp_path: Path) -> None:
    (tmp_path / "acl").write_text("topic write ejector-twin/+/+/status\n", encoding="utf-8")
    lines = ("allow_anonymous true", f"acl_file {tmp_path / 'acl'}")
    with broker(tmp_path, *lines) as strict:
        bench = At(tmp_path / "a.sqlite", strict.port)
        bench.put(message(1))
        bench.drained()
        bench.end()
    ((_, why),) = bench.outbox.refused("mqtt")
    assert "Not authorized" in why
    assert bench.said[0].startswith("mqtt refuses alarms")  # this broker may hang up as well


def test_names_with_a_meaning_in_topics_are_escaped() -> None:
    odd = channel(1, Unit("a/b+c", ""), prefix="plant/cell 3")
    assert odd.topic("alarm", "x#") == "plant/cell 3/a%2Fb%2Bc/-/alarm/x%23"


# --- who may come in ----------------------------------------------------------------------------


def with_users(folder: Path) -> tuple[str, str]:
    """What mosquitto is to be told so that it lets in ann alone, whose password is s3cret."""
    users = folder / "users"
    users.write_text("ann:s3cret\n", encoding="utf-8")
    subprocess.run(["mosquitto_passwd", "-U", users], check=True)
    users.chmod(0o644)
    return "allow_anonymous false", f"password_file {users}"


@pytest.mark.needs("mosquitto")
def test_user_and_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BROKER", "s3cret")
    ann = {"user": "ann", "password": Secret(env="BROKER")}
    with broker(tmp_path, *with_users(tmp_path)) as guarded:
        for known, settings in ((True, ann), (False, {}), (False, ann | {"user": "bob"})):
            ours = channel(guarded.port, **settings)
            if known:
                ours.open()
                ours.close()
                continue
            with pytest.raises(LostError, match="does not let us in: Not authorized"):
                ours.open()
            ours.hang_up()


@pytest.mark.needs("mosquitto", "openssl")
def test_inside_tls(tmp_path: Path) -> None:
    own = certificate(tmp_path)
    lines = ("allow_anonymous true", f"certfile {own}", f"keyfile {own}")
    with broker(tmp_path, *lines) as secured:
        ours = channel(secured.port, tls=ServerTls(trusted=own))
        ours.open()
        ours.close()
        stranger = channel(secured.port, tls=ServerTls())
        with pytest.raises(LostError, match="certificate verify failed"):
            stranger.open()
        stranger.hang_up()


def certificate(folder: Path) -> Path:
    """Of 127.0.0.1, with its key, as PEM."""
    path = folder / "own.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    command += ["-subj", "/CN=broker", "-addext", "subjectAltName=IP:127.0.0.1"]
    key = folder / "key.pem"
    command += ["-keyout", str(key), "-out", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    path.write_text(path.read_text() + key.read_text(), encoding="utf-8")
    return path


# --- as twin run has it -------------------------------------------------------------------------


def config(folder: Path, port: int, **mqtt_table: Any) -> Config:
    tables = {
        "asset": {"type": "compact-ejector-35", "id": "gripper-01"},
        "alarms": {"keep": True},
        "mqtt": {"host": "127.0.0.1", "port": port, **mqtt_table},
    }
    path = folder / "cell.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return Config.of(Document.read(path))


def begun(settings: Config, stream: Stream, said: list[str]) -> Outlets:
    begin = outlets_of(settings, said.append)
    assert begin is not None
    return begin(stream.alarms.standing())


def test_a_run_tells_what_stands_and_what_happens(tmp_path: Path, running: Broker) -> None:
    before, said = Stream(), list[str]()
    before.at(5, deviation(5))
    stream = Stream(before.desk.before)
    with Listener(running.port) as listener:
        outlets = begun(config(tmp_path, running.port, cycles=True), stream, said)
        stands = listener.until(LEAK)
        stream.at(9, Event(9, Kind.DEVIATION_CLEARED, ""))
        outlets.write(NONE, NO_TICKS, stream.said)
        cleared = listener.until(LEAK)
        cycle = Event(10, Kind.CYCLE, "", {"cycle": 7, "t0_measured": 825.0, "t1": float("nan")})
        outlets.write(NONE, NO_TICKS, [cycle])
        figures = listener.until("/cycle")
        outlets.close()
        listener.until("status", status="offline")
    assert (stands["deed"], stands["state"]) == ("restated", "unacknowledged")
    assert (cleared["deed"], cleared["state"]) == ("cleared", "returned")
    assert (figures["cycle"], figures["t0_measured"], figures["t1"]) == (7, 825.0, None)
    assert said == []


@pytest.mark.slow
def test_twin_run_tells_that_its_plc_has_gone(tmp_path: Path, running: Broker) -> None:
    tables = tomllib.loads(rigs.path_of("test_rig").read_text(encoding="utf-8"))
    tables["plc"]["program"]["commands"] = "coils"  # which nobody sets: it stays idle
    tables |= {"alarms": {"keep": True}, "mqtt": {"host": "127.0.0.1", "port": running.port}}
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    command = [sys.executable, "-m", "twin.cli", "run", str(path), "--address"]
    with start_plc(path) as plc, Listener(running.port) as listener:
        command.append(f"127.0.0.1:{plc.port}")
        with subprocess.Popen(command, cwd=rigs.ROOT, stdout=subprocess.DEVNULL) as process:
            try:
                listener.until("rig-01/status", status="online")
                plc.kill()
                stale = listener.until("rig-01/alarm/plc_stale")
                process.send_signal(signal.SIGINT)
                assert process.wait(30) == 130
            finally:
                process.kill()
        stopped = listener.until("rig-01/status", status="offline")
    assert (stale["deed"], stale["priority"], stale["active"]) == ("raised", "high", True)
    assert stopped["since"] is not None
    with open_store(tmp_path / "alarms.sqlite") as store:
        (unit,) = store.units()
    with open_outbox(tmp_path / "alarms.sqlite", unit) as outbox:
        assert outbox.destinations() == []


def test_without_the_tables_nothing_goes_anywhere(tmp_path: Path) -> None:
    plain = Config.of(Document.parse("[data]", str(tmp_path / "a.toml")))
    assert outlets_of(plain, pytest.fail) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[mqtt]\nhots = "a"', "cell.toml:2: mqtt.hots: unknown key"),
        ("[mqtt]\nport = 1", r"cell.toml: \[mqtt\] has no host"),
        ('[mqtt]\nhost = "a"', r"\[alarms\] does not"),
        ('[mqtt]\nhost = "a"\npassword = {env = "A"}', "a password needs a user"),
        ('[mqtt]\nhost = "a"\nuser = "u"\npassword = {env = "A"}', "is not sent in the clear"),
        ('[mqtt]\nhost = "a"\nuser = "u"\npassword = "s3cret"', "mqtt.password"),
        ('[mqtt]\nhost = "a"\nuser = "u"\npassword = {}', "needs one place: file or env"),
        ('[mqtt]\nhost = "a"\nprefix = "a/#"', "mqtt.prefix"),
        ('[mqtt]\nhost = "a"\n[mqtt.tls]\nkey = "k"', "certificate and key belong together"),
    ],
)
def test_what_cannot_be_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(f"{text}\n[data]", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        outlets_of(Config.of(Document.read(path)), pytest.fail)


@pytest.mark.parametrize("content", [None, "", "s3cret\n"])
def test_a_password_that_others_may_read_is_said(tmp_path: Path, content: str | None) -> None:
    said: list[str] = []
    secret, path = Secret(file=Path("pw")), tmp_path / "pw"
    if content is not None:
        path.write_text(content, encoding="utf-8")
        path.chmod(0o644 if content else 0o600)
    if not content:
        with pytest.raises(ConfigError, match=r"\[mqtt\] password.*pw.*(cannot be read|is empty)"):
            secret.read("[mqtt] password", tmp_path, said.append)
        return
    assert secret.read("[mqtt] password", tmp_path, said.append) == "s3cret"
    assert said == [
        f"[mqtt] password: others may read {path}; keep it to yourself: chmod 600 {path}"
    ]
    path.chmod(0o600)
    secret.read("[mqtt] password", tmp_path, pytest.fail)
