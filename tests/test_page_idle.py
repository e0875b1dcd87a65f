"""Connections that ask for nothing: let go, so that others find room."""

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from twin.page import server as module
from twin.page.server import Place, listen, make_server

GET = b"GET / HTTP/1.1\r\nHost: h\r\n"
PATIENCE_S = 30.0


async def answer(_request: Request) -> PlainTextResponse:
    return PlainTextResponse("here")


@pytest.fixture
def port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(module, "HEAD_S", 0.3)
    monkeypatch.setattr(module, "MOST_AT_ONCE", 5)
    place = Place("127.0.0.1", 0)
    server = make_server(Starlette(routes=[Route("/", answer)]), place)
    with listen(place) as listening:
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield listening.getsockname()[1]
        server.should_exit = True
        thread.join()


def come(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), PATIENCE_S)


def asked(port: int) -> bytes:
    with come(port) as browser:
        browser.sendall(GET + b"Connection: close\r\n\r\n")
        return b"".join(iter(lambda: browser.recv(4096), b""))


@pytest.mark.parametrize("said", [b"", GET], ids=["nothing", "half of a head"])
def test_who_does_not_ask_is_let_go_and_others_find_room(port: int, said: bytes) -> None:
    idle = [come(port) for _ in range(8)]
    for connection in idle:
        connection.sendall(said)
    for connection in idle:
        with connection:
            assert connection.recv(1) == b""  # or it would wait for as long as PATIENCE_S
    assert asked(port).endswith(b"here")


def test_half_of_a_second_request_is_let_go(port: int) -> None:
    with come(port) as browser:
        browser.sendall(GET + b"\r\n")
        answered = b""
        while not answered.endswith(b"here"):
            answered += browser.recv(4096)
        browser.sendall(GET)
        assert browser.recv(1) == b""
