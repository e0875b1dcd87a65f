"""Alarms by POST at a real HTTP server: again where that helps, set aside where it does not."""

import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from independent import free_port
from test_alarms_loop import LEAK, NONE, Stream, deviation
from test_mqtt import certificate
from test_notifications import NO_TICKS, Bench, message, wait_until

from twin.cli.notifications import outlets_of
from twin.config import Config
from twin.errors import ConfigError
from twin.notifications import sender
from twin.notifications.sender import LostError, Sent
from twin.notifications.settings import Secret, ServerTls, WebhookSettings
from twin.notifications.webhook import Webhook
from twin.settings import Document


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.05)


class Server:
    """Takes what is posted; a test says with which status it answers."""

    def __init__(self, port: int = 0, certificate: Path | None = None) -> None:
        self.heard: list[tuple[dict[str, str], dict[str, Any], int]] = []
        self.answers: list[int] = []  # the next ones; then 204
        self.hangs = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                if outer.hangs.is_set():
                    outer.release.wait(20.0)
                    return
                status = outer.answers.pop(0) if outer.answers else 204
                outer.heard.append((dict(self.headers), json.loads(body), status))
                self.send_response(status)
                self.send_header("Location", "/elsewhere")
                self.send_header("Content-Length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None: ...

        self.release = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = False
        if certificate is not None:
            context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
            context.load_cert_chain(certificate)
            self._server.socket = context.wrap_socket(self._server.socket, server_side=True)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    def taken(self) -> list[str]:
        return [headers["Idempotency-Key"] for headers, _, status in self.heard if status < 300]

    def close(self) -> None:
        self.release.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def server() -> Iterator[Server]:
    running = Server()
    yield running
    running.close()


class At(Bench):
    """A sender to an address."""

    def __init__(self, path: Path, port: int, **settings: Any) -> None:
        super().__init__(path)
        wanted = WebhookSettings(url=f"http://127.0.0.1:{port}/alarms", **settings)
        self.sender._channel = Webhook(wanted, Path(), pytest.fail)
        self.sender.start()

    def drained(self) -> None:
        wait_until(lambda: self.outbox.count("mqtt") == 0)


def test_each_change_is_posted_with_its_id(tmp_path: Path, server: Server) -> None:
    text = f"""
[asset]
type = "compact-ejector-35"
id = "gripper-01"
[alarms]
keep = true
[webhook]
url = "http://127.0.0.1:{server.port}/alarms"
[webhook.headers]
Authorization = {{file = "token"}}
"""
    (tmp_path / "token").write_text("Bearer s3cret\n", encoding="utf-8")
    (tmp_path / "token").chmod(0o600)
    path, said = tmp_path / "cell.toml", list[str]()
    path.write_text(text, encoding="utf-8")
    begin = outlets_of(Config.of(Document.read(path)), said.append)
    assert begin is not None
    stream = Stream()
    stream.at(5, deviation(5))
    outlets = begin([])
    outlets.write(NONE, NO_TICKS, stream.said)
    outlets.close()
    ((headers, body, _),) = server.heard
    assert headers["Idempotency-Key"] == body["id"]
    assert headers["Authorization"] == "Bearer s3cret"
    assert headers["Content-Type"] == "application/json"
    assert (body["alarm"], body["deed"], body["state"]) == (LEAK, "raised", "unacknowledged")
    assert said == []


def test_what_stands_is_not_posted_anew_by_every_run(tmp_path: Path, server: Server) -> None:
    before = Stream()
    before.at(5, deviation(5))
    stands = Stream(before.desk.before).alarms.standing()
    path = tmp_path / "cell.toml"
    url = f"http://127.0.0.1:{server.port}/"
    path.write_text(f'[data]\n[alarms]\nkeep = true\n[webhook]\nurl = "{url}"', encoding="utf-8")
    begin = outlets_of(Config.of(Document.read(path)), pytest.fail)
    assert begin is not None
    begin(stands).close()
    assert server.heard == []


@pytest.mark.parametrize("status", [500, 503, 408, 425, 429])
def test_what_may_come_later_is_posted_again(tmp_path: Path, server: Server, status: int) -> None:
    server.answers = [204, status, status]
    bench = At(tmp_path / "a.sqlite", server.port)
    bench.put(*(message(n) for n in range(4)))
    bench.drained()
    bench.end()
    keys = [headers["Idempotency-Key"] for headers, _, _ in server.heard]
    assert keys == ["0", "1", "1", "1", "2", "3"]
    assert server.taken() == ["0", "1", "2", "3"]
    assert f"status {status}" in bench.said[0]
    assert bench.outbox.refused("mqtt") == []


@pytest.mark.parametrize("status", [400, 401, 404, 301, 307])
def test_what_is_wrong_for_good_is_set_aside(tmp_path: Path, server: Server, status: int) -> None:
    server.answers = [status]
    bench = At(tmp_path / "a.sqlite", server.port)
    bench.put(message(1), message(2))
    bench.drained()
    bench.end()
    assert server.taken() == ["2"]
    ((refused, why),) = bench.outbox.refused("mqtt")
    assert (refused.id, f"status {status}" in why) == ("1", True)
    assert len(bench.said) == 1


def test_a_server_that_comes_later_gets_everything_in_order(tmp_path: Path) -> None:
    port = free_port()
    bench = At(tmp_path / "a.sqlite", port)
    bench.put(*(message(n) for n in range(50)))
    wait_until(lambda: bool(bench.said))
    server = Server(port)
    bench.drained()
    bench.end()
    server.close()
    assert server.taken() == [str(n) for n in range(50)]
    assert "Connection refused" in bench.said[0]


def test_a_server_that_does_not_answer_is_asked_again(tmp_path: Path, server: Server) -> None:
    server.hangs.set()
    bench = At(tmp_path / "a.sqlite", server.port, timeout_s=0.5)
    bench.put(message(1))
    wait_until(lambda: bool(bench.said))
    server.hangs.clear()
    server.release.set()
    bench.drained()
    bench.end()
    assert server.taken() == ["1"]
    assert "timed out" in bench.said[0]


@contextmanager
def answering(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """A port that takes one request and lets ``answer`` say what it will."""

    def serve() -> None:
        taken, _ = listener.accept()
        with taken, suppress(OSError):  # the other side may leave
            taken.recv(65536)
            answer(taken)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        thread.join()


def posted(port: int, timeout_s: float) -> Sent:
    url = f"http://127.0.0.1:{port}/"
    hook = Webhook(WebhookSettings(url=url, timeout_s=timeout_s), Path(), pytest.fail)
    sent = hook.send([message(1)])
    hook.close()
    return sent


def test_an_answer_that_drips_is_not_waited_for() -> None:
    def drip(taken: socket.socket) -> None:
        taken.sendall(b"HTTP/1.1 204 No Content\r\nX: ")
        for _ in range(100):
            taken.sendall(b"x")
            time.sleep(0.02)
        taken.sendall(b"\r\n\r\n")

    with answering(drip) as port:
        sent = posted(port, 0.2)
    assert sent.delivered == []
    assert "timed out" in str(sent.lost)


def test_what_comes_with_an_answer_is_not_read() -> None:
    gone = threading.Event()

    def promise(taken: socket.socket) -> None:
        taken.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000\r\n\r\n")
        gone.wait(20.0)

    with answering(promise) as port:
        sent = posted(port, 5.0)
        gone.set()
    assert sent.delivered == [message(1)]


@pytest.mark.needs("openssl")
def test_inside_tls(tmp_path: Path) -> None:
    own = certificate(tmp_path)
    server = Server(certificate=own)
    url = f"https://127.0.0.1:{server.port}/"
    trusting = Webhook(WebhookSettings(url=url, tls=ServerTls(trusted=own)), Path(), pytest.fail)
    assert trusting.send([message(1)]).delivered == [message(1)]
    trusting.close()
    stranger = Webhook(WebhookSettings(url=url), Path(), pytest.fail)
    lost = stranger.send([message(2)]).lost
    stranger.close()
    server.close()
    assert isinstance(lost, LostError)
    assert "certificate verify failed" in str(lost)
    assert server.taken() == ["1"]


def test_what_follows_the_address_is_not_told(tmp_path: Path, server: Server) -> None:
    """Many such addresses have their secret in the path."""
    (tmp_path / "url").write_text(f"http://127.0.0.1:{server.port}/hooks/s3cret?token=s3cret")
    (tmp_path / "url").chmod(0o600)
    hook = Webhook(WebhookSettings(url=Secret(file=Path("url"))), tmp_path, pytest.fail)
    server.answers = [500, 400]
    told = [str(hook.send([message(1)]).lost), *hook.send([message(1)]).refused.values()]
    hook.close()
    server.close()
    told.append(str(hook.send([message(1)]).lost))
    hook.close()
    assert [line for line in told if "s3cret" in line] == []


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"url": "cloud.example/alarms"}, "is no address"),
        ({"url": "https://a:b@cloud.example"}, "a password goes into headers"),
        ({"url": "http://cloud.example", "headers": {"A": {"env": "B"}}}, "take https"),
        ({"url": "https://cloud.example", "headers": {"A b": {"env": "B"}}}, "headers"),
        ({"url": "https://cloud.example", "headers": {"A": "secret"}}, "headers.A"),
    ],
)
def test_what_cannot_be_is_refused(table: dict[str, Any], message: str) -> None:
    document = Document("cell.toml", "", {"webhook": table})
    with pytest.raises(ConfigError, match=message):
        document.section(WebhookSettings, "webhook")


def test_a_header_that_nobody_has_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TOKEN", raising=False)
    wanted = WebhookSettings(url="https://a", headers={"A": Secret(env="TOKEN")})
    with pytest.raises(ConfigError, match=r"\[webhook\] headers.A: environment variable TOKEN"):
        Webhook(wanted, Path(), pytest.fail)


def test_a_secret_may_end_its_line(monkeypatch: pytest.MonkeyPatch, server: Server) -> None:
    monkeypatch.setenv("TOKEN", "Bearer s3cret\r\n")
    url = f"http://127.0.0.1:{server.port}/"
    wanted = WebhookSettings(url=url, headers={"A": Secret(env="TOKEN")})
    hook = Webhook(wanted, Path(), pytest.fail)
    assert hook.send([message(1)]).delivered == [message(1)]
    hook.close()
    assert server.heard[0][0]["A"] == "Bearer s3cret"


@pytest.mark.parametrize(
    ("secret", "why"),
    [
        ("two\nlines", "on one line"),
        ("\udcff", "on one line"),
        ("ключ", "Latin"),
    ],
)
def test_a_secret_that_cannot_be_sent(
    monkeypatch: pytest.MonkeyPatch, secret: str, why: str
) -> None:
    monkeypatch.setenv("TOKEN", secret)
    wanted = WebhookSettings(url="https://a", headers={"A": Secret(env="TOKEN")})
    with pytest.raises(ConfigError, match=r"\[webhook\] headers.A") as caught:
        Webhook(wanted, Path(), pytest.fail)
    assert why in caught.value.hint
    assert secret not in str(caught.value)


def test_a_request_that_cannot_be_made_is_lost_without_its_secrets(server: Server) -> None:
    hook = Webhook(WebhookSettings(url=f"http://127.0.0.1:{server.port}/"), Path(), pytest.fail)
    hook._headers["A"] = "s3cret\n"
    lost = hook.send([message(1)]).lost
    hook.close()
    assert isinstance(lost, LostError)
    assert "s3cret" not in str(lost)
