"""A connection inside TLS waits as a plain one does: for whole answers, and not for ever."""

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from independent import pem

from drivers import certificates
from drivers.lasting import LostError
from drivers.link import Link, ModbusSettings
from drivers.sources import open_source
from drivers.tags import Address
from drivers.telegram import Request
from twin.errors import ConfigError
from twin.settings import Document

FOUR = Request(Address("input", 1), 4)
TIMEOUT_MS = 100
ANSWER = FOUR.head(1, 1) + bytes(range(8))


class Plc:
    """Shakes hands with one client after the other, and does with its first request as told."""

    def __init__(self, folder: Path, act: Callable[[ssl.SSLSocket], None]) -> None:
        certificates.make(folder)
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(pem(folder), folder / certificates.KEY)
        self._act = act
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with suppress(OSError):
            client, _ = self._listener.accept()
            with self._context.wrap_socket(client, server_side=True) as inside:
                assert len(inside.recv(12)) == 12
                self._act(inside)
                inside.recv(1)  # until the client has gone

    def close(self) -> None:
        self._listener.close()
        self._thread.join()


@pytest.fixture
def linked(tmp_path: Path) -> Iterator[Callable[[Callable[[ssl.SSLSocket], None]], Link]]:
    opened: list[Link | Plc] = []

    def link_to(act: Callable[[ssl.SSLSocket], None]) -> Link:
        plc = Plc(tmp_path, act)
        tag = {"address": "30002", "type": "float32", "unit": "mbar", "reference": "absolute"}
        table = {"host": "127.0.0.1", "port": plc.port, "timeout_ms": TIMEOUT_MS}
        tls = {"trusted": tmp_path / certificates.OWN, "name": socket.gethostname()}
        link = Link(ModbusSettings.model_validate(table | {"tags": {"pressure": tag}, "tls": tls}))
        opened.extend((link, plc))
        link.open()
        return link

    yield link_to
    for one in opened:
        one.close()


def test_an_answer_comes_in_pieces(linked: Callable[..., Link]) -> None:
    def act(client: ssl.SSLSocket) -> None:
        for piece in (ANSWER[:3], ANSWER[3:10], ANSWER[10:]):
            client.sendall(piece)
            time.sleep(0.01)

    assert linked(act).read(FOUR.address, 4).tolist() == [0x0001, 0x0203, 0x0405, 0x0607]


def dribble(client: ssl.SSLSocket) -> None:
    for byte in ANSWER:
        client.sendall(bytes([byte]))
        time.sleep(0.6 * TIMEOUT_MS * 1e-3)


@pytest.mark.parametrize("act", [lambda client: None, dribble], ids=["silent", "dribbling"])
def test_one_that_does_not_answer_in_time_is_lost(
    linked: Callable[..., Link], act: Callable[[ssl.SSLSocket], None]
) -> None:
    link = linked(act)
    begun = time.monotonic()
    with pytest.raises(LostError, match="no answer"):
        link.read(FOUR.address, 4)
    assert time.monotonic() - begun < 5 * TIMEOUT_MS * 1e-3
    with pytest.raises(LostError, match="the connection is closed"):
        link.read(FOUR.address, 4)


def test_one_that_hangs_up_at_once_may_not_want_us(linked: Callable[..., Link]) -> None:
    link = linked(lambda client: client.close())
    with pytest.raises(LostError, match="it does not trust our certificate, or wants one"):
        link.read(FOUR.address, 4)


def test_files_lie_beside_the_configuration(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        text = f"""
            [driver]
            host = "127.0.0.1"
            port = {listener.getsockname()[1]}
            [driver.tags.pressure]
            address = "30002"
            type = "float32"
            unit = "mbar"
            reference = "absolute"
            [driver.tls]
            trusted = "plc.pem"
        """
        document = Document.parse(text, str(tmp_path / "rig.toml"))
        with (
            closing(open_source(document)) as source,  # type: ignore[type-var]
            pytest.raises(ConfigError, match=f"trusted {tmp_path}/plc.pem: cannot be used"),
        ):
            next(source)
