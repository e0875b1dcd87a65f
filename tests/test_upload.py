"""Logs that are asked for over a real broker, and arrive at a real HTTP server or in a folder."""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from log_rows import course
from mosquitto import Broker, Listener, broker
from paho.mqtt import publish
from paho.mqtt.client import MQTTv5
from test_alarms_loop import Stream
from test_mqtt import begun, impatient  # noqa: F401 - a fixture
from test_notifications import wait_until

from twin.cli.notifications import outlets_of
from twin.config import Config
from twin.errors import ConfigError
from twin.log.header import LogHeader
from twin.log.part import part_path
from twin.log.recorder import Recorder
from twin.notifications import upload_requests as asked
from twin.notifications import uploader
from twin.notifications.dispatch import Outlets
from twin.settings import Document

TYPE, ID = "compact-ejector-35", "gripper-01"
TOPIC = f"ejector-twin/{TYPE}/{ID}/request"
FORMAT = "ejector-twin-upload-request/1"
HOUR = 3_600_000_000_000
NOON = datetime(2026, 11, 22, 12, tzinfo=UTC)
NOON_NS = round(NOON.timestamp() * 1e9)


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploader, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(uploader, "LONGEST_PAUSE_S", 0.05)


class Store:
    """An HTTP server that keeps what is put there, or answers with what a test says."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}
        self.heads: list[dict[str, str]] = []
        self.answers: list[int] = []  # the next ones; then 201
        self.holds = threading.Event()  # answers nobody before it is set,
        self.holds.set()
        self.free = 0  # but the first ones
        store = self

        class Handler(BaseHTTPRequestHandler):
            def do_PUT(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                store.heads.append(dict(self.headers))
                assert len(store.heads) <= store.free or store.holds.wait(20.0)
                status = store.answers.pop(0) if store.answers else 201
                if status == 201:
                    store.kept[self.path] = body
                self.send_response(status)
                if status == 307:
                    self.send_header("Location", "http://127.0.0.1:9/elsewhere")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/logs"
        self._thread = threading.Thread(target=self.server.serve_forever, args=(0.01,))
        self._thread.start()

    def close(self) -> None:
        self.holds.set()
        self.server.shutdown()
        self.server.server_close()
        self._thread.join()


@pytest.fixture
def store() -> Iterator[Store]:
    made = Store()
    yield made
    made.close()


@pytest.fixture(params=[pytest.param("mosquitto", marks=pytest.mark.needs("mosquitto"))])
def running(tmp_path: Path) -> Iterator[Broker]:
    with broker(tmp_path) as one:
        yield one


def record(path: Path, unit: str = ID, begin_ns: int = NOON_NS, parts: int = 1) -> list[Path]:
    """A finished log of some parts, an hour each."""
    path.parent.mkdir(exist_ok=True)
    header = LogHeader(TYPE, unit, "cell.toml", "[data]")
    with Recorder(path, header, rotate_bytes=1) as log:
        for number in range(parts - 1):
            log.write(*_rows(begin_ns + number * HOUR))
        log._rotate_bytes = None
        log.write(*_rows(begin_ns + (parts - 1) * HOUR))
    return [part_path(path, number) for number in range(parts)]


def _rows(begin_ns: int) -> tuple[Any, Any]:
    samples, ticks = course(10_000)
    samples["host_ns"] = begin_ns + np.arange(len(samples)) * 1_000_000
    return samples, ticks


class Edge:
    """The outlets of a run, with what it says."""

    def __init__(self, here: Path, port: int, **upload: Any) -> None:
        tables: dict[str, Any] = {
            "asset": {"type": TYPE, "id": ID, "batch": "B7"},
            "alarms": {"keep": True},
            "mqtt": {"host": "127.0.0.1", "port": port},
        }
        if upload:
            tables["outlets"] = {"upload": {"logs": "logs", **upload}}
        path = here / "cell.toml"
        path.write_text(tomli_w.dumps(tables), encoding="utf-8")
        self.config, self.said = Config.of(Document.read(path)), list[str]()
        self.outlets: Outlets = begun(self.config, Stream(), self.said)

    def __enter__(self) -> "Edge":
        return self

    def __exit__(self, *_: object) -> None:
        self.outlets.close()


def ask(port: int, number: str | None, **wanted: Any) -> None:
    body = {"format": FORMAT, **({"id": number} if number else {}), **wanted}
    say(port, json.dumps(body))


def say(port: int, payload: str, **how: Any) -> None:
    publish.single(TOPIC, payload, qos=1, hostname="127.0.0.1", port=port, protocol=MQTTv5, **how)


def described(path: Path) -> dict[str, Any]:
    body = path.read_bytes()
    return {"name": path.name, "size": len(body), "sha256": hashlib.sha256(body).hexdigest()}


def test_a_log_that_is_asked_for_arrives_whole(
    tmp_path: Path, running: Broker, store: Store
) -> None:
    parts = record(tmp_path / "logs" / "today.mcap", parts=3)
    secret = tmp_path / "token"
    secret.write_text("Bearer s3cret", encoding="utf-8")
    secret.chmod(0o600)
    headers = {"Authorization": {"file": "token"}}
    with (
        Listener(running.port) as heard,
        Edge(tmp_path, running.port, url=store.url, headers=headers),
    ):
        heard.until("/status", status="online")
        ask(running.port, "a-1", log="today.mcap")
        answers = [heard.until("/upload", request="a-1") for _ in range(3)]
    assert [answer["state"] for answer in answers] == ["accepted", "running", "done"]
    assert answers[-1]["files"] == [described(path) for path in parts]
    assert answers[-1]["asset"] == {"type": TYPE, "id": ID, "batch": "B7"}
    assert answers[-1]["unfinished"] == []
    assert store.kept == {f"/logs/{TYPE}/{ID}/{path.name}": path.read_bytes() for path in parts}
    assert {head["Authorization"] for head in store.heads} == {"Bearer s3cret"}
    sent = hashlib.sha256(parts[0].read_bytes()).digest()
    assert store.heads[0]["Content-Digest"] == f"sha-256=:{base64.b64encode(sent).decode()}:"


def test_a_range_of_time_finds_the_parts_that_were_received_then(
    tmp_path: Path, running: Broker
) -> None:
    record(tmp_path / "logs" / "a.mcap", parts=3)
    record(tmp_path / "logs" / "b.mcap", begin_ns=NOON_NS - 5 * HOUR)
    record(tmp_path / "logs" / "theirs.mcap", unit="gripper-02")
    (tmp_path / "share").mkdir()
    begin, end = NOON + timedelta(minutes=30), NOON + timedelta(minutes=90)
    with Listener(running.port) as heard, Edge(tmp_path, running.port, folder="share"):
        heard.until("/status", status="online")
        ask(running.port, "r", **{"from": begin.isoformat(), "to": end.isoformat()})
        done = heard.until("/upload", state="done")
    assert [file["name"] for file in done["files"]] == ["a.0001.mcap"]
    (copy,) = (tmp_path / "share").rglob("*.*cap*")
    assert copy.read_bytes() == (tmp_path / "logs" / "a.0001.mcap").read_bytes()


def test_what_is_still_written_is_not_uploaded(tmp_path: Path, running: Broker) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "share").mkdir()
    header = LogHeader(TYPE, ID, "cell.toml", "[data]")
    with (
        Recorder(tmp_path / "logs" / "live.mcap", header, rotate_bytes=1) as log,
        Listener(running.port) as heard,
        Edge(tmp_path, running.port, folder="share"),
    ):
        heard.until("/status", status="online")
        ask(running.port, "1", log="live.mcap")
        none = heard.until("/upload", state="refused")
        log.write(*_rows(NOON_NS))
        ask(running.port, "2", log="live.mcap")
        done = heard.until("/upload", state="done")
    assert none["why"] == "no finished file of a log is like that; not finished: live.mcap"
    assert [file["name"] for file in done["files"]] == ["live.mcap"]
    assert done["unfinished"] == ["live.0001.mcap"]


def test_nothing_else_is_ever_uploaded(tmp_path: Path, running: Broker, store: Store) -> None:
    record(tmp_path / "logs" / "ours.mcap")
    record(tmp_path / "logs" / "theirs.mcap", unit="gripper-02")
    (outside,) = record(tmp_path / "elsewhere" / "secret.mcap")
    (tmp_path / "logs" / "link.mcap").symlink_to(outside)
    (tmp_path / "logs" / "text.mcap").write_text("no log", encoding="utf-8")
    (tmp_path / "logs" / "notes.txt").write_text("no log", encoding="utf-8")
    names = {
        "../elsewhere/secret.mcap": "there is no log of that name",
        str(outside): "there is no log of that name",
        "logs/ours.mcap": "there is no log of that name",
        "link.mcap": "there is no log of that name",
        "notes.txt": "there is no log of that name",
        "ours.mcap\0": "there is no log of that name",
        "text.mcap": "the file of that name cannot be read as a log",
        "theirs.mcap": "that is the log of another asset",
    }
    with Listener(running.port) as heard, Edge(tmp_path, running.port, url=store.url):
        heard.until("/status", status="online")
        for number, (name, why) in enumerate(names.items()):
            ask(running.port, str(number), log=name)
            assert heard.until("/upload", request=str(number), state="refused")["why"] == why, name
    assert store.heads == []


def test_a_link_among_the_parts_is_left_out(tmp_path: Path, running: Broker) -> None:
    first, second = record(tmp_path / "logs" / "ours.mcap", parts=2)
    second.rename(tmp_path / "moved.mcap")
    second.symlink_to(tmp_path / "moved.mcap")
    (tmp_path / "share").mkdir()
    with Listener(running.port) as heard, Edge(tmp_path, running.port, folder="share"):
        heard.until("/status", status="online")
        ask(running.port, "1", log=first.name)
        done = heard.until("/upload", state="done")
    assert [file["name"] for file in done["files"]] == [first.name]


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        ("{", "Invalid JSON"),
        ("[" * 4000, "Invalid JSON"),
        ("{" + " " * 5000 + "}", "a request has 4096 bytes at most"),
        ('{"format": "ejector-twin-upload-request/1", "log": "a.mcap"}', "id: Field required"),
        (f'{{"format": "{FORMAT}", "id": "../x", "log": "a.mcap"}}', "id: String should match"),
        (f'{{"format": "{FORMAT}", "id": "1"}}', "name a log, or from and to"),
        (f'{{"format": "{FORMAT}", "id": "1", "log": "a", "url": "http://x"}}', "url: unknown key"),
        (
            f'{{"format": "{FORMAT}", "id": "1", "from": "2026-11-22T12:00:00", "to": null}}',
            "from: Input should have timezone info",
        ),
    ],
)
def test_what_is_no_request_is_refused(payload: str, why: str) -> None:
    with pytest.raises(asked.RefusedError, match=why):
        asked.parse(payload.encode())


def test_a_request_that_cannot_be_read_is_answered(tmp_path: Path, running: Broker) -> None:
    with Listener(running.port) as heard, Edge(tmp_path, running.port, folder="share"):
        heard.until("/status", status="online")
        say(running.port, '{"format": "no"}')
        assert heard.until("/upload", request=None)["state"] == "refused"


def test_it_goes_on_where_it_was_after_a_restart(
    tmp_path: Path, running: Broker, store: Store
) -> None:
    parts = record(tmp_path / "logs" / "today.mcap", parts=3)
    store.answers = [201, 503, 503]
    store.free = 2
    store.holds.clear()
    with Listener(running.port) as heard:
        with Edge(tmp_path, running.port, url=store.url) as first:
            heard.until("/status", status="online")
            ask(running.port, "a", log="today.mcap")
            heard.until("/upload", state="running")
            wait_until(lambda: len(store.heads) == 3)  # the second part again, which hangs
            first.outlets._uploader.end()  # type: ignore[union-attr]
            store.holds.set()
        assert any("status 503" in line for line in first.said)
        assert list(store.kept) == [f"/logs/{TYPE}/{ID}/today.mcap"]
        with Edge(tmp_path, running.port, url=store.url):
            done = heard.until("/upload", state="done")
        assert len(store.heads) == 3 + 2, "what has arrived is not sent again"
    assert done["files"] == [described(path) for path in parts]


def test_a_request_finds_an_edge_that_was_away(tmp_path: Path, running: Broker) -> None:
    record(tmp_path / "logs" / "today.mcap")
    (tmp_path / "share").mkdir()
    with Listener(running.port) as heard:
        with Edge(tmp_path, running.port, folder="share"):
            heard.until("/status", status="online")
        ask(running.port, "away", log="today.mcap")
        with Edge(tmp_path, running.port, folder="share"):
            heard.until("/upload", request="away", state="done")


def test_asked_twice_it_is_done_once(tmp_path: Path, running: Broker, store: Store) -> None:
    record(tmp_path / "logs" / "today.mcap")
    with Listener(running.port) as heard, Edge(tmp_path, running.port, url=store.url):
        heard.until("/status", status="online")
        ask(running.port, "same", log="today.mcap")
        first = heard.until("/upload", state="done")
        ask(running.port, "same", log="other.mcap")
        second = heard.until("/upload", state="done")
    assert first["files"] == second["files"]
    assert len(store.heads) == 1


def test_too_many_requests_are_refused(
    tmp_path: Path, running: Broker, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploader, "MOST_OPEN", 2)
    record(tmp_path / "logs" / "today.mcap")
    store.holds.clear()
    with Listener(running.port) as heard, Edge(tmp_path, running.port, url=store.url):
        heard.until("/status", status="online")
        for number in "123":
            ask(running.port, number, log="today.mcap")
        refused = heard.until("/upload", state="refused")
        store.holds.set()
        heard.until("/upload", request="2", state="done")
    assert (refused["request"], "wait already" in refused["why"]) == ("3", True)


@pytest.mark.parametrize("status", [307, 403])
def test_a_place_that_will_not_have_it_is_not_asked_again(
    tmp_path: Path, running: Broker, store: Store, status: int
) -> None:
    record(tmp_path / "logs" / "today.mcap")
    store.answers = [status]
    with Listener(running.port) as heard, Edge(tmp_path, running.port, url=store.url):
        heard.until("/status", status="online")
        ask(running.port, "1", log="today.mcap")
        refused = heard.until("/upload", state="refused")
    assert refused["why"] == f"the place of uploads answers with status {status}"
    assert len(store.heads) == 1


def test_nothing_in_a_folder_is_replaced_and_a_share_is_waited_for(
    tmp_path: Path, running: Broker
) -> None:
    (log,) = record(tmp_path / "logs" / "today.mcap")
    share = tmp_path / "share"
    with (
        Listener(running.port) as heard,
        Edge(tmp_path, running.port, folder="share") as edge,
    ):
        heard.until("/status", status="online")
        ask(running.port, "1", log="today.mcap")
        wait_until(lambda: bool(edge.said))
        assert edge.said[0].startswith("uploads wait: ")
        assert not share.exists()
        share.mkdir()
        heard.until("/upload", request="1", state="done")
        (copy,) = (path for path in share.rglob("*") if path.is_file())
        assert copy.read_bytes() == log.read_bytes()
        ask(running.port, "2", log="today.mcap")
        heard.until("/upload", request="2", state="done")
        copy.write_text("theirs", encoding="utf-8")
        ask(running.port, "3", log="today.mcap")
        refused = heard.until("/upload", request="3", state="refused")
    assert refused["why"] == "another file called today.mcap is already there"
    assert copy.read_text() == "theirs"


def test_it_is_off_by_default(tmp_path: Path, running: Broker) -> None:
    record(tmp_path / "logs" / "today.mcap")
    with Listener(running.port) as heard:
        with Edge(tmp_path, running.port) as edge:
            heard.until("/status", status="online")
            assert edge.outlets._uploader is None
            ask(running.port, "1", log="today.mcap")
            heard.until("/request")
        heard.until("/status", status="offline")
        assert heard.on("/upload") == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('logs = "a"', "needs one place: url or folder"),
        ('logs = "a"\nurl = "http://h/x"\nfolder = "b"', "needs one place: url or folder"),
        ('folder = "b"', "outlets.upload.logs: is missing"),
        ('logs = "a"\nurl = "ftp://h/x"', "is no address"),
        ('logs = "a"\nurl = "http://h/x"\nheaders = {A = {env = "B"}}', "take https"),
    ],
)
def test_what_cannot_be_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(f'[mqtt]\nhost = "h"\n[outlets.upload]\n{text}\n[data]', encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        outlets_of(Config.of(Document.read(path)), pytest.fail)


def test_without_a_broker_nobody_can_ask(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text('[outlets.upload]\nlogs = "a"\nfolder = "b"\n[data]', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"there is no \[mqtt\]"):
        outlets_of(Config.of(Document.read(path)), pytest.fail)
